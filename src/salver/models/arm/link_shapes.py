"""Convex shapes of an arm's links for collision checks: from the URDF's geometry, or estimated.

A mesh is replaced by its convex hull, which contains the link, or by the hulls of a few slabs of it
(`salver.models.shapes.convex_shapes`). A link without collision geometry uses its visual one. For a link whose geometry
cannot be read, capsules can be fitted as an estimate.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import coal
import numpy as np
import pinocchio as pin

from salver.geometry import Array, matrix_from_rpy
from salver.models.arm.urdf import LARGEST_LINK, end_of
from salver.models.shapes.convex_shapes import Triangles, convex, convex_pieces

SIZES = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}
_NOUGHT = re.compile(r"0*\.?0*")


@dataclass(frozen=True)
class LinkShape:
    """A convex shape (Coal's) of a link and its placement in the link's frame (pin.SE3).

    mesh: the file and the scale of the mesh that it is the hull of.
    """

    link: str
    shape: Any
    placement: Any
    mesh: tuple[str, tuple[float, ...]] | None = None

    @property
    def itself(self) -> Any:
        """Coal's shape of the link's mesh instead of its hull: for collision checks, not for distances."""
        return self.shape if self.mesh is None else _mesh(*self.mesh)

    def holds(self, point: Array) -> bool:
        """Whether a point (3,) of the shape's own frame, m, lies inside the link's mesh: by its winding number, the sum
        of the triangles' solid angles (van Oosterom and Strackee 1983), which also tells where a surface is not closed.
        """
        if self.mesh is None:
            return False
        vertices, triangles = _surface(*self.mesh)
        corners = vertices[triangles] - point
        a, b, c = np.swapaxes(corners, 0, 1)
        la, lb, lc = np.linalg.norm(corners, axis=2).T
        dots = la * lb * lc + np.sum(a * b, 1) * lc + np.sum(b * c, 1) * la + np.sum(c * a, 1) * lb
        angles = 2 * np.arctan2(np.sum(a * np.cross(b, c), 1), dots)
        return bool(abs(angles.sum()) > 2 * np.pi)

    @property
    def pieces(self) -> tuple[Any, ...]:
        """Convex pieces, at the same placement, that contain the link more tightly where that is worthwhile."""
        return (self.shape,) if self.mesh is None else _pieces(*self.mesh)


@dataclass(frozen=True, eq=False)
class LinkShapes:
    """Shapes of all links of a URDF.

    shapes: those that are known. missing: link -> why its geometry, or a part of it, is not known.
    fitted: links that are approximated by capsules fitted to their inertia.
    """

    shapes: tuple[LinkShape, ...]
    missing: dict[str, str]
    fitted: tuple[str, ...]


@lru_cache(maxsize=16)
def link_shapes(urdf: str, capsules: bool = False, frame: float = 0.02) -> LinkShapes:
    """Shapes of the links of a URDF whose mesh files have absolute paths (`salver.models.arm.urdf.read_chain`).

    capsules: fit capsules to links whose geometry cannot be read (`_capsules`). frame: mass, kg, up to which a link
    without geometry counts as a frame, not a body.
    """
    root = ElementTree.fromstring(urdf)
    shapes: list[LinkShape] = []
    missing: dict[str, str] = {}
    fitted: list[str] = []
    for link in root.iter("link"):
        name = link.get("name", "")
        collision, visual = ([x for x in link.findall(tag) if not _empty(x)] for tag in ("collision", "visual"))
        elements = collision or visual
        reasons = []
        for element in elements:
            try:
                shape, mesh = _shape(element.find("geometry"))
            except (ValueError, RuntimeError) as error:
                reasons.append(str(error))
            else:
                shapes.append(LinkShape(name, shape, _origin(element), mesh))
        if not elements and _mass(link) > frame:
            reasons.append("the URDF gives it no geometry")
        if not reasons:
            continue
        guesses = _capsules(link, root) if capsules else []
        if guesses:
            fitted.append(name)
            shapes += guesses
        else:
            missing[name] = "; ".join(dict.fromkeys(reasons))
    return LinkShapes(tuple(shapes), missing, tuple(fitted))


def _empty(element: ElementTree.Element) -> bool:
    """Whether all sizes of an element's geometry are 0, which some URDFs use for no geometry."""
    kinds = element.findall("geometry/*")
    sizes = [size for kind in kinds for key in SIZES.get(kind.tag, ()) for size in kind.get(key, "").split()]
    return bool(sizes) and all(_NOUGHT.fullmatch(size) for size in sizes)


def _shape(geometry: ElementTree.Element | None) -> tuple[Any, tuple[str, tuple[float, ...]] | None]:
    """Coal's shape of a URDF's geometry, and the mesh's file and scale if it is the hull of one. Raises ValueError with
    the reason when it is not available."""
    kind = geometry[0] if geometry is not None and len(geometry) else None
    if kind is None:
        raise ValueError("its geometry is empty")
    if kind.tag == "mesh":
        file = kind.get("filename", "")
        if not Path(file).is_file():
            raise ValueError(f"there is no file {file}")
        scale = _numbers(kind, "scale", "1 1 1")
        if len(scale) != 3 or not all(np.isfinite(x) and x != 0 for x in scale):
            raise ValueError(f'the scale "{kind.get("scale")}" of its mesh is not three numbers other than 0')
        return _hull(file, tuple(scale)), (file, tuple(scale))
    if kind.tag not in SIZES:
        raise ValueError(f"its geometry is a <{kind.tag}>")
    numbers = [x for key in SIZES[kind.tag] for x in _numbers(kind, key)]
    count = 3 if kind.tag == "box" else len(SIZES[kind.tag])
    if len(numbers) != count:
        raise ValueError(f"its {kind.tag} has {len(numbers)} sizes, not {count}")
    if not all(np.isfinite(x) and x > 0 for x in numbers):
        raise ValueError(f"the size of its {kind.tag} is not positive")
    return getattr(coal, kind.tag.capitalize())(*numbers), None


@lru_cache(maxsize=256)
def _hull(file: str, scale: tuple[float, ...]) -> Any:
    points = np.asarray(_mesh(file, scale).vertices(), dtype=float)
    size = float(np.ptp(points, axis=0).max()) if len(points) else 0.0
    if not 0 < size < LARGEST_LINK:
        raise ValueError(f'the mesh {file} is {size:.4g} m large; one in millimetres needs scale="0.001 0.001 0.001"')
    return convex(points)


@lru_cache(maxsize=256)
def _pieces(file: str, scale: tuple[float, ...]) -> tuple[Any, ...]:
    return tuple(convex_pieces(*_surface(file, scale)))


@lru_cache(maxsize=256)
def _surface(file: str, scale: tuple[float, ...]) -> tuple[Array, Triangles]:
    """Vertices (n, 3), m, and triangles (k, 3) of a mesh."""
    mesh = _mesh(file, scale)
    triangles = [mesh.tri_indices(k) for k in range(mesh.num_tris)]
    return np.asarray(mesh.vertices(), dtype=float), np.array([[one[k] for k in range(3)] for one in triangles])


@lru_cache(maxsize=256)
def _mesh(file: str, scale: tuple[float, ...]) -> Any:
    try:
        return coal.MeshLoader().load(file, np.array(scale))
    except (ValueError, RuntimeError):
        raise ValueError(f"the mesh {file} cannot be read") from None


def _numbers(element: ElementTree.Element, key: str, otherwise: str = "") -> list[float]:
    return [float(x) for x in element.get(key, otherwise).split()]


def _origin(element: ElementTree.Element) -> Any:
    origin = element.find("origin")
    if origin is None:
        return pin.SE3.Identity()
    return pin.SE3(
        matrix_from_rpy(_numbers(origin, "rpy", "0 0 0")), np.array(_numbers(origin, "xyz", "0 0 0"), dtype=float)
    )


def _mass(link: ElementTree.Element) -> float:
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else float(mass.get("value", "0"))


def _capsules(
    link: ElementTree.Element, root: ElementTree.Element, densities: tuple[float, float] = (2700.0, 700.0)
) -> list[LinkShape]:
    """Capsules of a link by its mass, inertia and joints; none when the URDF gives it no mass.

    They run from the link's own joint, and from each of the next ones, to its centre of mass. Their radius is that of
    the solid cylinder of the same mass and least moment of inertia, limited to densities, kg/m^3, from solid aluminium
    to light shells with little inside, because many URDFs have arbitrary moments of inertia.
    """
    name, mass, inertial = link.get("name", ""), _mass(link), link.find("inertial")
    if mass <= 0 or inertial is None:
        return []
    placement, entries = _origin(inertial), inertial.find("inertia")
    joints = [joint for joint in root.findall("joint") if end_of(joint, "parent") == name]
    ends = [np.zeros(3), *(_origin(joint).translation for joint in joints)]
    segments = [(end, placement.translation) for end in ends]
    length = float(sum(np.linalg.norm(b - a) for a, b in segments))
    least, most = (_capsule_radius(mass / density, length) for density in densities)
    radius = most
    if entries is not None:
        xx, xy, xz, yy, yz, zz = (float(entries.get(f"i{k}", "0")) for k in ("xx", "xy", "xz", "yy", "yz", "zz"))
        moment = np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))[0]
        radius = float(np.clip(np.sqrt(2 * max(moment, 0.0) / mass), least, most))
    return [_capsule(name, a, b, radius) for a, b in segments]


def _capsule_radius(volume: float, length: float) -> float:
    """Radius (m) of a capsule about a segment of a length (m) that holds a volume (m^3)."""
    roots = np.roots([4 / 3 * np.pi, np.pi * length, 0.0, -volume])
    return float(roots.real.max())  # one root is positive; the real parts of the others are not


def _capsule(link: str, start: Array, end: Array, radius: float) -> LinkShape:
    """The capsule about the segment from start to end (link's frame, m)."""
    length = float(np.linalg.norm(end - start))
    z = np.array([0.0, 0.0, 1.0]) if length == 0.0 else (end - start) / length
    rotation = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), z).toRotationMatrix()
    return LinkShape(link, coal.Capsule(radius, length), pin.SE3(rotation, 0.5 * (start + end)))
