"""The exact contact condition of everything on the tray as rows that are linear in what the tray feels.

With w of `salver.models.tray_motion` at the tray frame E, each facet of each interface's contact wrench cone is
    c(p) . w <= 0,
with c a polynomial of the uncertain parameters p. Its worst case over the uncertain set is

    c_0 . w + sum_k |c_k . w| + sum_l |d_l . w|      (box)
    c_0 . w + |(c_k . w)_k| + sum_l |d_l . w|        (ellipsoid)

with c_k the linear terms times half-ranges and d_l all products of two parameters. Terms are bounded one by
one, so it is never too optimistic. It is exact for mass, centre of mass and inertia of a single object on a
tray that does not turn. It is convex in w: at fixed orientation, convex in the acceleration. Friction enters
through its least value (a smaller cone lies inside the larger), position through the area that every placement
keeps, mass through its two extreme values: a cone has no scale, and bounding mass and centre of mass one by
one would count both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from salver.errors import ScenarioError
from salver.geometry import Array, exp
from salver.models.bodies import bodies, uncertain_set
from salver.models.contact import ContactSet
from salver.models.interfaces import ContactNetwork, networks, regions_lost, shift_ranges, sure_contacts, to_tray
from salver.models.parameters import INERTIAL, UncertainSet, inertial_vector, phi_of
from salver.models.tray_motion import N_MOTION, at_rest, frame_map, wrench_map
from salver.models.wrench_cone import cone_facets

if TYPE_CHECKING:
    from salver.scenario import Scenario

MOST_GENERATORS = 256  # points times edges of one contact: at most some 12 000 facets
_MOST_MASSES = 3  # so many uncertain masses in one network are taken at all their extreme values
_CHUNK = 20_000  # terms worked on at once: they fit in the cache, and the product is too small to be threaded


@dataclass(frozen=True)
class ContactRows:
    """Rows of one network of touching bodies. Worst case of row i at w: see `worst`.

    Rows are divided by the normal force that the interface carries at rest on a level tray: a value of -0.2 means
    that a disturbance of a fifth of that weight leads out of the cone.
    network: the bodies and interfaces. interface: (n,) index of each row's interface. label: (n,) what kind of
    row it is; of the cone's facets, whether friction limits them.
    nominal: (n, 12) c_0. names: of the n_p parameters in `parameter` (n_p, n, 12), c_k, per half-range.
    remainder: (n_r, n, 12) d_l. internal: (n, n_w) effect of the network's internal wrenches on the rows; zero
    when positions are uncertain, because where those wrenches act is then unknown too.
    spread: (n_p, n_p), with A A^T the correlation of an ellipsoid; None for a box.
    mass_names, mass_signs: masses that are taken at their extremes, and at which of them (n, n_m) each row is.
    """

    network: ContactNetwork
    interface: npt.NDArray[np.intp]
    label: npt.NDArray[Any]
    nominal: Array
    names: tuple[str, ...]
    parameter: Array
    remainder: Array
    internal: Array
    spread: Array | None
    mass_names: tuple[str, ...]
    mass_signs: Array

    def worst(self, w: Array) -> Array:
        """(T, n) worst case over the uncertain set of every row at w (T, 12); internal wrenches at zero."""
        n, n_p = len(self.nominal), len(self.parameter)
        felt = np.any(w != 0, axis=0)  # a tray that does not turn feels three of the twelve
        columns = np.concatenate([self.parameter, self.remainder])[:, :, felt]
        columns = columns[np.any(columns, axis=(1, 2)) | (np.arange(len(columns)) < n_p)]
        flat = np.ascontiguousarray(columns.reshape(-1, columns.shape[2]).T)
        nominal = np.ascontiguousarray(self.nominal[:, felt].T)
        value = np.empty((len(w), n))
        chunk = max(1, _CHUNK // max(n, flat.shape[1]))
        for start in range(0, len(w), chunk):
            part = np.ascontiguousarray(w[start : start + chunk, felt])
            np.matmul(part, nominal, out=value[start : start + chunk])
            if len(columns) == 0:
                continue
            terms = (part @ flat).reshape(-1, len(columns), n)
            if self.spread is not None and n_p:
                factored = np.tensordot(terms[:, :n_p], self.spread, axes=(1, 0))
                terms[:, 0] = np.sqrt(np.square(factored).sum(axis=-1))
                terms[:, 1:n_p] = 0.0
            value[start : start + chunk] += np.abs(terms, out=terms).sum(axis=1)
        return value

    def worst_point(self, w: Array, row: int) -> dict[str, float]:
        """The point of the unit box or ball (by parameter name, in half-ranges) that is worst for a row at w (12,).

        To first order around the centre; products of parameters do not count.
        """
        slope = self.parameter[:, row] @ w
        if self.spread is None:
            s = np.where(slope >= 0, 1.0, -1.0)
        else:
            factored = self.spread.T @ slope
            s = self.spread @ factored / max(float(np.linalg.norm(factored)), 1e-300)
        point = dict(zip(self.names, s.tolist(), strict=True))
        return point | dict(zip(self.mass_names, self.mass_signs[row].tolist(), strict=True))

    def seen_from(self, p_EX: Array, R_EX: Array) -> ContactRows:
        """The same rows for w of another frame X that is fixed to the tray, for example an object's B."""
        back = frame_map(-R_EX.T @ p_EX, R_EX.T)
        return replace(
            self, nominal=self.nominal @ back, parameter=self.parameter @ back, remainder=self.remainder @ back
        )


