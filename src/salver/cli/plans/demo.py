"""`salver demo`: the paper's experiment, and a load for which planning for its ranges matters."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from salver.cli.common import Json, print_json, result_console, say
from salver.cli.progress import step

PAPER, BOTTLE = "panda-cube", "panda-tall-bottle"
BOTTLE_SHARE = 5  # the bottle has a fifth of the runs, because its plans differ by far more than a few per cent


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
    cube = experiment(PAPER, None, "baseline", out / "cube", n, seed, json)
    tall = experiment(BOTTLE, "fastest", "nominal", out / "bottle", max(1, n // BOTTLE_SHARE), seed, json)
    if json:
        print_json({"directory": out, "cube": cube, "bottle": tall})
        return
    console = result_console()
    console.print(f"\nThe paper's cube stayed on the tray in {_held(cube['campaign'])}: at this speed both do.")
    careful, careless = tall["plan"]["duration"], tall["nominal"]["duration"]
    console.print(
        f"The tall bottle, as fast as the arm and the load allow, stayed in {_held(tall['campaign'])}: "
        f"that costs {100 * (careful / careless - 1):.0f} % of time ({careful:.2f} s instead of {careless:.2f} s)."
    )
    console.print(f"See it fall and stay, side by side: {tall['page']} (open it in a browser)")
    console.print(f"The paper's experiment: {cube['page']}")
    console.print(
        "Next: salver plan panda-cube --fastest -o out/fastest, or a scenario of your own (docs/tutorial.md)."
    )


def experiment(name: str, method: str | None, beside: str, out: Path, n: int, seed: int, quiet: bool) -> dict[str, Any]:
    """Plan a scenario and what its plan is compared with, run both with the same n samples of the load, and report.

    The replay of the page shows both with one true load, the worst one of the motion that the plan is compared with.
    """
    from salver import scenario as scenarios
    from salver.campaigns import parameters_of_run, run_campaign
    from salver.cli.checks.campaign import show as show_campaign
    from salver.cli.checks.campaign import show_progress
    from salver.cli.plans.plan import show
    from salver.planning.make import plan_pair
    from salver.reports.pages.page import write_report
    from salver.simulation.physics import simulate

    chosen = scenarios.load(name)
    step(0, 1)  # reset the progress of the part before
    say(f"\n{name}: a plan, and the motion that it is compared with")
    plan, other = plan_pair(chosen, method, beside=beside)
    plan.save(out)
    other.save(out, beside)
    if not quiet:
        show(plan, other, beside)

    say(f"\n{name} in the physics engine: {n} loads within the ranges, each with both motions")
    step(0, 1)
    summary = run_campaign(out, n, seed, progress=show_progress).summary
    if not quiet:
        show_campaign(summary)
    parameters, noise = parameters_of_run(out, summary["plans"][beside]["worst_run"]["run"])
    for stem, each in (("plan", plan), (beside, other)):
        simulate(each, parameters=parameters, seed=noise).save(out, stem)
    return {"plan": plan.summary(), beside: other.summary(), "campaign": summary, "page": write_report(out)}


def _held(summary: dict[str, Any]) -> str:
    """Number of runs in which each plan kept its load, in plain words."""
    held = {stem: plan["outcomes"].get("holds", {"count": 0})["count"] for stem, plan in summary["plans"].items()}
    n = summary["definition"]["n"]
    return " and ".join(f"{count} of {n} runs {_NAMES[stem]}" for stem, count in held.items())


_NAMES = {
    "plan": "when planned for its uncertainty",
    "baseline": "with the straight line",
    "nominal": "when planned for its nominal values",
}
