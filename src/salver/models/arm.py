"""The arm: kinematics, dynamics and limits, from a URDF, by Pinocchio (paper, eqs 20 and 21).

The tray is bolted to the flange: its inertia is part of the last link, so that only what lies loose on it is
uncertain (paper, section V). Two frames matter: F, the flange, and E, the centre of the tray's top surface,
`tray.height` out along F's z and parallel to F. Every Jacobian here is a *body* Jacobian: it gives the twist
(v, omega) of a frame in that frame, linear part first; its rate is the plain time derivative of its entries.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from salver.errors import MissingDependencyError, ScenarioError
from salver.geometry import GRAVITY_S, Array, adjoint, invert
from salver.models.arm_limits import KNOWN_ARMS, JointLimits
from salver.models.contact import ContactSet

if TYPE_CHECKING:
    from salver import scenario
    from salver.models.bodies import Body

TRAY_FRAME = "salver_tray"


@dataclass(frozen=True, eq=False)
class ArmModel:
    """An arm with a tray on its flange. Not for use by several threads at once: they would share `data`.

    name: as in the scenario. pin_model, data: Pinocchio's model (tray included) and work space.
    flange, tray_id: name of the frame F; index of the frame E in `pin_model.frames`.
    joint_names: n names from the base outwards. link_names: links from the root to F, root first.
    limits: what the maker publishes. planning_limits: the share of it that the scenario lets a plan use.
    urdf: the URDF that was loaded, as text: everything beyond the flange left off, joints beside the chain
    fixed, `package://` replaced by absolute paths. urdf_path: the file it came from.
    base_position, base_yaw: pose of the URDF's root in S, m and rad.
    p_FE: (3,) centre of the tray's top surface in F, m. tray_com_F: (3,) the tray's centre of mass in F.
    tray_size: its edges along x and y of E, m.
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
    urdf: str
    urdf_path: Path
    base_position: Array
    base_yaw: float
    p_FE: Array
    tray_com_F: Array
    tray_size: tuple[float, float]

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.pin_model.nv)

    def tray_pose(self, q: Array) -> tuple[Array, Array]:
        """(p_SE, R_SE) at joint positions q (n,)."""
        pin.framesForwardKinematics(self.pin_model, self.data, q)
        placement = self.data.oMf[self.tray_id]
        return placement.translation.copy(), placement.rotation.copy()

    def object_pose(self, q: Array, p_EB: Array, R_EB: Array) -> tuple[Array, Array]:
        """(p_SB, R_SB) of a frame B that is fixed to the tray at (p_EB, R_EB)."""
        p, rotation = self.tray_pose(q)
        return p + rotation @ p_EB, rotation @ R_EB

    def link_pose(self, q: Array, link: str) -> tuple[Array, Array]:
        """(p_SL, R_SL) of a link of the URDF, by name."""
        pin.framesForwardKinematics(self.pin_model, self.data, q)
        placement = self.data.oMf[self.pin_model.getFrameId(link)]
        return placement.translation.copy(), placement.rotation.copy()

    def body_jacobian(self, q: Array) -> Array:
        """J_e (6, n): dq to the twist of E in E; the manipulator body Jacobian of eq (21)."""
        return pin.computeFrameJacobian(self.pin_model, self.data, q, self.tray_id, pin.LOCAL)

    def body_jacobian_rate(self, q: Array, dq: Array) -> Array:
        """dJ_e/dt (6, n) when the joints move at dq."""
        pin.computeJointJacobiansTimeVariation(self.pin_model, self.data, q, dq)
        pin.updateFramePlacement(self.pin_model, self.data, self.tray_id)
        return pin.getFrameJacobianTimeVariation(self.pin_model, self.data, self.tray_id, pin.LOCAL)

    def drift(self, q: Array, dq: Array) -> Array:
        """dJ_e/dt dq (6,): rate of E's body twist when ddq = 0."""
        pin.forwardKinematics(self.pin_model, self.data, q, dq, np.zeros(self.n))
        return pin.getFrameAcceleration(self.pin_model, self.data, self.tray_id, pin.LOCAL).vector.copy()

    def object_jacobian(self, q: Array, p_EB: Array, R_EB: Array) -> Array:
        """J_b (6, n): dq to the twist of B in B, for B fixed to the tray at (p_EB, R_EB)."""
        return tray_to_object(p_EB, R_EB) @ self.body_jacobian(q)

    def contact_jacobian(self, q: Array, contacts: ContactSet, p_EB: Array, R_EB: Array) -> Array:
        """J_c (3 n_c, n) of eq (21), with the selection B_c^T that it needs: velocities of the tray's material
        points at the contacts, in the contact frames. While the object sticks, J_c dq = G^T V_b (eq 24).
        """
        p_EC = p_EB + contacts.p_BC @ R_EB.T
        p_CE, R_CE = invert(p_EC, R_EB @ contacts.R_BC)
        rows = adjoint(p_CE, R_CE)[:, :3, :] @ self.body_jacobian(q)
        return rows.reshape(3 * contacts.count, self.n)

    def mass_matrix(self, q: Array) -> Array:
        """M_r (n, n) of eq (20), kg m^2."""
        pin.crba(self.pin_model, self.data, q)
        upper = np.triu(self.data.M)
        return upper + np.triu(upper, 1).T

    def coriolis(self, q: Array, dq: Array) -> Array:
        """C_r (n, n) of eq (20), by Christoffel symbols, so that dM/dt - 2 C is skew."""
        return pin.computeCoriolisMatrix(self.pin_model, self.data, q, dq).copy()

    def gravity(self, q: Array) -> Array:
        """N_r (n,) of eq (20), N m."""
        return pin.computeGeneralizedGravity(self.pin_model, self.data, q).copy()

    def bias(self, q: Array, dq: Array) -> Array:
        """C_r dq + N_r (n,)."""
        return pin.nonLinearEffects(self.pin_model, self.data, q, dq).copy()

    def inverse_dynamics(self, q: Array, dq: Array, ddq: Array) -> Array:
        """M_r ddq + C_r dq + N_r (n,): torque of arm and tray, nothing on it."""
        return pin.rnea(self.pin_model, self.data, q, dq, ddq).copy()


