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

TOLERANCE = 1e-9  # of a margin, as a share of the weight


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

    def worst_case(self, rows: ContactRows, at_once: int = 256) -> Array:
        """Worst case of the rows (T, n). With liquids and pendulums the instants are treated in pieces, to limit the
        memory."""
        value = rows.worst(self.w)
        if self.loads is not None:
            for first in range(0, len(value), at_once):
                at = slice(first, first + at_once)
                value[at] += most_added(rows, self.loads.worst, at)
        return value


def _balanced(value: Array, rows: ContactRows) -> tuple[Array, Array]:
    """Rows with the best internal wrenches added, and those wrenches (T, n_w)."""
    w_0 = internal_wrenches(value, rows.internal)
    return value + w_0 @ rows.internal.T, w_0
