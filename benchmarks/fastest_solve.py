"""Time to find the fastest safe motion, and how surely it is found.

    python benchmarks/fastest_solve.py [-n 9] [--starts 100]

First the paper's endpoints and start posture, cube, friction known exactly, tray level and free to tilt: duration and
solve time, the problem built anew each time. Then from random start postures of the Panda within its reach, clear of
itself: how many are solved, and in what time.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from salver.geometry import Array
from salver.planning.fastest import fastest
from salver.planning.postures import REACHED, PoseTarget, posture_at
from salver.planning.trajopt.ends import AtPosture
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.scenario import Scenario, load

TURNS = {"fixed": "level", "free": "tilting"}


def cube(friction: float, orientation: str) -> Scenario:
    return load("panda-cube").with_changes(
        objects__0__friction=friction,
        objects__0__uncertainty={},
        motion__duration=None,
        motion__goal_yaw="free",
        motion__orientation=orientation,
    )


def random_start_postures(problem: TransportProblem, count: int, seed: int = 7) -> Iterator[Array]:
    """Postures that hold the object level 0.35 to 0.65 m from the base's axis, 2 cm clear of the arm itself."""
    rng, limits = np.random.default_rng(seed), problem.limits
    assert problem.keep_out is not None
    found = 0
    while found < count:
        guess = limits.q_min + rng.uniform(0.1, 0.9, problem.n) * (limits.q_max - limits.q_min)
        radius, angle = rng.uniform(0.35, 0.65), rng.uniform(-1.2, 1.2)
        place = np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.2, 0.6)])
        body = problem.items[0]
        target = PoseTarget(place, np.eye(3), body.p_EB, body.R_EB, yaw_free=True)
        q, left = posture_at(problem.arm, target, guess, limits=limits)
        if left < REACHED and problem.keep_out.parts.clearance(q[None]).min() >= 0.02:
            found += 1
            yield q


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("-n", type=int, default=9, help="times that each of the four cases is solved")
    options.add_argument("--starts", type=int, default=100, help="random start postures, level and tilting")
    chosen = options.parse_args()
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}; wall time, warm")
    for friction in (0.4, 0.2):
        for orientation in TURNS:
            seconds = []
            for _ in range(chosen.n + 1):
                began = time.perf_counter()
                found = fastest(transport_problem(cube(friction, orientation)))
                seconds.append(time.perf_counter() - began)
            spent = np.sort(seconds[1:])
            print(
                f"friction {friction}, {TURNS[orientation]:8s} {found.duration:.4f} s, {found.status.code}; "
                f"N = {chosen.n}: median {np.median(spent):.2f} s, least {spent[0]:.2f} s, most {spent[-1]:.2f} s; "
                f"{found.iterations} iterations",
                flush=True,
            )
    for orientation in TURNS:
        problem = transport_problem(cube(0.4, orientation), robust=False)
        seconds, solved = [], 0
        for q in random_start_postures(problem, chosen.starts):
            began = time.perf_counter()
            found = fastest(replace(problem, start=AtPosture(q)))
            seconds.append(time.perf_counter() - began)
            solved += found.status.ok
            if not found.status.ok:
                print(f"  {found.status}")
        print(
            f"{chosen.starts} random start postures, {TURNS[orientation]}: {solved} solved; median "
            f"{np.median(seconds):.2f} s, 90 % {np.quantile(seconds, 0.9):.2f} s, most {max(seconds):.2f} s",
            flush=True,
        )


if __name__ == "__main__":
    main()
