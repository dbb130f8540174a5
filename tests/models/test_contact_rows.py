"""Worst-case contact rows: never optimistic, attained where they claim to be exact, and networks of objects."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import linprog

from armless_scenarios import scenario
from newton_euler import wrench
from salver.geometry import GRAVITY_S, Array, exp
from salver.models.bodies import Body
from salver.models.contact.internal_wrench import internal_wrenches
from salver.models.contact.wrench_cone import cone_facets
from salver.models.contact_rows import ContactRows, contact_rows
from salver.models.interfaces import networks, sure_contacts, to_tray
from salver.models.rigid_body import RigidBody, inertia_matrix
from salver.models.tray_motion import motion_vector
from salver.models.uncertain.parameters import INERTIAL, inertial_vector
from salver.trajectory import MotionSamples

BOX = {
    "name": "box",
    "shape": {"type": "box", "size": [0.08, 0.06, 0.2]},
    "mass": 0.5,
    "friction": 0.4,
    "at": [0.03, -0.02],
    "yaw_deg": 25.0,
    "com": [0.004, 0.003, -0.02],
}
EVERYTHING = {
    "mass": "20%",
    "com": [0.006, 0.005, 0.03],
    "inertia": [2e-4, 1e-4, 2e-4, 5e-5, 4e-5, 1e-4],
    "friction": 0.05,
    "position": [0.004, 0.006],
}


def tray_motions(count: int, seed: int, turning: float) -> MotionSamples:
    """Random instants of the tray frame E."""
    rng = np.random.default_rng(seed)
    zero = np.zeros((count, 3))
    return MotionSamples(
        np.arange(count, dtype=float),
        zero,
        zero,
        rng.normal(size=(count, 3)) * [2, 2, 1],
        exp(rng.normal(size=(count, 3)) * 0.2 * turning),
        rng.normal(size=(count, 3)) * turning,
        rng.normal(size=(count, 3)) * 4 * turning,
    )


def vector(motion: MotionSamples) -> Array:
    return motion_vector(motion.R_SB, motion.a_S, motion.omega_B, motion.alpha_B)


def required_wrench(body: Body, values: dict[str, float], motion_E: MotionSamples) -> Array:
    """(T, 6) at B of a body with true parameters, where it really stands on the really tilted tray."""
    inertial = inertial_vector(body.inertial) + [values.get(name, 0.0) for name in INERTIAL]
    true = RigidBody(inertial[0], inertial[1:4], inertia_matrix(inertial[4:]))
    place = body.p_EB + np.array([values.get("position_x", 0.0), values.get("position_y", 0.0), 0.0])
    tilt = exp(np.array([values.get("tilt_x", 0.0), values.get("tilt_y", 0.0), 0.0]))
    motion = motion_E.of_frame(np.zeros(3), tilt).of_frame(place, body.R_EB)
    return wrench(true.phi, motion.R_SB, motion.a_S, motion.omega_B, motion.alpha_B)


def true_values(body: Body, values: dict[str, float], motion_E: MotionSamples, rows: Array) -> Array:
    """(T, n_f) rows at the true wrench, per weight."""
    weight = (body.inertial.mass + values.get("mass", 0.0)) * -GRAVITY_S[2]
    return required_wrench(body, values, motion_E) @ rows.T / weight


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
@pytest.mark.parametrize("turning", [0.0, 1.0])
def test_worst_case_is_never_optimistic(kind: str, turning: float) -> None:
    made = scenario([BOX | {"uncertainty": EVERYTHING}], uncertainty={"set": kind, "tilt_deg": [1.5, 2.0]})
    body, rows = made.payload.first, contact_rows(made.payload)[0]
    least = cone_facets(replace(body.contacts, friction=body.contacts.friction - 0.05)).rows
    assert_allclose(rows.label.size % len(least), 0)
    motion = tray_motions(40, 1, turning)
    bound = rows.worst(vector(motion)).reshape(40, -1, len(least)).max(axis=1)
    uncertain, rng = made.payload.uncertain, np.random.default_rng(2)
    assert uncertain.size == 15
    largest = np.full_like(bound, -np.inf)
    for _ in range(300):
        s = rng.choice([-1.0, 1.0], size=uncertain.size) if kind == "box" else rng.normal(size=uncertain.size)
        s = s if kind == "box" else s / np.linalg.norm(s)
        deviation = dict(zip(uncertain.names, uncertain.factor @ s, strict=True))
        largest = np.maximum(largest, true_values(body, deviation, motion, least))
    assert np.all(largest <= bound + 1e-4 * np.abs(bound).max() * turning + 2e-6)
    nominal = true_values(body, {}, motion, least)
    # Random corners reach a good part of the tube's radius: the bound is not idle.
    share = (largest - nominal) / (bound - nominal)
    assert np.median(share) > (0.5 if kind == "box" else 0.25)


def test_corners_attain_the_worst_case_when_the_tray_does_not_turn() -> None:
    """Mass, centre of mass, inertia and friction: exact, row by row."""
    made = scenario([BOX | {"uncertainty": EVERYTHING | {"position": [0, 0]}}])
    body, rows = made.payload.first, contact_rows(made.payload)[0]
    least = cone_facets(replace(body.contacts, friction=body.contacts.friction - 0.05)).rows
    motion = tray_motions(30, 3, 0.0)
    bound = rows.worst(vector(motion)).reshape(30, -1, len(least)).max(axis=1)
    half = EVERYTHING["com"]
    assert isinstance(half, list)
    corners = [
        {"mass": m * 0.1, "com_x": x * half[0], "com_y": y * half[1], "com_z": z * half[2]}
        for m, x, y, z in product((-1, 1), repeat=4)
    ]
    largest = np.max([true_values(body, corner, motion, least) for corner in corners], axis=0)
    assert_allclose(bound, largest, atol=1e-12)


def test_nominal_rows_are_the_facets_of_each_body() -> None:
    made = scenario([BOX, BOX | {"name": "other", "at": [-0.05, 0.04], "yaw_deg": -40.0}])
    motion = tray_motions(20, 4, 1.0)
    both = contact_rows(made.payload.nominal)
    assert [r.network.bodies[0].name for r in both] == ["box", "other"]
    for body, rows in zip(made.payload.bodies, both, strict=True):
        assert_allclose(
            rows.worst(vector(motion)), true_values(body, {}, motion, cone_facets(body.contacts).rows), atol=1e-12
        )


def die(name: str, on: str, **more: object) -> dict:
    shape = {"type": "box", "size": [0.065, 0.065, 0.065]}
    return {"name": name, "shape": shape, "mass": 0.02, "friction": 0.54, "on": on, **more}


def test_lower_of_two_dice_carries_both() -> None:
    made = scenario([die("lower", "tray"), die("upper", "lower", at=[0.01, 0.0], friction=0.71)])
    (network,) = networks(made.payload.bodies)
    assert [f.name for f in network.interfaces] == ["lower on tray", "upper on lower"]
    assert network.internal.shape[2] == 0
    # The upper die rests where the two faces overlap: x from -0.0225 to 0.0325 of the lower one.
    corners = network.interfaces[1].contacts.p_BC[:, 0] + network.bodies[1].p_EB[0]
    assert_allclose([corners.min(), corners.max()], [-0.0225, 0.0325], atol=1e-12)
    motion = tray_motions(15, 6, 1.0)
    rows = contact_rows(made.payload.nominal)[0]
    lower, upper = network.bodies
    total = sum(required_wrench(b, {}, motion) @ to_tray(b.p_EB - lower.p_EB, b.R_EB).T for b in network.bodies)
    expected = total @ cone_facets(lower.contacts).rows.T / (0.04 * 9.81)
    assert_allclose(rows.worst(vector(motion))[:, rows.interface == 0], expected, atol=1e-12)
    alone = required_wrench(upper, {}, motion) @ cone_facets(network.interfaces[1].contacts).rows.T / (0.02 * 9.81)
    assert_allclose(rows.worst(vector(motion))[:, rows.interface == 1], alone, atol=1e-12)


def test_uncertain_position_keeps_only_the_sure_overlap() -> None:
    where = {"position": [0.002, 0.003]}
    made = scenario([die("lower", "tray", uncertainty=where), die("upper", "lower", uncertainty=where)])
    rows = contact_rows(made.payload)[0]
    motion = tray_motions(1, 7, 0.0)
    still = replace(motion, a_S=np.zeros((1, 3)), R_SB=np.eye(3)[None])
    # At rest the margin of tipping shrinks with the overlap: by 4 mm in x and 6 mm in y, of 32.5 mm.
    sure = sure_contacts(rows.network, np.array([0.1, 0.1]), made.payload.uncertain)[1]
    assert_allclose(np.abs(sure.p_BC[:, :2]).max(axis=0), [0.0285, 0.0265], atol=1e-12)
    assert rows.worst(vector(still)).max() < 0


def block(name: str, x: float, on: object = "tray") -> dict:
    shape = {"type": "box", "size": [0.038, 0.09, 0.103]}
    shape = shape if on == "tray" else {"type": "box", "size": [0.103, 0.09, 0.038]}
    return {"name": name, "shape": shape, "mass": 0.18, "friction": 0.3, "on": on, "at": [x, 0.0]}


ARCH = [block("left", -0.0325), block("right", 0.0325), block("top", 0.0, ["left", "right"])]


def lifted_feasible(items: list[Body], motion: MotionSamples) -> bool:
    """Reference for one instant: balance of every body over all contact forces at once."""
    (network,) = networks(items)
    maps = [to_tray(items[f.upper].p_EB, items[f.upper].R_EB) @ f.contacts.grasp_map for f in network.interfaces]
    columns = np.cumsum([0] + [m.shape[1] for m in maps])
    balance = np.zeros((6 * len(items), columns[-1]))
    for e, (f, m) in enumerate(zip(network.interfaces, maps, strict=True)):
        balance[6 * f.upper : 6 * f.upper + 6, columns[e] : columns[e + 1]] += m
        if f.lower is not None:
            balance[6 * f.lower : 6 * f.lower + 6, columns[e] : columns[e + 1]] -= m
    target = np.concatenate([to_tray(b.p_EB, b.R_EB) @ required_wrench(b, {}, motion)[0] for b in items])
    scale = np.tile([1, 1, 1, 20, 20, 20], len(items))
    result = linprog(np.zeros(columns[-1]), A_eq=scale[:, None] * balance, b_eq=scale * target, method="highs")
    return result.status == 0


def test_arch_agrees_with_all_contact_forces_at_once() -> None:
    made = scenario(ARCH)
    items, (rows,) = made.payload.bodies, contact_rows(made.payload.nominal)
    assert rows.internal.shape[1] == 6
    # Neither sharing alone would do: the rows need the internal wrenches.
    motion = tray_motions(40, 8, 0.3)
    value = rows.worst(vector(motion))
    best = np.array([least_of(row, rows.internal) for row in value])
    feasible = [
        lifted_feasible(items, MotionSamples(*(x[k : k + 1] for x in vars(motion).values()))) for k in range(40)
    ]
    assert 5 < sum(feasible) < 35
    assert_allclose(best <= 0, feasible)
    assert np.any((value.max(axis=1) > 0) & (best <= 0))


@pytest.mark.parametrize("name", ["left", "right", "top"])
@pytest.mark.parametrize("place", [[0.002, 0.0], [0.0, 0.003]])
def test_an_arch_of_which_one_body_may_stand_elsewhere_counts_on_no_internal_wrenches(
    name: str, place: list[float]
) -> None:
    """Their lever arms are known only where every body surely stands; friction and mass may be uncertain."""

    def rows(unknown: dict) -> ContactRows:
        uncertain = [{**body, "uncertainty": unknown} if body["name"] == name else body for body in ARCH]
        return contact_rows(scenario(uncertain).payload)[0]

    assert rows({"friction": 0.05, "mass": "10%"}).internal.shape[1] == 6
    assert rows({"position": place}).internal.shape[1] == 0


def least_of(row: Array, internal: Array) -> float:
    """Largest row with the best internal wrenches, at one instant."""
    return float((row + internal_wrenches(row[None], internal) @ internal.T).max())


@pytest.mark.parametrize("seed", range(4))
def test_no_sharing_of_internal_wrenches_is_better_than_the_one_found(seed: int) -> None:
    """Against the programme over all rows, of which salver's takes in few at a time."""
    rng = np.random.default_rng(seed)
    value, internal = rng.normal(size=(1, 300)), rng.normal(size=(300, 4))
    rows = np.column_stack([internal, -np.ones(300)])
    known = linprog(np.append(np.zeros(4), 1.0), A_ub=rows, b_ub=-value[0], bounds=(None, None), method="highs").fun
    assert least_of(value[0], internal) == pytest.approx(known, rel=1e-7)


