"""How safe a motion of the tray is for everything on it: all margins, over time, nominal and worst case.

For every interface (object on tray, object on object):
- cone coefficients: the least of Lambda = pinv(G F-hat) F, the paper's condition (eq 16), N;
- exact margin: how far inside the contact wrench cone the required wrench is, as a share of the normal force
  at rest; split into the part that friction limits (leaving it: sliding) and the rest (tipping, lifting);
- friction needed: the least coefficient for which the wrench is in the cone;
- tip-over margin: distance of the zero-moment point to the edge of the support polygon, m.

Worst cases are over the scenario's uncertain set, for objects that follow their tray: bounds that are never
too optimistic (see `salver.models.contact_rows`). By how much the closed loop leaves its reference can be added
as a first-order tube (`salver.margins.tracking`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from salver.errors import Status
from salver.geometry import Array, invert
from salver.models.bodies import Body, bodies, uncertain_set
from salver.models.contact import ContactSet
from salver.models.contact_rows import ContactRows, Labels, RowsOf, cone_rows, name_prefixes, network_rows
from salver.models.interfaces import ContactNetwork, Interface, networks, regions_lost, shift_ranges, to_tray
from salver.models.internal_wrench import internal_wrenches
from salver.models.parameters import UncertainSet, phi_jacobian
from salver.models.rigid_body import inertia_entries, regressor
from salver.models.tray_motion import frame_map, motion_vector, wrench_map
from salver.models.wrench_cone import (
    coulomb_friction_needed,
    friction_needed,
    support_rows,
    tip_over_margin,
    unit_friction_rows,
)
from salver.scenario import Scenario

if TYPE_CHECKING:
    from salver.trajectory import MotionSamples

EDGES = 8  # of the friction pyramids, when the scenario asks for fewer: at most 8 % short of the round cone
_NOTHING = UncertainSet((), np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class MarginModel:
    """Everything of a scenario that does not depend on the motion; made once by `margin_model`."""

    scenario: Scenario
    edges: int
    first: Body
    networks: tuple[ContactNetwork, ...]
    uncertain: UncertainSet

    def rows(self, network: int, uncertain: UncertainSet, rows_of: RowsOf, per_weight: bool) -> ContactRows:
        several, half = len(self.scenario.objects) > 1, 0.5 * np.array(self.scenario.tray.size)
        return network_rows(self.networks[network], uncertain, several, half, rows_of, per_weight)

    @cached_property
    def nominal(self) -> tuple[ContactRows, ...]:
        return tuple(self.rows(i, _NOTHING, cone_rows, True) for i in range(len(self.networks)))

    @cached_property
    def robust(self) -> tuple[ContactRows, ...]:
        return tuple(self.rows(i, self.uncertain, cone_rows, True) for i in range(len(self.networks)))

    @cached_property
    def paper(self) -> tuple[tuple[ContactRows, ContactRows], ...]:
        """Rows -pinv(G F-hat), in N: nominal and over the uncertain set, with the scenario's own cone edges."""
        rows_of = _coefficient_rows(self.scenario.contact.edges)
        return tuple(
            (self.rows(i, _NOTHING, rows_of, False), self.rows(i, self.uncertain, rows_of, False))
            for i in range(len(self.networks))
        )

    @cached_property
    def support(self) -> tuple[ContactRows, ...]:
        """Rows of the support polygon's edges in N m, and of f_z and -f_z in N, over the uncertain set."""
        return tuple(self.rows(i, self.uncertain, _edge_rows, False) for i in range(len(self.networks)))

    def with_only(self, names: tuple[str, ...]) -> MarginModel:
        """The same scenario with only these parameters uncertain."""
        return replace(self, uncertain=self.uncertain.restricted(names))


def margin_model(scenario: Scenario, edges: int | None = None) -> MarginModel:
    """The margin model of a scenario; the last few are kept. edges: of the friction pyramids (see `EDGES`)."""
    return _margin_model(scenario.model_dump_json(exclude_none=True), edges or max(EDGES, scenario.contact.edges))


@lru_cache(maxsize=16)
def _margin_model(text: str, edges: int) -> MarginModel:
    scenario = Scenario.model_validate_json(text)
    contact = scenario.contact.model_copy(update={"edges": edges})
    items = bodies(scenario.model_copy(update={"contact": contact}))
    return MarginModel(scenario, edges, items[0], networks(items), uncertain_set(scenario))


