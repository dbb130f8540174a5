"""Response of load dynamics along a motion, with the arm's compliance and uncertainty: wrench and limits. Each kind of
`LoadDynamics` has a subclass of `LoadResponse`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Protocol, Self

import numpy as np

from salver.dynamics.load_cases import LoadCase
from salver.dynamics.load_limits import LIGHT, LIGHTEST, LoadLimit, LoadVerdict
from salver.dynamics.modal_changes import Change, changed
from salver.dynamics.modal_motion import ModalMotion
from salver.dynamics.modal_state import ModalState
from salver.dynamics.motion_gradients import Unknowns, at_node
from salver.geometry import GRAVITY, Array, Indices


class ArmReaction(Protocol):
    """Response of an arm to the wrenches of K cases (`salver.sensitivity.arm.tracking.Reaction`): w (K, T, 12)."""

    @property
    def w(self) -> Array: ...

    def part(self, some: slice) -> Any: ...


@dataclass(frozen=True, eq=False)
class LoadResponse(ABC):
    """K cases of a load's inner dynamics along a motion of T instants.

    modes: with the arm's compliance; planned: on a tray without tracking error. wrench: (K, T, 6), N and N m, as in
    `ModalMotion`.
    reaction: response of the arm. change: of the modes, per half-range of each of n_c uncertain terms. higher: (K, T)
    m, by which these may raise `ModalMotion.height`; more_left: (K,) m, by which they may raise the residual swing.
    """

    motion_type: ClassVar[type[ModalMotion]] = ModalMotion
    least: ClassVar[float] = 1e-6  # m; smaller displacements have no direction

    modes: ModalMotion
    wrench: Array
    planned: ModalMotion
    reaction: ArmReaction | None = None
    change: Change | None = None
    higher: Array | float = 0.0
    more_left: Array | float = 0.0

    @classmethod
    def of(cls, modes: ModalMotion) -> Self:
        """The response on a tray without tracking error."""
        return cls(modes, modes.wrench, modes)

    @classmethod
    def compliant(
        cls, modes: ModalMotion, planned: ModalMotion, reaction: ArmReaction, dw: Array, start: ModalState | None = None
    ) -> Self:
        """The response with a compliant arm. dw: (K or 1, T, 12, n_c) changes of the tray's motion regressor by
        uncertain terms; start: their effect on the modes up to the beginning."""
        change = changed(modes, dw, start)
        return cls(modes, modes.wrench, planned, reaction, change, **cls.widened(modes, change, dw))

    @classmethod
    def widened(cls, modes: ModalMotion, change: Change, dw: Array) -> dict[str, Array]:
        """Values of the fields in `more`, such as `higher`, that follow from a change."""
        higher, left = (np.linalg.norm(x, axis=-2) for x in (change.r, np.hypot(*change.ending)))
        return {"higher": higher.max(axis=2).sum(axis=2), "more_left": left.max(axis=1).sum(axis=1)}

    def along(self, planned: ModalMotion) -> Self:
        """The response of other planned modes, with the arm's compliance as here."""
        start = self.modes.start
        if start is not None and planned.start is not None and self.planned.start is not None:
            start = planned.start.since(self.planned.start.since(start))
        modes = planned.shifted(self.modes.w - self.planned.w, start)
        return replace(self, modes=modes, wrench=modes.wrench, planned=planned)

    def at(self, index: Indices) -> Self:
        """The wrench at some instants."""
        return replace(self, wrench=self.wrench[:, index])

    def part(self, some: slice, planned: ModalMotion | None = None) -> Self:
        """Some of the cases; planned: theirs, where they are known."""
        modes = self.modes.part(some)
        if planned is None:
            planned = modes if self.planned is self.modes else self.planned.part(some)
        reaction = None if self.reaction is None else self.reaction.part(some)
        change = None if self.change is None else self.change.part(some)
        return type(self)(modes, self.wrench[some], planned, reaction, change, **self._more(some))

    def _more(self, some: slice) -> dict[str, Any]:
        own = {name: value for name, value in vars(self).items() if name in self.more}
        return {name: x if np.ndim(x) == 0 else np.asarray(x)[some] for name, x in own.items()}

    more: ClassVar[tuple[str, ...]] = ("higher", "more_left")  # fields with the effect of uncertainty, (K, ...)

    def unsure(self, away: Array, inclined: Array) -> Self:
        """The response if positions of the masses are uncertain by `away` (K, T, n_modes, 2), m, and the slope of the
        force by `inclined` (K, T, 1)."""
        return replace(self, higher=away.max(axis=(2, 3)), more_left=away[:, -1].max(axis=(1, 2)))

    def ending_by(self, case: Indices, unknowns: Unknowns, by_place: Array, by_speed: Array) -> Array:
        """Derivatives (m, c) of rows that are functions of `ModalMotion.ending`, from those by its two parts, (m,
        n_modes, 2) each; changes of the tray's final posture are neglected."""
        modes, last = self.modes, np.full(len(case), len(self.modes.t) - 1)
        to_speed = np.sqrt(GRAVITY / modes.upward[case, -1])[:, None, None] / modes.cases.omega[case]
        return at_node(unknowns, self.planned, case, last, by_place, by_speed * to_speed)

    @cached_property
    def lightness(self) -> Array:
        """Share (K, T) by which the apparent weight is below the weight."""
        return np.asarray(1 - self.modes.force[..., 2] / GRAVITY)

    @property
    def weight_limit(self) -> LoadLimit:
        """The limit on `lightness`, beyond which the modes are not valid."""

        def by(case: Indices, node: Indices, unknowns: Unknowns) -> Array:
            by_w = -self.modes.cases.at_O[case, 2] / GRAVITY
            return np.asarray((by_w[:, None] @ unknowns.felt[node])[:, 0])

        most = np.full(len(self.wrench), LIGHTEST)
        return LoadLimit("effective gravity", self.lightness, most, by, LIGHT)

    @abstractmethod
    def limits(self) -> list[LoadLimit]:
        """All limits, during the motion and after it."""

    @classmethod
    def verdict(cls, name: str, parts: Sequence[Self]) -> LoadVerdict:
        """The verdict on the load in a body, in the worst case of all parts."""
        modes, limits = parts[0].modes, [limit for part in parts for limit in part.limits()]
        size = np.max([(part.modes.height + part.higher).max(axis=0) for part in parts], axis=0)
        return LoadVerdict.of(name, modes.cases.each[0].dynamics, modes.t, limits, size)


def response_of(several: Sequence[LoadCase], t: Array, w: Array) -> LoadResponse:
    """The response of `alike` cases, from rest, on a tray without tracking error."""
    kind: type[LoadResponse] = several[0].dynamics.response
    return kind.of(kind.motion_type.along(several, t, w))


def slacks(part: LoadResponse, *groups: str) -> Array:
    """Least remaining share (K, T) of the limits in each case; of some groups of limits if any are named. Infinite
    without limits."""
    count = len(part.modes.t)
    none = np.full((len(part.wrench), count), np.inf)
    wanted = [limit for limit in part.limits() if not groups or limit.group in groups]
    return np.min([none, *(limit.left(count) for limit in wanted)], axis=0)
