"""What it costs to hold at every speed, and whether it does: docs/speeds.md.

    python benchmarks/speeds.py [--only loads|survey|liquids] [-n 60] [--runs 20]

loads: the ten loads of benchmarks/fastest.py. survey: n random tasks of benchmarks/survey.py, half of them with
obstacles. liquids: the ready-made scenarios with liquids and n / 5 random ones. Each is planned for full speed only,
for every constant speed, and (the default) for speeds that change by 0.25 1/s too; loads also with a level tray. The
default plan is then run in the physics engine at corners of the uncertain set: at constant speed factors, at smooth
overrides that wander between 0 and 1, and paused and resumed once; the plan for full speed only is run at half speed.

Results are kept in docs/data/speeds.jsonl and not made again; `make pages` writes docs/speeds.md from them.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import fastest
import liquids
import survey
from salver.errors import SalverError
from salver.geometry import Array
from salver.planning.fastest import plan_fastest
from salver.planning.plan import Plan
from salver.scenario import Scenario, load
from salver.simulation.physics import Experiment
from salver.trajectory import JointMotion, MotionSamples, SampledReference

DATA = Path(__file__).parents[1] / "docs" / "data" / "speeds.jsonl"
RATE = 0.25  # 1/s: of overrides, the default of motion.speed_rate
STEP = 2e-3  # s between samples of a motion that is overridden
WAYS = {"full": {"motion__speeds": "full"}, "constant": {"motion__speed_rate": 0.0}, "any": {}}
SLOWEST = 0.05


def tasks(kind: str, count: int) -> Iterator[tuple[str, Scenario]]:
    """Names and scenarios of a kind."""
    if kind == "loads":
        for name, case in fastest.scenarios().items():
            yield name, case.with_changes(motion__duration=None)
    elif kind == "survey":
        for number in range(count):
            try:
                yield f"survey {number}", survey.task(number)[1]
            except SystemExit as error:  # an arm of a package that is not installed
                print(f"survey {number}: {error}", flush=True)
    else:
        for name in liquids.SCENARIOS:
            yield name, load(name)
        for number in range(count // 5):
            yield f"liquid {number}", liquids.load_of(number)[1]


def override(duration: float, rng: np.random.Generator, paused: bool) -> tuple[Array, Array, Array]:
    """t (T,), factor and place on the motion (T,), s: a smooth factor whose rate stays within `RATE`; paused: full
    speed, one pause at a random instant, full speed again."""
    knots = [1.0] if paused or rng.random() < 0.5 else [float(rng.uniform(SLOWEST, 1.0))]
    t, factor, u = [0.0], [knots[0]], [0.0]
    pause_at, target, begin = rng.uniform(0.0, 0.8) * duration, knots[0], knots[0]
    since, ramp, resting = 0.0, 1.0, 0.0
    while u[-1] < duration:
        now = t[-1] - since
        if now >= ramp:
            if paused:
                if target == 1.0 and u[-1] >= pause_at and resting == 0.0:
                    new = 0.0
                elif target == 0.0 and resting < 0.3:
                    resting, new = resting + ramp, 0.0
                else:
                    new = 1.0
            else:
                new = float(rng.uniform(SLOWEST, 1.0))
            begin, target, since = target, new, t[-1]
            # A smooth step is at most pi / 2 times as fast as its mean.
            ramp, now = max(0.1, 0.5 * np.pi * abs(new - begin) / RATE), 0.0
        t.append(t[-1] + STEP)
        factor.append(begin + (target - begin) * 0.5 * (1 - np.cos(np.pi * min(1.0, (now + STEP) / ramp))))
        u.append(u[-1] + 0.5 * STEP * (factor[-1] + factor[-2]))
    return np.array(t), np.array(factor), np.minimum(np.array(u), duration)


def overridden(plan: Plan, t: Array, s: Array, u: Array) -> Plan:
    """The plan run at factors s (T,) at t (T,), at which it is where it would be at u (T,) at full speed."""
    assert plan.joint is not None
    rate = np.gradient(s, t)
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


def corner(plan: Plan, rng: np.random.Generator) -> dict[str, float]:
    """A random corner of what is uncertain."""
    uncertain = plan.uncertain
    values = uncertain.nominal + uncertain.half_range * rng.choice([-1.0, 1.0], uncertain.size)
    return dict(zip(map(str, uncertain.names), values.tolist(), strict=True))


def runs(plan: Plan, count: int, rng: np.random.Generator) -> dict[str, list[str]]:
    """Outcomes in the engine."""
    found: dict[str, list[str]] = {"constant": [], "override": [], "pause": []}
    rigid = not plan.scenario.payload.dynamic  # of a liquid only constant speeds are promised
    for k in range(count):
        factor = float(SLOWEST ** (k / max(1, count - 1)))
        moved = plan.at_speed(factor) if factor < 1.0 else plan
        found["constant"].append(Experiment(moved).run(corner(plan, rng)).outcome)
        if rigid:
            for kind in ("override", "pause"):
                law = override(plan.duration, rng, kind == "pause")
                found[kind].append(Experiment(overridden(plan, *law)).run(corner(plan, rng)).outcome)
    return found


def record(kind: str, name: str, case: Scenario, count: int) -> dict[str, Any]:
    """Durations by every way, and what becomes of runs."""
    rng = np.random.default_rng([20261125, sum(name.encode())])
    line: dict[str, Any] = {"kind": kind, "name": name}
    plans: dict[str, Plan] = {}
    for way, changes in WAYS.items():
        try:
            plans[way] = plan_fastest(case.with_changes(**changes))
        except SalverError as error:
            line[f"{way} why"] = str(error)
            continue
        line[way] = plans[way].duration if plans[way].ok else None
        line[f"{way} speeds"] = [list(each) for each in plans[way].speeds.intervals]
    if kind == "loads":
        level = plan_fastest(case.with_changes(motion__orientation="fixed"))
        line["level"] = level.duration if level.ok else None
    if "any" in plans and plans["any"].ok:
        line["outcomes"] = {way: dict(Counter(each)) for way, each in runs(plans["any"], count, rng).items()}
    if "full" in plans and plans["full"].ok:
        half = Experiment(plans["full"].at_speed(0.5))
        tried = max(1, count // 4)
        line["full at half speed"] = dict(Counter(half.run(corner(plans["full"], rng)).outcome for _ in range(tried)))
    return line


def read() -> dict[tuple[str, str], dict[str, Any]]:
    lines = DATA.read_text(encoding="utf-8").splitlines() if DATA.exists() else []
    return {(line["kind"], line["name"]): line for line in map(json.loads, lines)}


def held(outcomes: dict[str, int]) -> str:
    return f"{outcomes.get('holds', 0)} of {sum(outcomes.values())}"


def table(kind: str, lines: list[dict[str, Any]]) -> Iterator[str]:
    """Durations and their price, and runs."""
    ways = ["level"] * (kind == "loads") + list(WAYS)
    yield f"| task | {' | '.join(ways)} | price | at constant speed | overridden | paused | full at half speed |"
    yield f"|---|{'---|' * (len(ways) + 5)}"
    for line in lines:
        every, full, outcomes = line.get("any"), line.get("full"), line.get("outcomes", {})
        cells = [line["name"], *(f"{line[way]:.3f} s" if line.get(way) else "none" for way in ways)]
        cells.append(f"{100 * (every / full - 1):.1f} %" if every and full else "")
        cells += [held(outcomes[way]) if outcomes.get(way) else "" for way in ("constant", "override", "pause")]
        cells.append(held(line["full at half speed"]) if line.get("full at half speed") else "")
        yield f"| {' | '.join(cells)} |"


def summary(lines: list[dict[str, Any]]) -> str:
    both = [line for line in lines if line.get("any") and line.get("full")]
    price = 100 * np.array([line["any"] / line["full"] - 1 for line in both])
    every, half = Counter[str](), Counter[str]()
    for line in lines:
        half.update(line.get("full at half speed", {}))
        for each in line.get("outcomes", {}).values():
            every.update(each)
    full, any_speed = (sum(bool(line.get(way)) for line in lines) for way in ("full", "any"))
    return (
        f"Of {len(lines)} tasks {full} are planned for full speed only and {any_speed} for every speed. The price in "
        f"duration is {price.mean():.1f} % at the mean, {np.median(price):.1f} % at the median and {price.max():.1f} % "
        f"at most. In the engine, at corners of the ranges, {held(every)} runs hold at other speeds; of plans for full "
        f"speed only, at half speed, {held(half)}."
    )


def pieces() -> dict[str, str]:
    """What docs/speeds.md says in numbers, from docs/data/speeds.jsonl."""
    known = read()
    kinds = {kind: [line for (of, _), line in known.items() if of == kind] for kind in ("loads", "survey", "liquids")}
    out = {kind: "\n".join([summary(lines), "", *table(kind, lines)]) for kind, lines in kinds.items()}
    loads = kinds["loads"]
    price, level = (
        100 * np.median([a / b - 1 for a, b in pairs])
        for pairs in ([(line["any"], line["full"]) for line in loads], [(line["any"], line["level"]) for line in loads])
    )
    every, half = Counter[str](), Counter[str]()
    for line in (line for lines in kinds.values() for line in lines):
        half.update(line.get("full at half speed", {}))
        for each in line.get("outcomes", {}).values():
            every.update(each)
    out["findings"] = (
        f"- A plan that holds at every speed takes {price:.1f} % longer than one for full speed alone (median of the\n"
        f"  ten loads).\n- In the physics engine {held(every)} runs of such plans hold at other speeds; of plans for\n"
        f"  full speed alone, run at half speed, {held(half)}.\n"
        f"- A tray that may tilt saves {-level:.0f} % of the time of a level one (median of the ten loads)."
    )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=["loads", "survey", "liquids"])
    parser.add_argument("-n", type=int, default=60, help="tasks of the survey; a fifth of it of random liquids")
    parser.add_argument("--runs", type=int, default=20, help="of each kind with each task")
    asked = parser.parse_args()
    known = read()
    for kind in asked.only:
        for name, case in tasks(kind, asked.n):
            if (kind, name) in known:
                continue
            line = record(kind, name, case, asked.runs)
            known[kind, name] = line
            with DATA.open("a", encoding="utf-8") as file:
                file.write(json.dumps(line) + "\n")
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
