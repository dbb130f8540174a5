"""Logs of an arm with its load: joint positions with joint torques, with forces and torques at the wrist, or both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from salver.errors import FileFormatError, ScenarioError
from salver.files import load_npz
from salver.geometry import Array
from salver.models.bodies import Body
from salver.motion_files.readers import BAGS, read_table
from salver.motion_files.samples import reordered
from salver.scenario import Scenario

GAP = 0.03  # s, longest distance between two samples
FORCE = ("fx", "fy", "fz", "tx", "ty", "tz")


@dataclass(frozen=True, eq=False)
class Log:
    """One run, K samples of n joints.

    t (K,): s, with any origin. q (K, n): rad. tau (K, n): joint torques including gravity, N m; None without them.
    wrench_F (K, 6): force, N, and torque, N m, that the arm exerts through the sensor, at the flange, in its axes
    (f_z > 0 at rest, upright); None without a sensor. source: name of the file.
    """

    source: str
    t: Array
    q: Array
    tau: Array | None = None
    wrench_F: Array | None = None


def one_load(scenario: Scenario, purpose: str) -> Body:
    """The only object of a scenario with an arm. Raises ScenarioError, which names the purpose, for other scenarios."""
    if scenario.arm is None:
        raise ScenarioError(f"{scenario.name} has no arm; {purpose} needs one.")
    dynamic = scenario.payload.dynamic
    if len(scenario.objects) > 1 or dynamic:
        found = dynamic[0].inside if dynamic else f"{len(scenario.objects)} objects"
        raise ScenarioError(
            f"{scenario.name} carries {found}; {purpose} needs one rigid load: take objects one by one, and containers "
            "empty."
        )
    return scenario.payload.first


def read_log(path: str | Path, n: int, names: Sequence[str] = (), topic: str | None = None) -> Log:
    """Read a log of an arm with n joints.

    path: .npz with t, q and tau or wrench_F, as `salver execute` and `salver simulate` write it; .csv with the columns
    t, q1 ... qn and tau1 ... taun, or fx, fy, fz, tx, ty, tz, or all; or a ROS bag with a JointState that has efforts,
    a WrenchStamped, or both. names: of the joints, in the arm's order, for a bag. topic: of its JointState. Raises
    FileFormatError, one sentence.
    """
    path = Path(path)
    if path.suffix.lower() in BAGS or path.is_dir():
        log = _of_bag(path, tuple(names), topic)
    elif topic is not None:
        raise FileFormatError(f"{path} is not a bag, so it has no topic {topic}; leave --topic out.")
    elif path.suffix not in (".npz", ".csv"):
        raise FileFormatError(
            f"{path} is not a log; give a .npz that salver execute wrote, a .csv with t and q1 to q{n}, or a ROS bag."
        )
    else:
        found = load_npz(path, ("t", "q")) if path.suffix == ".npz" else _read_csv(path, n)
        log = Log(str(path), found["t"], found["q"], found.get("tau"), found.get("wrench_F"))
    _check(log, n)
    return log


def _of_bag(path: Path, names: tuple[str, ...], topic: str | None) -> Log:
    from salver.motion_files.ros_readers import read_sensed

    if not path.exists():
        raise FileFormatError(f"{path} does not exist; give a log as .npz or .csv, or a ROS bag.")
    samples, wrench = read_sensed(path, topic)
    samples = reordered(samples, names or samples.names)
    return Log(str(path), samples.t, samples.q, samples.tau, wrench)


def _read_csv(path: Path, n: int) -> dict[str, Array]:
    header, values = read_table(path)
    head = [name.lower() for name in header]
    groups = {name: [f"{name}{k + 1}" for k in range(n)] for name in ("q", "tau")}
    found = {}
    for name, columns in ({"t": ["t"], "wrench_F": list(FORCE)} | groups).items():
        have = [c for c in columns if c in head]
        if not have and name in ("tau", "wrench_F"):
            continue
        if len(have) < len(columns):
            missing = next(c for c in columns if c not in head)
            raise FileFormatError(
                f'{path} has no column "{missing}"; a log has t, q1 to q{n}, and tau1 to tau{n} or fx to tz.'
            )
        found[name] = values[:, [head.index(c) for c in columns]]
    return found | {"t": found["t"][:, 0]}


def check_times(
    t: Array, q: Array, source: str, planned: Array | None = None, longest: float = 600.0, moves: float = 0.02
) -> None:
    """Raise FileFormatError when times t (K,) and positions q (K, n) are not a log of a motion, planned as (L, n).

    longest: s, of a log. moves: rad, least movement of some joint.
    """
    step = np.diff(t)
    if not np.isfinite(t).all() or step.min() <= 0:
        k = int(np.argmin(step > 0))
        raise FileFormatError(
            f"{source}: its times do not grow from sample to sample: {t[k]:.9g} s is followed by {t[k + 1]:.9g} s "
            f"({np.count_nonzero(~(step > 0))} of {len(step)} steps)."
        )
    if np.ptp(t) > longest:
        raise FileFormatError(
            f"{source} is {np.ptp(t):.4g} s long; at most {longest:g} are accepted, and times are in s: cut it."
        )
    if step.max() > GAP:
        k = int(np.argmax(step))
        raise FileFormatError(
            f"{source} has no samples for {step[k]:.3g} s after t = {t[k]:.3f} s; at most {GAP:g} s may lie between "
            "two."
        )
    if planned is None:
        return
    if np.ptp(q, axis=0).max() < moves:
        raise FileFormatError(f"{source} has no motion in it: no joint moves by {moves:g} rad.")
    if np.abs(q).max() > 12 and np.abs(np.ptp(np.deg2rad(q), axis=0) - np.ptp(planned, axis=0)).max() < 0.2:
        raise FileFormatError(f"{source}: its joint positions are in degrees; they must be in rad.")


def _check(log: Log, n: int) -> None:
    parts = {"q": (log.q, n), "tau": (log.tau, n), "wrench_F": (log.wrench_F, 6)}
    if log.tau is None and log.wrench_F is None:
        raise FileFormatError(
            f"{log.source} holds neither joint torques (tau) nor wrist forces (wrench_F): the load cannot be weighed."
        )
    if np.ndim(log.t) != 1 or len(log.t) < 50:
        raise FileFormatError(f"{log.source} has {np.size(log.t)} samples; at least 50 are needed.")
    check_times(log.t, log.q, log.source)
    for name, (values, width) in parts.items():
        if values is None:
            continue
        if np.shape(values) != (len(log.t), width):
            raise FileFormatError(
                f"{log.source}: {name} has the shape {np.shape(values)}; this arm needs ({len(log.t)}, {width})."
            )
        if not np.isfinite(values).all():
            bad = np.asarray(~np.isfinite(values).all(axis=1))
            raise FileFormatError(
                f"{log.source}: {name} has values that are not numbers in {bad.sum()} of {bad.size} samples, first at "
                f"t = {log.t[int(np.argmax(bad))]:.6g} s; leave a gap of at most {GAP:g} s instead."
            )
        for k, column in enumerate(values.T if name != "q" else ()):
            share = _saturated(column)
            if share:
                raise FileFormatError(
                    f"{log.source}: column {k + 1} of {name} stays at {np.abs(column).max():.4g} for {100 * share:.0f} "
                    "% of the time: it is saturated, or was not recorded."
                )


def _saturated(column: Array) -> float:
    """Share of the samples (K,) at their largest value, if that suggests saturation; else 0.

    It does if one sample of twenty is there, or more than four in a row, and four times as many as at any other value
    (coarse sensors repeat every value).
    """
    size = float(np.abs(column).max())
    there = np.abs(np.abs(column) - size) < 1e-9 * max(size, 1e-9)
    begins = np.flatnonzero(np.diff(column, prepend=np.nan))
    runs, at_top = np.diff(begins, append=len(column)), there[begins]
    often = np.unique(column[~there], return_counts=True)[1].max(initial=1)
    long = runs[at_top].max() > 4 * max(1, runs[~at_top].max(initial=1))
    return float(there.mean()) if long or there.sum() > max(0.05 * len(column), 4 * often) else 0.0
