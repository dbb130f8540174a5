"""The load: loose bodies on a tray, their contacts, and their uncertain parameters.

`Scenario.payload` makes it once. It and its bodies compute everything that depends on the uncertain parameters
(`Body.phi_at`, `Body.place_at`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from salver.display import Outlined
from salver.errors import ScenarioError
from salver.geometry import Array
from salver.models.bodies import Body, check_rim, check_standing
from salver.models.interfaces import ContactNetwork, networks, regions_lost, shift_ranges
from salver.models.uncertain.parameters import NOTHING, Parameter, UncertainSet, inertial_vector, parse


@dataclass(frozen=True, eq=False, repr=False)
class Payload(Outlined):
    """The load. bodies: in the scenario's order; the motion of the first one is planned.

    uncertain: uncertain parameters of all bodies and of the tray. tray_half: (2,) half size of the tray, m.
    rim_height: m, of the rim around it; 0 without one.
    """

    bodies: tuple[Body, ...]
    uncertain: UncertainSet
    tray_half: Array
    rim_height: float = 0.0

    @property
    def first(self) -> Body:
        return self.bodies[0]

    @property
    def dynamic(self) -> tuple[Body, ...]:
        """The bodies with a liquid or a pendulum."""
        return tuple(body for body in self.bodies if body.inner is not None)

    @property
    def slowest_period(self) -> float:
        """Longest period of the liquids and pendulums at nominal values, s; 0 without any."""
        each = (float(x.inner.modes(x.inner.value).omega.min()) for x in self.dynamic if x.inner is not None)
        return max((2 * np.pi / omega for omega in each), default=0.0)

    @property
    def unmodelled(self) -> tuple[str, ...]:
        """What the models of its liquids and pendulums leave out, in words; verdicts begin with it."""
        each = (body.inner.unmodelled(body.name) for body in self.dynamic if body.inner is not None)
        return tuple(words for words in each if words)

    @cached_property
    def networks(self) -> tuple[ContactNetwork, ...]:
        """The networks of bodies that touch each other, directly or through others."""
        return networks(self.bodies)

    @cached_property
    def nominal(self) -> Payload:
        """The load without uncertain parameters."""
        return replace(self, uncertain=NOTHING)

    def with_only(self, parameters: Collection[Parameter]) -> Payload:
        """The load with only these parameters uncertain."""
        return replace(self, uncertain=self.uncertain.restricted(parameters))

    def with_edges(self, edges: int) -> Payload:
        """The load with friction cones linearised with `edges` edges."""
        return replace(self, bodies=tuple(replace(b, contacts=replace(b.contacts, edges=edges)) for b in self.bodies))

    def parameter(self, name: str) -> Parameter:
        """The parameter with a name from a user or a file. Raises ValueError when there is none."""
        return parse(name, [body.name for body in self.bodies])

    def least_friction(self, body: Body) -> float:
        """The least friction coefficient of a body within the uncertain set."""
        return body.friction - self.uncertain.ranges.get(Parameter(body.name, "friction"), 0.0)

    def phi(self, body: Body, values: Array) -> Array:
        """Exact inertial parameters (..., 10) of a body in B at values (..., n_p) of the uncertain parameters."""
        inertial, inner = np.broadcast_to(inertial_vector(body.own), (*values.shape[:-1], 10)).copy(), None
        for column, parameter in enumerate(self.uncertain.parameters):
            if parameter.owner == body.name and parameter.entry is not None:
                inertial[..., parameter.entry] = values[..., column]
            elif parameter == body.inner_parameter:
                inner = values[..., column]
        return body.phi(inertial, inner)

    def check(self) -> None:
        """Raise ValueError, one sentence, when the bodies cannot stand at their positions."""
        check_standing(self.bodies, self.tray_half)
        if self.rim_height:
            shift = {k: v for net in self.networks for k, v in shift_ranges(net, self.uncertain).items()}
            check_rim(self.bodies, self.tray_half, self.rim_height, shift)

    def check_places(self) -> None:
        """Raise ScenarioError when a contact area may vanish within the position uncertainty: nothing is safe then."""
        for network in self.networks:
            for name in regions_lost(network, self.tray_half, self.uncertain):
                raise ScenarioError(
                    f"With the uncertainty.position of its objects, one may stand beside its support ({name}); give "
                    "smaller half-ranges, so that a part of the contact area remains at all positions."
                )
