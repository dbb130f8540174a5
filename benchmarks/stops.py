"""Can it be stopped at any time? Five loads: stops along their fastest motion, taken at random instants in the engine.

    python benchmarks/stops.py [-n 50] [--cool 20] [--jobs 1] [--only cube ...] [--again]
    python benchmarks/stops.py --times [--only cube ...]    # stops anew along the same plans, and no runs

Each of n runs is stopped at an instant of its own, with the corners of the uncertain set first and then parameters
drawn from it: `salver campaign runs/stops/LOAD --stops --method corners`, which goes on where it was stopped. The first
runs (--cool) once more with the cool stop, which brakes the joints and knows nothing of the load. --again plans anew.
--times plans only the stops anew, also for an arm whose commands act at once, which shows what of a late stop is due to
the zero-order hold of commands.

Results are kept in docs/data/stops.json; `make pages` writes docs/stops.md from them.
"""

from __future__ import annotations

import argparse
import os
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fastest import scenarios as loads
from salver.campaigns import parameters_of_run, read_definition, run_campaign
from salver.campaigns.summary import DROPPED, LARGEST_SLIP
from salver.control.arm import ArmState
from salver.driver.stops import ControlledStop
from salver.files import read_json, write_json
from salver.models.arm.arm import ArmModel, load_arm, with_load
from salver.planning.fastest import FastestOptions, plan_fastest
from salver.planning.plan import Plan, load_plan
from salver.planning.stop_library import StopLibrary
from salver.planning.stops import plan_stops, stop_problem, with_stops
from salver.planning.trajopt.constraints.constraints import ContactConstraint
from salver.scenario import Scenario, load
from salver.simulation.physics import simulate

ROOT = Path(__file__).parent.parent
DATA = ROOT / "docs" / "data" / "stops.json"
WORK = ROOT / "runs" / "stops"
INSTANTS = 200  # at which stops are compared
AIM = 1.6  # times the cool stop's time: no stop should take more


def scenarios() -> dict[str, Scenario]:
    """The five loads."""
    known = loads()
    return {
        "cube": load("panda-cube"),
        "tall bottle": load("panda-tall-bottle"),
        "three bottles on a UR10": _three_bottles(),
        "stack of two": known["stack of two"],
        "cup off the middle": known["cup off the middle"],
    }


def _three_bottles() -> Scenario:
    """The bottle of `ur10-bottle` thrice, on a triangle."""
    base = load("ur10-bottle")
    bottle = base.objects[0].model_dump(mode="json", exclude_none=True)
    places = {"left": (0.05, 0.07), "right": (0.05, -0.07), "front": (-0.07, 0.0)}
    objects = [{**bottle, "name": name, "at": list(at)} for name, at in places.items()]
    shift = np.array(places["left"]) - np.array(bottle["at"])
    moved = {
        f"motion__{end}__position": (np.array(getattr(base.motion, end).position) + np.append(shift, 0.0)).tolist()
        for end in ("start", "goal")
    }
    return base.with_changes(name="three-bottles", objects=objects, motion__duration=None, **moved)


def planned(place: Path, scenario: Scenario, again: bool) -> tuple[Plan, dict[str, float]]:
    """The fastest plan with its stops, and the CPU time that each took, s; from the directory when it is there."""
    if again and place.is_dir():
        shutil.rmtree(place)
    if (place / "times.json").is_file():
        return load_plan(place), read_json(place / "times.json")
    begun = time.process_time()
    plan = plan_fastest(scenario.with_changes(motion__duration=None), options=FastestOptions(time_limit=300.0))
    found = time.process_time()
    plan = with_stops(plan)
    times = {"plan": found - begun, "stops": time.process_time() - found}
    plan.save(place)
    write_json(place / "times.json", times)
    return plan, times


def compared(plan: Plan) -> dict[str, float]:
    """How long stops take beside finishing and beside the cool stop, over instants all along the plan."""
    assert plan.stops is not None
    instants, takes, cool = ratios(plan, plan.stops)
    late = instants[takes > AIM * cool]
    return {
        "median": float(np.median(takes)),
        "longest": plan.stops.longest,
        "of_finishing": float(np.median(takes / (plan.duration - instants))),
        "of_cool": float(np.median(takes / cool)),
        "of_cool_most": float(np.max(takes / cool)),
        "late": len(late),
        "late_cool_slides": slides(plan, late),
        "late_until": float(late.max(initial=0.0)) / plan.duration,
    }


