"""The page's section on a campaign: outcomes with intervals, distributions, worst runs, how the tubes did."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from salver.campaigns.summary import LEFT_TUBES
from salver.reports.pages.cells import joined, motion_cell, outcome_cell, percent, table
from salver.reports.pages.charts import LENGTHS, Spec, Units, series, suited
from salver.reports.pages.words import length

if TYPE_CHECKING:
    from salver.reports.run import ReportedMotion, ReportedRun

# What the runs are told apart by: the first two that there are. Column, title, axis, units from coarse to fine.
MEASURES = (
    ("peak_slip", "Largest slip in each run", "slip", LENGTHS),
    ("e_p_peak", "Largest position error in each run", "e_p", LENGTHS),
    ("cone_least", "Least cone coefficient in each run", "min Λ", (("N", 1.0),)),
)


def section(run: ReportedRun, campaign: dict[str, Any]) -> tuple[str, list[Spec], Markup]:
    """Introduction, charts, and HTML below them."""
    plans = campaign["plans"]
    total = max(int(own["runs"]) for own in plans.values())
    definition = campaign.get("definition", {})
    intro = (
        f"{total} runs in the physics engine with true parameters drawn from the uncertain set "
        f"({definition.get('method', 'uniform')}, seed {definition.get('seed', 0)}), the same draws for each motion."
    )
    if not campaign.get("complete", True):
        intro += f" So far: {definition.get('n')} were asked for; the same command goes on."
    specs = [spec for spec in (_distribution(run, *wanted) for wanted in MEASURES) if spec is not None][:2]
    remarks = joined(_remarks(m, plans[m.stem]) for m in run.motions if m.stem in plans)
    extra = Markup('<div class="columns" style="margin-top:14px"><div>{}{}</div><div>{}</div></div>').format(
        _outcomes(run, plans), _paired(run, campaign), remarks
    )
    return intro, specs, extra


def _outcomes(run: ReportedRun, plans: dict[str, Any]) -> Markup:
    rows = []
    for m in run.motions:
        for i, (word, rate) in enumerate(plans.get(m.stem, {}).get("outcomes", {}).items()):
            rows.append(
                [
                    motion_cell(m.stem, m.label) if i == 0 else "",
                    outcome_cell(word),
                    f"{rate['count']} of {rate['of']}",
                    percent(rate["count"] / rate["of"]),
                    f"{percent(rate['low'])} to {percent(rate['high'])}",
                ]
            )
    return table(["", "outcome", "runs", "rate", "95 % interval (Clopper–Pearson)"], rows, numeric=(2, 3))


def _remarks(m: ReportedMotion, own: dict[str, Any]) -> Markup:
    """Worst run, how to repeat it, and how the tubes did, in sentences."""
    worst, label = own["worst_run"], m.label
    slip = f", slip {length(worst['peak_slip'])}" if worst.get("peak_slip") is not None else ""
    least = f", least coefficient {worst['cone_least']:.3g} N" if worst.get("cone_least") is not None else ""
    text = Markup("<p><b>{}, worst run:</b> number {}, {}{}{}; again with <code>{}</code></p>").format(
        label, worst["run"], worst["outcome"], slip, least, worst.get("replay", "")
    )
    tube = own.get("tube")
    if tube:
        left = tube["left"]
        text += Markup(
            "<p><b>{}, tubes:</b> in {} of {} runs a coefficient left its first-order tube, at most by {:.3g} N "
            "(run {}). {}</p>"
        ).format(
            label,
            left["count"],
            left["of"],
            tube["worst_excess"],
            tube["worst_run"],
            LEFT_TUBES if left["count"] else "",
        )
    return text


def _paired(run: ReportedRun, campaign: dict[str, Any]) -> Markup:
    text = Markup("")
    label = {m.stem: m.label.lower() for m in run.motions}
    for pair in campaign.get("paired", []):
        held = pair["holds"]
        first, second = (label.get(pair[key], pair[key]) for key in ("first", "second"))
        text += Markup(
            "<p>On the same draws: both held {} times, only {} {}, only {} {}, neither {} "
            "(McNemar’s exact p = {:.3g}).</p>"
        ).format(held["both"], first, held["only_first"], second, held["only_second"], held["neither"], held["p_value"])
    return text


def _distribution(run: ReportedRun, column: str, title: str, label: str, units: Units) -> Spec | None:
    """Share of all runs of each motion in which a quantity is known, and at most so large."""
    values = np.asarray(run.runs.get(column, ()), dtype=float)
    finite = np.isfinite(values)
    if not finite.any():
        return None
    unit, factor = suited(float(np.abs(values[finite]).max()), units)
    curves = []
    for m in run.motions:
        made = run.runs["stem"] == m.stem
        own = np.sort(factor * values[finite & made])
        if len(own):
            curves.append(series(m, m.label, own, 100 * np.arange(1, len(own) + 1) / np.count_nonzero(made)))
    shown = {
        "title": title,
        "note": "In so many of the runs it was no larger.",
        "x": f"{label}, {unit}",
        "y": "runs, %",
    }
    return {**shown, "unit": "%", "zero": True, "series": curves}
