"""What docs/live.md and docs/liquids.md say of live motions in numbers, from runs that are kept in docs/data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from salver.files import read_json
from salver.statistics import clopper_pearson

DATA = Path(__file__).parent.parent / "docs" / "data"

COLUMNS = (
    "load",
    "what",
    "steps",
    "committed",
    "ms a step: median / 99.9 %",
    "error and lag",
    "runs",
    "constraint violated",
    "lost",
    "by the filter",
)
TABLE = f"| {' | '.join(COLUMNS)} |\n{'|---' * len(COLUMNS)}|"


Runs = dict[str, list[dict[str, Any]]]  # by load and kind


def told_of(file: str, runs: Runs) -> str:
    """What runs say that are kept in one file of docs/data."""
    others = {"live-obstacles": obstacles, "live-speed": speed, "live-loop": loop, "live-faults": faults}
    if file in others:
        return others[file](runs)
    arrivals, rest = parted(runs)
    return "\n".join(filter(None, [streams(rest), faster(rest), arrivals]))


def of_kind(runs: Runs, kind: str) -> Runs:
    """Runs of a kind, by load."""
    each = ((*what.rsplit(", ", 1), found) for what, found in runs.items())
    return {name: found for name, of, found in each if of == kind}


def parted(runs: Runs) -> tuple[str, Runs]:
    """How long new goals take, in words, and the other runs."""
    from live_arrivals import arrived

    said = "\n".join(f"- {arrived(name, each)}." for name, each in of_kind(runs, "arrivals").items())
    return said, {what: each for what, each in runs.items() if not what.endswith(", arrivals")}


def streams(runs: Runs) -> str:
    return "\n".join([TABLE, *(row(*what.rsplit(", ", 1), each) for what, each in runs.items())]) if runs else ""


def faults(runs: Runs) -> str:
    from live_faults import faults_in_words

    each, names = [x for some in runs.values() for x in some], [what.rsplit(", ", 1)[0] for what in runs]
    return f"Of {len(each)} runs ({', '.join(names)}) {faults_in_words(each)}"


def pieces() -> dict[str, str]:
    """Tables and findings of both pages."""
    kept = {name: read_json(DATA / f"{name}.json") for name in ("live", "live-long", "live-liquids")}
    arrivals, kept["live"] = parted(kept["live"])
    nearest = {name: max(x["worst"] for each in runs.values() for x in each) for name, runs in kept.items()}
    long = [x for each in kept["live-long"].values() for x in each]
    lost, violated = sum(x["lost"] for x in long), sum(x["worst"] > 0 for x in long)
    either = clopper_pearson(lost + violated, len(long))
    which = ", ".join(sorted({name for x in long for name in x.get("broken", ())}))
    change = {
        load: np.median(np.concatenate([x["ms"] for x in kept["live"][f"panda-{load}, goals that change"]]))
        for load in ("cube", "tall-bottle")
    }
    others = {name: read_json(DATA / f"live-{name}.json") for name in ("obstacles", "faults", "loop", "speed")}
    return {
        "findings": f"- Of {len(long)} streams of 10 s at random corners of the ranges, {lost} lost the load in the "
        f"physics engine and {violated} violated a constraint ({which}; 95 % interval of either: "
        f"{100 * either.low:.2g} to {100 * either.high:.2g} %).\n"
        f"- A changed goal takes {change['cube']:.0f} ms of CPU time for a cube and {change['tall-bottle']:.0f} ms for "
        f"a tall bottle (medians).\n- {evasions(others['obstacles'])}",
        "streams": streams(kept["live"]),
        "long": streams(kept["live-long"]),
        "filter": faster(kept["live"]),
        "arrivals": arrivals,
        **{name: told_of(f"live-{name}", runs) for name, runs in others.items()},
        "nearest": f"The least distance of a constraint from its boundary (0) in any run, as a share of what it "
        f"limits: {max(nearest['live'], nearest['live-long']):.1e}.",
        "liquids": f"{streams(kept['live-liquids'])}\n\nThe least distance of a constraint from its boundary (0), as "
        f"a share of what it limits: {nearest['live-liquids']:.1e}.",
    }


def row(name: str, kind: str, runs: list[dict[str, Any]]) -> str:
    ms = np.concatenate([x["ms"] for x in runs])
    steps = sum(x["steps"] for x in runs)
    share = sum(x["committed"] for x in runs) / steps
    error = ""
    if kind.startswith("gentle"):
        off, lag = 100 * np.array([x["error"] for x in runs]), 1e3 * np.array([x["lag"] for x in runs])
        error = f"{np.median(off):.1f} % ({off.max():.1f}), {np.median(lag):.0f} ms ({lag.max():.0f})"
    engine = [x for x in runs if "lost" in x]
    filtered = [x["filter lost"] for x in engine if "filter lost" in x]
    beside = f"{sum(filtered)} of {len(filtered)}" if filtered else ""
    return (
        f"| {name} | {kind} | {steps} | {share:.2f} | {np.median(ms):.0f} / {np.quantile(ms, 0.999):.0f} | {error} | "
        f"{len(runs)} | {sum(x['worst'] > 0 for x in runs)} | {sum(x['lost'] for x in engine)} of {len(engine)} | "
        f"{beside} |"
    )


def faster(runs: dict[str, list[dict[str, Any]]]) -> str:
    """How quick the tray is beside the filter's, in words."""
    each = [x for kept in runs.values() for x in kept if "filter lost" in x]
    if not each:
        return ""
    speed = np.median([x["speed"] / x["filter speed"] for x in each])
    return (
        f"Of the {len(each)} shorter streams that the filter was given too, it loses "
        f"{sum(x['filter lost'] for x in each)}. salver's tray has {speed:.2f} of the filter's r.m.s. speed (median)."
    )


