"""The part of the margins that does not depend on the motion: contact networks and their constraints."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from salver.display import Outlined
from salver.geometry import Array, invert
from salver.models.contact.contact import ContactSet
from salver.models.contact.wrench_cone import support_rows
from salver.models.contact_rows import MOST_GENERATORS, ContactRows, Labels, RowsOf, cone_rows, network_rows
from salver.models.interfaces import ContactNetwork
from salver.models.payload import Payload
from salver.models.tray_motion import frame_map, motion_vector
from salver.models.uncertain.parameters import NOTHING, Parameter, UncertainSet
from salver.scenario import Scenario
from salver.trajectory import MotionSamples

EDGES = 8  # least number of edges of the friction pyramids, which are then at most 8 % inside the round cone


@dataclass(frozen=True, repr=False)
class MarginModel(Outlined):
    """The part of a scenario's margins that does not depend on the motion; made by `margin_model`.

    payload: with `edges` edges of its friction pyramids.
    """

    payload: Payload
    edges: int

    @property
    def networks(self) -> tuple[ContactNetwork, ...]:
        return self.payload.networks

    @property
    def uncertain(self) -> UncertainSet:
        return self.payload.uncertain

    def rows(self, network: int, uncertain: UncertainSet, rows_of: RowsOf = cone_rows) -> ContactRows:
        return network_rows(self.networks[network], uncertain, self.payload.tray_half, rows_of)

    @cached_property
    def nominal(self) -> tuple[ContactRows, ...]:
        return tuple(self.rows(i, NOTHING) for i in range(len(self.networks)))

    @cached_property
    def robust(self) -> tuple[ContactRows, ...]:
        return tuple(self.rows(i, self.uncertain) for i in range(len(self.networks)))

    @cached_property
    def support(self) -> tuple[ContactRows, ...]:
        """Rows of the support polygon's edges, m, and of f_z and -f_z, per weight, over the uncertain set."""
        return tuple(self.rows(i, self.uncertain, edge_rows) for i in range(len(self.networks)))

    def with_only(self, parameter: Parameter) -> MarginModel:
        """The model with only this parameter uncertain."""
        return replace(self, payload=self.payload.with_only((parameter,)))


def margin_model(scenario: Scenario, edges: int | None = None) -> MarginModel:
    """The margin model of a scenario, cached.

    edges: number of edges of the friction pyramids. Default: a multiple of the scenario's number, so that these
    pyramids contain the scenario's; the scenario's own number if the contacts have too many points for more.
    """
    own = scenario.contact.edges
    finer = own * -(-EDGES // own)
    most = max(max(body.regions) for body in scenario.payload.bodies)
    return _margin_model(
        scenario.model_dump_json(exclude_none=True), edges or (finer if most * finer <= MOST_GENERATORS else own)
    )


@lru_cache(maxsize=16)
def _margin_model(text: str, edges: int) -> MarginModel:
    return MarginModel(Scenario.model_validate_json(text).payload.with_edges(edges), edges)


def edge_rows(contacts: ContactSet) -> tuple[Array, Labels]:
    """Rows of the support polygon's edges (label 0), of f_z (1) and of -f_z (2)."""
    edges, normal = support_rows(contacts)
    return np.vstack([edges, normal, -normal]), np.array([0] * len(edges) + [1, 2])


def tray_motion(scenario: Scenario, samples: MotionSamples) -> Array:
    """Motion regressor w (T, 12) of the tray frame E if frame B of the first object moves as `samples`."""
    first = scenario.payload.first
    w_B = motion_vector(samples.R_SB, samples.a_S, samples.omega_B, samples.alpha_B)
    return w_B @ frame_map(*invert(first.p_EB, first.R_EB)).T
