"""The contact wrench cone: facets against linear and second-order programmes, and against closed forms."""

import clarabel
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import sparse
from scipy.optimize import linprog

from salver.geometry import exp
from salver.models.contact.contact import ContactSet, support_contacts
from salver.models.contact.wrench_cone import (
    cone_facets,
    friction_needed,
    margin,
    support_length,
    support_rows,
    tip_over_margin,
)
from salver.models.shapes import shapes

G = 9.81
CUBE = np.array([[0.02, 0.02, -0.02], [-0.02, 0.02, -0.02], [-0.02, -0.02, -0.02], [0.02, -0.02, -0.02]])


def polygon_contacts(
    n: int, edges: int, friction: float = 0.3, offset: tuple[float, float] = (0.01, -0.02)
) -> ContactSet:
    polygon = shapes.cylinder(0.03, 0.1, n).base_polygon + offset
    return support_contacts(np.column_stack([polygon, np.full(n, -0.05)]), friction, edges, 0.2)


def reach_by_facets(rows: np.ndarray, wrench: np.ndarray, direction: np.ndarray) -> float:
    """Largest s with F + s d inside, minus infinity if the line misses the cone."""
    value, rate = rows @ wrench, rows @ direction
    up = np.min(-value[rate > 1e-13] / rate[rate > 1e-13], initial=np.inf)
    down = np.max(-value[rate < -1e-13] / rate[rate < -1e-13], initial=-np.inf)
    return up if up >= down else -np.inf


def reach_lp(contacts: ContactSet, wrench_B: np.ndarray, direction_B: np.ndarray) -> float:
    """Largest s with F + s d in the cone, for one wrench and direction (6,), by a linear programme.

    Works on the lifted contact forces Lambda >= 0 and knows nothing of facets: the reference for them.
    Infinite if every s >= some value does; minus infinity if the line misses the cone.
    """
    scale = np.array([1, 1, 1, *([1 / support_length(contacts)] * 3)])
    balance = np.hstack([contacts.grasp_map, -direction_B[:, None]]) * scale[:, None]
    cost = np.zeros(balance.shape[1])
    cost[-1] = -1.0
    bounds = [(0, None)] * (len(cost) - 1) + [(None, None)]
    result = linprog(cost, A_eq=balance, b_eq=scale * wrench_B, bounds=bounds, method="highs")
    if result.status == 3:
        return float("inf")
    return float(result.x[-1]) if result.status == 0 else float("-inf")


def rectangle_cone(half_x: float, half_y: float, friction: float) -> np.ndarray:
    """A (16, 6) of a rectangular contact with |f_x|, |f_y| <= mu f_z at each point, moments at its centre.

    Closed form of Caron, Pham, Nakamura, "Stability of surface contacts for humanoid robots", ICRA 2015,
    eqs 17-23. The same cone as `cone_facets` of four corners with four edges at phase 45 degrees and sqrt(2) mu.
    """
    x, y, mu = half_x, half_y, friction
    rows = [[s, 0, -mu, 0, 0, 0] for s in (1, -1)] + [[0, s, -mu, 0, 0, 0] for s in (1, -1)]
    rows += [[0, 0, -y, s, 0, 0] for s in (1, -1)] + [[0, 0, -x, 0, s, 0] for s in (1, -1)]
    for s in (1, -1):
        for e in (1, -1):
            rows.append([s * y, e * x, -mu * (x + y), mu * s, mu * e, 1])
            rows.append([s * y, e * x, -mu * (x + y), -mu * s, -mu * e, -1])
    return np.array(rows, dtype=float)


@pytest.mark.parametrize(("n", "edges"), [(3, 3), (3, 4), (4, 4), (5, 7), (6, 4), (8, 8), (12, 4), (12, 12)])
def test_facets_agree_with_linear_programme(n: int, edges: int) -> None:
    rng = np.random.default_rng(n * 100 + edges)
    contacts = polygon_contacts(n, edges)
    rows, grasp_map = cone_facets(contacts).rows, contacts.grasp_map
    assert (rows @ grasp_map).max() < 1e-11
    outside = 0
    for _ in range(12):
        # Around a wrench inside and around one that need not be.
        wrench = grasp_map @ rng.exponential(size=grasp_map.shape[1]) * rng.choice([1.0, -1.0])
        direction = rng.normal(size=6) * [1, 1, 1, 0.03, 0.03, 0.03]
        expected = reach_lp(contacts, wrench, direction)
        outside += expected < 0
        assert_allclose(reach_by_facets(rows, wrench, direction), expected, rtol=1e-8)
    assert 0 < outside < 12


