"""Random tasks on many arms, half among obstacles: how many are solved, how near to the best known, how quickly?

    python benchmarks/survey.py -n 40 -o out/survey.jsonl     plan those that the file does not hold yet
    python benchmarks/survey.py --corners 10 -o out/survey.jsonl   run the plans of those that are solved in the engine
    python benchmarks/survey.py --table -o out/survey.jsonl   print the table of what it holds
    python benchmarks/survey.py --docs -o out/survey.jsonl    write it into docs/survey.md, and the data beside it
    ... --docs --other out/other.jsonl                        and, below, others that the program was not made with

Each task follows from its number; there is no floor. It is planned at the default effort and, to know what is possible,
at the thorough one with another seed. A task counts as solvable when any of them solves it; the best known is the
shortest; `--known FILE` adds what an earlier state of the program found (docs/data/survey.jsonl, for one).
One line of JSON for each task: a run that was interrupted goes on where it stopped.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from salver import sampling, scenario
from salver.errors import SalverError
from salver.models.arm.arm import load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.urdf import shared_folder
from salver.planning.fastest import EFFORTS, FastestOptions, plan_fastest
from salver.simulation.physics import Experiment

SEED = 20261121
THOROUGH = (replace(EFFORTS["thorough"], seed=1),)
DOCS = Path(__file__).parents[1] / "docs"
PAGE, DATA = DOCS / "survey.md", DOCS / "data" / "survey.jsonl"
SAME = 1e-4  # of a duration; plans that differ by less are one
TRIES = 50  # to place obstacles that leave both ends free
Task = Callable[[int], tuple[str, scenario.Scenario]]

# Name, reach (m) from the base, and, for those by URDF, file and flange.
ARMS: list[tuple[str, float, dict[str, str]]] = [
    ("panda", 0.80, {"model": "panda"}),
    ("ur3", 0.48, {"model": "ur3"}),
    ("ur5", 0.82, {"model": "ur5"}),
    ("ur10", 1.20, {"model": "ur10"}),
    ("xarm7", 0.65, {"model": "xarm7"}),
    ("gen3", 0.80, {"model": "gen3"}),
    ("jaco (URDF)", 0.75, {"model": "kinova_description/robots/kinova.urdf", "flange": "j2s6s200_end_effector"}),
    ("ur10 (URDF)", 1.20, {"model": "ur_description/urdf/ur10_robot.urdf", "flange": "tool0"}),
]


def task(number: int) -> tuple[str, scenario.Scenario]:
    """The arm's name and the scenario of a number; odd numbers have one to three obstacles."""
    rng = np.random.default_rng([SEED, number])
    name, reach, keys = ARMS[int(rng.integers(len(ARMS)))]
    arm: dict[str, Any] = dict(keys)
    if "flange" in arm:
        folder = shared_folder()
        if folder is None:
            raise SystemExit(
                "Two of the arms come with another package; install it with: pip install example-robot-data."
            )
        arm["model"] = str(folder / "example-robot-data" / "robots" / arm["model"])
        arm["limits"] = {"acceleration": 5.0}
    size = 0.5 * min(reach, 0.8)
    tall, wide = float(rng.uniform(0.15, 0.4) * size), float(rng.uniform(0.12, 0.25) * size)
    shape = {"type": "cylinder", "radius": wide / 2, "height": tall}
    if rng.random() < 0.5:
        shape = {"type": "box", "size": [wide, wide, tall]}
    ends = ends_of(rng, reach)
    data: dict[str, Any] = {
        "name": f"survey-{number}",
        "motion": {
            "start": {"position": ends[0].tolist()},
            "goal": {"position": ends[1].tolist()},
            "goal_yaw": "free" if rng.random() < 0.5 else "fixed",
        },
        "objects": [
            {
                "shape": shape,
                "mass": float(rng.uniform(0.1, 0.5)),
                "friction": float(rng.uniform(0.15, 0.6)),
                "support_inset": 0.002,
                "uncertainty": {"mass": "10%", "friction": "10%"} if rng.random() < 0.5 else {},
            }
        ],
        "contact": {"condition": "exact"},
        "tray": {"size": [0.45 * size, 0.45 * size], "mass": 0.2, "height": 0.05},
        "arm": arm,
        "surroundings": {"floor": "none"},
    }
    made = scenario.parse(data, data["name"])
    count = int(rng.integers(1, 4)) if number % 2 else 0
    return name, _among(made, ends, count, reach, rng) if count else made


