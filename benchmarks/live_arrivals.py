"""How long a live motion takes to a new goal, beside the best that a search as thorough as offline finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import salver as sv
from live_runs import PATIENCE, drive
from salver.errors import Status
from salver.live import Live
from salver.live.replanning.planner import Answer, Job
from salver.planning.fastest import AtPosture, fastest

LATE = 0.15  # share of the best known time by which a goal may be reached later
LOWEST, HIGHEST = np.array([0.40, -0.40, 0.35]), np.array([0.55, 0.15, 0.60])  # m, of goals of a Panda
REACH = np.array([0.15, 0.30, 0.12])  # m, of goals of other arms, from where the load is at first
Region = tuple[np.ndarray, np.ndarray]


def region(live: Live) -> Region:
    """The corners of the box from which goals of a live motion that has just begun are drawn, m."""
    if live.problem.scenario.name.startswith("panda"):
        return LOWEST, HIGHEST
    body = live.problem.items[0]
    p, _ = live.problem.arm.object_pose(live.committed.motion.q[0], body.p_EB, body.R_EB)
    return p - REACH, p + REACH


def arrival(scenario: sv.Scenario, rng: np.random.Generator) -> dict[str, float | None]:
    """A goal that changes at a random time of the way to another: s from the hand-over until the arm is at rest there,
    by the live motion and by a search as thorough as offline, from the same state; None where none was found."""
    live, jobs, found = Live(scenario, lead=0.1), [], []

    def noted(job: Job) -> Answer:
        jobs.append(job)
        found.append(live._planner.answer(job).found)
        return Answer(None, Status("optimal", "", True))

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
