"""Bounds of sloshing and swinging that a recording does not show.

Noise can hide a vibration a(t) of amplitude A, with N cycles and r times a mode's frequency f_n. The mass of the mode,
with negligible damping, moves by -a + 2 pi f_n times the integral of sin(2 pi f_n (t - s)) a(s) if the vibration starts
from rest. That is at most A (1 + 4 N / r); at most 4 N r A, by the integral of the excitation; and at most
2 A r^2 / |1 - r|, by a vibration that starts and ends abruptly. Motion that the sampling does not resolve is assumed to
be as fast as the recorded motion, or faster. The equilibrium of the mass is as uncertain as the acceleration. The
bounds are added.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from salver.auditing.motion import AuditedMotion, Doubt
from salver.auditing.options import AuditOptions
from salver.auditing.recorded import FASTER, LEVER, OUTER
from salver.auditing.slip import hidden_shakes, up_to
from salver.dynamics.liquid.sloshing import SloshingResponse
from salver.dynamics.liquid.spills import Spill
from salver.dynamics.liquid.surface import SurfaceMotion
from salver.dynamics.load_limits import LoadVerdict
from salver.dynamics.load_response import LoadResponse
from salver.dynamics.modal_motion import ModalMotion
from salver.geometry import GRAVITY, Array, interpolated

FOLLOWED = 2.0  # ratio to the fastest mode above which the surface does not follow vibration quasi-statically
STEPS = 16  # integration steps per radian of the fastest mode, for crests to 0.2 %


def unseen(name: str, parts: Sequence[LoadResponse], motion: AuditedMotion) -> tuple[LoadVerdict, float]:
    """The verdict on a body's liquid or pendulum in a recorded motion, with bounds of what the recording does not show,
    and the unknown acceleration of the body, m/s^2.

    parts: responses along the motion as estimated.
    """
    found, pushed = list[LoadResponse](), 0.0
    for part in parts:
        away, inclined = _away(part.modes, motion)
        which = part.modes.cases
        found.append(part.unsure(away, inclined))
        load = np.array([case.body.inertial.mass for case in which.each])[:, None, None, None]
        stiff = which.mass[:, None] * which.omega[:, None] ** 2
        pushed = max(pushed, float((stiff * away / load).sum(axis=2).max()))
    return type(found[0]).verdict(name, found), pushed


def unmodelled(name: str, parts: Sequence[LoadResponse], known: LoadVerdict, options: AuditOptions) -> list[Doubt]:
    """Doubts because sloshing may be higher than linear: near resonance, and in narrow glasses."""
    liquids = [part for part in parts if isinstance(part, SloshingResponse)]
    return _of_liquid(name, liquids, known, options) if isinstance(known, Spill) else []


def _of_liquid(name: str, parts: Sequence[SloshingResponse], known: Spill, options: AuditOptions) -> list[Doubt]:
    highest, slower = float(known.size.max()), 0.0
    for part in parts:
        most, crest = part.modes.cases.room, part.crest.max(axis=1) * softened(part.modes, options.softening)
        limit = np.where(np.isfinite(most), most, part.modes.cases.steepest)
        slower = max(slower, float(crest[crest > limit].max(initial=0.0)))
    if slower > options.runaway * highest:
        clause = (
            f"the motion is near the sloshing frequency of {name}: high waves are slower, and may reach "
            f"{1e3 * slower:.2g} mm where linear ones reach {1e3 * highest:.2g}; how they swirl is not known either"
        )
        return [("resonance", clause)]
    half = min(float(part.modes.cases.half.min()) for part in parts)
    if half < options.narrow and known.left.min() < options.rise * highest:
        clause = (
            f"waves in {name}, {2e3 * half:.2g} mm wide, may be {100 * options.rise:.0f} % higher than predicted: "
            f"glasses below {2e3 * options.narrow:.0f} mm are not known better, and {1e3 * known.left.min():.2g} mm "
            "are left"
        )
        return [("narrow", clause)]
    return []


def softened(modes: SurfaceMotion, softening: float) -> Array:
    """Amplification (K,) of the first mode because its frequency f falls with its amplitude a, as f (1 - c (a / R)^2)
    with c = softening.

    a is the amplitude at each instant, so that a short motion ends before the frequency matters, and a long excitation
    below resonance grows, as in nonlinear potential flow (test_audit_sloshing.py). Semi-implicit Euler, with r
    along non-rotating axes: r'' = -f - kd r' - (omega (1 - c (a / R)^2))^2 (f_z / g) r.
    """
    which = modes.cases
    omega, kd, gain = (x[:, 0] for x in (which.omega, which.kd, which.gain))
    half, last = which.half.min(axis=1), modes.t[-1] - modes.t[0]
    t = modes.t[0] + np.linspace(0.0, last, int(np.ceil(STEPS * omega.max() * last)) + 2)
    force, up = (interpolated(modes.t, x.swapaxes(0, 1), t) for x in (modes.at_modes[:, :, 0], modes.upward / GRAVITY))
    dt = t[1] - t[0]

    def highest(c: float) -> Array:
        r, rate = modes.r[:, 0, 0], modes.rate[:, 0, 0]
        top = np.zeros(len(r))
        for pushed, stiffer in zip(force, up, strict=True):
            swing = np.square(gain * r) + np.square(gain * rate / omega)
            softer = np.minimum(c * swing.sum(axis=1) / half**2, 1.0)
            pull = -pushed - kd * rate - (omega * (1 - softer)[:, None]) ** 2 * stiffer[:, None] * r
            top = np.maximum(top, np.linalg.norm(gain * r, axis=1))
            rate = rate + dt * pull
            r = r + dt * rate
        return top

    return np.asarray(highest(softening) / np.maximum(highest(0.0), np.finfo(float).tiny))


def _away(modal: ModalMotion, motion: AuditedMotion) -> tuple[Array, Array]:
    """Bounds of the unknown displacement of each mass (K, T, n_modes, 2), m, and of the slope of the force (K, T,
    1)."""
    which, recording, highest = modal.cases, motion.recording, motion.options.highest
    assert recording is not None
    up = modal.upward.min(axis=1)[:, None, None]
    omega = which.omega * np.sqrt(up / GRAVITY)
    missed, error = (np.broadcast_to(x, modal.t.shape) for x in (motion.missed, motion.acceleration_error))
    if np.isinf(error).any():  # there are no samples
        return np.full((len(omega), len(error), *omega.shape[1:]), np.inf), np.full((len(omega), len(error), 1), np.inf)
    modes, read = omega / (2 * np.pi), np.broadcast_to(recording.bandwidth / FASTER, modal.t.shape)
    shaken, slope = np.zeros_like(omega), 0.0
    fastest = FOLLOWED * float(modes.max())
    sensor = recording.sensor
    for frequency, cycles, share in hidden_shakes(motion, np.union1d(up_to(highest, 24), modes[modes < highest])):
        metres = 2 * (LEVER + GRAVITY / (2 * np.pi * frequency) ** 2)  # and the tilt of gravity
        blur = float(np.hypot(sensor.position.blur, metres * sensor.orientation.blur))
        amplitude = max(share * float(np.hypot(sensor.position.whole, metres * sensor.orientation.whole)), blur)
        shaken = np.maximum(shaken, amplitude * _gain(frequency, modes, cycles))
        if frequency <= fastest:
            slope = max(slope, amplitude * (2 * np.pi * frequency) ** 2)
    for found in recording.unseen:
        several = np.maximum(found.frequency * (found.last - found.first), 1.0)
        each = found.amplitude * _gain(found.frequency, modes[..., None], several)
        shaken = shaken + (found.share * each).sum(axis=-1)
        slow = found.frequency <= fastest
        slope += float((found.amplitude * (2 * np.pi * found.frequency) ** 2)[slow].max(initial=0.0))
    # Within the outermost samples the tray may reach its acceleration at the first or the last instant: an impulse.
    outer = np.linalg.norm(motion.samples.a_S[[0, -1]], axis=1).sum() * OUTER / recording.rate
    shaken = shaken + 0.5 * outer / omega
    short = missed / (2 * np.pi * read) ** 2
    shaken = shaken + (short * _gain(read, modes[..., None], read * np.ptp(modal.t))).max(axis=-1)
    lifted = 1 + which.omega**2 / GRAVITY * np.abs(modal.r).max(axis=1)  # vertical acceleration errors
    away = np.broadcast_to((lifted * shaken)[:, None], modal.r.shape)
    return away, (error + slope + np.where(read <= fastest, missed, 0.0))[:, None] / up


def _gain(frequency: Array | float, mode: Array, cycles: Array | float) -> Array:
    """Bound of the displacement of a mass over that of its container, after some cycles of a vibration."""
    ratio = frequency / mode
    with np.errstate(divide="ignore"):
        off = 2 * ratio**2 / np.abs(1 - ratio)
    return np.asarray(np.minimum(np.minimum(4 * cycles * ratio, 1 + 4 * cycles / ratio), off))