def ends_of(rng: np.random.Generator, reach: float) -> list[np.ndarray]:
    """Where a motion begins and ends, m, in front of an arm."""
    ends: list[np.ndarray] = []
    while len(ends) < 2 or np.linalg.norm(ends[1] - ends[0]) < 0.35 * reach:
        angle = rng.uniform(-1.2, 1.2, 2)
        radius, height = rng.uniform(0.45, 0.75, 2) * reach, rng.uniform(0.25, 0.6, 2) * reach
        ends = list(np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1))
    return ends


def _among(
    free: scenario.Scenario, ends: list[np.ndarray], count: int, reach: float, rng: np.random.Generator
) -> scenario.Scenario:
    """Posts, boxes and balls near the way, none of them in the tray or its load at an end."""
    assert free.arm is not None
    arm, payload = load_arm(free.arm, free.tray), free.payload
    found: list[dict[str, Any]] = []
    for _ in range(TRIES):
        if len(found) == count:
            break
        x, y, z = ends[0] + rng.uniform(0.25, 0.75) * (ends[1] - ends[0]) + rng.normal(0, 0.06, 3) * reach
        place = (float(x), float(y), float(max(z, 0.1)))
        kind = int(rng.integers(3))
        it: dict[str, Any] = {"type": "sphere", "radius": 0.05 * reach, "position": place}
        if kind == 0:
            height = place[2]
            it = {"type": "cylinder", "radius": 0.04 * reach, "height": height, "position": (*place[:2], height / 2)}
        elif kind == 1:
            it = {"type": "box", "size": (0.15 * reach, 0.15 * reach, 0.1 * reach), "position": place}
        it["name"] = f"obstacle-{len(found)}"
        tried = free.with_changes(obstacles=[*found, it])
        parts = arm_geometry(arm, payload.bodies, tried.obstacles)
        first = payload.first
        clear = np.hypot(*place[:2]) > 0.25 * reach
        if clear and all(parts.in_the_way(end - first.p_EB, np.eye(3)) is None for end in ends):
            found.append(it)
    return free.with_changes(obstacles=found) if found else free


def attempt(case: scenario.Scenario, options: FastestOptions | None) -> dict[str, Any]:
    """How one effort ends: duration in s (None when nothing was found that holds), CPU time in s, why not."""
    cpu = time.process_time()
    try:
        plan = plan_fastest(case, options=options)
        duration = plan.duration if plan.ok else None
        complaints = [s for s in (plan.status, plan.arm_status, plan.verification) if s is not None and not s.ok]
        says = complaints[0].sentence if complaints else ""
    except SalverError as error:
        duration, says = None, str(error)
    return {"duration": duration, "cpu": time.process_time() - cpu, "says": says}


def survey(numbers: range, path: Path, thorough: bool, task: Task = task) -> None:
    """Plan the tasks that the file does not hold yet, one line each."""
    path.parent.mkdir(parents=True, exist_ok=True)
    done = {record["number"] for record in read(path)}
    for number in numbers:
        if number in done:
            continue
        name, case = task(number)
        record: dict[str, Any] = {"number": number, "arm": name, "obstacles": len(case.obstacles)}
        record["default"] = attempt(case, None)
        record["thorough"] = [attempt(case, options) for options in THOROUGH] if thorough else []
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
        print(number, name, record["obstacles"], record["default"], flush=True)


def run_corners(path: Path, count: int, task: Task = task) -> None:
    """Plan each solved task again, and run it in the engine with objects at so many corners of the set, drawn at
    random; one line for each, beside the file. A corner that is drawn again would end as before, and counts again."""
    beside = corners_of(path)
    done = {record["number"]: record for record in read(beside)}
    for record in read(path):
        number = record["number"]
        if _of_this_plan(done.get(number), record) or record["default"]["duration"] is None:
            continue
        name, case = task(number)
        plan = plan_fastest(case)
        payload, experiment = plan.scenario.payload, Experiment(plan)
        drawn = sampling.draw(payload.uncertain, count, 0, "corners", payload.bodies)
        names = payload.uncertain.names
        corners = [tuple(map(float, row)) for row in drawn]
        ran = {corner: experiment.run(dict(zip(names, corner, strict=True))) for corner in set(corners)}
        outcomes = [ran[corner].outcome for corner in corners]
        line = {"number": number, "ok": plan.ok, "held": outcomes.count("holds"), "runs": count, "distinct": len(ran)}
        line |= {"duration": plan.duration, "outcomes": outcomes}
        if limited := [run.summary["arm"] for run in ran.values() if run.outcome == "limit"]:
            line["limited"] = {key: max(arm[key] for arm in limited) for key in ("torque_share_peak", "torque_cut")}
        with beside.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line) + "\n")
        print(number, name, line, flush=True)


