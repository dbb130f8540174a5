"""Load dynamics of a payload along a motion of the tray without tracking error."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from salver.dynamics.load_cases import VERDICT_APART, LoadCase, load_cases
from salver.dynamics.load_limits import LoadVerdict
from salver.dynamics.load_response import LoadResponse, response_of
from salver.geometry import Array, Indices
from salver.models.payload import Payload
from salver.models.uncertain.parameters import NOTHING, UncertainSet


@dataclass(frozen=True, eq=False)
class PayloadResponse:
    """Responses of all load dynamics of a payload, by body, along the tray's motion regressor w (T, 12) at t (T,): at
    nominal value and damping, and in all cases. whole, kept: for a subset of instants, the whole motion and their
    indices."""

    payload: Payload
    t: Array
    w: Array
    whole: PayloadResponse | None = None
    kept: Indices | None = None

    @classmethod
    def along(cls, payload: Payload, t: Array, w: Array) -> PayloadResponse | None:
        """The response along a motion that begins at rest; None without load dynamics."""
        return cls(payload, t, w) if payload.dynamic else None

    @cached_property
    def nominal(self) -> Mapping[str, tuple[LoadResponse, ...]]:
        return self._found(self._cases(NOTHING)) if self.whole is None else self._thinned(self.whole.nominal)

    @cached_property
    def worst(self) -> Mapping[str, tuple[LoadResponse, ...]]:
        return self._found(self.cases) if self.whole is None else self._thinned(self.whole.worst)

    @cached_property
    def cases(self) -> Mapping[str, tuple[LoadCase, ...]]:
        """All cases of each load over the uncertain set."""
        return self._cases(self.payload.uncertain)

    def _cases(self, uncertain: UncertainSet) -> dict[str, tuple[LoadCase, ...]]:
        return {body.name: load_cases(body, uncertain, VERDICT_APART) for body in self.payload.dynamic}

    def _found(self, cases: Mapping[str, tuple[LoadCase, ...]]) -> dict[str, tuple[LoadResponse, ...]]:
        return {name: (response_of(several, self.t, self.w),) for name, several in cases.items()}

    def elsewhere(self, t: Array, w: Array) -> PayloadResponse:
        """The response of the same cases along another motion, which begins at rest."""
        other = PayloadResponse(self.payload, t, w)
        vars(other)["cases"] = self.cases  # what is known of cases themselves takes as long as what they do
        return other

    def _thinned(self, found: Mapping[str, tuple[LoadResponse, ...]]) -> dict[str, tuple[LoadResponse, ...]]:
        assert self.kept is not None
        return {name: tuple(part.at(self.kept) for part in parts) for name, parts in found.items()}

    def at(self, index: Indices) -> PayloadResponse:
        """The response with wrenches at some instants only; limits stay those of the whole motion."""
        return replace(self, whole=self, kept=index)

    def only(self, payload: Payload) -> PayloadResponse:
        """The response with another uncertain set."""
        return replace(self, payload=payload, whole=None if self.whole is None else self.whole.only(payload))

    def load_verdicts(self, worst: bool) -> list[LoadVerdict]:
        """The verdict on each load."""
        each = self.worst if worst else self.nominal
        return [type(parts[0]).verdict(name, parts) for name, parts in each.items()]
