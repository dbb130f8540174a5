"""Facets and corners of hulls and cones: against Qhull, against what is known of them, and whatever their scale."""

from itertools import combinations
from math import comb

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial import ConvexHull

from salver.geometry import exp
from salver.models.contact.contact import cone_edges
from salver.models.shapes import hulls, shapes
from salver.models.shapes.hulls import _interior_direction, cone_facets, polytope
from salver.models.shapes.polygons import convex_hull, half_planes, intersection


def merged(equations: np.ndarray) -> np.ndarray:
    """Each plane of a triangulated hull once."""
    kept: list[np.ndarray] = []
    for row in equations:
        if all(np.abs(row - other).max() > 1e-7 for other in kept):
            kept.append(row)
    return np.array(kept)


def same_rows(first: np.ndarray, second: np.ndarray, close: float = 1e-7) -> bool:
    """Whether two lists of rows are one set."""
    away = np.abs(first[:, None] - second[None]).max(axis=2)
    return len(first) == len(second) and away.min(axis=0).max() < close and away.min(axis=1).max() < close


def sums(generators: np.ndarray) -> np.ndarray:
    """(2^k, d): all sums of +- k generators; their hull is a zonotope."""
    signs = np.array(np.meshgrid(*[(-1.0, 1.0)] * len(generators))).reshape(len(generators), -1).T
    return signs @ generators


def prism(base: np.ndarray, height: float) -> np.ndarray:
    return np.vstack([np.column_stack([base, np.full(len(base), z)]) for z in (-0.5 * height, 0.5 * height)])


def around(n: int) -> np.ndarray:
    angle = 2 * np.pi * np.arange(n) / n
    return np.column_stack([np.cos(angle), np.sin(angle)])


def wrench_rays(polygon: np.ndarray, edges: int) -> np.ndarray:
    """Unit wrenches (f, tau) of the edges of friction cones with coefficient 1 at the corners."""
    forces = np.sqrt(2) * cone_edges(1.0, edges, 0.1).T
    rays = np.array([[*f, y * f[2], -x * f[2], x * f[1] - y * f[0]] for x, y in polygon for f in forces])
    return rays / np.linalg.norm(rays, axis=1)[:, None]


def drawn(rng: np.random.Generator) -> np.ndarray:
    """Points of one of several kinds, of which many have facets with more points than they need."""
    d, kind = int(rng.integers(2, 6)), rng.integers(6)
    if kind == 0:
        return rng.normal(size=(rng.integers(d + 1, 30), d))
    if kind == 1:
        return sums(np.diag(rng.uniform(0.05, 1, d)))
    if kind == 2:
        return sums(rng.normal(size=(min(d + 1, 5), d)))
    if kind == 3:
        return sums(np.vstack([np.eye(d), rng.integers(-1, 2, size=(1, d))])[: min(d + 1, 6)])
    if kind == 4:
        lattice = rng.integers(-2, 3, size=(40, d)).astype(float)
        return np.vstack([lattice, np.eye(d), -np.eye(d), lattice[:4]])
    return prism(around(int(rng.integers(3, 25))), 0.6)


