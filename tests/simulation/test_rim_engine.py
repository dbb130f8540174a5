"""Loads against a rim, from the scenario to the engine, the audit and a live motion; and the rim itself."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import salver as sv
from salver.errors import ScenarioError, UnreachableError
from salver.learning.friction.tilts import tilt_test
from salver.live import Live
from salver.models.arm.arm import load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.planning.fastest import plan_fastest
from salver.scenario import Scenario
from salver.simulation.physics import Experiment
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build

RIM = {"height": 0.025, "thickness": 0.004, "friction": 0.15}


def book(against: str | list[str] | None = "-y", rim: dict | None = RIM) -> Scenario:
    """A slippery box on a Panda's tray; without a rim, at the same place."""
    ranges = {"mass": "10%", "com": [0.002, 0.002, 0.004], "friction": "15%", "position": [0.002, 0.0]}
    item = {
        "name": "book",
        "shape": {"type": "box", "size": [0.06, 0.08, 0.06]},
        "mass": 0.5,
        "friction": 0.18,
        "uncertainty": ranges,
        **({"against": against} if against else {"at": [0.0, -0.07]}),
    }
    tray = {"size": [0.2, 0.22], **({"rim": rim} if rim else {})}
    more = {"uncertainty": {"friction_rim": 0.15}} if rim else {}
    changes = {"objects": [item], "tray": tray, "motion__duration": None, "arm": {"model": "panda"}}
    return sv.load_scenario("panda-cube", **changes, contact__condition="exact", **more)


def test_the_engine_has_walls_around_the_surface_with_their_true_friction() -> None:
    scenario = book()
    arm = load_arm(scenario.arm, scenario.tray)
    model = build(scenario, true_world(scenario, {"friction_rim": 0.3}), arm).model
    for name, axis, sign in (("-x", 0, -1), ("+x", 0, 1), ("-y", 1, -1), ("+y", 1, 1)):
        wall = model.geom(f"salver:rim:{name}")
        assert_allclose(sign * wall.pos[axis] - wall.size[axis], [0.1, 0.11][axis], atol=1e-12)
        assert_allclose([wall.pos[2] - wall.size[2], wall.pos[2] + wall.size[2]], [0.0, 0.025], atol=1e-12)
        sides = {model.geom("salver:hull:0").id, wall.id}
        (pair,) = (k for k in range(model.npair) if {model.pair_geom1[k], model.pair_geom2[k]} == sides)
        assert_allclose(model.pair_friction[pair, :2], 0.3)
    with pytest.raises(ScenarioError, match="has no rim"):
        true_world(book(None, None), {"friction_rim": 0.3})


def test_collisions_know_the_rim() -> None:
    scenario = book()
    geometry = arm_geometry(load_arm(scenario.arm, scenario.tray))
    tray = geometry.model.geometryObjects[geometry.names.index("tray")]
    assert_allclose(2 * tray.geometry.halfSide, [0.208, 0.228, 0.035])
    flat = arm_geometry(load_arm(scenario.arm, book(None, None).tray)).model.geometryObjects[
        geometry.names.index("tray")
    ]
    moved = flat.placement.actInv(tray.placement)
    assert_allclose(moved.translation, [0.0, 0.0, 0.0125], atol=1e-12)


@pytest.mark.slow
def test_a_goal_may_lean_towards_the_rim_and_not_away_from_it() -> None:
    """By 25 degrees, where a book with a friction of 0.153 to 0.207 slides without a rim."""
    towards, away = ({"motion__goal__rpy_deg": [roll, 0.0, 0.0]} for roll in (25.0, -25.0))
    assert plan_fastest(book().with_changes(**towards)).ok
    with pytest.raises(UnreachableError, match="At the goal book cannot stay even at rest"):
        plan_fastest(book().with_changes(**away))
    with pytest.raises(ScenarioError, match="at which book slides even at rest"):
        book(None, None).with_changes(**towards)


def test_friction_is_not_learnt_from_a_load_that_the_rim_holds() -> None:
    with pytest.raises(ScenarioError, match="book is set against the rim"):
        tilt_test(book(), 0.1)


@pytest.mark.slow
def test_a_rim_makes_the_motion_faster_and_holds_the_load_and_without_it_the_load_is_lost() -> None:
    plan, free = plan_fastest(book()), plan_fastest(book(None, None))
    assert plan.ok
    assert plan.duration < 0.9 * free.duration
    names, half = plan.scenario.uncertain.names, plan.scenario.uncertain.half_range
    assert "position_y" not in names
    nominal = plan.scenario.uncertain.nominal
    rng = np.random.default_rng(4)
    for speed in (1.0, 0.5):
        experiment = Experiment(plan if speed == 1.0 else plan.at_speed(speed))
        for _ in range(3):
            corner = nominal + half * rng.choice([-1.0, 1.0], size=len(half))
            assert experiment.run(dict(zip(names, corner.tolist(), strict=True))).outcome == "holds"
    # An audit of the same joint motion says the same, of a tray with and without the rim.
    assert plan.joint is not None
    t = np.append(np.arange(0.0, plan.duration, 1e-3), plan.duration)
    columns = {"t": t, **{f"q_panda_joint{j}": q for j, q in enumerate(plan.joint.sample(t)[0].T, 1)}}
    assert sv.audit(columns, book()).summary()["worst_case"]["code"] == "holds"
    assert sv.audit(columns, book(None, None)).summary()["nominal"]["code"] == "slides"
    run = sv.simulate(columns, book(None, None), parameters={"friction": 0.16})
    assert run.outcome != "holds"


def test_a_load_against_a_wall_does_not_creep() -> None:
    """Its friction would be spent on creep into the wall: at its least, this box slid along the wall by 2.1 mm."""
    ranges = {"mass": "10%", "friction": "10%"}
    shape = {"type": "box", "size": [0.06, 0.06, 0.15]}
    box = {"name": "box", "shape": shape, "mass": 0.4, "friction": 0.3, "against": "-x", "uncertainty": ranges}
    start, goal = [0.54237, -0.370574, 0.4], [0.444272, 0.100574, 0.4]
    motion = {"start": {"position": start}, "goal": {"position": goal}}
    tray = {"rim": {"height": 0.03}, "height": 0.05}
    content = {"name": "rim", "motion": motion, "objects": [box], "tray": tray, "arm": {"model": "panda"}}
    run = Experiment(plan_fastest(Scenario.model_validate(content))).run({"friction": 0.27, "mass": 0.44})
    assert run.slip.max() < 2e-4
    assert not run.creep_E.any()


@pytest.mark.slow
def test_creep_of_the_engine_that_a_wall_holds_back_is_no_slip() -> None:
    """At half speed nothing else moves a load in a corner, and it would creep by a seventh of a millimetre."""
    plan = plan_fastest(book(["-y", "+x"])).at_speed(0.5)
    run = Experiment(plan).run({"friction_rim": 0.0})
    assert run.slip.max() < 3e-5


@pytest.mark.slow
def test_live_motion_leans_on_the_rim_too() -> None:
    """To the same goal, sooner than without; each committed motion passed the same verdict."""
    reached = []
    for scenario in (book(), book(None, None)):
        live = Live(scenario, lead=0.06)
        live.goto(tuple(scenario.motion.goal.position))
        for k in range(3000):
            live.command(1e-3 * k)
            if k % 60 == 0:
                live.plan(60.0)
            if live.state.requests[-1].outcome == "reached":
                break
        reached.append(k)
    assert reached[0] < reached[1] < 2999
