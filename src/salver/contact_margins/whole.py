"""Margins of everything on the tray along a motion, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from salver.contact_margins.interface import InterfaceMargins
from salver.contact_margins.model import margin_model
from salver.contact_margins.motion import tray_motion
from salver.contact_margins.values import RowValues
from salver.display import Shown
from salver.errors import Status
from salver.geometry import Array
from salver.liquid.sloshing import LIGHTEST
from salver.liquid.spills import Liquids, Spill
from salver.models.interfaces import regions_lost
from salver.models.liquid import LEAST_WEIGHT
from salver.scenario import Scenario

if TYPE_CHECKING:
    from salver.models.uncertain.parameters import Parameter
    from salver.trajectory import MotionSamples

FEW = 8  # instants at which the least of a motion is looked for first


def margins(scenario: Scenario, samples: MotionSamples, *, edges: int | None = None) -> Margins:
    """All margins of a motion of B, the frame of the scenario's first object (T instants).

    edges: of the friction pyramids, inscribed; unless given the least multiple of the scenario's that is 8 or more.
    """
    w = tray_motion(scenario, samples)
    return Margins(margin_model(scenario, edges), samples.t, w, Liquids.along(scenario.payload, samples.t, w))


@dataclass(frozen=True, repr=False)
class Margins(Shown, RowValues):
    """Margins of all objects along one motion; each is computed when it is first read."""

    def facts(self) -> dict[str, str]:
        """What a notebook shows of them."""
        worst, nominal = self.verdict(worst=True), self.verdict()
        return {
            "worst case": worst.sentence,
            "nominal": nominal.sentence,
            "duration": f"{float(self.t[-1] - self.t[0]):.4g} s",
            "interfaces": ", ".join(item.name for item in self.interfaces),
        }

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
        return np.min([-self.nominal_values[i][0].max(axis=1) for i in range(len(self.model.networks))], axis=0)

    @cached_property
    def exact_worst(self) -> Array:
        """(T,) the same in the worst case of the uncertain set."""
        return np.min([-self.worst_values[i][0].max(axis=1) for i in range(len(self.model.networks))], axis=0)

    def verdict(self, worst: bool = False) -> Status:
        """Holds, slides, tips or lifts: the first interface that fails, and when, in one sentence.

        Nominal: with round Coulomb cones. Worst case: with inscribed pyramids over the whole uncertain set, so
        "holds" is sure, "slides" and "tips" say that it cannot be excluded.
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
        spilt = next((s for s in (spill_status(spill, case) for spill in self.spills(worst)) if not s.ok), None)
        if spilt is not None and not any(f[0] <= spilt.details["time"] for f in failures):
            return spilt
        if failures:
            time, _, code, m = min(failures, key=lambda f: (f[0], f[1]))
            sentence = f"{m.name} {case}{code} at {time:.3f} s: {m.reason(code, time, worst)}."
            return Status(code, sentence[0].upper() + sentence[1:], False, {"interface": m.name, "time": time})
        dry = "".join(f" {spill_status(spill, '').sentence}" for spill in self.spills(worst))
        blind = f"Not checked: {'; '.join(payload.unmodelled)}. " if dry else ""
        least = min(self.interfaces, key=lambda m: float((m.exact_worst if worst else m.exact).min()))
        margin = least.exact_worst if worst else least.exact
        k = int(np.argmin(margin))
        sentence = (
            f"{blind}Everything holds{' ' + case.rstrip() if case else ''}; the least margin is "
            f"{100 * max(0.0, float(margin[k])):.1f} % of the weight ({least.name}, at {self.t[k]:.3f} s).{dry}"
        )
        details = {"interface": least.name, "time": float(self.t[k]), "margin": float(margin[k])}
        return Status("holds", sentence, True, details)

    def spills(self, worst: bool = False) -> list[Spill]:
        """How near each liquid comes to its brim."""
        return [] if self.liquids is None else self.liquids.spills(worst)

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
        """With only this parameter uncertain."""
        model, liquids = self.model.with_only(parameter), self.liquids
        return Margins(model, self.t, self.w, liquids and liquids.only(model.payload))

    def costs(self) -> dict[str, float]:
        """What each uncertain parameter, alone, takes from the least exact margin (share of the normal force)."""
        least = float(self.exact.min())
        return {p.name: least - self.only(p)._least(self.exact_worst) for p in self.model.uncertain.parameters}

    def _least(self, lower: Array) -> float:
        """The least exact margin in the worst case, of which no instant's is below `lower` (T,), as what may be with
        one parameter may be with all: few instants are looked at."""
        chosen = np.argsort(lower)[:FEW]
        found = float(self.at(chosen).exact_worst.min())
        others = np.setdiff1d(np.flatnonzero(lower < found), chosen)
        return float(self.at(others).exact_worst.min(initial=found)) if len(others) else found


def spill_status(spill: Spill, case: str = "") -> Status:
    """Whether one liquid stays in its container, in one sentence. case: words for the parameters."""
    k = int(np.argmin(spill.left))
    when = {"interface": spill.name, "time": float(spill.t[k]), "left": float(spill.left[k])}
    end = float(spill.t[-1])
    if np.isfinite(spill.left[k]) and spill.left[k] < 0:
        first = float(spill.t[np.argmax(spill.left < 0)])
        sentence = f"The liquid in {spill.name} {case}comes {_mm(-spill.left[k])} too high at {spill.t[k]:.3f} s"
        return Status("spills", f"{sentence}, the first time at {first:.3f} s.", False, when | {"time": first})
    if spill.steep.max() > 1:
        sentence = (
            f"The waves in {spill.name} {case}become {spill.steep.max():.2f} times as steep as what the model "
            "is valid for: they may break."
        )
        return Status("spills", sentence, False, when | {"time": float(spill.t[np.argmax(spill.steep > 1)])})
    if spill.light.max() > 1:
        k = int(spill.light.argmax())
        pressing = 100 * max(0.0, 1 - LIGHTEST * float(spill.light[k]))
        sentence = (
            f"Of its weight only {pressing:.0f} % hold down the liquid in {spill.name} at {spill.t[k]:.3f} s: below "
            f"{100 * LEAST_WEIGHT:.0f} % nothing is known of its waves."
        )
        return Status("spills", sentence, False, when | {"time": float(spill.t[k])})
    if spill.after < 0:
        sentence = f"The liquid in {spill.name} {case}comes {_mm(-spill.after)} too high after the motion."
        return Status("spills", sentence, False, when | {"time": end})
    if spill.settled < 0:
        sentence = f"The waves in {spill.name} {case}are {_mm(-spill.settled)} higher after the motion than is wanted."
        return Status("unsettled", sentence, False, when | {"time": end})
    if not np.isfinite(spill.left[k]):
        return Status("holds", f"The liquid in {spill.name} is kept in by its lid.", True, when)
    sentence = f"The liquid in {spill.name} stays {_mm(min(spill.left[k], spill.after))} below what it may reach."
    return Status("holds", sentence, True, when)


def _mm(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm"
