"""The scene in MuJoCo: an arm with a tray, or a tray alone, loose objects on it, obstacles around.

Contact is set up so that it is known exactly. An object stands on small feet, spheres at the corners of its
base (24 of them for a round one): each gives one contact, at a known point, against what it stands on, with
an explicit pair that carries the interface's friction. A hull, raised by a hair, catches it once it tips.

Without an arm the tray is at rest in the engine and the world moves: frame E is the engine's world, and what
the tray's acceleration does is applied as forces (see salver.simulation.tray_frame).

Engine settings are those under which sticking sticks (measured in tests/test_physics_calibration.py): elliptic cones,
impratio 300 (at 1000 sticking contacts creep a third of it, at half the speed), contact time constant of two steps.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from salver.errors import ScenarioError
from salver.geometry import Array, matrix_from_rpy, quat_wxyz_from_matrix
from salver.models.arm import ArmModel
from salver.models.bodies import TRAY
from salver.models.obstacle_shapes import mesh_pieces
from salver.models.rigid_body import RigidBody
from salver.scenario import Cylinder, Obstacle, Scenario
from salver.simulation.engine import mujoco
from salver.simulation.liquid_surface import WALL_OPACITY
from salver.simulation.loads import Load, TrueWorld
from salver.simulation.robots import each_joint

FOOT_RADIUS = 5e-4  # m
SMALL_POINT = 1e-6  # of m L^2: the inertia about itself of a mass that stands for a point
LEAST_INERTIA = 1e-12  # kg m^2; the engine takes less for none, and a gram swings on a few millimetres in a thin glass
DOWN = np.array([0.0, 0.0, -1.0])
HULL_GAP = 3e-4  # m between the hull's base and the feet: closed once an object tips
DAMPING_WIDTH = 0.95  # d_max of solimp: with solref it sets the contact's damping 2 / (d_max timeconst)
DAMPING_RATIO = 3.0  # of the contact's spring: below 2 feet chatter near the friction limit, at 10 they sink visibly
SOLIMP = (0.9, DAMPING_WIDTH, 0.001, 0.5, 2.0)
ARM_PREFIX = "arm/"
TRAY_BODY = TRAY_GEOM = "salver:tray"
OBSTACLE, FOOT, HULL = "salver:obstacle:", "salver:foot:", "salver:hull:"
_REFUSED_LINK = re.compile(f"Element name '{ARM_PREFIX}([^']*)'")  # in the engine's sentence


@dataclass(frozen=True)
class Scene:
    """A compiled scene and where things are in it.

    model: mujoco.MjModel. arm: the arm, or None when the tray is the engine's world.
    world: the objects as they truly are. tray_id, object_ids: MuJoCo bodies. n: joints of the arm.
    qpos_ids, qvel_ids: (m,) first index of each object's free joint. contact_time: solref[0], s.
    foot_object, foot_support, foot_number: (n_geom,) per geom: index of the object whose foot it is (-1: no
    foot), index of the object it rests on (-1: tray),
    number of the foot in `Load.outline_B`. obstacle: (n_geom,) whether it is one.
    swings: what moves of the liquids, in the order of the objects that hold one.
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
    foot_support: Array
    foot_number: Array
    obstacle: Array
    swings: tuple[Swing, ...] = ()

    @property
    def n(self) -> int:
        return 0 if self.arm is None else self.arm.n

    @property
    def point_ids(self) -> list[int]:
        """MuJoCo bodies that are points: what swings in the liquids."""
        return [int(i) for swing in self.swings for i in swing.body_ids]

    @property
    def loads(self) -> tuple[Load, ...]:
        return self.world.loads

    def place(self, data: Any, q: Array | None = None, down: Array = DOWN) -> None:
        """Put the arm at q (n,) at rest, and every object at its place on the tray, at rest with it; liquids level.

        down (3,): where gravity points in the world of the model, of any length: without an arm that is the tray's.
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
            x, y, z = (R_SE @ self.loads[swing.load].R_EB).T @ down_S
            data.qpos[swing.qpos_ids] = np.arctan2(y, -z), -np.arcsin(np.clip(x, -1, 1))
        mujoco.mj_forward(self.model, data)

    def tray_pose(self, data: Any) -> tuple[Array, Array]:
        """(p_SE, R_SE) of the real tray's surface, tilt included."""
        return data.xpos[self.tray_id].copy(), data.xmat[self.tray_id].reshape(3, 3).copy()


