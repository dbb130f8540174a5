"""Margins: how long they take, and what the exact condition gains over the paper's.

    python benchmarks/bench_margins.py

1. One box, 1000 instants: exact margin, worst case over many parameters, facets and rows from scratch.
2. The paper's endpoints on a level tray, straight min-jerk line: the shortest duration that each condition
   allows, nominal and with the paper's mass +-10 % (its closed-loop tube with the paper's condition, eq 16;
   the whole set with the exact one), and what the physics engine says of both.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from salver.contact_margins import Margins, margin_model, margins
from salver.models.shapes.hulls import cone_facets
from salver.planning.object.evaluation import evaluate
from salver.scenario import Scenario, load
from salver.simulation.physics import simulate_tray
from salver.trajectory import PolynomialReference, min_jerk_line

PAPER = load("panda-cube")
TWELVE = PAPER.with_changes(
    objects__0__uncertainty={
        "mass": "10%",
        "com": [0.002, 0.002, 0.002],
        "inertia": "10%",
        "friction": "10%",
        "position": [0.005, 0.005],
    },
    uncertainty={"tilt_deg": [1, 1]},
)


def line(scenario: Scenario, duration: float) -> PolynomialReference:
    start, goal = (np.array(p.position) for p in (scenario.motion.start, scenario.motion.goal))
    return min_jerk_line(duration, start, goal, np.eye(3), np.eye(3))


def timed(work: Callable[[], object], runs: int = 30) -> tuple[float, float]:
    """Least and median duration, ms."""
    work()
    out = []
    for _ in range(runs):
        began = time.perf_counter()
        work()
        out.append(1e3 * (time.perf_counter() - began))
    return min(out), float(np.median(out))


def timings() -> None:
    print("one box, 1000 instants: least / median, ms")
    samples = line(PAPER, 1.0).sample(np.linspace(0, 1, 1000))
    for edges in (4, 8, 16):
        margins(PAPER, samples, edges=edges).exact.min()
        least, median = timed(lambda edges=edges: margins(PAPER, samples, edges=edges).exact.min())  # type: ignore[misc]
        rows = len(margin_model(PAPER, edges).nominal[0].nominal)
        print(f"  exact margin, from samples, {edges:2d} edges ({rows} facets)   {least:7.2f} / {median:.2f}")
    names = margin_model(TWELVE, 4).uncertain.names
    for edges in (4, 8):
        margins(TWELVE, samples, edges=edges).exact_worst.min()
        work = lambda edges=edges: margins(TWELVE, samples, edges=edges).exact_worst.min()  # noqa: E731
        least, median = timed(work)
        print(f"  worst case, {len(names)} parameters, {edges} edges              {least:7.2f} / {median:.2f}")
    rays = margin_model(PAPER, 8).networks[0].interfaces[0].contacts.grasp_map.T
    print(
        "  facets of a cube, 8 edges, not cached              {:7.2f} / {:.2f}".format(
            *timed(lambda: cone_facets(rays))
        )
    )


def shortest(holds: Callable[[float], bool]) -> float:
    """By bisection to 1 ms."""
    low, high = 0.3, 6.0
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        if holds(middle):
            high = middle
        else:
            low = middle
    return high


def gain() -> None:
    print("shortest level min-jerk line on the paper's endpoints, s, and the engine at that duration")
    certain = PAPER.with_changes(objects__0__uncertainty="none")
    for label, scenario in (
        ("nominal", certain),
        ("mass +-10 %", PAPER),
        ("mass, com, inertia, friction, tilt", TWELVE),
    ):

        def paper(duration: float, scenario: Scenario = scenario) -> bool:
            asked = scenario.with_changes(contact__condition="paper")
            evaluation = evaluate(asked, line(asked, duration), 201)
            return bool((evaluation.cone_coefficients - evaluation.cone_radius).min() >= 0)

        def exact(duration: float, scenario: Scenario = scenario) -> bool:
            samples = line(scenario, duration).sample(np.linspace(0, duration, 201))
            # With the four edges of the paper's cones, as for its own condition.
            found: Margins = margins(scenario, samples, edges=4)
            return bool(found.exact_worst.min() >= 0)

        durations = shortest(paper), shortest(exact)
        seen = [simulate_tray(line(scenario, d), scenario).summary["outcome"] for d in durations]
        saved = 100 * (1 - durations[1] / durations[0])
        print(
            f"  {label:34s} paper {durations[0]:.3f} ({seen[0]})   exact {durations[1]:.3f} ({seen[1]})   "
            f"{saved:.0f} % shorter"
        )


if __name__ == "__main__":
    timings()
    gain()
