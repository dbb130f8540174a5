"""Data of the 3-D replay: poses of links, tray and objects over time, contact points and forces."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from salver.geometry import GRAVITY_S, Array, interpolated, invert, matrix_from_quat_wxyz, quat_wxyz_from_matrix, spread
from salver.models.bodies import Body
from salver.models.load_dynamics import Drawn, LoadDynamics
from salver.models.shapes import hulls
from salver.models.uncertain.parameters import Parameter
from salver.reports.pages.meshes import cell_meshes, decimate, link_meshes, obstacle_meshes, pack
from salver.reports.style import OBJECT_COLOURS, ROLE_COLOURS, TRAY_COLOUR, rgb
from salver.scenario.objects import Shape, smooth
from salver.simulation.record import drawn_inside
from salver.simulation.scene.loads import WALL_OPACITY, true_world

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.reports.run import ReportedMotion, ReportedRun
    from salver.scenario import Scenario, Tray


def stage(
    scenario: Scenario, bodies: Sequence[Body], arm: ArmModel | None, links: list[dict[str, Any]]
) -> dict[str, Any]:
    """Arm, tray, objects and obstacles for the viewer before anything moves, ready for JSON. links: packed."""
    first, tray = bodies[0], scenario.tray
    flange_E = invert(arm.p_FE, arm.R_FE)[0] if arm else np.array([0.0, 0.0, -tray.height])
    return {
        "meshes": links,
        "obstacles": [pack(mesh) for mesh in cell_meshes(scenario)],
        "joints": arm.n + 1 if arm else 1,
        "tray": {
            "size": list(tray.size),
            "boxes": tray.boxes,
            "post": _post(tray, flange_E),
            "colour": rgb(TRAY_COLOUR),
        },
        "objects": [
            {"name": body.name} | _outline(body, item.shape, OBJECT_COLOURS[i % len(OBJECT_COLOURS)])
            for i, (body, item) in enumerate(zip(bodies, scenario.objects, strict=True))
        ],
        "contacts": {
            "normal": first.contacts.R_BC[0, :, 2].tolist(),
            "owner": first.name,
            "coneHeight": 0.03,  # m
        },
        "edge": dict(zip(("kept", "beyond"), Drawn.edge_colours, strict=True)),
        "wallOpacity": WALL_OPACITY,
        "loadHeight": max(float(b.p_EB[2] - b.com_G[2] + b.solid.base_z + b.solid.height) for b in bodies),
    }


def _post(tray: Tray, flange_E: Array) -> list[list[float]]:
    """Points, m in E, of the drawn bracket from the flange (3,) to the tray: a straight line from below; from above a
    line around the tray's edge, because the load is between flange and tray."""
    x, y, z = flange_E.tolist()
    if z <= 0.0:
        return [[x, y, z], [0.0, 0.0, -tray.thickness]]
    beside, low = float(np.copysign(0.5 * tray.outer[0] + 0.04, x)), -tray.thickness - 0.04  # 29 mm: the post's radius
    return [[x, y, z], [beside, y, z], [beside, y, low], [0.0, 0.0, low], [0.0, 0.0, -tray.thickness]]


