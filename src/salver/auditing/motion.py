"""From samples as they were read to a motion of the tray, and what of the motion they cannot say."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.auditing.commanded import commanded_motion, open_questions
from salver.auditing.defects import Channels, channels_of, repaired
from salver.auditing.noise import Cells, Level
from salver.auditing.recorded import LEVER, Sensor, sensor_of, stretches
from salver.display import Outlined
from salver.errors import FileFormatError, SalverError
from salver.geometry import Array, hat, quat_wxyz_from_matrix
from salver.motion_files.samples import JointSamples, Samples, TraySamples, reordered
from salver.trajectory import MotionSamples

if TYPE_CHECKING:
    from salver.models.arm import ArmModel

HIGHEST = 50.0  # Hz, unless stated: above it no arm shakes its tray so that a load would notice
BRIDGED = 0.02  # s, or so many steps: without samples, and still a curve
BRIDGED_STEPS = 3.5
FEWEST = 32  # samples, below which noise is not told from motion
LEAST_DEGREES = 12.0  # angles beyond this, of which all are within the joints' ranges as degrees, are taken for such
SUSPECT_STEP = 0.5  # s between samples: rather a clock in ms
FIERCEST = 150.0  # m/s^2: the fastest delta robots
SCATTERED = 3.0  # bandwidth over the highest frequency, beyond which a curve follows no motion
MOSTLY = 0.25  # of the time, and of the power of accelerations
_AS_FAST = 0.95


@dataclass(frozen=True)
class Recording:
    """How a recorded motion was seen. sensor: its noise. rate: Hz. highest: Hz, up to which anything unseen is reckoned
    with. bandwidth: (T,) of the curve, Hz. ends: m/s at which it begins and ends.
    slowest: m/s, of the slowest instant from which it comes to such a speed within the recording, and of that to
    which it comes from one. unseen, mirrored: see `salver.auditing.recorded.Stretch`; in s."""

    sensor: Sensor
    rate: float
    highest: float
    bandwidth: Array
    ends: tuple[float, float]
    slowest: tuple[float, float]
    unseen: tuple[Cells, ...]
    mirrored: tuple[Cells, ...]
    louder: Array | float = 1.0


@dataclass(frozen=True, repr=False)
class TrayMotion(Outlined):
    """The tray's motion E in S as it will be audited.

    acceleration_error: (T,) m/s^2, or one number: by which the acceleration may be wrong through noise. missed: the
    same, by which it may be too small because the samples are too few. recording: None for a motion that is known
    exactly. doubts: (code, clause) of what forbids to say that everything holds; suspect: of what may explain that
    something does not. notes: sentences on what was repaired, assumed or left out.
    """

    samples: MotionSamples
    acceleration_error: Array | float = 0.0
    missed: Array | float = 0.0
    recording: Recording | None = None
    doubts: tuple[tuple[str, str], ...] = ()
    suspect: tuple[tuple[str, str], ...] = ()
    notes: tuple[str, ...] = ()


def tray_motion(
    samples: Samples,
    arm: ArmModel | None,
    p_BE: Array,
    R_BE: Array,
    highest: float = HIGHEST,
    noise: float | None = None,
    longest_gap: float | None = None,
) -> TrayMotion:
    """Motion of the tray E. p_BE, R_BE: pose of E in the object frame B, for files that tell B's motion.

    highest: Hz, above which nothing shakes the tray. noise: standard deviation of the samples, m or rad; found in them
    if None. longest_gap: s without samples that is bridged (default: `BRIDGED`). Raises FileFormatError or SalverError
    with a sentence.
    """
    for name, value, least, most in (
        ("highest", highest, 1e-3, 1e4),
        ("noise", noise, 0.0, 1.0),
        ("gap", longest_gap, 0.0, 3600.0),
    ):
        if value is not None and not least <= value <= most:
            raise SalverError(f"--{name} {value:g} was asked for; it must be from {least:g} to {most:g}.")
    if isinstance(samples, TraySamples):
        found = repaired(channels_of(samples))
        samples = replace(samples, t=found.t, p=found.y[:, :3], quat_wxyz=found.y[:, 3:])
        motion = _recorded(samples, highest, noise, None, longest_gap, found)
        return replace(motion, samples=motion.samples.of_frame(p_BE, R_BE)) if samples.frame == "B" else motion
    if arm is None:
        raise SalverError(
            f"{samples.source} is a joint motion, but the scenario has no arm; give it one, or a tray motion."
        )
    samples = reordered(samples, arm.joint_names)
    if samples.q.shape[1] != arm.n:
        raise FileFormatError(f"{samples.source} has {samples.q.shape[1]} joints; the arm {arm.name} has {arm.n}.")
    _in_radians(samples, arm)
    if samples.commanded:
        kind = "quintics" if samples.ddq is not None else "cubics"
        note = f"{len(samples.t)} waypoints with velocities, joined by {kind} as ros2_control's controller joins them."
        return TrayMotion(
            forward(arm, *commanded_motion(samples)),
            doubts=tuple(open_questions(samples)),
            notes=(*samples.notes, note),
        )
    found = repaired(channels_of(samples))
    samples = replace(samples, t=found.t, q=found.y)
    poses = [arm.tray_pose(q) for q in samples.q]
    quat = continuous(quat_wxyz_from_matrix(np.array([R for _, R in poses])))
    seen = TraySamples(samples.t, np.array([p for p, _ in poses]), quat, "E", samples.source, samples.notes)
    return _recorded(seen, highest, noise, _of_joints(arm, found, noise), longest_gap, found)


def _in_radians(samples: JointSamples, arm: ArmModel) -> None:
    """Raises FileFormatError for angles that no joint of the arm has, and that all have if they are degrees."""
    low, high = arm.limits.q_min, arm.limits.q_max
    turned = np.deg2rad(samples.q)
    if np.abs(samples.q).max() > LEAST_DEGREES and np.all((turned >= low) & (turned <= high)):
        beyond = np.maximum(samples.q - high, low - samples.q)
        k, j = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
        if beyond[k, j] > 0:
            raise FileFormatError(
                f"{samples.source} has {arm.joint_names[j]} at {samples.q[k, j]:.4g}, which goes from {low[j]:.4g} to "
                f"{high[j]:.4g} rad; these are degrees, and joint positions must be in rad."
            )


def continuous(quat_wxyz: Array) -> Array:
    """The same rotations (N, 4), each with the sign that is nearer to the one before."""
    turned = np.einsum("ij,ij->i", quat_wxyz[1:], quat_wxyz[:-1]) < 0
    return quat_wxyz * np.concatenate([[1.0], np.cumprod(np.where(turned, -1.0, 1.0))])[:, None]


def _of_joints(arm: ArmModel, found: Channels, noise: float | None) -> Sensor:
    """What a joint sensor's resolution, and its stated noise, are at the tray: through the Jacobian, at its largest."""
    step, some = found.step / found.metres[0], found.y[:: max(1, len(found.y) // 50)]
    gains = np.array([np.linalg.norm(arm.body_jacobian(q).reshape(2, -1), axis=1) for q in some]).max(axis=0)
    gains /= np.sqrt(3)  # of one component
    size = 0.0 if noise is None else noise
    return Sensor(
        Level.even(size * gains[0], step * gains[0]), Level.even(0.5 * size * gains[1], 0.5 * step * gains[1])
    )


def _recorded(
    samples: TraySamples,
    highest: float,
    noise: float | None,
    joints: Sensor | None,
    longest_gap: float | None,
    found: Channels,
) -> TrayMotion:
    t, p, quat = samples.t, samples.p, samples.quat_wxyz
    notes, doubts = list(samples.notes), []
    step = float(np.median(np.diff(t)))
    sensor = sensor_of(t, p, quat)
    if joints is not None:
        sensor = Sensor(*(replace(a, step=b.step) for a, b in zip(_levels(sensor), _levels(joints), strict=True)))
        if noise is not None:
            sensor = joints
    elif noise is not None:
        sensor = replace(sensor, position=Level.even(noise, sensor.position.step))
    for defect in found.defects:
        if defect.doubtful:
            doubts.append((defect.code, defect.clause))
        else:
            notes.append(f"{defect.clause[:1].upper()}{defect.clause[1:]}.")
    if found.shown < highest:
        doubts.append(
            (
                "filtered",
                f"the samples were filtered at {found.shown:.2g} Hz before they were saved: nothing faster is shown; "
                "samples before the filter would tell, or the knowledge that nothing is faster (--highest)",
            )
        )
        highest = found.shown
    doubts += _clock(t, step, highest) + _gaps(t, step, longest_gap, notes)
    parts = stretches(t, p, quat, sensor, highest, found.jitter)
    motion = _joined([part.motion for part in parts])
    error = np.concatenate([part.acceleration_error for part in parts])
    for begin, end in _holes(t, step, longest_gap):
        error[(motion.t > begin) & (motion.t < end)] = np.inf  # what happens there is a guess
    missed = np.concatenate([part.missed for part in parts])
    speed = np.linalg.norm(motion.v_S, axis=1) + LEVER * np.linalg.norm(motion.omega_B, axis=1)
    recording = Recording(
        sensor,
        1 / step,
        highest,
        np.concatenate([part.bandwidth for part in parts]),
        (float(speed[0]), float(speed[-1])),
        _slowest(speed),
        tuple(cells for part in parts for cells in part.unseen if len(cells.first)),
        tuple(cells for part in parts for cells in part.mirrored if len(cells.first)),
        np.concatenate([part.louder for part in parts]),
    )
    suspect = [(defect.code, defect.clause) for defect in found.defects if defect.systematic]
    most = int(np.argmax(np.linalg.norm(motion.a_S, axis=1)))
    if (peak := float(np.linalg.norm(motion.a_S[most]))) > FIERCEST:
        clause = (
            f"at {motion.t[most]:.3f} s the samples go as at {peak:.2g} m/s^2, which no arm does: an error of theirs"
        )
        suspect.append(("fierce", clause))
        doubts.append(suspect[-1])
    share = _scattered(motion, recording)
    if share > MOSTLY:
        clause = (
            f"{100 * share:.0f} % of the accelerations are faster than {highest:g} Hz: neither noise nor an arm, "
            "so something is wrong with the samples or their times"
        )
        suspect.append(("scatter", clause))
        doubts.append(suspect[-1])
    return TrayMotion(motion, error, missed, recording, tuple(doubts), tuple(suspect), tuple(notes))


def _scattered(motion: MotionSamples, recording: Recording) -> float:
    """Share of the accelerations' power above the highest frequency; 0 where the curve is not that fast for long."""
    fast = recording.bandwidth > SCATTERED * recording.highest
    if np.where(fast, np.gradient(motion.t), 0.0).sum() < MOSTLY * np.ptp(motion.t):
        return 0.0
    t = np.arange(motion.t[0], motion.t[-1], 1 / recording.rate)
    a = np.column_stack([np.interp(t, motion.t, axis) for axis in motion.a_S.T])
    power = np.sum(np.abs(np.fft.rfft(a * np.hanning(len(t))[:, None], axis=0)) ** 2, axis=1)
    high = np.fft.rfftfreq(len(t), 1 / recording.rate) > 0.5 * SCATTERED * recording.highest
    return float(power[high].sum() / max(power.sum(), 1e-300))


def _levels(sensor: Sensor) -> tuple[Level, Level]:
    return sensor.position, sensor.orientation


def _clock(t: Array, step: float, highest: float) -> list[tuple[str, str]]:
    found = []
    if step >= SUSPECT_STEP:
        found.append(
            (
                "clock",
                f"samples come every {step:g} s, as if the times were in ms: name the column t_ms if they are",
            )
        )
    if len(t) < FEWEST:
        found.append(("short", f"{len(t)} samples are too few to tell noise from motion; {FEWEST} are needed"))
    if 1 / step <= 1.05 * highest:
        found.append(
            (
                "sampling",
                f"{1 / step:.3g} samples a second do not show a shake of up to {highest:g} Hz: {2.5 * highest:.0f} a "
                f"second would, or the knowledge that nothing is faster than {0.4 / step:.2g} Hz (--highest)",
            )
        )
    return found


def _holes(t: Array, step: float, longest_gap: float | None) -> list[tuple[float, float]]:
    """Beginnings and ends of times without samples, longer than is bridged."""
    allowed = longest_gap if longest_gap is not None else max(BRIDGED, BRIDGED_STEPS * step)
    k = np.flatnonzero(np.diff(t) > allowed * (1 + 1e-9))
    return [(float(t[i]), float(t[i + 1])) for i in k]


def _gaps(t: Array, step: float, longest_gap: float | None, notes: list[str]) -> list[tuple[str, str]]:
    holes = _holes(t, step, longest_gap)
    if holes:
        begin, end = max(holes, key=lambda hole: hole[1] - hole[0])
        more = f" ({len(holes)} such gaps)" if len(holes) > 1 else ""
        return [
            (
                "gap",
                f"there are no samples for {end - begin:.3g} s after t = {begin:.3f} s{more}, when they otherwise come "
                f"every {step:.3g} s: bridge it with --gap {1.01 * (end - begin):.2g} if it may be guessed",
            )
        ]
    k = int(np.argmax(np.diff(t)))
    if np.diff(t)[k] > 2.5 * step:
        notes.append(
            f"No samples for {np.diff(t)[k]:.3g} s after t = {t[k]:.3f} s; the motion there is a smooth guess."
        )
    return []


def _slowest(speed: Array) -> tuple[float, float]:
    """The slowest instant before the last as fast as the first one, and after the first as fast as the last one."""
    before = int(np.flatnonzero(speed >= _AS_FAST * speed[0])[-1])
    after = int(np.flatnonzero(speed >= _AS_FAST * speed[-1])[0])
    return float(speed[: before + 1].min()), float(speed[after:].min())


def _joined(parts: list[MotionSamples]) -> MotionSamples:
    names = ("t", "p_SB", "v_S", "a_S", "R_SB", "omega_B", "alpha_B")
    return MotionSamples(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


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
