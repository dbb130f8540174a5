"""Worst cases of nasty loads: never below a sample of the nonlinear model, attained, and no more than is documented."""

from __future__ import annotations

from itertools import combinations, product

import numpy as np
import pytest
from numpy.testing import assert_allclose

import nasty
from salver.geometry import Array
from salver.models.bodies import uncertain_set
from salver.models.contact_rows import contact_rows
from salver.scenario import Scenario

LOADS = {"single": nasty.single, "stack": nasty.stack, "pair": nasty.pair}
CASES = [(load, kind) for load in LOADS for kind in ("box", "ellipsoid")]


def base_masses(made: Scenario) -> list[dict[str, float]]:
    """Deviations around which the worst case is taken: a box's masses at their extremes."""
    uncertain = uncertain_set(made)
    if uncertain.kind == "ellipsoid":
        return [{}]
    half = dict(zip(uncertain.names, uncertain.half_range, strict=True))
    masses = [name for name in uncertain.names if name.endswith("mass")]
    return [
        {m: s * half[m] for m, s in zip(masses, signs, strict=True)} for signs in product((-1, 1), repeat=len(masses))
    ]


class Expansion:
    """Values (T, n_f), slopes (n_p, T, n_f), squares and mixed terms of the true rows, by differences over half-ranges.

    Around a base, for the parameters that are not in it; all rows of all objects side by side.
    """

    def __init__(self, rows: nasty.TrueRows, w: Array, base: dict[str, float], products: bool = True) -> None:
        uncertain = rows.uncertain
        half = dict(zip(uncertain.names, uncertain.half_range, strict=True))
        names = tuple(n for n in uncertain.names if not n.endswith("friction") and n not in base)
        self.base, self.kept = base, uncertain.restricted(names)

        def at(*moved: tuple[str, int]) -> Array:
            return np.hstack(rows.at(base | {name: sign * half[name] for name, sign in moved}, w, base))

        self.centre = at()
        up, down = (
            np.array([at((n, sign)) for n in names]).reshape(len(names), *self.centre.shape) for sign in (1, -1)
        )
        self.slope, self.square = 0.5 * (up - down), 0.5 * (up + down) - self.centre
        pairs = combinations(range(len(names)), 2) if products else ()
        self.mixed = [at((names[i], 1), (names[j], 1)) - up[i] - up[j] + self.centre for i, j in pairs]

    def linear(self) -> Array:
        """(T, n_f) most that the slopes can add over the set."""
        if self.kept.kind == "box":
            return np.abs(self.slope).sum(axis=0)
        unit = nasty.directions(self.kept) / self.kept.half_range[:, None]
        return np.linalg.norm(np.einsum("ptf,pq->qtf", self.slope, unit), axis=0)

    def bound(self) -> Array:
        """(T,) what `contact_rows` promises: linear terms over the set, squares and products one by one."""
        squares = np.maximum(self.square, 0.0).sum(axis=0)
        products = sum((np.abs(m) for m in self.mixed), np.zeros_like(self.centre))
        return (self.centre + self.linear() + squares + products).max(axis=1)


def documented(rows: nasty.TrueRows, w: Array) -> Array:
    return np.max([Expansion(rows, w, base).bound() for base in base_masses(rows.made)], axis=0)


def sampled(rows: nasty.TrueRows, w: Array, count: int = 60) -> Array:
    """(T,) the worst true row over samples of the set: random ones, and at each instant where slopes point."""
    uncertain = rows.uncertain
    weight = {} if uncertain.kind == "ellipsoid" else None
    seen = [np.hstack(rows.at(change, w, weight)).max(axis=1) for change in nasty.samples(uncertain, count)]
    for base in base_masses(rows.made):
        found = Expansion(rows, w, base, products=False)
        expected = found.centre + found.linear()
        for t in range(len(w)):
            for f in np.argsort(expected[t])[-2:]:
                point = nasty.steepest(found.slope[:, t, f] / found.kept.half_range, found.kept)
                change = base | dict(zip(found.kept.names, point, strict=True))
                value = np.full(len(w), -np.inf)
                value[t] = np.hstack(rows.at(change, w[t : t + 1], base)).max()
                seen.append(value)
    return np.max(seen, axis=0)


