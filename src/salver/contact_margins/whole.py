"""All margins of a load along a motion, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from salver.contact_margins.interface import InterfaceMargins
from salver.contact_margins.model import margin_model, tray_motion
from salver.contact_margins.values import RowValues
from salver.display import Shown
from salver.dynamics.load_limits import LoadVerdict
from salver.dynamics.payload_response import PayloadResponse
from salver.errors import Status
from salver.geometry import Array
from salver.models.interfaces import regions_lost
from salver.plots import Curves, Plotted
from salver.scenario import Scenario

if TYPE_CHECKING:
    from salver.models.uncertain.parameters import Parameter
    from salver.trajectory import MotionSamples


def margins(scenario: Scenario, samples: MotionSamples, *, edges: int | None = None) -> Margins:
    """All margins of a motion of B, the frame of the scenario's first object (T instants).

    edges: of the inscribed friction pyramids; default: the least multiple of the scenario's that is 8 or more.
    """
    w = tray_motion(scenario, samples)
    return Margins(margin_model(scenario, edges), samples.t, w, PayloadResponse.along(scenario.payload, samples.t, w))


@dataclass(frozen=True, repr=False)
class Margins(Shown, RowValues, Plotted):
    """Margins of all objects along one motion; each is computed when it is first read."""

    def facts(self) -> dict[str, str]:
        """Facts that a notebook shows."""
        worst, nominal = self.verdict(worst=True), self.verdict()
        return {
            "worst case": worst.sentence,
            "nominal": nominal.sentence,
            "duration": f"{float(self.t[-1] - self.t[0]):.4g} s",
            "interfaces": ", ".join(item.name for item in self.interfaces),
        }

    @cached_property
    def interfaces(self) -> tuple[InterfaceMargins, ...]:
        """Margins of every interface, network by network, in the order of the objects."""
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
        """Least exact margin (T,) of all interfaces at nominal parameters, as a share of the normal force at rest."""
        return np.min([-self.nominal_values[i][0].max(axis=1) for i in range(len(self.model.networks))], axis=0)

    @cached_property
    def exact_worst(self) -> Array:
        """Least exact margin (T,) of all interfaces in the worst case of the uncertain set."""
        return np.min([-self.worst_values[i][0].max(axis=1) for i in range(len(self.model.networks))], axis=0)

    def curves(self) -> tuple[Array, Curves]:
        """The least exact margin of all interfaces, nominal and in the worst case of the uncertain set."""
        named = {"nominal": 100 * self.exact, "worst case": 100 * self.exact_worst}
        return self.t, {"contact margin,\n% of the weight": named}

    def verdict(self, worst: bool = False) -> Status:
        """Holds, slides, tips or lifts: the first interface that fails, and when, in one sentence.

        Friction pyramids are inscribed: with 32 edges or more for the nominal case, with those of `margins` for the
        worst case. So "holds" is certain, whereas "slides" and "tips" cannot be excluded.
        """
        failures = [f for m in self.interfaces if (f := m.failure(worst)) is not None]
        payload = self.model.payload
        shake = payload.uncertain.shake
        shaken = f"and of a tray that shakes by {shake.words} " if shake is not None else ""
        case = f"in the worst case of the uncertain parameters {shaken}" if worst else ""
        lost = [name for net in payload.networks for name in regions_lost(net, payload.tray_half, payload.uncertain)]
        if worst and lost:
            sentence = f"{lost[0]} may stand beside it: the uncertain position is as large as the contact region."
            return Status("tips", sentence, False, {"interface": lost[0], "time": float(self.t[0])})
        inner = self.load_verdicts(worst)
        beyond = next((s for s in (each.status(case) for each in inner) if not s.ok), None)
        if beyond is not None and not any(f[0] <= beyond.details["time"] for f in failures):
            return beyond
        if failures:
            time, _, code, m = min(failures, key=lambda f: (f[0], f[1]))
            sentence = f"{m.name} {case}{code} at {time:.3f} s: {m.reason(code, time, worst)}."
            return Status(code, sentence[0].upper() + sentence[1:], False, {"interface": m.name, "time": time})
        kept = "".join(f" {each.status().sentence}" for each in inner)
        blind = f"Not checked: {'; '.join(payload.unmodelled)}. " if kept and payload.unmodelled else ""
        least = min(self.interfaces, key=lambda m: float((m.exact_worst if worst else m.exact).min()))
        margin = least.exact_worst if worst else least.exact
        k = int(np.argmin(margin))
        sentence = (
            f"{blind}Everything holds{' ' + case.rstrip() if case else ''}; the least margin is "
            f"{100 * max(0.0, float(margin[k])):.1f} % of the weight ({least.name}, at {self.t[k]:.3f} s).{kept}"
        )
        details = {"interface": least.name, "time": float(self.t[k]), "margin": float(margin[k])}
        return Status("holds", sentence, True, details)

    def load_verdicts(self, worst: bool = False) -> list[LoadVerdict]:
        """Verdicts on the liquid or pendulum in each load."""
        return [] if self.loads is None else self.loads.load_verdicts(worst)

    def worst_parameters(self) -> dict[str, float]:
        """Values of the uncertain parameters at which the least worst-case margin occurs (to first order)."""
        values = self.worst_values
        network = int(np.argmax([v.max() for v, _ in values]))
        instant, row = np.unravel_index(int(np.argmax(values[network][0])), values[network][0].shape)
        point = self.model.robust[network].worst_point(self.w[instant], int(row))
        uncertain = self.model.uncertain
        signs = [-1.0 if p.kind == "friction" else point.get(p, 0.0) for p in uncertain.parameters]
        worst = uncertain.nominal + uncertain.half_range * np.array(signs)
        return dict(zip(uncertain.names, worst.tolist(), strict=True))

    def only(self, parameter: Parameter) -> Margins:
        """The margins with only this parameter uncertain."""
        model, loads = self.model.with_only(parameter), self.loads
        return Margins(model, self.t, self.w, loads and loads.only(model.payload))

    def costs(self) -> dict[str, float]:
        """Loss of the least exact margin by each uncertain parameter alone, as a share of the normal force."""
        least = float(self.exact.min())
        return {p.name: least - float(self.only(p).exact_worst.min()) for p in self.model.uncertain.parameters}
