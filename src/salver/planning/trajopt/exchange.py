"""Constraints at all times, not only at nodes: optimise, check on a finer grid, add nodes where a row is violated.

The exchange method for semi-infinite programmes (Hettich and Kortanek, SIAM Review 35(3), 1993).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array, Indices
from salver.planning.trajopt.constraints.constraints import evaluate, violated
from salver.planning.trajopt.curves import Grid, JointCurve, united
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.trajopt.found import CurveOf, FastestMotion
from salver.planning.trajopt.objectives import Duration, Objective, Point, Scalar
from salver.planning.trajopt.problem import TransportProblem, with_missed_cases
from salver.planning.trajopt.programme import Programme
from salver.planning.trajopt.spline import SplineMotion
from salver.planning.trajopt.sqp import SqpOptions, SqpSolution, minimise
from salver.planning.trajopt.trust import Trust
from salver.planning.trajopt.watch import Watch

SHORTEST = Duration()


@dataclass(frozen=True)
class ExchangeOptions:
    """Options of the exchange method. Violations are relative to the scale of their row.

    Attributes:
        rounds: of adding nodes, at most; each is a repair of the last optimum.
        repairs: iterations per repair, at most.
        repair: damping of the first step of the first repair, four times larger in each that follows; larger values
            keep a repair closer to what is repaired.
        added: extra nodes per spline piece, for load dynamics, which depend on the motion between nodes.
        finer: points of the check from node to node.
        hopeless, hopeless_at_nodes: violation on the check's grid, and at the nodes, above which no repair is tried.
        left: largest violation at the nodes with which a repair ends: the nodes keep this much more than the check.
        excess: a smaller violation is removed by a slightly longer duration instead of a repair.
        binding: rows closer than this to their limit are named as preventing a shorter motion.
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
        """The options for a problem: with load dynamics a longer duration does not always reduce a swing."""
        return cls(repair=4.0, added=1, finer=4, left=3e-4, excess=5e-4) if problem.cases else cls()


def programme_of(
    problem: TransportProblem,
    curve_of: CurveOf,
    start: SplineMotion,
    nodes: Array,
    objective: Objective = SHORTEST,
    points: int = 2,
) -> Programme:
    """The programme with constraints at nodes (N,) in [0, 1]; for the shortest duration, unless a base drives, only
    those near the start motion.

    curve_of: makes the curve of a problem and grid. points: from node to node, at which joint limits are imposed.
    """
    curve = curve_of(problem, Grid.of(start.spline, nodes, points))
    constraints = problem.constraints
    if objective.scalar is Scalar.DURATION and problem.arm.base is None:  # others may lead far from the start
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
    beat: float = np.inf,
) -> FastestMotion:
    """The local optimum from a start motion, which satisfies the constraints between the nodes too.

    gain: relative improvement below which an iteration counts as idle. beat: s; the search ends early when a shorter
    duration is unlikely: added nodes only make it longer.
    """
    began, watch, how = time.perf_counter(), watch or Watch(), ExchangeOptions.of(problem)
    spline = start.spline
    nodes = united(spline.nodes(nodes_per_span + how.added), problem.nodes)
    check = Grid.of(spline, Grid.of(spline, nodes, how.finer).s, 5)  # joint limits are checked on a finer grid
    fine = curve_of(problem, check)

    programme = programme_of(problem, curve_of, start, nodes, objective)
    begun = programme.begin(start.coefficients, start.duration)
    first = SqpOptions(iterations, watch, gain=gain, beat=beat)
    if problem.cases:  # load cases will be added, for which a loose optimum is enough
        first = SqpOptions(iterations, watch, gain=5e-3, violation=1e-2, poor=0.6)
    solution = minimise(programme, begun, first, Trust(damping))
    done = solution.iterations

    def found(status: Status, worst: dict[str, float], binding: tuple[str, ...]) -> FastestMotion:
        spent = time.perf_counter() - began, done
        motion = spline, point.coefficients, point.duration
        return FastestMotion(*motion, problem, status, worst, binding, *spent, point.margin, curve_of=curve_of)

    for exchange in range(how.rounds + 1):
        point = solution.iterate.point
        if point.duration > beat:
            status = Status("beaten", f"No safe motion in less than {beat:.4f} s was found.", False)
            return found(status, {}, ())
        seen = _seen(fine, point)
        more = with_missed_cases(problem, seen, point.margin)
        if more is not None:  # fill levels and damping ratios without a row yet
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
        if len(nodes) == len(before):  # the violation is caused by the motion between the nodes
            nodes = united(nodes, 0.5 * (nodes[1:] + nodes[:-1]))
        options, repair = _repair(problem, how, exchange, iterations, gain, watch)
        start = SplineMotion(spline, point.coefficients, point.duration)
        programme = programme_of(problem, curve_of, start, nodes, objective)
        programme = replace(programme, given=bool(problem.cases) and exchange > 0)  # a repair moves the arm little
        begun = programme.begin(start.coefficients, start.duration)
        solution = minimise(programme, begun, options, Trust(repair, 0.02))  # only rows near their limit
        done += solution.iterations
    return found(_status(solution, worst, objective.sought, fine, point, how), worst, binding)


