"""ros2/salver_ros: its logic with the real planner, its messages by the definitions of rosbags, and its node with
stand-ins for rclpy, which is not on PyPI. No ROS 2 runs here."""

import ast
import importlib
import re
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from ruamel.yaml import YAML

import salver as sv
from salver.errors import SalverError, ScenarioError
from salver.models.arm.arm import load_arm
from salver.motion_files.ros_writers import typed
from salver.planning.make import make_plan
from salver.trajectory import JointMotion

ROS2 = Path(__file__).parents[2] / "ros2"
sys.path.insert(0, str(ROS2 / "salver_ros"))

from salver_ros import messages, mock  # noqa: E402
from salver_ros.carrier import Carrier, Options, Trajectory, audit, of_motion, ordered, plan  # noqa: E402

STORE = get_typestore(Stores.ROS2_JAZZY)
for path in (ROS2 / "salver_msgs" / "srv").glob("*.srv"):
    for part, text in zip(("Request", "Response"), path.read_text().split("---"), strict=True):
        STORE.register(get_types_from_msg(text, f"salver_msgs/msg/{path.stem}_{part}"))
SCENARIO, GOAL, NEARER = "panda-cube", (0.444272, 0.100574, 0.4), (0.5, -0.1, 0.4)
PERIOD, EVERY = 0.01, 2  # s of the node; periods from one step of planning to the next
START = 1.7e9  # s of a clock of ROS


def filled(kind: str, **values: Any) -> Any:
    """A message of rosbags filled from plain data, as those of rclpy are."""
    return typed(STORE, kind, values)


def sent(motion: Trajectory) -> Trajectory:
    """What a controller receives."""
    kind = "trajectory_msgs/msg/JointTrajectory"
    wire = STORE.serialize_cdr(filled(kind, **messages.trajectory_message(motion)), kind)
    return messages.trajectory_of(STORE.deserialize_cdr(wire, kind))


class Arm:
    """A node and its controller, which reads the newest trajectory at the clock's time, as joint_trajectory_controller
    does with one that is stamped in the past, and an arm that does what its controller says."""

    def __init__(self, options: Options = Options(), scenario: Any = SCENARIO) -> None:  # noqa: B008
        live = sv.Live(scenario)
        self.q = live.command(0.0)[0].copy()
        self.carrier = Carrier(scenario, live.problem.arm.joint_names, self.q, options=options, lead=0.1)
        self.arm, self.t, self.count = live.problem.arm, START, 0
        self.beats, self.sees, self.steps = True, True, True
        self.motion: Trajectory | None = None
        self.times: list[float] = []
        self.path: list[np.ndarray] = []
        self.state = np.stack([self.q, 0 * self.q, 0 * self.q])  # q, dq, ddq
        self.states: list[np.ndarray] = []
        self.asked: Callable[[], Any] = lambda: None  # each period

    def run(self, seconds: float) -> "Arm":
        for _ in range(round(seconds / PERIOD)):
            self.t, self.count = self.t + PERIOD, self.count + 1
            if self.steps:
                self.asked()
                if self.beats:
                    self.carrier.beat(self.t)
                if self.sees:
                    self.carrier.measured(self.carrier.joints, self.q.tolist(), self.t)
                motion = self.carrier.step(self.t)
                self.motion = self.motion if motion is None else sent(motion)
                if self.count % EVERY == 0:
                    self.carrier.live.plan()
            if self.motion is not None:
                m = self.motion
                self.state = np.concatenate(JointMotion(m.t, m.q, m.dq, m.ddq).sample(self.t - m.begins))
                self.q = self.state[0]
            self.times.append(self.t)
            self.path.append(self.q)
            self.states.append(self.state)
        return self

    @property
    def p_SE(self) -> np.ndarray:
        return self.arm.tray_pose(self.q)[0]

    @property
    def speed(self) -> float:
        return float(np.abs(self.path[-1] - self.path[-2]).max()) / PERIOD

    def holds(self) -> bool:
        """The verdict on what the controller made of it, with velocities, as a motion that is commanded."""
        t = np.array(self.times) - self.times[0]
        motion = Trajectory(self.carrier.joints, 0.0, t, *np.array(self.states).swapaxes(0, 1))
        return audit(self.carrier.scenario, motion)[0]


