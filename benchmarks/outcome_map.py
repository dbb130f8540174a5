"""Where does robust planning change what happens? Outcomes in the physics engine over duration, friction and height.

    python benchmarks/outcome_map.py [--jobs 2] [--only friction|height]

Every cell plans the paper's move on the Panda for a box of 0.256 kg and 4 x 4 cm base, then runs it once with what
is worst for it: of mass (10 %), friction (10 %) and, in the second map, the centre of mass (3 mm in x and y), the
corner that takes most from the margin. Three motions: the straight min-jerk line, the robust plan on a level tray, and
the robust plan with a tray that may tilt; contact condition "exact". Where the arm cannot follow within its limits
the cell says so, whatever the object would have done; a cell without a plan is blank.

Writes docs/images/map-friction.svg, docs/images/map-height.svg and docs/data/outcome-maps.json.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import sys
import time
from collections.abc import Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.reports.style import BLACK, GREY, OUTCOME_COLOURS
from salver.scenario import Scenario, load

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMN = 3.45  # in, width of a picture
DOCS = Path(__file__).parent.parent / "docs"
MOTIONS = {"baseline": "straight line", "plan": "robust, level", "tilting": "robust, tilting"}
DURATIONS = [0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1.8]
FRICTIONS = [0.1, 0.15, 0.2, 0.3, 0.4, 0.5]
HEIGHTS = [0.02, 0.04, 0.06, 0.08, 0.1, 0.12]  # m, of the centre of mass over the tray


@dataclass(frozen=True)
class Cell:
    stem: str
    duration: float
    friction: float
    height: float
    com: float


def scenario_of(cell: Cell) -> Scenario:
    uncertainty: dict[str, Any] = {"mass": "10%", "friction": "10%"}
    if cell.com:
        uncertainty["com"] = [cell.com, cell.com, 0.0]
    paper = load("panda-cube")
    # The tray moves as in the paper, whatever stands on it: B is at the centre of mass.
    ends = {
        f"motion__{end}__position": [*pose.position[:2], pose.position[2] - 0.02 + cell.height]
        for end, pose in (("start", paper.motion.start), ("goal", paper.motion.goal))
    }
    return paper.with_changes(
        **ends,
        motion__duration=cell.duration,
        motion__orientation="free" if cell.stem == "tilting" else "fixed",
        contact__condition="exact",
        contact__edges=8,
        objects__0__shape={"type": "box", "size": [0.04, 0.04, 2 * cell.height]},
        objects__0__inertia=None,
        objects__0__friction=cell.friction,
        objects__0__uncertainty=uncertainty,
    )


def run(cell: Cell) -> dict[str, Any]:
    """Plan, then one run at the worst corner for that plan."""
    from salver.planning.make import make_plan
    from salver.simulation.physics import simulate

    scenario = scenario_of(cell)
    plan = make_plan(scenario, "baseline" if cell.stem == "baseline" else "robust")
    row: dict[str, Any] = {**vars(cell), "slip": None, "tip": None}
    if plan.status.code == "infeasible" or plan.joint is None:
        return row | {"outcome": "no plan"}
    if plan.arm_status is not None and not plan.arm_status.ok:
        return row | {"outcome": "limit"}
    record = simulate(plan, parameters=worst_corner(scenario, plan))
    own = record.summary["objects"][0]
    return row | {"outcome": record.outcome, "slip": own["peak_slip"], "tip": own["peak_tip_angle"]}


def worst_corner(scenario: Scenario, plan: Any) -> dict[str, float]:
    """The corner of the uncertain set with the least exact margin along the plan's own motion."""
    from salver.contact_margins import margins

    uncertain = scenario.payload.uncertain
    samples = plan.reference.sample(plan.t)
    best: tuple[float, dict[str, float]] | None = None
    # Of equal ones the first: heavier, for mass alone changes what the arm does and not the margin; less friction.
    usual = [-1.0 if name == "friction" else 1.0 for name in uncertain.names]
    for signs in itertools.product(*((sign, -sign) for sign in usual)):
        values = {
            name: float(nominal + sign * half)
            for name, nominal, half, sign in zip(
                uncertain.names, uncertain.nominal, uncertain.half_range, signs, strict=True
            )
        }
        changes: dict[str, Any] = {"objects__0__uncertainty": {}, "objects__0__mass": values["mass"]}
        changes["objects__0__friction"] = values["friction"]
        if "com_x" in values:
            changes["objects__0__com"] = [values["com_x"], values["com_y"], 0.0]
        # The object's frame moves with its nominal centre of mass; the tray is what moves the same.
        moved = scenario.with_changes(**changes)
        offset = [values.get("com_x", 0.0), values.get("com_y", 0.0), 0.0]
        margin = float(margins(moved, samples.of_frame(offset)).exact.min())
        if best is None or margin < best[0] - 1e-9:
            best = (margin, values)
    assert best is not None
    return best[1]


