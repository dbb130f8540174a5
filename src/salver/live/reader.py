"""Reader of the robot's loop: the committed motion at an instant, without waiting and without new arrays."""

from __future__ import annotations

from math import factorial
from typing import Any

import numpy as np
import pinocchio as pin

from salver.geometry import Array
from salver.trajectory import JointMotion, Quintics


class Pieces:
    """A motion as polynomials of live time, ready to be evaluated: rest before the first knot and after the last."""

    def __init__(self, motion: JointMotion, begins: float) -> None:
        self.knots: list[float] = (begins + motion.t).tolist()
        pieces = Quintics.through(motion.t, np.stack([motion.q, motion.dq, motion.ddq]))
        self.coefficients = _powers(pieces.coefficients, np.diff(motion.t)[:, None])
        self.first, self.last = motion.q[0], motion.q[-1]


class Reader:
    """Evaluates pieces into arrays of its own, which each call fills anew."""

    def __init__(self, model: Any, pieces: Pieces) -> None:
        """model: Pinocchio's, with the load bolted on, for this reader alone."""
        self._model, self._data = model, model.createData()
        n = model.nv
        self._powers = np.zeros((3, 6))
        self._out = np.zeros((3, n))
        self.q, self.dq, self.ddq = self._out
        self.tau = np.zeros(n)
        self._piece = 0
        self.pieces = pieces

    def take(self, pieces: Pieces) -> None:
        """Replace the pieces that `read` evaluates."""
        self.pieces, self._piece = pieces, 0

    def read(self, now: float) -> None:
        """Fill q, dq, ddq and tau with the command at live time `now`, s."""
        knots, powers = self.pieces.knots, self._powers
        if now >= knots[-1] or now < knots[0]:
            self._out.fill(0.0)
            np.copyto(self.q, self.pieces.last if now >= knots[0] else self.pieces.first)
        else:
            k = self._piece
            while now >= knots[k + 1]:
                k += 1
            while now < knots[k]:
                k -= 1
            self._piece = k
            u = now - knots[k]
            u2 = u * u
            u3, u4 = u2 * u, u2 * u2
            first, second, third = powers
            first[0], first[1], first[2], first[3], first[4], first[5] = u4 * u, u4, u3, u2, u, 1.0
            second[0], second[1], second[2], second[3], second[4] = 5 * u4, 4 * u3, 3 * u2, 2 * u, 1.0
            third[0], third[1], third[2], third[3] = 20 * u3, 12 * u2, 6 * u, 2.0
            np.dot(powers, self.pieces.coefficients[k], out=self._out)
        np.copyto(self.tau, pin.rnea(self._model, self._data, self.q, self.dq, self.ddq))


def _powers(bernstein: Array, h: Array) -> Array:
    """(K, 6, n) coefficients by powers of the time since each knot, highest first, of Bernstein coefficients (6, K, n)
    of pieces h (K, 1) s long."""
    powers, left = [], bernstein
    for k in range(6):
        powers.append(left[0] / factorial(k))
        left = np.diff(left, axis=0) * ((5 - k) / h)
    return np.ascontiguousarray(np.stack(powers[::-1], axis=1))
