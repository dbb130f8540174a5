"""What other laboratories measured (docs/data/real), and what salver predicts of the same motions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.optimize import curve_fit, least_squares
from scipy.spatial.transform import Rotation

from salver.auditing import Audit, audit_samples
from salver.dynamics.liquid.liquid import FLUIDS, damping_of
from salver.dynamics.liquid.surface import SurfaceMotion
from salver.dynamics.load_cases import LoadCase
from salver.geometry import Array, continuous
from salver.models.tray_motion import motion_vector
from salver.motion_files import JointSamples, TraySamples
from salver.scenario import Scenario, load, parse

FOLDER = Path(__file__).parents[2] / "docs" / "data" / "real"
FINE, RATE, FRAMES = 1e8, 100.0, 60.0  # integers for each rad or m; commanded samples and video frames a second
RADIUS, FILL = 0.049, 0.08
FORMULA = damping_of(RADIUS, FILL, FLUIDS["water"].viscosity)
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
    waves: SurfaceMotion
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
    if way == "joints":
        q = np.unwrap(_sloshing()[f"{name}/joints"] / FINE, axis=0)  # the sixth joint goes on past half a turn
        q[:, 2] -= BENT
        return joint_samples(_rested(q), RATE, name)
    tray = _rested(_sloshing()[f"{name}/tray"] / FINE)
    quat_wxyz = tray[:, [6, 3, 4, 5]] * np.array([1.0, *(3 * [-1.0 if way == "mirrored" else 1.0])])
    return TraySamples(np.arange(len(tray)) / RATE, tray[:, :3], quat_wxyz, name)


def _rested(samples: Array) -> Array:
    """Samples of a motion, with `AFTER` s of rest after them."""
    return np.concatenate([samples, np.repeat(samples[-1:], int(AFTER * RATE), axis=0)])


def joint_samples(q: Array, rate: float, name: str) -> JointSamples:
    """Joints of the Comau SmartSix, (N, 6) rad, `rate` times a second."""
    return JointSamples(np.arange(len(q)) / rate, tuple(f"q{k}_joint" for k in range(1, 7)), q, None, None, name)


def executed(name: str) -> str:
    """The way in which the arm moved: `Tilt_TRD` tilted to the other side than its files say (docs/reality.md)."""
    return "mirrored" if name.startswith("Tilt_TRD") else "joints"


def waves_of(audit: Audit, fill: float = FILL, damping: float = FORMULA) -> SurfaceMotion:
    """Those of each vessel along an audited motion."""
    s = audit.motion.samples
    w = motion_vector(s.R_SB, s.a_S, s.omega_B, s.alpha_B)
    return SurfaceMotion.along(tuple(LoadCase(body, fill, damping) for body in audit.scenario.payload.bodies), s.t, w)


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


# Four loose cups ------------------------------------------------------------------------------------------------------

CUP_RADIUS, CUP_FILL = 0.035, 0.049
ASIDE = 0.6  # rad by which the published first joint stands beside that of their planner
IN_VIDEO = (0, 2, 1, 3)  # the cup that each video shows, as its waves tell: the second and third are mistaken


@dataclass(frozen=True)
class Cup:
    """One of the four cups: t (T,) s, and the crest predicted (T,) m; seen_t (M,) s on the same clock, and the surface
    as seen (M,) m; the highest that its planner predicted, m."""

    t: Array
    crest: Array
    seen_t: Array
    seen: Array
    simulated: float

    @property
    def during(self) -> Array:
        """(M,) which frames were taken within the motion."""
        return np.asarray((self.seen_t > 0.9) & (self.seen_t < 3.0))

    @property
    def at_frames(self) -> Array:
        return np.interp(self.seen_t, self.t, self.crest)


def four_cups() -> Scenario:
    """Their task, on their arm."""
    return load(FOLDER / "four-cups.toml")


@lru_cache(maxsize=1)
def _four_cups() -> dict[str, Array]:
    with np.load(FOLDER / "four-cups.npz") as kept:
        return dict(kept)


def joints_of_cups() -> Array:
    """(N, 6) rad of their motion, `RATE` times a second."""
    return np.asarray(_four_cups()["joints"] / FINE - [ASIDE, 0, 0, 0, 0, 0])


def cups() -> list[Cup]:
    """The four cups along the motion that was executed."""
    audit = audit_samples(joint_samples(_rested(joints_of_cups()), RATE, "four-cups"), four_cups())
    waves = waves_of(audit, CUP_FILL, damping_of(CUP_RADIUS, CUP_FILL, FLUIDS["water"].viscosity))
    found = []
    for cup, crest in enumerate(waves.crest):
        video = IN_VIDEO.index(cup)
        seen_t, seen = (_four_cups()[f"{what}/{video + 1}"].astype(float) for what in ("times", "seen"))
        late = lag(seen_t, seen, waves.t, crest)
        found.append(Cup(waves.t, crest, seen_t - late, 1e-5 * seen, float(_four_cups()["simulated"][cup])))
    return found


# Forces ---------------------------------------------------------------------------------------------------------------

FORCE_RATE = 250.0  # samples a second: every other one, which is enough for 6 Hz


@dataclass(frozen=True)
class Pushed:
    """The wrench beneath the vessel in one motion. t (T,) s; wrench (T, 6) N, N m, measured, along the vessel's axes
    and as the vessel gets it; water (T, 6): what its waves need beyond a solid's, predicted. a_S (T, 3): measured."""

    t: Array
    wrench: Array
    water: Array
    a_S: Array
    end: float


