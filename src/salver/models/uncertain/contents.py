"""Unknown contents: the worst case of a contact constraint over all mass distributions inside a shape.

A row is linear in a body's inertial parameters, and these are moments of its mass distribution. So the contribution of
the body is the mean over its mass of a quadratic function of the point x,

    m E[ b . x + x^T Q x ],        b, Q linear in the motion regressor of the tray.

Its largest value over all distributions inside a convex set K whose mean (the centre of mass) lies in a box C around
the origin of B is, by the duality of moment problems,

    min over u of  max_{x in K} (b . x + x^T Q x - u . x)  +  sum_i |u_i| C_i.

The inner maximum is exact: it is in the relative interior of a face of K (a vertex, an edge, a facet, K itself) at
which the quadratic is stationary and concave, and a polytope has few faces (27 for a box). Every u gives a bound, so
that a search that ends early is conservative, never optimistic. Second moments need no relaxation; the moment
conditions of Heins and Schoellig (2025, arXiv 2411.07079) solve the same problem with one.

The search is column generation (Dantzig and Wolfe 1960): with the prices u of a mixture of four points of K, the point
that improves the mixture most is added.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Self

import numpy as np

from salver.geometry import Array, Indices, Mask
from salver.models.rigid_body import PAIRS, inertia_entries, inertia_matrix
from salver.models.shapes.hulls import polytope
from salver.models.uncertain.parameters import Parameter


@dataclass(frozen=True)
class MomentSearch:
    """Options of the search for the largest mean.

    Attributes:
        gap: largest gap between bound and attained value, as a share of a row's curvature over the shape. Doubled,
            bounds are looser by up to as much.
        steps: largest number of iterations.
        rows: number of rows that are searched together; they fit into the cache.
        pivot: relative size below which a column does not leave the mixture, to keep the others independent.
    """

    gap: float = 1e-3
    steps: int = 60
    rows: int = 2000
    pivot: float = 1e-5


MOMENT_SEARCH = MomentSearch()


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex polytope with all its faces, in units of `half` around `centre`, so that it fills a cube of side 2.

    foot: (F, 3) a point of each face's plane. basis: for dimensions 1, 2, 3 the directions (F_d, 3, d) that span the
    faces. normal (k, 3), offset (k,): normal . x <= offset inside.
    """

    centre: Array
    half: Array
    foot: Array
    basis: tuple[Array, Array, Array]
    normal: Array
    offset: Array

    @classmethod
    def of(cls, points: Array, most: int = 150) -> Hull:
        """The hull of points (n, 3), or their bounding box if the hull has more than `most` faces of all dimensions."""
        low, high = points.min(axis=0), points.max(axis=0)
        centre, half = 0.5 * (low + high), 0.5 * (high - low)
        scaled = (points - centre) / half
        hull = polytope(scaled)
        corners, normal, offset = scaled[hull.corners], hull.normal, hull.offset
        if 4 * len(corners) > most:  # vertices - edges + facets = 2 and facets >= 3
            corners = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
            normal, offset = np.vstack([np.eye(3), -np.eye(3)]), np.ones(6)
        on = np.abs(corners @ normal.T - offset) < 1e-7  # (corners, facets)
        edges = [(i, j) for i, j in combinations(range(len(corners)), 2) if (on[i] & on[j]).sum() >= 2]
        # Rounding can leave corners inside an edge, so that edges cover it twice, which is harmless.
        first = corners[[i for i, _ in edges]]
        along = corners[[j for _, j in edges]] - first
        across = np.linalg.svd(normal[:, None, :])[2][:, 1:]  # two directions within each facet
        return cls(
            centre,
            half,
            np.concatenate([corners, first, normal * offset[:, None], np.zeros((1, 3))]),
            (along[:, :, None], np.swapaxes(across, 1, 2), np.eye(3)[None]),
            normal,
            offset,
        )

    @property
    def corners(self) -> int:
        """Number of corners, which are the first faces."""
        return len(self.foot) - sum(len(basis) for basis in self.basis)

    def maxima(self, b: Array, Q: Array, flat: float = 1e-9) -> Maxima:
        """Candidates for the maximum of b . x + x^T Q x - u . x for any u: b (M, 3), Q (M, 3, 3).

        flat: relative curvature below which a face's maximum is taken on its boundary.
        """
        scale = np.abs(Q).max(axis=(1, 2), initial=0.0)[:, None] + 1e-300
        start = self.corners
        answer, there = np.zeros((len(b), len(self.foot), 3, 3)), np.zeros((len(b), len(self.foot)), dtype=bool)
        there[:, :start] = True
        for basis in self.basis:
            faces = slice(start, start + len(basis))
            start += len(basis)
            curvature = np.einsum("fia,mij,fjb->mfab", basis, Q, basis, optimize=True)
            concave = np.linalg.eigvalsh(curvature)[..., -1] < -flat * scale
            inverse = np.linalg.inv(np.where(concave[..., None, None], 2 * curvature, -np.eye(basis.shape[2])))
            answer[:, faces] = np.einsum("fia,mfab,fjb->mfij", basis, inverse, basis, optimize=True)
            there[:, faces] = concave
        slope = 2 * np.einsum("mij,fj->mfi", Q, self.foot) + b[:, None]
        return Maxima(self, b, Q, answer, there, self.foot - np.einsum("mfij,mfj->mfi", answer, slope))