def test_a_goal_is_gone_to_and_the_controller_follows_what_is_committed() -> None:
    arm = Arm()
    assert arm.carrier.goto("world", GOAL, None) == (True, "Accepted.")
    arm.run(0.5)
    assert np.abs(arm.q - arm.carrier.command).max() < 1e-6  # rad; the clock of ROS counts in 2.4e-7 s as a double
    arm.run(1.0)
    p, _ = arm.arm.object_pose(arm.q, *((b := arm.carrier.scenario.payload.first).p_EB, b.R_EB)[:2])
    assert np.abs(p - GOAL).max() < 1e-4
    assert arm.carrier.state()[0] == 0
    assert arm.holds()


def test_a_lost_heartbeat_makes_the_stop_that_keeps_the_load() -> None:
    arm = Arm(Options(heartbeat=0.1))
    arm.carrier.goto("world", GOAL, None)
    arm.run(0.45)
    assert arm.speed > 0.1
    assert not arm.carrier.live.stopped
    arm.beats = False
    arm.run(1.2)
    level, sentence, _ = arm.carrier.state()
    assert level == 2
    assert "no heartbeat for 0.1 s" in sentence
    assert arm.speed < 1e-6
    assert arm.holds()
    # It latches: heartbeats that come again do not lift it.
    arm.beats = True
    arm.run(0.1)
    ok, why = arm.carrier.goto("world", GOAL, None)
    assert not ok
    assert "the arm was stopped by the monitor (no heartbeat for 0.1 s); call resume() first" in why
    assert arm.carrier.resume()[0]
    assert arm.carrier.goto("world", GOAL, None)[0]


def test_an_arm_at_rest_needs_no_heartbeat() -> None:
    arm = Arm(Options(heartbeat=0.1))
    arm.beats = arm.sees = False
    assert not arm.run(0.5).carrier.live.stopped


def test_joint_states_that_do_not_come_any_more_stop_the_arm() -> None:
    arm = Arm()
    arm.carrier.goto("world", GOAL, None)
    arm.run(0.4)
    arm.sees = False
    arm.run(0.3)
    assert "no joint states for 0.2 s" in arm.carrier.live.stopped


def test_a_node_that_dies_leaves_a_motion_that_ends_at_rest_with_the_load() -> None:
    arm = Arm()
    arm.carrier.goto("world", GOAL, None)
    arm.run(0.5)
    assert arm.speed > 0.1
    arm.steps = False
    arm.run(1.0)
    assert arm.speed == 0.0
    assert arm.holds()


def test_stop_latches_and_refuses_goals_and_twists() -> None:
    arm = Arm()
    arm.carrier.goto("world", GOAL, None)
    arm.run(0.5)
    assert arm.carrier.stop("by the service stop")[0]
    assert not arm.carrier.goto("world", GOAL, None)[0]
    assert "call resume() first" in arm.carrier.twist("world", arm.t, (0.1, 0, 0), (0, 0, 0), arm.t)
    arm.run(1.2)
    assert arm.speed < 1e-6
    assert arm.holds()


@pytest.mark.slow
def test_a_twist_is_followed_and_decays_when_it_is_not_repeated() -> None:
    arm = Arm()
    arm.asked = lambda: arm.carrier.twist("world", arm.t, (0.0, 0.1, 0.0), (0.0, 0.0, 0.0), arm.t)
    before = arm.p_SE
    arm.run(0.4)
    moved = arm.p_SE - before
    assert 0.02 < moved[1] < 0.04
    assert np.abs(moved[[0, 2]]).max() < 0.1 * moved[1]
    assert arm.speed > 0.01
    arm.asked = lambda: None
    arm.run(1.3)
    assert arm.speed < 1e-6
    assert arm.carrier.live.settled
    assert arm.holds()


