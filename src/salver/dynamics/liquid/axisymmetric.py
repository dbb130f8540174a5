"""Sloshing modes of an axisymmetric container with a straight wall, upright or conical, by a spectral Galerkin method.

Linear potential flow, azimuthal wave number 1: phi = psi(r, z) cos(theta) in 0 > z > -h below the surface at rest,
whose centre O is the origin. The radius is R(z) = R + t z. A mode makes the quotient of

    K = int |grad phi|^2 dV    and    M = int phi^2 dS over the surface

stationary: K a = kappa M a, omega^2 = g kappa. Its trace f_n on the surface, with int f_n^2 dS = N_n and
lambda_n = int x f_n dS, gives what a cylinder's closed forms give:

    mass rho kappa_n lambda_n^2 / N_n,    rise b_n = lambda_n f_n(R) / N_n,    height z_n = int Psi f_n dS / lambda_n.

Psi is the Stokes-Joukowski potential of the liquid under a lid that turns at 1 rad/s about y: dPsi/dn = z n_x - x n_z
on the whole boundary. int Psi dPsi/dn dS is its moment of inertia about O, over density (Gavrilyuk, Lukovsky and
Timokha, Fluid Dynamics Research 37 (2005) 399; Dodge, The New Dynamic Behavior of Liquids in Moving Containers, 2000).

psi is a polynomial in s = r / R(z), odd in s, and in z. All integrals are polynomial, so Gauss's rule is exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre

from salver.geometry import Array


@dataclass(frozen=True, eq=False)
class Sloshing:
    """Modes 1 to n of the wave number 1, from the lowest. kappa (n,): omega^2 / g, 1/m. volume (n,): mass over density,
    m^3. height, rise (n,): m. inertia: of all the liquid under a lid about O, across the axis, over density, m^5."""

    kappa: Array
    volume: Array
    height: Array
    rise: Array
    inertia: float


def sloshing(radius: float, slope: float, depth: float, count: int, radial: int = 8, axial: int = 8) -> Sloshing:
    """The first modes of a liquid.

    Args:
        radius: R of the surface at rest, m.
        slope: t = dR/dz of the wall; 0 for a cylinder.
        depth: h, m; the radius at the bottom, R - t h, is at least 0.
        count: number of modes, at most `radial`.
        radial: number of polynomials across the container; 8 give the third mode to 1e-7, 6 to 1e-3.
        axial: number of polynomials along the axis, to which three are added for each R of depth; in deep liquids
            fewer, since they are denser near the surface.
    """
    across, along = _across(radial), _along(axial + int(np.ceil(min(3 * depth / radius, 8 * np.sqrt(depth / radius)))))
    q, by_z, weight = along.value, along.slope * 2 / depth, along.weight * depth / 2
    z = 0.5 * depth * (along.place - 1)
    wall = radius + slope * z

    def product(a: Array, b: Array, by: Array | float = 1.0) -> Array:
        return np.asarray((a * (weight * by)[:, None]).T @ b)

    # |grad phi|^2 r dr dz = [psi_s^2 s + psi^2 / s + (R(z) psi_z - t s psi_s)^2 s] ds dz
    even = product(q, q)
    mixed = np.kron(across.mixed, product(by_z, q, wall))
    energy = np.kron(across.flat + slope**2 * across.steep, even) - slope * (mixed + mixed.T)
    energy += np.kron(across.square, product(by_z, by_z, wall**2))
    trace = np.kron(np.eye(radial), np.ones(q.shape[1]))  # polynomials of s on the surface, where those of z are 1
    signs = (-1.0) ** np.arange(q.shape[1])  # polynomials of z at the bottom
    pushed = np.kron(np.ones(radial), q.T @ (weight * wall * (z + slope * wall)))  # by the walls under the lid
    pushed += np.kron(across.lever, (radius - slope * depth) ** 3 * signs - radius**3)
    flow = np.linalg.solve(energy, np.column_stack([trace.T, pushed]))
    at_surface, under_lid = trace @ flow, flow[:, -1]
    root = np.linalg.cholesky(across.square) * radius  # M = root root^T on the surface
    inverse, vectors = np.linalg.eigh(root.T @ at_surface[:, :-1] @ root)
    modes = np.linalg.solve(root.T, vectors[:, : -count - 1 : -1])  # traces with N_n = pi
    kappa = 1 / inverse[: -count - 1 : -1]

    lever = modes.T @ across.lever * radius**3  # lambda_n / pi
    seen = modes.T @ across.square @ at_surface[:, -1] * radius**2  # int Psi f_n dS / pi
    inertia = float(np.pi * pushed @ under_lid)
    return Sloshing(kappa, np.pi * kappa * lever**2, seen / lever, lever * modes.sum(axis=0), inertia)


@dataclass(frozen=True, eq=False)
class _Along:
    """Legendre polynomials and their derivatives (points, n) at Gauss's points from -1 to 1, and the weights."""

    value: Array
    slope: Array
    place: Array
    weight: Array


@lru_cache(maxsize=64)
def _along(count: int) -> _Along:
    place, weight = (np.asarray(x, dtype=float) for x in legendre.leggauss(count + 2))
    slope = np.stack([legendre.legval(place, legendre.legder(row)) for row in np.eye(count)], axis=1)
    return _Along(legendre.legvander(place, count - 1), slope, place, weight)


@dataclass(frozen=True, eq=False)
class _Across:
    """Integrals over s from 0 to 1 of the polynomials p = s P(2 s^2 - 1), which are 1 at the wall: of p'^2 s + p^2 / s
    (flat), p'^2 s^3 (steep), p p' s^2 (mixed), p^2 s (square), each (n, n), and of p s^2 (lever), (n,)."""

    flat: Array
    steep: Array
    mixed: Array
    square: Array
    lever: Array


@lru_cache(maxsize=8)
def _across(count: int) -> _Across:
    place, weight = (np.asarray(x, dtype=float) for x in legendre.leggauss(2 * count + 2))
    s, weight = 0.5 * (place + 1), 0.5 * weight
    even = np.asarray(legendre.legvander(2 * s**2 - 1, count - 1), dtype=float)
    slope = np.stack([legendre.legval(2 * s**2 - 1, legendre.legder(row)) for row in np.eye(count)], axis=1)
    p, by_s = s[:, None] * even, even + 4 * s[:, None] ** 2 * slope

    def integral(a: Array, b: Array, power: int) -> Array:
        return np.asarray((a * (weight * s**power)[:, None]).T @ b)

    flat = integral(by_s, by_s, 1) + integral(p, even, 0)
    return _Across(flat, integral(by_s, by_s, 3), integral(p, by_s, 2), integral(p, p, 1), p.T @ (weight * s**2))
