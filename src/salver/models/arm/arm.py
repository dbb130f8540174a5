"""The arm: kinematics, dynamics and limits, from a URDF, by Pinocchio (paper, eqs 20 and 21).

The tray is fixed to the flange: its inertia is part of the last link, so only the loose load is uncertain (paper,
section V). Frames: F, the flange, and E, the centre of the tray's top surface, `tray.height` out along F's z and
parallel to F. Every Jacobian here is a *body* Jacobian: it gives the twist (v, omega) of a frame in that frame, linear
part first; its time derivative is that of its entries.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from salver.errors import ScenarioError
from salver.geometry import GRAVITY_S, Array, adjoint, invert
from salver.models.arm.arm_limits import JointLimits, VelocityByPosition, joint_limits, read_joint_limits
from salver.models.arm.known_arms import KNOWN_ARMS, robot_file
from salver.models.arm.mobile_base import JOINTS, on_base
from salver.models.arm.tables import Arm, ArmLimits, MobileBase
from salver.models.arm.urdf import LARGEST_LINK, SUFFIXES, read_chain, read_disabled_pairs, without_shapes
from salver.models.described import Tray

if TYPE_CHECKING:
    from salver.models.bodies import Body

TRAY_FRAME = "salver_tray"
DRIVEN = ("along", "across")  # ways in which a base drives, beside its heading
OWN = ("the URDF", "the maker of")  # beginnings of the sources of the arm's own limits
# Of a moving link to which the URDF gives no mass, in the physics engine: 10 kg, 0.1 kg m^2. It is heavy, so that the
# load hardly moves the arm, as it does not move one under position control.
STAND_IN = pin.Inertia(10.0, np.zeros(3), 0.1 * np.eye(3))


@dataclass(frozen=True, eq=False)
class ArmModel:
    """An arm with a tray on its flange. Not for use by several threads at once: they would share `data`.

    name: as in the scenario. pin_model, data: Pinocchio's model (tray included) and work space.
    flange, tray_id: name of the frame F; index of the frame E in `pin_model.frames`.
    joint_names: n names from the base outwards. link_names: links from the root to F, root first.
    limits: of the joints; planning_limits: the part of them that the scenario lets a plan use; own_limits: those of the
    manufacturer and the URDF. rated: payload rating, kg, None if unknown.
    limit_sources: source of each kind of limit per joint; None without a limit. linear: whether a joint is prismatic
    (m instead of rad).
    urdf: the loaded URDF as text, without links beyond the flange, with joints beside the chain fixed, and with
    absolute paths of the mesh files that were found. urdf_path: its file. collisions: treatment of links with unknown
    geometry: "meshes" (refuse), "capsules" (fit some), "unchecked" (leave them out). disabled_pairs: (first, second),
    sorted: links that the SRDF excludes from comparison. weightless: moving links to which, with everything fixed to
    them, the URDF gives no mass. If there are any, torques are unknown: the arm has no torque limits, and counts as
    position-controlled. base_position, R_base: (3,) m and (3, 3), pose of the URDF's root in S. base: one that drives,
    as the scenario has it; its joints are the first three. p_FE, R_FE: (3,) m and
    (3, 3), pose in F of the middle of the tray's top surface. tray_com_E: (3,) the tray's centre of mass in E.
    tray_size: (3,) edges of the box around it, with its rim, along the axes of E, m.
    """

    name: str
    pin_model: Any
    data: Any
    flange: str
    tray_id: int
    joint_names: tuple[str, ...]
    link_names: tuple[str, ...]
    limits: JointLimits
    planning_limits: JointLimits
    own_limits: JointLimits
    rated: float | None
    limit_sources: Mapping[str, tuple[str | None, ...]]
    linear: tuple[bool, ...]
    urdf: str
    urdf_path: Path
    collisions: str
    disabled_pairs: frozenset[tuple[str, str]]
    weightless: tuple[str, ...]
    base_position: Array
    R_base: Array
    base: MobileBase | None
    p_FE: Array
    R_FE: Array
    tray_com_E: Array
    tray_size: tuple[float, float, float]

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.pin_model.nv)

    def unit(self, joint: int) -> str:
        """Unit of a joint's position: rad, or m if it is prismatic."""
        return "m" if self.linear[joint] else "rad"

    def base_velocity(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """Velocity (N, 2) of a base that drives, m/s, along and across its heading, and these two directions (N, 2, 2)
        in the axes of base_x and base_y, from positions and velocities of all joints (N, n)."""
        cosine, sine = np.cos(q[:, 2]), np.sin(q[:, 2])
        axes = np.stack([np.stack([cosine, sine], axis=1), np.stack([-sine, cosine], axis=1)], axis=1)
        return (axes @ dq[:, :2, None])[:, :, 0], axes

    def base_limits(self, limits: JointLimits) -> tuple[float, float]:
        """Largest of these two velocities, m/s: the limits of base_x and base_y; across the heading of a differential
        base, that at which it counts as rolling."""
        assert self.base is not None
        along, across = limits.velocity[:2].tolist()
        return along, self.base.sideways if self.base.kind == "differential" else across

    def tray_pose(self, q: Array) -> tuple[Array, Array]:
        """(p_SE, R_SE) at joint positions q (n,)."""
        pin.framesForwardKinematics(self.pin_model, self.data, q)
        placement = self.data.oMf[self.tray_id]
        return placement.translation.copy(), placement.rotation.copy()

    def tray_rotation(self, q: Array) -> Array:
        """R_SE at joint positions q (n,); with a work space of its own, from any thread."""
        data = self.pin_model.createData()
        pin.framesForwardKinematics(self.pin_model, data, q)
        return np.array(data.oMf[self.tray_id].rotation)

    def tray_velocity(self, q: Array, dq: Array) -> Array:
        """(6,) velocity of E, m/s, and angular velocity, rad/s, in S; with a work space of its own, from any thread."""
        data = self.pin_model.createData()
        pin.forwardKinematics(self.pin_model, data, q, dq)
        return np.array(pin.getFrameVelocity(self.pin_model, data, self.tray_id, pin.LOCAL_WORLD_ALIGNED).vector)

    def object_pose(self, q: Array, p_EB: Array, R_EB: Array) -> tuple[Array, Array]:
        """(p_SB, R_SB) of a frame B that is fixed to the tray at (p_EB, R_EB)."""
        p, rotation = self.tray_pose(q)
        return p + rotation @ p_EB, rotation @ R_EB

    def link_pose(self, q: Array, link: str) -> tuple[Array, Array]:
        """(p_SL, R_SL) of a link of the URDF, by name."""
        pin.framesForwardKinematics(self.pin_model, self.data, q)
        placement = self.data.oMf[self.pin_model.getFrameId(link, pin.FrameType.BODY)]
        return placement.translation.copy(), placement.rotation.copy()

    def body_jacobian(self, q: Array) -> Array:
        """J_e (6, n): from dq to the twist of E in E; the manipulator body Jacobian of eq (21)."""
        return pin.computeFrameJacobian(self.pin_model, self.data, q, self.tray_id, pin.LOCAL)

    def drift(self, q: Array, dq: Array) -> Array:
        """dJ_e/dt dq (6,): rate of E's body twist when ddq = 0."""
        return self.twist_and_drift(q, dq)[1]

    def twist_and_drift(self, q: Array, dq: Array) -> tuple[Array, Array]:
        """J_e dq (6,), E's body twist, and dJ_e/dt dq (6,), its rate when ddq = 0."""
        model, data, tray = self.pin_model, self.data, self.tray_id
        pin.forwardKinematics(model, data, q, dq, np.zeros(self.n))
        velocity = pin.getFrameVelocity(model, data, tray, pin.LOCAL)
        return velocity.vector, pin.getFrameAcceleration(model, data, tray, pin.LOCAL).vector

    def mass_matrix(self, q: Array) -> Array:
        """M_r (n, n) of eq (20), kg m^2."""
        pin.crba(self.pin_model, self.data, q)
        upper = np.triu(self.data.M)
        return upper + np.triu(upper, 1).T

    def gravity(self, q: Array) -> Array:
        """N_r (n,) of eq (20), N m."""
        return pin.computeGeneralizedGravity(self.pin_model, self.data, q).copy()

    def bias(self, q: Array, dq: Array) -> Array:
        """C_r dq + N_r (n,)."""
        return pin.nonLinearEffects(self.pin_model, self.data, q, dq).copy()

    def inverse_dynamics(self, q: Array, dq: Array, ddq: Array) -> Array:
        """M_r ddq + C_r dq + N_r (n,), N m: torque of arm and tray without load."""
        return pin.rnea(self.pin_model, self.data, q, dq, ddq).copy()


def tray_to_object(p_EB: Array, R_EB: Array) -> Array:
    """Adjoint Ad (6, 6) from twists of E, in E, to twists of B, in B, for B fixed to the tray."""
    return adjoint(*invert(p_EB, R_EB))


def load_arm(arm: Arm, tray: Tray) -> ArmModel:
    """The arm of a scenario with its tray. `arm.model` is a name of `KNOWN_ARMS` or a URDF or MJCF file, which needs
    `arm.flange`, the link that carries the tray.

    Raises ScenarioError (unknown arm, unreadable URDF, no such flange), MissingDependencyError.
    """
    known = KNOWN_ARMS.get(arm.model)
    path = robot_file(known) if known else _urdf_file(arm.model)
    flange = arm.flange or (known.flange if known else None)
    if flange is None:
        raise ScenarioError(f"arm.flange is missing; with the URDF {path} it must name the link that carries the tray.")
    chain = read_chain(path, flange, _folders(arm.package_dirs))
    if arm.base is not None:
        chain = on_base(chain, arm.base, path)
    model = _build(chain.urdf, path)
    massless = {j: link for j, link in moved_links(model).items() if not model.inertias[j].mass > 0}
    for j in massless:
        model.inertias[j] = pin.Inertia.Zero()
    weightless = tuple(massless.values())
    _move_base(model, np.array(arm.base_position), arm.R_base)
    p_FE, R_FE = np.array(tray.p_FE), tray.R_FE
    com_E = np.array([0.0, 0.0, -0.5 * tray.thickness])
    tray_id = _attach_tray(model, flange, tray, pin.SE3(R_FE, p_FE), com_E)
    names = tuple(model.names)[1:]
    name = Path(arm.model).stem
    driving = 0 if arm.base is None else len(JOINTS)
    given: list[tuple[str, Mapping[str, Any]]] = [("the URDF", _urdf_limits(model))]
    by_position = _velocity_by_position(model, chain.by_position)
    if known and arm.flange in (None, known.flange):
        given.append((f"the maker of the {arm.model}", _padded(known.limits, before=driving)))
        by_position = known.velocity_by_position.after(driving) if known.velocity_by_position else by_position
    if arm.joint_limits is not None:
        given.append((Path(arm.joint_limits).name, read_joint_limits(Path(arm.joint_limits), names, chain.all_joints)))
    given.append(("arm.limits", _padded(_stated(arm.limits, "arm.limits", name, model.nv - driving), before=driving)))
    if arm.base is not None:
        ends = dict(zip(("q_min", "q_max"), np.array([arm.base.x, arm.base.y, arm.base.yaw]).T, strict=True))
        stated = ends | _stated(arm.base.limits, "arm.base.limits", "arm.base", driving)
        given.append(("arm.base", _padded(stated, after=model.nv - driving)))
    if weightless:
        given.append(("", dict.fromkeys(("torque", "torque_rate"), np.full(model.nv, np.inf))))
    limits, sources = joint_limits(model.nv, given)
    limits = replace(limits, velocity_by_position=by_position)
    own_limits = joint_limits(model.nv, [one for one in given if one[0].startswith(OWN) or not one[0]])[0]
    for joint, low, high in zip(names, limits.q_min, limits.q_max, strict=True):
        if low >= high:
            raise ScenarioError(
                f"The joint {joint} of {path} goes from {low:g} to {high:g}; its lower limit must be below its upper "
                "one (a URDF that leaves them out means 0)."
            )
    return ArmModel(
        name=name,
        pin_model=model,
        data=model.createData(),
        flange=flange,
        tray_id=tray_id,
        joint_names=names,
        link_names=chain.links,
        limits=limits,
        planning_limits=limits.scaled(arm.limit_shares),
        own_limits=own_limits,
        rated=known.payload if known else None,
        limit_sources=sources,
        linear=tuple("JointModelP" in joint.shortname() for joint in list(model.joints)[1:]),
        urdf=chain.urdf,
        urdf_path=path,
        collisions=arm.collisions,
        disabled_pairs=frozenset() if arm.srdf is None else read_disabled_pairs(Path(arm.srdf), chain.all_links),
        weightless=weightless,
        base_position=np.array(arm.base_position),
        R_base=arm.R_base,
        base=arm.base,
        p_FE=p_FE,
        R_FE=R_FE,
        tray_com_E=com_E,
        tray_size=tray.outer,
    )


def with_load(arm: ArmModel, bodies: Sequence[Body]) -> ArmModel:
    """The arm with bodies fixed to its tray: its dynamics while nothing slides."""
    model = arm.pin_model.copy()
    frame = model.frames[arm.tray_id]
    for body in bodies:
        inertia = pin.Inertia(body.inertial.mass, body.inertial.com_B, body.inertial.inertia_com)
        model.appendBodyToJoint(frame.parentJoint, inertia, frame.placement * pin.SE3(body.R_EB, body.p_EB))
    return replace(arm, pin_model=model, data=model.createData())


def with_stand_ins(arm: ArmModel) -> ArmModel:
    """The arm with `STAND_IN` in place of each moving link without mass, as the physics engine moves it."""
    if not arm.weightless:
        return arm
    model = arm.pin_model.copy()
    for joint, link in moved_links(model).items():
        if link in arm.weightless:
            model.appendBodyToJoint(joint, STAND_IN, pin.SE3.Identity())
    return replace(arm, pin_model=model, data=model.createData())


def moved_links(model: Any) -> dict[int, str]:
    """The link that each joint of Pinocchio's model of a URDF moves, by the joint's number."""
    links = [frame for frame in model.frames if frame.type == pin.FrameType.BODY and frame.parentJoint > 0]
    return dict(sorted({frame.parentJoint: frame.name for frame in reversed(links)}.items()))


def _urdf_file(name: str) -> Path:
    path = Path(name)
    if path.suffix not in (*SUFFIXES, ".xacro"):
        raise ScenarioError(
            f'arm.model = "{name}" is not known; known are {", ".join(sorted(KNOWN_ARMS))}, or give a file, .urdf or '
            ".xml (MJCF)."
        )
    if not path.is_file():
        raise ScenarioError(f'arm.model = "{name}": there is no such file; give an existing URDF or MJCF.')
    return path.resolve()


def _folders(package_dirs: Sequence[str]) -> list[Path]:
    for k, folder in enumerate(package_dirs):
        if not Path(folder).is_dir():
            raise ScenarioError(
                f'arm.package_dirs[{k}] = "{folder}": there is no such folder; give folders that hold the packages '
                "whose meshes the URDF names."
            )
    return [Path(folder).resolve() for folder in package_dirs]


def _build(text: str, path: Path) -> Any:
    try:
        model = pin.buildModelFromXML(ElementTree.tostring(without_shapes(text), encoding="unicode"))
    except (ValueError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else "not a valid URDF"
        raise ScenarioError(f"The URDF {path} cannot be used ({reason}); it must describe one tree of links.") from None
    if model.nv == 0 or model.nq != model.nv:
        raise ScenarioError(
            f"The URDF {path} has {model.nv} degrees of freedom between root and flange and {model.nq} coordinates; "
            "an arm has at least one joint, all of them revolute or prismatic."
        )
    for name, inertia in zip(list(model.names)[1:], list(model.inertias)[1:], strict=True):
        if not (inertia.mass >= 0 and np.isfinite(inertia.toDynamicParameters()).all()):
            raise ScenarioError(
                f"The URDF {path} has an impossible mass or inertia (what the joint {name} moves weighs "
                f"{inertia.mass:g} kg); masses are at least 0, and all numbers finite."
            )
        gyration = np.sqrt(np.abs(np.linalg.eigvalsh(inertia.inertia)).max() / inertia.mass) if inertia.mass > 0 else 0
        if gyration > LARGEST_LINK:
            raise ScenarioError(
                f"The URDF {path} gives what the joint {name} moves, {inertia.mass:g} kg, the inertia of a mass "
                f"{gyration:.3g} m from its centre; at most {LARGEST_LINK:g} m are accepted, and inertias are in "
                "kg m^2 (1000 kg mm^2 are 0.001)."
            )
    model.gravity.linear = GRAVITY_S.copy()
    return model


def _move_base(model: Any, position: Array, rotation: Array) -> None:
    """Put the URDF's root at a pose of the world."""
    base = pin.SE3(rotation, position)
    for i in range(1, model.njoints):
        if model.parents[i] == 0:
            model.jointPlacements[i] = base * model.jointPlacements[i]
    for frame in list(model.frames)[1:]:
        if frame.parentJoint == 0:
            frame.placement = base * frame.placement


def _attach_tray(model: Any, flange: str, tray: Tray, pose_FE: Any, com_E: Array) -> int:
    """Add the tray's inertia, its centre of mass in the middle of the plate, and the frame E."""
    frame_id = model.getFrameId(flange, pin.FrameType.BODY)
    frame = model.frames[frame_id]
    placement = frame.placement * pose_FE
    model.appendBodyToJoint(frame.parentJoint, pin.Inertia(tray.mass, com_E, np.diag(tray.inertia)), placement)
    return int(model.addFrame(pin.Frame(TRAY_FRAME, frame.parentJoint, frame_id, placement, pin.FrameType.OP_FRAME)))


def _urdf_limits(model: Any) -> dict[str, Array]:
    """Limits of a URDF; a velocity or torque of zero counts as not given."""
    return {
        "q_min": model.lowerPositionLimit.copy(),
        "q_max": model.upperPositionLimit.copy(),
        "velocity": np.where(model.velocityLimit > 0, model.velocityLimit, np.nan),
        "torque": np.where(model.effortLimit > 0, model.effortLimit, np.nan),
    }


def _velocity_by_position(model: Any, given: Mapping[str, tuple[float, float]]) -> VelocityByPosition | None:
    """Velocity limits that depend on position, of a URDF whose joints have them (`Chain.by_position`)."""
    if not given:
        return None
    names = list(model.names)[1:]
    has = np.array([name in given for name in names])
    offset, deceleration = np.array([given.get(name, (1.0, 1.0)) for name in names]).T
    away = np.where(has, 0.0, 1e6)  # rad or m: of a joint without, the ends are where it never is
    lower, upper = model.lowerPositionLimit - away, model.upperPositionLimit + away
    return VelocityByPosition(lower, upper, 2 * deceleration, offset)


def _stated(limits: ArmLimits, key: str, name: str, n: int) -> dict[str, Array]:
    """The limits of n joints that a table of the scenario states, in which one number applies to all of them."""
    found = {}
    for kind, value in limits.model_dump(exclude_none=True).items():
        values = np.atleast_1d(np.array(value, dtype=float))
        if len(values) not in (1, n) or (isinstance(value, list) and len(values) != n):
            raise ScenarioError(
                f"{key}.{kind} has {len(values)} values; {name} has {n} joints: give one for each, or one number."
            )
        found[kind] = np.broadcast_to(values, n)
    return found


def _padded(limits: Mapping[str, Any], before: int = 0, after: int = 0) -> dict[str, Array]:
    """Limits that say nothing about so many joints before and after those that they are of."""
    return {key: np.pad(values, (before, after), constant_values=np.nan) for key, values in limits.items()}