@pytest.mark.parametrize(
    ("frame", "age", "v", "told"),
    [
        ("tool0", 0.0, (0.1, 0, 0), 'The twist is in the frame "tool0"; it must be in "world", the scenario\'s S.'),
        ("", 0.0, (0.1, 0, 0), 'The twist is in the frame ""; it must be in "world", the scenario\'s S.'),
        ("world", 0.3, (0.1, 0, 0), "The twist is 0.30 s old; it must be at most 0.1 s: set header.stamp."),
        ("world", np.nan, (0.1, 0, 0), "The twist is nan s old; it must be at most 0.1 s: set header.stamp."),
        ("world", 0.0, (np.nan, 0, 0), "The twist is refused: v has values that are not finite."),
        ("world", 0.0, (100.0, 0, 0), "The twist is refused: v is 100; it must be at most 5 m/s."),
    ],
)
def test_a_wrong_twist_is_refused_in_a_sentence(resting: Carrier, frame: str, age: float, v: Any, told: str) -> None:
    assert resting.twist(frame, 100.0 - age, v, (0, 0, 0), 100.0) == told


@pytest.fixture(scope="module")
def resting() -> Carrier:
    return Arm().carrier


def test_a_wrong_goal_or_message_is_refused_in_a_sentence(resting: Carrier) -> None:
    assert resting.goto("base", GOAL, None)[1].startswith('The goal is in the frame "base"')
    assert resting.goto("world", GOAL, (0, 0, 0, 0))[1] == "The goal's quaternion has the length 0; it must be 1."
    assert "leans the tray by 90 deg" in resting.goto("world", GOAL, (np.sqrt(0.5), 0, 0, np.sqrt(0.5)))[1]
    assert resting.goto_posture(["a"], [0.0]) == (False, "There is no joint panda_joint1; the message has a.")
    names = list(resting.joints)
    assert "7 joints and 1 values" in resting.measured(names, [0.0], 0.0)
    assert resting.measured(names, [np.nan] * 7, 0.0) == "panda_joint1 is not finite; positions must be numbers."
    assert ordered(names[::-1], range(7), names).tolist() == [6, 5, 4, 3, 2, 1, 0]


def test_it_starts_only_at_rest_and_where_the_load_is_safe(resting: Carrier) -> None:
    q = resting.command
    with pytest.raises(ScenarioError, match=r"panda_joint2 moves at 0\.200 rad/s"):
        Carrier(SCENARIO, resting.joints, q, [0.0, 0.2, *[0.0] * 5])
    with pytest.raises(ScenarioError, match="not safe at rest"):
        Carrier(SCENARIO, resting.joints, q + np.eye(7)[5])
    with pytest.raises(ScenarioError, match="has no arm"):
        Carrier("prisma-cube", resting.joints, q)


@pytest.mark.slow
def test_a_node_that_was_late_hands_nothing_over_until_it_is_resumed() -> None:
    """The controller went on along what it had; a motion that begins before now would make the arm jump."""
    arm = Arm()
    arm.carrier.goto("world", GOAL, None)
    arm.run(0.4)
    assert arm.speed > 0.1
    arm.carrier.goto("world", NEARER, None)
    arm.carrier.live.plan()  # another motion is ready, to be handed over in 0.1 s
    had = arm.motion
    arm.steps = False
    arm.run(0.3)
    arm.steps = True
    arm.run(0.03)
    assert arm.carrier.resume() == (False, "The arm still moves.")
    arm.run(1.5)
    assert arm.motion is had
    assert "the node was 0.31 s late" in arm.carrier.live.stopped
    assert arm.speed == 0.0
    assert arm.holds()
    assert arm.carrier.resume() == (True, "Accepted.")
    assert np.abs(arm.carrier.command - arm.q).max() < 1e-9  # it goes on from where the arm is
    assert arm.carrier.goto("world", NEARER, None)[0]
    arm.run(1.5)
    assert arm.motion is not had
    assert arm.carrier.state()[0] == 0


def test_a_controller_that_refuses_stops_the_arm() -> None:
    arm = Arm()
    arm.carrier.goto("world", GOAL, None)
    arm.run(0.4)
    arm.carrier.lost("the controller refuses the motion")
    had = arm.motion
    assert "the controller refuses the motion" in arm.run(0.5).carrier.live.stopped
    assert arm.motion is had


@pytest.fixture
def ready(safe: Any) -> Arm:
    """At the start of a plan that has stops, of which its run directory is named."""
    return Arm(Options(heartbeat=0.1), safe.plan.scenario).run(0.05)