def test_every_facet_touches_five_independent_generators() -> None:
    contacts = polygon_contacts(8, 4)
    rows, grasp_map = cone_facets(contacts).rows, contacts.grasp_map
    scale = np.array([1, 1, 1, *([1 / cone_facets(contacts).length] * 3)])
    for row in rows:
        active = (scale[:, None] * grasp_map)[:, np.abs(row @ grasp_map) < 1e-9]
        assert np.linalg.matrix_rank(active, tol=1e-6) == 5


@pytest.mark.parametrize(("n", "count"), [(3, 25), (6, 86), (12, 232)])
def test_number_of_facets_of_regular_polygons(n: int, count: int) -> None:
    polygon = shapes.cylinder(0.03, 0.1, n).base_polygon
    contacts = support_contacts(np.column_stack([polygon, np.full(n, -0.05)]), 0.3)
    assert len(cone_facets(contacts).rows) == count


def test_rectangle_agrees_with_closed_form() -> None:
    half_x, half_y, mu = 0.11, 0.04, 0.35
    corners = [[half_x, half_y, 0], [-half_x, half_y, 0], [-half_x, -half_y, 0], [half_x, -half_y, 0]]
    contacts = support_contacts(corners, np.sqrt(2) * mu, 4, np.pi / 4)
    ours = cone_facets(contacts)
    closed = rectangle_cone(half_x, half_y, mu)
    scale = np.array([1, 1, 1, *([ours.length] * 3)])
    closed = closed / np.linalg.norm(closed * scale, axis=1)[:, None]
    distance = np.abs(ours.rows[:, None] - closed[None]).max(axis=2)
    assert len(ours.rows) == len(closed) == 16
    assert distance.min(axis=0).max() < 1e-12
    assert distance.min(axis=1).max() < 1e-12


def test_margin_is_the_smallest_disturbance() -> None:
    contacts = polygon_contacts(5, 6)
    cone = cone_facets(contacts)
    wrench = np.array([0.1, 0.05, 2.0, 0.01, -0.02, 0.001])
    m = margin(cone.rows, wrench[None])[0]
    scale = np.array([1, 1, 1, *([cone.length] * 3)])
    rng = np.random.default_rng(0)
    assert m > 0
    for _ in range(200):
        d = rng.normal(size=6)
        d /= np.linalg.norm(d)
        assert reach_by_facets(cone.rows, wrench, d * scale) >= m * (1 - 1e-12)
    worst = cone.rows[np.argmax(cone.rows @ wrench)]
    assert_allclose(reach_lp(contacts, wrench, worst * scale**2), m, rtol=1e-8)


def test_how_far_a_pressure_point_is_beyond_an_edge_by_hand() -> None:
    """A rectangle of 0.2 x 0.1 m beside the origin; forces of 1 N upwards, and some sideways, through points of it."""
    corners = np.array([[x, y, -0.02] for x, y in ((0.3, 0.05), (0.1, 0.05), (0.1, -0.05), (0.3, -0.05))])
    contacts = support_contacts(corners, 0.4, 4)
    assert support_length(contacts) == pytest.approx(np.hypot(0.1, 0.05))
    rows, normal = support_rows(contacts)
    for x, y, beyond in (
        (0.2, 0.0, -0.05),
        (0.32, 0.0, 0.02),
        (0.3, 0.08, 0.03),
        (0.07, 0.01, 0.03),
        (0.15, -0.09, 0.04),
    ):
        force = np.array([0.2, -0.1, 1.0])
        wrench = np.concatenate([force, np.cross([x, y, -0.02], force)])
        assert (rows @ wrench).max() / (normal @ wrench) == pytest.approx(beyond)
    triangle = support_contacts(np.array([[0.1, 0.0, 0.0], [0.3, 0.0, 0.0], [0.1, 0.1, 0.0]]), 0.4, 4)
    rows, normal = support_rows(triangle)
    for x, y, beyond in ((0.07, 0.04, 0.03), (0.2, -0.02, 0.02), (0.3, 0.1, 0.1 * 0.2 / np.hypot(0.1, 0.2))):
        wrench = np.array([0.0, 0.0, 1.0, y, -x, 0.0])
        assert (rows @ wrench).max() / (normal @ wrench) == pytest.approx(beyond)
    many = np.random.default_rng(0).normal(size=(2, 3, 6))
    cone = cone_facets(contacts).rows
    expected = [[margin(cone, one[None])[0] for one in each] for each in many]
    assert_allclose(margin(cone, many), expected, atol=1e-12)


