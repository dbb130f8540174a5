"""A base that drives: its kinematics by hand, the shortest time that friction and jerk allow, and the engine."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from live_runs import LEAD, drive, said
from salver import scenario
from salver.auditing.arm import arm_status
from salver.driver.preflight import check_approach
from salver.errors import ScenarioError, UnreachableError
from salver.geometry import matrix_from_rpy
from salver.live import Live
from salver.models.arm.arm import load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.arm.known_arms import KNOWN_ARMS
from salver.motion_files.samples import JointSamples
from salver.planning.fastest import plan_fastest, transport_problem
from salver.planning.fastest.retiming import plan_retimed
from salver.planning.follow.limits import BETWEEN, verdict
from salver.planning.seeds.starts import Ends, straight
from salver.planning.trajopt.constraints.constraints import Driving
from salver.planning.verdict.verify import verify
from salver.simulation.physics import simulate
from salver.simulation.scene.loads import true_world
from salver.simulation.scene.scene import build
from salver.trajectory import JointMotion

COLUMN = """<robot name="column"><link name="column"><inertial><origin xyz="0 0 0.3"/><mass value="8"/>
  <inertia ixx="0.25" iyy="0.25" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0 0 0.3"/><geometry><cylinder radius="0.05" length="0.6"/></geometry></collision></link>
  <link name="top"/><joint name="to_top" type="fixed"><parent link="column"/><child link="top"/>
  <origin xyz="0 0 0.6"/></joint></robot>"""
ROUND = {"kind": "omnidirectional", "radius": 0.25, "height": 0.3, "mass": 40.0, "x": [-3.0, 3.0], "y": [-3.0, 3.0]}
RIDGEBACK = {
    "kind": "omnidirectional",
    "size": [0.96, 0.793, 0.311],
    "mass": 165.0,
    "x": [-3.0, 2.0],
    "y": [-2.0, 3.0],
    "mount": [0.27, 0.01, 0.653],
    "mount_rpy_deg": [0.0, 0.0, -90.0],
    "limits": {"velocity": [1.1, 1.2, 2.0]},
}
FRICTION, JERK = 0.3, 40.0


def task(arm, goal=(2.0, 0.0), heading=0.0, **more):
    """A flat box on a tray, 0.92 m above the floor in the middle."""
    start, goal = ({"position": [*at, 0.92], "rpy_deg": [0.0, 0.0, heading]} for at in ((0.0, 0.0), goal))
    return scenario.parse(
        {
            "name": "waiter",
            "motion": {"start": start, "goal": goal, "speeds": "full"},
            "objects": [
                {
                    "shape": {"type": "box", "size": [0.06, 0.06, 0.02]},
                    "mass": 0.2,
                    "friction": FRICTION,
                    "uncertainty": {},
                }
            ],
            "contact": {"condition": "exact"},
            "tray": {"height": 0.01},
            "arm": arm,
            "physics": {"robot": {"control": "position"}},
            **more,
        },
        "the test",
    )


@pytest.fixture(scope="module")
def column(tmp_path_factory):
    path = tmp_path_factory.mktemp("column") / "column.urdf"
    path.write_text(COLUMN)
    limits = {"velocity": 5.0, "acceleration": 10.0, "jerk": JERK}
    return {"model": str(path), "flange": "top", "base": {**ROUND, "limits": limits}, "jerk_scale": 1.0}


def on_ridgeback(**more):
    return {"model": "ur10", "base": {**RIDGEBACK, **more}}


def test_the_tray_is_where_the_base_has_driven_it(column):
    """Heading 20 + 30 deg, 0.2 m to the side of the base's middle, after 1 m along the axes of the pose at 0."""
    base = {**column["base"], "mount": [0.0, 0.2, 0.3]}
    arm = task(
        {
            **column,
            "base": base,
            "base_position": [0.5, 0.4, 0.1],
            "base_rpy_deg": [0, 0, 20],
        }
    ).arm
    model = load_arm(arm, task(column).tray)
    p, R = model.tray_pose(np.array([1.0, -0.5, np.deg2rad(30)]))
    c, s = math.cos(math.radians(20)), math.sin(math.radians(20))
    side = 0.2 * np.array([-math.sin(math.radians(50)), math.cos(math.radians(50))])
    at = np.array([0.5 + c * 1.0 + s * 0.5, 0.4 + s * 1.0 - c * 0.5]) + side
    assert p == pytest.approx([*at, 0.1 + 0.3 + 0.6 + 0.01], abs=1e-12)
    assert pytest.approx(matrix_from_rpy([0, 0, np.deg2rad(50)]), abs=1e-12) == R


