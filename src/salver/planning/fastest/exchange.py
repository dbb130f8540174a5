"""Conditions for all times, not only at nodes: optimise, check on a finer grid, add nodes where a row is broken.

The exchange method for semi-infinite programmes (Hettich and Kortanek, SIAM Review 35(3), 1993).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.planning.fastest.curves import Curve, Grid
from salver.planning.fastest.problem import TransportProblem
from salver.planning.fastest.rows import Indices, Margins, evaluate
from salver.planning.fastest.spline import SplineMotion
from salver.planning.fastest.sqp import DEEPEST, Options, Solution, minimise_duration

ROUGH_GAIN = 5e-3  # relative shortening below which a rough optimum is good enough
EXCHANGES = 6  # rounds of adding nodes
HOPELESS = 0.2  # a row broken by this share of its scale will not be repaired by more nodes
HOPELESS_AT_NODES = 1e-2  # and nor will one that is broken at the nodes already
REPAIR = 0.4  # damping of the first step after nodes were added: ever more mending, ever less search
SMALL_EXCESS = 2e-3  # what is left to a slightly longer duration instead of another round of optimisation
POINTS = 2  # from node to node, where joint limits are imposed
CHECK_FACTOR = 6  # the check between nodes uses a grid this much finer
POINTS_CHECKED = 5  # and where the joints' limits are, from one point of that grid to the next
FINEST = 5e-5  # of a limit, for what may happen between the points of that grid

_STRETCH = {"velocity": 1.02, "acceleration": 0.52, "jerk": 0.35, "torque rate": 1.02}

CurveOf = Callable[[TransportProblem, Grid], Curve]


@dataclass(frozen=True)
class Checked:
    """Coefficients (size, m) and duration of a motion whose rows were checked on the fine grid.

    worst: largest row of each family there, <= 0 when kept. iterations: of all rounds.
    """

    coefficients: Array
    duration: float
    status: Status
    worst: dict[str, float]
    iterations: int


def optimise(
    problem: TransportProblem,
    curve_of: CurveOf,
    start: SplineMotion,
    nodes_per_span: int,
    time_limit: float,
    damping: float = 1.0,
) -> Checked:
    """Shortest duration from a start, kept between the nodes too. curve_of: makes the curve of a problem and grid."""
    begun = time.perf_counter()
    margins, spline = _node_margins(problem), start.spline
    nodes = spline.nodes(nodes_per_span)
    fine = curve_of(problem, Grid.of(spline, Grid.of(spline, nodes, CHECK_FACTOR).s, POINTS_CHECKED))

    def solve(coefficients: Array, duration: float, options: Options, damping: float, depth: float) -> Solution:
        grid = Grid.of(spline, nodes, POINTS)
        postures = curve_of(problem, grid).motion(coefficients, duration)[0, grid.nodes]
        curve = curve_of(_watching(problem, postures), grid)
        left = max(0.05, time_limit - (time.perf_counter() - begun))
        limited = replace(options, time_limit=left)
        return minimise_duration(curve, coefficients, duration, margins, limited, damping, depth)

    solution = solve(start.coefficients, start.duration, Options(gain=1e-3), damping, DEEPEST)
    iterations = solution.iterations
    for exchange in range(EXCHANGES + 1):
        coefficients, duration = solution.iterate.coefficients, solution.iterate.duration
        worst, peaks = _between(fine, coefficients, duration)
        excess = max(worst.values())
        if 0.0 < excess < SMALL_EXCESS:
            # As much slower as puts the excess right: velocity goes with 1 / T, acceleration with its square.
            slower = duration * (1.0 + max(_STRETCH.get(name, 1.5) * value for name, value in worst.items()))
            stretched, _ = _between(fine, coefficients, slower)
            if max(stretched.values()) <= 0.0:
                worst, excess, duration = stretched, 0.0, slower
        late = time.perf_counter() - begun > time_limit
        hopeless = excess > HOPELESS or solution.iterate.at.violation > HOPELESS_AT_NODES
        if excess <= 0.0 or hopeless or exchange == EXCHANGES or late:
            break
        nodes = np.union1d(nodes, fine.grid.s[peaks])
        repair = REPAIR * 4.0**exchange
        options = Options(iterations=15, gain=1e-3, least_damping=repair)
        solution = solve(coefficients, duration, options, repair, 0.05)
        iterations += solution.iterations
    return Checked(coefficients, duration, _status(solution, worst, duration), worst, iterations)


def rough(
    problem: TransportProblem,
    curve_of: CurveOf,
    start: SplineMotion,
    nodes_per_span: int,
    time_limit: float,
    damping: float = 1.0,
) -> Solution:
    """A first optimum with few pieces, unchecked between nodes: a start for one with more."""
    grid = Grid.of(start.spline, start.spline.nodes(nodes_per_span))
    postures = curve_of(problem, grid).motion(start.coefficients, start.duration)[0]
    curve = curve_of(_watching(problem, postures), grid)
    options = Options(gain=ROUGH_GAIN, time_limit=time_limit)
    return minimise_duration(curve, start.coefficients, start.duration, _node_margins(problem), options, damping)


def _node_margins(problem: TransportProblem) -> Margins:
    """The scenario's own margin, and a little for what happens between nodes."""
    return replace(Margins(), contact=Margins().contact + problem.scenario.contact.margin)


def _status(solution: Solution, worst: dict[str, float], duration: float) -> Status:
    excess = max(worst.values())
    if excess <= 0.0:
        return Status("optimal", f"The shortest safe motion takes {duration:.4f} s.", True)
    if excess > HOPELESS and not solution.status.ok:
        return solution.status
    name = max(worst, key=lambda key: worst[key])
    sentence = f"No safe motion was found: between nodes {name} is exceeded by {100 * excess:.2g} % of its scale."
    return Status("infeasible", sentence, False, worst)


def _watching(problem: TransportProblem, q: Array) -> TransportProblem:
    """The problem with only those pairs of parts watched that come near along postures (N, n)."""
    return problem if problem.keep_out is None else replace(problem, keep_out=problem.keep_out.near(q))


def _between(fine: Curve, coefficients: Array, duration: float) -> tuple[dict[str, float], Indices]:
    """Largest row of each family on the fine grid, and the points where some row is broken at its peak."""
    margins = Margins(fine.problem.scenario.contact.margin, FINEST, 0.0)
    grid = fine.grid
    check = evaluate(fine.problem, grid.s, fine.motion(coefficients, duration), duration, margins, grid.nodes)
    marked = np.zeros(len(grid.s), dtype=bool)
    for family in check.families:
        index = np.flatnonzero((family.peaks & (family.values > 0)).any(axis=1))
        marked[family.points[index]] = True
        if family.following is not None:
            marked[family.points[index + 1]] = True
    return {family.name: float(family.values.max()) for family in check.families}, np.flatnonzero(marked)