def contact_rows(scenario: Scenario, *, robust: bool = True, edges: int | None = None) -> tuple[ContactRows, ...]:
    """The rows of every network of a scenario, over w of the tray frame E.

    robust: over the scenario's uncertain set; otherwise nominal parameters. edges: of the linearised friction
    cones, the scenario's own unless given. A plan keeps `rows.worst(w) <= -scenario.contact.margin`.
    Raises ScenarioError when an object may stand beside its support (`check_places`), or when its contact has so
    many points and edges that the cone's facets cannot be worked with.
    """
    if robust:
        check_places(scenario)
    if edges is not None and edges != scenario.contact.edges:
        scenario = scenario.model_copy(update={"contact": scenario.contact.model_copy(update={"edges": edges})})
    items = bodies(scenario)
    for body in items:
        most = max(body.regions)
        if most * scenario.contact.edges > MOST_GENERATORS:
            raise ScenarioError(
                f"{scenario.name}: contact.edges = {scenario.contact.edges} with the {most} contact points of "
                f"{body.name} makes too many facets for the exact condition; their product must be at most "
                f"{MOST_GENERATORS}."
            )
    uncertain = uncertain_set(scenario) if robust else UncertainSet((), np.zeros(0), np.zeros(0))
    several = len(items) > 1
    return tuple(
        network_rows(network, uncertain, several, 0.5 * np.array(scenario.tray.size)) for network in networks(items)
    )


def check_places(scenario: Scenario) -> None:
    """Raise ScenarioError when an uncertain position can leave nothing of a contact region: no motion is safe then."""
    uncertain, several = uncertain_set(scenario), len(scenario.objects) > 1
    half = dict(zip(uncertain.names, uncertain.half_range, strict=True))
    if not any(half[name] for name in uncertain.names if name.endswith(("position_x", "position_y"))):
        return
    for network in networks(bodies(scenario)):
        shift = shift_ranges(network, half, name_prefixes(network, several))
        for name in regions_lost(network, 0.5 * np.array(scenario.tray.size), shift):
            raise ScenarioError(
                f"{scenario.name}: with its uncertainty.position an object may stand beside its support ({name}); the "
                "half-ranges must leave a part of the contact region that is sure."
            )


