"""Margins of one interface along a motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from salver.contact_margins.root_finding import zero_between
from salver.contact_margins.values import TOLERANCE, RowValues
from salver.geometry import Array, Mask
from salver.models.contact.contact import ContactSet
from salver.models.contact.wrench_cone import friction_needed, tip_over_margin
from salver.models.contact_rows import ContactRows, Labels, cone_rows
from salver.models.interfaces import Interface, needed_at_tray, to_tray

HIGHEST = 5.0  # friction coefficient beyond which no contact is looked at
_FINE = 32  # edges of the pyramids of the nominal verdict: at most 0.5 % short of the round cone


@dataclass(frozen=True)
class InterfaceMargins:
    """Margins of one object on one support. Arrays (T,), time first; `_worst` over the uncertain set."""

    whole: RowValues
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
        """Wrench (T, 6) from the support at nominal parameters, at and in B of the object, N and N m."""
        network = self.whole.model.networks[self.network]
        required = [needed_at_tray(body, body.inertial.phi) for body in network.bodies]
        wrench_E = self.whole.w @ np.einsum("jik,jkw->iw", network.share[self.index], np.array(required)).T
        for j, body in enumerate(network.bodies):
            if self.whole.loads is not None and body.inner is not None:
                swing = self.whole.loads.nominal[body.name][0].wrench[0]
                wrench_E = wrench_E + swing @ network.share[self.index, j].T
        if network.internal.shape[2]:
            wrench_E = wrench_E + self.whole.nominal_values[self.network][1] @ network.internal[self.index].T
        upper = network.bodies[self.interface.upper]
        return np.asarray(wrench_E @ np.linalg.inv(to_tray(upper.p_EB, upper.R_EB)).T)

    def _margin(self, rows: ContactRows, value: Array, limited: bool | None) -> Array:
        chosen = rows.interface == self.index
        if limited is not None:
            chosen = chosen & (rows.label == limited)
        return -value[:, chosen].max(axis=1, initial=-np.inf)

    @cached_property
    def exact(self) -> Array:
        return self._margin(self.whole.model.nominal[self.network], self.whole.nominal_values[self.network][0], None)

    @cached_property
    def exact_worst(self) -> Array:
        return self._margin(self.whole.model.robust[self.network], self.whole.worst_values[self.network][0], None)

    @cached_property
    def sliding_worst(self) -> Array:
        """Margin of the facets that depend on friction."""
        return self._margin(self.whole.model.robust[self.network], self.whole.worst_values[self.network][0], True)

    @cached_property
    def tipping_worst(self) -> Array:
        """Margin of the facets that do not depend on friction."""
        return self._margin(self.whole.model.robust[self.network], self.whole.worst_values[self.network][0], False)

    @property
    def _internal_worst(self) -> Array:
        return self.whole.worst_values[self.network][1]

    @cached_property
    def friction_needed(self) -> Array:
        """Friction needed (T,) for inscribed pyramids: at most 1/cos(pi / edges) times that for round cones."""
        return friction_needed(self.interface.contacts, self.wrench_B)

    @cached_property
    def tip_over(self) -> Array:
        """Tip-over margin (T,) at nominal parameters, m; see `tip_over_margin`."""
        return tip_over_margin(self.interface.contacts, self.wrench_B)

    @cached_property
    def tip_over_worst(self) -> Array:
        """Lower bound (T,) of the tip-over margin over the uncertain set, m; never above the nominal one, even if the
        worst case distributes the forces of several supports differently."""
        rows = self.whole.model.support[self.network]
        value = self.whole.worst_case(rows) + self._internal_worst @ rows.internal.T
        own = np.flatnonzero(rows.interface == self.index)
        kind = rows.label[own]
        beyond = value[:, own[kind == 0]].max(axis=1)
        most, least = value[:, own[kind == 1]].max(axis=1), -value[:, own[kind == 2]].max(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            found = np.where(least > 0, -beyond / np.where(beyond > 0, least, most), -np.inf)
        return np.asarray(np.minimum(found, self.tip_over))

    @cached_property
    def friction_needed_worst(self) -> float:
        """Least friction coefficient of this interface at which the whole motion does not slide in the worst case.

        It is at least the nominal one, and infinite if no friction suffices.
        """
        whole, least = self.whole, max(0.999 * float(self.friction_needed.max()), 1e-4)
        leans = self.interface.contacts.on_walls > 0  # then tipping depends on friction too
        if (not leans and float(self.tipping_worst.min()) < -TOLERANCE) or least >= HIGHEST:
            return float("inf")

        def beyond(inverse: float) -> float:
            """Largest friction-limited row with a friction of 1 / inverse: negative where it holds."""

            def rows_of(contacts: ContactSet) -> tuple[Array, Labels]:
                return cone_rows(contacts.of_friction(1.0 / inverse))

            rows = whole.model.rows(self.network, whole.model.uncertain, rows_of)
            value = whole.worst_case(rows) + self._internal_worst @ rows.internal.T
            return -float(self._margin(rows, value, None if leans else True).min())

        if beyond(1.0 / least) <= 0:
            return least
        if beyond(1.0 / HIGHEST) > 0:
            return float("inf")
        return (1 + 1e-5) / zero_between(beyond, 1.0 / HIGHEST, 1.0 / least, 1e-6)  # on the side on which it holds

    @property
    def least_friction(self) -> float:
        """Least friction coefficient in the uncertain set."""
        network = self.whole.model.networks[self.network]
        return self.whole.model.payload.least_friction(network.bodies[self.interface.upper])

    def failure(self, worst: bool) -> tuple[float, int, str, InterfaceMargins] | None:
        """(time, order, code, self) of the first failure, or None."""
        if worst:
            tips, slides = self.tipping_worst < -TOLERANCE, self.sliding_worst < -TOLERANCE
            lifts = tips & np.isneginf(self.tip_over_worst)
        else:
            tips, slides = np.asarray(self.tip_over < 0), self._slides
            lifts = np.isneginf(self.tip_over)
        for k in np.flatnonzero(tips | slides)[:1]:
            code = "lifts" if lifts[k] else "tips" if tips[k] else "slides"
            return float(self.t[k]), self.index, code, self
        return None

    @property
    def _slides(self) -> Mask:
        if not self.interface.contacts.on_walls:
            return np.asarray(self._finely_needed > self.friction * (1 + TOLERANCE))
        rows, value = self.whole.model.nominal[self.network], self.whole.nominal_values[self.network][0]
        return np.asarray(self._margin(rows, value, True) < -TOLERANCE)

    @cached_property
    def _finely_needed(self) -> Array:
        """`friction_needed` (T,), with finer pyramids where it exceeds the friction with those of the model."""
        needed = self.friction_needed.copy()
        unclear = np.flatnonzero(needed > self.friction)
        if len(unclear):
            contacts = replace(self.interface.contacts, edges=max(_FINE, self.interface.contacts.edges))
            needed[unclear] = friction_needed(contacts, self.wrench_B[unclear])
        return needed

    def reason(self, code: str, time: float, worst: bool) -> str:
        """Why it fails, with figures."""
        after = int(np.searchsorted(self.t, time))
        if code == "lifts":
            return "no force presses it on its support"
        if code == "tips":
            beyond = -(self.tip_over_worst if worst else self.tip_over)[after:]
            distance = float(beyond[np.isfinite(beyond)].max())
            return f"its zero-moment point comes {1e3 * distance:.1f} mm beyond the edge of its support"
        if worst:
            needed = self.friction_needed_worst
            much = f"friction {needed:.3f}" if np.isfinite(needed) else "more friction than any"
            return f"the motion needs {much}, and the least in the ranges is {self.least_friction:.3f}"
        finely = self._finely_needed[after:]
        needed = float(finely[np.isfinite(finely)].max())
        return f"it needs friction up to {needed:.3f} and has {self.friction:.3f}"
