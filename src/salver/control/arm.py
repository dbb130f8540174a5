"""The arm's controller: computed torque that carries the object along its reference (paper, eqs 22 and 25).

    tau = J_b^T F_cmd + M_r u + C_r dq + N_r,        u = J_b^+ (V'_cmd - J_b' dq) + (1 - J_b^+ J_b) ddq_0

F_cmd and V'_cmd are those of the object's controller, eq (19), with the errors of `salver.control.object`, which
include the pose, so that there is no drift. J_b^T F_cmd is the paper's J_c^T F_c: while the object sticks,
J_c = G^T J_b (eq 24). ddq_0 is the acceleration of a posture task around the joint reference; eq (25) prints a
velocity. The simulation and a robot's driver both call `ArmController.step` once in each command period.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dposv

from salver.control.object import Gains
from salver.geometry import GRAVITY_S, Array
from salver.models.arm.arm import ArmModel, with_load, with_stand_ins
from salver.models.bodies import Body
from salver.scenario import Scenario
from salver.trajectory import JointMotion, Reference

OBJECT_FRAME = "salver_object"
POSTURE_GAINS = (100.0, 20.0)  # 1/s^2, 1/s: critically damped, slower than the object's own loop
_ORIGIN = np.zeros(3)
_GRAVITY = pin.Motion(GRAVITY_S, _ORIGIN)
_SINGULAR = 1e-3  # with a smaller pivot of J J^T's Cholesky factor, the pseudo-inverse is damped by this amount


@dataclass(slots=True)
class ArmState:
    """The measured state: joints q, dq (n,) in rad, rad/s; pose and twist of the object if they are measured.

    p_SB (3,), R_SB (3, 3), v_S (3,), omega_B (3,) as in docs/conventions.md; needed only with feedback = "object".
    """

    q: Array
    dq: Array
    p_SB: Array | None = None
    R_SB: Array | None = None
    v_S: Array | None = None
    omega_B: Array | None = None


@dataclass
class Saturation:
    """Statistics of the saturation of commanded torques.

    steps: control periods so far. torque, torque_rate: periods in which the torque or the torque rate of a joint was
    saturated. peak_share: largest demanded torque, before saturation, as a share of its limit.
    """

    steps: int = 0
    torque: int = 0
    torque_rate: int = 0
    peak_share: float = 0.0


class Course(Protocol):
    """A joint reference for a control loop: `at(*instant(t))` is q, dq, ddq (n,) at time t, s."""

    def instant(self, t: float) -> tuple[int, float]: ...

    def at(self, index: int, offset: float) -> tuple[Array, Array, Array]: ...


class JointTable:
    """A joint motion sampled at multiples of a period, s, for a control loop that has no time to evaluate splines."""

    def __init__(self, joint: JointMotion, period: float) -> None:
        self.period, self.duration = period, joint.duration
        self.t = np.arange(int(np.ceil(joint.duration / period - 1e-9)) + 1) * period
        self.q, self.dq, self.ddq = joint.sample(np.minimum(self.t, joint.duration))
        self._dddq = np.gradient(self.ddq, period, axis=0) if len(self.t) > 1 else np.zeros_like(self.ddq)

    def instant(self, t: float) -> tuple[int, float]:
        """Index of the nearest sample, and the time since it, s; that is 0 before the start and after the end."""
        if t <= 0.0:
            return 0, 0.0
        if t >= self.duration:
            return len(self.q) - 1, 0.0
        index = round(t / self.period)
        offset = t - index * self.period
        return index, 0.0 if abs(offset) < 1e-9 else offset

    def at(self, index: int, offset: float) -> tuple[Array, Array, Array]:
        """q, dq, ddq (n,) at an instant."""
        q, dq, ddq = self.q[index], self.dq[index], self.ddq[index]
        return _ahead(offset, q, dq, ddq, self._dddq[index]) if offset else (q, dq, ddq)


def wanted_acceleration(reference: tuple[Array, Array, Array], state: ArmState, gains: tuple[float, float]) -> Array:
    """Commanded joint acceleration (n,) from the reference q, dq, ddq, the measured state, and gains (kp, kd)."""
    q, dq, ddq = reference
    kp, kd = gains
    return np.asarray(ddq + kp * (q - state.q) + kd * (dq - state.dq))


class ArmController:
    """Computed-torque controller that moves the first of `bodies` along `reference`; the others stick to the tray.

    Args:
        arm: the arm with its tray; links without mass have `STAND_IN`, as in the physics engine.
        bodies: the nominal load; the controller uses no other parameters of it.
        joint: joint motion that follows the reference: the posture in the null space, or with space = "joint" the only
            reference. With space = "joint" it may be a `Course`, which is not known in advance.
        reference: motion of the object; may be None with space = "joint".
        gains: of the object's loop, eq (19); with space = "joint", kp[0] and kd[0] of every joint.
        feedback: "joints": the pose of the object comes from forward kinematics, with the object at its place on the
            tray; "object": its pose and twist are measured.
        space: "object" closes the loop on the object's pose, "joint" on the joints, for plans made in joint space.
        period: s between calls of `step`; the reference is sampled in advance at its multiples.
        limit_torque: saturate torques and torque rates at the maker's limits, as the robot does.

    After the end `step` holds the last posture, before t = 0 the first. A controller has one work space: use one in
    each thread.
    """

    def __init__(
        self,
        arm: ArmModel,
        bodies: Sequence[Body],
        joint: JointMotion | Course,
        reference: Reference | None,
        gains: Gains,
        *,
        feedback: Literal["joints", "object"] = "joints",
        space: Literal["object", "joint"] = "object",
        period: float = 1e-3,
        limit_torque: bool = True,
    ) -> None:
        if space == "object" and reference is None:
            raise ValueError("a controller in object space needs the object's reference")
        body = bodies[0]
        self.arm, self.gains, self.feedback, self.space, self.period = arm, gains, feedback, space, period
        self.saturation = Saturation()
        # B is the nominal centre of mass.
        self._inertia = pin.Inertia(body.inertial.mass, _ORIGIN, body.inertial.inertia_com)
        self._turn, self._turning, self._carried = pin.SE3.Identity(), pin.Motion.Zero(), pin.Motion.Zero()
        self._kp, self._kd = np.repeat(gains.kp, 3), np.repeat(gains.kd, 3)
        self._posture_gains = POSTURE_GAINS if space == "object" else (gains.kp[0], gains.kd[0])
        fixed = bodies if space == "joint" else bodies[1:]
        self._model = _with_object_frame(with_load(with_stand_ins(arm), fixed), body)
        self._data = self._model.createData()
        self._frame = self._model.getFrameId(OBJECT_FRAME)
        self._torque_limit = arm.limits.torque if limit_torque else np.full(arm.n, np.inf)
        self._torque_step = arm.limits.torque_rate * period if limit_torque else np.full(arm.n, np.inf)
        self._previous: Array | None = None

        self._joint = table = JointTable(joint, period) if isinstance(joint, JointMotion) else joint
        if reference is not None:
            if not isinstance(table, JointTable):
                raise ValueError("a controller in object space needs a JointMotion, not a Course")
            m = reference.sample(np.minimum(table.t, reference.duration))
            self._p, self._v, self._a = m.p_SB, m.v_S, m.a_S
            self._rotation, self._omega, self._alpha = m.R_SB, m.omega_B, m.alpha_B
            self._jerk, self._angular_jerk = (np.gradient(x, period, axis=0) for x in (m.a_S, m.alpha_B))
            samples = zip(m.p_SB, m.R_SB, m.v_S, m.omega_B, m.a_S, m.alpha_B, strict=True)
            self._at_samples = [_spatial(*sample) for sample in samples]

    def reset(self) -> None:
        """Clear the last torque and the counts of saturation, for another run."""
        self._previous = None
        self.saturation = Saturation()

    def take_over(self, other: ArmController) -> None:
        """Continue from another controller's last torque and counts of saturation."""
        self._previous, self.saturation = other._previous, other.saturation

    def step(self, state: ArmState, t: float) -> Array:
        """Joint torques (n,), N m, for a state at time t, s."""
        index, offset = self._joint.instant(t)
        model, data, q, dq = self._model, self._data, state.q, state.dq
        ddq = wanted_acceleration(self._joint.at(index, offset), state, self._posture_gains)

        if self.space == "joint":
            return self._limited(pin.rnea(model, data, q, dq, ddq))

        pin.forwardKinematics(model, data, q, dq, ddq)
        placement = pin.updateFramePlacement(model, data, self._frame)
        pin.computeJointJacobians(model, data)
        jacobian = pin.getFrameJacobian(model, data, self._frame, pin.LOCAL)
        by_posture = pin.getFrameAcceleration(model, data, self._frame, pin.LOCAL)
        acceleration, wrench_B = self._object_command(state, index, offset, placement)
        # ddq + J^+ (V'_cmd - J' dq - J ddq): eq (25) with the posture's acceleration in the null space.
        transposed = jacobian.T
        gram, missing = jacobian.dot(transposed), (acceleration - by_posture).vector
        factor, multiplier, failed = dposv(gram, missing)
        if failed or min(factor.diagonal().tolist()) < _SINGULAR:
            multiplier = np.linalg.solve(gram + _SINGULAR**2 * np.eye(6), missing)
        ddq = ddq + transposed.dot(multiplier)
        return self._limited(pin.rnea(model, data, q, dq, ddq) + transposed.dot(wrench_B.vector))

    def _object_command(self, state: ArmState, index: int, offset: float, placement: Any) -> tuple[Any, Any]:
        """Commanded rate of the body twist, eq (19), and the wrench at B for it: spatial vectors in the axes of B.

        They are Pinocchio's, because NumPy takes twice as long for such short vectors.
        """
        target, target_twist, target_acceleration = self._reference_at(index, offset)
        if self.feedback == "object":
            if state.p_SB is None or state.R_SB is None or state.v_S is None or state.omega_B is None:
                raise ValueError("feedback from the object needs its pose and twist in the state")
            placement = pin.SE3(state.R_SB, state.p_SB)
            twist = pin.Motion(state.R_SB.T @ state.v_S, state.omega_B)
        else:
            twist = pin.getFrameVelocity(self._model, self._data, self._frame, pin.LOCAL)
        error = placement.actInv(target)
        turn, turning, carried = self._turn, self._turning, self._carried
        turn.rotation = error.rotation
        wanted_twist = turn.act(target_twist)
        wanted = turn.act(target_acceleration)
        rate = wanted.vector  # a view: additions change `wanted`
        rate += self._kd * (wanted_twist - twist).vector
        rate += self._kp * pin.Motion(error.translation, pin.log3(error.rotation)).vector
        # The axes of B turn: in them, a vector that is constant in S has the rate -omega x itself.
        turning.angular = twist.angular
        carried.linear, carried.angular = twist.linear, wanted_twist.angular
        acceleration = wanted - turning.cross(carried)
        # Eq (1) of the nominal object.
        wrench_B = self._inertia * (acceleration - placement.actInv(_GRAVITY)) + self._inertia.vxiv(twist)
        return acceleration, wrench_B

    def _reference_at(self, index: int, offset: float) -> tuple[Any, Any, Any]:
        """The reference at an instant: pose in S, twist and acceleration (R*^T a*, alpha*) in the reference's axes."""
        if not offset:
            return self._at_samples[index]
        p, v, a = _ahead(offset, self._p[index], self._v[index], self._a[index], self._jerk[index])
        turn, omega, alpha = _ahead(offset, 0.0, self._omega[index], self._alpha[index], self._angular_jerk[index])
        return _spatial(p, self._rotation[index] @ pin.exp3(turn), v, omega, a, alpha)

    def _limited(self, torque: Array) -> Array:
        """Saturate the torque's rate, then the torque, at the limits, and count it in `saturation`."""
        report = self.saturation
        report.steps += 1
        share = max((np.abs(torque) / self._torque_limit).tolist())
        report.peak_share = max(report.peak_share, share)
        if self._previous is not None:
            change = torque - self._previous
            if True in (np.abs(change) > self._torque_step).tolist():
                report.torque_rate += 1
                torque = self._previous + np.clip(change, -self._torque_step, self._torque_step)
        if share > 1.0:
            report.torque += 1
            torque = np.clip(torque, -self._torque_limit, self._torque_limit)
        self._previous = torque
        return torque