def tray_to_object(p_EB: Array, R_EB: Array) -> Array:
    """Ad (6, 6) that takes twists of E, in E, to twists of B, in B, for B fixed to the tray."""
    return adjoint(*invert(p_EB, R_EB))


def load_arm(arm: scenario.Arm, tray: scenario.Tray) -> ArmModel:
    """The arm of a scenario with its tray. `arm.model` is a name of `KNOWN_ARMS` or a URDF file, which needs
    `arm.flange`, the link that carries the tray.

    Raises ScenarioError (unknown arm, unreadable URDF, no such flange), MissingDependencyError.
    """
    known = KNOWN_ARMS.get(arm.model)
    path = _robots_folder() / known.urdf if known else _urdf_file(arm.model)
    flange = arm.flange or (known.flange if known else None)
    if flange is None:
        raise ScenarioError(f"arm.flange is missing; with the URDF {path} it must name the link that carries the tray.")
    text, links = _chain(path, flange)
    model = _build(text, path)
    yaw = float(np.deg2rad(arm.base_yaw_deg))
    _move_base(model, np.array(arm.base_position), yaw)
    p_FE = np.array([0.0, 0.0, tray.height])
    com_F = np.array([0.0, 0.0, tray.height - 0.5 * tray.thickness])
    tray_id = _attach_tray(model, flange, tray, p_FE, com_F)
    limits = _limits(model, known.limits if known and arm.flange in (None, known.flange) else {})
    return ArmModel(
        name=Path(arm.model).stem,
        pin_model=model,
        data=model.createData(),
        flange=flange,
        tray_id=tray_id,
        joint_names=tuple(model.names)[1:],
        link_names=links,
        limits=limits,
        planning_limits=limits.scaled(arm.limit_shares),
        urdf=text,
        urdf_path=path,
        base_position=np.array(arm.base_position),
        base_yaw=yaw,
        p_FE=p_FE,
        tray_com_F=com_F,
        tray_size=tray.size,
    )


def with_load(arm: ArmModel, bodies: Sequence[Body]) -> ArmModel:
    """The arm with bodies stuck to its tray: what its motors feel while nothing moves on the tray."""
    model = arm.pin_model.copy()
    frame = model.frames[arm.tray_id]
    for body in bodies:
        inertia = pin.Inertia(body.inertial.mass, body.inertial.com_B, body.inertial.inertia_com)
        model.appendBodyToJoint(frame.parentJoint, inertia, frame.placement * pin.SE3(body.R_EB, body.p_EB))
    return replace(arm, pin_model=model, data=model.createData())


def _robots_folder() -> Path:
    try:
        package = metadata.distribution("example-robot-data")
    except metadata.PackageNotFoundError:
        raise MissingDependencyError(
            "The arm models are not installed; install the package example-robot-data, or give a .urdf file."
        ) from None
    return Path(str(package.locate_file("cmeel.prefix/share/example-robot-data/robots"))).resolve()


def _urdf_file(name: str) -> Path:
    path = Path(name)
    if path.suffix not in (".urdf", ".xml"):
        raise ScenarioError(
            f'arm.model = "{name}" is not known; known are {", ".join(sorted(KNOWN_ARMS))}, or give a .urdf file.'
        )
    if not path.is_file():
        raise ScenarioError(f'arm.model = "{name}": there is no such file; give an existing .urdf file.')
    return path.resolve()


