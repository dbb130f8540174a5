"""What real robots measured, and what salver predicts of it: docs/reality.md, from docs/data/real.

    python benchmarks/reality.py [--docs]

Prints the tables; --docs also draws the pictures and writes all of it into the page.
"""

from __future__ import annotations

import argparse
import sys
import textwrap
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from unittest.mock import patch

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.signal import butter, filtfilt, savgol_filter

import salver as sv
from salver.auditing import AuditOptions, audit_samples
from salver.dynamics import modal_motion
from salver.dynamics.liquid import surface
from salver.dynamics.liquid.liquid import LEANING, STEEPEST
from salver.geometry import Array
from salver.given import simulate_given

sys.path += [str(Path(__file__).parents[1] / folder) for folder in ("tests/helpers", "docs")]
import blocks

from measured_motions import (
    CLOCK,
    FILL,
    FORCE_RATE,
    FORMULA,
    RADIUS,
    Cup,
    Predicted,
    Pushed,
    cube,
    cups,
    decay,
    four_cups,
    joints_of_cups,
    names,
    predicted,
    pushed,
    slip_log,
    slip_runs,
    slipped,
    swing,
    tray_samples,
    vessel,
    waves_of,
)

DOCS = Path(__file__).parents[1] / "docs"
PAGE, IMAGES, README = DOCS / "reality.md", DOCS / "images", DOCS.parent / "README.md"
PATHS = {
    "LE": "lemniscate, spun by 900°",
    "RD": "circle, spun by 720°",
    "TRD": "travelling circle, spun by 270°",
    "Tilt_LE": "lemniscate, tilted",
    "Tilt_RD": "circle, tilted",
    "Tilt_TRD": "travelling circle, tilted",
}
SHOWN = "LE_3D_0m_4.8s_900deg", "RD_2D_0.3m_6.5s_720deg", "Tilt_TRD_2D_0.3m_3s_30deg"
CAMERA = np.deg2rad(270)  # about the vessel's axis, where surfaces are seen at their predicted height
HIGH = 0.012  # m of predicted height, above which sides are compared
BAND = 2.3, 3.8  # Hz, about the first mode
QUIET = 0.3  # s after the motion, from which on the waves that are left are looked at
SWINGS, GENTLE = 1.5e-3, 0.3e-3  # m: deviation of a tail whose frequency is read; predicted waves that are small
CLEAR = 0.6  # share of a tail's variance that a free oscillation explains, from which on its damping is read

WATER = 998.0 * np.pi * RADIUS**2 * FILL  # kg
LATER, FIRST, SMOOTH = 0.5, 1.5, 15.0  # s after the motion, s of it in which amplitudes are read; Hz of the filter
FITTED, FRICTIONS = "center30", np.array([0.13, 0.15, 0.17, 0.19, 0.21])
GAPS = AuditOptions(longest_gap=0.3)  # s without samples that are bridged


def path_of(name: str) -> str:
    return name.split("_2D")[0].split("_3D")[0]


def percentiles(values: list[float]) -> str:
    return f"{np.median(values):.2f} ({min(values):.2f} to {max(values):.2f})"


def prose(*parts: str, indent: int = 0) -> str:
    return textwrap.fill(" ".join(parts), 125, subsequent_indent=" " * indent, break_on_hyphens=False)


def steepness(p: Predicted) -> tuple[float, float]:
    """Of the free wave and of the whole surface, predicted, over R."""
    return float(p.waves.free_height[0].max()) / RADIUS, float(p.waves.height[0].max()) / RADIUS


def kind(p: Predicted) -> str:
    """How the motion stands to what salver calls valid."""
    free, whole = steepness(p)
    if free > STEEPEST:
        return f"free wave above {STEEPEST:g} R"
    return f"whole surface above {LEANING:g} R" if whole > LEANING else "valid"


def off(p: Predicted) -> float:
    """m r.m.s. of predicted less seen, in time."""
    return float(np.sqrt(np.mean((p.at_frames - p.seen)[p.during] ** 2)))


def alike(p: Predicted) -> float:
    return float(np.corrcoef(p.at_frames[p.during], p.seen[p.during])[0, 1])


def ratio(p: Predicted) -> float:
    crest, seen = p.peaks
    return crest / seen


