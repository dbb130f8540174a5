"""The page of a task of several legs: the legs side by side; each has a page of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from salver.planning.plan_files import PlanFiles
from salver.reports.pages.cells import outcome_cell, percent, table
from salver.reports.pages.sections import Sections, Tile
from salver.reports.pages.words import Headline, campaign_outcomes, of_campaign
from salver.reports.run import ReportedRun
from salver.scenario import Scenario
from salver.wording import listed


def overview(
    files: PlanFiles, runs: Sequence[ReportedRun], places: Sequence[Path], campaign: dict[str, Any] | None
) -> tuple[Headline, Sections, str, list[Tile]]:
    """Content of the page of the task: verdict, sections, task, tiles. places: the pages of the legs."""
    scenario, record = files.scenario, files.record
    runs_of = campaign_outcomes(campaign, "plan")
    made = Sections()
    rows = []
    for k, (run, place, leg) in enumerate(zip(runs, places, scenario.legs, strict=True), 1):
        x, y, z = leg.goal.position
        seen = run.plan.simulation
        rows.append(
            (
                Markup('<a href="{}">leg {}</a>').format(quote(place.name), k),
                listed([item.name for item in run.scenario.objects]),
                f"({x:.3f}, {y:.3f}, {z:.3f}) m" + (f", through {len(leg.through)} poses" if leg.through else ""),
                leg.handling if leg.taken or leg.added else "–",
                f"{run.plan.duration:.3f} s",
                percent(float(run.contact["plan"].worst.min())),
                "yes" if run.plan.summary.get("ok") else "NO",
                outcome_cell(seen.summary.get("outcome", "unknown")) if seen is not None else "not run",
            )
        )
    head = ("", "on the tray", "to", "then", "duration", "left in the worst case", "safe, as far as checked", "engine")
    made.add("legs", "Legs", "", extra=table(head, rows, (4, 5)))
    if runs_of:
        total = sum(runs_of.values())
        outcomes = [(outcome_cell(word), f"{count} of {total}") for word, count in runs_of.items()]
        intro = "The same true objects on all legs of a run; a run is called by its worst leg."
        made.add("campaign", "Perturbed runs of all legs", intro, extra=table(("outcome", "runs"), outcomes, (1,)))
    told = [(f"leg {k}", part["status"]["sentence"]) for k, part in enumerate(record["legs"], 1)]
    found = table(("", "status"), [("all", record["status"]["sentence"]), *told])
    made.add("provenance", "What was found", "", extra=found)
    least = min(float(run.contact["plan"].worst.min()) for run in runs)
    tiles = [
        ("Duration", f"{record['duration']:.2f} s", "of all legs, without stops"),
        ("Legs", str(len(runs)), ""),
        ("Left in the worst case", percent(least), "of the weight, on the leg with the least"),
    ]
    return _verdict(record, runs, runs_of), made, _asked(scenario, record), tiles


def _verdict(record: dict[str, Any], runs: Sequence[ReportedRun], outcomes: dict[str, int]) -> Headline:
    """Campaign before simulation before plan, as for one leg."""
    if not record["ok"]:
        return Headline("bad", "No safe plan of all legs was found", record["status"]["sentence"])
    blind = f"Not checked: {'; '.join(record['unchecked'])}." if record["unchecked"] else ""
    if outcomes:
        return of_campaign("On all legs the load", outcomes, blind)
    seen = [run.plan.simulation.summary.get("outcome") if run.plan.simulation else None for run in runs]
    wrong = [f"leg {k}: {word}" for k, word in enumerate(seen, 1) if word not in (None, "holds")]
    if wrong:
        return Headline("bad", f"In simulation the load did not stay put ({listed(wrong)})", blind)
    if all(seen):
        return Headline("good", "The load stays put on all legs, in theory and in simulation", blind)
    return Headline("good", "The load is predicted to stay put on all legs for every parameter assumed", blind)


def _asked(scenario: Scenario, record: dict[str, Any]) -> str:
    names = listed([item.name for item in scenario.objects])
    return (
        f"{scenario.summary + '. ' if scenario.summary else ''}{len(scenario.legs)} legs with {names}, from rest to "
        f"rest, in {record['duration']:.2f} s together; stops take their time."
    )
