"""The worst case of constraints over the uncertain set, for all modules.

A row is c(p) . w <= 0 with w the tray's motion regressor (`salver.models.tray_motion`) and c a polynomial of the
uncertain parameters p. Written in half-ranges s of the parameters, its worst case is

    c_0 . w + h((c_k . w)_k) + sum_l |d_l . w|,        h(x) = sum_k |x_k|   (box),   |A^T x|   (ellipsoid)

with c_k the linear terms, d_l all products of two parameters, and A A^T the correlation. h is the support function of
the set; products are bounded one by one, so that the worst case is never optimistic. The masses of a box are not among
the s: scaling all wrenches does not change the contact condition, and bounding mass and centre of mass separately would
count both, so that there is a set of rows for each combination of extreme masses.

A parameter error also makes the arm deviate from its reference, so that the regressor becomes w + dw_k s_k (`Drift`).
Because the parameter acts through both, c_0 . dw_k is added to c_k . w before h is taken; terms of the drift without a
linear term here are bounded separately. The worst case is the larger of two: with the drift, and without it (a
controller that is better than assumed). The zero-order hold of commands changes w by `Drift.swing` in either direction,
independently of the parameters; both signs are tried.

Vibration of the tray by any dw of a ball (`Vibration`) adds the support of that ball, a |c_f| + b |c_alpha| with the
parts of c for specific force and angular acceleration: a constant of each row, for every motion and speed.

A body with unknown contents adds the largest mean of a quadratic over all its mass distributions
(`models.uncertain.contents`); its drift is linear in the same moments, and is included in that mean.

All of it is convex in w, with the derivative `WorstCase.attained`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Self

import numpy as np

from salver.geometry import Array, Indices
from salver.models.uncertain.contents import Filling
from salver.models.uncertain.parameters import Parameter, Vibration, support
from salver.models.uncertain.worst_contents import SURE, ContentsCase, Unsolved, bounded

ALL = slice(None)


@dataclass(frozen=True)
class Drift:
    """Tracking perturbation: change of the tray's motion regressor because parameter errors make the arm deviate.

    terms: the factors of each of n_k terms, one parameter or a product of two. dw: (T, 12, n_k) change for one
    half-range of each. swing: (T, 12) change with either sign, independent of the parameters; None for zero.
    """

    terms: tuple[tuple[Parameter, ...], ...]
    dw: Array
    swing: Array | None = None


@dataclass(frozen=True)
class UncertainRows:
    """n constraints that are linear in the motion regressor w (12,) for all parameters.

    nominal: (n, 12) c_0. acting: n_p parameters. parameter: (n_p, n, 12) c_k per half-range of `acting`. remainder:
    (n_r, n, 12) d_l. spread: (n_p, n_p) A of an ellipsoid, None for a box. masses: n_m masses that are taken at their
    extremes. mass_signs: (n, n_m) the extreme of each mass in each row, -1 or 1. fillings: contributions of bodies with
    unknown contents. shake: vibration of the tray.
    """

    nominal: Array
    acting: tuple[Parameter, ...]
    parameter: Array
    remainder: Array
    spread: Array | None
    masses: tuple[Parameter, ...]
    mass_signs: Array
    fillings: tuple[Filling, ...] = field(default=(), kw_only=True)
    shake: Vibration | None = field(default=None, kw_only=True)

    @property
    def certain(self) -> bool:
        """Whether they do not depend on the uncertain parameters."""
        return not (len(self.parameter) or len(self.remainder) or self.fillings)

    @cached_property
    def each(self) -> Array:
        """c_k, then d_l, for each row (n, n_p + n_r, 12)."""
        return np.ascontiguousarray(np.swapaxes(np.concatenate([self.parameter, self.remainder]), 0, 1))

    @cached_property
    def by_entry(self) -> Array:
        """c_k, then d_l, for each entry of w (12, n_p + n_r, n)."""
        return np.ascontiguousarray(np.moveaxis(np.concatenate([self.parameter, self.remainder]), 2, 0))

    @cached_property
    def shaken(self) -> Array:
        """Largest contribution (n,) of the tray's vibration for all parameters, bounded term by term of c(p)."""
        if self.shake is None:
            return np.zeros(len(self.nominal))
        found = self.shake.support(np.concatenate([self.nominal[None], self.parameter, self.remainder])).sum(axis=0)
        for filling in self.fillings:
            found += (filling.farthest[:, None] * self.shake.support(filling.rows)).sum(axis=0)
        return np.asarray(found)

    def terms(self, w: Array) -> Array:
        """c_k . w, then d_l . w, (T, n, n_p + n_r) at w (T, 12)."""
        return np.moveaxis(np.tensordot(w, np.concatenate([self.parameter, self.remainder]), axes=(1, 2)), 1, 2)

    def radius(self, terms: Array) -> Array:
        """Largest sum (...) of `terms` (..., n_p + n_r) over the uncertain set."""
        n_p = len(self.acting)
        return support(terms[..., :n_p], self.spread) + support(terms[..., n_p:], None)

    def dual(self, terms: Array) -> Array:
        """Derivative (..., n_p + n_r) of `radius` by the terms: the factor of each in the worst case."""
        out = np.sign(terms)
        if self.spread is not None:
            factored = terms[..., : len(self.acting)] @ self.spread
            size = np.maximum(np.linalg.norm(factored, axis=-1, keepdims=True), 1e-300)
            out[..., : len(self.acting)] = factored / size @ self.spread.T
        return out

    def worst(self, w: Array, drift: Drift | None = None) -> Array:
        """Worst case (T, n) of every row at w (T, 12)."""
        return WorstCase.of(self, w, drift).values

    def worst_point(self, w: Array, row: int) -> dict[Parameter, float]:
        """The worst point for a row at w (12,), in half-ranges of each parameter, in the unit box or ball.

        To first order around the centre, without products of parameters.
        """
        slope = self.parameter[:, row] @ w
        dual = np.where(slope >= 0, 1.0, -1.0) if self.spread is None else self.dual(slope)
        point = dict(zip(self.acting, dual.tolist(), strict=True))
        for filling in (f.only([row]) for f in self.fillings):
            moments = filling.largest(filling.coefficients(w[None])[0])[1]
            point |= dict(zip(filling.moved, (filling.per[:, 0] @ moments[0] - filling.less).tolist(), strict=True))
        return point | dict(zip(self.masses, self.mass_signs[row].tolist(), strict=True))

    def mapped(self, change: Callable[[Array], Array]) -> Self:
        """A copy with every array (..., n, 12) replaced by change(array)."""
        return replace(
            self,
            nominal=change(self.nominal),
            parameter=change(self.parameter),
            remainder=change(self.remainder),
            fillings=tuple(filling.mapped(change) for filling in self.fillings),
        )

    def only(self, rows: Indices) -> Self:
        """Some of the rows."""
        chosen = self.mapped(lambda array: array[..., rows, :])
        made = replace(
            chosen,
            mass_signs=self.mass_signs[rows],
            fillings=tuple(
                replace(f.only(rows), rows=c.rows) for f, c in zip(self.fillings, chosen.fillings, strict=True)
            ),
        )
        return made