@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 8))])
def test_facets_and_corners_are_those_of_qhull_whatever_size_and_place(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(8):
        unit = drawn(rng)
        d = unit.shape[1]
        unit = unit @ np.linalg.qr(rng.normal(size=(d, d)))[0]
        scale, middle = 10 ** rng.uniform(-4, 3), rng.choice([0.0, 1.0, 10.0]) * rng.normal(size=d)
        points = scale * (unit + middle)
        found, known = polytope(points), ConvexHull(unit)
        rows = np.column_stack([found.normal, found.normal @ middle - found.offset / scale])
        assert same_rows(rows, merged(known.equations))
        assert (points @ found.normal.T - found.offset).max() < 1e-12 * scale * (1 + np.abs(middle).max())
        corners, theirs = unit[found.corners], unit[known.vertices]
        assert np.abs(corners[:, None] - theirs).max(axis=2).min(axis=1).max() < 1e-9  # each is one of Qhull's;
        assert len(np.unique(np.round(corners, 9), axis=0)) == len(corners)  # none comes twice,
        assert ConvexHull(corners).volume == pytest.approx(known.volume, rel=1e-9)  # and none is missing


@pytest.mark.parametrize("d", [2, 3, 4, 5])
def test_counts_of_known_polytopes(d: int) -> None:
    rng = np.random.default_rng(d)
    for turned in (np.eye(d), np.linalg.qr(rng.normal(size=(d, d)))[0]):
        box = polytope(sums(np.eye(d)) @ turned)
        cross = polytope(np.vstack([np.eye(d), -np.eye(d)]) @ turned)
        simplex = polytope(np.vstack([np.zeros(d), np.eye(d)]) @ turned)
        assert [len(p.normal) for p in (box, cross, simplex)] == [2 * d, 2**d, d + 1]
        assert [len(p.corners) for p in (box, cross, simplex)] == [2**d, 2 * d, d + 1]
    k = min(d + 2, 6)  # generators in general position: a facet for each d - 1 of them, on both sides
    zonotope = polytope(sums(rng.normal(size=(k, d))))
    assert len(zonotope.normal) == 2 * comb(k, d - 1)
    assert len(zonotope.corners) == 2 * sum(comb(k - 1, i) for i in range(d))


def test_a_cyclic_polytope_has_the_facets_that_gales_evenness_says() -> None:
    """On the moment curve in four dimensions: n (n - 3) / 2 of them, each with four corners; all points are corners."""
    t = np.cos(np.pi * (np.arange(10) + 0.5) / 10)
    found = polytope(np.stack([t, t**2, t**3, t**4], axis=1))
    assert len(found.normal) == 10 * 7 // 2
    assert len(found.corners) == 10


def test_facets_of_a_small_cone_are_all_planes_through_its_rays_that_none_is_beyond() -> None:
    """Independent of any hull: a plane through five of the wrenches is a facet where the others are below."""
    rays = wrench_rays(around(4) * [1.0, 0.6], 4)
    chosen = np.array(list(combinations(range(16), 5)))
    _, width, across = np.linalg.svd(rays[chosen])
    plane = across[width[:, 4] > 1e-9, 5]
    plane = np.concatenate([plane, -plane])
    plane = plane[(plane @ rays.T).max(axis=1) < 1e-9]
    assert same_rows(cone_facets(rays), merged(plane), 1e-9)


@pytest.mark.parametrize("count", [5, 64, 300])
@pytest.mark.parametrize("rank", [1, 2, 3])
def test_rays_within_a_cone_change_nothing_however_many_and_long(rank: int, count: int) -> None:
    """In three dimensions: a ray, all between two, and a corner of a box; each with its missing directions."""
    rng = np.random.default_rng(count)
    for _ in range(3):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        edges = turn[:rank]
        within = rng.uniform(0.1, 1, (count - rank, rank)) @ edges
        rays = rng.permutation(np.vstack([edges, within])) * 10.0 ** rng.uniform(-6, 6, (count, 1))
        rows = cone_facets(rays)
        if rank == 1:
            across = rows[1:]
            assert_allclose(rows[0], -turn[0], atol=1e-9)
        else:
            across = rows[rank:]
            assert same_rows(rows[:rank], -turn[:rank], 1e-9)
        assert len(across) == 2 * (3 - rank)
        assert_allclose(across @ edges.T, 0.0, atol=1e-9)
        assert np.linalg.matrix_rank(np.vstack([edges, across])) == 3
        assert_allclose(across.sum(axis=0), 0.0, atol=1e-12)  # each with its opposite


@pytest.mark.parametrize("count", [12, 80])
def test_facets_come_in_the_order_of_the_rays_that_lie_in_them(count: int) -> None:
    """However the cone is turned; the first ray counts most."""
    rays = wrench_rays(around(count // 4), 4)
    turn = np.linalg.qr(np.random.default_rng(2).normal(size=(6, 6)))[0]
    rows = cone_facets(rays)
    members = [tuple(on) for on in np.abs(rows @ rays.T) < 1e-9]
    assert members == sorted(members)
    assert np.abs(cone_facets(rays @ turn) @ turn.T - rows).max() < 1e-9
    assert len(set(members)) == len(members)


def test_points_that_are_nearly_in_a_plane_are_still_held() -> None:
    """A corner of a box raised by less than bits could tell: which all points bear out."""
    for raised in (1e-10, 1e-9, 1e-8):
        points = sums(np.eye(3))
        points[-1, 2] += raised
        found = polytope(points)
        assert (points @ found.normal.T - found.offset).max() < 1e-12
        assert found.holds(np.array([0.9, 0.9, 0.9]))
        assert not found.holds(np.array([0.9, 0.9, 1.1]))


def test_what_has_no_facets_is_refused() -> None:
    with pytest.raises(ValueError, match="contains a line"):
        cone_facets(np.vstack([np.eye(6), -np.eye(6)]))
    with pytest.raises(ValueError, match="contains a line"):
        cone_facets(np.vstack([around(5), [[0.0, 1.0]] * 64]))
    for flat, why in (
        (np.zeros((5, 3)), "all points are equal"),
        (np.eye(3)[:2], "no hull"),
        (prism(around(5), 0.0), "no hull"),
    ):
        with pytest.raises(ValueError, match=why):
            polytope(flat)


def test_a_line_in_a_cone_is_found() -> None:
    """A half space of dimension three: a half plane's rays, and one across."""
    half = np.column_stack([np.cos(np.linspace(0, np.pi, 7)), np.sin(np.linspace(0, np.pi, 7)), np.zeros(7)])
    rays = np.vstack([half, [[0.0, 0.0, 1.0]]])
    with pytest.raises(ValueError, match="contains a line"):
        cone_facets(rays)


def test_triangles_cover_the_hull_and_look_outward() -> None:
    points = np.vstack([prism(around(7), 2.0), np.zeros((3, 3))])
    points[:, 0] += 3.0
    a, b, c = np.moveaxis(points[hulls.triangles(points)], 1, 0)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6  # the divergence theorem
    assert volume == pytest.approx(2 * 7 * 0.5 * np.sin(2 * np.pi / 7))


@pytest.mark.parametrize("seed", range(4))
def test_polygons_are_counter_clockwise_and_hold_all_points(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for n in (3, 4, 7, 30, 190, 1000):
        scale = 10 ** rng.uniform(-4, 3)
        for points in (rng.normal(size=(n, 2)), around(n), rng.integers(-3, 4, size=(n + 20, 2)).astype(float)):
            points = scale * (points + rng.normal(size=2))
            found = convex_hull(points)
            x, y = found.T
            assert 0.5 * (x @ np.roll(y, -1) - y @ np.roll(x, -1)) == pytest.approx(ConvexHull(points).volume)
            normal, offset = half_planes(found)
            assert (points @ normal.T - offset).max() < 1e-12 * scale
            assert found[0].tolist() == min(points.tolist())


def test_no_polygon_where_points_lie_in_a_line() -> None:
    along = np.linspace(-1, 1, 9)[:, None]
    for points in (along * [1.0, 0.3], along * [1e-4, 3e-5] + 0.7, np.zeros((4, 2)), along[:2] * [1.0, 1.0]):
        assert convex_hull(points).shape == (0, 2)


def test_a_corner_by_rounding_only_is_none() -> None:
    square = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.3], [0.0, 0.3]]) @ exp(np.array([0.0, 0.0, 0.2]))[:2, :2].T
    between = np.vstack([w * square + (1 - w) * np.roll(square, 1, axis=0) for w in (0.1, 0.5, 0.7)])
    found = convex_hull(np.vstack([square, between, square + 1e-17, square * (1 - 1e-16)]))
    assert len(found) == 4
    assert same_rows(found, square, 1e-15)


def test_corners_that_stand_twice_up_to_rounding_stay() -> None:
    rng, square = np.random.default_rng(0), 0.05 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    for near in 10.0 ** np.arange(-17, -11):
        for turn in rng.uniform(0, 2 * np.pi, 20):
            corners = square @ np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
            found = convex_hull(np.vstack([corners, corners + near * rng.standard_normal((4, 2))]))
            area = 0.5 * np.sum(found[:, 0] * np.roll(found[:, 1], -1) - found[:, 1] * np.roll(found[:, 0], -1))
            assert abs(area - 0.01) < 1e-11
            assert len(found) == 4  # an edge from one to the other would have any direction


def test_polygons_that_only_touch_have_nothing_in_common() -> None:
    square = 0.05 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    for deep in (0.0, 1e-12, 1e-10):
        assert intersection(square, square + np.array([0.1 - deep, 0.03])).shape == (0, 2)
    assert len(intersection(square, square + np.array([0.1 - 1e-6, 0.03]))) == 4


def test_cylinder_of_a_load_is_a_prism() -> None:
    solid = shapes.cylinder(0.03, 0.1, 16)
    found = polytope(solid.bounding_points_G)
    assert len(found.normal) == 18
    assert len(found.corners) == 32
    assert sorted(found.offset[np.abs(found.normal[:, 2]) > 0.5]) == pytest.approx([0.05, 0.05])


def test_facets_of_a_wide_cone_with_uneven_rays_whichever_way_it_opens() -> None:
    """Three rays 2 degrees above a plane, one of them counted ten times: their mean is no direction inside."""
    turns = np.deg2rad([0, 120, 240])
    rays = np.column_stack([np.cos(turns), np.sin(turns), np.full(3, np.tan(np.deg2rad(2)))])
    normals = np.cross(rays[[1, 2, 0]], rays)  # out of the cone
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    for turn in np.random.default_rng(5).normal(size=(12, 3)):
        R = exp(turn)
        rows = cone_facets(np.vstack([rays, np.repeat(rays[:1], 9, axis=0)]) @ R.T)
        assert rows.shape == (3, 3)
        assert_allclose(np.sort((rows @ R) @ normals.T, axis=1)[:, -1], 1.0, atol=1e-9)  # each is one of the three
        assert np.linalg.matrix_rank(rows) == 3


def test_the_cone_of_a_single_ray_is_that_ray() -> None:
    ray = np.array([1.0, -2.0, 2.0]) / 3
    rows = cone_facets(np.array([2.0 * ray, 5.0 * ray]))
    assert (rows @ ray).max() < 1e-12
    assert (rows @ -ray).max() > 0.1  # not the other way,
    for aside in np.linalg.svd(ray[None, :])[2][1:]:
        assert (rows @ (ray + 0.1 * aside)).max() > 1e-3  # nor beside it


def test_a_direction_within_a_cone_is_found_though_most_of_its_rays_lie_on_one_side():
    rays = np.array([[0.05, 1.0, 0.0], [0.05, 0.0, 1.0], *[[0.05, -1.0, -1.0]] * 9])
    axis = _interior_direction(rays)
    assert np.linalg.norm(axis) == pytest.approx(1.0)
    assert (rays @ rays.mean(axis=0)).min() < 0
    assert (rays @ axis).min() > 0.01


def test_a_direction_within_a_cone_has_length_one_also_where_its_rays_mean_nothing() -> None:
    """Nine rays to one side and one nearly to the other: their mean is not within."""
    angle = np.deg2rad([0.0] * 9 + [170.0])
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inner = _interior_direction(rays)
    assert np.linalg.norm(inner) == pytest.approx(1.0)
    assert (rays @ inner).min() == pytest.approx(np.sin(np.deg2rad(5.0)), rel=0.2)  # the middle of 10 degrees


def test_what_is_beyond_a_facet_by_a_tolerance_is_held_with_it() -> None:
    box = polytope(sums(np.eye(3)))
    beyond = np.array([1.05, 0.2, -0.3])
    assert [box.holds(beyond), box.holds(beyond, 0.04), box.holds(beyond, 0.06)] == [False, False, True]
