"""The exact contact condition of all objects on the tray, as constraints linear in the tray's motion regressor.

With w of `salver.models.tray_motion` at the tray frame E, each facet of each interface's contact wrench cone is
    c(p) . w <= 0,
with c a polynomial of the uncertain parameters p; `salver.models.uncertain.worst_case` takes its worst case. That is
exact for mass, centre of mass and inertia of a single object on a tray that does not turn. Friction enters through its
least value (a smaller cone lies inside the larger), position through the area that every placement keeps, mass through
its two extreme values, and contents that are not known through `salver.models.uncertain.contents`.
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

MOST_GENERATORS = 256  # points times edges of one contact: at most some 12 000 facets
_MOST_MASSES = 3  # so many uncertain masses in one network are taken at all their extreme values


@dataclass(frozen=True)
class ContactRows(UncertainRows):
    """Contact constraints of one network of touching bodies.

    Rows are divided by the normal force that the interface carries at rest on a level tray: a value of -0.2 means
    that a disturbance of a fifth of that weight leads out of the cone.
    network: the bodies and interfaces. interface: (n,) index of each row's interface. label: (n,) what kind of
    row it is; of the cone's facets, whether friction limits them.
    internal: (n, n_w) effect of the network's internal wrenches on the rows, which are at zero in `worst`; zero
    when positions are uncertain, because where those wrenches act is then unknown too.
    wrench: (m, n, 6) effect on the rows of a wrench at E, in E, that each of the m bodies needs beyond its own.
    """

    network: ContactNetwork
    interface: Indices
    label: npt.NDArray[Any]
    internal: Array
    wrench: Array


@lru_cache(maxsize=8)
def contact_rows(payload: Payload) -> tuple[ContactRows, ...]:
    """The rows of every network, over w of the tray frame E and the payload's uncertain set; worked out once.

    A plan keeps `rows.worst(w) <= -margin`. `payload.nominal` and `payload.with_edges` answer other questions.
    Raises ScenarioError when an object may stand beside its support (`Payload.check_places`), or when its contact has
    so many points and edges that the cone's facets cannot be worked with.
    """
    payload.check_places()
    for body in payload.bodies:
        most, edges = max(body.regions), body.contacts.edges
        if most * edges > MOST_GENERATORS:
            raise ScenarioError(
                f"contact.edges = {edges} with the {most} contact points of {body.name} makes too many facets for the "
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
    network: ContactNetwork,
    uncertain: UncertainSet,
    tray_half: Array,
    rows_of: RowsOf = cone_rows,
    per_weight: bool = True,
) -> ContactRows:
    """Contact constraints of one network.

    rows_of: what is asked of each interface, linear in the wrench at B of the upper body; its facets, unless another
    question is to be answered over the same uncertain set. per_weight: divided by the normal force at rest.
    """
    half = uncertain.ranges
    shift = shift_ranges(network, uncertain)
    contacts = sure_contacts(network, tray_half, uncertain)
    model = _RowModel(network, [rows_of(c) for c in contacts], per_weight)
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
        fillings=tuple(fillings),
        shake=uncertain.shake,
    )


def _of(parameter: Parameter, body: Body) -> bool:
    return parameter.owner == body.name


def _filling(
    model: _RowModel, body: Body, within: list[Parameter], half: Deviation, signs: Mapping[Parameter, int]
) -> Filling:
    """What the contents of one body add to the rows at extreme masses."""
    deviation = {p: sign * half[p] for p, sign in signs.items()}
    mass = body.inertial.mass + sum(value for p, value in deviation.items() if _of(p, body))
    rows = mass * model.of_moments(body, deviation) / model.weights(deviation)[:, None]
    mean = np.array([half.get(Parameter(body.name, "com", axis), 0.0) for axis in "xyz"])
    nominal = np.concatenate([np.zeros(3), moments_of_inertia(body.inertial.inertia_com) / mass])
    # In half-ranges: a centre of mass is the mean itself, an inertia (about B's origin) is linear in second moments.
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
    """Products of a place and a moment of the contents (9, n, 12), one by one, each at the largest both can be."""
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
    """c(p) of one network: its rows (n, 12) at any values of the uncertain parameters."""

    def __init__(self, network: ContactNetwork, asked: list[tuple[Array, Labels]], per_weight: bool) -> None:
        self.network = network
        self.per_weight = per_weight
        self.facets = [rows for rows, _ in asked]
        self.interface = np.repeat(np.arange(len(asked)), [len(rows) for rows in self.facets])
        self.label = np.concatenate([label for _, label in asked])
        self._known: dict[tuple[object, ...], tuple[Array, Array]] = {}
        self._tilted: dict[tuple[object, ...], Array] = {}

    def _maps(self, body: Body, deviation: Deviation) -> tuple[Array, Array]:
        """(6, 12) wrench at E that a body needs, and (6, 6) from wrenches at E to those at its B; by its own parameters
        alone, of which few are apart from nominal at a time."""
        key = (body.name, *(each for each in deviation.items() if _of(each[0], body)))
        if key not in self._known:
            place = body.place_at(deviation)
            down = to_tray(place, body.R_EB)
            need = down @ wrench_map(body.phi_at(deviation)) @ frame_map(place, body.R_EB)
            self._known[key] = need, np.asarray(np.linalg.inv(down), dtype=float)
        return self._known[key]

    def _tilt(self, deviation: Deviation) -> Array:
        """(12, 12) what the tray feels as the real, tilted one does."""
        key = tuple(deviation.get(tilt) for tilt in TILT)
        if key not in self._tilted:
            self._tilted[key] = frame_map(np.zeros(3), tilt_at(deviation))
        return self._tilted[key]

    def _required(self, deviation: Deviation) -> Array:
        """(m, 6, 12) wrench at E that each body needs."""
        return np.array([self._maps(body, deviation)[0] for body in self.network.bodies])

    def _carried(self, deviation: Deviation) -> Array:
        """(n_e, 6, 12) wrench at E that each interface carries."""
        return np.einsum("ejik,jkw->eiw", self.network.share, self._required(deviation))

    def of_moments(self, body: Body, deviation: Deviation) -> Array:
        """(9, n, 12) rows per unit of each moment (E x, and six second ones, about B) of a unit mass in one body."""
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
        """(n,) what rows are divided by: the normal force at rest on a level tray of each row's interface, N."""
        if not self.per_weight:
            return np.ones(len(self.interface))
        return (self._carried(deviation) @ at_rest())[self.interface, 2]

    def rows(self, deviation: Deviation) -> Array:
        """c(p) (n, 12) at parameters that deviate from nominal, in N."""
        carried = self._carried(deviation)
        rows = np.concatenate([r @ carried[e] for e, r in enumerate(self.facets_at_tray(deviation))])
        return rows @ self._tilt(deviation)