def test_internal_wrenches_may_be_held_back_by_rows_that_seemed_not_to_matter() -> None:
    """One hundredth of a unit and w for some, -w for many others: half of it is left, at w = -.005."""
    value, internal = np.repeat([0.01, 0.0], [40, 260]), np.repeat([1.0, -1.0], [40, 260])[:, None]
    assert least_of(value, internal) == pytest.approx(0.005)


@pytest.mark.slow
@pytest.mark.parametrize("pace", [0.9, 1.1])
def test_arch_along_a_motion_has_the_right_least_margin_and_first_failure(pace: float) -> None:
    """Internal wrenches are solved for at few instants and interpolated between them."""
    (rows,) = contact_rows(scenario(ARCH).payload.nominal)
    t = np.linspace(0, 1, 101)
    motion = tray_motions(101, 9, 0.0)
    bell = 2.8 * pace**2 * np.sin(2 * np.pi * t)[:, None] * np.array([0.2, 1.0, 0.1])
    motion = replace(motion, R_SB=np.tile(np.eye(3), (101, 1, 1)), a_S=bell)
    value = rows.worst(vector(motion))
    along = (value + internal_wrenches(value, rows.internal) @ rows.internal.T).max(axis=1)
    each = np.array([least_of(row, rows.internal) for row in value])
    assert np.all(along >= each - 1e-9)
    assert_allclose(along.max(), each.max(), atol=1e-6)
    assert (each.max() > 0) == (pace > 1)
    assert_allclose(np.argmax(along > 0), np.argmax(each > 0))


def test_arch_at_rest_shares_the_weight_evenly() -> None:
    (network,) = networks(scenario(ARCH).payload.bodies)
    weight = np.array([0, 0, 0.18 * 9.81, 0, 0, 0])
    carried = network.share[:, 2] @ (to_tray(network.bodies[2].p_EB, np.eye(3)) @ weight)
    by_name = {f.name: c[2] for f, c in zip(network.interfaces, carried, strict=True)}
    assert_allclose(list(by_name.values()), [0.5 * weight[2]] * 4, rtol=1e-9)
