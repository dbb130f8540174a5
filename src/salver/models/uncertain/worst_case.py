"""The worst case of constraints over the uncertain set; it is taken here and nowhere else.

A row is c(p) . w <= 0 with w what the tray feels (`salver.models.tray_motion`) and c a polynomial of the uncertain
parameters p. Written in half-ranges s of the parameters, its worst case is

    c_0 . w + h((c_k . w)_k) + sum_l |d_l . w|,        h(x) = sum_k |x_k|   (box),   |A^T x|   (ellipsoid)

with c_k the linear terms, d_l all products of two parameters, and A A^T the correlation. h is the support function of
the set; products are bounded one by one, so the worst case is never too optimistic. A box's masses are not among the
s: a cone has no scale, and bounding mass and centre of mass one by one would count both, so rows stand once for each
extreme mass.

A wrong load also makes the arm miss its reference, and the tray then feels w + dw_k s_k (`Drift`). The same parameter
acts through both, so c_0 . dw_k is added to c_k . w before h is taken; what no parameter of these rows explains is
bounded by itself. Of two it is the larger: the tray strays, or it follows exactly (a controller better than assumed).
Commands that are held put w off by a swing to either side, whatever the parameters: both sides are tried.

A tray that shakes by any dw of a ball (`Vibration`) adds the support of that ball, a |c_f| + b |c_alpha| with the parts
of c that take specific force and angular acceleration: a constant of each row, whatever is planned, at every speed.

A body with unknown contents adds the largest mean of a quadratic over all its mass distributions
(`models.uncertain.contents`); its drift is linear in the same moments, and so in the same mean.

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
from salver.models.uncertain.worst_contents import SURE, ContentsCase, bounded, fill

Some = Indices | slice
ALL = slice(None)
Added = Callable[[Some, Some, bool], Array]
_CHUNK = 160_000  # terms worked on at once: they fit in the cache, and the product is too small to be threaded


@dataclass(frozen=True)
class Drift:
    """Tracking perturbation: change of the tray's motion regressor per unit of each parameter, in the closed loop.

    terms: the factors of each of n_k terms, one parameter or a product of two. dw: (T, 12, n_k) for one half-range of
    each. swing: (T, 12) to either side, whatever the parameters; None for nothing.
    """

    terms: tuple[tuple[Parameter, ...], ...]
    dw: Array
    swing: Array | None = None


@dataclass(frozen=True)
class UncertainRows:
    """n constraints that are linear in the motion regressor w (12,) for all parameters.

    nominal: (n, 12) c_0. acting: the n_p parameters in `parameter` (n_p, n, 12), c_k, per half-range. remainder:
    (n_r, n, 12) d_l. spread: (n_p, n_p) A of an ellipsoid, None for a box. masses, mass_signs: masses that are taken at
    their extremes, and at which of them (n, n_m) each row is. fillings: bodies whose contents are unknown.
    shake: of the tray whose frame w is of.
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
        """Whether they are the same whatever the parameters."""
        return not (len(self.parameter) or len(self.remainder) or self.fillings)

    @cached_property
    def each(self) -> Array:
        """(n, n_p + n_r, 12) c_k and then d_l, row by row."""
        return np.ascontiguousarray(np.swapaxes(np.concatenate([self.parameter, self.remainder]), 0, 1))

    @cached_property
    def by_entry(self) -> Array:
        """(12, n_p + n_r, n) the same by entries of w."""
        return np.ascontiguousarray(np.moveaxis(np.concatenate([self.parameter, self.remainder]), 2, 0))

    @cached_property
    def largest(self) -> Array:
        """(n, 36) c_0, what all other terms come to at most by the size of each of w, and the size of c_0."""
        each = np.abs(np.concatenate([self.parameter, self.remainder])).sum(axis=0)
        return np.hstack([self.nominal, each, np.abs(self.nominal)])

    @cached_property
    def shaken(self) -> Array:
        """(n,) most that the shake of the tray adds, at whatever parameters: of every term of c(p) by itself."""
        if self.shake is None:
            return np.zeros(len(self.nominal))
        found = self.shake.support(np.concatenate([self.nominal[None], self.parameter, self.remainder])).sum(axis=0)
        for filling in self.fillings:
            found += (filling.farthest[:, None] * self.shake.support(filling.rows)).sum(axis=0)
        return np.asarray(found)

    def terms(self, w: Array) -> Array:
        """(T, n, n_p + n_r) c_k . w and then d_l . w, of w (T, 12)."""
        return np.moveaxis(np.tensordot(w, np.concatenate([self.parameter, self.remainder]), axes=(1, 2)), 1, 2)

    def radius(self, terms: Array) -> Array:
        """(...) most that `terms` (..., n_p + n_r) can add."""
        n_p = len(self.acting)
        return support(terms[..., :n_p], self.spread) + support(terms[..., n_p:], None)

    def dual(self, terms: Array) -> Array:
        """(..., n_p + n_r) derivative of `radius` by the terms: how much of each is at work in the worst case."""
        out = np.sign(terms)
        if self.spread is not None:
            factored = terms[..., : len(self.acting)] @ self.spread
            size = np.maximum(np.linalg.norm(factored, axis=-1, keepdims=True), 1e-300)
            out[..., : len(self.acting)] = factored / size @ self.spread.T
        return out

    def worst(self, w: Array, drift: Drift | None = None) -> Array:
        """(T, n) worst case of every row at w (T, 12)."""
        return WorstCase.of(self, w, drift).values

    def slope(self, w: Array, row: Indices) -> Array:
        """(r, 12) derivative by w of the worst case of rows (r,), each at its own w (r, 12)."""
        return WorstCase(self, w, None, np.empty(0)).attained(np.arange(len(w)), row)

    def worst_point(self, w: Array, row: int) -> dict[Parameter, float]:
        """The point of the unit box or ball (by parameter, in half-ranges) that is worst for a row at w (12,).

        To first order around the centre; products of parameters do not count.
        """
        slope = self.parameter[:, row] @ w
        dual = np.where(slope >= 0, 1.0, -1.0) if self.spread is None else self.dual(slope)
        point = dict(zip(self.acting, dual.tolist(), strict=True))
        for filling in (f.only([row]) for f in self.fillings):
            moments = filling.largest(filling.coefficients(w[None])[0])[1]
            point |= dict(zip(filling.moved, (filling.per[:, 0] @ moments[0] - filling.less).tolist(), strict=True))
        return point | dict(zip(self.masses, self.mass_signs[row].tolist(), strict=True))

    def mapped(self, change: Callable[[Array], Array]) -> Self:
        """With every array (..., n, 12) of rows changed."""
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
    """Worst-case values (T, n) of constraints along w (T, 12), and the terms that are active there."""

    rows: UncertainRows
    w: Array
    drift: Drift | None
    values: Array

    @classmethod
    def of(
        cls, rows: UncertainRows, w: Array, drift: Drift | None = None, coarsely: bool = False, margin: float = 0.0
    ) -> WorstCase:
        """See `UncertainRows.worst`. coarsely: of rows surely beyond `SURE`, and beyond twice the margin that they are
        to keep, a bound is enough."""
        if not coarsely:
            return cls(rows, w, drift, _values(rows, w, drift))
        return cls(rows, w, drift, values_near(rows, w, drift, margin=max(0.0, SURE + 2.0 * margin)))

    def attained(self, node: Indices, row: Indices) -> Array:
        """(r, 12) derivative of the worst case by w, at nodes and rows (r,); that of the drift is left out."""
        return self.attained_swinging(node, row)[0]

    def attained_swinging(self, node: Indices, row: Indices) -> tuple[Array, Array]:
        """`attained`, and (r,) the side of the drift's swing on which it is: -1 or 1, 0 without a swing."""
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
    """w on both sides of a swing, and which side it is."""
    if drift is None or drift.swing is None:
        return ((0.0, w),)
    return (-1.0, w - drift.swing), (1.0, w + drift.swing)


