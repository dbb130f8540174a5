"""Closed-loop sensitivity of any plant and any controller: section III of the paper.

A plant x' = f(x, u, p, t) under a controller with internal state, xi' = g(xi, x, y_d(t), p_n, t) and
u = h(xi, x, y_d(t), p_n, t), is given as CasADi expressions. The derivatives of its state and its input by the true
parameters p at p = p_n follow, together with the nominal motion, from

    Pi'    = f_x Pi + f_u Theta + f_p          Pi    = dx/dp
    Pi_xi' = g_x Pi + g_xi Pi_xi               Pi_xi = dxi/dp
    Theta  = h_x Pi + h_xi Pi_xi               Theta = du/dp

(the paper prints a dot over Theta; h is algebraic, so that Theta itself is meant). CasADi supplies exact partial
derivatives. All equations are integrated together by the eighth-order method of `salver.integration`, with the step
halved until the results agree: unlike a method that chooses its steps, this treats thousands of perturbed plants alike,
and says how far off the end is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from salver.errors import Status
from salver.geometry import Array
from salver.integration import Rate, integrate
from salver.sensitivity.symbolic import ca

SampledReference = Callable[[Array], npt.ArrayLike]  # times (K,) to y_d (K, n_y)
_CONTRACTION = 16  # the error after halving the step is below 1/16 of the change; eighth order would give 1/255
_HALVINGS = 11  # largest number of halvings, from an eighth of the span: at most 8192 steps


def _none() -> ca.SX:
    return ca.SX(0, 1)


@dataclass(frozen=True)
class ClosedLoop:
    """Plant and controller as CasADi SX expressions of SX symbols, all columns: eqs (6), (7).

    x, p, p_nominal: symbols of the state, the true parameters, and the controller's nominal parameters (of the size of
    p, or empty). f: x' in terms of x, u, p, t. h: u in terms of xi, x, y_d, p_nominal, t.
    u: the symbol for the input in f. xi, g: internal state of the controller and its derivative; empty without one.
    t: symbol of time. y_d: symbol of the reference, which is sampled during integration; or give `reference`, its
    expression in t, which replaces y_d. parameters_reach_controller: must be True if g or h contain p itself, for
    example through a sensor with an uncertain scale; their direct terms are then included.
    Raises ValueError when expressions and symbols do not match.
    """

    x: ca.SX
    u: ca.SX
    p: ca.SX
    f: ca.SX
    h: ca.SX
    xi: ca.SX = field(default_factory=_none)
    g: ca.SX = field(default_factory=_none)
    p_nominal: ca.SX = field(default_factory=_none)
    y_d: ca.SX = field(default_factory=_none)
    t: ca.SX = field(default_factory=lambda: ca.SX.sym("t"))
    reference: ca.SX | None = None
    parameters_reach_controller: bool = False

    def __post_init__(self) -> None:
        pairs = [("f", self.f, "x", self.x), ("h", self.h, "u", self.u), ("g", self.g, "xi", self.xi)]
        if self.reference is not None:
            pairs.append(("reference", self.reference, "y_d", self.y_d))
        for name, expression, symbol_name, symbol in pairs:
            if expression.numel() != symbol.numel():
                raise ValueError(
                    f"{name} has {expression.numel()} entries but {symbol_name} has {symbol.numel()}; they must agree"
                )
        if self.p_nominal.numel() not in (0, self.p.numel()):
            raise ValueError(
                f"p_nominal has {self.p_nominal.numel()} entries but p has {self.p.numel()}; they must agree"
            )
        if not self.parameters_reach_controller and ca.depends_on(ca.vertcat(self.g, self.h), self.p):
            raise ValueError(
                "g or h depends on the true parameters p, which a controller cannot know; "
                "use p_nominal, or set parameters_reach_controller when p reaches it through what it measures"
            )

    @property
    def closed(self) -> ClosedLoop:
        """The loop with the reference's expression in place of y_d."""
        if self.reference is None:
            return self
        f, g, h = ca.substitute([self.f, self.g, self.h], [self.y_d], [ca.densify(self.reference)])
        names = {"x", "u", "p", "xi", "p_nominal", "t", "parameters_reach_controller"}
        return ClosedLoop(f=f, g=g, h=h, **{name: getattr(self, name) for name in names})


