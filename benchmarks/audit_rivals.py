"""Is "cannot tell" right? Another motion that the samples allow as well, and that loses the load: a rival.

Two kinds are tried. A *shake* of 14 to 50 Hz in a window that it fills, where the load is borne least, in the direction
in which noise hides most, inclined by the friction angle, up while it pushes (so it drifts even on a level tray). Its
energy over all samples is `SNR`^2 variances of the noise: a filter that knew it would see it at so many standard
deviations. Somewhere in a search over M frequencies, times and directions noise alone reaches sqrt(2 ln M) of them, 4
for M = 3000; no search tells such a shake from none (Ingster and Suslina, Nonparametric goodness-of-fit testing under
Gaussian models, Springer 2003). And a *mirror*: the samples' content above rate - 50 Hz taken for what mirrors it at
the rate. It differs from the motion nowhere that it was sampled.

A block that only slides finds the worst of them; what is said is what the physics engine says of that one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import make_interp_spline

from salver.errors import SalverError
from salver.scenario import Scenario
from salver.simulation.physics import simulate_tray

SNR = 4.0
HIGHEST = 50.0  # Hz
_STEP = 5e-4  # s, of the block: 40 in a period
_FINE = 1 / 4000  # s, between which what is hidden is a spline
_FREQUENCIES, _CYCLES = (50.0, 35.0, 24.0, 14.0), (1.5, 3, 6, 12, 24, 48, 96)
_LINES = 64  # of a spectrum that are mirrored
_GRAVITY = np.array([0.0, 0.0, -9.81])


@dataclass(frozen=True)
class Hidden:
    """A wave of a motion, as `audit_recordings.Wave` is one: value, first and second derivative of a spline."""

    spline: Any

    @classmethod
    def of(cls, t: np.ndarray, value: np.ndarray) -> Hidden:
        return cls(make_interp_spline(t, value, k=5))

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.spline(t), self.spline.derivative(1)(t), self.spline.derivative(2)(t)


def rivals(scenario: Scenario, motion: Any, rate: float, noise: float) -> list[Any]:
    """Motions (`audit_recordings.Motion`) of which the samples at this rate, with this noise, could be as well."""
    found = [_shake(scenario, motion, rate, noise)] if noise > 0 else []
    return found + ([_mirror(motion, rate)] if rate < 2 * HIGHEST else [])


def loses(scenario: Scenario, motion: Any, rate: float, noise: float) -> bool:
    """Whether the engine loses the load of one of them."""
    return any(outcome_of(other, scenario) != "holds" for other in rivals(scenario, motion, rate, noise))


def outcome_of(motion: Any, scenario: Scenario) -> str:
    """What the physics engine says of it; a load that is thrown so hard that the engine diverges is lost."""
    try:
        return simulate_tray(motion, scenario).outcome
    except SalverError:
        return "diverges"


def _with(motion: Any, waves: list[Hidden], lines: np.ndarray) -> Any:
    return replace(motion, waves=(*waves, *motion.waves), lines=np.concatenate([lines, motion.lines]))


def _shake(scenario: Scenario, motion: Any, rate: float, noise: float) -> Any:
    mu = float(scenario.objects[0].friction)
    fine = np.arange(0, motion.duration + _FINE, _FINE)
    t = np.arange(0, motion.duration, _STEP)
    s = motion.sample(t)
    felt = np.einsum("tji,tj->ti", s.R_SB, _GRAVITY - s.a_S)
    used = np.linalg.norm(felt[:, :2], axis=1) / np.maximum(-felt[:, 2], 1e-9)
    tries, bends = [], []
    for frequency in _FREQUENCIES:
        for cycles in _CYCLES:
            length = cycles / frequency
            window = int(length / _STEP)
            if window >= len(t) - 2:
                continue
            mean = np.convolve(used, np.ones(window) / window, "valid")
            first = int(np.argmax(mean))
            middle, R = t[first] + 0.5 * length, s.R_SB[first + window // 2]
            wave = _burst(fine, frequency, length, middle)
            energy = rate * _FINE * np.sum(wave**2)  # whatever its phase: not seen at its zeros only
            push = felt[first : first + window, :2].mean(axis=0)
            along = np.arctan2(push[1], push[0])
            bend = np.gradient(np.gradient(wave, _FINE), _FINE)
            for turn in (0.0, np.pi / 2):
                for slope in (mu, -mu):
                    to = R @ [np.cos(along + turn), np.sin(along + turn), slope]
                    line, moves = motion.cheapest(to / np.linalg.norm(to), middle)
                    size = SNR * motion.deviation(noise) / np.sqrt(max(energy, 1.0))
                    tries.append((wave, size * line))
                    bends.append(np.outer(np.interp(t, fine, bend), size * moves))
    worst = int(np.argmax(_block(t, s.R_SB, s.a_S + np.array(bends), mu)))
    wave, line = tries[worst]
    return _with(motion, [Hidden.of(fine, wave)], line[None])


def _burst(t: np.ndarray, frequency: float, length: float, middle: float) -> np.ndarray:
    """A sine in a window that comes and goes smoothly, over a period or a third of it."""
    ramp = min(1 / frequency, length / 3)
    x = t - middle
    return np.asarray(_smooth((0.5 * length - np.abs(x)) / ramp) * np.sin(2 * np.pi * frequency * x))


def _smooth(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0, 1)
    return np.asarray(x**3 * (10 - 15 * x + 6 * x**2))


def _mirror(motion: Any, rate: float) -> Any:
    """The strongest lines of the samples' spectrum, by the acceleration of their mirrors."""
    sampled = np.arange(int(motion.duration * rate) + 1) / rate
    fine = np.arange(0, motion.duration + _FINE, _FINE)
    y = motion.coordinates(sampled)
    # In a window that comes and goes: the ends of what is slow have lines everywhere.
    y = (y - y.mean(axis=0)) * np.hanning(len(y))[:, None]
    spectrum, f = np.fft.rfft(y, axis=0) / len(y), np.fft.rfftfreq(len(y), 1 / rate)
    seen = np.flatnonzero((f > max(rate - HIGHEST, 3 / motion.duration)) & (f < 0.49 * rate))
    strongest = seen[np.argsort(-np.linalg.norm(spectrum[seen], axis=1) * (rate - f[seen]) ** 2)[:_LINES]]
    turning, other = (np.exp(2j * np.pi * np.outer(fine, g)) for g in (f[strongest], f[strongest] - rate))
    added = 2 * ((other - turning) @ spectrum[strongest]).real
    added *= _smooth(np.minimum(fine, motion.duration - fine) * HIGHEST)[:, None]
    return _with(motion, [Hidden.of(fine, column) for column in added.T], np.eye(added.shape[1]))


def _block(t: np.ndarray, R: np.ndarray, a: np.ndarray, mu: float) -> np.ndarray:
    """(K,) m: how far a block slides on trays that turn as R (T, 3, 3) and accelerate by a (K, T, 3)."""
    felt = np.einsum("tji,ktj->tki", R, _GRAVITY - a)
    v, x, most = np.zeros((len(a), 2)), np.zeros((len(a), 2)), np.zeros(len(a))
    step = t[1] - t[0]
    for force in felt:
        v = v + step * force[:, :2]
        speed = np.linalg.norm(v, axis=1)
        v *= np.maximum(0, 1 - step * mu * np.maximum(-force[:, 2], 0) / np.maximum(speed, 1e-12))[:, None]
        x += step * v
        most = np.maximum(most, np.linalg.norm(x, axis=1))
    return most
