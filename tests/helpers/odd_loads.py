"""Loads that hide no mistake, and what they really need: Newton and Euler's laws in world axes, nothing of salver's.

Nothing here is symmetric: rectangles of unequal sides, each turned by an angle of its own, off the tray's centre, with
a centre of mass beside the middle, products of inertia, an uncertain place and a tilted tray; sets are boxes or
ellipsoids whose parameters are correlated, across objects too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from salver.geometry import Array
from salver.models.arm.arm import ArmModel
from salver.models.bodies import Body
from salver.models.contact.contact import support_contacts
from salver.models.contact.wrench_cone import cone_facets
from salver.scenario import Scenario, load
from salver.trajectory import MotionSamples

G = 9.81
RANGES = {
    "mass": "15%",
    "com": [0.004, 0.003, 0.006],
    "inertia": [8e-5, 2e-5, 5e-5, 2e-5, 3e-5, 6e-5],
    "friction": 0.05,
    "position": [0.003, 0.005],
}
LOWER = {
    "name": "lower",
    "shape": {"type": "box", "size": [0.12, 0.08, 0.05]},
    "mass": 0.5,
    "com": [0.006, -0.004, 0.003],
    "inertia": [5e-4, -6e-5, 9e-4, 5e-5, 7e-5, 1.1e-3],
    "friction": 0.6,
    "at": [0.02, -0.015],
    "yaw_deg": 25.0,
    "uncertainty": RANGES,
}
UPPER = {
    "name": "upper",
    "shape": {"type": "box", "size": [0.05, 0.1, 0.07]},
    "mass": 0.3,
    "com": [-0.003, 0.005, -0.006],
    "inertia": [4.5e-4, 4e-5, 2.2e-4, -3e-5, 5e-5, 3.5e-4],
    "friction": 0.7,
    "on": "lower",
    "at": [0.028, -0.008],
    "yaw_deg": -35.0,
    "uncertainty": RANGES | {"mass": "20%", "position": [0.004, 0.002]},
}
BESIDE = {**UPPER, "name": "beside", "on": "tray", "at": [-0.047, 0.042], "yaw_deg": 40.0}
BESIDE_LOWER = {**LOWER, "at": [0.028, -0.036]}  # nearer to the edge of the tray than it may shift


def scenario(objects: Sequence[dict], kind: str = "box", **changes: object) -> Scenario:
    """A Panda that carries these on a tilted tray. kind: of the set; an ellipsoid is correlated."""
    several = len(objects) > 1
    first, last = (f"{o['name']}." if several else "" for o in (objects[0], objects[-1]))
    pairs = {
        f"{first}mass,{first}com_x": 0.5,
        f"{first}com_x,{first}com_z": -0.6,
        f"{last}com_y,tilt_x": 0.4,
        f"{last}position_x,tilt_y": -0.5,
        f"{last}position_y,{first}com_y" if several else f"{last}position_y,{first}inertia_yy": 0.3,
    }
    given = {"set": kind, "tilt_deg": [1.0, 1.5], "correlation": pairs if kind == "ellipsoid" else {}}
    known = {name for o in objects for name in o.get("uncertainty", {})}
    if "tilt_deg" in changes or not {"mass", "com", "position", "inertia"} <= known:
        given["correlation"] = {}
    return load("panda-cube").with_changes(
        objects=[{"uncertainty": {}} | item for item in objects],
        uncertainty=given,
        arm__start_posture=None,
        motion__goal_yaw="fixed",
        **changes,
    )


def stack(kind: str = "box", **changes: object) -> Scenario:
    """One yawed box on another."""
    return scenario([LOWER, UPPER], kind, **changes)


def small(made: Scenario, share: float) -> Scenario:
    """The same with this share of every half-range but those of friction and place, which are no matter of slopes."""
    changes: dict[str, object] = {"uncertainty__tilt_deg": [share * x for x in made.uncertainty.tilt_deg or (0, 0)]}
    for k, item in enumerate(made.objects):
        for key in ("com", "inertia"):
            changes[f"objects__{k}__uncertainty__{key}"] = [share * x for x in getattr(item.uncertainty, key)]
        changes[f"objects__{k}__uncertainty__mass"] = share * item.uncertainty.mass.relative * item.mass
    return made.with_changes(**changes)


def pair(kind: str = "box", **changes: object) -> Scenario:
    """Two yawed boxes side by side."""
    return scenario([BESIDE_LOWER, BESIDE], kind, **changes)


def single(kind: str = "box", **changes: object) -> Scenario:
    return scenario([{**LOWER, "name": "box"}], kind, **changes)


def tray_motion(count: int, seed: int = 0, turning: float = 1.0, push: float = 1.0) -> MotionSamples:
    """Random instants of the tray frame E."""
    rng = np.random.default_rng(seed)
    turns = np.array([rotation(x) for x in 0.15 * turning * rng.normal(size=(count, 3))])
    zero = np.zeros((count, 3))
    return MotionSamples(
        np.arange(count, dtype=float),
        zero,
        zero,
        push * rng.normal(size=(count, 3)) * [1.5, 1.5, 1.0],
        turns,
        turning * rng.normal(size=(count, 3)),
        4 * turning * rng.normal(size=(count, 3)),
    )


def rotation(vector: Sequence[float] | Array) -> Array:
    """Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = np.asarray(vector) / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