def test_joints_of_the_base_come_first_with_limits_of_their_own():
    base = {**on_ridgeback(), "limits": {"acceleration": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]}}
    arm = load_arm(task(base).arm, task(base).tray)
    assert arm.joint_names[:4] == ("base_x", "base_y", "base_yaw", "shoulder_pan_joint")
    assert arm.linear[:4] == (True, True, False, False)
    assert arm.limits.q_min[:3] == pytest.approx([-3.0, -2.0, -np.pi])
    assert arm.limits.q_max[:3] == pytest.approx([2.0, 3.0, np.pi])
    assert arm.limits.velocity == pytest.approx([1.1, 1.2, 2.0, *KNOWN_ARMS["ur10"].limits["velocity"]])
    assert arm.limits.acceleration == pytest.approx([np.inf] * 3 + [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    assert np.isfinite(arm.limits.torque).tolist() == [False] * 3 + [True] * 6
    assert arm.limit_sources["velocity"][2:4] == ("arm.base", "the maker of the ur10")
    assert arm.limit_sources["acceleration"][2:4] == (None, "arm.limits")


def test_an_arm_keeps_its_velocity_limits_by_position_behind_a_base():
    alone, driven = ({"model": "fr3"} | more for more in ({}, {"base": RIDGEBACK}))
    one, other = (load_arm(task(arm).arm, task(arm).tray).limits for arm in (alone | {"base": None}, driven))
    q, dq = np.array([0.1, -1.2, 0.4, -2.9, 0.2, 0.7, 2.5]), np.array([1.0, -1, 1, -1, 1, -1, 1])
    expected = one.velocity_at(q, dq)[0]
    found = other.velocity_at(np.array([1.9, -1.9, 3.0, *q]), np.array([1.0, -1.0, 1.0, *dq]))[0]
    assert found == pytest.approx([1.1, 1.2, 2.0, *expected])
    assert np.any(expected < one.velocity)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"size": None}, "arm.base: its body needs size = [length, width, height], or radius and height"),
        ({"height": 0.2}, "arm.base: its body needs size"),
        ({"x": [1.0, -1.0]}, "arm.base: x = [1, -1] is no range; its first number must be below its second"),
        ({"kind": "tracked"}, 'arm.base.kind = "tracked": must be "omnidirectional" or "differential"'),
        ({"limits": {"velocity": [1.0, 1.0]}}, "arm.base.limits.velocity has 2 values; arm.base has 3 joints"),
    ],
)
def test_mistakes_of_the_table_are_named(change, said):
    with pytest.raises(ScenarioError) as error:
        load_arm(task(on_ridgeback(**change)).arm, task({"model": "ur10", "base": RIDGEBACK}).tray)
    assert said in str(error.value)


def test_a_base_takes_no_torques_and_no_name_twice(column, tmp_path):
    with pytest.raises(ScenarioError, match=r'control = "torque" does not move arm.base, which takes velocities'):
        task(column, physics={})
    path = tmp_path / "own.urdf"
    path.write_text(COLUMN.replace('"column"', '"mobile_base"'))
    own = task({**column, "model": str(path)})
    with pytest.raises(ScenarioError, match=r"has the name mobile_base, which arm.base needs itself"):
        load_arm(own.arm, own.tray)


def test_the_engine_moves_the_model_that_is_planned_with():
    """The URDF of a UR begins with a link named world, which MuJoCo would fix."""
    case = task({**on_ridgeback(), "base_position": [0.3, -0.2, 0.0], "base_rpy_deg": [0.0, 0.0, 25.0]})
    arm = load_arm(case.arm, case.tray)
    scene = build(case, true_world(case, {}), arm)
    data, full = mujoco.MjData(scene.model), np.zeros((scene.model.nv, scene.model.nv))
    q, dq = np.array([1.0, -0.5, 2.0, 0.3, -1.0, 1.2, 0.4, 1.1, -0.6]), np.linspace(-1, 1, 9)
    data.qpos[:9], data.qvel[:9] = q, dq
    mujoco.mj_forward(scene.model, data)
    mujoco.mj_fullM(scene.model, data, full)
    assert full[:9, :9] == pytest.approx(arm.mass_matrix(q), abs=1e-9)
    assert data.qfrc_bias[:9] == pytest.approx(arm.bias(q, dq), abs=1e-9)
    assert scene.tray_pose(data)[0] == pytest.approx(arm.tray_pose(q)[0], abs=1e-12)


