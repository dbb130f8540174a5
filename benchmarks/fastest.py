"""How fast, and does it survive? Ten scenarios by six ways of finding the shortest duration.

    python benchmarks/fastest.py [-n 1000] [--all] [--only "tall bottle" ...] [--again] [--jobs 2]

    line     the straight level min-jerk line, as fast as limits and nominal contact allow
    TOPP     the same line with the time-optimal law for nominal contact (no jerk, as TOPP-RA)
    paper    the paper's polynomial plan and condition (eqs 13-17), shortest duration the arm can follow
    nominal  the fastest motion, tray free to tilt, that trusts the nominal parameters
    level    the fastest robust motion with a level tray
    tilting  the fastest robust motion, tray free to tilt

Each motion is run n times in the physics engine with parameters drawn from the scenario's uncertain set, its
corners first, the same for every way; line and paper, which are slow, at most 32 times without --all. The
runs of a motion are a campaign in runs/fastest/SCENARIO/WAY: what was stopped goes on where it was, and
`salver simulate runs/fastest/SCENARIO/WAY --run K` shows a run. --again finds the motions anew.

Results are kept in docs/data/fastest.json; docs/peers.md says of the paper's way what they are.
"""

from __future__ import annotations

import argparse
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from salver.campaigns import run_campaign
from salver.errors import SalverError, Status
from salver.files import read_json, write_json
from salver.geometry import Array
from salver.planning.fastest import fastest, object_motion
from salver.planning.fastest.retiming import SplinePath, reachable_law
from salver.planning.make import plan_baseline, plan_object, with_arm
from salver.planning.plan import Plan, load_plan
from salver.planning.trajopt.constraints.constraints import evaluate, worst_of
from salver.planning.trajopt.problem import TransportProblem, transport_problem
from salver.scenario import Scenario, load
from salver.trajectory import JointMotion, SampledReference

ROOT = Path(__file__).parent.parent
DATA = ROOT / "docs" / "data" / "fastest.json"
WORK = ROOT / "runs" / "fastest"
METHODS = ("line", "TOPP", "paper", "nominal", "level", "tilting")
SLOW = ("line", "paper")
FEW = 32  # runs of these
REPORT_EVERY = 30.0  # s between lines of progress


def item(name: str, shape: dict[str, Any], mass: float, friction: float, **more: Any) -> dict[str, Any]:
    return {"name": name, "shape": shape, "mass": mass, "friction": friction, **more}


def box(x: float, y: float, z: float) -> dict[str, Any]:
    return {"type": "box", "size": [x, y, z]}


def cylinder(radius: float, height: float) -> dict[str, Any]:
    return {"type": "cylinder", "radius": radius, "height": height, "support_points": 8}


def scenarios() -> dict[str, Scenario]:
    """Ten loads on the paper's Panda and endpoints; heights follow the load, so that the tray starts at one place."""
    loads: dict[str, tuple[list[dict[str, Any]], dict[str, Any]]] = {
        "cube, friction 0.5": ([item("cube", box(0.04, 0.04, 0.04), 0.256, 0.5, uncertainty={"mass": "10%"})], {}),
        "cube, friction 0.4": ([_cube(0.4, com=[0.002] * 3, mass="20%", friction="10%")], {}),
        "cube, friction 0.2": ([_cube(0.2, com=[0.002] * 3, mass="20%", friction="10%")], {}),
        "tall bottle": (
            [
                item(
                    "bottle",
                    cylinder(0.03, 0.24),
                    0.256,
                    0.4,
                    uncertainty={"mass": "40%", "com": [0.005] * 3, "friction": "10%"},
                )
            ],
            {},
        ),
        "tall box": (
            [item("box", box(0.05, 0.05, 0.16), 0.4, 0.5, uncertainty={"mass": "20%", "com": [0.004, 0.004, 0.01]})],
            {},
        ),
        "can, half full": (
            [
                item(
                    "can",
                    cylinder(0.033, 0.12),
                    0.25,
                    0.3,
                    uncertainty={"mass": "30%", "com": [0.002, 0.002, 0.01], "friction": "15%"},
                )
            ],
            {},
        ),
        "cup off the middle": (
            [
                item(
                    "cup",
                    cylinder(0.04, 0.1),
                    0.3,
                    0.35,
                    at=[0.04, 0.03],
                    uncertainty={"mass": "20%", "position": [0.005, 0.005], "friction": "10%"},
                )
            ],
            {},
        ),
        "two cubes": (
            [
                _cube(0.4, name="left", at=[0.0, 0.04], com=[0.002] * 3, mass="20%", friction="10%"),
                _cube(0.4, name="right", at=[0.0, -0.04], com=[0.002] * 3, mass="20%", friction="10%"),
            ],
            {},
        ),
        "stack of two": (
            [
                item("lower", box(0.08, 0.08, 0.04), 0.3, 0.4, uncertainty={"mass": "10%", "friction": "10%"}),
                item("upper", box(0.05, 0.05, 0.04), 0.15, 0.4, on="lower", uncertainty={"mass": "20%"}),
            ],
            {},
        ),
        "tray mounted askew": (
            [_cube(0.4, com=[0.002] * 3, mass="20%", friction="10%")],
            {"uncertainty__tilt_deg": [1.0, 1.0]},
        ),
    }
    made = {}
    for name, (objects, changes) in loads.items():
        base = load("panda-cube").with_changes(
            name=name.replace(" ", "-").replace(",", ""),
            objects=objects,
            motion__goal_yaw="free",
            contact__condition="exact",
            **changes,
        )
        first = base.payload.first
        height = 0.38 + float(first.p_EB[2])
        start, goal = np.array([0.54237, -0.370574, height]), np.array([0.444272, 0.100574, height])
        offset = np.array([*first.p_EB[:2], 0.0])
        made[name] = base.with_changes(
            motion__start__position=(start + offset).tolist(), motion__goal__position=(goal + offset).tolist()
        )
    return made


