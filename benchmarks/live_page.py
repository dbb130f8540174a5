"""The page on live motions (docs/live.md), from runs that are kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from salver.files import read_json
from salver.statistics import clopper_pearson

DATA = Path(__file__).parent.parent / "docs" / "data"

COLUMNS = (
    "load, what, steps, committed, ms a step: median / 99.9 %, error and lag, runs, row broken, lost, by the filter"
)
TABLE = "\n".join(["| " + " | ".join(COLUMNS.split(", ")) + " |", "|---" * 10 + "|"])

HEAD = """# Changing the motion while it runs, measured

`python benchmarks/live.py -n {n} --docs` wrote this page; its runs are in `docs/data/live.json`. Times are CPU times of
one core of the machine it ran on, which others used too. Steps: of planning. Committed: share of them that brought a
verified motion. Lost: in the engine, what was executed, with the load at a random corner of its ranges. Filter: what
one makes of the same streams that knows the arm's limits of speed, acceleration and jerk, and no load, at such corners.
Gentle: followed as it is told, a stream keeps all limits and leaves {spared:.0f} % of what contact keeps at rest; the
error, rms, and how late the tray is are those of the stream in the middle (and the largest of all).

{table}
{rows}

{longer}

{faster}

Goals that change at a random time of the way to another, beside a search as thorough as offline from the same state
(`--kinds arrivals`): {changes}.

## Things that come

{obstacles}

## A loop of 1 kHz

{loop}

`command` takes {median:.1f} us at the median and {most:.0f} us at 99.9 %.

A row is broken when, with what was executed judged as one motion at every millisecond from its own beginning, any of
the conditions of a fastest motion is exceeded, without margins. The nearest to an edge that any run came: {worst:.1e}
of what is limited (0 is the edge).

What is wanted is, at the median, 60 ms (cube) and 200 ms (bottle) for a change of goal, 10 and 15 ms for a tick.
Published, on other machines and for other tasks: *Keep It Upright* (Heins and Schoellig, RA-L 2023) replans within 10
ms with a horizon of 2 s, in C++; FZI's shared control steps in 13 ms
([arXiv 2506.23624](https://arxiv.org/abs/2506.23624)).
"""


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


def longer(runs: dict[str, list[dict[str, Any]]], timed: int) -> str:
    """What the long streams came to, in words and a table. timed: so many of each kind were."""
    if not runs:
        return ""
    each = [x for kept in runs.values() for x in kept]
    broken, gone = sum(x["worst"] > 0 for x in each), sum(x["lost"] for x in each)
    rate = clopper_pearson(broken + gone, len(each))
    names = ", ".join(sorted({name for x in each for name in x.get("broken", ())}))
    which = f" ({names})" if names else ""
    rows = [row(*what.split(", "), kept) for what, kept in runs.items()]
    return (
        f"Streams of 10 s, {len(each)}, each in the engine too (`--length 10 --engine 1 --data "
        f"docs/data/live-long.json`; times of the first\n{timed} of each kind): {broken} broke a row{which}, "
        f"{gone} lost the load (95 % interval of either: {100 * rate.low:.2g} to {100 * rate.high:.2g} %).\n\n{TABLE}\n"
        + "\n".join(rows)
    )


def faster(runs: dict[str, list[dict[str, Any]]]) -> str:
    """How quick the tray is beside the filter's, in words."""
    pairs = [
        (x["speed"], x["filter speed"], x["filter lost"]) for each in runs.values() for x in each if "filter lost" in x
    ]
    if not pairs:
        return ""
    ours, filtered, gone = (np.array(x) for x in zip(*pairs, strict=True))
    return (
        f"Of the {len(pairs)} shorter streams that the filter was given as well, it loses {int(gone.sum())}.\n"
        f"The tray's speed, rms: {np.median(ours / filtered):.2f} of the filter's at the median."
    )


def obstacles() -> str:
    """What became of balls and posts, in words and tables, from what `live_obstacles.py --docs` kept."""
    import live_obstacles

    runs = {kind: read_json(DATA / f"live-obstacles-{kind}.json") for kind in ("real", "virtual")}
    flat = {
        kind: [x for found in each.values() for many in found.values() for x in many] for kind, each in runs.items()
    }
    hits = {kind: [x for x in each if x["would"] and x["hit"] is not None] for kind, each in flat.items()}
    missed = {kind: sum(x["would"] for x in each) - len(hits[kind]) for kind, each in flat.items()}
    silent = sum(x["announced"] is None or x["announced"] > x["hit"] for each in hits.values() for x in each)
    delay = 1e3 * max(x["announced"] for x in flat["real"] if x["announced"] is not None)
    count, load = {kind: len(each) for kind, each in flat.items()}, max(x["load"] for x in flat["real"])
    hit = sum(map(len, hits.values()))
    return f"""Everything is as it is by default. Of {hit} hits {silent} came unannounced. In real
time what came was announced {delay:.0f} ms after it was seen first at the latest. Evaded were {missed["real"]} of
{count["real"]} in real time, on two cores with a load of {load:.0f}; {missed["virtual"]} of {count["virtual"]} where
planning takes its processor time.

`python benchmarks/live_obstacles.py {count["real"] // 4}`, and `{count["virtual"] // 4} --virtual`: a ball, or a post
half a metre tall, comes at the load. It is seen 0.3 to 1.5 s before it would be there, and 30 times a second from then
on, with noise. The arm rests or is on its way. A post meets the forearm or the elbow up to 0.4 s before it would be at
the load.

In real time:

{live_obstacles.table(runs["real"])}

In processor time:

{live_obstacles.table(runs["virtual"])}"""


def loop() -> str:
    """How late a loop is beside a planner, in words and a table, from what `live_loop.py --docs` kept."""
    runs = read_json(DATA / "live-loop.json")
    rows = [
        f"| {kind} | {x['periods']} | {x['p99']:.2f} | {x['p999']:.2f} | {x['over 1 ms']} | {x['over 5 ms']} |"
        for kind, x in runs.items()
    ]
    load = max(x["load"] for x in runs.values())
    over = {kind: x["over 1 ms"] for kind, x in runs.items()}
    periods = runs["nobody"]["periods"]
    return f"""Of {periods} periods {over["nobody"]} were over 1 ms late beside nobody, {over["a process"]} beside a
planner in a process, {over["a thread"]} beside one in a thread.

`python benchmarks/live_loop.py 20 --docs`: a loop with real-time priority, started before the worker, and a hand that
sends twists, on two cores with a load of {load:.0f}. Frozen: `gc.freeze()` was called before.

| beside | periods | late by, ms: 99 % | 99.9 % | over 1 ms | over 5 ms |
|---|---|---|---|---|---|
""" + "\n".join(rows)