@dataclass(frozen=True)
class _Roles:
    """Terms of a drift that rows know (own), as which of `acting` (column); as which mass; as which parameter of which
    filling (filled); and terms that they do not know."""

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
    """Coefficients (..., n, 9) of each filling with the drift's change (..., n_k, n) in them, and what to take off."""
    change = np.swapaxes(change, -1, -2)
    strayed, less = list(coefficients), np.zeros(change.shape[:-1])
    for k, f, q in roles.filled:
        strayed[f] = strayed[f] + change[..., k, None] * fillings[f].per[q]
        less += change[..., k] * fillings[f].less[q]
    return strayed, less


def _values(rows: UncertainRows, w: Array, drift: Drift | None, some: Some = ALL) -> Array:
    """(T, n) worst case of all rows, or of some that have no fillings, in pieces of time; what fillings make of rows
    that matter is sought for all pieces together."""
    nominal = rows.nominal[some]
    if rows.certain and (drift is None or not drift.terms):
        either = [side @ nominal.T + rows.shaken[some] for _, side in _sides(w, drift)]
        return np.maximum(*either) if len(either) > 1 else either[0]
    n_k, n = 0 if drift is None else len(drift.terms), len(nominal)
    per_row = len(rows.parameter) + len(rows.remainder) + n_k + 30 * len(rows.fillings)
    values = np.empty((len(w), n))
    every = max(1, _CHUNK // max(1, n * per_row))
    cases, open_ = _cases(rows, w, drift, some), []
    for start in range(0, len(w), every):
        part = slice(start, start + every)
        found = list(cases(part))
        if rows.fillings:
            values[part], few = bounded(rows.fillings, found, start)
            open_ += few
        else:
            values[part] = found[0].value
            for case in found[1:]:
                np.maximum(values[part], case.value, out=values[part])
    if open_:
        fill(rows.fillings, open_, values)
    return values


def values_near(
    rows: UncertainRows, w: Array, drift: Drift | None, added: Added | None = None, margin: float = 0.0
) -> Array:
    """(T, n) worst case; where each term at its largest, one by one, leaves a row beyond `SURE` with a margin, that
    bound.

    added: what else is added to rows, of instants and rows that are asked for, or no less than that.
    """
    if rows.fillings or rows.spread is not None:
        return _values(rows, w, drift) + (0.0 if added is None else added(ALL, ALL, False))
    moved = np.zeros_like(w) if drift is None else np.abs(drift.dw).sum(axis=2)
    swing = np.zeros_like(w) if drift is None or drift.swing is None else np.abs(drift.swing)
    values = np.hstack([w, np.abs(w) + swing, swing + moved]) @ rows.largest.T + rows.shaken
    if added is not None:
        values += added(ALL, ALL, True)
    due = values > SURE - margin
    instants, some = np.flatnonzero(due.any(axis=1)), np.flatnonzero(due.any(axis=0))
    if len(instants):
        felt = None
        if drift is not None:
            felt = Drift(drift.terms, drift.dw[instants], None if drift.swing is None else drift.swing[instants])
        exact = _values(rows, w[instants], felt, some)
        values[np.ix_(instants, some)] = exact if added is None else exact + added(instants, some, False)
    return values


def _cases(rows: UncertainRows, w: Array, drift: Drift | None, some: Some) -> Callable[[slice], Iterator[ContentsCase]]:
    """The cases of which the worst counts, in a piece of time: either side of a swing, strayed or not."""
    n_p, n_k = len(rows.acting), 0 if drift is None else len(drift.terms)
    felt = ALL if drift is not None else np.any(w != 0, axis=0)  # a tray that does not turn feels three of the twelve
    nominal, flat = rows.nominal[some].T[felt], rows.by_entry[:, :, some][felt]
    _, n_c, n = flat.shape
    flat = flat.reshape(len(flat), n_c * n)
    sides = [np.ascontiguousarray(side[:, felt]) for _, side in _sides(w, drift)]
    drift = drift if n_k else None  # what only swings has no more cases than sides
    fillings = tuple(filling.mapped(lambda array: array[..., felt]) for filling in rows.fillings)
    if drift is not None:
        roles = _roles(rows, drift)
        # What rows do not know of comes last: where its sizes are summed, no copy is made of it.
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
                extra += rows.mass_signs[some, j] * change[:, place[k]]
        for side in sides:
            terms = (side[part] @ flat).reshape(count, n_c, n)
            own = [filling.coefficients(side[part]) for filling in fillings]
            level = side[part] @ nominal + np.abs(terms[:, n_p:]).sum(axis=1) + rows.shaken[some]
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
