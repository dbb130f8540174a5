"""What an estimate says of mass, centre of mass and inertia: physically possible, and sure to hold the truth."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import clarabel
import numpy as np
import pytest
from scipy.sparse import csc_matrix

import salver as sv
from salver.errors import SalverError
from salver.geometry import Array
from salver.learning import Identified, SensorBounds, identify
from salver.learning.load.narrowing import _within
from salver.learning.load.ranges import WIDTH, Estimate, consistent, intervals, slid
from salver.models.bodies import Body
from salver.models.physical import hull_faces, nearest, random_inertia, realisable
from salver.models.rigid_body import RigidBody
from salver.models.uncertain.parameters import INERTIAL, inertial_vector, phi_of
from salver.planning.plan import Plan
from salver.scenario import load
from sensed_arm import SensedArm, Sensors

WIDE = {"mass": "50%", "com": [0.015, 0.015, 0.015]}
QUIET = Sensors(wrist_coloured=0.0, rate=1000.0, force_bias=0.001, moment_bias=4e-5)
GOOD = SensorBounds(0.002, 8e-5, *[1e-9] * 3, 0.05, *[1e-9] * 8)  # hardly more than noise
NONE = np.zeros((10, 1))


def bottle() -> Body:
    return load("panda-tall-bottle").payload.first


def covariance(rng: np.random.Generator, phi: Array, size: float) -> Array:
    A = rng.standard_normal((10, 10))
    scale = size * np.concatenate([[phi[0]], np.full(3, 0.05 * phi[0]), np.full(6, np.abs(phi[4:]).max())])
    return np.asarray(np.outer(scale, scale) * (A @ A.T / 10 + 0.05 * np.eye(10)))


def values_of(phi: Array) -> Array:
    """(10,) values of `INERTIAL`."""
    return inertial_vector(RigidBody.from_phi(phi))


def filled(body: Body, rng: np.random.Generator, mass: float = 0.3) -> Array:
    """(10,) values of some mass distribution inside the shape, its centre of mass up to 15 mm away."""
    com = 0.015 * rng.uniform(-1, 1, 3)
    return np.concatenate([[mass], com, mass * random_inertia(body, com, rng)])


def test_what_a_mass_inside_the_shape_can_have_is_left_as_it_is() -> None:
    body, rng = bottle(), np.random.default_rng(1)
    for _ in range(20):
        phi = phi_of(filled(body, rng))
        found, off = nearest(body, phi, covariance(rng, phi, 0.1))
        assert off == 0
        assert np.array_equal(found, phi)


def test_the_nearest_possible_phi_is_that_of_a_conic_solver() -> None:
    """min (x - phi)^T C^-1 (x - phi), pseudo-inertia positive semidefinite, moments of pairs of faces not negative."""
    body, rng = bottle(), np.random.default_rng(2)
    faces = hull_faces(body)
    i, j = np.triu_indices(len(faces), 1)
    units = []
    for unit in np.eye(10):
        inertia = np.array([[unit[4], unit[5], unit[7]], [unit[5], unit[6], unit[8]], [unit[7], unit[8], unit[9]]])
        J = np.zeros((4, 4))
        J[:3, :3] = 0.5 * np.trace(inertia) * np.eye(3) - inertia
        J[:3, 3] = J[3, :3] = unit[1:4]
        J[3, 3] = unit[0]
        units.append(J)
    pairs = np.column_stack([np.sum((faces[i] @ J) * faces[j], axis=1) for J in units])
    outside = np.column_stack([faces @ J[:, 3] for J in units])
    column, row = np.tril_indices(4)  # the upper triangle column by column, off the diagonal times sqrt 2
    root = np.where(row == column, 1.0, np.sqrt(2))
    semidefinite = np.column_stack([root * J[row, column] for J in units])
    moved = 0
    for _ in range(6):
        true = phi_of(filled(body, rng))
        C = covariance(rng, true, 0.3)
        phi = true + 2 * np.linalg.cholesky(C) @ rng.standard_normal(10)
        L = np.linalg.cholesky(C)  # in standard deviations: x = phi + L z
        A = -np.vstack([pairs, -outside, semidefinite]) @ L
        b = np.vstack([pairs, -outside, semidefinite]) @ phi
        size = np.linalg.norm(A, axis=1)[: -len(root)].max()
        cones = [clarabel.NonnegativeConeT(len(pairs) + len(outside)), clarabel.PSDTriangleConeT(4)]
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_feas = settings.tol_gap_abs = settings.tol_gap_rel = 1e-11
        solver = clarabel.DefaultSolver(
            csc_matrix(np.eye(10)), np.zeros(10), csc_matrix(A / size), b / size, cones, settings
        )
        z = np.array(solver.solve().x)
        found, off = nearest(body, phi, C)
        assert off == pytest.approx(np.linalg.norm(z), rel=1e-4, abs=1e-6)
        assert np.linalg.solve(L, found - phi) == pytest.approx(z, abs=2e-3)
        assert realisable(body, values_of(found), within_shape=True)[0]
        moved += off > 0
    assert moved >= 4


def test_intervals_of_the_inertia_hold_every_phi_within_so_many_deviations() -> None:
    """Without linearising: h h^T / m is bent. And they are tight where the covariance is small."""
    body, rng = bottle(), np.random.default_rng(3)
    for size in (0.02, 0.1, 0.25):
        phi = phi_of(filled(body, rng))
        C = covariance(rng, phi, size)
        low, high = (x[4:] for x in intervals(Estimate(phi, C, NONE, np.zeros(3)), 2.0))
        away = rng.standard_normal((4000, 10))
        away *= 2 / np.linalg.norm(away, axis=1, keepdims=True)
        seen = np.array([values_of(phi + x)[4:] for x in away @ np.linalg.cholesky(C).T if phi[0] + x[0] > 0])
        assert np.all(seen >= low - 1e-12)
        assert np.all(seen <= high + 1e-12)
    tiny = covariance(rng, phi, 1e-4)
    low, high = (x[4:] for x in intervals(Estimate(phi, tiny, NONE, np.zeros(3)), 2.0))
    step = 1e-7 * np.eye(10)
    slope = np.array([(values_of(phi + s)[4:] - values_of(phi - s)[4:]) / 2e-7 for s in step]).T
    assert 0.5 * (high - low) == pytest.approx(2 * np.sqrt(np.diag(slope @ tiny @ slope.T)), rel=2e-3)


@pytest.mark.parametrize("size", [0.01, 0.05])
def test_intervals_hold_all_systematic_errors_at_once_and_are_reached(size: float) -> None:
    """Every sign of four errors as large as their bounds, without noise; the mass's extremes are reached, the others'
    nearly, for small ones."""
    body, rng = bottle(), np.random.default_rng(12)
    phi = phi_of(filled(body, rng))
    errors = np.linalg.cholesky(covariance(rng, phi, size))[:, :4]
    low, high = intervals(Estimate(phi, 1e-14 * np.diag(phi**2 + 1e-6), errors, np.zeros(3)))
    signs = np.array(np.meshgrid(*[[-1, 1]] * 4)).reshape(4, -1).T
    seen = np.array([values_of(phi + errors @ e) for e in signs])
    assert np.all(seen >= low - 1e-9)
    assert np.all(seen <= high + 1e-9)
    assert seen[:, 0].min() == pytest.approx(low[0], rel=1e-6)
    assert np.all(np.ptp(seen, axis=0) > (0.8 if size < 0.02 else 0.5) * (high - low))


def test_an_inertia_of_masses_inside_the_shape_is_never_cut_off() -> None:
    body, rng = bottle(), np.random.default_rng(4)
    half = 0.5 * np.ptp(body.points_B, axis=0)
    cuts = 0
    for _ in range(200):
        true = filled(body, rng)
        low, high = true[4:] - 1e-3 * rng.uniform(size=6), true[4:] + 1e-3 * rng.uniform(size=6)
        found = consistent(low, high, true[0] * half**2)
        assert np.all(found[0] >= low)
        assert np.all(found[1] <= high)
        assert np.all(found[0] <= true[4:] + 1e-12)
        assert np.all(true[4:] <= found[1] + 1e-12)
        cuts += bool(np.any(found[0] > low) or np.any(found[1] < high))
    assert cuts > 50
    slim = consistent(np.array([1.0, 0, 1, 0, 0, 0]), np.array([1.0, 0, 3, 0, 0, 0.5]), np.full(3, 10.0))
    assert slim[1] == pytest.approx([1.0, 0, 1.5, 0, 0, 0.5])  # no principal moment is more than the other two


def test_a_load_that_slid_is_off_by_no_more_than_is_said() -> None:
    """phi of a body at c + x of which only c is known, |x| up to so much: m c and I about B differ."""
    rng = np.random.default_rng(8)
    phi = phi_of(filled(bottle(), rng))
    shift = np.array([2e-3, 1e-3, 5e-4])
    said = slid(Estimate(phi, 1e-20 * np.eye(10), NONE, shift))
    for _ in range(300):
        body = RigidBody.from_phi(phi)
        moved = RigidBody(body.mass, body.com_B + shift * rng.uniform(-1, 1, 3), body.inertia_com).phi
        assert np.all(np.abs(moved - phi)[4:] <= said[4:] + 1e-15)
    assert said[1:4] == pytest.approx(shift)


@pytest.fixture
def plan(bottle_plan: Plan) -> Plan:
    return bottle_plan


def found(plan: Plan, true: Array, seed: int, changes: Mapping[str, object], sensors: Sensors = QUIET) -> Identified:
    known = replace(plan, scenario=plan.scenario.with_changes(**changes))
    arm = SensedArm(known, seed, sensors, joints=False)
    return identify(known, [arm.log(true)], arm.log(None), GOOD)


@pytest.mark.slow
def test_ranges_hold_random_fillings_and_are_narrow(plan: Plan) -> None:
    """95 % of ten parameters of 16 loads are claimed; the bottle's motion shows its inertia well."""
    body, rng = plan.scenario.payload.first, np.random.default_rng(6)
    held: list[bool] = []
    sure: list[bool] = []
    widths: list[list[float]] = []
    for seed in range(16):
        true = filled(body, rng, 0.256 * rng.uniform(0.55, 1.45))
        told = found(plan, true, seed, {"objects__0__uncertainty": WIDE | {"contents": "any"}})
        ranges = [told.ranges[name] for name in INERTIAL]
        held += [r.likely[0] <= x <= r.likely[1] for r, x in zip(ranges, true, strict=True)]
        sure += [r.low <= x <= r.high for r, x in zip(ranges, true, strict=True)]
        assert realisable(body, values_of(told.phi))[0]
        assert told.learnt_scenario().objects[0].uncertainty.contents == "any"
        widths.append([r.half / (r.before[1] - r.before[0]) for r in ranges[4:]])
        assert told.told == []
    xx, xy, yy, xz, yz, zz = np.median(widths, axis=0)
    assert max(xx, yy, xz, yz) < 0.03
    assert max(xy, zz) < 0.16  # of what may be in the bottle: this motion turns it least about z
    assert np.mean(held) >= 0.95
    assert np.mean(sure) >= 0.99


