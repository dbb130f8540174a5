"""Contact rows of everything on the tray at nominal parameters, and how each parameter changes them.

`salver.models.contact_rows` bounds rows over the whole uncertain set. Here each row is a function c(p) of the
parameters, divided by the normal force that its interface carries at rest, and its first derivative is wanted: the
direct term of the tube of a contact margin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from salver.geometry import Array
from salver.models.bodies import bodies, uncertain_set
from salver.models.contact_rows import ContactRows, network_rows
from salver.models.interfaces import ContactNetwork, networks
from salver.models.parameters import UncertainSet

if TYPE_CHECKING:
    from salver.scenario import Scenario

_STEP = 1e-4  # of a parameter's half-range


@dataclass(frozen=True)
class ContactChange:
    """Rows c with c . w <= 0 at w of the tray's E, as a share of the normal force at rest.

    rows: (n, 12) at nominal parameters. rows_p: (n_p, n, 12) derivatives; a placement's is that of the levers, on the
    part of the base that stays supported. owner: (n,) the interface of each. friction_limited: (n,) whether leaving
    the row means sliding; otherwise tipping or lifting.
    """

    rows: Array
    rows_p: Array
    owner: tuple[str, ...]
    friction_limited: np.ndarray


def contact_change(scenario: Scenario) -> ContactChange:
    """Nominal rows and their derivatives by the scenario's uncertain parameters; internal wrenches at zero."""
    items, uncertain = bodies(scenario), uncertain_set(scenario)
    several, tray_half = len(items) > 1, 0.5 * np.array(scenario.tray.size)
    found = networks(items)
    parts = [_rows(network, (), np.zeros(0), several, tray_half) for network in found]
    slopes = []
    for name, half in zip(uncertain.names, uncertain.half_range, strict=True):
        blocks = [_slope(network, name, _STEP * half, several, tray_half) for network in found]
        slopes.append(np.concatenate(blocks))
    rows = np.concatenate([part.nominal for part in parts])
    return ContactChange(
        rows,
        np.array(slopes).reshape(-1, *rows.shape),
        tuple(part.network.interfaces[int(e)].name for part in parts for e in part.interface),
        np.concatenate([part.label for part in parts]).astype(bool),
    )


def _rows(network: ContactNetwork, names: tuple[str, ...], half: Array, several: bool, tray_half: Array) -> ContactRows:
    return network_rows(network, UncertainSet(names, np.zeros(len(names)), half), several, tray_half)


def _slope(network: ContactNetwork, name: str, h: float, several: bool, tray_half: Array) -> Array:
    """(n, 12) derivative of a network's rows by one parameter."""
    kind = name.rpartition(".")[2]
    if kind == "friction":  # enters as nominal minus half-range
        down, up = (_rows(network, (name,), np.array([x]), several, tray_half).nominal for x in (h, -h))
        return (up - down) / (2 * h)
    part = _rows(network, (name,), np.array([h]), several, tray_half)
    if part.mass_names:  # once at the least mass, once at the largest
        n = len(part.nominal) // 2
        return (part.nominal[n:] - part.nominal[:n]) / (2 * h)
    if not part.names:
        return np.zeros_like(part.nominal)
    return part.parameter[0] / h
