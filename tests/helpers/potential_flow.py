"""Nonlinear potential flow in an upright container that is pushed about without turning: no pendulum, no small waves.

phi = sum a_j B_j(x, y) cosh(k_j (z + h)) / cosh(k_j h) with the container's own eigenfunctions B_j, which satisfy
Laplace's equation and the walls exactly; the surface eta = sum e_j B_j moves by its kinematic condition and
by Bernoulli's equation at its true place, both in the least-squares sense over points of the surface. Runge-Kutta
of fourth order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import eigh
from scipy.special import jnp_zeros, jv, jvp

from salver.geometry import Array


@dataclass(frozen=True)
class Basis:
    """Eigenfunctions (P, J) at points of the surface, their slopes, wave numbers k (J,), weights (P,), and at the wall
    (Q, J). x, y: (P,), x along the push."""

    value: np.ndarray
    by_x: np.ndarray
    by_y: np.ndarray
    k: np.ndarray
    weight: np.ndarray
    wall: np.ndarray
    x: np.ndarray
    y: np.ndarray


def rectangle(side: float, count: int = 14) -> Basis:
    """Waves along one side."""
    x = side * 0.5 * np.cos((np.arange(4 * count) + 0.5) * np.pi / (4 * count))
    k = np.arange(1, count + 1) * np.pi / side
    at = k * (x[:, None] + side / 2)
    weight = np.sqrt(1 - (2 * x / side) ** 2)  # of Chebyshev points
    ends = np.cos(k * np.array([[0.0], [side]]))
    return Basis(np.cos(at), -k * np.sin(at), np.zeros_like(at), k, weight, ends, x, np.zeros_like(x))


def box(sides: tuple[float, float], angle: float, count: int = 9) -> Basis:
    """Waves along both sides; what pushes along x of the flow pushes at this angle from the first side, rad."""
    at, wave = (np.arange(2 * count) + 0.5) * np.pi / (2 * count), np.arange(count + 1)
    x, y = (g.ravel() for g in np.meshgrid(*(side * 0.5 * np.cos(at) for side in sides)))
    edge = np.linspace(-0.5, 0.5, 9)
    end = np.repeat([-0.5, 0.5], len(edge))
    around = np.hstack([[np.tile(edge, 2), end], [end, np.tile(edge, 2)]])  # of the walls, in sides
    i, j = (g.ravel() for g in np.meshgrid(wave, wave))
    i, j = i[(i + j > 0) & (i + j <= count)], j[(i + j > 0) & (i + j <= count)]
    kx, ky = i * np.pi / sides[0], j * np.pi / sides[1]
    along, across = kx * (x[:, None] + sides[0] / 2), ky * (y[:, None] + sides[1] / 2)
    weight = np.sqrt((1 - (2 * x / sides[0]) ** 2) * (1 - (2 * y / sides[1]) ** 2))  # of Chebyshev points
    wall = np.cos(np.pi * i * (around[0][:, None] + 0.5)) * np.cos(np.pi * j * (around[1][:, None] + 0.5))
    return Basis(
        np.cos(along) * np.cos(across), -kx * np.sin(along) * np.cos(across), -ky * np.cos(along) * np.sin(across),
        np.hypot(kx, ky), weight, wall, np.cos(angle) * x + np.sin(angle) * y, y,
    )  # fmt: skip


def cylinder(radius: float, orders: tuple[int, ...] = (6, 6, 5, 4, 3)) -> Basis:
    """Waves that are mirrored in the plane y = 0; orders: how many of cos(m theta) for each m."""
    r = radius * np.sqrt((np.arange(14) + 0.5) / 14)
    theta = (np.arange(12) + 0.5) * np.pi / 12
    rr, tt = (g.ravel() for g in np.meshgrid(r, theta))
    edge = np.linspace(0, np.pi, 25)
    value, by_r, by_t, k, wall = [], [], [], [], []
    for m, number in enumerate(orders):
        for root in jnp_zeros(m, number):
            kk = root / radius
            scale = jv(m, root)
            k.append(kk)
            value.append(jv(m, kk * rr) * np.cos(m * tt) / scale)
            by_r.append(kk * jvp(m, kk * rr) * np.cos(m * tt) / scale)
            by_t.append(-m * jv(m, kk * rr) * np.sin(m * tt) / scale / rr)
            wall.append(np.cos(m * edge))
    by_r, by_t = np.array(by_r).T, np.array(by_t).T
    c, s = np.cos(tt)[:, None], np.sin(tt)[:, None]
    return Basis(
        np.array(value).T, c * by_r - s * by_t, s * by_r + c * by_t, np.array(k), np.ones(len(rr)), np.array(wall).T,
        rr * np.cos(tt), rr * np.sin(tt),
    )  # fmt: skip


def simulate(
    basis: Basis, depth: float, push: Callable[[float], tuple[float, float]], times: np.ndarray, damping: float = 0.0
) -> np.ndarray:
    """(T,) highest point at the wall at uniform times, m, from rest. push(t): specific force along x and z, m/s^2."""
    k, J = basis.k, len(basis.k)
    still = np.tanh(k * depth)
    omega = np.sqrt(9.81 * k * still)
    ones = np.ones((len(basis.x), 1))
    sqrt_w = np.sqrt(basis.weight)[:, None]
    project = np.linalg.pinv(sqrt_w * np.hstack([basis.value, ones]))

    def rates(t: float, state: np.ndarray) -> np.ndarray:
        e, a = state[:J], state[J:]
        eta = basis.value @ e
        up = np.exp(k * eta[:, None])
        # cosh(k (eta + h)) / cosh(k h) and sinh(k (eta + h)) / cosh(k h), without large numbers
        cosh = 0.5 * (up * (1 + still) + (1 - still) / up)
        sinh = 0.5 * (up * (1 + still) - (1 - still) / up)
        u, v = (basis.by_x * cosh) @ a, (basis.by_y * cosh) @ a
        w = (basis.value * k * sinh) @ a
        risen = w - u * (basis.by_x @ e) - v * (basis.by_y @ e)
        fx, fz = push(t)
        bernoulli = -0.5 * (u**2 + v**2 + w**2) - fz * eta - fx * basis.x
        matrix = sqrt_w * np.hstack([basis.value * cosh, ones])
        normal = matrix.T @ matrix + 1e-12 * np.eye(J + 1)
        pushed = np.linalg.solve(normal, matrix.T @ (sqrt_w[:, 0] * bernoulli))[:J]
        return np.concatenate([(project @ (sqrt_w[:, 0] * risen))[:J], pushed - 2 * damping * omega * a])

    state, out = np.zeros(2 * J), np.zeros(len(times))
    for i in range(len(times) - 1):
        state = _later(rates, times[i], times[i + 1] - times[i], state)
        out[i + 1] = np.max(basis.wall @ state[:J])
    return out


def _later(rates: Callable[[float, Array], Array], t: float, dt: float, state: Array) -> Array:
    """The state after a step of Runge and Kutta's method of order 4."""
    one = rates(t, state)
    two = rates(t + dt / 2, state + dt / 2 * one)
    three = rates(t + dt / 2, state + dt / 2 * two)
    four = rates(t + dt, state + dt * three)
    return np.asarray(state + dt / 6 * (one + 2 * two + 2 * three + four))


