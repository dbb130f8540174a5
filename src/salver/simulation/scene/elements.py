"""MuJoCo elements: the arm, an object with its contacts, its liquid or pendulum, an obstacle.

An object stands on small spheres, its feet, at the corners of its base (24 for a round base). Each foot has one
contact with the support, at a known point, with an explicit pair for the friction. The hull of the object, raised by
`HULL_GAP`, touches the support once the object tips.

The engine settings are those under which contacts stick (measured in test_physics_calibration.py): elliptic
cones, impratio 300 (1000 gives a third of the creep at half the speed), contact time constant of two steps.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from salver.geometry import Array, matrix_from_rpy, quat_wxyz_from_matrix
from salver.models.arm.arm import STAND_IN, ArmModel, moved_links
from salver.models.arm.urdf import without_shapes
from salver.models.bodies import TRAY
from salver.models.described import SIDES
from salver.models.load_dynamics import Rod
from salver.models.rigid_body import RigidBody
from salver.models.shapes.obstacle_shapes import mesh_pieces
from salver.scenario import Cylinder, Obstacle, Tray
from salver.simulation.scene.engine import mujoco
from salver.simulation.scene.loads import WALL_OPACITY, Load

FOOT_RADIUS = 5e-4  # m
FARTHEST_SWING = 60.0  # degrees; at 90 the two hinges of a pendulum become singular, and the engine diverges
SMALL_POINT = 1e-6  # inertia of a point mass about itself, as a share of m L^2
LEAST_INERTIA = 1e-12  # kg m^2; the engine treats less as zero, and light pendulums would have less
HULL_GAP = 3e-4  # m between the hull's base and the feet: closed once an object tips
DAMPING_WIDTH = 0.95  # d_max of solimp: with solref it sets the contact's damping 2 / (d_max timeconst)
DAMPING_RATIO = 3.0  # of a contact; below 2 feet chatter near the friction limit, at 10 they sink visibly
SOLIMP = (0.9, DAMPING_WIDTH, 0.001, 0.5, 2.0)
ARM_PREFIX = "arm/"
TRAY_BODY = TRAY_GEOM = "salver:tray"
FLOOR, OBSTACLE, FOOT, HULL = "salver:floor", "salver:obstacle:", "salver:foot:", "salver:hull:"
WALL = "salver:rim:"
# Geoms touch through explicit pairs only, and have no mass of their own.
INERT: dict[str, Any] = {"contype": 0, "conaffinity": 0, "mass": 0}
TRAY_COLOUR, POST_COLOUR = (0.06, 0.30, 0.36, 1.0), (0.35, 0.37, 0.40, 1.0)  # dark against floor, sky and white links
POST_RADIUS = 0.026  # m, as the replay draws it
COLOURS = ((0.80, 0.36, 0.22), (0.20, 0.45, 0.70), (0.35, 0.60, 0.30), (0.75, 0.60, 0.20), (0.50, 0.35, 0.60))


def strap(spec: Any, load: Load, k: int, contact_time: float) -> None:
    """Weld an object to the tray."""
    weld = spec.add_equality(type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
    weld.name1, weld.name2 = TRAY_BODY, f"salver:object:{k}"
    weld.solref, weld.solimp = [contact_time, 1.0], [0.999, 0.9999, 0.001, 0.5, 2.0]
    # Anchor in the object, its pose on the tray, weight of the rotation, and entries that MuJoCo ignores.
    weld.data[:11] = [0.0, 0.0, 0.0, *load.p_EB, *quat_wxyz_from_matrix(load.R_EB), 1.0]


def set_options(spec: Any, timestep: float, with_arm: bool, several: bool = False) -> None:
    """Set solver, integrator and gravity (see the module). several: whether several objects are on the tray."""
    option = spec.option
    option.timestep = timestep
    option.gravity = [0, 0, -9.81] if with_arm else [0, 0, 0]
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    # A sparse Jacobian makes an arm with four glasses 2.5 times faster.
    sparse = with_arm and several
    option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE if sparse else mujoco.mjtJacobian.mjJAC_DENSE
    option.impratio = 300
    option.tolerance = 1e-14
    option.iterations = 100
    option.noslip_iterations = 0
    # A diverged run must be detected: no silent reset to the initial state.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    # Contact softness from the true inertia; MuJoCo's estimate is wrong for a tray on an arm, and feet chatter.
    option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT)
    if with_arm:  # the arm connects all objects to one island, so that a search for islands costs time only
        option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)


def set_inertia(body: Any, mass: float, com: Array, inertia: Array) -> None:
    """Set position, mass and inertia of a body; MuJoCo uses its inertial frame only if all are explicit."""
    body.mass = mass
    body.ipos = com
    i = inertia
    body.fullinertia = [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]]
    body.explicitinertial = True


def add_arm(spec: Any, arm: ArmModel, friction: Array, visual: bool) -> Any:
    """Attach the arm's URDF at its base; returns the flange's body."""
    root = without_shapes(arm.urdf)
    _merge_fixed_links(root)
    for link in root.iter("link"):
        if link.get("name") in arm.weightless:
            _set_inertial(link, STAND_IN)
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
        joint.damping = np.zeros(3)  # joint friction comes from the scenario; eq (20) has no damping
        joint.frictionloss = friction[k]
    base = spec.worldbody.add_frame(pos=arm.base_position, quat=quat_wxyz_from_matrix(arm.R_base))
    spec.attach(robot, frame=base, prefix=ARM_PREFIX)
    if visual:
        _add_meshes(spec, arm)
    return spec.body(ARM_PREFIX + arm.flange)


def _merge_fixed_links(root: ElementTree.Element) -> None:
    """Merge the inertia of links that are fixed to one another, and remove that of links that do not move.

    Fixed links in URDFs often have impossible inertias, which the engine would refuse.
    """
    model = pin.buildModelFromXML(ElementTree.tostring(root, encoding="unicode"))
    moved, links = moved_links(model), {link.get("name", ""): link for link in root.iter("link")}
    for name, link in links.items():
        own, joint = link.find("inertial"), model.frames[model.getFrameId(name, pin.FrameType.BODY)].parentJoint
        if own is None or moved.get(joint) == name:
            continue
        link.remove(own)
        if joint in moved:
            _set_inertial(links[moved[joint]], model.inertias[joint])


def _set_inertial(link: ElementTree.Element, inertia: Any) -> None:
    for own in link.findall("inertial"):
        link.remove(own)
    element = ElementTree.SubElement(link, "inertial")
    ElementTree.SubElement(element, "origin", xyz=" ".join(repr(x) for x in inertia.lever.tolist()))
    ElementTree.SubElement(element, "mass", value=repr(float(inertia.mass)))
    entries = {f"i{'xyz'[i]}{'xyz'[j]}": repr(float(inertia.inertia[i, j])) for i in range(3) for j in range(i, 3)}
    ElementTree.SubElement(element, "inertia", entries)


def add_tray(body: Any, tray: Tray, flange_E: Array | None = None) -> None:
    """Add the tray's plate, and the walls of its rim, to a body at E. flange_E: (3,) the flange, m, to draw the post
    between it and the plate."""
    for name, (centre, size) in zip((TRAY_GEOM, *wall_names(tray)), tray.boxes, strict=True):
        half = [0.5 * x for x in size]
        body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=centre, rgba=TRAY_COLOUR, **INERT)
    if flange_E is not None and -flange_E[2] > tray.thickness + POST_RADIUS / 10:
        post = {"fromto": [0, 0, -tray.thickness, *flange_E], "size": [POST_RADIUS, 0, 0]}
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, rgba=POST_COLOUR, **post, **INERT)


def wall_names(tray: Tray) -> list[str]:
    return [f"{WALL}{side}" for side in SIDES] if tray.rim else []


def add_floor(spec: Any, height: float) -> str:
    """Add the floor, a plane at a height, m; returns its name."""
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    # It has the material of `add_surroundings`; without that, it is not drawn.
    material = next((item.name for item in spec.materials if item.name == FLOOR), "")
    spec.worldbody.add_geom(name=FLOOR, type=plane, size=[0, 0, 0.05], pos=[0, 0, height], material=material, **INERT)
    return FLOOR


def add_surroundings(spec: Any) -> None:
    """Add the material of a floor, a sky and soft light, for pictures."""
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
    )
    spec.add_texture(
        name=FLOOR,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.86, 0.87, 0.89],
        rgb2=[0.81, 0.82, 0.85],
        width=256,
        height=256,
    )
    floor = spec.add_material(name=FLOOR, texrepeat=[4, 4], texuniform=True)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = FLOOR
    spec.worldbody.add_light(pos=[1.5, -1.5, 3], dir=[-0.4, 0.4, -0.8], diffuse=[0.55, 0.55, 0.55], castshadow=True)


def _add_meshes(spec: Any, arm: ArmModel) -> None:
    from salver.simulation.scene.meshes import arm_meshes

    for link, parts in arm_meshes(arm).items():
        body = spec.body(ARM_PREFIX + link)
        for k, part in enumerate(parts):
            name = f"salver:link:{link}:{k}"
            mesh = spec.add_mesh(
                name=name, uservert=part.vertices.ravel().tolist(), userface=part.faces.ravel().tolist()
            )
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open surfaces have no volume
            geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=[*part.colour, 1], **INERT)
            geom.group = 0


def foot_name(k: int, number: int) -> str:
    return f"{FOOT}{k}:{number}"


def hull_name(k: int) -> str:
    return f"{HULL}{k}"


def swing_name(k: int, mode: int) -> str:
    return f"salver:swing:{k}:{mode}"


def rod_name(k: int, mode: int, rod: Rod) -> str:
    return f"{swing_name(k, mode)}:rod:{''.join('xy'[axis] for axis in rod.along)}"


def obstacle_name(k: int) -> str:
    return f"{OBSTACLE}{k}"


def add_load(spec: Any, load: Load, k: int) -> None:
    """Add an object at the world's origin, free to move: its feet, its hull, its liquid or pendulum."""
    body = spec.worldbody.add_body(name=f"salver:object:{k}")
    body.add_freejoint(name=f"salver:object:{k}")
    if load.value is not None:
        _add_swing(spec, body, load, k)
    still = load.still
    set_inertia(body, still.mass, still.com_B, still.inertia_com + lent(still) * np.eye(3))
    for number, point in enumerate(load.outline_B):
        body.add_geom(
            name=foot_name(k, number),
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=[FOOT_RADIUS, 0, 0],
            pos=point + np.array([0, 0, FOOT_RADIUS]),
            group=4,
            **INERT,
        )
    centre, height = -load.com_G, load.solid.height
    raised = centre + np.array([0, 0, HULL_GAP / 2])
    shape: dict[str, Any]
    if load.shape.type == "box":  # type: ignore[attr-defined]
        sides = load.solid.base_polygon.max(axis=0)
        shape = {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [*sides, (height - HULL_GAP) / 2], "pos": raised}
    elif isinstance(load.shape, Cylinder):
        size = [load.shape.radius, (height - HULL_GAP) / 2, 0]
        shape = {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": size, "pos": raised}
    else:
        points = load.solid.bounding_points_G.copy()
        points[:, 2] = np.maximum(points[:, 2], load.solid.base_z + HULL_GAP)
        mesh = spec.add_mesh(name=f"salver:mesh:{k}", uservert=points.ravel().tolist())
        shape = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": mesh.name, "pos": centre}
    rgba = [*COLOURS[k % len(COLOURS)], 1 if load.value is None else WALL_OPACITY]
    body.add_geom(name=hull_name(k), rgba=rgba, **shape, **INERT)


def lent(still: RigidBody) -> float:
    """Inertia, kg m^2, to add about every axis so that the engine's compiler accepts a body.

    The part of a liquid in a box that does not slosh (`Modes.still`) may violate the triangle inequality. The addition
    keeps the principal axes, and is subtracted again in the compiled scene.
    """
    least, middle, largest = np.linalg.eigvalsh(still.inertia_com).tolist()
    lacks = largest - middle - least
    return lacks + 1e-9 * largest if lacks > 1e-9 * largest else 0.0


def _add_swing(spec: Any, body: Any, load: Load, k: int) -> None:
    """Add the sloshing or swinging masses as pendulums, whose stiffness depends on lift and tilt as it should."""
    modes, damping = load.modes, load.damping or 0.0
    inertia = modes.mass * modes.length**2
    for n, rods in enumerate(modes.pendulums):
        hung, at = body, load.origin_B
        for rod in rods:
            hung = hung.add_body(name=rod_name(k, n, rod), pos=at + np.array([0.0, 0.0, rod.pivot]))
            for axis in rod.along:
                hung.add_joint(
                    name=f"{swing_name(k, n)}:{'xy'[axis]}",
                    type=mujoco.mjtJoint.mjJNT_HINGE,
                    axis=np.eye(3)[1 - axis],
                    limited=True,
                    range=[-FARTHEST_SWING, FARTHEST_SWING],
                    damping=np.array([2 * damping * modes.omega[n, axis] * inertia[n, axis], 0.0, 0.0]),
                )
            own = max(SMALL_POINT * inertia[n, rod.along[-1]], LEAST_INERTIA)
            set_inertia(hung, rod.mass, np.array([0.0, 0.0, rod.height - rod.pivot]), own * np.eye(3))
            at = np.array([0.0, 0.0, -rod.pivot])
    site = f"salver:inside:{k}"
    body.add_site(name=site, pos=load.origin_B, group=5)
    for name, kind in (("velocity", mujoco.mjtSensor.mjSENS_VELOCIMETER), ("turn", mujoco.mjtSensor.mjSENS_GYRO)):
        spec.add_sensor(name=f"{site}:{name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)


def add_obstacle(spec: Any, obstacle: Obstacle, k: int) -> list[str]:
    """Add an obstacle; returns the names of its geoms, several for a mesh of several pieces."""
    geom, radius, half = mujoco.mjtGeom, obstacle.radius or 0.0, 0.5 * (obstacle.length or obstacle.height or 0.0)
    kinds = {
        "box": (geom.mjGEOM_BOX, [0.5 * x for x in obstacle.size or ()]),
        "sphere": (geom.mjGEOM_SPHERE, [radius, 0, 0]),
        "capsule": (geom.mjGEOM_CAPSULE, [radius, half, 0]),
        "cylinder": (geom.mjGEOM_CYLINDER, [radius, half, 0]),
    }
    pieces: list[dict[str, Any]] = []
    if obstacle.type == "mesh":
        for j, points in enumerate(mesh_pieces(obstacle)):
            mesh = spec.add_mesh(name=f"{obstacle_name(k)}:{j}", uservert=points.ravel().tolist())
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            pieces.append({"type": geom.mjGEOM_MESH, "meshname": mesh.name})
    else:
        kind, size = kinds[obstacle.type]
        pieces.append({"type": kind, "size": size})
    names = [f"{obstacle_name(k)}:{j}" for j in range(len(pieces))]
    rotation = matrix_from_rpy(np.deg2rad(obstacle.rpy_deg))
    for name, piece in zip(names, pieces, strict=True):
        spec.worldbody.add_geom(
            name=name,
            pos=obstacle.position,
            quat=quat_wxyz_from_matrix(rotation),
            rgba=[0.55, 0.57, 0.62, 0.6],
            **piece,
            **INERT,
        )
    return names


def add_pairs(
    spec: Any, loads: tuple[Load, ...], walls: list[str], rim_friction: float, obstacles: list[str], contact_time: float
) -> None:
    """Add the contact pairs with their friction. walls: names of the rim's geoms."""

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
        for number, support in foot_supports(load):
            pair(TRAY_GEOM if support == TRAY else hull_name(index[support]), foot_name(k, number), load.friction)
        pair(TRAY_GEOM, hull_name(k), load.friction)
        for j in range(k):
            pair(hull_name(j), hull_name(k), min(load.friction, loads[j].friction))
        for wall in walls:
            pair(wall, hull_name(k), rim_friction)
        for obstacle in obstacles:
            pair(obstacle, hull_name(k), load.friction)
    for obstacle, part in itertools.product(obstacles, (TRAY_GEOM, *walls)):
        pair(obstacle, part, 0.5)


def foot_supports(load: Load) -> Iterable[tuple[int, str]]:
    """For each foot its number, and the name of its support."""
    return enumerate(name for name, points in load.supports.items() for _ in points)
