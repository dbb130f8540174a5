"""What other laboratories measured (docs/data/real), and what salver predicts of the same motions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from salver.auditing import Audit, audit_samples
from salver.geometry import Array
from salver.models.liquid import FLUIDS, damping_of
from salver.models.tray_motion import motion_vector
from salver.motion_files import JointSamples, TraySamples
from salver.scenario import Scenario, load
from salver.sensitivity.wave_cases import Case
from salver.sensitivity.waves import Waves, along

FOLDER = Path(__file__).parents[1] / "docs" / "data" / "real"
FINE, RATE, FRAMES = 1e8, 100.0, 60.0  # integers for each rad or m; commanded samples and video frames a second
RADIUS, FILL = 0.049, 0.08
FORMULA = damping_of((RADIUS,), FILL, FLUIDS["water"].viscosity)
AFTER = 8.0  # s of rest that are added to each commanded motion, for the waves that are left
BENT = np.pi / 2  # rad: where the commanded third joint stands when that of the URDF stands at zero


@lru_cache(maxsize=1)
def vessel() -> Scenario:
    """The vessel on the flange of the arm."""
    return load(FOLDER / "vessel.toml")


@lru_cache(maxsize=1)
def _sloshing() -> dict[str, Array]:
    with np.load(FOLDER / "sloshing.npz") as kept:
        return dict(kept)


def names() -> list[str]:
    """All 48 motions."""
    return sorted({key.split("/")[0] for key in _sloshing()})


@dataclass(frozen=True)
class Predicted:
    """The waves of a commanded motion, and how the surface was seen to stand.

    audit: of the motion with `AFTER` s of rest. t (T,), s, of `waves`. end: s, of the motion. seen_t (M,), seen (M,):
    s on the same clock, and m over rest. lag: s by which the video began before the log.
    """

    name: str
    audit: Audit
    t: Array
    waves: Waves
    end: float
    seen_t: Array
    seen: Array
    lag: float

    @property
    def during(self) -> Array:
        """(M,) which frames were taken during the motion and the second after it."""
        return np.asarray((self.seen_t > 0) & (self.seen_t < self.end + 1))

    @property
    def peaks(self) -> tuple[float, float]:
        """m: the highest crest predicted, and the highest surface seen."""
        return float(self.waves.crest[0].max()), float(self.seen[self.during].max())

    @property
    def at_frames(self) -> Array:
        """(M,) m of the crest predicted at each frame."""
        return np.interp(self.seen_t, self.t, self.waves.crest[0])


def samples(name: str, way: str) -> JointSamples | TraySamples:
    """The commanded motion, with rest after it: of the joints, of the tray, or of a tray tilted to the other side
    ("mirrored")."""
    rest = int(AFTER * RATE)
    if way == "joints":
        q = np.unwrap(_sloshing()[f"{name}/joints"] / FINE, axis=0)  # the sixth joint goes on past half a turn
        q[:, 2] -= BENT
        q = np.concatenate([q, np.repeat(q[-1:], rest, axis=0)])
        return JointSamples(np.arange(len(q)) / RATE, tuple(f"q{k}_joint" for k in range(1, 7)), q, None, None, name)
    tray = _sloshing()[f"{name}/tray"] / FINE
    tray = np.concatenate([tray, np.repeat(tray[-1:], rest, axis=0)])
    quat_wxyz = tray[:, [6, 3, 4, 5]] * np.array([1.0, *(3 * [-1.0 if way == "mirrored" else 1.0])])
    return TraySamples(np.arange(len(tray)) / RATE, tray[:, :3], quat_wxyz, "E", name)


def executed(name: str) -> str:
    """The way in which the arm moved: `Tilt_TRD` tilted to the other side than its files say (docs/reality.md)."""
    return "mirrored" if name.startswith("Tilt_TRD") else "joints"


def waves_of(audit: Audit, fill: float = FILL, damping: float = FORMULA) -> Waves:
    """Those of the vessel along an audited motion."""
    s = audit.motion.samples
    w = motion_vector(s.R_SB, s.a_S, s.omega_B, s.alpha_B)
    return along((Case(audit.scenario.payload.first, fill, damping),), s.t, w)


def predicted(name: str, way: str | None = None, damping: float = FORMULA) -> Predicted:
    """One of the 48 motions; way: as of `samples`, as it was executed unless given."""
    audit = audit_samples(samples(name, way or executed(name)), vessel())
    waves, t = waves_of(audit, damping=damping), audit.motion.samples.t
    seen = _sloshing()[f"{name}/seen"] * 1e-5
    seen_t = np.arange(len(seen)) / FRAMES
    late = lag(seen_t, seen, t, waves.crest[0])
    return Predicted(name, audit, t, waves, float(t[-1] - AFTER), seen_t - late, seen, late)


def lag(seen_t: Array, seen: Array, t: Array, crest: Array) -> float:
    """s by which what was seen comes later than what is predicted, where both correlate best."""
    step = 0.25 / FRAMES
    here = np.interp(np.arange(seen_t[0], seen_t[-1], step), seen_t, np.maximum(seen, 0.0))
    there = np.interp(np.arange(t[0], t[-1], step), t, crest)
    shift = int(np.argmax(np.correlate(here, there, "full"))) - (len(there) - 1)
    return shift * step + float(seen_t[0] - t[0])
