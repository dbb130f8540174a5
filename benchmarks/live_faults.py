"""Live motions while everything around them fails: clock, measurements, obstacles, the planner's answers, requests."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

import salver as sv
from live_arrivals import region
from live_runs import PERIOD, Told, executed, rows_of
from salver.live import Live, Moving
from salver.live.replanning.planner import Answer, Job, Planner
from salver.planning.fastest import TransportProblem
from salver.trajectory import JointMotion

SECONDS, LONGEST = 1.2, 10.0  # of faults; and at most until the arm rests after a stop
EVERY = 20  # periods between steps of planning
NONSENSE = (np.nan, None, "x", [1.0], [[0.0] * 3] * 2, 1e400, -1e9, {}, 1j, True)


class Faulty:
    """One run. failed: what was raised, or moved though it was stopped."""

    def __init__(self, scenario: sv.Scenario, rng: np.random.Generator) -> None:
        self.rng, self.live = rng, Live(scenario, lead=0.1)
        self.region = region(self.live)
        self.planner, self.clock, self.failed = Planner(self.live.problem), 0.0, []
        self.rows, self.t, self.knots, self.still = [], [], [], None
        self.off = 0.0  # rad by which the arm is elsewhere

    def run(self) -> Told:
        for k in count():
            faulty = k * PERIOD < SECONDS
            if k * PERIOD >= LONGEST or (not faulty and self.still is not None):
                break
            if not faulty and not self.live.stopped:
                self.tried(lambda: self.live.stop("this is the end"))
            if faulty and self.rng.random() < 0.03:
                self.tried(self.request)
            if faulty and k % 10 == 0:
                self.tried(self.measure)
            if faulty and self.rng.random() < 0.01:
                self.tried(self.see)
            self.period(faulty)
            if k % EVERY == 0:
                self.tried(lambda faulty=faulty: self.live.plan(60.0, self.answer if faulty else None))
        if np.any(self.rows[-1][1]):
            self.failed.append("the arm did not come to rest")
        return Told(*np.swapaxes(np.array(self.rows), 0, 1), np.array(self.t), self.knots)

    def tried(self, call: Any) -> None:
        try:
            call()
        except Exception as error:
            self.failed.append(f"{type(error).__name__}: {error}")

    def period(self, faulty: bool) -> None:
        """One of the loop, whose clock may fail; what it is told is kept once for each live time."""
        live, before, said = self.live, self.live.now, self.clock + PERIOD
        self.clock = said
        if faulty and self.rng.random() < 0.01:
            said = self.rng.choice([np.nan, np.inf, -np.inf, self.clock - 1.0, self.clock + 5.0, self.clock - PERIOD])
        out = np.stack(live.command(said))
        self.clock = said if np.isfinite(said) else self.clock
        if self.t and live.now <= before:
            if not np.allclose(out, self.rows[-1], rtol=0.0, atol=1e-9):  # a hand-over is another spline there
                self.failed.append("the command changed though no time passed")
        else:
            self.rows.append(out)
            self.t.append(live.now)
            path, since = live.path
            self.knots += [
                (knot, *(x[0] for x in path.sample(knot - since)))
                for knot in since + path.t
                if before < knot < live.now
            ]
        resting = bool(live.stopped) and not np.any(out[1:3])
        if resting and self.still is not None and np.abs(out[0] - self.still).max() > 1e-9:
            self.failed.append("a latched stop moved")
        if self.still is not None and live.stopped and not resting:
            self.failed.append("a latched stop began to move")
        self.still = out[0].copy() if resting and live.now >= live.committed.ends else None

    def request(self) -> None:
        rng, live = self.rng, self.live
        source = rng.choice(["operator", "policy", "policy", "nobody"])
        wrong = NONSENSE[rng.integers(len(NONSENSE))]
        right = rng.random() > 0.15
        v, times, n = rng.uniform(-0.8, 0.8, 3), 0.05 * np.arange(1, 6), live.problem.n
        calls = [
            lambda: live.goto(rng.uniform(*self.region) if right else wrong, queued=rng.random() < 0.3, source=source),
            lambda: live.twist(v if right else wrong, frame=rng.choice(["world", "tray"]), source=source),
            lambda: live.twist(v, rng.uniform(-1, 1, 3) if right else wrong, source=source),
            lambda: live.jog(rng.uniform(-1, 1, n) if right else wrong, source=source),
            lambda: live.chunk(times, np.linspace(*self.region, 5) if right else wrong, source=source),
            lambda: live.override(rng.uniform(0.02, 1.1) if right else wrong, source=source),
            lambda: live.hold(source=source),
            lambda: live.release(source=source),
            lambda: live.stop(str(wrong), source=source),
            lambda: live.resume(source=source),
            lambda: live.resume(),
            lambda: live.release(),
            lambda: live.put(self.crate() if right else wrong, source=source),
            lambda: live.remove("crate" if right else wrong, source=source),
            lambda: live.prepare(60.0),
        ]
        often = [0.14, 0.14, 0.04, 0.04, 0.08, 0.06, 0.03, 0.05, 0.02, 0.02, 0.13, 0.13, 0.04, 0.04, 0.04]
        calls[rng.choice(len(calls), p=often)]()

    def crate(self) -> Moving:
        """An obstacle that stands still near the tray."""
        at = self.live.committed.motion.q[-1] if not self.rows else self.rows[-1][0]
        p = self.live.problem.arm.tray_pose(at)[0] + self.rng.normal(0.0, 0.35, 3)
        return Moving("crate", "box", p, size=self.rng.uniform(0.02, 0.3, 3))

    def measure(self) -> None:
        rng, q = self.rng, self.rows[-1][0] if self.rows else self.live.committed.motion.q[0]
        if rng.random() < (0.2 if self.off else 0.004):
            self.off = 0.0 if self.off else rng.uniform(0.06, 0.5)
        seen = q + self.off + rng.normal(0.0, 1e-4, q.shape)
        self.live.measured(NONSENSE[rng.integers(len(NONSENSE))] if rng.random() < 0.02 else seen)

    def see(self) -> None:
        rng, n = self.rng, int(self.rng.integers(0, 3))
        times = [None, self.clock, self.clock - 0.1, self.clock + 1.0, np.nan]
        seen = [
            Moving(
                f"thing {k}",
                rng.choice(["sphere", "box", "capsule", "cone"], p=[0.4, 0.4, 0.15, 0.05]),
                rng.uniform([-1, -1, 0], [1, 1, 1]),
                rng.uniform(-2, 2, 3),
                radius=rng.uniform(0.0, 0.1),
                length=0.2,
                size=rng.uniform(0.01, 0.2, 3),
                uncertainty=rng.choice([0.01, np.nan, -1.0], p=[0.9, 0.05, 0.05]),
                seen=rng.choice(times, p=[0.4, 0.4, 0.1, 0.05, 0.05]),
            )
            for k in range(n)
        ]
        self.live.obstacles(seen)

    def answer(self, job: Job) -> Answer:
        """The planner's, which may be wrong, altered or missing."""
        rng, answered = self.rng, self.planner.answer(job)
        found, fault = answered.found, rng.random()
        if fault < 0.05:
            raise RuntimeError("the planner failed")
        if found is None or fault > 0.3:
            return answered
        motion = found.motion
        faster = JointMotion(motion.t / 1.5, motion.q, 1.5 * motion.dq, 2.25 * motion.ddq)
        far = replace(motion, q=motion.q + rng.normal(0.0, 0.02, motion.q.shape))
        changed = [
            replace(found, motion=faster),
            replace(found, motion=far),
            replace(found, begins=found.begins + rng.uniform(-0.2, 0.2)),
            replace(found, seal=rng.bytes(32)),
            replace(found, off=0.0 * found.off),
        ]
        return replace(answered, found=changed[rng.integers(len(changed))])