def pushed() -> Pushed:
    """The motion of `force.npz`: half a metre sideways in 0.8 s, by the joints that were measured."""
    with np.load(FOLDER / "force.npz") as kept:
        q, wrench = kept["joints"][::2] / FINE, kept["wrench"][::2].astype(float)
    t = np.arange(len(q)) / FORCE_RATE
    audit = audit_samples(joint_samples(q, FORCE_RATE, "force"), vessel())
    s, waves = audit.motion.samples, waves_of(audit)
    moving = np.linalg.norm(s.v_S, axis=1) > 1e-2
    # The sensor tells what the vessel does to it, along axes that are turned by half a turn about the upright one.
    seen = wrench[: len(t)] * np.array([1.0, 1.0, -1.0, 1.0, 1.0, -1.0])
    water = _at(t, s.t, waves.wrench[0])
    return Pushed(t[: len(seen)], seen, water[: len(seen)], _at(t, s.t, s.a_S)[: len(seen)], float(s.t[moving][-1]))


def _at(t: Array, known_t: Array, known: Array) -> Array:
    return np.column_stack([np.interp(t, known_t, axis) for axis in known.T])


def swing(t: Array, y: Array, frequency: float) -> float:
    """Amplitude of y at a frequency, Hz, beside a straight line."""
    phase = 2 * np.pi * frequency * t
    design = np.column_stack([np.cos(phase), np.sin(phase), np.ones_like(t), t])
    return float(np.hypot(*np.linalg.lstsq(design, y, rcond=None)[0][:2]))


def decay(t: Array, y: Array, near: float) -> tuple[float, float]:
    """Frequency (Hz) and damping (of critical) of a free oscillation near a frequency."""

    def model(t: Array, a: float, b: float, c: float, f: float, damping: float) -> Array:
        phase = 2 * np.pi * f * t
        return np.exp(-damping * phase) * (a * np.cos(phase) + b * np.sin(phase)) + c

    size = float(np.std(y))
    found = curve_fit(model, t - t[0], y, [size, size, 0.0, near, 0.005], maxfev=9999)[0]
    return float(found[3]), float(found[4])


# An object that slips -------------------------------------------------------------------------------------------------