@pytest.mark.slow
def test_ranges_of_inertia_are_narrowed_and_nothing_else_of_it_becomes_uncertain(plan: Plan) -> None:
    nominal = inertial_vector(plan.scenario.payload.first.inertial)
    true = nominal.copy()
    true[[4, 6]] *= 1.1
    told = found(plan, true, 1, {"objects__0__uncertainty": WIDE | {"inertia": "80%"}})
    made = told.learnt_scenario()
    ranges = {p.quantity: h for p, h in made.payload.uncertain.ranges.items()}
    off = inertial_vector(made.payload.first.inertial) - true
    for k, name in enumerate(INERTIAL[4:], 4):
        if name in ("inertia_xx", "inertia_yy", "inertia_zz"):
            assert abs(off[k]) <= ranges[name] < 0.8 * nominal[k]
        else:
            assert name not in ranges


@pytest.mark.slow
def test_a_set_that_was_an_ellipsoid_and_becomes_a_box_has_no_correlation(plan: Plan) -> None:
    """Half-ranges of the box within an ellipsoid would leave its corners out."""
    true = inertial_vector(plan.scenario.payload.first.inertial)
    before = {"objects__0__uncertainty": WIDE, "uncertainty__set": "ellipsoid"}
    told = found(plan, true, 1, before | {"uncertainty__correlation": {"mass,com_x": 0.3}})
    made = told.learnt_scenario()
    assert (made.uncertainty.set, made.uncertainty.correlation) == ("box", {})


