"""First files of newcomers: an arm, one object, a start and a goal, nothing else. What is planned, and is it kept?

    python benchmarks/newcomers.py -n 60 -o out/newcomers.jsonl      plan those that the file does not hold yet
    ... --corners 4                                                  and run each plan in the engine
    ... --urdf arm.urdf tool0 --package-dir packages                 with other arms beside those by name
    ... --urdfs folder --package-dir packages                        with the URDFs of a folder alone
    ... --reachable                                                  all arms by name, at ends in reach of 60 postures
    ... --price                                                      what each default costs in duration, beside it
    python benchmarks/newcomers.py --table -o out/newcomers.jsonl    print only what the file holds

Each file follows from its number. Every other one gives a duration (2 s) too, and is planned by the default method, the
safest, and as the fastest; the others ask for the fastest motion by leaving it out.

How low the arm reaches is read off the visual meshes of its links, placed by Pinocchio every 10 ms: no shape of the
planner's, no Coal. In the engine the object is the nominal one and one at corners drawn at random: friction 10 % less,
mass 8 % either way, centre of mass and place 2 mm along both axes; at full speed and at half of it.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from salver import scenario
from salver.errors import SalverError
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import ArmGeometry, arm_geometry
from salver.models.arm.known_arms import KNOWN_ARMS
from salver.models.bodies import Body
from salver.planning.fastest import plan_fastest
from salver.planning.make import make_plan
from salver.planning.plan import Plan
from salver.planning.postures import REACHED, PoseTarget, posture_at
from salver.simulation.physics import Experiment
from salver.simulation.scene.meshes import arm_meshes
from survey import ARMS, read

SEED, STEP, DURATION = 20261125, 0.01, 2.0
SPEEDS = (1.0, 0.5)
GUESSES, DRAWS, APART = 60, 300, 0.35
REFUSED = ("UnreachableError", "unreachable", "collision", "falls")  # an end is impossible, or the duration too short
# Defaults that make a newcomer's plan safe, each turned off.
DEFAULTS: dict[str, dict[str, Any]] = {
    "the floor": {"surroundings__floor": "none"},
    "assumed ranges": {"objects__0__uncertainty": "none"},
    "any speed": {"motion__speeds": "full"},
}
DEFAULTS["all three"] = {key: value for off in DEFAULTS.values() for key, value in off.items()}
Arms = list[tuple[str, float, dict[str, Any]]]


def task(number: int, arms: Arms, reachable: bool = False) -> tuple[str, scenario.Scenario]:
    """The arm's name and the scenario of a number; the arms take turns where the ends must be reachable."""
    rng = np.random.default_rng([SEED, number])
    if not reachable:
        return _drawn(number, arms, rng)
    chosen = arms[number % len(arms)]
    name, case = _drawn(number, [chosen], rng)
    assert case.arm is not None
    arm, ends = load_arm(case.arm, case.tray), list[np.ndarray]()
    parts = arm_geometry(arm, case.payload.bodies, case.around)
    for _ in range(DRAWS):
        at = _place(rng, chosen[1], 1, most=1.2)[0]
        far = all(np.linalg.norm(at - end) >= APART * chosen[1] for end in ends)
        if far and stands(parts, case.payload.first, at):
            ends.append(at)
        if len(ends) == 2:
            start, goal = (end.tolist() for end in ends)
            return name, case.with_changes(motion__start__position=start, motion__goal__position=goal)
    raise SalverError(f"Of {DRAWS} places for {name} no two are within its reach and apart.")


def stands(parts: ArmGeometry, load: Body, at: np.ndarray) -> bool:
    """Whether one of `GUESSES` random postures leads to one in which the load is at a place and nothing touches."""
    arm, target = parts.arm, PoseTarget(at, np.eye(3), load.p_EB, load.R_EB)
    low, high = np.maximum(arm.limits.q_min, -np.pi), np.minimum(arm.limits.q_max, np.pi)
    for guess in np.random.default_rng(0).uniform(low, high, (GUESSES, arm.n)):
        q, error = posture_at(arm, target, guess, limits=arm.limits, iterations=30)
        if error < REACHED and parts.first_touch(q[None]) is None:
            return True
    return False


def _place(rng: np.random.Generator, reach: float, count: int, most: float = 0.75) -> np.ndarray:
    """Places (count, 3), m, in front of an arm, up to `most` of its reach away."""
    angle, radius = rng.uniform(-1.2, 1.2, count), rng.uniform(0.45, most, count) * reach
    height = rng.uniform(0.3, most - 0.05, count) * reach
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)


