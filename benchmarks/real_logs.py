"""What logs of a real Panda and a real UR10e say to `salver track` and `salver identify`: two parts of docs/reality.md.

    git clone https://github.com/marcocognetti/FrankaEmikaPandaDynModel
    git clone https://github.com/shamilmamedov/dynamic_calibration
    python benchmarks/real_logs.py FrankaEmikaPandaDynModel dynamic_calibration [--docs]

The logs stay where they are: the first repository is GPL-3, the second has no licence.
"""

from __future__ import annotations

import argparse
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, filtfilt

import salver as sv
from salver.errors import FileFormatError
from salver.geometry import Array
from salver.learning.load.channels import ChannelReading
from salver.learning.load.identify import LoggedRun, _felt, identify_runs, prior
from salver.learning.logs import Log
from salver.learning.tracking.deviations import STANDSTILL
from salver.learning.tracking.executed import executed
from salver.learning.tracking.track import track
from salver.motion_files import JointSamples
from salver.scenario import Scenario, parse
from salver.trajectory import JointMotion

sys.path.append(str(Path(__file__).parents[1] / "docs"))
import blocks

PAGE = Path(__file__).parents[1] / "docs" / "reality.md"
SLOW = 5  # cosines over the whole log that are taken for drift of the integrated commands
LOADED = 2.805  # kg, as published
GAINS = {  # N m for each A
    "theirs": (10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232),
    "De Luca's": (14.87, 13.26, 11.13, 10.62, 11.03, 11.47),
}


def numbers(path: Path) -> Array:
    return np.array(path.read_text().split(), dtype=float)


def panda(repository: Path) -> str:
    """What measured joints of a Panda are beside those that its commanded velocities add up to."""
    folder = repository / "matlab/data/Exciting_Traj/Trajectory_1"
    sent = CubicSpline(numbers(folder / "gen_time.txt"), numbers(folder / "gen_dq.txt").reshape(-1, 7))
    t = np.linspace(0.0, sent.x[-1], 2101)
    commanded = JointMotion(t, numbers(folder / "gen_q0.txt") + sent.antiderivative()(t), sent(t), sent.derivative()(t))
    log = folder / "rbt_log"
    q = numbers(log / "exciting_traj_positions.txt").reshape(-1, 7)
    names = tuple(f"panda_joint{k}" for k in range(1, 8))
    done = executed(commanded, JointSamples(numbers(log / "exciting_traj_time.txt"), names, q, None, None, "log"))
    _, dq, ddq = commanded.sample(done.t)
    drift = np.cos(np.pi * np.outer(np.arange(len(done.t)), np.arange(SLOW)) / len(done.t))
    lags, left = [], []
    for off, v, a in zip(done.noisy.T, dq.T, ddq.T, strict=True):
        shapes = np.column_stack([v, a, np.tanh(v / STANDSTILL), drift])
        sizes = np.linalg.lstsq(shapes, off, rcond=None)[0]
        lags.append(-sizes[0])
        left.append(np.std(off - shapes @ sizes))
    plan = sv.plan("panda-tall-bottle")
    assert plan.joint is not None
    t = np.arange(-0.5, plan.duration + 0.8, 1e-3)
    lagged = np.column_stack([plan.joint.sample(t - done.shift - lag)[0][:, j] for j, lag in enumerate(lags)])
    excess = track(plan, JointSamples(t - t[0], names, lagged, None, None, "lagged")).excess
    return (
        f"In {done.t[-1]:.0f} s of a Panda's motion (up to {np.abs(dq).max():.1f} rad/s and {np.abs(ddq).max():.1f} "
        f"rad/s²) all joints are late by the same {1e3 * done.shift:.1f} ms; between joints the lags differ by "
        f"{1e3 * np.ptp(lags):.2f} ms at most, and {1e3 * min(left):.2f} to {1e3 * max(left):.2f} mrad r.m.s. are "
        "left, as of times that jitter by tenths of a ms. Its commands are velocities, so positions drift besides, by "
        f"{1e3 * np.abs(done.noisy).max():.1f} mrad at most. A second-order lag for each joint is not wrong there, but "
        f"the log cannot show it: a common delay says the same. Lags that differ so take {100 * excess:.1f} % of the "
        "weight from the fastest tall bottle."
    )


@dataclass(frozen=True)
class Motion:
    """What `identify` asks of a plan."""

    scenario: Scenario
    joint: JointMotion

    @property
    def duration(self) -> float:
        return self.joint.duration