def margins(
    scenario: Scenario, samples: MotionSamples, *, edges: int | None = None, tracking: Array | None = None
) -> Margins:
    """All margins of a motion of B, the frame of the scenario's first object (T instants).

    edges: of the friction pyramids, inscribed; 8 unless the scenario has more. tracking: (T, 12, n_p) from
    `tracking_motion`, when the tray does not follow the motion exactly.
    """
    return Margins(margin_model(scenario, edges), samples.t, tray_motion(scenario, samples), tracking)


def tray_motion(scenario: Scenario, samples: MotionSamples) -> Array:
    """w (T, 12) of the tray frame E when the first object's B moves as `samples`."""
    first = bodies(scenario)[0]
    w_B = motion_vector(samples.R_SB, samples.a_S, samples.omega_B, samples.alpha_B)
    return w_B @ frame_map(*invert(first.p_EB, first.R_EB)).T


@dataclass(frozen=True)
class Margins:
    """Margins of everything on the tray along one motion; computed when asked for.

    t (T,); w (T, 12): motion of the tray frame E. tracking: (T, 12, n_p) or None, see `margins`.
    """

    model: MarginModel
    t: Array
    w: Array
    tracking: Array | None = None

    @cached_property
    def interfaces(self) -> tuple[InterfaceMargins, ...]:
        """One for every interface, network by network; within one, in the order of the objects."""
        return tuple(
            InterfaceMargins(self, i, e)
            for i, net in enumerate(self.model.networks)
            for e in range(len(net.interfaces))
        )

    def of(self, name: str) -> tuple[InterfaceMargins, ...]:
        """The interfaces on which an object stands."""
        return tuple(m for m in self.interfaces if m.object == name)

    @cached_property
    def exact(self) -> Array:
        """(T,) least exact margin of all interfaces at nominal parameters, as a share of the normal force."""
        return np.min([-self._values(i)[0].max(axis=1) for i in range(len(self.model.networks))], axis=0)

    @cached_property
    def exact_worst(self) -> Array:
        """(T,) the same in the worst case of the uncertain set."""
        return np.min([-self._worst_values(i)[0].max(axis=1) for i in range(len(self.model.networks))], axis=0)

    def _values(self, network: int) -> tuple[Array, Array]:
        return self._nominal_values[network]

    def _worst_values(self, network: int) -> tuple[Array, Array]:
        return self._robust_values[network]

    @cached_property
    def _nominal_values(self) -> list[tuple[Array, Array]]:
        """Rows (T, n) and internal wrenches (T, n_w) of each network."""
        return [_balanced(rows.worst(self.w), rows) for rows in self.model.nominal]

    @cached_property
    def _robust_values(self) -> list[tuple[Array, Array]]:
        return [_balanced(self._with_tracking(rows), rows) for rows in self.model.robust]

    def _with_tracking(self, rows: ContactRows) -> Array:
        """Worst case of the rows (T, n), with the tube of the tracking error added."""
        value = rows.worst(self.w)
        if self.tracking is not None:
            scaled = self.tracking @ self.model.uncertain.factor
            terms = np.einsum("fk,tkp->tfp", rows.nominal, scaled, optimize=True)
            box = self.model.uncertain.kind == "box"
            value += np.abs(terms).sum(axis=2) if box else np.linalg.norm(terms, axis=2)
        return value

    def verdict(self, worst: bool = False) -> Status:
        """Holds, slides, tips or lifts: the first interface that fails, and when, in one sentence.

        Nominal: with round Coulomb cones. Worst case: with inscribed pyramids over the whole uncertain set, so
        "holds" is sure, "slides" and "tips" say that it cannot be excluded.
        """
        failures = [f for m in self.interfaces if (f := m.failure(worst)) is not None]
        case = "in the worst case of the uncertain parameters " if worst else ""
        lost = [name for net in self.model.networks for name in self._lost(net)] if worst else []
        if lost:
            sentence = f"{lost[0]} may stand beside it: the uncertain position is as large as the contact region."
            return Status("tips", sentence, False, {"interface": lost[0], "time": float(self.t[0])})
        if failures:
            time, _, code, m = min(failures, key=lambda f: (f[0], f[1]))
            sentence = f"{m.name} {case}{code} at {time:.3f} s: {m.reason(code, time, worst)}."
            return Status(code, sentence[0].upper() + sentence[1:], False, {"interface": m.name, "time": time})
        least = min(self.interfaces, key=lambda m: float((m.exact_worst if worst else m.exact).min()))
        margin = least.exact_worst if worst else least.exact
        k = int(np.argmin(margin))
        sentence = (
            f"Everything holds{' ' + case.rstrip() if case else ''}; the least margin is "
            f"{100 * max(0.0, float(margin[k])):.1f} % of the weight ({least.name}, at {self.t[k]:.3f} s)."
        )
        details = {"interface": least.name, "time": float(self.t[k]), "margin": float(margin[k])}
        return Status("holds", sentence, True, details)

    def _lost(self, network: ContactNetwork) -> list[str]:
        several = len(self.model.scenario.objects) > 1
        half = dict(zip(self.model.uncertain.names, self.model.uncertain.half_range, strict=True))
        shift = shift_ranges(network, half, name_prefixes(network, several))
        return regions_lost(network, 0.5 * np.array(self.model.scenario.tray.size), shift)

    def costs(self) -> dict[str, float]:
        """What each uncertain parameter, alone, takes from the least exact margin (share of the normal force)."""
        least = float(self.exact.min())
        return {
            name: least - float(Margins(self.model.with_only((name,)), self.t, self.w).exact_worst.min())
            for name in self.model.uncertain.names
        }


