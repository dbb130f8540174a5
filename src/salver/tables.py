"""Results as pandas and xarray tables (optional: pip install 'salver[tables]')."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING, Any

from salver.errors import needs

if TYPE_CHECKING:
    import pandas
    import xarray

    from salver.geometry import Array

TIME = "t"
_COMPONENTS = {"xyz": tuple("xyz"), "wxyz": tuple("wxyz")}
# Dimensions after time, by the names of docs/conventions.md.
DIMENSIONS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("q", "dq", "ddq", "tau"), ("joint",)),
    **dict.fromkeys(("p_SE", "p_SB", "v_S", "a_S", "omega_B", "alpha_B"), ("xyz",)),
    **dict.fromkeys(("quat_SE_wxyz", "quat_SB_wxyz"), ("wxyz",)),
    **dict.fromkeys(("cone_coefficients", "cone_radius"), ("edge",)),
}


@dataclass(frozen=True)
class Table:
    """Arrays with named dimensions.

    variables: name to (dimensions, array). labels: dimension to the names of its entries. about: attributes.
    """

    variables: Mapping[str, tuple[tuple[str, ...], Array]]
    labels: Mapping[str, Sequence[str]] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)


class Tabular:
    """A result that can be converted to a table of pandas or xarray."""

    __slots__ = ()

    def table(self) -> Table:
        """The arrays with their dimensions."""
        raise NotImplementedError

    def to_xarray(self) -> xarray.Dataset:
        """The result as an `xarray.Dataset` with named dimensions. Raises MissingDependencyError without xarray."""
        with needs("tables", "to_xarray"):
            import xarray
        table = self.table()
        labels = {name: list(values) for name, values in (_COMPONENTS | dict(table.labels)).items()}
        used = {name for dimensions, _ in table.variables.values() for name in dimensions}
        return xarray.Dataset(
            {name: pair for name, pair in table.variables.items() if name != TIME},
            {TIME: table.variables[TIME][1], **{name: labels[name] for name in used if name in labels}},
            dict(table.about),
        )

    def to_pandas(self) -> pandas.DataFrame:
        """The result as a `pandas.DataFrame`: a row for each instant, a column for each component, such as `p_SE_x`.
        Raises MissingDependencyError without pandas."""
        frames = pandas_module()
        table = self.table()
        labels = _COMPONENTS | dict(table.labels)
        columns: dict[str, Array] = {}
        for name, (dimensions, values) in table.variables.items():
            if not dimensions or dimensions[0] != TIME or name == TIME:
                continue
            names = [labels.get(d) or range(size) for d, size in zip(dimensions[1:], values.shape[1:], strict=True)]
            stem = name.removesuffix("_wxyz")
            for number, parts in enumerate(product(*names)):
                columns["_".join([stem, *map(str, parts)])] = values.reshape(len(values), -1)[:, number]
        frame: pandas.DataFrame = frames.DataFrame(columns, index=frames.Index(table.variables[TIME][1], name=TIME))
        frame.attrs.update(table.about)
        return frame


def dimensioned(
    arrays: Mapping[str, Array], own: Mapping[str, tuple[str, ...]]
) -> dict[str, tuple[tuple[str, ...], Array]]:
    """`Table.variables` of arrays (T, ...) whose dimensions are in `own` or `DIMENSIONS`; others are left out."""
    known = {**DIMENSIONS, **own}
    return {TIME: ((TIME,), arrays[TIME])} | {
        name: ((TIME, *known[name]), values) for name, values in arrays.items() if name in known
    }


def pandas_module() -> Any:
    """The module pandas. Raises MissingDependencyError if it is not installed."""
    with needs("tables", "to_pandas"):
        import pandas
    return pandas
