"""Worst cases of nasty loads: never below a sample of the nonlinear model, attained, and no more than is documented."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_allclose

import odd_loads
import sampled_sets
from salver.errors import ScenarioError
from salver.geometry import Array
from salver.models.contact_rows import contact_rows
from salver.models.uncertain.contents import Filling, Hull
from salver.models.uncertain.parameters import Parameter
from salver.models.uncertain.worst_case import Drift, UncertainRows, WorstCase
from salver.models.uncertain.worst_contents import SURE
from salver.scenario import Scenario

LOADS = {"single": odd_loads.single, "stack": odd_loads.stack, "pair": odd_loads.pair}
CASES = [(load, kind) for load in LOADS for kind in ("box", "ellipsoid")]
SLOW = pytest.mark.slow


def claimed(made: Scenario, w: Array) -> Array:
    """(T,) the worst case that the contact rows claim, of everything carried."""
    return np.max([rows.worst(w).max(axis=1) for rows in contact_rows(made.payload)], axis=0)


@pytest.mark.parametrize(
    ("load", "kind", "turning"),
    [
        *((*case, 1.0) for case in CASES),
        *(pytest.param("single", kind, 0.0, marks=SLOW) for kind in ("box", "ellipsoid")),
    ],
)
def test_worst_case_lies_between_samples_and_what_is_documented(load: str, kind: str, turning: float) -> None:
    made = LOADS[load](kind)
    rows, w = odd_loads.TrueRows(made), odd_loads.felt(odd_loads.tray_motion(6, 1, turning))
    bound, most, reached = claimed(made, w), sampled_sets.documented(rows, w), sampled_sets.sampled(rows, w)
    # The tilt is cut off after its second order: tilt^3 / 6 of the weight, 3e-6.
    assert np.all(reached <= bound + 1e-5)
    assert np.all(bound <= most + 1e-9)
    nominal = rows.worst({}, w)
    assert np.all(nominal < bound)
    # Products are counted one by one, as if each could be at its worst: at most a third of the tube in an ellipsoid.
    assert np.median((reached - nominal) / (bound - nominal)) > 0.66


@pytest.mark.parametrize(("load", "kind"), CASES)
def test_worst_case_of_a_small_set_is_attained(load: str, kind: str) -> None:
    """Where products do not matter, the tube is as wide as the farthest sample: no term is missing, none too many."""
    made = odd_loads.small(LOADS[load](kind), 1e-3)
    made = made.with_changes(**{f"objects__{k}__uncertainty__position": [3e-6, 2e-6] for k in range(len(made.objects))})
    rows, w = odd_loads.TrueRows(made), odd_loads.felt(odd_loads.tray_motion(10, 2))
    nominal = rows.worst({}, w)
    share = (sampled_sets.sampled(rows, w, 2) - nominal) / (claimed(made, w) - nominal)
    assert_allclose(share, 1.0, atol=2e-3)  # products are a thousandth of the slopes


ONE = {
    "mass": {"mass": 0.08},
    "com_x": {"com": [0.01, 0, 0]},
    "com_y": {"com": [0, 0.012, 0]},
    "com_z": {"com": [0, 0, 0.01]},
    "inertia_xx": {"inertia": [2e-4, 0, 0, 0, 0, 0]},
    "inertia_xy": {"inertia": [0, 1e-4, 0, 0, 0, 0]},
    "inertia_zz": {"inertia": [0, 0, 0, 0, 0, 2e-4]},
    "position_x": {"position": [0.006, 0]},
    "position_y": {"position": [0, 0.007]},
}
TWO = [
    ("lower.com_y", "lower.com_y"),
    ("upper.position_x", "upper.position_x"),
    ("tilt_x", "tilt_x"),
    ("tilt_y", "tilt_y"),
    ("lower.mass", "lower.com_x"),
    ("upper.mass", "upper.com_y"),
    ("lower.com_x", "lower.com_z"),
    ("upper.mass", "upper.position_y"),
    ("upper.com_z", "upper.position_x"),
    ("lower.mass", "upper.mass"),
    ("upper.mass", "lower.position_x"),
    ("upper.com_x", "lower.position_y"),
    ("lower.position_x", "upper.position_x"),
    ("lower.com_y", "tilt_x"),
    ("upper.com_x", "tilt_y"),
    ("upper.mass", "tilt_x"),
    ("upper.position_y", "tilt_x"),
    ("lower.position_x", "tilt_y"),
    ("upper.inertia_xy", "tilt_y"),
    ("lower.inertia_zz", "tilt_x"),
    ("tilt_x", "tilt_y"),
]


def with_only(names: tuple[str, str], kind: str, slippery: str) -> Scenario:
    """The stack with one or two uncertain parameters, correlated in an ellipsoid, one of them on ice."""
    objects = []
    for item in (odd_loads.LOWER, {**odd_loads.UPPER, "mass": 0.6}):
        known: dict = {}
        for name in names:
            owner, _, parameter = name.rpartition(".")
            if owner == item["name"]:
                for key, value in ONE[parameter].items():
                    known[key] = np.add(known[key], value).tolist() if key in known and names[0] != names[1] else value
        objects.append({**item, "uncertainty": known} | ({"friction": 0.25} if item["name"] == slippery else {}))
    tilt = [6.0 * ("tilt_x" in names), 7.0 * ("tilt_y" in names)]
    correlation = {f"{names[0]},{names[1]}": 0.6} if kind == "ellipsoid" and names[0] != names[1] else {}
    given = {"set": kind, "tilt_deg": tilt, "correlation": correlation}
    return odd_loads.scenario(objects).with_changes(uncertainty=given)


@pytest.mark.parametrize("names", TWO, ids="*".join)
@pytest.mark.parametrize("slippery", ["lower", pytest.param("upper", marks=SLOW)])
def test_no_product_of_two_parameters_is_missed(names: tuple[str, str], slippery: str) -> None:
    """Large ranges: a box's worst case is attained wherever squares and product have the sign of the slopes."""
    made = with_only(names, "box", slippery)
    rows, w = odd_loads.TrueRows(made), odd_loads.felt(odd_loads.tray_motion(40, 3, push=1.5))
    bound, half = claimed(made, w), dict(zip(rows.uncertain.names, rows.uncertain.half_range, strict=True))
    grid = [dict(zip(half, s, strict=True)) for s in product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=len(half))]
    seen = [np.hstack(rows.at({n: s[n] * half[n] for n in half}, w)).max(axis=1) for s in grid]
    gap = bound - np.max(seen, axis=0)
    # A tilt is cut off after the second order: 7 degrees cubed over 6 of what presses sideways; both tilts thrice that.
    cut = {0: 1e-9, 1: 3e-4, 2: 9e-4}[sum("tilt" in name for name in set(names))]
    assert gap.min() > -cut
    assert np.sum(gap < cut) >= 3, np.sort(gap)[:4]
    assert np.all(bound <= sampled_sets.documented(rows, w) + 1e-9)


