"""Errors of a sensor that no mean over samples or logs removes: so they are bounded.

Each is a `SystematicError`: a name, a bound, and what a sensor reads more when the error is as large as its bound. All
are unknowns of the least-squares problem beside the load (`salver.learning.load.identify`), so one that the logs show
is estimated, and refused when it is beyond its bound; of one that they do not show, the extreme is added to the ranges.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from salver.errors import ScenarioError
from salver.geometry import Array

FORCES = ("f_x", "f_y", "f_z")
MOMENTS = ("t_x", "t_y", "t_z")
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class SensorBounds:
    """Bounds of sensors' systematic errors. All are largest absolute values, not standard deviations.

    Each log and the empty run are compared, so a bias counts by what it is other than in the empty run. The defaults
    are wide enough for usual sensors; sources are in docs/howto/identify.md.

    Attributes:
        force_bias: N, of each wrist force after taring.
        moment_bias: N m, of each wrist moment after taring.
        cable: N, by which a cable or hose pulls otherwise than in the empty run as the arm moves.
        scale: share by which each wrist channel reads too much or too little.
        cross_talk: share of each other wrist channel that is read by mistake.
        lever: m, the range of a sensor's moments over that of its forces; turns forces into moments for cable and
            cross_talk.
        position: m along each axis, of the sensor's origin from the flange.
        tilt: rad about each axis, of the sensor from the flange.
        delay: s by which sensors are later, or earlier, than joint positions.
        filter_time: s, the time constant of a low-pass filter in the sensor beyond its delay.
        slip: m along x and y that the load slides during a log.
        torque_bias: N m, of each joint torque.
        torque_scale: share by which each joint torque reads too much or too little.
        links: share by which each link of the arm is heavier or lighter than in the empty run.
    """

    force_bias: float = 0.1
    moment_bias: float = 0.005
    cable: float = 0.05
    scale: float = 0.02
    cross_talk: float = 0.02
    lever: float = 0.05
    position: float = 0.001
    tilt: float = 0.01
    delay: float = 0.01
    filter_time: float = 0.01
    slip: float = 0.002
    torque_bias: float = 0.15
    torque_scale: float = 0.02
    links: float = 0.002

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if not (np.isfinite(value) and value > 0):
                raise ScenarioError(f"{each.name} = {value:g} must be a finite number above 0: a bound of a sensor.")


@dataclass(frozen=True, eq=False)
class SystematicError:
    """effect (N, m): what m channels read more at N instants when the error is as large as its bound. kind: the field
    of `SensorBounds`. run: whether it is another in every run; one that is not is the sensor's own."""

    kind: str
    of: str
    bound: float
    effect: Array
    run: bool = False

    @property
    def name(self) -> str:
        return f"{self.kind} of {self.of}" if self.of else self.kind


@dataclass(frozen=True, eq=False)
class Felt:
    """Readings (N, m) of m channels at N instants t under a load.

    slid (2, N, m): what they would read more per m by which it slides along x and y. q (N, n): the arm's posture.
    """

    t: Array
    q: Array
    values: Array
    slid: Array

    @property
    def rate(self) -> Array:
        return np.asarray(np.gradient(self.values, self.t, axis=0))


def wrist_errors(bounds: SensorBounds, felt: Felt) -> Iterator[SystematicError]:
    """Systematic errors of a wrist sensor with six channels."""
    channels, values, eye = (*FORCES, *MOMENTS), felt.values, np.eye(6)
    unit = np.array([1.0] * 3 + [bounds.lever] * 3)
    bend = _postures(felt.q)
    for i, name in enumerate(channels):
        bias = bounds.force_bias if i < 3 else bounds.moment_bias
        yield SystematicError("force_bias" if i < 3 else "moment_bias", name, bias, _only(i, 6, bias, values), True)
        for k, shape in enumerate(bend.T):
            effect = bounds.cable * unit[i] * shape[:, None] * eye[i]
            yield SystematicError("cable", f"{name}, {k + 1}", bounds.cable, effect, True)
        yield SystematicError("scale", name, bounds.scale, bounds.scale * values * eye[i])
        for j, other in enumerate(channels):
            if j != i:
                effect = bounds.cross_talk * (unit[i] / unit[j] * values[:, j])[:, None] * eye[i]
                yield SystematicError("cross_talk", f"{other} in {name}", bounds.cross_talk, effect)
    force, moment = values[:, :3], values[:, 3:]
    for k, axis in enumerate(np.eye(3)):
        shifted = np.hstack([0 * force, -np.cross(axis, force)])
        turned = -np.hstack([np.cross(axis, force), np.cross(axis, moment)])
        yield SystematicError("position", AXES[k], bounds.position, bounds.position * shifted)
        yield SystematicError("tilt", AXES[k], bounds.tilt, bounds.tilt * turned)
    yield from _of_any(bounds, felt, "wrist")


def torque_errors(bounds: SensorBounds, felt: Felt, links: Array) -> Iterator[SystematicError]:
    """Systematic errors of the torques of n joints. links (k, N, n): what those need for each link."""
    n, size = felt.values.shape[1], bounds.torque_scale
    for j in range(n):
        bias = _only(j, n, bounds.torque_bias, felt.values)
        yield SystematicError("torque_bias", f"joint {j + 1}", bounds.torque_bias, bias, True)
        yield SystematicError("torque_scale", f"joint {j + 1}", size, size * felt.values * np.eye(n)[j])
    for k, torque in enumerate(links):
        yield SystematicError("links", f"link {k + 1}", bounds.links, bounds.links * torque, True)
    yield from _of_any(bounds, felt, "joint torques")


def _of_any(bounds: SensorBounds, felt: Felt, sensor: str) -> Iterator[SystematicError]:
    rate = felt.rate
    yield SystematicError("delay", sensor, bounds.delay, -bounds.delay * rate)
    curved = np.asarray(np.gradient(rate, felt.t, axis=0))
    yield SystematicError("filter_time", sensor, bounds.filter_time, bounds.filter_time**2 * curved)
    later = np.where(felt.t > felt.t.mean(), 0.5, -0.5)[:, None]
    for axis, effect in zip("xy", felt.slid, strict=True):
        yield SystematicError("slip", axis, bounds.slip, bounds.slip * later * effect, True)


def _only(i: int, m: int, size: float, like: Array) -> Array:
    return np.asarray(np.tile(size * np.eye(m)[i], (len(like), 1)))


def _postures(q: Array) -> Array:
    """(N, 2) the two directions in which a posture (N, n) changes most, at most 1."""
    away = q - q[0]
    left, size, _ = np.linalg.svd(away - away.mean(axis=0), full_matrices=False)
    shapes = left[:, :2] * size[:2]
    return np.asarray(shapes / np.maximum(np.abs(shapes).max(axis=0), 1e-9))