def faulty(name: str, rng: np.random.Generator) -> tuple[dict[str, Any], TransportProblem, JointMotion]:
    """What became of one run, and what was commanded in it."""
    run = Faulty(sv.load_scenario(name), rng)
    told = run.run()
    rows = rows_of(run.live.problem, told)
    found = {"worst": max(rows.values()), "failed": sorted(set(run.failed)), "refusals": run.live.state.refusals}
    found["moved"] = float(np.mean(np.any(told.dq != 0.0, axis=1)))
    if found["worst"] > 0:
        found["broken"] = sorted(name for name, value in rows.items() if value > 0)
    return found, run.live.problem, executed(told)


def faults_in_words(runs: list[dict[str, Any]]) -> str:
    """What became of runs, in a sentence."""
    engine, moved = [x["lost"] for x in runs if "lost" in x], 100 * np.mean([x["moved"] for x in runs])
    violated, failed = sum(x["worst"] > 0 for x in runs), sum(bool(x["failed"]) for x in runs)
    return (
        f"{violated} violated a constraint, {failed} raised something or moved while stopped, and {sum(engine)} of "
        f"{len(engine)} lost the load in the engine. The arm moved {moved:.0f} % of the time, and "
        f"{sum(x['refusals'] for x in runs)} requests were refused."
    )
