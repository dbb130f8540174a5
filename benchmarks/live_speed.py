"""Live motions whose speed is changed and which are held at random instants: whether anything is dropped, and how soon.

`live.py --kinds overrides rests`. A session is three goals one after the other; on the way the override is set three
times, to 0.2 to 1, and the arm is held and released twice, at random instants. The commanded motion is judged as one
motion at every millisecond, and then run in the physics engine with the load at a random corner of its ranges.

Beside that, at random instants of motions at full speed: how soon the arm rests by the stop that a hold takes, by
finishing, and by braking along the path, the soonest that passes the verdict.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from live_arrivals import region
from live_runs import LEAD, PERIOD, drive, executed, in_turn, rows_of
from salver.live import Live
from salver.live.committed.commit import verified
from salver.live.committed.motion import Committed
from salver.live.replanning.planner import Job
from salver.live.replanning.wishes import Halt
from salver.planning.fastest import TransportProblem
from salver.trajectory import JointMotion

LONGEST, SHORTEST, LONGER = 2.0, 0.05, 1.1  # s of braking along the path; times as long as the one before
STEP = 0.01  # s
HIGHER = np.array([0.0, 0.0, 0.05])  # m: nearer to the floor the arm with a bottle mostly meets it


def goals(live: Live, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random goals (count, 3), m."""
    lowest, highest = region(live)
    return rng.uniform(lowest + HIGHER, highest, (count, 3))


def session(name: str, rng: np.random.Generator) -> tuple[dict[str, Any], TransportProblem, JointMotion]:
    """What became of one session, and what was commanded in it."""
    live = Live(name, lead=LEAD)
    ways = goals(live, 3, rng)
    told = [drive(live, 0.2, [(0.0, lambda live: live.override(rng.uniform(0.2, 1.0)))])]
    for goal in ways:
        live.goto(goal, queued=True)
    rests, now = [], 0.2
    for k, at in enumerate(np.sort(rng.uniform(0.2, 2.5, 4))):
        if at > now:
            told.append(drive(live, at - now, begins=now))
            now = live.now + PERIOD
        if k % 2 == 0:
            live.override(rng.uniform(0.2, 1.0))
            continue
        ends = live.committed.ends
        live.hold()
        told.append(drive(live, 0.6, begins=now))
        rests.append((max(live.committed.ends - now, 0.0), max(ends - now, 0.0)))
        live.release()
        now = live.now + PERIOD
    while not live.settled and now < 25.0:
        told.append(drive(live, 0.5, begins=now))
        now = live.now + PERIOD
    states = in_turn(*told)
    worst = rows_of(live.problem, states)
    found = {
        "worst": max(worst.values()),
        "broken": [row for row, value in worst.items() if value > 0],
        "reached": bool(live.settled),
        "refusals": live.state.refusals,
        "rests": rests,
        "seconds": now,
    }
    return found, live.problem, executed(states)


def braked(live: Live, base: Committed, begins: float) -> float:
    """s in which the arm can rest on the path, going slower and slower; infinite where finishing is sooner."""
    within, run = SHORTEST, base.run
    while within < min(LONGEST, 2.0 * (base.ends - begins)):
        profile = run.then(begins, 0.0, within)
        t = np.linspace(0.0, within, int(np.ceil(within / STEP)) + 1)
        u, factor, rate = (x[:, None] for x in profile.along(t))
        if u[-1, 0] < base.motion.duration:
            q, dq, ddq = run.path.sample(u[:, 0])
            motion = JointMotion(t, q, factor * dq, factor**2 * ddq + rate * dq)
            if verified(live.problem, motion, begins, base).committed is not None:
                return within
        within *= LONGER
    return np.inf


def ways_to_rest(name: str, rng: np.random.Generator) -> dict[str, float]:
    """From an instant of a motion between two random places at full speed."""
    live = Live(name, lead=LEAD)
    for goal in goals(live, 2, rng):
        live.goto(goal)
        drive(live, 0.15, begins=live.now)
        base = live.committed
        drive(live, 3.0, begins=live.now)
    at = base.begins + rng.uniform(0.1, 0.8) * (base.ends - base.begins)
    begins = float(base.nodes[np.searchsorted(base.nodes, at)])
    stop = live._planner.answer(Job(Halt(), base, begins, 60.0)).found
    left = base.ends - begins
    return {"stop": min(left, np.inf if stop is None else stop.ends - begins), "left": left,
            "path": min(braked(live, base, begins), 99.0)}  # fmt: skip