def _drawn(number: int, arms: Arms, rng: np.random.Generator) -> tuple[str, scenario.Scenario]:
    name, reach, keys = arms[int(rng.integers(len(arms)))]
    ends = _place(rng, reach, 2)
    while np.linalg.norm(ends[1] - ends[0]) < APART * reach:
        ends = _place(rng, reach, 2)
    tall, wide = float(rng.uniform(0.06, 0.22)), float(rng.uniform(0.05, 0.09))
    shape = {"type": "cylinder", "radius": wide / 2, "height": tall}
    if rng.random() < 0.5:
        shape = {"type": "box", "size": [wide, wide, tall]}
    motion: dict[str, Any] = {"start": {"position": ends[0].tolist()}, "goal": {"position": ends[1].tolist()}}
    if number % 2:
        motion["duration"] = DURATION
    item = {"shape": shape, "mass": float(rng.uniform(0.1, 0.5)), "friction": float(rng.uniform(0.2, 0.6))}
    return name, scenario.parse({"name": f"newcomer-{number}", "motion": motion, "objects": [item], "arm": keys}, name)


def lowest(plan: Plan, arm: ArmModel) -> dict[str, float]:
    """m over the base of the lowest point of each link that moves, over a plan's motion."""
    assert plan.joint is not None
    q = plan.joint.sample(np.arange(0.0, plan.joint.duration, STEP))[0]
    points = {link: np.vstack([part.vertices for part in parts]) for link, parts in arm_meshes(arm).items()}
    low = {link: np.inf for link in points if np.ptp([arm.link_pose(x, link)[1] for x in q], axis=0).max() > 1e-6}
    for x in q:
        for link in low:
            p, R = arm.link_pose(x, link)
            low[link] = min(low[link], float(p[2] + (points[link] @ R[2]).min() - arm.base_position[2]))
    return low


def corners(case: scenario.Scenario, count: int, rng: np.random.Generator) -> list[dict[str, float]]:
    """True values of so many objects, drawn at random, and none for the nominal one."""
    item, (com, side) = case.objects[0], 2e-3 * rng.choice([-1.0, 1.0], (2, count, 3))
    masses = item.mass * (1 + 0.08 * rng.choice([-1.0, 1.0], count))
    return [{}] + [
        {"friction": 0.9 * item.friction, "mass": float(mass), "com_x": x, "com_y": y, "position_x": u, "position_y": v}
        for mass, (x, y, _), (u, v, _) in zip(masses, com.tolist(), side.tolist(), strict=True)
    ]


