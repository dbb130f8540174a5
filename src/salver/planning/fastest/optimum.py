"""The local optimum near an initial guess, with many or few spline pieces, checked between the nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from salver.planning.fastest.options import FastestOptions
from salver.planning.seeds.starts import Start
from salver.planning.trajopt.curves import FreeCurve
from salver.planning.trajopt.exchange import SHORTEST, optimise
from salver.planning.trajopt.found import FastestMotion
from salver.planning.trajopt.objectives import Objective
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import RestSpline, SplineMotion
from salver.planning.trajopt.watch import Watch

DEGREE = 5  # of motions, paths and time laws: four times differentiable, so the jerk is continuous


def few_pieces(options: FastestOptions) -> RestSpline:
    """The spline of rough optima, which has few pieces."""
    return RestSpline(DEGREE, max(4, options.spans // 3))


def refitted(motion: SplineMotion, spans: int) -> SplineMotion:
    """The motion refitted with this number of spline pieces."""
    spline, s = RestSpline(DEGREE, spans), np.linspace(0, 1, 201)
    return SplineMotion(spline, spline.fit(s, motion.spline.matrices(s)[0] @ motion.coefficients), motion.duration)


def nearby(
    found: FastestMotion,
    objective: Objective,
    duration: float,
    options: FastestOptions | None = None,
    *,
    begin: Start | None = None,
    watch: Watch | None = None,
) -> FastestMotion:
    """Find the motion with the least objective in a given duration (s), under the same constraints as `found`.

    The search begins at `found`, or at the path `begin` between the same ends.
    """
    options = options or FastestOptions()
    start: SplineMotion = found if begin is None else begin.motion(found.problem, found.spline)
    damping = options.near if begin is None else options.refined
    start, watch = replace(start, duration=duration), watch or Watch(options.time_limit)
    return optimum(found.problem, options, start, watch, damping, objective)


def optimum(
    problem: TransportProblem,
    options: FastestOptions,
    start: SplineMotion,
    watch: Watch,
    damping: float,
    objective: Objective = SHORTEST,
    beat: float = np.inf,
) -> FastestMotion:
    """The local optimum near a start, checked between the nodes.

    problem: what to solve. options: of the search. start: the initial motion. watch: reports progress and may end the
    search. damping: of the first step. objective: what to minimise. beat: as in `optimise`.
    """
    per_span, most = options.nodes_per_span, options.most
    return optimise(problem, FreeCurve, start, per_span, watch, damping, objective, most, beat=beat)