def _of_this_plan(ran: dict[str, Any] | None, record: dict[str, Any]) -> bool:
    """Whether runs at corners were of the plan that a record tells of."""
    duration = record["default"]["duration"]
    return ran is not None and duration is not None and abs(ran.get("duration", 0.0) - duration) < SAME * duration


def corners_of(path: Path) -> Path:
    return path.with_suffix(".corners.jsonl")


def read(path: Path) -> list[dict[str, Any]]:
    """The records of a file; a last line that was cut off is left out."""
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    return [json.loads(line) for line in lines if line.endswith("\n")]


def best_known(record: dict[str, Any]) -> float | None:
    """The shortest duration that any effort found, s; None when none found any."""
    found = [tried["duration"] for tried in (record["default"], *record["thorough"])] + record.get("known", [])
    return min((duration for duration in found if duration is not None), default=None)


def table(records: list[dict[str, Any]]) -> str:
    """Markdown: one row for each arm, for tasks with and without obstacles, and for all."""
    rows = ["| tasks | number | solvable | solved | within 3 % | within 10 % | CPU time, median, s | below 3 s |"]
    rows.append("|---|---|---|---|---|---|---|---|")
    groups = {name: [r for r in records if r["arm"] == name] for name, _, _ in ARMS}
    groups["without obstacles"] = [r for r in records if not r["obstacles"]]
    groups["with obstacles"] = [r for r in records if r["obstacles"]]
    groups["all"] = records
    for name, group in groups.items():
        if not group:
            continue
        best = [best_known(record) for record in group]
        solvable = [(r["default"], known) for r, known in zip(group, best, strict=True) if known is not None]
        ratios = np.array([default["duration"] / known for default, known in solvable if default["duration"]])
        cpu = np.array([r["default"]["cpu"] for r in group])
        near = [f"{int((ratios <= limit).sum())}" for limit in (1.03, 1.10)]
        row = [name, len(group), len(solvable), len(ratios), *near, f"{np.median(cpu):.2f}", f"{int((cpu < 3).sum())}"]
        rows.append(f"| {' | '.join(map(str, row))} |")
    return "\n".join(rows)


def page(records: list[dict[str, Any]], ran: list[dict[str, Any]], others: list[dict[str, Any]]) -> str:
    """docs/survey.md: what was done, the table, and the tasks that are not as they should be; then other tasks, that
    the program was not made with. ran: runs at corners, of any of them."""
    compared, known = (sum(bool(r.get(key)) for r in records) for key in ("thorough", "known"))
    also = " and ".join(
        [f"{compared} of them at `--effort thorough` too, with another seed,"] * bool(compared)
        + [f"{known} by earlier states of the program, at both efforts:"] * bool(known)
    )
    lines = [
        "# Random tasks",
        "",
        *_findings(records, ran),
        "",
        "![Tasks by how far the duration found is above the best known one](images/survey.svg)",
        "",
        "Written by `python benchmarks/survey.py --docs`; one line for each task is in `docs/data/survey.jsonl`.",
        "",
        f"Tasks {records[0]['number']} to {records[-1]['number']} of the survey: random ends, loads and cells on",
        "the arms that salver knows and on two URDFs, no floor; every other one has one to three obstacles near it.",
        f"Each is planned at the default effort, {also or 'and nothing else:'}",
        "a task that any of these solves counts as solvable. The shortest duration is the best known;",
        "a shorter one may exist. A task that was planned at the default effort only is not compared.",
        "Times are processor times of one core.",
        "",
        table(records),
        "",
        *_exceptions(records),
        _in_engine(records, ran),
        "",
    ]
    if others:
        lines += [
            "## Tasks that the program was not made with",
            "",
            f"Tasks {others[0]['number']} to {others[-1]['number']}, planned at both efforts by the program as it is.",
            "",
            table(others),
            "",
            *_exceptions(others),
            _in_engine(others, ran),
            "",
        ]
    return "\n".join(lines)


