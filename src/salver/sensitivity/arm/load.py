"""What the uncertain parameters of the carried objects change, for objects that stick to their tray.

A tray that feels w (the twelve numbers of `salver.models.tray_motion`, at E) needs the wrench `load(p) w` for all
that stands on it, and its first object feels `place(p) w` and needs the contact wrench `wrench(p) w`. All three maps
are polynomials of the parameters: mass, centre of mass and inertia enter through phi, position and tilt through
where the objects are. Products matter, because the moment of a weight is mass times distance: at a corner of
+-40 % in mass, a fifth of what first derivatives see of the centre of mass would be missed. So each product of two
parameters that occurs is a term of its own, beside the parameters themselves.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from salver.geometry import Array, exp
from salver.models.bodies import Body, bodies, uncertain_set
from salver.models.interfaces import to_tray
from salver.models.parameters import INERTIA, INERTIAL, UncertainSet, inertial_vector, phi_of
from salver.models.tray_motion import N_MOTION, frame_map, wrench_map
from salver.sensitivity import tubes

if TYPE_CHECKING:
    from collections.abc import Mapping

    from salver.scenario import Scenario

_STEP = 1e-3  # of a parameter's half-range, for first derivatives; they are then exact to 1e-6, also for a tilt


@dataclass(frozen=True)
class LoadChange:
    """Maps of w (12,) at the tray's E, and what n_c terms add to them: n_p parameters, then products of two of them.

    uncertain: the parameters and their set. names, half_range: (n_c,) of the terms; "mass*com_x" is the product of two
    deviations, and its half-range that of the deviations multiplied.
    load: (6, 12) to the wrench at E that all objects together need; load_p: (n_c, 6, 12) per unit of each term.
    wrench, wrench_p: the same for the first object alone, at its B. place (12, 12), place_p: to the w that it feels.
    """

    uncertain: UncertainSet
    names: tuple[str, ...]
    half_range: Array
    load: Array
    load_p: Array
    wrench: Array
    wrench_p: Array
    place: Array
    place_p: Array

    def radius(self, sensitivity: Array) -> Array:
        """Half-width (...) of the tube of quantities with sensitivity (..., n_c) over the uncertain set.

        `tubes.radius` of the parameters, and every product at its largest.
        """
        n_p = self.uncertain.size
        first = tubes.radius(sensitivity[..., :n_p], self.uncertain)
        return np.asarray(first + np.abs(sensitivity[..., n_p:]) @ self.half_range[n_p:])

    def deviations(self, values: Array) -> Array:
        """The terms (..., n_c) at values (..., n_p) of the parameters."""
        each = values - self.uncertain.nominal
        first, second = self.pairs.T
        return np.concatenate([each, each[..., first] * each[..., second]], axis=-1)

    @property
    def pairs(self) -> npt.NDArray[np.intp]:
        """(n_c - n_p, 2) which parameters each product is of."""
        index = {name: k for k, name in enumerate(self.uncertain.names)}
        products = self.names[self.uncertain.size :]
        return np.array([[index[part] for part in name.split("*")] for name in products], dtype=np.intp).reshape(-1, 2)

    def products(self, maps: Array, dw: Array) -> Array:
        """(T, i, n_c - n_p) what the terms `maps` (n_c, i, 12) of the parameters make of their own dw (T, 12, n_c)."""
        first, second = self.pairs.T
        own = [np.einsum("cik,tkc->tic", maps[a], dw[:, :, b]) for a, b in ((first, second), (second, first))]
        return np.asarray(own[0] + np.where(first == second, 0.0, 1.0) * own[1])


def load_change(scenario: Scenario) -> LoadChange:
    """The maps of a scenario's objects and its uncertain set."""
    items, uncertain = bodies(scenario), uncertain_set(scenario)
    model = _Maps(items, len(items) > 1)
    nominal = model.at({})
    half = dict(zip(uncertain.names, uncertain.half_range.tolist(), strict=True))
    terms = {name: model.slope({name: _STEP * h}) / (_STEP * h) for name, h in half.items()}
    ranges = dict(half)
    for first, second in combinations_with_replacement(uncertain.names, 2):
        if not _interact(first, second):
            continue
        change = model.bend({first: half[first]}, {second: half[second]}, nominal)
        name = f"{first}*{second}"
        ranges[name] = half[first] * half[second]
        terms[name] = change / ranges[name]
    stacked = np.array(list(terms.values())).reshape(-1, *nominal.shape)
    return LoadChange(
        uncertain,
        tuple(terms),
        np.array(list(ranges.values())),
        *(part for rows in _ROWS for part in (nominal[rows], stacked[:, rows])),
    )


_ROWS = (slice(0, 6), slice(6, 12), slice(12, 24))  # of the stacked maps: load, wrench, place


def _interact(first: str, second: str) -> bool:
    """Whether two parameters can act as a product: of one object, and not two entries of its inertia."""
    (owner, _, a), (other, _, b) = first.rpartition("."), second.rpartition(".")
    acting = [name for name in (a, b) if name != "friction" and name not in INERTIA]
    return len(acting) == 2 and (owner == other or "tilt" in a or "tilt" in b)


@dataclass(frozen=True)
class _Maps:
    items: list[Body]
    several: bool

    def at(self, deviation: Mapping[str, float]) -> Array:
        """(24, 12) load, wrench and place, one below the other, at parameters that deviate from nominal."""
        tilt = exp(np.array([deviation.get("tilt_x", 0.0), deviation.get("tilt_y", 0.0), 0.0]))
        load = np.zeros((6, N_MOTION))
        first: list[Array] = []
        for body in self.items:
            own = f"{body.name}." if self.several else ""
            shift = np.array([*(deviation.get(f"{own}position_{axis}", 0.0) for axis in "xy"), 0.0])
            p_EB, R_EB = tilt @ (body.p_EB + shift), tilt @ body.R_EB
            inertial = inertial_vector(body.inertial) + [deviation.get(own + name, 0.0) for name in INERTIAL]
            place = frame_map(p_EB, R_EB)
            wrench = wrench_map(phi_of(inertial)) @ place
            load += to_tray(p_EB, R_EB) @ wrench
            first = first or [wrench, place]
        return np.concatenate([load, *first])

    def slope(self, step: Mapping[str, float]) -> Array:
        """Half the difference between a step and its opposite."""
        return 0.5 * (self.at(step) - self.at({name: -h for name, h in step.items()}))

    def bend(self, first: Mapping[str, float], second: Mapping[str, float], nominal: Array) -> Array:
        """What two steps together add beyond each alone; for a step with itself, its even part."""
        back = {name: -h for name, h in second.items()}
        if first.keys() == second.keys():
            return 0.5 * (self.at(first) + self.at(back)) - nominal
        away = {name: -h for name, h in first.items()}
        return 0.25 * (
            self.at({**first, **second})
            - self.at({**first, **back})
            - self.at({**away, **second})
            + self.at({**away, **back})
        )