@dataclass(frozen=True)
class WorstCase:
    """Worst-case values (T, n) of constraints along w (T, 12), with their derivatives."""

    rows: UncertainRows
    w: Array
    drift: Drift | None
    values: Array

    @classmethod
    def of(
        cls, rows: UncertainRows, w: Array, drift: Drift | None = None, coarsely: bool = False, margin: float = 0.0
    ) -> WorstCase:
        """The worst case of rows at w (T, 12). coarsely: values may be upper bounds for rows with a margin of more than
        `-SURE` and twice the required `margin`."""
        if not coarsely or rows.fillings or rows.spread is not None:
            return cls(rows, w, drift, _values(rows, w, drift))
        return cls(rows, w, drift, _values_near(rows, w, drift, min(SURE, -2.0 * margin)))

    def attained(self, node: Indices, row: Indices) -> Array:
        """Derivative (r, 12) of the worst case by w at nodes and rows (r,), with the drift constant."""
        return self.attained_swinging(node, row)[0]

    def attained_swinging(self, node: Indices, row: Indices) -> tuple[Array, Array]:
        """`attained`, and the sign (r,) of the drift's swing in the worst case: -1 or 1, 0 without a swing."""
        rows, nominal = self.rows, self.rows.nominal[row]
        if rows.certain and (self.drift is None or not self.drift.terms):
            if self.drift is None or self.drift.swing is None:
                return nominal, np.zeros(len(row))
            return nominal, np.where(np.einsum("rk,rk->r", nominal, self.drift.swing[node]) > 0.0, 1.0, -1.0)
        each = rows.each[row]
        fillings = tuple(filling.only(row) for filling in rows.fillings)
        if self.drift is not None and self.drift.terms:
            change = (nominal[:, None] @ self.drift.dw[node])[:, 0]
            roles = _roles(rows, self.drift)
            known = sum((rows.mass_signs[row, j] * change[:, k] for k, j in roles.mass), np.zeros(len(row)))
            known += np.abs(change[:, roles.other]).sum(axis=1)
        values, at_work, moments, swings = [], [], [], []
        for swung, side in _sides(self.w, self.drift):
            w = side[node]
            terms = (each @ w[:, :, None])[:, :, 0]
            own = [np.einsum("rk,prk->rp", w, f.rows) for f in fillings]
            cases = [(terms, np.zeros(len(row)), own)]
            if self.drift is not None and self.drift.terms:
                strayed = terms.copy()
                strayed[:, roles.column] += change[:, roles.own]
                coefficients, less = _strayed(fillings, roles, change.T, own)
                cases.append((strayed, known - less, coefficients))
            for terms, more, coefficients in cases:
                value, filled = np.einsum("rk,rk->r", w, nominal) + rows.radius(terms) + more, []
                for filling, of in zip(fillings, coefficients, strict=True):
                    largest, found = filling.largest(of)
                    value += largest - np.einsum("rk,prk,rp->r", w, filling.rows, filling.nominal)
                    filled.append(found - filling.nominal)
                values.append(value)
                at_work.append(terms)
                moments.append(filled)
                swings.append(swung)
        best, those = np.argmax(values, axis=0), np.arange(len(row))
        dual = rows.dual(np.stack(at_work)[best, those])
        tangent = nominal + (dual[:, None] @ each)[:, 0]
        for k, filling in enumerate(fillings):
            chosen = np.stack([filled[k] for filled in moments])[best, those]
            tangent += np.einsum("rp,prk->rk", chosen, filling.rows)
        return tangent, np.array(swings)[best]


