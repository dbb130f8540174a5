"""The scene in MuJoCo: an arm with a tray, or a tray alone, loose objects on it, obstacles around.

`salver.simulation.scene.elements` has the bodies, geoms and contact pairs.

Without an arm the tray is at rest in the engine: frame E is the engine's world, and inertial forces act on the objects
(see salver.simulation.tray_frame).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from salver.errors import ScenarioError
from salver.geometry import Array, Indices, quat_wxyz_from_matrix
from salver.models.arm.arm import ArmModel
from salver.scenario import Scenario
from salver.simulation.scene.elements import (
    ARM_PREFIX,
    FLOOR,
    OBSTACLE,
    TRAY_BODY,
    add_arm,
    add_floor,
    add_load,
    add_obstacle,
    add_pairs,
    add_surroundings,
    add_tray,
    foot_name,
    foot_supports,
    lent,
    rod_name,
    set_inertia,
    set_options,
    strap,
    swing_name,
    wall_names,
)
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.loads import Load, TrueWorld
from salver.simulation.scene.robots import each_joint
from salver.simulation.scene.shaking import Shaking
from salver.simulation.scene.sliding import Sliding

DOWN = np.array([0.0, 0.0, -1.0])
HINGE = (-1.0, 1.0)  # sign of a pendulum's displacement along x and y for positive angles about y and x
_REFUSED_LINK = re.compile(f"Element name '{ARM_PREFIX}([^']*)'")  # in the engine's error message


@dataclass(frozen=True)
class Scene:
    """A compiled scene, with the indices of its parts.

    model: mujoco.MjModel. arm: the arm, or None if the tray is the engine's world.
    world: the true loads. tray_id, object_ids: MuJoCo bodies. n: joints of the arm.
    qpos_ids, qvel_ids: (m,) first index of each object's free joint. contact_time: solref[0], s.
    foot_object, foot_number: (n_geom,) for each geom the index of the object whose foot it is (-1: no foot), and its
    number in `Load.outline_B`.
    obstacle: (n_geom,) whether a geom is an obstacle or the floor.
    swings: the liquids and pendulums, in the order of the objects. shaking: vibration of the tray, or None. sliding:
    kinetic friction, or None where it is the static one.
    """

    model: Any
    arm: ArmModel | None
    world: TrueWorld
    tray_id: int
    object_ids: Array
    qpos_ids: Array
    qvel_ids: Array
    contact_time: float
    foot_object: Array
    foot_number: Array
    obstacle: Array
    swings: tuple[Swing, ...] = ()
    shaking: Shaking | None = None
    sliding: Sliding | None = None

    @property
    def n(self) -> int:
        return 0 if self.arm is None else self.arm.n

    @property
    def beside_walls(self) -> bool:
        """Whether an arm carries a load against the rim, whose contacts must not creep (salver.simulation.creep)."""
        return self.arm is not None and any(load.nominal.walls is not None for load in self.loads)

    @property
    def point_ids(self) -> list[int]:
        """MuJoCo bodies that are point masses: the pendulums inside the objects."""
        return [int(i) for swing in self.swings for i in swing.body_ids]

    @cached_property
    def _loose_ids(self) -> Indices:
        return np.array([*self.object_ids, *self.point_ids], dtype=np.intp)

    def slide(self, data: Any) -> None:
        """Set the friction of the contacts that slide."""
        if self.sliding is not None:
            self.sliding.apply(self.model, data)

    def shake(self, data: Any, t: float) -> None:
        """Apply the forces of the tray's vibration at t, s, to the load, when an arm holds the tray."""
        if self.shaking is not None:
            self.shaking.push(self.model, data, self._loose_ids, data.xpos[self.tray_id], t)

    @property
    def loads(self) -> tuple[Load, ...]:
        return self.world.loads

    def place(self, data: Any, q: Array | None = None, down: Array = DOWN) -> None:
        """Set the initial state: arm at q (n,), objects at their places on the tray, pendulums hanging, all at rest.

        down (3,): direction of gravity in the engine's world; without an arm that is frame E.
        """
        data.qvel[:] = 0
        if q is not None:
            data.qpos[: self.n] = q
        mujoco.mj_kinematics(self.model, data)
        p_SE, R_SE = self.tray_pose(data)
        for load, i in zip(self.loads, self.qpos_ids, strict=True):
            data.qpos[i : i + 3] = p_SE + R_SE @ load.p_EB
            data.qpos[i + 3 : i + 7] = quat_wxyz_from_matrix(R_SE @ load.R_EB)
        down_S = down / np.linalg.norm(down)
        for swing in self.swings:
            down_B, first, second = (R_SE @ self.loads[swing.load].R_EB).T @ down_S, swing.first, 1 - swing.first
            data.qpos[swing.qpos_ids[:, first]] = HINGE[first] * np.arctan2(down_B[first], -down_B[2])
            data.qpos[swing.qpos_ids[:, second]] = HINGE[second] * np.arcsin(np.clip(down_B[second], -1, 1))
        mujoco.mj_forward(self.model, data)

    def tray_pose(self, data: Any) -> tuple[Array, Array]:
        """Pose (p_SE, R_SE) of the real tray's surface, including its tilt."""
        return data.xpos[self.tray_id].copy(), data.xmat[self.tray_id].reshape(3, 3).copy()


