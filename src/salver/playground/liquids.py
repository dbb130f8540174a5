"""The liquids in the playground's engine: how each stands, whether it came over its brim, and whether it is calm."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.geometry import Array
from salver.simulation.outcome import liquid_room, surfaces
from salver.simulation.scene.liquid_surface import DrawnSurface
from salver.simulation.scene.scene import Scene
from salver.simulation.trace import Recorder, Trace


class LiquidSurfaces:
    """Recent surfaces of liquids.

    Part of a surface follows what its container feels, as a mean over some time: so it is known half of that later
    (11 ms for a cup of 80 mm).
    """

    def __init__(self, scene: Scene, period: float) -> None:
        """period: s between samples."""
        self._scene = scene
        modes = [scene.loads[swing.load].modes for swing in scene.swings]
        self._late = max((max(1, round(0.5 / (m.following * period))) for m in modes), default=0)  # samples
        self._half_wave = max((np.pi / float(m.omega.min()) for m in modes), default=0.0)  # s, of the slowest
        self._recorder = Recorder(scene, 2 * self._late + max(1, round(0.1 / period)))  # 0.1 s more of samples
        self.begin()

    def begin(self) -> None:
        """Everything stands in its place, and still."""
        self._recorder.keep(0)
        self._spilt: dict[int, float] = {}  # when, of which load
        self._rough = -np.inf  # s, when a wave was seen last
        self._shown: list[DrawnSurface | None] = [None] * len(self._scene.loads)

    def took(self, t: float, q: Array, dq: Array, tau: Array, data: Any) -> None:
        """The state at time t, and the torque; the engine has made one step since."""
        if not self._scene.swings:
            return
        if self._recorder.full:
            self._look()
        self._recorder.joints(t, q, dq, tau)
        self._recorder.take(data)

    @property
    def shown(self) -> list[DrawnSurface | None]:
        """The surface of each object now, a single sample; None without a liquid."""
        if self._scene.swings:
            self._look()
        return self._shown

    def spilt(self, k: int) -> bool:
        """Whether load k was seen to spill."""
        return k in self._spilt

    def calm(self) -> bool:
        """Whether every liquid has stood level for half a wave, as a wave that is seen at its zero would not."""
        if not self._scene.swings:
            return True
        self._look()
        return float(self._recorder.t[self._recorder.count - 1]) - self._rough > self._half_wave

    def _look(self) -> None:
        """At what was taken since the last look; what the next one needs of it is kept."""
        trace = self._recorder.trace()
        seen = surfaces(self._scene, trace)
        whole = slice(self._late, max(self._late, len(trace.t) - self._late))  # known with all of their means
        for swing in self._scene.swings:
            k, load = swing.load, self._scene.loads[swing.load]
            t, heights, crest = trace.t[whole], seen[whole, k, :2], seen[whole, k, 2]
            over, waves = (
                crest > liquid_room(load),
                load.modes.highest(heights - _level(trace, k)[whole] * load.modes.half),
            )
            if over.any():
                self._spilt.setdefault(k, float(t[np.argmax(over)]))
            rough = waves > 2e-4  # m over the level
            if rough.any():
                self._rough = float(t[rough][-1])
            now = seen[[max(0, len(trace.t) - 1 - self._late)], k, :2]
            assert load.fill is not None
            self._shown[k] = DrawnSurface.of_heights(load.nominal, load.fill, now, self._spilt.get(k))
        self._recorder.keep(2 * self._late)


def _level(trace: Trace, k: int) -> Array:
    """(N, 2) slopes of a level surface along x and y of object k, as long as that has not fallen over."""
    up_B = trace.R_XB[:, k, 2]
    return np.asarray(-up_B[:, :2] / np.maximum(up_B[:, 2:], 0.1))