@dataclass(frozen=True)
class Swing:
    """The moving masses of one liquid, each a point on a spherical pendulum: hinges about x, then y, of the container.

    load: which object it is in. qpos_ids: (n_modes, 2) of its angles. body_ids: (n_modes,) of the masses. sensor: first
    of the six readings at the centre of the still surface: velocity, turning rate, in the container's axes.
    """

    load: int
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
    also: Callable[[Any], None] | None = None,
) -> Scene:
    """Compile the scene of one run. visual: with meshes, floor and light, for pictures; physics is the same. strapped:
    objects are fixed to the tray, and touch nothing. also: adds to the mujoco.MjSpec what else there is."""
    spec = specify(scenario, world, arm, visual=visual, strapped=strapped)
    if also is not None:
        also(spec)
    return _compiled(spec, arm, world, 2 * scenario.physics.timestep)


def specify(
    scenario: Scenario, world: TrueWorld, arm: ArmModel | None = None, *, visual: bool = False, strapped: bool = False
) -> Any:
    """The same, not yet compiled: a mujoco.MjSpec that can be changed or written as a file."""
    spec = mujoco.MjSpec()
    if visual:
        _add_surroundings(spec)
    _options(spec, scenario.physics.timestep, with_arm=arm is not None)
    root = spec.worldbody
    if arm is not None:
        parent = _add_arm(spec, arm, each_joint(scenario.physics.joint_friction, arm, "physics.joint_friction"), visual)
        parent = parent.add_body(name=TRAY_BODY, pos=arm.p_FE, quat=quat_wxyz_from_matrix(world.R_tilt))
        com_E = world.R_tilt.T @ (arm.tray_com_F - arm.p_FE)
        inertia = world.R_tilt.T @ np.diag(scenario.tray.inertia) @ world.R_tilt
        _set_inertia(parent, scenario.tray.mass, com_E, inertia)
    else:
        parent = root.add_body(name=TRAY_BODY)
    x, y = scenario.tray.size
    thickness = scenario.tray.thickness
    parent.add_geom(
        name=TRAY_GEOM,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[x / 2, y / 2, thickness / 2],
        pos=[0, 0, -thickness / 2],
        rgba=[0.75, 0.77, 0.80, 1],
        **_INERT,
    )
    for k, load in enumerate(world.loads):
        _add_load(spec, load, k)
    obstacles: list[str] = []
    if arm is not None:
        for k, obstacle in enumerate(scenario.obstacles):
            obstacles += _add_obstacle(spec, obstacle, k)
    if strapped:
        for k, load in enumerate(world.loads):
            _strap(spec, load, k, 2 * scenario.physics.timestep)
    else:
        _add_pairs(spec, world.loads, obstacles, 2 * scenario.physics.timestep)
    return spec


def _strap(spec: Any, load: Load, k: int, contact_time: float) -> None:
    weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
    weld.name1, weld.name2 = TRAY_BODY, f"salver:object:{k}"
    weld.solref, weld.solimp = [contact_time, 1.0], [0.999, 0.9999, 0.001, 0.5, 2.0]
    # Anchor in the object, its pose on the tray, weight of the rotation, and what MuJoCo does not read.
    weld.data[:11] = [0.0, 0.0, 0.0, *load.p_EB, *quat_wxyz_from_matrix(load.R_EB), 1.0]


# Geoms meet only through explicit pairs, and add no mass of their own.
_INERT: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0}


