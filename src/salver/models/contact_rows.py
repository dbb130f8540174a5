"""The exact contact condition of all objects on the tray, as constraints linear in the tray's motion regressor.

With w of `salver.models.tray_motion` at the tray frame E, each facet of each interface's contact wrench cone is
    c(p) . w <= 0,
with c a polynomial of the uncertain parameters p; `salver.models.uncertain.worst_case` computes its worst case. That is
exact for mass, centre of mass and inertia of a single object on a tray that does not rotate. The least friction is used
(its cone is inside all others), the contact area that is common to all positions, both extreme masses, and for unknown
contents `salver.models.uncertain.contents`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product
from typing import Any

import numpy as np
import numpy.typing as npt

from salver.errors import ScenarioError
from salver.geometry import Array, Indices
from salver.models.bodies import Body
from salver.models.contact.contact import ContactSet
from salver.models.contact.wrench_cone import cone_facets
from salver.models.interfaces import ContactNetwork, shift_ranges, sure_contacts, to_tray
from salver.models.payload import Payload
from salver.models.tray_motion import N_MOTION, at_rest, frame_map, wrench_map
from salver.models.uncertain.contents import INERTIA_OF_MOMENTS, Filling, Hull, moments_of_inertia
from salver.models.uncertain.parameters import TILT, Parameter, UncertainSet, tilt_at
from salver.models.uncertain.worst_case import UncertainRows

MOST_GENERATORS = 256  # largest product of points and edges of one contact; gives about 12 000 facets
_MOST_MASSES = 3  # largest number of uncertain masses in a network that are enumerated at their extremes


@dataclass(frozen=True)
class ContactRows(UncertainRows):
    """Contact constraints of one network of touching bodies.

    Rows are divided by the normal force of the interface at rest on a level tray: at a value of -0.2, a disturbance of
    a fifth of that weight leaves the cone. network: the bodies and interfaces. interface: (n,) index of each row's
    interface. label: (n,) kind of each row; for the facets of a cone, whether friction limits them. internal: (n, n_w)
    effect of the network's internal wrenches on the rows; `worst` takes these wrenches as zero. Without columns if
    positions are uncertain, because the points where internal wrenches act are then unknown. wrench: (m, n, 6) effect
    on the rows of an additional wrench at E, in E, that each of the m bodies needs. wrench_by_place: (n_p, m, n, 6) how
    much the uncertain positions of bodies that touch others change that; a body that stands alone has none, since the
    wrench on it moves with it.
    """

    network: ContactNetwork
    interface: Indices
    label: npt.NDArray[Any]
    internal: Array
    wrench: Array
    wrench_by_place: Array


@lru_cache(maxsize=8)
def contact_rows(payload: Payload) -> tuple[ContactRows, ...]:
    """The contact constraints of every network, linear in w of the tray frame E, over the payload's uncertain set.

    A plan satisfies `rows.worst(w) <= -margin`. For the nominal load or other cones, pass `payload.nominal` or
    `payload.with_edges`. Cached. Raises ScenarioError when an object may stand beside its support
    (`Payload.check_places`), or when its contact has too many points and edges.
    """
    payload.check_places()
    for body in payload.bodies:
        most, edges = max(body.regions), body.contacts.edges
        if most * edges > MOST_GENERATORS:
            raise ScenarioError(
                f"contact.edges = {edges} with the {most} contact points of {body.name} gives too many facets for the "
                f"exact condition; their product must be at most {MOST_GENERATORS}."
            )
    return tuple(network_rows(network, payload.uncertain, payload.tray_half) for network in payload.networks)


Labels = npt.NDArray[Any]
Deviation = Mapping[Parameter, float]
RowsOf = Callable[[ContactSet], tuple[Array, Labels]]


def cone_rows(contacts: ContactSet) -> tuple[Array, Labels]:
    """Facets (n_f, 6) of the contact wrench cone, and whether each depends on friction (n_f,)."""
    cone = cone_facets(contacts)
    return cone.rows, cone.friction_limited


def network_rows(
    network: ContactNetwork, uncertain: UncertainSet, tray_half: Array, rows_of: RowsOf = cone_rows
) -> ContactRows:
    """Contact constraints of one network.

    rows_of: constraints of each interface, linear in the wrench at B of the upper body, with their labels; default: the
    facets of the cone.
    """
    half = uncertain.ranges
    shift = shift_ranges(network, uncertain)
    contacts = sure_contacts(network, tray_half, uncertain)
    model = _RowModel(network, [rows_of(c) for c in contacts])
    owners = ("", *(body.name for body in network.bodies))
    acting = [p for p in uncertain.parameters if p.loads and p.owner in owners]
    filled = [b for b in network.bodies if b.any_contents and any(p.kind == "inertia" for p in acting if _of(p, b))]
    masses = [p for p in acting if p.kind == "mass"]
    if uncertain.kind == "ellipsoid" or len(masses) > _MOST_MASSES:
        masses = [p for p in masses if any(_of(p, body) for body in filled)]
    if len(masses) > _MOST_MASSES:
        raise ScenarioError(
            f'{len(masses)} objects that touch each other have uncertainty.contents = "any"; at most {_MOST_MASSES} '
            "are accepted."
        )
    within = [p for p in acting if p.kind in ("com", "inertia") and any(_of(p, body) for body in filled)]
    others = tuple(p for p in acting if p not in masses and p not in within)
    corners = [dict(zip(masses, signs, strict=True)) for signs in product((-1, 1), repeat=len(masses))]
    blocks = [_expand(model, others, half, signs) for signs in corners]
    fillings, products = [], []
    for body in filled:
        made = [_filling(model, body, [p for p in within if _of(p, body)], half, signs) for signs in corners]
        fillings.append(Filling.joined(made))
        products += _placed(model, fillings[-1], body, [p for p in others if p.places], half, corners)
    nominal = np.concatenate([block[0] for block in blocks])
    parameter = np.concatenate([block[1] for block in blocks], axis=1)
    remainder = np.concatenate([np.concatenate([block[2] for block in blocks], axis=1), *products])
    copies = len(blocks)
    internal = np.concatenate([block[3] for block in blocks])
    if any(np.any(s) for s in shift.values()):
        internal = internal[:, :0]
    kept = np.abs(remainder).max(axis=(1, 2), initial=0.0) > 1e-12
    return ContactRows(
        nominal,
        others,
        parameter,
        remainder[kept],
        uncertain.restricted(others).spread,
        tuple(masses),
        np.repeat(np.array(list(product((-1.0, 1.0), repeat=len(masses)))), len(model.label), axis=0),
        network,
        np.tile(model.interface, copies),
        np.tile(model.label, copies),
        internal,
        np.concatenate([block[4] for block in blocks], axis=1),
        np.concatenate([block[5] for block in blocks], axis=2),
        fillings=tuple(fillings),
        shake=uncertain.shake,
    )


def _of(parameter: Parameter, body: Body) -> bool:
    return parameter.owner == body.name


def _filling(
    model: _RowModel, body: Body, within: list[Parameter], half: Deviation, signs: Mapping[Parameter, int]
) -> Filling:
    """The contribution of one body's unknown contents to the rows, for each combination of extreme masses."""
    deviation = {p: sign * half[p] for p, sign in signs.items()}
    mass = body.inertial.mass + sum(value for p, value in deviation.items() if _of(p, body))
    rows = mass * model.of_moments(body, deviation) / model.weights(deviation)[:, None]
    mean = np.array([half.get(Parameter(body.name, "com", axis), 0.0) for axis in "xyz"])
    nominal = np.concatenate([np.zeros(3), moments_of_inertia(body.inertial.inertia_com) / mass])
    # Derivatives in half-ranges: the centre of mass is the mean, the inertia (about B) is linear in second moments.
    per, less = np.zeros((len(within), 9)), np.zeros(len(within))
    for k, p in enumerate(within):
        entry = p.entry - 1 if p.entry is not None else 0
        per[k] = np.eye(9)[entry] if p.kind == "com" else np.append(np.zeros(3), mass * INERTIA_OF_MOMENTS[entry - 3])
        per[k] /= half[p]
        less[k] = per[k] @ nominal
    count = rows.shape[1]
    return Filling(
        Hull.of(body.points_B),
        mean,
        rows,
        np.tile(nominal, (count, 1)),
        tuple(within),
        np.repeat(per[:, None], count, axis=1),
        less,
    )