# What a load really needs --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrueBody:
    """A body as it is: mass kg, c_E and I_E about its centre of mass (axes of E), place of its frame B in E."""

    mass: float
    c_E: Array
    I_E: Array
    p_EB: Array
    R_EB: Array


def true_body(made: Scenario, body: Body, change: dict[str, float]) -> TrueBody:
    """A body whose parameters deviate by `change` (full names) from nominal, on a tray that is tilted so."""
    own = f"{body.name}." if len(made.objects) > 1 else ""

    def by(name: str) -> float:
        return change.get(own + name, 0.0)

    item = next(o for o in made.objects if o.name == body.name)
    given = np.array(item.inertia)
    six = given if len(given) == 6 else np.array([given[0], 0, given[1], 0, 0, given[2]])
    xx, xy, yy, xz, yz, zz = six + [by(f"inertia_{s}") for s in ("xx", "xy", "yy", "xz", "yz", "zz")]
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    tilt = rotation([change.get("tilt_x", 0.0), change.get("tilt_y", 0.0), 0.0])
    yaw = rotation([0.0, 0.0, np.deg2rad(item.yaw_deg)])
    # On its support: half the height above it, and the stated centre of mass beside the middle of the shape.
    height, floor, below = item.shape.size[2], 0.0, item.on
    while below != "tray":
        support = next(o for o in made.objects if o.name == below)
        floor, below = floor + support.shape.size[2], support.on
    middle = np.array([*item.at, floor + 0.5 * height])
    p = middle + yaw @ np.array(item.com) + np.array([by("position_x"), by("position_y"), 0.0])
    turn = tilt @ yaw
    c = tilt @ (p + yaw @ np.array([by("com_x"), by("com_y"), by("com_z")]))
    return TrueBody(item.mass + by("mass"), c, turn @ inertia @ turn.T, tilt @ p, turn)


def felt(motion: MotionSamples) -> Array:
    """(T, 12) what a frame feels: specific force, angular acceleration, and xx, xy, yy, xz, yz, zz of omega omega^T."""
    force = np.einsum("tji,tj->ti", motion.R_SB, motion.a_S + np.array([0, 0, G]))
    x, y, z = motion.omega_B.T
    return np.column_stack([force, motion.alpha_B, x * x, x * y, y * y, x * z, y * z, z * z])


