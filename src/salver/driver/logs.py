"""The log of a run on an arm."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.driver.execution import ExecutionLog, Watchdog, named, timing
from salver.driver.preflight import Check
from salver.errors import SalverError
from salver.files import provenance, save_result
from salver.geometry import log, quat_wxyz_from_matrix
from salver.run_directory import save_record

if TYPE_CHECKING:
    from salver.driver.robots.robots import Robot
    from salver.models.arm.arm import ArmModel
    from salver.planning.plan import Plan

FOLDER = "execution"
RECORD_RATE = 200.0  # samples per second kept in the log
ROOM = 100e6  # bytes that must be free before an arm moves


def check_place(directory: Path) -> Check:
    """Whether a log can be written there; called before anything moves."""
    folder = directory / FOLDER
    try:
        folder.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(4096))
        free = shutil.disk_usage(folder).free
    except OSError as error:
        return Check("log", False, f"The log cannot be written to {folder}: {error.strerror}.")
    return Check("log", free > ROOM, f"{folder} has {free / 1e6:.0f} MB left for the log; {ROOM / 1e6:.0f} are needed.")


def summary_of(plan: Plan, robot: Robot, log_: ExecutionLog, checks: list[Check], watchdog: Watchdog) -> dict[str, Any]:
    """The run in figures."""
    error = np.abs(log_.q - log_.q_wanted)
    return {
        "source": robot.source,
        "takes": robot.takes,
        "method": plan.method,
        "outcome": "stopped" if log_.stopped else "done",
        "stopped": log_.stopped,
        "load_kept_in_stop": log_.keeps_load,
        "timing": timing(log_, robot.period),
        "bridged": int(log_.bridged.sum()),
        "joint_error_peak": float(error.max()) if len(error) else 0.0,
        "saturation": dict(log_.saturation),
        "watchdog": asdict(watchdog),
        "checks": [asdict(check) for check in checks],
        "provenance": provenance(plan.scenario),
    }


def arrays_of(arm: ArmModel, log_: ExecutionLog, robot: Robot) -> dict[str, np.ndarray]:
    """Arrays of a run from its joints: the tray's motion, and its distance from that of the joints' references."""
    kept = np.arange(0, len(log_.t), max(1, round(1 / (RECORD_RATE * robot.period))))
    q = log_.q[kept]
    (p_SE, R_SE), (p_wanted, R_wanted) = (
        (np.array([p for p, _ in poses]).reshape(-1, 3), np.array([R for _, R in poses]).reshape(-1, 3, 3))
        for poses in ([arm.tray_pose(joints) for joints in each] for each in (q, log_.q_wanted[kept]))
    )
    return {
        "t": log_.t[kept],
        "q": q,
        "dq": log_.dq[kept],
        "tau" if robot.takes == "torque" else "command": log_.sent[kept],
        "bridged": log_.bridged[kept],
        "p_SE": p_SE,
        "quat_SE_wxyz": quat_wxyz_from_matrix(R_SE),
        "tray_e_p": np.linalg.norm(p_wanted - p_SE, axis=1),
        "tray_e_o": np.linalg.norm(log(np.swapaxes(R_SE, 1, 2) @ R_wanted), axis=1),
    }


def keep(directory: Path, stem: str, arrays: dict[str, np.ndarray], summary: dict[str, Any]) -> Path:
    """Write a log to DIRECTORY/execution/STEM.npz and .json; logs of earlier runs are kept, numbered.

    When that cannot be, it is written to a directory for temporary files, and the summary says why. Raises
    SalverError only when that fails too.
    """
    try:
        return save_record(directory, FOLDER, stem, arrays, summary)
    except BaseException as error:  # the log must be written whatever happens
        reason = named(error)
    place = Path(tempfile.mkdtemp(prefix="salver-log-")) / stem
    summary["log_elsewhere"] = f"The log could not be written to {directory / FOLDER} ({reason})."
    try:
        return save_result(place, arrays, summary)
    except BaseException as error:
        raise SalverError(f"{summary['log_elsewhere']} Nor could it be written to {place.parent} ({error}).") from None