def _options(spec: Any, timestep: float, with_arm: bool) -> None:
    option = spec.option
    option.timestep = timestep
    option.gravity = [0, 0, -9.81] if with_arm else [0, 0, 0]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.impratio = 300
    option.tolerance = 1e-14
    option.iterations = 100
    option.noslip_iterations = 0
    # A diverged run must be seen as such: no silent return to the initial state.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # Softness from the true inertia at each contact; MuJoCo's estimate is off through an arm, and many feet chatter.
    option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT)
    if with_arm:  # through the arm all objects are one island: looking for several only costs time
        option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)


def _set_inertia(body: Any, mass: float, com: Array, inertia: Array) -> None:
    """MuJoCo takes a body's inertial frame as given only if position, mass and inertia are all explicit."""
    body.mass = mass
    body.ipos = com
    i = inertia
    body.fullinertia = [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]
    body.explicitinertial = True


def _add_arm(spec: Any, arm: ArmModel, friction: Array, visual: bool) -> Any:
    """Attach the arm's URDF at its base; returns the flange's body."""
    root = ElementTree.fromstring(arm.urdf)
    for link in root.iter("link"):
        for tag in ("visual", "collision"):
            for element in link.findall(tag):
                link.remove(element)
    extension = ElementTree.SubElement(root, "mujoco")
    ElementTree.SubElement(extension, "compiler", fusestatic="false", discardvisual="false", balanceinertia="false")
    robot = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    for joint in robot.joints:
        k = arm.joint_names.index(joint.name)
        limited = np.isfinite(arm.limits.q_min[k]) and np.isfinite(arm.limits.q_max[k])
        joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE if limited else mujoco.mjtLimited.mjLIMITED_FALSE
        if limited:
            joint.range = [arm.limits.q_min[k], arm.limits.q_max[k]]
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.damping = np.zeros(3)  # what friction there is comes from the scenario; the URDF's is not in eq (20)
        joint.frictionloss = friction[k]
    half = 0.5 * arm.base_yaw
    base = spec.worldbody.add_frame(pos=arm.base_position, quat=[np.cos(half), 0, 0, np.sin(half)])
    spec.attach(robot, frame=base, prefix=ARM_PREFIX)
    if visual:
        _add_meshes(spec, arm)
    return spec.body(ARM_PREFIX + arm.flange)


def _add_surroundings(spec: Any) -> None:
    """A floor, a sky and soft light."""
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.35, 0.35, 0.35]
    spec.visual.headlight.specular = [0.1, 0.1, 0.1]
    gradient, skybox = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, mujoco.mjtTexture.mjTEXTURE_SKYBOX
    spec.add_texture(
        name="salver:sky",
        type=skybox,
        builtin=gradient,
        rgb1=[0.97, 0.98, 1],
        rgb2=[0.80, 0.84, 0.9],
        width=256,
        height=1536,
    )
    spec.add_texture(
        name="salver:floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.86, 0.87, 0.89],
        rgb2=[0.81, 0.82, 0.85],
        width=256,
        height=256,
    )
    floor = spec.add_material(name="salver:floor", texrepeat=[4, 4], texuniform=True)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "salver:floor"
    root = spec.worldbody
    root.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 0.05], material="salver:floor", **_INERT)
    root.add_light(pos=[1.5, -1.5, 3], dir=[-0.4, 0.4, -0.8], diffuse=[0.55, 0.55, 0.55], castshadow=True)


def _add_meshes(spec: Any, arm: ArmModel) -> None:
    from salver.simulation.meshes import arm_meshes

    for link, parts in arm_meshes(arm).items():
        body = spec.body(ARM_PREFIX + link)
        for k, part in enumerate(parts):
            name = f"salver:link:{link}:{k}"
            mesh = spec.add_mesh(
                name=name, uservert=part.vertices.ravel().tolist(), userface=part.faces.ravel().tolist()
            )
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # pieces of a skin enclose no volume
            geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=[*part.colour, 1], **_INERT)
            geom.group = 0


def _foot(k: int, number: int) -> str:
    return f"{FOOT}{k}:{number}"


