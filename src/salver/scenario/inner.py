"""The interface of tables for moving contents: [objects.liquid], [objects.pendulum]."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

from salver.fields import Model

if TYPE_CHECKING:
    from salver.dynamics.liquid.interiors import Interior
    from salver.models.load_dynamics import LoadDynamics


class InnerDynamics(Model):
    """A liquid or a pendulum inside an object. quantity, noun: as in `LoadDynamics`; noun also names the table."""

    quantity: ClassVar[str]
    noun: ClassVar[str]

    @property
    def value(self) -> float:
        """Nominal value of the quantity, m."""
        return float(getattr(self, self.quantity))

    @property
    @abstractmethod
    def assumed(self) -> float:
        """Half-range of the quantity, m, that is assumed if the scenario gives none."""

    @abstractmethod
    def check(self, name: str, outside: Interior, height: float, half_range: float) -> None:
        """Raise ValueError, one sentence, when it does not fit into its object or its model is not valid for it.

        name: of the object. outside: its outer walls. height: of the object, m. half_range: of the
        quantity, m.
        """

    @abstractmethod
    def dynamics(self, height: float) -> LoadDynamics:
        """The dynamic model of the contents in an object of a height, m."""