def _placed(
    model: _RowModel,
    filling: Filling,
    body: Body,
    places: list[Parameter],
    half: Deviation,
    corners: list[dict[Parameter, int]],
) -> list[Array]:
    """Bounds (9, n, 12) of the products of a position or tilt and a moment of the contents, for each of the former."""
    found = []
    for p in places:
        blocks = []
        for signs in corners:
            base = {m: sign * half[m] for m, sign in signs.items()}
            mass = body.inertial.mass + sum(value for m, value in base.items() if _of(m, body))
            change = model.of_moments(body, base | {p: half[p]}) - model.of_moments(body, base | {p: -half[p]})
            blocks.append(0.5 * mass * change / model.weights(base)[:, None])
        found.append(np.concatenate(blocks, axis=1) * filling.farthest[:, None, None])
    return found


class _RowModel:
    """The function c(p) of one network: its rows (n, 12) at any values of the uncertain parameters."""

    def __init__(self, network: ContactNetwork, asked: list[tuple[Array, Labels]]) -> None:
        self.network = network
        self.facets = [rows for rows, _ in asked]
        self.interface = np.repeat(np.arange(len(asked)), [len(rows) for rows in self.facets])
        self.label = np.concatenate([label for _, label in asked])
        self._known: dict[tuple[object, ...], tuple[Array, Array]] = {}
        self._tilted: dict[tuple[object, ...], Array] = {}

    def _maps(self, body: Body, deviation: Deviation) -> tuple[Array, Array]:
        """Maps of a body, cached: from w to its wrench at E (6, 12), and from wrenches at E to wrenches at B (6, 6)."""
        key = (body.name, *(each for each in deviation.items() if _of(each[0], body)))
        if key not in self._known:
            place = body.place_at(deviation)
            down = to_tray(place, body.R_EB)
            need = down @ wrench_map(body.phi_at(deviation)) @ frame_map(place, body.R_EB)
            self._known[key] = need, np.asarray(np.linalg.inv(down), dtype=float)
        return self._known[key]

    def _tilt(self, deviation: Deviation) -> Array:
        """Map (12, 12) from w of the assumed tray frame to w of the real, tilted one."""
        key = tuple(deviation.get(tilt) for tilt in TILT)
        if key not in self._tilted:
            self._tilted[key] = frame_map(np.zeros(3), tilt_at(deviation))
        return self._tilted[key]

    def _required(self, deviation: Deviation) -> Array:
        """Maps (m, 6, 12) from w to the wrench at E that each body needs."""
        return np.array([self._maps(body, deviation)[0] for body in self.network.bodies])

    def _carried(self, deviation: Deviation) -> Array:
        """Maps (n_e, 6, 12) from w to the wrench at E that each interface transmits."""
        return np.einsum("ejik,jkw->eiw", self.network.share, self._required(deviation))

    def of_moments(self, body: Body, deviation: Deviation) -> Array:
        """Rows (9, n, 12) for each moment of a unit mass in one body: E x, then six second moments, about B."""
        j, place = self.network.bodies.index(body), body.place_at(deviation)
        down, seen = to_tray(place, body.R_EB), frame_map(place, body.R_EB)
        facets = self.facets_at_tray(deviation)
        found = []
        for phi in np.vstack([np.eye(10)[1:4], np.hstack([np.zeros((6, 4)), INERTIA_OF_MOMENTS.T])]):
            wrench = down @ wrench_map(phi) @ seen
            found.append(np.concatenate([r @ self.network.share[e, j] @ wrench for e, r in enumerate(facets)]))
        return np.array(found) @ self._tilt(deviation)

    def facets_at_tray(self, deviation: Deviation) -> list[Array]:
        """Facet rows (n_f, 6) of each interface for wrenches at E."""
        out = []
        for interface, rows in zip(self.network.interfaces, self.facets, strict=True):
            out.append(rows @ self._maps(self.network.bodies[interface.upper], deviation)[1])
        return out

    def weights(self, deviation: Deviation) -> Array:
        """Divisor (n,) of each row: the normal force of its interface at rest on a level tray, N."""
        return (self._carried(deviation) @ at_rest())[self.interface, 2]

    def rows(self, deviation: Deviation) -> Array:
        """c(p) (n, 12), N, at a deviation of the uncertain parameters from nominal."""
        carried = self._carried(deviation)
        rows = np.concatenate([r @ carried[e] for e, r in enumerate(self.facets_at_tray(deviation))])
        return rows @ self._tilt(deviation)