def ratios(plan: Plan, stops: StopLibrary) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Instants all along the plan, s; what stops take from there, and what the cool stop does."""
    instants = (np.arange(INSTANTS) + 0.5) / INSTANTS * plan.duration
    loaded = _loaded(plan)
    cool = np.array([_cool_stop(plan, loaded, now).braking for now in instants])
    return instants, np.array([stops.course(now).rests - now for now in instants]), cool


def slides(plan: Plan, instants: np.ndarray) -> int:
    """At how many instants the cool stop breaks contact in the worst case, of an arm that follows it exactly."""
    problem, loaded, s = replace(stop_problem(plan), tracking=None), _loaded(plan), np.linspace(0.0, 1.0, 101)
    count = 0
    for now in instants:
        stop = _cool_stop(plan, loaded, float(now))
        z = np.array([np.stack([*stop.reference(x * stop.braking), np.zeros(problem.n)]) for x in s]).swapaxes(0, 1)
        motion = problem.at(s, z, stop.braking, imposed=False)
        rows = [block for contact in problem.contacts for block in ContactConstraint(contact).blocks(motion)]
        count += max(float(block.values.max()) for block in rows) > 0.0
    return count


def at_once(plan: Plan) -> dict[str, float]:
    """How long stops would take of an arm whose commands are not held."""
    problem = stop_problem(plan)
    assert plan.joint is not None
    assert problem.tracking is not None
    problem = replace(problem, tracking=replace(problem.tracking, delay=0.0))
    _, takes, cool = ratios(plan, plan_stops(problem, plan.joint, space=plan.space))
    ratio = takes / cool
    return {"median": float(np.median(takes)), "of_cool_most": float(ratio.max()), "late": int((ratio > AIM).sum())}


def _loaded(plan: Plan) -> ArmModel:
    assert plan.scenario.arm is not None
    return with_load(load_arm(plan.scenario.arm, plan.scenario.tray), plan.scenario.payload.bodies)


def _cool_stop(plan: Plan, loaded: ArmModel, now: float) -> ControlledStop:
    assert plan.joint is not None
    q, dq, _ = (x[0] for x in plan.joint.sample(now))
    return ControlledStop(loaded, ArmState(q, dq))


def cooled(plan: Plan, now: float) -> Plan:
    """The plan with the cool stop from an instant as its only stop."""
    stop = _cool_stop(plan, _loaded(plan), now)
    s = np.linspace(0.0, 1.0, 61)
    q, dq, ddq = (np.array(x)[None] for x in zip(*(stop.reference(x * stop.braking) for x in s), strict=True))
    library = StopLibrary(np.array([now]), np.array([stop.braking]), s, q, dq, ddq, np.zeros((2, q.shape[2])), np.inf)
    return replace(plan, stops=library)


def cool(place: Path, plan: Plan, n: int) -> dict[str, int]:
    """The first n runs of the campaign with the cool stop: how many lost their load."""
    lost = 0
    for run in range(n):
        parameters, seed = parameters_of_run(place, run, "stops")
        now = read_definition(place, "stops").stop_at(run, plan.duration)
        assert now is not None
        record = simulate(cooled(plan, now), parameters=parameters, seed=seed, stop_at=now)
        slip = max(item["peak_slip"] for item in record.summary["objects"])
        lost += record.outcome in DROPPED or slip > LARGEST_SLIP
    return {"runs": n, "lost": lost}


def study(name: str, scenario: Scenario, n: int, few: int, jobs: int, again: bool) -> dict[str, Any]:
    place = WORK / name.replace(" ", "-")
    plan, times = planned(place, scenario, again)
    assert plan.stops is not None
    campaign = run_campaign(place, n, method="corners", stems=["plan"], jobs=jobs, stops=True)
    told = campaign.summary["plans"]["plan"]
    return {
        "duration": plan.duration,
        "instants": int((plan.duration - 0.01) / 0.02),
        "stops": len(plan.stops.t),
        "finishing": plan.stops.finishing,
        "seconds": times,
        **compared(plan),
        "outcomes": {outcome: rate["count"] for outcome, rate in told["outcomes"].items()},
        "runs": told["runs"],
        "lost": told["stops"]["lost"]["count"],
        "beyond_a_limit": told["stops"]["beyond_a_limit"]["count"],
        "slip": told["quantiles"]["peak_slip"]["max"],
        "cool": cool(place, plan, min(few, n)),
    }


def anew(place: Path, scenario: Scenario) -> tuple[Plan, dict[str, Any]]:
    """The plan with its stops planned anew, and how long they take."""
    plan, times = planned(place, scenario, False)
    begun = time.process_time()
    plan = with_stops(plan)
    times["stops"] = time.process_time() - begun
    assert plan.stops is not None
    plan.save(place)
    write_json(place / "times.json", times)
    found = {"stops": len(plan.stops.t), "finishing": plan.stops.finishing, "seconds": times, **compared(plan)}
    return plan, found


FINDINGS = """- Of {runs} runs that were stopped in the physics engine at random instants, {lost} lost the load.
- Of {others} of these runs that were repeated with a controlled stop, which brakes the joints without regard to the
  load, {dropped} lost it.