def cells(which: str) -> list[Cell]:
    if which == "friction":
        return [Cell(s, t, mu, 0.02, 0.0) for s in MOTIONS for t in DURATIONS for mu in FRICTIONS]
    return [Cell(s, t, 0.5, h, 0.003) for s in MOTIONS for t in DURATIONS for h in HEIGHTS]


OUTCOME_MARKS = {
    "holds": "",
    "slides": "s",
    "spills": "w",
    "tips": "t",
    "lifts": "l",
    "lost": "×",
    "limit": "–",
    "no plan": "",
}


def outcome_map(
    table: Mapping[str, Any], columns: Iterable[tuple[str, str]], x: str = "duration", y: str = "friction"
) -> Figure:
    """Outcome of a motion over two quantities: one panel for each (stem, title) of `columns`.

    table: columns `x`, `y`, "stem" and "outcome" of equal length, one row a run; several runs of one cell show the
    worst. A cell where something happened carries a letter besides its colour; one without a plan is blank.
    """
    from matplotlib.figure import Figure as Drawing
    from matplotlib.patches import Patch

    columns = list(columns)
    order = list(OUTCOME_MARKS)
    colours = OUTCOME_COLOURS | {"holds": "#dcefe8", "no plan": "white"}
    xs, ys = (np.unique(np.asarray(table[key], dtype=float)) for key in (x, y))
    figure = Drawing(figsize=(COLUMN * len(columns), 2.5), layout="constrained")
    axes = figure.subplots(1, len(columns), squeeze=False, sharey=True)
    seen: set[str] = set()
    for ax, (stem, title) in zip(axes[0], columns, strict=True):
        worst: dict[tuple[int, int], str] = {}
        for xv, yv, own, outcome in zip(table[x], table[y], table["stem"], table["outcome"], strict=True):
            if own != stem:
                continue
            cell = (int(np.searchsorted(xs, xv)), int(np.searchsorted(ys, yv)))
            if cell not in worst or order.index(str(outcome)) > order.index(worst[cell]):
                worst[cell] = str(outcome)
        edges_x, edges_y = _edges(xs), _edges(ys)
        for (i, j), outcome in worst.items():
            seen.add(outcome)
            left, low = edges_x[i], edges_y[j]
            wide, high = edges_x[i + 1] - left, edges_y[j + 1] - low
            ax.add_patch(_cell(left, low, wide, high, colours[outcome]))
            seen_on = "white" if colours[outcome] == BLACK else BLACK
            ax.text(
                left + wide / 2, low + high / 2, OUTCOME_MARKS[outcome], ha="center", va="center", size=7, color=seen_on
            )
        ax.set(xlim=(edges_x[0], edges_x[-1]), ylim=(edges_y[0], edges_y[-1]), xlabel=f"{x} [s]")
        ax.set_title(title, loc="left")
        ax.grid(visible=False)
    axes[0, 0].set_ylabel(f"{y} coefficient" if y == "friction" else y)
    handles = [
        Patch(facecolor=colours[o], edgecolor=GREY, linewidth=0.4, label=f"{o} ({m})" if m else o)
        for o, m in OUTCOME_MARKS.items()
        if o in seen
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _cell(left: float, low: float, wide: float, high: float, colour: str) -> Any:
    from matplotlib.patches import Rectangle

    return Rectangle((left, low), wide, high, facecolor=colour, edgecolor="white", linewidth=0.6)


def _edges(centres: np.ndarray) -> np.ndarray:
    """Borders of cells around increasing centres."""
    if len(centres) == 1:
        return np.array([centres[0] - 0.5, centres[0] + 0.5])
    middle = 0.5 * (centres[1:] + centres[:-1])
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])


def draw(which: str, rows: list[dict[str, Any]]) -> None:
    sys.path.append(str(DOCS))
    from paper_figures import drawn, paper_style

    columns = {key: [row[key] for row in rows] for key in rows[0]}
    label = {"friction": "friction", "height": "height of the centre of mass [m]"}[which]
    columns[label] = columns[which]
    with paper_style():
        figure = outcome_map(columns, MOTIONS.items(), "duration", label)
        (DOCS / "images" / f"map-{which}.svg").write_bytes(drawn(figure, "svg"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    parser.add_argument("--only", choices=("friction", "height"))
    options = parser.parse_args()
    path = DOCS / "data" / "outcome-maps.json"
    made = json.loads(path.read_text()) if path.is_file() else {}
    for which in (options.only,) if options.only else ("friction", "height"):
        began = time.perf_counter()
        with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
            rows = list(pool.map(run, cells(which)))
        made[which] = rows
        path.write_text(json.dumps(made, indent=0) + "\n")
        draw(which, rows)
        print(f"{which}: {len(rows)} cells in {time.perf_counter() - began:.0f} s")
        for stem, title in MOTIONS.items():
            own = [row["outcome"] for row in rows if row["stem"] == stem]
            print(f"  {title}: " + ", ".join(f"{word} {own.count(word)}" for word in sorted(set(own))))


if __name__ == "__main__":
    main()
