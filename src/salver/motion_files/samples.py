"""Samples of a motion that was read from a file, with the checks that all formats share."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from salver.display import Outlined
from salver.errors import FileFormatError
from salver.geometry import Array, continuous

FEWEST = 8  # least number of samples of a recording, to separate accelerations from noise
SHORTEST_STEP = 1e-5  # s
MOST_SAMPLES = 1_000_000  # of a motion that is written, or waypoints of a path that is timed
NUMBERED = re.compile(r"(?:q_)?(([qja])_?\[?(\d+)\]?)", re.IGNORECASE)  # names that only number the joints: q1, J1, A1
AT_REST = 0.02  # m/s or rad/s, below which a motion is at rest between two legs


@dataclass(frozen=True, repr=False)
class TraySamples(Outlined):
    """Poses of the tray frame E in S.

    t (N,): s from the first sample. p (N, 3): m. quat_wxyz (N, 4): continuous in sign, of norm 1 up to rounding in the
    file. notes: repairs on reading, as sentences. form: format of the file: "csv", "npz", "message" (of ROS) or "ros2"
    (a bag). verdict: the warning in the file ("UNSAFE: why"), else empty.
    """

    t: Array
    p: Array
    quat_wxyz: Array
    source: str
    notes: tuple[str, ...] = ()
    form: str = "csv"
    verdict: str = ""


@dataclass(frozen=True, repr=False)
class JointSamples(Outlined):
    """Joint positions q (N, n) at t (N,), with velocities and accelerations if the file has them.

    names: (n,) of the joints, in the order of the columns. commanded: whether these are waypoints of a command, with
    velocities; otherwise they are a recording. form, verdict: as in `TraySamples`. tau: (N, n), N m, or None.
    """

    t: Array
    names: tuple[str, ...]
    q: Array
    dq: Array | None
    ddq: Array | None
    source: str
    notes: tuple[str, ...] = ()
    commanded: bool = False
    form: str = "csv"
    tau: Array | None = None
    verdict: str = ""


Samples = TraySamples | JointSamples
SomeSamples = TypeVar("SomeSamples", bound=Samples)


def part(samples: SomeSamples, some: slice) -> SomeSamples:
    """Some of the samples, at times from the first of them."""
    arrays = {name: value[some] for name, value in vars(samples).items() if isinstance(value, np.ndarray)}
    return replace(samples, **{**arrays, "t": arrays["t"] - arrays["t"][0]})


def cuts_at_rests(samples: Samples, count: int) -> list[slice]:
    """The samples of `count` parts of a motion, cut in the middle of its longest rests, each from rest to rest.

    Raises FileFormatError when it rests less often.
    """
    t = samples.t
    x = samples.q if isinstance(samples, JointSamples) else np.hstack([samples.p, samples.quat_wxyz])
    still = np.abs(np.diff(x, axis=0)).max(axis=1) < AT_REST * np.diff(t)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]])))
    rests = [(t[b] - t[a], a, b) for a, b in edges.reshape(-1, 2) if a > 0 and b < len(t) - 1]
    if len(rests) < count - 1:
        raise FileFormatError(
            f"{samples.source} rests {len(rests)} times on its way, below {AT_REST:g} m/s or rad/s from sample to "
            f"sample; {count} legs need {count - 1}."
        )
    cuts = [0, *sorted((a + b) // 2 for _, a, b in sorted(rests)[len(rests) - count + 1 :]), len(t) - 1]
    return [slice(a, b + 1) for a, b in pairwise(cuts)]


def tray_samples(t: Array, p: Array, quat_wxyz: Array, source: str) -> TraySamples:
    """Check and repair poses. Raises FileFormatError, one sentence with the row."""
    _finite({"the time": t, "the position": p, "the quaternion": quat_wxyz}, source)
    norm = np.linalg.norm(quat_wxyz, axis=1)
    wrong = np.flatnonzero(np.abs(norm - 1) > 0.02)
    if len(wrong):
        raise FileFormatError(
            f"{source}: the quaternion of sample {wrong[0] + 1} has norm {norm[wrong[0]]:.4g}; a rotation has norm 1."
        )
    if np.abs(p).max() > 100:
        k = int(np.argmax(np.abs(p).max(axis=1)))
        raise FileFormatError(
            f"{source}: the position of sample {k + 1} is {np.abs(p[k]).max():.4g} m away; positions are in metres "
            "(of a table also in others: --units mm)."
        )
    quat = continuous(quat_wxyz / np.median(norm))  # one factor for all samples keeps the resolution of the file
    t, keep, notes = _clock(t, np.hstack([p, quat]), source)
    return TraySamples(t[keep] - t[0], p[keep], quat[keep], source, notes)


def joint_samples(
    t: Array,
    names: tuple[str, ...],
    q: Array,
    dq: Array | None,
    ddq: Array | None,
    source: str,
    commanded: bool = False,
    fewest: int = FEWEST,
    tau: Array | None = None,
) -> JointSamples:
    """Check and repair joint positions. Raises FileFormatError, one sentence with the row."""
    joints = {"positions": q, "velocities": dq, "accelerations": ddq, "efforts": tau}
    each = {f"one of the {name}": array for name, array in joints.items() if array is not None}
    _finite({"the time": t, **each}, source)
    t, keep, notes = _clock(t, q, source, 2 if commanded else fewest)
    dq, ddq, tau = (None if x is None else x[keep] for x in (dq, ddq, tau))
    return JointSamples(t[keep] - t[0], names, q[keep], dq, ddq, source, notes, commanded, tau=tau)


def reordered(samples: JointSamples, names: tuple[str, ...]) -> JointSamples:
    """The motion with the columns of the joints `names`, in that order; others are left out."""
    missing = [name for name in names if name not in samples.names]
    if missing:
        # Names that only number the joints (q1, J1, A1, ...) fit any arm with as many joints.
        numbered = all(NUMBERED.fullmatch(name) or name.isdigit() for name in samples.names)
        if numbered and len(samples.names) == len(names) and not set(names) & set(samples.names):
            return samples
        raise FileFormatError(
            f"{samples.source} has no joint {missing[0]}; it has {', '.join(samples.names)}, and the scenario's arm "
            f"has {', '.join(names)}."
        )
    order = [samples.names.index(name) for name in names]
    dq, ddq, tau = (None if x is None else x[:, order] for x in (samples.dq, samples.ddq, samples.tau))
    return replace(samples, names=names, q=samples.q[:, order], dq=dq, ddq=ddq, tau=tau)


def _finite(arrays: dict[str, Array], source: str) -> None:
    for name, array in arrays.items():
        bad = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim))))
        if len(bad):
            raise FileFormatError(f"{source}: {name} of sample {bad[0] + 1} is not a finite number.")


def _clock(t: Array, y: Array, source: str, fewest: int = FEWEST) -> tuple[Array, Array, tuple[str, ...]]:
    """Repaired times, indices of samples to keep, and notes. Raises FileFormatError if times decrease.

    Equal samples (N, d) at one time are dropped; different samples at one time are spread until the next time.
    """
    step = np.diff(t)
    back = np.flatnonzero(step < 0)
    if len(back):
        k = int(back[0])
        raise FileFormatError(
            f"{source}: time runs backwards from {t[k]:.6f} s to {t[k + 1]:.6f} s at sample {k + 2}; samples must be "
            "in the order of time."
        )
    keep = np.concatenate([[0], 1 + np.flatnonzero((step > 0) | np.any(y[1:] != y[:-1], axis=1))])
    notes = []
    if len(keep) < len(t):
        notes.append(f"{len(t) - len(keep)} samples repeat the time of the one before and were left out.")
    new = np.flatnonzero(np.append(True, np.diff(t[keep]) > 0))
    if 1 < len(new) < len(keep):
        notes.append(f"{len(keep) - len(new)} samples have the time of the one before and were spread till the next.")
        last = len(keep) - new[-1]
        end = t[-1] + (t[-1] - t[keep][new[-2]]) * last / (new[-1] - new[-2])
        t = t.astype(float).copy()
        t[keep] = np.interp(np.arange(len(keep)), np.append(new, len(keep)), np.append(t[keep][new], end))
    if len(keep) < fewest:
        raise FileFormatError(f"{source} has {len(keep)} samples at different times; an audit needs at least {fewest}.")
    usual = float(np.median(np.diff(t[keep])))
    if usual < SHORTEST_STEP:
        raise FileFormatError(
            f"{source}: samples come every {usual:.3g} s; an audit reads up to {1 / SHORTEST_STEP:g} a second, so the "
            "unit of its times is another: give it by --units, or name the column t_ms, t_us or t_ns."
        )
    return t, keep, tuple(notes)