@dataclass(frozen=True)
class InterfaceMargins:
    """Margins of one object on one support. Arrays (T,), time first; `_worst` over the uncertain set."""

    whole: Margins
    network: int
    index: int

    @property
    def interface(self) -> Interface:
        return self.whole.model.networks[self.network].interfaces[self.index]

    @property
    def name(self) -> str:
        """Such as "cup1 on tray"."""
        return self.interface.name

    @property
    def object(self) -> str:
        return self.whole.model.networks[self.network].bodies[self.interface.upper].name

    @property
    def t(self) -> Array:
        return self.whole.t

    @property
    def friction(self) -> float:
        return float(self.interface.contacts.friction[0])

    @cached_property
    def wrench_B(self) -> Array:
        """(T, 6) what the support must give, at nominal parameters, at B of the object, N and N m."""
        network = self.whole.model.networks[self.network]
        required = [
            to_tray(b.p_EB, b.R_EB) @ wrench_map(b.inertial.phi) @ frame_map(b.p_EB, b.R_EB) for b in network.bodies
        ]
        wrench_E = self.whole.w @ np.einsum("jik,jkw->iw", network.share[self.index], np.array(required)).T
        if not network.determinate:
            wrench_E = wrench_E + self.whole._values(self.network)[1] @ network.internal[self.index].T
        upper = network.bodies[self.interface.upper]
        return np.asarray(wrench_E @ np.linalg.inv(to_tray(upper.p_EB, upper.R_EB)).T)

    def _margin(self, rows: ContactRows, value: Array, limited: bool | None) -> Array:
        chosen = rows.interface == self.index
        if limited is not None:
            chosen = chosen & (rows.label == limited)
        return -value[:, chosen].max(axis=1, initial=-np.inf)

    @cached_property
    def exact(self) -> Array:
        return self._margin(self.whole.model.nominal[self.network], self.whole._values(self.network)[0], None)

    @cached_property
    def exact_worst(self) -> Array:
        return self._margin(self.whole.model.robust[self.network], self.whole._worst_values(self.network)[0], None)

    @cached_property
    def sliding_worst(self) -> Array:
        """Margin of the facets that depend on friction."""
        return self._margin(self.whole.model.robust[self.network], self.whole._worst_values(self.network)[0], True)

    @cached_property
    def tipping_worst(self) -> Array:
        """Margin of the facets that do not depend on friction."""
        return self._margin(self.whole.model.robust[self.network], self.whole._worst_values(self.network)[0], False)

    @cached_property
    def cone_coefficient(self) -> Array:
        """Least coefficient Lambda of the pseudo-inverse distribution, N: the paper's condition."""
        rows = self.whole.model.paper[self.network][0]
        return self._margin(rows, rows.worst(self.whole.w), None)

    @cached_property
    def cone_coefficient_worst(self) -> Array:
        rows = self.whole.model.paper[self.network][1]
        return self._margin(rows, self.whole._with_tracking(rows), None)

    @property
    def _internal_worst(self) -> Array:
        return self.whole._worst_values(self.network)[1]

    @cached_property
    def friction_needed(self) -> Array:
        """For friction pyramids, inscribed: at most 1/cos(pi / edges) above the round cone's."""
        return friction_needed(self.interface.contacts, self.wrench_B)

    @cached_property
    def tip_over(self) -> Array:
        """m, see `tip_over_margin`."""
        return tip_over_margin(self.interface.contacts, self.wrench_B)

    @cached_property
    def tip_over_worst(self) -> Array:
        """m: least distance over the uncertain set (a bound)."""
        rows = self.whole.model.support[self.network]
        value = self.whole._with_tracking(rows) + self._internal_worst @ rows.internal.T
        own = np.flatnonzero(rows.interface == self.index)
        kind = rows.label[own]
        beyond = value[:, own[kind == 0]].max(axis=1)
        most, least = value[:, own[kind == 1]].max(axis=1), -value[:, own[kind == 2]].max(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(least > 0, -beyond / np.where(beyond > 0, least, most), -np.inf)

    @cached_property
    def friction_needed_worst(self) -> float:
        """Least coefficient (of this interface) that keeps the whole motion from sliding in the worst case.

        Infinite when no friction would do. By bisection to 1e-4, on the facets with the coefficient taken out.
        """
        if float(self.tipping_worst.min()) < -_TOLERANCE:
            return float("inf")
        model = self.whole.model
        rows = model.rows(self.network, model.uncertain, _friction_rows, False)
        own = np.flatnonzero(rows.interface == self.index)
        tangential, normal = (_only(rows, own[rows.label[own] == kind]) for kind in (0, 1))
        w, tracking, w_0 = self.whole.w, self.whole.tracking, self._internal_worst
        low, high = 0.0, 5.0

        def fails(mu: float, keep: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
            at_mu = _combined(tangential, normal, mu)
            part = replace(self.whole, w=w[keep], tracking=None if tracking is None else tracking[keep])
            return np.asarray((part._with_tracking(at_mu) + w_0[keep] @ at_mu.internal.T).max(axis=1) > 0)

        candidates = np.arange(len(w))
        if fails(high, candidates).any():
            return float("inf")
        while high - low > 1e-4:
            middle = 0.5 * (low + high)
            failing = fails(middle, candidates)
            if failing.any():
                low, candidates = middle, candidates[failing]
            else:
                high = middle
        return high

    @property
    def least_friction(self) -> float:
        """Of the uncertain set."""
        uncertain = self.whole.model.uncertain
        name = f"{self.object}.friction" if len(self.whole.model.scenario.objects) > 1 else "friction"
        if name not in uncertain.names:
            return self.friction
        return self.friction - float(uncertain.half_range[uncertain.names.index(name)])

    def failure(self, worst: bool) -> tuple[float, int, str, InterfaceMargins] | None:
        """(time, order, code, self) of the first failure, or None."""
        if worst:
            tips, slides = self.tipping_worst < -_TOLERANCE, self.sliding_worst < -_TOLERANCE
            lifts = tips & np.isneginf(self.tip_over_worst)
        else:
            tips, slides = np.asarray(self.tip_over < 0), self._slides()
            lifts = np.isneginf(self.tip_over)
        for k in np.flatnonzero(tips | slides)[:1]:
            code = "lifts" if lifts[k] else "tips" if tips[k] else "slides"
            return float(self.t[k]), self.index, code, self
        return None

    def _slides(self) -> npt.NDArray[np.bool_]:
        """(T,) whether the round cone is left; the programme for it only where pyramids leave it open."""
        needed, mu = self.friction_needed, self.friction * (1 + _TOLERANCE)
        slides = needed * np.cos(np.pi / self.interface.contacts.edges) > mu
        unclear = np.flatnonzero(~slides & (needed > mu) & np.isfinite(needed))
        # Only an unclear instant before the first clear one can change the verdict.
        first = int(np.argmax(slides)) if slides.any() else len(slides)
        for k in unclear[unclear < first]:
            if coulomb_friction_needed(self.interface.contacts, self.wrench_B[k])[0] > mu:
                slides[k] = True
                break
        return slides

    def reason(self, code: str, time: float, worst: bool) -> str:
        """Why it fails, with figures."""
        k = int(np.searchsorted(self.t, time))
        if code == "lifts":
            return "nothing presses it on its support"
        if code == "tips":
            distance = -float((self.tip_over_worst if worst else self.tip_over)[k])
            return f"its zero-moment point is {1e3 * distance:.1f} mm beyond the edge of its support"
        if worst:
            needed = self.friction_needed_worst
            much = f"friction {needed:.3f}" if np.isfinite(needed) else "more friction than any"
            return f"the motion needs {much} where at least {self.least_friction:.3f} is sure"
        needed = float(coulomb_friction_needed(self.interface.contacts, self.wrench_B[k])[0])
        return f"it needs friction {needed:.3f} and has {self.friction:.3f}"


_TOLERANCE = 1e-9


def _balanced(value: Array, rows: ContactRows) -> tuple[Array, Array]:
    """Rows with the best internal wrenches added, and those wrenches (T, n_w)."""
    w_0 = internal_wrenches(value, rows.internal)
    return value + w_0 @ rows.internal.T, w_0


def _coefficient_rows(edges: int) -> RowsOf:
    def rows(contacts: ContactSet) -> tuple[Array, Labels]:
        distribution = np.linalg.pinv(replace(contacts, edges=edges).grasp_map)
        return -distribution, np.zeros(len(distribution), dtype=bool)

    return rows


def _edge_rows(contacts: ContactSet) -> tuple[Array, Labels]:
    """Edges (label 0, N m), f_z (1, N) and -f_z (2, N)."""
    edges, normal = support_rows(contacts)
    return np.vstack([edges, normal, -normal]), np.array([0] * len(edges) + [1, 2])


def _friction_rows(contacts: ContactSet) -> tuple[Array, Labels]:
    """Tangential (label 0) and normal (1) parts of the facets that friction limits."""
    tangential, normal = unit_friction_rows(contacts)
    return np.vstack([tangential, normal]), np.array([0] * len(tangential) + [1] * len(normal))


def _only(rows: ContactRows, index: npt.NDArray[np.intp]) -> ContactRows:
    return replace(
        rows,
        interface=rows.interface[index],
        label=rows.label[index],
        nominal=rows.nominal[index],
        parameter=rows.parameter[:, index],
        remainder=rows.remainder[:, index],
        internal=rows.internal[index],
    )


def _combined(tangential: ContactRows, normal: ContactRows, mu: float) -> ContactRows:
    """Facets at coefficient mu."""
    return replace(
        normal,
        nominal=tangential.nominal / mu + normal.nominal,
        parameter=tangential.parameter / mu + normal.parameter,
        remainder=tangential.remainder / mu + normal.remainder,
        internal=tangential.internal / mu + normal.internal,
    )


def tracking_motion(scenario: Scenario, samples: MotionSamples, state: Array, wrench: Array) -> Array:
    """First-order change (T, 12, n_p) of the tray motion w when the closed loop meets other parameters.

    state: Pi (T, 12, n_p); wrench: d wrench_B / dp (T, 6, n_p) of the first object, both of the closed loop at
    the uncertain parameters of the scenario (Plan.state_sensitivity; grasp_map @ Plan.input_sensitivity).
    What of the wrench's change is not due to the parameters themselves is due to the motion's.
    """
    first, uncertain = bodies(scenario)[0], uncertain_set(scenario)
    prefix = f"{first.name}." if len(scenario.objects) > 1 else ""
    own = tuple(n.removeprefix(prefix) if n.startswith(prefix) else "" for n in uncertain.names)
    y = regressor(samples.R_SB, samples.a_S, samples.omega_B, samples.alpha_B)
    moved = wrench - y @ phi_jacobian(first.inertial, own)
    omega, domega = samples.omega_B, np.swapaxes(state[:, 9:], 1, 2)
    inertia = first.inertial.inertia_com
    gyroscopic = np.cross(domega, (omega @ inertia)[:, None]) + np.cross(omega[:, None], domega @ inertia)
    dalpha = (np.swapaxes(moved[:, 3:], 1, 2) - gyroscopic) @ np.linalg.inv(inertia)
    products = omega[:, None, :, None] * domega[:, :, None, :]
    products = inertia_entries(products + np.swapaxes(products, 2, 3))
    dforce = np.swapaxes(moved[:, :3], 1, 2) / first.inertial.mass
    dw_B = np.concatenate([dforce, dalpha, products], axis=2)
    return np.swapaxes(dw_B @ frame_map(*invert(first.p_EB, first.R_EB)).T, 1, 2)