@dataclass(frozen=True, eq=False)
class Maxima:
    """Candidates for the maxima of M quadratics minus u . x over a hull: points x = stationary + answer u, one of each
    face. there (M, F): whether the quadratic is concave on the face."""

    hull: Hull
    b: Array
    Q: Array
    answer: Array
    there: Mask
    stationary: Array

    def at(self, u: Array) -> tuple[Array, Array]:
        """The maximum (M,) over the hull of b . x + x^T Q x - u . x, and its point (M, 3)."""
        x = self.stationary + np.einsum("mfij,mj->mfi", self.answer, u)
        inside = np.all(x @ self.hull.normal.T <= self.hull.offset + 1e-9, axis=2)
        value = np.sum(x * ((self.b - u)[:, None] + np.matmul(x, self.Q)), axis=2)
        value[~(self.there & inside)] = -np.inf
        best, row = np.argmax(value, axis=1), np.arange(len(u))
        return value[row, best], x[row, best]

    def only(self, rows: Mask) -> Maxima:
        """The candidates of some of the quadratics."""
        b, Q, answer, there = self.b[rows], self.Q[rows], self.answer[rows], self.there[rows]
        return Maxima(self.hull, b, Q, answer, there, self.stationary[rows])


def largest_mean(hull: Hull, mean: Array, b: Array, Q: Array, enough: Array | None = None) -> tuple[Array, Array]:
    """Upper bounds (M,) of E[b . x + x^T Q x] over all distributions in a hull with |E x| <= mean (3,).

    Also returns moments (M, 9) (E x, then xx, xy, yy, xz, yz, zz) that nearly attain them. b (M, 3), Q (M, 3, 3); x is
    in metres; the origin lies in the hull. enough: (M,) values below which bounds need not be improved.
    """
    values, moments = np.empty(len(b)), np.empty((len(b), 9))
    half, centre = hull.half, hull.centre
    shifted = b + 2 * Q @ centre
    constant = b @ centre + np.einsum("i,mij,j->m", centre, Q, centre)
    goal = np.full(len(b), -np.inf) if enough is None else enough - constant
    for start in range(0, len(b), MOMENT_SEARCH.rows):
        part = slice(start, start + MOMENT_SEARCH.rows)
        scaled = shifted[part] * half, Q[part] * np.outer(half, half)
        found = _search(hull, mean / half, -centre / half, *scaled, goal[part])
        values[part] = found[0] + constant[part]
        x = found[1] * half + centre
        moments[part, :3] = np.einsum("mp,mpi->mi", found[2], x)
        moments[part, 3:] = inertia_entries(np.einsum("mp,mpi,mpj->mij", found[2], x, x))
    return values, moments


