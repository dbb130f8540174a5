"""Options of the search for a fastest motion, and the motion that it finds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.planning.follow.forward import tray_motion
from salver.planning.trajopt.curves import FreeCurve, Grid, united
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import RestSpline
from salver.trajectory import JointMotion, MotionSamples, SampledReference


@dataclass(frozen=True)
class FastestOptions:
    """Options of the search for a fastest motion.

    spans: polynomial pieces of a motion; doubled, there are twice as many unknowns, and motions are no longer.
    nodes_per_span: instants of each at which conditions are imposed; between them they are checked.
    pairs: of end postures from which the search begins when the start posture is free. ways: around what stands in the
    way, the shortest of thrice as many. starts: local optima refined, of which the best is taken. Doubling any of these
    three at most doubles the work; a hard task may gain by it. patience: rough optima in turn, for each of `starts`,
    that are no shorter than what was found, after which the others are left out.
    rough_gain: relative shortening below which a rough optimum is good enough, and by which another must promise to be
    shorter. mendable: violation of a rough optimum that more pieces may mend; doubled, worse ones are refined.
    iterations: of each optimum at most, as a multiple of the usual 60, and of the 25 of a rough one. seed: of all that
    is random. time_limit: s, None for none: then no clock decides anything.
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
        """Iterations of an optimum, at most."""
        return round(60 * self.iterations)

    @property
    def most_roughly(self) -> int:
        """Iterations of a rough optimum, at most."""
        return round(25 * self.iterations)

    def first(self, problem: TransportProblem) -> int:
        """Pairs that are tried first: fewer when one of the two postures is given."""
        return self.pairs if problem.start_posture is None else max(1, self.pairs // 4)


EFFORTS = {
    "quick": FastestOptions(pairs=1, ways=1),
    "normal": FastestOptions(),
    "thorough": FastestOptions(pairs=12, ways=3, starts=4, iterations=3.0),
}


@dataclass(frozen=True)
class FastestMotion:
    """Result. spline, coefficients (size, n), duration: the motion. worst: largest row of each block on the fine
    grid (<= 0: kept). binding: the blocks that hinder a shorter time. wall_time: s. iterations: of all rounds and
    starts. margin: that was sought, when it was (`LeastMargin`).
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

    def after(self, *before: FastestMotion) -> FastestMotion:
        """The motion with the time and the iterations of earlier searches added."""
        every = (self, *before)
        spent, steps = sum(x.wall_time for x in every), sum(x.iterations for x in every)
        return replace(self, wall_time=spent, iterations=steps)

    def sample(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """q, dq, ddq, dddq (T, n) at times t, clamped to rest outside [0, duration]."""
        s = np.clip(np.asarray(t, dtype=float) / self.duration, 0.0, 1.0)
        curve = FreeCurve(self.problem, Grid.of(self.spline, s))
        q, *rates = curve.motion(self.coefficients, self.duration)
        inside = ((t >= 0) & (t <= self.duration))[:, None]
        dq, ddq, dddq = (np.where(inside, rate, 0.0) for rate in rates)
        return q, dq, ddq, dddq

    def joint_motion(self) -> JointMotion:
        """The motion as samples; exact between them too, because the breaks of the spline are among them."""
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
