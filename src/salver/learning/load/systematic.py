"""Systematic errors of sensors, which averaging does not remove, with their bounds.

A `SystematicError` has a name, a bound, and the change of the readings when the error is at its bound. All are unknowns
of the least-squares problem, together with the load (`salver.learning.load.identify`): an error that the logs show is
estimated, and logs with an error beyond its bound are refused; for others the extreme is added to the ranges.
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

    Logs are compared with the empty run, so that only the change of a bias since then matters. The defaults are wide
    enough for usual sensors; docs/howto/identify.md has the sources.

    Attributes:
        force_bias: N, of each wrist force after taring.
        moment_bias: N m, of each wrist moment after taring.
        cable: N, change of the pull of a cable or hose since the empty run.
        scale: relative error of each wrist channel.
        cross_talk: share of every other wrist channel in a reading.
        lever: m, ratio of the ranges of moments and forces; converts forces to moments for cable and cross_talk.
        position: m along each axis, of the sensor's origin from the flange.
        tilt: rad about each axis, of the sensor from the flange.
        delay: s, delay or lead of the sensors relative to joint positions.
        filter_time: s, time constant of a low-pass filter in the sensor besides its delay.
        slip: m along x and y, slip of the load during a log.
        torque_bias: N m, of each joint torque.
        torque_scale: relative error of each joint torque.
        links: relative change of the mass of each link since the empty run.
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
    """A systematic error. kind: field of `SensorBounds`. effect (N, m): change of m channels at N instants when the
    error is at its bound. run: whether it changes from run to run; otherwise it belongs to the sensor."""

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

    slid (2, N, m): change of the readings per m of slip of the load along x and y. q (N, n): the arm's posture.
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
    """Systematic errors of the torques of n joints. links (k, N, n): torques that each link needs."""
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
    """The two principal components (N, 2) of postures (N, n), scaled to at most 1."""
    away = q - q[0]
    left, size, _ = np.linalg.svd(away - away.mean(axis=0), full_matrices=False)
    shapes = left[:, :2] * size[:2]
    return np.asarray(shapes / np.maximum(np.abs(shapes).max(axis=0), 1e-9))
