"""Samples: where they lie, how they are spread, that a run can be had again, and that objects can exist."""

import itertools

import numpy as np
import pytest

from salver import scenario as scenarios
from salver.errors import SalverError
from salver.models.uncertain.parameters import NOTHING, Parameter, UncertainSet
from salver.sampling import METHODS, draw, sign_vectors

OWN = (Parameter("cube", "mass"), Parameter("cube", "com", "x"), Parameter("cube", "friction"))
BOX = UncertainSet(OWN, np.array([1.0, 0.0, 0.5]), np.array([0.1, 0.02, 0.05]))
CORRELATION = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, -0.3], [0.0, -0.3, 1.0]])
ELLIPSOID = UncertainSet(OWN, BOX.nominal, BOX.half_range, "ellipsoid", CORRELATION)


def unit(uncertain: UncertainSet, values: np.ndarray) -> np.ndarray:
    """Back to the unit box or ball."""
    return np.linalg.solve(uncertain.factor, (values - uncertain.nominal).T).T


def cube(**uncertainty):
    base = scenarios.load("panda-cube").model_dump(mode="json", exclude_none=True)
    base["objects"][0]["uncertainty"] = uncertainty
    base["objects"][0].pop("inertia")
    return base


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("uncertain", [BOX, ELLIPSOID], ids=["box", "ellipsoid"])
def test_samples_lie_in_the_set_and_come_again_with_the_same_seed(method, uncertain):
    values = draw(uncertain, 200, 3, method)
    s = unit(uncertain, values)
    assert values.shape == (200, 3)
    norm = np.abs(s).max(axis=1) if uncertain.kind == "box" else np.linalg.norm(s, axis=1)
    assert norm.max() <= 1 + 1e-12
    assert np.array_equal(values, draw(uncertain, 200, 3, method))
    if method != "corners":
        assert not np.allclose(values, draw(uncertain, 200, 4, method))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("uncertain", [BOX, ELLIPSOID], ids=["box", "ellipsoid"])
def test_a_run_does_not_depend_on_how_many_others_there_are(method, uncertain):
    assert np.array_equal(draw(uncertain, 7, 5, method), draw(uncertain, 100, 5, method)[:7])


def test_uniform_in_the_box_has_its_moments():
    s = unit(BOX, draw(BOX, 4000, 0))
    assert np.abs(s.mean(axis=0)).max() < 4 * np.sqrt(1 / 3 / 4000)
    assert np.abs(np.cov(s.T) - np.eye(3) / 3).max() < 0.03


def test_uniform_in_the_ellipsoid_is_uniform_in_volume_and_correlated():
    values = draw(ELLIPSOID, 4000, 0)
    radius = np.linalg.norm(unit(ELLIPSOID, values), axis=1)
    # In a ball of dimension 3 the share within radius r is r^3.
    for r in (0.3, 0.6, 0.9):
        assert abs(np.mean(radius < r) - r**3) < 4 * np.sqrt(0.25 / 4000)
    # The covariance of the uniform distribution on {x: x^T W^-1 x <= 1} is W / (n_p + 2).
    w = np.outer(BOX.half_range, BOX.half_range) * CORRELATION
    scale = np.outer(BOX.half_range, BOX.half_range)
    assert np.abs((np.cov(values.T) * 5 - w) / scale).max() < 0.07


def test_the_first_runs_of_corners_are_exactly_the_corners_of_the_box():
    values = draw(BOX, 10, 0, "corners")
    expected = {tuple(np.round(BOX.nominal + BOX.half_range * s, 12)) for s in itertools.product((-1, 1), repeat=3)}
    assert {tuple(np.round(v, 12)) for v in values[:8]} == expected
    assert np.allclose(values[0], BOX.nominal - BOX.half_range)
    assert np.allclose(values[1], BOX.nominal + BOX.half_range)
    assert np.abs(unit(BOX, values[8:])).max() < 1


def test_corners_of_an_ellipsoid_are_on_its_boundary_and_touch_its_bounding_box():
    values = draw(ELLIPSOID, 14, 0, "corners")
    assert np.allclose(np.linalg.norm(unit(ELLIPSOID, values), axis=1), 1)
    touched = (values - ELLIPSOID.nominal) / ELLIPSOID.half_range
    for j in range(3):
        assert touched[2 * j, j] == pytest.approx(-1)
        assert touched[2 * j + 1, j] == pytest.approx(1)
    # At its largest in parameter j, parameter i of an ellipsoid is at its correlation with j.
    assert np.allclose(touched[1], CORRELATION[0])