@pytest.mark.parametrize(("along", "touches"), [(1.0, False), (1.02, True)])
def test_the_body_of_the_base_keeps_clear_of_obstacles(column, along, touches):
    """A round body of radius 0.25 m and a wall whose side is at x = 1.26 m."""
    wall = {"type": "box", "name": "wall", "position": [1.36, 0.0, 0.1], "size": [0.2, 4.0, 0.2]}
    case = task(column, obstacles=[wall])
    parts = arm_geometry(load_arm(case.arm, case.tray), case.payload.bodies, case.around)
    found = parts.first_touch(np.array([[along, 0.5, 0.7]]))
    assert ((found.first, found.second) == ("mobile_base", "wall")) if touches else found is None


@pytest.mark.parametrize(("base_yaw", "heading"), [(0.0, 0.0), (35.0, 35.0), (0.0, 90.0)])
def test_shortest_time_of_a_straight_line_is_that_of_friction_and_jerk(column, base_yaw, heading):
    """Acceleration mu g, reached by the largest jerk: T = 2 (v / a + a / j) with d = v (v / a + a / j)."""
    along = np.array([math.cos(math.radians(base_yaw)), math.sin(math.radians(base_yaw))])
    case = task({**column, "base_rpy_deg": [0.0, 0.0, base_yaw]}, (2.0 * along).tolist(), heading)
    a, d = FRICTION * 9.81, 2.0
    ramp = a / JERK
    v = 0.5 * a * (math.sqrt(ramp**2 + 4 * d / a) - ramp)
    least = 2 * (v / a + ramp)
    plan = plan_fastest(case)
    assert plan.ok, plan.status
    assert least <= plan.duration <= 1.02 * least
    assert plan.joint.q[[0, -1]] == pytest.approx(
        np.array([[0.0, 0.0, np.deg2rad(heading - base_yaw)], [2.0, 0.0, np.deg2rad(heading - base_yaw)]]), abs=1e-9
    )


def test_the_engine_drives_the_base_to_the_goal_with_the_load_in_place(column):
    plan = plan_fastest(task(column, (0.8, 0.6)))
    record = simulate(plan)
    assert record.summary["outcome"] == "holds", record.summary
    assert record.q[-1] == pytest.approx([0.8, 0.6, 0.0], abs=1e-3)


@pytest.mark.slow
def test_a_base_drives_around_a_table_that_it_was_far_from_at_first():
    """The first path keeps far from the table, and a shorter one through it is 0.6 s faster."""
    case = scenario.load("serving-robot").with_changes(arm__base__kind="omnidirectional")
    around, straight = (plan_fastest(one) for one in (case, case.with_changes(obstacles=[])))
    assert around.ok, around.status
    assert straight.duration < 3.2 < 3.6 < around.duration < 3.8


def test_a_differential_base_parks_sideways_without_moving_across_its_heading(column):
    """It ends 1.5 m to its left with the heading that it began with, by turns and arcs."""
    base = {**column["base"], "kind": "differential"}
    plan = plan_fastest(task({**column, "base": base}, (0.0, 1.5)))
    assert plan.ok, plan.status
    q, dq, _ = plan.joint.sample(np.linspace(0.0, plan.duration, 1000))
    across = -np.sin(q[:, 2]) * dq[:, 0] + np.cos(q[:, 2]) * dq[:, 1]
    assert np.abs(across).max() <= 0.005
    assert np.abs(dq[:, :2]).max() > 0.5
    assert q[-1] == pytest.approx([0.0, 1.5, 0.0], abs=1e-9)


def test_no_verdict_lets_a_differential_base_slide_sideways(column):
    """The motion of an omnidirectional base, which goes straight to its left."""
    sideways = plan_fastest(task(column, (0.0, 1.5)))
    case = task({**column, "base": {**column["base"], "kind": "differential"}}, (0.0, 1.5))
    found = verify(transport_problem(case), sideways.joint)
    amount = re.match(r"velocity of the base across its heading would be exceeded by (\S+) mm/s", found.sentence)
    assert amount is not None, found.sentence
    fastest = np.abs(sideways.joint.sample(np.linspace(0.0, sideways.duration, 1000))[1][:, 1]).max()
    assert float(amount[1]) == pytest.approx(1e3 * (fastest - 0.005), rel=0.01)
    arm, joint = load_arm(case.arm, case.tray), sideways.joint
    recorded = JointSamples(joint.t, arm.joint_names, joint.q, None, None, "recording")
    assert ", whether the base moves across its heading" in arm_status(recorded, arm, case).sentence
    said = verdict(arm, joint).sentence
    assert "the base moves across its heading at " in said
    assert ", above 0.005 m/s" in said
    assert not plan_retimed(case, sideways.joint.q[::20]).ok