@pytest.mark.parametrize(
    "names",
    [pytest.param(pair, marks=[SLOW] * (k % 2)) for k, pair in enumerate(TWO) if pair[0] != pair[1]],
    ids="*".join,
)
def test_two_correlated_parameters(names: tuple[str, str]) -> None:
    made = with_only(names, "ellipsoid", "lower")
    rows, w = odd_loads.TrueRows(made), odd_loads.felt(odd_loads.tray_motion(20, 4, push=1.5))
    angles, factor = np.linspace(0, 2 * np.pi, 49)[:-1], sampled_sets.directions(rows.uncertain)
    points = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ factor.T
    changes = [dict(zip(rows.uncertain.names, point, strict=True)) for point in points]
    reached = np.max([np.hstack(rows.at(change, w, {})).max(axis=1) for change in changes], axis=0)
    bound = claimed(made, w)
    assert np.all(reached <= bound + 3e-4)
    assert np.all(bound <= sampled_sets.documented(rows, w) + 1e-9)


def test_a_tower_of_more_masses_than_are_taken_at_their_extremes() -> None:
    """Four uncertain masses: bounded as slopes and products; every corner of them stays below."""
    box = {"shape": {"type": "box", "size": [0.06, 0.08, 0.04]}, "friction": 0.5}
    inertia = [1e-4, 2e-5, 8e-5, 1e-5, -1e-5, 1.2e-4]
    names = ["a", "b", "c", "d"]
    objects = [
        box
        | {
            "name": name,
            "on": names[k - 1] if k else "tray",
            "mass": 0.3 - 0.05 * k,
            "inertia": inertia,
            "at": [0.004 * k, -0.003 * k],
            "yaw_deg": 10.0 * k,
            "uncertainty": {"mass": "25%", "com": [0.003, 0.0, 0.002]},
        }
        for k, name in enumerate(names)
    ]
    made = odd_loads.scenario(objects).with_changes(uncertainty__tilt_deg=None)
    rows, w = odd_loads.TrueRows(made), odd_loads.felt(odd_loads.tray_motion(6, 5))
    assert sum(name.endswith("mass") for name in made.payload.uncertain.names) == 4
    corners = sampled_sets.samples(made.payload.uncertain, 200, 6)
    reached = np.max([rows.worst(change, w, {}) for change in corners], axis=0)
    bound, nominal = claimed(made, w), rows.worst({}, w)
    assert np.all(reached <= bound + 1e-9)
    assert np.median((reached - nominal) / (bound - nominal)) > 0.4


