"""From samples as they were read to a motion of the tray with accelerations, and what had to be assumed for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import BPoly

from salver.audit.samples import JointSamples, Samples, TraySamples, reordered
from salver.audit.smoothing import Smooth, gaps, smooth
from salver.errors import FileFormatError, SalverError
from salver.geometry import Array, hat, matrix_from_quat_wxyz
from salver.trajectory import MotionSamples

if TYPE_CHECKING:
    from salver.models.arm import ArmModel

PER_BANDWIDTH = 20  # instants per period of the highest frequency that is let through: peaks are met to 1.2 %
MOST_INSTANTS = 20_000
COARSE = 0.02  # s: waypoints further apart than this are a controller's, not a recording's


@dataclass(frozen=True)
class TrayMotion:
    """The tray's motion as it will be audited.

    samples: of frame E in S. noise: standard deviations found in the samples, m and rad (or rad of the joints), by
    name. bandwidth: Hz, of the narrowest smoothing used; None where nothing was smoothed.
    acceleration_noise: what the noise leaves in the acceleration of the tray, m/s^2 (estimate, mid-motion).
    notes: sentences on what was repaired or assumed.
    """

    samples: MotionSamples
    noise: dict[str, float]
    bandwidth: float | None
    acceleration_noise: float
    notes: tuple[str, ...]


def tray_motion(
    samples: Samples,
    arm: ArmModel | None,
    p_BE: Array,
    R_BE: Array,
    bandwidth: float | None = None,
    longest_gap: float | None = None,
) -> TrayMotion:
    """Motion of the tray E. p_BE, R_BE: pose of E in the object frame B, for files that tell B's motion.

    bandwidth: Hz of the smoothing, found from the data if None. longest_gap: s without samples that is bridged
    (default: 0.1 s and three steps). Raises FileFormatError or SalverError with a sentence.
    """
    notes = list(samples.notes)
    _check_gaps(samples, longest_gap, notes)
    if isinstance(samples, TraySamples):
        motion, noise, fits = _from_poses(samples, bandwidth)
        if samples.frame == "B":
            motion = motion.of_frame(p_BE, R_BE)
        acceleration_noise = fits[0].acceleration_noise
    else:
        if arm is None:
            raise SalverError(
                f"{samples.source} is a joint motion, but the scenario has no arm; give it one, or a tray motion."
            )
        samples = reordered(samples, arm.joint_names)
        if samples.q.shape[1] != arm.n:
            raise FileFormatError(f"{samples.source} has {samples.q.shape[1]} joints; the arm {arm.name} has {arm.n}.")
        t, q, dq, ddq, fits = _joints(samples, bandwidth, notes)
        motion = forward(arm, t, q, dq, ddq)
        noise = {"joints": fits[0].noise} if fits else {}
        gain = np.linalg.norm(arm.body_jacobian(q[len(q) // 2])[:3])
        acceleration_noise = fits[0].acceleration_noise * float(gain) if fits else 0.0
    for fit in fits:
        moving = [end for end, still in zip(("start", "end"), fit.rest, strict=True) if not still]
        if moving:
            where = " and ".join(moving)
            notes.append(f"The motion is not at rest at its {where}; accelerations there are less certain.")
            break
    narrowest = min((fit.bandwidth for fit in fits), default=None)
    return TrayMotion(motion, noise, narrowest, float(acceleration_noise), tuple(notes))


def _check_gaps(samples: Samples, longest_gap: float | None, notes: list[str]) -> None:
    step = float(np.median(np.diff(samples.t)))
    if isinstance(samples, JointSamples) and samples.dq is not None and step > COARSE:
        return  # waypoints with velocities: what happens between them is defined
    allowed = longest_gap if longest_gap is not None else 0.1 + 3 * step
    gap, when = gaps(samples.t)
    if gap > allowed:
        raise SalverError(
            f"{samples.source} has no samples for {gap:.3g} s after t = {when:.3f} s, when they otherwise come every "
            f"{step:.3g} s; what happened then is unknown; bridge it with --gap {1.01 * gap:.2g} if it may be guessed."
        )
    if gap > 5 * step:
        notes.append(f"No samples for {gap:.3g} s after t = {when:.3f} s; the motion there is a smooth guess.")


def _grid(t: Array, fits: tuple[Smooth, ...]) -> Array:
    """Instants to judge: dense enough for what the smoothing lets through, both ends included."""
    fastest = max(fit.bandwidth for fit in fits)
    count = int(np.clip(np.ceil(PER_BANDWIDTH * fastest * (t[-1] - t[0])), 200, MOST_INSTANTS))
    return np.linspace(t[0], t[-1], count + 1)


def _from_poses(
    samples: TraySamples, bandwidth: float | None
) -> tuple[MotionSamples, dict[str, float], tuple[Smooth, ...]]:
    """Position and quaternion smoothed as seven numbers; the quaternion need not stay normalised.

    With Q = |Q| q: Q^-1 Q' has the vector part omega/2, and Q^-1 Q'' - (Q^-1 Q')^2 has alpha/2.
    """
    position = smooth(samples.t, samples.p, bandwidth)
    rotation = smooth(samples.t, samples.quat_wxyz, bandwidth)
    t = _grid(samples.t, (position, rotation))
    p, v, a = position(t)
    quat, rate, bend = rotation(t)
    inverse = quat * np.array([1, -1, -1, -1]) / np.sum(quat**2, axis=1, keepdims=True)
    spin = _product(inverse, rate)
    turn = _product(inverse, bend) - _product(spin, spin)
    motion = MotionSamples(t, p, v, a, matrix_from_quat_wxyz(quat), 2 * spin[:, 1:], 2 * turn[:, 1:])
    return motion, {"position": position.noise, "orientation": 2 * rotation.noise}, (position, rotation)


def _product(a: Array, b: Array) -> Array:
    """Products (N, 4) of quaternions (w, x, y, z)."""
    w = a[:, 0] * b[:, 0] - np.einsum("ij,ij->i", a[:, 1:], b[:, 1:])
    xyz = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w[:, None], xyz], axis=1)


def _joints(
    samples: JointSamples, bandwidth: float | None, notes: list[str]
) -> tuple[Array, Array, Array, Array, tuple[Smooth, ...]]:
    """(t, q, dq, ddq, fits). Far-apart waypoints with velocities are joined as ros2_control's joint trajectory
    controller does, by cubics, or quintics with accelerations; everything else is smoothed."""
    step = float(np.median(np.diff(samples.t)))
    if samples.dq is not None and step > COARSE and bandwidth is None:
        given = [samples.q, samples.dq, *([samples.ddq] if samples.ddq is not None else [])]
        curve = BPoly.from_derivatives(samples.t, np.stack(given, axis=1))
        # Both sides of each waypoint: the acceleration of cubics jumps there.
        inner = np.linspace(0, 1, max(3, int(np.ceil(np.diff(samples.t).max() / 2e-3))))[None, :-1]
        inner = np.clip(inner, 1e-9, None)
        t = np.append((samples.t[:-1, None] + np.diff(samples.t)[:, None] * inner).ravel(), samples.t[-1])
        notes.append(f"{len(samples.t)} waypoints, joined by {'quintics' if samples.ddq is not None else 'cubics'}.")
        q, dq, ddq = (curve.derivative(k)(t) if k else curve(t) for k in range(3))
        return t, q, dq, ddq, ()
    if step > COARSE:
        notes.append("The waypoints have no velocities; judged is a smooth curve through them.")
    fit = smooth(samples.t, samples.q, bandwidth)
    t = _grid(samples.t, (fit,))
    q, dq, ddq = fit(t)
    return t, q, dq, ddq, (fit,)


def forward(arm: ArmModel, t: Array, q: Array, dq: Array, ddq: Array) -> MotionSamples:
    """Motion of the tray E at joint positions, velocities and accelerations (T, n)."""
    import pinocchio as pin

    model, data, frame = arm.pin_model, arm.data, arm.tray_id
    p, rotation = np.empty((len(t), 3)), np.empty((len(t), 3, 3))
    twist, rate = np.empty((len(t), 6)), np.empty((len(t), 6))
    local: Any = pin.LOCAL
    for k in range(len(t)):
        pin.forwardKinematics(model, data, q[k], dq[k], ddq[k])
        placement = pin.updateFramePlacement(model, data, frame)
        p[k], rotation[k] = placement.translation, placement.rotation
        twist[k] = pin.getFrameVelocity(model, data, frame, local).vector
        rate[k] = pin.getFrameAcceleration(model, data, frame, local).vector
    v_S = np.einsum("tij,tj->ti", rotation, twist[:, :3])
    # The rate of the body twist is not the acceleration of the point: omega x v is missing.
    a_E = rate[:, :3] + np.einsum("tij,tj->ti", hat(twist[:, 3:]), twist[:, :3])
    return MotionSamples(t, p, v_S, np.einsum("tij,tj->ti", rotation, a_E), rotation, twist[:, 3:], rate[:, 3:])
