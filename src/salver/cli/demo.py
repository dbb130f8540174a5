"""`salver demo`: all of it on the paper's scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from salver.cli.common import Json, print_json, result_console, say

SCENARIO = "panda-cube"


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Run directory to make.")] = Path("out/panda-cube"),
    n: Annotated[int, typer.Option("-n", "--runs", min=1, help="Perturbed runs of each plan.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the perturbed parameters.")] = 0,
    json: Json = False,
) -> None:
    """Carry the paper's cube: plan it, run it perturbed with and without a physics engine, draw and report it.

    Stopped half way, the same command goes on where it was.

    Example: `salver demo -o out/panda-cube`
    """
    from salver import scenario as scenarios
    from salver.planning.make import plan_pair
    from salver.planning.plan import load_plan
    from salver.report.figures import write_figures
    from salver.report.page import write_report
    from salver.simulation.physics import simulate

    chosen = scenarios.load(SCENARIO)
    _head(1, "Plan: the robust trajectory, and the straight line it is compared with")
    plan, baseline = plan_pair(chosen)
    plan.save(out)
    baseline.save(out, "baseline")
    if not json:
        from salver.cli.plan import show

        show(plan, baseline)

    _head(2, f"Physics: arm, tray and loose cube; {n} runs of each plan with the cube's mass perturbed")
    for stem in ("plan", "baseline"):
        simulate(load_plan(out, stem)).save(out, stem)
    summary = _campaign(out, n, seed, json)

    _head(3, f"Figures, with {n} perturbed closed loops without an engine, and the report page")
    figures = write_figures(out, "png", n, seed, say=say)
    page = write_report(out)
    if json:
        print_json({"directory": out, "plan": plan.summary(), "campaign": summary, "figures": figures, "page": page})
        return
    console = result_console()
    console.print(_in_words(summary, n))
    console.print(f"Report: {page} (open it in a browser: replay, margins, campaign)")
    console.print(f"Figures of the paper, redrawn: {out / 'figures'}")
    console.print(
        "Next: salver plan panda-cube --fastest -o out/fastest, or a scenario of your own (docs/tutorial.md)."
    )


def _campaign(out: Path, n: int, seed: int, quiet: bool) -> dict[str, Any]:
    from salver.campaign import run_campaign
    from salver.cli.campaign import progress_bar, show

    with progress_bar() as progress:
        summary: dict[str, Any] = run_campaign(out, n, seed, progress=progress).summary
    if not quiet:
        show(summary)
    return summary


def _head(number: int, text: str) -> None:
    say(f"\n[{number}/3] {text}")


def _in_words(summary: dict[str, Any], n: int) -> str:
    """The campaign's outcome in one sentence for someone who has not read the paper."""
    held = {stem: plan["outcomes"].get("holds", {"count": 0})["count"] for stem, plan in summary["plans"].items()}
    counts = " and ".join(f"{count} of {n} with the {_NAMES.get(stem, stem)}" for stem, count in held.items())
    return f"\nThe cube stayed on the tray in {counts}."


_NAMES = {"plan": "robust plan", "baseline": "straight line"}