def variational(loop: ClosedLoop) -> ca.Function:
    """Right-hand side of the variational equations as a CasADi function.

    (x, xi, Pi, Pi_xi, p, p_nominal, t, y_d) to (x', xi', Pi', Pi_xi', u, Theta).
    """
    loop = loop.closed
    x, u, p, xi = loop.x, loop.u, loop.p, loop.xi
    Pi, Pi_xi = ca.SX.sym("Pi", x.numel(), p.numel()), ca.SX.sym("Pi_xi", xi.numel(), p.numel())
    Theta = ca.jacobian(loop.h, x) @ Pi + ca.jacobian(loop.h, xi) @ Pi_xi + ca.jacobian(loop.h, p)
    f_x, f_u, f_p = (ca.substitute(ca.jacobian(loop.f, z), u, loop.h) for z in (x, u, p))
    dPi = f_x @ Pi + f_u @ Theta + f_p
    dPi_xi = ca.jacobian(loop.g, x) @ Pi + ca.jacobian(loop.g, xi) @ Pi_xi + ca.jacobian(loop.g, p)
    dx = ca.substitute(loop.f, u, loop.h)
    symbols = [x, xi, Pi, Pi_xi, p, loop.p_nominal, loop.t, loop.y_d]
    return _function("variational", symbols, [dx, loop.g, dPi, dPi_xi, loop.h, Theta])


def closed_loop_rate(loop: ClosedLoop) -> ca.Function:
    """CasADi function from (x, xi, p, p_nominal, t, y_d) to (x', xi', u)."""
    loop = loop.closed
    symbols = [loop.x, loop.xi, loop.p, loop.p_nominal, loop.t, loop.y_d]
    return _function("closed_loop", symbols, [ca.substitute(loop.f, loop.u, loop.h), loop.g, loop.h])


def _function(name: str, symbols: list[ca.SX], expressions: list[ca.SX]) -> ca.Function:
    unknown = [s for s in ca.symvar(ca.veccat(*expressions)) if not ca.depends_on(ca.veccat(*symbols), s)]
    if unknown:
        raise ValueError(f"f, g or h contains the unknown symbol {unknown[0].name()}; declare it or give it a value")
    return ca.Function(name, symbols, [ca.densify(e) for e in expressions])


class _Evaluated:
    """A CasADi function that is called with arrays through its buffers, without converting them to CasADi matrices,
    which takes most of the time of a usual call."""

    def __init__(self, function: ca.Function) -> None:
        self._buffer: Any
        self._buffer, self._run = function.buffer()
        self._given = [np.zeros(function.size_in(i), order="F") for i in range(function.n_in())]
        self._found = [np.zeros(function.size_out(i), order="F") for i in range(function.n_out())]
        for i, array in enumerate(self._given):
            self._buffer.set_arg(i, array.ravel(order="K").data)
        for i, array in enumerate(self._found):
            self._buffer.set_res(i, array.ravel(order="K").data)

    def __call__(self, *given: npt.ArrayLike) -> list[Array]:
        for place, value in zip(self._given, given, strict=True):
            place[...] = np.reshape(value, place.shape)
        self._run()
        return [array.copy() for array in self._found]


@dataclass(frozen=True)
class Sensitivity:
    """Nominal motion and first-order sensitivities, time axis first.

    t (T,); x (T, n_x), xi (T, n_xi), u (T, n_u); state_sensitivity Pi (T, n_x, n_p); controller_sensitivity
    Pi_xi (T, n_xi, n_p); input_sensitivity Theta (T, n_u, n_p). status: whether the tolerance was met; its detail
    `error` is the estimated relative error.
    """

    t: Array
    x: Array
    xi: Array
    u: Array
    state_sensitivity: Array
    controller_sensitivity: Array
    input_sensitivity: Array
    status: Status


