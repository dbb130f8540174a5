"""Live motions: how long a change takes, what is followed, and whether anything is dropped.

python benchmarks/live.py [-n RUNS] [--engine EVERY] [--seconds S]
    python benchmarks/live.py -n 1000 --length 10 --engine 1 --data docs/data/live-long.json    # long streams
    python benchmarks/live.py --liquids -n 4 --engine 1    # open liquids
    python benchmarks/live.py -n 100 --kinds arrivals    # how long new goals take beside the best known
    python benchmarks/live.py --kinds obstacles [--virtual]    # balls and posts that come at the load, in real time
    python benchmarks/live.py -n 150 --kinds faults    # while everything around them fails

Runs are kept in docs/data/live.json, of liquids in live-liquids.json, and are not made again (--again: all anew), so
that counts can be gone on with. `make pages` writes docs/live.md and a table of docs/liquids.md from them.
Times are CPU times of one core, in the same process. What was executed is judged as one motion, at every millisecond
and from its own beginning; every so many runs (--engine) it is then run in the physics engine, where the load is as far
from nominal as it may be, beside what a filter makes of the same stream that knows the arm's limits and no load.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "helpers"))
import salver as sv
from live_arrivals import HIGHEST, LOWEST, arrival, arrived
from live_faults import faults_in_words, faulty
from live_obstacles import table, throws
from live_page import faster, row
from live_runs import EVERY, drive, executed, halted, in_turn, rows_of
from live_streams import SECONDS, STREAMS, clipped, stream
from salver.campaigns.summary import DROPPED, LARGEST_SLIP
from salver.errors import Status
from salver.files import read_json, write_atomic
from salver.live import Live
from salver.live.replanning.steer import TICK
from salver.planning.fastest import TransportProblem, joint_plan
from salver.trajectory import JointMotion

SCENARIOS = ("panda-cube", "panda-tall-bottle")
LIQUIDS = ("panda-coffee", "panda-four-glasses", "ur10-beaker")
LOST = (*DROPPED, "spills")
LOWEST_UR10, HIGHEST_UR10 = np.array([0.45, -0.30, 0.50]), np.array([0.75, 0.30, 0.80])  # m, of goals of a UR10
TIMED = 10  # long streams of each kind of which it is kept what every step took
SILENCE = 1.4  # s after a stream
LAGS = np.arange(0.0, 0.06, 1e-3)  # s
NOTHING = Status("optimal", "", True)
DOCS = Path(__file__).parent.parent / "docs"
DATA, LIQUIDS_DATA, FAULTS_DATA = (DOCS / "data" / f"{name}.json" for name in ("live", "live-liquids", "live-faults"))


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


KINDS, ARRIVALS, FAULTS, OBSTACLES = ["goals that change", *STREAMS], "arrivals", "faults", "obstacles"


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


def failed(name: str, k: int, engine: bool) -> dict[str, Any]:
    """The k-th run with a load in which everything else fails. engine: there too."""
    rng = drawn(name, FAULTS, k)
    found, problem, motion = faulty(sv.load_scenario(name), rng)
    return found | ({"lost": lost(problem, motion, rng)} if engine else {})


def _speed(problem: TransportProblem, motion: JointMotion, t: float) -> float:
    q, dq, _ = motion.sample(t)
    return float(np.linalg.norm((problem.arm.body_jacobian(q[0]) @ dq[0])[:3]))


def commands(scenario: sv.Scenario) -> tuple[float, float]:
    """CPU time of `command`, us: median and 99.9 % of means of ten."""
    live = Live(scenario, lead=0.1)
    drive(live, 0.4, [(0.0, lambda _: live.goto((0.45, 0.1, 0.45)))])
    spent = []
    for k in range(5000):
        begun = time.thread_time_ns()
        live.command(0.4 + 1e-4 * k)
        spent.append(1e-3 * (time.thread_time_ns() - begun))
    return float(np.median(spent)), float(np.quantile(spent, 0.999))


def keep(path: Path, runs: dict[str, list[dict[str, Any]]]) -> None:
    """Runs by kind, one a line: so it can be read what came anew."""
    line = json.JSONEncoder(default=lambda number: number.item()).encode
    each = (f"{json.dumps(kind)}: [\n" + ",\n".join(map(line, kept)) + "\n]" for kind, kept in runs.items())
    write_atomic(path, "{\n" + ",\n".join(each) + "\n}\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=4, help="runs of each kind with each load")
    parser.add_argument("--engine", type=int, default=4, help="every so many of them in the engine too")
    parser.add_argument("--filter", type=int, default=4, help="and every so many as a filter does them")
    parser.add_argument("--length", type=float, default=SECONDS, help="s of a stream")
    parser.add_argument(
        "--kinds", nargs="*", default=KINDS, help=f"some of them only, {ARRIVALS}, {FAULTS}; or {OBSTACLES}"
    )
    parser.add_argument("--seconds", type=float, default=np.inf, help="begin no further run after so long")
    parser.add_argument("--again", action="store_true", help="forget what is kept")
    parser.add_argument("--virtual", action="store_true", help="of obstacles: planning has a core of its own")
    parser.add_argument("--liquids", nargs="*", choices=LIQUIDS, help="of open liquids: these, or all")
    parser.add_argument("--data", type=Path, help="where runs are kept")
    asked = parser.parse_args()
    wet = asked.liquids is not None
    asked.data = asked.data or (LIQUIDS_DATA if wet else FAULTS_DATA if asked.kinds == [FAULTS] else DATA)
    scenarios = (asked.liquids or LIQUIDS) if wet else SCENARIOS
    if asked.kinds == [OBSTACLES]:
        came = {name: throws(name, asked.n, asked.virtual) for name in scenarios}
        path = DATA.with_name(f"live-obstacles-{'virtual' if asked.virtual else 'real'}.json")
        write_atomic(path, json.dumps(came, indent=1, default=lambda x: x.item()) + "\n")
        print(table(came))
        return
    begun = time.monotonic()
    runs = read_json(asked.data) if asked.data.is_file() and not asked.again else {}
    each = [(name, kind) for name in scenarios for kind in asked.kinds]
    for k in range(asked.n):
        for name, kind in each:
            kept = runs.setdefault(f"{name}, {kind}", [])
            if len(kept) == k and time.monotonic() - begun < asked.seconds:
                # By a filter a liquid is lost beyond what the engine takes.
                beside = k % asked.engine == 0, k % asked.filter == 0 and not wet
                kept.append(
                    arrival(sv.load_scenario(name), drawn(name, kind, k))
                    if kind == ARRIVALS
                    else failed(name, k, beside[0])
                    if kind == FAULTS
                    else run(name, kind, k, *beside, asked.length)
                )
                keep(asked.data, runs)
                if kept[-1].get("worst", 0.0) > 0 or kept[-1].get("lost"):
                    print(f"{name}, {kind}, run {k}: {kept[-1]['worst']:.2e}, lost: {kept[-1].get('lost')}", flush=True)
    for name in scenarios:
        if faults := runs.pop(f"{name}, {FAULTS}", []):
            print(f"{name}: {faults_in_words(faults)}")
    changes = [arrived(name, kept) for name in scenarios if (kept := runs.pop(f"{name}, {ARRIVALS}", []))]
    rows = [row(*what.split(", "), kept) for what, kept in runs.items() if kept]
    print("\n".join(rows), faster(runs), ";\n".join(changes), sep="\n", flush=True)
    if not wet:
        median, most = commands(sv.load_scenario(SCENARIOS[0]))
        print(f"`command` takes {median:.1f} us at the median and {most:.0f} us at 99.9 %.")


if __name__ == "__main__":
    main()