def replay_scene(run: ReportedRun, arm: ArmModel | None) -> dict[str, Any]:
    """Everything that the viewer draws, ready for JSON; arrays are float32 in base64, time first."""
    variants, reach = [_variant(motion, run, arm) for motion in run.motions], np.zeros((0, 3))
    if arm:
        joints = [joint_poses(m.arrays["q"][:: max(1, len(m.t) // 8)], arm)[..., :3] for m in run.motions]
        reach = np.vstack([arm.base_position, *(p.reshape(-1, 3) for p in joints)])
    return {
        **stage(run.scenario, run.bodies, arm, [pack(mesh) for mesh in link_meshes(arm)] if arm else []),
        "variants": variants,
        **viewpoint([m.arrays["p_SB"] for m in run.motions], reach, run.scenario),
        "start": min(float(v["t"][0]) for v in variants),
        "duration": max(float(v["t"][-1]) for v in variants),
    }


def still(
    key: str, colour: str, bodies: Sequence[Body], tray: tuple[Array, Array], joints: Array, path: list[list[float]]
) -> dict[str, Any]:
    """A variant for the viewer that does not move, without contacts: the tray at (p_SE, R_SE), its load on it, what
    swings hanging.

    joints: (n + 1, 7), as `joint_poses`. path: points of a line that is drawn, m.
    """
    p_SE, R_SE = tray
    return {
        "key": key,
        "colour": rgb(colour),
        "t": [0.0],
        "joints": packed(joints),
        "tray": packed([*p_SE, *quat_wxyz_from_matrix(R_SE)]),
        "objects": packed(_on_tray(p_SE[None], R_SE[None], bodies)),
        "inside": [None if b.inner is None else _at_rest(b, b.inner, R_SE) for b in bodies],
        "path": path,
    }


def _at_rest(body: Body, inner: LoadDynamics, R_SE: Array) -> dict[str, Any]:
    up_B = (R_SE @ body.R_EB)[2]
    slope = up_B[None, :2] / max(float(up_B[2]), 0.1)  # of one that has fallen over nothing is drawn
    return inside(inner.drawn(body, inner.value, inner.at_rest(inner.value, slope), None), np.array([0]))


def viewpoint(paths: Sequence[Array], arm: Array, scenario: Scenario) -> dict[str, Any]:
    """Where the camera looks from: the first path runs across the picture, the arm behind it, seen a little obliquely.

    paths: of the load, (N, 3) m each. arm (K, 3): its base, and where its joints are seen; none without one. In the
    picture are these, and as much of the obstacles as is within 0.3 m; the floor is a little below them where the
    scenario has none.
    """
    points, base = np.vstack(paths), arm[0, :2] if len(arm) else paths[0][:, :2].mean(axis=0) - [1.0, 0.0]
    low, high = np.vstack([points - 0.12, arm]).min(axis=0), np.vstack([points + 0.12, arm]).max(axis=0)
    if scenario.obstacles:
        corners = np.vstack([mesh.vertices for mesh in obstacle_meshes(scenario.obstacles)])
        low = np.minimum(low, np.maximum(corners.min(axis=0), low - 0.3))
        high = np.maximum(high, np.minimum(corners.max(axis=0), high + 0.3))
    path = paths[0][:, :2]
    along, outward = path[-1] - path[0], path.mean(axis=0) - base
    across = np.array([-along[1], along[0]]) if np.linalg.norm(along) > 0.05 else outward
    across = across if across @ outward >= 0 else -across
    return {
        "bounds": [low.tolist(), high.tolist()],
        "floor": float(low[2]) - 0.3 if scenario.floor is None else scenario.floor,
        "azimuth": float(np.arctan2(across[1], across[0])) + 0.45,  # rad
    }


def _variant(motion: ReportedMotion, run: ReportedRun, arm: ArmModel | None) -> dict[str, Any]:
    body, record = run.bodies[0], motion.seen
    source = record.arrays if record else motion.arrays
    t = source["t"]
    keep = spread(len(t), int(np.ceil((t[-1] - t[0]) * 60.0)) + 1)  # about 60 a second: the viewer interpolates
    tray, objects = poses(motion, run.bodies, keep)
    p, R = objects[:, 0, :3], matrix_from_quat_wxyz(objects[:, 0, 3:])
    if "contact_forces_B" in source:
        points_B, forces_B = source["contact_points_B"], source["contact_forces_B"][keep]
    else:
        points_B, forces_B = body.contacts.p_BC, interpolated(motion.t, contact_forces_B(motion, body), t[keep])
    contacts = p[:, None] + np.einsum("tij,cj->tci", R, points_B)
    return {
        "key": motion.stem,
        "label": motion.label,
        "about": motion.planned_for(ranges=run.scenario.payload.uncertain.size > 0),
        "colour": rgb(ROLE_COLOURS[motion.stem]),
        "source": "plan" if record is None else "run",
        "t": np.round(t[keep], 5).tolist(),
        "joints": packed(joint_poses(source["q"][keep], arm)) if arm else packed(np.tile(IDENTITY, (len(keep), 1))),
        "tray": packed(tray),
        "objects": packed(objects),
        "contactCount": len(points_B),
        "friction": _true_friction(motion, body, lone=len(run.bodies) == 1),
        # An arrow of 24 mm at rest.
        "metresPerNewton": 0.024 * len(points_B) / (body.inertial.mass * abs(GRAVITY_S[2])),
        "contacts": packed(contacts),
        "forces": packed(np.einsum("tij,tcj->tci", R, forces_B)),
        "inside": [each and inside(each, keep) for each in drawn(motion, run)],
        "path": np.round(p[spread(len(p), 90)], 5).tolist(),
    }


def poses(motion: ReportedMotion, bodies: Sequence[Body], keep: np.ndarray) -> tuple[Array, Array]:
    """(K, 7) and (K, m, 7) in S: tray and objects of a motion, as they were seen in its run or else as it is planned,
    at those of its samples."""
    record = motion.seen
    if record is None:
        R_SE = motion.R_SB[keep] @ bodies[0].R_EB.T
        p_SE = motion.arrays["p_SB"][keep] - R_SE @ bodies[0].p_EB
        return np.hstack([p_SE, quat_wxyz_from_matrix(R_SE)]), _on_tray(p_SE, R_SE, bodies)
    source = record.arrays
    tray = np.hstack([source["p_SE"], source["quat_SE_wxyz"]])[keep]
    objects = _on_tray(tray[:, :3], matrix_from_quat_wxyz(tray[:, 3:]), bodies)
    if "p_SB" in source:
        objects = np.concatenate([source["p_SB"], source["quat_SB_wxyz"]], axis=2)[keep]
    return tray, objects


def drawn(motion: ReportedMotion, run: ReportedRun) -> list[Drawn | None]:
    """What moves inside each object as the engine saw it, as planned where nothing was run; a real arm sees none.
    Of a given motion whose samples were thinned it is not known, for it is quicker than what is left of them."""
    out: list[Drawn | None] = [None] * len(run.bodies)
    if not run.scenario.payload.dynamic or motion.summary.get("thinned"):
        return out
    if motion.seen is not None:
        arrays, summary = motion.seen.arrays, motion.seen.summary
        if not np.size(arrays.get("surface", ())):
            return out
        return drawn_inside(true_world(run.scenario, summary.get("parameters")).loads, arrays["surface"], summary)
    planned = run.loads(motion)
    assert planned is not None
    for k, body in enumerate(run.bodies):
        if body.inner is not None:
            seen = planned.nominal[body.name][0].modes.seen[0]
            over = seen[:, 2] > body.inner.edge(body.inner.value)
            beyond = float(motion.t[np.argmax(over)]) if np.any(over) else None
            out[k] = body.inner.drawn(body, body.inner.value, seen[:, :2], beyond)
    return out


def inside(each: Drawn, keep: np.ndarray) -> dict[str, Any]:
    """The drawing of an object's load dynamics, in B: shape and its motion, its limit, and when it exceeded that, s."""
    page = each.page(keep)
    return page | {
        "moves": packed(page["moves"]),
        "edge": np.round(each.edge_B, 6).tolist(),
        "beyond": each.beyond,
        "colour": each.colour,
    }


def _true_friction(motion: ReportedMotion, body: Body, lone: bool) -> float:
    """Friction of the run that is shown, which may differ from the plan's."""
    changed = (motion.seen.summary.get("parameters") or {}) if motion.seen else {}
    return float(changed.get(Parameter(body.name, "friction", lone=lone).name, body.friction))


IDENTITY = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


def contact_forces_B(motion: ReportedMotion, body: Body) -> Array:
    """(T, n_c, 3) planned force of each contact on the object, in B: Lambda through the cone edges, eqs (4), (5)."""
    edges = body.contacts.edges
    coefficients = motion.arrays["cone_coefficients"][:, : edges * body.contacts.count]
    forces_C = (coefficients @ body.contacts.cone_edges.T).reshape(len(coefficients), -1, 3)
    return np.einsum("cij,tcj->tci", body.contacts.R_BC, forces_C)


def _on_tray(p_SE: Array, R_SE: Array, objects: Sequence[Body]) -> Array:
    """Poses (T, m, 7) of objects that stay where they stand on a tray with poses (T, 3), (T, 3, 3)."""
    poses = [np.hstack([p_SE + R_SE @ b.p_EB, quat_wxyz_from_matrix(R_SE @ b.R_EB)]) for b in objects]
    return np.stack(poses, axis=1)


def joint_poses(q: Array, arm: ArmModel) -> Array:
    """(T, n + 1, 7) poses in S of the frames that the link meshes are given in; the first is the world."""
    import pinocchio as pin

    poses = np.tile(IDENTITY, (len(q), arm.n + 1, 1))
    for k, joints in enumerate(q):
        pin.forwardKinematics(arm.pin_model, arm.data, joints)
        for j in range(1, arm.n + 1):
            placement = arm.data.oMi[j]
            poses[k, j, :3] = placement.translation
            poses[k, j, 3:] = quat_wxyz_from_matrix(placement.rotation)
    return poses


def _outline(body: Body, shape: Shape, colour: str) -> dict[str, Any]:
    """Outline of an object in B: an upright prism, a mesh, or the hull of anything else."""
    kind = shape.type
    offset = -body.com_G
    if kind in ("box", "cylinder", "cone", "prism"):
        solid = smooth(shape, 48)
        low = body.solid.base_z + offset[2]
        return {
            "polygon": np.round(solid.base_polygon + offset[:2], 6).tolist(),
            "top": np.round(solid.top_polygon + offset[:2], 6).tolist(),
            "low": float(low),
            "high": float(low + body.solid.height),
            "open": body.inner is not None and body.inner.open,
            "colour": rgb(colour),
        }
    points, triangles = body.solid.bounding_points_G, hulls.triangles(body.solid.bounding_points_G)
    if body.solid.surface is not None:
        points, triangles = decimate(*body.solid.surface, 3000)
    return {"points": np.round(points + offset, 6).tolist(), "triangles": triangles.tolist(), "colour": rgb(colour)}


def packed(values: npt.ArrayLike) -> str:
    """Numbers for the viewer: float32 in base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f4").tobytes()).decode()
