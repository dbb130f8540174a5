"""Planners of others and salver on the same loads: how fast, and does the load stay?

    python benchmarks/peers.py [-n 20] [--only "tall bottle" ...] [--planners toppra ruckig ...] [--again] [--docs]
    python benchmarks/peers.py -n 1000 --hopeless 100    # a motion that keeps nothing in 100 runs is run no more
    python benchmarks/peers.py --agreement     # time laws by toppra and by salver on one path, at the same points

The loads are those of benchmarks/fastest.py. Each motion is run n times in the engine under the same controller, with
parameters drawn from the scenario's uncertain set, its corners first, the same for every planner. Score:

    duration         s
    kept             runs in which the load stays and the arm keeps its limits; and those in which the load stays;
                     with the 95 % interval that the runs drawn at random give (the extremes of the ranges come first)
    limits violated  of the planned motion itself: the worst joint's share of the maker's limit, where that is above 1
    planning time    processor time, s, from the task to the motion

Live planners need their packages (pip install toppra ruckig drake). What is not installed is read from
frozen motions: benchmarks/frozen/PLANNER/SCENARIO.csv (columns t and the joints' names, dq_, ddq_), with
provenance.toml beside them, which says who planned them, with which version and how. --freeze writes them.

Results are kept in runs/peers; --docs keeps them in docs/data/peers.json and draws the plot, and `make pages`
writes the tables of docs/peers.md and the README from it. Your own planner: see there.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import shutil
import time
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from fastest import ROOT, line_path, plan_of, scenarios, survival
from peer_planners import PLANNERS, Motion, Planner, Task, toppra_law, without_contact
from salver.campaigns.engine import TABLE
from salver.campaigns.summary import read_table
from salver.errors import SalverError
from salver.files import read_json, write_atomic, write_json
from salver.motion_files import MotionSeries as MotionFile
from salver.motion_files import write
from salver.motion_files.readers import read_table as read_columns
from salver.planning.fastest.retiming import reachable_law
from salver.planning.follow.limits import peaks
from salver.planning.plan import Plan, load_plan
from salver.planning.trajopt.problem import transport_problem
from salver.scenario import Scenario
from salver.statistics import clopper_pearson
from salver.trajectory import JointMotion

PUBLISHED = ROOT / "docs" / "data" / "peers.json"
PLOT = ROOT / "docs" / "images" / "peers.png"
FROZEN = Path(__file__).parent / "frozen"
WORK = ROOT / "runs" / "peers"
RESULTS = "results.json"
DIGITS = 9  # of frozen motions, rad
DISTRIBUTIONS = {"pydrake": "drake"}  # where a package is imported by another name
CROWDED = 0.04  # s to the next on its right: the name of a point stands on its left


# Motions ---------------------------------------------------------------------------------------------------------


def folder_of(work: Path, scenario: Scenario, planner: str) -> Path:
    """Where a motion and its runs are."""
    return work / scenario.name / planner.replace(" ", "-").replace(",", "")


def frozen(name: str, task: Task) -> tuple[Motion, float]:
    """A motion from its file, and the processor time that its provenance tells."""
    folder = FROZEN / name
    header, values = read_columns(folder / f"{task.scenario.name}.csv")
    table = dict(zip(header, values.T, strict=True))
    q, dq, ddq = (
        np.stack([table[f"{what}_{joint}"] for joint in task.problem.arm.joint_names], axis=1)
        for what in ("q", "dq", "ddq")
    )
    told = tomllib.loads((folder / "provenance.toml").read_text())
    return (table["t"] - table["t"][0], q, dq, ddq), float(told["seconds"][task.scenario.name])


def freeze(planner: Planner, task: Task, plan: Plan, seconds: float) -> None:
    """Write a motion that was planned here, and who planned it."""
    import tomli_w

    folder = FROZEN / planner.name
    joint = plan.joint
    assert joint is not None
    ns: Any = np.round(joint.t * 1e9).astype(np.int64)
    motion = MotionFile(
        ns, task.problem.arm.joint_names, *(np.round(x, DIGITS) for x in (joint.q, joint.dq, joint.ddq))
    )
    write(motion, folder / f"{task.scenario.name}.csv")
    path = folder / "provenance.toml"
    told = tomllib.loads(path.read_text()) if path.is_file() else {"seconds": {}}
    distribution = DISTRIBUTIONS.get(planner.package or "salver", planner.package or "salver")
    told |= {
        "package": distribution,
        "version": metadata.version(distribution),
        "made": time.strftime("%Y-%m-%d"),
        "with": f'python benchmarks/peers.py --freeze "{planner.name}"',
        "on": f"{platform.system()} {platform.machine()}, Python {platform.python_version()}",
    }
    told["seconds"][task.scenario.name] = round(seconds, 3)
    write_atomic(path, tomli_w.dumps(told))


def planned(planner: Planner, task: Task) -> tuple[Plan, float, str]:
    """The motion as a plan that the engine takes, processor time, and "live" or "frozen"."""
    kind = "frozen" if planner.missing else "live"
    _ = task.path, task.problem.contacts  # given to every planner, so not part of its time
    if planner.missing:
        found, seconds = frozen(planner.name, task)
        return plan_of(task.scenario, task.problem, JointMotion(*found)), seconds, kind
    began = time.process_time()
    made = planner.plan(task)
    seconds = time.process_time() - began
    plan = made if isinstance(made, Plan) else plan_of(task.scenario, task.problem, JointMotion(*made))
    return plan, seconds, kind


def broken(task: Task, plan: Plan) -> dict[str, float]:
    """Kind of limit to the worst share of it, where it is above 1 (to 1 %): of the motion itself."""
    assert plan.joint is not None
    shares = {p.kind: float(p.share) for p in peaks(task.problem.arm, plan.joint, task.problem.items)}
    return {kind: share for kind, share in shares.items() if share > 1.01}


def score(planner: Planner, task: Task, n: int, jobs: int, work: Path) -> dict[str, Any]:
    """One planner on one scenario."""
    place = folder_of(work, task.scenario, planner.name)
    if (place / "plan.json").is_file():
        plan = load_plan(place)
        seconds, kind = plan.solver["processor_time"], plan.solver["kind"]
    else:
        plan, seconds, kind = planned(planner, task)
        plan = replace(plan, solver={**plan.solver, "processor_time": seconds, "kind": kind})
        plan.save(place)
    outcomes = survival(place, n, jobs, f"{task.scenario.name} {planner.name}") if n else {}
    ends = read_table(place / "campaign" / TABLE)["outcome"][_extremes(task.scenario, n) :] if n else []
    return {
        "kind": kind,
        "duration": plan.duration,
        "seconds": seconds,
        "broken": broken(task, plan),
        "runs": n,
        "outcomes": outcomes,
        "drawn": "".join("1" if end == "holds" else "0" for end in ends),
    }


def _extremes(scenario: Scenario, n: int) -> int:
    """How many of the first n runs are extremes of the ranges, which come first; 0 where all are: a sample of them."""
    count = 2**scenario.uncertain.size
    return count if count < n else 0


# What is told ----------------------------------------------------------------------------------------------------


def totals(results: dict[str, Any], name: str) -> dict[str, Any]:
    """Of one planner over all scenarios that every planner was asked."""
    rows = [found[name] for found in results.values() if "duration" in found.get(name, {})]
    failed = sum("failed" in found.get(name, {}) for found in results.values())
    runs = sum(row["runs"] for row in rows)
    return {
        "solved": len(rows),
        "of": len(rows) + failed,
        "runs": runs,
        "held": sum(row["outcomes"].get("holds", 0) for row in rows),
        "stayed": sum(row["outcomes"].get("holds", 0) + row["outcomes"].get("limit", 0) for row in rows),
        "kept share": _mean_share(rows, ("holds",)),  # each load counts the same, however many runs it has
        "stayed share": _mean_share(rows, ("holds", "limit")),
        "kept between": _between(rows),
        "duration": float(np.mean([row["duration"] for row in rows])) if rows else None,
        "seconds": float(np.median([row["seconds"] for row in rows])) if rows else None,
        "broken": {
            kind: max(row["broken"].get(kind, 0.0) for row in rows)
            for kind in dict.fromkeys(kind for row in rows for kind in row["broken"])
        },
        "kind": " and ".join(sorted({row["kind"] for row in rows})),
    }


def _mean_share(rows: list[dict[str, Any]], outcomes: tuple[str, ...]) -> float:
    """Mean over loads of the share of runs that end so; 0 without runs."""
    shares = [sum(row["outcomes"].get(name, 0) for name in outcomes) / row["runs"] for row in rows if row["runs"]]
    return float(np.mean(shares)) if shares else 0.0


def _between(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """95 % interval (Clopper and Pearson 1934) of the share that is kept of what the ranges allow, mean of the loads.

    Of the runs drawn at random, as many of each load; where loads differ it covers more often (Hoeffding 1956).
    """
    least = min((len(row["drawn"]) for row in rows), default=0)
    kept = sum(row["drawn"][:least].count("1") for row in rows)
    rate = clopper_pearson(kept, least * len(rows))
    return rate.low, rate.high


def counts(results: dict[str, Any]) -> str:
    """How many runs, of which loads."""
    total, loads = 0, dict[str, list[str]]()
    for load, found in results.items():
        runs = [row["runs"] for row in found.values() if "runs" in row]
        total += sum(runs)
        each = f"{min(runs)}" if min(runs) == max(runs) else f"{min(runs)} to {max(runs)}"
        loads.setdefault(each, []).append(load)
    of_each = "; ".join(f"{each} of each motion for *{'*, *'.join(names)}*" for each, names in loads.items())
    return f"{total} runs in all: {of_each}."


def pieces() -> dict[str, str]:
    """The tables of docs/peers.md and the README, from docs/data/peers.json."""
    results: dict[str, Any] = read_json(PUBLISHED)
    few = ["| planner | mean duration | kept |", "|---|---|---|"]
    for name in PLANNERS:
        if all_ := totals(results, name):
            few.append(f"| {name} | {all_['duration']:.2f} s | {math.floor(1e3 * all_['kept share']) / 10} % |")
    return {"summary": "\n".join(few), "score": "\n".join(tables(results))}


def tables(results: dict[str, Any]) -> list[str]:
    """Markdown: all planners over all loads, and each on each."""
    names = [name for name in PLANNERS if any(name in found for found in results.values())]
    lines = [
        counts(results),
        "",
        "| planner | plans for | mean duration | kept | 95 % interval | load stays | limits violated by the plan "
        "| planning time | |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in names:
        all_ = totals(results, name)
        worst = ", ".join(f"{kind} {share:.1f}×" for kind, share in all_["broken"].items()) or "none"
        mean = "none found" if all_["duration"] is None else f"{all_['duration']:.3f} s"
        if all_["solved"] < all_["of"]:
            mean += f" ({all_['solved']} of {all_['of']})"
        seconds = "" if all_["seconds"] is None else f"{all_['seconds']:.2f} s"
        lines.append(
            f"| {name} | {PLANNERS[name].knows} | {mean} | {all_['held']} of {all_['runs']} | "
            f"{_percent(all_['kept between'])} | {all_['stayed']} of {all_['runs']} | {worst} | {seconds} | "
            f"{all_['kind']} |"
        )
    lines += ["", "Each cell: duration, kept of all runs, 95 % interval; how many loads stay, where that is more.", ""]
    lines += [f"| load | {' | '.join(names)} |", "|---|" + "---|" * len(names)]
    for load, found in results.items():
        lines.append(f"| {load} | {' | '.join(_cell(found.get(name, {})) for name in names)} |")
    return lines


def _cell(found: dict[str, Any]) -> str:
    if "duration" not in found:
        return "none" if "failed" in found else ""
    held = found["outcomes"].get("holds", 0)
    stayed = held + found["outcomes"].get("limit", 0)
    stays = f"; {stayed} stay" if stayed > held else ""
    return f"{found['duration']:.3f} s, {held}/{found['runs']}, {_percent(_between([found]))}{stays}"


def _percent(between: tuple[float, float]) -> str:
    low, high = np.floor(1e3 * between[0]) / 10, np.ceil(1e3 * between[1] - 1e-9) / 10  # outwards
    return f"{low:.1f} to {high:.1f} %"


def plot(results: dict[str, Any], path: Path) -> None:
    """Each planner's motions: mean duration against the share of runs that were kept."""
    from matplotlib.figure import Figure

    from salver.reports import style

    figure = Figure(figsize=(7.2, 3.6), layout="constrained")
    axes = figure.add_subplot()
    told = {name: totals(results, name) for name in PLANNERS}
    told = {name: all_ for name, all_ in told.items() if all_["duration"] is not None and all_["runs"]}
    for name, all_ in told.items():
        x, kept, stayed = all_["duration"], 100 * all_["kept share"], 100 * all_["stayed share"]
        colour = style.BLUE if name.startswith("salver") else style.GREY
        axes.plot([x, x], [kept, stayed], color=colour, linewidth=1)
        axes.plot([x, x], [100 * share for share in all_["kept between"]], color=colour, linewidth=4, alpha=0.4)
        axes.plot(x, stayed, "o", markersize=6, markerfacecolor="white", color=colour)
        axes.plot(x, kept, "o", markersize=6, color=colour)
        crowded = any(0 <= other["duration"] - x < CROWDED for key, other in told.items() if key != name)
        at, side = ((-6, 5), "right") if crowded else ((6, 5), "left")
        axes.annotate(name, (x, stayed), xytext=at, ha=side, textcoords="offset points", fontsize=8)
    axes.set(xlabel="mean duration, s", ylabel="runs, %, mean of all loads", ylim=(-6, 112))
    axes.set_title("full: load and limits kept (bar: 95 % of those drawn at random); open: the load stays", fontsize=9)
    axes.margins(x=0.22)
    axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)


