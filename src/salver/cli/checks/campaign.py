"""`salver campaign`: many perturbed runs of the plans of a directory."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import typer

from salver.cli.common import ExitCode, Json, print_json, print_table, result_console, say
from salver.cli.progress import step


def campaign(
    directory: Annotated[Path, typer.Argument(help="Run directory that `salver plan` made.")],
    n: Annotated[int, typer.Option("-n", "--runs", help="Runs of each plan.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the samples: the same seed gives the same runs.")] = 0,
    method: Annotated[
        str,
        typer.Option(help="How the uncertain set is sampled: uniform or corners (the extremes first)."),
    ] = "uniform",
    stem: Annotated[
        list[str] | None, typer.Option("--plan", help="Plan to run; repeat for several. Default: plan and baseline.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("-j", "--jobs", help="Processes. Default: one for each core, or one for few runs.")
    ] = None,
    folder: Annotated[
        str | None, typer.Option(help="Folder in DIRECTORY for the results. Default: campaign, or stops with --stops.")
    ] = None,
    stops: Annotated[
        bool, typer.Option("--stops", help="Stop each run at a random instant by the plan's own stops.")
    ] = False,
    json: Json = False,
) -> None:
    """Run every plan of a directory many times with perturbed parameters, all plans on the same samples.

    If it is interrupted, even killed, the same command resumes. Results: runs.parquet and
    campaign.json in DIRECTORY/campaign. One run alone: `salver simulate DIRECTORY --run K`.

    Ends with 0 when all runs were made, whatever became of the objects, and 1 when some could not be.

    With --stops (plans made with `salver plan --stops`) it says how many stops lost the load: slipped over 5 mm,
    tipped, lifted off or left the tray.

    Example: `salver campaign out/panda-cube -n 100 --seed 0`
    """
    from salver.campaigns import run_campaign

    try:
        result = run_campaign(directory, n, seed, method, stem, jobs, folder, show_progress, stops=stops)
    except KeyboardInterrupt:
        say("salver: stopped; finished runs are kept: repeat the command to continue.")
        raise typer.Exit(ExitCode.INTERRUPTED) from None
    if json:
        print_json(result.summary)
    else:
        show(result.summary)
        result_console().print(f"Runs: {result.folder / 'runs.parquet'}, summary: {result.folder / 'campaign.json'}")
    if any("error" in plan["outcomes"] for plan in result.summary["plans"].values()):
        raise typer.Exit(ExitCode.NOT_ACHIEVED)


def show_progress(done: int, total: int, counts: Counter[tuple[str, str]]) -> None:
    """Show the number of finished runs and the count of each outcome."""
    step(done, total, ", ".join(f"{stem} {outcome} {count}" for (stem, outcome), count in sorted(counts.items())))


def show(summary: dict[str, Any]) -> None:
    """Print the summary as a table with a column for each plan."""
    from salver.campaigns.summary import LEFT_TUBES

    plans = summary["plans"]
    each = list(plans.values())
    outcomes = dict.fromkeys(name for plan in each for name in plan["outcomes"])
    rows = [[name, *(_rate(plan["outcomes"].get(name)) for plan in each)] for name in outcomes]
    if any(plan["tube"] for plan in each):
        rows.append(["coefficient left its tube", *(_rate(plan["tube"] and plan["tube"]["left"]) for plan in each)])
    if any(plan.get("stops") for plan in each):
        for name, label in (("lost", "lost in a stop"), ("beyond_a_limit", "kept beyond a limit of the arm")):
            rows.append([label, *(_rate(plan["stops"] and plan["stops"][name]) for plan in each)])
        takes = [plan["stops"]["takes"] for plan in each]
        rows.append(
            ["stop takes, median (max)", *(f"{x['median']:.4g} s ({x['max']:.4g})" if x else "" for x in takes)]
        )
        rows.append(["finished, because no stop is sooner", *(str(plan["stops"]["finished"]) for plan in each)])
    print_table(titles := ["", *plans], rows, left=titles)
    out = result_console()
    if any(plan["tube"] and plan["tube"]["left"]["count"] for plan in plans.values()):
        out.print(LEFT_TUBES)
    for pair in summary["paired"]:
        held = pair["holds"]
        out.print(
            f"Held: both {held['both']}, only {pair['first']} {held['only_first']}, only {pair['second']} "
            f"{held['only_second']}, neither {held['neither']} (McNemar p = {held['p_value']:.3g})"
        )
    for stem, plan in plans.items():
        worst = plan["worst_run"]
        reason = f": {worst['sentence']}" if worst["sentence"] else ""
        slip = f", slip {1e3 * worst['peak_slip']:.3g} mm" if worst.get("peak_slip") is not None else ""
        out.print(
            f"Worst run of {stem}: {worst['run']} ({worst['outcome']}{reason}{slip}); again with: {worst['replay']}"
        )


def _rate(rate: dict[str, Any] | None) -> str:
    if not rate:
        return ""
    return f"{rate['count']} of {rate['of']} ({100 * rate['low']:.1f} to {100 * rate['high']:.1f} %)"
