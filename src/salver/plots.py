"""Curves of results over time, drawn with matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from salver.errors import SalverError, needs

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from salver.geometry import Array

Curves = Mapping[str, Mapping[str, "Array"]]


class Plotted:
    """A result whose curves over time can be drawn."""

    __slots__ = ()

    def curves(self) -> tuple[Array, Curves]:
        """Instants (T,), s, and for each axes, by its label with the unit, curves (T,) by their names."""
        raise NotImplementedError

    def plot(self, axes: Axes | Sequence[Axes] | None = None) -> list[Axes]:
        """Draw the curves over time.

        Args:
            axes: matplotlib axes to draw on, one for each label of `curves`; default: a new figure.

        Returns:
            The axes, in the order of `curves`.

        Raises:
            SalverError: another number of axes.
            MissingDependencyError: no axes, and matplotlib is not installed.
        """
        t, panels = self.curves()
        if axes is None:
            with needs("plots", "plot"):
                import matplotlib.pyplot as plt

            size = (7.0, 0.6 + 1.7 * len(panels))
            _, made = plt.subplots(len(panels), sharex=True, squeeze=False, figsize=size, layout="constrained")
            axes = list(made[:, 0])
        drawn: list[Axes] = np.atleast_1d(np.asarray(axes, dtype=object)).tolist()
        if len(drawn) != len(panels):
            needed = "; ".join(panels).replace("\n", " ")
            raise SalverError(f"plot was given {len(drawn)} axes; it needs {len(panels)}: {needed}.")
        for one, (label, named) in zip(drawn, panels.items(), strict=True):
            for name, values in named.items():
                one.plot(t, values, label=name)
            one.axhline(0.0, color="0.4", linewidth=0.6)
            one.set_ylabel(label)
            one.margins(x=0)
            one.legend(fontsize="small", loc="upper left", bbox_to_anchor=(1.0, 1.0))
        drawn[-1].set_xlabel("time, s")
        return drawn