def agreement(points: list[int], only: list[str] | None) -> None:
    """The time-optimal law on the straight line: toppra's reachability analysis against salver's linear programme.

    Both get the same path, the same limits on velocity, acceleration and torque, then also the same rows of nominal
    contact, at as many points. toppra states its conditions at the points ("nodes") or at both ends of every interval
    ("intervals", its default); salver at the middles. So durations differ by what a finer grid takes away.
    """
    print("duration in s by salver and by toppra (conditions at nodes, over intervals), ratios salver / toppra, and")
    print("processor time of each in s")
    print(f"{'':37s}points   salver    nodes intervals  ratios            processor time")
    for name, scenario in scenarios().items():
        if only is not None and name not in only:
            continue
        path = line_path(scenario)
        full = transport_problem(scenario, level=True, robust=False)
        for what, problem in (("limits", without_contact(full)), ("limits, contact", full)):
            for count in points:
                durations, seconds = [], []
                for kind in ("own", "nodes", "intervals"):
                    began = time.process_time()
                    if kind == "own":
                        law = reachable_law(problem, path, count)
                        durations.append(np.inf if law is None else float(law[0][-1]))
                    else:
                        u, rate = toppra_law(problem, path, count, kind)
                        total = float(np.sum(2 * np.diff(u) / (rate[1:] + rate[:-1])))
                        durations.append(total if np.isfinite(total) else np.inf)
                    seconds.append(time.process_time() - began)
                told = " ".join(f"{duration:8.5f}" for duration in durations)
                ratios = " ".join(f"{durations[0] / theirs:.5f}" for theirs in durations[1:])
                spent = " ".join(f"{second:.2f}" for second in seconds)
                print(f"{name:20s} {what:16s} {count:5d} {told}   {ratios}   {spent}", flush=True)


