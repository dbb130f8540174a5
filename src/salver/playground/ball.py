"""A ball that is thrown at the load: where the engine has it, and what is reported of it to the live motion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from salver.geometry import GRAVITY_S, Array
from salver.live import Moving
from salver.live.replanning.obstacles import Movable, predicted
from salver.models.arm.arm import ArmModel
from salver.models.arm.arm_geometry import arm_geometry
from salver.models.bodies import TRAY
from salver.models.payload import Payload
from salver.simulation.scene.elements import FLOOR, HULL, INERT, TRAY_GEOM, hull_name
from salver.simulation.scene.engine import mujoco

BALL = "playground:ball"


@dataclass(frozen=True)
class Throw:
    """A ball, and how it is thrown and seen.

    radius, mass, friction: m, kg, coefficient. flight: s until it would be at the tray. away: m from there. aside: rad,
    least and most, to either side of the way in which the arm reaches: from there it flies on past the arm. over: s
    after which it is put away. seen_every: s between looks at it.
    """

    radius: float = 0.05
    mass: float = 0.1
    friction: float = 0.5
    flight: float = 1.2
    away: float = 1.8
    aside: tuple[float, float] = (1.1, 1.9)
    over: float = 2.0
    seen_every: float = 0.1


def furnish(spec: Any, arm: ArmModel, throw: Throw) -> None:
    """Add the ball, which the floor, tray and load feel, the links of the arm do not."""
    ball = spec.worldbody.add_body(name=BALL, pos=[0, 0, float(arm.base_position[2]) - 10.0])
    ball.add_freejoint(name=BALL)
    ball.mass, ball.inertia = throw.mass, np.full(3, 0.4 * throw.mass * throw.radius**2)
    ball.explicitinertial = True
    ball.add_geom(name=BALL, type=mujoco.mjtGeom.mjGEOM_SPHERE, size=np.array([throw.radius, 0, 0]), **INERT)
    for geom in list(spec.geoms):
        if geom.name.startswith((FLOOR, TRAY_GEOM, HULL)):
            friction = [throw.friction, throw.friction, 0.0, 0.0, 0.0]
            spec.add_pair(geomname1=BALL, geomname2=geom.name, condim=3, friction=friction)


class Ball:
    """The ball of one scene; away until it is thrown."""

    def __init__(self, model: Any, arm: ArmModel, payload: Payload, throw: Throw) -> None:
        self._throw, self.radius = throw, throw.radius
        joint = model.joint(BALL).id
        self._qpos, self._qvel = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        self._away = model.qpos0[self._qpos : self._qpos + 7].copy()
        self._movable, self._base = Movable(arm_geometry(arm, payload.bodies)), arm.base_position
        self._rng = np.random.default_rng(0)
        self._since: float | None = None
        self._seen = -np.inf
        self._geom = int(model.body_geomadr[model.body(BALL).id])
        self._feel = {model.geom(hull_name(k)).id: body.name for k, body in enumerate(payload.bodies)}
        self._feel[model.geom(TRAY_GEOM).id] = TRAY
        self._forget()

    def _forget(self) -> None:
        self.passed = np.inf  # m, the least distance from what moves of arm, tray and load
        self._hit = self._through = ""  # what felt it first; the link that it flew through last

    def throw(self, data: Any, t: float, p_SE: Array) -> None:
        """At what stands on the tray, from the side."""
        how = self._throw
        out = p_SE[:2] - self._base[:2]
        bearing = np.arctan2(out[1], out[0]) + self._rng.choice([-1.0, 1.0]) * self._rng.uniform(*how.aside)
        target = p_SE + np.array([0.0, 0.0, 0.08])
        begin = target + np.array([how.away * np.cos(bearing), how.away * np.sin(bearing), 0.2])
        data.qpos[self._qpos : self._qpos + 7] = [*begin, 1.0, 0.0, 0.0, 0.0]
        data.qvel[self._qvel : self._qvel + 6] = 0.0
        data.qvel[self._qvel : self._qvel + 3] = (target - begin) / how.flight - 0.5 * how.flight * GRAVITY_S
        self._since, self._seen = t, -np.inf
        self._forget()

    @property
    def flies(self) -> bool:
        return self._since is not None

    @property
    def sentence(self) -> str:
        """Its least distance, or what it hit, while it flies."""
        if not self.flies or not np.isfinite(self.passed):
            return ""
        if self._hit:
            return f"The ball has hit the {self._hit}."
        if self._through:
            return f"The ball has hit {self._through}, which does not feel it: it flies through."
        return f"The ball has come to {1e3 * max(self.passed, 0.0):.0f} mm."

    def state(self, data: Any) -> tuple[Array, Array]:
        return data.qpos[self._qpos : self._qpos + 3].copy(), data.qvel[self._qvel : self._qvel + 3].copy()

    def step(self, data: Any, t: float) -> list[Moving] | None:
        """After each period. What is to be told of it now; None for nothing new."""
        if self._since is None:
            data.qpos[self._qpos : self._qpos + 7] = self._away
            data.qvel[self._qvel : self._qvel + 6] = 0.0
            return None
        for geom in data.contact.geom[np.any(data.contact.geom == self._geom, axis=1)].ravel():
            self._hit = self._hit or self._feel.get(int(geom), "")
        (p, v), how = self.state(data), self._throw
        if t - self._since > how.over:
            self._since = None
            return []
        if t - self._seen < how.seen_every:
            return None
        self._seen = t
        if p[2] < self._base[2] + 2 * how.radius:
            return []  # it lies on the floor
        return [Moving("ball", "sphere", p, v, GRAVITY_S, radius=how.radius, uncertainty=0.01, growth=0.05, seen=t)]

    def measure(self, data: Any, q: Array) -> None:
        """Note how near it is."""
        if self._since is None:
            return
        p, _ = self.state(data)
        here = predicted(Moving("ball", "sphere", p, radius=self._throw.radius), 0.0)
        distances = self._movable.distances(q[None], here, p[None])[0]  # type: ignore[arg-type]
        self.passed = min(self.passed, float(distances.min()))
        nearest = self._movable.names[int(np.argmin(distances))]
        if distances.min() <= 0.0 and nearest not in self._feel.values():
            self._through = nearest
