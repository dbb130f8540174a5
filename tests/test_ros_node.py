"""examples/ros2/carry.py, all of it but the node: rclpy is not on PyPI, so the node has never been run."""

import ast
import importlib.util
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from salver.export import write_export
from salver.planning.make import make_plan
from salver.scenario import load

CARRY = Path(__file__).parents[1] / "examples" / "ros2" / "carry.py"


@pytest.fixture(scope="module")
def carry() -> ModuleType:
    spec = importlib.util.spec_from_file_location("carry", CARRY)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory, with its motion as messages in YAML and as a bag beside it."""
    out = tmp_path_factory.mktemp("run")
    make_plan(load("panda-cube"), "baseline").save(out, "plan")
    write_export(out, "yaml", out / "motion.yaml", rate=50.0)
    write_export(out, "ros2", out / "bag", rate=50.0)
    return out


@pytest.mark.slow
def test_the_goal_is_the_message_of_the_bag_without_efforts(carry: ModuleType, folder: Path) -> None:
    """To the last byte, in the message types of ROS 2 Jazzy."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    kind = "trajectory_msgs/msg/JointTrajectory"
    with AnyReader([folder / "bag"]) as reader:
        (bagged,) = (reader.deserialize(raw, kind) for c, _, raw in reader.messages() if c.msgtype == kind)

    def point(time_from_start: object, **rows: list[float]) -> object:
        arrays = {name: np.array(row) for name, row in rows.items()}
        return store.types[f"{kind}Point"](time_from_start=time_from_start, effort=np.empty(0), **arrays)

    types = SimpleNamespace(  # those of rclpy take lists, and have defaults for what is not given
        Duration=store.types["builtin_interfaces/msg/Duration"],
        JointTrajectoryPoint=point,
        JointTrajectory=partial(store.types[kind], header=bagged.header),
    )
    goal = carry.trajectory(carry.read_motion(str(folder / "motion.yaml")), types)
    expected = replace(bagged, points=[replace(point, effort=np.empty(0)) for point in bagged.points])
    assert bytes(store.serialize_cdr(goal, kind)) == bytes(store.serialize_cdr(expected, kind))


def test_it_begins_only_where_the_motion_does_and_at_rest(carry: ModuleType, folder: Path) -> None:
    motion = carry.read_motion(str(folder / "motion.yaml"))
    names, start = motion["joint_names"][::-1], np.array(motion["points"][0]["positions"])[::-1]
    still = np.zeros(len(names))
    assert carry.not_at_start(motion, names, start, still) == ""
    assert carry.not_at_start(motion, names, start, []) == ""  # who does not tell velocities
    for k, name in enumerate(names):
        there, moving = start.copy(), still.copy()
        there[k] += 0.02
        moving[k] = -0.02
        assert carry.not_at_start(motion, names, there, still).startswith(f"{name} is at {there[k]:.3f} rad")
        assert carry.not_at_start(motion, names, start, moving).startswith(f"{name} still moves")
        there[k] = np.nan
        assert carry.not_at_start(motion, names, there, still)
    assert "does not know" in carry.not_at_start(motion, names[1:], start[1:], still[1:])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("points: 3", "no joint trajectory"),
        ("{", "no joint trajectory"),
        ("!!python/object/apply:os.system [true]", "no joint trajectory"),
        ("{joint_names: [a], points: []}", "no motion"),
        (
            "{joint_names: [a], points: ["
            "{positions: [0], velocities: [0], time_from_start: {sec: 1, nanosec: 0}},"
            "{positions: [.nan], velocities: [0], time_from_start: {sec: 2, nanosec: 0}}]}",
            "no motion",
        ),
        (
            "{joint_names: [a], points: ["
            "{positions: [0], velocities: [0], time_from_start: {sec: 1, nanosec: 0}},"
            "{positions: [1], velocities: [0], time_from_start: {sec: 1, nanosec: 0}}]}",
            "no motion",
        ),
    ],
)
def test_what_is_no_motion_is_refused_in_a_sentence(carry: ModuleType, tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "motion.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=told):
        carry.read_motion(str(path))


def test_a_file_that_is_not_there_is_named(carry: ModuleType, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot be read: No such file"):
        carry.read_motion(str(tmp_path / "none.yaml"))


def test_launch_file_gives_every_parameter_that_the_node_declares() -> None:
    """All that can be said of it here."""
    declared = set(re.findall(r'declare_parameter\("(\w+)"', CARRY.read_text()))
    (given,) = re.findall(r"given = (\{.*\})", CARRY.with_name("carry.launch.py").read_text())
    assert set(ast.literal_eval(given)) == declared