class PositionController(ArmController):
    """A model of a robot's internal position controller: each joint follows the commanded positions as

        q'' + 2 damping rate q' + rate^2 q = rate^2 commanded(t - delay),

    with a rate (n,) in rad/s, a damping (n,) as a share of critical, and a delay in s. It uses the nominal arm and
    `bodies`. Torque rates are not limited, because those limits are of a robot's torque interface.
    """

    def __init__(
        self, arm: ArmModel, bodies: Sequence[Body], commanded: JointMotion, rate: Array, damping: Array, delay: float,
        *, period: float = 1e-3,
    ) -> None:  # fmt: skip
        super().__init__(arm, bodies, commanded, None, Gains((1.0, 1.0), (1.0, 1.0)), space="joint", period=period)
        self._rate, self._damping, self._delay = rate, damping, delay
        self._torque_step = np.full_like(self._torque_limit, np.inf)

    def step(self, state: ArmState, t: float) -> Array:
        """Joint torques (n,), N m, for a state at time t, s."""
        commanded = self._joint.at(*self._joint.instant(t - self._delay))[0]
        ddq = self._rate * (self._rate * (commanded - state.q) - 2 * self._damping * state.dq)
        return self._limited(pin.rnea(self._model, self._data, state.q, state.dq, ddq))


