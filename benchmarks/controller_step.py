"""Time of one step of the arm's controller, as a robot's driver would call it at 1 kHz.

    python benchmarks/controller_step.py [-n 20000]

Prints the median and the 99.9 percentile over n steps along the paper's move, with the machine they were taken on:
by the wall clock, which counts what other processes take on a busy machine, and in processor time, which does not.
"""

from __future__ import annotations

import argparse
import os
import platform
import time

import numpy as np

from salver import scenario
from salver.control.arm import ArmController, ArmState, controller_for
from salver.models.arm.arm import load_arm
from salver.planning.follow.motion import follow_scenario
from salver.trajectory import JointMotion, Reference, min_jerk_line

BUDGET = 150e-6  # s, at the median


def measure(controller: ArmController, motion: JointMotion, reference: Reference, n: int) -> np.ndarray:
    """(n, 2) seconds of each of n steps, wall and processor, at states near the reference and along all of it."""
    rng = np.random.default_rng(0)
    times = np.arange(n) * controller.period % motion.duration
    q, dq, _ = motion.sample(times)
    q, dq = q + 1e-3 * rng.normal(size=q.shape), dq + 1e-2 * rng.normal(size=dq.shape)
    seen = reference.sample(times)
    states = [ArmState(q[k], dq[k], seen.p_SB[k], seen.R_SB[k], seen.v_S[k], seen.omega_B[k]) for k in range(n)]
    spent = np.empty((n, 2))
    for k in range(n):
        before = time.perf_counter(), time.thread_time()
        controller.step(states[k], times[k])
        spent[k] = time.perf_counter() - before[0], time.thread_time() - before[1]
    return spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=20000, help="steps of each kind")
    n = parser.parse_args().n
    cube = scenario.load("panda-cube")
    start, goal = cube.motion.start, cube.motion.goal
    reference = min_jerk_line(2.5, np.array(start.position), np.array(goal.position), start.rotation, goal.rotation)
    arm = load_arm(cube.arm, cube.tray)
    motion, status = follow_scenario(cube, reference, arm)
    if motion is None:
        raise SystemExit(status.sentence)
    print(f"{platform.platform()}, {os.cpu_count()} cores, Python {platform.python_version()}, {n} steps of each kind")
    print(
        f"{'closed on':<24}{'wall: median':>13}{'99.9 %':>8}{'largest':>9}{'processor: median':>19}{'99.9 %':>8}   us"
    )
    medians = []
    for space, feedback in (("object", "joints"), ("object", "object"), ("joint", "joints")):
        changed = cube.with_changes(physics__feedback=feedback)
        controller = controller_for(changed, motion, reference, arm=arm, space=space)
        wall, cpu = 1e6 * measure(controller, motion, reference, n).T
        medians.append(np.median(wall))
        name = "joints" if space == "joint" else f"object, seen by {feedback}"
        print(
            f"{name:<24}{medians[-1]:>13.1f}{np.percentile(wall, 99.9):>8.1f}{wall.max():>9.1f}"
            f"{np.median(cpu):>19.1f}{np.percentile(cpu, 99.9):>8.1f}"
        )
    kept = "kept" if max(medians) < 1e6 * BUDGET else "not kept"
    print(
        f"Budget: {1e6 * BUDGET:.0f} us at the median, {kept}; a period is {1e6 * cube.physics.command_period:.0f} us."
    )


if __name__ == "__main__":
    main()
