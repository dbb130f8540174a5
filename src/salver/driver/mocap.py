"""Motion capture of object and tray, merged into the log of a run on the arm: e_p and e_o as in the paper's Fig. 8.

Two kinds of CSV are read. Vicon's export of objects (rate in the second line, names in the third, then columns RX RY RZ
[RW] TX TY TZ with their units): rotation vector, or quaternion when there is RW. Or a plain table with the headings t,
p_x, p_y, p_z, q_w, q_x, q_y, q_z (s, m), each with NAME_ in front when there are several objects.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from salver.errors import FileFormatError, SalverError
from salver.geometry import Array, compose, exp, interpolated, invert, log, matrix_from_quat_wxyz, quat_wxyz_from_matrix

if TYPE_CHECKING:
    from collections.abc import Mapping

    from salver.models.bodies import Body
    from salver.trajectory import Reference


@dataclass(frozen=True)
class CaptureOptions:
    """Assumptions about motion capture, and requirements on a recording that shows whether a load stayed in place.

    rest: time before the motion over which poses at rest are averaged, s; fewest: samples in it. longest: duration of a
    recording in which the motion is searched for, s. gap: largest time between samples that is interpolated, s. slip:
    smallest displacement on the tray that counts as a slip, m. stray: largest movement of markers at rest beyond their
    noise, m. sure: multiple of a track's noise that deviations without slip hardly ever exceed. fits: largest
    difference of the tray's pose from that by the joints, m. faster, spinning: velocity above the reference, m/s, and
    angular velocity, rad/s, above which markers must have been confused.
    """

    rest: float = 0.1
    fewest: int = 5
    longest: float = 3600.0
    gap: float = 0.1
    slip: float = 2e-3
    stray: float = 5e-4
    sure: float = 4.5 * 2**0.5
    fits: float = 0.02
    faster: float = 3.0
    spinning: float = 30.0


STANDARD = CaptureOptions()


@dataclass(frozen=True)
class Track:
    """A rigid body seen by motion capture. t (N,): s, its own clock. p (N, 3), R (N, 3, 3): pose in its own world."""

    t: Array
    p: Array
    R: Array


def read_tracks(path: str | Path) -> dict[str, Track]:
    """Tracks by name, without samples in which a body was not seen. Raises FileFormatError."""
    path = Path(path)
    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            rows = [row for row in csv.reader(file) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError):
        raise FileFormatError(f"{path} cannot be read as a text file; motion capture comes as CSV.") from None
    header = next((i for i, row in enumerate(rows) if row[0].strip().lower() == "frame"), None)
    try:
        tracks = _vicon(rows, header) if header is not None else _plain(rows)
    except (ValueError, IndexError, KeyError):
        tracks = {}
    tracks = {name: track for name, track in tracks.items() if len(track.t) > 1}
    if not tracks:
        raise FileFormatError(
            f"{path} is no motion capture that can be read; accepted are Vicon's CSV of objects, or columns t, p_x, "
            "p_y, p_z, q_w, q_x, q_y, q_z."
        )
    return tracks


def _vicon(rows: list[list[str]], header: int) -> dict[str, Track]:
    rate = float(rows[header - 2][0])
    names, columns = rows[header - 1], [cell.strip().upper() for cell in rows[header]]
    units = [cell.strip().lower() for cell in rows[header + 1]] + [""] * len(columns)
    starts = [i for i, cell in enumerate(columns) if cell == "RX"]
    table = _numbers(rows[header + 2 :], len(columns))
    frame = table[:, 0] + (table[:, 1] if columns[1] == "SUB FRAME" else 0.0)
    tracks = {}
    for start, stop in zip(starts, [*starts[1:], len(columns)], strict=True):
        at = {columns[i]: i for i in range(start, stop)}
        scale = {"mm": 1e-3, "m": 1.0}[units[at["TX"]] or "mm"]
        p = scale * table[:, [at["TX"], at["TY"], at["TZ"]]]
        turn = table[:, [at["RX"], at["RY"], at["RZ"]]]
        if "RW" in at:
            R = _rotations(np.column_stack([table[:, at["RW"]], turn]))
        else:
            R = exp(np.deg2rad(turn) if units[at["RX"]] == "deg" else turn)
        label = next((names[i] for i in range(start, -1, -1) if i < len(names) and names[i].strip()), f"object{start}")
        tracks[label.split(":")[-1].strip()] = _seen((frame - table[0, 0]) / rate, p, R)
    return tracks


def _plain(rows: list[list[str]]) -> dict[str, Track]:
    columns = {name.strip(): i for i, name in enumerate(rows[0])}
    table = _numbers(rows[1:], len(columns))
    tracks = {}
    for name in [c.removesuffix("p_x") for c in columns if c.endswith("p_x")]:
        p = table[:, [columns[f"{name}p_{c}"] for c in "xyz"]]
        R = _rotations(table[:, [columns[f"{name}q_{c}"] for c in "wxyz"]])
        tracks[name.removesuffix("_") or "object"] = _seen(table[:, columns["t"]], p, R)
    return tracks


def _numbers(rows: list[list[str]], width: int) -> Array:
    """Table with NaN where a cell is empty."""
    padded = [[*row, *[""] * width][:width] for row in rows]
    return np.array([[float(cell) if cell.strip() else np.nan for cell in row] for row in padded])


def _rotations(quat_wxyz: Array) -> Array:
    """Rotations of quaternions that need not be normalised; NaN stays NaN."""
    size = np.linalg.norm(quat_wxyz, axis=1, keepdims=True)
    good = np.isfinite(size[:, 0]) & (size[:, 0] > 0)
    R = np.full((len(size), 3, 3), np.nan)
    R[good] = matrix_from_quat_wxyz(quat_wxyz[good] / size[good])
    return R


def _seen(t: Array, p: Array, R: Array) -> Track:
    """Samples that were seen: Vicon writes zeros, or nothing, for bodies that it does not see."""
    numbers = np.isfinite(t) & np.all(np.isfinite(p), axis=1) & np.all(np.isfinite(R), axis=(1, 2))
    good = numbers & np.any(p != 0, axis=1)
    return Track(t[good], p[good], R[good])


def find_offset(
    track: Track, reference: Reference, p_BX: Array | None = None, options: CaptureOptions = STANDARD
) -> float:
    """Time of the track's own clock at which the motion starts, by the best fit of its speed to the reference's, of a
    point p_BX (3,) fixed to B.
    """
    step = 2e-3
    if not 0 < track.t[-1] - track.t[0] < options.longest:
        raise SalverError(
            f"The motion capture goes from {track.t[0]:g} to {track.t[-1]:g} s; its times must be in s and go forwards "
            f"for at most {options.longest:g} s."
        )
    t = np.arange(track.t[0], track.t[-1], step)
    if len(t) * step < 0.5 * reference.duration:
        raise SalverError(
            f"The motion capture lasts {track.t[-1] - track.t[0]:.2f} s, the motion {reference.duration:.2f} s; it "
            "must cover the motion."
        )
    travelled = interpolated(track.t, track.p, t)
    width = max(1, round(0.05 / step))  # smooths what differentiating makes of noise
    window = np.ones(width) / width
    speed = np.convolve(np.linalg.norm(np.gradient(travelled, step, axis=0), axis=1), window, mode="same")
    asked = reference.sample(np.arange(0.0, reference.duration, step)).of_frame(np.zeros(3) if p_BX is None else p_BX)
    wanted = np.linalg.norm(asked.v_S, axis=1)
    wanted = np.convolve(wanted, window, mode="same")
    room = len(speed) - len(wanted)
    if room < 0:
        speed = np.concatenate([np.zeros(len(wanted)), speed, np.zeros(len(wanted))])
        t = t[0] + step * (np.arange(len(speed)) - len(wanted))
    match = np.correlate(speed, wanted, mode="valid") - 0.5 * np.correlate(speed**2, np.ones_like(wanted), mode="valid")
    return float(t[int(np.argmax(match))])


def merge(
    arrays: Mapping[str, np.ndarray],
    tracks: Mapping[str, Track],
    reference: Reference,
    body: Body,
    *,
    object_name: str,
    tray_name: str | None = None,
    offset: float | None = None,
    p_SV: Array | None = None,
    R_SV: Array | None = None,
    options: CaptureOptions = STANDARD,
) -> dict[str, np.ndarray]:
    """Arrays of a log (t, p_SE, quat_SE_wxyz, ...) with the object as motion capture saw it: p_SB, quat_SB_wxyz, e_p,
    e_o, slip, slip_E, lift, mocap_offset.

    p_SV, R_SV: pose of the capture's world in S; the same by default. The marker frame may have any pose on a body:
    that pose is computed from the rest before the motion, when the body is where the plan has it. offset: the capture's
    time at the start of the motion; found from the speed by default. Without a track of the tray, slip is relative to
    the tray's position by the joints; with one, `tray_seen` (T, 3) is its observed position in S, m.
    slip, lift (T, 1): largest displacement, m, of a corner of the base along the tray and off it. `salver.driver.seen`
    judges whether the load stayed.
    """
    for name in (object_name, *([tray_name] if tray_name else [])):
        if name not in tracks:
            raise SalverError(f'The motion capture has no object "{name}"; it has {", ".join(tracks)}.')
    if offset is not None:
        shift = offset
    elif tray_name:  # which does not slide
        shift = find_offset(tracks[tray_name], reference, -body.R_EB.T @ body.p_EB, options)
    else:
        shift = find_offset(tracks[object_name], reference, options=options)
    world = (np.zeros(3) if p_SV is None else p_SV), (np.eye(3) if R_SV is None else R_SV)
    t = arrays["t"]
    start = reference.sample(0.0)
    p_SB, R_SB = _in_world(tracks[object_name], shift, world, t, start.p_SB[0], start.R_SB[0], options)
    p_SE, R_SE = arrays["p_SE"], matrix_from_quat_wxyz(arrays["quat_SE_wxyz"])
    if tray_name:
        R_start = start.R_SB[0] @ body.R_EB.T
        p_start = start.p_SB[0] - R_start @ body.p_EB
        p_SE, R_SE = _in_world(tracks[tray_name], shift, world, t, p_start, R_start, options)
    wanted = reference.sample(t)
    on_tray = compose(*invert(p_SE, R_SE), p_SB, R_SB)
    place = (body.p_EB, body.R_EB) if tray_name else _mean_pose(*on_tray, _resting(t, options.rest))
    away = _displaced(on_tray, place, body.base_polygon_B)
    turn = np.full(len(t), np.nan)
    seen = np.isfinite(R_SB).all(axis=(1, 2))
    turn[seen] = np.linalg.norm(log(np.swapaxes(R_SB[seen], 1, 2) @ wanted.R_SB[seen]), axis=1)
    quat = np.full((len(t), 4), np.nan)
    quat[seen] = quat_wxyz_from_matrix(R_SB[seen])
    return {
        **arrays,
        "p_SB": p_SB[:, None],
        "quat_SB_wxyz": quat[:, None],
        "e_p": np.linalg.norm(wanted.p_SB - p_SB, axis=1),
        "e_o": turn,
        "slip_E": (on_tray[0] - place[0])[:, None],
        "slip": np.linalg.norm(away[..., :2], axis=2).max(axis=1)[:, None],
        "lift": np.abs(away[..., 2]).max(axis=1)[:, None],
        "mocap_offset": np.array(shift),
        **({"tray_seen": p_SE} if tray_name else {}),
    }


def _displaced(pose: tuple[Array, Array], place: tuple[Array, Array], points_B: Array) -> Array:
    """Displacement (T, m, 3), m, on the tray, of the corners of a base (m, 3) from where another place would put
    them."""
    p_EB, R_EB = pose
    return p_EB[:, None] + np.einsum("tij,mj->tmi", R_EB, points_B) - (place[0] + points_B @ place[1].T)


def _mean_pose(p: Array, R: Array, which: np.ndarray) -> tuple[Array, Array]:
    """Mean of poses (T, 3), (T, 3, 3) at the instants `which` at which it was seen; NaN when there are none."""
    seen = which & np.isfinite(p).all(axis=1)
    if not seen.any():
        return np.full(3, np.nan), np.full((3, 3), np.nan)
    middle = R[seen][0]
    return p[seen].mean(axis=0), middle @ exp(log(middle.T @ R[seen]).mean(axis=0))


def _resting(t: Array, rest: float) -> np.ndarray:
    """Samples of the rest before the motion; the one nearest to its start when there are none."""
    resting = (t >= -rest) & (t <= 0)
    return resting if resting.any() else t == t[np.argmin(np.abs(t))]


def _in_world(
    track: Track, shift: float, world: tuple[Array, Array], t: Array, p: Array, R: Array, options: CaptureOptions
) -> tuple[Array, Array]:
    """Pose (T, 3), (T, 3, 3) in S at times t of the motion, given the pose (p, R) at its start; NaN where not seen."""
    own = track.t - shift
    p_V, R_V = compose(*world, track.p, track.R)
    p_MB, R_MB = compose(
        *invert(*_mean_pose(p_V, R_V, _resting(own, options.rest))), p, R
    )  # marker frame to the body's own
    i = np.clip(np.searchsorted(own, t) - 1, 0, len(own) - 2)
    u = (t - own[i]) / (own[i + 1] - own[i])
    between = R_V[i] @ exp(u[:, None] * log(np.swapaxes(R_V[i], 1, 2) @ R_V[i + 1]))
    p_t = p_V[i] + u[:, None] * (p_V[i + 1] - p_V[i])
    p_out, R_out = compose(p_t, between, p_MB, R_MB)
    seen = (t >= own[0]) & (t <= own[-1]) & (own[i + 1] - own[i] <= options.gap)
    return np.where(seen[:, None], p_out, np.nan), np.where(seen[:, None, None], R_out, np.nan)
