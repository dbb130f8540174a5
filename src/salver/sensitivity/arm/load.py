"""Effect of the uncertain parameters of objects that stick to their tray.

At the motion regressor w of the tray (`salver.models.tray_motion`, at E) the load needs the wrench `load(p) w`, and its
first object the contact wrench `wrench(p) w`. Both maps are polynomials of the parameters: mass, centre of mass and
inertia enter through phi, position and tilt through the poses of the objects. Products matter, because the moment of a
weight is mass times distance: at a corner of +-40 % in mass, first derivatives would miss a fifth. So each product of
two parameters that occurs is a term, besides the parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np
import numpy.typing as npt

from salver.geometry import Array
from salver.models.bodies import Body
from salver.models.interfaces import to_tray
from salver.models.payload import Payload
from salver.models.tray_motion import N_MOTION, frame_map, wrench_map
from salver.models.uncertain.parameters import Parameter, UncertainSet, support, tilt_at

_STEP = 1e-3  # difference step, in half-ranges; first derivatives are then exact to 1e-6, even for a tilt


@dataclass(frozen=True)
class LoadChange:
    """Maps of w (12,) at the tray's E, and their derivatives by n_c terms: n_p parameters, then products of two of
    them.

    uncertain: the parameters and their set. pairs: (n_c - n_p, 2) indices of the parameters in each product.
    half_range: (n_c,) of the terms. load: (6, 12) from w to the wrench at E that the whole load needs; load_p: (n_c, 6,
    12) per unit of each term. wrench, wrench_p: likewise for the first object alone, at its B.
    """

    uncertain: UncertainSet
    pairs: npt.NDArray[np.intp]
    half_range: Array
    load: Array
    load_p: Array
    wrench: Array
    wrench_p: Array

    def radius(self, sensitivity: Array) -> Array:
        """Half-width (...) of the tube of quantities with sensitivity (..., n_c) over the uncertain set.

        The parameters take the worst values in their set, and every product of two its largest value.
        """
        terms, n_p = sensitivity * self.half_range, self.uncertain.size
        return support(terms[..., :n_p], self.uncertain.spread) + support(terms[..., n_p:], None)

    def deviations(self, values: Array) -> Array:
        """The terms (..., n_c) at values (..., n_p) of the parameters."""
        each = values - self.uncertain.nominal
        first, second = self.pairs.T
        return np.concatenate([each, each[..., first] * each[..., second]], axis=-1)

    @cached_property
    def terms(self) -> tuple[tuple[Parameter, ...], ...]:
        """The factors of each term: one parameter, or two."""
        p = self.uncertain.parameters
        return (*((parameter,) for parameter in p), *((p[i], p[j]) for i, j in self.pairs))

    def products(self, maps: Array, dw: Array) -> Array:
        """Effects (T, i, n_c - n_p) of the terms `maps` (n_c, i, 12) of the parameters on their own dw (T, 12, n_c)."""
        first, second = self.pairs.T
        each = np.moveaxis(dw, 0, 2)  # (12, n_c, T)
        own = [maps[a] @ np.moveaxis(each[:, b], 1, 0) for a, b in ((first, second), (second, first))]
        return np.moveaxis(own[0] + np.where(first == second, 0.0, 1.0)[:, None, None] * own[1], 2, 0).swapaxes(1, 2)


def load_change(payload: Payload) -> LoadChange:
    """The maps of a payload, with the terms of its uncertain set."""
    maps, uncertain = _Maps(payload.bodies), payload.uncertain
    nominal, half = maps.at({}), uncertain.ranges
    terms, ranges, pairs = maps.slopes(half), list(half.values()), []
    for (i, first), (j, second) in combinations_with_replacement(enumerate(uncertain.parameters), 2):
        if not _interact(first, second):
            continue
        pairs.append((i, j))
        ranges.append(half[first] * half[second])
        terms.append(maps.bend({first: half[first]}, {second: half[second]}, nominal) / ranges[-1])
    stacked = np.array(terms).reshape(-1, *nominal.shape)
    return LoadChange(
        uncertain,
        np.array(pairs, dtype=np.intp).reshape(-1, 2),
        np.array(ranges),
        *(part for rows in (slice(0, 6), slice(6, 12)) for part in (nominal[rows], stacked[:, rows])),
    )


def wrench_of(body: Body, uncertain: UncertainSet) -> tuple[Array, Array]:
    """The map (6, 12) from w at the tray's E to the contact wrench of a body at its B, and its derivatives
    (n_p, 6, 12)."""
    maps = _Maps((body,))
    return maps.at({})[6:], np.array(maps.slopes(uncertain.ranges)).reshape(-1, 12, N_MOTION)[:, 6:]


def _interact(first: Parameter, second: Parameter) -> bool:
    """Whether the product of two parameters has an effect: both of one object, and neither an entry of its inertia."""
    acting = first.loads and second.loads and "inertia" not in (first.kind, second.kind)
    return acting and (first.owner == second.owner or "tilt" in (first.kind, second.kind))


@dataclass(frozen=True)
class _Maps:
    items: tuple[Body, ...]

    def at(self, deviation: Mapping[Parameter, float]) -> Array:
        """The maps load and wrench, stacked (12, 12), at a deviation of the parameters."""
        tilt, wrenches = tilt_at(deviation), []
        load = np.zeros((6, N_MOTION))
        for body in self.items:
            p_EB, R_EB = tilt @ body.place_at(deviation), tilt @ body.R_EB
            wrenches.append(wrench_map(body.phi_at(deviation)) @ frame_map(p_EB, R_EB))
            load += to_tray(p_EB, R_EB) @ wrenches[-1]
        return np.concatenate([load, wrenches[0]])

    def slopes(self, ranges: Mapping[Parameter, float]) -> list[Array]:
        """Derivatives by each parameter with a half-range: central differences."""
        return [(self.at({p: _STEP * h}) - self.at({p: -_STEP * h})) / (2 * _STEP * h) for p, h in ranges.items()]

    def bend(self, first: Mapping[Parameter, float], second: Mapping[Parameter, float], nominal: Array) -> Array:
        """Second-order effect of two steps together; for equal steps, the even part."""
        back = {p: -h for p, h in second.items()}
        if first.keys() == second.keys():
            return 0.5 * (self.at(first) + self.at(back)) - nominal
        away = {p: -h for p, h in first.items()}
        return 0.25 * (
            self.at({**first, **second})
            - self.at({**first, **back})
            - self.at({**away, **second})
            + self.at({**away, **back})
        )
