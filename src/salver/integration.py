"""Initial value problems by the eighth-order method of Dormand and Prince with equal steps (SciPy's DOP853), many
states together; SciPy's driver alone would choose the steps by an error over all of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_ivp

from salver.geometry import Array

Rate = Callable[[float, Array], Array]  # (instant, state) to the derivative of the state


def integrate(
    rate: Rate, state: Array, start: float, t: Array, max_step: float, corners: Sequence[float] = ()
) -> Array:
    """States (T, ...) at increasing instants t (T,) >= start, from `state` (...) at `start`.

    corners: instants at which the derivative is not smooth; steps end there. From the step on in which a state
    diverges, all are NaN.
    """
    out, y = np.full((len(t), state.size), np.nan), state.ravel()
    out[t == start] = y
    for a, b in pairwise(np.unique([start, *(c for c in corners if start < c < t[-1]), t[-1]]).tolist()):

        def slope(now: float, y: Array, end: float = b) -> Array:
            # Rounding must not put a stage after the end: a sample there may belong to the next piece.
            return rate(min(now, end), y.reshape(state.shape)).ravel()

        inside, step = (t > a) & (t <= b), (b - a) / np.ceil((b - a) / max_step)
        every = {"first_step": step, "max_step": step, "rtol": 1.0, "atol": np.inf}  # no error changes the step
        found = solve_ivp(slope, (a, b), y, "DOP853", np.union1d(t[inside], [b]), **every)
        states, reached = np.reshape(found.y, (state.size, -1)).T, np.flatnonzero(inside)[: len(found.t)]
        out[reached] = states[: len(reached)]
        if not found.success:
            break
        y = states[-1]
    return out.reshape(len(t), *state.shape)