def grouped(every: list[Predicted], of: dict[str, list[Predicted]]) -> list[str]:
    """A table with one line for each group and one for all."""
    rows = [
        "| motions | n | highest seen, mm | predicted / seen | r.m.s. in time, mm | correlation |",
        "|---|---|---|---|---|---|",
    ]
    for name, some in {**of, "**all**": every}.items():
        seen = [1e3 * p.peaks[1] for p in some]
        rows.append(
            f"| {name} | {len(some)} | {min(seen):.0f} to {max(seen):.0f} | {percentiles([ratio(p) for p in some])} | "
            f"{1e3 * np.median([off(p) for p in some]):.1f} | {np.median([alike(p) for p in some]):.2f} |"
        )
    return rows


def sides(every: list[Predicted]) -> list[str]:
    """Seen over predicted where the surface stands high on the camera's side of the vessel, and on the other one."""
    rows = ["| motions | high on the camera's side | high on the far side |", "|---|---|---|"]
    for path, said in PATHS.items():
        near, far = [], []
        for p in every:
            if path_of(p.name) == path:
                toward, share = _towards_camera(p)
                near += share[toward > 0.5].tolist()
                far += share[toward < -0.5].tolist()
        rows.append(f"| {said} | {np.median(near):.2f} ({len(near)} frames) | {np.median(far):.2f} ({len(far)}) |")
    return rows


def _towards_camera(p: Predicted) -> tuple[Array, Array]:
    """Of frames in which a high surface is predicted: cosine of its direction from the camera's, and seen over
    predicted."""
    x, y = (np.interp(p.seen_t, p.t, axis) for axis in p.waves.seen[0, :, :2].T)
    some = p.during & (p.at_frames > HIGH)
    return np.cos(np.arctan2(y, x) - CAMERA)[some], p.seen[some] / p.at_frames[some]


def frequency(p: Predicted) -> tuple[float, float]:
    """Hz at which the surface is seen to swing after the motion, and m, by standard deviation."""
    some = p.seen_t > p.end + QUIET
    left = p.seen[some] - p.seen[some].mean()
    power = np.abs(np.fft.rfft(left * np.hanning(len(left)), 32 * len(left)))
    f = np.fft.rfftfreq(32 * len(left), np.median(np.diff(p.seen_t)))
    within = (f > BAND[0]) & (f < BAND[1])
    return float(f[within][np.argmax(power[within])]), float(left.std())


def damping(p: Predicted, near: float) -> tuple[float, float]:
    """Damping of the tail, of critical, and the share of its variance that a free oscillation explains."""
    some = p.seen_t > p.end + QUIET
    t, y = p.seen_t[some], p.seen[some]
    f, found = decay(t, y, near)
    phase = 2 * np.pi * f * (t - t[0])
    shapes = np.column_stack([np.exp(-found * phase) * wave for wave in (np.cos(phase), np.sin(phase))] + [phase**0])
    left = y - shapes @ np.linalg.lstsq(shapes, y, rcond=None)[0]
    return found, float(1 - left.var() / y.var())


def damped(every: list[Predicted], first: float) -> str:
    """What the tails say of damping, and what it matters."""
    low, high = vessel().payload.first.inner.damping
    tails = [damping(p, first) for p in every if frequency(p)[1] > SWINGS]
    clear = [found for found, share in tails if share > CLEAR]
    quarters, below = np.quantile(clear, [0.25, 0.5, 0.75]), sum(found < low for found in clear)
    undamped = [float(waves_of(p.audit, damping=0.0).crest[0].max()) / p.peaks[0] for p in every]
    return prose(
        f"Of these tails {len(clear)} are a decaying wave to {100 * CLEAR:.0f} % of their variance. Their damping is",
        f"{quarters[1]:.4f} of critical at the median (quartiles {quarters[0]:.4f} and {quarters[2]:.4f}), beside",
        f"{FORMULA:.4f} by the formula; {below} are below the default range ({low:.4f} to {high:.2f}),",
        f"{sum(found < 0 for found in clear)} of them below 0: no free wave grows, but one whose plane turns may seem",
        "to before a camera that sees one side. Little depends on damping: without any, the highest crest of a motion",
        "would be predicted up to",
        f"{100 * (max(undamped) - 1):.1f} % higher. The default range is left as it is.",
    )


