"""Counted runs of identification: how often ranges cover the truth, what is dropped.

python benchmarks/learning.py --logs 112    # 12 cases of 112 loads, and the same with the noise doubled
python benchmarks/learning.py --defects 50    # sensors that are wrong, within their bounds and beyond
python benchmarks/learning.py --shown 50    # how far these are from sound ones with another load

Logs are made by `salver.learning.load.sensors`, whose errors are not those that the estimator assumes. Loads are drawn
within mass +-50 % and centre of mass +-15 mm, for the tall bottle on a Panda. Each row of the tables is kept in
docs/data/learning.json; `make pages` writes docs/howto from it.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear
from scipy.stats import norm

import salver as sv
from salver.errors import SalverError
from salver.files import read_json, write_json
from salver.learning.load.estimate import _normal
from salver.learning.load.excite import plan_excite
from salver.learning.load.identify import LoggedRun, _felt, identify, identify_runs
from salver.learning.load.narrowing import prior
from salver.learning.load.systematic import SensorBounds
from salver.models.physical import random_inertia
from salver.models.uncertain.parameters import INERTIAL, inertial_vector, phi_of
from salver.planning.fastest import plan_fastest
from salver.planning.plan import Plan
from salver.scenario import Scenario, load

sys.path.append(str(Path(__file__).parents[1] / "tests" / "helpers"))
from sensed_arm import SensedArm, Sensors
from wrong_sensors import Defects, WrongArm

DOCS = Path(__file__).parents[1] / "docs"
KEPT = DOCS / "data" / "learning.json"
KINDS = {
    "wrist, half coloured": (True, Sensors(rate=1000.0)),
    "wrist, white": (True, Sensors(rate=1000.0, wrist_coloured=0.0)),
    "joint torques": (False, Sensors(rate=1000.0)),
}
WIDE = {"mass": "50%", "com": [0.015, 0.015, 0.015]}


def bottle(friction: str = "known", nominal: float = 0.4) -> Scenario:
    uncertain = WIDE | {"friction": "10%" if friction == "known" else 0.2}
    return load("panda-tall-bottle").with_changes(objects__0__uncertainty=uncertain, objects__0__friction=nominal)


def coverage(name: str, plans: Sequence[Plan], kind: str, times: float, count: int) -> dict[str, object]:
    """How many of the ten parameters of each load lie within their ranges, and how wide these are: g, mm, kg mm^2.

    Loads are random masses inside the shape, each carried once along each plan.
    """
    inside, learnt, half, spent, refused = np.zeros((2, 10), dtype=int), np.zeros(10, dtype=int), [], [], 0
    scale, scenario = np.array([1e3] * 4 + [1e6] * 6), plans[0].scenario
    wrist, sensors = KINDS[kind]
    for k in range(count):
        values, runs = filled(scenario, k), []
        for i, plan in enumerate(plans):
            arm = SensedArm(plan, k + count * i, replace(sensors, times=times), wrist=wrist, joints=not wrist)
            runs.append(LoggedRun(plan, arm.log(values), arm.log(None)))
        begun = time.process_time()
        try:
            ranges = identify_runs(scenario, runs).ranges
        except SalverError as error:
            refused += 1
            print(f"  log {k}: {error}", file=sys.stderr)
            continue
        spent.append(time.process_time() - begun)
        both = np.array([[r.likely, (r.low, r.high)] for r in (ranges[name] for name in INERTIAL)])
        inside += ((both[..., 0] <= values[:, None]) & (values[:, None] <= both[..., 1])).T
        learnt += [ranges[name].learnt for name in INERTIAL]
        half.append((0.5 * scale[:, None] * (both[..., 1] - both[..., 0])).T)
    found = {"inside": inside.tolist(), "half": np.median(half, axis=0).tolist(), "refused": refused}
    found |= {
        "learnt": learnt.tolist(),
        "logs": count - refused,
        "cpu_ms": 1e3 * float(np.median(spent)),
        "times": times,
    }
    print(f"{name} | {kind} | {found}", file=sys.stderr, flush=True)
    return {"motion": name, "sensor": kind} | found


TIMES = (1, 3, 10)
# Which bounds a sensor reaches or oversteps, and whether it is one in the wrist.
DEFECTS = {
    "bias after taring": (True, ("force_bias", "moment_bias")),
    "scale": (True, ("scale",)),
    "cross-talk": (True, ("cross_talk",)),
    "cable": (True, ("cable",)),
    "place": (True, ("position",)),
    "tilt": (True, ("tilt",)),
    "delay": (True, ("delay",)),
    "bias of torques": (False, ("torque_bias",)),
    "scale of torques": (False, ("torque_scale",)),
    "links": (False, ("links",)),
    "filter of torques": (False, ("filter_time",)),
    "delay of torques": (False, ("delay",)),
}


def wrong_sensors(plan: Plan, name: str, count: int) -> dict[str, object]:
    """Of so many loads, how many logs are refused and how many ranges hold all ten parameters, when a sensor is `TIMES`
    as wrong as its bounds say."""
    (wrist, kinds), bounds = DEFECTS[name], SensorBounds()
    size = ", ".join(f"{kind} = {getattr(bounds, kind):g}" for kind in kinds)
    found: dict[str, object] = {"defect": name, "loads": count, "size": size}
    for times in TIMES:
        sizes = {kind: times * getattr(bounds, kind) for kind in kinds}
        if "torque_scale" in sizes:
            sizes["scale"] = sizes.pop("torque_scale")
        if "filter_time" in sizes:
            sizes["bandwidth"] = 1 / (2 * np.pi * sizes.pop("filter_time"))
        refused = held = 0
        for k in range(count):
            values, defects = filled(plan.scenario, k), Defects(**sizes, seed=k)
            arm = WrongArm(plan, k, Sensors(rate=1000.0), wrist=wrist, joints=not wrist, defects=defects)
            try:
                ranges = identify(plan, [arm.log(values)], arm.log(None)).ranges
            except SalverError as error:
                refused += 1
                print(f"  {name}, {times} times its bound, load {k}: {error}", file=sys.stderr)
                continue
            held += all(ranges[key].low <= x <= ranges[key].high for key, x in zip(INERTIAL, values, strict=True))
        found |= {f"refused_{times}": refused, f"held_{times}": held}
    print(found, file=sys.stderr, flush=True)
    return found


def of_wrong_sensors(row: dict[str, Any]) -> str:
    counts = [(row[f"held_{times}"], row[f"refused_{times}"]) for times in TIMES]
    cells = [f"{held}, {refused}, {row['loads'] - held - refused}" for held, refused in counts]
    return f"| {row['defect']} | {row['size']} | {row['loads']} | {' | '.join(cells)} |"


# Kinds of errors that other loads resemble, and how many standard deviations of noise a test asks for that refuses one
# sound log in 30 000, as the program does.
RESEMBLED = {
    "scale": "scale",
    "place": "position",
    "tilt": "tilt",
    "scale of torques": "torque_scale",
    "links": "links",
}
ASKED = 4.0


def shown(plan: Plan, name: str, count: int) -> dict[str, object]:
    """How far a sensor ten times as wrong as its bounds is from the nearest explanation by a sound one: any load, and
    all errors within their bounds. In standard deviations d of the logs' noise; no test refuses more than Phi(d - 4) of
    such logs and so few sound ones (Neyman and Pearson)."""
    wrist, apart = DEFECTS[name][0], []
    for k in range(count):
        arm = SensedArm(plan, k, Sensors(rate=1000.0), wrist=wrist, joints=not wrist)
        values, known = filled(plan.scenario, k), prior(plan.scenario)
        readings = _felt(plan.scenario, [LoggedRun(plan, arm.log(values), arm.log(None))], known)
        here = {reading.sensor: 0.0 for each in readings for reading in each}
        errors, _, information, _ = _normal(readings, [1.0], known, phi_of(values), here, SensorBounds())
        size = np.concatenate([known[1], np.ones(len(errors))])
        value, axes = np.linalg.eigh(information * np.outer(size, size))
        root = (axes * np.sqrt(np.maximum(value, 0.0))).T
        wrong = np.zeros(len(size))
        signs = np.random.default_rng([17, k]).choice([-1.0, 1.0], len(errors))
        wrong[10:] = [10 * sign * (e.kind == RESEMBLED[name]) for e, sign in zip(errors, signs, strict=True)]
        most = np.concatenate([np.full(10, np.inf), np.ones(len(errors))])
        nearest = lsq_linear(root, root @ wrong, (-most, most), max_iter=1000, tol=1e-12)
        apart.append(float(np.sqrt(2 * nearest.cost)))
    found = {"defect": name, "loads": count, "apart": float(np.median(apart))}
    found["refusable"] = float(100 * norm.cdf(np.array(apart) - ASKED).mean())
    print(found, file=sys.stderr, flush=True)
    return found


def of_shown(row: dict[str, Any]) -> str:
    return f"| {row['defect']} | {row['loads']} | {row['apart']:.1f} | {row['refusable']:.0f} % |"


def filled(scenario: Scenario, seed: int) -> np.ndarray:
    """(10,) a random mass inside the shape, within the ranges."""
    body, rng = scenario.payload.first, np.random.default_rng([11, seed])
    values = inertial_vector(body.inertial)
    share = 1 + 0.5 * rng.uniform(-1, 1)
    values[0], values[1:4] = share * values[0], 0.015 * rng.uniform(-1, 1, 3)
    values[4:] = values[0] * random_inertia(body, values[1:4], rng)
    return values


def of_coverage(row: dict[str, Any]) -> str:
    cells = []
    for half, inside in zip(row["half"], row["inside"], strict=True):
        mass, com, inertia = half[0], half[1:4], np.array(half[4:])[[0, 2, 5]]
        shown = 2 * np.array(row["learnt"]) > row["logs"]
        where = ", ".join(f"{x:.2f}" for x in com) + " mm" if shown[1:4].all() else "-"
        turning = ", ".join(f"{x:.0f}" for x in inertia) + " kg mm^2" if shown[[4, 6, 9]].all() else "-"
        held = "/".join(map(str, inside[:4])) + f"; {min(inside[4:])} ({100 * min(inside) / row['logs']:.1f} %)"
        cells.append(f"{mass:.1f} g; {where}; {turning} | {held}")
    name = row["motion"] + (", noise doubled" if row["times"] == 2 else "")
    ends = f"{row['refused']} | {row['cpu_ms']:.0f} ms"
    return f"| {name} | {row['sensor']} | {row['logs']} | {' | '.join(cells)} | {ends} |"


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--logs", type=int, default=0)
    asked.add_argument("--defects", type=int, default=0)
    asked.add_argument("--shown", type=int, default=0)
    asked.add_argument("--times", type=float, nargs="+", default=[1.0, 2.0], help="the noise that is told")
    asked.add_argument("--only", default="", help="cases whose motion and sensor hold this, as in the table")
    given = asked.parse_args()
    if given.logs:
        motions = {
            "cube, 2.5 s": lambda: [sv.plan("panda-cube")],
            "bottle, fastest": lambda: [sv.plan("panda-tall-bottle", "fastest")],
            "bottle, excite, 2 s": lambda: [plan_excite(bottle(), 2.0)],
            "bottle, careful and excite, 4 s": lambda: [plan_fastest(bottle("open")), plan_excite(bottle("open"), 4.0)],
        }
        asked_for = {name: [kind for kind in KINDS if given.only in f"{name}, {kind}"] for name in motions}
        plans = {name: made() for name, made in motions.items() if asked_for[name]}
        for times in given.times:
            for name, made in plans.items():
                ranges = WIDE | {"contents": "any"}
                wide = [replace(p, scenario=p.scenario.with_changes(objects__0__uncertainty=ranges)) for p in made]
                for kind in asked_for[name]:
                    keep("identified", coverage(name, wide, kind, times, given.logs), ("motion", "sensor", "times"))
    if given.defects or given.shown:
        plan = sv.plan("panda-tall-bottle", "fastest")
        wide = replace(plan, scenario=plan.scenario.with_changes(objects__0__uncertainty=WIDE | {"contents": "any"}))
        for name in [name for name in DEFECTS if given.only in name]:
            if given.defects:
                keep("wrong sensors", wrong_sensors(wide, name, given.defects), ("defect",))
            if given.shown and name in RESEMBLED:
                keep("shown", shown(wide, name, given.shown), ("defect",))


def pieces() -> dict[str, str]:
    """The tables of docs/howto/identify.md, from docs/data/learning.json."""
    kept = read_json(KEPT)
    identified = sorted(kept["identified"], key=lambda row: row["times"])
    heads = {
        "identified": "motion | sensor | logs | 95 %: mass; x, y, z; xx, yy, zz | inside | to plan with | inside "
        "| refused | time",
        "wrong": "error | bound | loads | held, refused, missed: as large as the bound | 3 times | 10 times",
        "shown": "error, 10 times its bound | loads | standard deviations from a sound one, median | refused at best",
    }
    rows = {
        "identified": map(of_coverage, identified),
        "wrong": map(of_wrong_sensors, kept["wrong sensors"]),
        "shown": map(of_shown, kept["shown"]),
    }
    return {
        name: "\n".join([f"| {head} |", "|---" * (head.count("|") + 1) + "|", *rows[name]])
        for name, head in heads.items()
    }


def keep(table: str, row: dict[str, Any], keys: Sequence[str]) -> None:
    """Put a row in its table, for one with the same keys or behind all others."""
    kept = read_json(KEPT) if KEPT.exists() else {}
    rows = [old for old in kept.get(table, []) if [old.get(key) for key in keys] != [row[key] for key in keys]]
    write_json(KEPT, kept | {table: [*rows, row]})


if __name__ == "__main__":
    main()