@dataclass(frozen=True)
class Swing:
    """The pendulums inside one object (`salver.models.load_dynamics.Modes.pendulums`).

    load: index of the object. first: axis of the container, 0 or 1, along which the first hinge of each one swings.
    qpos_ids: (n_modes, 2) indices of the angles along x and y. body_ids: (n_points,) MuJoCo bodies of the masses.
    sensor: first of six sensor values at the origin of the dynamics: velocity, angular velocity, in the container's
    axes.
    """

    load: int
    first: int
    qpos_ids: Array
    body_ids: Array
    sensor: int


def build(
    scenario: Scenario,
    world: TrueWorld,
    arm: ArmModel | None = None,
    *,
    visual: bool = False,
    strapped: bool = False,
    seed: int = 0,
) -> Scene:
    """Compile the scene of one run.

    visual: with meshes and light, for pictures; the physics does not change. strapped: objects are fixed to the tray,
    without contacts. seed: seed of the tray's vibration.
    """
    spec = specify(scenario, world, arm, visual=visual, strapped=strapped)
    shake = scenario.uncertainty.shake
    shaking = None if shake is None or strapped else Shaking.drawn(shake.vibration, seed)
    made, share = _compiled(spec, arm, world, 2 * scenario.physics.timestep), scenario.physics.kinetic_friction
    return replace(made, shaking=shaking, sliding=None if share == 1.0 else Sliding.of(made.model, share))


def specify(
    scenario: Scenario, world: TrueWorld, arm: ArmModel | None = None, *, visual: bool = False, strapped: bool = False
) -> Any:
    """The scene of `build` before compilation: a mujoco.MjSpec that can be changed or written to a file."""
    spec = mujoco.MjSpec()
    if visual:
        add_surroundings(spec)
    set_options(spec, scenario.physics.timestep, arm is not None, several=len(world.loads) > 1)
    root = spec.worldbody
    if arm is not None:
        parent = add_arm(spec, arm, each_joint(scenario.physics.joint_friction, arm, "physics.joint_friction"), visual)
        parent = parent.add_body(name=TRAY_BODY, pos=arm.p_FE, quat=quat_wxyz_from_matrix(arm.R_FE @ world.R_tilt))
        com_E = world.R_tilt.T @ arm.tray_com_E
        inertia = world.R_tilt.T @ np.diag(scenario.tray.inertia) @ world.R_tilt
        set_inertia(parent, scenario.tray.mass, com_E, inertia)
    else:
        parent = root.add_body(name=TRAY_BODY)
    flange_E = -(arm.R_FE @ world.R_tilt).T @ arm.p_FE if visual and arm is not None else None
    add_tray(parent, scenario.tray, flange_E)
    for k, load in enumerate(world.loads):
        add_load(spec, load, k)
    obstacles: list[str] = []
    if arm is not None:
        for k, obstacle in enumerate(scenario.obstacles):
            obstacles += add_obstacle(spec, obstacle, k)
        if scenario.floor is not None:
            obstacles.append(add_floor(spec, scenario.floor))
    elif visual:
        add_floor(spec, 0.0)
    if strapped:
        for k, load in enumerate(world.loads):
            strap(spec, load, k, 2 * scenario.physics.timestep)
    else:
        walls = wall_names(scenario.tray)
        add_pairs(spec, world.loads, walls, world.rim_friction, obstacles, 2 * scenario.physics.timestep)
    return spec


def _compiled(spec: Any, arm: ArmModel | None, world: TrueWorld, contact_time: float) -> Scene:
    """Compile a scene. Raises ScenarioError when a moving link of the arm has no valid mass and inertia."""
    try:
        model = spec.compile()
    except ValueError as error:
        reason, link = str(error).splitlines()[0].removeprefix("Error: "), _REFUSED_LINK.search(str(error))
        if arm is None or link is None:
            raise
        raise ScenarioError(
            f"The physics engine cannot move the link {link[1]} of {arm.urdf_path} ({reason}); a link that a joint "
            "moves needs <inertial> with a mass above 0 and an inertia that a body can have."
        ) from None
    for k, load in enumerate(world.loads):
        if inertia := lent(load.still):
            model.body(f"salver:object:{k}").inertia -= inertia
            mujoco.mj_setConst(model, mujoco.MjData(model))
    foot = np.full((2, model.ngeom), -1)
    for k, load in enumerate(world.loads):
        for number, _ in foot_supports(load):
            foot[:, model.geom(foot_name(k, number)).id] = k, number
    joints = [model.joint(f"salver:object:{k}").id for k in range(len(world.loads))]
    return Scene(
        model=model,
        arm=arm,
        world=world,
        tray_id=model.body(TRAY_BODY).id,
        object_ids=np.array([model.body(f"salver:object:{k}").id for k in range(len(world.loads))]),
        qpos_ids=model.jnt_qposadr[joints],
        qvel_ids=model.jnt_dofadr[joints],
        contact_time=contact_time,
        foot_object=foot[0],
        foot_number=foot[1],
        obstacle=np.array([model.geom(i).name.startswith((OBSTACLE, FLOOR)) for i in range(model.ngeom)]),
        swings=tuple(_found_swing(model, k, load) for k, load in enumerate(world.loads) if load.value is not None),
    )


def _found_swing(model: Any, k: int, load: Load) -> Swing:
    pendulums = load.modes.pendulums
    names = [swing_name(k, n) for n in range(len(pendulums))]
    joints = [[model.joint(f"{name}:{axis}").qposadr[0] for axis in "xy"] for name in names]
    bodies = [model.body(rod_name(k, n, rod)).id for n, rods in enumerate(pendulums) for rod in rods]
    sensor = int(model.sensor(f"salver:inside:{k}:velocity").adr[0])
    return Swing(k, pendulums[0][0].along[0], np.array(joints), np.array(bodies), sensor)
