"""Balls and posts that come at an arm, with everything as it is by default: `live.py --kinds obstacles`.

A loop of 1 kHz commands, the default `Worker` plans in its process, and a camera reports at 30 Hz what comes, from a
random time before it would be there on. Half of the time the arm rests, half of it is on its way. What was commanded is
then held against the true way of what came, without any uncertainty. For each hit, a search without time limit looks
for a way out from the first tick after the obstacle was seen.

In real time, what the machine has to do besides counts. Otherwise planning takes the processor time that it takes, of a
loop's time that waits for it, as with a core of its own; with the very same decisions, in one process.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from itertools import product
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from live_arrivals import Region, region
from live_loop import PERIOD, prompt
from salver.files import read_result, save_result
from salver.geometry import GRAVITY_S
from salver.live import Live, Moving, Worker
from salver.live.committed.motion import Committed
from salver.live.replanning.obstacles import Movable, MovingClearance, predicted
from salver.live.replanning.planner import Answer, Job, Planner
from salver.live.replanning.replan import Replanner
from salver.live.replanning.steer import TICK
from salver.live.replanning.wishes import Refused, pose_goal
from salver.planning.fastest import TransportProblem
from salver.planning.verdict.margins import ConstraintMargins
from salver.trajectory import JointMotion

CAMERA = 1 / 30  # s between reports
SIGHT = 0.3, 1.5  # s before it would be there, from which on it is seen
ROOM = 0.1  # m that it is away at least when it is seen first
AFTER = 0.7  # s, until it has passed
KINDS = ("ball", "post")
MOTION = ("t", "q", "dq", "ddq")
FAR, AROUND = (0.25, 0.12, 0.4), 8  # m to the goals of the search without time limit, and directions of them
PATIENCE = 5.0  # s of it for each

Camera = Callable[[float], None]  # reports at a time of the loop's clock
Situation = tuple[
    Committed, float, Moving
]  # what was committed, the live time and what was seen when it was seen first


class Real:
    """A robot's loop in a thread of its own, with the default worker."""

    def __init__(self, live: Live) -> None:
        self.live, self.rows, self._ends = live, [], False
        self._thread, self._worker = threading.Thread(target=self._run, daemon=True), Worker(live)
        self.clock = time.perf_counter

    def __enter__(self) -> Real:
        self._thread.start()
        with prompt():
            self._worker.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._worker.close()
        self._ends = True
        self._thread.join()

    def _run(self) -> None:
        with prompt():
            while not self._ends:
                now = time.perf_counter()
                self.rows.append((now, self.live.command(now)[0].copy()))
                time.sleep(max(0.0, now + PERIOD - time.perf_counter()))

    def run(self, seconds: float, camera: Camera | None = None) -> None:
        begun, k = time.perf_counter(), 0
        with prompt():
            while (now := time.perf_counter()) < begun + seconds:
                if camera is not None:
                    camera(now)
                k += 1
                time.sleep(max(0.0, min(begun + k * CAMERA, begun + seconds) - time.perf_counter()))


class Virtual:
    """The same in a time of its own, in which planning takes its processor time."""

    def __init__(self, live: Live) -> None:
        self.live, self.rows, self._planner = live, [], Planner(live.problem)
        self._t, self._camera, self._seen = 0.0, None, -np.inf

    def __enter__(self) -> Virtual:
        self._real, time.perf_counter = time.perf_counter, time.process_time  # by which planners keep to their budget
        self._period()
        return self

    def __exit__(self, *_: object) -> None:
        time.perf_counter = self._real

    def clock(self) -> float:
        return self._t

    def _period(self) -> None:
        self._t += PERIOD
        self.rows.append((self._t, self.live.command(self._t)[0].copy()))
        if self._camera is not None and self._t - self._seen >= CAMERA:
            self._seen = self._t
            self._camera(self._t)

    def _answer(self, job: Job) -> Answer:
        begun = time.process_time()
        answer = self._planner.answer(job)
        for _ in range(round((time.process_time() - begun) / PERIOD)):
            self._period()
        return answer

    def run(self, seconds: float, camera: Camera | None = None) -> None:
        self._camera, self._seen, ends = camera, -np.inf, self._t + seconds
        while self._t < ends:
            self._period()
            if not self.live.idle:
                self.live.plan(2.0, self._answer)


