"""Contact rows of everything on the tray at nominal parameters, and how each parameter changes them.

`salver.models.contact_rows` bounds rows over the whole uncertain set, for objects that follow the planned motion.
Here each row is a function c(p) of the parameters, divided by the normal force that its interface carries at rest, and
its first derivative is wanted, the direct term of the tube of a contact margin; and the bound over the set is
widened by what the tracking error changes.
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
from salver.sensitivity.arm.load import LoadChange

if TYPE_CHECKING:
    from salver.scenario import Scenario

_STEP = 1e-4  # of a parameter's half-range
_CHUNK = 1_000_000  # numbers worked on at once


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


def worst_contact(rows: ContactRows, w: Array, dw: Array, load: LoadChange) -> Array:
    """(T, n) worst case of every row over the uncertain set, the arm's tracking error included; safe below 0.

    w: (T, 12) what the tray feels, at E. dw: (T, 12, n_c) its change per unit of each of the load's terms. Exact in
    the parameters where the motion is as planned, first order in the tracking error.
    """
    step = max(1, _CHUNK // (len(rows.nominal) * (len(load.names) + len(rows.remainder) + 1)))
    parts = [slice(k, k + step) for k in range(0, len(w), step)]
    return np.concatenate([_worst_part(rows, w[part], dw[part] * load.half_range, load) for part in parts])


def _worst_part(rows: ContactRows, w: Array, scaled: Array, load: LoadChange) -> Array:
    change = rows.nominal @ scaled  # (T, n, n_c)
    column = {name: k for k, name in enumerate(load.names)}
    value = w @ rows.nominal.T
    for name, sign in zip(rows.mass_names, rows.mass_signs.T, strict=True):
        value += sign * change[:, :, column[name]]
    linear = np.tensordot(w, rows.parameter, axes=(1, 2))  # (T, n_p, n)
    linear += np.swapaxes(change[:, :, [column[name] for name in rows.names]], 1, 2)
    if rows.spread is None:
        value += np.abs(linear).sum(axis=1)
    else:
        value += np.linalg.norm(np.tensordot(rows.spread, linear, axes=(0, 1)), axis=0)
    value += np.abs(np.tensordot(w, rows.remainder, axes=(1, 2))).sum(axis=1)
    other = [k for name, k in column.items() if name not in (*rows.names, *rows.mass_names)]
    return np.asarray(value + np.abs(change[:, :, other]).sum(axis=2))