def machine(runs: list[dict[str, Any]]) -> str:
    """On what runs in real time ran, in words."""
    return f"{max(x['cores'] for x in runs)} cores with a load of {max(x['load'] for x in runs):.0f}"


def evasions(runs: Runs) -> str:
    """What became of balls and posts in real time, in sentences."""
    from live_obstacles import delays, evaded, missed, silent

    real = [x for each in of_kind(runs, "obstacles").values() for x in each if x["would"]]
    late, (ways, searched) = delays(real), missed(real)
    away, hit = sum(map(evaded, real)), sum(x["hit"] is not None for x in real)
    return (
        f"Of {len(real)} balls and posts that came at the load, {away} were evaded, in real time on {machine(real)}. A "
        f"search without time limit was run for {searched} of the {hit} that hit and found a way out of {ways}: so "
        f"{100 * away / (away + ways * hit / searched):.0f} % of those that could be evaded were. "
        f"{sum(map(silent, real))} of the {hit} hits came unannounced; 99 % of the announcements came within "
        f"{np.quantile(late, 0.99):.0f} ms after the obstacle was first seen, and each within {late.max():.0f} ms."
    )


def obstacles(runs: Runs) -> str:
    """What became of balls and posts, in tables."""
    from live_obstacles import table

    heads = {"obstacles": "In real time", "virtual": "In processor time"}
    return "\n\n".join(f"{says}:\n\n{table(some)}" for kind, says in heads.items() if (some := of_kind(runs, kind)))


def loop(runs: Runs) -> str:
    """How late a loop is beside a planner, in words and a table."""
    by = {kind: each[-1] for kind, each in of_kind(runs, "loop").items()}
    rows = [
        f"| {kind} | {x['periods']} | {100 * x['under 1.2 ms']:.2f} % | {x['p99']:.2f} | {x['p999']:.2f} | "
        f"{x['over 1 ms']} | {x['over 5 ms']} |"
        for kind, x in by.items()
    ]
    heads = ("beside", "periods", "under 1.2 ms", "late by, ms: 99 %", "99.9 %", "over 1 ms", "over 5 ms")
    took = np.array([x["command"] for x in by.values()])
    said = (
        f"Measured on {machine([*by.values()])}. `command` takes {np.median(took[:, 0]):.1f} µs of CPU time at the "
        f"median and {took[:, 1].max():.0f} µs at 99.9 %."
    )
    return "\n".join([said, "", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *rows])


def speed(runs: Runs) -> str:
    """What became of motions whose speed was changed and which were held."""
    sessions = [x for each in of_kind(runs, "overrides").values() for x in each]
    lost, violated = sum(x["lost"] for x in sessions), sum(x["worst"] > 0 for x in sessions)
    rests = np.array([rest for x in sessions for rest in x["rests"] if rest[1] > 0])
    heads = ("load", "instants", "stop", "finishing", "on the path: sooner than finishing", "within 1.3 times the stop")
    rows = []
    for name, found in of_kind(runs, "rests").items():
        stop, left, path = (np.array([x[way] for x in found]) for way in ("stop", "left", "path"))
        near = (path < left).sum(), (path <= 1.3 * stop).sum()
        rows.append(
            f"| {name} | {len(found)} | {np.median(stop):.2f} s | {np.median(left):.2f} s | {near[0]} | {near[1]} |"
        )
    either = clopper_pearson(lost + violated, len(sessions))
    return (
        f"Of {len(sessions)} sessions {lost} lost the load in the physics engine and {violated} violated a constraint "
        f"(95 % interval of either: {100 * either.low:.2g} to {100 * either.high:.2g} %). The "
        f"{len(rests)} holds of a moving arm brought it to rest in {np.median(rests[:, 0]):.2f} s at the median and "
        f"{rests[:, 0].max():.2f} s at most; finishing would have taken {np.median(rests[:, 1]):.2f} and "
        f"{rests[:, 1].max():.2f} s.\n\nFrom instants at full speed, s to rest (medians), and at how "
        "many of them going slower and slower along the path does as well:\n\n"
        + "\n".join([f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *rows])
    )