def attempt(case: scenario.Scenario, method: str | None, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """One plan of one file: whether it is safe by itself, how low it reaches, how its runs end."""
    began = time.process_time()
    try:
        plan = make_plan(case, method)
    except SalverError as error:
        return {"ok": False, "code": type(error).__name__, "says": str(error), "cpu": time.process_time() - began}
    found: dict[str, Any] = {"ok": plan.ok, "code": plan.status.code, "says": plan.verdict}
    found["cpu"] = time.process_time() - began
    if not plan.ok or plan.joint is None:
        return found
    assert case.arm is not None
    links = lowest(plan, load_arm(case.arm, case.tray))
    link = min(links, key=lambda name: links[name])
    found |= {"duration": plan.duration, "lowest": links[link], "link": link}
    for speed in SPEEDS if count else ():
        run = Experiment(plan.at_speed(speed) if speed < 1 else plan)
        outcomes = [run.run(true) for true in corners(case, count, rng)]
        found[f"at {speed:g}"] = [(record.outcome, float(record.slip.max())) for record in outcomes]
    return found


def without(case: scenario.Scenario) -> dict[str, float | None]:
    """Duration, s, of the fastest plan with all defaults ("") and with each turned off; None without a plan."""
    found: dict[str, float | None] = {}
    for name, off in {"": {}, **DEFAULTS}.items():
        plan = plan_fastest(case.with_changes(motion__duration=None, **off))
        found[name] = plan.duration if plan.ok else None
    return found


def prices(records: list[dict[str, Any]]) -> str:
    """Markdown: what each default costs in duration, over the files that have a plan with and without it."""
    rows = ["| default | files | mean | median | most | planned only without it |", "|---|---|---|---|---|---|"]
    found = [record["without"] for record in records if "without" in record]
    for name in DEFAULTS if found else ():
        more = [100 * (one[""] / one[name] - 1) for one in found if one[""] and one[name]]
        only = sum(1 for one in found if one[name] and not one[""])
        figures = (f"{x:.1f} %" for x in (np.mean(more), np.median(more), np.max(more)))
        rows.append(f"| {name} | {len(more)} | {' | '.join(figures)} | {only} |")
    return "\n".join(rows) if found else ""


def table(records: list[dict[str, Any]]) -> str:
    """Markdown: one row for each method."""
    rows = [
        "| planned as | files | refused | planned | lowest link, m | below the base | runs | not held |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for method in ("default", "fastest"):
        tried = [record[method] for record in records if method in record]
        ok = [found for found in tried if "lowest" in found]
        runs = [outcome for found in ok for speed in SPEEDS for outcome, _ in found.get(f"at {speed:g}", ())]
        low = [found["lowest"] for found in ok]
        refused = sum(found.get("code") in REFUSED for found in tried)
        lost = sum(outcome != "holds" for outcome in runs)
        height = f"{min(low, default=np.nan):.3f}"
        cells = [method, len(tried), refused, len(ok), height, sum(x < 0 for x in low), len(runs), lost]
        rows.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(rows)


def in_folder(folder: Path) -> list[tuple[str, str]]:
    """The URDFs of a folder, each with the link tool0 or else its last one, as the flange."""
    files = sorted(folder.glob("*.urdf"))
    links = [[link.get("name", "") for link in ElementTree.parse(file).getroot().iter("link")] for file in files]
    return [(str(file), "tool0" if "tool0" in names else names[-1]) for file, names in zip(files, links, strict=True)]


def own(urdf: str, flange: str, packages: list[str]) -> tuple[str, float, dict[str, Any]]:
    """A URDF as an arm of `ARMS`."""
    return measured({"model": urdf, "flange": flange, "package_dirs": packages, "limits": {"acceleration": 5.0}})


def measured(keys: dict[str, Any]) -> tuple[str, float, dict[str, Any]]:
    """An arm of `ARMS`; its reach is what three of four random postures stay within."""
    arm = load_arm(scenario.Arm.model_validate(keys), scenario.Tray())
    low, high = np.maximum(arm.limits.q_min, -np.pi), np.minimum(arm.limits.q_max, np.pi)
    drawn = np.random.default_rng(0).uniform(low, high, (400, arm.n))
    away = [np.linalg.norm(arm.tray_pose(q)[0][:2]) for q in drawn]
    return Path(keys["model"]).stem, float(np.quantile(away, 0.75)), keys


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=60, help="files up to n - 1,")
    parser.add_argument("--first", type=int, default=0, help="from this one on")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/newcomers.jsonl"))
    parser.add_argument("--corners", type=int, default=0, help="objects beside the nominal one in the engine")
    parser.add_argument("--urdf", nargs=2, action="append", default=[], metavar=("FILE", "FLANGE"))
    parser.add_argument("--urdfs", type=Path, help="folder of URDFs, which are the only arms")
    parser.add_argument("--reachable", action="store_true", help="only files whose ends can be reached")
    parser.add_argument("--package-dir", action="append", default=[], help="folder of packages whose meshes URDFs name")
    parser.add_argument("--price", action="store_true", help="plan without each default, too")
    parser.add_argument("--table", action="store_true", help="only print the table")
    given = parser.parse_args()
    arms: Arms = [arm for arm in ARMS if "flange" not in arm[2] and given.urdfs is None]
    if given.reachable and given.urdfs is None:
        arms = [measured({"model": name}) for name, arm in KNOWN_ARMS.items() if arm.package is None]
    urdfs = [*given.urdf, *(() if given.urdfs is None else in_folder(given.urdfs))]
    arms += [own(urdf, flange, given.package_dir) for urdf, flange in urdfs]
    done = {record["number"] for record in read(given.out)}
    given.out.parent.mkdir(parents=True, exist_ok=True)
    for number in [] if given.table else sorted(set(range(given.first, given.n)) - done):
        try:
            name, case = task(number, arms, given.reachable)
        except SalverError as error:
            print(number, error, flush=True)
            continue
        rng, record = np.random.default_rng([SEED, number, 1]), {"number": number, "arm": name}
        for key, method in (("default", None), ("fastest", "fastest"))[: 2 if case.motion.duration else 1]:
            record[key] = attempt(case, method, given.corners, rng)
        if given.price:
            record["without"] = without(case)
        with given.out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
        print(number, name, record, flush=True)
    print(table(read(given.out)), prices(read(given.out)), sep="\n\n")


if __name__ == "__main__":
    main()