def _repair(
    problem: TransportProblem, how: ExchangeOptions, exchange: int, iterations: int, gain: float, watch: Watch
) -> tuple[SqpOptions, float]:
    """Options of solving a programme again with added nodes, and the damping of its first step, which grows with each
    round."""
    damping = how.repair * 4.0**exchange
    if problem.cases and exchange == 0:  # the first optimum was a loose one
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
    """A rough optimum with few spline pieces, unchecked between its nodes: an initial guess for one with more.

    gain, beat: as in `optimise`.
    """
    programme = programme_of(problem, curve_of, start, start.spline.nodes(nodes_per_span), points=1)
    begun = programme.begin(start.coefficients, start.duration)
    return minimise(programme, begun, SqpOptions(iterations, watch, gain=gain, beat=beat))


def reached(sought: str, duration: float) -> Status:
    """The status of a motion that satisfies every constraint."""
    return Status("optimal", f"The {sought} safe motion found takes {duration:.4f} s.", True)


def _status(
    solution: SqpSolution, worst: dict[str, float], sought: str, fine: JointCurve, point: Point, how: ExchangeOptions
) -> Status:
    excess = max(worst.values())
    if excess <= 0.0:
        return reached(sought, point.duration)
    if excess > how.hopeless and not solution.status.ok:
        return solution.status
    found = violated(evaluate(fine.problem.constraints, _seen(fine, point)))
    return Status("infeasible", f"No safe motion was found: the best attempt violates {found}.", False, worst)


def _seen(fine: JointCurve, point: Point) -> MotionEvaluation:
    """The motion at a point, on the fine grid."""
    z = fine.motion(point.coefficients, point.duration)
    return fine.problem.at(fine.grid.s, z, point.duration, fine.grid.nodes, imposed=False)


def _slowed(
    fine: JointCurve,
    objective: Objective,
    point: Point,
    worst: dict[str, float],
    binding: tuple[str, ...],
    slower: float,
    small: float,
) -> tuple[dict[str, float], tuple[str, ...], Point]:
    """A motion with violations below `small` between the nodes, slowed down until it meets all constraints: its largest
    rows, binding blocks, and the point; unchanged if that is not enough. worst, binding, slower: from `_between`."""
    if 0.0 < max(worst.values()) < small:
        longer = replace(point, duration=point.duration * (1.0 + slower))
        stretched, still, _, _ = _between(fine, objective, longer, _seen(fine, longer))
        if max(stretched.values()) <= 0.0:
            return stretched, still, longer
    return worst, binding, point


def _between(
    fine: JointCurve, objective: Objective, point: Point, motion: MotionEvaluation
) -> tuple[dict[str, float], tuple[str, ...], float, Indices]:
    """Check on the fine grid: largest row of each block, the blocks that prevent a shorter motion, the relative
    increase of the duration that would meet all rows, and the points of violated peaks."""
    grid, problem = fine.grid, fine.problem
    blocks = objective.demanded(evaluate(problem.constraints, motion), point.margin)
    largest: dict[str, float] = {}
    marked = np.zeros(len(grid.s), dtype=bool)
    for block in blocks:
        most = float(block.values.max())
        largest[block.name] = max(most, largest.get(block.name, most))  # several blocks may have the same name
        if most <= 0:
            continue
        index = np.flatnonzero((block.peaks & (block.values > 0)).any(axis=1))
        marked[block.points[index]] = True
        if block.following is not None:
            marked[block.points[index + 1]] = True
    binding = tuple(dict.fromkeys(b.name for b in blocks if b.by_time and largest[b.name] > -ExchangeOptions.binding))
    slower = max(0.0, *(block.slows * largest[block.name] for block in blocks))
    return largest, binding, slower, np.flatnonzero(marked)
