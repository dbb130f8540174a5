"""The worst case of rows over the uncertain set: the one place where it is taken.

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

All of it is convex in w, with the derivative `WorstCase.attained`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from salver.geometry import Array
from salver.models.parameters import Parameter
from salver.models.tray_motion import frame_map

Indices = npt.NDArray[np.intp]
_CHUNK = 80_000  # terms worked on at once: they fit in the cache, and the product is too small to be threaded


@dataclass(frozen=True)
class Drift:
    """How what the tray feels changes with the parameters, through the closed loop that carries it.

    terms: the factors of each of n_k terms, one parameter or a product of two. dw: (T, 12, n_k) for one half-range of
    each. swing: (T, 12) to either side, whatever the parameters; None for nothing.
    """

    terms: tuple[tuple[Parameter, ...], ...]
    dw: Array
    swing: Array | None = None


@dataclass(frozen=True)
class UncertainRows:
    """n rows over w (12,) that are linear in it for any parameters.

    nominal: (n, 12) c_0. acting: the n_p parameters in `parameter` (n_p, n, 12), c_k, per half-range. remainder:
    (n_r, n, 12) d_l. spread: (n_p, n_p) A of an ellipsoid, None for a box. masses, mass_signs: masses that are taken at
    their extremes, and at which of them (n, n_m) each row is.
    """

    nominal: Array
    acting: tuple[Parameter, ...]
    parameter: Array
    remainder: Array
    spread: Array | None
    masses: tuple[Parameter, ...]
    mass_signs: Array

    def terms(self, w: Array) -> Array:
        """(T, n, n_p + n_r) c_k . w and then d_l . w, of w (T, 12)."""
        return np.moveaxis(np.tensordot(w, np.concatenate([self.parameter, self.remainder]), axes=(1, 2)), 1, 2)

    def radius(self, terms: Array) -> Array:
        """(...) most that `terms` (..., n_p + n_r) can add."""
        return self._support(terms[..., : len(self.acting)]) + np.abs(terms[..., len(self.acting) :]).sum(axis=-1)

    def dual(self, terms: Array) -> Array:
        """(..., n_p + n_r) derivative of `radius` by the terms: how much of each is at work in the worst case."""
        out = np.sign(terms)
        if self.spread is not None:
            factored = terms[..., : len(self.acting)] @ self.spread
            size = np.maximum(np.linalg.norm(factored, axis=-1, keepdims=True), 1e-300)
            out[..., : len(self.acting)] = factored / size @ self.spread.T
        return out

    def tangent(self, row: Indices, dual: Array) -> Array:
        """(r, 12) derivative by w of rows (r,) with these terms at work (r, n_p + n_r)."""
        terms = np.concatenate([self.parameter[:, row], self.remainder[:, row]])
        return self.nominal[row] + np.einsum("rp,prk->rk", dual, terms)

    def worst(self, w: Array, drift: Drift | None = None) -> Array:
        """(T, n) worst case of every row at w (T, 12)."""
        return WorstCase.of(self, w, drift).values

    def worst_point(self, w: Array, row: int) -> dict[Parameter, float]:
        """The point of the unit box or ball (by parameter, in half-ranges) that is worst for a row at w (12,).

        To first order around the centre; products of parameters do not count.
        """
        slope = self.parameter[:, row] @ w
        dual = np.where(slope >= 0, 1.0, -1.0) if self.spread is None else self.dual(slope)
        point = dict(zip(self.acting, dual.tolist(), strict=True))
        return point | dict(zip(self.masses, self.mass_signs[row].tolist(), strict=True))

    def seen_from(self, p_EX: Array, R_EX: Array) -> Self:
        """The same rows for w of another frame X that is fixed to the tray, for example an object's B."""
        back = frame_map(-R_EX.T @ p_EX, R_EX.T)
        return replace(
            self, nominal=self.nominal @ back, parameter=self.parameter @ back, remainder=self.remainder @ back
        )

    def _support(self, terms: Array) -> Array:
        """h (...) of terms (..., n_p)."""
        if self.spread is None:
            return np.asarray(np.abs(terms).sum(axis=-1))
        return np.linalg.norm(terms @ self.spread, axis=-1)