def coming(kind: str, at: np.ndarray, seconds: float, rng: np.random.Generator) -> Moving:
    """What would be at a place in so many seconds, as it is seen now."""
    bearing = rng.uniform(-np.pi, np.pi)
    way = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    if kind == "ball":
        begin = at + rng.uniform(1.0, 2.5) * seconds * way + [0.0, 0.0, rng.uniform(-0.1, 0.5)]
        v = (at - begin) / seconds - 0.5 * seconds * GRAVITY_S
        return Moving("ball", "sphere", begin, v, GRAVITY_S, radius=0.05)
    v = -rng.uniform(0.3, 1.2) * way
    return Moving("post", "box", at - seconds * v, v, size=(0.08, 0.08, 0.5))


def away(movable: Movable, q: np.ndarray, seen: Moving) -> float:
    """m from an arm in a posture."""
    here = predicted(seen, 0.0)
    return float(movable.distances(q[None], here, here.at(np.zeros(1))[0]).min())


def later(first: Moving, dt: float, rng: np.random.Generator, when: float) -> Moving:
    """As a camera sees it dt later, with 2 mm and 2 cm/s of noise."""
    p, v, a = (np.asarray(x, dtype=float) for x in (first.position, first.velocity, first.acceleration))
    p, v = p + dt * v + 0.5 * dt**2 * a + rng.normal(0, 2e-3, 3), v + dt * a + rng.normal(0, 0.02, 3)
    return Moving(first.name, first.type, p, v, a, first.radius, first.length, first.size, seen=when)


def one(
    robot: Real | Virtual, home: np.ndarray, around: Region, movable: Movable, kind: str, rng: np.random.Generator
) -> tuple[dict[str, Any], Situation]:
    """What became of one; and the situation in which it was seen first."""
    live = robot.live
    live.obstacles([])
    live.goto(q=home)
    robot.run(0.1)
    while not live.settled:
        robot.run(0.1)
    sight, moves = float(rng.uniform(*SIGHT)), bool(rng.random() < 0.5)
    while moves and live.committed.ends - live.now < 0.2:
        live.goto(rng.uniform(*around))
        for _ in range(200):
            robot.run(0.01)
            if live.settled or live.now > live.committed.begins + 0.1:
                break
    base, body = live.committed, live.problem.items[0]
    q = base.state(live.now + sight)[0]
    target = live.problem.arm.object_pose(q, body.p_EB, body.R_EB)[0] + rng.normal(0, 0.03, 3)
    first = coming(kind, target, sight, rng)
    while away(movable, base.state(live.now)[0], first) < ROOM:
        first = coming(kind, target, sight, rng)
    begun, live_begun, rows = robot.clock(), live.now, len(robot.rows)
    truth, base = predicted(first, live_begun), live.committed
    reports: list[tuple[float, float, bool]] = []

    def camera(now: float) -> None:
        seen, asked = later(first, now - begun, rng, now), time.thread_time()
        live.obstacles([seen])
        said = bool(live.state.passing)
        reports.append((robot.clock() - begun, time.thread_time() - asked, said))

    robot.run(sight + AFTER, camera)
    t, q = (np.array(x) for x in zip(*robot.rows[rows::2], strict=True))
    t = t - begun
    free = movable.distances(q, truth, truth.at(live_begun + t)[0]).min(axis=1)
    hit = float(t[int(np.argmax(free <= 0.0))]) if free.min() <= 0.0 else None
    # What it would have come to, had nothing been done.
    still = base.motion.sample(np.clip(live_begun + t - base.begins, 0.0, base.motion.duration))[0]
    would = float(movable.distances(still, truth, truth.at(live_begun + t)[0]).min()) <= 0.0
    announced = next((at for at, _, said in reports if said), None)
    became = {
        "what": kind,
        "sight": round(sight, 3),
        "moves": moves,
        "would": would,
        "hit": None if hit is None else round(hit, 3),
        "announced": None if announced is None else round(announced, 4),
        "look": round(1e3 * max(took for _, took, *_ in reports), 2),
        "lead": round(live._lead.of("tick"), 3),
        "load": round(os.getloadavg()[0], 1),
        "cores": os.cpu_count(),
    }
    return became, (base, live_begun, first)


