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


def pieces() -> dict[str, str]:
    """Tables and findings of both pages."""
    from live_arrivals import arrived
    from live_faults import faults_in_words

    kept = {name: read_json(DATA / f"{name}.json") for name in ("live", "live-long", "live-liquids")}
    arrivals = {what: kept["live"].pop(what) for what in list(kept["live"]) if what.endswith(", arrivals")}
    tables = {
        name: "\n".join([TABLE, *(row(*what.split(", "), each) for what, each in runs.items())])
        for name, runs in kept.items()
    }
    nearest = {name: max(x["worst"] for each in runs.values() for x in each) for name, runs in kept.items()}
    streams = [x for each in kept["live-long"].values() for x in each]
    lost, violated = sum(x["lost"] for x in streams), sum(x["worst"] > 0 for x in streams)
    either = clopper_pearson(lost + violated, len(streams))
    which = ", ".join(sorted({name for x in streams for name in x.get("broken", ())}))
    change = {
        load: np.median(np.concatenate([x["ms"] for x in kept["live"][f"panda-{load}, goals that change"]]))
        for load in ("cube", "tall-bottle")
    }
    what_comes, balls = obstacles()
    return {
        "findings": f"- Of {len(streams)} streams of 10 s at random corners of the ranges, {lost} lost the load in the "
        f"physics engine and {violated} violated a constraint ({which}; 95 % interval of either: "
        f"{100 * either.low:.2g} to {100 * either.high:.2g} %).\n"
        f"- A changed goal takes {change['cube']:.0f} ms of CPU time for a cube and {change['tall-bottle']:.0f} ms for "
        f"a tall bottle (medians).\n- {what_comes}",
        "streams": tables["live"],
        "long": tables["live-long"],
        "filter": faster(kept["live"]),
        "arrivals": "\n".join(f"- {arrived(what.split(', ')[0], each)}." for what, each in arrivals.items()),
        "obstacles": balls,
        "faults": "\n".join(
            f"- {what.split(', ')[0]}: {faults_in_words(each)}"
            for what, each in read_json(DATA / "live-faults.json").items()
        ),
        "loop": loop(),
        "speed": speed(),
        "nearest": f"The least distance of a constraint from its boundary (0) in any run, as a share of what it "
        f"limits: {max(nearest['live'], nearest['live-long']):.1e}.",
        "liquids": f"{tables['live-liquids']}\n\nThe least distance of a constraint from its boundary (0), as a share "
        f"of what it limits: {nearest['live-liquids']:.1e}.",
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


def obstacles() -> tuple[str, str]:
    """What became of balls and posts, in a sentence and in tables, from what `live.py --kinds obstacles` kept."""
    import live_obstacles

    runs = {kind: read_json(DATA / f"live-obstacles-{kind}.json") for kind in ("real", "virtual")}
    flat = {
        kind: [x for found in each.values() for many in found.values() for x in many] for kind, each in runs.items()
    }
    hits = {kind: [x for x in each if x["would"] and x["hit"] is not None] for kind, each in flat.items()}
    evaded = {kind: sum(x["would"] for x in each) - len(hits[kind]) for kind, each in flat.items()}
    silent = sum(x["announced"] is None or x["announced"] > x["hit"] for each in hits.values() for x in each)
    delay = 1e3 * max(x["announced"] for x in flat["real"] if x["announced"] is not None)
    possible = {kind: sum(x["would"] and x["way"] for x in each) for kind, each in flat.items()}
    load = max(x["load"] for x in flat["real"])
    hit = sum(map(len, hits.values()))
    sentence = (
        "Of the obstacles that came at the load and for which a search without time limit finds a way out, "
        f"{evaded['virtual']} of {possible['virtual']} were evaded where planning takes its processor time, and "
        f"{evaded['real']} of {possible['real']} in real time on two cores with a load of {load:.0f}. {silent} of "
        f"{hit} hits came unannounced; in real time each announcement came at most {delay:.0f} ms after the obstacle "
        "was first seen."
    )
    tables = [live_obstacles.table(runs[kind]) for kind in ("real", "virtual")]
    return sentence, f"In real time:\n\n{tables[0]}\n\nIn processor time:\n\n{tables[1]}"


def loop() -> str:
    """How late a loop is beside a planner, in words and a table, from what `live_loop.py --docs` kept."""
    runs = read_json(DATA / "live-loop.json")
    rows = [
        f"| {kind} | {x['periods']} | {x['p99']:.2f} | {x['p999']:.2f} | {x['over 1 ms']} | {x['over 5 ms']} |"
        for kind, x in runs.items()
    ]
    over = {kind: x["over 1 ms"] for kind, x in runs.items()}
    heads = ["| beside | periods | late by, ms: 99 % | 99.9 % | over 1 ms | over 5 ms |", "|---" * 6 + "|"]
    load = max(x["load"] for x in runs.values())
    said = (
        f"Of {runs['nobody']['periods']} periods, on two cores with a load of {load:.0f}, {over['nobody']} were over "
        f"1 ms late beside nobody, {over['a process']} beside a planner in a process, {over['a thread']} beside one in "
        "a thread."
    )
    return "\n".join([said, "", *heads, *rows])


def speed() -> str:
    """What became of motions whose speed was changed and which were held, from what `live_speed.py` kept."""
    kept = read_json(DATA / "live-speed.json")
    sessions = [x for runs in kept["sessions"].values() for x in runs]
    lost, violated = sum(x["lost"] for x in sessions), sum(x["worst"] > 0 for x in sessions)
    rests = np.array([rest for x in sessions for rest in x["rests"] if rest[1] > 0])
    heads = ("load", "instants", "stop", "finishing", "on the path: sooner than finishing", "within 1.3 times the stop")
    rows = []
    for name, found in kept["ways"].items():
        stop, left, path = (np.array([x[way] for x in found]) for way in ("stop", "left", "path"))
        near = (path < left).sum(), (path <= 1.3 * stop).sum()
        rows.append(
            f"| {name} | {len(found)} | {np.median(stop):.2f} s | {np.median(left):.2f} s | {near[0]} | {near[1]} |"
        )
    return (
        f"Of {len(sessions)} sessions {lost} lost the load in the physics engine and {violated} violated a constraint "
        f"(95 % interval of either: 0 to {100 * clopper_pearson(lost + violated, len(sessions)).high:.2g} %). The "
        f"{len(rests)} holds of a moving arm brought it to rest in {np.median(rests[:, 0]):.2f} s at the median and "
        f"{rests[:, 0].max():.2f} s at most; finishing would have taken {np.median(rests[:, 1]):.2f} and "
        f"{rests[:, 1].max():.2f} s.\n\nFrom instants at full speed, s to rest (medians), and at how "
        "many of them going slower and slower along the path does as well:\n\n"
        + "\n".join([f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *rows])
    )