def test_level_acceleration_by_hand() -> None:
    """A cube follows a level tray at a: friction a/g, zero-moment point h a/g behind the centre."""
    contacts = support_contacts(CUBE, 0.5)
    a = np.array([0.0, 1.0, 4.905, 6.0])
    wrench = 0.256 * np.column_stack([a, 0 * a, 0 * a + G, 0 * a, 0 * a, 0 * a])
    assert_allclose(friction_needed(contacts, wrench), a / G, atol=1e-12)
    assert_allclose(tip_over_margin(contacts, wrench), 0.02 - 0.02 * a / G, atol=1e-12)
    m = margin(cone_facets(contacts).rows, wrench)
    assert m[0] > m[1] > 0 > m[3]
    assert abs(m[2]) < 1e-12


def test_no_friction_helps_past_tipping_or_pulling() -> None:
    contacts = support_contacts(CUBE, 0.5)
    tipping = np.array([1.001 * G, 0, G, 0, 0, 0])
    pulling = np.array([0, 0, -1.0, 0, 0, 0])
    assert np.all(np.isinf(friction_needed(contacts, np.stack([tipping, pulling]))))
    assert tip_over_margin(contacts, tipping)[0] < 0
    assert tip_over_margin(contacts, pulling)[0] == -np.inf


def test_friction_needed_is_where_the_wrench_enters_the_cone() -> None:
    rng = np.random.default_rng(3)
    points = np.array(
        [[0.05, 0.0, -0.1], [0.01, 0.06, -0.1], [-0.04, 0.02, -0.1], [-0.02, -0.05, -0.1], [0.03, -0.04, -0.1]]
    )
    contacts = support_contacts(points, 0.4, 6, 0.1)
    wrench = (contacts.grasp_map @ rng.exponential(size=(contacts.grasp_map.shape[1], 8))).T
    needed = friction_needed(contacts, wrench)
    assert np.all(needed <= 0.4)
    for f, mu in zip(wrench, needed, strict=True):
        for factor, inside in ((1.001, True), (0.999, False)):
            rows = cone_facets(support_contacts(points, mu * factor, 6, 0.1)).rows
            assert (margin(rows, f[None])[0] >= 0) == inside


def gauge_by_cone_programme(contacts: ContactSet, wrench: np.ndarray) -> float:
    """Friction needed under round cones by one second-order cone programme: largest s with s F_t possible at 1."""
    points = contacts.p_BC
    n = len(points)
    balance = np.zeros((6, 1 + 3 * n))
    for i, p in enumerate(points):
        n_i, x_i, y_i = 1 + 3 * i, 2 + 3 * i, 3 + 3 * i  # normal force first, as a second-order cone has it
        for column, force in ((n_i, [0, 0, 1.0]), (x_i, [1.0, 0, 0]), (y_i, [0, 1.0, 0])):
            balance[:, column] = [*force, *np.cross(p - points.mean(axis=0), force)]
    centred = wrench.copy()
    centred[3:] -= np.cross(points.mean(axis=0), wrench[:3])
    tangential = np.array([True, True, False, False, False, True])
    balance[:, 0] = np.where(tangential, -centred, 0)
    scale = np.array([1, 1, 1, 20, 20, 20.0])
    rows = sparse.vstack([scale[:, None] * balance, sparse.hstack([sparse.csc_matrix((3 * n, 1)), -sparse.eye(3 * n)])])
    target = np.concatenate([scale * np.where(tangential, 0, centred), np.zeros(3 * n)])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    cost = np.zeros(1 + 3 * n)
    cost[0] = -1
    cones = [clarabel.ZeroConeT(6), *[clarabel.SecondOrderConeT(3)] * n]
    quadratic = sparse.csc_matrix((len(cost), len(cost)))
    solution = clarabel.DefaultSolver(quadratic, cost, sparse.csc_matrix(rows), target, cones, settings).solve()
    assert str(solution.status) == "Solved"
    return 1 / solution.x[0]


def test_pyramids_bracket_the_round_cone() -> None:
    rng = np.random.default_rng(4)
    for n in (3, 4, 6):
        contacts = polygon_contacts(n, 16)
        wrench = (contacts.grasp_map @ rng.exponential(size=(contacts.grasp_map.shape[1], 2))).T
        ratio = [gauge_by_cone_programme(contacts, row) for row in wrench] / friction_needed(contacts, wrench)
        assert np.all(ratio <= 1 + 1e-6)
        assert np.all(ratio >= np.cos(np.pi / 16) - 1e-6)
        assert ratio.min() < 1 - 1e-4  # they do differ


