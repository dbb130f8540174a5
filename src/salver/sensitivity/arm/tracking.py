"""Tracking errors of a joint motion from parameter errors of the load and from the zero-order hold.

The controller is computed torque with the nominal load. Let M be the mass matrix of the arm with it, J_E the body
Jacobian of the tray, and dF the additional wrench of the true load along the motion (`salver.sensitivity.arm.load`).
Then the acceleration

    m(t) = M(q)^-1 J_E(q)^T dF(t),        dF = (d load / dp) w(t)

is missing from the commanded one, for any law of the commanded acceleration. With a loop on the joints the error obeys

    e'' + kd e' + kp e = m(t),            e = q* - q,

the linear filter of the paper's object (`salver.linear_filter`). The additional load also acts on the deviation that it
causes: a second-order effect through the same filter, with the products of two parameters.

A command is held for a period, so that it acts late: M^-1 dtau/dt times the delay is missing too, in every run alike.
Before the motion the arm has rested under its load for some time, with a static deflection.

Fastest plans and the chain use this model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from salver.geometry import Array, Indices, hat
from salver.linear_filter import LinearFilter, at_instant, settled
from salver.models.payload import Payload
from salver.models.tray_motion import N_MOTION
from salver.models.uncertain.worst_case import Drift
from salver.scenario import Scenario
from salver.sensitivity.arm.load import LoadChange, load_change
from salver.sensitivity.arm.terms import MotionTerms


@dataclass(frozen=True)
class JointDeviation:
    """d/dp of the joints' motion at T instants, in rad, rad/s, rad/s^2 per unit of p.

    state: (T, 3 n, n_c), of q, dq and ddq, stacked. missing: (T, n, n_c) missing acceleration ddq_cmd - ddq.
    """

    state: Array
    missing: Array

    @property
    def q(self) -> Array:
        """(T, n, n_c)."""
        return self.state[:, : self.missing.shape[1]]

    @property
    def dq(self) -> Array:
        """(T, n, n_c)."""
        n = self.missing.shape[1]
        return self.state[:, n : 2 * n]

    @property
    def ddq(self) -> Array:
        """(T, n, n_c)."""
        return self.state[:, 2 * self.missing.shape[1] :]


@dataclass(frozen=True)
class TrayDeviation:
    """d/dp of the tray's motion at T instants, n_c parameters.

    state: (T, 12, n_c) rows dp in S, dtheta in E, dv in S, domega in E. w: (T, 12, n_c) of its motion regressor, in E.
    """

    state: Array
    w: Array


class Law(Protocol):
    """Response of a loop to a missing acceleration."""

    def __call__(
        self, missing: Array, before: Array, start: Array | None = None
    ) -> tuple[JointDeviation, TrayDeviation]:
        """Deviations by a missing acceleration (T, n, n_c). before: (n_c,) 1 for terms that act before the motion too,
        else 0. start: (2, n, n_c) e and e' at the beginning, which replace `before`."""
        ...


@dataclass(frozen=True, eq=False)
class Reaction:
    """Compliance of an arm along `terms` to each of K wrenches that its controller does not include."""

    terms: MotionTerms
    joints: JointDeviation
    tray: TrayDeviation

    @cached_property
    def w(self) -> Array:
        """Change (K, T, 12) of the tray's motion regressor."""
        return self.tray.w.transpose(2, 0, 1)

    @cached_property
    def torque(self) -> Array:
        """Change (T, n, K) of the commanded torque, N m."""
        return commanded(self.terms, self.joints)

    def part(self, some: slice | Indices) -> Reaction:
        """The compliance to some of the wrenches."""
        joints, tray = ({name: x[..., some] for name, x in vars(of).items()} for of in (self.joints, self.tray))
        return Reaction(self.terms, JointDeviation(**joints), TrayDeviation(**tray))


