"""Worst case of the contact rows over the uncertain set, with the rows that attain it and the closed loop's share.

`salver.models.contact_rows` bounds a body that follows its tray exactly. A wrong load also makes the arm miss its
reference, and what the tray then feels differs from w by some dw for each parameter (`tracking`). The same
parameter acts through both, so they are added before absolute values are taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from salver.geometry import Array
from salver.models.contact_rows import ContactRows
from salver.models.parameters import Parameter

Indices = npt.NDArray[np.intp]


@dataclass(frozen=True)
class WorstCase:
    """values (N, n_f) of the rows at their worst. For derivatives: signs of the terms (N, n_f, .) at the worst."""

    values: Array
    rows: ContactRows
    parameter_weight: Array
    remainder_sign: Array

    def attained(self, node: Indices, row: Indices) -> Array:
        """(r, 12) derivative of the worst case by w, at nodes and rows (r,); that of dw is left out."""
        c = self.rows
        out = c.nominal[row].copy()
        if len(c.parameter):
            out += np.einsum("rp,prk->rk", self.parameter_weight[node, row], c.parameter[:, row])
        if len(c.remainder):
            out += np.einsum("rp,prk->rk", self.remainder_sign[node, row], c.remainder[:, row])
        return out


def worst_case(
    rows: ContactRows, w: Array, dw: Array | None = None, parameters: tuple[Parameter, ...] = ()
) -> WorstCase:
    """Worst case at w (N, 12), also when term k changes w by dw[..., k] (N, 12, n_k) per half-range.

    The first terms are those of `parameters`, the others products of two.
    With dw, the larger of two: the tray strays by dw, or it follows exactly (a controller better than assumed).
    """
    values = w @ rows.nominal.T
    change = _terms(w, rows.parameter)
    signs = np.zeros((*values.shape, 0))
    if len(rows.remainder):
        terms = _terms(w, rows.remainder)
        values = values + np.abs(terms).sum(axis=-1)
        signs = np.sign(terms)
    spread, weight = _radius(rows, change)
    if dw is not None:
        followed = rows.nominal @ dw
        strayed, extra = change.copy(), np.zeros_like(values)
        for k in range(followed.shape[-1]):
            parameter = parameters[k] if k < len(parameters) else None
            if parameter in rows.acting:
                strayed[..., rows.acting.index(parameter)] += followed[..., k]
            elif parameter in rows.masses:
                extra += rows.mass_signs[:, rows.masses.index(parameter)] * followed[..., k]
            else:  # a product, or a parameter of something else on the tray
                extra += np.abs(followed[..., k])
        straying, straying_weight = _radius(rows, strayed)
        straying = straying + extra
        weight = np.where((straying > spread)[..., None], straying_weight, weight)
        spread = np.maximum(spread, straying)
    return WorstCase(values + spread, rows, weight, signs)


def _radius(rows: ContactRows, change: Array) -> tuple[Array, Array]:
    """Worst case (N, n_f) of the linear terms (N, n_f, n_p) over the set, and its derivative by each term."""
    if rows.spread is None or not change.shape[-1]:
        return np.abs(change).sum(axis=-1), np.sign(change)
    factored = change @ rows.spread
    size = np.sqrt(np.square(factored).sum(axis=-1)) + 1e-15
    return size, factored @ rows.spread.T / size[..., None]


def _terms(w: Array, rows: Array) -> Array:
    """(N, n_f, p) of w (N, 12) and rows (p, n_f, 12)."""
    p, n_f, _ = rows.shape
    if p == 0:
        return np.zeros((len(w), n_f, 0))
    return (w @ rows.transpose(2, 1, 0).reshape(w.shape[1], n_f * p)).reshape(len(w), n_f, p)
