"""What docs/liquids.md says in numbers, written into that page: one command, or its parts one by one (--only).

    python benchmarks/liquids.py [--only flow|cones|runs|places|survey|leaning] [-n 1000] [--beside 20] [--minutes 60]
        [--loads 60]

flow: how high a liquid rises, as predicted and as nonlinear potential flow shows it (potential_flow.py), on the
straight min-jerk line over 0.48 m, level, in a box of 80 mm by 60 mm, along its longer side and at 35 degrees to it,
in a cup of 80 mm and in a paper cup of panda-paper-cups, whose heights are those at the radius of its level. The flow
of a cup is unstable in steep waves (its points are few): where it ends, a dash.
cones: how much higher the crests of free waves are than linear waves, in cones.
runs: each ready-made scenario with a liquid in the physics engine, n random draws of all that is uncertain: its fastest
plan, with the processor time that it takes, the median of seven after a first; of the first draws the fastest plan of
somebody who takes the liquid for a solid, and the straight line in the same time. What was run is kept in
out/liquids.jsonl and not run again; scenarios take turns by what a run takes, so that the table can be written at any
time.
places: the fastest plans where cups may stand millimetres beside their places, with the processor time of one solve,
and runs at corners of all that is uncertain; kept and continued as those are.
survey: so many random loads, each with a cup or a box of liquid or several, on random arms between random ends: planned
as fast as they go, and run at corners of all that is uncertain. What is known of each is in docs/data/liquids.jsonl,
and of its runs beside it; loads that stand there are not planned again.
leaning: the same loads where surfaces may stand .5 R high at the wall, in docs/data/liquids-leaning.jsonl.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from salver.dynamics.liquid import sloshing
from salver.dynamics.liquid.interiors import Round
from salver.dynamics.liquid.liquid import STEEPEST
from salver.dynamics.liquid.surface import SurfaceMotion
from salver.dynamics.load_cases import LoadCase
from salver.errors import ScenarioError
from salver.models.tray_motion import at_rest
from salver.planning.fastest import plan_fastest
from salver.planning.fastest.planned import joint_plan
from salver.planning.fastest.search import fastest
from salver.planning.make import plan_baseline
from salver.planning.plan import Plan
from salver.planning.trajopt.problem import transport_problem
from salver.sampling import draw
from salver.scenario import Scenario, load, parse
from salver.simulation.physics import Experiment, simulate_tray
from salver.simulation.record import SimulationRecord

sys.path += [str(Path(__file__).parents[1] / folder) for folder in ("tests/helpers", "docs")]
from blocks import replace as written

from potential_flow import box, cone, cylinder, rectangle, simulate_cone
from potential_flow import simulate as flow
from survey import corners_of, ends_of, read, run_corners, survey

PAGE = Path(__file__).parents[1] / "docs" / "liquids.md"
SOLVES = 7
SCENARIOS, SEED = ("panda-coffee", "panda-four-glasses", "ur10-beaker"), 1
# Ranges of the place, mm, for which a scenario is planned.
PLACED = {**dict.fromkeys((*SCENARIOS, "panda-paper-cups"), (2.0, 5.0)), "panda-coffee, turned": (10.0,)}
KEPT, DRAWS = Path(__file__).parents[1] / "out" / "liquids.jsonl", 1000
SURVEY, SURVEY_SEED, CORNERS = PAGE.parent / "data" / "liquids.jsonl", 20261123, 4
LEANING, LEANS = PAGE.parent / "data" / "liquids-leaning.jsonl", 0.5  # over R
ARMS = {"panda": 0.8, "ur3": 0.48, "ur5": 0.82, "ur10": 1.2, "xarm7": 0.65, "gen3": 0.8}  # and their reach, m
PLACES = {1: [[0.0, 0.0]], 2: [[-0.055, 0.0], [0.055, 0.0]], 3: [[-0.05, -0.05], [0.05, -0.05], [0.0, 0.055]]}
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
        ("paper cup", load("panda-paper-cups"), None, 0.0),
    ):
        for fill in (0.035, 0.05, 0.065):
            inside = scenario.objects[0].inner.inside
            level = float(inside.half(fill)[0]) / inside.slope if inside.slope else np.inf  # over the apex
            for duration in (1.6, 1.4, 1.25, 1.1, 1.0):
                case, t = LoadCase(scenario.payload.first, fill, 0.005), np.linspace(0, duration, 201)
                w = np.tile(at_rest(), (len(t), 1))
                w[:, :2] = np.outer([push(duration, x) for x in t], [np.cos(angle), np.sin(angle)])
                waves, times = SurfaceMotion.along((case,), t, w), np.arange(0, duration + 0.5, 0.0015)
                with np.errstate(all="ignore"):
                    if basis is None:
                        conical = cone(np.arctan(inside.slope), level, 1 - fill / level)
                        seen = simulate_cone(conical, lambda x, T=duration: (push(T, x), 9.81), times, 0.005)
                        seen = np.array([inside.level_rise(fill, x) for x in seen])
                    else:
                        seen = flow(basis, fill, lambda x, T=duration: (push(T, x), 9.81), times, 0.005)
                during, after = seen[times <= duration].max(), seen[times > duration].max()
                cells = [waves.crest.max(), during, waves.left()[0], after]
                shown = [f"{1e3 * x:.1f}" if np.isfinite(x) and x < 0.05 else "–" for x in cells]
                ratio = f"{waves.crest.max() / during:.2f}" if shown[1] != "–" else "–"
                steep = f"{0.3 * waves.free_height.max() / waves.cases.steepest[0]:.2f}"
                yield f"| {name}, {1e3 * fill:.0f} mm | {duration} | {steep} | {' | '.join(shown)} | {ratio} |"


def cone_rows(R: float = 0.04, slopes: tuple[float, ...] = (0.01, 0.1, 0.25)) -> Iterator[str]:
    """kappa of free waves of 0.1 R and 0.2 R in cones: the highest crest of five periods, and what is assumed."""
    yield f"| depth / R | assumed | {' | '.join(f't = {slope:g}' for slope in slopes)} |"
    yield f"|---|---|{len(slopes) * '---|'}"
    for depth in (0.5, 1.0, 1.5):
        cells = [f"{Round(R).modes(depth * R, 998.0).peaking[0]:.2f}"]
        for slope in slopes:
            inside, h, level = Round(R - slope * depth * R, slope), depth * R, R / slope
            basis, omega = cone(np.arctan(slope), level, 1 - h / level), inside.modes(h, 998.0).omega[0, 0]
            first, times = np.zeros(len(basis.nu)), np.linspace(0, 10 * np.pi / omega, 2500)
            first[6] = R * 9.81 / omega  # of the first function with m = 1, which is nearly the mode
            with np.errstate(all="ignore"):
                small, *highest = (
                    simulate_cone(basis, lambda t: (0.0, 9.81), times, 0.005, a * first).max() for a in (1e-3, 0.1, 0.2)
                )
            found = []
            for share, high in zip((0.1, 0.2), highest, strict=True):
                a = 1e3 * share * small
                kappa = (inside.level_rise(h, high) / a - 1) * R / a
                found.append(f"{kappa:.2f}" if abs(high) < R else "–")
            cells.append(", ".join(found))
        yield f"| {depth} | {' | '.join(cells)} |"


def taken_for_solid(scenario: Scenario) -> Plan:
    """The fastest plan of somebody who does not know that a liquid moves."""
    problem = replace(transport_problem(scenario), cases=(), every_case=())
    found = fastest(problem)
    return joint_plan(scenario, problem, found.joint_motion(), found.status, {})


Run = Callable[[Mapping[str, float]], SimulationRecord]


@dataclass(frozen=True)
class Motion:
    """What is run of a scenario, how often it should be, and the CPU time, s, that its plan takes."""

    scenario: str
    said: str
    duration: float
    cpu: str
    wanted: int
    run: Run
    draws: list[dict[str, float]]

    @property
    def key(self) -> str:
        return f"{self.scenario}, {self.said}, {self.duration:.4f} s"


def motions(name: str, n: int, beside: int) -> Iterator[Motion]:
    """Those of a scenario."""
    scenario = load(name)
    spent = []
    for _ in range(1 + SOLVES):  # the first loads what it needs
        began = time.process_time()
        plan = plan_fastest(scenario)
        spent.append(time.process_time() - began)
    cpu = f"{np.median(spent[1:]):.2f}"
    solid = taken_for_solid(scenario)
    line = plan_baseline(scenario.with_changes(motion__duration=plan.duration)).reference
    uncertain = scenario.payload.uncertain
    values = draw(uncertain, max(n, DRAWS), seed=SEED, bodies=scenario.payload.bodies)
    draws = [dict(zip(uncertain.names, row.tolist(), strict=True)) for row in values]
    yield Motion(name, "planned with the liquid", plan.duration, cpu, n, Experiment(plan).run, draws)
    yield Motion(name, "liquid taken for a solid", solid.duration, "", beside, Experiment(solid).run, draws)
    yield Motion(
        name, "straight line, no arm", plan.duration, "", beside, lambda p: simulate_tray(line, scenario, p), draws
    )


def placed(named: str, mm: float) -> Scenario:
    """A scenario with its containers within a range of their places, mm; "turned": by 90 degrees about the vertical."""
    name, *turned = named.split(", ")
    scenario = load(name)
    changes: dict[str, Any] = {
        f"objects__{k}__uncertainty__position": 2 * [1e-3 * mm] for k in range(len(scenario.objects))
    }
    if turned:
        changes |= {"motion__goal_yaw": "fixed", "motion__goal__rpy_deg": [0.0, 0.0, 90.0]}
    return scenario.with_changes(motion__speeds="full", **changes)


def placed_motions(named: str, n: int) -> Iterator[Motion]:
    """Plans for each range, run at corners of it; the plan for exact places is run at those of the largest range."""
    ranges = PLACED[named]
    for mm, within in ((0.0, ranges[-1]), *zip(ranges, ranges, strict=True)):
        began = time.process_time()
        plan = plan_fastest(placed(named, mm))
        cpu, payload = f"{time.process_time() - began:.1f}", placed(named, within).payload
        values = draw(payload.uncertain, n, SEED, "corners", payload.bodies)
        draws = [dict(zip(payload.uncertain.names, row.tolist(), strict=True)) for row in values]
        said = f"{mm:g} mm | {within:g} mm"
        yield Motion(named, said, plan.duration, cpu, n, Experiment(plan).run, draws)


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


def run_rows(every: list[Motion], minutes: float, said: str = "motion") -> Iterator[str]:
    """A table of all runs that are kept, after as many more as there is time for. said: heads its column of that."""
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
    yield f"| scenario | s | CPU, s | {said} | holds | highest wave / room |"
    yield "|---|---|---|---|---|---|" + said.count("|") * "---|"
    for motion in every:
        results = list(known[motion.key].values())
        yield f"| `{motion.scenario}` | {motion.duration:.3f} | {motion.cpu} | {motion.said} | {counted(results)} |"


def container(rng: np.random.Generator, name: str, at: list[float], size: float) -> dict[str, Any]:
    """A cup or a box of liquid that stands at a place on the tray, of a size that leaves room for others."""
    wall, share = rng.uniform(0.002, 0.005), float(rng.choice([0.0, 0.1, 0.2, 0.3]))
    if rng.random() < 0.5:
        inside: dict[str, Any] = {"radius": size * rng.uniform(0.02, 0.05)}
        half = inside["radius"]
    else:
        longer = size * rng.uniform(0.04, 0.1)
        sides = longer, longer / rng.uniform(1.0, 2.2)
        inside, half = {"size": list(sides[:: int(rng.choice([-1, 1]))])}, longer / 2
    fill = half * rng.uniform(0.55, 1.8) / (1 - share)
    brim = fill * (1 + share) + rng.uniform(0.008, 0.03)
    shape: dict[str, Any] = {"type": "cylinder", "radius": half + wall, "height": brim + wall}
    if "size" in inside:
        shape = {"type": "box", "size": [*(x + 2 * wall for x in inside["size"]), brim + wall]}
    liquid = {"kind": str(rng.choice(["water", "coffee", "oil"])), "fill": fill, "brim": brim, **inside}
    kind = rng.random()
    if kind < 0.15:
        liquid["sealed"] = True
    elif kind < 0.3:
        liquid |= {"settled_wave": rng.uniform(0.003, 0.008), "settled_within": rng.uniform(0.0, 1.0)}
    elif kind < 0.4:
        liquid["highest_wave"] = rng.uniform(0.004, 0.01)
    known = [("mass", "10%", 0.7), ("friction", "10%", 0.7), ("com", [0.002, 0.002, 0.003], 0.5)]
    uncertainty = {key: half_range for key, half_range, often in known if rng.random() < often}
    return {
        "name": name,
        "at": at,
        "yaw_deg": float(rng.uniform(-45, 45)),
        "shape": shape,
        "mass": rng.uniform(0.08, 0.4),
        "friction": rng.uniform(0.25, 0.6),
        "support_inset": 0.002,
        "liquid": liquid,
        "uncertainty": uncertainty | {"fill": f"{100 * share:g}%"},
    }


def load_of(number: int) -> tuple[str, Scenario]:
    """The arm's name and the scenario of a number; what a scenario refuses is drawn again."""
    rng = np.random.default_rng([SURVEY_SEED, number])
    while True:
        arm = str(rng.choice(list(ARMS)))
        start, goal = (end.tolist() for end in ends_of(rng, ARMS[arm]))
        places = PLACES[int(rng.choice([1, 1, 1, 2, 3]))]
        size = 1.0 if len(places) == 1 else 0.7
        data = {
            "name": f"liquids-{number}",
            "motion": {
                "start": {"position": start},
                "goal": {"position": goal},
                "goal_yaw": "free" if rng.random() < 0.5 else "fixed",
            },
            "objects": [container(rng, f"cup{k}", at, size) for k, at in enumerate(places)],
            "contact": {"condition": "exact"},
            "tray": {"size": [0.25, 0.25], "height": 0.05, "mass": 0.3},
            "arm": {"model": arm},
        }
        try:
            return arm, parse(data, str(data["name"]))
        except ScenarioError:
            continue


