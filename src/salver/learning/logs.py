"""Logs of an arm that carried something: joint positions with joint torques, with wrist forces and torques, or both."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from salver.errors import FileFormatError, reason
from salver.files import load_npz
from salver.geometry import Array
from salver.motion_files.readers import BAGS
from salver.motion_files.samples import reordered

LONGEST_GAP = 0.03  # s between two samples; more is a gap in the clock
LONGEST = 600.0  # s of a log
MOST_ROWS = 2_000_000
OFTEN_THERE = 0.05  # of the samples at the largest value: saturated
CLIPPED = 4  # samples at the largest value one after the other, which noise does not make
FOUR = 4  # times as often, or as long, as at any other value
FORCE = ("fx", "fy", "fz", "tx", "ty", "tz")


@dataclass(frozen=True, eq=False)
class Log:
    """One run, K samples of n joints. t (K,): s, from any beginning. q (K, n): rad.

    tau (K, n): N m at the joints, gravity included; None when there are none. wrench_F (K, 6): force N and torque N m
    that the arm exerts through the sensor on all beyond it, at the flange, in its axes (f_z > 0 at rest, upright); None
    when there is no sensor. source: where it was read.
    """

    source: str
    t: Array
    q: Array
    tau: Array | None = None
    wrench_F: Array | None = None


def read_log(path: str | Path, n: int, names: Sequence[str] = (), topic: str | None = None) -> Log:
    """A log of an arm with n joints.

    .npz with t, q and tau or wrench_F, as `salver execute` and `salver simulate` write it; .csv with the columns t,
    q1 ... qn and tau1 ... taun, or fx, fy, fz, tx, ty, tz, or all; or a ROS bag with a JointState that has efforts, a
    WrenchStamped, or both. names: of the joints, in the arm's order, for a bag; topic: of its JointState.

    Raises FileFormatError, one sentence.
    """
    path = Path(path)
    if path.suffix.lower() in BAGS or path.is_dir():
        log = _of_bag(path, tuple(names), topic)
    elif topic is not None:
        raise FileFormatError(f"{path} is no bag, so it has no topic {topic}; leave --topic away.")
    elif path.suffix not in (".npz", ".csv"):
        raise FileFormatError(
            f"{path} is no log; give a .npz that salver execute wrote, a .csv with t and q1 to q{n}, or a ROS bag."
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
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = csv.reader(file)
            head = [name.strip().lower() for name in next(rows, [])]
            lines = [row for _, row in zip(range(MOST_ROWS), rows, strict=False) if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise FileFormatError(f"{path} cannot be read ({reason(error)}); a log is a .npz or a .csv file.") from None
    groups = {"t": ["t"], "q": [f"q{k + 1}" for k in range(n)], "tau": [f"tau{k + 1}" for k in range(n)]}
    groups["wrench_F"] = list(FORCE)
    found = {}
    for name, columns in groups.items():
        have = [c for c in columns if c in head]
        if not have and name in ("tau", "wrench_F"):
            continue
        if len(have) < len(columns):
            missing = next(c for c in columns if c not in head)
            raise FileFormatError(
                f'{path} has no column "{missing}"; a log has t, q1 to q{n}, and tau1 to tau{n} or fx to tz.'
            )
        try:
            values = np.array([[float(row[head.index(c)]) for c in columns] for row in lines])
        except (ValueError, IndexError):
            raise FileFormatError(f"{path} has a row that is not all numbers in {', '.join(columns)}.") from None
        found[name] = values[:, 0] if name == "t" else values
    return found


def _check(log: Log, n: int) -> None:
    parts = {"q": (log.q, n), "tau": (log.tau, n), "wrench_F": (log.wrench_F, 6)}
    if log.tau is None and log.wrench_F is None:
        raise FileFormatError(
            f"{log.source} holds neither joint torques (tau) nor wrist forces (wrench_F): nothing weighs."
        )
    if np.ndim(log.t) != 1 or len(log.t) < 50:
        raise FileFormatError(f"{log.source} has {np.size(log.t)} samples; at least 50 are needed.")
    for name, (values, width) in parts.items():
        if values is not None and np.shape(values) != (len(log.t), width):
            raise FileFormatError(
                f"{log.source}: {name} has the shape {np.shape(values)}; of this arm it is ({len(log.t)}, {width})."
            )
        if values is not None and not np.isfinite(values).all():
            bad = np.asarray(~np.isfinite(values).all(axis=1))
            raise FileFormatError(
                f"{log.source}: {name} has values that are no numbers in {bad.sum()} of {bad.size} samples, first at "
                f"t = {log.t[int(np.argmax(bad))]:.6g} s; leave a gap of at most {LONGEST_GAP:g} s instead."
            )
    steps = np.diff(log.t)
    if not np.isfinite(log.t).all():
        raise FileFormatError(f"{log.source}: its times do not grow from sample to sample: some are no numbers.")
    if steps.min() <= 0:
        k = int(np.argmin(steps > 0))
        raise FileFormatError(
            f"{log.source}: its times do not grow from sample to sample: {log.t[k]:.9g} s is followed by "
            f"{log.t[k + 1]:.9g} s ({np.count_nonzero(steps <= 0)} of {len(steps)} steps)."
        )
    if log.t[-1] - log.t[0] > LONGEST:
        raise FileFormatError(
            f"{log.source} is {log.t[-1] - log.t[0]:.4g} s long; at most {LONGEST:g} are accepted, and times are in s."
        )
    if steps.max() > LONGEST_GAP:
        k = int(np.argmax(steps))
        raise FileFormatError(
            f"{log.source} has no samples for {steps[k]:.3g} s after t = {log.t[k]:.3f} s; at most {LONGEST_GAP:g} s "
            "may lie between two."
        )
    for name, values in (("tau", log.tau), ("wrench_F", log.wrench_F)):
        if values is not None:
            stuck = np.all(np.diff(values, axis=0) == 0, axis=0)
            if stuck.any():
                raise FileFormatError(
                    f"{log.source}: column {int(np.argmax(stuck)) + 1} of {name} never changes: it was not recorded, "
                    "or it is saturated."
                )
            k, size, share = _stays(values)
            if share > 0:
                raise FileFormatError(
                    f"{log.source}: column {k + 1} of {name} stays at {size:.4g} for {100 * share:.0f} % of the time: "
                    "it is saturated."
                )


def _stays(values: Array) -> tuple[int, float, float]:
    """Which column of values (K, m) stays at its largest absolute value, that value, and for which share of the time;
    0 when none does.

    It does when it is there in one of twenty samples, or for more than `CLIPPED` without a break, and four times as
    often or as long as at any other value: sensors of coarse steps stay a while everywhere.
    """
    found = 0, 0.0, 0.0
    for k, column in enumerate(values.T):
        size = float(np.abs(column).max())
        there = np.abs(np.abs(column) - size) < 1e-9 * max(size, 1e-9)
        begins = np.flatnonzero(np.diff(column, prepend=np.nan))
        runs, at_top = np.diff(begins, append=len(column)), there[begins]
        often = np.unique(column[~there], return_counts=True)[1].max(initial=1)
        long = runs[at_top].max() > max(CLIPPED, FOUR * runs[~at_top].max(initial=1))
        if there.mean() > found[2] and (long or there.sum() > max(OFTEN_THERE * len(column), FOUR * often)):
            found = k, size, float(there.mean())
    return found
