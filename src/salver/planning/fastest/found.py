"""Options of the search for the fastest motion, and its result."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.planning.follow.forward import tray_motion
from salver.planning.trajopt.curves import FreeCurve, Grid, united
from salver.planning.trajopt.exchange import CurveOf
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import RestSpline
from salver.trajectory import JointMotion, MotionSamples, SampledReference


@dataclass(frozen=True)
class FastestOptions:
    """Options of the search for the fastest motion.

    A rough optimum is a local optimum with few spline pieces; the best of them are refined with all `spans`. Doubling
    `pairs`, `ways` or `starts` at most doubles the computing time and may find a shorter motion in a hard task.

    Attributes:
        spans: polynomial pieces of the motion.
        nodes_per_span: instants per piece at which the constraints are imposed; between them they are checked.
        pairs: pairs of start and goal postures from which the search begins when the start posture is free.
        ways: initial paths around obstacles: the shortest of three times as many random ones.
        starts: rough optima that are refined; the best result is taken.
        patience: the search of rough optima ends after `patience * starts` in a row without improvement.
        rough_gain: relative improvement below which the optimisation of a rough optimum stops, or another is no better.
        mendable: largest constraint violation of a rough optimum that is still refined.
        iterations: limit per optimum, as a multiple of the default (60; 25 for a rough one).
        seed: of the random number generator.
        time_limit: s; None for no limit, which makes the result independent of the computer's speed.
    """

    spans: int = 20
    nodes_per_span: int = 2
    pairs: int = 2
    ways: int = 2
    starts: int = 1
    patience: int = 6
    rough_gain: float = 1e-2
    mendable: float = 1e-2
    iterations: float = 1.0
    seed: int = 0
    time_limit: float | None = None

    @property
    def most(self) -> int:
        """Largest number of iterations of an optimum."""
        return round(60 * self.iterations)

    @property
    def most_roughly(self) -> int:
        """Largest number of iterations of a rough optimum."""
        return round(25 * self.iterations)

    def first(self, problem: TransportProblem) -> int:
        """Number of posture pairs that are tried first: fewer when one of the two postures is given."""
        return self.pairs if problem.start_posture is None else max(1, self.pairs // 4)


EFFORTS = {
    "quick": FastestOptions(pairs=1, ways=1),
    "normal": FastestOptions(),
    "thorough": FastestOptions(pairs=12, ways=3, starts=4, iterations=3.0),
}


@dataclass(frozen=True)
class FastestMotion:
    """Result of a search.

    spline, coefficients (size, m), duration (s): the motion; curve_of: its parametrisation. worst: largest value of
    each constraint block on a fine grid, <= 0 if met. binding: names of the constraints that prevent a shorter motion.
    wall_time: s. iterations: of all rounds and starts. margin: the maximised one, with the objective `LeastMargin`.
    lower_bound: of the duration on a given path, s; it ignores jerk, torque rate and uncertainty.
    """

    problem: TransportProblem
    spline: RestSpline
    coefficients: Array
    duration: float
    status: Status
    worst: dict[str, float]
    binding: tuple[str, ...]
    wall_time: float
    iterations: int
    margin: float = 0.0
    lower_bound: float = 0.0
    curve_of: CurveOf = FreeCurve

    def after(self, *before: FastestMotion) -> FastestMotion:
        """The motion with the wall time and the iterations of earlier searches added."""
        every = (self, *before)
        spent, steps = sum(x.wall_time for x in every), sum(x.iterations for x in every)
        return replace(self, wall_time=spent, iterations=steps)

    def sample(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """q, dq, ddq, dddq (T, n) at times t, clamped to rest outside [0, duration]."""
        s = np.clip(np.asarray(t, dtype=float) / self.duration, 0.0, 1.0)
        curve = self.curve_of(self.problem, Grid.of(self.spline, s))
        q, *rates = curve.motion(self.coefficients, self.duration)
        inside = ((t >= 0) & (t <= self.duration))[:, None]
        dq, ddq, dddq = (np.where(inside, rate, 0.0) for rate in rates)
        return q, dq, ddq, dddq

    def joint_motion(self) -> JointMotion:
        """The motion as samples, which include the breaks of the spline: interpolation between them is exact."""
        t = self.duration * united(np.linspace(0, 1, 401), self.spline.breaks())
        q, dq, ddq, _ = self.sample(t)
        return JointMotion(t, q, dq, ddq)

    def reference(self) -> SampledReference:
        """The motion of the first object's frame B."""
        joint = self.joint_motion()
        return SampledReference(object_motion(self.problem, joint.t, joint.q, joint.dq, joint.ddq))


def object_motion(problem: TransportProblem, t: Array, q: Array, dq: Array, ddq: Array) -> MotionSamples:
    """Motion of the first object's frame B at joint states (T, n)."""
    tray = tray_motion(problem.arm, JointMotion(t, q, dq, ddq))
    return tray.of_frame(problem.items[0].p_EB, problem.items[0].R_EB)
