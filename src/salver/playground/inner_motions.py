"""Liquids and pendulums in the playground's engine: their motion, and whether they passed their limit."""

from __future__ import annotations

from typing import Any

import numpy as np

from salver.geometry import Array
from salver.models.load_dynamics import Drawn
from salver.simulation.outcome import inner_motions
from salver.simulation.scene.scene import Scene
from salver.simulation.trace import Recorder


class InnerMotions:
    """The latest motion of the liquids and pendulums in the loads.

    Part of a surface follows the mean acceleration of its container over some time: so it is known half of that time
    later (11 ms for a cup of 80 mm).
    """

    def __init__(self, scene: Scene, period: float) -> None:
        """period: s between samples."""
        self._scene = scene
        modes = [scene.loads[swing.load].modes for swing in scene.swings]
        self._late = max((max(1, round(0.5 / (m.following * period))) for m in modes), default=0)  # samples
        self._recorder = Recorder(scene, 2 * self._late + max(1, round(0.1 / period)))  # 0.1 s more of samples
        self.begin()

    def begin(self) -> None:
        """Begin with all objects at their places and at rest."""
        self._recorder.keep(0)
        self._seen = True
        self._beyond: dict[int, float] = {}  # when, of which load
        self._shown: list[Drawn | None] = [None] * len(self._scene.loads)

    def took(self, t: float, q: Array, dq: Array, tau: Array, data: Any) -> None:
        """Record the state at time t, s, and the torque, after which the engine has made one step."""
        if not self._scene.swings:
            return
        if self._recorder.full:
            self._look()
        self._recorder.take(t, q, dq, tau, data)
        self._seen = False

    @property
    def shown(self) -> list[Drawn | None]:
        """A sample of the liquid or pendulum in each object now; None without one."""
        if self._scene.swings:
            self._look()
        return self._shown

    def beyond(self, k: int) -> bool:
        """Whether the liquid or pendulum in load k has passed its limit."""
        if self._scene.swings:
            self._look()
        return k in self._beyond

    def _look(self) -> None:
        """Evaluate the samples recorded since the last call, and keep what the next call needs."""
        if self._seen:
            return
        self._seen = True
        trace = self._recorder.trace()
        seen = inner_motions(self._scene, trace)
        whole = slice(self._late, max(self._late, len(trace.t) - self._late))  # known with all of their means
        for swing in self._scene.swings:
            k, load = swing.load, self._scene.loads[swing.load]
            over = seen[whole, k, 2] > load.edge
            if over.any():
                self._beyond.setdefault(k, float(trace.t[whole][np.argmax(over)]))
            now = seen[[max(0, len(trace.t) - 1 - self._late)], k, :2]
            self._shown[k] = load.drawn(now, self._beyond.get(k))
        self._recorder.keep(2 * self._late)