_CROSS = np.zeros((3, 3, 3))
_CROSS[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_CROSS[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = -1.0


def needed_at_E(body: TrueBody, w: Array) -> Array:
    """(T, 6) force and moment about E's origin, axes of E, of a body that rests on a tray which feels w (T, 12)."""
    spin = w[:, [6, 7, 9, 7, 8, 10, 9, 10, 11]].reshape(-1, 3, 3)  # omega omega^T
    centripetal = spin @ body.c_E - np.trace(spin, axis1=1, axis2=2)[:, None] * body.c_E
    force = body.mass * (w[:, :3] + np.cross(w[:, 3:6], body.c_E) + centripetal)
    gyroscopic = np.einsum("ijk,tjl,kl->ti", _CROSS, spin, body.I_E)
    moment = np.cross(body.c_E, force) + w[:, 3:6] @ body.I_E + gyroscopic
    return np.hstack([force, moment])


def at_B(wrench_E: Array, body: TrueBody) -> Array:
    """(T, 6) the same wrench about the body's own frame B, in it."""
    force = wrench_E[:, :3]
    moment = wrench_E[:, 3:] - np.cross(body.p_EB, force)
    return np.hstack([force @ body.R_EB, moment @ body.R_EB])


def interface_wrenches(made: Scenario, change: dict[str, float], w: Array) -> list[Array]:
    """(T, 6) for each object: what its support must give, about the object's own frame B, in it."""
    true = {body.name: true_body(made, body, change) for body in made.payload.bodies}
    need = {name: needed_at_E(body, w) for name, body in true.items()}
    return [at_B(sum(need[n] for n in carried_by(made, item.name)), true[item.name]) for item in made.objects]


def carried_by(made: Scenario, name: str) -> list[str]:
    """The object and all that stands on it."""
    found = [name]
    for item in made.objects:
        if item.on in found:
            found.append(item.name)
    return found


def clipped(polygon: Array, clip: Array) -> Array:
    """Convex polygons (n, 2), counter-clockwise: their common part, by Sutherland and Hodgman."""
    out = [np.asarray(p) for p in polygon]
    for a, b in zip(clip, np.roll(clip, -1, axis=0), strict=True):
        normal = np.array([b[1] - a[1], a[0] - b[0]])  # outwards
        inside = [normal @ (p - a) <= 1e-12 for p in out]
        new: list[Array] = []
        for k, p in enumerate(out):
            q, p_in, q_in = out[(k + 1) % len(out)], inside[k], inside[(k + 1) % len(out)]
            if p_in:
                new.append(p)
            if p_in != q_in:
                share = normal @ (a - p) / (normal @ (q - p))
                new.append(p + share * (q - p))
        out = new
    return np.array(out)


def rectangle(item: object) -> Array:
    """(4, 2) corners in E, counter-clockwise, of a box seen from above."""
    x, y, _ = item.shape.size  # type: ignore[attr-defined]
    corners = 0.5 * np.array([[x, y], [-x, y], [-x, -y], [x, -y]])
    return corners @ rotation([0, 0, np.deg2rad(item.yaw_deg)])[:2, :2].T + item.at  # type: ignore[attr-defined]


def sure_points_B(made: Scenario, name: str) -> Array:
    """(n, 3) corners, in B, of the base of a box that stays supported wherever it and its support stand."""
    item = next(o for o in made.objects if o.name == name)
    below = next((o for o in made.objects if o.name == item.on), None)
    half = np.zeros(2) + (item.uncertainty.position or 0.0)
    if below is None:
        surface = 0.5 * np.array(made.tray.size) * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
    else:
        surface = rectangle(below)
        half += below.uncertainty.position or 0.0
    region = rectangle(item)
    for sign in ([1, 1], [1, -1], [-1, 1], [-1, -1]) if half.any() else ([0, 0],):
        region = clipped(region, surface + np.array(sign) * half)
    # The part of the contact that is there at rest, in the nominal place.
    region = clipped(region, surface)
    yaw = rotation([0, 0, np.deg2rad(item.yaw_deg)])
    flat = (region - item.at) @ yaw[:2, :2]
    base = np.column_stack([flat, np.full(len(flat), -0.5 * item.shape.size[2])])
    return base - np.array(item.com)


class TrueRows:
    """For each object, the facets of its sure contact with least friction, at the wrench it truly needs, N."""

    def __init__(self, made: Scenario, edges: int | None = None) -> None:
        self.made, self.items, self.uncertain = made, made.payload.bodies, made.payload.uncertain
        self.above = {item.name: carried_by(made, item.name) for item in made.objects}
        self._known: dict[Any, tuple[TrueBody, Array, Array]] = {}
        self.facets = []
        for body in self.items:
            points = sure_points_B(made, body.name)
            contacts = support_contacts(points, made.payload.least_friction(body), edges or made.contact.edges)
            self.facets.append(cone_facets(contacts).rows)

    def at(self, change: dict[str, float], w: Array, weight: dict[str, float] | None = None) -> list[Array]:
        """(T, n_f) for each object, as a share of the normal force at rest: above 0 the contact fails.

        weight: the deviations at which that normal force is taken; those of `change` unless given.
        """
        at, found = change if weight is None else weight, []
        for body, rows in zip(self.items, self.facets, strict=True):
            above = [item for item in self.items if item.name in self.above[body.name]]
            need = sum(self._maps(item, change)[1] for item in above)
            heavy = G * sum(self._maps(item, at)[0].mass for item in above)
            found.append(w @ (rows @ self._maps(body, change)[2] @ need).T / heavy)
        return found

    def _maps(self, body: Body, change: dict[str, float]) -> tuple[TrueBody, Array, Array]:
        """The body as it is, and as matrices what it needs of w at E (6, 12), and a wrench at E at B (6, 6)."""
        own = f"{body.name}." if len(self.made.objects) > 1 else ""
        key = (body.name, *sorted(each for each in change.items() if each[0].startswith((own, "tilt"))))
        if key not in self._known:
            true = true_body(self.made, body, change)
            self._known[key] = true, needed_at_E(true, np.eye(12)).T, at_B(np.eye(6), true).T
        return self._known[key]

    def worst(self, change: dict[str, float], w: Array, weight: dict[str, float] | None = None) -> Array:
        """(T,) the largest of all."""
        return np.hstack(self.at(change, w, weight)).max(axis=1)


# What an arm needs, by Pinocchio ---------------------------------------------------------------------------------


def with_bodies(arm: ArmModel, carried: Sequence[TrueBody]) -> Any:
    """Pinocchio's model of arm and tray with these bodies bolted to the tray."""
    model = arm.pin_model.copy()
    frame = model.frames[arm.tray_id]
    for body in carried:
        inertia = pin.Inertia(body.mass, body.c_E, body.I_E)
        model.appendBodyToJoint(frame.parentJoint, inertia, frame.placement)
    return model


def torques(model: Any, q: Array, dq: Array, ddq: Array) -> Array:
    """(T, n) N m."""
    data = model.createData()
    return np.array([pin.rnea(model, data, *state) for state in zip(q, dq, ddq, strict=True)])


def true_bodies(made: Scenario, change: dict[str, float]) -> list[TrueBody]:
    return [true_body(made, body, change) for body in made.payload.bodies]


def nominal_bodies(made: Scenario) -> list[TrueBody]:
    return true_bodies(made, {})


def mass_matrices(model: Any, q: Array) -> Array:
    """(T, n, n) column by column from inverse dynamics: what a unit acceleration of each joint takes at rest."""
    still = np.zeros_like(q)
    weight = torques(model, q, still, still)
    columns = [torques(model, q, still, still + unit) - weight for unit in np.eye(q.shape[1])]
    return np.stack(columns, axis=2)