def test_worst_case_with_a_drift_is_its_definition() -> None:
    """Two rows, mass at its extremes; looked for at every corner of what is free, with and without the drift.

    The centre of mass acts through the row and through the drift at once; a mass has the sign of its row; a product,
    one of masses too, and a parameter of something else are free of both.
    """
    rng = np.random.default_rng(8)
    mass, com, other = Parameter("box", "mass"), Parameter("box", "com", "x"), Parameter("beside", "mass")
    signs = np.array([[1.0], [-1.0]])
    drifts = ((com,), (mass,), (mass, com), (mass, mass), (com, com), (other,))
    for _ in range(20):
        nominal, parameter, remainder = rng.normal(size=(2, 12)), *rng.normal(size=(2, 1, 2, 12))
        rows = UncertainRows(nominal, (com,), parameter, remainder, None, (mass,), signs)
        w, dw, swing = rng.normal(size=(3, 12)), rng.normal(size=(3, 12, len(drifts))), 0.3 * rng.normal(size=(3, 12))
        expected = np.full((3, 2), -np.inf)
        for side, s, product_of_rows, *free in product((-1.0, 1.0), repeat=7):
            for strays in (0.0, 1.0):
                for row in range(2):
                    at = np.array([s, signs[row, 0], *free])
                    felt = w + side * swing
                    value = (felt + strays * dw @ at) @ nominal[row]
                    value += s * felt @ parameter[0, row] + product_of_rows * felt @ remainder[0, row]
                    expected[:, row] = np.maximum(expected[:, row], value)
        worst = WorstCase.of(rows, w, Drift(drifts, dw, swing))
        assert_allclose(worst.values, expected, atol=1e-12)


def random_rows(rng: np.random.Generator, kind: str) -> tuple[UncertainRows, tuple[tuple[Parameter, ...], ...]]:
    """Two rows with a parameter, a mass and, if wanted, contents that move with another; and terms of a drift."""
    acting, mass = (Parameter("box", "com", "x"), Parameter("box", "com", "y")), Parameter("box", "mass")
    inside = Parameter("can", "com", "x")
    corners = np.array(list(product((-0.1, 0.3), (-0.2, 0.1), (-0.3, 0.2))))
    filling = Filling(
        Hull.of(corners),
        np.array([0.02, 0.03, 0.04]),
        rng.normal(size=(9, 2, 12)),
        0.01 * rng.normal(size=(2, 9)),
        (inside,),
        3 * rng.normal(size=(1, 2, 9)),
        3 * rng.normal(size=1),
    )
    rows = UncertainRows(
        rng.normal(size=(2, 12)),
        acting,
        rng.normal(size=(2, 2, 12)),
        rng.normal(size=(1, 2, 12)),
        rng.normal(size=(2, 2)) if kind == "ellipsoid" else None,
        (mass,),
        np.array([[1.0], [-1.0]]),
        fillings=(filling,) if kind == "filled" else (),
    )
    drifts = ((acting[0],), (mass,), (mass, acting[1]), (Parameter("beside", "mass"),))
    return rows, (*drifts, (inside,)) if kind == "filled" else drifts


@pytest.mark.parametrize("kind", ["box", "ellipsoid", "filled"])
def test_slopes_support_worst_cases_and_the_side_of_a_swing_is_the_worse_one(kind: str) -> None:
    """A worst case is convex in what is felt: wherever one looks it lies above every tangent."""
    rng, near = np.random.default_rng(9), 2e-2 if kind == "filled" else 1e-5  # contents: the gap of their coefficients
    for _ in range(2 if kind == "filled" else 6):
        rows, terms = random_rows(rng, kind)
        w, swing = rng.normal(size=(3, 12)), 0.3 * rng.normal(size=(3, 12))
        dw = 0.3 * rng.normal(size=(3, 12, len(terms)))
        for drift in (None, Drift(terms, dw), Drift(terms, dw, swing)):
            here = WorstCase.of(rows, w, drift)
            node, row = (x.ravel() for x in np.indices(here.values.shape))
            slope, side = here.attained_swinging(node, row)
            sure = here.values[node, row] > SURE  # others are bounds
            for size in (0.01, 0.3, 3.0):
                away = size * rng.normal(size=(3, 12))
                there = WorstCase.of(rows, w + away, drift).values[node, row]
                least = here.values[node, row] + np.einsum("rk,rk->r", slope, away[node])
                assert np.all(there[sure] >= least[sure] - near)
            if drift is None:  # then it is as many times as large as what is felt
                through = np.einsum("rk,rk->r", slope, w[node])
                assert_allclose(through[sure], here.values[node, row][sure], atol=near)
            if drift is None or drift.swing is None:
                assert not side.any()
                continue
            assert set(np.abs(side)) == {1.0}
            plain = Drift(terms, dw)
            sides = [WorstCase.of(rows, w + s * swing, plain).values[node, row] for s in (-1.0, 1.0)]
            assert_allclose(np.maximum(*sides)[sure], here.values[node, row][sure], atol=near)
            assert_allclose(np.where(side > 0, sides[1], sides[0])[sure], here.values[node, row][sure], atol=near)