def _expand(
    model: _RowModel, acting: tuple[Parameter, ...], half: Deviation, signs: Mapping[Parameter, int]
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """c_0, c_k, d_l, the effects of internal wrenches and of wrenches on the bodies, and how much positions change the
    latter, at one set of extreme masses.

    c is quadratic in all parameters except the tilt, so that differences over the half-ranges give its terms exactly;
    the tilt is expanded to second order (relative error below tilt^3 / 6).
    """
    base = {p: sign * half[p] for p, sign in signs.items()}

    def at(*moves: tuple[Parameter, int]) -> Array:
        return model.rows(base | {p: sign * half[p] for p, sign in moves})

    centre = at()
    up, down = [at((p, 1)) for p in acting], [at((p, -1)) for p in acting]
    linear = [0.5 * (a - b) for a, b in zip(up, down, strict=True)]
    # A square varies between 0 and its full value; the middle of that range is added to the centre.
    half_square = [0.5 * (0.5 * (a + b) - centre) for a, b in zip(up, down, strict=True)]
    mixed = [
        at((acting[i], 1), (acting[j], 1)) - up[i] - up[j] + centre
        for i, j in combinations(range(len(acting)), 2)
        if _interact(acting[i], acting[j])
    ]
    weight = model.weights(base)
    shape = (-1, len(weight), N_MOTION)
    facets = list(enumerate(model.facets_at_tray(base)))
    internal = np.concatenate([rows @ model.network.internal[e] for e, rows in facets])

    def wrench(*moves: tuple[Parameter, int]) -> Array:
        rows = model.facets_at_tray(base | {p: sign * half[p] for p, sign in moves})
        each = zip(rows, model.network.share, strict=True)
        return np.concatenate([np.einsum("ni,jik->jnk", facet, share) for facet, share in each], axis=1)

    places = [p for p in acting if p.kind == "position" and len(model.network.bodies) > 1]
    by_place = [0.5 * (wrench((p, 1)) - wrench((p, -1))) for p in places]
    return (
        (centre + sum(half_square)) / weight[:, None],
        np.array(linear).reshape(shape) / weight[:, None],
        np.array(half_square + mixed).reshape(shape) / weight[:, None],
        internal / weight[:, None],
        wrench() / weight[:, None],
        np.reshape(by_place, (len(places), len(model.network.bodies), len(weight), 6)) / weight[:, None],
    )


def _interact(first: Parameter, second: Parameter) -> bool:
    """Whether c can contain the product of two parameters: of one body, or with a position or the tray's tilt."""
    return first.owner == second.owner or first.places or second.places
