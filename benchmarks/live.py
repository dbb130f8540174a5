"""Live motions: how long a change takes, what is followed, and whether anything is dropped.

python benchmarks/live.py [-n RUNS] [--engine EVERY] [--seconds S] [--docs]     # --docs writes docs/live.md
    python benchmarks/live.py -n 1000 --length 10 --engine 1 --data docs/data/live-long.json    # long streams
    python benchmarks/live.py --liquids -n 4 --engine 1 --docs    # open liquids; writes a table into docs/liquids.md
    python benchmarks/live.py -n 100 --kinds arrivals    # how long new goals take beside the best known

Runs are kept in docs/data/live.json, of liquids in live-liquids.json, and are not made again (--again: all anew), so
that counts can be gone on with.
Times are CPU times of one core, in the same process. What was executed is judged as one motion, at every millisecond
and from its own beginning; every so many runs (--engine) it is then run in the physics engine, where the load is as far
from nominal as it may be, beside what a filter makes of the same stream that knows the arm's limits and no load.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "docs"))
sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from blocks import replace as written

import salver as sv
from live_runs import PATIENCE, PERIOD, drive, executed, in_turn, rows_of
from salver.campaigns.summary import DROPPED, FAR
from salver.errors import Status
from salver.files import read_json, write_json
from salver.live import Live
from salver.live.planner import Answer, Job
from salver.live.steer import TICK
from salver.planning.fastest import AtPosture, TransportProblem, evaluate, fastest, joint_plan
from salver.playground import World
from salver.statistics import clopper_pearson
from salver.trajectory import JointMotion

SCENARIOS = ("panda-cube", "panda-tall-bottle")
LIQUIDS = ("panda-coffee", "panda-four-glasses", "ur10-beaker")
LOST = (*DROPPED, "spills")
BALLS, EVADING = 10, 0.5  # s from a look at a ball to what is done about it
LOWEST, HIGHEST = np.array([0.40, -0.40, 0.35]), np.array([0.55, 0.15, 0.60])  # m, of goals; of a UR10:
LOWEST_UR10, HIGHEST_UR10 = np.array([0.45, -0.30, 0.50]), np.array([0.75, 0.30, 0.80])
TIMED = 10  # long streams of each kind of which it is kept what every step took
SECONDS, SILENCE = 1.5, 1.4  # s of a stream, and after it
LAGS = np.arange(0.0, 0.06, 1e-3)  # s
SPARED = 0.2  # of what contact keeps at rest, that a gentle stream leaves, followed as it is told
NOTHING = Status("optimal", "", True)
DOCS = Path(__file__).parent.parent / "docs"
PAGE, DATA, LONG = DOCS / "live.md", DOCS / "data" / "live.json", DOCS / "data" / "live-long.json"
LIQUIDS_PAGE, LIQUIDS_DATA = DOCS / "liquids.md", DOCS / "data" / "live-liquids.json"


ARRIVALS, LATE = "arrivals", 0.15  # a change of goal; share by which it may come later than the best known


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
    return run.outcome in LOST or max(item["peak_slip"] for item in run.summary["objects"]) > FAR


def goals(scenario: sv.Scenario, rng: np.random.Generator) -> tuple[Planned, tuple, dict[str, float]]:
    """Goals that change at random times, and now and then a stop; how many there were."""
    live = Planned(Live(scenario, lead=0.1))
    t, wishes = 0.0, []
    region = (LOWEST_UR10, HIGHEST_UR10) if scenario.name.startswith("ur10") else (LOWEST, HIGHEST)
    while t < 2.0:
        place = rng.uniform(*region)
        stop = rng.random() < 0.2
        wishes.append((t, lambda _, place=place, stop=stop: live.stop() if stop else live.goto(place)))
        t += rng.uniform(0.1, 0.7)
    states = drive(live, 2.0, wishes)
    return live, in_turn(states, drive(live, 1.6, begins=2.0)), {"changes": len(wishes)}


def arrival(name: str, k: int) -> dict[str, float | None]:
    """A goal that changes at a random time of the way to another: s from the hand-over until the arm is at rest there,
    by the live motion and by a search as thorough as offline, from the same state; None where none was found."""
    rng = np.random.default_rng([13, (*SCENARIOS, *LIQUIDS).index(name), len(ARRIVALS), k])
    live, jobs, found = Live(sv.load_scenario(name), lead=0.1), [], []

    def noted(job: Job) -> Answer:
        jobs.append(job)
        found.append(live._planner.answer(job).found)
        return Answer(None, NOTHING)

    drive(live, rng.uniform(0.2, 0.7), [(0.0, lambda _: live.goto(rng.uniform(LOWEST, HIGHEST)))])
    live.goto(rng.uniform(LOWEST, HIGHEST))
    live.plan(PATIENCE, noted)
    job = jobs[0]
    start = AtPosture(*job.base.state(job.begins))
    searched = fastest(job.base.left(job.begins, replace(live.problem, start=start, goal=job.wish.end)))
    taken = None if found[0] is None else found[0].ends - job.begins
    return {"taken": taken, "searched": searched.duration if searched.status.ok else None}


def arrived(name: str, each: list[dict[str, float | None]]) -> str:
    """What changes of goal came to beside the best known, in words."""
    found = np.array([[np.inf if x is None else x for x in (way["taken"], way["searched"])] for way in each])
    found = found[np.isfinite(found).any(axis=1)]
    over = found[:, 0] / found.min(axis=1)
    return (
        f"{name}, of {len(over)} goals that either found a way to {100 * np.mean(over <= 1 + LATE):.1f} % are reached "
        f"within {100 * LATE:.0f} % of the best known time, at the median {100 * np.median(over) - 100:.1f} % above it "
        f"({np.isinf(over).sum()} are not found at once)"
    )


def gentle(rng: np.random.Generator, seconds: float = SECONDS):
    rate, phase = rng.uniform(0.5, 3.0, 3), rng.uniform(0, 6, 3)
    return lambda t: np.array([0.12, 0.15, 0.05]) * (np.sin(rate * t + phase) - (1 - min(t, 0.4) / 0.4) * np.sin(phase))


def hostile(rng: np.random.Generator, seconds: float = SECONDS):
    """Another velocity every 0.13 s."""
    speeds = rng.uniform(-1.3, 1.3, (max(40, int(seconds / 0.13) + 1), 3)) * [1, 1, 0.4]
    return lambda t: speeds[int(t / 0.13)]


def noise(rng: np.random.Generator, seconds: float = SECONDS):
    """Of up to 5 Hz."""
    rate, phase = 2 * np.pi * rng.uniform(0.5, 5.0, (6, 3)), rng.uniform(0, 6, (6, 3))
    return lambda t: np.array([0.4, 0.4, 0.15]) * np.sin(rate * t + phase).sum(axis=0)


def gaps(rng: np.random.Generator, seconds: float = SECONDS):
    """Velocities, and times at which nothing is said."""
    speeds, silent = hostile(rng, seconds), rng.random(max(40, int(seconds / 0.09) + 1)) < 0.4
    return lambda t: None if silent[int(t / 0.09)] else speeds(t)


STREAMS = {"gentle twists": gentle, "hostile twists": hostile, "noise up to 5 Hz": noise, "twists with gaps": gaps}
KINDS = ["goals that change", *STREAMS]


def twists(scenario: sv.Scenario, told, seconds: float) -> tuple[Planned, tuple, dict[str, float]]:
    """A stream of twists, 100 a second, and then silence; how far off what is wanted they were, as a share, and by
    how much later they were what is wanted, s."""
    live = Planned(Live(scenario, lead=TICK))
    times = np.arange(0.0, seconds, 0.01)
    said = [(t, told(t)) for t in times]
    wishes = [(t, lambda _, v=v: live.twist(v)) for t, v in said if v is not None]
    states = drive(live, seconds, wishes, round(TICK / PERIOD))
    arm, followed = live.problem.arm, []
    for q, dq in zip(states[0][::10], states[1][::10], strict=True):
        followed.append(arm.tray_pose(q)[1] @ (arm.body_jacobian(q) @ dq)[:3])
    wanted, followed = np.array([np.zeros(3) if v is None else v for _, v in said]), np.array(followed)
    off = [_off(times, followed, wanted, late) for late in LAGS]
    silence = drive(live, SILENCE, every=round(TICK / PERIOD), begins=seconds)
    return live, in_turn(states, silence), {"error": off[0], "lag": float(LAGS[int(np.argmin(off))])}


def _off(t: np.ndarray, followed: np.ndarray, wanted: np.ndarray, late: float) -> float:
    """How far what was followed is from what was wanted so much earlier, as a share, from 0.2 s on."""
    before = np.stack([np.interp(t - late, t, column) for column in wanted.T], axis=1)
    return float(np.linalg.norm((followed - before)[20:]) / np.linalg.norm(wanted[20:]))


def spared(problem: TransportProblem, q: np.ndarray, told, seconds: float) -> float:
    """The largest row of a stream that is followed as it is told, with the tray level; of contact, with a share of what
    it is at rest left over."""
    arm, step = problem.arm, 5e-3
    level, rows = arm.tray_pose(q)[1], []
    for t in np.arange(0.0, seconds, step):
        R = arm.tray_pose(q)[1]
        turned = 0.5 * sum(np.cross(R[:, i], level[:, i]) for i in range(3))
        dq = np.linalg.pinv(arm.body_jacobian(q)) @ np.concatenate([R.T @ told(t), R.T @ (5.0 * turned)])
        rows.append((q, dq))
        q = q + step * dq
    q_all, dq_all = map(np.array, zip(*rows, strict=True))
    ddq = np.gradient(dq_all, step, axis=0)
    z = np.stack([q_all, dq_all, ddq, np.gradient(ddq, step, axis=0)])
    s = np.linspace(0.0, 1.0, len(rows))
    constraints = [constraint.near(q_all[::5]) for constraint in problem.constraints]
    still = np.zeros_like(z[:, :5])
    still[0] = q_all[0]
    at_rest, moving = (
        evaluate(constraints, replace(problem.at(at, states, step * (len(s) - 1), imposed=False), moving=False))
        for at, states in ((s[:5], still), (s, z))
    )
    left = [SPARED * float(a.values.max()) if a.name.startswith("contact") else 0.0 for a in at_rest]
    along = ((b, x) for b, x in zip(moving, left, strict=True) if len(b.values) > 20)  # and not after it
    return max(float(b.values[20:].max()) - x for b, x in along)


def within(x: np.ndarray, limit: np.ndarray) -> np.ndarray:
    return x * min(1.0, float(np.min(limit / np.maximum(np.abs(x), 1e-12))))


def clipped(problem: TransportProblem, q: np.ndarray, told, seconds: float) -> JointMotion:
    """What a filter makes of a stream that keeps the tray's orientation and the joints' own limits of position, speed,
    acceleration and jerk, and knows of no load: velocities by the Jacobian's pseudo-inverse, at 1 kHz; what is beyond a
    limit is made shorter, all joints alike."""
    arm, limits = problem.arm, problem.limits
    dq, ddq = np.zeros_like(q), np.zeros_like(q)
    level, rows = arm.tray_pose(q)[1], [(q, dq, ddq)]
    for k in range(round((seconds + 0.8) / PERIOD)):
        t = k * PERIOD
        v = told(round(t, 2)) if t < seconds - 0.011 else None
        R = arm.tray_pose(q)[1]
        turned = 0.5 * sum(np.cross(R[:, i], level[:, i]) for i in range(3))  # rad, to where it should be, in S
        wanted = np.concatenate([R.T @ (np.zeros(3) if v is None else v), R.T @ (5.0 * turned)])
        asked = np.linalg.pinv(arm.body_jacobian(q), rcond=1e-2) @ wanted
        room = np.sqrt(np.maximum(limits.acceleration * np.stack([limits.q_max - q, q - limits.q_min]), 0.0))
        asked = within(asked, np.minimum(limits.velocity, np.where(asked > 0, *room)))
        ddq = ddq + within(within((asked - dq) / 0.02, limits.acceleration) - ddq, limits.jerk * PERIOD)
        q, dq = q + PERIOD * dq + 0.5 * PERIOD**2 * ddq, dq + PERIOD * ddq
        rows.append((q, dq, ddq))
    q_all, dq_all, ddq_all = map(np.array, zip(*rows, strict=True))
    dq_all[-1] = ddq_all[-1] = 0.0
    return JointMotion(PERIOD * np.arange(len(q_all)), q_all, dq_all, ddq_all)


def stream(name: str, kind: str, rng: np.random.Generator, seconds: float):
    """One of a kind; a gentle one can be followed as it is told, with some of the contact to spare."""
    if not kind.startswith("gentle"):
        return STREAMS[kind](rng, seconds)
    live = Live(sv.load_scenario(name))
    while True:
        told = gentle(rng, seconds)
        if spared(live.problem, live.committed.motion.q[0], told, seconds) <= 0.0:
            return told


def run(name: str, kind: str, k: int, engine: bool, beside: bool, seconds: float) -> dict[str, Any]:
    """The k-th run of a kind with a load. engine: there too; beside: what a filter makes of it as well."""
    scenario = sv.load_scenario(name)
    rng = np.random.default_rng([13, (*SCENARIOS, *LIQUIDS).index(name), len(kind), k])
    told = stream(name, kind, rng, seconds) if kind in STREAMS else None
    live, states, off = goals(scenario, rng) if told is None else twists(scenario, told, seconds)
    motion, problem = executed(states), live.problem
    found = {
        "ms": [round(1e3 * x, 1) for x in live.cpu] if k < TIMED or seconds <= SECONDS else [],
        "steps": len(live.cpu),
        "committed": live.committed,
        "worst": max(rows_of(problem, states).values()),
        "speed": float(np.sqrt(np.mean([_speed(problem, motion, t) ** 2 for t in np.arange(0.2, seconds, 0.02)]))),
        **off,
    }
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


def longer() -> str:
    """What the long streams came to, in words and a table."""
    if not LONG.is_file():
        return ""
    runs = {what: kept for what, kept in read_json(LONG).items() if kept}
    each = [x for kept in runs.values() for x in kept]
    broken, gone = sum(x["worst"] > 0 for x in each), sum(x["lost"] for x in each)
    rate = clopper_pearson(broken + gone, len(each))
    rows = [row(*what.split(", "), kept) for what, kept in runs.items()]
    return (
        f"Streams of 10 s, {len(each)}, each in the engine too (`--length 10 --engine 1 --data "
        f"docs/data/live-long.json`; times of the first\n{TIMED} of each kind): {broken} broke a row, "
        f"{gone} lost the load (95 % interval of either: {100 * rate.low:.2g} to {100 * rate.high:.2g} %).\n\n{TABLE}\n"
        + "\n".join(rows)
    )


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


def balls(scenario: sv.Scenario, count: int) -> tuple[int, int]:
    """Of so many balls that are thrown at the load: how many were evaded, and of how many of the others it was told."""
    evaded = told = 0
    for seed in range(count):
        world = World(scenario, lead=EVADING)
        world.ball.thrown_by(np.random.default_rng(seed))
        world.say({"throw": True})
        said = False
        for k in range(1300):
            world.advance()
            if k % 20 == 0:
                world.live.plan(10.0)
            if k % 5 == 0:
                world.measure()
            said |= bool(world.live.state.passing)
        missed = world.ball.passed > 0
        evaded, told = evaded + missed, told + (said and not missed)
    return evaded, told


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

Balls that are thrown from the side at what stands on the tray, seen 1.2 s before they are there and every 0.1 s from
then on, with {evading:.1f} s from each look to what is done: {balls}.

`command` takes {median:.1f} us at the median and {most:.0f} us at 99.9 %.

A row is broken when, with what was executed judged as one motion at every millisecond from its own beginning, any of
the conditions of a fastest motion is exceeded, without margins. The nearest to an edge that any run came: {worst:.1e}
of what is limited (0 is the edge).

What is wanted is, at the median, 60 ms (cube) and 200 ms (bottle) for a change of goal, 10 and 15 ms for a tick.
Published, on other machines and for other tasks: *Keep It Upright* (Heins and Schoellig, RA-L 2023) replans within 10
ms with a horizon of 2 s, in C++; FZI's shared control steps in 13 ms
([arXiv 2506.23624](https://arxiv.org/abs/2506.23624)).
"""


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=4, help="runs of each kind with each load")
    parser.add_argument("--engine", type=int, default=4, help="every so many of them in the engine too")
    parser.add_argument("--filter", type=int, default=4, help="and every so many as a filter does them")
    parser.add_argument("--length", type=float, default=SECONDS, help="s of a stream")
    parser.add_argument("--kinds", nargs="*", default=KINDS, help=f"some of them only, or {ARRIVALS}")
    parser.add_argument("--seconds", type=float, default=np.inf, help="begin no further run after so long")
    parser.add_argument("--again", action="store_true", help="forget what is kept")
    parser.add_argument("--liquids", nargs="*", choices=LIQUIDS, help="of open liquids: these, or all")
    parser.add_argument("--data", type=Path, help="where runs are kept")
    parser.add_argument("--docs", action="store_true", help="write docs/live.md, or the table in docs/liquids.md")
    asked = parser.parse_args()
    wet = asked.liquids is not None
    asked.data = asked.data or (LIQUIDS_DATA if wet else DATA)
    scenarios = (asked.liquids or LIQUIDS) if wet else SCENARIOS
    begun = time.monotonic()
    runs = read_json(asked.data) if asked.data.is_file() and not asked.again else {}
    each = [(name, kind) for name in scenarios for kind in asked.kinds]
    for k in range(asked.n):
        for name, kind in each:
            kept = runs.setdefault(f"{name}, {kind}", [])
            if len(kept) == k and time.monotonic() - begun < asked.seconds:
                # By a filter a liquid is lost beyond what the engine takes.
                beside = k % asked.engine == 0, k % asked.filter == 0 and not wet
                kept.append(arrival(name, k) if kind == ARRIVALS else run(name, kind, k, *beside, asked.length))
                write_json(asked.data, runs)
                if kept[-1].get("worst", 0.0) > 0 or kept[-1].get("lost"):
                    print(f"{name}, {kind}, run {k}: {kept[-1]['worst']:.2e}, lost: {kept[-1].get('lost')}", flush=True)
    changes = [arrived(name, kept) for name in scenarios if (kept := runs.pop(f"{name}, {ARRIVALS}", []))]
    rows = [row(*what.split(", "), kept) for what, kept in runs.items() if kept]
    print("\n".join(rows), faster(runs), ";\n".join(changes), sep="\n", flush=True)
    if asked.docs and wet:
        nearest = max(x["worst"] for kept in runs.values() for x in kept)
        said = f"The nearest to an edge (0) that any came: {nearest:.1e} of what is limited."
        written(LIQUIDS_PAGE, "live", "\n".join([TABLE, *rows, "", said]))
    if not asked.docs or wet:
        return
    thrown = []
    for name in SCENARIOS:
        evaded, told = balls(sv.load_scenario(name), BALLS)
        thrown.append(f"{name}, {evaded} of {BALLS} evaded, {told} of the others announced")
        print(thrown[-1], flush=True)
    median, most = commands(sv.load_scenario(SCENARIOS[0]))
    print(f"command: {median:.1f} us, {most:.1f} us at 99.9 %")
    every = [*runs.values(), *(read_json(LONG).values() if LONG.is_file() else [])]
    worst = max(x["worst"] for kept in every for x in kept)
    words = {"table": TABLE, "changes": ";\n".join(changes), "longer": longer(), "spared": 100 * SPARED}
    numbers = {"median": median, "most": most, "worst": worst, "balls": ";\n".join(thrown), "evading": EVADING}
    PAGE.write_text(
        HEAD.format(n=asked.n, rows="\n".join(rows), faster=faster(runs), **words, **numbers), encoding="utf-8"
    )


if __name__ == "__main__":
    main()