def _cube(
    coefficient: float, /, name: str = "cube", at: list[float] | None = None, **uncertainty: Any
) -> dict[str, Any]:
    made = item(name, box(0.04, 0.04, 0.04), 0.256, coefficient, uncertainty=uncertainty)
    return made | ({"at": at} if at else {})


# The motions -----------------------------------------------------------------------------------------------------


def plan_of(scenario: Scenario, problem: TransportProblem, joint: JointMotion) -> Plan:
    """A motion of the joints as a plan that the simulation takes."""
    z = joint.sample(joint.t)
    reference = SampledReference(object_motion(problem, joint.t, *z))
    return Plan(scenario, "fastest", reference, Status("evaluated", "A motion for comparison.", True), joint)


def line_path(scenario: Scenario) -> SplinePath:
    timed = scenario.with_changes(motion__duration=2.5)
    followed = with_arm(plan_baseline(timed))
    if followed.joint is None:
        raise SalverError(f"{scenario.name}: the arm cannot follow the straight line.")
    return SplinePath.of(followed.joint)


def fastest_line(scenario: Scenario, problem: TransportProblem, path: SplinePath) -> tuple[float, Plan]:
    """Bisection on the duration of the min-jerk line."""
    s = np.linspace(0, 1, 201)
    nominal = replace(problem, max_tilt=np.inf, keep_out=None, tracking=None)
    long = with_arm(plan_baseline(scenario.with_changes(motion__duration=2.5))).joint
    assert long is not None

    def joint(duration: float) -> JointMotion:
        q, dq, ddq = long.sample(2.5 * s)
        ratio = 2.5 / duration
        return JointMotion(duration * s, q, dq * ratio, ddq * ratio**2)

    def kept(duration: float) -> bool:
        m = joint(duration)
        z = np.stack([m.q, m.dq, m.ddq, m.jerk(m.t)])
        return worst_of(evaluate(nominal.constraints, nominal.at(s, z, duration), margins=False))[0] <= 0

    low, high = 0.3, 6.0
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if kept(middle) else (middle, high)
    return high, plan_of(scenario, problem, joint(high))


def topp(scenario: Scenario, problem: TransportProblem, path: SplinePath) -> tuple[float, Plan]:
    law = reachable_law(problem, path)
    if law is None:
        raise SalverError(f"{scenario.name}: no time law on the line.")
    return float(law[0][-1]), plan_of(scenario, problem, JointMotion(*law_motion(path, *law)))


def law_motion(path: SplinePath, t: Array, u: Array) -> tuple[Array, Array, Array, Array]:
    """(t, q, dq, ddq) of a path that is at u at times t."""
    rate = np.gradient(u, t)
    rate[[0, -1]] = 0.0
    q, first, second = path.derivatives(u, 2)
    return t, q, first * rate[:, None], second * rate[:, None] ** 2 + first * np.gradient(rate, t)[:, None]