def _sides(w: Array, drift: Drift | None) -> tuple[tuple[float, Array], ...]:
    """Signs of the drift's swing, each with w plus that swing."""
    if drift is None or drift.swing is None:
        return ((0.0, w),)
    return (-1.0, w - drift.swing), (1.0, w + drift.swing)


@dataclass(frozen=True)
class _Roles:
    """How the terms of a drift, by their index, enter rows.

    own: terms that are parameters in `acting`, with column: their indices there. mass: (term, index in `masses`).
    filled: (term, filling, parameter of the filling). other: terms that are not in the rows.
    """

    own: list[int]
    column: list[int]
    mass: list[tuple[int, int]]
    filled: list[tuple[int, int, int]]
    other: list[int]


def _roles(rows: UncertainRows, drift: Drift) -> _Roles:
    return _roles_of(rows.acting, rows.masses, tuple(filling.moved for filling in rows.fillings), drift.terms)


@lru_cache(maxsize=256)
def _roles_of(
    acting: tuple[Parameter, ...],
    masses: tuple[Parameter, ...],
    fillings: tuple[tuple[Parameter, ...], ...],
    terms: tuple[tuple[Parameter, ...], ...],
) -> _Roles:
    roles = _Roles([], [], [], [], [])
    moved = {p: (f, q) for f, filling in enumerate(fillings) for q, p in enumerate(filling)}
    for k, factors in enumerate(terms):
        if len(factors) == 1 and factors[0] in acting:
            roles.own.append(k)
            roles.column.append(acting.index(factors[0]))
        elif len(factors) == 1 and factors[0] in masses:
            roles.mass.append((k, masses.index(factors[0])))
        elif len(factors) == 1 and factors[0] in moved:
            roles.filled.append((k, *moved[factors[0]]))
        else:  # a product, or a parameter of something else on the tray
            roles.other.append(k)
    return roles


def _strayed(
    fillings: tuple[Filling, ...], roles: _Roles, change: Array, coefficients: list[Array]
) -> tuple[list[Array], Array]:
    """Coefficients (..., n, 9) of each filling, with the drift's change (..., n_k, n), and a constant to subtract."""
    change = np.swapaxes(change, -1, -2)
    strayed, less = list(coefficients), np.zeros(change.shape[:-1])
    for k, f, q in roles.filled:
        strayed[f] = strayed[f] + change[..., k, None] * fillings[f].per[q]
        less += change[..., k] * fillings[f].less[q]
    return strayed, less


