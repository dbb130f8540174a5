"""Shortest safe durations of upright's tasks on a base that drives, beside the same arm on a base that stands.

    python benchmarks/mobile_base.py      writes the table of docs/howto/mobile-base.md

Goals are those of upright's experiments, as displacements from the home posture of the scenario `ridgeback-bottle`
(github.com/utiasDSL/upright, upright_cmd/config: ral23/experiments/_point1.yaml, _point2.yaml, _point3.yaml,
demos/ur10_demo.yaml); the other loads are those of the scenarios `upright-...`.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from salver.errors import UnreachableError
from salver.models.arm.arm import load_arm
from salver.planning.fastest import plan_fastest
from salver.scenario import Scenario, load

PAGE = Path(__file__).parents[1] / "docs" / "howto" / "mobile-base.md"
GOALS = ((-2.0, 1.0, 0.0), (2.0, 0.0, -0.25), (0.0, -2.0, 0.25), (-0.25, 0.5, 0.25))  # m
LOADS = ("bottle", "dice", "arch", "cups")


def of_load(case: Scenario, name: str, goal: tuple[float, ...]) -> Scenario:
    """The task with a load of upright's and a goal, on the base that drives."""
    objects = load(f"upright-{name}").model_dump(mode="json", exclude_none=True)["objects"]
    loaded = case if name == "bottle" else case.with_changes(objects=objects)
    first, arm = loaded.payload.first, load_arm(loaded.arm, loaded.tray)
    start, _ = arm.object_pose(np.array(loaded.arm.start_posture), first.p_EB, first.R_EB)
    ends = {"motion__start__position": start.tolist(), "motion__goal__position": (start + goal).tolist()}
    return loaded.with_changes(**ends)


def standing(case: Scenario) -> Scenario:
    """The task with the arm where the base that drives would have it at the start."""
    (x, y, _, *posture), base = case.arm.start_posture, case.arm.base
    place = {"base": None, "base_position": [x + base.mount[0], y + base.mount[1], base.mount[2]]}
    place |= {"base_rpy_deg": list(base.mount_rpy_deg), "start_posture": posture}
    return case.with_changes(surroundings__floor=0.0, **{f"arm__{key}": value for key, value in place.items()})


def duration(case: Scenario) -> str:
    try:
        plan = plan_fastest(case)
    except UnreachableError:
        return "out of reach"
    return f"{plan.duration:.2f}" if plan.ok else "none found"


def main() -> None:
    case = load("ridgeback-bottle")
    rows = ["| load | displacement, m | omnidirectional, s | differential, s | standing, s |", "|---|---|---|---|---|"]
    for name, goal in [*(("bottle", goal) for goal in GOALS), *((name, GOALS[0]) for name in LOADS[1:])]:
        task = of_load(case, name, goal)
        place = ", ".join(f"{x:g}" for x in goal)
        each = (task, task.with_changes(arm__base__kind="differential"), standing(task))
        rows.append(f"| {name} | {place} | {' | '.join(map(duration, each))} |")
        print(rows[-1], flush=True)
    sys.path.insert(0, str(PAGE.parents[1]))
    import blocks

    blocks.replace(PAGE, "durations", "\n".join(rows))


if __name__ == "__main__":
    main()
