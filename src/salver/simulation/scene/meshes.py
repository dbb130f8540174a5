"""Visual meshes of an arm's links, including COLLADA, which MuJoCo does not read; else their collision shapes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from salver.geometry import Array, Indices, matrix_from_rpy
from salver.models.arm.arm import ArmModel
from salver.models.arm.link_shapes import link_shapes
from salver.models.shapes.mesh_files import LARGEST, read_mesh_file
from salver.models.shapes.surfaces import surface

WHITE = (0.93, 0.93, 0.95)
GREY = (0.72, 0.76, 0.80)


@dataclass(frozen=True)
class MeshPart:
    """Triangles of one colour: vertices (n, 3) m, in the link's frame; faces (k, 3); colour (3,) from 0 to 1."""

    vertices: Array
    faces: Indices
    colour: tuple[float, float, float]


def arm_meshes(arm: ArmModel) -> dict[str, list[MeshPart]]:
    """Mesh parts by link: the visual meshes (.dae, .stl, .obj) or, if none can be read, the shapes of the collision
    checks. Links of unknown shape are left out."""
    meshes: dict[str, list[MeshPart]] = {}
    for link in ElementTree.fromstring(arm.urdf).iter("link"):
        for visual in link.findall("visual"):
            mesh = visual.find("geometry/mesh")
            if mesh is None or not Path(mesh.get("filename", "")).is_file():
                continue
            scale = np.array([float(x) for x in mesh.get("scale", "1 1 1").split()])
            origin = visual.find("origin")
            rotation, position = np.eye(3), np.zeros(3)
            if origin is not None:
                rotation = matrix_from_rpy([float(x) for x in origin.get("rpy", "0 0 0").split()])
                position = np.array([float(x) for x in origin.get("xyz", "0 0 0").split()])
            for part in read_mesh(mesh.get("filename", "")):
                vertices = (part.vertices * scale) @ rotation.T + position
                meshes.setdefault(link.get("name", ""), []).append(MeshPart(vertices, part.faces, part.colour))
    seen = set(meshes)
    for item in link_shapes(arm.urdf, capsules=arm.collisions == "capsules").shapes:
        if item.link not in seen:
            meshes.setdefault(item.link, []).append(MeshPart(*surface(item.shape, item.placement), GREY))
    return meshes


@lru_cache(maxsize=64)
def read_mesh(filename: str) -> tuple[MeshPart, ...]:
    """Parts of a mesh file; none if it cannot be read."""
    try:
        if filename.lower().endswith(".dae"):
            if Path(filename).stat().st_size > LARGEST:
                return ()
            return tuple(_collada(ElementTree.parse(filename).getroot()))
        loaded = read_mesh_file(filename)
        return (MeshPart(np.asarray(loaded.vertices, dtype=float), np.asarray(loaded.faces), WHITE),)
    except (OSError, ValueError, KeyError, AttributeError, IndexError, ElementTree.ParseError):
        return ()


def _collada(root: ElementTree.Element) -> list[MeshPart]:
    """Triangles of a COLLADA 1.4 scene, placed by its nodes and coloured by their material's diffuse colour."""
    for element in root.iter():
        element.tag = element.tag.rpartition("}")[2]
    by_id = {element.get("id"): element for element in root.iter() if element.get("id")}
    unit = root.find("asset/unit")
    scale = float(unit.get("meter", 1)) if unit is not None else 1.0
    up = root.findtext("asset/up_axis", "Y_UP")
    upright = matrix_from_rpy([np.pi / 2, 0, 0]) if up == "Y_UP" else np.eye(3)
    parts: list[MeshPart] = []

    def visit(node: ElementTree.Element, parent: Array) -> None:
        pose = parent
        for matrix in node.findall("matrix"):
            pose = pose @ np.array((matrix.text or "").split(), dtype=float).reshape(4, 4)
        for instance in node.findall("instance_geometry"):
            materials = {m.get("symbol"): m.get("target", "")[1:] for m in instance.iter("instance_material")}
            for vertices, faces, symbol in _triangles(by_id[instance.get("url", "")[1:]], by_id):
                placed = (vertices @ pose[:3, :3].T + pose[:3, 3]) * scale @ upright.T
                parts.append(MeshPart(placed, faces, _colour(materials.get(symbol, symbol), by_id)))
        for child in node.findall("node"):
            visit(child, pose)

    for scene in root.iter("visual_scene"):
        for node in scene.findall("node"):
            visit(node, np.eye(4))
    return parts


def _triangles(
    geometry: ElementTree.Element, by_id: dict[str | None, ElementTree.Element]
) -> list[tuple[Array, Indices, str | None]]:
    """(vertices, faces, material symbol) of each set of triangles or polygons; polygons become triangle fans."""
    found: list[tuple[Array, Indices, str | None]] = []
    for group in [*geometry.iter("triangles"), *geometry.iter("polylist")]:
        inputs = {i.get("semantic"): i for i in group.findall("input")}
        positions = by_id[inputs["VERTEX"].get("source", "")[1:]].find("input[@semantic='POSITION']")
        source = by_id[positions.get("source", "")[1:]]  # type: ignore[union-attr]
        vertices = np.array(source.findtext("float_array", "").split(), dtype=float).reshape(-1, 3)
        stride = 1 + max(int(i.get("offset", 0)) for i in inputs.values())
        offset = int(inputs["VERTEX"].get("offset", 0))
        corner = np.array(group.findtext("p", "").split(), dtype=int).reshape(-1, stride)[:, offset]
        if group.tag == "triangles":
            faces = corner.reshape(-1, 3)
        else:
            sizes = np.array(group.findtext("vcount", "").split(), dtype=int)
            first = np.cumsum(sizes) - sizes
            faces = np.array(
                [corner[[a, a + j, a + j + 1]] for a, n in zip(first, sizes, strict=True) for j in range(1, n - 1)]
            )
        if len(faces):
            found.append((vertices, faces, group.get("material")))
    return found


def _colour(material: str | None, by_id: dict[str | None, ElementTree.Element]) -> tuple[float, float, float]:
    element = by_id.get(material)
    effect = element.find("instance_effect") if element is not None else None
    if effect is None:
        return WHITE
    text = by_id[effect.get("url", "")[1:]].findtext(".//diffuse/color")
    if not text:
        return WHITE
    red, green, blue = (float(x) for x in text.split()[:3])
    return red, green, blue
