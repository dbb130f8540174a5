"""How late a loop of 1 kHz is beside a planner, in real time, and what makes it late.

A hand sends twists 100 times a second; the loop, with real-time priority where that is allowed, sleeps until each
period begins, and commands. Beside nobody it shows what the machine does; beside a planner in a process, what the
exchange with it adds; with what exists when it begins frozen (`gc.freeze`), what Python's collection of garbage is of
that; beside a planner in a thread, what it costs to share an interpreter. `live.py --kinds loop` runs it.
"""

from __future__ import annotations

import gc
import os
import time
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np

import salver as sv
from live_runs import drive
from salver.live import Live, Worker

PERIOD, SETTLED = 1e-3, 1.0  # s; until the planner's leads are learnt
KINDS = ("nobody", "a process", "a process, frozen", "a thread")


@contextmanager
def prompt():
    """The loop's thread comes before all others of the machine, as on a robot, where that is allowed."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except (AttributeError, PermissionError):
        yield
        return
    try:
        yield
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def lateness(kind: str, seconds: float) -> dict[str, Any]:
    """Of a loop beside a planner of a kind: ms by which its periods are too long, and what its calls took."""
    scenario = sv.load_scenario("panda-cube")
    live = Live(scenario)
    worker = nullcontext() if kind == "nobody" else Worker(live, process=kind != "a thread")
    with prompt(), worker:
        if kind.endswith("frozen"):
            gc.freeze()
        try:
            begun = time.perf_counter()
            due, k, late, took, last = begun, 0, [], [], begun
            while last < begun + SETTLED + seconds:
                due += PERIOD
                if (left := due - time.perf_counter()) > 0:
                    time.sleep(left)
                now = time.perf_counter()
                live.command(now)
                took.append(time.perf_counter() - now)
                if k % 10 == 0:
                    live.twist(0.2 * np.array([np.sin(3 * now), np.cos(2 * now), 0.3 * np.sin(now)]))
                late.append(now - last - PERIOD)
                if now - due > 0.05:
                    due = now  # it does not catch up
                k, last = k + 1, now
        finally:
            gc.unfreeze()
        moved = not live.committed.at_rest
    late, took = (1e3 * np.array(x[round(SETTLED / PERIOD) :]) for x in (late, took))
    return {
        "periods": len(late),
        "median": float(np.median(late)),
        "p99": float(np.quantile(late, 0.99)),
        "p999": float(np.quantile(late, 0.999)),
        "under 1.2 ms": float((late < 0.2).mean()),
        "over 1 ms": int((late > 1.0).sum()),
        "over 5 ms": int((late > 5.0).sum()),
        "command p999": float(np.quantile(took, 0.999)),
        "moved": moved,
        "load": os.getloadavg()[0],
        "cores": os.cpu_count(),
        "command": commands(scenario),
    }


def commands(scenario: sv.Scenario) -> tuple[float, float]:
    """CPU time of `command`, us: median and 99.9 %."""
    live = Live(scenario, lead=0.1)
    drive(live, 0.4, [(0.0, lambda _: live.goto((0.45, 0.1, 0.45)))])
    spent = []
    for k in range(5000):
        begun = time.thread_time_ns()
        live.command(0.4 + 1e-4 * k)
        spent.append(1e-3 * (time.thread_time_ns() - begun))
    return float(np.median(spent)), float(np.quantile(spent, 0.999))
