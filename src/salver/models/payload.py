"""The load: loose bodies on a tray, their contacts, and their uncertain parameters.

Made once from a scenario (`Scenario.payload`) and passed on; everything that depends on the uncertain parameters is
asked of it or of its bodies (`Body.phi_at`, `Body.place_at`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from salver.display import Outlined
from salver.errors import ScenarioError
from salver.geometry import Array
from salver.models.bodies import Body, check_standing
from salver.models.interfaces import ContactNetwork, networks, regions_lost
from salver.models.uncertain.parameters import NOTHING, Parameter, UncertainSet, inertial_vector, parse


@dataclass(frozen=True, eq=False, repr=False)
class Payload(Outlined):
    """Bodies in the scenario's order; the first is the one whose motion is planned.

    uncertain: about all of them and the tray's tilt. tray_half: (2,) half size of the tray, m.
    """

    bodies: tuple[Body, ...]
    uncertain: UncertainSet
    tray_half: Array

    @property
    def first(self) -> Body:
        return self.bodies[0]

    @property
    def dynamic(self) -> tuple[Body, ...]:
        """The bodies in which something moves."""
        return tuple(body for body in self.bodies if body.inner is not None)

    @property
    def slowest_period(self) -> float:
        """s, the longest period of what moves inside its bodies, at nominal values; 0 where nothing does."""
        each = (float(x.inner.modes(x.inner.value).omega.min()) for x in self.dynamic if x.inner is not None)
        return max((2 * np.pi / omega for omega in each), default=0.0)

    @property
    def unmodelled(self) -> tuple[str, ...]:
        """Parts of its inner dynamics that are not modelled, in words, to stand before any verdict."""
        each = (body.inner.unmodelled(body.name) for body in self.dynamic if body.inner is not None)
        return tuple(words for words in each if words)

    @cached_property
    def networks(self) -> tuple[ContactNetwork, ...]:
        """The bodies that touch each other, directly or through others."""
        return networks(self.bodies)

    @cached_property
    def nominal(self) -> Payload:
        """The load with nothing uncertain."""
        return replace(self, uncertain=NOTHING)

    def with_only(self, parameters: Collection[Parameter]) -> Payload:
        """The load with only these parameters uncertain."""
        return replace(self, uncertain=self.uncertain.restricted(parameters))

    def with_edges(self, edges: int) -> Payload:
        """The load with friction cones linearised by so many edges."""
        return replace(self, bodies=tuple(replace(b, contacts=replace(b.contacts, edges=edges)) for b in self.bodies))

    def parameter(self, name: str) -> Parameter:
        """The parameter that a user or a file calls so. Raises ValueError when there is none."""
        return parse(name, [body.name for body in self.bodies])

    def least_friction(self, body: Body) -> float:
        """The least coefficient within the uncertain set."""
        return body.friction - self.uncertain.ranges.get(Parameter(body.name, "friction"), 0.0)

    def phi(self, body: Body, values: Array) -> Array:
        """(..., 10) inertial parameters of a body in B at values (..., n_p) of the uncertain parameters, exactly."""
        inertial, inner = np.broadcast_to(inertial_vector(body.own), (*values.shape[:-1], 10)).copy(), None
        for column, parameter in enumerate(self.uncertain.parameters):
            if parameter.owner == body.name and parameter.entry is not None:
                inertial[..., parameter.entry] = values[..., column]
            elif parameter == body.inner_parameter:
                inner = values[..., column]
        return body.phi(inertial, inner)

    def check(self) -> None:
        """Raise ValueError when the bodies cannot stand as they are said to: one sentence."""
        check_standing(self.bodies, self.tray_half)

    def check_places(self) -> None:
        """Raise ScenarioError when an uncertain position can leave nothing of a contact: nothing is safe then."""
        for network in self.networks:
            for name in regions_lost(network, self.tray_half, self.uncertain):
                raise ScenarioError(
                    f"With the uncertainty.position of its objects, one may stand beside its support ({name}); the "
                    "half-ranges must leave a part of the contact region that is sure."
                )
