"""Inertial parameters that an object of a given shape can have.

Mass, centre of mass and inertia are the moments of order 0, 1, 2 of a mass distribution. Every distribution has
mass > 0 and positive second moments (which implies the triangle inequality of the principal moments; Traversaro et
al. 2016, Wensing et al. 2018). For one that lies within the shape's convex hull, and any two faces with distances
h_i(x), h_j(x) >= 0 inside, also the mean of h_i h_j is not negative (moment conditions of order one; Heins and
Schoellig, "Robust Nonprehensile Object Transportation with Uncertain Inertial Parameters", 2025). These conditions are
necessary; the tests count how far they are from sufficient.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from salver.geometry import Array, Mask
from salver.models.rigid_body import inertia_entries, inertia_matrix
from salver.models.shapes.hulls import polytope

if TYPE_CHECKING:
    from salver.models.bodies import Body

_TOLERANCE = 1e-9  # relative to the size of the shape


def _pseudo_inertia(phi: Array) -> Array:
    """Pseudo-inertia (4, 4), the mass moments of order 0, 1, 2 of (x, 1), linear in phi (10,)."""
    inertia = inertia_matrix(phi[4:])
    second = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    return np.block([[second, phi[1:4, None]], [phi[None, 1:4], phi[:1, None]]])


_PSEUDO = np.stack([_pseudo_inertia(unit) for unit in np.eye(10)])


def hull_faces(body: Body) -> Array:
    """Half-spaces (k, 4), n . x + d <= 0, of the shape's convex hull in B, with unit vectors n."""
    hull = polytope(body.points_B)
    return np.column_stack([hull.normal, -hull.offset])


def second_moments(values: Array) -> Array:
    """Second moments (n, 3, 3) per mass about the centre of mass, from values (n, 10) of `parameters.INERTIAL`."""
    inertia = inertia_matrix(values[:, 4:]) / values[:, 0, None, None]
    return 0.5 * np.trace(inertia, axis1=1, axis2=2)[:, None, None] * np.eye(3) - inertia


def realisable(body: Body, values: npt.ArrayLike, *, within_shape: bool = True) -> Mask:
    """Whether a mass distribution can have each of the values (n, 10) of `parameters.INERTIAL`, in B.

    within_shape: the distribution must lie within the shape's convex hull (necessary conditions, see above); otherwise
    only the centre of mass must, and the inertia must be that of some distribution.
    """
    values = np.atleast_2d(np.asarray(values, dtype=float))
    possible = values[:, 0] > 0
    if not possible.any():
        return np.asarray(possible)
    faces = hull_faces(body)
    normal, offset = faces[:, :3], faces[:, 3]
    size = float(np.ptp(body.solid.bounding_points_G, axis=0).max())
    kept = values[possible]
    spread, com = second_moments(kept), kept[:, 1:4]
    fine = np.linalg.eigvalsh(spread)[:, 0] >= -_TOLERANCE * size**2
    inside = com @ normal.T + offset
    fine &= np.all(inside <= _TOLERANCE * size, axis=1)
    if within_shape:
        # mean of (n_i . x + d_i)(n_j . x + d_j) = n_i . spread n_j + inside_i inside_j
        products = normal @ spread @ normal.T + inside[:, :, None] * inside[:, None, :]
        fine &= np.all(products >= -_TOLERANCE * size**2, axis=(1, 2))
    result = np.zeros(len(values), dtype=bool)
    result[possible] = fine
    return result


def nearest(
    body: Body, phi: Array, covariance: Array, *, within_shape: bool = True, rounds: int = 60
) -> tuple[Array, float]:
    """The phi (10,) nearest to a phi with a covariance (10, 10), in B, that a mass distribution can have
    (`realisable`), and its distance in standard deviations.

    All conditions are linear in phi except that the pseudo-inertia J (Wensing, Kim and Slotine 2018) is positive
    semidefinite, which linear cuts v^T J v >= 0 impose, in at most so many rounds (least distance programming: Lawson
    and Hanson 1974).
    """
    from scipy.optimize import nnls

    faces, size = hull_faces(body), float(np.ptp(body.solid.bounding_points_G, axis=0).max())
    first, second = np.triu_indices(len(faces) if within_shape else 0, 1)
    along = np.vstack([np.einsum("ia,kab,ib->ik", faces[first], _PSEUDO, faces[second]), -faces @ _PSEUDO[:, 3].T])
    scale = np.array([size, size, size, 1.0])
    root, z = np.linalg.cholesky(covariance), np.zeros(10)
    cuts = np.zeros((0, 10))
    for _ in range(rounds):
        found = phi + root @ z
        values, vectors = np.linalg.eigh(np.einsum("k,kab->ab", found, _PSEUDO) / np.outer(scale, scale))
        allowed = 0.01 * _TOLERANCE * abs(phi[0])
        short = along @ found < -allowed * size**2
        bent = (vectors[:, values < -allowed] / scale[:, None]).T
        if not short.any() and not len(bent):
            break
        cuts = np.vstack([cuts, along[short], np.einsum("ia,kab,ib->ik", bent, _PSEUDO, bent)])
        rows = cuts @ root
        length = np.linalg.norm(rows, axis=1)
        both = np.column_stack([rows, -cuts @ phi]) / length[:, None]
        left = both.T @ nnls(both.T, np.eye(11)[10])[0] - np.eye(11)[10]
        z = -left[:10] / left[10]
    return phi + root @ z, float(np.linalg.norm(z))


def random_inertia(body: Body, com: Array, rng: np.random.Generator, points: int = 6) -> Array:
    """Inertia (6,) per mass of random point masses within the shape's hull, about their centre of mass com (3,).

    com must lie within the hull. The last mass is placed so that the centre of mass is com.
    """
    faces, corners = hull_faces(body), body.points_B
    x = rng.dirichlet(np.full(len(corners), 1.0 / len(corners)), points) @ corners  # often near a corner
    share = rng.dirichlet(np.ones(points))
    way = com - share @ x
    speed, left = faces[:, :3] @ way, -(faces[:, :3] @ com + faces[:, 3])
    room = float(np.min(left[speed > 1e-12] / speed[speed > 1e-12], initial=1e3))
    far = max(room, 0.0) * rng.uniform(0.2, 1.0)
    away = np.vstack([x, com + far * way]) - com
    weight = np.append(share * far, 1.0) / (1.0 + far)
    second = np.einsum("p,pi,pj->ij", weight, away, away)
    return inertia_entries(np.trace(second) * np.eye(3) - second)
