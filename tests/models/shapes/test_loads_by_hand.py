"""Loads by hand: what a shape's base stands on, what every placement keeps, what is inside, what is in a glass."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from armless_scenarios import scenario
from salver.dynamics.liquid.interiors import Rectangle, Round
from salver.dynamics.liquid.liquid import damping_of, hollow
from salver.dynamics.liquid.sloshing import Liquid
from salver.geometry import Array
from salver.models.arm.link_shapes import link_shapes
from salver.models.bodies import Body
from salver.models.contact.internal_wrench import internal_wrenches
from salver.models.interfaces import networks, sure_contacts
from salver.models.load_dynamics import APART
from salver.models.shapes import shapes
from salver.models.shapes.convex_shapes import convex
from salver.models.shapes.surfaces import surface
from salver.models.uncertain.contents import Filling, Hull, inertia_ranges, largest_mean, most_second_moments
from salver.models.uncertain.parameters import Parameter

LOW, HIGH = np.array([-0.1, -0.2, -0.3]), np.array([0.3, 0.1, 0.2])
BOX = np.array(list(product(*zip(LOW, HIGH, strict=True))))


def same_points(found: Array, expected: Array) -> bool:
    apart = np.linalg.norm(np.asarray(found)[:, None] - np.asarray(expected)[None], axis=2)
    return len(found) == len(expected) and max(apart.min(axis=0).max(), apart.min(axis=1).max()) < 1e-9


# ---- on what a load stands --------------------------------------------------------------------------------------


def item(name: str, x: float, y: float, **more: object) -> dict:
    shape = {"type": "box", "size": [x, y, 0.05]}
    return {"name": name, "shape": shape, "mass": 0.3, "friction": 0.5, **more}


def test_a_base_that_stands_over_the_edge_of_what_tapers_rests_where_both_are() -> None:
    """A box on a triangular prism: the triangle's own corners are what is left of the box's base."""
    triangle = [[0.0, 0.0], [0.09, 0.0], [0.0, 0.06]]
    prism = {"type": "prism", "polygon": triangle, "height": 0.05}
    lower = {"name": "wedge", "shape": prism, "mass": 0.5, "friction": 0.5, "at": [0.01, 0.02]}
    made = scenario([lower, item("box", 0.2, 0.2, on="wedge", at=[0.01, 0.02])])
    wedge, box = made.payload.bodies
    seen = box.contacts.p_BC[:, :2] @ box.R_EB[:2, :2].T + box.p_EB[:2]
    placed = (wedge.solid.top_polygon - wedge.com_G[:2]) @ wedge.R_EB[:2, :2].T + wedge.p_EB[:2]
    assert same_points(seen, placed)
    assert same_points(placed - placed.min(axis=0), np.array(triangle))


def test_what_every_placement_keeps_of_an_overhanging_base() -> None:
    """Axes aligned, centres of mass off the middle: the lower top spans x in [-0.03, 0.07], less 4 mm either side, and
    the upper base, turned by 90 degrees, x in [0.01, 0.09] and y in [-0.02, 0.04]."""
    lower = item("lower", 0.1, 0.1, at=[0.02, 0.0], com=[0.01, 0.005, 0.0])
    shift = {"position": [0.004, 0.002]}
    upper = item("upper", 0.06, 0.08, at=[0.05, 0.01], yaw_deg=90.0, com=[0.006, -0.004, 0.0], on="lower")
    made = scenario([lower, {**upper, "uncertainty": shift}]).payload
    (network,) = networks(made.bodies)
    sure = sure_contacts(network, made.tray_half, made.uncertain)[1]
    box = made.bodies[1]
    seen = sure.p_BC[:, :2] @ box.R_EB[:2, :2].T + box.p_EB[:2]
    assert same_points(seen, np.array([[x, y] for x in (0.01, 0.066) for y in (-0.02, 0.04)]))


def test_parameters_of_a_body_are_where_they_are_and_what_they_weigh() -> None:
    made = scenario([item("box", 0.1, 0.06, at=[0.02, -0.01], yaw_deg=30.0)]).payload
    (box,) = made.bodies
    change = {Parameter("box", "mass"): 0.02, Parameter("box", "position", "x"): 0.003}
    change |= {Parameter("box", "position", "y"): -0.004, Parameter("other", "mass"): 1.0}
    assert (box.phi_at(change) - box.phi_at({}))[0] == pytest.approx(0.02)
    assert box.place_at(change) - box.p_EB == pytest.approx([0.003, -0.004, 0.0])


def test_inertial_parameters_of_many_loads_at_once_are_those_of_each() -> None:
    uncertain = {"mass": "10%", "com": [0.002, 0.003, 0.004]}
    made = scenario([item("box", 0.1, 0.06, uncertainty=uncertain)]).payload
    values = made.uncertain.nominal + np.random.default_rng(0).normal(size=(3, 2, made.uncertain.size)) * 1e-3
    several = made.phi(made.first, values)
    assert several.shape == (3, 2, 10)
    for i, j in np.ndindex(3, 2):
        assert several[i, j] == pytest.approx(made.phi(made.first, values[i, j]))


@pytest.mark.parametrize("share", [1.0 - 1e-12, 1.01])
def test_a_sheet_without_thickness_is_the_limit_of_what_can_be(share: float) -> None:
    """Its largest moment is the sum of the two others; beyond that there is no mass distribution."""
    sheet = item("sheet", 0.1, 0.06, inertia=[2e-4, 0.0, 3e-4, 0.0, 0.0, 5e-4 * share])
    if share < 1:
        assert scenario([sheet]).payload.first.inertial.mass == 0.3
    else:
        with pytest.raises(Exception, match="larger than the sum of the other two"):
            scenario([sheet])


def _glass() -> Body:
    glass = {"type": "cylinder", "radius": 0.043, "height": 0.12}
    inside = {"kind": "water", "radius": 0.04, "fill": 0.06, "brim": 0.1}
    cup = {"name": "glass", "shape": glass, "mass": 0.2, "friction": 0.4, "liquid": inside}
    cup["uncertainty"] = {"fill": 0.004}
    return scenario([cup]).payload.first


def test_a_fuller_glass_weighs_as_much_more_as_water_does() -> None:
    """And what changes with its parameters changes as it is told to."""
    glass, fill = _glass(), Parameter("glass", "fill")
    assert glass.inner is not None
    water = glass.inner.density * np.pi * glass.inner.inside.half(0.0)[0] ** 2
    nominal = glass.inner_value({})
    assert nominal is not None
    assert glass.inner_value({fill: 0.004}) == pytest.approx(nominal + 0.004)
    assert (glass.phi_at({fill: 0.004}) - glass.phi_at({}))[0] == pytest.approx(0.004 * water)
    slope = glass.phi_jacobian([Parameter("glass", "mass"), fill])
    assert slope[0] == pytest.approx([1.0, water])
    for column, parameter in zip(slope.T, (Parameter("glass", "mass"), fill), strict=True):
        moved = (glass.phi_at({parameter: 1e-6}) - glass.phi_at({})) / 1e-6
        assert column == pytest.approx(moved, rel=1e-3, abs=1e-6)


# ---- what is inside ---------------------------------------------------------------------------------------------


def test_the_largest_moments_of_a_box_are_those_of_masses_at_its_two_ends() -> None:
    """Shares of a unit mass at low and high with the mean m have E x^2 = (low + high) m - low high, and the variance
    (high - m)(m - low); where the mean may lie beyond the box, all of it is at the farther end."""
    mean = np.array([0.02, 0.03, 0.04])
    square = np.array([0.2 * 0.02 + 0.03, 0.1 * 0.03 + 0.02, 0.1 * 0.04 + 0.06])
    most = most_second_moments(BOX, mean)
    assert most[[0, 2, 5]] == pytest.approx(square)
    assert most[[1, 3, 4]] == pytest.approx(
        np.sqrt([square[0] * square[1], square[0] * square[2], square[1] * square[2]])
    )
    assert most_second_moments(BOX, np.full(3, 0.5))[[0, 2, 5]] == pytest.approx([0.3**2, 0.2**2, 0.3**2])
    variance = np.array([0.28 * 0.12, 0.13 * 0.17, 0.24 * 0.26])
    nominal = np.array([0.05, -0.01, 0.06, 0.02, -0.03, 0.11])
    ranges = inertia_ranges(BOX, mean, 2.0, nominal)
    xx, yy, zz = 2 * (variance.sum() - variance)
    assert ranges[[0, 2]] == pytest.approx([xx - 0.05, yy - 0.06])
    assert ranges[5] == pytest.approx(0.11)  # zz can be at most 0.1115, but nothing at all too
    assert zz - 0.11 < 0.11
    products = 2 * np.sqrt(variance[[0, 0, 1]] * variance[[1, 2, 2]])
    assert ranges[[1, 3, 4]] == pytest.approx(products + np.array([0.01, 0.02, 0.03]))


@pytest.mark.parametrize(
    ("points", "faces"),
    [
        (BOX, (8, 12, 6)),
        (BOX[[0, 1, 2, 4, 5, 6]], (6, 9, 5)),  # a wedge: two triangles and three rectangles
        (np.random.default_rng(0).normal(size=(4000, 3)) ** 3, (8, 12, 6)),  # of very many corners, the box around them
    ],
)
def test_a_hull_has_the_corners_edges_and_facets_of_its_solid(points: Array, faces: tuple[int, int, int]) -> None:
    if len(points) == 4000:
        angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
        ring = np.column_stack([0.2 * np.cos(angle) + 0.05, 0.1 * np.sin(angle)])
        points = np.vstack([np.column_stack([ring, np.full(200, z)]) for z in (0.0, 0.3)])
    hull = Hull.of(points)
    assert (hull.corners, len(hull.basis[0])) == faces[:2]
    assert len(hull.normal) == faces[2]
    scaled = (points - hull.centre) / hull.half
    assert (scaled @ hull.normal.T <= hull.offset + 1e-9).all()
    assert (scaled @ hull.normal.T).max(axis=0) == pytest.approx(hull.offset)  # every facet touches it


def test_a_bound_is_as_good_where_it_matters_when_it_is_told_what_is_enough() -> None:
    rng = np.random.default_rng(2)
    hull, mean = Hull.of(BOX), np.array([0.02, 0.03, 0.04])
    b, Q = rng.normal(size=(20, 3)), 20 * rng.normal(size=(20, 3, 3))
    Q = Q + np.swapaxes(Q, 1, 2)
    best = largest_mean(hull, mean, b, Q)[0]
    for enough in (best - 0.05, best + 0.05):
        told = largest_mean(hull, mean, b, Q, enough)[0]
        assert np.all(told >= best - 1e-9)
        assert np.all(told <= np.maximum(best, enough) + 1e-6 * np.abs(Q).sum(axis=(1, 2)))


def test_cheap_limits_of_a_box_that_is_not_around_its_origin() -> None:
    """The mean may be 0.2 m to the right, where the box goes on to 0.3, but not to the left, where it ends at 0.1."""
    none = np.zeros((0, 1, 9))
    filling = Filling(
        Hull.of(BOX), np.array([0.2, 0.0, 0.0]), np.zeros((9, 1, 12)), np.zeros((1, 9)), (), none, np.zeros(0)
    )
    right, left, square = np.eye(9)[[0, 0, 3]] * np.array([[1], [-1], [1]])
    sure, most = filling.limits(np.array([right, left, square]))
    assert sure == pytest.approx([0.2, 0.0, 0.2**2])
    assert most == pytest.approx([0.2, 0.2, 0.2 * 0.2 + 0.03])


# ---- several supports -------------------------------------------------------------------------------------------


def test_an_internal_wrench_is_found_where_it_is_needed_most_and_where_it_fails_first() -> None:
    """Rows a + w and b - w are least at w = (b - a) / 2, with (a + b) / 2. A spike of one instant is between those at
    which the programme is solved at first; later ones hold by no choice."""
    value = np.tile([-1.0, -1.0], (61, 1))
    value[31] = [3.0, -5.0]
    w = internal_wrenches(value, np.array([[1.0], [-1.0]]))
    assert w[31] == pytest.approx([-4.0])
    assert (value + w @ [[1.0, -1.0]]).max(axis=1)[31] == pytest.approx(-1.0)
    value[[41, 44, 51]] = [[2.0, 1.0], [6.0, -2.0], [5.0, -2.5]]
    found = (value + internal_wrenches(value, np.array([[1.0], [-1.0]])) @ [[1.0, -1.0]]).max(axis=1)
    assert found.max() == pytest.approx(2.0)
    assert found[41] == pytest.approx(1.5)
    assert np.flatnonzero(found > 0)[0] == 41


# ---- links ------------------------------------------------------------------------------------------------------


def test_a_flat_link_is_as_thick_as_a_slab_about_where_it_is() -> None:
    flat = np.array([[x, y, 0.1] for x in (-0.2, 0.3) for y in (0.0, 0.1)])
    import pinocchio as pin

    corners = surface(convex(flat), pin.SE3.Identity())[0]
    assert corners.min(axis=0) == pytest.approx([-0.2, 0.0, 0.1 - 0.5e-3], abs=1e-9)
    assert corners.max(axis=0) == pytest.approx([0.3, 0.1, 0.1 + 0.5e-3], abs=1e-9)


def test_a_capsule_runs_from_a_joint_to_the_centre_of_mass() -> None:
    urdf = """<robot name="it"><link name="base"/><link name="tip"/>
      <link name="rod"><inertial><mass value="2"/><origin xyz="0.1 0.2 0.05"/>
        <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
        <collision><geometry><mesh filename="/nowhere.stl"/></geometry></collision></link>
      <joint name="a" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 0 1"/></joint>
      <joint name="b" type="fixed"><parent link="rod"/><child link="tip"/><origin xyz="0.3 0.1 -0.2"/></joint>
    </robot>"""
    found = [shape for shape in link_shapes(urdf, capsules=True).shapes if shape.link == "rod"]
    assert len(found) == 2
    for shape, begin in zip(found, ([0.0, 0.0, 0.0], [0.3, 0.1, -0.2]), strict=True):
        half = shape.shape.halfLength
        ends = np.array([shape.placement.act(np.array([0.0, 0.0, z])) for z in (-half, half)])
        assert same_points(ends, np.array([begin, [0.1, 0.2, 0.05]]))


# ---- in a glass -------------------------------------------------------------------------------------------------

CUP = Liquid(Round(0.04), 0.005, 0.06, 0.1, 1000.0, (0.004, 0.01))
TROUGH = Liquid(Rectangle(0.12, 0.07), 0.005, 0.05, 0.1, 1000.0, (0.004, 0.01))


@pytest.mark.parametrize("liquid", [CUP, TROUGH], ids=["cup", "trough"])
def test_a_crest_is_that_of_a_plane_until_it_steepens(liquid: Liquid) -> None:
    """Inclined as gravity says, a surface is a plane; free waves of twice the height are four times as much steeper, to
    second order kappa / R eta^2; and turning about a level axis raises it."""
    modes, slope, none = liquid.modes(liquid.fill), np.array([0.1, -0.07]), np.zeros(2)
    inclined = -modes.half * slope
    assert modes.crest(inclined, slope, 0.0) == pytest.approx(float(modes.highest(inclined)))
    eta = np.array([0.003, 0.002])
    once, twice = (float(modes.crest(x, none, 0.0) - modes.highest(x)) for x in (eta, 2 * eta))
    assert once == pytest.approx(float((modes.peaking / modes.half * eta**2).sum()))
    assert once > 0
    assert twice == pytest.approx(4 * once)
    assert modes.crest(none, none, 2.0) == pytest.approx(2 * float(modes.crest(none, none, 1.0)))
    assert modes.crest(none, none, 1.0) > 0


@pytest.mark.parametrize("liquid", [CUP, TROUGH], ids=["cup", "trough"])
def test_pendulums_held_and_what_is_still_are_the_frozen_liquid(liquid: Liquid) -> None:
    """Mass, lever and moments of inertia about the middle of the surface."""
    modes = liquid.modes(liquid.fill)
    frozen, still = modes.frozen, modes.still
    mass, height = np.array([(rod.mass, rod.height) for rods in modes.pendulums for rod in rods]).T
    assert still.mass + mass.sum() == pytest.approx(frozen.mass)
    assert still.mass * still.com_B[2] + mass @ height == pytest.approx(frozen.mass * frozen.com_B[2])
    for axis in range(2):
        held = still.inertia_com[axis, axis] + still.mass * still.com_B[2] ** 2 + mass @ height**2
        about = frozen.inertia_com[axis, axis] + frozen.mass * frozen.com_B[2] ** 2
        assert held == pytest.approx(about)
    assert still.inertia_com[2, 2] == frozen.inertia_com[2, 2]


@pytest.mark.parametrize("liquid", [CUP, TROUGH], ids=["cup", "trough"])
def test_fills_stand_as_near_to_one_another_as_is_needed_and_no_nearer(liquid: Liquid) -> None:
    assert liquid.cases(0.03, 0.03) == [(0.03, 0.004), (0.03, 0.01)]
    least, most = 0.004, 0.03
    fills = sorted({fill for fill, _ in liquid.cases(least, most)})
    assert [fills[0], fills[-1]] == pytest.approx([least, most], abs=1e-9)
    omega = np.array([liquid.modes(fill).omega[0].min() for fill in fills])
    steps = np.diff(omega) / omega[0]
    assert len(fills) > 3
    assert steps.max() <= APART * 1.001  # interpolated between two hundred fills
    assert steps.min() >= 0.6 * APART


def test_damping_of_a_shallow_and_of_a_deep_cup() -> None:
    """Dodge 2000: 0.79 sqrt(nu / sqrt(g R^3)) (1 + 0.318 / sinh(1.84 h/R) (1 + (1 - h/R) / cosh(1.84 h/R)))."""
    deep = 0.79 * np.sqrt(1e-6 / np.sqrt(9.81 * 0.04**3))
    assert damping_of(0.04, 0.4, 1e-6) == pytest.approx(deep, rel=1e-6)
    # h/R = 0.5: sinh(0.92) = 1.05539, cosh(0.92) = 1.45390.
    assert damping_of(0.04, 0.02, 1e-6) == pytest.approx(deep * (1 + 0.318 / 1.05539 * (1 + 0.5 / 1.45390)), rel=1e-5)


@pytest.mark.parametrize("liquid", [CUP, TROUGH], ids=["cup", "trough"])
def test_what_moves_hangs_below_the_surface_and_is_slower_than_what_follows(liquid: Liquid) -> None:
    modes, half = liquid.modes(liquid.fill), liquid.inside.half(liquid.fill)
    long = int(np.argmax(half))
    assert modes.height.max() < 0
    assert modes.height.min() > -liquid.fill
    assert modes.frozen.com_B == pytest.approx([0.0, 0.0, -0.5 * liquid.fill])
    assert modes.following > modes.omega[:, long].max() * 1.1
    # At the wall a plane of slope 1 rises by R: most of it by the first mode.
    first = {True: 2 / (1.84118**2 - 1), False: 8 / np.pi**2}[liquid.inside.round]
    assert modes.rise[0] == pytest.approx(first * half, rel=1e-4)
    assert np.all(modes.rest_rise > 0)


def test_a_trough_turns_about_its_upright_axis_the_same_whichever_side_is_called_x() -> None:
    x, y = (
        Liquid(Rectangle(*sides), 0.0, 0.05, 0.1, 1000.0, (0.0, 0.0)).modes(0.05).frozen
        for sides in ((0.12, 0.07), (0.07, 0.12))
    )
    assert x.inertia_com[2, 2] == pytest.approx(y.inertia_com[2, 2], rel=1e-6)
    assert x.inertia_com[0, 0] == pytest.approx(y.inertia_com[1, 1], rel=1e-6)


def test_a_hollow_is_a_solid_less_what_is_cut_out() -> None:
    """A tube's wall and bottom, of volumes and levers over the base."""
    solid, inside = shapes.cylinder(0.05, 0.1), Liquid(Round(0.04), 0.02, 0.05, 0.08, 1000.0, (0.0, 0.0))
    com, inertia = hollow(solid, inside)
    R = np.linalg.norm(solid.base_polygon, axis=1).max()
    outer, inner = np.pi * R**2 * 0.1, np.pi * 0.04**2 * 0.08
    z = (outer * 0.05 - inner * 0.06) / (outer - inner)  # over the base
    assert com == pytest.approx([0.0, 0.0, z - 0.05])
    about = outer * solid.unit_inertia[2, 2] - inner * shapes.cylinder(0.04, 0.08).unit_inertia[2, 2]
    assert inertia[2, 2] == pytest.approx(about / (outer - inner))


def test_the_surface_of_a_capsule_is_about_its_middle() -> None:
    import coal
    import pinocchio as pin

    points = surface(coal.Capsule(0.1, 0.4), pin.SE3(np.eye(3), np.array([1.0, 2.0, 3.0])))[0]
    assert points.min(axis=0) == pytest.approx([0.9, 1.9, 2.7], abs=2e-3)
    assert points.max(axis=0) == pytest.approx([1.1, 2.1, 3.3], abs=2e-3)
