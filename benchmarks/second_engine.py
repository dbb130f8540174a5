"""The same loads on the same moving tray in a second physics engine, Drake: do both tell the same story?

    pip install drake
    python benchmarks/second_engine.py [-n 200] [--seed 1] [--docs]

Drake shares nothing with MuJoCo here but the feet on which an object stands. The tray really moves: a body of a million
kilograms, driven at every step to the velocity of the next instant (`salver.simulation.tray_frame` keeps it still and
moves the world instead). Contact is Drake's own: compliant points, Coulomb's cone kept exactly ("lagged"), 0.5 ms.
What an object did is measured in both with one ruler (`salver.simulation.outcome`).

Who is right is said by hand. Without turning, what the tray demands of an object is one number, how many times the
friction or the tipping moment that there is, at the instant that takes most: above 1 it must slide or tip. Within 3 %
of 1 nothing is counted: what gives way there gives way for a moment, and by less than what counts as sliding. What tips
above 1 rocks first, and is called lost from two degrees on: that edge lies higher, and each engine has its own. So the
same is asked of both with 3 % more and 3 % less: where a verdict turns, it is at an edge. Where the engines differ, the
edge of each is sought, and by hand: rigid, sliding by Coulomb, rocking on two edges of its base (Housner 1963).

Writes its numbers into docs/physics.md with --docs.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import AddContactMaterial, Convex, GeometrySet, ProximityProperties, Sphere
from pydrake.geometry import Box as DrakeBox
from pydrake.geometry import CollisionFilterDeclaration as Filter
from pydrake.geometry import Cylinder as DrakeCylinder
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialForce, SpatialVelocity
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    ExternallyAppliedSpatialForce,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import RotationalInertia, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from by_hand import GRAVITY, demand, kept_by_hand, rocking, slipping
from salver.models.bodies import TRAY
from salver.scenario import Scenario, load, names
from salver.simulation import creep
from salver.simulation.outcome import Thresholds, behaviour, inner_motions, judge
from salver.simulation.physics import simulate_tray
from salver.simulation.scene.elements import FOOT_RADIUS
from salver.simulation.scene.loads import Load, TrueWorld, true_world
from salver.simulation.scene.scene import build
from salver.simulation.trace import Trace
from salver.trajectory import Reference, min_jerk_line

STEP = 5e-4  # s
TRAY_MASS = 1e6  # kg, so that the objects do not move it
STIFFNESS = 2e5  # N/m a foot: a kilogram on four sinks 12 um
DISSIPATION = 5.0  # s/m, of Hunt and Crossley: feet settle without bouncing
STICTION = 1e-6  # m/s: what an object may creep while it sticks
ANY_FRICTION = 1e6  # Drake takes 2 a b / (a + b) of two surfaces: with this one, twice the other
EDGE = 0.03
ENGINES = ("MuJoCo", "Drake")
DOCS = Path(__file__).parent.parent / "docs"
sys.path.insert(0, str(DOCS))


def in_drake(reference: Reference, scenario: Scenario, parameters: dict[str, float] | None = None) -> dict[str, Any]:
    """Summary of a run as `simulate_tray` gives it: the tray moves as if the first object were glued on."""
    world = true_world(scenario, parameters)
    scene = build(scenario, world)
    physics = scenario.physics
    first = world.loads[0].nominal
    assert not np.any(world.tilt), "a tray out of level is not in this comparison"
    t = np.arange(-physics.settle_before, reference.duration + physics.settle_after, STEP)
    back = RigidTransform(RotationMatrix(first.R_EB), first.p_EB).inverse()
    of_B = reference.sample(t)
    tray = of_B.of_frame(back.translation(), back.rotation().matrix())
    omega_S = np.einsum("tij,tj->ti", tray.R_SB, tray.omega_B)
    plant, simulator, bodies = _plant(world, scenario.tray.size)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    start = RigidTransform(RotationMatrix(tray.R_SB[0]), tray.p_SB[0])
    plant.SetFreeBodyPose(context, bodies[0], start)
    for body, item in zip(bodies[1:], world.loads, strict=True):
        at = RigidTransform(RotationMatrix(item.R_EB), item.p_EB)
        plant.SetFreeBodyPose(context, body, start.multiply(at))
    drive = ExternallyAppliedSpatialForce()
    drive.body_index = bodies[0].index()
    port = plant.get_applied_spatial_force_input_port()
    poses = np.empty((len(t), len(bodies), 3, 4))
    for k, now in enumerate(t):
        for j, body in enumerate(bodies):
            poses[k, j] = plant.EvalBodyPoseInWorld(context, body).GetAsMatrix34()
        if k + 1 == len(t):
            break
        seen: SpatialVelocity = plant.EvalBodySpatialVelocityInWorld(context, bodies[0])
        turn = (
            TRAY_MASS * (omega_S[k + 1] - seen.rotational()) / STEP
        )  # its inertia is that of a ball, TRAY_MASS kg m^2
        push = TRAY_MASS * (tray.v_S[k + 1] - seen.translational()) / STEP
        drive.F_Bq_W = SpatialForce(turn, push)
        port.FixValue(context, [drive])
        simulator.AdvanceTo(now - t[0] + STEP)
    R, p = poses[..., :3], poses[..., 3]
    m, none = len(world.loads), np.zeros((len(t), 0))
    touches = np.ones((len(t), m), bool)
    trace = Trace(
        t, none, none, none, p[:, 0], R[:, 0], p[:, 1:], R[:, 1:], np.zeros((len(t), 0, 3)), np.zeros((len(t), m, 3)),
        touches, np.zeros(len(t), bool),
    )  # fmt: skip
    moved = behaviour(scene, trace, creep.still_bias(len(t)), scenario.tray.size)
    return judge(t, moved, touches, Thresholds(), world.loads, inner_motions(scene, trace))


def _plant(world: TrueWorld, tray_size: tuple[float, float]) -> tuple[Any, Any, list[Any]]:
    """Drake's plant: the tray, then the objects; feet touch what they stand on, and nothing else touches."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=STEP, contact_model="point", discrete_contact_approximation="lagged", stiction_tolerance=STICTION
    )
    plant, graph = AddMultibodyPlant(config, builder)
    ball = SpatialInertia(TRAY_MASS, np.zeros(3), _unit(RotationalInertia(*[TRAY_MASS] * 3), TRAY_MASS))
    instance = plant.AddModelInstance("tray")
    bodies = [plant.AddRigidBody(TRAY, instance, ball)]
    plant.set_gravity_enabled(instance, False)
    loads = plant.AddModelInstance("loads")
    top = DrakeBox(*tray_size, 0.1)
    surfaces = {TRAY: plant.RegisterCollisionGeometry(
        bodies[0], RigidTransform([0, 0, -0.05]), top, TRAY, _material(ANY_FRICTION)
    )}  # fmt: skip
    feet: list[tuple[Any, str]] = []
    for item in world.loads:
        own = item.inertial
        about_B = own.inertia_com + own.mass * (own.com_B @ own.com_B * np.eye(3) - np.outer(own.com_B, own.com_B))
        i = RotationalInertia(*np.diag(about_B), about_B[0, 1], about_B[0, 2], about_B[1, 2])
        body = plant.AddRigidBody(item.name, loads, SpatialInertia(own.mass, own.com_B, _unit(i, own.mass)))
        bodies.append(body)
        surfaces[item.name] = plant.RegisterCollisionGeometry(
            body, RigidTransform(-item.com_G), _hull(item), item.name, _material(ANY_FRICTION)
        )
        for support, points in item.supports.items():
            for number, point in enumerate(points):
                at = RigidTransform(point + np.array([0, 0, FOOT_RADIUS]))
                name = f"{item.name}:{support}:{number}"
                foot = plant.RegisterCollisionGeometry(
                    body, at, Sphere(FOOT_RADIUS), name, _material(item.friction / 2)
                )
                feet.append((foot, support))
    everything = [*surfaces.values(), *(foot for foot, _ in feet)]
    rules = graph.collision_filter_manager()
    plant.Finalize()
    rules.Apply(Filter().ExcludeWithin(GeometrySet(everything)))
    for foot, support in feet:
        rules.Apply(Filter().AllowBetween(GeometrySet([foot]), GeometrySet([surfaces[support]])))
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    return plant, simulator, bodies


