"""Verdicts of the margins against the physics engine, on random objects and random motions.

    python benchmarks/bench_verdicts.py [--runs 200] [--seed 0]

Each run draws a box (size, friction, place on the tray, turned about the vertical, centre of mass off its middle)
and a rest-to-rest motion (a curved path, half of them turning the tray as well), and runs it in a duration
between 0.8 and 1.25 times the one at which the exact margin is zero. The engine moves the tray exactly. Each
disagreement is shown with how far from the limit the motion is, and what the engine saw.
"""

from __future__ import annotations

import argparse
from collections import Counter

import numpy as np

from salver.geometry import exp
from salver.margins import Margins, margin_model, margins, tray_motion
from salver.scenario import Scenario, parse
from salver.simulation.physics import simulate_tray
from salver.trajectory import (
    MotionSamples,
    PolynomialReference,
    boundary_solution,
    geodesic_angular_velocity,
    position_boundary,
)

INSTANTS = 401


def random_scenario(rng: np.random.Generator) -> Scenario:
    x, y, z = rng.uniform([0.03, 0.03, 0.03], [0.1, 0.1, 0.2])
    friction = float(rng.uniform(0.12, 0.7))
    item = {
        "shape": {"type": "box", "size": [x, y, z]},
        "mass": float(rng.uniform(0.05, 2)),
        "com": (rng.uniform(-0.25, 0.25, 3) * [x, y, z]).tolist(),
        "friction": friction,
        "at": rng.uniform(-0.07, 0.07, 2).tolist(),
        "yaw_deg": float(rng.uniform(-90, 90)),
    }
    ends = {"start": {"position": [0, 0, 1]}, "goal": {"position": [0, 0, 1]}, "duration": 1.0}
    return parse({"name": "random", "motion": ends, "objects": [item], "tray": {"size": [0.4, 0.4]}}, "random")


def random_motion(rng: np.random.Generator, turning: bool, friction: float) -> PolynomialReference:
    """Rest to rest in one second, about half a metre."""
    goal = rng.normal(size=3) * [0.3, 0.3, 0.1]
    solution = boundary_solution(8, position_boundary(1.0, np.zeros(3), goal))
    position = solution.particular + solution.null_space @ (0.02 * rng.normal(size=(solution.null_space.shape[1], 3)))
    turn = None
    if turning:
        tilt = rng.uniform(0.1, 0.6) * np.arctan(friction) * exp([0, 0, rng.uniform(0, 2 * np.pi)])[:, 0]
        turn = geodesic_angular_velocity(1.0, np.eye(3), exp(tilt))
    return PolynomialReference(1.0, np.eye(3), position, turn)


def run_in(reference: PolynomialReference, duration: float) -> PolynomialReference:
    """The same path in another duration."""
    omega = None if reference.angular_velocity is None else reference.angular_velocity / duration
    return PolynomialReference(duration, reference.R_start, reference.position, omega)


def limit(scenario: Scenario, reference: PolynomialReference) -> float:
    """Duration at which the exact margin is zero, by bisection; infinite when none is."""
    model = margin_model(scenario, 32)

    def holds(duration: float) -> bool:
        samples: MotionSamples = run_in(reference, duration).sample(np.linspace(0, duration, INSTANTS))
        return bool(Margins(model, samples.t, tray_motion(scenario, samples)).exact.min() >= 0)

    low, high = 0.1, 20.0
    if not holds(high):
        return float("inf")
    while high > 1.001 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--runs", type=int, default=200)
    options.add_argument("--seed", type=int, default=0)
    asked = options.parse_args()
    count: Counter[tuple[str, str]] = Counter()
    wrong = []
    for k in range(asked.runs):
        rng = np.random.default_rng([asked.seed, k])
        scenario = random_scenario(rng)
        reference = random_motion(rng, bool(k % 2), scenario.objects[0].friction)
        critical = limit(scenario, reference)
        if not np.isfinite(critical):
            count["no pace holds", "not run"] += 1
            continue
        pace = float(rng.uniform(0.8, 1.25))
        motion = run_in(reference, pace * critical)
        verdict = margins(scenario, motion.sample(np.linspace(0, motion.duration, INSTANTS))).verdict()
        summary = simulate_tray(motion, scenario).summary
        seen = str(summary["outcome"])
        count[verdict.code, seen] += 1
        if verdict.ok != (seen == "holds"):
            wrong.append((pace, verdict.sentence, seen, summary["objects"][0]))
    print("margins -> engine:")
    for (ours, theirs), number in sorted(count.items()):
        print(f"  {ours:14s} {theirs:8s} {number}")
    print(f"{len(wrong)} of {asked.runs} disagree")
    for pace, sentence, seen, figures in sorted(wrong, key=lambda item: item[0]):
        peak = ", ".join(f"{key} {value:.2g}" for key, value in figures.items() if isinstance(value, float))
        print(f"  at {pace:.3f} of the limiting duration: {sentence} Engine: {seen} ({peak})")


if __name__ == "__main__":
    main()
