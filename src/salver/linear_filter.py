"""Linear second-order filters, discretised exactly for polynomial inputs.

    x'' + kd x' + kp x = d(t)

These are the error dynamics of the object's loop and of the arm's joints, driven by a parameter error; and, with a
stiffness kp that changes over time, a sloshing mode or a pendulum in a load on a tray that lifts or tilts. Each step of
a grid is exact if the drive d is a polynomial there: linear between nodes, or cubic through the four nearest nodes
(nodes of any spacing). All steps together are one banded triangular system."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dtbtrs

from salver.geometry import Array

_FINE_POINTS, _FINE_WEIGHTS = (0.5 * x for x in np.polynomial.legendre.leggauss(6))
MOST_BANDED_DRIVES = 24  # with more drives, stepping several filters together node by node is faster
_SAME = 1e-9  # of the longest interval: nodes less apart are computed as one
_MOST_PIECES = 64  # largest number of pieces of an interval, each as long as the fastest time constant


@dataclass(frozen=True, eq=False)
class LinearFilter:
    """One filter, or several (...), on T nodes, for a drive with Q samples.

    step: (..., T - 1, 2, 2), takes (x, x') from one node to the next. gain: (..., T - 1, 2, J), takes the J samples of
    the drive that matter in a step to the change of (x, x'). samples: (T - 1, J) indices of these samples; None if each
    step has its own. kp: 1/s^2, one number or (..., T) at the nodes. kd: 1/s, one number or (...).
    """

    kp: float | Array
    kd: float | Array
    step: Array
    gain: Array
    samples: npt.NDArray[np.intp] | None

    @classmethod
    def on_nodes(cls, t: Array, kp: float, kd: float, order: int = 1, shares: Array | None = None) -> LinearFilter:
        """For a drive known at increasing nodes t (T,), linear (order 1) or cubic (order 3; T >= 4) between them.

        shares: the nodes as shares of the duration; a cache reuses what depends on these alone.
        """
        if len(t) <= order:
            raise ValueError(f"a filter of order {order} needs at least {order + 1} nodes, not {len(t)}")
        t = np.asarray(t, dtype=float)
        return _on_nodes(t.tobytes(), kp, kd, order, (t if shares is None else shares).tobytes())

    @classmethod
    def stiffened(cls, t: Array, kp: Array, kd: Array, extra: Array) -> LinearFilter:
        """Filters with the time-varying stiffness kp (...) + extra (..., T), underdamped: kd (...) < 2 sqrt(kp).

        The drive and `extra` are known at nodes t (T,) and cubic between them. The term extra x is treated as one more
        drive, with x in each step the cubic Hermite polynomial of both its ends; that makes the step implicit:
        (1 + F) X_(k+1) = (step - G) X_k + gain d.
        """
        samples, kinds, kind = _alike(t, 3)
        h, fastest = np.diff(t)[kinds], int(np.argmax(kp))
        u, weights = _fine(_pieces(float(kp.flat[fastest]), float(kd.flat[fastest]), h))
        basis = (weights * h[:, None])[:, :, None] * _basis(t[samples[kinds]], t[kinds], h, u)  # (S, G, 4)
        sigma = 0.5 * kd[..., None, None]
        omega = np.sqrt(kp[..., None, None] - sigma**2)
        left = h[:, None] * (1 - u)
        fading, angle = np.exp(-sigma * left), omega * left
        pushed = fading * np.sin(angle) / omega
        after = np.stack([pushed, fading * np.cos(angle) - sigma * pushed], axis=-2)  # (..., S, 2, G)
        ends = [[(1 - u) ** 2 * (1 + 2 * u), u * (1 - u) ** 2], [u**2 * (3 - 2 * u), u**2 * (u - 1)]]
        scale = np.stack([np.ones_like(h), h], axis=1)[:, None, :, None]  # rates are per second, u per step
        stiffer = extra[..., samples]
        begin, end = (
            np.einsum("...trcj,...tj->...trc", (per * scale)[..., kind, :, :, :], stiffer)
            for per in ((after[..., None, :] * np.array(pair)) @ basis[:, None] for pair in ends)
        )
        back = _inverse(np.eye(2) + end)
        fading, angle = np.exp(-sigma[..., 0] * h), omega[..., 0] * h
        sine = fading * np.sin(angle) / omega[..., 0]
        plain = _transition(kp[..., None], kd[..., None], fading * np.cos(angle), sine)[..., kind, :, :]
        gain = back @ (after @ basis)[..., kind, :, :]
        return cls(kp[..., None] + extra, kd, back @ (plain - begin), gain, samples)

    @property
    def nodes(self) -> int:
        """The number T of nodes."""
        return self.step.shape[-3] + 1

    def respond(self, drive: Array, start: Array | None = None) -> tuple[Array, Array]:
        """x and x' at the nodes, each (..., T, c...), for a drive (..., Q, c...). start: (x, x') (..., 2, c...) at the
        first node; default 0."""
        *lead, steps, _, width = self.gain.shape
        shape = (*lead, steps + 1, *drive.shape[len(lead) + 1 :])
        if drive.size == 0:  # no parameter or no variable: LAPACK writes out of bounds for no columns
            return np.zeros(shape), np.zeros(shape)
        flat = drive.reshape(*lead, drive.shape[len(lead)], -1)
        state = np.zeros((*lead, steps + 1, 2, flat.shape[-1]))
        if start is not None:
            state[..., 0, :, :] = start.reshape(*lead, 2, -1)
        if self.samples is None:
            state[..., 1:, :, :] = self.gain @ flat.reshape(*lead, steps, width, -1)
        else:
            state[..., 1:, :, :] = self.gain @ flat[..., self.samples, :]
        state = self._stepped(state) if lead and flat.shape[-1] > MOST_BANDED_DRIVES else self._solved(state)
        return state[..., 0, :].reshape(shape), state[..., 1, :].reshape(shape)

    def acceleration(self, drive: Array, x: Array, rate: Array) -> Array:
        """x'' (..., T, c...) at the nodes, for a drive known there."""
        over = x.ndim - (self.gain.ndim - 3) - 1
        kp, kd = np.asarray(self.kp), np.asarray(self.kd)
        kp = kp if kp.ndim == 0 else kp.reshape(*kp.shape, *(1,) * over)
        kd = kd if kd.ndim == 0 else kd.reshape(*kd.shape, *(1,) * (over + 1))
        return np.asarray(drive - kd * rate - kp * x)

    def only(self, which: tuple[npt.NDArray[np.intp] | slice, ...]) -> LinearFilter:
        """Some of several filters."""
        kp, kd = np.asarray(self.kp), np.asarray(self.kd)
        return LinearFilter(kp[which], kd[which], self.step[which], self.gain[which], self.samples)

    @cached_property
    def _bands(self) -> Array:
        """X_(k+1) - step_k X_k for all k, filter after filter, as a lower triangular band: (4, 2 T ...)."""
        *lead, steps = self.step.shape[:-2]
        bands = np.zeros((4, *lead, steps + 1, 2))
        bands[0] = 1.0
        bands[2, ..., :-1, 0], bands[3, ..., :-1, 0] = -self.step[..., 0, 0], -self.step[..., 1, 0]
        bands[1, ..., :-1, 1], bands[2, ..., :-1, 1] = -self.step[..., 0, 1], -self.step[..., 1, 1]
        return np.asfortranarray(bands.reshape(4, -1))

    def _stepped(self, state: Array) -> Array:
        """As `_solved`, but node by node for all filters and drives at once, which is faster with many drives."""
        found = np.ascontiguousarray(np.moveaxis(state, -3, 0))
        for before, step, now in zip(found, np.moveaxis(self.step, -3, 0), found[1:], strict=False):
            now += step @ before
        return np.moveaxis(found, 0, -3)

    def _solved(self, state: Array) -> Array:
        right = np.asfortranarray(state.reshape(-1, state.shape[-1]))
        return dtbtrs(self._bands, right, uplo="L", overwrite_b=True)[0].reshape(state.shape)


def _inverse(matrix: Array) -> Array:
    """Inverse of matrices (..., 2, 2)."""
    (a, b), (c, d) = np.moveaxis(matrix, (-2, -1), (0, 1))
    return np.moveaxis(np.array([[d, -b], [-c, a]]) / (a * d - b * c), (0, 1), (-2, -1))


def _pieces(kp: float, kd: float, h: Array) -> int:
    """Number of quadrature pieces of each of the steps h (T - 1,)."""
    return min(max(int(np.ceil(fastest_rate(kp, kd) * float(h.max()))), 1), _MOST_PIECES)


@lru_cache(maxsize=_MOST_PIECES)
def _fine(pieces: int) -> tuple[Array, Array]:
    """Quadrature points (G,) of a step, as fractions of it, and their weights (G,)."""
    inside = ((np.arange(pieces)[:, None] + 0.5 + _FINE_POINTS) / pieces).ravel()
    return inside, np.tile(_FINE_WEIGHTS, pieces) / pieces


@lru_cache(maxsize=_MOST_PIECES)
def _left(pieces: int) -> Array:
    """Remaining fractions (G + 1,) of a step at the points of `_fine`, then at its beginning."""
    return np.append(1 - _fine(pieces)[0], 1.0)


@lru_cache(maxsize=64)
def _weighed(shares: bytes, order: int, pieces: int) -> tuple[npt.NDArray[np.intp], Array]:
    """Interpolation in each interval: its nodes (T - 1, J), and their Lagrange polynomials (T - 1, G, J) at the
    quadrature points, times their weights; independent of the unit of time."""
    t, (inside, weights) = np.frombuffer(shares), _fine(pieces)
    samples = _nearest(len(t), order)
    return samples, weights[:, None] * _basis(t[samples], t[:-1], np.diff(t), inside)


def _nearest(count: int, order: int) -> npt.NDArray[np.intp]:
    """(count - 1, order + 1) indices of the nodes that interpolate in each interval."""
    first = np.clip(np.arange(count - 1) - order // 2, 0, count - order - 1)
    return np.asarray(first[:, None] + np.arange(order + 1))


def _basis(known: Array, t: Array, h: Array, inside: Array) -> Array:
    """(S, G, J) Lagrange polynomials of nodes `known` (S, J) at fractions `inside` (G,) of the intervals of length h
    (S,) that begin at t (S,)."""
    at = (t[:, None] + h[:, None] * inside)[:, :, None, None]
    own = np.eye(known.shape[1], dtype=bool)
    apart = np.where(own, 1.0, known[:, :, None] - known[:, None, :])
    return np.asarray(np.where(own, 1.0, (at - known[:, None, None, :]) / apart[:, None]).prod(axis=3))


def _alike(t: Array, order: int) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """The nodes that interpolate in each interval of t (T,), as `_nearest`; intervals (S,) of which each has other
    distances between these, and for each interval the one of these that it is like (T - 1,)."""
    samples, h = _nearest(len(t), order), np.diff(t)
    apart = np.round((t[samples] - t[:-1, None]) / (_SAME * h.max())).astype(np.int64)
    _, kinds, kind = np.unique(apart, axis=0, return_index=True, return_inverse=True)
    return samples, kinds, kind.reshape(-1)


@lru_cache(maxsize=64)
def fastest_rate(kp: float, kd: float) -> float:
    """Largest modulus of the poles of x'' + kd x' + kp x, 1/s."""
    return float(np.abs(np.roots([1.0, kd, kp])).max())


def transition(kp: float, kd: float, t: npt.ArrayLike) -> Array:
    """State transition (..., 2, 2): takes (x, x') to (x, x') t seconds later, without a drive."""
    return _transition(kp, kd, *_ringing(kp, kd, np.asarray(t, dtype=float)))


def _transition(kp: float | Array, kd: float | Array, cosine: Array, sine: Array) -> Array:
    """`transition` from the cosine and sine of `_ringing`."""
    own = 0.5 * kd * sine
    found = np.empty((*np.shape(sine), 2, 2))
    found[..., 0, 0], found[..., 0, 1], found[..., 1, 0], found[..., 1, 1] = (
        cosine + own,
        sine,
        -kp * sine,
        cosine - own,
    )
    return found


def _ringing(kp: float, kd: float, t: Array) -> tuple[Array, Array]:
    """Real part, and imaginary part over omega, of e^((-sigma + i omega) t), the poles -sigma +- i omega."""
    sigma = 0.5 * kd
    squared = kp - sigma**2
    omega = abs(squared) ** 0.5
    if omega < 1e-9:
        fading = np.exp(-sigma * t)
        return fading, t * fading
    if squared > 0:
        fading = np.exp(-sigma * t)
        return fading * np.cos(omega * t), fading * np.sin(omega * t) / omega
    slow, quick = np.exp((omega - sigma) * t), np.exp((-omega - sigma) * t)
    return 0.5 * (slow + quick), 0.5 * (slow - quick) / omega


def settled(kp: float, kd: float, seconds: float, drive: Array) -> Array:
    """(x, x') (2, ...) from rest after a constant drive (...) has acted for `seconds`."""
    return np.multiply.outer(_settled(kp, kd, seconds), drive)


@lru_cache(maxsize=64)
def _settled(kp: float, kd: float, seconds: float) -> Array:
    end = np.array([1.0 / kp, 0.0])
    return end - transition(kp, kd, seconds) @ end


def at_instant(t: Array, x: Array, now: float) -> Array:
    """x (...) at the instant `now`, linear between its values (T, ...) at nodes t (T,)."""
    k = int(np.clip(np.searchsorted(t, now) - 1, 0, len(t) - 2))
    u = (now - t[k]) / (t[k + 1] - t[k])
    return np.asarray((1 - u) * x[k] + u * x[k + 1])


def swinging_at(t: Array, x: Array, rate: Array, now: float) -> tuple[Array, Array]:
    """x and x' (...) at the instant `now`, cubic Hermite between x and x' (T, ...) at nodes t (T,)."""
    k = int(np.clip(np.searchsorted(t, now) - 1, 0, len(t) - 2))
    h = t[k + 1] - t[k]
    u = (now - t[k]) / h
    gap = x[k + 1] - x[k]
    far, bend = h * rate[k + 1] - gap, h * rate[k] - gap
    aside = u * (1 - u) * ((1 - u) * bend - u * far)
    slope = ((1 - u) * (1 - 3 * u) * bend + u * (3 * u - 2) * far + gap) / h
    return np.asarray(x[k] + u * gap + aside), np.asarray(slope)


@lru_cache(maxsize=16)
def _on_nodes(t: bytes, kp: float, kd: float, order: int, shares: bytes) -> LinearFilter:
    """`LinearFilter.on_nodes`, cached, because live motions use the same nodes again and again."""
    nodes = np.frombuffer(t)
    h = nodes[1:] - nodes[:-1]
    pieces = _pieces(kp, kd, h)
    samples, basis = _weighed(shares, order, pieces)
    # Responses to an impulse at each quadrature point, and, last, over the whole step.
    cosine, sine = _ringing(kp, kd, h[:, None] * _left(pieces))
    after = np.stack([sine[:, :-1], (cosine - 0.5 * kd * sine)[:, :-1]], axis=1)
    gain = after * h[:, None, None] @ basis
    return LinearFilter(kp, kd, _transition(kp, kd, cosine[:, -1], sine[:, -1]), gain, samples)
