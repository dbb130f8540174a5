"""The motion of the tray from samples, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from salver.auditing.commanded import commanded_motion, open_questions
from salver.auditing.defects import Channels, Defect, channels_of, repaired
from salver.auditing.noise import NoiseLevel, Oscillations, filtered_at
from salver.auditing.options import DEFAULT, AuditOptions
from salver.auditing.recorded import LEVER, Sensor, read_motion, sensor_of
from salver.display import Outlined
from salver.errors import FileFormatError, SalverError
from salver.geometry import Array, continuous, quat_wxyz_from_matrix
from salver.motion_files.samples import Samples, TraySamples, reordered
from salver.planning.follow import forward
from salver.trajectory import JointMotion, MotionSamples

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel

Doubt = tuple[str, str]  # a code, and a clause with the remedy


@dataclass(frozen=True)
class RecordingQuality:
    """Noise and resolution of a recorded motion.

    sensor: its noise. rate: Hz. bandwidth: (T,) of the fitted curve, Hz. ends: speeds at the beginning and the end,
    m/s. slowest: m/s, least speed before the recording is last as fast as at its beginning, and least speed after it is
    first as fast as at its end. unseen: see `salver.auditing.recorded.Reading`; in s.
    """

    sensor: Sensor
    rate: float
    bandwidth: Array
    ends: tuple[float, float]
    slowest: tuple[float, float]
    unseen: tuple[Oscillations, ...] = ()


@dataclass(frozen=True, repr=False)
class AuditedMotion(Outlined):
    """The motion of the tray frame E in S that is audited.

    acceleration_error: (T,) or one number, m/s^2, bound of the error by noise. missed: likewise, acceleration that the
    sampling cannot resolve. recording: None for a motion that is known exactly. doubts: (code, clause) that exclude the
    verdict "holds"; suspect: (code, clause) that could explain a violation. notes: sentences on repairs, assumptions
    and omissions.
    """

    samples: MotionSamples
    acceleration_error: Array | float = 0.0
    missed: Array | float = 0.0
    recording: RecordingQuality | None = None
    doubts: tuple[Doubt, ...] = ()
    suspect: tuple[Doubt, ...] = ()
    notes: tuple[str, ...] = ()
    options: AuditOptions = DEFAULT


def tray_motion(samples: Samples, arm: ArmModel | None, options: AuditOptions = DEFAULT) -> AuditedMotion:
    """The motion of the tray frame E. Raises FileFormatError or SalverError."""
    if isinstance(samples, TraySamples):
        found = repaired(channels_of(samples), options)
        samples = replace(samples, t=found.t, p=found.y[:, :3], quat_wxyz=found.y[:, 3:])
        return _recorded(samples, None, found, options)
    if arm is None:
        raise SalverError(
            f"{samples.source} is a joint motion, but the scenario has no arm; give it one, or a tray motion."
        )
    samples = reordered(samples, arm.joint_names)
    if samples.q.shape[1] != arm.n:
        raise FileFormatError(f"{samples.source} has {samples.q.shape[1]} joints; the arm {arm.name} has {arm.n}.")
    check_radians(samples.q, arm, samples.source, samples.form)
    if samples.commanded:
        kind = "quintics" if samples.ddq is not None else "cubics"
        note = f"{len(samples.t)} waypoints with velocities, joined by {kind} as ros2_control's controller joins them."
        return AuditedMotion(
            forward.tray_motion(arm, JointMotion(*commanded_motion(samples))),
            doubts=tuple(open_questions(samples)),
            notes=(*samples.notes, note),
            options=options,
        )
    found = _in_ranges(repaired(channels_of(samples), options), samples.q, arm, options)
    poses = [arm.tray_pose(q) for q in found.y]
    quat = continuous(quat_wxyz_from_matrix(np.array([R for _, R in poses])))
    seen = TraySamples(found.t, np.array([p for p, _ in poses]), quat, samples.source, samples.notes)
    return _recorded(seen, _gains(arm, found), found, options)


def _in_ranges(found: Channels, q: Array, arm: ArmModel, options: AuditOptions) -> Channels:
    """Add a defect if recorded positions q (N, n) are further out of the joints' ranges than another zero explains."""
    beyond = np.maximum(arm.limits.q_min - q, q - arm.limits.q_max).max(axis=0)
    j = int(np.argmax(beyond))
    if beyond[j] <= options.beyond:
        return found
    clause = (
        f"{arm.joint_names[j]} is up to {beyond[j]:.3g} {arm.unit(j)} out of its range: its unit, the order of the "
        "columns or the arm is another"
    )
    return found.having(Defect("range", clause, systematic=True))


