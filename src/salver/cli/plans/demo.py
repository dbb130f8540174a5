"""`salver demo`: the paper's experiment, and a load for which planning for its ranges matters."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from salver.cli.common import Json, print_json, result_console, say
from salver.cli.progress import step

if TYPE_CHECKING:
    from salver.campaigns.engine import Campaign
    from salver.planning.plan import Plan

PAPER, BOTTLE = "panda-cube", "panda-tall-bottle"
BOTTLE_SHARE = 5  # the bottle has a fifth of the runs, because its plans differ by far more than a few per cent
STEPS = 4


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Directory for the two run directories.")] = Path("out/demo"),
    n: Annotated[int, typer.Option("-n", "--runs", min=1, help="Perturbed runs of each of the paper's plans.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the perturbed parameters.")] = 0,
    json: Json = False,
) -> None:
    """Run the paper's whole experiment, and a case where planning for ranges matters: a tall bottle at top speed.

    If it is interrupted, the same command resumes.

    Example: `salver demo -o out/demo`
    """
    cube = paper(out / "cube", n, seed, json)
    tall = bottle(out / "bottle", max(1, n // BOTTLE_SHARE), seed, json)
    if json:
        print_json({"directory": out, "cube": cube, "bottle": tall})
        return
    console = result_console()
    console.print(f"\nThe paper's cube stayed on the tray in {_held(cube['campaign'])}: at this speed both do.")
    console.print(
        f"The tall bottle, as fast as the arm and the load allow, stayed in {_held(tall['campaign'])}: "
        f"that costs {_price(tall)} of time."
    )
    console.print(f"See it fall and stay, side by side: {tall['page']} (open it in a browser)")
    console.print(f"The paper's experiment: {cube['page']}")
    console.print(
        "Next: salver plan panda-cube --fastest -o out/fastest, or a scenario of your own (docs/tutorial.md)."
    )


def paper(out: Path, n: int, seed: int, quiet: bool) -> dict[str, Any]:
    """Plan, run and report the paper's scenario: the robust trajectory and the straight line."""
    from salver.planning.plan import load_plan
    from salver.reports.pages.page import write_report
    from salver.simulation.physics import simulate

    _head(1, "The paper's cube, half a metre in 2.5 s: its robust trajectory, and the straight line")
    plan, _ = _planned(PAPER, None, "baseline", out, quiet)

    _head(2, f"Physics: arm, tray and loose cube; {n} runs of each with the cube's mass perturbed")
    for stem in ("plan", "baseline"):
        simulate(load_plan(out, stem)).save(out, stem)
    summary = _campaign(out, n, seed, quiet).summary

    return {"plan": plan.summary(), "campaign": summary, "page": write_report(out)}


def bottle(out: Path, n: int, seed: int, quiet: bool) -> dict[str, Any]:
    """The fastest motion of the tall bottle, planned for its ranges and for nominal values, on the same samples."""
    from salver.campaigns import parameters_of_run
    from salver.planning.plan import load_plan
    from salver.reports.pages.page import write_report
    from salver.simulation.physics import simulate

    _head(
        3,
        "A tall bottle as fast as possible, the tray leaning like a waiter's: planned for its ranges, and nominally",
    )
    plan, nominal = _planned(BOTTLE, "fastest", "nominal", out, quiet)

    _head(4, f"Physics: {n} bottles of unknown weight and balance, each with both motions")
    campaign = _campaign(out, n, seed, quiet)
    # The replay shows both motions with one true bottle, the worst one of the nominal motion.
    run = campaign.summary["plans"]["nominal"]["worst_run"]["run"]
    parameters, noise = parameters_of_run(out, run)
    for stem in ("plan", "nominal"):
        simulate(load_plan(out, stem), parameters=parameters, seed=noise).save(out, stem)
    return {
        "plan": plan.summary(),
        "nominal": nominal.summary(),
        "campaign": campaign.summary,
        "page": write_report(out),
    }


def _planned(name: str, method: str | None, beside: str, out: Path, quiet: bool) -> tuple[Plan, Plan]:
    """A scenario's plan, and the plan that it is compared with."""
    from salver import scenario as scenarios
    from salver.cli.plans.plan import show
    from salver.planning.make import plan_pair

    plan, other = plan_pair(scenarios.load(name), method, beside=beside)
    plan.save(out)
    other.save(out, beside)
    if not quiet:
        show(plan, other, beside)
    return plan, other


def _campaign(out: Path, n: int, seed: int, quiet: bool) -> Campaign:
    from salver.campaigns import run_campaign
    from salver.cli.checks.campaign import show, show_progress

    campaign = run_campaign(out, n, seed, progress=show_progress)
    if not quiet:
        show(campaign.summary)
    return campaign


def _head(number: int, text: str) -> None:
    step(0, 1)  # reset the progress of the part before
    say(f"\n[{number}/{STEPS}] {text}")


def _held(summary: dict[str, Any]) -> str:
    """Number of runs in which each plan kept its load, in plain words."""
    held = {stem: plan["outcomes"].get("holds", {"count": 0})["count"] for stem, plan in summary["plans"].items()}
    n = summary["definition"]["n"]
    return " and ".join(f"{count} of {n} runs {_NAMES[stem]}" for stem, count in held.items())


def _price(tall: dict[str, Any]) -> str:
    careful, careless = tall["plan"]["duration"], tall["nominal"]["duration"]
    return f"{100 * (careful / careless - 1):.0f} % ({careful:.2f} s instead of {careless:.2f} s)"


_NAMES = {
    "plan": "when planned for its uncertainty",
    "baseline": "with the straight line",
    "nominal": "when planned for its nominal values",
}