def test_a_plan_is_carried_out_as_it_is_and_the_arm_goes_on_from_its_end(ready: Arm, safe: Any) -> None:
    ok, told = ready.carrier.run(str(safe.folder), ready.t)
    assert ok, told
    assert ready.carrier.goto("world", GOAL, None) == (False, "A plan is carried out; stop, or wait for its end.")
    assert not ready.carrier.run(str(safe.folder), ready.t)[0]
    begins = ready.t + ready.carrier.options.ahead
    ready.run(safe.plan.duration + 0.2)
    t = np.array(ready.times) - begins
    wanted = safe.plan.joint.sample(np.clip(t, 0.0, None))[0]
    assert np.abs(np.array(ready.path) - wanted).max() < 1e-5
    assert ready.holds()
    assert ready.carrier.state()[0] == 0
    assert ready.carrier.goto("world", NEARER, None)[0]
    ready.run(1.0)
    assert np.abs(ready.q - safe.plan.joint.q[-1]).max() > 0.05
    assert not ready.carrier.live.stopped


@pytest.mark.slow
@pytest.mark.parametrize("after", [0.3, 0.75, 1.1])
def test_a_plan_is_stopped_by_its_own_stops(ready: Arm, safe: Any, after: float) -> None:
    assert ready.carrier.run(str(safe.folder), ready.t)[0]
    begins = ready.t + ready.carrier.options.ahead
    ready.run(after)
    ready.beats = False
    while not ready.carrier.live.stopped:
        ready.run(PERIOD)
    assert "no heartbeat for 0.1 s" in ready.carrier.live.stopped
    asked = ready.t - begins
    assert asked == pytest.approx(after + 0.1 - ready.carrier.options.ahead, abs=1.1 * PERIOD)
    assert ready.carrier.resume() == (False, "The arm still moves.")
    ready.run(1.5)
    wanted = safe.plan.stops.stopped(safe.plan.joint, asked + ready.carrier.options.ahead)
    assert wanted.duration < safe.plan.duration or after > 1.0  # in its last moments finishing it is soonest
    t = np.array(ready.times) - begins
    assert np.abs(np.array(ready.path) - wanted.sample(np.clip(t, 0.0, None))[0]).max() < 1e-5
    assert ready.speed == 0.0
    assert not ready.carrier.goto("world", GOAL, None)[0]
    assert ready.carrier.resume() == (True, "Accepted.")
    assert ready.carrier.goto("world", GOAL, None)[0]


def test_a_plan_that_is_stopped_before_it_begins_does_not_begin(ready: Arm, safe: Any) -> None:
    q = ready.q
    assert ready.carrier.run(str(safe.folder), ready.t)[0]
    ready.run(PERIOD)
    assert ready.motion is not None  # the controller has it
    ready.carrier.stop()
    ready.run(0.5)
    assert np.abs(ready.q - q).max() < 1e-6
    assert ready.carrier.resume()[0]


@pytest.mark.slow
def test_a_plan_that_cannot_be_carried_out_is_refused_in_a_sentence(ready: Arm, safe: Any, tmp_path: Path) -> None:
    carrier = ready.carrier
    assert "is not a run directory" in carrier.run(str(tmp_path), 0.0)[1]
    here = carrier.scenario
    box = {"type": "box", "name": "far", "size": [0.1, 0.1, 0.1], "position": [3.0, 0.0, 0.5]}
    cases = (
        (sv.load_scenario("prisma-cube"), "was planned for other values of arm, "),
        (here.with_changes(motion__duration=0.5), "is not carried out: UNSAFE: "),
        (here.with_changes(surroundings__floor=-0.3), "was planned for other values of surroundings; start with "),
        (here.with_changes(obstacles=[box]), "was planned for other values of obstacles; start with "),
    )
    for k, (case, told) in enumerate(cases):
        directory = make_plan(case, "baseline").save(tmp_path / str(k))
        assert told in carrier.run(str(directory), 0.0)[1]
    carrier.measured(carrier.joints, ready.q + 0.02 * np.eye(7)[1], ready.t)
    assert carrier.run(str(safe.folder), ready.t)[1].startswith(
        "panda_joint2 is at 1.060 rad; the plan begins at 1.040"
    )
    carrier.measured(carrier.joints, ready.q, ready.t)
    carrier.stop("by hand")
    assert carrier.run(str(safe.folder), ready.t)[1].startswith("Stopped by the operator: by hand")


