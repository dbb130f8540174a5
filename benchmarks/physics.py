"""Physics: speed of the engine and of whole runs, and where an object first slides against where it should.

    python benchmarks/physics.py [--quick]

Speed is measured by replaying the torques of a run, so that the engine does what it does in a run and nothing else.
Sliding: level straight moves of 0.48 m. Predicted is the duration at which the exact friction cone is left, in closed
form for the min-jerk line, T^2 = (10 / sqrt 3) L / (mu g); seen is the longest duration at which the engine's object
slides more than 0.05 mm (creep taken off), by bisection.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Callable

import numpy as np

from salver.models.arm.arm import load_arm
from salver.planning.make import make_plan
from salver.scenario import Scenario, load
from salver.simulation.physics import Experiment, simulate, simulate_tray
from salver.simulation.run import Options
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build
from salver.trajectory import min_jerk_line

PAPER = load("panda-cube")
START, GOAL = np.array(PAPER.motion.start.position), np.array(PAPER.motion.goal.position)
LENGTH = float(np.linalg.norm(GOAL - START))
SLIDES = 5e-5  # m
QUICK = {"physics__settle_before": 0.1, "physics__settle_after": 0.0}


def engine_alone(scenario: Scenario, repeats: int) -> tuple[float, float]:
    """Wall seconds of the steps of one run, its torques replayed from the same start: the very same run.

    With every command's steps at their quickest of all repetitions (an idle machine), and at their median.
    """
    scenario = scenario.with_changes(physics__settle_before=0.0)
    plan = make_plan(scenario, "baseline")
    rate = 1 / scenario.physics.command_period
    record = simulate(plan, options=Options(record_rate=rate))
    arm = load_arm(scenario.arm, scenario.tray)
    scene = build(scenario, true_world(scenario), arm)
    steps = round(scenario.physics.command_period / scenario.physics.timestep)
    walls = np.empty((repeats, len(record.tau)))
    for k in range(repeats):
        data = mujoco.MjData(scene.model)
        scene.place(data, record.q[0])
        for i, tau in enumerate(record.tau):
            data.qfrc_applied[: arm.n] = tau
            began = time.perf_counter()
            mujoco.mj_step(scene.model, data, nstep=steps)
            walls[k, i] = time.perf_counter() - began
        assert data.ncon == 4
    return float(walls.min(axis=0).sum()), float(np.median(walls, axis=0).sum())


def whole_runs(repeats: int) -> tuple[np.ndarray, float]:
    """Processor seconds of whole runs of the paper's move, after a first one, and the simulated seconds of each."""
    experiment = Experiment(plan := make_plan(PAPER, "baseline"))
    seconds = []
    for k in range(repeats + 1):
        began = time.process_time()
        experiment.run({"mass": 0.24 + 0.03 * k / repeats})
        seconds.append(time.process_time() - began)
    physics = PAPER.physics
    return np.array(seconds[1:]), plan.duration + physics.settle_before + physics.settle_after


def first_sliding(slip: Callable[[float], float], expected: float, width: float = 0.06) -> float:
    """Longest duration that slides, by bisection to 0.1 %, from within `width` of the expected one; nan outside it."""
    low, high = (1 - width) * expected, (1 + width) * expected
    if slip(low) <= SLIDES or slip(high) > SLIDES:
        return np.nan
    while high - low > 1e-3 * expected:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if slip(middle) > SLIDES else (low, middle)
    return 0.5 * (low + high)


def sliding_with_tray(friction: float, expected: float) -> float:
    scenario = PAPER.with_changes(**QUICK)

    def slip(duration: float) -> float:
        reference = min_jerk_line(duration, START, GOAL, np.eye(3), np.eye(3))
        return float(simulate_tray(reference, scenario, {"friction": friction}).slip.max())

    return first_sliding(slip, expected)


def sliding_with_arm(friction: float, expected: float) -> tuple[float, bool]:
    """Also whether the arm kept its limits over the whole bracket."""
    kept = []

    def slip(duration: float) -> float:
        plan = make_plan(PAPER.with_changes(motion__duration=duration, **QUICK), "baseline")
        record = simulate(plan, parameters={"friction": friction})
        kept.append(record.summary["arm"]["limits_kept"])
        return float(record.slip.max())

    return first_sliding(slip, expected, 0.04), all(kept)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer repetitions and frictions")
    quick = parser.parse_args().quick
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, MuJoCo {mujoco.__version__}")

    repeats = 3 if quick else 10
    for timestep in (5e-4, 1e-3):
        scenario = PAPER.with_changes(physics__timestep=timestep)
        quickest, median = engine_alone(scenario, repeats)
        span = PAPER.motion.duration + PAPER.physics.settle_after
        per_step = 1e6 * timestep / span
        print(
            f"engine alone, {1e3 * timestep:g} ms steps: {span / quickest:.0f} x real time undisturbed, "
            f"{span / median:.0f} x at the median ({per_step * quickest:.1f}, {per_step * median:.1f} us a step)"
        )
    seconds, span = whole_runs(repeats)
    print(
        f"whole run of {span:.1f} s with controller and measurement: {seconds.min():.2f} s of processor time at best, "
        f"{np.median(seconds):.2f} s at the median; 100 runs on two free cores: {50 * np.median(seconds):.0f} s"
    )

    print("friction   first sliding duration: predicted   tray alone          with the arm")
    worst = 0.0
    for friction in (0.2, 0.4) if quick else (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6):
        expected = float(np.sqrt(10 / np.sqrt(3) * LENGTH / (friction * 9.81)))
        tray = sliding_with_tray(friction, expected)
        arm, kept = sliding_with_arm(friction, expected)
        note = "" if kept else "  (beyond the arm's limits)"
        worst = max(worst, abs(tray / expected - 1), abs(arm / expected - 1))
        print(
            f"{friction:8.2f} {expected:35.4f} s {tray:9.4f} ({100 * (tray / expected - 1):+.2f} %)"
            f" {arm:9.4f} ({100 * (arm / expected - 1):+.2f} %){note}"
        )
    print(f"largest difference {100 * worst:.2f} %")


if __name__ == "__main__":
    main()
