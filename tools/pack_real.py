"""Packs measurements of other laboratories into docs/data/real, which `python benchmarks/reality.py` reads.

    python tools/pack_real.py FOLDER

FOLDER holds slosh/measured, slosh/joint, slosh/tray, slosh/comau, slosh/force, slosh/four-cups and slip, copied from
the repositories that docs/data/real/SOURCES.txt names. Commanded motions are kept at 100 of their 500 samples a second:
peaks of predicted waves change by less than 0.02 %.
"""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from scipy.io import loadmat

KEPT = Path(__file__).parents[1] / "docs" / "data" / "real"
FINE = 1e8  # integers for each rad or m
EVERY = 5  # of the commanded samples
CUPS_CSV, CUPS_MAT = (
    f"{folder}/TO_arc_0.015eta_lim_4containers_180_deg{ending}"
    for folder, ending in (("CSV", ".csv"), ("etas", "_etas.mat"))
)
FORCE_BAG = "force/bagfiles/290425/y_noRot.bag"
URDF_TAIL = """
  <link name="tool0"/>
  <joint name="tool0_joint" type="fixed">
    <origin xyz="0 0 0" rpy="0 1.5707963267948966 0"/>
    <parent link="axes_6"/>
    <child link="tool0"/>
  </joint>
</robot>
"""


def fine(values: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.round(FINE * values).astype(np.int32)


def sloshing(folder: Path) -> dict[str, NDArray[np.int32] | NDArray[np.int16]]:
    """Of each motion: the commanded joints and tray, and the heights seen, in hundredths of mm."""
    found: dict[str, NDArray[np.int32] | NDArray[np.int16]] = {}
    for path in sorted((folder / "measured").glob("*.mat")):
        name = path.stem
        joints = np.loadtxt(folder / "joint" / f"{name}_joint.csv", delimiter=";")[::EVERY, 1:]
        found[f"{name}/joints"] = fine(joints)
        found[f"{name}/tray"] = fine(np.loadtxt(folder / "tray" / f"{name}.csv", delimiter=";")[::EVERY, 1:])
        found[f"{name}/seen"] = np.round(100 * loadmat(path)["slosh_heights"].ravel()).astype(np.int16)
    return found


def four_cups(folder: Path) -> dict[str, NDArray[np.int32] | NDArray[np.int16] | NDArray[np.float64]]:
    """The joints of the motion, what its planner predicts of each cup, m, and what each video shows, in hundredths of
    mm."""
    predicted = loadmat(folder / CUPS_MAT)
    found: dict[str, NDArray[np.int32] | NDArray[np.int16] | NDArray[np.float64]] = {
        "joints": fine(np.loadtxt(folder / CUPS_CSV, delimiter=";")[::EVERY]),
        "simulated": np.array([predicted[f"eta_{k}"].max() for k in range(1, 5)]),
    }
    for k in range(1, 5):
        video = loadmat(folder / "exp_etas" / f"container_{k}" / "full_slosh" / f"1A_15_c{k}.mat")
        found[f"times/{k}"] = video["slosh_times"].ravel()
        found[f"seen/{k}"] = np.round(100 * (video["world_points"][:, 1] - video["h0_point"].item())).astype(np.int16)
    return found


def force(path: Path) -> dict[str, NDArray[np.int32] | NDArray[np.float32] | NDArray[np.float64]]:
    """The joints that were measured and the wrench beneath the vessel."""
    joints, wrenches, times = [], [], ([], [])
    with AnyReader([path]) as reader:
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            if connection.topic == "/comau_smart_six/joint_states":
                joints.append(message.position)
                times[0].append(1e-9 * (stamp - reader.start_time))
            else:
                both = message.linear, message.angular
                wrenches.append([getattr(x, axis) for x in both for axis in "xyz"])
                times[1].append(1e-9 * (stamp - reader.start_time))
    return {
        "t_joints": np.array(times[0]),
        "joints": fine(np.array(joints)),
        "t_wrench": np.array(times[1]),
        "wrench": np.array(wrenches, dtype=np.float32),
    }


def slip(folder: Path) -> dict[str, NDArray[np.float32]]:
    """Every column of every log of the twelve runs; a line that lacks columns is left out."""
    return {
        f"{run.name}/{log.stem}": whole(log.read_text().splitlines()[1:])
        for run in sorted(x for x in folder.iterdir() if x.is_dir())
        for log in sorted(run.glob("*.csv"))
    }


def whole(lines: list[str]) -> NDArray[np.float32]:
    rows = [line.split(",") for line in lines]
    return np.array([row for row in rows if len(row) == len(rows[0])], dtype=np.float32)


def arm(path: Path) -> str:
    """The URDF with the root element that it lacks, without meshes, and with a flange whose z points out of it."""
    text = re.sub(r"\s*<(visual|collision)>.*?</\1>", "", path.read_text(), flags=re.S)
    body = text.split("?>", 1)[1].rstrip()
    return f'<?xml version="1.0"?>\n<robot name="comau_smartsix">{body}{URDF_TAIL}'


def main() -> None:
    folder = Path(sys.argv[1])
    KEPT.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(KEPT / "sloshing.npz", **sloshing(folder / "slosh"))
    np.savez_compressed(KEPT / "force.npz", **force(folder / "slosh" / FORCE_BAG))
    np.savez_compressed(KEPT / "four-cups.npz", **four_cups(folder / "slosh" / "four-cups"))
    np.savez_compressed(KEPT / "slip.npz", **slip(folder / "slip"))
    (KEPT / "comau_smartsix.urdf").write_text(arm(folder / "slosh" / "comau" / "comau_smartsix5.urdf"))
    shutil.copyfile(folder / "slosh" / "LICENSE", KEPT / "LICENSE-sloshing")
    shutil.copyfile(folder / "slip" / "LICENSE", KEPT / "LICENSE-slip")


if __name__ == "__main__":
    main()
