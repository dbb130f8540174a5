"""A base that drives: three joints and a body in front of the arm's own chain. All else works on joints, as before.

The base's frame is on the floor under the middle of its body, x forwards. From the pose that `arm.base_position` and
`arm.base_rpy_deg` give, `base_x` and `base_y` (m) move it along the fixed axes of that pose, and `base_yaw` (rad) turns
it. Wheels, their slip and their odometry are not modelled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

from salver.errors import ScenarioError
from salver.models.arm.tables import MobileBase
from salver.models.arm.urdf import Chain

JOINTS = ("base_x", "base_y", "base_yaw")
LINKS = ("mobile_base_origin", "mobile_base_x", "mobile_base_y", "mobile_base")  # the last is the body
TOP = "mobile_base_top"
_LINK = """<link name="{name}"><inertial><origin xyz="0 0 {middle}"/><mass value="{mass}"/>
  <inertia ixx="{x}" iyy="{y}" izz="{z}" ixy="0" ixz="0" iyz="0"/></inertial>{shape}</link>"""
_SHAPE = '<collision><origin xyz="0 0 {middle}"/><geometry><{kind}/></geometry></collision>'
_JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
  <axis xyz="{axis}"/><limit lower="{ends[0]}" upper="{ends[1]}" effort="0" velocity="0"/></joint>"""
_MOUNT = """<joint name="mobile_base_mount" type="fixed"><parent link="{parent}"/><child link="{child}"/>
  <origin xyz="{xyz}" rpy="{rpy}"/></joint>"""


def on_base(chain: Chain, base: MobileBase, path: Path, carriage: float = 1e-6) -> Chain:
    """The chain of a robot, from the file `path`, on a base that drives.

    carriage: mass of each of the two links between the joints, as a share of the base's, since the physics engine moves
    no link without mass. Raises ScenarioError when a link or joint of the file has one of the names of the base's.
    """
    taken = sorted((chain.all_links & {*LINKS, TOP}) | (chain.all_joints & {*JOINTS}))
    if taken:
        raise ScenarioError(f"The URDF {path} has the name {taken[0]}, which arm.base needs itself; rename it there.")
    if base.size is not None:
        solid, kind = pin.Inertia.FromBox(base.mass, *base.size), f'box size="{_numbers(base.size)}"'
    else:
        solid = pin.Inertia.FromCylinder(base.mass, base.radius, base.height)
        kind = f'cylinder radius="{base.radius}" length="{base.height}"'
    middle, parts = 0.5 * base.top, []
    for name, share in zip(LINKS, (0.0, carriage, carriage, 1.0), strict=True):
        x, y, z = (share * np.diag(solid.inertia)).tolist()
        shape = _SHAPE.format(middle=middle, kind=kind) if name == LINKS[-1] else ""
        parts.append(_LINK.format(name=name, mass=share * base.mass, middle=middle, x=x, y=y, z=z, shape=shape))
    moved = (("prismatic", "1 0 0", base.x), ("prismatic", "0 1 0", base.y), ("revolute", "0 0 1", base.yaw))
    for name, (parent, child), (kind, axis, ends) in zip(JOINTS, pairwise(LINKS), moved, strict=True):
        parts.append(_JOINT.format(name=name, kind=kind, parent=parent, child=child, axis=axis, ends=ends))
    robot, root = ElementTree.fromstring(chain.urdf), chain.links[0]
    if root == "world":  # the physics engine takes a link of this name for the world itself
        root = TOP
        for key, place in (("name", "link"), ("link", "joint/parent")):
            for element in robot.iterfind(f"{place}[@{key}='world']"):
                element.set(key, root)
    xyz, rpy = _numbers(base.mount or (0.0, 0.0, base.top)), _numbers(np.deg2rad(base.mount_rpy_deg).tolist())
    parts.append(_MOUNT.format(parent=LINKS[-1], child=root, xyz=xyz, rpy=rpy))
    robot.extend(ElementTree.fromstring(part) for part in parts)
    return replace(chain, urdf=ElementTree.tostring(robot, encoding="unicode"), links=(*LINKS, root, *chain.links[1:]))


def _numbers(values: Sequence[float]) -> str:
    return " ".join(map(repr, values))