def test_pure_torsion_of_a_round_cone() -> None:
    """Corners at distance r under a central load N give mu N r in all; edges of a pyramid may give less."""
    contacts = support_contacts(CUBE, 0.5)
    r, normal = 0.02 * np.sqrt(2), 3.0
    wrench = np.array([[0, 0, normal, 0, 0, 0.3 * normal * r]])
    assert_allclose(friction_needed(contacts, wrench), 0.3 * np.sqrt(2), rtol=1e-10)


def test_contacts_with_different_friction_and_normals() -> None:
    rng = np.random.default_rng(5)
    tilted = exp(np.array([[0.1, 0, 0], [0, 0.2, 0], [-0.1, 0, 0], [0, 0, 0.3]]))
    contacts = ContactSet(CUBE, tilted, np.array([0.2, 0.5, 0.3, 0.4]), 4, 0.0)
    rows = cone_facets(contacts).rows
    for _ in range(6):
        wrench, direction = (
            contacts.grasp_map @ rng.exponential(size=16),
            rng.normal(size=6) * [1, 1, 1, 0.02, 0.02, 0.02],
        )
        assert_allclose(reach_by_facets(rows, wrench, direction), reach_lp(contacts, wrench, direction), rtol=1e-8)


@pytest.mark.parametrize("count", [1, 2])
def test_too_few_contacts_leave_directions_without_force(count: int) -> None:
    contacts = support_contacts(CUBE[:count], 0.5)
    rows = cone_facets(contacts).rows
    inside = contacts.grasp_map @ np.ones(4 * count)
    assert margin(rows, inside[None])[0] > -1e-12
    off = inside + np.array([0, 0, 0, 1e-3, 1e-3, 0])  # a moment that no force at these points gives
    assert margin(rows, off[None])[0] < -1e-4


def test_opposing_contacts_have_no_facets() -> None:
    """Two fingers press a block between them: what one adds the other takes, with no wrench left."""
    turned = np.stack([exp(np.array([0.0, angle, 0.0])) for angle in (0.5 * np.pi, -0.5 * np.pi)])
    fingers = ContactSet(np.array([[-0.02, 0.0, 0.0], [0.02, 0.0, 0.0]]), turned, np.full(2, 0.5), 4)
    assert np.linalg.norm(fingers.grasp_map @ np.ones(8)) < 1e-12
    with pytest.raises(ValueError, match="can press against each other"):
        cone_facets(fingers)


def test_rectangle_whose_cone_defeats_the_hulls_merging() -> None:
    """Qhull stops at this one (many generators in one plane); the facets must come out all the same."""
    x, y = 0.05965631125602035 / 2, 0.0741424379364645 / 2
    contacts = support_contacts([[x, y, 0], [-x, y, 0], [-x, -y, 0], [x, -y, 0]], 0.4, 32)
    rows, grasp_map = cone_facets(contacts).rows, contacts.grasp_map
    assert (rows @ grasp_map).max() < 1e-7
    rng = np.random.default_rng(6)
    for _ in range(8):
        wrench = grasp_map @ rng.exponential(size=grasp_map.shape[1])
        direction = rng.normal(size=6) * [1, 1, 1, 0.05, 0.05, 0.05]
        assert_allclose(reach_by_facets(rows, wrench, direction), reach_lp(contacts, wrench, direction), rtol=1e-6)


def test_what_presses_at_a_corner_needs_no_friction() -> None:
    """The centre of pressure is at the edge of the support, not beyond it."""
    contacts = support_contacts(CUBE, 0.3, 8)
    for x, y in ((0.02, 0.02), (-0.02, 0.02), (0.02, 0.0), (0.0, -0.02)):
        wrench = np.array([[0.0, 0.0, 5.0, 5.0 * y, -5.0 * x, 0.0]])
        assert tip_over_margin(contacts, wrench) == pytest.approx([0.0], abs=1e-15)
        assert friction_needed(contacts, wrench)[0] == 0.0
        assert np.isinf(friction_needed(contacts, wrench * [1, 1, 1, 1 + 1e-6, 1 + 1e-6, 1])[0])


def test_contacts_in_a_line_are_no_support_wherever_it_is() -> None:
    line = np.column_stack([np.linspace(0.01, 0.05, 4), np.full(4, 0.03), np.full(4, -0.02)])
    with pytest.raises(ValueError, match="in one plane"):
        friction_needed(support_contacts(line, 0.3, 8), np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]))