def _values(rows: UncertainRows, w: Array, drift: Drift | None, at_once: int = 160_000) -> Array:
    """Worst case (T, n) of all rows, computed in pieces of time; the searches for the worst fillings run for all pieces
    together. at_once: terms of a piece, which fit into the cache and are too few for several threads."""
    if rows.certain and (drift is None or not drift.terms):
        either = [side @ rows.nominal.T + rows.shaken for _, side in _sides(w, drift)]
        return np.maximum(*either) if len(either) > 1 else either[0]
    n_k, n = 0 if drift is None else len(drift.terms), len(rows.nominal)
    per_row = len(rows.parameter) + len(rows.remainder) + n_k + 30 * len(rows.fillings)
    values = np.empty((len(w), n))
    every = max(1, at_once // max(1, n * per_row))
    cases, unsolved = _cases(rows, w, drift), []
    for start in range(0, len(w), every):
        part = slice(start, start + every)
        found = list(cases(part))
        if rows.fillings:
            values[part], few = bounded(rows.fillings, found, start)
            unsolved += few
        else:
            values[part] = found[0].value
            for case in found[1:]:
                np.maximum(values[part], case.value, out=values[part])
    if unsolved:  # all together, because a search for a single row is inefficient
        every_one = Unsolved.joined(unsolved)
        np.maximum.at(values, tuple(every_one.at), every_one.worst(rows.fillings))
    return values


def _values_near(rows: UncertainRows, w: Array, drift: Drift | None, near: float) -> Array:
    """Worst case (T, n) of rows without fillings over a box; a cheap upper bound where that is at most `near`."""
    still = Drift((), np.zeros((*w.shape, 0))) if drift is None else drift
    moved, swing = np.abs(still.dw).sum(axis=2), np.abs(np.zeros_like(w) if still.swing is None else still.swing)
    each = np.abs(np.concatenate([rows.parameter, rows.remainder])).sum(axis=0)
    by = np.hstack([rows.nominal, each, np.abs(rows.nominal)])
    values = np.hstack([w, np.abs(w) + swing, swing + moved]) @ by.T + rows.shaken
    instants, some = (np.flatnonzero((values > near).any(axis=axis)) for axis in (1, 0))
    if len(instants):
        felt = Drift(still.terms, still.dw[instants], None if still.swing is None else still.swing[instants])
        values[np.ix_(instants, some)] = _values(rows.only(some), w[instants], felt)
    return values


def _cases(rows: UncertainRows, w: Array, drift: Drift | None) -> Callable[[slice], Iterator[ContentsCase]]:
    """Cases whose maximum is the worst case, in a slice of time: both signs of the swing, with and without drift."""
    n_p, n_k = len(rows.acting), 0 if drift is None else len(drift.terms)
    felt = ALL if drift is not None else np.any(w != 0, axis=0)  # without rotation only three of the twelve are nonzero
    nominal, flat = rows.nominal.T[felt], rows.by_entry[felt]
    _, n_c, n = flat.shape
    flat = flat.reshape(len(flat), n_c * n)
    sides = [np.ascontiguousarray(side[:, felt]) for _, side in _sides(w, drift)]
    drift = drift if n_k else None  # a drift with a swing alone has two cases
    fillings = tuple(filling.mapped(lambda array: array[..., felt]) for filling in rows.fillings)
    if drift is not None:
        roles = _roles(rows, drift)
        # Terms that are not in the rows come last, so that their absolute values are summed without a copy.
        order = [*roles.own, *(k for k, _ in roles.mass), *(k for k, _, _ in roles.filled), *roles.other]
        moved, place = np.swapaxes(drift.dw, 1, 2)[:, order], {k: i for i, k in enumerate(order)}
        there = replace(roles, filled=[(place[k], f, q) for k, f, q in roles.filled])

    def cases(part: slice) -> Iterator[ContentsCase]:
        count = len(w[part])
        if drift is not None:
            change = (moved[part].reshape(-1, moved.shape[2]) @ nominal).reshape(count, n_k, n)
            other = change[:, n_k - len(roles.other) :]
            extra = np.abs(other, out=other).sum(axis=1)
            for k, j in roles.mass:
                extra += rows.mass_signs[:, j] * change[:, place[k]]
        for side in sides:
            terms = (side[part] @ flat).reshape(count, n_c, n)
            own = [filling.coefficients(side[part]) for filling in fillings]
            level = side[part] @ nominal + np.abs(terms[:, n_p:]).sum(axis=1) + rows.shaken
            for filling, of in zip(fillings, own, strict=True):
                level -= np.einsum("np,tnp->tn", filling.nominal, of)
            radius = support(terms[:, :n_p], rows.spread, axis=1)
            if drift is None or fillings:
                yield ContentsCase(level + radius, own)
            if drift is None:
                continue
            terms[:, roles.column] += change[:, : len(roles.own)]
            straying = support(terms[:, :n_p], rows.spread, axis=1) + extra
            if not fillings:
                yield ContentsCase(level + np.maximum(radius, straying), own)
                continue
            strayed, less = _strayed(fillings, there, change, own)
            yield ContentsCase(level + straying - less, strayed)

    return cases
