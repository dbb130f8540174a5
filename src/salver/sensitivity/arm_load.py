"""What the uncertain parameters of the carried objects change, for objects that stick to their tray.

A tray that feels w (the twelve numbers of `salver.models.tray_motion`, at E) needs the wrench `load(p) w` for all
that stands on it, and its first object feels `place(p) w` and needs the contact wrench `wrench(p) w`. All three maps
are polynomials of the parameters, so their derivatives are constants of the scenario, found once. Mass, centre of
mass and inertia enter through phi; position and tilt through where the objects are.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from salver.geometry import Array, exp
from salver.models.bodies import Body, bodies, uncertain_set
from salver.models.interfaces import to_tray
from salver.models.parameters import INERTIAL, UncertainSet, inertial_vector, phi_of
from salver.models.tray_motion import N_MOTION, frame_map, wrench_map

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from salver.scenario import Scenario

_STEP = 1e-3  # of a parameter's half-range: differences are then exact to 1e-9, also for a tilt


@dataclass(frozen=True)
class LoadChange:
    """Maps of w (12,) at the tray's E, and their derivatives by n_p parameters (axis 0).

    uncertain: the parameters and their set. load: (6, 12) to the wrench at E that all objects together need, and
    load_p: (n_p, 6, 12). wrench, wrench_p: the same for the first object alone, at its B. place, place_p: (12, 12) to
    the w that the first object feels at B.
    """

    uncertain: UncertainSet
    load: Array
    load_p: Array
    wrench: Array
    wrench_p: Array
    place: Array
    place_p: Array


def load_change(scenario: Scenario) -> LoadChange:
    """The maps of a scenario's objects and its uncertain set."""
    items, uncertain = bodies(scenario), uncertain_set(scenario)
    model = _Maps(items, len(items) > 1)
    nominal = model.at({})
    slopes = [_slope(model.at, name, h) for name, h in zip(uncertain.names, uncertain.half_range, strict=True)]
    load_p, wrench_p, place_p = (
        np.array([slope[k] for slope in slopes]).reshape(-1, *nominal[k].shape) for k in range(3)
    )
    return LoadChange(uncertain, nominal[0], load_p, nominal[1], wrench_p, nominal[2], place_p)


@dataclass(frozen=True)
class _Maps:
    items: list[Body]
    several: bool

    def at(self, deviation: Mapping[str, float]) -> tuple[Array, Array, Array]:
        """(load, wrench, place) at parameters that deviate from nominal."""
        tilt = exp(np.array([deviation.get("tilt_x", 0.0), deviation.get("tilt_y", 0.0), 0.0]))
        load = np.zeros((6, N_MOTION))
        first: tuple[Array, Array] | None = None
        for body in self.items:
            own = f"{body.name}." if self.several else ""
            shift = np.array([*(deviation.get(f"{own}position_{axis}", 0.0) for axis in "xy"), 0.0])
            p_EB, R_EB = tilt @ (body.p_EB + shift), tilt @ body.R_EB
            inertial = inertial_vector(body.inertial) + [deviation.get(own + name, 0.0) for name in INERTIAL]
            place = frame_map(p_EB, R_EB)
            wrench = wrench_map(phi_of(inertial)) @ place
            load += to_tray(p_EB, R_EB) @ wrench
            first = first or (wrench, place)
        assert first is not None
        return load, *first


def _slope(
    at: Callable[[Mapping[str, float]], tuple[Array, Array, Array]], name: str, half: float
) -> tuple[Array, Array, Array]:
    h = _STEP * half
    up, down = at({name: h}), at({name: -h})
    load, wrench, place = ((a - b) / (2 * h) for a, b in zip(up, down, strict=True))
    return load, wrench, place