def test_a_keep_in_box_may_stand_on_the_floor_that_the_base_drives_on(column):
    """Its other faces count: the base is round, so that its distance from them is known."""
    box = {"position": [0.5, 0.1, 1.0], "size": [3.0, 2.2, 2.0], "rpy_deg": [0.0, 0.0, 10.0]}
    arm = load_arm(task(column).arm, task(column).tray)
    parts = arm_geometry(arm, obstacles=task(column, surroundings={"keep_in": box}).around)
    walls = [k for k, (i, j) in enumerate(parts.pairs) if parts.names[i] == "mobile_base" and "box" in parts.names[j]]
    at = np.array([1.3, 0.6, 0.4])
    off = matrix_from_rpy(np.deg2rad(box["rpy_deg"])).T @ [at[0] - 0.5, at[1] - 0.1, 0.0]
    by_hand = 0.5 * np.array([3.0, 2.2]) - np.abs(off[:2]) - 0.25
    assert parts.clearance(at[None])[0, walls].min() == pytest.approx(by_hand.min(), abs=1e-3)
    assert task(column, surroundings={"keep_in": {**box, "size": [8.0, 12.0, 2.0]}}).around[0].point[0] < -3.0
    with pytest.raises(ScenarioError, match="mobile_base is outside the keep-in box in every posture"):
        arm_geometry(
            arm, obstacles=task(column, surroundings={"keep_in": {**box, "position": [0.5, 0.1, 1.01]}}).around
        )


@pytest.mark.slow
def test_a_twist_is_followed_steadily_by_a_base_whose_jerk_is_limited_as_bases_are():
    """It slowed to 0.12 m/s now and then while only the verdict looked at the jerk just before an earlier increment's
    end; while limits of the jerk joined each programme late, 12 % of it was followed."""
    live, granted = Live("serving-robot", lead=LEAD), []
    looks = [(at, lambda live: granted.append(live.state.granted)) for at in np.arange(0.7, 1.6, 0.1)]
    drive(live, 1.6, sorted([*said(lambda t: (0.4, 0.0, 0.0), 1.6), *looks], key=lambda wish: wish[0]))
    assert min(granted) > 0.9, granted


def test_rounding_of_positions_of_metres_is_no_jerk(column):
    """Pre-flight looks at pieces of 0.25 ms four times: third differences of 2.9 m in 0.06 ms are wrong by percents."""
    case = task(column)
    arm, jerk, quarter = load_arm(case.arm, case.tray), 0.9995 * JERK, 0.2
    t = np.union1d(np.linspace(0.0, 4 * quarter, 161), quarter * np.arange(0.5, 4.0) + 2.4e-4)
    since = [np.maximum(t - at, 0.0) for at in (0.0, quarter, 3 * quarter)]
    q, dq, ddq = np.zeros((3, len(t), arm.n))
    for x, power in ((q, 3), (dq, 2), (ddq, 1)):
        x[:, 0] = jerk / math.factorial(power) * (np.array([1.0, -2.0, 2.0]) @ np.power(since, power))
    q[:, 0] -= 2.9
    checks = check_approach(JointMotion(t, q, dq, ddq), SimpleNamespace(scenario=case), arm)
    assert [check.sentence for check in checks if not check.ok] == []