def _chain(path: Path, flange: str) -> tuple[str, tuple[str, ...]]:
    """The URDF as text, cut to the chain from its root to the flange, and the names of the chain's links.

    What hangs beyond the flange (a gripper) is left off; joints beside the chain are fixed at zero. A
    continuous joint becomes a revolute one of two turns: the rest of salver counts joint angles as numbers.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise ScenarioError(f"The URDF {path} cannot be read ({error}); it must be an XML file of a robot.") from None
    names = {link.get("name") for link in root.iter("link")}
    if root.tag != "robot" or not names:
        raise ScenarioError(
            f"The URDF {path} describes no robot: its root is <{root.tag}>; it must be <robot> with links."
        )
    if flange not in names:
        shown = ", ".join(sorted(str(name) for name in names))
        raise ScenarioError(f'arm.flange = "{flange}" is no link of {path}; its links are {shown}.')

    joints = root.findall("joint")
    to_child = {_end(joint, "child"): joint for joint in joints}
    links = [flange]
    while links[0] in to_child:
        links.insert(0, _end(to_child[links[0]], "parent"))
    beyond = {flange}
    while grown := {_end(j, "child") for j in joints if _end(j, "parent") in beyond} - beyond:
        beyond |= grown
    beyond.discard(flange)

    for element in list(root):
        if element.tag == "link" and element.get("name") in beyond:
            root.remove(element)
        elif element.tag == "joint":
            if _end(element, "child") in beyond:
                root.remove(element)
            elif _end(element, "child") not in links:
                element.set("type", "fixed")
            elif element.get("type") == "continuous":
                element.set("type", "revolute")
                limit = element.find("limit")
                limit = ElementTree.SubElement(element, "limit", effort="0", velocity="0") if limit is None else limit
                limit.set("lower", str(-2 * np.pi))
                limit.set("upper", str(2 * np.pi))
        elif element.tag in ("gazebo", "transmission"):
            root.remove(element)
    for mesh in root.iter("mesh"):
        mesh.set("filename", _mesh_path(mesh.get("filename", ""), path))
    return ElementTree.tostring(root, encoding="unicode"), tuple(links)


def _end(joint: ElementTree.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else element.get("link", "")


def _mesh_path(name: str, urdf: Path) -> str:
    """Absolute path of a mesh: the part after `package://` is looked for in every folder above the URDF."""
    relative = name.removeprefix("file://").removeprefix("package://")
    for folder in urdf.parents:
        if (folder / relative).is_file():
            return str(folder / relative)
    return name


def _build(text: str, path: Path) -> Any:
    try:
        model = pin.buildModelFromXML(text)
    except (ValueError, RuntimeError) as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else "not a valid URDF"
        raise ScenarioError(f"The URDF {path} cannot be used ({reason}); it must describe one tree of links.") from None
    if model.nv == 0 or model.nq != model.nv:
        raise ScenarioError(
            f"The URDF {path} has {model.nv} degrees of freedom between root and flange and {model.nq} coordinates; "
            "an arm has at least one joint, all of them revolute or prismatic."
        )
    model.gravity.linear = GRAVITY_S.copy()
    return model


def _move_base(model: Any, position: Array, yaw: float) -> None:
    """Put the URDF's root at a pose of the world."""
    base = pin.SE3(pin.utils.rotate("z", yaw), position)
    for i in range(1, model.njoints):
        if model.parents[i] == 0:
            model.jointPlacements[i] = base * model.jointPlacements[i]
    for frame in list(model.frames)[1:]:
        if frame.parentJoint == 0:
            frame.placement = base * frame.placement


def _attach_tray(model: Any, flange: str, tray: scenario.Tray, p_FE: Array, com_F: Array) -> int:
    """Add the tray's inertia, its centre of mass in the middle of the plate, and the frame E."""
    frame_id = model.getFrameId(flange)
    frame = model.frames[frame_id]
    inertia = pin.Inertia(tray.mass, com_F, np.diag(tray.inertia))
    model.appendBodyToJoint(frame.parentJoint, inertia, frame.placement)
    placement = frame.placement * pin.SE3(np.eye(3), p_FE)
    return int(model.addFrame(pin.Frame(TRAY_FRAME, frame.parentJoint, frame_id, placement, pin.FrameType.OP_FRAME)))


def _limits(model: Any, published: dict[str, list[float]]) -> JointLimits:
    """Published limits; for what is not published, the URDF's; infinite where that says nothing (or zero)."""
    unknown = np.full(model.nv, np.inf)
    values: dict[str, Array] = {
        "q_min": model.lowerPositionLimit.copy(),
        "q_max": model.upperPositionLimit.copy(),
        "velocity": np.where(model.velocityLimit > 0, model.velocityLimit, np.inf),
        "acceleration": unknown,
        "jerk": unknown,
        "torque": np.where(model.effortLimit > 0, model.effortLimit, np.inf),
        "torque_rate": unknown,
    }
    values.update({key: np.array(value) for key, value in published.items()})
    return JointLimits(**values)