def test_an_arm_that_leaves_its_plan_is_stopped(ready: Arm, safe: Any) -> None:
    assert ready.carrier.run(str(safe.folder), ready.t)[0]
    ready.run(1.0)
    ready.carrier.measured(ready.carrier.joints, ready.q + 0.06 * np.eye(7)[3], ready.t)
    assert "panda_joint4 is 0.060 rad from where the plan has it" in ready.carrier.live.stopped


def test_points_within_a_nanosecond_are_sent_as_one_which_is_the_last() -> None:
    """Controllers refuse points at one time, and a last point that moves."""
    t = np.array([0.0, 0.5, 1.0 - 2e-10, 1.0])
    q = np.arange(4.0)[:, None]
    found = sent(of_motion(("a",), JointMotion(t, q, q, q), 0.0))
    assert found.t.tolist() == [0.0, 0.5, 1.0]
    assert found.q.ravel().tolist() == [0.0, 1.0, 3.0]


def test_a_trajectory_is_the_same_after_the_wire() -> None:
    q = np.random.default_rng(0).normal(size=(3, 4, 2))
    motion = Trajectory(("a", "b"), 1.5, np.array([0.0, 0.25, 1.0, 2.999999999]), *q)
    found = sent(motion)
    assert (found.names, found.begins) == (motion.names, motion.begins)
    for name in ("t", "q", "dq", "ddq"):
        assert np.array_equal(getattr(found, name), getattr(motion, name)), name


def test_a_message_that_is_no_trajectory_is_refused_in_a_sentence() -> None:
    kind = "trajectory_msgs/msg/JointTrajectory"
    with pytest.raises(ValueError, match="has 0 points"):
        messages.trajectory_of(filled(kind, joint_names=["a"]))
    with pytest.raises(ValueError, match="positions must be 2 numbers in each point"):
        messages.trajectory_of(filled(kind, joint_names=["a", "b"], points=[{"positions": [1.0]}] * 2))


@pytest.fixture(scope="module")
def planned() -> tuple[Carrier, Trajectory]:
    """As a planning request of MoveIt: from a posture to a posture, upright."""
    arm = Arm()
    goal = arm.q + np.array([0.5, 0, 0, 0, 0, 0, 0])
    ok, told, motion = plan(arm.carrier.scenario, arm.q, goal, True, 0.0, 5.0)
    assert ok, told
    assert motion is not None
    assert np.abs(motion.q[0] - arm.q).max() < 1e-9
    assert np.abs(motion.q[-1] - goal).max() < 1e-9
    leans = [arm.arm.tray_pose(q)[1][2, 2] for q in motion.q[::10]]
    assert np.arccos(min(1.0, *leans)) < 0.02
    return arm.carrier, motion


@pytest.mark.slow
def test_a_planned_motion_is_audited_and_one_that_is_twice_as_fast_is_not_safe(planned: Any) -> None:
    carrier, motion = planned
    assert audit(carrier.scenario, sent(motion))[0]
    hasty = Trajectory(motion.names, 0.0, motion.t / 2, motion.q, 2 * motion.dq, 4 * motion.ddq)
    ok, told = audit(carrier.scenario, hasty)
    assert not ok
    assert "slide" in told


@pytest.mark.slow
def test_a_gentle_motion_is_slower(planned: Any) -> None:
    carrier, motion = planned
    ok, told, gentle = plan(carrier.scenario, motion.q[0], motion.q[-1], True, 0.3, 5.0)
    assert ok, told
    assert np.abs(gentle.dq).max() < 0.3 * 2.61  # rad/s, the largest of the arm's limits
    assert gentle.t[-1] > 1.5 * motion.t[-1]


def test_what_cannot_be_planned_or_audited_is_told_in_a_sentence(planned: Any) -> None:
    carrier, motion = planned
    far = motion.q[0] + np.array([0, 0, 0, 0, 0, 1.0, 0])  # the tray would lean by 1 rad
    ok, told, nothing = plan(carrier.scenario, motion.q[0], far, False, 1.0, 5.0)
    assert not ok
    assert nothing is None
    assert told.endswith(".")
    ok, told = audit(
        carrier.scenario, Trajectory(tuple("abcdefg"), *[getattr(motion, x) for x in ("begins", "t", "q", "dq", "ddq")])
    )
    assert not ok
    assert "no joint panda_joint1" in told


