"""How a liquid moves in its container along a motion of the tray.

The modes of `salver.models.liquid` are filters with a memory (`salver.sensitivity.filter`), driven by the lateral
specific force at each mode's height and stiffened by the vertical one. All is linear in the drive; the transposed
filter gives the derivative of any function of the waves by what the tray felt at all earlier times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from salver.geometry import Array
from salver.models.bodies import Body
from salver.models.interfaces import to_tray
from salver.models.liquid import APART, GRAVITY, LEAST_WEIGHT, LEFT_OVER, STEEPEST, TILTING, Liquid, Modes
from salver.models.parameters import Parameter, UncertainSet
from salver.models.tray_motion import N_MOTION, frame_map
from salver.sensitivity.filter import LinearFilter

Indices = npt.NDArray[np.intp]
VERDICT_APART = 0.02  # of frequency, between the fills at which a verdict looks
_TURNING = np.zeros(N_MOTION)
_TURNING[[6, 8]] = 1.0  # omega_x^2 + omega_y^2: the same in every frame whose z is the tray's


@dataclass(frozen=True, eq=False)
class Case:
    """The liquid of one body at one fill (m) and damping (of critical).

    at_O (3, 12), at_mode (n_modes, 2, 12): w of the tray's E to the specific force at the centre of the surface, and
    the lateral one at each mode. to_E (6, 6): wrench at O to that at E, in E.
    """

    body: Body
    fill: float
    damping: float
    modes: Modes
    at_O: Array
    at_mode: Array
    to_E: Array

    @classmethod
    def of(cls, body: Body, fill: float, damping: float) -> Case:
        assert body.liquid is not None
        modes = body.liquid.modes(fill)

        def felt(height: float) -> Array:
            at = body.p_EB + body.R_EB @ (body.surface_B(fill) + np.array([0.0, 0.0, height]))
            return frame_map(at, body.R_EB)

        heights = modes.height
        at_mode = np.array([[felt(z[0])[0], felt(z[1])[1]] for z in heights])
        p_EO = body.p_EB + body.R_EB @ body.surface_B(fill)
        return cls(body, fill, damping, modes, felt(0.0)[:3], at_mode, to_tray(p_EO, body.R_EB))

    @property
    def liquid(self) -> Liquid:
        assert self.body.liquid is not None
        return self.body.liquid

    @property
    def room(self) -> float:
        """m to which the surface may rise."""
        return self.liquid.room(self.fill)

    @property
    def steepest(self) -> float:
        """m, the largest free wave for which the model is valid."""
        return STEEPEST * float(self.modes.half.min())

    @property
    def kd(self) -> Array:
        return np.asarray(2 * self.damping * self.modes.omega)

    def along(self, t: Array, w: Array) -> Waves:
        """Its waves along a motion that begins at rest: what the tray feels, w (T, 12), at nodes t (T,), T >= 4."""
        return along([self], t, w)[0]


def cases(body: Body, uncertain: UncertainSet, apart: float = APART) -> tuple[Case, ...]:
    """Fills and dampings of a body's liquid that stand for all of an uncertain set; none without a liquid."""
    liquid = body.liquid
    if liquid is None:
        return ()
    half = uncertain.ranges
    fill = half.get(Parameter(body.name, "fill"), 0.0)
    found = liquid.cases(liquid.fill - fill, liquid.fill + fill, apart)
    if Parameter(body.name, "damping") not in half:
        found = [(h, liquid.nominal_damping) for h in dict.fromkeys(h for h, _ in found)]
    return tuple(Case.of(body, *each) for each in found)