def _findings(records: list[dict[str, Any]], ran: list[dict[str, Any]]) -> list[str]:
    found = [(r["default"]["duration"], best) for r in records if (best := best_known(r))]
    near = sum(bool(duration) and duration <= 1.03 * best for duration, best in found)
    cpu = np.median([r["default"]["cpu"] for r in records])
    numbers = {r["number"] for r in records}
    held, runs = (sum(run[key] for run in ran if run["number"] in numbers) for key in ("held", "runs"))
    return [
        f"- Of {len(found)} random tasks that have a known solution the default effort solves "
        f"{sum(bool(duration) for duration, _ in found)}, {near} within 3 % of the best known duration.",
        f"- A task takes {cpu:.2f} s of processor time at the median.",
        f"- In the physics engine {held} of {runs} runs with the worst loads hold.",
    ]


def _exceptions(records: list[dict[str, Any]]) -> list[str]:
    """Tasks that were missed, that are slower than the best known, and that nothing solves."""
    default = [(r, r["default"]["duration"], best_known(r)) for r in records]
    missed = [
        f"{r['number']} ({r['arm']}): {r['default']['says'].rstrip('.')}"
        for r, found, best in default
        if best and not found
    ]
    slower = [
        f"{r['number']} ({r['arm']}): {found:.3f} s, {best:.3f} s is known"
        for r, found, best in default
        if best and found and found > 1.03 * best
    ]
    unsolved = [f"{r['number']} ({r['arm']})" for r, _, best in default if best is None]
    return [
        f"Solvable and not solved at the default effort: {'; '.join(missed) or 'none'}.",
        "",
        f"More than 3 % above the best known: {'; '.join(slower) or 'none'}.",
        "",
        f"Not solved in any run: {', '.join(unsolved) or 'none'}.",
        "",
    ]


def _in_engine(records: list[dict[str, Any]], ran: list[dict[str, Any]]) -> str:
    """How many of the runs at corners hold."""
    latest = {record["number"]: record for record in ran}
    of_these = [latest[r["number"]] for r in records if _of_this_plan(latest.get(r["number"]), r)]
    lost = [f"{run['number']} ({run['runs'] - run['held']})" for run in of_these if run["held"] < run["runs"]]
    solved = sum(r["default"]["duration"] is not None for r in records)
    return (
        "In the physics engine, with the arm and with objects at corners of the uncertain set (`--corners 10`), "
        f"{sum(run['held'] for run in of_these)} of {sum(run['runs'] for run in of_these)} runs hold, of "
        f"{len(of_these)} of the {solved} solved tasks. {sum(run['distinct'] for run in of_these)} of them are "
        "different: a corner that was drawn again, and a task without ranges, is run once and counted as often."
        f"{' Lost: ' + ', '.join(lost) + '.' if lost else ''}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=200, help="tasks up to n - 1,")
    parser.add_argument("--first", type=int, default=0, help="from this one on")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/survey.jsonl"))
    parser.add_argument("--table", action="store_true", help="only print the table")
    parser.add_argument("--docs", action="store_true", help="write the page of what the file holds")
    parser.add_argument("--corners", type=int, default=0, help="only run solved tasks so often at corners")
    parser.add_argument("--known", type=Path, action="append", default=[], help="records of earlier states")
    parser.add_argument("--other", type=Path, help="records of tasks that the program was not made with")
    parser.add_argument("--quick", action="store_true", help="without the thorough effort")
    given = parser.parse_args()
    if given.corners:
        run_corners(given.out, given.corners)
        return
    if not (given.table or given.docs):
        survey(range(given.first, given.n), given.out, thorough=not given.quick)
    records = sorted(read(given.out), key=lambda record: int(record["number"]))
    earlier = [(known["number"], best_known(known)) for path in given.known for known in read(path)]
    for record in records:
        known = [best for number, best in earlier if best and number == record["number"]]
        record["known"] = [*record.get("known", []), *sorted(known)[:1]]
    if given.docs:
        DATA.write_text("".join(json.dumps(record) + "\n" for record in records), encoding="utf-8")
        others = sorted(read(given.other), key=lambda record: int(record["number"])) if given.other else []
        ran = read(corners_of(given.out)) + (read(corners_of(given.other)) if given.other else [])
        PAGE.write_text(page(records, ran, others), encoding="utf-8")
    print(table(records))


if __name__ == "__main__":
    main()