def test_rows_that_nothing_uncertain_changes_are_worst_on_the_side_to_which_the_swing_pushes() -> None:
    rng, none = np.random.default_rng(2), np.zeros((0, 2, 12))
    rows = UncertainRows(rng.normal(size=(2, 12)), (), none, none, None, (), np.zeros((2, 0)))
    w, swing = rng.normal(size=(5, 12)), rng.normal(size=(5, 12))
    here = WorstCase.of(rows, w, Drift((), np.zeros((5, 12, 0)), swing))
    pushed = swing @ rows.nominal.T
    assert here.values == pytest.approx(w @ rows.nominal.T + np.abs(pushed))
    node, row = (x.ravel() for x in np.indices(here.values.shape))
    slope, side = here.attained_swinging(node, row)
    assert np.array_equal(slope, rows.nominal[row])
    assert np.array_equal(side, np.sign(pushed).ravel())
    assert len(set(side)) == 2


@pytest.mark.parametrize("kind", ["box", "ellipsoid"])
def test_what_terms_add_is_their_sum_or_their_length_whatever_they_are_stacked_in(kind: str) -> None:
    """Of a box the sum of sizes, of an ellipsoid the length of A^T c and the sizes of products."""
    rng = np.random.default_rng(3)
    rows, _ = random_rows(rng, kind)
    terms = rng.normal(size=(4, 3, 3))
    own = terms[..., :2] if rows.spread is None else terms[..., :2] @ rows.spread
    most = np.abs(own).sum(axis=-1) if rows.spread is None else np.sqrt((own**2).sum(axis=-1))
    assert_allclose(rows.radius(terms), most + np.abs(terms[..., 2]), atol=1e-12)
    step = 1e-6
    for k in range(3):
        more, less = (rows.radius(terms + s * step * np.eye(3)[k]) for s in (1, -1))
        assert_allclose(rows.dual(terms)[..., k], (more - less) / (2 * step), atol=1e-6)


def test_what_need_not_be_worked_out_is_never_told_better_than_it_is() -> None:
    rng, far = np.random.default_rng(5), 0
    for within in np.linspace(1.0, 30.0, 40):
        rows, terms = random_rows(rng, "box")
        rows = rows.mapped(lambda array: 0.1 * array)
        w, swing = 0.3 * rng.normal(size=(5, 12)), rng.normal(size=(5, 12))
        drift = Drift(terms, 0.1 * rng.normal(size=(5, 12, len(terms))), swing)
        w = w - within * rows.nominal[0]  # one row is more or less within its edge
        coarse, exact = (WorstCase.of(rows, w, drift, coarsely).values for coarsely in (True, False))
        assert np.all(coarse >= exact - 1e-12)
        assert_allclose(coarse[exact > SURE], exact[exact > SURE], atol=1e-12)
        far += int((coarse <= SURE).sum())
    assert far > 0


def test_contacts_that_cannot_be_worked_with_are_refused() -> None:
    """More points times edges than facets can be made of; a place that may be beside the support."""
    can = {"name": "can", "shape": {"type": "cylinder", "radius": 0.04, "height": 0.1, "support_points": 64}}
    can |= {"mass": 0.3, "friction": 0.4}
    with pytest.raises(ScenarioError, match=r"64 contact points .* 5 .* 256"):
        contact_rows(odd_loads.scenario([can], contact__edges=5).payload)
    with pytest.raises(ScenarioError, match=r"edges = 5 with the 64 contact points .* 256"):
        contact_rows(odd_loads.scenario([can], contact__edges=4).payload.with_edges(5))
    beside = odd_loads.stack(objects__1__uncertainty__position=[0.08, 0.0])
    with pytest.raises(ScenarioError, match="upper on lower"):
        contact_rows(beside.payload)
    assert contact_rows(beside.payload.nominal)
