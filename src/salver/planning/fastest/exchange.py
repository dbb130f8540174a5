"""Conditions for all times, not only at nodes: optimise, check on a finer grid, add nodes where a row is broken.

The exchange method for semi-infinite programmes (Hettich and Kortanek, SIAM Review 35(3), 1993).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array, Indices
from salver.planning.fastest.constraints import Constraint, evaluate, violated
from salver.planning.fastest.curves import Curve, Grid, united
from salver.planning.fastest.evaluation import MotionEvaluation
from salver.planning.fastest.objectives import Duration, Objective, Point, Scalar
from salver.planning.fastest.problem import TransportProblem, with_missed_cases
from salver.planning.fastest.programme import Iterate, Programme
from salver.planning.fastest.spline import SplineMotion
from salver.planning.fastest.sqp import SqpOptions, SqpSolution, minimise
from salver.planning.fastest.starts import TOUCHES
from salver.planning.fastest.trust import Trust
from salver.planning.fastest.watch import Watch

ROUGH_GAIN = 1e-2  # relative shortening below which a rough optimum is good enough
GAIN = 1e-3  # and one at which an optimum is
ROUGH_ITERATIONS = 25  # at most, of a rough optimum
ITERATIONS = 60  # and of one
REPAIR_ITERATIONS = 15  # of each round of adding nodes
HASTE = 0.8  # of a duration at which a path keeps its rows, that is tried next
HASTENED = 0.03  # damping of the first step from the shortest of these
ROUGH_EXCHANGES = 2  # rounds of adding nodes to a rough optimum,
LOOKS = 4  # that is looked at so often from one node to the next,
BINDING = 0.02  # rows nearer than this to their edge, in their unit, bind
EXCHANGES = 6  # rounds of adding nodes
HOPELESS = 0.2  # a row broken by this share of its scale will not be repaired by more nodes
HOPELESS_AT_NODES = 1e-2  # and nor will one that is broken at the nodes already
REPAIR = 0.4  # damping of the first step after nodes were added: ever more mending, ever less search
SLUGGISH = 10.0  # times that, with liquids
LEFT = 9e-4  # violation that is then left to a repair: what the nodes keep from the edge and the check does not,
MENDED = 3e-4  # or less, with liquids
LOOSE_GAIN, LOOSE = 5e-3, 1e-2  # gain and violation of the first optimum with liquids, which shows what cases it lacks
LOOSELY_POOR = 0.6  # share of what was hoped for below which a step towards that is corrected
EARNEST = 0.5  # of the gain: of the next one, in which what the arm gives way to the liquids is given
REPAIR_DEPTH = 0.02  # what is near enough to matter to such a step
SMALL_EXCESS = 2e-3  # what is left to a slightly longer duration instead of another round of optimisation
SMALL_EXCESS_OF_WAVES = 5e-4  # with liquids: waves need not become lower
WAVES_PER_SPAN = 1  # nodes more, where liquids remember what was between them
POINTS = 2  # from node to node, where joint limits are imposed
CHECK_FACTOR = 6  # the check between nodes uses a grid this much finer
CHECK_FACTOR_OF_WAVES = 4  # where nodes are closer already
POINTS_CHECKED = 5  # and where the joints' limits are, from one point of that grid to the next

SHORTEST = Duration()

CurveOf = Callable[[TransportProblem, Grid], Curve]


@dataclass(frozen=True)
class Checked:
    """Coefficients (size, m), duration and margin (as in `Point`) of a motion whose rows were checked on the fine grid.

    problem: with all the cases of liquids that were looked at.
    worst: largest row of each block there, <= 0 when kept. binding: names of those blocks that hinder a shorter time:
    that depend on time, and come near their edge. iterations: of all rounds. looked: whether the check looked at every
    fill and damping of a liquid, along this very motion.
    """

    problem: TransportProblem
    coefficients: Array
    duration: float
    margin: float
    status: Status
    worst: dict[str, float]
    binding: tuple[str, ...]
    iterations: int
    looked: bool = False


def programme_of(
    problem: TransportProblem,
    curve_of: CurveOf,
    start: SplineMotion,
    nodes: Array,
    objective: Objective = SHORTEST,
    points: int = POINTS,
    watched: Sequence[Constraint] | None = None,
) -> Programme:
    """The programme at nodes (N,) in [0, 1], watching, for a shorter time, only what comes near along the start.

    curve_of: makes the curve of a problem and grid. points: from node to node, where the joints' limits are imposed.
    watched: the constraints, when it is known what comes near.
    """
    curve = curve_of(problem, Grid.of(start.spline, nodes, points))
    constraints = problem.constraints if watched is None else watched
    if watched is None and objective.scalar is Scalar.DURATION:  # others may lead far from where they begin
        postures = curve.motion(start.coefficients, start.duration)[0, curve.grid.nodes]
        constraints = tuple(constraint.near(postures) for constraint in constraints)
    return Programme(curve, constraints, objective)


def optimise(
    problem: TransportProblem,
    curve_of: CurveOf,
    start: SplineMotion,
    nodes_per_span: int,
    watch: Watch | None = None,
    damping: float = 1.0,
    objective: Objective = SHORTEST,
    iterations: int = ITERATIONS,
    gain: float = GAIN,
    also: Array | None = None,
    beat: float = np.inf,
) -> Checked:
    """The optimum from a start, kept between the nodes too; of the duration, unless another objective is given.

    gain: relative improvement below which an iteration counts as idle. also: more nodes, s in [0, 1]. beat: s; given up
    where it will hardly be shorter than this: nodes that are added only make it longer.
    """
    watch = watch or Watch()
    spline = start.spline
    nodes = spline.nodes(nodes_per_span + WAVES_PER_SPAN * bool(problem.liquids))
    nodes = nodes if also is None else united(nodes, also)
    finer = CHECK_FACTOR_OF_WAVES if problem.liquids else CHECK_FACTOR
    check = Grid.of(spline, Grid.of(spline, nodes, finer).s, POINTS_CHECKED)
    fine = curve_of(problem, check)

    programme = programme_of(problem, curve_of, start, nodes, objective)
    begun = programme.begin(start.coefficients, start.duration)
    first = SqpOptions(iterations, watch, gain=gain, beat=beat)
    if problem.liquids:  # more cases of them will join
        first = SqpOptions(iterations, watch, gain=LOOSE_GAIN, violation=LOOSE, poor=LOOSELY_POOR)
    solution = minimise(programme, begun, first, Trust(damping))
    done = solution.iterations
    for exchange in range(EXCHANGES + 1):
        point = solution.iterate.point
        if point.duration > beat:
            status = Status("beaten", f"No safe motion in less than {beat:.4f} s was found.", False)
            return Checked(problem, point.coefficients, point.duration, point.margin, status, {}, (), done)
        seen = _seen(fine, point)
        more = with_missed_cases(problem, seen, point.margin)
        if more is not None:  # fills and dampings that no row stood for
            problem, fine = more, curve_of(more, check)
            seen = _seen(fine, point).feeling(seen.terms).straying(seen.response)
        worst, binding, slower, peaks = _between(fine, objective, point, seen)
        if objective.scalar is Scalar.DURATION:
            worst, binding, point = _slowed(fine, objective, point, worst, binding, slower)
        excess = max(worst.values())
        late = watch.over()
        hopeless = excess > HOPELESS or solution.iterate.violation > HOPELESS_AT_NODES
        if excess <= 0.0 or hopeless or exchange == EXCHANGES or late:
            break
        before, nodes = nodes, united(nodes, fine.grid.s[peaks])
        if len(nodes) == len(before):  # what is broken is driven by what was between them: waves
            nodes = united(nodes, 0.5 * (nodes[1:] + nodes[:-1]))
        options, repair = _repair(problem, exchange, iterations, gain, watch)
        # A repair leads nowhere else: unless something that was not watched came too near, the same is watched.
        same = all(value <= 0.0 or name in binding for name, value in worst.items())
        watched = programme.constraints if same else None
        start = SplineMotion(spline, point.coefficients, point.duration)
        programme = programme_of(problem, curve_of, start, nodes, objective, watched=watched)
        programme = replace(programme, given=bool(problem.liquids))
        begun = programme.begin(start.coefficients, start.duration)
        solution = minimise(programme, begun, options, Trust(repair, REPAIR_DEPTH))
        done += solution.iterations
    status = _status(solution, worst, objective.sought, fine, point)
    looked = point is solution.iterate.point
    return Checked(problem, point.coefficients, point.duration, point.margin, status, worst, binding, done, looked)


def _repair(
    problem: TransportProblem, exchange: int, iterations: int, gain: float, watch: Watch
) -> tuple[SqpOptions, float]:
    """How a programme is solved once more, with the nodes that it lacked, and the damping of its first step."""
    damping = REPAIR * 4.0**exchange
    kept = SqpOptions(REPAIR_ITERATIONS, watch, gain=gain, violation=LEFT, least_damping=damping, mending=True)
    if not problem.liquids:
        return kept, damping
    damping *= SLUGGISH
    if exchange == 0:  # what was loose is now sought in earnest
        return SqpOptions(iterations, watch, gain=EARNEST * gain), damping
    return replace(kept, violation=MENDED, least_damping=damping), damping


def rough(
    problem: TransportProblem,
    curve_of: CurveOf,
    start: SplineMotion,
    nodes_per_span: int,
    watch: Watch,
    damping: float = 1.0,
    iterations: int = ROUGH_ITERATIONS,
    beat: float = np.inf,
) -> SqpSolution:
    """A first optimum with few pieces: a start for one with more. Between its nodes only what touches is looked at: a
    thin obstacle would fit between two of them.

    beat: s; given up where it will hardly be shorter than this. Nodes that are added only make it longer.
    """
    nodes, at, done = start.spline.nodes(nodes_per_span), start, 0
    for exchange in range(ROUGH_EXCHANGES + 1):
        programme = programme_of(problem.roughly, curve_of, at, nodes, points=1)
        begun = programme.begin(at.coefficients, at.duration)
        first = begun if exchange else hastened(programme, begun)
        trust = Trust(damping if first is begun else min(damping, HASTENED))
        solution = minimise(programme, first, SqpOptions(iterations, watch, gain=ROUGH_GAIN, beat=beat), trust)
        done += solution.iterations
        touched = _touched(curve_of(problem, Grid.of(start.spline, nodes, LOOKS)), solution.iterate)
        beaten = solution.iterate.duration > beat
        if beaten or solution.iterate.violation > HOPELESS_AT_NODES or not len(touched) or watch.over():
            break
        nodes, damping, iterations = united(nodes, touched), REPAIR, min(iterations, REPAIR_ITERATIONS)
        at = SplineMotion(start.spline, solution.iterate.coefficients, solution.iterate.duration)
    return replace(solution, iterations=done)


def _touched(fine: Curve, found: Iterate) -> Array:
    """s (N,) on a fine grid at which a motion is deepest in something, of all pairs that are watched."""
    keep_out = fine.problem.keep_out
    if keep_out is None or not len(keep_out.required):
        return np.zeros(0)
    nearest = keep_out.distances(fine.motion(found.coefficients, found.duration)[0]).min(axis=1)
    padded = np.pad(nearest, 1, constant_values=np.inf)
    least = (nearest <= padded[:-2]) & (nearest <= padded[2:])
    return np.asarray(fine.grid.s[least & (nearest < -TOUCHES)])


def hastened(programme: Programme, begun: Iterate) -> Iterate:
    """The same path in less time, as long as no row that depends on time comes near its edge."""
    while True:
        point = replace(begun.point, duration=HASTE * begun.duration)
        shorter = programme.at(point)
        if any(block.by_time and block.values.max() > 0 for block in shorter.blocks):
            return begun
        begun = shorter


def reached(sought: str, duration: float) -> Status:
    """Of a motion that keeps everything."""
    return Status("optimal", f"The {sought} safe motion found takes {duration:.4f} s.", True)


def _status(solution: SqpSolution, worst: dict[str, float], sought: str, fine: Curve, point: Point) -> Status:
    excess = max(worst.values())
    if excess <= 0.0:
        return reached(sought, point.duration)
    if excess > HOPELESS and not solution.status.ok:
        return solution.status
    found = violated(evaluate(fine.problem.constraints, _seen(fine, point)))
    return Status("infeasible", f"No safe motion was found: the best attempt violates {found}.", False, worst)


def _seen(fine: Curve, point: Point) -> MotionEvaluation:
    """The motion at a point, on the fine grid."""
    z = fine.motion(point.coefficients, point.duration)
    motion = fine.problem.at(fine.grid.s, z, point.duration, fine.grid.nodes, imposed=False)
    return replace(motion, coarsely=point.margin == 0.0)  # where a margin is sought, rows further away count too


def _slowed(
    fine: Curve, objective: Objective, point: Point, worst: dict[str, float], binding: tuple[str, ...], slower: float
) -> tuple[dict[str, float], tuple[str, ...], Point]:
    """A motion that oversteps by little between the nodes, as much slower as keeps everything: its largest rows, what
    binds it, the motion; as given where that is not enough. The last three: of the motion, from `_between`."""
    small = SMALL_EXCESS_OF_WAVES if fine.problem.liquids else SMALL_EXCESS
    if 0.0 < max(worst.values()) < small:
        longer = replace(point, duration=point.duration * (1.0 + slower))
        stretched, still, _, _ = _between(fine, objective, longer, _seen(fine, longer))
        if max(stretched.values()) <= 0.0:
            return stretched, still, longer
    return worst, binding, point


def _between(
    fine: Curve, objective: Objective, point: Point, motion: MotionEvaluation
) -> tuple[dict[str, float], tuple[str, ...], float, Indices]:
    """Largest row of each block on the fine grid, the blocks that hinder a shorter time, by how much slower,
    relatively, the motion would keep them all, and the points where some row is broken at its peak."""
    grid, problem = fine.grid, fine.problem
    blocks = objective.demanded(evaluate(problem.constraints, motion), point.margin)
    largest: dict[str, float] = {}
    marked = np.zeros(len(grid.s), dtype=bool)
    for block in blocks:
        most = float(block.values.max())
        largest[block.name] = max(most, largest.get(block.name, most))  # several may have one name
        if most <= 0:
            continue
        index = np.flatnonzero((block.peaks & (block.values > 0)).any(axis=1))
        marked[block.points[index]] = True
        if block.following is not None:
            marked[block.points[index + 1]] = True
    slower = max(0.0, *(block.slows * largest[block.name] for block in blocks))
    binding = tuple(dict.fromkeys(b.name for b in blocks if b.by_time and largest[b.name] > -BINDING))
    return largest, binding, slower, np.flatnonzero(marked)