def ur_log(path: Path, gains: tuple[float, ...]) -> Log:
    """A log of the UR10e, with torques as its currents times the gains; rows that are garbled are left out."""
    rows = [line.split(",") for line in path.read_text().splitlines()]
    kept = np.array([row for row in rows if len(row) == 31], dtype=float)
    kept = kept[np.abs(kept[:, 0] - np.median(kept[:, 0])) < 60.0]
    kept = kept[np.append(True, np.diff(np.maximum.accumulate(kept[:, 0])) > 0)]
    first, last = np.flatnonzero(np.abs(kept[:, 7:13]).max(axis=1) > 0.01)[[0, -1]]
    kept = kept[max(0, first - 60) : last + 60]  # with 0.6 s of rest
    return Log(path.stem, kept[:, 0] - kept[0, 0], kept[:, 1:7], kept[:, 13:19] * gains)


def smooth(log: Log) -> JointMotion:
    t = np.arange(0.0, log.t[-1], 0.01)
    q = filtfilt(*butter(4, 5.0, fs=100.0), np.column_stack([np.interp(t, log.t, x) for x in log.q.T]), axis=0)
    dq = np.gradient(q, 0.01, axis=0)
    return JointMotion(t, q, dq, np.gradient(dq, 0.01, axis=0))


def weighed(reading: ChannelReading) -> tuple[float, float]:
    """kg by least squares with friction of each joint that the load changes; share of the torques that is left."""
    count, n = reading.values.shape
    shapes, y = [], []
    for j, unit in enumerate(reading.values.std(axis=0)):
        v = reading.motion.dq[:, j]
        friction = np.zeros((count, n, 3))
        friction[:, j] = np.column_stack([np.tanh(v / STANDSTILL), v, np.ones(count)])
        shapes.append(np.column_stack([reading.rows[:, j], friction.reshape(count, -1)]) / unit)
        y.append(reading.values[:, j] / unit)
    shape, felt = np.concatenate(shapes), np.concatenate(y)
    found = np.linalg.lstsq(shape, felt, rcond=None)[0]
    return float(found[0]), float(np.sum((felt - shape @ found) ** 2) / np.sum(felt**2))


def ur10e(repository: Path) -> str:
    """What `identify` makes of motor currents with and without a known load."""
    load = {
        "name": "load",
        "shape": {"type": "cylinder", "radius": 0.12, "height": 0.2},
        "mass": 2.5,
        "friction": 0.5,
        "uncertainty": {"mass": "80%", "com": [0.1, 0.1, 0.09]},
    }
    ends = {"start": {"position": [0.5, 0.0, 0.5]}, "goal": {"position": [0.5, 0.2, 0.5]}, "duration": 2.0}
    flange = {"size": [0.3, 0.3], "height": 0.001, "mass": 1e-4, "inertia": [1e-7, 1e-7, 1e-7]}
    arm = {"model": str(repository / "URe/urdf/ur10e.urdf"), "flange": "tool0", "collisions": "unchecked"}
    scenario = parse({"name": "ur10e", "motion": ends, "objects": [load], "tray": flange, "arm": arm}, "ur10e")
    rows = ["| log | gains | `salver identify` | least squares, kg | truly |", "|---|---|---|---|---|"]
    for harmonics in (14, 15):
        stem = f"ur-20_02_19_{harmonics}harm50sec"
        for whose, gains in GAINS.items():
            empty, loaded = (
                ur_log(repository / "dataset_ur10e/identification_data" / f"{name}.csv", gains)
                for name in (stem, f"{stem}Load")
            )
            run = LoggedRun(Motion(scenario, smooth(empty)), loaded, empty)  # type: ignore[arg-type]
            try:
                mass = identify_runs(scenario, [run]).ranges["mass"]
                said = f"{mass.low:.2f} to {mass.high:.2f} kg"
            except FileFormatError as error:
                said = "refuses: " + str(error).split(": ", 1)[1].split(":")[0]
            kg, left = weighed(_felt(scenario, [run], prior(scenario))[0][0])
            rows.append(f"| {harmonics} harmonics | {whose} | {said} | {kg:.2f} ({100 * left:.0f} % left) | {LOADED} |")
    return "\n".join(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("panda", type=Path, help="folder of FrankaEmikaPandaDynModel")
    parser.add_argument("ur10e", type=Path, help="folder of dynamic_calibration")
    parser.add_argument("--docs", action="store_true", help="write docs/reality.md")
    options = parser.parse_args()
    parts = {
        "panda": textwrap.fill(panda(options.panda), 125, break_on_hyphens=False),
        "ur10e": ur10e(options.ur10e),
    }
    for name, text in parts.items():
        if options.docs:
            blocks.replace(PAGE, name, text)
        else:
            print(f"{name}\n{text}\n")


if __name__ == "__main__":
    main()
