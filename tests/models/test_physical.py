"""Which inertial parameters are possible: against mass distributions that exist, and that do not."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import linprog

from salver.geometry import Array
from salver.models.bodies import Body
from salver.models.physical import hull_faces, nearest, random_inertia, realisable, second_moments
from salver.models.rigid_body import inertia_entries, parallel_axis
from salver.models.uncertain.parameters import inertial_vector
from salver.scenario import load, parse


def body_of(shape: dict) -> Body:
    ends = {"start": {"position": [0, 0, 0]}, "goal": {"position": [1, 0, 0]}, "duration": 1.0}
    tray = {"size": [0.4, 0.4]}
    item = {"shape": shape, "mass": 0.7, "friction": 0.4}
    return parse({"name": "test", "motion": ends, "objects": [item], "tray": tray}, "test").payload.first


BOX = body_of({"type": "box", "size": [0.1, 0.2, 0.3]})
WEDGE = body_of({"type": "prism", "polygon": [[0, 0], [0.2, 0], [0.05, 0.15]], "height": 0.1})
BOTTLE = body_of({"type": "cylinder", "radius": 0.04, "height": 0.3})


def of_points(points: Array, masses: Array) -> Array:
    """(10,) inertial values of point masses."""
    com = masses @ points / masses.sum()
    inertia = sum(parallel_axis(m, p - com) for m, p in zip(masses, points, strict=True))
    return np.concatenate([[masses.sum()], com, inertia_entries(inertia)])


def points_within(body: Body, count: int, rng: np.random.Generator) -> Array:
    """Convex combinations of the corners that favour corners: extreme distributions."""
    corners = body.solid.bounding_points_G - body.com_G
    return rng.dirichlet(np.full(len(corners), 0.1), size=count) @ corners


@pytest.mark.parametrize("body", [BOX, WEDGE, BOTTLE])
def test_every_distribution_within_the_shape_is_accepted(body: Body) -> None:
    rng = np.random.default_rng(0)
    values = [of_points(points_within(body, k, rng), rng.exponential(size=k)) for k in (1, 2, 3, 4, 8) * 40]
    assert realisable(body, values).all()
    assert realisable(body, inertial_vector(body.inertial)).all()


@pytest.mark.parametrize("body", [BOX, WEDGE, BOTTLE])
def test_inertia_drawn_at_random_is_of_masses_within_the_shape_about_the_place_that_was_asked_for(body: Body) -> None:
    rng, sizes = np.random.default_rng(3), []
    extent = np.ptp(body.points_B, axis=0)
    for com in np.concatenate([0.5 * points_within(body, 20, rng), 0.9 * points_within(body, 20, rng)]):
        six = random_inertia(body, com, rng)
        assert realisable(body, np.concatenate([[1.0], com, six])), com
        sizes.append(0.5 * (six[0] + six[2] + six[5]) / (extent @ extent))  # mean square distance from there
    assert 0.01 < np.mean(sizes) < 0.25  # evenly filled boxes have 1/12, all mass in the corners 1/4


@pytest.mark.parametrize("body", [BOX, WEDGE, BOTTLE])
def test_distributions_that_reach_outside_are_told(body: Body) -> None:
    """Half the mass at each of two opposite extreme points, pulled outwards."""
    corners = body.solid.bounding_points_G - body.com_G
    for axis in range(3):
        ends = corners[[corners[:, axis].argmin(), corners[:, axis].argmax()]]
        middle = ends.mean(axis=0)
        inside, outside = (of_points(middle + f * (ends - middle), np.array([0.35, 0.35])) for f in (0.999, 1.01))
        assert list(realisable(body, [inside, outside])) == [True, False]
        assert list(realisable(body, [inside, outside], within_shape=False)) == [True, True]


def test_box_by_hand() -> None:
    """The largest moment about x puts all mass at the eight corners: m (h_y^2 + h_z^2)."""
    largest = 0.7 * (0.1**2 + 0.15**2)
    value = of_points(BOX.solid.bounding_points_G, np.full(8, 0.7 / 8))
    assert_allclose(value[4], largest)
    more = value.copy()
    more[4] *= 1.001
    assert list(realisable(BOX, [value, more])) == [True, False]
    heavy_corner = np.concatenate([[0.7], [0.05, 0.1, 0.15], np.zeros(6)])
    nudged = heavy_corner + np.array([0, 1e-4, 0, 0, 0, 0, 0, 0, 0, 0])
    spread = heavy_corner + np.array([0, 0, 0, 0, 1e-5, 0, 1e-5, 0, 0, 1e-5])
    assert list(realisable(BOX, [heavy_corner, nudged, spread])) == [True, False, False]


def test_no_distribution_breaks_the_triangle_inequality_or_has_no_mass() -> None:
    value = inertial_vector(BOX.inertial)
    thin = value.copy()
    thin[4] = value[6] + value[9] + 1e-3
    assert list(realisable(BOX, [value, thin, -value], within_shape=False)) == [True, False, False]


def test_inertia_of_the_papers_cube_needs_more_than_the_cube() -> None:
    """Table I gives 3.4e-4; mass at the corners of the cube has 2.05e-4."""
    (cube,) = load("panda-cube").payload.bodies
    value = inertial_vector(cube.inertial)
    assert not realisable(cube, value)[0]
    assert realisable(cube, value, within_shape=False)[0]


def mass_distribution(body: Body, values: Array, per_axis: int = 9) -> tuple[Array, Array] | None:
    """Point masses (points in B (k, 3), masses (k,)) within the shape's hull with the given inertial values (10,).

    On a lattice of `per_axis` points along each side of the bounding box, and the hull's corners; None if there is
    none on that lattice. A distribution proves that the values are possible.
    """
    faces = hull_faces(body)
    corners = body.points_B
    axes = [
        np.linspace(low, high, per_axis) for low, high in zip(corners.min(axis=0), corners.max(axis=0), strict=True)
    ]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    size = float(np.ptp(corners, axis=0).max())
    lattice = lattice[np.all(lattice @ faces[:, :3].T + faces[:, 3] <= 1e-9 * size, axis=1)]
    points = np.vstack([lattice, corners])
    away = (points - values[1:4]) / size
    pairs = np.triu_indices(3)
    moments = np.vstack([np.ones(len(points)), away.T, (away[:, pairs[0]] * away[:, pairs[1]]).T])
    target = np.concatenate([[1.0, 0, 0, 0], second_moments(values[None])[0][pairs] / size**2])
    result = linprog(np.zeros(len(points)), A_eq=moments, b_eq=target, bounds=(0, None), method="highs")
    if result.status != 0:
        return None
    used = result.x > 0
    return points[used], values[0] * result.x[used]


@pytest.mark.parametrize("body", [BOX, WEDGE])
def test_accepted_values_have_a_distribution(body: Body) -> None:
    """The conditions are necessary; how far from sufficient is counted: point masses prove nearly all."""
    rng = np.random.default_rng(1)
    nominal = inertial_vector(body.inertial)
    count = 20_000
    draws = np.tile(nominal, (count, 1))
    draws[:, 1:4] += rng.uniform(-1, 1, (count, 3)) * 0.3 * np.ptp(body.solid.bounding_points_G, axis=0)
    draws[:, [4, 6, 9]] *= rng.uniform(0.05, 3, (count, 3))
    draws[:, [5, 7, 8]] += rng.uniform(-1, 1, (count, 3)) * 0.5 * nominal[[4, 4, 6]]
    accepted = draws[realisable(body, draws)][:20]
    assert len(accepted) == 20
    found = [mass_distribution(body, value) for value in accepted]
    proven = [f for f in found if f is not None]
    assert len(proven) >= 18
    for value, pair in zip(accepted, found, strict=True):
        if pair is not None:
            assert_allclose(of_points(*pair), value, atol=1e-9)
    refused = draws[~realisable(body, draws)][:8]
    assert all(mass_distribution(body, value) is None for value in refused)


def test_the_nearest_that_masses_can_have_by_hand() -> None:
    """Second moments of -2e-5 about one plane, where how far away something is counts each moment alike: that one
    becomes 0, and nothing else moves; its distance is what was missing, in standard deviations."""
    moments, deviation = np.array([-2e-5, 3e-4, 2e-4]), 1e-5
    to_inertia = np.zeros((10, 10))  # (m, m c, second moments, products) to (m, m c, inertia)
    to_inertia[:4, :4] = 1e-3 * np.eye(4)
    diagonal, products = [4, 6, 9], [5, 7, 8]
    to_inertia[np.ix_(diagonal, [4, 5, 6])] = deviation * (np.ones((3, 3)) - np.eye(3))
    to_inertia[products, [7, 8, 9]] = deviation
    phi = np.zeros(10)
    phi[0], phi[diagonal] = 0.5, moments.sum() - moments
    found, away = nearest(BOX, phi, to_inertia @ to_inertia.T, within_shape=False)
    assert away == pytest.approx(2.0, rel=1e-3)
    wanted = phi.copy()
    wanted[diagonal] = np.array([0.0, 3e-4, 2e-4]).sum() - np.array([0.0, 3e-4, 2e-4])
    assert_allclose(found, wanted, atol=1e-9)
    assert_allclose(nearest(BOX, wanted, to_inertia @ to_inertia.T, within_shape=False)[0], wanted, atol=1e-12)
