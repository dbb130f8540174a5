"""Counted runs of identification and of learning while carrying: how often ranges cover the truth, what is dropped.

python benchmarks/learning.py --logs 40 --loads 4 --trips 3

Logs are made by `salver.learning.sensors`, whose errors are not those that the estimator assumes. Loads are drawn
within mass +-50 %, centre of mass +-15 mm, friction +-10 %, for the tall bottle on a Panda.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

import salver as sv
from salver.learning import identify
from salver.learning.identify import NAMES
from salver.learning.sensors import SensedArm, Sensors
from salver.learning.trips import SENSORS, trips
from salver.models.parameters import inertial_vector
from salver.planning.plan import Plan
from salver.scenario import Scenario, load

WIDE = {"mass": "50%", "com": [0.015, 0.015, 0.015]}


def bottle() -> Scenario:
    return load("panda-tall-bottle").with_changes(objects__0__uncertainty=WIDE | {"friction": "10%"})


def coverage(plan: Plan, wrist: bool, times: float, count: int) -> None:
    """How many of the four parameters of each load lie within their ranges."""
    inside, half, spent = np.zeros(4, dtype=int), [], []
    nominal = inertial_vector(plan.scenario.payload.first.inertial)
    for k in range(count):
        rng, values = np.random.default_rng([11, k]), nominal.copy()
        share = 1 + 0.5 * rng.uniform(-1, 1)
        values[0], values[1:4], values[4:] = share * values[0], 0.015 * rng.uniform(-1, 1, 3), share * values[4:]
        arm = SensedArm(plan, k, Sensors(times=times), wrist=wrist, joints=not wrist)
        loaded, empty = arm.log(values), arm.log(None)
        begun = time.process_time()
        ranges = identify(plan, [loaded], empty).ranges
        spent.append(time.process_time() - begun)
        inside += [ranges[n].low <= x <= ranges[n].high for n, x in zip(NAMES, values[:4], strict=True)]
        half.append([1e3 * ranges[n].half for n in NAMES])
    mass, *com = np.median(half, axis=0)
    who, found = "wrist" if wrist else "torques", ", ".join(map(str, inside))
    wide = f"{mass:.1f} g, {', '.join(f'{x:.2f}' for x in com)} mm"
    spent_ms = 1e3 * np.median(spent)
    print(
        f"  {who:8} noise x{times:g}: inside {found} of {count}; median half-width {wide}; {spent_ms:.0f} ms",
        flush=True,
    )


def carried(sensor: str, loads: int, count: int) -> None:
    """Trips with hidden loads: durations, and whether anything was lost."""
    ratio, durations, held, total = [], [], 0, 0
    for seed in range(1, loads + 1):
        made = list(trips(bottle(), count, seed, sensor))  # type: ignore[arg-type]
        held, total = held + sum(trip.outcome == "holds" for trip in made), total + len(made)
        durations.append([trip.plan.duration for trip in made])
        ratio.append(made[1].plan.duration / made[0].plan.duration if len(made) > 1 else np.nan)
        print(f"  {sensor} load {seed}: " + ", ".join(f"{d:.3f} s" for d in durations[-1]), flush=True)
    print(
        f"  {sensor}: held in {held} of {total} trips; second trip over first: median {np.median(ratio):.3f}",
        flush=True,
    )


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--logs", type=int, default=40)
    asked.add_argument("--loads", type=int, default=4)
    asked.add_argument("--trips", type=int, default=3)
    given = asked.parse_args()
    motions = {
        "cube, 2.5 s": sv.plan("panda-cube"),
        "tall bottle, fastest": sv.plan("panda-tall-bottle", "fastest"),
    }
    for name, plan in motions.items():
        print(name)
        wide = replace(plan, scenario=plan.scenario.with_changes(objects__0__uncertainty=WIDE))
        for wrist in (True, False):
            for times in (1.0, 2.0):
                coverage(wide, wrist, times, given.logs)
    print("careful first, then fast")
    for sensor in SENSORS:
        carried(sensor, given.loads, given.trips)


if __name__ == "__main__":
    main()