- The longest of all stops takes {longest:.2f} s."""
LATE = """Of {instants} instants of each plan, {late}
have a stop that takes more than {aim:g} times the controlled stop's time, all in the first {share:.0f} % of the plan.
There the tray leans into the first acceleration and the load is at its contact constraint; the controlled stop violates
it at {slides} of these. The main cause is the zero-order hold of commands: a jerk acts one period late. Without the
hold the longest stops take, of the controlled stop's time,
{once}."""


def pieces() -> dict[str, str]:
    """What docs/stops.md says in numbers, from docs/data/stops.json."""
    kept: dict[str, Any] = read_json(DATA)
    results = {name: kept[name] for name in scenarios() if name in kept}
    every = results.values()
    heads = "stopped runs | lost | kept, arm beyond a limit | largest slip, mm | lost by the controlled stop"
    rows = [f"| load | {heads} |", "|---" * 6 + "|"]
    heads = "plan, s | stops (CPU) | takes, s: median, longest | of finishing | of the controlled stop: median, most"
    times = [f"| load | {heads} |", "|---" * 6 + "|"]
    for name, r in results.items():
        cool = f"{r['cool']['lost']} of {r['cool']['runs']}" if r["cool"]["runs"] else "not run"
        rows.append(f"| {name} | {r['runs']} | {r['lost']} | {r['beyond_a_limit']} | {1e3 * r['slip']:.2f} | {cool} |")
        times.append(
            f"| {name} | {r['duration']:.2f} | {r['stops']} of {r['instants']} ({r['seconds']['stops']:.0f} s) "
            f"| {r['median']:.2f}, {r['longest']:.2f} | {r['of_finishing']:.2f} "
            f"| {r['of_cool']:.2f}, {r['of_cool_most']:.2f} |"
        )
    out = {"runs": "\n".join(rows), "times": "\n".join(times)}
    out["findings"] = FINDINGS.format(
        runs=sum(r["runs"] for r in every),
        lost=sum(r["lost"] for r in every),
        others=sum(r["cool"]["runs"] for r in every),
        dropped=sum(r["cool"]["lost"] for r in every),
        longest=max(r["longest"] for r in every),
    )
    out["late"] = LATE.format(
        aim=AIM,
        late=", ".join(f"{r['late']} ({name})" for name, r in results.items()),
        instants=INSTANTS,
        slides=", ".join(str(r["late_cool_slides"]) for r in every),
        share=100 * max(r["late_until"] for r in every),
        once=", ".join(f"{r['at_once']['of_cool_most']:.2f} ({name})" for name, r in results.items()),
    )
    return out


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("-n", type=int, default=50, help="stopped runs of each load")
    options.add_argument("--cool", type=int, default=20, help="how many of them with the cool stop too")
    options.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    options.add_argument("--only", nargs="+", help="these loads")
    options.add_argument("--again", action="store_true", help="plan anew")
    options.add_argument("--times", action="store_true", help="stops anew, and without held commands; no runs")
    chosen = options.parse_args()
    cases = scenarios()
    results = read_json(DATA) if DATA.is_file() else {}
    for name in chosen.only or cases:
        place = WORK / name.replace(" ", "-")
        if chosen.times:
            plan, found = anew(place, cases[name])
            results[name] |= {**found, "at_once": at_once(plan)}
        else:
            results[name] = study(name, cases[name], chosen.n, chosen.cool, chosen.jobs, chosen.again)
        write_json(DATA, results)
        print(name, results[name], flush=True)


if __name__ == "__main__":
    main()