def _unit(inertia: Any, mass: float) -> Any:
    unit = UnitInertia()
    unit.SetFromRotationalInertia(inertia, mass)
    return unit


def _hull(item: Load) -> Any:
    """What carries the feet of another."""
    kind = item.shape.type  # type: ignore[attr-defined]
    if kind == "box":
        return DrakeBox(*(2 * item.solid.base_polygon.max(axis=0)), item.solid.height)
    if kind == "cylinder":
        return DrakeCylinder(item.shape.radius, item.solid.height)  # type: ignore[attr-defined]
    return Convex(points=item.solid.bounding_points_G.T, label=item.name)


def _material(friction: float) -> Any:
    properties = ProximityProperties()
    AddContactMaterial(
        dissipation=DISSIPATION, point_stiffness=2 * STIFFNESS, friction=CoulombFriction(friction, friction),
        properties=properties,
    )  # fmt: skip
    return properties


@dataclass(frozen=True)
class Case:
    """Loads on a tray that moves along a straight line. demand: by hand, of one object on a level tray; else None."""

    name: str
    scenario: Scenario
    reference: Reference
    demand: float | None = None

    def in_both(self) -> tuple[str, str]:
        mujoco = simulate_tray(self.reference, self.scenario).summary["outcome"]
        return mujoco, in_drake(self.reference, self.scenario)["outcome"]

    def asking(self, share: float) -> Case:
        """The same way in the time in which it asks for a share of the acceleration. Of straight lines."""
        duration = self.reference.duration / np.sqrt(share)
        p = self.reference.sample(np.array([0.0, self.reference.duration])).p_SB
        return replace(self, reference=min_jerk_line(duration, p[0], p[1], np.eye(3), np.eye(3)))

    def at_an_edge(self, here: tuple[str, str]) -> list[str]:
        """Which engines, that say this, say otherwise when 3 % more or less is asked for."""
        around = [self.asking(share).in_both() for share in (1 - EDGE, 1 + EDGE)]
        turns = [any((other[k] == "holds") != (here[k] == "holds") for other in around) for k in (0, 1)]
        return [name for name, turned in zip(ENGINES, turns, strict=True) if turned]

    def turns_at(self, keeps: Callable[[Case], bool]) -> float:
        """What the tray asks for, as a share of what there is, where it is no longer kept: to a half per cent."""
        assert self.demand is not None
        low, high = 1.0, 1.4
        while high - low > 5e-3:
            middle = 0.5 * (low + high)
            low, high = (middle, high) if keeps(self.asking(middle / self.demand)) else (low, middle)
        return 0.5 * (low + high)

    def edges(self) -> str:
        """Where each engine's verdict turns, and by hand that of what leaves its base."""
        (own,) = true_world(self.scenario).loads
        mujoco = self.turns_at(lambda case: simulate_tray(case.reference, case.scenario).summary["outcome"] == "holds")
        drake = self.turns_at(lambda case: in_drake(case.reference, case.scenario)["outcome"] == "holds")
        by_hand = self.turns_at(lambda case: kept_by_hand(own, case.reference))
        return f"it is lost from {mujoco:.2f} on in MuJoCo, {drake:.2f} in Drake, {by_hand:.2f} by hand"