def study(chosen: argparse.Namespace, results: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Every planner on every load; all that is known after each."""
    for name, scenario in scenarios().items():
        if chosen.only is not None and name not in chosen.only:
            continue
        task, found = Task(scenario), results.setdefault(name, {})
        for planner in PLANNERS.values():
            if chosen.planners is not None and planner.name not in chosen.planners:
                continue
            if planner.missing and not (FROZEN / planner.name / f"{scenario.name}.csv").is_file():
                print(f"{name:20s} {planner.name:20s} left out: {planner.package} is not installed, nothing is frozen")
                continue
            if found.get(planner.name, {}).get("runs", -1) >= _wanted(found.get(planner.name, {}), chosen):
                continue
            try:
                for n in sorted({min(chosen.hopeless, chosen.n), chosen.n}):
                    if found.get(planner.name, {}).get("runs", -1) < n <= _wanted(found.get(planner.name, {}), chosen):
                        found[planner.name] = score(planner, task, n, chosen.jobs, chosen.work)
                print(f"{name:20s} {planner.name:20s} {_cell(found[planner.name])}", flush=True)
            except SalverError as error:
                found[planner.name] = {"failed": str(error)}
                print(f"{name:20s} {planner.name:20s} {error}", flush=True)
            yield results


def _wanted(row: dict[str, Any], chosen: argparse.Namespace) -> int:
    """How many runs a motion shall have, after those that it has."""
    hopeless = row.get("runs", 0) >= chosen.hopeless and not row["outcomes"].get("holds", 0)
    return int(chosen.hopeless if hopeless else chosen.n)


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("-n", type=int, default=20, help="perturbed runs of each motion")
    options.add_argument("--hopeless", type=int, default=100, help="runs after which one that kept nothing is given up")
    options.add_argument("--only", nargs="*", choices=list(scenarios()), metavar="LOAD", help=", ".join(scenarios()))
    options.add_argument("--planners", nargs="*", choices=list(PLANNERS), metavar="NAME", help=", ".join(PLANNERS))
    options.add_argument("--again", action="store_true", help="forget what is known of these loads and planners")
    options.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    options.add_argument("--work", type=Path, default=WORK, help="folder of motions, runs and results")
    options.add_argument(
        "--docs", action="store_true", help="keep them in docs/data and draw the plot of docs/peers.md"
    )
    options.add_argument(
        "--freeze",
        nargs="*",
        choices=list(PLANNERS),
        metavar="NAME",
        help="plan with these planners and write benchmarks/frozen",
    )
    options.add_argument("--agreement", action="store_true", help="only compare time laws with toppra's")
    options.add_argument("--points", type=int, nargs="*", default=[201, 801], help="of --agreement")
    chosen = options.parse_args()
    if chosen.agreement:
        if PLANNERS["toppra"].missing:
            raise SystemExit("The package toppra is not installed; install it with: pip install toppra.")
        agreement(chosen.points, chosen.only)
        return
    wanted = {name: made for name, made in scenarios().items() if chosen.only is None or name in chosen.only}
    for name in chosen.freeze or ():
        for scenario in wanted.values():
            task = Task(scenario)
            plan, seconds, _ = planned(PLANNERS[name], task)
            freeze(PLANNERS[name], task, plan, seconds)
    data = chosen.work / RESULTS
    results: dict[str, Any] = read_json(data) if data.is_file() else {}
    if chosen.again:
        for name, scenario in wanted.items():
            for planner in chosen.planners or list(PLANNERS):
                results.get(name, {}).pop(planner, None)
                shutil.rmtree(folder_of(chosen.work, scenario, planner), ignore_errors=True)
    for found in study(chosen, results):
        write_json(data, found)
    print("\n".join(tables(results)))
    if chosen.docs:
        write_json(PUBLISHED, results)
        plot(results, PLOT)


if __name__ == "__main__":
    main()
