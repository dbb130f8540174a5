"""Runs the paper's section V in the physics engine and writes the figures into docs/physics.md.

python docs/make_physics.py
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import blocks
import numpy as np
from make_reproduction import table
from paper_figures import drawn, heavier, paper_style, tracking

from salver.campaigns import run_campaign
from salver.planning.make import make_plan
from salver.reports.run import read_run
from salver.scenario import load

PAGE = Path(__file__).parent / "physics.md"
IMAGES = Path(__file__).parent / "images"
DATA = Path(__file__).parent / "data"
SECTION_V = load("panda-cube").with_changes(objects__0__uncertainty={"mass": "10%", "inertia": "10%"})
RUNS, SEED = 100, 0
STEMS = {"plan": "robust", "baseline": "straight line"}


def campaign(directory: Path) -> str:
    """100 runs of each motion with the same perturbed masses and inertias."""
    done = run_campaign(directory, RUNS, SEED)
    plans = done.summary["plans"]
    rows = [["holds", *(_rate(plans[stem]["outcomes"]["holds"]) for stem in STEMS)]]
    for key, name, factor in (
        ("peak_slip", "largest slip, creep taken off (nm): median, largest", 1e9),
        ("e_p_peak", "largest position error of the object (mm)", 1e3),
        ("e_o_peak", "largest orientation error of the object (mrad)", 1e3),
        ("cone_least", "least Lambda from measured forces (mN): median, least", 1e3),
    ):
        extreme = "min" if key == "cone_least" else "max"
        cells = [plans[stem]["quantiles"][key] for stem in STEMS]
        rows.append([name, *(f"{factor * q['median']:.3g}, {factor * q[extreme]:.3g}" for q in cells)])
    tubes = [plans[stem]["tube"] for stem in STEMS]
    rows.append(["runs outside the tube of Lambda", *(_rate(tube["left"]) for tube in tubes)])
    rows.append(["furthest outside (mN, share of the radius)", *(_excess(tube) for tube in tubes)])
    rows.append(["the same after start-up (share)", *(f"{100 * t['excess_settled']['max']:.1f} %" for t in tubes)])
    peaks = done.to_pandas().pivot(index="run", columns="stem", values="e_p_peak")
    better = 1e6 * (peaks["plan"] - peaks["baseline"])
    lines = [
        table(["quantity", *STEMS.values()], rows),
        "",
        "Run by run, the robust motion's largest position error is "
        f"{better.median():+.1f} µm against the line's (from {better.min():+.1f} to {better.max():+.1f} µm).",
    ]
    return "\n".join(lines)


def _rate(rate: dict[str, float]) -> str:
    return f"{rate['count']} of {rate['of']} ({100 * rate['low']:.1f} to {100 * rate['high']:.1f} %)"


def _excess(tube: dict[str, Any]) -> str:
    return f"{1e3 * tube['worst_excess']:.1f}, {100 * tube['worst_excess_relative']:.0f} %"


def fifty_grams(directory: Path) -> str:
    """Fig. 8: the object's errors over time, as planned and 50 g heavier."""
    run = read_run(directory)
    plans = {stem: make_plan(SECTION_V, "robust" if stem == "plan" else "baseline") for stem in STEMS}
    nominal = {stem: heavier(plan, 0.0) for stem, plan in plans.items()}
    heavy = {stem: heavier(plan) for stem, plan in plans.items()}
    rows = []
    for stem, title in STEMS.items():
        for name, record in (("nominal", nominal[stem]), ("+50 g", heavy[stem])):
            moving = record.t <= plans[stem].duration
            rows.append(
                [
                    title,
                    name,
                    record.outcome,
                    f"{1e3 * record.e_p[moving].max():.3f}",
                    f"{1e3 * np.sqrt(np.mean(record.e_p[moving] ** 2)):.3f}",
                    f"{1e3 * record.e_o[moving].max():.3f}",
                    f"{1e3 * np.sqrt(np.mean(record.e_o[moving] ** 2)):.3f}",
                ]
            )
    with paper_style():
        (IMAGES / "fig8-tracking.png").write_bytes(drawn(tracking(run.motions, nominal, heavy)))
    return table(
        ["motion", "object", "outcome", "e_p peak (mm)", "e_p rms (mm)", "e_o peak (mrad)", "e_o rms (mrad)"], rows
    )


def maps(_: Path) -> str:
    """How many cells of the two maps each motion holds, and the shortest duration that holds in each row."""
    made = json.loads((DATA / "outcome-maps.json").read_text())
    blocks = []
    for which, rows in made.items():
        stems = list(dict.fromkeys(row["stem"] for row in rows))
        values = sorted({row[which] for row in rows})
        lines = []
        for value in values:
            cells = [[row for row in rows if row["stem"] == stem and row[which] == value] for stem in stems]
            lines.append([f"{value:g}", *(_shortest(own) for own in cells)])
        unit = " (m)" if which == "height" else ""
        blocks.append(table([f"{which}{unit}", "straight line", "robust, level", "robust, tilting"], lines))
    return "\n\n".join(blocks)


def agreement(_: Path) -> str:
    """What benchmarks/audit_agreement.py counted."""
    cases = json.loads((DATA / "audit-agreement.json").read_text())
    words = ("holds", "slides", "tips")
    rows = [
        [f"audit: {said}", *(str(sum(c["audit"] == said and c["engine"] == seen for c in cases)) for seen in words)]
        for said in words
    ]
    return table([f"{len(cases)} motions", *(f"engine: {seen}" for seen in words)], rows)


def _shortest(rows: list[dict[str, Any]]) -> str:
    """Shortest duration from which on everything held, and what happened at the one before."""
    ordered = sorted(rows, key=lambda row: -row["duration"])
    held = None
    for row in ordered:
        if row["outcome"] != "holds":
            before = f"; {row['duration']:g} s: {row['outcome']}"
            return (f"{held:g} s" if held else "none") + before
        held = row["duration"]
    return f"{held:g} s or less"


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        directory = Path(folder)
        make_plan(SECTION_V, "robust").save(directory)
        make_plan(SECTION_V, "baseline").save(directory, "baseline")
        for make in (campaign, fifty_grams, maps, agreement):
            blocks.replace(PAGE, make.__name__, make(directory))


if __name__ == "__main__":
    main()
