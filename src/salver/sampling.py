"""Samples of the uncertain parameters for the perturbed runs of a campaign.

Every method samples the uncertain set of the scenario, a box (eq 8 of the paper) or an ellipsoid (eq 9), and keeps
only combinations that a physical object can have. Run k depends on (seed, k) alone, so that runs can be added later.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from salver.errors import SalverError
from salver.geometry import Array, Mask
from salver.models.physical import hull_faces, random_inertia, realisable
from salver.models.uncertain.parameters import Parameter, UncertainSet, inertial_vector

if TYPE_CHECKING:
    from salver.models.bodies import Body

Method = Literal["uniform", "corners"]
METHODS: tuple[str, ...] = get_args(Method)

Possible = Callable[[Array], Mask]


def draw(
    uncertain: UncertainSet, n: int, seed: int = 0, method: Method = "uniform", bodies: Sequence[Body] | None = None
) -> Array:
    """Sample the parameters of n runs: values (n, n_p) in SI units, in the order of `uncertain.names`.

    Args:
        method: "uniform": independent, uniform over the volume of the set. "corners": first the extreme points (all
            low, all high, then the others in a seeded order; for an ellipsoid its points of least and largest value in
            each parameter, then its diagonals), then uniform.
        bodies: if given, combinations that no object can have are left out: mass, friction or inertia not positive,
            principal moments against the triangle inequality, a centre of mass outside the shape, and, if the
            nominal object satisfies it, an inertia that no mass distribution within the shape has. With
            `contents = "any"`, the inertia is that of random point masses inside the object, whatever the method.

    Raises:
        SalverError: (almost) no combination is possible.
    """
    if n < 0:
        raise SalverError(f"The number of runs is {n}; it must be 0 or more.")
    if method not in METHODS:
        raise SalverError(f'There is no sampling method "{method}"; known are {", ".join(METHODS)}.')
    if uncertain.size == 0:
        return np.zeros((n, 0))
    filled = [body for body in bodies or () if body.any_contents]
    if any(_inertia_of(p, filled) for p in uncertain.parameters):
        return _filled(uncertain, n, seed, method, bodies or (), filled)
    possible = _possible(uncertain, bodies)
    return {"uniform": _uniform, "corners": _corners}[method](uncertain, n, seed, possible)


def _inertia_of(parameter: Parameter, filled: Sequence[Body]) -> bool:
    return parameter.kind == "inertia" and any(parameter.owner == body.name for body in filled)


def _filled(
    uncertain: UncertainSet,
    n: int,
    seed: int,
    method: Method,
    bodies: Sequence[Body],
    filled: Sequence[Body],
    within: float = 0.95,
) -> Array:
    """Samples for bodies with random contents: inertias of random mass distributions, all else by the method.

    within: share of the way to the shape's surface at which a centre of mass is at most: only a mass concentrated on
    the surface has its centre of mass there.
    """
    others = [p for p in uncertain.parameters if not _inertia_of(p, filled)]
    known = [body for body in bodies if body not in filled]
    column = {p: j for j, p in enumerate(uncertain.parameters)}
    values = np.zeros((n, uncertain.size))
    values[:, [column[p] for p in others]] = draw(uncertain.restricted(others), n, seed, method, known)
    for body in filled:
        own = {p.entry: j for p, j in column.items() if p.owner == body.name and p.entry is not None}
        faces, nominal = hull_faces(body), inertial_vector(body.inertial)
        for k in range(n):
            at = np.array([values[k, own[i]] if i in own else nominal[i] for i in range(4)])
            outwards = faces[:, :3] @ at[1:]
            beyond = outwards > -within * faces[:, 3]
            if beyond.any():
                at[1:] *= within * float(np.min(-faces[beyond, 3] / outwards[beyond]))
            inertia = at[0] * random_inertia(body, at[1:], np.random.default_rng([seed, k, 1]))
            for i, j in own.items():
                values[k, j] = at[i] if i < 4 else inertia[i - 4]
    return values


def _uniform(
    uncertain: UncertainSet, n: int, seed: int, possible: Possible, first: int = 0, tries: int = 1000
) -> Array:
    """Runs first .. first + n - 1, each from its own generator. tries: draws before the set counts as impossible."""
    values = np.empty((n, uncertain.size))
    for row, k in enumerate(range(first, first + n)):
        rng = np.random.default_rng([seed, k])
        for _ in range(tries):
            values[row] = _point(uncertain, rng)
            if possible(values[row : row + 1])[0]:
                break
        else:
            raise SalverError(
                f"None of {tries} samples of the uncertain set ({', '.join(uncertain.names)}) is an object that can "
                "exist; narrow the ranges of inertia and centre of mass, or correct their nominal values."
            )
    return values


def _corners(uncertain: UncertainSet, n: int, seed: int, possible: Possible) -> Array:
    values: list[Array] = []
    for s in _extreme_points(uncertain, seed):
        if len(values) == n:
            break
        value = uncertain.nominal + uncertain.factor @ s
        if possible(value[None])[0]:
            values.append(value)
    rest = _uniform(uncertain, n - len(values), seed, possible, first=len(values))
    return np.vstack([*values, rest]) if values else rest


def _extreme_points(uncertain: UncertainSet, seed: int) -> Iterator[Array]:
    """Points of the unit box or ball that map to the extreme points of the set, each once."""
    radius = 1.0 if uncertain.kind == "box" else 1 / np.sqrt(uncertain.size)
    if uncertain.kind == "ellipsoid" and uncertain.size > 1:
        # A s is largest in parameter j where s points along row j of A.
        rows = uncertain.factor / np.linalg.norm(uncertain.factor, axis=1, keepdims=True)
        for row in rows:
            yield -row
            yield row
    for signs in sign_vectors(uncertain.size, seed):
        yield radius * signs


def sign_vectors(n_p: int, seed: int) -> Iterator[Array]:
    """All 2^n_p vectors of signs, each once: all low, all high, then the others in a seeded order.

    They are generated one by one, so that many parameters need little memory.
    """
    yield -np.ones(n_p)
    yield np.ones(n_p)
    total = 2**n_p
    rng = np.random.default_rng([seed, n_p])
    if n_p <= 12:
        for code in rng.permutation(np.arange(1, total - 1)):
            yield _signs(int(code), n_p)
        return
    seen = {0, total - 1}
    while len(seen) < total:
        code = int.from_bytes(rng.bytes((n_p + 7) // 8), "little") % total
        if code not in seen:
            seen.add(code)
            yield _signs(code, n_p)


def _signs(code: int, n_p: int) -> Array:
    return np.array([1.0 if code >> j & 1 else -1.0 for j in range(n_p)])


def _point(uncertain: UncertainSet, rng: np.random.Generator) -> Array:
    """A point of the set (n_p,), uniform over its volume.

    For an ellipsoid: a direction from normal numbers, and a radius that is the n_p-th root of a uniform number.
    """
    n_p = uncertain.size
    if uncertain.kind == "box" or n_p == 1:
        s = 2 * rng.random(n_p) - 1
    else:
        direction = rng.standard_normal(n_p)
        s = direction / np.linalg.norm(direction) * rng.random() ** (1 / n_p)
    return np.asarray(uncertain.nominal + s @ uncertain.factor.T)


def _possible(uncertain: UncertainSet, bodies: Sequence[Body] | None) -> Possible:
    """A test whether objects with parameters (n, n_p) can exist, with the answers (n,)."""
    positive = [j for j, p in enumerate(uncertain.parameters) if p.kind in ("mass", "friction") and p.owner]
    tests = [_inertial_test(uncertain, body) for body in bodies or ()]

    def possible(p: Array) -> Mask:
        fine = np.all(p[:, positive] > 0, axis=1)
        for test in tests:
            fine &= test(p)
        return fine

    return possible


def _inertial_test(uncertain: UncertainSet, body: Body) -> Possible:
    """A joint test of one body's mass, centre of mass and inertia."""
    own = [(j, p.entry) for j, p in enumerate(uncertain.parameters) if p.owner == body.name]
    columns = [(j, entry) for j, entry in own if entry is not None]
    nominal = inertial_vector(body.own)
    within_shape = bool(realisable(body, nominal)[0])

    def test(p: Array) -> Mask:
        if not columns:
            return np.ones(len(p), dtype=bool)
        values = np.tile(nominal, (len(p), 1))
        for j, i in columns:
            values[:, i] = p[:, j]
        return realisable(body, values, within_shape=within_shape)

    return test
