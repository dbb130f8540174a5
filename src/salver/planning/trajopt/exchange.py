"""Conditions for all times, not only at nodes: optimise, check on a finer grid, add nodes where a row is broken.

The exchange method for semi-infinite programmes (Hettich and Kortanek, SIAM Review 35(3), 1993).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array, Indices
from salver.planning.trajopt.constraints.constraints import evaluate, violated
from salver.planning.trajopt.curves import Curve, Grid, united
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.objectives import Duration, Objective, Point, Scalar
from salver.planning.trajopt.problem import TransportProblem, with_missed_cases
from salver.planning.trajopt.programme import Programme
from salver.planning.trajopt.spline import SplineMotion
from salver.planning.trajopt.sqp import SqpOptions, SqpSolution, minimise
from salver.planning.trajopt.trust import Trust
from salver.planning.trajopt.watch import Watch

SHORTEST = Duration()

CurveOf = Callable[[TransportProblem, Grid], Curve]


@dataclass(frozen=True)
class ExchangeOptions:
    """Options of the exchange: how an optimum is kept between the nodes of its programme.

    rounds: of adding nodes, at most; doubled, what six do not mend is tried for longer. repairs: iterations of each, at
    most. repair: damping of the first step of the first round, four times more in each that follows; doubled, a repair
    stays nearer to what is repaired.
    added: nodes of each spline piece beside what is asked for; as inner dynamics remember what was between them.
    finer: the check's points from node to node; doubled, it takes twice the time.
    hopeless: a row broken by this share of its scale on the check's grid, or by `hopeless_at_nodes` at the nodes, is
    not repaired.
    left: violation that is left to a repair: what the nodes keep from the edge and the check does not.
    excess: what is broken by less is left to a slightly longer duration; doubled, fewer rounds and longer motions.
    binding: rows nearer than this to their edge are said to hinder a shorter time; doubled, more are named.
    """

    rounds: int = 6
    repairs: int = 15
    repair: float = 0.4
    added: int = 0
    finer: int = 6
    hopeless: float = 0.2
    hopeless_at_nodes: float = 1e-2
    left: float = 9e-4
    excess: float = 2e-3
    binding: float = 0.02

    @classmethod
    def of(cls, problem: TransportProblem) -> ExchangeOptions:
        """The usual ones; what swings need not become calmer in a longer time."""
        return cls(repair=4.0, added=1, finer=4, left=3e-4, excess=5e-4) if problem.cases else cls()


@dataclass(frozen=True)
class Checked:
    """Coefficients (size, m), duration and margin (as in `Point`) of a motion whose rows were checked on the fine grid.

    problem: with all the cases of inner dynamics that were checked.
    worst: largest row of each block there, <= 0 when kept. binding: names of those blocks that hinder a shorter time:
    that depend on time, and come near their edge. iterations: of all rounds.
    """

    problem: TransportProblem
    coefficients: Array
    duration: float
    margin: float
    status: Status
    worst: dict[str, float]
    binding: tuple[str, ...]
    iterations: int


def programme_of(
    problem: TransportProblem,
    curve_of: CurveOf,
    start: SplineMotion,
    nodes: Array,
    objective: Objective = SHORTEST,
    points: int = 2,
) -> Programme:
    """The programme at nodes (N,) in [0, 1], watching, for a shorter time, only what comes near along the start.

    curve_of: makes the curve of a problem and grid. points: from node to node, where the joints' limits are imposed.
    """
    curve = curve_of(problem, Grid.of(start.spline, nodes, points))
    constraints = problem.constraints
    if objective.scalar is Scalar.DURATION:  # others may lead far from where they begin
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
    iterations: int = 60,
    gain: float = 1e-3,
    also: Array | None = None,
    beat: float = np.inf,
) -> Checked:
    """The optimum from a start, kept between the nodes too; of the duration, unless another objective is given.

    gain: relative improvement below which an iteration counts as idle. also: more nodes, s in [0, 1]. beat: s; given up
    where it will hardly be shorter than this: nodes that are added only make it longer.
    """
    watch, how = watch or Watch(), ExchangeOptions.of(problem)
    spline = start.spline
    nodes = united(spline.nodes(nodes_per_span + how.added), problem.nodes)
    nodes = nodes if also is None else united(nodes, also)
    check = Grid.of(spline, Grid.of(spline, nodes, how.finer).s, 5)  # the joints' limits are looked at so much finer
    fine = curve_of(problem, check)

    programme = programme_of(problem, curve_of, start, nodes, objective)
    begun = programme.begin(start.coefficients, start.duration)
    first = SqpOptions(iterations, watch, gain=gain, beat=beat)
    if problem.cases:  # more cases of them will join, which a loose optimum shows as well
        first = SqpOptions(iterations, watch, gain=5e-3, violation=1e-2, poor=0.6)
    solution = minimise(programme, begun, first, Trust(damping))
    done = solution.iterations
    for exchange in range(how.rounds + 1):
        point = solution.iterate.point
        if point.duration > beat:
            status = Status("beaten", f"No safe motion in less than {beat:.4f} s was found.", False)
            return Checked(problem, point.coefficients, point.duration, point.margin, status, {}, (), done)
        seen = _seen(fine, point)
        more = with_missed_cases(problem, seen, point.margin)
        if more is not None:  # fills and dampings that no row stood for
            problem, fine = more, curve_of(more, check)
            seen = _seen(fine, point).knowing(terms=seen.terms, response=seen.response)
        worst, binding, slower, peaks = _between(fine, objective, point, seen)
        if objective.scalar is Scalar.DURATION:
            worst, binding, point = _slowed(fine, objective, point, worst, binding, slower, how.excess)
        excess = max(worst.values())
        late = watch.over()
        hopeless = excess > how.hopeless or solution.iterate.violation > how.hopeless_at_nodes
        if excess <= 0.0 or hopeless or exchange == how.rounds or late:
            break
        before, nodes = nodes, united(nodes, fine.grid.s[peaks])
        if len(nodes) == len(before):  # what is broken is driven by what was between them
            nodes = united(nodes, 0.5 * (nodes[1:] + nodes[:-1]))
        options, repair = _repair(problem, how, exchange, iterations, gain, watch)
        start = SplineMotion(spline, point.coefficients, point.duration)
        programme = programme_of(problem, curve_of, start, nodes, objective)
        programme = replace(programme, given=bool(problem.cases))
        begun = programme.begin(start.coefficients, start.duration)
        solution = minimise(programme, begun, options, Trust(repair, 0.02))  # of rows only what is near
        done += solution.iterations
    status = _status(solution, worst, objective.sought, fine, point, how)
    return Checked(problem, point.coefficients, point.duration, point.margin, status, worst, binding, done)


def _repair(
    problem: TransportProblem, how: ExchangeOptions, exchange: int, iterations: int, gain: float, watch: Watch
) -> tuple[SqpOptions, float]:
    """Options of solving a programme once more with added nodes, and the damping of its first step: ever more
    repair, ever less search."""
    damping = how.repair * 4.0**exchange
    if problem.cases and exchange == 0:  # what was loose is now sought in earnest
        return SqpOptions(iterations, watch, gain=0.5 * gain), damping
    kept = SqpOptions(how.repairs, watch, gain=gain, violation=how.left, least_damping=damping, mending=True)
    return kept, damping


def rough(
    problem: TransportProblem,
    curve_of: CurveOf,
    start: SplineMotion,
    nodes_per_span: int,
    watch: Watch,
    gain: float,
    iterations: int = 25,
    beat: float = np.inf,
) -> SqpSolution:
    """A rough optimum with few pieces, unchecked between its nodes: an initial guess for one with more.

    gain: as of `optimise`. beat: s; given up where it will hardly be shorter than this.
    """
    programme = programme_of(problem.roughly, curve_of, start, start.spline.nodes(nodes_per_span), points=1)
    begun = programme.begin(start.coefficients, start.duration)
    return minimise(programme, begun, SqpOptions(iterations, watch, gain=gain, beat=beat))


def reached(sought: str, duration: float) -> Status:
    """The status of a motion that satisfies every constraint."""
    return Status("optimal", f"The {sought} safe motion found takes {duration:.4f} s.", True)


def _status(
    solution: SqpSolution, worst: dict[str, float], sought: str, fine: Curve, point: Point, how: ExchangeOptions
) -> Status:
    excess = max(worst.values())
    if excess <= 0.0:
        return reached(sought, point.duration)
    if excess > how.hopeless and not solution.status.ok:
        return solution.status
    found = violated(evaluate(fine.problem.constraints, _seen(fine, point)))
    return Status("infeasible", f"No safe motion was found: the best attempt violates {found}.", False, worst)


def _seen(fine: Curve, point: Point) -> MotionEvaluation:
    """The motion at a point, on the fine grid."""
    z = fine.motion(point.coefficients, point.duration)
    motion = fine.problem.at(fine.grid.s, z, point.duration, fine.grid.nodes, imposed=False)
    return replace(motion, coarsely=point.margin == 0.0)  # where a margin is sought, rows further away count too


def _slowed(
    fine: Curve,
    objective: Objective,
    point: Point,
    worst: dict[str, float],
    binding: tuple[str, ...],
    slower: float,
    small: float,
) -> tuple[dict[str, float], tuple[str, ...], Point]:
    """A motion that oversteps by less than `small` between the nodes, as much slower as keeps everything: its largest
    rows, what binds it, the motion; as given where that is not enough. worst, binding, slower: from `_between`."""
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
    binding = tuple(dict.fromkeys(b.name for b in blocks if b.by_time and largest[b.name] > -ExchangeOptions.binding))
    return largest, binding, slower, np.flatnonzero(marked)