def sensitivity(
    loop: ClosedLoop,
    p_nominal: npt.ArrayLike,
    t: npt.ArrayLike,
    x0: npt.ArrayLike,
    xi0: npt.ArrayLike = (),
    reference: SampledReference | None = None,
    Pi0: npt.ArrayLike | None = None,
    tolerance: float = 1e-9,
    absolute_tolerance: float = 1e-12,
    corners: Sequence[float] = (),
) -> Sensitivity:
    """Integrate x, xi, Pi and Pi_xi together from t[0], and evaluate u and Theta, at increasing times t (T,).

    reference: function of times that returns y_d, if the loop has no expression for it. Pi0 (n_x, n_p): sensitivity of
    the initial state, default zero; that of the controller's is zero. tolerance: error estimated from the last halving
    of the step, relative to each quantity's size; changes below absolute_tolerance, in the quantity's unit, are
    ignored. corners: instants at which the reference is not smooth.
    """
    t = np.asarray(t, dtype=float)
    n_x, n_xi, n_p = loop.x.numel(), loop.xi.numel(), loop.p.numel()
    p = _sized("p_nominal", p_nominal, (n_p,))
    Pi = np.zeros((n_x, n_p)) if Pi0 is None else _sized("Pi0", Pi0, (n_x, n_p))
    motion = np.concatenate([_sized("x0", x0, (n_x,)), _sized("xi0", xi0, (n_xi,))])
    # One matrix: a column with the motion itself, then a column of (Pi, Pi_xi) for each parameter.
    state = np.column_stack([motion, np.vstack([Pi, np.zeros((n_xi, n_p))])])
    function, believed = _Evaluated(variational(loop)), p[: loop.p_nominal.numel()]

    def evaluate(s: Array, time: float) -> list[Array]:
        y = _sampled(loop, reference, time)
        return function(s[:n_x, 0], s[n_x:, 0], s[:n_x, 1:], s[n_x:, 1:], p, believed, time, y)

    def rate(time: float, s: Array) -> Array:
        slope = np.empty_like(s)
        slope[:n_x, :1], slope[n_x:, :1], slope[:n_x, 1:], slope[n_x:, 1:], _, _ = evaluate(s, time)
        return slope

    states, status = _refined(rate, state, t, (tolerance, absolute_tolerance), corners)
    inputs = [evaluate(s, time)[4:] for s, time in zip(states, t, strict=True)]
    return Sensitivity(
        t,
        states[:, :n_x, 0],
        states[:, n_x:, 0],
        np.stack([u[:, 0] for u, _ in inputs]),
        states[:, :n_x, 1:],
        states[:, n_x:, 1:],
        np.stack([Theta for _, Theta in inputs]),
        status,
    )


@dataclass(frozen=True)
class Motions:
    """Nonlinear closed-loop motions of n plants: t (T,); x (n, T, n_x), xi (n, T, n_xi), u (n, T, n_u)."""

    t: Array
    x: Array
    xi: Array
    u: Array
    status: Status


