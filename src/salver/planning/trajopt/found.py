"""The motion that an optimisation finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.planning.follow.forward import tray_motion
from salver.planning.trajopt.curves import FreeCurve, Grid, JointCurve, united
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import SplineMotion
from salver.trajectory import JointMotion, MotionSamples, SampledReference

CurveOf = Callable[[TransportProblem, Grid], JointCurve]


@dataclass(frozen=True)
class FastestMotion(SplineMotion):
    """Result of a search: a motion that was checked on a fine grid.

    problem: with all load cases that were checked. curve_of: makes its parametrisation. worst: largest value of each
    constraint block on the fine grid, <= 0 if met. binding: names of the constraints that prevent a shorter motion:
    those that depend on time and are near their limit. wall_time: s. iterations: of all rounds and starts. margin: the
    maximised one, with the objective `LeastMargin`. lower_bound: of the duration on a given path, s; it ignores jerk,
    torque rate and uncertainty.
    """

    problem: TransportProblem
    status: Status
    worst: dict[str, float] = field(default_factory=dict)
    binding: tuple[str, ...] = ()
    wall_time: float = 0.0
    iterations: int = 0
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
