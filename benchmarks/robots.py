"""Robots that are not their model: what they cost the tall bottle, counted in the engine.

python benchmarks/robots.py -n 1000 [--no-logs | --seeds 8 --seed 105] [--docs] [--only lag]

Each robot carries the nominal load strapped to its tray, and its tracking is judged; then it carries loose loads, the
32 corners of the ranges first: campaigns in runs/robots (--runs), which go on where they were stopped. Rows are kept in
docs/data/robots.json; `make pages` writes docs/howto/track.md from them. Another table has the excess found from noisy
logs against the true one.
"""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import salver as sv
from salver.campaigns import run_campaign
from salver.errors import FileFormatError
from salver.files import read_json, write_json
from salver.learning.tracking.track import Judge, track
from salver.models.arm.arm import load_arm
from salver.motion_files.samples import joint_samples
from salver.planning.plan import Plan, load_plan
from salver.simulation.physics import Experiment

DOCS = Path(__file__).parents[1] / "docs"
PAGE, KEPT = DOCS / "howto" / "track.md", DOCS / "data" / "robots.json"
LOGS = ((0.0, 1), (2e-5, 1), (1e-4, 1), (2e-5, 5), (1e-4, 5))  # rad of noise, and which samples are kept
SPREAD = (1.2, 0.8, 1.0, 1.1, 0.9, 1.2, 0.8)


def position(hertz: float, spread: bool = False, **more: float) -> dict[str, object]:
    bandwidth = [hertz * x for x in SPREAD] if spread else hertz
    return {"physics__robot": {"control": "position", "bandwidth": bandwidth, **more}}


RESTED = {"physics__settle_before": 1.0}  # the arm has sagged under its load before it moves
ROBOTS: dict[str, dict[str, object]] = {
    "2 ms of delay": {"physics__delay_steps": 2},
    "payload set 0.3 kg too heavy": {"physics__robot": {"payload_error": 0.3}, **RESTED},
    "friction 0.2 N m, not compensated": {"physics__joint_friction": 0.2, **RESTED},
    "friction 0.5 N m": {"physics__joint_friction": 0.5, **RESTED},
    "lag of 8 Hz in all joints": position(8.0),
    "lag of 15 Hz in all joints": position(15.0),
    "lag of 12 Hz +-20 % between joints": position(12.0, spread=True),
    "the same, damping 0.4": position(12.0, spread=True, damping=0.4),
    "as a UR10e by servoj: 7.7 Hz, 5 ms late": position(7.7, delay=0.005),
}


def held(folder: Path, n: int) -> int:
    """Of n loose loads, the corners of the ranges first, how many stay."""
    made = run_campaign(folder, n, 1, "corners", ["plan"], jobs=1)
    return int(made.summary["plans"]["plan"]["outcomes"]["holds"]["count"])


def robots(plan: Plan, n: int, only: str, runs: Path) -> None:
    """Judge each robot, and count; what was counted before is not done again."""
    for name, changes in ROBOTS.items():
        if only not in name:
            continue
        folder = runs / re.sub(r"[^a-z0-9]+", "-", name.lower())
        real = replace(plan, scenario=plan.scenario.with_changes(**changes))
        if not (folder / "plan.npz").exists():
            real.save(folder)
        row = {"robot": name, "n": n, "excess": excess(real), "kept": held(folder, n)}
        kept = {old["robot"]: old for old in (read_json(KEPT) if KEPT.exists() else [])} | {name: row}
        write_json(KEPT, [kept[robot] for robot in ROBOTS if robot in kept])
        print(of_robot(row), file=sys.stderr, flush=True)


def names_of(plan: Plan) -> tuple[str, ...]:
    assert plan.scenario.arm is not None
    return tuple(load_arm(plan.scenario.arm, plan.scenario.tray).joint_names)


def excess(real: Plan) -> float | None:
    """The excess of a robot's run; None if it is so far astray that it is not this plan's log."""
    try:
        done = Experiment(real).strapped()
        return track(real, joint_samples(done.t, names_of(real), done.q, None, None, "log")).excess
    except FileFormatError:
        return None