def _hull(k: int) -> str:
    return f"{HULL}{k}"


def _swing(k: int, mode: int) -> str:
    return f"salver:swing:{k}:{mode}"


def _obstacle(k: int) -> str:
    return f"{OBSTACLE}{k}"


_COLOURS = ((0.80, 0.36, 0.22), (0.20, 0.45, 0.70), (0.35, 0.60, 0.30), (0.75, 0.60, 0.20), (0.50, 0.35, 0.60))


def _add_load(spec: Any, load: Load, k: int) -> None:
    body = spec.worldbody.add_body(name=f"salver:object:{k}")
    body.add_freejoint(name=f"salver:object:{k}")
    inertial = load.inertial
    if load.fill is not None:
        still = load.modes.still
        surface = RigidBody(still.mass, still.com_B + load.surface_B, still.inertia_com)
        inertial = RigidBody.from_phi(inertial.phi + surface.phi)
        _add_swing(spec, body, load, k)
    _set_inertia(body, inertial.mass, inertial.com_B, inertial.inertia_com)
    for number, point in enumerate(load.outline_B):
        body.add_geom(
            name=_foot(k, number),
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[FOOT_RADIUS, 0, 0],
            pos=point + np.array([0, 0, FOOT_RADIUS]),
            group=4,
            **_INERT,
        )
    rgba = [*_COLOURS[k % len(_COLOURS)], 1 if load.fill is None else WALL_OPACITY]
    centre, height = -load.com_G, load.solid.height
    raised = centre + np.array([0, 0, HULL_GAP / 2])
    if load.shape.type == "box":  # type: ignore[attr-defined]
        sides = 2 * load.solid.base_polygon.max(axis=0)
        body.add_geom(
            name=_hull(k),
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[sides[0] / 2, sides[1] / 2, (height - HULL_GAP) / 2],
            pos=raised,
            rgba=rgba,
            **_INERT,
        )
    elif isinstance(load.shape, Cylinder):
        body.add_geom(
            name=_hull(k),
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[load.shape.radius, (height - HULL_GAP) / 2, 0],
            pos=raised,
            rgba=rgba,
            **_INERT,
        )
    else:
        points = load.solid.bounding_points_G.copy()
        points[:, 2] = np.maximum(points[:, 2], load.solid.base_z + HULL_GAP)
        mesh = spec.add_mesh(name=f"salver:mesh:{k}", uservert=points.ravel().tolist())
        body.add_geom(
            name=_hull(k), type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, pos=centre, rgba=rgba, **_INERT
        )


