"""Counted runs of identification and of learning while carrying: how often ranges cover the truth, what is dropped.

python benchmarks/learning.py --logs 112 [--docs]          # 9 cases of 112 logs, and the same with the noise doubled
python benchmarks/learning.py --logs 0 --loads 24 [--docs] # careful first, then fast

Logs are made by `salver.learning.sensors`, whose errors are not those that the estimator assumes. Loads are drawn
within mass +-50 %, centre of mass +-15 mm, and to be carried friction +-10 %, for the tall bottle on a Panda.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import salver as sv
from salver.errors import SalverError
from salver.learning import identify
from salver.learning.excite import plan_excite
from salver.learning.identify import NAMES
from salver.learning.sensors import SensedArm, Sensors
from salver.learning.trips import SENSORS, trips
from salver.models.parameters import inertial_vector
from salver.planning.plan import Plan
from salver.scenario import Scenario, load

HOWTO = Path(__file__).parents[1] / "docs" / "howto"
KINDS = {
    "wrist, half coloured": (True, Sensors(rate=1000.0)),
    "wrist, white": (True, Sensors(rate=1000.0, wrist_coloured=0.0)),
    "joint torques": (False, Sensors(rate=1000.0)),
}
WIDE = {"mass": "50%", "com": [0.015, 0.015, 0.015]}


def bottle() -> Scenario:
    return load("panda-tall-bottle").with_changes(objects__0__uncertainty=WIDE | {"friction": "10%"})


def coverage(name: str, plan: Plan, kind: str, times: float, count: int) -> str:
    """How many of the four parameters of each load lie within their ranges, and how wide these are."""
    inside, half, spent, refused = np.zeros(4, dtype=int), [], [], 0
    nominal, (wrist, sensors) = inertial_vector(plan.scenario.payload.first.inertial), KINDS[kind]
    for k in range(count):
        rng, values = np.random.default_rng([11, k]), nominal.copy()
        share = 1 + 0.5 * rng.uniform(-1, 1)
        values[0], values[1:4], values[4:] = share * values[0], 0.015 * rng.uniform(-1, 1, 3), share * values[4:]
        arm = SensedArm(plan, k, replace(sensors, times=times), wrist=wrist, joints=not wrist)
        loaded, empty = arm.log(values), arm.log(None)
        begun = time.process_time()
        try:
            ranges = identify(plan, [loaded], empty).ranges
        except SalverError as error:
            refused += 1
            print(f"  log {k}: {error}", file=sys.stderr)
            continue
        spent.append(time.process_time() - begun)
        inside += [ranges[n].low <= x <= ranges[n].high for n, x in zip(NAMES, values[:4], strict=True)]
        half.append([1e3 * ranges[n].half for n in NAMES])
    mass, *com = np.median(half, axis=0)
    least = 100 * inside.min() / max(1, count - refused)
    where = ", ".join(f"{x:.2f}" for x in com) + " mm" if max(com) < 14.9 else "not identified"
    held = f"{'/'.join(map(str, inside))} of {count - refused} ({least:.1f} %)"
    doubled, spent_ms = ", noise doubled" if times == 2 else "", 1e3 * np.median(spent)
    row = f"| {name} | {kind}{doubled} | {mass:.1f} g | {where} | {held} | {refused} | {spent_ms:.0f} ms |"
    print(row, file=sys.stderr, flush=True)
    return row


def carried(sensor: str, loads: int, count: int) -> str:
    """Trips with hidden loads: durations, and whether anything was lost."""
    ratio, durations, held, total = [], [], 0, 0
    for seed in range(1, loads + 1):
        made = list(trips(bottle(), count, seed, sensor))  # type: ignore[arg-type]
        held, total = held + sum(trip.outcome == "holds" for trip in made), total + len(made)
        durations.append([trip.plan.duration for trip in made])
        ratio.append(made[1].plan.duration / made[0].plan.duration if len(made) > 1 else np.nan)
        print(f"  {sensor} load {seed}: " + ", ".join(f"{d:.3f} s" for d in durations[-1]), file=sys.stderr, flush=True)
    full = [d for d in durations if len(d) == count]
    times = " | ".join(f"{t:.3f} s" for t in np.median(full, axis=0))
    row = f"| {sensor}, {loads} loads | {times} | {np.median(ratio):.3f} | {np.nanmax(ratio):.3f} | {held} of {total} |"
    print(row, file=sys.stderr, flush=True)
    return row


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--logs", type=int, default=40)
    asked.add_argument("--loads", type=int, default=4)
    asked.add_argument("--trips", type=int, default=3)
    asked.add_argument("--docs", action="store_true", help="write the tables into docs/howto")
    given = asked.parse_args()
    if given.logs:
        wide = bottle()
        motions = {
            "cube, 2.5 s": sv.plan("panda-cube"),
            "bottle, fastest": sv.plan("panda-tall-bottle", "fastest"),
            "bottle, excite, 2 s": plan_excite(wide, 2.0),
        }
        rows = ["| motion | sensor | mass | centre of mass x, y, z | inside | refused | time |", "|---" * 7 + "|"]
        for times in (1.0, 2.0):
            for name, plan in motions.items():
                scenario = plan.scenario.with_changes(objects__0__uncertainty=WIDE)
                for kind in KINDS:
                    rows.append(coverage(name, replace(plan, scenario=scenario), kind, times, given.logs))
        written("identified", HOWTO / "identify.md", rows, given.docs)
    if given.loads:
        heads = " | ".join(f"trip {k}" for k in range(1, given.trips + 1))
        rows = [
            f"| sensor | {heads} | second over first, median | worst | held |",
            "|---" * (given.trips + 4) + "|",
            *(carried(sensor, given.loads, given.trips) for sensor in SENSORS),
        ]
        written("learnt", HOWTO / "learn.md", rows, given.docs)


def written(name: str, page: Path, rows: list[str], into: bool) -> None:
    """Print a table, and put it into its page."""
    print("\n".join(rows), end="\n\n")
    if into:
        sys.path.insert(0, str(HOWTO.parent))
        import blocks

        blocks.replace(page, name, "\n".join(rows))


if __name__ == "__main__":
    main()
