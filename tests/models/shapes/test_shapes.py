"""Shapes: areas, inertia, composites and meshes against each other and against integration."""

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

from salver.models.shapes import shapes

L = np.array([[0.0, 0.0], [0.06, 0.0], [0.05, 0.04], [0.01, 0.05]])


def saved(mesh: trimesh.Trimesh, folder, name: str = "part.stl") -> str:
    path = folder / name
    mesh.export(path)
    return str(path)


def test_box_and_cylinder_by_hand() -> None:
    box = shapes.box((0.1, 0.2, 0.3))
    assert_allclose(np.diag(box.unit_inertia), [(0.04 + 0.09) / 12, (0.01 + 0.09) / 12, (0.01 + 0.04) / 12])
    cylinder = shapes.cylinder(0.05, 0.2, 16)
    assert_allclose(np.diag(cylinder.unit_inertia), [0.0025 / 4 + 0.04 / 12] * 2 + [0.0025 / 2])
    assert np.linalg.norm(cylinder.base_polygon, axis=1).max() <= 0.05 + 1e-15
    # The hull that bounds the centre of mass contains the disc.
    assert np.linalg.norm(cylinder.bounding_points_G[:, :2], axis=1).min() > 0.05


def test_prism_agrees_with_a_mesh_of_it(tmp_path) -> None:
    prism = shapes.prism(L, 0.12)
    # A convex hull is a closed mesh whose moments trimesh knows.
    body = trimesh.convex.convex_hull(prism.bounding_points_G)
    same = shapes.mesh(saved(body, tmp_path))
    middle = np.array([*(0.5 * (L.min(axis=0) + L.max(axis=0))), 0.0])
    assert_allclose(same.centroid_G + middle, prism.centroid_G, atol=1e-8)
    assert_allclose(same.unit_inertia, prism.unit_inertia, rtol=1e-5, atol=1e-10)
    assert_allclose(same.height, 0.12, rtol=1e-6)
    assert len(same.base_polygon) == len(same.top_polygon) == 4
    ours, theirs = (p[np.lexsort(p.T)] for p in (same.base_polygon + middle[:2], prism.base_polygon))
    assert_allclose(ours, theirs, atol=1e-7)


def test_two_halves_make_the_whole() -> None:
    half = shapes.box((0.1, 0.08, 0.05))
    for axis in range(3):
        size, away = np.array([0.1, 0.08, 0.05]), np.zeros(3)
        size[axis] *= 2
        away[axis] = 0.25 * size[axis]
        joined = shapes.composite([(half, away, 0.3), (half, -away, 0.3)])
        whole = shapes.box(tuple(size))
        assert_allclose(joined.unit_inertia, whole.unit_inertia, atol=1e-15)
        assert_allclose(joined.centroid_G, 0, atol=1e-15)
        assert_allclose(joined.height, whole.height)
        ours, theirs = (p[np.lexsort(np.round(p, 9).T)] for p in (joined.base_polygon, whole.base_polygon))
        assert_allclose(ours, theirs, atol=1e-12)


def test_composite_stands_on_its_lowest_parts_only() -> None:
    """A table: four legs and a top; it stands on the hull of the legs and carries on the top."""
    leg, top = shapes.box((0.01, 0.01, 0.1)), shapes.box((0.2, 0.12, 0.02))
    parts = [(leg, np.array([x, y, 0.05]), 0.05) for x in (-0.06, 0.06) for y in (-0.04, 0.04)]
    table = shapes.composite([*parts, (top, np.array([0, 0, 0.11]), 0.4)])
    assert_allclose(np.ptp(table.base_polygon, axis=0), [0.13, 0.09])
    assert_allclose(np.ptp(table.top_polygon, axis=0), [0.2, 0.12])
    assert_allclose(table.height, 0.12)
    assert_allclose(table.centroid_G, [0, 0, (0.2 * 0.05 + 0.4 * 0.11) / 0.6 - 0.06], atol=1e-15)


def test_mesh_in_millimetres(tmp_path) -> None:
    box = saved(trimesh.creation.box((40, 60, 100)), tmp_path)
    solid = shapes.mesh(box, 1e-3)
    assert_allclose(solid.unit_inertia, shapes.box((0.04, 0.06, 0.1)).unit_inertia, atol=1e-12)
    with pytest.raises(ValueError, match="set scale"):
        shapes.mesh(box)


def test_mesh_mistakes_are_one_sentence(tmp_path) -> None:
    with pytest.raises(ValueError, match="does not exist; give the path"):
        shapes.mesh(str(tmp_path / "none.stl"))
    (tmp_path / "text.stl").write_text("this is no mesh")
    with pytest.raises(ValueError, match=r"cannot be read|holds no triangles"):
        shapes.mesh(str(tmp_path / "text.stl"))
    open_box = trimesh.creation.box((0.1, 0.1, 0.1))
    open_box.update_faces(np.arange(len(open_box.faces)) > 0)
    with pytest.raises(ValueError, match="not a closed surface"):
        shapes.mesh(saved(open_box, tmp_path, "open.stl"))
    on_edge = trimesh.creation.box((0.1, 0.1, 0.1))
    on_edge.apply_transform(trimesh.transformations.rotation_matrix(0.5, [1, 0, 0]))
    with pytest.raises(ValueError, match="stands on a point or an edge"):
        shapes.mesh(saved(on_edge, tmp_path, "edge.stl"))


def test_a_composite_off_centre_stands_under_its_lowest_part() -> None:
    """A block 0.2 m to the side, and a longer one upon it that is not: the base of the one, the top of the other."""
    low, high = shapes.box((0.04, 0.06, 0.02)), shapes.box((0.5, 0.1, 0.02))
    whole = shapes.composite([(low, np.array([0.2, -0.1, 0.01]), 1.0), (high, np.array([0.0, 0.05, 0.03]), 1.0)])
    assert_allclose(whole.base_polygon.min(axis=0), [0.18, -0.13])
    assert_allclose(whole.base_polygon.max(axis=0), [0.22, -0.07])
    assert_allclose(whole.top_polygon.min(axis=0), [-0.25, 0.0], atol=1e-15)
    assert_allclose(whole.top_polygon.max(axis=0), [0.25, 0.1])
    assert_allclose(whole.centroid_G, [0.1, -0.025, 0.0], atol=1e-15)
