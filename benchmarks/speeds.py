"""What it costs to hold at every speed, and whether it does: docs/speeds.md.

    python benchmarks/speeds.py -o out/speeds.jsonl [--seconds 540] [--jobs 16]   plan, and run in the physics engine
    python benchmarks/speeds.py -o out/speeds.jsonl --summary     print what is known, by group and kind of run
    python benchmarks/speeds.py -o out/speeds.jsonl --docs        write it into docs/data, for `make pages`

loads: the ten loads of benchmarks/fastest.py. survey, liquids, rounds: random tasks of benchmarks/survey.py (a third
among obstacles), liquids.py and legs.py, with numbers that nothing was made with. Each is planned for every speed (the
default), for full speed only and for every constant speed; loads also with a level tray. shaken: loads and tasks of
the survey, planned for a tray that vibrates.

The default plan is run at random corners of the uncertain set: at 50 constant factors, at 50 random smooth overrides
whose rate reaches `RATE`, and paused and resumed at 20 random instants; the plan for full speed only is run at half
speed; the plan for a vibrating tray 20 times, on one. All legs of a round are run so, one after the other.

A line of JSON each: plans first, then runs, each tenth part of them of all tasks, longest first. What stands there is
not done again, so that a run that was cut goes on where it was; plans are kept beside it.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from multiprocessing import Pool
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

import fastest
import legs
import liquids
import survey
from lines import Line, read, taken, write
from salver.errors import SalverError
from salver.geometry import Array
from salver.planning.fastest import plan_fastest
from salver.planning.fastest.legs import plan_legs
from salver.planning.plan import Plan
from salver.planning.round import MultiLegPlan, load
from salver.scenario import Scenario, parse
from salver.simulation.physics import Experiment
from salver.simulation.round import RoundExperiment
from salver.trajectory import JointMotion, MotionSamples, SampledReference

DATA = Path(__file__).parents[1] / "docs" / "data" / "speeds.jsonl"
RATE = 0.25  # 1/s: of overrides, the default of motion.speed_rate
STEP = 2e-3  # s between samples of a motion that is overridden
SLOWEST = 0.02
REST = 0.3  # s that a pause takes at rest
WAYS: dict[str, dict[str, Any]] = {
    "any": {},
    "full": {"motion__speeds": "full"},
    "constant": {"motion__speed_rate": 0.0},
    "level": {"motion__orientation": "fixed"},
}
SHAKES = (
    {"amplitude": 2e-5, "frequency": 20},
    {"amplitude": 5e-5, "frequency": 15},
    {"tilt_deg": 0.05, "frequency": 12},
)
FIRST = 5000  # number of the first random task
FREE, AMONG, LIQUIDS, ROUNDS, SHAKEN = 42, 22, 16, 6, 42
ARMS = ("panda", "ur3", "ur5", "ur10", "xarm7")  # those that come with salver
KINDS = {"constant": 50, "override": 50, "pause": 20}  # and the runs of each
PARTS = 10  # of the runs of a task
GROUPS = ("loads", "survey", "liquids", "rounds", "shaken")


def numbers(seed: int, arms: list[str], first: int, step: int = 1) -> Iterator[int]:
    """Numbers from the first on of random tasks with an arm that comes with salver, which is their first draw."""
    for number in itertools.count(first, step):
        if arms[int(np.random.default_rng([seed, number]).integers(len(arms)))] in ARMS:
            yield number


def names() -> Iterator[tuple[str, str]]:
    """Groups and names of all tasks."""
    arms = [name for name, *_ in survey.ARMS]
    free, among = (itertools.islice(numbers(survey.SEED, arms, FIRST + k, 2), n) for k, n in enumerate((FREE, AMONG)))
    drawn = [f"survey {number}" for number in sorted((*free, *among))]
    yield from (("loads", name) for name in fastest.scenarios())
    yield from (("survey", name) for name in drawn)
    cups = itertools.islice(numbers(liquids.SURVEY_SEED, list(liquids.ARMS), FIRST), LIQUIDS)
    yield from (("liquids", f"liquid {number}") for number in cups)
    yield from (("rounds", f"round {number}") for number in range(ROUNDS))
    yield from (("shaken", name) for name in (*fastest.scenarios(), *drawn[:SHAKEN]))


def task(group: str, name: str) -> Scenario:
    """The scenario of a task."""
    if name in fastest.scenarios():
        case = fastest.scenarios()[name].with_changes(motion__duration=None)
    else:
        kind, number = name.split()
        makers: dict[str, Callable[[int], Scenario]] = {
            "survey": lambda k: survey.task(k)[1],
            "liquid": lambda k: liquids.load_of(k)[1],
            "round": lambda k: parse(legs.task(FIRST, k), name),
        }
        case = makers[kind](int(number))
    if group == "shaken":
        case = case.with_changes(uncertainty__shake=SHAKES[crc32(name.encode()) % len(SHAKES)])
    return case


def override(duration: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """t (T,) and factor (T,): a sum of sines that stays between `SLOWEST` and 1; its rate reaches `RATE`."""
    t = np.arange(0.0, duration / SLOWEST, STEP)
    frequency, phase = 2 * np.pi * rng.uniform(0.05, 2.0, 3), rng.uniform(0, 2 * np.pi, 3)
    rates = rng.uniform(0.1, 1.0, 3)
    rates *= RATE / np.abs(np.cos(np.outer(t, frequency) + phase) @ rates).max()
    swing = np.sin(np.outer(t, frequency) + phase) @ (rates / frequency)
    swing *= min(1.0, (1 - SLOWEST) / np.ptp(swing))
    return t, swing + rng.uniform(SLOWEST - swing.min(), 1 - swing.max())


def pause(duration: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """The same: a constant factor from which the motion comes to rest at a random place on it, then again towards 1."""
    place = rng.uniform(0.02, 0.98) * duration
    before = rng.uniform(0.5, 1.0) * min(1.0, 2 * np.sqrt(RATE * place / np.pi))
    # A cosine step of the factor by s takes pi s / 2 RATE, and the motion advances by s / 2 of that.
    brakes, rises = 0.5 * np.pi * before / RATE, 0.5 * np.pi / RATE
    begins = (place - 0.5 * before * brakes) / before
    t = np.arange(0.0, begins + brakes + REST + rises + duration, STEP)
    down, up = (
        np.clip(x, 0, np.pi) for x in ((t - begins) * np.pi / brakes, (t - begins - brakes - REST) * np.pi / rises)
    )
    return t, before * 0.5 * (1 + np.cos(down)) + 0.5 * (1 - np.cos(up))


def overridden(plan: Plan, t: Array, s: Array) -> Plan:
    """The plan run at factors s (T,) at t (T,), until it is at its end."""
    assert plan.joint is not None
    u = np.concatenate([[0.0], np.cumsum(0.5 * STEP * (s[1:] + s[:-1]))])
    count = int(np.searchsorted(u, plan.duration)) + 1
    rate = np.gradient(s, t)[:count]
    t, s, u = t[:count], s[:count].copy(), np.minimum(u[:count], plan.duration)
    s[-1] = rate[-1] = 0.0  # it ends at rest
    q, dq, ddq = plan.joint.sample(u)
    joint = JointMotion(t, q, dq * s[:, None], ddq * s[:, None] ** 2 + dq * rate[:, None])
    at = plan.reference.sample(u)
    samples = MotionSamples(
        t,
        at.p_SB,
        at.v_S * s[:, None],
        at.a_S * s[:, None] ** 2 + at.v_S * rate[:, None],
        at.R_SB,
        at.omega_B * s[:, None],
        at.alpha_B * s[:, None] ** 2 + at.omega_B * rate[:, None],
    )
    return replace(plan, reference=SampledReference(samples), joint=joint, tau=None, stops=None)


def run(plan: Plan | MultiLegPlan, task_name: str, kind: str, number: int) -> Line:
    """One run in the engine: its outcome, the largest slip, m, the duration, s, and the mean of the speed factor."""
    rng = np.random.default_rng([FIRST, crc32(f"{task_name} {kind}".encode()), number])
    uncertain = plan.scenario.uncertain
    values = uncertain.nominal + uncertain.half_range * rng.choice([-1.0, 1.0], uncertain.size)
    true = dict(zip(map(str, uncertain.names), values.tolist(), strict=True))

    def changed(leg: Plan) -> Plan:
        if kind in ("override", "pause"):
            return overridden(leg, *(pause if kind == "pause" else override)(leg.duration, rng))
        factor = {"constant": (number + 1) / KINDS["constant"], "half": 0.5}.get(kind, 1.0)
        return leg if factor == 1.0 else leg.at_speed(factor)

    moved: Plan | MultiLegPlan
    if isinstance(plan, MultiLegPlan):
        moved = replace(plan, legs=tuple(map(changed, plan.legs)))
        of_legs = RoundExperiment(moved).run(true, number)
        outcome, records = of_legs.outcome, of_legs.legs
    else:
        moved = changed(plan)
        record = Experiment(moved).run(true, number)
        outcome, records = record.outcome, (record,)
    slip = max(each.slip.max() for each in records)
    return {
        "outcome": outcome,
        "slip": float(slip),
        "duration": moved.duration,
        "factor": plan.duration / moved.duration,
    }


def folder(path: Path, group: str, name: str, way: str) -> Path:
    return path.parent / "plans" / group / name.replace(" ", "-").replace(",", "") / way


def plan_one(job: tuple[Path, float, str, str, str]) -> Line | None:
    """Plan a task in one way, and keep the plan if it is safe."""
    path, until, group, name, way = job
    if time.time() > until:
        return None
    began, line = time.process_time(), Line()
    try:
        case = task(group, name).with_changes(**WAYS[way])
        plan = plan_legs(case) if case.legs else plan_fastest(case)
        line = {"outcome": "planned" if plan.ok else "unsafe", "duration": plan.duration, "factor": 1.0}
        if plan.ok and way in ("any", "full"):  # those that are run
            plan.save(folder(path, group, name, way))
        if not plan.ok:
            line["says"] = plan.verdict
    except SalverError as error:
        line = {"outcome": "none", "says": str(error)}
    about = {"group": group, "task": name, "kind": "plan", "number": way}
    return write(path, about | line | {"cpu": time.process_time() - began})


loaded = lru_cache(maxsize=8)(load)


def run_some(job: tuple[Path, float, str, str, list[tuple[str, int]]]) -> int:
    """Run a plan some times; the number of runs."""
    path, until, group, name, wanted = job
    for done, (kind, number) in enumerate(wanted):
        if time.time() > until:
            return done
        try:
            line = run(loaded(folder(path, group, name, "full" if kind == "half" else "any")), name, kind, number)
        except SalverError as error:
            line = {"outcome": "error", "slip": 0.0, "duration": 0.0, "factor": 0.0, "says": str(error)}
        write(path, {"group": group, "task": name, "kind": kind, "number": number} | line)
    return len(wanted)


def benchmark(path: Path, seconds: float, jobs: int, only: list[str]) -> None:
    """Make the lines that are missing; jobs that are due are left out when the time is over."""
    path.parent.mkdir(parents=True, exist_ok=True)
    end = time.time() + seconds
    done = {(line["group"], line["task"], line["kind"], line["number"]) for line in read(path)}
    chosen = [(group, name) for group, name in names() if group in only]
    slow = {"liquids": 0, "rounds": 1, "survey": 2, "loads": 3, "shaken": 4}

    def ways(group: str) -> list[str]:
        return {"shaken": ["any"], "loads": list(WAYS)}.get(group, ["any", "full", "constant"])

    plans = [(path, end, *one, way) for one in chosen for way in ways(one[0]) if (*one, "plan", way) not in done]
    plans.sort(key=lambda job: (slow[job[2]], job[4] != "any"))
    with Pool(jobs) as pool:
        for line in taken(pool.imap_unordered(plan_one, plans), end - 0.6 * seconds):
            if line is not None:
                print(f"{line['task']}, {line['number']}: {line['outcome']}", flush=True)
        safe = {
            (line["group"], line["task"], line["number"]): line["duration"]
            for line in read(path)
            if line["outcome"] == "planned"
        }
        runs: list[tuple[int, float, Any]] = []
        for group, name in chosen:
            for part in range(PARTS):
                wanted = [(kind, k) for kind, count in KINDS.items() for k in range(part, count, PARTS)]
                if group == "shaken":
                    wanted = [("shaken", k) for k in range(part, KINDS["pause"], PARTS)]
                wanted = wanted if (group, name, "any") in safe else []
                wanted += [("half", part)] if part < 5 and (group, name, "full") in safe else []
                wanted = [one for one in wanted if (group, name, *one) not in done]
                if wanted:
                    takes = max(safe.get((group, name, way), 0.0) for way in WAYS) * len(wanted)
                    turn = part + PARTS * (group == "shaken")
                    runs.append((turn, -takes, (path, end, group, name, wanted)))
        runs.sort(key=lambda one: one[:2])
        count, told = 0, time.time()
        for some in taken(pool.imap_unordered(run_some, [job for *_, job in runs]), end + 15.0):
            count += some
            if time.time() > told + 10.0:
                told = time.time()
                print(f"{count} of {sum(len(job[4]) for *_, job in runs)} runs, {end - told:.0f} s left", flush=True)


def gathered(lines: list[Line]) -> list[Line]:
    """A record of each task, as docs/data keeps it: durations by every way, and outcomes by kind of run."""
    found: dict[tuple[str, str], Line] = {}
    for line in lines:
        kind, outcome = line["kind"], line["outcome"]
        into = found.setdefault((line["group"], line["task"]), {"kind": line["group"], "name": line["task"]})
        if kind == "plan":
            into[line["number"]] = line["duration"] if outcome == "planned" else None
        else:
            runs = into.setdefault("full at half speed", {}) if kind == "half" else into.setdefault("outcomes", {})
            of = runs if kind == "half" else runs.setdefault(kind, {})
            of[outcome] = of.get(outcome, 0) + 1
    return sorted(found.values(), key=lambda one: (GROUPS.index(one["kind"]), one["name"]))


def held(outcomes: dict[str, int]) -> str:
    return f"{outcomes.get('holds', 0)} of {sum(outcomes.values())}"


def table(kind: str, lines: list[Line]) -> Iterator[str]:
    """Durations and their price, and runs."""
    ways = ["level"] * (kind == "loads") + ["full", "constant", "any"]
    yield f"| task | {' | '.join(ways)} | price | at constant speed | overridden | paused | full at half speed |"
    yield f"|---|{'---|' * (len(ways) + 5)}"
    for line in lines:
        every, full, outcomes = line.get("any"), line.get("full"), line.get("outcomes", {})
        cells = [line["name"], *(f"{line[way]:.3f} s" if line.get(way) else "none" for way in ways)]
        cells.append(f"{100 * (every / full - 1):.1f} %" if every and full else "")
        cells += [held(outcomes[way]) if outcomes.get(way) else "" for way in ("constant", "override", "pause")]
        cells.append(held(line["full at half speed"]) if line.get("full at half speed") else "")
        yield f"| {' | '.join(cells)} |"


def costly(line: Line) -> bool:
    """Whether holding at every speed costs more than 2 % of the duration, or a plan is missing."""
    return not line.get("any") or not line.get("full") or line["any"] > 1.02 * line["full"]


def totals(lines: list[Line]) -> tuple[Counter[str], Counter[str]]:
    """Outcomes of all runs of plans for every speed, and of those for full speed only, at half speed."""
    every, half = Counter[str](), Counter[str]()
    for line in lines:
        half.update(line.get("full at half speed", {}))
        for each in line.get("outcomes", {}).values():
            every.update(each)
    return every, half


def summary(lines: list[Line]) -> str:
    both = [line for line in lines if line.get("any") and line.get("full")]
    price = 100 * np.array([line["any"] / line["full"] - 1 for line in both])
    every, half = totals(lines)
    full, any_speed = (sum(bool(line.get(way)) for line in lines) for way in ("full", "any"))
    costs = ""
    if both:
        costs = (
            f" The price in duration is {price.mean():.1f} % at the mean, {np.median(price):.1f} % at the median and "
            f"{price.max():.1f} % at most."
        )
    return (
        f"Of {len(lines)} tasks {full} are planned for full speed only and {any_speed} for every speed.{costs} In the "
        f"engine, at corners of the ranges, {held(every)} runs hold at other speeds; of plans for full speed only, at "
        f"half speed, {held(half)}."
    )


def told(lines: list[Line]) -> Iterator[str]:
    """The summary of every group; then its runs by kind, and each that did not hold."""
    records = gathered(lines)
    for group in GROUPS:
        of = [record for record in records if record["kind"] == group]
        if not of:
            continue
        yield f"\n{group}: {summary(of)}"
        for record in of:
            if not record.get("any"):
                says = [x.get("says") for x in lines if x["task"] == record["name"] and x["number"] == "any"]
                yield f"  not planned: {record['name']}: {says[:1]}"
        for kind in (*KINDS, "shaken", "half"):
            runs = [line for line in lines if line["group"] == group and line["kind"] == kind]
            if not runs:
                continue
            kept = [line for line in runs if line["outcome"] in ("holds", "limit")]
            slip = 1e3 * max((line["slip"] for line in kept), default=0.0)
            tasks = len({line["task"] for line in runs})
            counts = dict(Counter(line["outcome"] for line in runs))
            lost = len(runs) - len(kept)
            yield f"  {kind}: {len(runs)} runs of {tasks} tasks, {lost} lost {counts}; {slip:.3f} mm in the others"
            if kind != "half":
                for line in runs:
                    if line["outcome"] != "holds":
                        yield f"    {json.dumps(line)}"


def pieces() -> dict[str, str]:
    """What docs/speeds.md says in numbers, from docs/data/speeds.jsonl."""
    known = read(DATA)
    kinds = {kind: [line for line in known if line["kind"] == kind] for kind in GROUPS}
    shaken = kinds.pop("shaken")
    shown = kinds | {"survey": [line for line in kinds["survey"] if costly(line)]}
    out = {kind: "\n".join([summary(lines), "", *table(kind, shown[kind])]) for kind, lines in kinds.items() if lines}
    runs = sum((Counter(line["outcomes"]["shaken"]) for line in shaken if line.get("outcomes")), Counter[str]())
    out["shaken"] = (
        f"Plans for a tray that shakes were run in the engine on one that does: {held(runs)} runs of\n"
        f"{sum(bool(line.get('any')) for line in shaken)} plans hold, at corners of their ranges "
        "(`python benchmarks/speeds.py --only shaken`)."
    )
    loads = kinds["loads"]
    price, level = (
        100 * np.median([a / b - 1 for a, b in pairs])
        for pairs in ([(line["any"], line["full"]) for line in loads], [(line["any"], line["level"]) for line in loads])
    )
    every, half = totals([line for lines in kinds.values() for line in lines])
    out["findings"] = (
        f"- A plan that holds at every speed takes {price:.1f} % longer than one for full speed alone (median of the\n"
        f"  ten loads).\n- In the physics engine {held(every)} runs of such plans hold at other speeds; of plans for\n"
        f"  full speed alone, run at half speed, {held(half)}.\n"
        f"- A tray that may tilt saves {-level:.0f} % of the time of a level one (median of the ten loads)."
    )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", type=Path, default=Path("out/speeds.jsonl"), dest="path", help="lines, added to")
    parser.add_argument("--only", nargs="*", default=list(GROUPS), choices=GROUPS)
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--seconds", type=float, default=1e6, help="after which it stops")
    parser.add_argument("--summary", action="store_true", help="print what is known, and nothing else")
    parser.add_argument("--docs", action="store_true", help="write what is known into docs/data, and nothing else")
    asked = parser.parse_args()
    if asked.docs:
        DATA.write_text("".join(json.dumps(line) + "\n" for line in gathered(read(asked.path))), encoding="utf-8")
    elif not asked.summary:
        benchmark(asked.path, asked.seconds, asked.jobs, asked.only)
    if not asked.docs:
        print("\n".join(told(read(asked.path))))


if __name__ == "__main__":
    main()