def afterwards(every: list[Predicted], first: float) -> str:
    """What the waves do that are left."""
    seen = [frequency(p) for p in every]
    clear = [f for f, size in seen if size > SWINGS]
    bounds, highest = [], []
    for p in every:
        bounds.append(float(p.waves.left()[0]))
        highest.append(float(p.seen[p.seen_t > p.end + QUIET].max()))
    kept = sum(h <= b for h, b in zip(highest, bounds, strict=True))
    gentle = [k for k, p in enumerate(every) if p.waves.tail[0].sum(axis=0).max() < GENTLE]
    times = np.divide(bounds, highest)
    small = [1e3 * highest[k] for k in gentle]
    return prose(
        f"The surface is seen to swing at {np.median(clear):.3f} Hz at the median ({min(clear):.2f} to",
        f"{max(clear):.2f}; {len(clear)} motions whose tails have a standard deviation above {1e3 * SWINGS:g} mm);",
        f"{first:.3f} Hz is predicted, {100 * (first / np.median(clear) - 1):+.1f} %.",
        "The bound on what is left after a motion, which limits plans, holds in",
        f"{kept} of {len(every)}: it is {np.median(times):.0f} times the highest seen at the",
        f"median ({min(times):.1f} to {max(times):.0f}). By linear theory alone {len(gentle)} gentle motions leave",
        f"less than {1e3 * GENTLE:g} mm; up to {max(small):.0f} mm are seen after them, {np.median(small):.0f} at the",
        "median.",
    )


