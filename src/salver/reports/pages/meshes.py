"""Meshes of links and obstacles small enough to embed: decimated, quantised to 16 bits."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.geometry import Array, matrix_from_rpy
from salver.models.described import Wall
from salver.models.shapes.obstacle_shapes import obstacle_shapes
from salver.models.shapes.surfaces import Surface, surface
from salver.reports.style import OBSTACLE_COLOUR, rgb

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.scenario import Obstacle, Scenario


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
    colour: Sequence[float]


def link_meshes(arm: ArmModel, most: int = 2200) -> list[LinkMesh]:
    """Meshes of the links from base to flange, each `decimate`d to `most` triangles."""
    import pinocchio as pin
    from scipy.spatial import cKDTree

    from salver.simulation.scene.meshes import arm_meshes

    meshes = []
    for link, parts in arm_meshes(arm).items():
        frame = arm.pin_model.frames[arm.pin_model.getFrameId(link, pin.FrameType.BODY)]
        fine = merge_vertices(*joined((part.vertices, part.faces) for part in parts))
        vertices, triangles = decimate(*fine, target=most)  # all colours together, so that no seam opens
        colours = [part.colour for part in parts]
        which = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
        middles = np.vstack([part.vertices[part.faces].mean(axis=1) for part in parts])
        nearest = which[cKDTree(middles).query(vertices[triangles].mean(axis=1))[1]]
        placed = vertices @ frame.placement.rotation.T + frame.placement.translation
        for colour in dict.fromkeys(colours):
            own = triangles[np.isin(nearest, [k for k, other in enumerate(colours) if other == colour])]
            used, renumbered = np.unique(own, return_inverse=True)
            if len(own):
                meshes.append(LinkMesh(link, int(frame.parentJoint), placed[used], renumbered.reshape(-1, 3), colour))
    return meshes


def obstacle_meshes(obstacles: Iterable[Obstacle]) -> list[LinkMesh]:
    """Obstacles as they are compared with the arm, in the world."""
    meshes = []
    for obstacle in obstacles:
        pieces = [surface(shape, placement) for shape, placement in obstacle_shapes(obstacle)]
        vertices, triangles = decimate(*joined(pieces))
        meshes.append(LinkMesh(obstacle.name, 0, vertices, triangles, rgb(OBSTACLE_COLOUR)))
    return meshes


def cell_meshes(scenario: Scenario, thick: float = 0.008) -> list[LinkMesh]:
    """Obstacles, and the edges of the keep-in box as bars so thick, m."""
    meshes, room = obstacle_meshes(scenario.obstacles), scenario.surroundings.keep_in
    if room is not None:
        import coal
        import pinocchio as pin

        R, size, bars = matrix_from_rpy(np.deg2rad(room.rpy_deg)), np.array(room.size), []
        for along, across in product(np.eye(3), product((-0.5, 0.5), repeat=2)):
            middle = np.zeros(3)
            middle[along == 0.0] = across
            placement = pin.SE3(R, np.array(room.position) + R @ (middle * size))
            bars.append(surface(coal.Box(*(along * size + thick)), placement))
        meshes.append(LinkMesh(Wall.name, 0, *joined(bars), rgb(OBSTACLE_COLOUR)))
    return meshes


def joined(surfaces: Iterable[Surface]) -> Surface:
    """Several surfaces as one."""
    vertices, triangles, count = [], [], 0
    for points, faces in surfaces:
        vertices.append(points)
        triangles.append(np.asarray(faces) + count)
        count += len(points)
    return np.vstack(vertices), np.vstack(triangles)


def merge_vertices(vertices: Array, triangles: np.ndarray) -> tuple[Array, np.ndarray]:
    """Vertices within a micrometre made one, and triangles that lose a corner by it left out."""
    _, first, merged = np.unique(np.round(vertices, 6), axis=0, return_index=True, return_inverse=True)
    triangles = merged.reshape(-1)[triangles]
    a, b, c = triangles.T
    return vertices[first], triangles[(a != b) & (b != c) & (c != a)]


def decimate(vertices: Array, triangles: np.ndarray, target: int = 2200) -> tuple[Array, np.ndarray]:
    """At most about `target` triangles, by quadric edge collapse. With fewer a link of the Panda visibly loses its
    shape; with more only the file grows."""
    import fast_simplification

    if len(triangles) <= target:
        return vertices, triangles
    points, faces = fast_simplification.simplify(  # agg of 7, its default, leaves spikes of a millimetre on links
        vertices.astype(np.float32), triangles.astype(np.int32), target_count=target, agg=3
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