def surveyed(loads: int, path: Path) -> tuple[dict[int, float], str, float]:
    """Of so many random loads, kept in a file: durations of those that are planned, s, what became of their runs, in
    words, and the CPU time of a plan at the median, s."""
    survey(range(loads), path, False, load_of)
    run_corners(path, CORNERS, load_of)
    records, ran = read(path), {line["number"]: line for line in read(corners_of(path))}
    planned = {x["number"]: x["default"]["duration"] for x in records if x["default"]["duration"] is not None}
    runs = [outcome for number in planned for outcome in ran[number]["outcomes"]]
    lost = [f"; load {n}: {ended(ran[n])}" for n in planned if ran[n]["held"] < ran[n]["runs"]]
    said = f"{runs.count('holds')} of {len(runs)} runs at corners hold{''.join(lost)}"
    return planned, said, float(np.median([record["default"]["cpu"] for record in records]))


def ended(line: dict[str, Any]) -> str:
    """How the runs of a load end that do not hold."""
    count = Counter(outcome for outcome in line["outcomes"] if outcome != "holds")
    said = ", ".join(f"{n} {how}" for how, n in count.items())
    if "limit" in count:
        peak, cut = line["limited"]["torque_share_peak"], line["limited"]["torque_cut"]
        said += f" (it stays; a motor is asked for {peak:.4g} of its torque, in {100 * cut:.2g} % of the periods)"
    return said


