"""The floor: the plane on which an arm stands, which links, tray and load keep above wherever nothing else is said."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from salver import scenario
from salver.errors import ScenarioError, UnreachableError
from salver.geometry import Array
from salver.live import Live
from salver.models.arm.arm import ArmModel, load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.planning.fastest import plan_fastest, transport_problem
from salver.planning.follow.clearance import sweep
from salver.planning.make import make_plan
from salver.planning.plan import Plan
from salver.reports.pages.replay import replay_scene
from salver.reports.run import ReportedRun
from salver.scenario import Scenario
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.meshes import arm_meshes
from salver.simulation.scene.scene import build

# Where the upper arm of a UR10 and the wrist of a Gen3 go below the base unless something is there.
UR10 = ([0.472, -0.277, 0.691], [0.374, 0.446, 0.397])
GEN3 = ([0.256, -0.393, 0.428], [0.519, 0.148, 0.475])


def newcomer(model: str, start: list[float], goal: list[float], **more: Any) -> Scenario:
    """An arm, a bottle that is known exactly, a start and a goal."""
    shape = {"type": "cylinder", "radius": 0.033, "height": 0.15}
    data = {
        "name": "newcomer",
        "motion": {"start": {"position": start}, "goal": {"position": goal}},
        "objects": [{"name": "bottle", "shape": shape, "mass": 0.4, "friction": 0.35, "uncertainty": "none"}],
        "arm": {"model": model},
    }
    return scenario.parse({**data, **more}, "newcomer")


def arm_of(case: Scenario) -> ArmModel:
    assert case.arm is not None
    return load_arm(case.arm, case.tray)


def lowest(plan: Plan, links: tuple[str, ...]) -> float:
    """m; of the visual meshes of some links along a plan, which no planner looks at."""
    arm, meshes = arm_of(plan.scenario), arm_meshes(arm_of(plan.scenario))
    low = np.inf
    for q in plan.joint.sample(np.arange(0.0, plan.duration, 0.02))[0]:  # type: ignore[union-attr]
        for link in links:
            p, R = arm.link_pose(q, link)
            low = min(low, *(float((p + part.vertices @ R.T)[:, 2].min()) for part in meshes[link]))
    return low


def test_where_the_floor_is() -> None:
    """At the arm's base unless a height is given; nowhere without an arm, or where there is said to be none."""
    cube = scenario.load("panda-cube")
    assert cube.floor == 0.0
    assert cube.with_changes(arm__base_position=(0.0, 0.0, 0.7)).floor == 0.7
    assert cube.with_changes(surroundings__floor=-0.3).floor == -0.3
    assert [obstacle.name for obstacle in cube.around] == ["floor"]
    for without in (cube.with_changes(surroundings__floor="none"), cube.with_changes(arm=None)):
        assert without.floor is None
        assert without.around == ()
    with pytest.raises(
        ScenarioError, match=r'surroundings.floor = "table": must be a finite number .* "base" or "none"'
    ):
        cube.with_changes(surroundings__floor="table")


def test_a_base_that_is_not_upright_stands_on_no_floor() -> None:
    """Turned about the vertical it does; on a wall, from a ceiling and on a slant the floor must be given."""
    cube = scenario.load("panda-cube")
    assert cube.with_changes(arm__base_rpy_deg=(0.0, 0.0, 70.0)).floor == 0.0
    for turn, tilt in (((0.0, 90.0, 0.0), "90"), ((180.0, 0.0, 20.0), "180"), ((-30.0, 0.0, 0.0), "30")):
        told = rf"tilts the base by {tilt} deg, .*; give surroundings.floor, the floor's height in S, m, or \"none\""
        with pytest.raises(ScenarioError, match=told):
            cube.with_changes(arm__base_rpy_deg=turn)
        assert cube.with_changes(arm__base_rpy_deg=turn, surroundings__floor=-0.8).floor == -0.8
        assert cube.with_changes(arm__base_rpy_deg=turn, surroundings__floor="none").floor is None


@pytest.mark.parametrize("height", [0.0, -0.25])
def test_distances_from_the_floor_are_heights(height: float) -> None:
    """Of every link the height of the lowest corner of its hull; only what the arm stands on is not compared."""
    case = newcomer("ur5", [0.4, -0.2, 0.4], [0.4, 0.2, 0.4], surroundings={"floor": height})
    arm = arm_of(case)
    parts = arm_geometry(arm, case.payload.bodies, case.around)
    compared = {parts.names[i]: k for k, (i, j) in enumerate(parts.pairs) if parts.names[j] == "floor"}
    assert set(compared) == {
        *("upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link", "ee_link"),
        *("tray", "bottle"),
    }
    q = np.array([[0.3, -0.6, 1.9, -2.0, -1.6, 0.4], [0.0, 0.4, 0.5, 0.2, 0.3, 0.0]])
    for link in ("upper_arm_link", "forearm_link", "wrist_2_link"):
        hull = parts.model.geometryObjects[compared_part(parts.names, link)].geometry
        for k, posture in enumerate(q):
            place = placed(parts, arm, posture, compared_part(parts.names, link))
            points = np.array([hull.point(i) for i in range(hull.num_points)])
            low = (place.translation + points @ place.rotation.T)[:, 2].min() - height
            assert parts.clearance(q)[k, compared[link]] == pytest.approx(low, abs=1e-6)