def claimed(made: Scenario, w: Array) -> Array:
    """(T,) the worst case that the contact rows claim, of everything carried."""
    return np.max([rows.worst(w).max(axis=1) for rows in contact_rows(made)], axis=0)


@pytest.mark.parametrize(
    ("load", "kind", "turning"),
    [*((*case, 1.0) for case in CASES), ("single", "box", 0.0), ("single", "ellipsoid", 0.0)],
)
def test_worst_case_lies_between_samples_and_what_is_documented(load: str, kind: str, turning: float) -> None:
    made = LOADS[load](kind)
    rows, w = nasty.TrueRows(made), nasty.felt(nasty.tray_motion(6, 1, turning))
    bound, most, reached = claimed(made, w), documented(rows, w), sampled(rows, w)
    # The tilt is cut off after its second order: tilt^3 / 6 of the weight, 3e-6.
    assert np.all(reached <= bound + 1e-5)
    assert np.all(bound <= most + 1e-9)
    nominal = np.hstack(rows.at({}, w)).max(axis=1)
    assert np.all(nominal < bound)
    # Products are counted one by one, as if each could be at its worst: at most a third of the tube in an ellipsoid.
    assert np.median((reached - nominal) / (bound - nominal)) > 0.66


@pytest.mark.parametrize(("load", "kind"), CASES)
def test_worst_case_of_a_small_set_is_attained(load: str, kind: str) -> None:
    """Where products do not matter, the tube is as wide as the farthest sample: no term is missing, none too many."""
    made = nasty.small(LOADS[load](kind), 1e-3)
    made = made.with_changes(**{f"objects__{k}__uncertainty__position": [3e-6, 2e-6] for k in range(len(made.objects))})
    rows, w = nasty.TrueRows(made), nasty.felt(nasty.tray_motion(10, 2))
    nominal = np.hstack(rows.at({}, w)).max(axis=1)
    share = (sampled(rows, w, 2) - nominal) / (claimed(made, w) - nominal)
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
    for item in (nasty.LOWER, {**nasty.UPPER, "mass": 0.6}):
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
    return nasty.scenario(objects).with_changes(uncertainty=given)


@pytest.mark.parametrize("names", TWO, ids="*".join)
@pytest.mark.parametrize("slippery", ["lower", "upper"])
def test_no_product_of_two_parameters_is_missed(names: tuple[str, str], slippery: str) -> None:
    """Large ranges: a box's worst case is attained wherever squares and product have the sign of the slopes."""
    made = with_only(names, "box", slippery)
    rows, w = nasty.TrueRows(made), nasty.felt(nasty.tray_motion(40, 3, push=1.5))
    bound, half = claimed(made, w), dict(zip(rows.uncertain.names, rows.uncertain.half_range, strict=True))
    grid = [dict(zip(half, s, strict=True)) for s in product((-1.0, -0.5, 0.0, 0.5, 1.0), repeat=len(half))]
    seen = [np.hstack(rows.at({n: s[n] * half[n] for n in half}, w)).max(axis=1) for s in grid]
    gap = bound - np.max(seen, axis=0)
    # A tilt is cut off after the second order: 7 degrees cubed over 6 of what presses sideways; both tilts thrice that.
    cut = {0: 1e-9, 1: 3e-4, 2: 9e-4}[sum("tilt" in name for name in set(names))]
    assert gap.min() > -cut
    assert np.sum(gap < cut) >= 3, np.sort(gap)[:4]
    assert np.all(bound <= documented(rows, w) + 1e-9)


@pytest.mark.parametrize("names", [pair for pair in TWO if pair[0] != pair[1]], ids="*".join)
def test_two_correlated_parameters(names: tuple[str, str]) -> None:
    made = with_only(names, "ellipsoid", "lower")
    rows, w = nasty.TrueRows(made), nasty.felt(nasty.tray_motion(20, 4, push=1.5))
    angles, factor = np.linspace(0, 2 * np.pi, 49)[:-1], nasty.directions(rows.uncertain)
    points = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ factor.T
    changes = [dict(zip(rows.uncertain.names, point, strict=True)) for point in points]
    reached = np.max([np.hstack(rows.at(change, w, {})).max(axis=1) for change in changes], axis=0)
    bound = claimed(made, w)
    assert np.all(reached <= bound + 3e-4)
    assert np.all(bound <= documented(rows, w) + 1e-9)