def rules(every: list[Predicted]) -> list[str]:
    """What becomes of the prediction without one rule of the model."""
    spun = [p for p in every if not p.name.startswith("Tilt")]
    rising = [p for p in every if "_3D_" in p.name]
    leant = [p for p in every if p.name.startswith("Tilt")]
    asked: list[tuple[str, str, list[Predicted], object, str, object]] = [
        (
            "a round vessel does not spin its water",
            "spun",
            spun,
            modal_motion,
            "_spin",
            lambda _, __, w, ___: 0 * w[..., 0],
        ),
        (
            "force along the vessel stiffens waves",
            "3D",
            rising,
            modal_motion,
            "_upward",
            lambda _, w: 0 * w[..., 0] + 9.81,
        ),
        ("tilting at a rate raises the crest", "tilted", leant, surface, "TILTING", 0.0),
    ]
    rows = [
        "| rule | motions | n | predicted / seen, with it | without | r.m.s., mm | without | correlation | without |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for said, which, some, where, name, other in asked:
        with patch.object(where, name, other):
            without = [replace(p, waves=waves_of(p.audit)) for p in some]
            cells = [
                form.format(scale * np.median([of(p) for p in group]))
                for form, scale, of in (("{:.2f}", 1, ratio), ("{:.1f}", 1e3, off), ("{:.3f}", 1, alike))
                for group in (some, without)
            ]
        rows.append(f"| {said} | {which} | {len(some)} | {' | '.join(cells)} |")
    return rows


def tilts(every: list[Predicted]) -> list[str]:
    """The frame of `Tilt_TRD`: predicted over seen, with the joints as published and with the tilt mirrored."""
    rows = ["| motion | highest seen, mm | as published | mirrored |", "|---|---|---|---|"]
    for p in every:
        if p.name.startswith("Tilt_TRD"):
            other = predicted(p.name, "joints")
            rows.append(
                f"| `{p.name}` | {1e3 * p.peaks[1]:.1f} | {ratio(other):.2f}, correlation {alike(other):.2f} | "
                f"{ratio(p):.2f}, correlation {alike(p):.2f} |"
            )
    return rows


def motions(every: list[Predicted]) -> list[str]:
    rows = [
        "| motion | seen, mm | predicted | ratio | r.m.s., mm | correlation | free wave / R | surface / R |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for p in every:
        crest, seen = p.peaks
        free, whole = steepness(p)
        rows.append(
            f"| `{p.name}` | {1e3 * seen:.1f} | {1e3 * crest:.1f} | {crest / seen:.2f} | {1e3 * off(p):.1f} | "
            f"{alike(p):.2f} | {free:.2f} | {whole:.2f} |"
        )
    return rows


def picture(every: list[Predicted], path: Path) -> None:
    """All motions about the diagonal, and three in time."""
    figure = plt.figure(figsize=(11, 6.4), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=[1, 1.25])
    left = figure.add_subplot(grid[:, 0])
    for marker, (name, said) in zip("o^sDvP", PATHS.items(), strict=True):
        peaks = 1e3 * np.array([p.peaks for p in every if path_of(p.name) == name])
        left.plot(peaks[:, 1], peaks[:, 0], marker, ms=6, alpha=0.8, label=said)
    top, ratios = 68, [ratio(p) for p in every]
    left.plot([0, top], [0, top], "k-", lw=0.8)
    band = [0, min(ratios) * top], [0, max(ratios) * top]
    left.fill_between([0, top], *band, color="0.9", zorder=0, label=f"{min(ratios):.2f} to {max(ratios):.2f}")
    left.set(xlim=(10, top), ylim=(10, top), xlabel="highest surface seen, mm", ylabel="predicted, mm")
    left.set_title("48 motions, nothing fitted", fontsize=10)
    left.legend(fontsize=8, loc="upper left")
    for k, name in enumerate(SHOWN):
        p = next(p for p in every if p.name == name)
        right = figure.add_subplot(grid[k, 1])
        right.plot(p.seen_t, 1e3 * p.seen, "k", lw=0.9, label="seen")
        right.plot(p.t, 1e3 * p.waves.crest[0], "C0", lw=1.1, label="predicted")
        right.axvline(p.end, color="0.6", lw=0.8)
        right.set(xlim=(0.5, p.end + 2.5), ylabel="height, mm")
        right.set_title(f"{name}: predicted / seen {ratio(p):.2f}", fontsize=9)
        if k == 0:
            right.legend(fontsize=8)
    right.set_xlabel("time, s")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def sloshing() -> tuple[list[Predicted], dict[str, str]]:
    """Section 1: all 48 motions, and its parts of the page."""
    every = [predicted(name) for name in names()]
    by_path = {said: [p for p in every if path_of(p.name) == path] for path, said in PATHS.items()}
    kinds = {
        said: [p for p in every if kind(p) == said]
        for said in ("valid", f"whole surface above {LEANING:g} R", f"free wave above {STEEPEST:g} R")
    }
    first = float(vessel().payload.first.inner.modes(FILL).omega[0, 0]) / (2 * np.pi)
    clear = [f for f, size in map(frequency, every) if size > SWINGS]
    ratios, below = [ratio(p) for p in every], [p for p in every if ratio(p) < 1]
    low = ", ".join(f"{x:.2f}" for x in sorted(ratio(p) for p in below))
    span = f"{np.median(ratios):.2f} of what was seen at the median ({min(ratios):.2f} to {max(ratios):.2f})"
    found = (
        f"1. **Sloshing.** In {len(every)} motions of a real arm, none left out and nothing fitted, the highest",
        f"surface is predicted at {span}, and the first frequency within",
        f"{100 * abs(first / np.median(clear) - 1):.1f} %; {len(below)} motions rose higher than predicted ({low}).",
    )
    readme = (
        f"- None of its own plans has run on a real arm. Of {len(every)} motions of a real arm that others measured,",
        f"it predicts the highest water at {span}: [real robots](docs/reality.md).",
    )
    parts = {
        "readme": prose(*readme, indent=2),
        "findings": prose(*found, indent=3),
        "paths": "\n".join(grouped(every, by_path)),
        "kinds": "\n".join(grouped(every, kinds)),
        "sides": "\n".join(sides(every)),
        "tilts": "\n".join(tilts(every)),
        "rules": "\n".join(rules(every)),
        "after": afterwards(every, first),
        "damping": damped(every, first),
        "motions": "\n".join(motions(every)),
    }
    return every, parts


# Forces ---------------------------------------------------------------------------------------------------------------


def forces() -> tuple[str, str, Pushed]:
    """Section 2: the finding, the table, and what was compared."""
    p = pushed()
    after = (p.t > p.end + LATER) & (p.t < p.t[-1] - LATER)
    early = after & (p.t < p.end + LATER + FIRST)
    seen_f, seen_damping = decay(p.t[after], p.wrench[after, 1], 3.0)
    told_f, told_damping = decay(p.t[after], p.water[after, 1], 3.0)
    rows = ["| after the motion | measured | predicted |", "|---|---|---|"]
    shares = []
    for name, axis, order in (("along the motion, at f", 1, 1), ("upward, at 2 f", 2, 2)):
        seen = swing(p.t[early], p.wrench[early, axis], order * seen_f)
        told = swing(p.t[early], p.water[early, axis], order * told_f)
        shares.append(told / seen)
        rows.append(f"| amplitude of the force {name}, N | {seen:.3f} | {told:.3f} |")
    rows.append(f"| frequency f, Hz | {seen_f:.3f} | {told_f:.3f} |")
    rows.append(f"| damping, of critical | {seen_damping:.4f} | {told_damping:.4f} |")
    delay, solid, left = _solid(p)
    rows.append("")
    low, high = vessel().payload.first.inner.damping
    rows.append(
        prose(
            f"During the motion the force is that of a solid of {solid:.2f} kg beside the waves, the one number that",
            f"is fitted (the water has {WATER:.2f} kg, the vessel was not weighed), {1e3 * delay:.0f} ms late; of",
            f"{np.abs(p.wrench[:, 1]).max():.1f} N {left:.2f} N r.m.s. are left, most of them the arm's shaking.",
            f"The default range of the damping of water in this vessel, {low:.4f} to {high:.2f}, holds the",
            "measured one.",
        )
    )
    found = (
        "2. **Forces.** Waves push a real wrist as predicted after one motion: the force along the motion, at the "
        f"first frequency, is predicted at {shares[0]:.2f} of the measured one, and the upward force of second order, "
        f"at twice that frequency, at {shares[1]:.2f}; the damping is {seen_damping / told_damping:.1f} times the "
        "formula's."
    )
    return found, "\n".join(rows), p


def _solid(p: Pushed) -> tuple[float, float, float]:
    """s by which the sensor is late, kg that it carries beside the waves, N r.m.s. that are left."""
    during = (p.t > p.end - 1.2) & (p.t < p.end + 0.5)
    low = butter(3, SMOOTH, fs=FORCE_RATE)
    seen, water, a = (filtfilt(*low, x) for x in (p.wrench[:, 1], p.water[:, 1], p.a_S[:, 1]))
    best = (np.inf, 0.0, 0.0)
    for steps in range(20):
        force, moved = (seen - np.roll(water, steps))[during], np.roll(a, steps)[during]
        mass = float(force @ moved / (moved @ moved))
        best = min(best, (float(np.sqrt(np.mean((force - mass * moved) ** 2))), steps / FORCE_RATE, mass))
    return best[1], best[2], best[0]


def picture_of_forces(p: Pushed, path: Path) -> None:
    figure, axes = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout="constrained")
    delay, low = int(FORCE_RATE * _solid(p)[0]), butter(3, SMOOTH, fs=FORCE_RATE)
    for axis, k, name in zip(axes, (1, 2), ("along the motion", "upward"), strict=True):
        axis.plot(p.t - p.end, filtfilt(*low, p.wrench[:, k]), "k", lw=0.9, label=f"measured, below {SMOOTH:g} Hz")
        axis.plot(p.t - p.end, np.roll(p.water[:, k], delay), "C0", lw=1.1, label="predicted of the waves")
        axis.set(xlim=(LATER, 4.0), ylim=np.array([-1, 1]) * (0.45, 0.18)[k - 1], ylabel=f"force {name}, N")
    axes[0].legend(fontsize=8, loc="upper right")
    axes[1].set_xlabel("time after the motion, s")
    figure.savefig(path, dpi=110)
    plt.close(figure)


# An object that slips -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Run:
    """A transport: seen and in the engine, (N,) s and (N, 2) m of slip; the largest, m; peak acceleration, m/s^2."""

    name: str
    t: Array
    seen: Array
    engine_t: Array
    engine: Array
    peak: float
    friction: float
    outcome: str

    @property
    def largest(self) -> tuple[float, float]:
        return _largest(self.seen), _largest(self.engine)

    @property
    def final(self) -> tuple[Array, Array]:
        return self.seen[-20:].mean(axis=0), self.engine[-1]

    @property
    def off(self) -> float:
        return _off(self.t, self.seen, self.engine_t, self.engine)


def _largest(slip: Array) -> float:
    return float(np.linalg.norm(slip, axis=1).max())


def _off(t: Array, seen: Array, engine_t: Array, engine: Array) -> float:
    """m r.m.s."""
    some = (t > 0) & (t < engine_t[-1])
    told = np.column_stack([np.interp(t[some], engine_t, axis) for axis in engine.T])
    return float(np.sqrt(np.mean(np.sum((told - seen[some]) ** 2, axis=1))))


def engine(name: str, friction: float) -> tuple[Array, Array]:
    """(T,) s and (T, 2) m of slip of the cube in the physics engine."""
    record = simulate_given(tray_samples(name), cube(friction), options=GAPS)
    return record.t, record.slip_E[:, 0, :2]


def slips() -> tuple[str, dict[str, str], list[Run]]:
    """Section 3: the finding, parts of the page, and the runs."""
    every = {name: slipped(name) for name in slip_runs()}
    tried = {name: [engine(name, mu) for mu in FRICTIONS] for name in every}
    errors = [_off(*every[FITTED], *found) for found in tried[FITTED]]
    k = int(np.clip(np.argmin(errors), 1, len(errors) - 2))
    mu = float(-0.5 * np.divide(*np.polyfit(FRICTIONS[k - 1 : k + 2], errors[k - 1 : k + 2], 2)[1::-1]))
    proven = {}
    for name, (_, seen) in every.items():
        largest = [_largest(found) for _, found in tried[name]]
        proven[name] = float(np.interp(-_largest(seen), [-x for x in largest], FRICTIONS))
    low, high = min(proven.values()), max(proven.values())
    runs = []
    for name, (t, seen) in every.items():
        audit = audit_samples(tray_samples(name), cube(0.5 * (low + high), 0.5 * (high - low)), GAPS)
        s = audit.motion.samples
        sets_off = s.t[np.argmax(np.linalg.norm(s.p_SB[:, :2] - s.p_SB[0, :2], axis=1) > 2e-3)]
        peak = float(np.linalg.norm(s.a_S[s.t > sets_off - 0.2, :2], axis=1).max())
        runs.append(Run(name, t, seen, *engine(name, mu), peak, proven[name], audit.outcome))
    rows = [
        "| run | peak, m/s² | largest slip seen, mm | engine | final slip seen (x, y), mm | engine | r.m.s., mm | "
        "friction that gives the largest | audit |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for run in runs:
        (seen, told), (at, ends) = run.largest, run.final
        rows.append(
            f"| `{run.name}`{' (fitted)' if run.name == FITTED else ''} | {run.peak:.1f} | {1e3 * seen:.1f} | "
            f"{1e3 * told:.1f} | {1e3 * at[0]:.0f}, {1e3 * at[1]:.0f} | {1e3 * ends[0]:.0f}, {1e3 * ends[1]:.0f} | "
            f"{1e3 * run.off:.1f} | {run.friction:.3f} | {run.outcome.replace('_', ' ')} |"
        )
    others = [run for run in runs if run.name != FITTED]
    slow, close, fast = (
        [run.largest[1] / run.largest[0] for run in others if run.name.endswith(speed)]
        for speed in ("20", ("30", "40"), "50")
    )
    slips = [1e3 * run.largest[0] for run in others if run.name.endswith("20")]
    by_speed = [[run.friction for run in runs if run.name.endswith(speed)] for speed in ("20", "30", "40", "50")]
    means = ", ".join(f"{np.mean(x):.3f}" for x in by_speed)
    held = sum(run.outcome == "holds" for run in runs)
    found = (
        f"3. **Slip.** One Coulomb coefficient ({mu:.3f}), fitted to one of twelve transports of a real cube, predicts "
        f"the largest slip of the others in the engine at {min(close):.2f} to {max(close):.2f} of what was seen at "
        f"middle speeds, at {min(fast):.2f} to {max(fast):.2f} at the highest and at {min(slow):.2f} to "
        f"{max(slow):.2f} at the lowest, where it slips by {min(slips):.1f} to {max(slips):.1f} mm: the friction that "
        f"fits grows with speed ({means} from slow to fast), so a value fitted at middle speeds is too high for slow "
        f"motions; an audit says of {held} of the {len(runs)} runs that the cube holds."
    )
    return found, {"slips": "\n".join(rows), "clock": clock(), "jolt": jolt()}, runs


def clock() -> str:
    """What says that the logs' clock is slow."""
    shares, masses = [], []
    for name in slip_runs():
        v, pose = slip_log(name, "ee_vel"), slip_log(name, "ee_pose")
        moved = np.sum(0.5 * (v[1:, 2] + v[:-1, 2]) * np.diff(v[:, 0]))
        shares.append(moved / (pose[-1, 2] - pose[0, 2]))
        if name.endswith("20"):  # nearly nothing slips
            t = np.arange(v[0, 0], v[-1, 0], 1e-3)
            a = savgol_filter(np.interp(t, v[:, 0], v[:, 2]), 41, 2, deriv=1, delta=1e-3)
            wrench = slip_log(name, "ftsensor")
            force = np.interp(t, wrench[:, 0], savgol_filter(wrench[:, 1] - wrench[:200, 1].mean(), 41, 2))
            some = np.abs(a) > 0.1
            masses.append(-float(a[some] @ force[some] / (a[some] @ a[some])))
    return prose(
        f"The logs contradict themselves: velocity, integrated over their times, gives {min(shares):.3f} to",
        f"{max(shares):.3f} of the 0.4 m that the poses move. Taken as they are, force over acceleration gives",
        f"{np.mean(masses):.2f} kg for tray, camera and cube; with {CLOCK:g} s for each second of the logs it is",
        f"{CLOCK * np.mean(masses):.2f} kg, and the published ones have 1.26 kg. So the clock is taken to be slow by",
        f"{CLOCK:g}, an inference; peak accelerations are then half of what the logs' times give.",
    )


def jolt() -> str:
    """What becomes of the vertical shake."""
    jolts, early, rest, moving = [], [], [], []
    for name in slip_runs():
        v, wrench = slip_log(name, "ee_vel"), slip_log(name, "ftsensor")
        begins = v[np.argmax(np.hypot(v[:, 1], v[:, 2]) > 0.05), 0]
        upward = wrench[:, 3] - np.median(wrench[:, 3])
        smooth = np.convolve(upward, np.ones(20) / 20, "same")
        k = int(np.argmax(np.abs(upward)))
        jolts.append(abs(float(upward[k])))
        early.append(CLOCK * (begins - wrench[k, 0]))
        before = (wrench[:, 0] > begins - 0.3) & (wrench[:, 0] < begins - 0.1)
        during = (wrench[:, 0] > begins - 0.05) & (wrench[:, 0] < begins + 0.5)
        rest.append(float(smooth[before].std()))
        moving.append(float(smooth[during].std()))
    return prose(
        f"The vertical shake is real, but not one of the transport: the wrist feels one jolt of {min(jolts):.0f} to",
        f"{max(jolts):.0f} N, {min(early):.1f} to {max(early):.1f} s before the tray sets off, when the arm's control",
        f"begins. During the transport the upward force varies by {np.median(moving):.2f} N (standard deviation of",
        f"means over 20 samples; {np.median(rest):.3f} N before it):",
        f"{100 * np.median(moving) / (1.26 * 9.81):.1f} % of the weight.",
    )


def picture_of_slips(runs: list[Run], path: Path) -> None:
    figure, axes = plt.subplots(3, 4, figsize=(13, 7), layout="constrained")
    for axis, run in zip(axes.flat, runs, strict=True):
        for k, name in enumerate("xy"):
            axis.plot(run.t, 1e3 * run.seen[:, k], f"C{k}", lw=1.4, label=f"{name} seen")
            axis.plot(run.engine_t, 1e3 * run.engine[:, k], f"C{k}--", lw=1.1, label=f"{name} engine")
        axis.set_title(run.name + (" (fitted)" if run.name == FITTED else ""), fontsize=9)
        axis.set_xlim(run.t[-1] - 2.2, run.t[-1])
    axes[0, 0].legend(fontsize=7)
    for axis in axes[:, 0]:
        axis.set_ylabel("slip, mm")
    for axis in axes[-1]:
        axis.set_xlabel("time, s")
    figure.savefig(path, dpi=100)
    plt.close(figure)


# Four loose cups ------------------------------------------------------------------------------------------------------

LEVEL, LEANT = (1.83, 185), (1.39, 34)  # s of their motions and of computing: with water level, with solids leaning
POSTURES = 41  # of their path, as far from each other in joint space


def planned() -> tuple[list[tuple[float, float]], str]:
    """(s of motion, s of computing) of salver on their task, and the table."""
    task, q = four_cups(), joints_of_cups()
    gone = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1)))
    path = np.column_stack([np.interp(np.linspace(0, gone[-1], POSTURES), gone, joint) for joint in q.T])
    ranges = {f"objects__{k}__uncertainty": {"friction": "10%", "fill": "5%"} for k in range(4)}
    asked: list[tuple[str, str, Callable[[], sv.Plan]]] = [
        ("their path, level", "{:.2f} s, in {:.0f} s".format(*LEVEL), lambda: sv.retime(path, task)),
        ("any path, up to 2° from level", "–", lambda: sv.plan(task.with_changes(motion__max_tilt_deg=2.0))),
        ("any path, leaning", "named as future work", lambda: sv.plan(task)),
        ("the same, friction ±10 %, fill ±5 %", "–", lambda: sv.plan(task.with_changes(**ranges))),
    ]
    found, rows = [], ["| the tray's motion | theirs | salver |", "|---|---|---|"]
    for said, theirs, ask in asked:
        began = time.process_time()
        plan = ask()
        found.append((plan.duration, time.process_time() - began))
        rows.append(f"| {said} | {theirs} | {plan.duration:.2f} s, in {found[-1][1]:.1f} s |")
    return found, "\n".join(rows)