@dataclass(frozen=True)
class Cone:
    """Flow in a cone of half-angle `lean`, rad, whose surface at rest is `level` over the apex, m, and whose bottom is
    a part of a sphere around it at `bottom` times that distance.

    With R the distance from the apex, phi = sum a_j B_j(theta, angle) (s^nu_j + c_j s^(-1 - nu_j)), s = R / level, and
    Legendre functions B_j of degree nu_j that satisfy the wall; points (P,) of the surface at polar angle theta and
    around it; B (P, J), its slopes by both angles, and at the wall (Q, J), at angles (Q,).
    """

    lean: float
    level: float
    bottom: float
    theta: np.ndarray
    around: np.ndarray
    nu: np.ndarray
    value: np.ndarray
    by_theta: np.ndarray
    by_around: np.ndarray
    wall: np.ndarray


def cone(lean: float, level: float, bottom: float, orders: tuple[int, ...] = (6, 6, 5, 4, 3)) -> Cone:
    """Waves that are mirrored in the plane y = 0, as in `cylinder`."""
    tilt = np.arctan(np.tan(lean) * np.sqrt((np.arange(14) + 0.5) / 14))
    theta, around = (g.ravel() for g in np.meshgrid(tilt, (np.arange(12) + 0.5) * np.pi / 12))
    edge = np.linspace(0, np.pi, 25)

    x, w = legendre.leggauss(60)
    x, w = 0.5 * lean * (x + 1), 0.5 * lean * w
    found, value, by_theta, by_around, wall = [], [], [], [], []
    for m, number in enumerate(orders):
        # Legendre's equation, weakly: int (sin B'^2 + m^2 / sin B^2) = nu (nu + 1) int sin B^2, B' = 0 at the wall.
        p, dp = _odd_or_even(m, x / lean, lean)
        weight = (w * np.sin(x))[:, None]
        energy = (dp * weight).T @ dp + m**2 * (p * w[:, None] / np.sin(x)[:, None]).T @ p
        values, vectors = eigh(energy, (p * weight).T @ p)
        first = int(m == 0)  # the level itself
        vectors, values = vectors[:, first : first + number], values[first : first + number]
        vectors = vectors / vectors.sum(axis=0)  # the polynomials are 1 at the wall
        p, dp = _odd_or_even(m, theta / lean, lean)
        found += (np.sqrt(values + 0.25) - 0.5).tolist()
        value += list((p @ vectors).T * np.cos(m * around))
        by_theta += list((dp @ vectors).T * np.cos(m * around))
        by_around += list((p @ vectors).T * -m * np.sin(m * around))
        wall += number * [np.cos(m * edge)]
    return Cone(
        lean, level, bottom, theta, around, np.array(found), np.array(value).T, np.array(by_theta).T,
        np.array(by_around).T, np.array(wall).T,
    )  # fmt: skip


