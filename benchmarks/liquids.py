"""What docs/liquids.md says in numbers, written into that page: one command, two tables.

    python benchmarks/liquids.py [--only flow|runs] [-n 1000] [--beside 20] [--minutes 60]

flow: how high a liquid rises, as predicted and as nonlinear potential flow shows it (tests/potential_flow.py), on the
straight min-jerk line over 0.48 m, level, in a box of 80 mm by 60 mm, along its longer side and at 35 degrees to it,
and in a cup of 80 mm. The flow of a cup is unstable in steep waves (its points are few): where it ends, a dash.
runs: each ready-made scenario with a liquid in the physics engine, n random draws of all that is uncertain: its fastest
plan; of the first of them the fastest plan of somebody who takes the liquid for a solid, and the straight line in the
same time. What was run is kept in out/liquids.jsonl and not run again; scenarios take turns by what a run takes, so
that the table can be written at any time.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from salver.models.tray_motion import at_rest
from salver.planning.fastest import plan_fastest
from salver.planning.fastest.planned import joint_plan
from salver.planning.fastest.problem import transport_problem
from salver.planning.fastest.search import fastest
from salver.planning.make import plan_baseline
from salver.planning.plan import Plan
from salver.sampling import draw
from salver.scenario import Scenario, load
from salver.sensitivity.wave_cases import Case
from salver.sensitivity.waves import along
from salver.simulation.physics import Experiment, simulate_tray
from salver.simulation.record import SimulationRecord

sys.path += [str(Path(__file__).parents[1] / folder) for folder in ("tests", "docs")]
from blocks import replace as written

from potential_flow import box, cylinder, rectangle
from potential_flow import simulate as flow

PAGE = Path(__file__).parents[1] / "docs" / "liquids.md"
SCENARIOS, SEED = ("panda-coffee", "panda-four-glasses", "ur10-beaker"), 1
KEPT, DRAWS = Path(__file__).parents[1] / "out" / "liquids.jsonl", 1000
BOX = {
    "objects__0__shape": {"type": "box", "size": [0.1, 0.07, 0.085]},
    "objects__0__liquid": {"kind": "water", "size": [0.08, 0.06], "fill": 0.05, "brim": 0.08},
}


def push(duration: float, t: float) -> float:
    x = min(max(t / duration, 0.0), 1.0)
    return 0.48 / duration**2 * (60 * x - 180 * x**2 + 120 * x**3)


def flow_rows() -> Iterator[str]:
    """One for each motion."""
    yield "| liquid | s | steepest a/R | predicted, mm | seen | after, bound | seen | predicted / seen |"
    yield "|---|---|---|---|---|---|---|---|"
    cup = load("panda-coffee")
    boxed, aside = cup.with_changes(**BOX), np.deg2rad(35)
    for name, scenario, basis, angle in (
        ("box", boxed, rectangle(0.08, 10), 0.0),
        ("box, aside", boxed, box((0.08, 0.06), aside), aside),
        ("cup", cup, cylinder(0.04), 0.0),
    ):
        for fill in (0.035, 0.05, 0.065):
            for duration in (1.6, 1.4, 1.25, 1.1, 1.0):
                case, t = Case(scenario.payload.first, fill, 0.005), np.linspace(0, duration, 201)
                w = np.tile(at_rest(), (len(t), 1))
                w[:, :2] = np.outer([push(duration, x) for x in t], [np.cos(angle), np.sin(angle)])
                waves, times = along((case,), t, w), np.arange(0, duration + 0.5, 0.0015)
                with np.errstate(all="ignore"):
                    seen = flow(basis, fill, lambda x, T=duration: (push(T, x), 9.81), times, 0.005)
                during, after = seen[times <= duration].max(), seen[times > duration].max()
                cells = [waves.crest.max(), during, waves.left()[0], after]
                shown = [f"{1e3 * x:.1f}" if np.isfinite(x) and x < 0.05 else "–" for x in cells]
                ratio = f"{waves.crest.max() / during:.2f}" if shown[1] != "–" else "–"
                steep = f"{0.3 * waves.free_height.max() / waves.cases.steepest[0]:.2f}"
                yield f"| {name}, {1e3 * fill:.0f} mm | {duration} | {steep} | {' | '.join(shown)} | {ratio} |"


def taken_for_solid(scenario: Scenario) -> Plan:
    """The fastest plan of somebody who does not know that a liquid moves."""
    problem = replace(transport_problem(scenario), liquids=())
    found = fastest(problem)
    return joint_plan(scenario, problem, found.joint_motion(), found.status, {})


Run = Callable[[Mapping[str, float]], SimulationRecord]


@dataclass(frozen=True)
class Motion:
    """What is run of a scenario, how often it should be, and the CPU time, s, that its plan took."""

    scenario: str
    said: str
    duration: float
    cpu: str
    wanted: int
    run: Run
    draws: list[dict[str, float]]

    @property
    def key(self) -> str:
        return f"{self.scenario}, {self.said}, {self.duration:.6f} s"


def motions(name: str, n: int, beside: int) -> Iterator[Motion]:
    """Those of a scenario."""
    scenario = load(name)
    began = time.process_time()
    plan = plan_fastest(scenario)
    spent = f"{time.process_time() - began:.1f}"
    solid = taken_for_solid(scenario)
    line = plan_baseline(scenario.with_changes(motion__duration=plan.duration)).reference
    uncertain = scenario.payload.uncertain
    values = draw(uncertain, max(n, DRAWS), seed=SEED, bodies=scenario.payload.bodies)
    draws = [dict(zip(uncertain.names, row.tolist(), strict=True)) for row in values]
    yield Motion(name, "planned with the liquid", plan.duration, spent, n, Experiment(plan).run, draws)
    yield Motion(name, "liquid taken for a solid", solid.duration, "", beside, Experiment(solid).run, draws)
    yield Motion(
        name, "straight line, no arm", plan.duration, "", beside, lambda p: simulate_tray(line, scenario, p), draws
    )


def outcome(record: SimulationRecord) -> list[str | float]:
    """What became of a run, and how high its waves came, as a share of the room."""
    return [record.outcome, max(x["peak_wave"] / x["room"] for x in record.summary["objects"] if x.get("room"))]


def counted(results: list[list[str | float]]) -> str:
    """How many runs hold, and what the others do; how high the waves came, of those that hold."""
    ended = Counter(str(how) for how, _ in results)
    highest = max((float(share) for how, share in results if how == "holds"), default=0.0)
    others = ", ".join(f"{count} {how}" for how, count in ended.most_common() if how != "holds")
    said = f"**{ended['holds']} of {len(results)}**" + (f" ({others})" if others else "")
    return f"{said} | {highest:.2f}" if highest else f"{said} | –"


def run_rows(n: int, beside: int, minutes: float) -> Iterator[str]:
    """A table of all runs that are kept, after as many more as there is time for."""
    every = [motion for name in SCENARIOS for motion in motions(name, n, beside)]
    known: dict[str, dict[int, list[str | float]]] = {motion.key: {} for motion in every}
    KEPT.parent.mkdir(exist_ok=True)
    for line in KEPT.read_text().splitlines() if KEPT.exists() else []:
        key, k, result = json.loads(line)
        known.setdefault(key, {})[k] = result
    spent, end = dict.fromkeys(known, 0.0), time.monotonic() + 60 * minutes
    with KEPT.open("a") as file:
        while time.monotonic() < end:
            open_ = [motion for motion in every if len(known[motion.key]) < motion.wanted]
            if not open_:
                break
            motion = min(open_, key=lambda motion: spent[motion.key])
            k = next(k for k in range(motion.wanted) if k not in known[motion.key])
            began = time.process_time()
            known[motion.key][k] = outcome(motion.run(motion.draws[k]))
            spent[motion.key] += time.process_time() - began
            file.write(json.dumps([motion.key, k, known[motion.key][k]]) + "\n")
            file.flush()
    yield "| scenario | s | CPU, s | motion | holds | highest wave / room |"
    yield "|---|---|---|---|---|---|"
    for motion in every:
        results = list(known[motion.key].values())
        yield f"| `{motion.scenario}` | {motion.duration:.3f} | {motion.cpu} | {motion.said} | {counted(results)} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=["flow", "runs"])
    parser.add_argument("-n", type=int, default=1000, help="runs of each plan")
    parser.add_argument("--beside", type=int, default=20, help="runs of each of the other motions")
    parser.add_argument("--minutes", type=float, default=1e6, help="write what there is after so many")
    options = parser.parse_args()
    if options.only != "runs":
        written(PAGE, "flow", "\n".join(flow_rows()))
    if options.only != "flow":
        written(PAGE, "runs", "\n".join(run_rows(options.n, options.beside, options.minutes)))


if __name__ == "__main__":
    main()