def loose_cups() -> tuple[str, dict[str, str], list[Cup]]:
    """Section 5: the finding, parts of the page, and the cups."""
    every, (durations, table) = cups(), planned()
    rows = [
        "| cup | highest seen, mm | salver | over seen | their planner | over seen | r.m.s., mm | correlation |",
        "|---|---|---|---|---|---|---|---|",
    ]
    ours, theirs = [], []
    for k, cup in enumerate(every, 1):
        told, seen = cup.at_frames[cup.during], cup.seen[cup.during]
        ours.append(cup.crest.max() / seen.max())
        theirs.append(cup.simulated / seen.max())
        rows.append(
            f"| {k} | {1e3 * seen.max():.1f} | {1e3 * cup.crest.max():.1f} | {ours[-1]:.2f} | "
            f"{1e3 * cup.simulated:.1f} | {theirs[-1]:.2f} | {1e3 * np.sqrt(np.mean((told - seen) ** 2)):.1f} | "
            f"{np.corrcoef(told, seen)[0, 1]:.2f} |"
        )
    (on_path, took), (leaning, less) = durations[0], durations[2]
    found = (
        f"4. **Four loose cups.** A published planner computes for {LEVEL[1]} s and plans a level motion of "
        f"{LEVEL[0]:.2f} s; salver computes for {took:.0f} s and plans one of {on_path:.2f} s on the same path, or for "
        f"{less:.0f} s and plans one of {leaning:.2f} s that leans the tray. Along the motion that was executed it "
        f"predicts the highest surface at {min(ours):.2f} to {max(ours):.2f} of what was seen, "
        f"their planner at {min(theirs):.2f} to {max(theirs):.2f}."
    )
    return found, {"cups": "\n".join(rows), "cup-plans": table}, every


