"""What the tables of inner dynamics have in common: [objects.liquid], [objects.pendulum]."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

from salver.scenario.fields import Model

if TYPE_CHECKING:
    from salver.models.load_dynamics import LoadDynamics


class InnerDynamics(Model):
    """What moves inside an object. quantity, noun: as of `LoadDynamics`; noun is the name of its table too."""

    quantity: ClassVar[str]
    noun: ClassVar[str]

    @property
    @abstractmethod
    def value(self) -> float:
        """Of the quantity, m."""

    @property
    @abstractmethod
    def assumed(self) -> float:
        """m, the half-range of the quantity where nothing is said of it."""

    @abstractmethod
    def check(self, name: str, outside: tuple[float, ...], height: float, half_range: float) -> None:
        """Raise ValueError when it cannot be in its object or is beyond what the model is valid for: one sentence.

        outside: (radius,) or (x, y) of the object, m. half_range: of the quantity, m.
        """

    @abstractmethod
    def dynamics(self, height: float) -> LoadDynamics:
        """It as mechanics see it, in an object of this height."""
