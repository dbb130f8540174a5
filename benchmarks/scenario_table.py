"""The table of the ready-made scenarios in docs/scenarios.md, with what the physics engine says.

    python benchmarks/scenario_table.py [docs/scenarios.md]

For each scenario with a duration, on the straight min-jerk line with the tray held level: the shortest one at which
everything holds at nominal parameters, and over the whole uncertain set (exact contact condition, pyramids of 16
edges). Then the engine, with the tray moved exactly and without an arm: the motion of the robust duration with
nominal objects and with the worst ones of the set; and the motion 5 % shorter than the nominal limit.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from salver.contact_margins import Margins, margin_model, margins, tray_motion
from salver.files import read_json, write_atomic
from salver.planning.make import plan_object
from salver.scenario import Scenario, load, names
from salver.simulation.physics import simulate_tray
from salver.trajectory import MotionSamples, PolynomialReference, min_jerk_line

EDGES = 16
INSTANTS = 301
SHORTER = 0.95


def level_line(scenario: Scenario, duration: float) -> PolynomialReference:
    """From start to goal in the start's orientation."""
    start, goal = scenario.motion.start, scenario.motion.goal
    return min_jerk_line(duration, np.array(start.position), np.array(goal.position), start.rotation, start.rotation)


def margins_at(scenario: Scenario, samples: MotionSamples, duration: float) -> Margins:
    """Margins of a motion of one second, run in another duration."""
    s = samples
    rate = 1 / duration
    scaled = MotionSamples(
        s.t * duration, s.p_SB, s.v_S * rate, s.a_S * rate**2, s.R_SB, s.omega_B * rate, s.alpha_B * rate**2
    )
    return Margins(margin_model(scenario, EDGES), scaled.t, tray_motion(scenario, scaled))


def shortest(scenario: Scenario, worst: bool) -> float:
    """Shortest duration, s, by bisection to 0.2 %; infinite when not even a very slow motion holds."""
    samples = level_line(scenario, 1.0).sample(np.linspace(0, 1, INSTANTS))

    def holds(duration: float) -> bool:
        m = margins_at(scenario, samples, duration)
        return bool((m.exact_worst if worst else m.exact).min() >= 0)

    low, high = 0.05, 60.0
    if not holds(high):
        return float("inf")
    while high > 1.002 * low:
        middle = float(np.sqrt(low * high))
        low, high = (low, middle) if holds(middle) else (middle, high)
    return high


def row(name: str) -> str:
    scenario = load(name)
    nominal, robust = shortest(scenario, False), shortest(scenario, True)
    samples = level_line(scenario, 1.0).sample(np.linspace(0, 1, INSTANTS))
    faster = margins_at(scenario, samples, SHORTER * nominal).verdict()
    worst = margins_at(scenario, samples, robust).worst_parameters()

    def engine(duration: float, parameters: dict[str, float] | None = None) -> str:
        return str(simulate_tray(level_line(scenario, duration), scenario, parameters).summary["outcome"])

    length = np.linalg.norm(np.subtract(scenario.motion.goal.position, scenario.motion.start.position))
    objects = len(scenario.payload.bodies)
    verdicts = (engine(robust), engine(robust, worst), engine(SHORTER * nominal))
    plan = plan_object(scenario)
    found = margins(scenario, plan.reference.sample(np.linspace(0, plan.duration, INSTANTS)))
    carried = simulate_tray(plan.reference, scenario, found.worst_parameters()).summary["outcome"]
    planned = str(carried) if plan.ok else "no safe plan"
    first = f"{faster.code} ({faster.details['interface']})" if not faster.ok else "holds"
    cells = (
        f"`{name}`",
        str(objects),
        f"{length:.2f}",
        f"{nominal:.2f}",
        f"{robust:.2f}",
        *verdicts[:2],
        first,
        verdicts[2],
        f"{plan.duration:g}",
        planned,
    )
    return table(cells)


def table(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cells) + " |\n"


HEADER = """# Ready-made scenarios

`salver scenarios` lists them; each file cites its source. This table is made by `make scenario-table`.

Columns: number of objects; length of the straight line from start to goal; the shortest duration of a level min-jerk
motion along it at which everything holds, at nominal parameters and over the whole uncertain set (exact contact
condition). Then what the physics engine says with the tray moved exactly: at the robust duration with nominal
objects and with the worst objects of the set; and, 5 % faster than the nominal limit, what the margins and what the
engine say goes wrong. Last, the robust plan in the scenario's own duration, in the engine with the worst objects.

Where the two disagree, the margins are on the safe side, for three reasons: a scenario's `support_inset` takes a
strip off the base that the real object still stands on (all rows that "tip" for the margins and hold in the
engine have one); pyramids and polygons lie inside round cones and bases; and a motion that leaves the cone only
for an instant slips less than the engine counts (0.5 mm) or tips less than 2 degrees before it is caught again.

"""

COLUMNS = (
    "scenario",
    "objects",
    "length, m",
    "nominal, s",
    "robust, s",
    "engine at robust",
    "engine at robust, worst objects",
    "5 % faster: margins",
    "5 % faster: engine",
    "planned, s",
    "plan: engine, worst objects",
)


FREE = """
## Liquids

`panda-coffee`, `panda-four-glasses`, `panda-paper-cups` and `ur10-beaker` have no duration of their own: the shortest
safe one is planned. [Liquids](liquids.md) says how long they take, and what the physics engine says of them.

## Several legs

`waiters-round` is a task of [several legs](howto/legs.md): three glasses are taken off one by one. Its shortest safe
duration is planned too.
"""


def tall_boxes(path: Path) -> str:
    """The section on the grid of tall boxes, from what `benchmarks/tall_boxes.py` recorded."""
    if not path.is_file():
        return ""
    out = """
## Tall boxes of unknown mass distribution

For each height 135 runs in the engine (`python benchmarks/tall_boxes.py`): 15 centres of mass, at the middle, the
faces and the corners of the possible ones (6 cm to each side, the full height), three scales of inertia, three goals.
One plan per goal for the whole uncertain set, in the duration of the scenario; beside it the level min-jerk line at
the shortest duration that holds for the nominal box.

"""
    out += table(("height, cm", "planned for the set", "planned for the nominal box"))
    out += table(["---"] * 3)
    for height, found in read_json(path).items():
        told = (", ".join(f"{n} {outcome}" for outcome, n in sorted(counts.items())) for counts in found.values())
        out += table((height, *told))
    return out


def main() -> None:
    path = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/scenarios.md")
    rows = []
    for name in (n for n in names() if load(n).motion.duration is not None):
        began = time.perf_counter()
        rows.append(row(name))
        print(f"{rows[-1].strip()}  ({time.perf_counter() - began:.1f} s)", file=sys.stderr, flush=True)
    grid = tall_boxes(path.parent / "data" / "tall-boxes.json")
    write_atomic(path, HEADER + table(COLUMNS) + table("---" for _ in COLUMNS) + "".join(rows) + FREE + grid)


if __name__ == "__main__":
    main()
