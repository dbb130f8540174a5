"""The page of an audit: the verdict on a motion that somebody else made, its margins, and the motion itself."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from salver.auditing import Audit
from salver.errors import Status
from salver.files import output_file, to_json, versions, write_atomic
from salver.geometry import Array, interpolated, spread
from salver.motion_files import JointSamples
from salver.motion_files.samples import reordered
from salver.planning.plan import Plan
from salver.reports.pages.cells import table
from salver.reports.pages.charts import curve, time_chart
from salver.reports.pages.page import filled, replay
from salver.reports.pages.sections import Sections, tile_list
from salver.reports.pages.speed_bar import speed_bar
from salver.reports.pages.words import Headline
from salver.reports.parameters import ranges
from salver.reports.run import ReportedMotion, ReportedRun
from salver.reports.style import BLUE, VERMILION
from salver.trajectory import SampledReference
from salver.wording import number

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel

HEADLINES = {
    "holds": ("good", "Everything stays where it is, whatever is carried within its ranges"),
    "cannot_tell": ("warning", "It cannot be told whether everything stays"),
    "does_not_hold": ("bad", "Not everything stays where it is"),
}


def write_audit_page(audit: Audit, path: str | Path) -> Path:
    """Write the page of an audit. Another file that stands at `path` is kept, numbered. Raises SalverError."""
    target = output_file(path, (".html", ".htm"))
    return write_atomic(target, audit_page(audit), keep=True)


def audit_page(audit: Audit) -> str:
    """The whole page as text."""
    run, arm = _run(audit)
    level, headline = HEADLINES[audit.outcome]
    if audit.outcome == "does_not_hold" and audit.nominal.ok:
        headline = "It holds for the nominal load, and not for everything that it may be"
    if audit.outcome == "holds" and not audit.arm.ok:
        level, headline = "bad", "The load would stay where it is, but the arm cannot go this way"
    sentence = audit.worst.sentence if audit.nominal.ok else audit.nominal.sentence
    answer = Headline(level, headline, f"{audit.arm.sentence} {sentence}")
    shown = replay(run, arm)
    for variant in shown["variants"]:
        variant["caption"] = "as it was read"
    return filled(
        answer,
        _sections(audit),
        shown,
        name=f"{Path(audit.source).name} with the load of {audit.scenario.name}",
        asked=f"A motion of {float(np.ptp(audit.motion.samples.t)):.2f} s that is given, with {run.load} on the tray.",
        notes=audit.motion.notes,
        tiles=_tiles(audit),
        source=audit.source,
        scenarios=[audit.scenario],
    )


def _tiles(audit: Audit) -> Markup:
    margins, (nominal, worst) = audit.margins, audit.reserves
    tight = max(margins.interfaces, key=lambda m: m.friction_needed_worst / m.friction)
    shown = [
        ("Duration", f"{float(np.ptp(audit.motion.samples.t)):.2f} s", ""),
        (
            "Friction needed",
            number(float(tight.friction_needed.max()), 3, otherwise="none suffices"),
            f"of {tight.friction:g} · worst case {number(tight.friction_needed_worst, 3, otherwise='none suffices')}",
        ),
        (
            "Left in the worst case",
            f"{100 * float(worst.min()):.1f} %",
            f"of the weight · nominal {100 * float(nominal.min()):.1f} %",
        ),
        (
            "Tip-over margin, worst case",
            number(1e3 * min(float(m.tip_over_worst.min()) for m in margins.interfaces), 1, " mm", "lifts"),
            "",
        ),
    ]
    factor = audit.speeds_worst.pace.details["factor"]
    shown.append(
        ("It would just hold in", "no time" if factor is None else f"{factor:.3f}", "of its time, in the worst case")
    )
    return tile_list(shown)


def _sections(audit: Audit) -> Sections:
    page, s, margins = Sections(), audit.motion.samples, audit.margins
    nominal, worst = audit.reserves
    zero = {"y": 0, "label": ""}
    friction, tip = [], []
    for k, m in enumerate(margins.interfaces):
        faint = {} if k == 0 else {"opacity": 0.5}
        friction.append(curve(m.name, BLUE, margins.t, np.minimum(m.friction_needed, 5.0), **faint))
        tip.append(curve(f"{m.name}, worst case", BLUE, margins.t, 1e3 * m.tip_over_worst, **faint))
        tip.append(curve(f"{m.name}, nominal", VERMILION, margins.t, 1e3 * m.tip_over, **faint))
    lines = [{"y": m.friction, "label": f"there is {m.friction:g}"} for m in margins.interfaces[:1]]
    charts = [
        time_chart(
            "Distance to sliding, tipping or lifting",
            "margin, % of the weight",
            [
                curve("worst case", BLUE, s.t, 100 * worst),
                curve("nominal", VERMILION, s.t, 100 * nominal, width=1.0, opacity=0.7),
            ],
            "How far inside its contact wrench cone the required wrench stays: above zero it sticks.",
            "%",
            lines=[zero],
        ),
        time_chart("Friction needed", "coefficient", friction, "Nominal. Below the line it sticks.", lines=lines),
        time_chart("Distance to tipping", "mm", tip, "Of the zero-moment point to the edge.", "mm", lines=[zero]),
        time_chart(
            "The tray",
            "m/s, m/s²",
            [
                curve("acceleration", BLUE, s.t, np.linalg.norm(s.a_S, axis=1)),
                curve("speed", VERMILION, s.t, np.linalg.norm(s.v_S, axis=1)),
            ],
            "As the audit understands the motion.",
        ),
    ]
    page.add(
        "margins",
        "Margins",
        "How near the motion comes to moving what it carries.",
        charts,
        speed_bar(audit.speeds_worst.summary()),
    )
    page.add("known", "How the motion is known", "", extra=_known(audit))
    return page


def _known(audit: Audit) -> Markup:
    seen = audit.motion.recording
    widths = [[f"± {name}", half] for name, _, half in ranges(audit.scenario.payload.uncertain)]
    rows = [
        ["read from", audit.source],
        ["judged", f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, by salver {versions()['salver']}"],
        ["for", f"scenario {audit.scenario.name}, digest {audit.scenario.digest}"],
        *(widths or [["ranges", "none: the nominal values alone"]]),
        ["arm", audit.arm.sentence],
        ["nominal", audit.nominal.sentence],
        ["worst case", audit.worst.sentence],
    ]
    if seen is None:
        rows.append(["samples", "a command: known exactly"])
    else:
        rows.append(["samples", f"{seen.rate:.4g} a second, noise of {1e3 * seen.sensor.displacement:.2g} mm"])
        rows.append(
            ["reckoned with", f"shakes of up to {audit.motion.options.highest:g} Hz that the samples do not show"]
        )
    rows += [[f"what {name} costs", f"{100 * cost:.1f} % of the weight"] for name, cost in audit.costs.items()]
    rows.append(["speeds, worst case", audit.speeds_worst.sentence])
    rows.append(["pace, worst case", audit.speeds_worst.pace.sentence])
    details = Markup("<details><summary>{}</summary><pre>{}</pre></details>")
    return table(["", ""], rows) + details.format("all figures", to_json(audit.summary()))


def _run(audit: Audit) -> tuple[ReportedRun, ArmModel | None]:
    """What the replay draws: the load at rest on the tray along the motion, and the arm where its joints are known."""
    scenario = audit.scenario
    first = scenario.payload.first
    samples = audit.motion.samples.of_frame(first.p_EB, first.R_EB)
    keep = spread(len(samples.t), 4001)
    keep = keep[np.diff(samples.t[keep], prepend=-np.inf) > 1e-6]
    thinned = samples.only(keep)
    plan = Plan(scenario, "given", SampledReference(thinned), Status("given", audit.source, True))
    arrays: dict[str, Array] = dict(plan.arrays())
    arm, joints = None, audit.given
    if isinstance(joints, JointSamples) and scenario.arm is not None:
        from salver.models.arm.arm import load_arm

        arm = load_arm(scenario.arm, scenario.tray)
        q = reordered(joints, arm.joint_names).q
        arrays["q"] = interpolated(joints.t, q, arrays["t"])
    summary: Mapping[str, Any] = {"ok": audit.ok, "method": "given", "thinned": len(keep) < len(samples.t)}
    return ReportedRun(Path(audit.source), scenario, [ReportedMotion("plan", arrays, dict(summary))]), arm
