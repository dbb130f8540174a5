"""An arm from MuJoCo's own format, MJCF, as a URDF: MuJoCo compiles the file, so that defaults, includes, angles in
degrees and inertias that follow from geoms are what they are there.

Source: MuJoCo documentation, "XML reference" and "mjModel" (fields of the compiled model).
"""

from __future__ import annotations

from functools import lru_cache
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from salver.errors import ScenarioError, needs, reason

if TYPE_CHECKING:
    from collections.abc import Iterable


def read_mjcf(path: Path, flange: str) -> ElementTree.Element:
    """The robot of an MJCF file as the element `<robot>` of a URDF.

    Bodies become links, sites links without mass. A joint whose anchor is not its body's origin, or of several on one
    body, gets a link of its own. Torque limits are those of the joints and of their actuators. Bodies that hang on a
    free or ball joint (objects of a scene), mocap bodies and planes are left out; height fields and signed-distance
    geoms are geometry of unknown shape. Armature, damping and friction of joints have no place in a URDF.

    Raises ScenarioError: a file that MuJoCo does not read, a floating flange, a joint whose zero is not its initial
    position or whose torque is limited to one sign, a chain that is closed, a mesh that is sheared.
    MissingDependencyError without MuJoCo.
    """
    parts = _Parts(path)
    model = parts.model
    chain = parts.chain(flange)
    loose = parts.loose()
    if held := [body for body in chain if body in loose]:
        raise ScenarioError(
            f"The MJCF {path}: {flange} hangs on a free or ball joint of {parts.name(held[0])}, or that is a mocap "
            "body; an arm has hinges and slides only, and its first body stands in the world."
        )
    parts.demand_usable(chain)
    robot = ElementTree.Element("robot", name=path.stem)
    for body in range(model.nbody):
        if body not in loose:
            robot.extend(parts.of_body(body))
    taken = {element.get("name") for element in robot.iter("link")}
    for site in range(model.nsite):
        name, body = model.site(site).name, int(model.site_bodyid[site])
        if name and name not in taken and body not in loose:
            place = _place(model.site_pos[site], model.site_quat[site])
            robot.extend([ElementTree.Element("link", name=name), _joint(name, parts.name(body), name, place)])
    return robot


def _compiled(path: Path) -> tuple[Any, Any]:
    """MuJoCo's specification of a file, and its model."""
    with needs("engine", "An arm from an MJCF"):
        import mujoco
    try:
        files = [path.parent / file for file in mujoco.mju_getXMLDependencies(str(path))]
        return _compiled_once(path, tuple(file.stat().st_mtime_ns for file in files if file.is_file()))
    except (ValueError, RuntimeError, OSError, mujoco.FatalError) as error:
        said = " ".join(reason(error).split())
        raise ScenarioError(
            f"The MJCF {path} cannot be read ({said}); MuJoCo must be able to load the file, with its meshes beside it."
        ) from None


@lru_cache(maxsize=4)
def _compiled_once(path: Path, changed: tuple[int, ...]) -> tuple[Any, Any]:
    import mujoco

    before = mujoco.get_mju_user_warning()
    # Numbers that are not finite are refused where they are used. MuJoCo would write its warning into a file.
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    finally:
        mujoco.set_mju_user_warning(before)
    # Geoms that only look are left out where no body has nothing else; their meshes are large.
    shapes = [[bool(geom.contype or geom.conaffinity) for geom in body.geoms] for body in spec.bodies]
    spec.compiler.discardvisual = all(any(shape) for shape in shapes if shape)
    return spec, spec.compile()


