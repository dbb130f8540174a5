"""The 135-run grid of tall boxes, for each height: does any plan drop a box?

    python benchmarks/tall_boxes.py [--heights 30 40 50] [--out docs/data/tall-boxes.json]

After Heins and Schoellig, "Robust Nonprehensile Object Transportation with Uncertain Inertial Parameters", 2025:
15 centres of mass (the middle, 6 faces and 8 vertices of the box of possible ones) x 3 scales of the uniform
inertia x 3 goals. One plan per goal, made for the whole uncertain set; each run has other true parameters. The
engine moves the tray exactly as planned. A second column: the level min-jerk line at the shortest duration that
holds for the *nominal* box, which is what a planner does that trusts its model.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from itertools import product

import numpy as np

from salver.files import write_json
from salver.planning.make import plan_object
from salver.scenario import Scenario, load
from salver.simulation.physics import simulate_tray
from salver.trajectory import Reference
from scenario_table import level_line, shortest

GOALS = ((-2.0, 1.0, 0.0), (2.0, 0.0, -0.25), (0.0, -2.0, 0.25))
INERTIA_SCALES = (1.0, 0.5, 0.1)


def centres(half: np.ndarray) -> list[np.ndarray]:
    faces = [sign * axis for axis in np.eye(3) for sign in (1, -1)]
    return [half * s for s in (np.zeros(3), *faces, *(np.array(v) for v in product((1, -1), repeat=3)))]


def outcomes(scenario: Scenario, reference: Reference) -> Counter[str]:
    item = scenario.objects[0]
    half = item.uncertainty.com
    assert half is not None
    x, y, z = item.shape.size  # type: ignore[union-attr]
    uniform = item.mass / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])
    seen: Counter[str] = Counter()
    for com, scale in product(centres(np.array(half)), INERTIA_SCALES):
        parameters = dict(zip(("com_x", "com_y", "com_z"), com.tolist(), strict=True))
        parameters |= dict(zip(("inertia_xx", "inertia_yy", "inertia_zz"), (scale * uniform).tolist(), strict=True))
        seen[str(simulate_tray(reference, scenario, parameters).summary["outcome"])] += 1
    return seen


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--heights", type=int, nargs="+", default=[30, 40, 50])
    options.add_argument("--out", default="docs/data/tall-boxes.json")
    asked = options.parse_args()
    record = {}
    for height in asked.heights:
        began = time.perf_counter()
        robust: Counter[str] = Counter()
        trusting: Counter[str] = Counter()
        for goal in GOALS:
            scenario = load(f"tall-box-{height}")
            scenario = scenario.with_changes(
                motion__goal__position=np.add(scenario.motion.start.position, goal).tolist()
            )
            plan = plan_object(scenario)
            if not plan.ok:
                raise SystemExit(f"{scenario.name} to {goal}: {plan.status.sentence}")
            robust += outcomes(scenario, plan.reference)
            trusting += outcomes(scenario, level_line(scenario, shortest(scenario, worst=False)))
        print(
            f"{height} cm: planned for the set {dict(robust)}; planned for the nominal box {dict(trusting)} "
            f"({time.perf_counter() - began:.0f} s)",
            flush=True,
        )
        record[str(height)] = {"planned for the set": dict(robust), "planned for the nominal box": dict(trusting)}
    write_json(asked.out, record)


if __name__ == "__main__":
    main()