def test_many_parameters_give_distinct_corners_without_enumerating_them():
    signs = list(itertools.islice(sign_vectors(40, 0), 500))
    assert len({tuple(s) for s in signs}) == 500
    assert np.all(signs[0] == -1)
    assert np.all(signs[1] == 1)
    assert len({tuple(s) for s in sign_vectors(6, 1)}) == 64


@pytest.mark.parametrize("method", METHODS)
def test_any_contents_differ_from_run_to_run_and_a_run_comes_again(method):
    """Nothing but the contents is unknown: inertias that are all others, of as many runs as are asked for."""
    scenario = scenarios.parse(cube(contents="any", com=[0.004, 0.003, 0.002]), "test")
    uncertain, bodies = scenario.payload.uncertain, scenario.payload.bodies
    values = draw(uncertain, 12, 5, method, bodies)
    inertia = values[:, [p.kind == "inertia" for p in uncertain.parameters]]
    assert len(np.unique(inertia.round(12), axis=0)) == 12
    assert np.ptp(inertia, axis=0).min() > 1e-5
    assert np.array_equal(values, draw(uncertain, 12, 5, method, bodies))
    assert np.array_equal(values[:5], draw(uncertain, 5, 5, method, bodies))


def test_impossible_inertias_are_left_out():
    # A slender rod has Izz << Ixx = Iyy: half of the draws of Ixx against Iyy break the triangle inequality.
    data = cube(inertia=[2e-5, 2e-5, 6e-5])
    scenario = scenarios.parse(data, "test")
    values = draw(scenario.payload.uncertain, 100, 0, "uniform", scenario.payload.bodies)
    xx, yy, zz = values.T
    assert np.all((xx + yy >= zz) & (xx + zz >= yy) & (yy + zz >= xx))
    free = draw(scenario.payload.uncertain, 100, 0, "uniform")
    assert not np.all(free[:, 0] + free[:, 1] >= free[:, 2])


def test_no_sample_needs_mass_outside_the_shape():
    # All mass in the faces x = +-a is the most that E[x^2] can be: a^2 m = (Iyy + Izz - Ixx) / 2.
    data = cube(mass="10%", inertia="95%", com=[0.015, 0.015, 0.0])
    scenario = scenarios.parse(data, "test")
    values = draw(scenario.payload.uncertain, 100, 0, "uniform", scenario.payload.bodies)
    names = scenario.payload.uncertain.names
    column = {name: values[:, names.index(name)] for name in names}
    second_x = (column["inertia_yy"] + column["inertia_zz"] - column["inertia_xx"]) / 2
    about_B = second_x / column["mass"] + column["com_x"] ** 2
    assert about_B.max() <= 0.02**2 + 1e-12
    # (a - x)(a - y) >= 0 everywhere inside; with no product of inertia given, E[xy] = com_x com_y.
    assert np.all(0.02**2 - 0.02 * (column["com_x"] + column["com_y"]) + column["com_x"] * column["com_y"] >= 0)


def test_a_nominal_inertia_too_large_for_the_shape_does_not_empty_the_set():
    # The paper's 3.4e-4 kg m^2 cannot be had within a 4 cm cube of 0.256 kg (2.05e-4 at most, mass in the corners).
    scenario = scenarios.load("panda-cube").with_changes(objects__0__uncertainty__inertia="10%")
    values = draw(scenario.payload.uncertain, 100, 0, "uniform", scenario.payload.bodies)
    assert np.ptp(values[:, 1]) > 0.9 * 0.2 * 3.4e-4


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_set_in_which_nothing_is_possible_is_refused_with_a_sentence(method):
    data = cube(inertia=[1e-9, 1e-9, 1e-9])
    scenario = scenarios.parse(data, "test")
    nominal = np.array([1e-5, 1e-5, 9e-5])  # Izz > Ixx + Iyy
    impossible = UncertainSet(scenario.payload.uncertain.parameters, nominal, np.full(3, 1e-9))
    with pytest.raises(SalverError, match=r"None of \d+ samples"):
        draw(impossible, 5, 0, method, scenario.payload.bodies)


def test_wrong_use_is_one_sentence():
    with pytest.raises(SalverError, match='no sampling method "random"; known are uniform, corners'):
        draw(BOX, 3, 0, "random")
    with pytest.raises(SalverError, match="must be 0 or more"):
        draw(BOX, -1)
    assert draw(NOTHING, 4).shape == (4, 0)