@dataclass(frozen=True)
class WorstCase:
    """values (T, n) of rows at their worst along w (T, 12), and which terms are at work there."""

    rows: UncertainRows
    w: Array
    drift: Drift | None
    values: Array

    @classmethod
    def of(cls, rows: UncertainRows, w: Array, drift: Drift | None = None) -> WorstCase:
        """See `UncertainRows.worst`."""
        return cls(rows, w, drift, _values(rows, w, drift))

    def attained(self, node: Indices, row: Indices) -> Array:
        """(r, 12) derivative of the worst case by w, at nodes and rows (r,); that of the drift is left out."""
        return self.attained_swinging(node, row)[0]

    def attained_swinging(self, node: Indices, row: Indices) -> tuple[Array, Array]:
        """`attained`, and (r,) the side of the drift's swing on which it is: -1 or 1, 0 without a swing."""
        rows, nominal = self.rows, self.rows.nominal[row]
        stacked = np.concatenate([rows.parameter[:, row], rows.remainder[:, row]])
        found: list[tuple[Array, Array]] = []
        for side in _sides(self.w, self.drift):
            w = side[node]
            terms = np.einsum("rk,prk->rp", w, stacked)
            radius, dual = rows.radius(terms), rows.dual(terms)
            if self.drift is not None:
                change = np.einsum("rk,rkp->rp", nominal, self.drift.dw[node])
                own, column, mass, other = _roles(rows, self.drift)
                strayed = terms.copy()
                strayed[:, column] += change[:, own]
                straying = rows.radius(strayed) + np.abs(change[:, other]).sum(axis=1)
                straying += sum((rows.mass_signs[row, j] * change[:, k] for k, j in mass), np.zeros(len(row)))
                dual = np.where((straying > radius)[:, None], rows.dual(strayed), dual)
                radius = np.maximum(radius, straying)
            found.append((np.einsum("rk,rk->r", w, nominal) + radius, dual))
        dual, swung = found[0][1], np.full(len(row), 1.0 - len(found))
        for value, other_dual in found[1:]:
            above = value > found[0][0]
            dual, swung = np.where(above[:, None], other_dual, dual), np.where(above, 1.0, swung)
        return nominal + np.einsum("rp,prk->rk", dual, stacked), swung


def _sides(w: Array, drift: Drift | None) -> tuple[Array, ...]:
    if drift is None or drift.swing is None:
        return (w,)
    return w - drift.swing, w + drift.swing


def _roles(rows: UncertainRows, drift: Drift) -> tuple[list[int], list[int], list[tuple[int, int]], list[int]]:
    """Terms of a drift that rows know, and as which of `acting`; as which mass; and terms that they do not know."""
    own, column, mass, other = [], [], [], []
    for k, factors in enumerate(drift.terms):
        if len(factors) == 1 and factors[0] in rows.acting:
            own.append(k)
            column.append(rows.acting.index(factors[0]))
        elif len(factors) == 1 and factors[0] in rows.masses:
            mass.append((k, rows.masses.index(factors[0])))
        else:  # a product, or a parameter of something else on the tray
            other.append(k)
    return own, column, mass, other


def _values(rows: UncertainRows, w: Array, drift: Drift | None) -> Array:
    """(T, n) worst case, in pieces of time."""
    n_p, n_k, n = len(rows.acting), 0 if drift is None else len(drift.terms), len(rows.nominal)
    felt = np.any(w != 0, axis=0) | (drift is not None)  # a tray that does not turn feels three of the twelve
    columns = np.concatenate([rows.parameter, rows.remainder])[:, :, felt]
    nominal, flat = rows.nominal[:, felt].T, np.ascontiguousarray(columns.reshape(-1, columns.shape[2]).T)
    sides = [np.ascontiguousarray(side[:, felt]) for side in _sides(w, drift)]
    if drift is not None:
        own, column, mass, other = _roles(rows, drift)
        moved = np.ascontiguousarray(np.swapaxes(drift.dw, 1, 2))
    values = np.full((len(w), n), -np.inf)
    every = max(1, _CHUNK // max(1, n * (len(columns) + n_k)))
    for start in range(0, len(w), every):
        part = slice(start, start + every)
        count = len(w[part])
        if drift is not None:
            change = (moved[part].reshape(-1, moved.shape[2]) @ nominal).reshape(count, n_k, n)
            extra = np.abs(change[:, other]).sum(axis=1)
            for k, j in mass:
                extra += rows.mass_signs[:, j] * change[:, k]
        for side in sides:
            terms = (side[part] @ flat).reshape(count, len(columns), n)
            radius = _support(rows, terms[:, :n_p])
            if drift is not None:
                terms[:, column] += change[:, own]
                radius = np.maximum(radius, _support(rows, terms[:, :n_p]) + extra)
            value = side[part] @ nominal + np.abs(terms[:, n_p:]).sum(axis=1) + radius
            np.maximum(values[part], value, out=values[part])
    return values


def _support(rows: UncertainRows, terms: Array) -> Array:
    """h (T, n) of terms (T, n_p, n)."""
    if rows.spread is None:
        return np.asarray(np.abs(terms).sum(axis=1))
    return np.asarray(np.sqrt(np.square(np.einsum("pq,tpn->tqn", rows.spread, terms)).sum(axis=1)))