def pack() -> Iterator[Case]:
    """Every ready scenario of one leg without a liquid, in its own duration (or a second), in .8 and .6 of it."""
    for name in names():
        scenario = load(name)
        if scenario.legs or any(item.liquid for item in scenario.objects):
            continue
        ends = scenario.motion.start, scenario.motion.goal
        (p_start, R_start), (p_goal, R_goal) = ((np.array(end.position), end.rotation) for end in ends)
        for part in (1.0, 0.8, 0.6):
            line = min_jerk_line(part * (scenario.motion.duration or 1.0), p_start, p_goal, R_start, R_goal)
            yield Case(f"{name} in {part:g} of its time", scenario.with_changes(arm=None), line)


def random_cases(count: int, seed: int) -> Iterator[Case]:
    rng = np.random.default_rng(seed)
    paper = load("panda-cube")
    quick = {"physics__settle_before": 0.2, "physics__settle_after": 0.1, "arm": None}
    for k in range(count):
        wide, deep, high = rng.uniform(0.03, 0.1), rng.uniform(0.03, 0.1), rng.uniform(0.03, 0.25)
        if rng.random() < 0.5:
            shape: dict[str, Any] = {"type": "box", "size": [wide, deep, high]}
        else:
            shape = {"type": "cylinder", "radius": wide / 2, "height": high}
        item = {
            "name": "load", "shape": shape, "mass": rng.uniform(0.05, 2.0),
            "at": rng.uniform(-0.03, 0.03, 2).tolist(), "yaw_deg": rng.uniform(-180, 180),
            "friction": rng.uniform(0.1, 0.7),
        }  # fmt: skip
        scenario = paper.with_changes(objects=[item], tray__size=[0.4, 0.4], **quick)
        turn, climb = rng.uniform(-np.pi, np.pi), rng.uniform(-0.5, 0.5)
        way = 0.5 * np.array([np.cos(turn) * np.cos(climb), np.sin(turn) * np.cos(climb), np.sin(climb)])
        wanted = rng.uniform(0.6, 1.5)
        (own,) = true_world(scenario).loads
        long, short = 20.0, 0.15
        while long - short > 1e-4:
            middle = 0.5 * (long + short)
            line = min_jerk_line(middle, np.zeros(3), way, np.eye(3), np.eye(3))
            gravity_kept = 10 / np.sqrt(3) * abs(way[2]) / middle**2 < 0.9 * GRAVITY
            if gravity_kept and demand(own, line) < wanted:
                long = middle
            else:
                short = middle
        line = min_jerk_line(long, np.zeros(3), way, np.eye(3), np.eye(3))
        yield Case(f"random {k}", scenario, line, demand(own, line))


