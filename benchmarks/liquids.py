"""How high a liquid rises, as predicted and as nonlinear potential flow shows it (tests/potential_flow.py).

The straight min-jerk line over 0.48 m, level, in a box 80 mm wide and in a cup of 80 mm; prints the table of
docs/liquids.md. The flow of a cup is unstable in steep waves (its points are few): where it ends, a dash.

python benchmarks/liquids.py
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import salver as sv
from salver.models.tray_motion import at_rest
from salver.sensitivity.waves import Case

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from potential_flow import cylinder, rectangle, simulate

BOX = {
    "objects__0__shape": {"type": "box", "size": [0.1, 0.07, 0.085]},
    "objects__0__liquid": {"kind": "water", "size": [0.08, 0.06], "fill": 0.05, "brim": 0.08},
}


def push(duration: float, t: float) -> float:
    x = min(max(t / duration, 0.0), 1.0)
    return 0.48 / duration**2 * (60 * x - 180 * x**2 + 120 * x**3)


def rows() -> Iterator[str]:
    """One for each motion."""
    cup = sv.load_scenario("panda-coffee")
    for name, scenario, basis in (
        ("box", cup.with_changes(**BOX), rectangle(0.08, 10)),
        ("cup", cup, cylinder(0.04)),
    ):
        for fill in (0.035, 0.05, 0.065):
            for duration in (1.6, 1.4, 1.25, 1.1, 1.0):
                case, t = Case(scenario.payload.first, fill, 0.005), np.linspace(0, duration, 201)
                w = np.tile(at_rest(), (len(t), 1))
                w[:, 0] = [push(duration, x) for x in t]
                waves, times = case.along(t, w), np.arange(0, duration + 0.5, 0.0015)
                with np.errstate(all="ignore"):
                    seen = simulate(basis, fill, lambda x, T=duration: (push(T, x), 9.81), times, 0.005)
                during, after = seen[times <= duration].max(), seen[times > duration].max()
                cells = [waves.crest.max(), during, waves.left()[0], after]
                shown = [f"{1e3 * x:.1f}" if np.isfinite(x) and x < 0.05 else "–" for x in cells]
                ratio = f"{waves.crest.max() / during:.2f}" if shown[1] != "–" else "–"
                steep = f"{0.3 * waves.free_height.max() / waves.cases.steepest[0]:.2f}"
                yield f"| {name}, {1e3 * fill:.0f} mm | {duration} | {steep} | {' | '.join(shown)} | {ratio} |"


if __name__ == "__main__":
    print("| liquid | s | steepest a/R | predicted, mm | seen | after, bound | seen | predicted / seen |")
    print("|---|---|---|---|---|---|---|---|")
    for row in rows():
        print(row, flush=True)