def paper(scenario: Scenario) -> tuple[float, Plan]:
    """Shortest duration at which the paper's condition can be planned, then lengthened until the arm can follow."""
    base = scenario.with_changes(contact__condition="paper", motion__goal_yaw="fixed")

    def planned(duration: float) -> Plan | None:
        plan = plan_object(base.with_changes(motion__duration=duration))
        return plan if plan.status.ok and plan.verification.ok else None

    low, high = 0.3, 6.0
    if planned(high) is None:
        raise SalverError(f"{scenario.name}: the paper's condition cannot be kept at any duration up to {high:g} s.")
    while high - low > 0.01:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if planned(middle) else (middle, high)
    for _ in range(12):
        plan = planned(high)
        if plan is not None:
            followed = with_arm(plan)
            if followed.arm_status is not None and followed.arm_status.ok:
                return high, followed
        high *= 1.05
    raise SalverError(f"{scenario.name}: the arm cannot follow the paper's plan.")


def optimum(scenario: Scenario, *, level: bool, robust: bool) -> tuple[float, Plan]:
    problem = transport_problem(scenario, level=level, robust=robust)
    found = fastest(problem)
    if not found.status.ok:
        raise SalverError(str(found.status))
    return found.duration, plan_of(scenario, problem, found.joint_motion())


# Runs ------------------------------------------------------------------------------------------------------------


def survival(place: Path, n: int, jobs: int, label: str) -> dict[str, int]:
    """Outcomes of the first n perturbed runs of the plan in a run directory. Those that it holds are not made again."""
    last = time.monotonic()

    def progress(done: int, total: int, _: Counter[tuple[str, str]]) -> None:
        nonlocal last
        if time.monotonic() - last > REPORT_EVERY:
            last = time.monotonic()
            print(f"{label} {done} of {total} runs", flush=True)

    made = run_campaign(place, n, method="corners", stems=["plan"], jobs=jobs, progress=progress)
    return {outcome: rate["count"] for outcome, rate in made.summary["plans"]["plan"]["outcomes"].items()}


def motion(place: Path, way: Callable[[], tuple[float, Plan]]) -> tuple[float, float]:
    """Duration of a way's motion and processor time to find it, s. The plan is in the run directory afterwards."""
    if (place / "plan.json").is_file():
        plan = load_plan(place)
    else:
        began = time.process_time()
        _, found = way()
        plan = replace(found, solver={**found.solver, "processor_time": time.process_time() - began})
        plan.save(place)
    return plan.duration, plan.solver["processor_time"]


def study(
    name: str, scenario: Scenario, runs_of: Callable[[str], int], jobs: int, known: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """All ways of one scenario; what is known so far after each."""
    nominal = transport_problem(scenario, level=True, robust=False)
    path = line_path(scenario)
    ways: dict[str, Callable[[], tuple[float, Plan]]] = {
        "line": lambda: fastest_line(scenario, nominal, path),
        "TOPP": lambda: topp(scenario, nominal, path),
        "paper": lambda: paper(scenario),
        "nominal": lambda: optimum(scenario, level=False, robust=False),
        "level": lambda: optimum(scenario, level=True, robust=True),
        "tilting": lambda: optimum(scenario, level=False, robust=True),
    }
    out = dict(known)
    for method, way in ways.items():
        label, n = f"{name:20s} {method:8s}", runs_of(method)
        if out.get(method, {}).get("runs", -1) >= n:
            continue
        place = WORK / scenario.name / method
        try:
            duration, seconds = motion(place, way)
            print(f"{label} {duration:.3f} s, found in {seconds:.2f} s", flush=True)
            outcomes = survival(place, n, jobs, label) if n else {}
        except SalverError as error:
            out[method] = {"failed": str(error)}
            print(f"{label} {error}", flush=True)
        else:
            out[method] = {"duration": duration, "seconds": seconds, "runs": n, "outcomes": outcomes}
            print(f"{label} {outcomes}", flush=True)
        yield out


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("-n", type=int, default=20, help="perturbed runs of each motion")
    options.add_argument("--all", action="store_true", help=f"as many of line and paper, too, not {FEW}")
    options.add_argument("--only", nargs="*", help="names of scenarios")
    options.add_argument("--again", action="store_true", help="forget the motions and runs that there are")
    options.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    chosen = options.parse_args()

    def runs_of(method: str) -> int:
        return min(chosen.n, FEW) if method in SLOW and not chosen.all else int(chosen.n)

    results: dict[str, Any] = read_json(DATA) if DATA.is_file() else {}
    wanted = {name: made for name, made in scenarios().items() if chosen.only is None or name in chosen.only}
    if chosen.again:
        for name, scenario in wanted.items():
            shutil.rmtree(WORK / scenario.name, ignore_errors=True)
            results.pop(name, None)
        write_json(DATA, results)
    for name, scenario in wanted.items():
        for found in study(name, scenario, runs_of, chosen.jobs, results.get(name, {})):
            results[name] = found
            write_json(DATA, results)


if __name__ == "__main__":
    main()