@dataclass(frozen=True, eq=False)
class HeldCommands:
    """Deviation of the nominal motion by the zero-order hold: q, dq, torque (T, n), tray, w (T, 12), see `Deviation`.

    These are means over a period. swing: (T, 12) change of w from the mean to the beginning of a command, with the
    opposite sign at its end. late: (T, n) rad/s^2, missing acceleration of late commands.
    """

    q: Array
    dq: Array
    torque: Array
    tray: Array
    w: Array
    swing: Array
    late: Array

    def __add__(self, other: HeldCommands) -> HeldCommands:
        """Sum of two hold effects."""
        return HeldCommands(*(a + b for a, b in zip(vars(self).values(), vars(other).values(), strict=True)))


@dataclass(frozen=True, eq=False)
class Deviation:
    """Deviation of a motion at T instants, per unit of each of n_c terms of the parameter error, and by the zero-order
    hold.

    terms: of the planned motion. joints, tray: their deviations. torque: (T, n, n_c) of the commanded torque, N m. law:
    of the loop.
    """

    load: LoadChange
    terms: MotionTerms
    joints: JointDeviation
    tray: TrayDeviation
    torque: Array
    held: HeldCommands
    law: Law

    def along(self, terms: MotionTerms) -> Deviation:
        """The deviation along a similar motion, with its terms."""
        return replace(self, terms=terms)

    def reaction(self, wrench: Array, start: Array | None = None) -> Reaction:
        """Response of the arm, to first order, to wrenches (K, T, 6) at E that the controller does not include.

        start: (2, n, K) e and e' where the motion begins, 0 unless given.
        """
        pushed = np.asarray(np.swapaxes(self.terms.jacobian, 1, 2) @ wrench.transpose(1, 2, 0), dtype=float)
        missing = self.terms.mass_inverse @ pushed
        return Reaction(self.terms, *self.law(missing, np.zeros(len(wrench)), start))

    def felt(self, held: bool = True) -> tuple[Array, Drift]:
        """w (T, 12) at nominal parameters, and its change by parameter errors. held: include the zero-order hold."""
        drift = Drift(self.load.terms, self.tray.w * self.load.half_range, self.held.swing if held else None)
        return self.terms.w + self.held.w if held else self.terms.w, drift

    def state_at(self, t: Array, now: float) -> Array:
        """e and e' (2, n, n_c + 1) at the instant `now`, of each term and of late commands. t: (T,) of the nodes."""
        joints, held = self.joints, self.held
        both = (joints.q, held.q[:, :, None]), (joints.dq, held.dq[:, :, None])
        return -np.stack([np.concatenate([at_instant(t, x, now) for x in each], axis=1) for each in both])

    def joint_radius(self, order: int) -> Array:
        """Largest deviation (T, n) of the joints' position (order 0), velocity (1) or acceleration (2) from the
        plan."""
        name = ("q", "dq", "ddq")[order]
        return self._radius(getattr(self.joints, name), getattr(self.held, name))

    def torque_radius(self) -> Array:
        """Largest deviation (T, n) of the commanded torque from the plan, N m."""
        return self._radius(self.torque, self.held.torque)

    def tray_radius(self) -> tuple[Array, Array]:
        """Largest error of the tray's position (T, 3) in S, m, and of its orientation (T, 3) in E, rad."""
        moved = self._radius(self.tray.state[:, :6], self.held.tray[:, :6])
        return moved[:, :3], moved[:, 3:]

    def _radius(self, sensitivity: Array, held: Array) -> Array:
        """Largest change (T, m) of a quantity by parameter errors and the zero-order hold together."""
        return np.asarray(np.abs(held) + self.load.radius(sensitivity))


