"""Random tasks of several legs: how long they take, and in the engine at corners of the set.

    python benchmarks/legs.py [-n 12] [--seed 0] [--corners 4] [--through] [--only xarm7]

Poses, objects (off-centre, taken and put on) and ranges are drawn; arms take turns. For each task the duration of all
legs, CPU time, and how many runs in the engine held on all legs, with true parameters at corners of the set, the same
on all legs.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from salver import sampling
from salver.errors import SalverError
from salver.planning.fastest.legs import plan_legs
from salver.planning.round import MultiLegPlan
from salver.scenario import Scenario, parse
from salver.simulation.round import RoundExperiment

# Least and largest distance from the base, lowest and highest place, m.
WHERE = {"panda": (0.35, 0.6, 0.3, 0.6), "ur10": (0.5, 0.85, 0.3, 0.8), "xarm7": (0.35, 0.55, 0.25, 0.5)}
PLACES = ((0.055, 0.055), (-0.055, 0.055), (-0.055, -0.055), (0.055, -0.055))


def task(seed: int, number: int, through: bool = False) -> dict[str, Any]:
    """A scenario of 2 to 4 legs, as a file would give it. through: with a pose to pass on each, half-way and aside."""
    rng = np.random.default_rng([seed, number])
    arm = list(WHERE)[number % len(WHERE)]
    near, far, low, high = WHERE[arm]

    def pose() -> dict[str, Any]:
        r, angle, z = rng.uniform(near, far), rng.uniform(-1.2, 1.2), rng.uniform(low, high)
        turned = float(rng.uniform(-60, 60)) if rng.random() < 0.5 else 0.0
        return {"position": [float(r * np.cos(angle)), float(r * np.sin(angle)), float(z)], "rpy_deg": [0, 0, turned]}

    count = int(rng.integers(2, 5))
    objects = []
    for k, at in enumerate(rng.permutation(PLACES)[: min(count, 4)]):
        height = float(rng.uniform(0.05, 0.2))
        round_ = {"type": "cylinder", "radius": float(rng.uniform(0.025, 0.04)), "height": height}
        box = {"type": "box", "size": [0.06, 0.05, height]}
        objects.append(
            {
                "name": f"o{k}",
                "shape": round_ if rng.random() < 0.6 else box,
                "mass": float(rng.uniform(0.1, 0.6)),
                "friction": float(rng.uniform(0.25, 0.6)),
                "at": at.tolist(),
                "support_inset": 0.003,
                "uncertainty": {"mass": "15%", "com": [0.002, 0.002, 0.005], "friction": "10%"},
            }
        )
    here, legs = [item["name"] for item in objects], []
    late = here.pop() if count > 2 and rng.random() < 0.5 else None
    for k in range(count):
        leg: dict[str, Any] = {"goal": pose()}
        if late is not None and k == 0:
            leg["put"] = late
            here.append(late)
        elif len(here) > 1 and rng.random() < 0.8:
            leg["take"] = here.pop(int(rng.integers(len(here))))
        legs.append(leg)
    start = pose()
    for begin, leg in zip([start, *(leg["goal"] for leg in legs)], legs, strict=False):
        if through:
            half_way = 0.5 * (np.array(begin["position"]) + leg["goal"]["position"])
            turned = 0.5 * (begin["rpy_deg"][2] + leg["goal"]["rpy_deg"][2])
            aside = half_way * np.array([0.95, 0.95, 1.1])  # nearer to the base, and higher
            leg["through"] = [{"position": aside.tolist(), "rpy_deg": [0, 0, float(turned)]}]
    return {
        "name": f"task-{seed}-{number}",
        "motion": {"start": start, "orientation": "free"},
        "legs": legs,
        "objects": objects,
        "contact": {"condition": "exact"},
        "tray": {"size": [0.22, 0.22], "height": 0.05, "mass": 0.2, "inertia": [3e-4, 3e-4, 6e-4]},
        "arm": {"model": arm},
    }


def held(plan: MultiLegPlan, corners: int) -> int:
    """Runs at corners of the set in which everything holds on all legs."""
    case, experiment = plan.scenario, RoundExperiment(plan)
    drawn = sampling.draw(case.uncertain, corners, 0, "corners", case.bodies)
    runs = (experiment.run(dict(zip(case.uncertain.names, map(float, row), strict=True))) for row in drawn)
    return sum(run.outcome == "holds" for run in runs)


def row(case: Scenario, corners: int) -> str:
    began = time.process_time()
    assert case.arm is not None
    name = f"{case.name} | {case.arm.model} | {len(case.legs)}"
    try:
        whole = plan_legs(case)
    except SalverError as error:
        return f"| {name} | {error} |"
    spent = time.process_time() - began
    if not whole.ok:
        return f"| {name} | {whole.status} | | {spent:.1f} |"
    return f"| {name} | {whole.duration:.4f} | {held(whole, corners)} of {corners} | {spent:.1f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=list(WHERE), help="tasks of one arm")
    parser.add_argument("--through", action="store_true", help="with a pose to pass on each leg")
    parser.add_argument("--corners", type=int, default=4)
    args = parser.parse_args()
    print("| task | arm | legs | duration, s | corner runs that held | CPU, s |")
    print("|---|---|---|---|---|---|")
    for number in range(args.n):
        data = task(args.seed, number, args.through)
        if args.only in (None, data["arm"]["model"]):
            print(row(parse(data, "a random task"), args.corners), flush=True)


if __name__ == "__main__":
    main()
