"""Measure slip, lift, tip and contact of each object in a trace, and judge the outcome.

The motion of an object is measured relative to its support: the tray, or the object below it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from salver.geometry import GRAVITY, Array
from salver.models.load_dynamics import LEAST_WEIGHT
from salver.simulation import creep
from salver.simulation.scene.elements import DAMPING_WIDTH
from salver.simulation.scene.loads import Load
from salver.simulation.scene.scene import HINGE, Scene
from salver.simulation.trace import Trace


@dataclass(frozen=True)
class Thresholds:
    """Thresholds above which an object counts as slipping, tipping or lifting.

    slip: m along the support, creep subtracted; ten times the residual of the creep law in the paper's motion.
    tip: rad from its orientation at rest; a cube of 4 cm has then lifted one side by 1.4 mm.
    lift: m between the whole base and its support.
    """

    slip: float = 5e-4
    tip: float = float(np.deg2rad(2.0))
    lift: float = 1e-3


@dataclass(frozen=True)
class Behaviour:
    """Motion of m objects at N instants; see SimulationRecord for the other fields.

    lost (N, m): whether the centre of the base is beyond the tray's edge.

    p_EB (N, m, 3), R_EB (N, m, 3, 3): pose relative to the real tray.
    """

    p_EB: Array
    R_EB: Array
    slip_E: Array
    creep_E: Array
    slip: Array
    lift: Array
    tip_angle: Array
    lost: Array


def behaviour(scene: Scene, trace: Trace, bias: creep.TrayBias, tray_size: tuple[float, float]) -> Behaviour:
    """Measure every object. Displacements are relative to the first instant with t >= 0."""
    start = int(np.searchsorted(trace.t, -1e-9))
    R_EX = np.swapaxes(trace.R_XE, -1, -2)
    p_EB = np.einsum("tij,tmj->tmi", R_EX, trace.p_XB - trace.p_XE[:, None])
    R_EB = np.einsum("tij,tmjk->tmik", R_EX, trace.R_XB)
    count, m = p_EB.shape[:2]
    slip_E, creep_E = np.zeros((count, m, 3)), np.zeros((count, m, 3))
    slip, tip, lift = np.zeros((count, m)), np.zeros((count, m)), np.full((count, m), np.inf)
    lost = np.zeros((count, m), bool)
    index = {load.name: k for k, load in enumerate(scene.loads)}
    gain = creep.gain(scene.contact_time, scene.model.opt.timestep, DAMPING_WIDTH)
    for k, load in enumerate(scene.loads):
        below = index.get(next(iter(load.supports)))

        def crept(point_B: Array, load: Load = load, below: int | None = below) -> Array:
            p_EP, p_below = load.p_EB + load.R_EB @ point_B, None if below is None else scene.loads[below].p_EB
            return creep.creep(trace.t, bias, p_EP, load.p_EB, p_below, gain)

        creep_E[:, k] = crept(load.base_centre_B)
        if below is not None:
            creep_E[:, k] += creep_E[:, below]
        creep_E[:, k] -= creep_E[start, k]
        centre = p_EB[:, k] + R_EB[:, k] @ load.base_centre_B
        slip_E[:, k] = centre - centre[start]
        p, R = _in_support(p_EB, R_EB, k, below)
        for point in load.outline_B:
            d, own_creep = p + R @ point, crept(point)
            if below is not None:
                own_creep = own_creep @ scene.loads[below].R_EB
            moved = d - d[start] - (own_creep - own_creep[start])
            slip[:, k] = np.maximum(slip[:, k], np.hypot(moved[:, 0], moved[:, 1]))
            lift[:, k] = np.minimum(lift[:, k], d[:, 2] - d[start, 2])
        relative = R[start].T @ R
        tip[:, k] = np.arctan2(np.hypot(relative[:, 0, 2], relative[:, 1, 2]), relative[:, 2, 2])
        beyond = np.abs(centre[:, :2]) > 0.5 * np.array(tray_size)
        lost[:, k] = np.any(beyond, axis=1) | (p_EB[:, k, 2] < 0)
    return Behaviour(p_EB, R_EB, slip_E, creep_E, slip, np.maximum(lift, 0), tip, lost)


def _in_support(p_EB: Array, R_EB: Array, k: int, below: int | None) -> tuple[Array, Array]:
    """Pose (N, 3), (N, 3, 3) of object k relative to its support."""
    if below is None:
        return p_EB[:, k], R_EB[:, k]
    back = np.swapaxes(R_EB[:, below], -1, -2)
    return np.einsum("tij,tj->ti", back, p_EB[:, k] - p_EB[:, below]), back @ R_EB[:, k]


def inner_motions(scene: Scene, trace: Trace) -> Array:
    """`LoadDynamics.seen` (N, m, 3), m, of the liquid or pendulum in each object; NaN without one.

    For a liquid: its height at the wall along x and y, and its highest point, above the level at rest.
    """
    out = np.full((len(trace.t), len(scene.loads), 3), np.nan)
    for i, swing in enumerate(scene.swings):
        load, count = scene.loads[swing.load], len(swing.qpos_ids)
        swung = trace.swung[:, i, :count]
        incline = np.tan(swung) * HINGE  # slope of each pendulum
        incline[..., 1 - swing.first] /= np.cos(swung[..., swing.first])
        # Average over the fastest time constant, because chattering contacts give short peaks of acceleration.
        own = 1 / load.modes.following
        accelerated = _rate(trace.t, trace.moved[:, i], own) - trace.pulled[:, i]
        force = np.einsum("tji,tj->ti", trace.R_XB[:, swing.load], accelerated)
        slope = force[:, :2] / np.maximum(force[:, 2:], LEAST_WEIGHT * GRAVITY)
        turned = np.cumsum(trace.turned[:, i, :2], axis=0) * (trace.t[1] - trace.t[0])
        turning = np.sum(_rate(trace.t, turned, own) ** 2, axis=1)
        out[:, swing.load] = load.inner.seen(load.inner_value, incline, slope, turning)
    return out


def _rate(t: Array, x: Array, seconds: float) -> Array:
    """Mean derivative of x (N, ...) over `seconds` around each instant, less at the ends."""
    k, half = np.arange(len(t)), max(1, round(0.5 * seconds / (t[1] - t[0])))
    before, after = np.maximum(k - half, 0), np.minimum(k + half, len(t) - 1)
    return np.asarray((x[after] - x[before]) / (t[after] - t[before])[:, None])


def judge(
    t: Array,
    seen: Behaviour,
    touches: Array,
    thresholds: Thresholds,
    loads: Sequence[Load],
    inner: Array,
) -> dict[str, Any]:
    """Summarise each object and the whole load from t = 0 on, until an object is lost.

    The outcome is the worst of tips, lifts, lost, spills, swings, slides, holds. first_*: time of the first instant
    over the threshold, or None. inner: (N, m, 3), see `inner_motions`.
    """
    moving = t >= -1e-9
    objects = []
    for k, load in enumerate(loads):
        kept = moving & ~np.logical_or.accumulate(seen.lost[:, k])
        at = t[kept]
        slip, lift, tip = seen.slip[kept, k], seen.lift[kept, k], seen.tip_angle[kept, k]
        events = {
            "first_slip": _first(at, slip > thresholds.slip),
            "first_lift": _first(at, lift > thresholds.lift),
            "first_tip": _first(at, tip > thresholds.tip),
            "lost_at": _first(t[moving], seen.lost[moving, k]),
        }
        swung: dict[str, Any] = {}
        if load.value is not None:
            size, edge = inner[kept, k, 2], float(load.edge)
            events[load.inner.event] = _first(at, size > edge)
            swung = {load.inner.peak: _largest(size), "room": edge if np.isfinite(edge) else None}
        objects.append(
            {
                "name": load.name,
                "outcome": next(
                    (word for word, event in WORST_FIRST.items() if events.get(event) is not None), "holds"
                ),
                "peak_slip": _largest(slip),
                "final_slip": float(slip[-1]) if len(slip) else None,
                "peak_creep": _largest(np.linalg.norm(seen.creep_E[kept, k], axis=-1)),
                "peak_lift": _largest(lift),
                "peak_tip_angle": _largest(tip),
                **swung,
                **events,
                "contact_lost": float(np.sum(~touches[moving, k]) * (t[1] - t[0])),
            }
        )
    order = [*WORST_FIRST, "holds"]
    worst = min(objects, key=lambda o: order.index(str(o["outcome"])))
    return {
        "outcome": worst["outcome"],
        "worst_object": worst["name"],
        "slides_at_rest": bool(np.any(seen.slip[~moving].max(axis=0, initial=0.0) > thresholds.slip)),
        "objects": objects,
        "thresholds": {"slip": thresholds.slip, "tip_angle": thresholds.tip, "lift": thresholds.lift},
    }


WORST_FIRST = {
    "tips": "first_tip",
    "lifts": "first_lift",
    "lost": "lost_at",
    "spills": "first_spill",
    "swings": "first_swing",
    "slides": "first_slip",
}


def _first(t: Array, happened: Array) -> float | None:
    return float(t[np.argmax(happened)]) if np.any(happened) else None


def _largest(x: Array) -> float:
    return float(np.max(x, initial=0.0))
