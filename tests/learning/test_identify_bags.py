"""Logs of loads in ROS bags: a JointState with efforts and a WrenchStamped, each with times and order of its own."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import salver as sv
from salver.errors import FileFormatError
from salver.learning import Log, read_log
from salver.models.arm.arm import load_arm
from salver.planning.plan import Plan
from sensed_arm import SensedArm, Sensors, nominal_load

STORE = get_typestore(Stores.ROS2_HUMBLE)
JOINTS, WRENCH = "sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped"
BEGIN = 1_700_000_000  # s, of a clock that counts from 1970


@pytest.fixture(scope="module")
def plan() -> Plan:
    return sv.plan("panda-cube")


@pytest.fixture(scope="module")
def log(plan: Plan) -> Log:
    assert plan.joint is not None
    t = np.arange(0.0, plan.duration + 0.0025, 0.005)  # a bag has no time before its own beginning
    return SensedArm(plan, 1, Sensors(times=0.0)).log(nominal_load(plan), "log", (t, *plan.joint.sample(t)[:3]))


@pytest.fixture(scope="module")
def names(plan: Plan) -> tuple[str, ...]:
    assert plan.scenario.arm is not None
    return tuple(load_arm(plan.scenario.arm, plan.scenario.tray).joint_names)


def header(t: float) -> object:
    sec = int(np.floor(t))
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=BEGIN + sec, nanosec=int(1e9 * (t - sec)))
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id="")


def bag(path: Path, log: Log, names: tuple[str, ...], topics: tuple[str, ...] = ("/joint_states",), late: float = 0.0):
    """The joints backwards with a finger, and a wrist that is read at other times, `late` s later."""
    vector, total = STORE.types["geometry_msgs/msg/Vector3"], (*names[::-1], "finger")
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic in topics:
            to = writer.add_connection(topic, JOINTS, typestore=STORE)
            for k, t in enumerate(log.t):
                effort = np.zeros(0) if log.tau is None else np.append(log.tau[k, ::-1], 0.0)
                q = np.append(log.q[k, ::-1], 0.01)
                message = STORE.types[JOINTS](
                    header=header(t), name=list(total), position=q, velocity=np.zeros(0), effort=effort
                )
                writer.write(to, int(1e9 * t), STORE.serialize_cdr(message, JOINTS))
        if log.wrench_F is not None:
            to = writer.add_connection("/wrench", WRENCH, typestore=STORE)
            for t in np.arange(-0.0013, log.t[-1] + 0.004, 0.002):
                felt = [np.interp(t, log.t, column) for column in log.wrench_F.T]
                both = STORE.types["geometry_msgs/msg/Wrench"](force=vector(*felt[:3]), torque=vector(*felt[3:]))
                message = STORE.types[WRENCH](header=header(t + late), wrench=both)
                writer.write(to, int(1e9 * (t + 0.01)), STORE.serialize_cdr(message, WRENCH))
    return path


def test_a_bag_says_what_was_logged(tmp_path: Path, log: Log, names: tuple[str, ...]) -> None:
    """Of the wrist to what bends between two samples."""
    read = read_log(bag(tmp_path / "log", log, names), 7, names)
    assert read.t == pytest.approx(log.t, abs=1e-6)
    assert read.q == pytest.approx(log.q, abs=1e-12)
    assert read.tau == pytest.approx(log.tau, abs=1e-12)
    assert log.wrench_F is not None
    assert read.wrench_F is not None
    bend = np.abs(np.diff(log.wrench_F, 2, axis=0)).max()
    assert read.wrench_F[1:-1] == pytest.approx(log.wrench_F[1:-1], abs=bend)
    assert bend < 0.01 * np.ptp(log.wrench_F, axis=0).max()


def test_a_bag_without_a_wrist_has_torques_only(tmp_path: Path, log: Log, names: tuple[str, ...]) -> None:
    read = read_log(bag(tmp_path / "log", replace(log, wrench_F=None), names), 7, names)
    assert read.wrench_F is None
    assert read.tau is not None


@pytest.mark.slow
def test_bags_that_do_not_weigh_are_refused(tmp_path: Path, log: Log, names: tuple[str, ...]) -> None:
    nothing = replace(log, tau=None, wrench_F=None)
    with pytest.raises(FileFormatError, match="the load cannot be weighed"):
        read_log(bag(tmp_path / "still", nothing, names), 7, names)
    with pytest.raises(FileFormatError, match=r"2 logs of the joints .*; name one with --topic"):
        read_log(bag(tmp_path / "two", log, names, ("/a", "/b")), 7, names)
    assert read_log(tmp_path / "two", 7, names, "/b").q == pytest.approx(log.q)
    with pytest.raises(FileFormatError, match="0 logs of the joints"):
        read_log(tmp_path / "two", 7, names, "/c")
    with pytest.raises(FileFormatError, match=r"the joints were logged up to .* s away from its nearest sample"):
        read_log(bag(tmp_path / "late", log, names, late=0.5), 7, names)
    with pytest.raises(FileFormatError, match="has no joint panda_joint1"):
        read_log(bag(tmp_path / "names", log, tuple(f"j{k}" for k in range(7))), 7, names)
    with pytest.raises(FileFormatError, match="does not exist"):
        read_log(tmp_path / "none.mcap", 7, names)
