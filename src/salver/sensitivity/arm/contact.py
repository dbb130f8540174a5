"""Contact rows of everything on the tray at nominal parameters, and how each parameter changes them.

`salver.models.contact_rows` bounds rows over the whole uncertain set, for objects that follow the planned motion.
Here each row is a function c(p) of the parameters, divided by the normal force that its interface carries at rest, and
its first derivative is wanted, the direct term of the tube of a contact margin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from salver.geometry import Array
from salver.models.contact_rows import ContactRows, network_rows
from salver.models.interfaces import ContactNetwork
from salver.models.payload import Payload
from salver.models.uncertain.parameters import NOTHING, Parameter, UncertainSet

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


def contact_change(payload: Payload) -> ContactChange:
    """Nominal rows and their derivatives by the payload's uncertain parameters; internal wrenches at zero."""
    found, tray_half = payload.networks, payload.tray_half
    parts = [network_rows(network, NOTHING, tray_half) for network in found]
    slopes = [
        np.concatenate([_slope(network, parameter, _STEP * half, tray_half) for network in found])
        for parameter, half in payload.uncertain.ranges.items()
    ]
    rows = np.concatenate([part.nominal for part in parts])
    return ContactChange(
        rows,
        np.array(slopes).reshape(-1, *rows.shape),
        tuple(part.network.interfaces[int(e)].name for part in parts for e in part.interface),
        np.concatenate([part.label for part in parts]).astype(bool),
    )


def _slope(network: ContactNetwork, parameter: Parameter, h: float, tray_half: Array) -> Array:
    """(n, 12) derivative of a network's rows by one parameter."""

    def rows(half: float) -> ContactRows:
        return network_rows(network, UncertainSet((parameter,), np.zeros(1), np.array([half])), tray_half)

    if parameter.kind == "friction":  # enters as nominal minus half-range
        return (rows(-h).nominal - rows(h).nominal) / (2 * h)
    part = rows(h)
    if part.masses:  # once at the least mass, once at the largest
        n = len(part.nominal) // 2
        return (part.nominal[n:] - part.nominal[:n]) / (2 * h)
    if not part.acting:
        return np.zeros_like(part.nominal)
    return part.parameter[0] / h
