"""Live motions: how long a change takes, what is followed, and whether anything is dropped: docs/live.md.

    python benchmarks/live.py -n 4                                       streams, and goals that change
    python benchmarks/live.py -n 1000 --length 10 --engine 1             long streams
    python benchmarks/live.py -n 4 --engine 1 --liquids                  open liquids
    python benchmarks/live.py -n 300 --kinds arrivals                    how long new goals take beside the best known
    python benchmarks/live.py -n 34 --kinds obstacles --jobs 16          balls and posts come at the load, in real time
    python benchmarks/live.py -n 34 --kinds virtual                      where planning takes its processor time
    python benchmarks/live.py -n 170 --kinds faults --engine 1           while everything around them fails
    python benchmarks/live.py -n 34 --kinds overrides rests              speed override and hold
    python benchmarks/live.py -n 1 --kinds loop                          the 1 kHz loop beside a planner, in real time

    ... [-o out/live.jsonl] [--seconds 300] [--jobs 16]    add lines to a file; what stands there is not done again
    ... [-o out/live.jsonl] --summary                      print what is known
    ... [-o out/live.jsonl] --docs                         write it into docs/data, for `make pages`

Times are CPU times of one core, in the same process. What was executed is judged as one motion, at every millisecond
and from its own beginning; every so many runs (--engine) it is then run in the physics engine, where the load is as far
from nominal as it may be, beside what a filter makes of the same stream that knows the arm's limits and no load.

What runs in real time comes first, and each such session counts as three jobs: a loop, its planner and a camera.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from multiprocessing import Pool
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "helpers"))
import live_loop
import salver as sv
from lines import Line, read, taken, write
from live_arrivals import HIGHEST, LOWEST, arrival
from live_faults import faulty
from live_obstacles import encounters, way_out, write_situation
from live_page import told_of
from live_runs import EVERY, drive, executed, halted, in_turn, rows_of
from live_speed import session, ways_to_rest
from live_streams import SECONDS, STREAMS, clipped, stream
from salver.campaigns.summary import DROPPED, LARGEST_SLIP
from salver.errors import Status
from salver.files import read_json, write_atomic
from salver.live import Live
from salver.live.replanning.steer import TICK
from salver.planning.fastest import TransportProblem, joint_plan
from salver.trajectory import JointMotion

SCENARIOS = ("panda-cube", "panda-tall-bottle")
LOADS = (*SCENARIOS, "ur3-cup", "ur5-bottle", "ur10-bottle", "gen3-cup")
LIQUIDS = ("panda-coffee", "panda-four-glasses", "ur10-beaker")
LOST = (*DROPPED, "spills")
LOWEST_UR10, HIGHEST_UR10 = np.array([0.45, -0.30, 0.50]), np.array([0.75, 0.30, 0.80])  # m, of goals of a UR10
TIMED = 10  # long streams of each kind of which it is kept what every step took
SILENCE = 1.4  # s after a stream
LAGS = np.arange(0.0, 0.06, 1e-3)  # s
NOTHING = Status("optimal", "", True)
DOCS = Path(__file__).parent.parent / "docs" / "data"
TOGETHER = 5  # encounters with obstacles in one session
WITHIN, GRACE = 0.75, 20.0  # share of the time that real time may take; s for a run that has begun
LOOP = 60.0  # s
Job = tuple[Namespace, float, str, str, list[int]]  # what was asked, until when, the load, the kind, which runs


class Planned:
    """A live motion whose steps of planning are counted: s of each that did something, and how many were committed."""

    def __init__(self, live: Live) -> None:
        self.live, self.cpu, self.committed = live, [], 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.live, name)

    def plan(self, budget: float) -> None:
        if self.live.idle:
            return
        before, begun = self.live._offer, time.process_time()
        self.live.plan(budget)
        self.cpu.append(time.process_time() - begun)
        self.committed += self.live._offer is not before


def lost(problem: TransportProblem, motion: JointMotion, rng: np.random.Generator) -> bool:
    """Whether the engine loses the load at a random corner of its ranges: it tips, lifts, spills or slips too far."""
    plan = joint_plan(problem.scenario, problem, motion, NOTHING, {})
    uncertain = plan.uncertain
    corner = uncertain.nominal + uncertain.half_range * rng.choice([-1, 1], len(uncertain.names))
    run = sv.simulate(plan, parameters=dict(zip(map(str, uncertain.names), corner.tolist(), strict=True)))
    return run.outcome in LOST or max(item["peak_slip"] for item in run.summary["objects"]) > LARGEST_SLIP


def goals(scenario: sv.Scenario, rng: np.random.Generator) -> tuple[Planned, tuple, dict[str, float]]:
    """Goals that change at random times, and now and then a stop; how many there were."""
    live = Planned(Live(scenario, lead=0.1))
    t, wishes = 0.0, []
    region = (LOWEST_UR10, HIGHEST_UR10) if scenario.name.startswith("ur10") else (LOWEST, HIGHEST)
    while t < 2.0:
        place = rng.uniform(*region)
        stop = rng.random() < 0.2
        wishes.append((t, lambda _, place=place, stop=stop: halted(live) if stop else live.goto(place)))
        t += rng.uniform(0.1, 0.7)
    states = drive(live, 2.0, wishes)
    return live, in_turn(states, drive(live, 1.6, begins=2.0)), {"changes": len(wishes)}


KINDS = ["goals that change", *STREAMS]


def twists(scenario: sv.Scenario, told, seconds: float) -> tuple[Planned, tuple, dict[str, float]]:
    """A stream of twists, 100 a second, and then silence; how far off what is wanted they were, as a share, and by
    how much later they were what is wanted, s."""
    live = Planned(Live(scenario, lead=TICK))
    times = np.arange(0.0, seconds, 0.01)
    said = [(t, told(t)) for t in times]
    wishes = [(t, lambda _, v=v: live.twist(v)) for t, v in said if v is not None]
    states = drive(live, seconds, wishes, EVERY)
    arm, followed = live.problem.arm, []
    for q, dq in zip(states[0][::10], states[1][::10], strict=True):
        followed.append(arm.tray_pose(q)[1] @ (arm.body_jacobian(q) @ dq)[:3])
    wanted, followed = np.array([np.zeros(3) if v is None else v for _, v in said]), np.array(followed)
    off = [_off(times, followed, wanted, late) for late in LAGS]
    silence = drive(live, SILENCE, every=EVERY, begins=seconds)
    return live, in_turn(states, silence), {"error": off[0], "lag": float(LAGS[int(np.argmin(off))])}


def _off(t: np.ndarray, followed: np.ndarray, wanted: np.ndarray, late: float) -> float:
    """How far what was followed is from what was wanted so much earlier, as a share, from 0.2 s on."""
    before = np.stack([np.interp(t - late, t, column) for column in wanted.T], axis=1)
    return float(np.linalg.norm((followed - before)[20:]) / np.linalg.norm(wanted[20:]))


def drawn(name: str, kind: str, k: int) -> np.random.Generator:
    """What is random in the k-th run of a kind with a load."""
    return np.random.default_rng([13, (*SCENARIOS, *LIQUIDS).index(name), len(kind), k])


def run(name: str, kind: str, k: int, engine: bool, beside: bool, seconds: float) -> dict[str, Any]:
    """The k-th run of a kind with a load. engine: there too; beside: what a filter makes of it as well."""
    scenario, rng = sv.load_scenario(name), drawn(name, kind, k)
    told = stream(scenario, kind, rng, seconds) if kind in STREAMS else None
    live, states, off = goals(scenario, rng) if told is None else twists(scenario, told, seconds)
    motion, problem = executed(states), live.problem
    rows = rows_of(problem, states)
    found = {
        "ms": [round(1e3 * x, 1) for x in live.cpu] if k < TIMED or seconds <= SECONDS else [],
        "steps": len(live.cpu),
        "committed": live.committed,
        "worst": max(rows.values()),
        "speed": float(np.sqrt(np.mean([_speed(problem, motion, t) ** 2 for t in np.arange(0.2, seconds, 0.02)]))),
        **off,
    }
    if found["worst"] > 0:
        found["broken"] = sorted(name for name, value in rows.items() if value > 0)
    if engine:
        found["lost"] = lost(problem, motion, rng)
    if beside and told is not None:
        filtered = clipped(problem, motion.q[0], told, seconds)
        found["filter lost"] = lost(problem, filtered, rng)
        speeds = [_speed(problem, filtered, t) ** 2 for t in np.arange(0.2, seconds, 0.02)]
        found["filter speed"] = float(np.sqrt(np.mean(speeds)))
    return found


def _speed(problem: TransportProblem, motion: JointMotion, t: float) -> float:
    q, dq, _ = motion.sample(t)
    return float(np.linalg.norm((problem.arm.body_jacobian(q[0]) @ dq[0])[:3]))


def again(name: str, kind: str, k: int) -> np.random.Generator:
    """What is random in the k-th run of another kind with a load."""
    return np.random.default_rng([crc32(f"{name}, {kind}".encode()), k])


def streamed(name: str, kind: str, k: int, asked: Namespace) -> Line:
    # By a filter a liquid is lost beyond what the engine takes.
    beside = k % asked.filter == 0 and name not in LIQUIDS
    return run(name, kind, k, k % asked.engine == 0, beside, asked.length) | {"length": asked.length}


def judged(of: Callable[[str, np.random.Generator], tuple[Line, TransportProblem, JointMotion]], every: bool) -> Any:
    """A kind of run that is run in the engine too. every: of each run, not only of those asked for."""

    def one(name: str, kind: str, k: int, asked: Namespace) -> Line:
        rng = again(name, kind, k)
        found, problem, motion = of(name, rng)
        return found | ({"lost": lost(problem, motion, rng)} if every or k % asked.engine == 0 else {})

    return one


RUNS: dict[str, Callable[[str, str, int, Namespace], Line]] = {
    **dict.fromkeys(KINDS, streamed),
    "arrivals": lambda name, kind, k, _: arrival(sv.load_scenario(name), drawn(name, kind, k)),
    "faults": judged(faulty, False),
    "overrides": judged(session, True),
    "rests": lambda name, kind, k, _: ways_to_rest(name, again(name, kind, k)),
    "loop": lambda name, *_: live_loop.lateness(name, LOOP),
    "ways": lambda name, _, k, asked: {"way": way_out(name, _situation(asked.path, name, "obstacles", k))},
    "virtual ways": lambda name, _, k, asked: {"way": way_out(name, _situation(asked.path, name, "virtual", k))},
}
REAL = ("obstacles", "loop")  # what runs in real time
WAYS = {"obstacles": "ways", "virtual": "virtual ways"}  # searches where something hits


def _situation(path: Path, name: str, kind: str, k: int) -> Path:
    """Where the situation in which an obstacle was seen first is kept: beside the lines."""
    return path.parent / "situations" / f"{name}-{kind}-{k}.npz"


def work(job: Job) -> list[Line]:
    """The lines of some runs, written as they are made; none is begun when the time is over."""
    asked, until, name, kind, numbers = job
    lines = []
    if kind in WAYS:
        for k, found, situation in encounters(name, numbers, kind == "virtual", until):
            write_situation(_situation(asked.path, name, kind, k), situation)
            lines.append(write(asked.path, {"name": name, "kind": kind, "number": k} | found))
    elif time.time() < until:
        for k in numbers:
            lines.append(
                write(asked.path, {"name": name, "kind": kind, "number": k} | RUNS[kind](name, kind, k, asked))
            )
    return lines


def missing(asked: Namespace, kind: str, until: float) -> Iterator[Job]:
    """Jobs of a kind whose lines are missing."""
    lines = read(asked.path)
    done = {(line["name"], line["kind"], line["number"]) for line in lines}
    if kind in WAYS.values():
        of = next(first for first, then in WAYS.items() if then == kind)
        due = [
            (line["name"], line["number"])
            for line in lines
            if line["kind"] == of and line["would"] and line["hit"] is not None
        ]
    else:
        names = asked.liquids or (SCENARIOS if kind in (*KINDS, "arrivals") else LOADS)
        due = [(name, k) for k in range(asked.n) for name in (live_loop.KINDS if kind == "loop" else names)]
    left = [(name, k) for name, k in due if (name, kind, k) not in done]
    if kind not in WAYS:
        yield from ((asked, until, name, kind, [k]) for name, k in left)
        return
    for first in range(0, len(left), TOGETHER):  # all loads in turn
        for name in dict.fromkeys(name for name, _ in left):
            if some := [k for each, k in left if each == name][first : first + TOGETHER]:
                yield asked, until, name, kind, some


def benchmark(asked: Namespace) -> None:
    """Make the lines that are missing."""
    asked.path.parent.mkdir(parents=True, exist_ok=True)
    begun, end = time.time(), time.time() + asked.seconds
    real, rest = ([kind for kind in asked.kinds if (kind in REAL) is here] for here in (True, False))
    ways = [WAYS[kind] for kind in asked.kinds if kind in WAYS]
    for kinds, jobs, until in (
        (real, max(1, asked.jobs // 3), begun + WITHIN * asked.seconds if rest or ways else end),
        (rest, asked.jobs, end),
        (ways, asked.jobs, end),
    ):
        due = [job for kind in kinds for job in missing(asked, kind, until)]
        with Pool(min(jobs, max(1, len(due)))) as pool:
            for count, lines in enumerate(taken(pool.imap_unordered(work, due), until + GRACE), 1):
                for line in lines:
                    if line.get("worst", 0.0) > 0 or line.get("lost") or line.get("failed"):
                        print(line, flush=True)
                print(f"{count} of {len(due)} jobs, {end - time.time():.0f} s left", flush=True)


def gathered(lines: list[Line]) -> dict[str, dict[str, list[Line]]]:
    """Runs by file of docs/data, and by load and kind."""
    found: dict[str, dict[str, list[Line]]] = {}
    ways = {(line["name"], line["kind"], line["number"]): line["way"] for line in lines if "way" in line}
    for line in sorted(lines, key=lambda line: line["number"]):
        name, kind, number = (line.pop(key) for key in ("name", "kind", "number"))
        if kind in WAYS.values():
            continue
        length = line.pop("length", SECONDS)
        if kind in WAYS and (way := ways.get((name, WAYS[kind], number))) is not None:
            line["way"] = way
        files = dict.fromkeys(WAYS, "live-obstacles") | {"faults": "live-faults", "loop": "live-loop"}
        files |= dict.fromkeys(("overrides", "rests"), "live-speed")
        streams = "live-liquids" if name in LIQUIDS else "live" if length == SECONDS else "live-long"
        found.setdefault(files.get(kind, streams), {}).setdefault(f"{name}, {kind}", []).append(line)
    return found


def keep(path: Path, runs: dict[str, list[Line]]) -> None:
    """Runs by load and kind, one a line: so it can be read what came anew."""
    each = (f"{json.dumps(kind)}: [\n" + ",\n".join(map(json.dumps, kept)) + "\n]" for kind, kept in runs.items())
    write_atomic(path, "{\n" + ",\n".join(each) + "\n}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", type=Path, default=Path("out/live.jsonl"), dest="path", help="lines, added to")
    parser.add_argument("-n", type=int, default=4, help="runs of each kind with each load")
    parser.add_argument(
        "--kinds", nargs="*", default=KINDS, choices=[k for k in (*RUNS, *WAYS) if not k.endswith("ways")]
    )
    parser.add_argument("--engine", type=int, default=4, help="every so many of them in the engine too")
    parser.add_argument("--filter", type=int, default=4, help="and every so many as a filter does them")
    parser.add_argument("--length", type=float, default=SECONDS, help="s of a stream")
    parser.add_argument("--liquids", nargs="*", choices=LIQUIDS, help="of open liquids: these, or all")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--seconds", type=float, default=1e6, help="after which it stops")
    parser.add_argument("--summary", action="store_true", help="print what is known, and nothing else")
    parser.add_argument("--docs", action="store_true", help="write what is known into docs/data, and nothing else")
    asked = parser.parse_args()
    asked.liquids = LIQUIDS if asked.liquids == [] else asked.liquids
    if not (asked.summary or asked.docs):
        benchmark(asked)
    for name, runs in gathered(read(asked.path)).items():
        if asked.docs:
            at = DOCS / f"{name}.json"
            keep(at, (read_json(at) if at.exists() else {}) | runs)
        else:
            print(told_of(name, runs), flush=True)


if __name__ == "__main__":
    main()