def onset(friction: float) -> tuple[float, float]:
    """Duration of a level line of half a metre at which the paper's cube begins to slide: by hand, in Drake."""
    scenario = load("panda-cube").with_changes(arm=None, physics__settle_before=0.2, physics__settle_after=0.0)
    way = np.array([0.48, 0.0, 0.0])
    expected = float(np.sqrt(10 / np.sqrt(3) * 0.48 / (friction * GRAVITY)))

    def slides(duration: float) -> bool:
        line = min_jerk_line(duration, np.zeros(3), way, np.eye(3), np.eye(3))
        (only,) = in_drake(line, scenario, {"friction": friction})["objects"]
        return bool(only["peak_slip"] > 5e-5)

    low, high = 0.94 * expected, 1.06 * expected
    if not slides(low) or slides(high):
        return expected, float("nan")
    while high - low > 1e-3 * expected:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if slides(middle) else (low, middle)
    return expected, 0.5 * (low + high)


def compare(cases: Iterator[Case], title: str) -> list[str]:
    """A sentence on how often the engines agree that the load stayed, and each case in which they do not."""
    began, rows, agreed, same, counted, near, below = time.process_time(), [], 0, 0, 0, 0, 0
    clear, clearly = 0, 0  # further than 3 % from the edge of either engine's own verdict, and the same in both
    right = dict.fromkeys(ENGINES, 0)  # of those that must hold
    for case in cases:
        outcomes = case.in_both()
        if case.demand is not None and abs(case.demand - 1) < EDGE:
            near += 1
            continue
        counted += 1
        kept = [outcome == "holds" for outcome in outcomes]
        agreed += kept[0] == kept[1]
        same += outcomes[0] == outcomes[1]
        edge: list[str] = []
        if case.demand is not None:
            for engine, holds in zip(right, kept, strict=True):
                right[engine] += holds and case.demand < 1
            below += case.demand < 1
            if case.demand > 1 or not all(kept):  # what is kept asks for less than there is with 3 % more too
                edge = case.at_an_edge(outcomes)
            clear += not edge
            clearly += not edge and kept[0] == kept[1]
        if kept[0] != kept[1]:
            by_hand = ""
            if case.demand is not None:
                (own,) = true_world(case.scenario).loads
                by_hand = (
                    f"; the tray asks for {case.demand:.2f} of what there is, by hand it slides "
                    f"{1e3 * slipping(own, case.reference):.1f} mm and rocks to "
                    f"{np.rad2deg(rocking(own, case.reference)):.1f} degrees; {case.edges()}"
                )
            rows.append(f"- {case.name}: {outcomes[0]} in MuJoCo, {outcomes[1]} in Drake{by_hand}.")
        print(f"{case.name}: {', '.join(outcomes)}{'; edge of ' + ' and '.join(edge) if edge else ''}", flush=True)
    seconds = time.process_time() - began
    sentence = (
        f"{title}: the engines agree whether the load stays in {agreed} of {counted}, and on how it is lost in {same}"
        f"{f' ({near} within 3 % of the edge by hand are not counted)' if near else ''}. {seconds:.0f} s of CPU time."
    )
    if below:
        sentence += (
            f" Of the {below} that ask for less than there is, MuJoCo keeps {right['MuJoCo']}, Drake {right['Drake']}. "
            "What asks for more slides or rocks, and is called lost from half a millimetre or two degrees on: there "
            "each engine's verdict has an edge of its own. Of those that are further than 3 % from both edges, the "
            f"engines agree in {clearly} of {clear} ({100 * clearly / clear:.1f} %). Where they differ"
            f"{':' if rows else ': nowhere.'}"
        )
    return [sentence, *(["", *rows] if rows else [])]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=200, help="random cases")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", action="append", choices=["onset", "ready", "random"], help="a part; default: all")
    parser.add_argument("--docs", action="store_true", help="write the numbers into docs/physics.md")
    asked = parser.parse_args()
    wanted = asked.only or ["onset", "ready", "random"]
    found: dict[str, list[str]] = {}
    if "onset" in wanted:
        lines = found["onset"] = ["| friction | begins to slide, by hand | in Drake | |", "|---|---|---|---|"]
        for friction in (0.1, 0.2, 0.3, 0.4, 0.5):
            expected, seen = onset(friction)
            lines.append(f"| {friction} | {expected:.4f} s | {seen:.4f} s | {100 * (seen / expected - 1):+.2f} % |")
            print(lines[-1], flush=True)
    if "ready" in wanted:
        title = f"The ready scenarios without liquids, at three speeds each (Drake {version('drake')})"
        found["ready"] = compare(pack(), title)
    if "random" in wanted:
        title = f"{asked.n} random boxes and cylinders, seed {asked.seed}"
        found["random"] = compare(random_cases(asked.n, asked.seed), title)
    for part, lines in found.items():
        if asked.docs:
            from blocks import replace

            replace(DOCS / "physics.md", f"second engine, {part}", "\n".join(lines))
        else:
            print("\n".join(lines))


if __name__ == "__main__":
    main()