CLOCK = 2.0  # s for each second of the logs' clock: see docs/reality.md
SLOWED = 15.45  # about so many of the film's seconds for one of the logs' clock
EDGE, MASS = 0.06, 0.236  # m, kg of the cube; the first from its tag's height over the tray's, the second as published
_QUIET = 30  # samples at the beginning, at rest


@lru_cache(maxsize=1)
def _slip() -> dict[str, Array]:
    with np.load(FOLDER / "slip.npz") as kept:
        return {key: kept[key].astype(float) for key in kept.files}


def slip_runs() -> list[str]:
    """All twelve: place on the tray and speed."""
    return sorted({key.split("/")[0] for key in _slip()})


def slip_log(run: str, log: str) -> Array:
    """The rows of a log as they are kept: a time, and what was measured."""
    return _slip()[f"{run}/{log}"]


def cube(friction: float, range_: float = 0.0) -> Scenario:
    """The object on the tray, with so much friction, and known to within a range."""
    one = {
        "name": "cube",
        "shape": {"type": "box", "size": [EDGE, EDGE, EDGE]},
        "mass": MASS,
        "friction": friction,
        "uncertainty": {"friction": range_},
    }
    ends = {"start": {"position": [0.0, 0.0, 0.5]}, "goal": {"position": [0.0, 0.4, 0.5]}, "duration": 1.0}
    tray = {"size": [0.4, 0.4], "height": 0.05, "mass": 1.0}
    return parse({"name": "iiwa-cube", "motion": ends, "objects": [one], "tray": tray}, "iiwa-cube")


def tray_samples(run: str) -> TraySamples:
    """The tray's motion, level where it begins, in true seconds."""
    pose = slip_log(run, "ee_pose")
    turned = Rotation.from_euler("xyz", np.unwrap(pose[:, 4:7], axis=0))
    quat_wxyz = continuous((turned * turned[0].inv()).as_quat()[:, [3, 0, 1, 2]])
    place = pose[:, 1:4] - pose[0, 1:4] + np.array([0.0, 0.0, 0.5])
    return TraySamples(CLOCK * (pose[:, 0] - pose[0, 0]), place, quat_wxyz, run)


def slipped(run: str) -> tuple[Array, Array]:
    """(N,) s on the clock of `tray_samples`, and (N, 2) m by which the cube's tag has moved along the tray, as the
    film from above shows it. The film's clock, scale and direction are those by which the tray's own tag moves as the
    arm does."""
    pose, on_cube, on_tray = (slip_log(run, log) for log in ("ee_pose", "tag1", "tag2"))
    film, moved = on_cube[:, 0], pose[:, 1:3] - pose[0, 1:3]
    tray = _at(film, on_tray[:, 0], on_tray[:, 1:3])
    apart = on_cube[:, 1:3] - tray
    tray, apart = (x - x[:_QUIET].mean(axis=0) for x in (tray, apart))
    middle = film[np.argmax(-tray[:, 1] > 0.5 * np.ptp(tray[:, 1]))]
    passed = pose[np.argmax(moved[:, 1] > 0.5 * np.ptp(moved[:, 1])), 0]

    def along_arm(x: Array, scale: float, angle: float) -> Array:
        c, s = np.cos(angle), np.sin(angle)
        return scale * np.column_stack([c * x[:, 0] - s * x[:, 1], -s * x[:, 0] - c * x[:, 1]])

    def missed(unknown: Array) -> Array:
        slower, late, scale, angle = unknown
        t = passed + late + (film - middle) / (SLOWED * slower)
        return (_at(t, pose[:, 0], moved) - along_arm(tray, scale, angle)).ravel()

    slower, late, scale, angle = least_squares(missed, [1.0, 0.0, 0.95, 0.0], x_scale=[0.1, 0.01, 0.1, 0.1]).x
    t = passed + late + (film - middle) / (SLOWED * slower) - pose[0, 0]
    return CLOCK * t, along_arm(apart, scale, angle)
