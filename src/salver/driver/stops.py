"""Stops: how the loop brings the arm to rest."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np
import pinocchio as pin

from salver.control.arm import ArmController, ArmState, Course, JointTable, wanted_acceleration
from salver.geometry import Array
from salver.models.arm.arm import ArmModel, with_load

if TYPE_CHECKING:
    from salver.models.bodies import Body
    from salver.planning.plan import Plan


@dataclass(frozen=True)
class StopOptions:
    """Options of bringing an arm to rest.

    gains: gains of a controlled stop in every joint, 1/s^2 and 1/s. share: share of the manufacturer's acceleration
    limit with which a controlled stop brakes: the load may fall, but the arm must not move far. least: shortest braking
    time, s. hold: time at rest after a stop, s. sensed: largest measurement error of a joint, rad. off, faster:
    deviation from the reference, rad and rad/s, above which the arm is not pulled back to it.
    """

    gains: tuple[float, float] = (200.0, 28.0)
    share: float = 0.8
    least: float = 0.15
    hold: float = 0.25
    sensed: float = 5e-4
    off: float = 0.01
    faster: float = 0.1


STANDARD = StopOptions()


class Stop(Protocol):
    """A stop: from a moving state to rest. Its commands still pass the loop's gate (`salver.driver.gate`)."""

    @property
    def keeps_load(self) -> bool:
        """Whether the load surely stays on the tray, judged by the readings so far."""
        ...

    @property
    def allowed(self) -> Array | float:
        """Deviation (n,) from the reference, rad, within which the load surely stays; negative when it never does."""
        ...

    @property
    def duration(self) -> float:
        """Time from the beginning of the stop until the arm rests and control may end, s."""
        ...

    def reference(self, s: float) -> tuple[Array, Array, Array]:
        """(q, dq, ddq) at which the arm should be a time s after the stop began."""
        ...

    def step(self, state: ArmState, s: float) -> Array:
        """Torque (n,), N m, for a state a time s after the stop began."""
        ...


StopFrom = Callable[[ArmState, float], Stop]
"""The stop from a plausible state, at time t of the motion, s."""


class QuinticBraking:
    """Quintic braking: a velocity that goes to zero without a jump of acceleration or torque."""

    def __init__(self, q: Array, dq: Array, acceleration: Array, least: float) -> None:
        """Braking from q with velocity dq, within accelerations (n,), rad/s^2, in at least a time, s."""
        self._q, self._dq = q.copy(), dq.copy()
        needed = 1.875 * np.abs(dq) / acceleration  # the step's steepest slope
        self.duration = max(least, float(np.max(np.where(np.isfinite(needed), needed, 0.0))))

    def at(self, s: float) -> tuple[Array, Array, Array]:
        """(q, dq, ddq) a time s later."""
        x = min(max(s / self.duration, 0.0), 1.0)
        left = 1 - x**3 * (10 - 15 * x + 6 * x**2)
        slope = -30 * x**2 * (1 - x) ** 2 / self.duration
        area = self.duration * (x - x**4 * (2.5 - 3 * x + x**2))
        return self._q + area * self._dq, left * self._dq, slope * self._dq


def controlled_stops(arm: ArmModel, bodies: Sequence[Body], options: StopOptions = STANDARD) -> StopFrom:
    """Controlled stops of an arm with its load, from any state."""
    loaded = with_load(arm, bodies)
    return lambda state, t: ControlledStop(loaded, state, options)


class ControlledStop:
    """A controlled stop: brings the arm to rest from any state within a share of its acceleration, and holds it there.

    It ignores contact: the load may slide or fall. It is used without a load, or when all other stops failed. The
    target of a joint that cannot be braked within its range is the end of the range: one beyond it would push against
    the joint's mechanical stop and shake the other joints.
    """

    keeps_load, allowed = False, -1.0

    def __init__(self, loaded: ArmModel, state: ArmState, options: StopOptions = STANDARD) -> None:
        """loaded: the arm with what it carries (`salver.models.arm.arm.with_load`)."""
        self._loaded, self._options = loaded, options
        self._braking = QuinticBraking(state.q, state.dq, options.share * loaded.limits.acceleration, options.least)

    @property
    def braking(self) -> float:
        """Time until the arm is at rest, s."""
        return self._braking.duration

    @property
    def duration(self) -> float:
        return self.braking + self._options.hold

    def reference(self, s: float) -> tuple[Array, Array, Array]:
        q, dq, ddq = self._braking.at(s)
        limits = self._loaded.limits
        within = np.minimum(np.maximum(q, limits.q_min), limits.q_max)
        moves = q == within
        return within, np.where(moves, dq, 0.0), np.where(moves, ddq, 0.0)

    def step(self, state: ArmState, s: float) -> Array:
        return _torque(self._loaded, state, self.reference(s), self._options.gains)


def stops_of(
    plan: Plan, controller: ArmController, arm: ArmModel, bodies: Sequence[Body], options: StopOptions = STANDARD
) -> StopFrom:
    """The stops of a plan (`salver.planning.stops`), or controlled stops if it has none."""
    if plan.stops is None:
        return controlled_stops(arm, bodies, options)
    return PlannedStops(plan, controller, arm, bodies, options)


class PlannedStops:
    """The load-safe stops of a plan, sampled at the loop's periods before it starts.

    controller: the controller that follows the plan.
    """

    def __init__(
        self,
        plan: Plan,
        controller: ArmController,
        arm: ArmModel,
        bodies: Sequence[Body],
        options: StopOptions = STANDARD,
    ) -> None:
        assert plan.joint is not None
        assert plan.stops is not None
        self.options = options
        self.library, self.controller, self.loaded = plan.stops, controller, with_load(arm, bodies)
        self.gains = (plan.scenario.control.kp[0], plan.scenario.control.kd[0])
        self.plan = JointTable(plan.joint, controller.period)
        self.tables = [JointTable(self.library.motion(k), controller.period) for k in range(len(self.library.t))]

    def __call__(self, state: ArmState, t: float) -> PlannedStop:
        course = self.library.course(t)
        return PlannedStop(self, state, t, course.leaves, course.stop, course.rests)