def compared_part(names: tuple[str, ...], link: str) -> int:
    return names.index(link)


def placed(parts: Any, arm: ArmModel, q: Array, part: int) -> Any:
    import pinocchio as pin

    pin.updateGeometryPlacements(arm.pin_model, arm.data, parts.model, parts.data, q)
    return parts.data.oMg[part]


@pytest.mark.slow
def test_the_elbow_stays_above_the_table() -> None:
    """The same task with and without a floor: only without one the upper arm is 40 cm below the base."""
    kept, free = (plan_fastest(newcomer("ur10", *UR10, **more)) for more in ({}, {"surroundings": {"floor": "none"}}))
    assert kept.ok
    assert free.ok
    moving = ("upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link")
    assert lowest(kept, moving) > 0.0
    assert lowest(free, moving) < -0.1
    assert kept.unchecked[0] == "anything around the arm but the floor"
    assert free.unchecked[0] == "anything around the arm"


@pytest.mark.slow
def test_ten_millimetres_are_kept() -> None:
    """By an elbow that would otherwise sink below the table; a floor 12 mm higher is met."""
    case = newcomer("gen3", *GEN3)
    plan = plan_fastest(case)
    assert plan.ok
    parts = arm_geometry(arm_of(case), case.payload.bodies, case.around)
    assert plan.joint is not None
    swept = sweep(parts, plan.joint)
    assert swept.obstacle is not None
    assert 0.00999 < swept.obstacle.distance < 0.012
    raised = case.with_changes(surroundings__floor=0.012)
    touch = sweep(arm_geometry(arm_of(case), case.payload.bodies, raised.around), plan.joint).touch
    assert touch is not None
    assert touch.second == "floor"


@pytest.mark.slow
def test_an_end_in_the_floor_is_refused_in_a_sentence() -> None:
    """By both planners, and by a live motion; of an end that is too low for a wrist it is said how much is."""
    below = newcomer("panda", [0.5, -0.2, 0.05], [0.5, 0.2, 0.4])
    says = "At the start the tray is in the floor; move the start up, or say where the floor is: surroundings.floor"
    with pytest.raises(UnreachableError, match=says):
        plan_fastest(below)
    status = make_plan(below.with_changes(motion__duration=2.0), "robust").arm_status
    assert status is not None
    assert says in status.sentence
    with pytest.raises(UnreachableError, match=r"m higher one was found\.$"):
        plan_fastest(newcomer("panda", [0.5, -0.25, 0.2], [0.5, 0.25, 0.4]))
    with pytest.raises(ScenarioError, match="floor"):
        Live(scenario.load("panda-cube").with_changes(surroundings__floor=0.3))


def test_a_start_posture_in_the_floor_is_refused() -> None:
    with pytest.raises(
        UnreachableError, match=r"In the start posture panda_link\d and floor touch \(surroundings.floor"
    ):
        plan_fastest(scenario.load("panda-cube").with_changes(surroundings__floor=0.25))


def test_what_follows_a_motion_of_the_tray_keeps_above_the_floor() -> None:
    """The paper's motion of the tray alone, of which the postures of a UR5 are then chosen."""
    case = newcomer("ur5", [0.35, -0.4, 0.42], [0.35, 0.4, 0.42])
    plan = make_plan(case.with_changes(motion__duration=4.0), "robust")
    assert plan.arm_status is not None
    assert plan.arm_status.ok
    assert lowest(plan, ("upper_arm_link", "forearm_link", "wrist_2_link")) > 0.0


def test_what_falls_in_the_engine_lies_on_the_floor() -> None:
    """A bottle let go beside the tray, of a floor at -0.2 m: it comes to rest there; without a floor it falls on."""
    rests = []
    for floor in (-0.2, "none"):
        case = newcomer("panda", [0.5, -0.2, 0.4], [0.5, 0.2, 0.4], surroundings={"floor": floor})
        scene = build(case, true_world(case), arm_of(case))
        data = mujoco.MjData(scene.model)
        scene.place(data, np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.6, 0.8]))
        at = scene.qpos_ids[0]
        data.qpos[at : at + 3] = [1.2, 0.0, 0.3]
        mujoco.mj_step(scene.model, data, nstep=3000)
        rests.append((data.qpos[at + 2], np.linalg.norm(data.qvel[scene.qvel_ids[0] :][:3])))
    (height, speed), (fallen, _) = rests
    assert height == pytest.approx(-0.2 + 0.075, abs=2e-3)
    assert speed < 1e-2
    assert fallen < -5.0


@pytest.mark.slow
def test_the_page_draws_the_ground_where_the_floor_is(tmp_path: Any) -> None:
    from salver.reports.run import read_run

    case = scenario.load("panda-cube").with_changes(surroundings__floor=-0.11)
    make_plan(case).save(tmp_path)
    run: ReportedRun = read_run(tmp_path)
    assert replay_scene(run, arm_of(case))["floor"] == -0.11


def test_a_stop_keeps_above_the_floor_too() -> None:
    """What a search for stops is given watches the floor."""
    problem = transport_problem(newcomer("ur5", [0.4, -0.2, 0.4], [0.4, 0.2, 0.4]))
    assert problem.keep_out is not None
    of_floor = problem.keep_out.parts.of_floor
    assert of_floor.sum() == 8
    assert set(problem.keep_out.required[of_floor]) == {0.01}
    assert set(problem.keep_out.required[~of_floor]) == {0.005}
