"""A recording as a run directory: the commanded motion is its plan, the engine's motion its log.

So all that is there for plans is there for it: `salver report`, `salver export`, `salver simulate`.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from salver.driver.execute import JUDGED, RECORDED
from salver.driver.live import commanded
from salver.driver.logs import RECORD_RATE, keep
from salver.files import provenance
from salver.geometry import Array
from salver.planning.plan import Plan
from salver.planning.plan_files import make_way
from salver.scenario import Scenario
from salver.simulation.run import Options, Run, measure
from salver.simulation.scene.scene import Scene
from salver.simulation.trace import Recorder
from salver.trajectory import JointMotion


class SessionRecording:
    """Samples of one session; begun and ended at rest."""

    longest = 120.0  # s

    def __init__(self, scenario: Scenario, parameters: Mapping[str, float], scene: Scene, since: float) -> None:
        self.scenario, self.parameters, self.scene, self.since = scenario, dict(parameters), scene, since
        self.every = max(1, round(1 / (RECORD_RATE * scenario.physics.command_period)))
        room = int(self.longest / (self.every * scenario.physics.command_period)) + 1
        self._recorder = Recorder(scene, room)
        self._wanted = np.empty((3, room, scene.n))
        self._due = 0

    @property
    def seconds(self) -> float:
        return self._recorder.count * self.every * self.scenario.physics.command_period

    @property
    def full(self) -> bool:
        return self._recorder.full

    @property
    def rests(self) -> bool:
        """Whether what was commanded last is to rest."""
        last = self._recorder.count - 1
        return last >= 0 and bool(np.abs(self._wanted[1:, last]).max() < 1e-2)  # rad/s, rad/s^2

    def due(self) -> bool:
        """Whether this period is one that is kept; asked once in each."""
        self._due += 1
        return (self._due - 1) % self.every == 0 and not self.full

    def took(self, t: float, q: Array, dq: Array, tau: Array, wanted: tuple[Array, Array, Array], data: object) -> None:
        """The state at time t, the torque, q, dq, ddq as they were commanded; the engine has made one step since."""
        self._wanted[:, self._recorder.count] = wanted
        self._recorder.take(t - self.since, q, dq, tau, data)

    def commanded(self) -> Plan:
        """The commanded motion, judged like any joint motion from rest to rest."""
        count = self._recorder.count
        q, dq, ddq = self._wanted[:, :count].copy()
        return commanded(self.scenario, JointMotion(self._recorder.t[:count] - self._recorder.t[0], q, dq, ddq))

    def save(self, directory: Path, unprotected: bool) -> Path:
        """Write the run directory; what stood there is kept. Returns the path of the log."""
        began, plan = time.perf_counter(), self.commanded()
        trace = self._recorder.trace()
        options = Options(record_rate=1 / self.scenario.physics.command_period)  # all of what was kept
        wanted = plan.reference.sample(trace.t)
        run = Run(plan.scenario, self.parameters, options, plan.reference, self.scene, wanted)
        record = measure(run, trace, {"with_arm": True}, began)
        assert plan.joint is not None
        error = np.abs(trace.q - plan.joint.sample(trace.t)[0])
        summary = {
            "source": "simulated arm, by hand" + (", at times without protection" if unprotected else ""),
            "method": plan.method,
            "stopped": "",
            "joint_error_peak": float(error.max()),
            "parameters": self.parameters,
            "provenance": provenance(plan.scenario),
            **{key: record.summary[key] for key in JUDGED if key in record.summary},
        }
        make_way(plan.scenario, directory, force=True)
        plan.save(directory)
        return keep(directory, "plan", {name: np.asarray(getattr(record, name)) for name in RECORDED}, summary)