def test_the_simulated_arm_stands_at_the_start_in_the_world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = sv.load_scenario("ur10-beaker")
    monkeypatch.setattr(sys, "argv", ["mock", "ur10-beaker", str(tmp_path / "new")])
    assert mock.main() == 0
    robot = ElementTree.fromstring((tmp_path / "new" / "robot.urdf").read_text())
    given = {
        joint.get("name"): float(joint.findtext(".//param")) for joint in robot.find("ros2_control").findall("joint")
    }
    live = sv.Live(scenario)
    assert given == dict(zip(live.problem.arm.joint_names, live.command(0.0)[0], strict=True))
    q = np.array(list(given.values()))
    elsewhere = scenario.with_changes(
        arm__base_position=(0.3, -0.2, 0.1), arm__base_rpy_deg=(35.0, -70.0, 40.0), surroundings__floor="none"
    )
    arm = load_arm(elsewhere.arm, scenario.tray)
    model = pin.buildModelFromXML(mock.robot_description(arm, q))
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    flange = data.oMf[model.getFrameId(arm.flange)]
    p_SE, R_SE = arm.tray_pose(q)
    assert np.abs(flange.act(arm.p_FE) - p_SE).max() < 1e-6
    assert np.abs(flange.rotation - R_SE).max() < 1e-6
    parameters = YAML(typ="safe").load((tmp_path / "new" / "controllers.yaml").read_text())
    for name in (mock.TRAJECTORIES, mock.POSITIONS):
        assert parameters[name]["ros__parameters"]["joints"] == list(arm.joint_names)
    monkeypatch.setattr(sys, "argv", ["mock", "no-such", str(tmp_path)])
    assert mock.main() == 1


def test_markers_are_the_tray_and_the_load_on_the_flange(resting: Carrier) -> None:
    found = filled("visualization_msgs/msg/MarkerArray", **messages.marker_messages(resting.markers(), "panda_link8"))
    tray, cube = ([[p.x, p.y, p.z] for p in one.points] for one in found.markers)
    assert np.ptp(tray, axis=0) == pytest.approx([0.2, 0.2, 0.01])
    assert np.max(tray, axis=0)[2] == pytest.approx(0.05)  # the tray's surface over the flange
    assert np.ptp(cube, axis=0) == pytest.approx([0.04, 0.04, 0.04])
    assert np.min(cube, axis=0)[2] == pytest.approx(0.05)


def test_markers_stand_on_a_tray_that_is_mounted_sideways(resting: Carrier) -> None:
    scenario = resting.scenario.with_changes(tray__offset=(0.1, 0.0), tray__rpy_deg=(0.0, 90.0, 0.0))
    arm = load_arm(scenario.arm, scenario.tray)
    held = SimpleNamespace(live=SimpleNamespace(problem=SimpleNamespace(arm=arm)), scenario=scenario)
    tray, cube = (one["points"] for one in Carrier.markers(held))
    up = arm.R_FE[:, 2]  # out of the tray's surface
    assert ((cube - arm.p_FE) @ up).min() == pytest.approx(0.0, abs=1e-9)
    assert ((tray - arm.p_FE) @ up).max() == pytest.approx(0.0, abs=1e-9)


# --- the node, which there is no rclpy to run


class StandIn:
    """As much of rclpy.node.Node as the node uses."""

    given: dict[str, Any] = {}  # noqa: RUF012

    def __init__(self, name: str) -> None:
        self.by_topic: dict[str, Any] = {}
        self.published: dict[str, list[Any]] = {}
        self.periods: list[Any] = []
        self.told: list[str] = []
        self.t = START

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.given.get(name, default))

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)

    def create_subscription(self, kind: Any, topic: str, heard: Any, depth: int, callback_group: Any) -> None:
        self.by_topic[topic] = lambda **values: heard(kind(**values))

    def create_service(self, kind: Any, name: str, serve: Any, callback_group: Any) -> None:
        self.by_topic[name] = lambda **values: serve(kind.Request(**values), kind.Response())

    def create_timer(self, period: float, called: Any, callback_group: Any) -> None:
        self.periods.append(called)

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=round(self.t * 1e9)))

    def get_logger(self) -> Any:
        note = lambda text, **_: self.told.append(text)  # noqa: E731
        return SimpleNamespace(info=note, warning=note)