class Along(ABC):
    """A stop along a motion that keeps the load.

    The controller of the motion continues, so no command jumps when a stop begins. An arm that is far from its
    reference is not drawn back to it, which would be a jolt: its path to rest begins where the arm is, and its excess
    speed decays.
    """

    def __init__(self, loaded: ArmModel, gains: tuple[float, float], state: ArmState, options: StopOptions) -> None:
        """loaded: the arm with what it carries. gains: 1/s^2, 1/s of the loop in the joints."""
        self._loaded, self._gains, self._options = loaded, gains, options
        q, dq, _ = self.course(0.0)
        off, faster = state.q - q, state.dq - dq
        self._beside: QuinticBraking | None = None
        if not (np.abs(off).max() <= options.off and np.abs(faster).max() <= options.faster):
            self._beside = QuinticBraking(off, faster, options.share * loaded.limits.acceleration, options.least)
        self.keeps_load = True
        self._watch(state, 0.0)

    @abstractmethod
    def course(self, s: float) -> tuple[Array, Array, Array]:
        """(q, dq, ddq) of the motion that keeps the load, a time s after the stop began."""

    @property
    @abstractmethod
    def allowed(self) -> Array:
        """Deviation (n,) from that motion, rad, within which the load surely stays."""

    @property
    @abstractmethod
    def rests(self) -> float:
        """Time after the beginning of the stop at which that motion is at rest, s."""

    @abstractmethod
    def following(self, state: ArmState, s: float) -> Array | None:
        """Torque (n,), N m, of the controller that follows the motion anyway, as long as it does."""

    @property
    def exact(self) -> bool:
        """Whether the arm follows that motion itself, not one with an offset."""
        return self._beside is None

    @property
    def duration(self) -> float:
        beside = 0.0 if self._beside is None else self._beside.duration
        return max(self.rests, beside) + self._options.hold

    def reference(self, s: float) -> tuple[Array, Array, Array]:
        course = self.course(s)
        if self._beside is None:
            return course
        q, dq, ddq = (a + b for a, b in zip(course, self._beside.at(s), strict=True))
        return q, dq, ddq

    def step(self, state: ArmState, s: float) -> Array:
        self._watch(state, s)
        if self._beside is None and (torque := self.following(state, s)) is not None:
            return torque
        return _torque(self._loaded, state, self.reference(s), self._gains)

    def _watch(self, state: ArmState, s: float) -> None:
        """The load is sure to stay only while the arm is where it was checked to be."""
        self.keeps_load &= bool((np.abs(state.q - self.course(s)[0]) <= self.allowed + self._options.sensed).all())


class PlannedStop(Along):
    """The plan up to the beginning of one of its stops, then that stop, then rest; the plan's controller continues up
    to that beginning."""

    def __init__(
        self, stops: PlannedStops, state: ArmState, begun: float, leaves: float, k: int | None, rests: float
    ) -> None:
        """begun: s of the plan's time, now. k: which stop; None: to the plan's end, or where it begins before it.
        rests: s of the plan's time."""
        self._stops, self._begun, self._leaves, self._k, self._rests = stops, begun, leaves, k, rests
        super().__init__(stops.loaded, stops.gains, state, stops.options)

    @property
    def allowed(self) -> Array:
        return self._stops.library.stray[-1 if self._k is None else self._k]

    @property
    def rests(self) -> float:
        return self._rests - self._begun

    def following(self, state: ArmState, s: float) -> Array | None:
        return None if self._left(s) else self._stops.controller.step(state, min(self._begun + s, self._leaves))

    def course(self, s: float) -> tuple[Array, Array, Array]:
        t = self._begun + s
        table, now = self._stops.plan, min(t, self._leaves)
        if self._k is not None and self._left(s):
            table, now = self._stops.tables[self._k], t - self._leaves
        return table.at(*table.instant(now))

    def _left(self, s: float) -> bool:
        return self._k is not None and self._begun + s >= self._leaves - 1e-9


class PathStop(Along):
    """A stop on the path of a motion that runs slowed: the speed factor goes to 0."""

    def __init__(
        self, loaded: ArmModel, gains: tuple[float, float], state: ArmState, path: Course, t: float, factor: float,
        rate: float, options: StopOptions,
    ) -> None:  # fmt: skip
        """The stop from time t of the path, s. rate: rate of the speed factor at which the load stays, 1/s."""
        self._path, self._t, self._factor, self._rate = path, t, factor, rate
        super().__init__(loaded, gains, state, options)

    @property
    def allowed(self) -> Array:
        return np.zeros(self._loaded.n)

    @property
    def rests(self) -> float:
        return self._factor / self._rate

    def course(self, s: float) -> tuple[Array, Array, Array]:
        factor = max(self._factor - self._rate * s, 0.0)
        now = self._t + 0.5 * (self._factor + factor) * min(s, self.rests)
        q, dq, ddq = self._path.at(*self._path.instant(now))
        return q, factor * dq, factor**2 * ddq - (self._rate * dq if factor else 0.0)

    def following(self, state: ArmState, s: float) -> Array | None:
        return None


def _torque(
    loaded: ArmModel, state: ArmState, reference: tuple[Array, Array, Array], gains: tuple[float, float]
) -> Array:
    wanted = wanted_acceleration(reference, state, gains)
    return np.asarray(pin.rnea(loaded.pin_model, loaded.data, state.q, state.dq, wanted)).copy()