@dataclass(frozen=True, eq=False)
class JointLoop:
    """Computed torque with a loop on the joints and the nominal load.

    load: effect of the uncertain parameters. kp, kd: gains, 1/s^2 and 1/s. settle: s at rest under the load before the
    motion. delay: s, delay of a command by the hold, half a period. start: (2, n, n_c + 1) e and e' of each term and of
    late commands at the beginning, if the motion does not begin from that rest.
    """

    load: LoadChange
    kp: float
    kd: float
    settle: float
    delay: float
    start: Array | None = None

    @property
    def settling(self) -> float:
        """Time of rest after which a deviation has settled, s: eight time constants."""
        return float(8.0 / np.sqrt(self.kp))

    def begun(self, start: Array) -> JointLoop:
        """The loop for a motion that begins with a deviation (2, n, n_c + 1), as `Deviation.state_at` gives it."""
        return replace(self, start=start)

    def along(
        self,
        t: Array,
        terms: MotionTerms,
        rates: Array,
        order: int = 3,
        shares: Array | None = None,
        before: Array | None = None,
    ) -> Deviation:
        """The deviation along a motion at nodes t (T,) of any spacing; rates: (3, T, n) dq, ddq, dddq.

        order: of the polynomial for the missing acceleration between nodes, 1 or 3. shares: the nodes as shares of the
        duration, if other motions have them too (for a cache). before: (T, n) dddq just before each node, if it jumps:
        the missing acceleration of late commands then jumps too, which a polynomial cannot represent.
        """
        response = LinearFilter.on_nodes(t, self.kp, self.kd, order, shares)

        def law(missing: Array, before: Array, start: Array | None = None) -> tuple[JointDeviation, TrayDeviation]:
            if start is None and before.any():
                start = settled(self.kp, self.kd, self.settle, missing[0] * before)
            e, rate = response.respond(missing, start)
            state = np.concatenate([e, rate, response.acceleration(missing, e, rate)], axis=1)
            joints = JointDeviation(np.negative(state, out=state), missing)
            return joints, tray_of_joints(terms, joints)

        late_by = late(terms, rates, self.delay, not len(self.load.half_range))
        if before is None:
            return deviation(self.load, terms, late_by, law, self.start)
        # Jumps are treated exactly, as steps; the rest is continuous.
        steps = np.cumsum(self.delay * (rates[2] - before), axis=0)
        found = deviation(self.load, terms, late_by - steps, law, self.start)
        filter_ = replace(LinearFilter.on_nodes(t, self.kp, self.kd, 1, shares), samples=None)
        e, rate = filter_.respond(np.repeat(steps[:-1], 2, axis=0))
        state = np.concatenate([e, rate, filter_.acceleration(steps, e, rate)], axis=1)
        joints = JointDeviation(-state[:, :, None], steps[:, :, None])
        stepped = _held(terms, joints, tray_of_joints(terms, joints), commanded(terms, joints))
        return replace(found, held=found.held + stepped)

    def sag(self, terms: MotionTerms) -> Drift:
        """Change of the tray's specific force when the arm rests in each posture of a motion: the static deflection
        e = m / kp by parameter errors tilts the tray. Includes second order in the load."""
        n_p = self.load.uncertain.size
        up, jacobian = terms.up, terms.jacobian
        w = np.zeros_like(terms.w)
        w[:, :3] = up

        def leaning(wrench: Array) -> Array:
            """dw (T, 12, n_c) by wrenches (T, n_c, 6) at E that the controller does not include."""
            missing = terms.mass_inverse @ np.swapaxes(wrench @ jacobian, 1, 2)
            dw = np.zeros((len(w), N_MOTION, wrench.shape[1]))
            dw[:, :3] = hat(up) @ (jacobian[:, 3:] @ missing) / -self.kp
            return dw

        wrench = np.tensordot(w, self.load.load_p, axes=(1, 2))
        dw = leaning(wrench)
        if dw.shape[2] > n_p:
            again = leaning(self.load.products(self.load.load_p, dw).swapaxes(1, 2))
            dw[:, :, n_p:] += again
        return Drift(self.load.terms, dw * self.load.half_range)


def joint_loop(scenario: Scenario, payload: Payload) -> JointLoop:
    """The loop of a scenario's controller, for the uncertain set of a payload; of a robot under position control that
    of its slowest joint."""
    physics, robot = scenario.physics, scenario.physics.robot
    kp, kd, delay = scenario.control.kp[0], scenario.control.kd[0], 0.5 * physics.command_period
    if robot.control == "position":
        rate = 2 * np.pi * float(np.min(robot.bandwidth))
        kp, kd = rate**2, 2 * float(np.min(robot.damping)) * rate
    return JointLoop(load_change(payload), kp, kd, physics.settle_before, delay)


