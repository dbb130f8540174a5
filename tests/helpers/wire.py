"""What is shared by all that drives a UR or an xArm over the wire: a plan, its controller, and events in a run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import ur_server
import xarm_server
from salver import scenario
from salver.driver.robots import ur, xarm
from salver.planning.make import make_plan
from salver.planning.stops import plan_stops, stop_problem

CALM = {"physics__settle_before": 0.05, "physics__settle_after": 0.1}
CASES = {
    "ur": scenario.load("ur5-bottle").with_changes(arm__model="ur5e", **CALM),
    "xarm": scenario.load("panda-cube").with_changes(
        arm__model="xarm7", arm__start_posture=None, motion__duration=1.25, motion__nodes=21, **CALM
    ),
}


def planned(robot: str, folder: Path) -> Path:
    """A plan of its case, with stops, in a run directory."""
    plan = make_plan(CASES[robot], "baseline")
    assert plan.joint is not None
    replace(plan, stops=plan_stops(stop_problem(plan), plan.joint, 0.2, plan.space)).save(folder)
    return folder


def controller(robot: str, **options: Any) -> Any:
    """options: those of the servers' `Controller`."""
    if robot == "ur":
        return ur_server.Controller(**options)
    return xarm_server.Controller(**{"model": "xarm7"} | options)


def ports(robot: str, made: Any) -> list[tuple[Any, str, int]]:
    """Where the adapter has the controller's ports: owner, name and the port that it has here."""
    if robot == "ur":
        return [(ur, "RTDE_PORT", made.ports[0]), (ur, "SCRIPT_PORT", made.ports[1])]
    from xarm.core.config.x_config import XCONF

    names = ((XCONF.SocketConf, "TCP_CONTROL_PORT"), (xarm, "REPORTS"), (xarm, "SETTINGS"))
    return [(*name, port) for name, port in zip(names, made.ports, strict=True)]


def asked_at(step: int, what: Callable[[Any], Any]) -> Callable[[Any], None]:
    """Once, in a period of a controller after so many commands."""
    seen: list[int] = []

    def each(robot: Any) -> None:
        if len(robot.commands) > step and not seen:
            seen.append(1)
            what(robot)

    return each


def until(condition: Callable[[], Any]) -> None:
    """Wait for what the controller does in its own time, however long that takes on a busy machine."""
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(1e-3)
