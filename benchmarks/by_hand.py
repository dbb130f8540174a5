"""What a moving tray asks of a loose object: sliding by Coulomb, rocking on two edges of its base (Housner 1963)."""

from __future__ import annotations

import numpy as np

from salver.simulation.outcome import Thresholds
from salver.simulation.scene.loads import Load
from salver.trajectory import Reference

GRAVITY = 9.81


def demand(item: Load, reference: Reference) -> float:
    """Of one object on a level tray that does not turn, B along S. Friction: |a_h| of mu (g + a_z). Tipping: where the
    resultant of weight and inertia meets the tray, against each edge of the base."""
    a = reference.sample(np.linspace(0, reference.duration, 2001)).a_S
    level, weight = a[:, :2], GRAVITY + a[:, 2]
    corners = item.outline_B - item.inertial.com_B
    height = -corners[:, 2].mean()
    sliding = np.linalg.norm(level, axis=1) / (item.friction * weight)
    base = corners[np.argsort(np.arctan2(corners[:, 1], corners[:, 0])), :2]
    edge = np.roll(base, -1, axis=0) - base
    outward = np.stack([edge[:, 1], -edge[:, 0]], axis=1)
    reach = np.sum(outward * base, axis=1)  # from the centre of mass to the edge, times its length
    tipping = -(height * level / weight[:, None]) @ outward.T / reach
    return float(max(sliding.max(), tipping.max()))


def rocking(item: Load, reference: Reference) -> float:
    """Peak angle, rad, of one object that does not slide, on a level tray that does not turn: rigid, it leaves its base
    over the edge that fails first, comes down on it again and goes over the opposite one (Housner, Bull. Seismol. Soc.
    Am. 53(2), 1963); an impact keeps the angular momentum about the new edge. A round base may also roll: for it this
    is a guide.
    """
    a = reference.sample(np.linspace(0, reference.duration, 2001)).a_S
    corners = item.outline_B - item.inertial.com_B
    height = -corners[:, 2].mean()
    base = corners[np.argsort(np.arctan2(corners[:, 1], corners[:, 0])), :2]
    edge = np.roll(base, -1, axis=0) - base
    outward = np.stack([edge[:, 1], -edge[:, 0]], axis=1) / np.linalg.norm(edge, axis=1)[:, None]
    reach = np.sum(outward * base, axis=1)
    first = int(np.argmax((-(height * a[:, :2] / (GRAVITY + a[:, 2])[:, None]) @ outward.T / reach).max(axis=0)))
    n = outward[first]
    reaches = {1: float(reach[first]), -1: float(reach[int(np.argmin(outward @ n))])}
    axis = np.array([-n[1], n[0], 0.0])
    own, mass = float(axis @ item.inertial.inertia_com @ axis), item.inertial.mass
    step = 2e-5
    t = np.arange(0, reference.duration + 0.3, step)
    a = reference.sample(np.minimum(t, reference.duration)).a_S * (t <= reference.duration)[:, None]
    angle, rate, side, peak = 0.0, 0.0, 0, 0.0  # leaning to `side`, by angle; at rest with side 0
    for push, weight in zip(a[:, :2] @ n, GRAVITY + a[:, 2], strict=True):
        if not side:
            side = next((s for s in (1, -1) if -s * push * height > weight * reaches[s]), 0)
            if not side:
                continue
        arm, other = reaches[side], reaches[-side]
        far = float(np.hypot(arm, height))
        up = np.arctan2(arm, height) - angle  # of the edge's line to the centre of mass, off the vertical
        rate += step * mass * far * (-side * push * np.cos(up) - weight * np.sin(up)) / (own + mass * far**2)
        angle += step * rate
        if angle <= 0:
            kept = (own + mass * (height**2 - arm * other)) / (own + mass * (height**2 + other**2))
            angle, rate, side = 0.0, -rate * max(kept, 0.0), -side
            if rate < 1e-4:
                rate, side = 0.0, 0
        peak = max(peak, angle)
        if peak > 0.6:
            break
    return peak


def slipping(item: Load, reference: Reference) -> float:
    """Peak way, m, of one object that does not tip, on a level tray along a straight line: Coulomb's friction, 1-D."""
    step = 1e-4
    a = reference.sample(np.arange(0, reference.duration, step)).a_S
    along = a[int(np.argmax(np.linalg.norm(a[:, :2], axis=1))), :2]
    x, u, peak = 0.0, 0.0, 0.0  # of the object against the tray
    for push, held in zip(-a[:, :2] @ along / np.linalg.norm(along), item.friction * (GRAVITY + a[:, 2]), strict=True):
        sense = np.sign(u) or np.sign(push) * (abs(push) > held)
        after = u + step * (push - held * sense) * bool(sense)
        u = 0.0 if after * sense < 0 else after
        x += step * u
        peak = max(peak, abs(x))
    return peak


def kept_by_hand(item: Load, reference: Reference) -> bool:
    """Whether a rigid object neither slides nor tips by as much as counts."""
    limits = Thresholds()
    return slipping(item, reference) < limits.slip and rocking(item, reference) < limits.tip