@pytest.mark.parametrize(
    ("heading", "way", "most"), [(0.0, "along", 1.0), (180.0, "along", 1.0), (90.0, "across", 1.2)]
)
def test_no_verdict_lets_a_base_drive_faster_than_its_maker_says(column, heading, way, most):
    """Forwards, backwards and sideways, where no fixed axis is at its limit: motions from elsewhere may exceed a plan's
    share of a limit by 0.5 %, never the limit itself."""
    limits = {"velocity": [1.0, 1.2, 4.0], "acceleration": 10.0, "jerk": JERK}
    base = {**column["base"], "limits": limits, "yaw_deg": [-300.0, 300.0]}
    case = task({**column, "base": base, "velocity_scale": 1.0})
    arm, t, towards = load_arm(case.arm, case.tray), np.linspace(0.0, 4.0, 401), np.array([0.8, 0.6])
    for v, refused in ((1.004 * most, True), (0.999 * most, False)):
        q, dq, ddq = np.zeros((3, len(t), 3))
        q[:, :2] = v * np.outer(0.5 * t - np.sin(np.pi * t / 2.0) / np.pi, towards)
        dq[:, :2] = v * np.outer(np.sin(np.pi * t / 4.0) ** 2, towards)
        ddq[:, :2] = v * np.outer(0.25 * np.pi * np.sin(np.pi * t / 2.0), towards)
        q[:, 2] = math.atan2(0.6, 0.8) + np.deg2rad(heading)
        found = verdict(arm, JointMotion(t, q, dq, ddq), between=BETWEEN)
        assert found.code == ("limit_exceeded" if refused else "within_limits"), found.sentence
        assert not refused or f"the base moves {way} its heading at {v:.4g} m/s" in found.sentence


def test_a_differential_base_begins_with_the_heading_that_is_nearer_forwards_or_backwards():
    """Its goal is behind it, a little to the right: it turns by 0.09 rad, drives backwards, and turns on."""
    arm = SimpleNamespace(base=SimpleNamespace(kind="differential"))
    pair = Ends(np.array([0.5, 0.2, 0.2, 1.0]), np.array([-0.5, -0.1, 0.4, 2.0]), 0.0, True)
    heading = math.atan2(0.3, 1.0)
    turned, arrived = [0.5, 0.2, heading, 1.0], [-0.5, -0.1, heading, 2.0]
    assert straight(pair, arm).postures == pytest.approx(np.array([pair.start, turned, arrived, pair.goal]))


def test_a_height_that_a_base_cannot_lift_its_tray_to_is_said_with_the_one_that_it_has(column):
    goal = {"position": [1.0, 0.3, 0.9204], "rpy_deg": [0.0, 0.0, 0.0]}
    with pytest.raises(
        UnreachableError, match=r"the goal: .* by 0\.4 mm and 0 deg\. Position \[1\.0, 0\.3, 0\.92\] is"
    ):
        plan_fastest(task(column).with_changes(motion__goal=goal))


@pytest.mark.parametrize("way", [0, 1])
def test_derivatives_of_the_velocities_of_a_base_are_those_of_differences(way):
    rng = np.random.default_rng(4)
    case = task(on_ridgeback(kind="differential"))
    problem = transport_problem(case)
    z = rng.uniform(-1, 1, (4, 6, 9))

    def rows(z):
        motion = problem.at(np.linspace(0.0, 1.0, 6), z, 1.0)
        blocks = list(Driving(problem.arm, problem.limits).blocks(motion))
        return blocks[way]

    node, row = (x.ravel() for x in np.indices((6, 2)))
    gradient, step = rows(z).gradient(node, row).reshape(-1, 4, 9), 1e-6
    for k in range(2):
        for j in range(9):
            moved = z.copy()
            moved[k, :, j] += step
            assert ((rows(moved).values - rows(z).values) / step).ravel() == pytest.approx(gradient[:, k, j], abs=1e-5)


def test_a_base_keeps_its_limits_along_and_across_its_heading(column):
    """At 45 deg it would be 1.41 times as fast if only the fixed axes were limited; an omnidirectional one may turn
    to drive slantwise."""
    slow = {"velocity": [1.0, 1.0, 2.0], "acceleration": 10.0, "jerk": JERK}
    durations = {}
    for kind in ("differential", "omnidirectional"):
        base = {**column["base"], "limits": slow, "kind": kind}
        plan = plan_fastest(task({**column, "base": base}, (2.0, 2.0), 45.0))
        assert plan.ok, plan.status
        q, dq, _ = plan.joint.sample(np.linspace(0.0, plan.duration, 500))
        along = np.cos(q[:, 2]) * dq[:, 0] + np.sin(q[:, 2]) * dq[:, 1]
        across = np.cos(q[:, 2]) * dq[:, 1] - np.sin(q[:, 2]) * dq[:, 0]
        assert 0.97 < np.abs(along).max() <= 0.98
        assert np.abs(across).max() <= (0.005 if kind == "differential" else 0.98)
        durations[kind] = plan.duration
    assert durations["omnidirectional"] < 0.9 * durations["differential"]