def check_radians(q: Array, arm: ArmModel, source: str, form: str = "csv", least: float = 12.0) -> None:
    """Raise FileFormatError for positions q (N, n) outside the joints' ranges that would be inside as degrees.

    form: format of the file. least: larger angles that fit as degrees count as such.
    """
    low, high = arm.limits.q_min, arm.limits.q_max
    turned = np.deg2rad(q)
    if np.abs(q).max() > least and np.all((turned >= low) & (turned <= high)):
        beyond = np.maximum(q - high, low - q)
        k, j = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
        if beyond[k, j] > 0:
            advice = "give --units deg" if form == "csv" else "joint positions must be in rad"
            raise FileFormatError(
                f"{source} has {arm.joint_names[j]} at {q[k, j]:.4g}, which goes from {low[j]:.4g} to {high[j]:.4g} "
                f"rad; these are degrees: {advice}."
            )


def _gains(arm: ArmModel, found: Channels) -> tuple[float, float]:
    """Largest displacement, m, and rotation, rad (half the angle), of the tray per unit of noise of all joints, by the
    Jacobian."""
    some = found.y[:: max(1, len(found.y) // 50)]
    place, turn = np.array([np.linalg.norm(arm.body_jacobian(q).reshape(2, -1), axis=1) for q in some]).max(axis=0)
    return float(place / 3**0.5), float(0.5 * turn / 3**0.5)


def _recorded(
    samples: TraySamples, gains: tuple[float, float] | None, found: Channels, options: AuditOptions
) -> AuditedMotion:
    """The motion of recorded poses. gains: from joint noise to pose noise, for joint recordings."""
    t, p, quat, notes, noise = samples.t, samples.p, samples.quat_wxyz, list(samples.notes), options.noise
    doubts = [(defect.code, defect.clause) for defect in found.defects if defect.doubtful]
    suspect = [(defect.code, defect.clause) for defect in found.defects if defect.systematic]
    notes += [f"{each.clause[:1].upper()}{each.clause[1:]}." for each in found.defects if not each.doubtful]
    # The orientation often shows a filter better: a level tray moves in its position only.
    parts = (found.y[:, :3], found.y[:, 4:]) if found.pose else (found.y,)
    shown = min(filtered_at(found.t, y, options.drop, options.fewest) for y in parts)
    if shown < options.highest:
        clause = (
            f"the samples were filtered at {shown:.2g} Hz before they were saved: nothing faster is shown; samples "
            "before the filter would tell, or the knowledge that nothing is faster (--highest)"
        )
        doubts.append(("filtered", clause))
        options = replace(options, highest=shown)
        # Keep as many samples as the filtered signal has degrees of freedom, so that its noise is white again.
        every = max(1, min(int((len(t) - 1) / (t[-1] - t[0]) / (2 * shown)), len(t) // options.fewest))
        keep = np.unique(np.append(np.arange(0, len(t), every), len(t) - 1))
        t, p, quat = t[keep], p[keep], quat[keep]
    step, sensor = float(np.median(np.diff(t))), sensor_of(t, p, quat)
    if gains is not None:
        steps = [found.step / found.metres[0] * gain for gain in gains]
        sizes = [sensor.position.size, sensor.orientation.size] if noise is None else [noise * gain for gain in gains]
        sensor = Sensor(*(NoiseLevel(size, each) for size, each in zip(sizes, steps, strict=True)))
    elif noise is not None:
        sensor = replace(sensor, position=NoiseLevel(noise, sensor.position.step))
    gaps = _gaps(t, step, options.longest_gap)
    doubts += _sampling(t, step, options) + _unbridged(gaps, step)
    k = int(np.argmax(np.diff(t)))
    if not gaps and np.diff(t)[k] > 2.5 * step:
        notes.append(
            f"No samples for {np.diff(t)[k]:.3g} s after t = {t[k]:.3f} s; the motion there is a smooth guess."
        )
    reading = read_motion(t, p, quat, sensor, options)
    motion, error = reading.motion, reading.acceleration_error
    for begin, end in gaps:
        error[(motion.t > begin) & (motion.t < end)] = np.inf  # the motion in a gap is a guess
    speed = np.linalg.norm(motion.v_S, axis=1) + LEVER * np.linalg.norm(motion.omega_B, axis=1)
    ends = float(speed[0]), float(speed[-1])
    quality = RecordingQuality(sensor, 1 / step, reading.bandwidth, ends, _slowest(speed), reading.unseen)
    most = int(np.argmax(np.linalg.norm(motion.a_S, axis=1)))
    if (peak := float(np.linalg.norm(motion.a_S[most]))) > options.fiercest:
        fierce = "fierce", f"at {motion.t[most]:.3f} s the samples go as at {peak:.2g} m/s^2, which no arm does"
        doubts.append(fierce)
        suspect.append(fierce)
    return AuditedMotion(motion, error, reading.missed, quality, tuple(doubts), tuple(suspect), tuple(notes), options)


def _sampling(t: Array, step: float, options: AuditOptions) -> list[Doubt]:
    found = []
    if step >= options.slowest:
        clause = f"samples come every {step:g} s, as if the times were in ms: if they are, give --units ms"
        found.append(("clock", clause))
    if len(t) < options.fewest:
        found.append(("short", f"{len(t)} samples are too few to tell noise from motion; {options.fewest} are needed"))
    if 1 / step < 1.98 * options.highest:  # Nyquist, and clocks that are a little slow
        clause = (
            f"{1 / step:.3g} samples a second do not show a shake of up to {options.highest:g} Hz: "
            f"{2.5 * options.highest:.0f} a second would, or the knowledge that nothing is faster than "
            f"{0.4 / step:.2g} Hz (--highest)"
        )
        found.append(("sampling", clause))
    return found


def _gaps(t: Array, step: float, longest: float | None) -> list[tuple[float, float]]:
    """Beginnings and ends of gaps between samples that are longer than `longest`, s."""
    allowed = longest if longest is not None else max(0.02, 3.5 * step)
    k = np.flatnonzero(np.diff(t) > allowed * (1 + 1e-9))
    return [(float(t[i]), float(t[i + 1])) for i in k]


def _unbridged(gaps: list[tuple[float, float]], step: float) -> list[Doubt]:
    if not gaps:
        return []
    begin, end = max(gaps, key=lambda gap: gap[1] - gap[0])
    more = f" ({len(gaps)} such gaps)" if len(gaps) > 1 else ""
    clause = (
        f"there are no samples for {end - begin:.3g} s after t = {begin:.3f} s{more}, when they otherwise come every "
        f"{step:.3g} s: bridge it with --gap {1.01 * (end - begin):.2g} if it may be guessed"
    )
    return [("gap", clause)]


def _slowest(speed: Array) -> tuple[float, float]:
    """Least speed before the last sample as fast as the first one, and after the first sample as fast as the last."""
    before = int(np.flatnonzero(speed >= 0.95 * speed[0])[-1])
    after = int(np.flatnonzero(speed >= 0.95 * speed[-1])[0])
    return float(speed[: before + 1].min()), float(speed[after:].min())
