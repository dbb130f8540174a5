"""The worst of an uncertain set, by looking: at points of it, and by differences of what a load really needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from odd_loads import TrueRows
from salver.geometry import Array
from salver.models.arm.arm import ArmModel, tray_to_object
from salver.models.uncertain.parameters import UncertainSet
from salver.scenario import Scenario


def directions(uncertain: UncertainSet) -> Array:
    """(n_p, n_p) A with the set nominal + A s, s in the unit box or ball; written out from its definition.

    An ellipsoid is {x : x^T W^-1 x <= 1} with W = D C D, D the half-ranges and C the correlation.
    """
    if uncertain.kind == "box":
        return np.diag(uncertain.half_range)
    correlation = np.eye(uncertain.size) if uncertain.correlation is None else uncertain.correlation
    w = np.outer(uncertain.half_range, uncertain.half_range) * correlation
    scale = np.diag(uncertain.half_range)
    values, vectors = np.linalg.eigh(np.linalg.solve(scale, np.linalg.solve(scale, w).T))
    return scale @ vectors * np.sqrt(values)  # not Cholesky's: any square root will do


def projection(uncertain: UncertainSet, index: list[int]) -> UncertainSet:
    """The same set seen in some of its parameters: an ellipsoid's shadow has the same covariances."""
    correlation = None if uncertain.correlation is None else uncertain.correlation[index][:, index]
    return replace(
        uncertain,
        parameters=tuple(uncertain.parameters[i] for i in index),
        nominal=uncertain.nominal[index],
        half_range=uncertain.half_range[index],
        correlation=correlation,
    )


def steepest(slope: Array, uncertain: UncertainSet) -> Array:
    """(..., n_p) points of the set, as deviations, that raise quantities with slopes (..., n_p) most."""
    if uncertain.kind == "box":
        return np.where(slope >= 0, 1.0, -1.0) * uncertain.half_range
    factor = directions(uncertain)
    along = slope @ factor
    size = np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-300)
    return along / size @ factor.T


def samples(uncertain: UncertainSet, count: int, seed: int = 0) -> list[dict[str, float]]:
    """Deviations on the boundary of the set: corners of a box, random directions of an ellipsoid."""
    rng = np.random.default_rng(seed)
    if uncertain.kind == "box":
        s = rng.choice([-1.0, 1.0], size=(count, uncertain.size))
    else:
        s = rng.normal(size=(count, uncertain.size))
        s /= np.linalg.norm(s, axis=1, keepdims=True)
    return [dict(zip(uncertain.names, x, strict=True)) for x in s @ directions(uncertain).T]


Felt = Callable[[dict[str, float]], Array]
"""What a tray feels, (T, 12), when the parameters deviate."""


def base_masses(made: Scenario) -> list[dict[str, float]]:
    """Deviations around which the worst case is taken: a box's masses at their extremes."""
    uncertain = made.payload.uncertain
    if uncertain.kind == "ellipsoid":
        return [{}]
    half = dict(zip(uncertain.names, uncertain.half_range, strict=True))
    masses = [p.name for p in uncertain.parameters if p.kind == "mass"]
    return [
        {m: s * half[m] for m, s in zip(masses, signs, strict=True)} for signs in product((-1, 1), repeat=len(masses))
    ]


class Expansion:
    """Values (T, n_f), slopes (n_p, T, n_f), squares and mixed terms of the true rows, by differences over half-ranges.

    Around a base, for the parameters that are not in it; all rows of all objects side by side.
    """

    def __init__(self, rows: TrueRows, w: Array | Felt, base: dict[str, float], products: bool = True) -> None:
        uncertain = rows.uncertain
        half = dict(zip(uncertain.names, uncertain.half_range, strict=True))
        acting = [
            i for i, p in enumerate(uncertain.parameters) if p.kind != "friction" and uncertain.names[i] not in base
        ]
        self.base, self.kept = base, projection(uncertain, acting)
        names = self.kept.names

        def at(*moved: tuple[str, int]) -> Array:
            change = base | {name: sign * half[name] for name, sign in moved}
            return np.hstack(rows.at(change, _under(w, change), base))

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
        unit = directions(self.kept) / self.kept.half_range[:, None]
        return np.linalg.norm(np.einsum("ptf,pq->qtf", self.slope, unit), axis=0)

    def bound(self) -> Array:
        """(T,) what `contact_rows` promises: linear terms over the set, squares and products one by one."""
        squares = np.maximum(self.square, 0.0).sum(axis=0)
        products = sum((np.abs(m) for m in self.mixed), np.zeros_like(self.centre))
        return (self.centre + self.linear() + squares + products).max(axis=1)


def documented(rows: TrueRows, w: Array | Felt) -> Array:
    return np.max([Expansion(rows, w, base).bound() for base in base_masses(rows.made)], axis=0)


def sampled(rows: TrueRows, w: Array | Felt, count: int = 60) -> Array:
    """(T,) the worst true row over samples of the set: random ones, and at each instant where slopes point."""
    uncertain = rows.uncertain
    weight = {} if uncertain.kind == "ellipsoid" else None
    seen = [rows.worst(change, _under(w, change), weight) for change in samples(uncertain, count)]
    for base in base_masses(rows.made):
        found = Expansion(rows, w, base, products=False)
        expected = found.centre + found.linear()
        for t in range(len(expected)):
            for f in np.argsort(expected[t])[-2:]:
                point = steepest(found.slope[:, t, f] / found.kept.half_range, found.kept)
                change = base | dict(zip(found.kept.names, point, strict=True))
                value = np.full(len(expected), -np.inf)
                value[t] = rows.worst(change, _under(w, change)[t : t + 1], base)[0]
                seen.append(value)
    return np.max(seen, axis=0)


def _under(w: Array | Felt, change: dict[str, float]) -> Array:
    return w(change) if callable(w) else w


def object_jacobian(arm: ArmModel, q: Array, p_EB: Array, R_EB: Array) -> Array:
    """J_b (6, n): dq to the twist of B in B, for B fixed to the tray at (p_EB, R_EB)."""
    return tray_to_object(p_EB, R_EB) @ arm.body_jacobian(q)
