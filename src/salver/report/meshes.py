"""Arm link meshes small enough to embed: loaded from the URDF, decimated, quantised to 16 bits."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.geometry import Array

if TYPE_CHECKING:
    from salver.models.arm import ArmModel

# Below this many triangles a link of the Panda visibly loses its shape; above it only the file grows.
TRIANGLES_PER_LINK = 1800
CAREFUL = 3  # of the simplifier's 0 to 10: 7, its default, leaves spikes of a millimetre on these links


@dataclass(frozen=True)
class LinkMesh:
    """One rigid piece of the arm, in the frame of its joint.

    joint: index of the joint it moves with; 0 is the fixed base, whose frame is the world's.
    vertices: (n, 3) m. triangles: (k, 3) indices. colour: (3,) 0 to 1.
    """

    name: str
    joint: int
    vertices: Array
    triangles: np.ndarray
    colour: tuple[float, float, float]


def link_meshes(arm: ArmModel, target: int = TRIANGLES_PER_LINK) -> list[LinkMesh]:
    """Visual meshes of the links from base to flange, about `target` triangles each.

    A URDF whose mesh files are not at hand gives an empty list: the replay then shows tray and objects alone.
    """
    import pinocchio as pin

    try:
        geometry = pin.buildGeomFromUrdfString(arm.pin_model, arm.urdf, pin.GeometryType.VISUAL)
    except (ValueError, RuntimeError):
        return []
    base = pin.SE3(pin.utils.rotate("z", arm.base_yaw), arm.base_position)
    meshes = []
    for item in geometry.geometryObjects:
        if not hasattr(item.geometry, "num_tris"):
            continue
        vertices, triangles = decimate(*_triangles_of(item), target)
        placement = item.placement if item.parentJoint else base * item.placement
        vertices = vertices @ placement.rotation.T + placement.translation
        colour = tuple(float(c) for c in item.meshColor[:3])
        meshes.append(LinkMesh(item.name, int(item.parentJoint), vertices, triangles, colour))  # type: ignore[arg-type]
    return meshes


def _triangles_of(item: Any) -> tuple[Array, np.ndarray]:
    """Vertices (n, 3) and triangles (k, 3) of a loaded mesh, equal vertices merged."""
    shape = item.geometry
    vertices = np.array(shape.vertices()) * np.asarray(item.meshScale)
    indices = (shape.tri_indices(i) for i in range(shape.num_tris))
    triangles = np.array([(t[0], t[1], t[2]) for t in indices])
    return merge_vertices(vertices, triangles)


def merge_vertices(vertices: Array, triangles: np.ndarray) -> tuple[Array, np.ndarray]:
    """Vertices within a micrometre made one, and triangles that lose a corner by it left out."""
    _, first, merged = np.unique(np.round(vertices, 6), axis=0, return_index=True, return_inverse=True)
    triangles = merged.reshape(-1)[triangles]
    a, b, c = triangles.T
    return vertices[first], triangles[(a != b) & (b != c) & (c != a)]


def decimate(vertices: Array, triangles: np.ndarray, target: int) -> tuple[Array, np.ndarray]:
    """At most about `target` triangles, by quadric edge collapse."""
    import fast_simplification

    if len(triangles) <= target:
        return vertices, triangles
    points, faces = fast_simplification.simplify(
        vertices.astype(np.float32), triangles.astype(np.int32), target_count=target, agg=CAREFUL
    )
    return np.asarray(points, dtype=float), np.asarray(faces)


def pack(mesh: LinkMesh) -> dict[str, Any]:
    """For the page: positions in 16 bits over the bounding box, indices in 16 bits, both base64, little-endian."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    quantised = np.round((mesh.vertices - low) / span * 65535).astype("<u2")
    return {
        "name": mesh.name,
        "joint": mesh.joint,
        "low": [round(float(x), 6) for x in low],
        "span": [round(float(x), 6) for x in span],
        "vertices": base64.b64encode(quantised.tobytes()).decode(),
        "triangles": base64.b64encode(mesh.triangles.astype("<u2").tobytes()).decode(),
        "colour": [round(c, 3) for c in mesh.colour],
    }
