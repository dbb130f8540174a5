"""The page's sections: headings, tables and places for charts. A section without data is left out."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from salver.models.arm.arm_limits import LIMITS
from salver.reports.pages import charts, perturbed_runs
from salver.reports.pages.cells import NOTHING, joined, motion_cell, outcome_cell, speed_bar, table
from salver.reports.pages.words import campaign_outcomes, length, true_parameters
from salver.reports.tables import arm_usage, found_rows
from salver.wording import listed, number

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
from salver.reports.run import Record, ReportedRun

Tile = tuple[str, str, str]  # label, figure, and what is said below it


@dataclass
class Sections:
    """Sections that `build` gathers: HTML, (anchor, title) of each, chart specs by key."""

    html: Markup = NOTHING
    titles: list[tuple[str, str]] = field(default_factory=lambda: [("replay", "Replay")])
    specs: dict[str, charts.Spec] = field(default_factory=dict)

    def add(
        self,
        key: str,
        title: str,
        intro: str,
        specs: Iterable[charts.Spec] = (),
        extra: Markup = NOTHING,
        grid: str = "",
    ) -> None:
        figures = joined(self._figure(key, i, spec) for i, spec in enumerate(specs))
        if not figures and not extra:
            return
        self.titles.append((key, title))
        self.html += Markup('<section id="{}"><h2>{}</h2>').format(key, title)
        self.html += Markup("<p>{}</p>").format(intro) if intro else ""
        self.html += Markup('<div class="charts {}">{}</div>').format(grid, figures) if figures else ""
        self.html += extra + Markup("</section>\n")

    def _figure(self, key: str, number: int, spec: charts.Spec) -> Markup:
        name = f"{key}-{number}"
        self.specs[name] = spec
        return Markup(
            '<figure><figcaption>{}</figcaption><p class="note">{}</p><div class="legend"></div>'
            '<div class="plot" data-chart="{}"></div></figure>'
        ).format(spec["title"], spec.get("note", ""), name)


def build(run: ReportedRun, arm: ArmModel | None) -> Sections:
    """All sections for what the run directory has."""
    page = Sections()
    add_margins(page, run, run.plan.summary.get("speeds"))
    if run.scenario.payload.dynamic:
        page.add("inside", "What moves inside", "How near it comes to its edge.", charts.inside_charts(run))
    if run.campaign is not None:
        found, specs, extra = perturbed_runs.section(run, run.campaign)
        page.add("campaign", "Perturbed runs", found, specs, extra)
    for kind in RUNS:
        _run_section(page, run, kind)
    page.add(
        "forces",
        "Contact forces",
        "Every friction cone is spanned by its edges; Λ are the coefficients along them, in newtons. Lines: nominal. "
        "Shaded: the tube in which they stay, to first order, for every body in the uncertain set.",
        charts.cone_charts(run),
    )
    sensitivity = charts.sensitivity_charts(run)
    page.add(
        "sensitivity",
        "Sensitivity",
        "What the assumed ranges do to the closed loop of plant and controller. Smaller is more robust.",
        sensitivity,
        grid="three" if len(sensitivity) == 3 else "",
    )
    add_motion(page, run)
    if arm is not None:
        page.add(
            "arm",
            "The arm",
            _limits_in_words(arm),
            charts.clearance_charts(run, arm),
            _usage_table(run, arm),
        )
    page.add("provenance", "Task and provenance", "", extra=_provenance(run))
    return page


def add_margins(page: Sections, run: ReportedRun, speeds: Mapping[str, Any] | None) -> None:
    """speeds: as `SafeSpeeds.summary`, None where they are not known."""
    intro = f"How far {run.load} is from sliding, tipping or lifting."
    page.add("margins", "Margins", intro, charts.margin_charts(run), speed_bar(speeds))


def add_motion(page: Sections, run: ReportedRun) -> None:
    page.add("motion", "The motion", "Where the object is taken.", charts.reference_charts(run), grid="three")


def tiles(run: ReportedRun) -> list[Tile]:
    """Key numbers below the verdict."""
    plan, base = run.plan, run.compared
    shown = margin_tiles(run)
    slips = [_peak(m.simulation, "slip") for m in run.motions]
    if slips[0] is not None:
        moved = [length(slip) if slip is not None else "not run" for slip in slips]
        shown.append(("Slip in simulation", moved[0], f"{base.stem} {moved[1]}" if base is not None else ""))
    held = campaign_outcomes(run.campaign, plan.stem).get("holds")
    if held is not None:
        rate = run.campaign["plans"][plan.stem]["outcomes"]["holds"]  # type: ignore[index]
        interval = f"95 % interval {100 * rate['low']:.0f} to {100 * rate['high']:.0f} %"
        shown.append(("Perturbed runs that held", f"{held} of {rate['of']}", interval))
    return shown


def margin_tiles(run: ReportedRun) -> list[Tile]:
    """Duration and margins of the plan, beside those of what it is compared with."""
    curves, base = [run.contact[m.stem] for m in run.motions], run.compared

    def tile(label: str, values: list[float], digits: int, unit: str, of: str = "", otherwise: str = "–") -> Tile:
        said = [number(value, digits, unit, otherwise) for value in values]
        return label, said[0], " · ".join(filter(None, [of, f"{base.stem} {said[1]}" if base is not None else ""]))

    needed = [float(c.coefficient.max()) for c in curves if c.coefficient is not None]
    shown = [tile("Duration", [m.duration for m in run.motions], 2, " s")]
    if needed:
        shown.append(tile("Friction needed", needed, 3, "", f"of {curves[0].available:g}", "none suffices"))
    else:
        used = [100 * float(c.friction.max()) for c in curves]
        shown.append(tile("Friction in use", used, 0, " %", "of what there is", "more than any"))
    shown.append(tile("Left in the worst case", [100 * float(c.worst.min()) for c in curves], 1, " %", "of the weight"))
    if run.paper:
        floor = [float(m.cone_floor.min()) for m in run.motions]
        shown.append(tile("Least coefficient in its tube", floor, 3, " N"))
    tip = [1e3 * float(c.tip_worst.min()) for c in curves]
    return [*shown, tile("Tip-over margin, worst case", tip, 1, " mm", otherwise="lifts")]


RUNS = {
    "simulation": (
        "In simulation",
        "The whole arm with its controller, tray and object in the engine; peak values until an object is lost.",
    ),
    "what_if": (
        "What if",
        "A run in the physics engine with values outside the ranges that the plan was made for. It says nothing for or "
        "against the plan.",
    ),
    "execution": (
        "On the arm",
        "The control loop that drives the real arm: what it tracked.",
    ),
}


def _run_section(page: Sections, run: ReportedRun, kind: str) -> None:
    """The runs of one kind, in the physics engine or on an arm; left out when there are none."""
    records = [(m, record) for m in run.motions if (record := getattr(m, kind)) is not None]
    if not records:
        return
    rows = []
    for m, record in records:
        known = true_parameters(run, record.summary) or "nominal"
        rows.append(
            [
                motion_cell(m.stem, m.label),
                outcome_cell(record.summary.get("outcome", "unknown")),
                *("" if (peak := _peak(record, key)) is None else number(factor * peak, 2) for key, factor in _PEAKS),
                record.summary.get("source", "") if kind == "execution" else known,
            ]
        )
    last = "true parameters" if kind != "execution" else "arm"
    head = ["", "outcome", "slip, mm", "lift, mm", "tip, °", "e_p, mm", "e_o, mrad", last]
    extra = table(head, rows, numeric=range(2, 7))
    for m, record in records:
        if record.summary.get("stopped"):
            extra += Markup("<p><b>{} was stopped:</b> {}</p>").format(m.label, record.summary["stopped"])
    title, intro = RUNS[kind]
    page.add(kind, title, intro, charts.run_charts(records), extra)


_PEAKS = (("slip", 1e3), ("lift", 1e3), ("tip_angle", 180 / np.pi), ("e_p", 1e3), ("e_o", 1e3))


def _usage_table(run: ReportedRun, arm: ArmModel) -> Markup:
    usage = {m.stem: arm_usage(m, arm) for m in run.motions}
    kinds = list(next(iter(usage.values())))
    rows = []
    for j in range(arm.n):
        bars = [joined(_bar(usage[m.stem][kind][j], m.stem) for m in run.motions) for kind in kinds]
        rows.append([arm.joint_names[j], *bars])
    head = ["joint", *(f"{kind.replace('_', ' ')}, % of limit" for kind in kinds)]
    return Markup('<div style="margin-top:16px">{}</div>').format(table(head, rows))


def _bar(share: float, stem: str) -> Markup:
    if not np.isfinite(share):
        return Markup('<div class="bar {}"><span>–</span></div>').format(stem)
    near = " near" if share > 0.95 else ""
    return Markup('<div class="bar {}{}"><i><b style="width:{:.1f}%"></b></i><span>{:.0f}</span></div>').format(
        stem, near, 100 * min(share, 1.0), 100 * share
    )


def _limits_in_words(arm: ArmModel) -> str:
    """Whose limits these are, and which nobody gave."""
    given: dict[str, list[str]] = {}
    for kind in LIMITS:
        for source in dict.fromkeys(arm.limit_sources[kind.key]):
            given.setdefault(source or "", []).append(kind.name)
    nobody = given.pop("", [])
    text = f"Peak use of the limits: {'; '.join(f'{listed(kinds)} from {source}' for source, kinds in given.items())}."
    text += " Percentages in sentences are of the part that a plan may use."
    return text + (f" Nobody gave limits for {listed(nobody)}: not checked." if nobody else "")


def _provenance(run: ReportedRun) -> Markup:
    details = table(["", ""], found_rows(run))
    for name in ("scenario.toml", *(f"{m.stem}.json" for m in run.motions)):
        text = (run.directory / name).read_text(encoding="utf-8")
        details += Markup("<details><summary>{}</summary><pre>{}</pre></details>").format(name, text)
    return details


def _peak(record: Record | None, key: str) -> float | None:
    """The largest value until an object is lost, if the record says it, else of the whole curve; None without one."""
    if record is None:
        return None
    items = [item.get(f"peak_{key}") for item in record.summary.get("objects", ())]
    known = [value for value in (*items, record.summary.get(f"{key}_peak")) if value is not None]
    values = charts.record_curve(record, key)
    return max(known) if known else None if values is None else float(np.nanmax(values))