def way(problem: TransportProblem, movable: Movable, base: Committed, now: float, first: Moving) -> bool:
    """Whether a search that takes no time finds a verified motion, clear of what was seen first, from the next tick on:
    to a goal at some distance in some direction."""
    begins = TICK * np.ceil(now / TICK + 1e-9)
    passing = MovingClearance(movable, (predicted(first, now),), begins)
    replanner = Replanner.of(replace(problem, extra=(*problem.extra, passing)))
    body = problem.items[0]
    p, _ = problem.arm.object_pose(base.state(now + SIGHT[0])[0], body.p_EB, body.R_EB)
    turns = 2 * np.pi * np.arange(AROUND) / AROUND
    ways = [*np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1), [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    for far, aside in product(FAR, ways):
        try:
            goal = pose_goal(problem, p + far * np.asarray(aside))
        except Refused:
            continue
        if replanner.to(goal.end, base, begins, PATIENCE)[0] is not None:
            return True
    return False


def encounters(
    name: str, numbers: list[int], virtual: bool, until: float
) -> Iterator[tuple[int, dict[str, Any], Situation]]:
    """Balls (even numbers) and posts (odd ones) that come at a load, one after the other in one session, and the
    situation in which each was seen first; none begins after a time."""
    live = Live(name)
    home, around = live.committed.motion.q[0], region(live)
    movable = Movable(Live(name).problem.keep_out.parts)  # a live motion's own are its threads'
    with Virtual(live) if virtual else Real(live) as robot:
        for k in numbers:
            if time.time() > until:
                return
            rng = np.random.default_rng([17, crc32(name.encode()), k])
            yield k, *one(robot, home, around, movable, KINDS[k % len(KINDS)], rng)
            robot.rows.clear() if virtual else None


def write_situation(path: Path, situation: Situation) -> None:
    base, now, seen = situation
    knots = {key: getattr(base.motion, key) for key in MOTION}
    summary = {"begins": base.begins, "now": now, "seen": asdict(seen)}
    save_result(path, {**knots, "nodes": base.nodes, "deviation": base.deviation}, summary)


def read_situation(path: Path) -> Situation:
    """A situation as far as a way out depends on it: without the margins of what was committed."""
    arrays, found = read_result(path)
    motion, t = JointMotion(*(arrays[key] for key in MOTION)), arrays["nodes"]
    nothing = ConstraintMargins.of((), t, None)
    return Committed(found["begins"], motion, t, arrays["deviation"], nothing), found["now"], Moving(**found["seen"])


def way_out(name: str, path: Path) -> bool:
    """Whether a search without time limit finds a way out of the situation that is kept in a file."""
    problem = Live(name).problem
    return way(problem, Movable(Live(name).problem.keep_out.parts), *read_situation(path))


def evaded(run: dict[str, Any]) -> bool:
    return run["would"] and run["hit"] is None


def silent(run: dict[str, Any]) -> bool:
    """Whether it hit before it was announced, though it would have done so had nothing been done."""
    announced, hit = run["announced"], run["hit"]
    return run["would"] and hit is not None and (announced is None or announced > hit)


def missed(runs: list[dict[str, Any]]) -> tuple[int, int]:
    """How many hits a search without time limit found a way out of, and of how many it looked for one."""
    looked = [x["way"] for x in runs if x["would"] and not evaded(x) and "way" in x]
    return sum(looked), len(looked)


def delays(runs: list[dict[str, Any]]) -> np.ndarray:
    """ms from when each that would hit was seen first to its announcement."""
    return 1e3 * np.array([x["announced"] for x in runs if x["would"] and x["announced"] is not None])


def table(runs: dict[str, list[dict[str, Any]]]) -> str:
    """runs: by load."""
    rows = [HEAD]
    for name, kind in product(runs, KINDS):
        of = [x for x in runs[name] if x["what"] == kind]
        threat, late = sum(x["would"] for x in of), delays(of)
        clear, quiet = sum(map(evaded, of)), sum(map(silent, of))
        delay = f"{np.median(late):.0f} / {np.quantile(late, 0.99):.0f} / {late.max():.0f}" if len(late) else ""
        rows.append(
            f"| {name} | {kind} | {threat} | {clear} | {threat - clear - quiet} | {quiet} | "
            f"{' of '.join(map(str, missed(of)))} | {delay} | {max((x['look'] for x in of), default=0.0):.1f} | "
            f"{sum(x['hit'] is not None for x in of if not x['would'])} |"
        )
    return "\n".join(rows)


HEAD = (
    "| load | what | would hit | evaded | hit, announced | hit in silence | hits with a way out, of those searched | "
    "announced after, ms: median / 99 % / largest | look, ms of CPU at most | hit that would not |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)