class Future:
    """One that is done."""

    def __init__(self, found: Any) -> None:
        self.result = lambda: found

    def add_done_callback(self, called: Any) -> None:
        called(self)


class Client:
    """An action client whose server accepts, and has not come to an end."""

    goals: list[Any] = []  # noqa: RUF012
    accepted = True

    def __init__(self, node: Any, kind: Any, name: str, callback_group: Any) -> None:
        self.name = name
        self.goals.clear()

    def server_is_ready(self) -> bool:
        return True

    def send_goal_async(self, goal: Any) -> Future:
        self.goals.append(goal.trajectory)
        pending = SimpleNamespace(add_done_callback=lambda called: None)
        return Future(SimpleNamespace(accepted=self.accepted, get_result_async=lambda: pending))


def set_message_fields(message: Any, values: dict[str, Any]) -> None:
    for name, value in vars(filled(message.__msgtype__, **values)).items():
        setattr(message, name, value)


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The module, imported beside stand-ins for what it imports of ROS."""

    def message(kind: str) -> Any:
        return lambda **values: filled(kind, **values)

    def service(name: str) -> Any:
        return SimpleNamespace(
            Request=message(f"salver_msgs/msg/{name}_Request"), Response=message(f"salver_msgs/msg/{name}_Response")
        )

    def module(name: str, **members: Any) -> None:
        found = ModuleType(name)
        vars(found).update(members)
        monkeypatch.setitem(sys.modules, name, found)

    class Shutdown(Exception):
        pass

    module("rclpy")
    module("rclpy.action", ActionClient=Client)
    module("rclpy.callback_groups", MutuallyExclusiveCallbackGroup=object, ReentrantCallbackGroup=object)
    module("rclpy.executors", ExternalShutdownException=Shutdown, MultiThreadedExecutor=object)
    module("rclpy.node", Node=StandIn)
    module("rclpy.qos", DurabilityPolicy=SimpleNamespace(TRANSIENT_LOCAL=1), QoSProfile=lambda **_: None)
    module("rosidl_runtime_py", set_message_fields=set_message_fields)
    module("control_msgs.action", FollowJointTrajectory=SimpleNamespace(Goal=SimpleNamespace))
    module("salver_msgs.srv", **{name: service(name) for name in ("Audit", "Goto", "Plan", "Run")})
    plain = SimpleNamespace(Request=SimpleNamespace, Response=SimpleNamespace)
    module("std_srvs.srv", Trigger=plain)
    for kind in (
        "diagnostic_msgs/DiagnosticStatus", "geometry_msgs/TwistStamped", "sensor_msgs/JointState", "std_msgs/Empty",
        "std_msgs/Float64MultiArray", "trajectory_msgs/JointTrajectory", "visualization_msgs/MarkerArray",
    ):  # fmt: skip
        package, name = kind.split("/")
        known = sys.modules.get(f"{package}.msg")
        module(f"{package}.msg", **(vars(known) if known else {}), **{name: message(f"{package}/msg/{name}")})
    monkeypatch.delitem(sys.modules, "salver_ros.node", raising=False)
    found = importlib.import_module("salver_ros.node")
    monkeypatch.setattr(found, "Worker", lambda live, stops: SimpleNamespace(start=lambda: None))
    monkeypatch.setattr(found, "ProcessPoolExecutor", lambda *_, **__: ThreadPoolExecutor(1))
    return found


def run(node: Any, seconds: float, q: Any) -> None:
    for k in range(round(seconds / PERIOD)):
        node.t += PERIOD
        node.by_topic["joint_states"](name=list(node.carrier.joints), position=q() if callable(q) else q)
        for period in node.periods:
            period()
        if k % EVERY == 0:
            node.carrier.live.plan()


@pytest.mark.parametrize("output", ["action", "topic", "position"])
def test_the_node_takes_a_goal_and_commands_the_controller(
    node: ModuleType, monkeypatch: pytest.MonkeyPatch, resting: Carrier, output: str
) -> None:
    monkeypatch.setattr(StandIn, "given", {"output": output, "controller": "arm"})
    found = node.Salver()
    assert not found.by_topic["~/stop"]().success  # before anything is known of the arm
    assert "waits for joint states" in found.by_topic["~/goto"]().message
    names, q = list(resting.joints), resting.command.tolist()
    found.by_topic["joint_states"](name=names, position=q)
    (markers,) = found.published["~/markers"]
    assert [one.ns for one in markers.markers] == ["tray", "cube"]
    pose = {"header": {"frame_id": "world"}, "pose": {"position": dict(zip("xyz", GOAL, strict=True))}}
    told = found.by_topic["~/goto"](pose=pose, any_heading=True)
    assert (told.success, told.message) == (True, "Accepted.")
    run(found, 0.5, lambda: found.carrier.command)
    if output == "position":
        sent = [one.data for one in found.published["arm/commands"]]
        assert np.array_equal(sent[-1], found.carrier.command)
        assert np.abs(sent[-1] - q).max() > 0.1
    else:
        got = Client.goals if output == "action" else found.published["arm/joint_trajectory"]
        motion = messages.trajectory_of(got[-1])
        now = JointMotion(motion.t, motion.q, motion.dq, motion.ddq).sample(found.t - motion.begins)[0][0]
        assert np.abs(now - found.carrier.command).max() < 1e-6
    found.by_topic["~/twist"](header={"frame_id": "tool0"}, twist={"linear": {"x": 0.1}})
    assert found.told[-1].startswith('The twist is in the frame "tool0"')
    assert found.by_topic["~/stop"]().success
    run(found, 1.0, lambda: found.carrier.command)
    state = found.published["~/state"][-1]
    assert bytes([2]) == state.level
    assert "by the service stop" in state.message
    assert found.by_topic["~/resume"]().success
    found.close()


@pytest.mark.slow
def test_the_node_stops_when_its_controller_refuses(
    node: ModuleType, monkeypatch: pytest.MonkeyPatch, resting: Carrier
) -> None:
    monkeypatch.setattr(Client, "accepted", False)
    found = node.Salver()
    found.by_topic["joint_states"](name=list(resting.joints), position=resting.command)
    found.by_topic["~/goto"](posture={"name": list(resting.joints), "position": resting.command + 0.1 * np.eye(7)[0]})
    run(found, 0.5, resting.command)
    assert "the controller refuses the motion" in found.carrier.live.stopped
    assert len(Client.goals) == 1


@pytest.mark.slow
def test_the_node_plans_and_audits(node: ModuleType, resting: Carrier) -> None:
    found = node.Salver()
    names, q = list(resting.joints), resting.command
    found.by_topic["joint_states"](name=names, position=q)
    planned = found.by_topic["~/plan"](goal={"name": names[::-1], "position": (q + 0.3 * np.eye(7)[0])[::-1]})
    assert planned.success, planned.message
    assert planned.trajectory.points[-1].positions == pytest.approx(q + 0.3 * np.eye(7)[0])
    again = messages.trajectory_message(messages.trajectory_of(planned.trajectory))
    assert found.by_topic["~/audit"](trajectory=again).success
    assert found.by_topic["~/audit"]().message == "The trajectory has 0 points; it must have two or more."
    assert found.by_topic["~/plan"](goal={"name": ["a"], "position": [0.0]}).message.startswith("There is no joint")


def test_parameters_that_cannot_be_are_told(node: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    for given in ({"output": "effort"}, {"rate": 10.0}):
        monkeypatch.setattr(StandIn, "given", given)
        with pytest.raises(SalverError, match=f"{next(iter(given))} is"):
            node.Salver()


def test_the_launch_file_names_parameters_and_files_that_there_are() -> None:
    """All that can be said of it here."""
    launch = (ROS2 / "salver_ros" / "launch" / "carry.launch.py").read_text()
    ast.parse(launch)
    given = set(re.findall(r'"(\w+)": (?:given|controller|float)', launch))
    source = (ROS2 / "salver_ros" / "salver_ros" / "node.py").read_text()
    assert given == {"scenario", "output", "controller", "heartbeat"}
    assert given - {field.name for field in fields(Options)} <= set(re.findall(r'value\("(\w+)"', source))
    package = ElementTree.parse(ROS2 / "salver_ros" / "package.xml")
    needed = {element.text for element in package.iter("exec_depend")}
    imported = set(re.findall(r"^(?:from|import) (\w+)", source + launch, re.M))
    own = {"salver", "salver_ros", *sys.stdlib_module_names, "launch"}
    assert imported - own <= needed
