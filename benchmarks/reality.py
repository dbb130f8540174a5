"""What real robots measured, and what salver predicts of it: docs/reality.md, from docs/data/real.

    python benchmarks/reality.py [--docs]

Prints the tables; --docs also draws the pictures and writes all of it into the page.
"""

from __future__ import annotations

import argparse
import sys
import textwrap
from pathlib import Path

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from salver.geometry import Array
from salver.models.liquid import LEANING, STEEPEST

sys.path += [str(Path(__file__).parents[1] / folder) for folder in ("tests", "docs")]
import blocks

from measured import FILL, RADIUS, Predicted, names, predicted, vessel

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
SWINGS, GENTLE = (
    1.5e-3,
    0.3e-3,
)  # m: standard deviation of a tail whose frequency is read; predicted waves that are small


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
    x, y = (np.interp(p.seen_t, p.t, axis) for axis in p.waves.eta_B[0].T)
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
        right.set(xlim=(0.5, p.end + 2.5), ylabel="mm")
        right.set_title(f"{name}: predicted / seen {ratio(p):.2f}", fontsize=9)
        if k == 0:
            right.legend(fontsize=8)
    right.set_xlabel("s")
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
    first = float(vessel().payload.first.liquid.modes(FILL).omega[0, 0]) / (2 * np.pi)
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
        "after": afterwards(every, first),
        "motions": "\n".join(motions(every)),
    }
    return every, parts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--docs", action="store_true", help="write docs/reality.md and its pictures")
    options = parser.parse_args()
    every, parts = sloshing()
    if options.docs:
        picture(every, IMAGES / "reality-sloshing.png")
        blocks.replace(README, "reality", parts.pop("readme"))
        for name, text in parts.items():
            blocks.replace(PAGE, name, text)
    else:
        print("\n\n".join(f"{name}\n{text}" for name, text in parts.items()))


if __name__ == "__main__":
    main()