def missing_acceleration(load: LoadChange, terms: MotionTerms) -> Array:
    """Missing acceleration M^-1 J_E^T dF (T, n, n_c), rad/s^2."""
    if not len(load.half_range):
        return np.zeros((*terms.q.shape, 0))
    wrench = np.tensordot(terms.w, load.load_p, axes=(1, 2))  # (T, n_c, 6)
    return np.asarray(terms.mass_inverse @ np.swapaxes(wrench @ terms.jacobian, 1, 2))


def commanded(terms: MotionTerms, joints: JointDeviation) -> Array:
    """Change (T, n, n_c) of the commanded torque, N m: by the joints' deviation, and by the missing acceleration."""
    return np.asarray(terms.torque_z @ joints.state + terms.mass_matrix @ joints.missing)


def late(terms: MotionTerms, rates: Array, delay: float, alone: bool = False) -> Array:
    """Missing acceleration (T, n) of the hold delay: M^-1 dtau/dt times the delay. rates: (3, T, n) dq, ddq, dddq.

    alone: whether M^-1 is not needed elsewhere, so that a solve is cheaper.
    """
    torque_rate = terms.torque_z @ rates.swapaxes(0, 1).reshape(len(terms.q), -1, 1)
    lost = np.linalg.solve(terms.mass_matrix, torque_rate) if alone else terms.mass_inverse @ torque_rate
    return np.asarray(delay * lost[:, :, 0])


def deviation(load: LoadChange, terms: MotionTerms, late: Array, law: Law, start: Array | None = None) -> Deviation:
    """Deviation under a law by parameter errors, to second order, and by the hold delay. start: as in `JointLoop`."""
    n_p, n_c = load.uncertain.size, len(load.half_range)
    missing = missing_acceleration(load, terms)
    # A parameter error acts before the motion too, a late command does not.
    first = np.concatenate([missing[:, :, :n_p], late[:, :, None]], axis=2)
    begun = None if start is None else np.concatenate([start[:, :, :n_p], start[:, :, n_c:]], axis=2)
    joints, tray = law(first, np.append(np.ones(n_p), 0.0), begun)
    torque = commanded(terms, joints)
    held = _held(terms, joints, tray, torque)
    loads = [[x[:, :, :-1] for x in (*vars(joints).values(), *vars(tray).values(), torque)]]
    if n_c > n_p:
        wrench = np.swapaxes(terms.jacobian, 1, 2) @ load.products(load.load_p, tray.w)
        begun = None if start is None else start[:, :, n_p:n_c]
        joints, tray = law(missing[:, :, n_p:] + terms.mass_inverse @ wrench, np.ones(n_c - n_p), begun)
        loads.append([*vars(joints).values(), *vars(tray).values(), commanded(terms, joints)])
    state, missing, moved, w, torque = (np.concatenate(x, axis=2) for x in zip(*loads, strict=True))
    return Deviation(load, terms, JointDeviation(state, missing), TrayDeviation(moved, w), torque, held, law)


def _held(terms: MotionTerms, joints: JointDeviation, tray: TrayDeviation, torque: Array) -> HeldCommands:
    """The effect of the hold delay, which is the last term of the deviations."""
    late, swing = joints.missing[:, :, -1], np.zeros_like(terms.w)
    swing[:, :6] = (terms.jacobian @ late[:, :, None])[:, :, 0]
    q, dq, torque, moved, w = (x[:, :, -1] for x in (joints.q, joints.dq, torque, tray.state, tray.w))
    return HeldCommands(q, dq, torque, moved, w, swing, late)


def tray_of_joints(terms: MotionTerms, joints: JointDeviation) -> TrayDeviation:
    """Deviation of the tray by a deviation of the joints."""
    shift, rate, felt = terms.changed(joints.state)
    R, theta = terms.R_SE, shift[:, 3:]
    slid = rate[:, :3] - hat(terms.twist[:, :3]) @ theta
    return TrayDeviation(np.concatenate([R @ shift[:, :3], theta, R @ slid, rate[:, 3:]], axis=1), felt)