@pytest.mark.slow
def test_an_inertia_that_the_scenario_or_the_shape_does_not_allow_is_told(plan: Plan) -> None:
    nominal = inertial_vector(plan.scenario.payload.first.inertial)
    for times, more, said in (
        (1.3, {}, "inertia_.*with no range: give uncertainty.inertia"),
        (1.3, {"inertia": "10%"}, r"The logs put inertia_.* kg m\^2, the scenario between"),
        (6.0, {}, "distribution of mass inside bottle"),
    ):
        true = nominal.copy()
        true[4:] *= times
        with pytest.raises(SalverError, match=said):
            found(plan, true, 1, {"objects__0__uncertainty": WIDE | more})


@pytest.mark.parametrize(("k", "unit"), [(0, "kg"), (1, "m"), (3, "m"), (4, "kg m^2"), (9, "kg m^2")])
def test_what_logs_and_scenario_say_apart_is_told_in_its_unit(k: int, unit: str) -> None:
    low, high = np.arange(10.0), np.arange(10.0) + 0.5
    words = f"The logs put {INERTIAL[k]} between {k + 2} and {k + 2.5} {unit}, the scenario between {k} and {k + 0.5}:"
    with pytest.raises(SalverError, match=re.escape(words)):
        _within(k, (low + 2, high + 2), (low, high), (low, high))


def test_joint_torques_say_that_they_show_no_inertia(tmp_path: Path) -> None:
    made = sv.plan("panda-cube-1.0s")
    known = replace(made, scenario=made.scenario.with_changes(objects__0__uncertainty=WIDE))
    arm = SensedArm(known, 3, wrist=False)
    told = identify(known, [arm.log(inertial_vector(known.scenario.payload.first.inertial))], arm.log(None)).told
    assert any("inertia_zz" in sentence and "wrist force-torque sensor would" in sentence for sentence in told)
    assert WIDTH == 3
