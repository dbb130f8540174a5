"""How much higher waves may be than a recorded motion says.

What noise hides is a shake a(t) of amplitude A, N cycles and r times a mode's frequency f_n. Its mass, which hardly
fades, moves by -a + 2 pi f_n times the integral of sin(2 pi f_n (t - s)) a(s), where the shake begins from rest: by
A (1 + 4 N / r) at most; by 4 N r A, the integral of what drives it; and by 2 A r^2 / |1 - r|, what a shake that is
there at once moves it by, as it swells and again as it fades. What samples that are too few make the motion fall short
of is as fast as what was read there, or faster. The surface at rest beneath a mass is known as well as the acceleration
is. All of it is added.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from salver.auditing.motion import Recording, TrayMotion
from salver.auditing.recorded import FASTER, LEVER
from salver.auditing.slip import SEEN
from salver.geometry import Array
from salver.models.liquid import GRAVITY
from salver.sensitivity.sloshing import Slosh
from salver.sensitivity.spills import Spill
from salver.sensitivity.waves import Waves, along

FOLLOWED = 2.0  # times the fastest mode: a surface does not follow what shakes it faster, but for what moves a mass
# c of a free wave: 0.07 to 0.3 in cups 0.6 to 1.5 R deep, by nonlinear potential flow (tests/potential_flow.py).
SOFTENING = 0.3
SOFTEST = 0.1  # beyond which no second order says anything
RUNAWAY = 1.25  # times as high as linear waves: more than one passing push makes of it
NARROW = 0.025  # m of radius, or of half a side, below which waves were seen up to `RISE` higher than predicted
RISE = 0.2
_ROUNDS = 4
_FREQUENCIES = 24


def unseen(name: str, parts: Sequence[Slosh], motion: TrayMotion) -> tuple[Spill, float]:
    """What a liquid may come to in a recorded motion, from what it comes to in the motion as it is read, parts; and the
    acceleration, m/s^2, by which its container may be pushed more than is known."""
    found, pushed = [], 0.0
    for part in parts:
        away, inclined = _away(part.waves, motion)
        which = part.waves.cases
        height = (which.gain[:, None] * away).sum(axis=2)
        higher = height + which.rest_rise[:, None] * inclined
        freer = height + np.abs(which.half - which.rest_rise)[:, None] * inclined
        summed = higher[..., 0] if which.round else higher.sum(axis=2)
        more = (which.gain * away[:, -1]).sum(axis=1)
        left = more[:, 0] if which.round else more.sum(axis=1)
        found.append(replace(part, higher=summed, freer=freer, more_left=left))
        load = np.array([case.body.inertial.mass for case in which.each])[:, None, None, None]
        stiff = which.mass[:, None] * which.omega[:, None] ** 2
        pushed = max(pushed, float((stiff * away / load).sum(axis=2).max()))
    return Spill.of(name, found), pushed


def softened(name: str, parts: Sequence[Slosh]) -> Spill:
    """What a liquid comes to whose waves are slower the higher they are: near resonance they run away.

    A wave of amplitude a has the frequency f (1 - c (a / R)^2); each round takes the highest crest so far for a, and
    passes the half of that on its way.
    """
    found = []
    for part in parts:
        highest = part
        for _ in range(_ROUNDS):
            which, waves = highest.waves.cases, part.waves
            softer = SOFTENING * (highest.crest.max(axis=1) / which.half.min(axis=1)) ** 2
            softer = np.minimum(softer, SOFTEST)
            each = [replace(x, softer=float(k * s)) for k in (0.5, 1) for x, s in zip(which.each, softer, strict=True)]
            tried = Slosh.of(along(each, waves.t, waves.w[0])).crest.max(axis=1).reshape(2, -1)
            best = [each[k * len(softer) + i] for i, k in enumerate(np.argmax(tried, axis=0))]
            other = Slosh.of(along(best, waves.t, waves.w[0]))
            if other.crest.max() <= highest.crest.max():
                break
            highest = other
        found.append(highest)
    return Spill.of(name, found)


def _away(waves: Waves, motion: TrayMotion) -> tuple[Array, Array]:
    """(K, T, n_modes, 2) m by which each mass may be elsewhere, and (K, T, 1) slope by which the force may be."""
    which, recording = waves.cases, motion.recording
    assert recording is not None
    up = waves.upward.min(axis=1)[:, None, None]
    omega = which.omega * np.sqrt(up / GRAVITY)
    missed, error = (np.broadcast_to(x, waves.t.shape) for x in (motion.missed, motion.acceleration_error))
    if np.isinf(error).any():  # there are no samples
        return np.full((len(omega), len(error), *omega.shape[1:]), np.inf), np.full((len(omega), len(error), 1), np.inf)
    modes, read = omega / (2 * np.pi), np.broadcast_to(recording.bandwidth / FASTER, waves.t.shape)
    shaken, slope = np.zeros_like(omega), 0.0
    fastest = FOLLOWED * float(modes.max())
    for frequency, amplitude, cycles in _shakes(recording, waves.t, modes):
        shaken = np.maximum(shaken, amplitude * _gain(frequency, modes, cycles))
        if frequency <= fastest:
            slope = max(slope, amplitude * (2 * np.pi * frequency) ** 2)
    for cells in (*recording.unseen, *recording.mirrored):
        cycles = np.maximum(cells.frequency * (cells.last - cells.first), 1.0)
        each = cells.amplitude * _gain(cells.frequency, modes[..., None], cycles)
        shaken = shaken + (cells.share * each).sum(axis=-1)
        slow = cells.frequency <= fastest
        slope += float((cells.amplitude * (2 * np.pi * cells.frequency) ** 2)[slow].max(initial=0.0))
    short = missed / (2 * np.pi * read) ** 2
    shaken = shaken + (short * _gain(read, modes[..., None], read * np.ptp(waves.t))).max(axis=-1)
    lifted = 1 + which.omega**2 / GRAVITY * np.abs(waves.r).max(axis=1)  # what is wrong upwards stiffens it
    away = np.broadcast_to((lifted * shaken)[:, None], waves.r.shape)
    return away, (error + slope + np.where(read <= fastest, missed, 0.0))[:, None] / up


def _shakes(recording: Recording, t: Array, modes: Array) -> list[tuple[float, float, float]]:
    """Frequency (Hz), amplitude (m, tilt of gravity in it) and cycles of what noise hides, modes (...) among them."""
    sensor, duration = recording.sensor, float(t[-1] - t[0])
    louder = float(np.max(recording.louder))
    found = []
    even = np.geomspace(min(1.0, recording.highest), recording.highest, _FREQUENCIES)
    for frequency in np.unique(np.concatenate([even, modes[modes < recording.highest]])):
        metres = 2 * (LEVER + GRAVITY / (2 * np.pi * frequency) ** 2)
        noise = louder * np.hypot(sensor.position.whole, metres * sensor.orientation.whole)
        blur = np.hypot(sensor.position.blur, metres * sensor.orientation.blur)
        cycles = 1.0
        while True:
            amplitude = max(SEEN * noise * np.sqrt(2 * frequency / (recording.rate * cycles)), blur)
            found.append((float(frequency), float(amplitude), cycles))
            if cycles / frequency > duration:
                break
            cycles *= 2
    return found


def _gain(frequency: Array | float, mode: Array, cycles: Array | float) -> Array:
    """By how much more than its container a mass may move, after so many cycles of a shake."""
    ratio = frequency / mode
    with np.errstate(divide="ignore"):
        off = 2 * ratio**2 / np.abs(1 - ratio)
    return np.asarray(np.minimum(np.minimum(4 * cycles * ratio, 1 + 4 * cycles / ratio), off))