def _search(hull: Hull, mean: Array, origin: Array, b: Array, Q: Array, enough: Array) -> tuple[Array, Array, Array]:
    """`largest_mean` in the hull's units, |E x - origin| <= mean: bounds, points (M, 4, 3) and their shares (M, 4).

    A column of the mixture is a point x of the hull with a corner e of the box of means; the shares satisfy
    sum of share (x - e) = 0.
    """
    count = len(b)
    size = np.abs(Q).sum(axis=(1, 2)) + 1e-12
    start = origin + np.sign(b) * mean
    start = np.where(np.all(start @ hull.normal.T <= hull.offset, axis=1)[:, None], start, origin)
    points = np.repeat(start[:, None], 4, axis=1)
    points[:, 1:] -= 0.5 * np.where(start >= 0, 1.0, -1.0)[:, None] * np.eye(3)
    cost = np.sum(points * (b[:, None] + np.matmul(points, Q)), axis=2)
    cost[:, 1:] -= 10 * (size + np.abs(b).sum(axis=1))[:, None]  # artificial points, which leave at once
    columns = np.ones((count, 4, 4))
    columns[:, :3] = np.swapaxes(points - start[:, None], 1, 2)
    bounds, shares = np.full(count, np.inf), np.zeros((count, 4))
    left, maxima = np.arange(count), hull.maxima(b, Q)
    for _ in range(MOMENT_SEARCH.steps):
        inverse = np.linalg.inv(columns[left])
        price = np.einsum("mpi,mp->mi", inverse, cost[left])
        u = price[:, :3]
        top, x = maxima.at(u)
        e = origin + np.where(u >= 0, mean, -mean)
        bound = top + np.sum(u * e, axis=1)
        bounds[left] = np.minimum(bounds[left], bound)
        entering = np.concatenate([x - e, np.ones((len(left), 1))], axis=1)
        share, along = np.maximum(inverse[:, :, 3], 0.0), np.einsum("mpi,mi->mp", inverse, entering)
        shares[left] = share
        pivots = along > MOMENT_SEARCH.pivot * np.abs(along).max(axis=1, keepdims=True)
        apart = bounds[left] - price[:, 3] > MOMENT_SEARCH.gap * size[left]
        open_ = apart & pivots.any(axis=1) & (bounds[left] > enough[left])
        if not open_.any():
            break
        ratio = np.where(pivots, share / np.where(pivots, along, 1.0), np.inf)
        leaving = np.argmin(ratio, axis=1)
        going, out = left[open_], leaving[open_]
        columns[going, :, out] = entering[open_]
        points[going, out] = x[open_]
        cost[going, out] = (bound - np.sum(u * (e - x), axis=1))[open_]
        left, maxima = going, maxima.only(open_)
    return bounds, points, shares / shares.sum(axis=1, keepdims=True)


# (6, 6) from second moments (xx, xy, yy, xz, yz, zz) to inertia entries about the same point: tr(S) 1 - S
INERTIA_OF_MOMENTS = np.stack([inertia_entries(np.trace(m) * np.eye(3) - m) for m in inertia_matrix(np.eye(6))], axis=1)


def moments_of_inertia(inertia: Array) -> Array:
    """The six second moments of an inertia (3, 3), about the same point."""
    return inertia_entries(0.5 * np.trace(inertia) * np.eye(3) - inertia)


def most_second_moments(points: Array, mean: Array) -> Array:
    """Largest |E x_i x_j| (6,) of distributions within the bounding box of points (n, 3) with |E x| <= mean."""
    low, high = points.min(axis=0), points.max(axis=0)
    # (x - low)(high - x) >= 0 for each of its points.
    square = np.maximum(0.0, np.abs(low + high) * np.minimum(mean, np.maximum(-low, high)) - low * high)
    return np.array([np.sqrt(square[i] * square[j]) for i, j in PAIRS])


