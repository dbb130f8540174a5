"""Before the arm moves and after: checks that are demanded first, and the log that is kept of a run."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from driver_rig import CASE, Rig
from pylibfranka_stand_in import Library
from salver import scenario
from salver.driver import execute, logs
from salver.driver.execution import ExecutionLog, Watchdog
from salver.driver.logs import arrays_of, check_place, keep
from salver.driver.preflight import Check
from salver.driver.robots.franka import FrankaRobot
from salver.errors import SalverError
from salver.files import load_npz, read_json
from salver.geometry import Array
from salver.models.arm.arm import load_arm
from salver.planning.make import make_plan


@pytest.mark.slow
def test_checks_are_demanded_before_the_arm_is_connected(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the plan, and of what a Franka asks for: neither may be found out with the arm already in hand."""
    library = Library(rig.plan)
    monkeypatch.setitem(sys.modules, "pylibfranka", library)
    for where, name in ((execute, "check_plan"), (FrankaRobot, "check")):
        with monkeypatch.context() as patched:
            patched.setattr(where, name, lambda *args: [Check("x", False, "It is not fit.")])
            with pytest.raises(SalverError, match=r"Not moved\. It is not fit\."):
                execute.run_plan(rig.folder, "franka", "arm")
    assert library.calls == []


@pytest.mark.slow
def test_a_way_to_the_start_that_is_not_fit_is_not_gone(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pylibfranka", Library(rig.plan))
    monkeypatch.setattr(execute, "check_approach", lambda *args: [Check("x", False, "A wall is in between.")])
    with pytest.raises(SalverError, match=r"Not moved\. A wall is in between\."):
        execute.run_plan(
            rig.folder, "franka", "arm", move_to_start=True, confirm=lambda _: pytest.fail("it was asked for")
        )


def test_where_no_log_can_be_written_nothing_moves(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "execution").write_text("in the way")
    assert "cannot be written" in check_place(tmp_path).sentence
    assert check_place(rig.folder).ok
    monkeypatch.setattr(logs, "ROOM", 1e30)
    with pytest.raises(SalverError, match=r"Not moved\. .* MB left for the log"):
        execute.run_plan(rig.folder, realtime=False)


@pytest.mark.slow
def test_a_second_run_keeps_the_first_ones_log(rig: Rig, tmp_path: Path) -> None:
    make_plan(CASE).save(tmp_path)
    first = execute.run_plan(tmp_path, realtime=False)
    kept = load_npz(first.path)
    second = execute.run_plan(tmp_path, watchdog=Watchdog(joint_error=1e-5), realtime=False)
    assert second.path == tmp_path / "execution" / "plan.npz"
    assert second.summary["stopped"]
    again = load_npz(tmp_path / "execution" / "plan-1.npz")
    assert all(np.array_equal(kept[name], again[name], equal_nan=kept[name].dtype.kind == "f") for name in kept)
    assert read_json(tmp_path / "execution" / "plan-1.json")["stopped"] == ""
    for _ in range(3):
        assert keep(tmp_path, "plan", {"t": np.zeros(2)}, {"n": 1}).name == "plan.npz"


def test_errors_of_the_tray_are_those_of_a_turned_frame(tmp_path: Path) -> None:
    """Joint 7 of a level tray turns it about the vertical: its error is that very angle, wherever the tray looks."""
    case = scenario.load("panda-cube-yaw").with_changes(motion__nodes=21)
    plan = make_plan(case)
    arm = load_arm(case.arm, case.tray)  # type: ignore[arg-type]
    joint = plan.joint
    assert joint is not None
    t = np.linspace(0, joint.duration, 301)
    q, dq, _ = joint.sample(t)
    turned = np.array([arm.tray_pose(posture)[1] for posture in q])
    assert np.abs(np.arctan2(turned[:, 1, 0], turned[:, 0, 0])).max() > 0.3
    log_ = _log_of(t, q, dq)
    robot: Any = SimpleNamespace(period=1e-3, takes="torque")
    faithful = arrays_of(arm, log_, robot)
    assert faithful["tray_e_o"].max() < 1e-6
    assert faithful["tray_e_p"].max() < 1e-6
    away = q.copy()
    away[:, 6] += 0.02
    assert arrays_of(arm, replace(log_, q=away), robot)["tray_e_o"] == pytest.approx(0.02, abs=1e-6)


def _log_of(t: Array, q: Array, dq: Array) -> Any:
    none = np.zeros(len(t))
    return ExecutionLog(t, q, dq, 0 * q, q, none, none, none, none.astype(bool))
