"""A scenario and its results in words: sentences for the top of the page."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.geometry import log
from salver.reports.parameters import pretty, quantity, ranges
from salver.wording import listed

if TYPE_CHECKING:
    from salver.reports.run import ReportedRun


@dataclass(frozen=True)
class Headline:
    """The answer in one line. level: "good", "warning" or "bad"."""

    level: str
    headline: str
    detail: str


def verdict(run: ReportedRun) -> Headline:
    """Campaign before simulation before plan: the strongest evidence there is decides."""
    plan, load = run.plan, run.load[0].upper() + run.load[1:]
    several = len(run.bodies) > 1
    if not plan.summary.get("ok", True):
        return Headline("bad", "No safe plan was found", str(plan.summary.get("verdict", "")).removeprefix("UNSAFE: "))
    blind = plan.summary.get("unchecked", [])
    said = [
        f"Not checked: {'; '.join(blind)}." if blind else "",
        "" if run.scenario.uncertain.size else "For exactly these values.",
        plan.summary.get("stops", {}).get("sentence", ""),
    ]
    detail = " ".join(filter(None, said))
    outcomes = campaign_outcomes(run.campaign, plan.stem)
    if outcomes:
        return of_campaign(load, outcomes, detail)
    if plan.simulation is not None:
        outcome = str(plan.simulation.summary.get("outcome", "unknown"))
        true = true_parameters(run, plan.simulation.summary)
        true = f" with {true}" if true else ""
        if outcome == "holds":
            stay = "stay" if several else "stays"
            return Headline("good", f"{load} {stay} put, in theory and in simulation{true}", detail)
        which = plan.simulation.summary.get("worst_object", run.bodies[0].name)
        what = {"limit": "the arm broke its limits", "lost": f"the {which} left the tray"}.get(
            outcome, f"the {which} {outcome}"
        )
        return Headline("bad", f"In simulation{true} {what}", detail)
    verb = "are" if several else "is"
    return Headline("good", f"{load} {verb} predicted to stay put for every parameter in the assumed range", detail)


def of_campaign(load: str, outcomes: Mapping[str, int], promise: str) -> Headline:
    """The answer of perturbed runs. outcomes: number of runs of each."""
    total, held = sum(outcomes.values()), outcomes.get("holds", 0)
    level = "good" if held == total else "warning" if held > total / 2 else "bad"
    count = f"all {total}" if held == total else f"{held} of {total}"
    others = ", ".join(f"{n} {word}" for word, n in outcomes.items() if word != "holds" and n)
    detail = f"The others: {others}. {promise}" if others else promise
    return Headline(level, f"{load} stayed put in {count} perturbed runs", detail)


def campaign_outcomes(campaign: Mapping[str, Any] | None, stem: str) -> dict[str, int]:
    """Outcome to number of runs of one motion; empty without a campaign."""
    known = {} if campaign is None else campaign["plans"].get(stem, {}).get("outcomes", {})
    return {word: int(rate["count"]) for word, rate in known.items()}


def asked(run: ReportedRun) -> str:
    """The task in a sentence or two."""
    s, plan = run.scenario, run.plan
    start, goal = (np.array(p.position) for p in (s.motion.start, s.motion.goal))
    far, across = float(np.linalg.norm(goal - start)), goal - start
    turned = np.rad2deg(np.linalg.norm(log(s.motion.start.rotation.T @ s.motion.goal.rotation)))
    what = " and ".join(_thing(run, i) for i in range(len(s.objects)))
    carrier = f"The arm {Path(s.arm.model).stem}" if s.arm else "A tray"
    rim = f" with a rim of {100 * s.tray.rim_height:.3g} cm" if s.tray.rim else ""
    parts = [f"{abs(across[i]):.2f} m along {axis}" for i, axis in enumerate("xyz") if abs(across[i]) > 5e-3]
    text = (
        f"{carrier} carries {what}, loose on a {s.tray.size[0] * 100:.0f} × {s.tray.size[1] * 100:.0f} cm tray{rim}, "
        f"{far:.2f} m far ({', '.join(parts) or 'on the spot'}) from rest to rest in {plan.duration:.2f} s"
    )
    if turned > 0.05:
        text += f", turning it by {turned:.0f}°"
    if s.obstacles and s.arm:
        text += f", clear of {listed([f'the {obstacle.name}' for obstacle in s.obstacles])}"
    does = plan.summary.get("extent", {}).get("sentence", "")
    return f"{text}. {_unknown(run)} {does}".rstrip()


def _thing(run: ReportedRun, i: int) -> str:
    item = run.scenario.objects[i]
    shape = item.shape
    size = {
        "box": lambda: " × ".join(f"{100 * x:.3g}" for x in shape.size) + " cm",  # type: ignore[union-attr]
        "cylinder": lambda: f"radius {100 * shape.radius:.3g} cm, height {100 * shape.height:.3g} cm",  # type: ignore[union-attr]
        "cone": lambda: (
            f"radius {100 * shape.radius:.3g} to {100 * shape.top_radius:.3g} cm, "  # type: ignore[union-attr]
            f"height {100 * shape.height:.3g} cm"  # type: ignore[union-attr]
        ),
    }.get(shape.type, lambda: f"{100 * run.bodies[i].solid.height:.3g} cm high")()
    where = ", against the rim" if item.sides else ""
    return f"the {item.name} ({size}, {1e3 * item.mass:.4g} g, friction {item.friction:g}{where})"


def _unknown(run: ReportedRun) -> str:
    uncertain = run.scenario.payload.uncertain
    if not uncertain.size:
        return "Everything about it is taken as known."
    return f"Not known exactly: {listed([f'{name} ±{half}' for name, _, half in ranges(uncertain)])}."


def outcome_in_words(outcome: str) -> str:
    """For a caption: "holds", "slides", "joint limits broken"."""
    return {"limit": "joint limits broken", "lost": "left the tray"}.get(outcome, outcome)


def true_parameters(run: ReportedRun, summary: Mapping[str, Any]) -> str:
    """Parameters of a run that were not nominal: "friction 0.09", or nothing."""
    said = []
    for name, value in (summary.get("parameters") or {}).items():
        p, known = run.parameter(name), ""
        if name in (summary.get("outside") or {}):
            ends = summary["outside"][name]
            known = " (taken as known exactly by the plan)"
            if ends is not None:
                known = f" (outside its range, {' to '.join(quantity(p, x) for x in ends)})"
        said.append(f"{pretty(p)} {quantity(p, value)}{known}")
    return ", ".join(said)


def length(metres: float) -> str:
    """A small length in the unit that suits it."""
    return f"{1e3 * metres:.3g} mm" if abs(metres) >= 1e-4 else f"{1e6 * metres:.2g} µm"