def inertia_ranges(points: Array, mean: Array, mass: float, nominal: Array) -> Array:
    """Half-ranges (6,), around nominal entries, of the inertia about the centre of mass of any distribution of a mass,
    kg, within the bounding box of points (n, 3) in B, with |E x| <= mean."""
    low, high = points.min(axis=0), points.max(axis=0)
    middle = np.clip(0.5 * (low + high), -mean, mean)
    variance = np.maximum((high - middle) * (middle - low), 0.0)  # Bhatia and Davis 2000
    most = mass * np.array(
        [variance.sum() - variance[i] if i == j else np.sqrt(variance[i] * variance[j]) for i, j in PAIRS]
    )
    return np.where([i == j for i, j in PAIRS], np.maximum(most - nominal, nominal), most + np.abs(nominal))


@dataclass(frozen=True, eq=False)
class Filling:
    """The contribution of one body with unknown contents to n rows.

    hull, mean: see `largest_mean`. rows: (9, n, 12) change of the rows per unit of each moment: E x and the six second
    moments about the origin of B, per mass. nominal: (n, 9) moments that the nominal rows contain. moved: n_q
    parameters that act through the moments, in half-ranges: each is per (n_q, n, 9) times the moments, minus less
    (n_q,).
    """

    hull: Hull
    mean: Array
    rows: Array
    nominal: Array
    moved: tuple[Parameter, ...]
    per: Array
    less: Array

    @classmethod
    def joined(cls, parts: Sequence[Filling]) -> Filling:
        """The rows of several fillings of one body together."""
        stacked = [np.concatenate([getattr(p, name) for p in parts], axis=1) for name in ("rows", "per")]
        nominal, less = np.concatenate([p.nominal for p in parts]), parts[0].less
        return replace(parts[0], rows=stacked[0], nominal=nominal, per=stacked[1], less=less)

    def only(self, rows: Indices | list[int]) -> Self:
        """The contribution to some of the rows."""
        return replace(self, rows=self.rows[:, rows], nominal=self.nominal[rows], per=self.per[:, rows])

    def mapped(self, change: Callable[[Array], Array]) -> Self:
        """A copy with rows (9, n, 12) replaced by change(rows)."""
        return replace(self, rows=change(self.rows))

    def coefficients(self, w: Array) -> Array:
        """Coefficients (T, n, 9) of the moments at w (T, 12)."""
        return np.moveaxis(np.tensordot(w, self.rows, axes=(1, 2)), 1, 2)

    def limits(self, of: Array) -> tuple[Array, Array]:
        """Cheap lower and upper bounds of the largest contribution with coefficients (..., 9)."""
        first, second = of[..., :3], of[..., 3:]
        corner = np.where(first >= 0, self.mean, -self.mean)
        products = np.stack([corner[..., i] * corner[..., j] for i, j in PAIRS], axis=-1)
        sure = np.sum(np.abs(first) * self.mean, axis=-1)
        squares = [k for k, (i, j) in enumerate(PAIRS) if i == j]
        most = np.abs(second) * self._most
        most[..., squares] = np.maximum(second[..., squares], 0.0) * self._most[squares]
        inside = np.all(corner @ (self.hull.normal / self.hull.half).T <= self._reach, axis=-1)
        at_corner = sure + np.sum(second * products, axis=-1)
        return np.where(inside, at_corner, 0.0), sure + most.sum(axis=-1)

    def largest(self, of: Array, enough: Array | None = None) -> tuple[Array, Array]:
        """The largest contribution (M,) with coefficients (M, 9), and moments (M, 9) that nearly attain it; see
        `largest_mean`."""
        Q = inertia_matrix(of[:, 3:])
        Q[:, ~np.eye(3, dtype=bool)] *= 0.5
        return largest_mean(self.hull, self.mean, of[:, :3], Q, enough)

    @property
    def farthest(self) -> Array:
        """Largest deviation (9,) of each moment from its nominal value."""
        return np.concatenate([self.mean, self._most]) + np.abs(self.nominal).max(axis=0)

    @property
    def _reach(self) -> Array:
        return self.hull.offset + self.hull.normal @ (self.hull.centre / self.hull.half)

    @property
    def _most(self) -> Array:
        return most_second_moments(self.hull.centre + np.array([[-1], [1]]) * self.hull.half, self.mean)