def _odd_or_even(m: int, s: np.ndarray, lean: float, count: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Polynomials (n, count) s^m P_k(2 s^2 - 1) and their derivatives by the angle s times `lean`."""
    x = 2 * s**2 - 1
    even = legendre.legvander(x, count - 1)
    slope = np.stack([legendre.legval(x, legendre.legder(row)) for row in np.eye(count)], axis=1)
    power, less = (s**m)[:, None], (m * s ** max(m - 1, 0))[:, None]
    return power * even, (less * even + power * slope * 4 * s[:, None]) / lean


def simulate_cone(
    basis: Cone,
    push: Callable[[float], tuple[float, float]],
    times: np.ndarray,
    damping: float = 0.0,
    begin: np.ndarray | None = None,
) -> np.ndarray:
    """(T,) as `simulate`. begin: (J,) first potential at the surface, of each B_j."""
    nu, J, theta = basis.nu, len(basis.nu), basis.theta
    sine, cosine = np.sin(theta), np.cos(theta)
    image = nu / (nu + 1) * basis.bottom ** (2 * nu + 1)  # c: no flow through the bottom
    ones = np.ones((len(theta), 1))
    project = np.linalg.pinv(np.hstack([basis.value, ones]))
    still = basis.level / cosine
    omega = np.sqrt(9.81 / basis.level * (nu - (nu + 1) * image) / (1 + image))

    def rates(t: float, state: np.ndarray) -> np.ndarray:
        e, a = state[: J + 1], state[J + 1 :]
        R = still + basis.value @ e[:J] + e[J]
        s = (R / basis.level)[:, None]
        out, back = s**nu, image * s ** (-1 - nu)
        shape = (out + back) / (1 + image)
        radial = (basis.value * (nu * out - (nu + 1) * back) / (1 + image)) @ a / R
        aside, around = (basis.by_theta * shape) @ a / R, (basis.by_around * shape) @ a / (R * sine)
        R_theta = basis.level * sine / cosine**2 + basis.by_theta @ e[:J]
        risen = radial - aside * R_theta / R - around * (basis.by_around @ e[:J]) / (R * sine)
        fx, fz = push(t)
        bernoulli = -0.5 * (radial**2 + aside**2 + around**2)
        bernoulli -= fz * (R * cosine - basis.level) + fx * R * sine * np.cos(basis.around)
        matrix = np.hstack([basis.value * shape, ones])
        normal = matrix.T @ matrix + 1e-12 * np.eye(J + 1)
        pushed = np.linalg.solve(normal, matrix.T @ bernoulli)[:J]
        return np.concatenate([project @ risen, pushed - 2 * damping * omega * a])

    state, out = np.zeros(2 * J + 1), np.zeros(len(times))
    if begin is not None:
        state[J + 1 :] = begin
    for i in range(len(times) - 1):
        state = _later(rates, times[i], times[i + 1] - times[i], state)
        R = basis.level / np.cos(basis.lean) + basis.wall @ state[:J] + state[J]
        out[i + 1] = np.max(R) * np.cos(basis.lean) - basis.level
    return out