def of_robot(row: dict[str, Any]) -> str:
    taken = "" if row["excess"] is None else f"{100 * row['excess']:.1f} %"
    return f"| {row['robot']} | {taken} | {row['kept']} of {row['n']} |"


def pieces() -> dict[str, str]:
    """The table of docs/howto/track.md, and what it shows, from docs/data/robots.json."""
    rows = read_json(KEPT)
    most = [row for row in rows if row["kept"] >= 0.9 * row["n"]]
    lost = sum(row["n"] - row["kept"] for row in most)
    taken = 100 * max(row["excess"] or 0.0 for row in rows)
    findings = (
        f"- {len(most)} of {len(rows)} simulated robots lost {lost} loads in {sum(row['n'] for row in most)} runs; the "
        "others, with friction that nobody compensates, lost all.\n"
        f"- Tracking errors take up to {taken:.0f} % of the weight from the contact margin; an equal lag of all joints "
        "takes nothing."
    )
    return {
        "robots": "\n".join(["| robot | excess | kept |", "|---|---|---|", *map(of_robot, rows)]),
        "findings": findings,
    }


def logs(plan: Plan, seeds: int, seed: int, only: str) -> str:
    heads = [f"{noise:g} rad, {1000 // every} a second" for noise, every in LOGS]
    rows = [f"| robot | true | {' | '.join(heads)} |", f"|---|---|{'---|' * len(heads)}"]
    for name, changes in ROBOTS.items():
        if only not in name:
            continue
        real = replace(plan, scenario=plan.scenario.with_changes(**changes))
        judge = Judge.of(real.scenario)
        names, done = names_of(real), Experiment(real).strapped()
        t, q = done.t, done.q
        assert real.joint is not None
        if np.abs(q - real.joint.sample(t)[0]).max() > 0.2:
            continue  # the robot does not do the plan at all
        dq = np.gradient(q, t, axis=0)
        states, moving = (q, dq, np.gradient(dq, t, axis=0)), t > -0.2
        true = max(0.0, judge.largest(judge.along(t[moving], [x[moving] for x in states]))[0])
        cells = []
        for noise, every in LOGS:
            rng, found = np.random.default_rng(seed), []
            for _ in range(seeds if noise else 1):
                noisy = (q + noise * rng.standard_normal(q.shape))[::every]
                seen = track(real, joint_samples(t[::every], names, noisy, None, None, "log"), judge)
                found.append((100 * (seen.excess - true), 100 * seen.uncertainty))
            off, known = np.array(found).T
            cells.append(f"{off.min():+.1f} to {off.max():+.1f} (± {np.median(known):.1f})")
        rows.append(f"| {name} | {100 * true:.1f} | {' | '.join(cells)} |")
        print(rows[-1], file=sys.stderr, flush=True)
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-n", type=int, default=100, help="loose loads of each robot; 0: none is counted")
    parser.add_argument("--no-logs", action="store_true", help="leave the table of noisy logs out")
    parser.add_argument("--seeds", type=int, default=4, help="noisy logs of each robot")
    parser.add_argument("--seed", type=int, default=5, help="of their noise")
    parser.add_argument("--only", default="", help="robots whose name holds this")
    parser.add_argument("--runs", type=Path, default=Path("runs/robots"), help="where plans and campaigns are kept")
    parser.add_argument("--docs", action="store_true", help="write the table of noisy logs into docs/howto/track.md")
    chosen = parser.parse_args()
    plan = chosen.runs / "plan"
    if not plan.exists():
        sv.plan("panda-tall-bottle", "fastest").save(plan)
    made = load_plan(plan)
    if chosen.n:
        robots(made, chosen.n, chosen.only, chosen.runs)
    print(pieces()["robots"])
    if not chosen.no_logs:
        table = logs(made, chosen.seeds, chosen.seed, chosen.only)
        print(table)
        if chosen.docs:
            sys.path.insert(0, str(DOCS))
            import blocks

            blocks.replace(PAGE, "track", table)


if __name__ == "__main__":
    main()
