"""Modes of load dynamics along a motion of the tray.

The modes of `salver.models.load_dynamics` are second-order filters (`salver.linear_filter`), driven by the lateral
specific force at each mode's height, with a stiffness that depends on the vertical one. They are linear in the drive,
so the effect of small changes of the motion goes through the same filters. All cases of a load are computed together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np

from salver.dynamics.load_cases import LoadCase, ModalCases
from salver.dynamics.modal_state import ModalState
from salver.geometry import GRAVITY, Array, Indices
from salver.linear_filter import LinearFilter
from salver.models.load_dynamics import LEAST_WEIGHT
from salver.models.tray_motion import N_MOTION

TURNING = np.zeros(N_MOTION)
TURNING[[6, 8]] = 1.0  # omega_x^2 + omega_y^2: the same in every frame whose z is the tray's


def _upward(which: ModalCases, w: Array) -> Array:
    """Vertical specific force (K, T), which sets the stiffness of the modes."""
    return np.maximum((w @ which.at_O[:, 2, :, None])[..., 0], LEAST_WEIGHT * GRAVITY)


def _spin(which: ModalCases, turning: LinearFilter, w: Array, start: ModalState | None) -> Array:
    """Rotation (K, T) of the container about its axis since the beginning, rad."""
    if not which.round:
        return np.zeros(w.shape[:2])
    return _turning(turning, w, start)[0]


def _turning(turning: LinearFilter, w: Array, start: ModalState | None) -> tuple[Array, Array]:
    """Rotation (K, T) of the container about its axis, rad, and its rate, rad/s."""
    if w.strides[0] == 0 and start is None:  # the same for all cases
        angle, rate = (np.broadcast_to(x, w.shape[:2]) for x in turning.respond(w[0, :, 5]))
        return angle, rate
    begun = None if start is None else np.stack([start.spin, start.turning])
    angle, rate = turning.respond(w[:, :, 5].T, begun)
    return angle.T, rate.T


def _at_modes(which: ModalCases, w: Array, spin: Array) -> Array:
    """Lateral specific force (K, T, n_modes, 2) at each mode, along axes that do not rotate with the container."""
    K, n = which.at_mode.shape[:2]
    felt = (w @ np.swapaxes(which.at_mode.reshape(K, 2 * n, N_MOTION), 1, 2)).reshape(K, -1, n, 2)
    return turned(felt, spin[..., None])


@dataclass(frozen=True, eq=False)
class ModalMotion:
    """K cases of inner dynamics along a motion of T nodes.

    Lateral vectors have two components. In a round body, whose walls do not drag the masses along, they are in the axes
    that the body had at the beginning, which do not rotate with it.
    filters: (K, n_modes, axes), a single one for both axes of a round body. turning: filter from the angular
    acceleration about the axis to the angle, `spin` (K, T), rad. w (K, T, 12): the tray's motion regressor. upward
    (K, T): vertical specific force, which sets the stiffness. at_modes: lateral specific force at each mode; r, rate,
    second: position (m), velocity and acceleration of each moving mass; (K, T, n_modes, 2). start: initial states, None
    for rest.
    """

    cases_type: ClassVar[type[ModalCases]] = ModalCases
    iterations: ClassVar[int] = 24  # largest number, in which waves along both sides of a box interact
    settled: ClassVar[float] = 1e-3  # largest change, as a share of the waves, after which they end
    cases: ModalCases
    t: Array
    filters: LinearFilter
    turning: LinearFilter
    w: Array
    upward: Array
    spin: Array
    at_modes: Array
    r: Array
    rate: Array
    second: Array
    start: ModalState | None = None

    @classmethod
    def along(cls, several: Sequence[LoadCase], t: Array, w: Array, start: ModalState | None = None) -> Self:
        """The modes of `alike` cases along the tray's motion regressor w (T, 12) at t (T,). start: initial states, at
        rest unless given."""
        which = cls.cases_type.of(tuple(several))
        felt = np.broadcast_to(w, (len(several), *w.shape))
        upward = _upward(which, felt)
        axes = 1 if which.round else 2
        kp, kd = which.omega[..., :axes] ** 2, which.kd[..., :axes]
        extra = kp[..., None] * (upward / GRAVITY - 1)[:, None, None]
        filters = LinearFilter.stiffened(t, kp, kd, extra)
        turning = LinearFilter.on_nodes(t, 0.0, 0.0, 3)
        spin = _spin(which, turning, felt, start)
        at_modes = _at_modes(which, felt, spin)
        begun = cls(which, t, filters, turning, felt, upward, spin, at_modes, at_modes, at_modes, at_modes, start)
        force = at_modes[..., None]
        first = (begun.level(force), None) if start is None else (start.r[..., None], start.rate[..., None])
        return begun.moved(*(x[..., 0] for x in begun.respond(force, *first)))

    def moved(self, r: Array, rate: Array, second: Array) -> Self:
        """The modes with other positions, velocities and accelerations of the masses."""
        return replace(self, r=r, rate=rate, second=second)

    def part(self, some: slice) -> Self:
        """Some of the cases."""
        which, filters = type(self.cases).of(self.cases.each[some]), self.filters.only((some,))
        names = ("w", "upward", "spin", "at_modes", "r", "rate", "second")
        start = None if self.start is None else self.start.part(some)
        felt = {name: getattr(self, name)[some] for name in names}
        return replace(self, cases=which, filters=filters, start=start, **felt)

    def shifted(self, dw: Array, start: ModalState | None = None) -> Self:
        """The modes for w + dw (K, T, 12), to first order in dw, which is zero before the motion. start: initial
        states, if not at rest."""
        begun = None
        if start is not None:
            assert self.start is not None
            begun = start.since(self.start)
        w, change = self.w + dw, self.pushed(dw[..., None], before=False, start=begun)
        spin = _spin(self.cases, self.turning, w, start)
        at_modes = _at_modes(self.cases, w, spin)
        other = replace(self, w=w, upward=_upward(self.cases, w), spin=spin, at_modes=at_modes, start=start)
        return other.moved(*(x + dx[..., 0] for x, dx in zip((self.r, self.rate, self.second), change, strict=True)))

    @cached_property
    def turns(self) -> Array:
        """Angular velocity (K, T) of the container about its axis, rad/s."""
        return _turning(self.turning, self.w, self.start)[1]

    @cached_property
    def walls(self) -> tuple[Array, Array, Array] | None:
        """Coupling of the waves in a box that rotates about its vertical axis: force on each mass per mass, as factors
        (K, T, n_modes, 2) of r' and r along the other side, and of r along the same side. None without rotation.

        Relative to the box, an inviscid liquid flows backwards along the walls and carries its waves at C times the
        angular velocity Omega for the first mode, C = 16 x y / (pi^2 (x^2 + y^2)) with sides x and y: 0.81 in a square
        box, 1 in a cylinder, where liquid and waves do not rotate. So waves along one side drive those along the other,
        eta_x'' = ... + C Omega (1 + k_x / k_y) eta_y' + C Omega' eta_y + C^2 Omega^2 k_x / k_y eta_x, where k is the
        square of each frequency, and with the other sign along y.
        """
        if self.cases.round or not self.turns.any():
            return None
        by_rate, by_place, own = self.cases.carried
        turns, faster = self.turns[:, :, None, None], self.w[:, :, 5, None, None]
        return turns * by_rate, faster * by_place, turns**2 * own

    @cached_property
    def pushed_by_turning(self) -> tuple[Array, Array]:
        """Derivatives (K, T, n_modes, 2) of the forces of `walls` by the angular velocity `turns` and by its rate."""
        by_rate, by_place, own = self.cases.carried
        turned = by_rate * self.rate[..., ::-1] + 2 * self.turns[..., None, None] * own * self.r
        return turned, by_place * self.r[..., ::-1]

    def _taken_along(self, drive: Array, begin: Array | None) -> tuple[Array, tuple[Array, Array] | None]:
        """Drives, from first states, of the filters, with what the walls take along of the waves that they make: by
        iteration. And the answer of the filters, if it is known."""
        if self.walls is None or not drive.size:
            return drive, None
        found, before = drive, np.zeros(1)
        by_rate, by_place, own = (x.transpose(0, 2, 3, 1)[..., None] for x in self.walls)
        for _ in range(self.iterations):
            r, rate = self.filters.respond(found, begin)
            if np.abs(r - before).max() < self.settled * np.abs(r).max():
                return found, (r, rate)
            found = drive + by_rate * rate[:, :, ::-1]
            found += by_place * r[:, :, ::-1]
            found += own * r
            before = r
        return found, None

    @cached_property
    def force(self) -> Array:
        """Specific force (K, T, 3) at the centre of the surface, in the container's axes."""
        return self.w @ np.swapaxes(self.cases.at_O, 1, 2)

    def respond(
        self, force: Array, start: Array | None = None, rate: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """r, r' and r'' (K, T, n_modes, 2, c) to lateral specific forces (K, T, n_modes, 2, c) at the modes. start,
        rate: (K, n_modes, 2, c) r and r' at the first node, 0 unless given."""
        begin = None
        if start is not None:
            begin = self._by_filter(np.stack([start, np.zeros_like(start) if rate is None else rate], axis=1))
        return self._answer(self._by_filter(-force), begin)

    def _answer(self, drive: Array, begin: Array | None) -> tuple[Array, Array, Array]:
        """r, r' and r'' (K, T, n_modes, 2, c) to drives, and first states, of the filters."""
        drive, known = self._taken_along(drive, begin)
        x, rate = known or self.filters.respond(drive, begin)
        second = self.filters.acceleration(drive, x, rate)
        return self._by_mode(x), self._by_mode(rate), self._by_mode(second)

    def _by_filter(self, x: Array) -> Array:
        """(K, T, n_modes, 2, c) to (K, n_modes, axes, T, 2 c / axes)."""
        K, T, n = x.shape[:3]
        return np.ascontiguousarray(x.reshape(K, T, n, self.filters.gain.shape[2], -1).transpose(0, 2, 3, 1, 4))

    def _by_mode(self, x: Array) -> Array:
        """Back from `_by_filter`."""
        K, n, _, T = x.shape[:4]
        return x.transpose(0, 3, 1, 2, 4).reshape(K, T, n, 2, -1)

    def level(self, force: Array) -> Array:
        """(K, n_modes, 2, c) r where a motion begins: the surface is level, whatever the tray is."""
        softer = (GRAVITY / self.upward[:, 0])[:, None, None, None]
        return np.asarray(-force[:, 0] / self.cases.omega[..., None] ** 2 * softer)

    def _level(self, drive: Array) -> Array:
        """First states of drives of the filters: (K, n_modes, axes, 2, 2 c / axes)."""
        stiffness = np.asarray(self.filters.kp)[..., :1]
        return np.stack([drive[:, :, :, 0] / stiffness, np.zeros_like(drive[:, :, :, 0])], axis=3)

    def pushed(
        self, dw: Array, before: bool, start: ModalState | None = None, spun: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """First-order changes of r, r' and r'' (K, T, n_modes, 2, c) by changes dw (K or 1, T, 12, c) of the tray's
        motion regressor: by lateral force, stiffness and rotation. before: whether the changes exist before the motion
        too. start: their effect up to then, if the modes do not begin at rest. spun: result of `spun`, if known."""
        drive = self._driven(dw, self.spun(dw, start) if spun is None else spun)
        begin = self._level(drive) if before else None
        if start is not None:
            places, speeds = (x.reshape(*x.shape[:3], -1) for x in (start.r, start.rate))
            begin = self._by_filter(np.stack([places, speeds], axis=1))
        return self._answer(drive, begin)

    def _driven(self, dw: Array, spun: Array) -> Array:
        """Changes (K, n_modes, axes, T, 2 c / axes) of the filters' drives by changes dw (K or 1, T, 12, c); spun: as
        of `spun`."""
        moved = np.concatenate([dw, spun[:, :, None]], axis=2)
        drive = self._drive_map @ moved[:, None, None]
        return np.asarray(drive.reshape(*drive.shape[:4], -1))

    @cached_property
    def _drive_map(self) -> Array:
        """Linear map (K, n_modes, axes, T, 2 / axes, 13) from the tray's motion regressor, and `spun`, to the filters'
        drives."""
        which, (K, T, n, _) = self.cases, self.r.shape
        c, s = (f(self.spin)[:, :, None, None] for f in (np.cos, np.sin))
        x, y = which.at_mode[:, None, :, 0], which.at_mode[:, None, :, 1]
        found = np.empty((K, T, n, 2, N_MOTION + 1))
        found[..., 0, :N_MOTION], found[..., 1, :N_MOTION] = c * x - s * y, s * x + c * y
        stiffer = which.omega[:, None] ** 2 / GRAVITY * self.r
        found[..., :N_MOTION] += stiffer[..., None] * which.at_O[:, None, None, None, 2]
        if which.round:
            found[..., N_MOTION] = across(self.at_modes)
        else:
            found[..., N_MOTION], by_faster = (-x for x in self.pushed_by_turning)
            found[..., 5] += by_faster
        axes = self.filters.gain.shape[2]
        by_filter = found.reshape(K, T, n, axes, 2 // axes, -1).transpose(0, 2, 3, 1, 4, 5)
        return np.negative(by_filter, order="C")

    def spun(self, dw: Array, start: ModalState | None = None) -> Array:
        """Changes (K or 1, T, c) of `spin`, or of `turns` for a box, by changes dw (K or 1, T, 12, c); equal for all
        `alike` cases. start: as in `turned_by`."""
        return self.turned_by(dw, start)[0 if self.cases.round else 1]

    def turned_by(self, dw: Array, start: ModalState | None = None) -> tuple[Array, Array]:
        """Changes (K or 1, T, c) of `spin` and of `turns` by changes dw (K or 1, T, 12, c). start: their effect up to
        the beginning, zero unless given."""
        drive, begun = dw[:, :, 5].swapaxes(0, 1), None
        if start is not None:
            drive = np.broadcast_to(drive, (len(drive), len(start.spin), drive.shape[2]))
            begun = np.stack([x.reshape(len(x), -1) for x in (start.spin, start.turning)])
        angle, rate = self.turning.respond(drive, begun)
        return angle.swapaxes(0, 1), rate.swapaxes(0, 1)

    @cached_property
    def ending(self) -> tuple[Array, Array]:
        """Displacement of each mass from its equilibrium at the end, and its velocity divided by the frequency, both
        (K, n_modes, 2), m."""
        omega, softer = self.cases.omega, (GRAVITY / self.upward[:, -1])[:, None, None]
        rest = self.at_modes[:, -1] / omega**2 * softer
        return self.r[:, -1] + rest, self.rate[:, -1] / omega * np.sqrt(softer)

    @cached_property
    def slope(self) -> Array:
        """Slope f / f_z (K, T, 2): inclination at equilibrium of a hanging mass or a surface under the specific
        force."""
        return turned(self.force[..., :2] / self.upward[..., None], self.spin)

    @property
    def seen(self) -> Array:
        """Displacements (K, T, 3), m, in the body's axes, that pictures and charts show (`LoadDynamics.seen`)."""
        own, still = turned(self.r, -self.spin[..., None]), np.zeros(len(self.t))
        slope = turned(self.slope, -self.spin)
        lengths = [case.modes.length for case in self.cases.each]
        each = zip(self.cases.each, own, lengths, slope, strict=True)
        return np.stack([case.dynamics.seen(case.value, r / length, s, still) for case, r, length, s in each])

    @property
    def height(self) -> Array:
        """Largest displacement (K, T), m, which is carried over from one motion to the next."""
        return np.linalg.norm(self.r, axis=-1).max(axis=2)

    @cached_property
    def peak(self) -> tuple[Indices, Array]:
        """Instant (K,) at which `height` is largest during the motion, and the peak (K,), m, the one before the motion
        if that was larger: it determines how far the phase can have drifted."""
        heights = self.height
        k = np.argmax(heights, axis=1)
        highest = heights[np.arange(len(k)), k]
        return k, highest if self.start is None else np.maximum(highest, self.start.peak)

    @property
    def peaks_now(self) -> Array:
        """(K,) 1 where `peak` occurs in this motion, 0 where it was before."""
        return np.ones(len(self.r)) if self.start is None else (self.peak[1] > self.start.peak).astype(float)

    def fading(self, seconds: float) -> Array:
        """Share (K, n_modes, 2) of the swing that remains after some seconds of rest."""
        return np.asarray(np.exp(-0.5 * self.cases.kd * seconds))

    @cached_property
    def wrench(self) -> Array:
        """Additional wrench (K, T, 6) that the moving masses require at E, N and N m: to first order in the swing,
        except for the vertical force, of second order, from the rise and fall of their centre of mass."""
        which, force = self.cases, self.force
        back = -self.spin[..., None]
        r, second = turned(self.r, back), turned(self.second, back)
        mass = which.mass[:, None]
        pushed, hung = (mass * second).sum(axis=2), (mass * r).sum(axis=2)
        tilted = (mass * which.height[:, None] * second).sum(axis=2)
        out = np.zeros((*force.shape[:2], 6))
        out[..., :2] = pushed
        out[..., 2] = (which.rising[:, None] * (self.rate**2 + self.r * self.second)).sum(axis=(2, 3))
        out[..., 3] = hung[..., 1] * force[..., 2] - tilted[..., 1]
        out[..., 4] = tilted[..., 0] - hung[..., 0] * force[..., 2]
        out[..., 5] = hung[..., 0] * force[..., 1] - hung[..., 1] * force[..., 0]
        return out @ np.swapaxes(which.to_E, 1, 2)

    @cached_property
    def slower(self) -> tuple[Array, Array]:
        """Derivatives (K, T, n_modes, 2) of r and r' by log T, with the tray's motion regressor fixed at each share of
        T.

        In shares of T the equation is x'' / T^2 + kd x' / T + kp x = d.
        """
        more = 2 * self.second + self.cases.kd[:, None] * self.rate
        slower = self.spun_slower[..., None, None]
        if self.cases.round:
            more = more - slower * across(self.at_modes)
        else:
            by_rate, _, own = self.cases.carried
            turns = self.turns[..., None, None]
            more = more + 2 * turns * slower * own * self.r - (turns - slower) * by_rate * self.rate[..., ::-1]
        begun = self.rate[:, 0, ..., None]  # r' is fixed, so the derivative per share is T times as large
        r, rate, _ = self.respond(-more[..., None], np.zeros_like(begun), begun)
        return r[..., 0], rate[..., 0] - self.rate

    @cached_property
    def spun_slower(self) -> Array:
        """Derivative (K, T) of the spin, or of `turns` for a box, by log T."""
        if not self.cases.round:
            return self.turns - self.turns[:, :1]
        if self.start is None:
            return 2 * self.spin
        return 2 * (self.spin - self.start.spin[:, None]) - np.outer(self.start.turning, self.t - self.t[0])

    @property
    def states(self) -> ModalState:
        """Modal states at each node, (T, K, ...)."""
        start, peak = self.start, np.maximum.accumulate(self.height, axis=1)
        if start is not None:
            peak = np.maximum(peak, start.peak[:, None])
        spins = _turning(self.turning, self.w, start)
        return ModalState(*(x.swapaxes(0, 1) for x in (self.r, self.rate, *spins, peak)))

    @property
    def equilibrium(self) -> Array:
        """Equilibrium positions (K, n_modes, 2) of the masses in the tray's final posture, m."""
        return -self.at_modes[:, -1] / self.stiffness

    @property
    def stiffness(self) -> Array:
        """Stiffness per mass (K, n_modes, 2) at the end, 1/s^2; `omega` squared at rest on a level tray."""
        return np.asarray(self.cases.omega**2 / GRAVITY * self.upward[:, -1, None, None])

    def equilibrium_by(self, dw: Array, spun: Array) -> Array:
        """Changes (K, n_modes, 2, c) of `equilibrium` by changes dw (K or 1, T, 12, c); spun: result of `spun`."""
        drive, stiffness = self._driven(dw, spun), np.asarray(self.filters.kp)[..., None]
        return self._by_mode(drive[:, :, :, -1:] / stiffness[:, :, :, -1:])[:, 0]


def turned(x: Array, angle: Array) -> Array:
    """Vectors (..., 2) rotated by angles (...), rad."""
    c, s, x, y = np.cos(angle), np.sin(angle), x[..., 0], x[..., 1]
    return _pairs(c * x - s * y, s * x + c * y)


def across(x: Array) -> Array:
    """Derivative of `turned` by the angle: the vectors rotated by 90 degrees."""
    return _pairs(-x[..., 1], x[..., 0])


def _pairs(x: Array, y: Array) -> Array:
    """Vectors (..., 2) from their components; three times as fast as `numpy.stack`."""
    found = np.empty((*x.shape, 2))
    found[..., 0], found[..., 1] = x, y
    return found