def name_prefixes(network: ContactNetwork, several: bool) -> dict[str, str]:
    """What stands before a parameter's name, by body."""
    return {body.name: f"{body.name}." if several else "" for body in network.bodies}


Labels = npt.NDArray[Any]
RowsOf = Callable[[ContactSet], tuple[Array, Labels]]


def cone_rows(contacts: ContactSet) -> tuple[Array, Labels]:
    """Facets (n_f, 6) of the contact wrench cone, and which depend on friction (n_f,)."""
    cone = cone_facets(contacts)
    return cone.rows, cone.friction_limited


def network_rows(
    network: ContactNetwork,
    uncertain: UncertainSet,
    several: bool,
    tray_half: Array,
    rows_of: RowsOf = cone_rows,
    per_weight: bool = True,
) -> ContactRows:
    """Rows of one network.

    several: whether parameter names have the object's name in front. rows_of: what is asked of each interface,
    linear in the wrench at B of the upper body; its facets, unless another question is to be answered over the
    same uncertain set. per_weight: divided by the normal force at rest.
    """
    own = name_prefixes(network, several)
    half = dict(zip(uncertain.names, uncertain.half_range, strict=True))
    friction = {b.name: b.friction - half.get(own[b.name] + "friction", 0.0) for b in network.bodies}
    shift = shift_ranges(network, half, own)
    contacts = sure_contacts(network, tray_half, friction, shift)
    model = _RowModel(network, [rows_of(c) for c in contacts], own, per_weight)
    acting = [
        name
        for name in uncertain.names
        if not name.endswith("friction")
        and (name in ("tilt_x", "tilt_y") or name.rpartition(".")[0] in own or not several)
    ]
    masses = [name for name in acting if name.endswith("mass")]
    if uncertain.kind == "ellipsoid" or len(masses) > _MOST_MASSES:
        masses = []
    names = tuple(name for name in acting if name not in masses)
    blocks = [
        _expand(model, names, half, dict(zip(masses, signs, strict=True)))
        for signs in product((-1, 1), repeat=len(masses))
    ]
    nominal = np.concatenate([block[0] for block in blocks])
    parameter = np.concatenate([block[1] for block in blocks], axis=1)
    remainder = np.concatenate([block[2] for block in blocks], axis=1)
    copies = len(blocks)
    spread: Array | None = None
    if uncertain.kind == "ellipsoid":
        part = uncertain.restricted(names)
        spread = np.eye(len(names)) if part.correlation is None else np.asarray(np.linalg.cholesky(part.correlation))
    internal = np.concatenate([block[3] for block in blocks])
    if any(np.any(s) for s in shift.values()):
        internal = internal[:, :0]
    kept = np.abs(remainder).max(axis=(1, 2), initial=0.0) > 1e-12
    return ContactRows(
        network,
        np.tile(model.interface, copies),
        np.tile(model.label, copies),
        nominal,
        names,
        parameter,
        remainder[kept],
        internal,
        spread,
        tuple(masses),
        np.repeat(np.array(list(product((-1.0, 1.0), repeat=len(masses)))), len(model.label), axis=0),
    )