def _add_swing(spec: Any, body: Any, load: Load, k: int) -> None:
    """The moving masses of a liquid. Pendulums and not springs: what lifts or tilts the container stiffens them."""
    modes, damping = load.modes, load.damping or 0.0
    for n, (mass, height, length, omega) in enumerate(
        zip(modes.mass[:, 0], modes.height[:, 0], modes.length[:, 0], modes.omega[:, 0], strict=True)
    ):
        bob = body.add_body(name=_swing(k, n), pos=load.surface_B + np.array([0.0, 0.0, height + length]))
        for axis in np.eye(3)[:2]:
            bob.add_joint(
                name=f"{_swing(k, n)}:{'x' if axis[0] else 'y'}",
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=axis,
                damping=np.array([2 * damping * omega * mass * length**2, 0.0, 0.0]),
            )
        own = max(SMALL_POINT * mass * length**2, LEAST_INERTIA)
        _set_inertia(bob, mass, np.array([0.0, 0.0, -length]), own * np.eye(3))
    site = f"salver:surface:{k}"
    body.add_site(name=site, pos=load.surface_B, group=5)
    for name, kind in (("velocity", mujoco.mjtSensor.mjSENS_VELOCIMETER), ("turn", mujoco.mjtSensor.mjSENS_GYRO)):
        spec.add_sensor(name=f"{site}:{name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)


def _add_obstacle(spec: Any, obstacle: Obstacle, k: int) -> list[str]:
    """Add an obstacle; returns the names of its geoms, several for a mesh of several pieces."""
    kinds = {
        "box": (mujoco.mjtGeom.mjGEOM_BOX, [0.5 * x for x in obstacle.size or ()]),
        "sphere": (mujoco.mjtGeom.mjGEOM_SPHERE, [obstacle.radius or 0.0, 0, 0]),
        "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, [obstacle.radius or 0.0, 0.5 * (obstacle.length or 0.0), 0]),
        "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, [obstacle.radius or 0.0, 0.5 * (obstacle.length or 0.0), 0]),
    }
    pieces: list[dict[str, Any]] = []
    if obstacle.type == "mesh":
        for j, points in enumerate(mesh_pieces(obstacle)):
            mesh = spec.add_mesh(name=f"{_obstacle(k)}:{j}", uservert=points.ravel().tolist())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            pieces.append({"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh.name})
    else:
        kind, size = kinds[obstacle.type]
        pieces.append({"type": kind, "size": size})
    names = [f"{_obstacle(k)}:{j}" for j in range(len(pieces))]
    rotation = matrix_from_rpy(np.deg2rad(obstacle.rpy_deg))
    for name, piece in zip(names, pieces, strict=True):
        spec.worldbody.add_geom(
            name=name,
            pos=obstacle.position,
            quat=quat_wxyz_from_matrix(rotation),
            rgba=[0.55, 0.57, 0.62, 0.6],
            **piece,
            **_INERT,
        )
    return names


def _add_pairs(spec: Any, loads: tuple[Load, ...], obstacles: list[str], contact_time: float) -> None:
    def pair(first: str, second: str, friction: float) -> None:
        spec.add_pair(
            geomname1=first,
            geomname2=second,
            condim=3,
            friction=[friction, friction, 0, 0, 0],
            solref=[contact_time, DAMPING_RATIO],
            solimp=SOLIMP,
        )

    index = {load.name: k for k, load in enumerate(loads)}
    for k, load in enumerate(loads):
        for number, support in _foot_supports(load):
            pair(TRAY_GEOM if support == TRAY else _hull(index[support]), _foot(k, number), load.friction)
        pair(TRAY_GEOM, _hull(k), load.friction)
        for j in range(k):
            pair(_hull(j), _hull(k), min(load.friction, loads[j].friction))
        for obstacle in obstacles:
            pair(obstacle, _hull(k), load.friction)
    for obstacle in obstacles:
        pair(obstacle, TRAY_GEOM, 0.5)


def _foot_supports(load: Load) -> Iterable[tuple[int, str]]:
    return enumerate(name for name, points in load.supports.items() for _ in points)


def _compiled(spec: Any, arm: ArmModel | None, world: TrueWorld, contact_time: float) -> Scene:
    """Raises ScenarioError: a link of the arm has no mass or inertia that the engine could move. One that is fixed to
    another may be without: what is fixed together moves as one.
    """
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
    foot = np.full((3, model.ngeom), -1)
    index = {load.name: k for k, load in enumerate(world.loads)}
    for k, load in enumerate(world.loads):
        for number, support in _foot_supports(load):
            geom = model.geom(_foot(k, number)).id
            foot[:, geom] = k, -1 if support == TRAY else index[support], number
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
        foot_support=foot[1],
        foot_number=foot[2],
        obstacle=np.array([model.geom(i).name.startswith(OBSTACLE) for i in range(model.ngeom)]),
        swings=tuple(_found_swing(model, k, load) for k, load in enumerate(world.loads) if load.fill is not None),
    )


def _found_swing(model: Any, k: int, load: Load) -> Swing:
    names = [_swing(k, n) for n in range(len(load.modes.mass))]
    joints = [[model.joint(f"{name}:{axis}").qposadr[0] for axis in "xy"] for name in names]
    bodies = [model.body(name).id for name in names]
    return Swing(k, np.array(joints), np.array(bodies), int(model.sensor(f"salver:surface:{k}:velocity").adr[0]))