@dataclass
class Relay:
    """Two controllers in sequence: `first` until the time `at`, s, then `second`, whose time starts at 0 there."""

    first: ArmController
    second: ArmController
    at: float

    @property
    def saturation(self) -> Saturation:
        return self.first.saturation

    def reset(self) -> None:
        self.first.reset()
        self.second.reset()

    def step(self, state: ArmState, t: float) -> Array:
        """Joint torques (n,), N m, for a state at time t, s."""
        if t < self.at - 1e-9:
            return self.first.step(state, t)
        if self.second.saturation is not self.first.saturation:
            self.second.take_over(self.first)
        return self.second.step(state, t - self.at)


def controller_for(
    scenario: Scenario,
    joint: JointMotion | Course,
    reference: Reference | None,
    *,
    arm: ArmModel | None = None,
    space: Literal["object", "joint"] = "object",
    bodies: Sequence[Body] | None = None,
) -> ArmController:
    """The controller of a scenario, with its arm, nominal load, gains, feedback and command period.

    bodies: replaces the scenario's nominal load. Raises ScenarioError when the scenario has no arm.
    """
    return ArmController(
        scenario.load_arm() if arm is None else arm,
        scenario.payload.bodies if bodies is None else bodies,
        joint,
        reference,
        Gains(scenario.control.kp, scenario.control.kd),
        feedback=scenario.physics.feedback,
        space=space,
        period=scenario.physics.command_period,
    )


def _ahead(dt: float, x: Any, dx: Array, ddx: Array, dddx: Array) -> tuple[Any, Array, Array]:
    """Value, first and second derivative a time dt later, by Taylor's series."""
    rate = dx + dt * (ddx + (0.5 * dt) * dddx)
    return x + dt * (dx + (0.5 * dt) * (ddx + (dt / 3) * dddx)), rate, ddx + dt * dddx


def _spatial(p: Array, rotation: Array, v: Array, omega: Array, a: Array, alpha: Array) -> tuple[Any, Any, Any]:
    """A pose with its velocity and acceleration, linear parts given in S, as spatial vectors in its own axes."""
    back = rotation.T
    return pin.SE3(rotation, p), pin.Motion(back @ v, omega), pin.Motion(back @ a, alpha)


def _with_object_frame(arm: ArmModel, body: Body) -> Any:
    """Pinocchio's model of the arm with the frame B of a body on the tray added."""
    model = arm.pin_model.copy()
    tray = model.frames[arm.tray_id]
    placement = tray.placement * pin.SE3(body.R_EB, body.p_EB)
    model.addFrame(pin.Frame(OBJECT_FRAME, tray.parentJoint, arm.tray_id, placement, pin.FrameType.OP_FRAME))
    return model