def simulate(
    loop: ClosedLoop,
    p_samples: npt.ArrayLike,
    p_nominal: npt.ArrayLike,
    t: npt.ArrayLike,
    x0: npt.ArrayLike,
    xi0: npt.ArrayLike = (),
    reference: SampledReference | None = None,
    tolerance: float = 1e-9,
    absolute_tolerance: float = 1e-12,
    corners: Sequence[float] = (),
) -> Motions:
    """Simulate the full closed loop with true parameters p_samples (n, n_p) and a controller with p_nominal (n_p,).

    x0 (n_x,) or (n, n_x) and xi0 (n_xi,) or (n, n_xi) at t[0]; other arguments as in `sensitivity`.
    """
    t = np.asarray(t, dtype=float)
    n_x, n_xi, n_p = loop.x.numel(), loop.xi.numel(), loop.p.numel()
    p = _sized("p_samples", np.atleast_2d(np.asarray(p_samples, dtype=float)), (None, n_p)).T
    n = p.shape[1]
    believed = _sized("p_nominal", p_nominal, (n_p,))[: loop.p_nominal.numel()]
    start = [np.broadcast_to(np.asarray(z, dtype=float), (n, size)) for z, size in ((x0, n_x), (xi0, n_xi))]
    # Samples are columns; nominal parameters, time and reference are common to all.
    function = _Evaluated(closed_loop_rate(loop).map("closed_loops", "serial", n, [3, 4, 5], []))

    def evaluate(time: float, s: Array) -> list[Array]:
        return function(s[:n_x], s[n_x:], p, believed, time, _sampled(loop, reference, time))

    begin, tolerances = np.concatenate(start, axis=1).T, (tolerance, absolute_tolerance)
    states, status = _refined(lambda time, s: np.vstack(evaluate(time, s)[:2]), begin, t, tolerances, corners)
    u = np.stack([evaluate(time, s)[2] for s, time in zip(states, t, strict=True)])
    x, xi, u = (np.moveaxis(array, 2, 0) for array in (states[:, :n_x], states[:, n_x:], u))
    return Motions(t, x, xi, u, status)


def _sampled(loop: ClosedLoop, reference: SampledReference | None, t: float) -> Array:
    """y_d (1, n_y) at time t; without columns if the loop has an expression for it."""
    if loop.reference is not None or loop.y_d.numel() == 0:
        return np.empty((1, 0))
    if reference is None:
        raise ValueError("the loop's y_d is a symbol; give reference, a function of times (K,) to (K, n_y)")
    return _sized("reference(t)", reference(np.array([t])), (1, loop.y_d.numel()))


def _sized(name: str, value: npt.ArrayLike, shape: tuple[int | None, ...]) -> Array:
    array = np.asarray(value, dtype=float)
    if array.ndim != len(shape) or any(want not in (None, got) for want, got in zip(shape, array.shape, strict=True)):
        raise ValueError(f"{name} has shape {array.shape}; {tuple('any' if s is None else s for s in shape)} is needed")
    return array


def _refined(
    rate: Rate, state: Array, t: Array, tolerances: tuple[float, float], corners: Sequence[float]
) -> tuple[Array, Status]:
    """Integrate with steps halved until the change is within the tolerances."""
    tolerance, absolute = tolerances
    step, coarse, error = float(t[-1] - t[0]) / 8, None, np.inf
    for _ in range(_HALVINGS):
        with np.errstate(over="ignore", invalid="ignore"):  # an unstable step; the next one is shorter
            fine = integrate(rate, state, float(t[0]), t, step, corners)
        if coarse is not None:
            error = _relative_difference(coarse, fine, absolute) / _CONTRACTION
            if error <= tolerance:
                sentence = f"converged: steps of {step:.2g} s err by about {error:.1e}"
                return fine, Status("converged", sentence, True, {"step": step, "error": error})
        coarse, step = fine, step / 2
    sentence = f"steps of {2 * step:.2g} s still err by about {error:.1e}, more than the tolerance {tolerance:.1e}"
    assert coarse is not None
    return coarse, Status("step_limit", sentence, False, {"step": 2 * step, "error": error})


def _relative_difference(a: Array, b: Array, absolute: float) -> float:
    """Largest |a - b| of (T, rows, columns), relative to the entry's largest value over time.

    For entries below a thousandth of their column's largest, it is relative to that thousandth; differences below
    `absolute` are ignored, so that rounding does not matter.
    """
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return float("inf")
    peak = np.abs(b).max(axis=0)
    size = np.maximum(peak, 1e-3 * peak.max(axis=0, initial=0.0))
    change = np.abs(a - b).max(axis=0)
    return float(np.max(np.divide(change, size, out=np.zeros_like(change), where=change > absolute), initial=0.0))
