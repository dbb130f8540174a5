"""The committed motion: verified, ending at rest, in the clock of the live motion.

A motion is quintic from knot to knot (`JointMotion`), so one that leaves another at an instant is exact again. The
arm's deviation under a parameter error and held commands continues from one motion to the next, and so do modal states.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from salver.dynamics.modal_history import Past
from salver.geometry import Array
from salver.live.committed.profile import SAME, SpeedProfile
from salver.planning.fastest import TransportProblem
from salver.planning.trajopt.evaluation import MotionEvaluation
from salver.planning.verdict.margins import ConstraintMargins
from salver.trajectory import JointMotion

SHORTEST = 1e-3  # s that the motion of an arm at rest is written to last


# Of an arm that rests for long:
SETTLED = 1.0  # s after which what the load makes it sag by changes no more
CALMED = 5.0  # s after which swings are so small that it hardly gives way to them
AT_ONCE = 0.5  # s of that for which swings and arm are found together; longer, their iteration converges slowly
STEP = 1e-2  # s between instants


@dataclass(frozen=True, eq=False)
class Committed:
    """A motion that ends at rest, with all its constraints checked.

    begins: live time of the motion's own time 0, s. motion: knots from 0 on; at rest after the last one, and before the
    first only when nothing moved before. nodes: (N,) live times at which the deviation is known. deviation:
    (N, 2, n, k) e and e' of each term, see `JointLoop.start`; None where nothing is uncertain. loads: modal states of
    liquids and pendulums along it, None without them. off: (N,) m by which objects on the tray may be displaced. seal:
    from the process whose verdict it passed (`salver.live.committed.seal`); empty before that. profile: its path at
    full speed and its speed factor; None at full speed."""

    begins: float
    motion: JointMotion
    nodes: Array
    deviation: Array | None
    margins: ConstraintMargins
    loads: Past | None = None
    off: Array = field(default_factory=lambda: np.zeros(1))
    seal: bytes = b""
    profile: SpeedProfile | None = None

    @property
    def run(self) -> SpeedProfile:
        """Its path, and how fast it is run."""
        return self.profile or SpeedProfile(self.motion, self.begins)

    @property
    def ends(self) -> float:
        """Live time at which the arm is at rest, s."""
        return self.begins + self.motion.duration

    def state(self, t: float) -> tuple[Array, Array, Array]:
        """q, dq, ddq (n,) at live time t."""
        q, dq, ddq = self.motion.sample(t - self.begins)
        return q[0], dq[0], ddq[0]

    @property
    def at_rest(self) -> bool:
        """Whether the motion is a rest from its beginning on."""
        return bool(np.all(self.motion.q == self.motion.q[0]))

    def stray(self, problem: TransportProblem) -> Array:
        """(n,) rad, largest deviation of each joint from the motion under the uncertain set."""
        if self.deviation is None or problem.tracking is None:
            return np.zeros(problem.n)
        e = self.deviation[:, 0]
        off = problem.tracking.load.radius(e[:, :, :-1]) + np.abs(e[:, :, -1])
        if self.loads is not None:
            off = off + self.loads.stray
        return np.asarray(off.max(axis=0))

    def left(self, t: float, problem: TransportProblem) -> TransportProblem:
        """The problem of a motion that leaves this one at live time t: with the deviation and the modal states at that
        instant."""
        if problem.cases:
            problem = replace(problem, past=self._loads_at(t, problem))
        return _astray(problem, self.deviation_at(t, problem))

    def deviation_at(self, t: float, problem: TransportProblem) -> Array | None:
        """(2, n, k) the deviation at live time t; None where nothing is uncertain."""
        if self.deviation is None or problem.tracking is None:
            return None
        if t <= self.nodes[-1]:
            k = int(np.clip(np.searchsorted(self.nodes, t) - 1, 0, len(self.nodes) - 2))
            u = (t - self.nodes[k]) / (self.nodes[k + 1] - self.nodes[k])
            return np.asarray((1 - u) * self.deviation[k] + u * self.deviation[k + 1])
        held = min(t - self.nodes[-1], SETTLED)
        along = standing_still(_astray(problem, self.deviation[-1]), self.motion.q[-1], held)
        assert along.response is not None
        return along.response.state_at(along.shares * held, held)

    def _loads_at(self, t: float, problem: TransportProblem) -> Past:
        """The modal states at live time t, s; only with a liquid or pendulum."""
        if self.loads is None:
            problem.check_still("a motion that goes on from another")
        assert self.loads is not None
        own, ends = t - self.begins, self.loads.t[-1]
        left = own - ends
        if left <= SAME:
            return replace(self.loads, now=min(own, ends))
        rest = replace(problem, cases=problem.every_case, past=replace(self.loads, now=ends))
        rest = _astray(rest, None if self.deviation is None else self.deviation[-1])
        swung = max(left - CALMED, 0.0)  # freely, after the arm that gives way to them has braked them
        left = min(left, CALMED)
        while True:
            step = min(left, AT_ONCE)
            held, left = standing_still(rest, self.motion.q[-1], step), left - step
            if left <= 0.0:
                return held.rested(swung) if swung else replace(held.left, now=step)
            rest = replace(rest, past=replace(held.left, now=step))
            if rest.tracking is not None and held.response is not None:
                sagging = held.response.state_at(np.multiply(step, held.shares), step)
                rest = replace(rest, tracking=rest.tracking.begun(sagging))


def standing_still(problem: TransportProblem, q: Array, seconds: float) -> MotionEvaluation:
    """The arm at rest in a posture (n,) for a duration, s, from the deviation and the modal states with which the
    problem begins."""
    z = np.zeros((4, max(5, int(np.ceil(seconds / STEP)) + 1), problem.n))
    z[0] = q
    return problem.at(np.linspace(0.0, 1.0, z.shape[1]), z, seconds)


def _astray(problem: TransportProblem, deviation: Array | None) -> TransportProblem:
    """The problem of an arm that is off by a deviation (2, n, k) where it begins; by nothing that is known for None."""
    if problem.tracking is None or deviation is None:
        return problem
    return replace(problem, tracking=problem.tracking.begun(deviation))


def between(motion: JointMotion, first: float, last: float) -> JointMotion:
    """A motion from one instant to a later one, from time 0; at rest where it has ended before."""
    inside = motion.t[(motion.t > first + SAME) & (motion.t < last - SAME)]
    t = np.concatenate([[first], inside, [last]])
    return JointMotion(t - first, *motion.sample(t))


def joined(*motions: JointMotion) -> JointMotion:
    """Motions one after the other, each of which begins, at its own time 0, where the one before ends."""
    *before, last = motions
    first, *later = [*(motion for motion in before if motion.duration > SAME), last]
    begins = np.cumsum([motion.duration for motion in (first, *later)])
    t = np.concatenate([first.t, *(at + motion.t[1:] for at, motion in zip(begins, later, strict=False))])
    states = (np.vstack([getattr(first, x), *(getattr(motion, x)[1:] for motion in later)]) for x in ("q", "dq", "ddq"))
    return JointMotion(t, *states)


def resting(q: Array) -> JointMotion:
    """The motion of an arm that does not move."""
    still = np.zeros((2, len(q)))
    return JointMotion(np.array([0.0, SHORTEST]), np.tile(q, (2, 1)), still, still.copy())
