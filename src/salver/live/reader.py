"""Reader of the robot's loop: the committed motion at an instant, without waiting and without new arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from salver.geometry import Array
from salver.trajectory import JointMotion


class Pieces:
    """A motion as polynomials of live time, ready to be evaluated: rest before the first knot and after the last."""

    def __init__(self, motion: JointMotion, begins: float) -> None:
        self.knots: list[float] = (begins + motion.t).tolist()
        # As powers of the time since their knot, highest first: (K, 6, n).
        lengths = np.diff(motion.t)
        q, dq, ddq = motion.q, motion.dq, motion.ddq
        self.coefficients = np.ascontiguousarray(_powers(q, dq, ddq, lengths))
        self.still = np.zeros_like(self.coefficients[:1])[0]
        self.rest = self.still.copy()
        self.rest[5] = q[-1]
        self.still[5] = q[0]


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
            np.copyto(self.q, self.pieces.rest[5] if now >= knots[0] else self.pieces.still[5])
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


def _powers(q: Array, dq: Array, ddq: Array, h: Array) -> Array:
    """(K, 6, n) coefficients, highest power first, of the quintics between knots (K + 1, n) that are h (K,) apart."""
    h = h[:, None]
    p, v, a = q[:-1], dq[:-1], ddq[:-1]
    gap = q[1:] - (p + v * h + 0.5 * a * h**2)
    slope = (dq[1:] - (v + a * h)) * h
    bend = (ddq[1:] - a) * h**2
    third = 10 * gap - 4 * slope + 0.5 * bend
    fourth = -15 * gap + 7 * slope - bend
    fifth = 6 * gap - 3 * slope + 0.5 * bend
    return np.stack([fifth / h**5, fourth / h**4, third / h**3, 0.5 * a, v, p], axis=1)
