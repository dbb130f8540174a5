"""Results as tables of other libraries: pandas and xarray, which salver does not need itself (pip install
'salver[tables]')."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import TYPE_CHECKING, Any

from salver.errors import MissingDependencyError

if TYPE_CHECKING:
    import pandas
    import xarray

    from salver.geometry import Array

TIME = "t"
_COMPONENTS = {"xyz": tuple("xyz"), "wxyz": tuple("wxyz")}
# Of quantities by their names in docs/conventions.md, after the time.
DIMENSIONS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("q", "dq", "ddq", "tau"), ("joint",)),
    **dict.fromkeys(("p_SE", "p_SB", "v_S", "a_S", "omega_B", "alpha_B"), ("xyz",)),
    **dict.fromkeys(("quat_SE_wxyz", "quat_SB_wxyz"), ("wxyz",)),
    **dict.fromkeys(("cone_coefficients", "cone_radius"), ("edge",)),
}


@dataclass(frozen=True)
class Table:
    """Arrays with named dimensions. variables: name to (dimensions, array). labels: dimension to the name of each
    entry. about: what it is, in words and numbers."""

    variables: Mapping[str, tuple[tuple[str, ...], Array]]
    labels: Mapping[str, Sequence[str]] = field(default_factory=dict)
    about: Mapping[str, Any] = field(default_factory=dict)


class Tabular:
    """A result with a table: `table` gives it."""

    __slots__ = ()

    def table(self) -> Table:
        """The arrays with their dimensions."""
        raise NotImplementedError

    def to_xarray(self) -> xarray.Dataset:
        """An `xarray.Dataset`: every array with named dimensions and labels. Raises MissingDependencyError."""
        try:
            import xarray
        except ImportError:
            raise _missing("xarray") from None
        table = self.table()
        labels = {name: list(values) for name, values in (_COMPONENTS | dict(table.labels)).items()}
        used = {name for dimensions, _ in table.variables.values() for name in dimensions}
        return xarray.Dataset(
            {name: pair for name, pair in table.variables.items() if name != TIME},
            {TIME: table.variables[TIME][1], **{name: labels[name] for name in used if name in labels}},
            dict(table.about),
        )

    def to_pandas(self) -> pandas.DataFrame:
        """A `pandas.DataFrame`: one row an instant, one column a component, as `p_SE_x`. Raises
        MissingDependencyError."""
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
    """`Table.variables` of arrays (T, ...): dimensions by `own`, else `DIMENSIONS`. What is in neither is left out."""
    known = {**DIMENSIONS, **own}
    return {TIME: ((TIME,), arrays[TIME])} | {
        name: ((TIME, *known[name]), values) for name, values in arrays.items() if name in known
    }


def pandas_module() -> Any:
    """The package pandas. Raises MissingDependencyError."""
    try:
        import pandas
    except ImportError:
        raise _missing("pandas") from None
    return pandas


def _missing(package: str) -> MissingDependencyError:
    return MissingDependencyError(f"{package} is not installed; it comes with: pip install 'salver[tables]'.")