def along(several: Sequence[Case], t: Array, w: Array) -> list[Waves]:
    """The waves of each case; all their filters are made at once."""
    upward = [_upward(w @ case.at_O[2]) for case in several]
    kp, kd, extra = [], [], []
    for case, up in zip(several, upward, strict=True):
        own, brakes = (x[:, :1] if case.modes.round else x for x in (case.modes.omega**2, case.kd))
        kp.append(own.ravel())
        kd.append(brakes.ravel())
        extra.append(own.ravel()[:, None] * (up / GRAVITY - 1))
    made = iter(LinearFilter.stiffened(t, np.concatenate(kp), np.concatenate(kd), np.concatenate(extra)))
    axes = [1 if case.modes.round else 2 for case in several]
    filters = [
        [[next(made) for _ in range(n)] * (3 - n) for _ in case.kd] for case, n in zip(several, axes, strict=True)
    ]
    return [Waves(*each, w) for each in zip(several, [t] * len(several), filters, upward, strict=True)]


def _upward(force: Array) -> Array:
    return np.maximum(force, LEAST_WEIGHT * GRAVITY)


@dataclass(frozen=True, eq=False)
class Waves:
    """A liquid along a motion of T nodes.

    Vectors across the container have two components. In a round one, whose wall cannot take the liquid along, they are
    along axes that do not turn about the container's own: those that the container had at the beginning.
    filters: one of each mode and axis, of a round container the same for both. upward: (T,) specific force that
    stiffens them. near: waves to which these are a small change, and of what is felt.
    """

    case: Case
    t: Array
    filters: list[list[LinearFilter]]
    upward: Array
    w: Array
    near: tuple[Waves, Array] | None = None

    def shifted(self, dw: Array) -> Waves:
        """The waves of w + dw (T, 12), to first order in dw, which begins with the motion."""
        return replace(self, w=self.w + dw, upward=_upward((self.w + dw) @ self.case.at_O[2]), near=(self, dw))

    @cached_property
    def force(self) -> Array:
        """(T, 3) specific force at the centre of the surface, in the container's axes."""
        return self.w @ self.case.at_O.T

    @cached_property
    def spin(self) -> Array:
        """(T,) rad by which the container has turned about its axis."""
        if not self.case.modes.round:
            return np.zeros(len(self.t))
        return self._turning.respond(self.w[:, 5])[0]

    @cached_property
    def _turning(self) -> LinearFilter:
        """From the angular acceleration about the axis to the angle."""
        return LinearFilter.on_nodes(self.t, 0.0, 0.0, 3)

    def _still(self, x: Array) -> Array:
        """Vectors (T, ..., 2) in the container's axes to those that do not turn with it."""
        return _turned(x, self.spin)

    @cached_property
    def _at_modes(self) -> Array:
        """(T, n_modes, 2) lateral specific force at each mode."""
        return self._still(np.einsum("nak,tk->tna", self.case.at_mode, self.w))

    def respond(self, force: Array, start: Array | None = None) -> tuple[Array, Array, Array]:
        """r, r' and r'' (T, n_modes, 2, c) to lateral specific forces (T, n_modes, 2, c) at the modes."""
        shape = force.shape
        r, rate, second = (np.empty(shape) for _ in range(3))
        for n, each in enumerate(self.filters):
            axes = [(each[0], slice(0, 2))] if each[0] is each[1] else [(each[0], slice(0, 1)), (each[1], slice(1, 2))]
            for one, axis in axes:
                drive = -force[:, n, axis]
                begin = None if start is None else np.stack([start[n, axis], np.zeros_like(start[n, axis])])
                r[:, n, axis], rate[:, n, axis] = one.respond(drive, begin)
                second[:, n, axis] = one.acceleration(drive, r[:, n, axis], rate[:, n, axis])
        return r, rate, second

    def _level(self, force: Array) -> Array:
        """(n_modes, 2, c) r where a motion begins: the surface is level, whatever the tray is."""
        return -force[0] / self.case.modes.omega[..., None] ** 2 * (GRAVITY / self.upward[0])

    def _pushed(self, dw: Array, before: bool) -> tuple[Array, Array, Array]:
        """r, r' and r'' (T, n_modes, 2, c), to first order, by changes dw (T, 12, c) of what the tray feels: pushed
        aside, stiffened, and turned under the waves. before: whether what changes was so before the motion too."""
        case = self.case
        drive = np.moveaxis(self._still(np.einsum("nak,tkc->tcna", case.at_mode, dw)), 1, 3)
        drive += (case.modes.omega**2 / GRAVITY * self.r)[..., None] * (case.at_O[2] @ dw)[:, None, None]
        drive += _across(self._at_modes)[..., None] * self._spun(dw)[:, None, None]
        return self.respond(drive, self._level(drive) if before else None)

    def _spun(self, dw: Array) -> Array:
        """(T, c) change of `spin`."""
        return self._turning.respond(dw[:, 5])[0] if self.case.modes.round else np.zeros((len(dw), dw.shape[2]))

    @cached_property
    def _moved(self) -> tuple[Array, Array, Array]:
        if self.near is not None:
            waves, dw = self.near
            changes = waves._pushed(dw[:, :, None], before=False)
            return (waves.r + changes[0][..., 0], waves.rate + changes[1][..., 0], waves.second + changes[2][..., 0])
        force = self._at_modes[..., None]
        r, rate, second = self.respond(force, self._level(force))
        return r[..., 0], rate[..., 0], second[..., 0]

    @property
    def r(self) -> Array:
        """(T, n_modes, 2) place of each moving mass, m."""
        return self._moved[0]

    @property
    def rate(self) -> Array:
        """(T, n_modes, 2) m/s."""
        return self._moved[1]

    @property
    def second(self) -> Array:
        """(T, n_modes, 2) m/s^2."""
        return self._moved[2]

    @cached_property
    def slope(self) -> Array:
        """(T, 2) of a surface at rest under the force: f / f_z."""
        return self._still(self.force[:, :2] / self.upward[:, None])

    @cached_property
    def eta(self) -> Array:
        """(T, 2) m by which the surface stands at the wall, by linear theory."""
        return np.asarray(
            np.einsum("na,tna->ta", self.case.modes.gain, self.r) - self.case.modes.rest_rise * self.slope
        )

    @property
    def eta_B(self) -> Array:
        """(T, 2) the same along the container's own axes."""
        return _turned(self.eta, -self.spin)

    @cached_property
    def free(self) -> Array:
        """(T, 2) m, the part of it that is a wave, not the incline of a surface at rest."""
        return self.eta + self.case.modes.half * self.slope

    @cached_property
    def crest(self) -> Array:
        """(T,) height of the highest point over the surface at rest, m, what is not linear included."""
        return self.case.modes.crest(self.eta, self.slope, self.w @ _TURNING)

    def raised(self, by: Array | float, freer: Array | float) -> Array:
        """(T,) the crest, m, of waves that are higher by so much, (T,), of which the free wave by (T, 2) at most."""
        modes, free = self.case.modes, np.abs(self.free)
        return self.crest + by + (modes.peaking / modes.half * freer * (2 * free + freer)).sum(axis=1)

    @property
    def free_height(self) -> Array:
        """(T,) height of the free wave, by linear theory."""
        return self.case.modes.highest(self.free)

    @property
    def _wide(self) -> float:
        return float(self.case.modes.half.max())

    @cached_property
    def tail(self) -> Array:
        """(n_modes, 2) amplitude at the wall of the waves that are left at the end, when all is at rest, m."""
        return np.asarray(self.case.modes.gain * np.hypot(*self._ending))

    @cached_property
    def _ending(self) -> tuple[Array, Array]:
        """(n_modes, 2) how far each mass is from its rest at the end, and its speed over the frequency there, m."""
        case = self.case
        softer = GRAVITY / self.upward[-1]
        rest = self._at_modes[-1] / case.modes.omega**2 * softer
        return self.r[-1] + rest, self.rate[-1] / case.modes.omega * np.sqrt(softer)

    def left(self, seconds: float = 0.0, more: float = 0.0) -> float:
        """m, no crest is higher from so many seconds after the end on, the tray at rest: both modes at their best.
        more: m by which the linear waves may be higher."""
        modes, amplitude = self.case.modes, (self.tail * self._fading(seconds)).sum(axis=0) + more
        highest = self.case.modes.highest(amplitude + modes.half * np.abs(self.slope[-1]))
        over = LEFT_OVER * (self._peak[1] + more) ** 3 / float(modes.half.min()) ** 2
        return float(highest + np.sum(modes.peaking / modes.half * amplitude**2) + over)

    @cached_property
    def _peak(self) -> tuple[int, float]:
        """When the linear wave is highest during the motion, and how high, m: how far its phase can have drifted."""
        heights = self.case.modes.highest(self.eta)
        k = int(np.argmax(heights))
        return k, float(heights[k])

    def _fading(self, seconds: float) -> Array:
        return np.asarray(np.exp(-self.case.damping * self.case.modes.omega * seconds))

    @cached_property
    def wrench(self) -> Array:
        """(T, 6) what the container must give at E beyond what the liquid would need if a lid lay on it, N and N m."""
        modes, force = self.case.modes, self.force
        r, second = _turned(self.r, -self.spin), _turned(self.second, -self.spin)
        pushed = np.einsum("na,tna->ta", modes.mass, second)
        turned = np.einsum("na,tna->ta", modes.mass * modes.height, second)
        hung = np.einsum("na,tna->ta", modes.mass, r)
        out = np.zeros((len(r), 6))
        out[:, :2] = pushed
        out[:, 3] = hung[:, 1] * force[:, 2] - turned[:, 1]
        out[:, 4] = turned[:, 0] - hung[:, 0] * force[:, 2]
        out[:, 5] = hung[:, 0] * force[:, 1] - hung[:, 1] * force[:, 0]
        return out @ self.case.to_E.T

    # What else the tray feels ------------------------------------------------------------------------------------

    def changed(self, dw: Array) -> Change:
        """To first order, by changes dw (T, 12, c) of what the tray feels, before the motion too."""
        modes, case, spun = self.case.modes, self.case, self._spun(dw)[:, None]
        r, rate, second = self._pushed(dw, before=True)
        force = np.einsum("ik,tkc->tic", case.at_O, dw)
        lateral = np.moveaxis(self._still(np.moveaxis(force[:, :2], 1, 2)), 1, 2)
        slope = (lateral - self.slope[:, :, None] * force[:, None, 2]) / self.upward[:, None, None]
        slope += _across(self.slope)[:, :, None] * spun
        eta = np.einsum("na,tnac->tac", modes.gain, r) - modes.rest_rise[:, None] * slope
        left = np.einsum("na,nac->ac", modes.gain, np.hypot(r[-1], rate[-1] / modes.omega[..., None]))

        def weighed(x: Array, dx: Array, mass: Array) -> tuple[Array, Array]:
            """Sums over the modes in the container's axes, (T, 2, 1), and their changes (T, 2, c)."""
            own = _turned(np.einsum("na,tna->ta", mass, x), -self.spin)
            moved = _turned(np.moveaxis(np.einsum("na,tnac->tac", mass, dx), 1, 2), -self.spin)
            return own[:, :, None], np.moveaxis(moved, 2, 1) - _across(own)[:, :, None] * spun

        pushed = weighed(self.second, second, modes.mass)[1]
        turned = weighed(self.second, second, modes.mass * modes.height)[1]
        hung, hangs = weighed(self.r, r, modes.mass)
        f = self.force[:, :, None]
        out = np.empty((len(r), 6, dw.shape[2]))
        out[:, :2], out[:, 2] = pushed, 0.0
        out[:, 3] = hangs[:, 1] * f[:, 2] + hung[:, 1] * force[:, 2] - turned[:, 1]
        out[:, 4] = turned[:, 0] - hangs[:, 0] * f[:, 2] - hung[:, 0] * force[:, 2]
        out[:, 5] = hangs[:, 0] * f[:, 1] - hangs[:, 1] * f[:, 0] + hung[:, 0] * force[:, 1] - hung[:, 1] * force[:, 0]
        thrown = TILTING / GRAVITY * self._wide**2 * np.einsum("k,tkc->tc", _TURNING, dw)
        wrench = np.einsum("ij,tjc->tic", case.to_E, out)
        return Change(eta, eta + modes.half[:, None] * slope, thrown, wrench, left)

    # Derivatives, of rows (m,) at nodes (m,): by w at all nodes (m, T, 12), and by log T of the duration (m,) --------

    def crest_by(self, node: Indices) -> tuple[Array, Array]:
        """Of the crest."""
        modes = self.case.modes
        by_free = 2 * modes.peaking / modes.half * self.free[node]
        return self._surface_by(node, self._steepest(self.eta[node]), by_free, TILTING / GRAVITY * self._wide**2)

    def free_by(self, node: Indices) -> tuple[Array, Array]:
        """Of the height of the free wave."""
        return self._surface_by(node, np.zeros((len(node), 2)), self._steepest(self.free[node]), 0.0)

    def _surface_by(self, node: Indices, by_eta: Array, by_free: Array, thrown: float) -> tuple[Array, Array]:
        case, modes = self.case, self.case.modes
        both, up = by_eta + by_free, self.upward[node, None]
        by_slope = (by_free * modes.half - both * modes.rest_rise) / up
        lateral = _turned(by_slope, -self.spin[node])
        by_force = np.column_stack([lateral, -(by_slope * self.slope[node]).sum(axis=1)])
        by_spin = self.upward[node] * (by_slope * _across(self.slope[node])).sum(axis=1)
        by_r = modes.gain * both[:, None, :]
        return self._back(node, by_r, np.zeros_like(by_r), by_force @ case.at_O + thrown * _TURNING, by_spin)

    def _steepest(self, eta: Array) -> Array:
        """Derivative of `Modes.highest`."""
        if self.case.modes.round:
            return np.asarray(eta / np.maximum(np.linalg.norm(eta, axis=-1, keepdims=True), 1e-12))
        return np.sign(eta)

    def left_by(self, seconds: float = 0.0) -> tuple[Array, Array]:
        """Of `left`, one row; the tray's posture at the end is taken as given."""
        modes, fading = self.case.modes, self._fading(seconds)
        amplitude = (self.tail * fading).sum(axis=0)
        slope = self._steepest(amplitude + modes.half * np.abs(self.slope[-1]))
        slope = fading * modes.gain * (slope + 2 * modes.peaking / modes.half * amplitude)
        away, speed = self._ending
        size = np.maximum(np.hypot(away, speed), 1e-12)
        to_speed = np.sqrt(GRAVITY / self.upward[-1]) / modes.omega
        last = np.array([len(self.t) - 1])
        by_r, by_rate = slope * away / size, slope * speed / size * to_speed
        by_w, by_duration = self._back(last, by_r[None], by_rate[None], np.zeros((1, N_MOTION)), np.zeros(1))
        k, peak = np.array([self._peak[0]]), self._peak[1]
        more, longer = self._surface_by(k, self._steepest(self.eta[k]), np.zeros((1, 2)), 0.0)
        steep = 3 * LEFT_OVER * peak**2 / float(modes.half.min()) ** 2
        return by_w + steep * more, by_duration + steep * longer

    def wrench_by(self, node: Indices, weight: Array) -> tuple[Array, Array]:
        """Of weight (m, 6) . wrench."""
        case, modes, force, spin = self.case, self.case.modes, self.force[node], self.spin[node]
        r, second = _turned(self.r[node], -spin), _turned(self.second[node], -spin)
        weight = weight @ case.to_E
        across = weight[:, [4, 3]] * [1.0, -1.0]  # what turns along x is a moment about y
        by_second = modes.mass * (weight[:, None, :2] + modes.height * across[:, None])
        hanging = -across * force[:, 2:] + weight[:, 5:] * force[:, [1, 0]] * [1.0, -1.0]
        stiff = modes.omega**2 / GRAVITY
        by_hung = modes.mass * hanging[:, None]
        by_spin = -(by_second * _across(second) + by_hung * _across(r)).sum(axis=(1, 2))
        hung = np.einsum("na,mna->ma", modes.mass, r)
        by_force = np.column_stack(
            [-weight[:, 5] * hung[:, 1], weight[:, 5] * hung[:, 0], -(across * hung).sum(axis=1)]
        )
        by_force[:, 2] -= np.einsum("mna,mna->m", by_second, stiff * r)
        by_w = by_force @ case.at_O - np.einsum("mna,nak->mk", by_second, case.at_mode)
        by_second = _turned(by_second, spin)
        by_r = _turned(by_hung, spin) - stiff * self.upward[node, None, None] * by_second
        by_spin -= (by_second * _across(self._at_modes[node])).sum(axis=(1, 2))
        return self._back(node, by_r, -case.kd * by_second, by_w, by_spin)

    @cached_property
    def _slower(self) -> tuple[Array, Array]:
        """(T, n_modes, 2) derivative of r and r' by log T, where what the tray feels is the same in each share of it.

        In shares of T the equation reads x'' / T^2 + kd x' / T + kp x = d.
        """
        more = 2 * self.second + self.case.kd * self.rate
        turned = 2 * self.spin[:, None, None] * _across(self._at_modes)
        r, rate, _ = self.respond((turned - more)[..., None])
        return r[..., 0], rate[..., 0] - self.rate

    def _back(self, node: Indices, by_r: Array, by_rate: Array, by_w: Array, by_spin: Array) -> tuple[Array, Array]:
        """From derivatives (m, n_modes, 2) by r and r', (m, 12) by w itself and (m,) by the spin, at the rows' own
        nodes."""
        case, count, row = self.case, len(node), np.arange(len(node))
        out = np.zeros((count, len(self.t), N_MOTION))
        out[row, node] = by_w
        softened, turned = np.zeros((2, len(self.t), count))
        turned[node, row] = by_spin
        for n, each in enumerate(self.filters):
            driven = np.empty((len(self.t), count, 2))
            for axis in range(2):
                x, rate = np.zeros((2, len(self.t), count))
                x[node, row], rate[node, row] = by_r[:, n, axis], by_rate[:, n, axis]
                driven[..., axis] = each[axis].gradient(x, rate)
            out -= np.einsum("tma,ak->mtk", _turned(driven, -self.spin), case.at_mode[n])
            softened += np.einsum("tma,ta->tm", driven, case.modes.omega[n] ** 2 / GRAVITY * self.r[:, n])
            turned -= np.einsum("tma,ta->tm", driven, _across(self._at_modes[:, n]))
        out -= softened.T[:, :, None] * case.at_O[2]
        slower = [np.einsum("mna,mna->m", by, x[node]) for by, x in zip((by_r, by_rate), self._slower, strict=True)]
        if case.modes.round:
            out[:, :, 5] += self._turning.gradient(turned, np.zeros_like(turned)).T
        return out, slower[0] + slower[1] + 2 * self.spin[node] * by_spin


@dataclass(frozen=True, eq=False)
class Change:
    """What c changes of what the tray feels make of waves, to first order.

    eta, free: (T, 2, c) of the waves' heights along both axes, m. thrown: (T, c) of what tilting throws up, m. wrench:
    (T, 6, c) at E. left: (2, c) of what is left at the end, an amplitude, m.
    """

    eta: Array
    free: Array
    thrown: Array
    wrench: Array
    left: Array


def _turned(x: Array, angle: Array) -> Array:
    """Vectors (T, ..., 2) turned by angles (T,), rad."""
    shape = (-1, *(1,) * (x.ndim - 2))
    c, s = np.cos(angle).reshape(shape), np.sin(angle).reshape(shape)
    return np.stack([c * x[..., 0] - s * x[..., 1], s * x[..., 0] + c * x[..., 1]], axis=-1)


def _across(x: Array) -> Array:
    """Derivative of `_turned` by the angle: turned by a quarter."""
    return np.stack([-x[..., 1], x[..., 0]], axis=-1)
