"""Values of all contact constraints along a motion, nominal and in the worst case; margins are computed from them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from salver.contact_margins.model import MarginModel
from salver.dynamics.load_rows import LoadRows, most_added
from salver.dynamics.payload_response import PayloadResponse
from salver.geometry import Array
from salver.models.contact.internal_wrench import internal_wrenches
from salver.models.contact_rows import ContactRows

AT_ONCE = 256  # instants that are computed at once


@dataclass(frozen=True)
class RowValues:
    """Contact constraints along a motion: t (T,), motion regressor w (T, 12) of the tray frame E.

    loads: responses of liquids and pendulums along the motion, or None.
    """

    model: MarginModel
    t: Array
    w: Array
    loads: PayloadResponse | None = None

    @cached_property
    def nominal_values(self) -> list[tuple[Array, Array]]:
        """Rows (T, n) and internal wrenches (T, n_w) of each network."""
        return [_balanced(self.nominal_case(rows), rows) for rows in self.model.nominal]

    @cached_property
    def worst_values(self) -> list[tuple[Array, Array]]:
        return [_balanced(self.worst_case(rows), rows) for rows in self.model.robust]

    def nominal_case(self, rows: ContactRows) -> Array:
        """Rows (T, n) at nominal parameters."""
        value = rows.worst(self.w)
        return value if self.loads is None else value + LoadRows.of(rows, self.loads.nominal).values

    def worst_case(self, rows: ContactRows) -> Array:
        """Worst case of the rows (T, n)."""
        value = rows.worst(self.w)
        if self.loads is not None:  # in pieces of time, because all cases at all instants would need too much memory
            for first in range(0, len(value), AT_ONCE):
                at = slice(first, first + AT_ONCE)
                value[at] += most_added(rows, self.loads.worst, at)
        return value


def _balanced(value: Array, rows: ContactRows) -> tuple[Array, Array]:
    """Rows with the best internal wrenches added, and those wrenches (T, n_w)."""
    w_0 = internal_wrenches(value, rows.internal)
    return value + w_0 @ rows.internal.T, w_0