def picture_of_cups(every: list[Cup], path: Path) -> None:
    figure, axes = plt.subplots(1, 4, figsize=(13, 2.8), sharey=True, layout="constrained")
    for k, (axis, cup) in enumerate(zip(axes, every, strict=True), 1):
        axis.plot(cup.seen_t, 1e3 * cup.seen, "k", lw=0.9, label="seen")
        axis.plot(cup.t, 1e3 * cup.crest, "C0", lw=1.1, label="predicted")
        axis.axhline(15, color="0.6", lw=0.8, label="their limit")
        axis.set(xlim=(0.8, 4.0), title=f"cup {k}", xlabel="time, s")
    axes[0].set_ylabel("height, mm")
    axes[-1].legend(fontsize=8)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", action="store_true", help="write docs/reality.md and its pictures")
    options = parser.parse_args()
    every, parts = sloshing()
    on_wrist, parts["forces"], p = forces()
    slid, more, runs = slips()
    carried, tables, loose = loose_cups()
    parts |= more | tables
    parts["findings"] += "\n" + "\n".join(prose(found, indent=3) for found in (on_wrist, slid, carried))
    if options.docs:
        picture(every, IMAGES / "reality-sloshing.png")
        picture_of_forces(p, IMAGES / "reality-forces.png")
        picture_of_slips(runs, IMAGES / "reality-slip.png")
        picture_of_cups(loose, IMAGES / "reality-cups.png")
        blocks.replace(README, "reality", parts.pop("readme"))
        for name, text in parts.items():
            blocks.replace(PAGE, name, text)
    else:
        print("\n\n".join(f"{name}\n{text}" for name, text in parts.items()))


if __name__ == "__main__":
    main()