class _RowModel:
    """c(p) of one network: its rows (n, 12) at any values of the uncertain parameters."""

    def __init__(
        self, network: ContactNetwork, asked: list[tuple[Array, Labels]], prefix: dict[str, str], per_weight: bool
    ) -> None:
        self.network = network
        self.prefix = prefix
        self.per_weight = per_weight
        self.facets = [rows for rows, _ in asked]
        self.interface = np.repeat(np.arange(len(asked)), [len(rows) for rows in self.facets])
        self.label = np.concatenate([label for _, label in asked])

    def _place(self, body: int, deviation: dict[str, float]) -> Array:
        """(3,) origin of a body's B in E."""
        own = self.prefix[self.network.bodies[body].name]
        shift = [deviation.get(f"{own}position_{axis}", 0.0) for axis in "xy"]
        return self.network.bodies[body].p_EB + np.array([*shift, 0.0])

    def _required(self, deviation: dict[str, float]) -> Array:
        """(m, 6, 12) wrench at E that each body needs."""
        maps = []
        for j, body in enumerate(self.network.bodies):
            own, place = self.prefix[body.name], self._place(j, deviation)
            inertial = inertial_vector(body.inertial) + [deviation.get(own + name, 0.0) for name in INERTIAL]
            maps.append(to_tray(place, body.R_EB) @ wrench_map(phi_of(inertial)) @ frame_map(place, body.R_EB))
        return np.array(maps)

    def _carried(self, deviation: dict[str, float]) -> Array:
        """(n_e, 6, 12) wrench at E that each interface carries."""
        return np.einsum("ejik,jkw->eiw", self.network.share, self._required(deviation))

    def facets_at_tray(self, deviation: dict[str, float]) -> list[Array]:
        """Facet rows (n_f, 6) of each interface for wrenches at E."""
        out = []
        for interface, rows in zip(self.network.interfaces, self.facets, strict=True):
            upper = self.network.bodies[interface.upper]
            out.append(rows @ np.linalg.inv(to_tray(self._place(interface.upper, deviation), upper.R_EB)))
        return out

    def weights(self, deviation: dict[str, float]) -> Array:
        """(n,) what rows are divided by: the normal force at rest on a level tray of each row's interface, N."""
        if not self.per_weight:
            return np.ones(len(self.interface))
        return (self._carried(deviation) @ at_rest())[self.interface, 2]

    def rows(self, deviation: dict[str, float]) -> Array:
        """c(p) (n, 12) at parameters that deviate from nominal, in N."""
        tilt = exp(np.array([deviation.get("tilt_x", 0.0), deviation.get("tilt_y", 0.0), 0.0]))
        carried = self._carried(deviation)
        rows = np.concatenate([r @ carried[e] for e, r in enumerate(self.facets_at_tray(deviation))])
        return rows @ frame_map(np.zeros(3), tilt)


def _expand(
    model: _RowModel, names: tuple[str, ...], half: dict[str, float], signs: dict[str, int]
) -> tuple[Array, Array, Array, Array]:
    """c_0, c_k, d_l and the internal columns around the masses at their extremes.

    c is quadratic in all parameters but the tilt, so differences over the half-ranges give its terms exactly;
    tilt is cut off after the second order (relative error below tilt^3 / 6).
    """
    base = {name: sign * half[name] for name, sign in signs.items()}

    def at(*moves: tuple[str, int]) -> Array:
        return model.rows(base | {name: sign * half[name] for name, sign in moves})

    centre = at()
    up, down = [at((name, 1)) for name in names], [at((name, -1)) for name in names]
    linear = [0.5 * (a - b) for a, b in zip(up, down, strict=True)]
    # A square varies between nothing and its full value: its middle belongs to the centre.
    half_square = [0.5 * (0.5 * (a + b) - centre) for a, b in zip(up, down, strict=True)]
    mixed = [
        at((names[i], 1), (names[j], 1)) - up[i] - up[j] + centre
        for i, j in combinations(range(len(names)), 2)
        if _interact(names[i], names[j])
    ]
    weight = model.weights(base)
    shape = (-1, len(weight), N_MOTION)
    internal = np.concatenate([rows @ model.network.internal[e] for e, rows in enumerate(model.facets_at_tray(base))])
    return (
        (centre + sum(half_square)) / weight[:, None],
        np.array(linear).reshape(shape) / weight[:, None],
        np.array(half_square + mixed).reshape(shape) / weight[:, None],
        internal / weight[:, None],
    )


def _interact(first: str, second: str) -> bool:
    """Whether a product of two parameters can occur: of one body, or through positions and the tray's tilt."""
    same_body = first.rpartition(".")[0] == second.rpartition(".")[0]
    shared = ("position_x", "position_y", "tilt_x", "tilt_y")
    return same_body or first.endswith(shared) or second.endswith(shared)
