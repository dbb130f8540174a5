"""Worst case of the contact rows over the uncertain set, with the rows that attain it and the closed loop's share.

`salver.models.contact_rows` bounds a body that follows its tray exactly. A wrong load also makes the arm miss its
reference, and what the tray then feels differs from w by some dw for each parameter (`joint_tracking`). The same
parameter acts through both, so they are added before absolute values are taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from salver.geometry import Array
from salver.models.contact_rows import ContactRows

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


def worst_case(rows: ContactRows, w: Array, dw: Array | None = None, names: tuple[str, ...] = ()) -> WorstCase:
    """Worst case at w (N, 12) when each of `names` also changes w by dw (N, 12, len(names)) per half-range."""
    values = w @ rows.nominal.T
    weight = np.zeros((*values.shape, 0))
    signs = np.zeros((*values.shape, 0))
    own = [rows.names.index(name) if name in rows.names else -1 for name in names]
    change = _terms(w, rows.parameter)
    if dw is not None:
        followed = np.einsum("nkp,fk->nfp", dw, rows.nominal)
        for k, name in enumerate(names):
            if own[k] >= 0:
                change[..., own[k]] += followed[..., k]
            elif name in rows.mass_names:
                values = values + rows.mass_signs[:, rows.mass_names.index(name)] * followed[..., k]
            else:  # a parameter of something else on the tray
                values = values + np.abs(followed[..., k])
    if len(rows.parameter):
        if rows.spread is None:
            values = values + np.abs(change).sum(axis=-1)
            weight = np.sign(change)
        else:
            factored = change @ rows.spread
            radius = np.sqrt(np.square(factored).sum(axis=-1)) + 1e-15
            values = values + radius
            weight = factored @ rows.spread.T / radius[..., None]
    if len(rows.remainder):
        terms = _terms(w, rows.remainder)
        values = values + np.abs(terms).sum(axis=-1)
        signs = np.sign(terms)
    return WorstCase(values, rows, weight, signs)


def _terms(w: Array, rows: Array) -> Array:
    """(N, n_f, p) of w (N, 12) and rows (p, n_f, 12)."""
    p, n_f, _ = rows.shape
    if p == 0:
        return np.zeros((len(w), n_f, 0))
    return (w @ rows.transpose(2, 1, 0).reshape(w.shape[1], n_f * p)).reshape(len(w), n_f, p)
