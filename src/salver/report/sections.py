"""The page's sections: headings, tables and places for charts. What has no data is left out."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.models import wrench_cone
from salver.report import charts
from salver.report.style import OUTCOME_COLOURS, ROLE_COLOURS
from salver.report.tables import arm_usage, scenario_rows, solver_rows
from salver.report.words import length
from salver.statistics import clopper_pearson

if TYPE_CHECKING:
    from salver.models.arm import ArmModel
    from salver.report.run import Run


NAVIGATION = {
    "replay": "Replay",
    "margins": "Margins",
    "campaign": "Perturbed runs",
    "simulation": "Simulation",
    "forces": "Contact forces",
    "sensitivity": "Sensitivity",
    "motion": "Motion",
    "arm": "Arm",
    "provenance": "Task and provenance",
}


@dataclass
class Sections:
    """What `build` gathers: HTML, (anchor, title) of each section, chart specs by key."""

    html: str = ""
    titles: list[tuple[str, str]] = field(default_factory=lambda: [("replay", NAVIGATION["replay"])])
    specs: dict[str, charts.Spec] = field(default_factory=dict)

    def add(
        self, key: str, title: str, intro: str, specs: Iterable[charts.Spec] = (), extra: str = "", grid: str = ""
    ) -> None:
        figures = "".join(self._figure(key, i, spec) for i, spec in enumerate(specs))
        if not figures and not extra:
            return
        self.titles.append((key, NAVIGATION[key]))
        self.html += f'<section id="{key}"><h2>{escape(title)}</h2>'
        self.html += f"<p>{escape(intro)}</p>" if intro else ""
        self.html += f'<div class="charts {grid}">{figures}</div>' if figures else ""
        self.html += extra + "</section>\n"

    def _figure(self, key: str, number: int, spec: charts.Spec) -> str:
        name = f"{key}-{number}"
        self.specs[name] = spec
        note = f'<p class="note">{escape(spec["note"])}</p>' if spec.get("note") else ""
        return (
            f'<figure><figcaption>{escape(spec["title"])}</figcaption>{note}<div class="legend"></div>'
            f'<div class="plot" data-chart="{name}"></div></figure>'
        )


def build(run: Run, arm: ArmModel | None) -> Sections:
    """All sections for what the run directory has."""
    page = Sections()
    name = run.bodies[0].name
    page.add(
        "margins",
        "Margins",
        f"Four views of how close the {name} comes to sliding, tipping or lifting along the nominal motion.",
        charts.margin_charts(run),
    )
    _campaign(page, run)
    _simulation(page, run)
    page.add(
        "forces",
        "Contact forces and their tubes",
        "Every friction cone is spanned by its edges; Λ are the coefficients along them, in newtons. Lines: nominal. "
        "Shaded: the tube in which they stay, to first order, for every body in the uncertain set.",
        charts.cone_charts(run),
    )
    page.add(
        "sensitivity",
        "Sensitivity to what is not known",
        "What the assumed ranges do to the closed loop of plant and controller. Smaller is more robust.",
        charts.sensitivity_charts(run),
        grid="three",
    )
    motion = charts.reference_charts(run)
    page.add("motion", "The motion", "Where the object is taken.", motion, grid="three")
    if arm is not None:
        page.add(
            "arm",
            "Joint motion against limits",
            f"Peak use of what the maker of the {arm.name} allows.",
            charts.joint_charts(run, arm.limits),
            _usage_table(run, arm),
        )
    page.add("provenance", "What was asked, and what made this", "", extra=_provenance(run))
    return page


def tiles(run: Run) -> str:
    """Key numbers below the verdict."""
    plan, body = run.plan, run.bodies[0]
    base = run.motion("baseline")
    needed = [float(np.max(wrench_cone.friction_needed(body.contacts, m.arrays["wrench_B"]))) for m in run.motions]
    floor = [float(m.cone_floor.min()) for m in run.motions]
    tip = [1e3 * float(np.min(wrench_cone.tip_over_margin(body.contacts, m.arrays["wrench_B"]))) for m in run.motions]

    def versus(values: list[float], digits: int, unit: str = "") -> str:
        return f"baseline {_number(values[1], digits)}{unit}" if base is not None else ""

    shown = [
        ("Duration", f"{plan.duration:.2f} s", versus([m.duration for m in run.motions], 2, " s")),
        (
            "Friction needed",
            _number(needed[0], 3),
            f"of {body.friction:g} · " + versus(needed, 3) if base else f"of {body.friction:g}",
        ),
        ("Least coefficient with tube", f"{_number(floor[0], 3)} N", versus(floor, 3, " N")),
        ("Tip-over margin", f"{_number(tip[0], 1)} mm", versus(tip, 1, " mm")),
    ]
    slips = [charts.record_curve(m, "slip") for m in run.motions]
    if slips[0] is not None:
        moved = [length(float(np.max(s))) if s is not None else "not run" for s in slips]
        shown.append(("Slip in simulation", moved[0], f"baseline {moved[1]}" if len(moved) > 1 else ""))
    if run.campaign is not None:
        held = run.campaign["plans"].get(plan.stem, {}).get("outcomes", {}).get("holds")
        if held:
            shown.append(
                (
                    "Perturbed runs that held",
                    f"{held['count']} of {held['of']}",
                    f"true rate {_percent(held['low'])}–{_percent(held['high'])} (95 %)",
                )
            )
    solver = plan.summary.get("solver") or {}
    seconds = solver.get("seconds")
    if isinstance(seconds, int | float):
        shown.append(
            (
                "Planned in",
                f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.3g} s",
                str(solver.get("name", "")),
            )
        )
    return "".join(
        f"<div><dt>{escape(a)}</dt><dd>{escape(b)}<small>{escape(c)}</small></dd></div>" for a, b, c in shown
    )


def _simulation(page: Sections, run: Run) -> None:
    specs = charts.simulation_charts(run)
    if not specs:
        return
    rows = []
    for m in run.motions:
        if m.simulation is None:
            continue
        summary = m.simulation.summary
        changed = summary.get("parameters") or {}
        rows.append(
            [
                f'<span class="dot" style="background:{ROLE_COLOURS[m.stem]}"></span>{escape(m.label)}',
                _outcome(str(summary.get("outcome", "unknown"))),
                *(
                    _peak(m, key, factor)
                    for key, factor in (
                        ("slip", 1e3),
                        ("lift", 1e3),
                        ("tip_angle", 180 / np.pi),
                        ("e_p", 1e3),
                        ("e_o", 1e3),
                    )
                ),
                escape(", ".join(f"{k} = {v:.4g}" for k, v in changed.items()) or "nominal"),
            ]
        )
    head = ["", "outcome", "slip, mm", "lift, mm", "tip, °", "e_p, mm", "e_o, mrad", "true parameters"]
    extra = table(head, rows, numeric=range(2, 7))
    page.add(
        "simulation",
        "In simulation",
        "The whole arm with its controller, tray and object in the physics engine; peak values.",
        specs,
        extra,
    )


def _campaign(page: Sections, run: Run) -> None:
    if run.campaign is None:
        return
    plans = run.campaign["plans"]
    rows = []
    for m in run.motions:
        own = plans.get(m.stem)
        if own is None:
            continue
        for i, (word, rate) in enumerate(own["outcomes"].items()):
            interval = clopper_pearson(int(rate["count"]), int(rate["of"]))
            label = (
                f'<span class="dot" style="background:{ROLE_COLOURS[m.stem]}"></span>{escape(m.label)}'
                if i == 0
                else ""
            )
            rows.append(
                [
                    label,
                    _outcome(word),
                    f"{interval.count} of {interval.total}",
                    _percent(interval.value),
                    f"{_percent(interval.low)} to {_percent(interval.high)}",
                ]
            )
    left = table(["", "outcome", "runs", "rate", "95 % interval (Clopper–Pearson)"], rows, numeric=(2, 3))
    worst = "".join(_worst(m.label, plans[m.stem]["worst_run"]) for m in run.motions if m.stem in plans)
    extra = f'<div class="columns" style="margin-top:14px"><div>{left}</div><div>{worst}{_paired(run)}</div></div>'
    specs = [
        spec
        for spec in (
            _histogram(run, "slip_peak", 1e3, "Largest slip in each run", "slip, mm"),
            _histogram(run, "e_p_peak", 1e3, "Largest position error in each run", "e_p, mm"),
        )
        if spec
    ]
    if not specs:
        specs = [
            spec
            for spec in (_histogram(run, "cone_least", 1.0, "Least cone coefficient in each run", "min Λ, N"),)
            if spec
        ]
    total = max(int(own["runs"]) for own in plans.values())
    page.add(
        "campaign",
        "Perturbed runs",
        f"{total} runs with parameters drawn from the uncertain set, the same draws for each motion.",
        specs,
        extra,
    )


def _worst(label: str, worst: dict[str, Any]) -> str:
    slip = f", slip {1e3 * worst['slip_peak']:.3g} mm" if worst.get("slip_peak") is not None else ""
    least = f", least coefficient {worst['cone_least']:.3g} N" if worst.get("cone_least") is not None else ""
    return (
        f"<p><b>Worst run, {escape(label.lower())}:</b> number {worst['run']}, "
        f"{escape(str(worst['outcome']))}{slip}{least}.<br>"
        f"<code>{escape(str(worst.get('replay', '')))}</code></p>"
    )


def _paired(run: Run) -> str:
    text = ""
    for pair in (run.campaign or {}).get("paired", []):
        held = pair["holds"]
        text += (
            f"<p><b>On the same draws:</b> both held {held['both']} times, "
            f"only {escape(pair['first'])} {held['only_first']}, only {escape(pair['second'])} {held['only_second']}, "
            f"neither {held['neither']} "
            f"(McNemar's exact p = {held['p_value']:.3g}).</p>"
        )
    return text


def _histogram(run: Run, column: str, factor: float, title: str, label: str) -> charts.Spec | None:
    if column not in run.runs:
        return None
    values = factor * run.runs[column].astype(float)
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    low, high = float(finite.min()), float(finite.max())
    edges = np.linspace(
        min(0.0, low) if low < 0.5 * high else low, high if high > low else low + max(abs(low), 1e-6), 25
    )
    groups = [
        {
            "name": m.label,
            "colour": ROLE_COLOURS[m.stem],
            "counts": np.histogram(values[(run.runs["stem"] == m.stem) & np.isfinite(values)], edges)[0].tolist(),
        }
        for m in run.motions
        if np.any(run.runs["stem"] == m.stem)
    ]
    key = " · ".join(f"{g['name']}: {sum(g['counts'])} runs" for g in groups)
    return {
        "title": title,
        "note": key,
        "x": label,
        "y": "runs",
        "edges": [float(f"{e:.5g}") for e in edges],
        "groups": groups,
        "series": [],
    }


def _usage_table(run: Run, arm: ArmModel) -> str:
    usage = {m.stem: arm_usage(m, arm) for m in run.motions}
    kinds = list(next(iter(usage.values())))
    rows = []
    for j in range(arm.n):
        cells = [escape(arm.joint_names[j])]
        for kind in kinds:
            cells.append("".join(_bar(usage[m.stem][kind][j], m.stem) for m in run.motions))
        rows.append(cells)
    return (
        '<div style="margin-top:16px">' + table(["joint", *(f"{kind}, % of limit" for kind in kinds)], rows) + "</div>"
    )


def _bar(share: float, stem: str) -> str:
    near = " near" if share > 0.95 else ""
    width = f"{100 * min(share, 1.0):.1f}"
    return f'<div class="bar {stem}{near}"><i><b style="width:{width}%"></b></i><span>{100 * share:.0f}</span></div>'


def _provenance(run: Run) -> str:
    left = table(["asked", ""], [[escape(a), escape(b)] for a, b in scenario_rows(run)])
    right = table(["computed", ""], [[escape(a), escape(b)] for a, b in solver_rows(run)])
    details = ""
    for name in ("scenario.toml", *(f"{m.stem}.json" for m in run.motions)):
        text = (run.directory / name).read_text(encoding="utf-8")
        details += f"<details><summary>{name}</summary><pre>{escape(text)}</pre></details>"
    return f'<div class="columns"><div>{left}</div><div>{right}</div></div>{details}'


def table(head: Iterable[str], rows: Iterable[Iterable[str]], numeric: Iterable[int] = ()) -> str:
    """HTML table; cells are HTML already, headings are text; columns of `numeric` are set right."""
    right = set(numeric)
    style = [' class="n"' if i in right else "" for i in range(64)]
    top = "".join(f"<th{style[i]}>{escape(cell)}</th>" for i, cell in enumerate(head))
    body = "".join(
        "<tr>" + "".join(f"<td{style[i]}>{cell}</td>" for i, cell in enumerate(row)) + "</tr>" for row in rows
    )
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def _peak(m: Any, key: str, factor: float) -> str:
    values = charts.record_curve(m, key)
    return "" if values is None else _number(factor * float(np.max(values)), 2)


def _outcome(word: str) -> str:
    return f'<span class="dot" style="background:{OUTCOME_COLOURS.get(word, "#7a8490")}"></span>{escape(word)}'


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}".replace("-", "−") if np.isfinite(value) else "none would do"