def survey_said(loads: int) -> str:
    """What became of that many random loads, in a sentence."""
    planned, runs, cpu = surveyed(loads, SURVEY)
    return (
        f"Of {loads} random loads with cups and boxes on {len(ARMS)} arms, planned as fast as they go, "
        f"{len(planned)} were planned, in {cpu:.1f} s of processor time at the median;\n{runs}."
    )


def leaning_said(loads: int) -> str:
    """The same where surfaces may stand higher, beside those."""
    known = {record["number"]: record["default"]["duration"] for record in read(SURVEY)}
    sloshing.LESS = STEEPEST / LEANS
    planned, runs, _ = surveyed(loads, LEANING)
    shares = [100 * (duration / known[number] - 1) for number, duration in planned.items() if known[number]]
    return (
        f"The first {loads} with surfaces up to {LEANS:g} R high at the wall: {len(planned)} planned, of durations "
        f"{np.mean(shares):+.2f} %\nat the mean ({min(shares):+.1f} to {max(shares):+.1f} %); {runs}."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=["flow", "cones", "runs", "places", "survey", "leaning"])
    parser.add_argument("-n", type=int, default=1000, help="runs of each plan")
    parser.add_argument("--beside", type=int, default=20, help="runs of each of the other motions")
    parser.add_argument("--minutes", type=float, default=1e6, help="write what there is after so many")
    parser.add_argument("--loads", type=int, default=60, help="of the survey")
    options = parser.parse_args()

    def runs() -> Iterator[str]:
        every = [motion for name in SCENARIOS for motion in motions(name, options.n, options.beside)]
        return run_rows(every, options.minutes)

    def places() -> Iterator[str]:
        every = [motion for named in PLACED for motion in placed_motions(named, options.n)]
        return run_rows(every, options.minutes, "planned for | run within")

    parts: dict[str, Callable[[], Iterable[str]]] = {
        "flow": flow_rows,
        "cones": cone_rows,
        "survey": lambda: [survey_said(options.loads)],
        "runs": runs,
        "places": places,
        "leaning": lambda: [leaning_said(options.loads)],
    }
    for part in (options.only,) if options.only else parts:
        written(PAGE, part, "\n".join(parts[part]()))


if __name__ == "__main__":
    main()
