"""A liquid among the contact conditions of the object's plan: it stays below its brim, and its slosh joins the rows.

At fixed orientation waves are linear in the plan's variables but for what the tray's lifting stiffens, and the height
of a wave is convex in them. Both functions are given as they are after a step of the linear model, with their tangents
there; the sequential method sees to the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from salver.geometry import Array, Indices
from salver.models.contact_rows import ContactRows
from salver.models.tray_motion import N_MOTION
from salver.sensitivity.slosh_rows import Sloshed
from salver.sensitivity.sloshing import LIGHTEST, Slosh
from salver.sensitivity.wave_cases import SloshingCase
from salver.sensitivity.wave_gradients import Unknowns
from salver.sensitivity.waves import along

Kind = tuple[Array, Array, Callable[[Indices, Indices, Unknowns], Array]]


@dataclass(frozen=True)
class Wet:
    """Cases of every liquid, by body, along what the tray feels, w (T, 12) at t (T,), with its derivative
    (T, 12, n_z)."""

    cases: dict[str, tuple[SloshingCase, ...]]
    t: Array
    w: Array
    w_jacobian: Array

    def after(self, step: Array | None) -> dict[str, tuple[Slosh, ...]]:
        """What they do after a step (n_z,) of the linear model."""
        w = self.w if step is None else self.w + self.w_jacobian @ step
        return {name: (Slosh.of(along(cases, self.t, w)),) for name, cases in self.cases.items()}

    def steps(self, step: Array | None, shape: tuple[int, ...]) -> Array:
        """(*shape, n_z) the step, for every row."""
        n_z = self.w_jacobian.shape[2]
        return np.broadcast_to(np.zeros(n_z) if step is None else step, (*shape, n_z))

    @property
    def unknowns(self) -> Unknowns:
        """The plan's own."""
        return Unknowns(self.w_jacobian)


@dataclass(frozen=True)
class BrimRows:
    """Shares of the room that one liquid leaves, in each case; of the steepness for which the model is valid; and, at
    the last instant, of what it may do after the motion."""

    said: str
    name: str
    wet: Wet

    @property
    def owner(self) -> tuple[str, ...]:
        (part,) = self.wet.after(None)[self.name]
        return (self.said,) * (len(part.wrench) * len(_conditions(part)))

    def slack(self, step: Array | None = None) -> tuple[Array, Array]:
        (part,) = self.wet.after(step)[self.name]
        slack = np.hstack([1 - value / scale for value, scale, _ in _conditions(part)])
        return slack, self.wet.steps(step, slack.shape)

    def least(self) -> Array:
        return self.slack()[0]

    def cuts(self, instant: Indices, row: Indices, terms: Array) -> tuple[Array, Array]:
        step = terms[0]
        (part,) = self.wet.after(step)[self.name]
        found, count, unknowns = _conditions(part), len(part.wrench), self.wet.unknowns
        offset, slope = np.empty(len(row)), np.empty((len(row), len(step)))
        for kind, (values, scale, by) in enumerate(found):
            mine = np.flatnonzero(row // count == kind)
            if len(mine):
                case = row[mine] % count
                slope[mine] = -by(case, instant[mine], unknowns) / scale[case, None]
                offset[mine] = 1 - values[instant[mine], case] / scale[case]
        return offset - slope @ step, slope


def _conditions(part: Slosh) -> list[Kind]:
    """Of every kind the values (T, K), their scale (K,), and their derivatives by (case, node)."""
    which, liquid = part.waves.cases, part.waves.cases.liquid
    ends = [(None, which.room), (liquid.within, np.full(len(which.each), liquid.settled))]
    found: list[Kind] = [
        (part.free_height.T, which.steepest, part.free_by),
        (part.lightness.T, np.full(len(which.each), LIGHTEST), part.lightness_by),
        (_at_end(part, part.free_left), which.steepest, _of_end(part.free_left_by)),
    ]
    if np.isfinite(which.room).all():
        found.append((part.crest.T, which.room, part.crest_by))
    for seconds, limit in ends:
        if np.isfinite(limit).all():
            found.append((_at_end(part, part.left(seconds)), limit, _of_end(partial(part.left_by, seconds=seconds))))
    return found


def _at_end(part: Slosh, value: Array) -> Array:
    """(T, K) of which only the last instant says anything."""
    values = np.zeros((len(part.waves.t), len(value)))
    values[-1] = value
    return values


def _of_end(by: Callable[[Indices, Unknowns], Array]) -> Callable[[Indices, Indices, Unknowns], Array]:
    return lambda case, node, unknowns: by(case, unknowns)


@dataclass(frozen=True)
class SloshingRows:
    """Contact rows (with the sign of a slack) at what the tray feels, and what its liquids add to them."""

    owner: tuple[str, ...]
    rows: ContactRows
    wet: Wet

    def slack(self, step: Array | None = None) -> tuple[Array, Array]:
        w = self.wet.w if step is None else self.wet.w + self.wet.w_jacobian @ step
        sloshed = Sloshed.of(self.rows, self.wet.after(step)).values
        shape = (len(w), len(self.rows.nominal))
        seen = np.broadcast_to(w[:, None], (*shape, N_MOTION))
        return -self.rows.worst(w) - sloshed, np.concatenate([self.wet.steps(step, shape), seen], axis=2)

    def least(self) -> Array:
        return self.slack()[0]

    def cuts(self, instant: Indices, row: Indices, terms: Array) -> tuple[Array, Array]:
        step, felt = terms[0, :-N_MOTION], terms[:, -N_MOTION:]
        sloshed = Sloshed.of(self.rows, self.wet.after(step))
        own = -self.rows.slope(felt, row)
        slope = np.einsum("mi,miz->mz", own, self.wet.w_jacobian[instant])
        slope -= sloshed.history(instant, row, self.wet.unknowns)
        value = np.einsum("mi,mi->m", own, felt) - sloshed.values[instant, row]
        return value - slope @ step, slope