class _Parts:
    """Elements of the URDF of a compiled model."""

    def __init__(self, path: Path) -> None:
        self._spec, self._m = _compiled(path)
        self._path = path
        import mujoco

        self._enums, m = mujoco, self._m
        self._bodies = _names(map(m.body, range(m.nbody)), "body", [m.site(k).name for k in range(m.nsite)])
        self._joints = _names(map(m.joint, range(m.njnt)), "joint")

    @property
    def model(self) -> Any:
        return self._m

    def name(self, body: int) -> str:
        return self._bodies[body]

    def joint_name(self, joint: int) -> str:
        return self._joints[joint]

    def slides(self, joint: int) -> bool:
        return bool(self._m.jnt_type[joint] == self._enums.mjtJoint.mjJNT_SLIDE)

    def joints(self, body: int) -> Iterable[int]:
        first = int(self._m.body_jntadr[body])
        return range(first, first + int(self._m.body_jntnum[body]))

    def chain(self, flange: str) -> list[int]:
        """Bodies that carry a frame, which is a body or a site; none if there is no such frame."""
        model = self._m
        found = [body for body in range(model.nbody) if self.name(body) == flange]
        found += [int(model.site_bodyid[k]) for k in range(model.nsite) if model.site(k).name == flange]
        chain = found[:1]
        while chain and chain[-1] > 0:
            chain.append(int(model.body_parentid[chain[-1]]))
        return chain

    def loose(self) -> set[int]:
        """Mocap bodies, bodies with a free or ball joint, and what hangs on them."""
        model, kinds = self._m, self._enums.mjtJoint
        several = (kinds.mjJNT_FREE, kinds.mjJNT_BALL)
        loose: set[int] = set()
        for body in range(1, model.nbody):  # parents come before their children
            own = any(model.jnt_type[joint] == kind for joint in self.joints(body) for kind in several)
            if own or model.body_mocapid[body] >= 0 or int(model.body_parentid[body]) in loose:
                loose.add(body)
        return loose

    def demand_usable(self, chain: list[int]) -> None:
        """Raise ScenarioError for a joint of the chain that has no range, another zero or torque of one sign only, and
        when a constraint closes the chain or couples its joints."""
        model, objects = self._m, self._enums.mjtObj
        for joint in (joint for body in chain for joint in self.joints(body)):
            name, zero = self.joint_name(joint), float(model.qpos0[model.jnt_qposadr[joint]])
            if zero:
                raise ScenarioError(
                    f"The MJCF {self._path}: ref of the joint {name} is {zero:g}; it must be 0, since joint positions "
                    "are counted from where its bodies stand in the file."
                )
            if self.slides(joint) and not model.jnt_limited[joint]:
                raise ScenarioError(
                    f"The MJCF {self._path}: the joint {name} slides and has no range; give it one, in m."
                )
            if not self._torque(joint):
                raise ScenarioError(
                    f"The MJCF {self._path}: the torque of the joint {name} is limited to one sign; give a range with "
                    "0 inside."
                )
        moving = {body for body in chain if body > 0}
        on_body = {objects.mjOBJ_BODY: lambda k: k, objects.mjOBJ_SITE: lambda k: model.site_bodyid[k],
                   objects.mjOBJ_JOINT: lambda k: model.jnt_bodyid[k]}  # fmt: skip
        named = {objects.mjOBJ_BODY: model.body, objects.mjOBJ_SITE: model.site, objects.mjOBJ_JOINT: model.joint}
        coupled, tendons = self._enums.mjtEq.mjEQ_JOINT, self._enums.mjtEq.mjEQ_TENDON
        for k in np.flatnonzero(model.eq_active0):
            kind = objects.mjOBJ_JOINT if model.eq_type[k] == coupled else objects(int(model.eq_objtype[k]))
            ends = [int(x) for x in (model.eq_obj1id[k], model.eq_obj2id[k]) if x >= 0]
            if model.eq_type[k] == tendons:
                kind, ends = objects.mjOBJ_JOINT, [joint for tendon in ends for joint in self._joints_of(tendon)]
            if kind in on_body and (held := [end for end in ends if int(on_body[kind](end)) in moving]):
                name = named[kind](held[0]).name
                raise ScenarioError(
                    f"The MJCF {self._path}: a constraint of <equality> holds {name}, which lies between the world and "
                    "the flange; joints of an arm must move on their own."
                )

    def _joints_of(self, tendon: int) -> list[int]:
        """Joints that a tendon couples."""
        model, first = self._m, int(self._m.tendon_adr[tendon])
        wraps = range(first, first + int(model.tendon_num[tendon]))
        return [int(model.wrap_objid[k]) for k in wraps if model.wrap_type[k] == self._enums.mjtWrap.mjWRAP_JOINT]

    def of_body(self, body: int, carriage: float = 1e-6) -> list[ElementTree.Element]:
        """A body's link, with the joints that it hangs on and the links between those. carriage: mass of a link between
        two joints, as a share of the body's, since links that move have mass."""
        model, name = self._m, self.name(body)
        link = self._link(name, body)
        link.extend(self._shapes(body))
        if body == 0:
            return [link]
        parent, place = self.name(int(model.body_parentid[body])), _place(model.body_pos[body], model.body_quat[body])
        anchor, made = np.zeros(3), [link]
        for number, joint in enumerate(self.joints(body)):
            at = model.jnt_pos[joint].copy()
            last = number == model.body_jntnum[body] - 1 and not at.any()
            child = name if last else f"{name}:{number}"
            made.append(self._moving(joint, parent, child, place * pin.SE3(np.eye(3), at - anchor)))
            if last:
                return made
            made.append(self._link(child, body, 0.0 if number == model.body_jntnum[body] - 1 else carriage))
            parent, place, anchor = child, pin.SE3.Identity(), at
        made.append(_joint(f"{name}_fixed", parent, name, place * pin.SE3(np.eye(3), -anchor)))
        return made

    def _link(self, name: str, body: int, share: float = 1.0) -> ElementTree.Element:
        """A link with a share of a body's mass and inertia."""
        model, link = self._m, ElementTree.Element("link", name=name)
        if (mass := share * float(model.body_mass[body])) > 0:
            inertial = ElementTree.SubElement(link, "inertial")
            inertial.append(_origin(_place(model.body_ipos[body], model.body_iquat[body])))
            ElementTree.SubElement(inertial, "mass", value=repr(mass))
            x, y, z = (repr(share * float(moment)) for moment in model.body_inertia[body])
            ElementTree.SubElement(inertial, "inertia", ixx=x, iyy=y, izz=z, ixy="0", ixz="0", iyz="0")
        return link

    def _moving(self, joint: int, parent: str, child: str, place: Any) -> ElementTree.Element:
        model = self._m
        limited = bool(model.jnt_limited[joint])
        kind = "prismatic" if self.slides(joint) else "revolute" if limited else "continuous"
        made = _joint(self.joint_name(joint), parent, child, place, kind)
        ElementTree.SubElement(made, "axis", xyz=_text(model.jnt_axis[joint]))
        limit = ElementTree.SubElement(made, "limit", velocity="0")
        torque = self._torque(joint)
        limit.set("effort", repr(torque if np.isfinite(torque) else 0.0))
        if limited:
            limit.attrib.update(zip(("lower", "upper"), map(repr, model.jnt_range[joint].tolist()), strict=True))
        return made

    def _torque(self, joint: int) -> float:
        """The least limit of a joint's torque, N m or N, that the joint or its actuators have; infinite without one."""
        model, enums = self._m, self._enums
        on_joint = (enums.mjtTrn.mjTRN_JOINT, enums.mjtTrn.mjTRN_JOINTINPARENT)
        found = [model.jnt_actfrcrange[joint]] if model.jnt_actfrclimited[joint] else []
        for k in range(model.nu):
            on = any(model.actuator_trntype[k] == kind for kind in on_joint)  # an enum is no number to `in`
            if on and model.actuator_trnid[k, 0] == joint:
                gear = abs(float(model.actuator_gear[k, 0]))
                plain = model.actuator_biastype[k] == enums.mjtBias.mjBIAS_NONE
                if model.actuator_forcelimited[k]:
                    found.append(gear * model.actuator_forcerange[k])
                elif plain and model.actuator_ctrllimited[k]:  # a motor
                    found.append(gear * abs(model.actuator_gainprm[k, 0]) * model.actuator_ctrlrange[k])
        return float(min((max(min(-low, high), 0.0) for low, high in found), default=np.inf))

    def _shapes(self, body: int) -> list[ElementTree.Element]:
        """The geoms that touch something, or else those that only look."""
        model = self._m
        first = int(model.body_geomadr[body])
        geoms = range(first, first + int(model.body_geomnum[body])) if first >= 0 else range(0)
        solid = [g for g in geoms if model.geom_contype[g] or model.geom_conaffinity[g]]
        made = []
        for geom in solid or (geoms if body else ()):
            if (shape := self._shape(geom)) is not None:
                made.append(ElementTree.Element("collision" if solid else "visual"))
                made[-1].append(_origin(self._geom_place(geom)))
                ElementTree.SubElement(made[-1], "geometry").append(shape)
        return made

    def _geom_place(self, geom: int) -> Any:
        model = self._m
        place, mesh = _place(model.geom_pos[geom], model.geom_quat[geom]), int(model.geom_dataid[geom])
        if model.geom_type[geom] != self._enums.mjtGeom.mjGEOM_MESH:
            return place
        name, scale = model.mesh(mesh).name, model.mesh_scale[mesh]
        given = self._spec.mesh(name)
        if np.any(scale != scale[0]) and np.any(given.refquat[1:]):
            raise ScenarioError(
                f"The MJCF {self._path}: the mesh {name} has a refquat, and a scale that differs between axes; give it "
                "one scale, or turn its geom instead."
            )
        # MuJoCo takes the vertices scale * v relative to scale * refpos and refquat, then to their centre and axes.
        reference = _place(scale * given.refpos, given.refquat)
        return place * (reference * _place(model.mesh_pos[mesh], model.mesh_quat[mesh])).inverse()

    def _shape(self, geom: int) -> ElementTree.Element | None:
        """A geom's geometry; None for planes. An ellipsoid is the box around it. A URDF knows no height fields and
        signed distances: their shape is not known."""
        model, kinds = self._m, self._enums.mjtGeom
        (a, b, c), kind = model.geom_size[geom], kinds(int(model.geom_type[geom]))  # an enum is no number to `in`
        if kind == kinds.mjGEOM_SPHERE:
            return ElementTree.Element("sphere", radius=repr(float(a)))
        if kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
            tag = "capsule" if kind == kinds.mjGEOM_CAPSULE else "cylinder"
            return ElementTree.Element(tag, radius=repr(float(a)), length=repr(2 * float(b)))
        if kind in (kinds.mjGEOM_BOX, kinds.mjGEOM_ELLIPSOID):
            return ElementTree.Element("box", size=_text([2 * a, 2 * b, 2 * c]))
        if kind != kinds.mjGEOM_MESH:
            return (
                None if kind == kinds.mjGEOM_PLANE else ElementTree.Element(kind.name.removeprefix("mjGEOM_").lower())
            )
        mesh = int(model.geom_dataid[geom])
        at = int(model.mesh_pathadr[mesh])
        file = model.paths[at : model.paths.index(b"\0", at)].decode() if at >= 0 else model.mesh(mesh).name
        return ElementTree.Element("mesh", filename=file, scale=_text(model.mesh_scale[mesh]))


