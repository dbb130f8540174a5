"""Contributions of load dynamics to contact rows and to the arm's deviation, each load in its worst case
(`salver.dynamics.load_response`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from salver.dynamics.load_response import LoadResponse
from salver.dynamics.motion_gradients import Unknowns, wrench_by
from salver.geometry import Array, Indices
from salver.models.contact_rows import ContactRows
from salver.models.uncertain.worst_case import ALL


@dataclass(frozen=True, eq=False)
class LoadRows:
    """Contributions of loads to contact rows (T, n), each in its worst case. loads: for each load in one of the rows'
    bodies, the body's index, the load's parts, and their contributions (K, T, n) in all cases."""

    rows: ContactRows
    loads: list[tuple[int, tuple[LoadResponse, ...], list[Array]]]
    values: Array

    @classmethod
    def of(cls, rows: ContactRows, responses: Mapping[str, tuple[LoadResponse, ...]]) -> LoadRows:
        """The contributions of responses, given in parts by the name of the load's body."""
        total, loads = np.zeros((1, 1)), []
        for j, parts, added in _each_added(rows, responses):
            total = total + _most(added)
            if j is not None:
                loads.append((j, parts, added))
        return cls(rows, loads, total)

    def history(self, node: Indices, row: Indices, unknowns: Unknowns) -> Array:
        """Derivatives (m, c) of the contributions to rows at nodes (m,), by unknowns of the motion; changes of the
        arm's response and of the effect of uncertain positions are neglected."""
        found = np.zeros((len(node), unknowns.felt.shape[2]))
        for j, parts, added in self.loads:
            worst = np.concatenate([part[:, node, row] for part in added]).argmax(axis=0)
            for k, case, mine in of_parts([len(part.wrench) for part in parts], worst):
                by = self.rows.wrench[j][row[mine]]
                found[mine] += wrench_by(parts[k].planned, unknowns, case, node[mine], by)
        return found


def given_way(responses: Mapping[str, tuple[LoadResponse, ...]], what: Callable[[Any], Array]) -> Array:
    """Largest change (T, m) by all load dynamics, each in its worst case, of a quantity of the arm: `what` returns it
    (T, m, K) from a reaction."""
    each = [[what(x.reaction) for x in parts if x.reaction is not None] for parts in responses.values()]
    most = [reduce(np.maximum, [np.abs(x).max(axis=-1) for x in parts]) for parts in each if parts]
    return sum(most, np.zeros((1, 1)))


def of_parts(counts: Sequence[int], which: Indices) -> Iterator[tuple[int, Indices, Indices]]:
    """Split case numbers `which` (m,), counted through all parts with `counts` cases each: yields the part, the numbers
    within it, and their positions in `which`."""
    before = 0
    for k, count in enumerate(counts):
        mine = np.flatnonzero((which >= before) & (which < before + count))
        if len(mine):
            yield k, which[mine] - before, mine
        before += count


def most_added(rows: ContactRows, responses: Mapping[str, tuple[LoadResponse, ...]], at: slice) -> Array:
    """Contributions (T, n) of loads to rows at some instants, each in its worst case."""
    return sum((_most(added) for _, _, added in _each_added(rows, responses, at)), np.zeros((1, 1)))


def _most(added: list[Array]) -> Array:
    """Largest contribution (T, n) over all cases of all parts."""
    return np.asarray(reduce(np.maximum, [part.max(axis=0) for part in added]))


def _each_added(
    rows: ContactRows, responses: Mapping[str, tuple[LoadResponse, ...]], at: slice = ALL
) -> Iterator[tuple[int | None, tuple[LoadResponse, ...], list[Array]]]:
    """For each load: the index of its body in the network, or None for one elsewhere; its parts; and their
    contributions (K, T, n) to the rows at some instants, or 0 as (1, 1, 1)."""
    index = {body.name: j for j, body in enumerate(rows.network.bodies)}
    for name, parts in responses.items():
        j = index.get(name)
        added = [_added(part, rows.nominal.T, None if j is None else rows.wrench[j].T, at) for part in parts]
        for moved in () if j is None else rows.wrench_by_place[:, j]:
            added = [x + np.abs(part.wrench[:, at] @ moved.T) for x, part in zip(added, parts, strict=True)]
        yield j, parts, added


def _added(part: LoadResponse, nominal: Array, held: Array | None, at: slice) -> Array:
    """Contribution of a part to rows `nominal` (12, n), and to rows `held` (6, n) of the wrench on its container."""
    added = np.zeros((1, 1, 1))
    if part.reaction is not None:  # for all objects: the arm's deviation moves the whole tray
        added = part.reaction.w[:, at] @ nominal
    if held is not None:
        added = added + part.wrench[:, at] @ held
        if part.change is not None:
            swings = np.swapaxes(part.change.wrench[:, at], 2, 3)
            swung = (swings.reshape(-1, 6) @ held).reshape(*swings.shape[:3], held.shape[1])  # (K, T, n_c, n)
            added += np.abs(swung, out=swung).sum(axis=2)
    return added
