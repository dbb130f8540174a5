"""Arms that are unlike most: three slides that carry a wrist, of which tests make whatever else they need."""

from __future__ import annotations

from pathlib import Path

from salver import scenario
from salver.models.arm.arm import ArmModel, load_arm

LINK = """<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{com}"/>
  <inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="{com}"/><geometry><box size="{size}"/></geometry></collision></link>"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{at}"/>
  <axis xyz="{axis}"/><limit lower="{low}" upper="{high}" effort="{effort}" velocity="{speed}"/>{more}</joint>"""


def joint(name: str, kind: str, parent: str, child: str, at: str, axis: str, **more: object) -> str:
    values = {"low": -2.0, "high": 2.0, "effort": 200.0, "speed": 2.0, "more": "", **more}
    return JOINT.format(name=name, kind=kind, parent=parent, child=child, at=at, axis=axis, **values)


def gantry(*, turn: str = "continuous", more: str = "") -> str:
    """Three slides along x, y, z that carry a wrist of three joints that turn about z, y, x."""
    links = [
        LINK.format(name="rail", mass=5, com="0 0 0", size="2 0.05 0.05"),
        LINK.format(name="beam", mass=4, com="0 0 0.2", size="0.05 2 0.05"),
        LINK.format(name="post", mass=3, com="0 0 0.4", size="0.05 0.05 0.05"),
        LINK.format(name="head", mass=1, com="0 0 0.5", size="0.05 0.05 0.05"),
        LINK.format(name="yaw", mass=0.5, com="0 0 0.02", size="0.04 0.04 0.04"),
        LINK.format(name="pitch", mass=0.5, com="0 0 0.02", size="0.04 0.04 0.02"),
        LINK.format(name="roll", mass=0.5, com="0 0 0.02", size="0.04 0.04 0.02"),
    ]
    joints = [
        joint("x", "prismatic", "rail", "beam", "0 0 0", "1 0 0", low=-0.8, high=0.8),
        joint("y", "prismatic", "beam", "post", "0 0 0", "0 1 0", low=-0.8, high=0.8),
        joint("z", "prismatic", "post", "head", "0 0 0", "0 0 1", low=-0.3, high=0.5),
        joint("turn", turn, "head", "yaw", "0 0 0.55", "0 0 1", more=more),
        joint("lean", "revolute", "yaw", "pitch", "0 0 0.06", "0 1 0"),
        joint("tip", "revolute", "pitch", "roll", "0 0 0.05", "1 0 0"),
    ]
    return f'<robot name="gantry">{"".join(links)}{"".join(joints)}</robot>'


CELL = {
    "name": "gantry",
    "motion": {"duration": 1.2, "start": {"position": [-0.2, -0.1, 0.9]}, "goal": {"position": [0.2, 0.2, 0.95]}},
    "objects": [
        {
            "name": "box",
            "shape": {"type": "box", "size": [0.06, 0.06, 0.08]},
            "mass": 0.3,
            "friction": 0.4,
            "uncertainty": {},
        }
    ],
    "contact": {"condition": "exact"},
    "tray": {"height": 0.08},
}


def cell(tmp_path: Path, text: str, **arm: object) -> scenario.Scenario:
    path = tmp_path / "gantry.urdf"
    path.write_text(text)
    return scenario.parse({**CELL, "arm": {"model": str(path), "flange": "roll", **arm}}, "the test")


def loaded(tmp_path: Path, text: str, **arm: object) -> ArmModel:
    case = cell(tmp_path, text, **arm)
    assert case.arm is not None
    return load_arm(case.arm, case.tray)
