"""Loads against the rim of a tray: how much sooner, and does the rim hold them in the engine?

python benchmarks/rims.py --docs     the table of docs/physics.md: three loads with and without a rim
python benchmarks/rims.py --random 20    random loads, rims and ways: runs at corners of the ranges, at full and at
                                         half speed, and of the same motions without the rim
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from salver import sampling
from salver.planning.fastest import plan_fastest
from salver.planning.plan import Plan
from salver.scenario import Scenario, load
from salver.simulation.physics import Experiment

DOCS = Path(__file__).parents[1] / "docs"
PAGE = DOCS / "physics.md"
TRAY = {"size": [0.2, 0.2]}
CORNERS = 4  # of the ranges, for each motion at each speed
RANGES = {"mass": "10%", "friction": "10%", "com": [0.002, 0.002, 0.005], "position": [0.002, 0.002]}
LOADS: dict[str, dict[str, Any]] = {
    "box, 6 x 6 x 15 cm": {"shape": {"type": "box", "size": [0.06, 0.06, 0.15]}, "mass": 0.4, "friction": 0.35},
    "bottle, 6.6 x 20 cm": {
        "shape": {"type": "cylinder", "radius": 0.033, "height": 0.2},
        "mass": 0.5,
        "friction": 0.35,
    },
    "slippery book": {"shape": {"type": "box", "size": [0.12, 0.09, 0.03]}, "mass": 0.5, "friction": 0.12},
}


def scenario(item: dict[str, Any], rim: dict[str, Any], friction_rim: float = 0.0) -> Scenario:
    """One object on a Panda's tray with a rim, half a metre along y."""
    given = {"name": "load", "uncertainty": RANGES, **item}
    base = load("panda-cube").with_changes(
        objects=[given],
        tray=TRAY | {"rim": rim},
        contact__condition="exact",
        motion__duration=None,
        arm={"model": "panda"},
    )
    return base.with_changes(uncertainty__friction_rim=friction_rim) if friction_rim else base


def without_rim(found: Scenario) -> Scenario:
    """The same object at the same place of a tray without a rim; its place is as exact."""
    body, data = found.payload.first, found.model_dump(mode="json", exclude_none=True)
    (item,) = data["objects"]
    centre = body.p_EB - body.R_EB @ body.com_G
    half = [0.0 if pushed else x for x, pushed in zip(RANGES["position"], body.pushed, strict=True)]
    item |= {"at": centre[:2].tolist(), "uncertainty": item["uncertainty"] | {"position": half}}
    del item["against"], data["tray"]["rim"]
    data["uncertainty"].pop("friction_rim", None)
    return Scenario.model_validate(data)


def outcomes(plan: Plan, seed: int, speeds: tuple[float, ...] = (1.0, 0.5)) -> Counter[str]:
    """Outcomes of runs at corners of the ranges, the least friction among them."""
    payload, seen = plan.scenario.payload, Counter[str]()
    names, drawn = payload.uncertain.names, sampling.draw(payload.uncertain, CORNERS, seed, "corners", payload.bodies)
    for speed in speeds:
        experiment = Experiment(plan if speed == 1.0 else plan.at_speed(speed))
        for row in drawn:
            seen[experiment.run(dict(zip(names, map(float, row), strict=True))).outcome] += 1
    return seen


def stripped(plan: Plan) -> Plan:
    """The motion of a plan, with its load on a tray without a rim."""
    return replace(plan, scenario=without_rim(plan.scenario))


def random_task(number: int) -> Scenario:
    rng = np.random.default_rng([39, number])
    width, height = rng.uniform(0.05, 0.10), rng.uniform(0.06, 0.18)
    kind = ("box", "cylinder", "prism")[number % 3]
    shape: dict[str, Any] = {"type": kind, "height": height}
    if kind == "box":
        shape = {"type": kind, "size": [width, rng.uniform(0.05, 0.10), height]}
    elif kind == "cylinder":
        shape |= {"radius": 0.5 * width}
    else:
        shape |= {"polygon": [[0.5 * width, 0.0], [0.0, 0.5 * width], [-0.5 * width, 0.0], [0.0, -0.4 * width]]}
    sides = [["-y"], ["+y"], ["-x"], ["+y", "-x"], ["-y", "+x"]][int(rng.integers(5))]
    item = {
        "shape": shape,
        "mass": rng.uniform(0.2, 0.6),
        "friction": rng.uniform(0.15, 0.5),
        "against": sides,
        "yaw_deg": [0.0, 90.0, 30.0][int(rng.integers(3))],
    }
    rim = {"height": rng.uniform(0.01, 0.05), "friction": 0.2}
    return scenario(item, rim, 0.2)


def survey(count: int) -> str:
    kept, bare, lost, numbers = Counter[str](), Counter[str](), 0, 0
    for number in range(count):
        plan = plan_fastest(random_task(number))
        if not plan.ok:
            print(f"{number}: {plan.status.sentence}")
            continue
        with_rim, without = outcomes(plan, number), outcomes(stripped(plan), number, (1.0,))
        print(f"{number}: {plan.duration:.3f} s, with the rim {words(with_rim)}; without {words(without)}", flush=True)
        kept, bare, numbers = kept + with_rim, bare + without, numbers + 1
        lost += without["holds"] < without.total()
    return (
        f"{numbers} random boxes, cylinders and prisms against one or two sides of rims of 1 to 5 cm, whose friction "
        f"is 0 to 0.4 in the engine: {words(kept)} with the rim; without it {words(bare)}, and {lost} of the "
        f"{numbers} motions lose their load at some corner."
    )


def table() -> str:
    rows = ["| load | rim | away from it | against it | | runs against it | the same motion without the rim |"]
    rows += ["|---|---|---|---|---|---|---|"]
    for name, item in LOADS.items():
        for height in (0.01, 0.03):
            leaning = scenario(item | {"against": "-y"}, {"height": height})
            plan, free = plan_fastest(leaning), plan_fastest(without_rim(leaning))
            seen, bare = outcomes(plan, 0), outcomes(stripped(plan), 0, (1.0,))
            rows.append(
                f"| {name} | {1e3 * height:.0f} mm | {free.duration:.3f} s | {plan.duration:.3f} s "
                f"| {100 * (plan.duration / free.duration - 1):+.0f} % | {words(seen)} | {words(bare)} |"
            )
            print(rows[-1], flush=True)
    return "\n".join(rows)


def words(seen: Counter[str]) -> str:
    return ", ".join(f"{word} {number} of {seen.total()}" for word, number in seen.most_common())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--random", type=int, default=0)
    parser.add_argument("--docs", action="store_true")
    asked = parser.parse_args()
    if asked.docs:
        import blocks

        blocks.replace(PAGE, "rim", table())
        blocks.replace(PAGE, "random rims", survey(asked.random or 24))
    else:
        print(survey(asked.random))


if __name__ == "__main__":
    sys.path.insert(0, str(DOCS))
    main()