def _names(given: Iterable[Any], kind: str, others: Iterable[str] = ()) -> list[str]:
    """Names of bodies or joints: those without one get their kind and number, and underscores where that is taken."""
    names = [one.name for one in given]
    taken = {*names, *others}
    words = ((f"{kind}_{k}" + more * "_" for more in count()) for k in range(len(names)))
    return [name or next(word for word in free if word not in taken) for name, free in zip(names, words, strict=True)]


def _place(position: Any, quat_wxyz: Any) -> Any:
    w, x, y, z = (float(k) for k in quat_wxyz)
    return pin.SE3(pin.Quaternion(w, x, y, z).normalized(), np.array(position, dtype=float))


def _origin(place: Any) -> ElementTree.Element:
    return ElementTree.Element("origin", xyz=_text(place.translation), rpy=_text(pin.rpy.matrixToRpy(place.rotation)))


def _joint(name: str, parent: str, child: str, place: Any, kind: str = "fixed") -> ElementTree.Element:
    made = ElementTree.Element("joint", name=name if kind != "fixed" else f"{name}_mount", type=kind)
    made.append(_origin(place))
    for tag, link in (("parent", parent), ("child", child)):
        ElementTree.SubElement(made, tag, link=link)
    return made


def _text(numbers: Any) -> str:
    return " ".join(repr(float(x)) for x in numbers)