def _expand(
    model: _RowModel, acting: tuple[Parameter, ...], half: Deviation, signs: Mapping[Parameter, int]
) -> tuple[Array, Array, Array, Array, Array]:
    """c_0, c_k, d_l, the internal columns and those of wrenches on the bodies, around the masses at their extremes.

    c is quadratic in all parameters but the tilt, so differences over the half-ranges give its terms exactly;
    tilt is cut off after the second order (relative error below tilt^3 / 6).
    """
    base = {p: sign * half[p] for p, sign in signs.items()}

    def at(*moves: tuple[Parameter, int]) -> Array:
        return model.rows(base | {p: sign * half[p] for p, sign in moves})

    centre = at()
    up, down = [at((p, 1)) for p in acting], [at((p, -1)) for p in acting]
    linear = [0.5 * (a - b) for a, b in zip(up, down, strict=True)]
    # A square varies between nothing and its full value: its middle belongs to the centre.
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
    wrench = np.concatenate([np.einsum("ni,jik->jnk", rows, model.network.share[e]) for e, rows in facets], axis=1)
    return (
        (centre + sum(half_square)) / weight[:, None],
        np.array(linear).reshape(shape) / weight[:, None],
        np.array(half_square + mixed).reshape(shape) / weight[:, None],
        internal / weight[:, None],
        wrench / weight[:, None],
    )


def _interact(first: Parameter, second: Parameter) -> bool:
    """Whether a product of two parameters can occur: of one body, or through positions and the tray's tilt."""
    return first.owner == second.owner or first.places or second.places
