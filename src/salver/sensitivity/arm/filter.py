"""The error filter e'' + kd e' + kp e = D(t) on nodes of any spacing, linear in D at the nodes.

Between nodes D is the cubic through the four nearest; on it, each step is integrated exactly. The arm usually holds
its load for a while before it moves, so it starts from where it has sagged to: `settle` says for how long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from salver.geometry import Array

_NEIGHBOURS = 4
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(5)
_POINTS, _WEIGHTS = 0.5 + 0.5 * _POINTS, 0.5 * _WEIGHTS


@dataclass(frozen=True)
class NodeFilter:
    """e and e' at nodes t (T,) for D at the nodes, from rest; e'' = D - kd e' - kp e.

    Over interval k: x[k + 1] = step[k] x[k] + gain[k] D[columns[k]], with x = (e, e'). step: (T-1, 2, 2), gain:
    (T-1, 2, 4), columns: (T-1, 4). sag: (T, 2) what e and e' keep of a unit forcing that was there before t[0].
    """

    step: Array
    gain: Array
    columns: npt.NDArray[np.intp]
    sag: Array
    kp: float
    kd: float

    def _run(self, flat: Array) -> Array:
        """(T, 2, m) e and e' for D (T, m)."""
        push = np.einsum("tic,tcm->tim", self.gain, flat[self.columns])
        x = np.zeros((len(flat), 2, flat.shape[1]))
        for k in range(len(flat) - 1):
            x[k + 1] = self.step[k] @ x[k] + push[k]
        return x

    def respond(self, forcing: Array, settled: Array | float = 1.0) -> tuple[Array, Array, Array]:
        """(e, e', e''), each of the shape of the forcing (T, ...) at the nodes.

        settled: 1 where the forcing of t[0] was there before it, 0 where it was not; broadcast over the last axis.
        """
        x = self._run(forcing.reshape(len(forcing), -1))
        before = np.broadcast_to(forcing[0] * settled, forcing.shape[1:])
        e, rate = (x[:, k].reshape(forcing.shape) + np.multiply.outer(self.sag[:, k], before) for k in range(2))
        return e, rate, forcing - self.kd * rate - self.kp * e


def node_filter(t: Array, kp: float, kd: float, settle: float = 0.0) -> NodeFilter:
    """The filter on increasing nodes t (T,), T >= 4. settle: s that a forcing has been there before t[0]."""
    count, h = len(t), np.diff(t)
    if count < _NEIGHBOURS:
        raise ValueError(f"a filter on nodes needs at least {_NEIGHBOURS} of them, not {count}")
    first = np.clip(np.arange(count - 1) - 1, 0, count - _NEIGHBOURS)
    columns = first[:, None] + np.arange(_NEIGHBOURS)
    # Lagrange's polynomials of the four nearest nodes at the quadrature points inside each interval: (T-1, G, 4).
    inside = t[:-1, None] + h[:, None] * _POINTS
    basis = np.ones((count - 1, len(_POINTS), _NEIGHBOURS))
    for i in range(_NEIGHBOURS):
        for j in range(_NEIGHBOURS):
            if i != j:
                own, other = t[columns[:, i], None], t[columns[:, j], None]
                basis[:, :, i] *= (inside - other) / (own - other)
    remaining = transition(kp, kd, h[:, None] * (1 - _POINTS))[:, :, :, 1]
    gain = np.einsum("tg,tgi,tgc->tic", h[:, None] * _WEIGHTS, remaining, basis)
    sag = transition(kp, kd, t - t[0]) @ sagged(kp, kd, settle)
    return NodeFilter(transition(kp, kd, h), gain, columns, sag, kp, kd)


def sagged(kp: float, kd: float, settle: float) -> Array:
    """(2,) e and e' that a unit forcing has led to after `settle` seconds from rest."""
    end = np.array([1.0 / kp, 0.0])
    return end - transition(kp, kd, np.asarray(settle)) @ end


def transition(kp: float, kd: float, t: npt.ArrayLike) -> Array:
    """(..., 2, 2): (e, e') at t = 0 to those t seconds later, unforced."""
    t = np.asarray(t, dtype=float)
    sigma = 0.5 * kd
    omega = np.sqrt(complex(kp - sigma**2))
    forward, backward = np.exp((1j * omega - sigma) * t), np.exp((-1j * omega - sigma) * t)
    cosine = np.real(forward + backward) / 2
    sine = t * np.exp(-sigma * t) if abs(omega) < 1e-9 else np.real((forward - backward) / (2j * omega))
    shifted = np.array([[sigma, 1.0], [-kp, -sigma]])
    return cosine[..., None, None] * np.eye(2) + sine[..., None, None] * shifted
