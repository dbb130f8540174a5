"""What salver decides, frozen: before a part is replaced by a simpler one, and after.

    python tools/frozen.py            # record into out/frozen.json
    python tools/frozen.py --check    # compare with what is recorded there; ends with 1 when something got worse

Recorded are plans of every method and arm, tasks of the survey, stops, live ticks, audits, an identification and runs
in the physics engine, all with fixed seeds. What is only moved or renamed leaves every number as it is. Where an
algorithm is replaced, durations may grow by 1 % at the mean and 3 % at worst, and no outcome may be lost.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import salver as sv
from salver.errors import SalverError, Status
from salver.files import write_json
from salver.live import Live
from salver.planning.fastest import joint_plan, plan_fastest
from salver.planning.make import make_plan
from salver.planning.plan import Plan
from salver.planning.stop_library import StopLibrary
from salver.planning.stops import plan_stops, stop_problem, with_stops
from salver.sampling import draw
from salver.simulation.physics import Experiment

ROOT = Path(__file__).parents[1]
KEPT = ROOT / "out" / "frozen.json"
MEAN, WORST = 0.01, 0.03  # relative growth of a duration that is allowed
PLANS: list[tuple[str, str | None, dict[str, Any]]] = [
    ("panda-cube", "robust", {}),
    ("panda-cube", "safest", {"motion__duration": 1.0}),
    ("panda-cube", "least-sensitive", {"motion__duration": 1.0}),
    ("panda-cube", "fastest", {}),
    ("panda-cube", "fastest", {"motion__orientation": "fixed"}),
    ("panda-cube-3-parameters", "robust", {}),
    ("panda-cube-tilted-goal", "robust", {"contact__condition": "exact"}),
    ("panda-tall-bottle", None, {}),
    ("panda-tall-bottle", None, {"motion__speeds": "full"}),
    ("ur3-cup", "fastest", {}),
    ("ur5-bottle", None, {}),
    ("ur10-bottle", "fastest", {}),
    ("gen3-cup", "fastest", {}),
    ("upright-arch", "fastest", {}),
    ("upright-bottle", "fastest", {}),
    ("panda-coffee", None, {}),
    ("panda-coffee", "robust", {"motion__duration": 1.6, "motion__orientation": "fixed", "motion__goal_yaw": "fixed"}),
    ("ur10-beaker", None, {}),
]
SURVEY = range(24)
TICKS, PERIODS = 60, 20  # of planning, and of a millisecond between them


def of_plan(plan: Plan) -> dict[str, Any]:
    """What a plan claims."""
    return {
        "ok": plan.ok,
        "duration": plan.duration,
        "margin": plan.left,
        "slack": plan.verification.slack,
        "speeds": plan.speeds.every,
    }


def attempted(made: Callable[[], Plan]) -> dict[str, Any]:
    try:
        return of_plan(made())
    except SalverError as error:
        return {"ok": False, "refused": type(error).__name__}


def plans() -> Iterator[tuple[str, dict[str, Any]]]:
    for name, method, changes in PLANS:
        case = sv.load_scenario(name, **changes)
        yield f"{name} {method} {changes}", attempted(lambda case=case, method=method: make_plan(case, method))
    yield "waiters-round", (lambda legs: {"ok": legs.ok, "duration": legs.duration})(sv.plan_legs("waiters-round"))


def tasks() -> Iterator[tuple[str, dict[str, Any]]]:
    sys.path.insert(0, str(ROOT / "benchmarks"))
    import survey

    for number in SURVEY:
        yield f"task {number}", attempted(lambda number=number: plan_fastest(survey.task(number)[1]))


def stops() -> Iterator[tuple[str, dict[str, Any]]]:
    for name in ("panda-tall-bottle", "panda-cube"):
        found = with_stops(plan_fastest(sv.load_scenario(name))).stops
        assert found is not None
        yield name, of_stops(found)
    slow = make_plan(sv.load_scenario("panda-coffee", motion__duration=1.6), "safest")
    assert slow.joint is not None
    every = 0.1  # s, with a liquid doubled: all stops would take minutes
    yield "panda-coffee in 1.6 s", of_stops(plan_stops(stop_problem(slow), slow.joint, every, slow.space))


def of_stops(found: StopLibrary) -> dict[str, Any]:
    return {"duration": found.longest, "count": len(found.t), "all": float(found.duration.sum())}


def ticks() -> Iterator[tuple[str, dict[str, Any]]]:
    """Twists that turn around, and where they led."""
    for name in ("panda-cube", "panda-tall-bottle"):
        live, rng, begun, twist = (
            Live(sv.load_scenario(name), lead=0.06),
            np.random.default_rng(3),
            set[float](),
            np.zeros(6),
        )
        for k in range(TICKS * PERIODS):
            if k % (6 * PERIODS) == 0:
                twist = rng.uniform(-1, 1, 6) * [0.5, 0.5, 0.5, 0.3, 0.3, 0.3]
            if k % PERIODS == 0:
                live.twist(twist[:3], twist[3:])
            live.command(1e-3 * k)
            if k % PERIODS == 0:
                live.plan(60.0)
            begun.add(live.committed.begins)
        motion = live.committed.motion
        judged = joint_plan(live.problem.scenario, live.problem, motion, Status("recorded", "", True), {}, "live")
        assert judged.arm_status is not None
        yield name, {"ok": judged.arm_status.ok, "committed": len(begun), "end": motion.q[-1].tolist()}


def audits() -> Iterator[tuple[str, dict[str, Any]]]:
    plan = plan_fastest(sv.load_scenario("panda-tall-bottle"))
    assert plan.joint is not None
    for factor in (1.0, 0.9, 0.8):
        t = np.arange(0.0, plan.duration, 2e-3)
        columns = {"t": t * factor, **{f"q_panda_joint{j}": q for j, q in enumerate(plan.joint.sample(t)[0].T, 1)}}
        found = sv.audit(columns, "panda-tall-bottle").summary()
        yield f"{factor}", {key: found[key]["code"] for key in ("nominal", "worst_case")}


def runs() -> Iterator[tuple[str, dict[str, Any]]]:
    """Outcomes of the engine at corners of the uncertain set."""
    for name in ("panda-tall-bottle", "panda-coffee"):
        plan = plan_fastest(sv.load_scenario(name))
        payload, experiment = plan.scenario.payload, Experiment(plan)
        drawn = draw(payload.uncertain, 4, 0, "corners", payload.bodies)
        each = [dict(zip(payload.uncertain.names, map(float, row), strict=True)) for row in drawn]
        outcomes = [experiment.run(parameters).outcome for parameters in each]
        yield name, {"ok": set(outcomes) == {"holds"}, "outcomes": outcomes}


PARTS = {"plans": plans, "survey": tasks, "stops": stops, "live": ticks, "audits": audits, "engine": runs}


def worse(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """What got worse, a line each."""
    found, growth = [], []
    for key, was in before.items():
        now = after.get(key, {})
        if was.get("ok") and not now.get("ok"):
            found.append(f"{key}: was ok, is not: {now}")
        for code in ("nominal", "worst_case"):
            if code in was and was[code] != "holds" and now.get(code) == "holds":
                found.append(f"{key}: {code} was {was[code]}, now holds")
        if was.get("ok", True) and "duration" in was and now.get("duration"):
            growth.append(now["duration"] / was["duration"] - 1)
            if growth[-1] > WORST:
                found.append(f"{key}: {was['duration']:.4f} s became {now['duration']:.4f} s")
    if growth and np.mean(growth) > MEAN:
        found.append(f"durations grew by {100 * np.mean(growth):.2f} % at the mean")
    same = sum(after.get(key) == was for key, was in before.items())
    print(f"{same} of {len(before)} are the same to the last digit")
    if growth:
        print(f"durations: {100 * np.mean(growth):+.3f} % at the mean, {100 * np.max(growth):+.3f} % at most")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="compare with what is recorded")
    parser.add_argument("--only", nargs="*", default=list(PARTS), choices=list(PARTS), metavar="PART")
    asked = parser.parse_args()
    found: dict[str, Any] = {}
    for part in asked.only:
        begun = time.process_time()
        found |= {f"{part}: {name}": record for name, record in PARTS[part]()}
        print(f"{part}: {time.process_time() - begun:.1f} s of processor time", flush=True)
    if not asked.check:
        known = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}
        KEPT.parent.mkdir(exist_ok=True)
        write_json(KEPT, known | found)
        return
    known = json.loads(KEPT.read_text(encoding="utf-8"))
    problems = worse({key: was for key, was in known.items() if key in found}, found)
    print("\n".join(problems) or "nothing got worse")
    sys.exit(bool(problems))


if __name__ == "__main__":
    main()
