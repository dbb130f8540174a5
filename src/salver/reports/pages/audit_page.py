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
from salver.files import to_json, versions
from salver.geometry import Array, interpolated, spread
from salver.motion_files.samples import reordered
from salver.planning.plan import Plan
from salver.reports.contact import curves_of
from salver.reports.pages.cells import table
from salver.reports.pages.page import filled, replay
from salver.reports.pages.sections import Sections, add_margins, add_motion, margin_tiles
from salver.reports.pages.words import Headline
from salver.reports.parameters import ranges
from salver.reports.run import ReportedMotion, ReportedRun
from salver.trajectory import SampledReference

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel

HEADLINES = {
    "holds": ("good", "Everything stays where it is, whatever is carried within its ranges"),
    "cannot_tell": ("warning", "It cannot be told whether everything stays"),
    "does_not_hold": ("bad", "Not everything stays where it is"),
}


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
    factor = audit.speeds_worst.pace.details["factor"]
    held = "no time" if factor is None else f"{factor:.3f}"
    shown = replay(run, arm)
    for variant in shown["variants"]:
        variant["caption"] = "as it was read"
    return filled(
        answer,
        _sections(audit, run),
        shown,
        name=f"{Path(audit.source).name} with the load of {audit.scenario.name}",
        asked=f"A motion of {float(np.ptp(audit.motion.samples.t)):.2f} s that is given, with {run.load} on the tray.",
        notes=audit.motion.notes,
        tiles=[*margin_tiles(run), ("It would just hold in", held, "of its time, in the worst case")],
        source=audit.source,
        scenarios=[audit.scenario],
    )


def _sections(audit: Audit, run: ReportedRun) -> Sections:
    page = Sections()
    add_margins(page, run, audit.speeds_worst.summary())
    add_motion(page, run)
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
    details = Markup("<details><summary>{}</summary><pre>{}</pre></details>")
    return table(["", ""], rows) + details.format("all figures", to_json(audit.summary()))


def _run(audit: Audit) -> tuple[ReportedRun, ArmModel | None]:
    """What the replay draws: the load at rest on the tray along the motion, and the arm where its joints are known."""
    scenario = audit.scenario
    first = scenario.payload.first
    samples = audit.motion.samples.of_frame(first.p_EB, first.R_EB)
    thinned = samples.only(spread(len(samples.t), 4001)).distinct()
    plan = Plan(scenario, "given", SampledReference(thinned), Status("given", audit.source, True))
    arrays: dict[str, Array] = dict(plan.arrays())
    arm, joints = None, audit.joints
    if joints is not None and scenario.arm is not None:
        arm = scenario.load_arm()
        q = reordered(joints, arm.joint_names).q
        arrays["q"] = interpolated(joints.t, q, arrays["t"])
    summary: Mapping[str, Any] = {"ok": audit.ok, "method": "given", "thinned": len(thinned.t) < len(samples.t)}
    motion = ReportedMotion("plan", arrays, dict(summary))
    curves = {"plan": curves_of(audit.margins, audit.margins.exact_worst)}
    return ReportedRun(Path(audit.source), scenario, [motion], margins=curves), arm
