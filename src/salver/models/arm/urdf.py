"""Reading a URDF: the chain from its root to the flange, and its mesh files.

xacro is a language whose files are run to give a URDF; loading a scenario runs nothing, so such a file is
refused and has to be converted first.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import metadata
from itertools import islice
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from salver.errors import ScenarioError, reason
from salver.models.arm.known_arms import OWN_FOLDER
from salver.models.arm.mjcf import read_mjcf
from salver.models.shapes.mesh_files import LARGEST

SUFFIXES = (".urdf", ".xml")
# m, of a link; of the links that one joint moves also the radius of gyration. It tells wrong units: inertias in g mm^2
# give 3e4 times the true radius, in kg mm^2 1e3 times. The largest arbitrary one seen in a URDF is 3.2 (a Robonaut's).
LARGEST_LINK = 10.0
MOST_JOINTS = 20  # that move, between root and flange
# Of a revolute joint's limit, either way: more than ten turns in rad are degrees, of which there are up to three turns;
# what is beyond stands for none (999999 of a Fetch's base).
DEGREES = 20 * np.pi, 1080.0
TURNS = 1.0  # of a continuous joint, either way: the rest of salver counts joint angles as numbers
MODELS = "example-robot-data"  # the package whose models of some arms come with salver, `salver/robots`
BY_POSITION = "position_based_velocity_limits"  # an element of a joint in franka_description, as libfranka reads it


@dataclass(frozen=True)
class Chain:
    """An arm from a URDF. urdf: text of what is left of it. links: from the root to the flange, root first.
    all_links, all_joints: names of everything that the file has.
    by_position: velocity_offset, rad/s, and deceleration_limit, rad/s^2, of joints whose velocity limit depends on
    position: those with an element `BY_POSITION` (libfranka 0.21, include/franka/joint_velocity_limits.h).
    """

    urdf: str
    links: tuple[str, ...]
    all_links: frozenset[str]
    all_joints: frozenset[str]
    by_position: Mapping[str, tuple[float, float]]


def read_chain(path: Path, flange: str, package_dirs: Sequence[Path] = (), longest: int = 200) -> Chain:
    """Read a URDF, or an MJCF (`salver.models.arm.mjcf`), and keep the chain from its root to the flange.

    What hangs beyond the flange (a gripper) is left off; joints beside the chain are fixed at zero. A continuous
    joint becomes a revolute one of `TURNS` turns either way; soft limits of a safety controller that are narrower than
    the limits stand for them. Mesh files that are found get absolute paths. longest: characters of a name.

    Raises ScenarioError: no URDF, no such link, a chain that closes or branches back, a joint on it that follows
    another one, has no axis or limits that cannot be in rad.
    """
    root = _parse(path, flange)
    for element in root:
        name = element.get("name", "")
        if len(name) > longest:
            raise ScenarioError(
                f'The URDF {path}: the name of <{element.tag}> "{name[:20]}..." has {len(name)} characters; it may '
                f"have at most {longest}."
            )
    names = frozenset(link.get("name", "") for link in root.iter("link"))
    if flange not in names:
        shown = ", ".join(sorted(names))
        raise ScenarioError(f'arm.flange = "{flange}" is no link of {path}; its links are {shown}.')
    _demand_numbers(root, path)
    joints = root.findall("joint")
    links = _links_to(flange, joints, path)
    beyond = _beyond(flange, joints)
    apart = names - _beyond(links[0], joints) - {links[0]}
    if apart:
        raise ScenarioError(
            f"The URDF {path} is not one tree: no joint leads from its root {links[0]} to "
            f"{', '.join(sorted(apart)[:3])}."
        )

    for element in list(root):
        if element.tag == "link" and element.get("name") in beyond:
            root.remove(element)
        elif element.tag == "joint":
            if end_of(element, "child") in beyond:
                root.remove(element)
            elif end_of(element, "child") not in links:
                element.set("type", "fixed")
                for mimic in element.findall("mimic"):
                    element.remove(mimic)
            else:
                _on_the_chain(element, path)
        elif element.tag in ("gazebo", "transmission"):
            root.remove(element)
    moving = [j for j in root.findall("joint") if end_of(j, "child") in links and j.get("type") != "fixed"]
    if len(moving) > MOST_JOINTS:
        raise ScenarioError(
            f"The URDF {path} has {len(moving)} joints that move between its root and {flange}; an arm may have at "
            f"most {MOST_JOINTS}."
        )
    for mesh in root.iter("mesh"):
        mesh.set("filename", find_mesh(mesh.get("filename", ""), path, package_dirs))
    all_joints = frozenset(joint.get("name", "") for joint in joints)
    by_position = {joint.get("name", ""): found for joint in moving if (found := _by_position(joint, path))}
    return Chain(ElementTree.tostring(root, encoding="unicode"), tuple(links), names, all_joints, by_position)


def read_disabled_pairs(path: Path, links: Collection[str]) -> frozenset[tuple[str, str]]:
    """Pairs of links, names in order, whose collisions an SRDF (MoveIt's semantic description) disables.

    Raises ScenarioError when the file cannot be read, or names none of the robot's links.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise ScenarioError(f"arm.srdf: {path} cannot be read ({reason(error)}); it must be an SRDF file.") from None
    pairs = [(e.get("link1", ""), e.get("link2", "")) for e in root.iter("disable_collisions")]
    found = frozenset((min(pair), max(pair)) for pair in pairs if pair[0] in links and pair[1] in links)
    if pairs and not found:
        raise ScenarioError(f"arm.srdf: {path} names no links of this arm; give the SRDF that belongs to its URDF.")
    return found


def find_mesh(name: str, urdf: Path, package_dirs: Sequence[Path] = (), nested: int = 2) -> str:
    """Absolute path of a mesh file that a URDF names; the name itself if no such file is found.

    `package://PACKAGE/FILE` is looked for in `package_dirs`, then in AMENT_PREFIX_PATH and ROS_PACKAGE_PATH (below
    fewer than `nested` folders), then among the models that come with salver, in every folder above the URDF, in
    example-robot-data where that is installed. Other names are relative to the URDF.
    """
    scheme, _, rest = name.rpartition("://")
    if scheme not in ("package", "model"):
        folders = [folder for folder in urdf.parents if (folder / rest).is_file()]
        return str(folders[0] / rest) if folders else name
    package, _, file = rest.partition("/")
    for folder in (*package_dirs, *_ros_folders()):
        here = [folder] if folder.name == package else []
        below = (p for k in range(nested) for p in folder.glob("*/" * k + package))
        for place in (*here, *islice(below, 16)):
            if (place / file).is_file():
                return str(place / file)
    if package == MODELS and (OWN_FOLDER / file).is_file():
        return str(OWN_FOLDER / file)
    installed = shared_folder()
    for folder in (*urdf.parents, *([] if installed is None else [installed])):
        for relative in (rest, file):
            if (folder / relative).is_file():
                return str(folder / relative)
    return name


@lru_cache(maxsize=1)
def shared_folder() -> Path | None:
    """Folder of the models of the package example-robot-data; None if it is not installed."""
    try:
        package = metadata.distribution(MODELS)
    except metadata.PackageNotFoundError:
        return None
    return Path(str(package.locate_file("cmeel.prefix/share"))).resolve()


def _ros_folders() -> list[Path]:
    """Folders that hold ROS packages, of ROS 2 and of ROS 1."""
    ament = [Path(prefix) / "share" for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if prefix]
    ros = [Path(folder) for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if folder]
    return [folder for folder in (*ament, *ros) if folder.is_dir()]


def _parse(path: Path, flange: str) -> ElementTree.Element:
    try:
        root = _tree(path)
    except (OSError, expat.ExpatError, UnicodeError) as error:
        raise ScenarioError(
            f"The URDF {path} cannot be read ({reason(error)}); it must be an XML file of a robot."
        ) from None
    if root.tag == "mujoco":
        return read_mjcf(path, flange)
    if any(element.tag.startswith("xacro:") for element in root.iter()):
        raise ScenarioError(
            f"The file {path} is written in xacro, which has to be run to give a URDF; do that once, with "
            f"xacrodoc {path.name} -o {path.name.split('.')[0]}.urdf (pip install xacrodoc), and give the result."
        )
    if root.tag != "robot" or root.find("link") is None:
        raise ScenarioError(
            f"The URDF {path} describes no robot: its root is <{root.tag}>; it must be <robot> with links."
        )
    for element in list(root.iter()):
        element.attrib = {key: value for key, value in element.attrib.items() if ":" not in key}
        for child in [child for child in element if ":" in child.tag]:
            element.remove(child)
    return root


def _tree(path: Path) -> ElementTree.Element:
    """The file's elements, names as they are written: URDFs use prefixes of other tools without declaring them."""
    if path.stat().st_size > LARGEST:
        raise ScenarioError(
            f"The URDF {path} is larger than {LARGEST // 1_000_000} MB; it must be an XML file of a robot."
        )
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    with path.open("rb") as file:
        parser.ParseFile(file)
    return builder.close()


# Attributes that must be so many finite numbers: what the URDF parser cannot read it leaves out without a word.
_NUMBERS = {
    "mass": (("value", 1),),
    "inertia": tuple((key, 1) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")),
    "origin": (("xyz", 3), ("rpy", 3)),
    "axis": (("xyz", 3),),
    "limit": tuple((key, 1) for key in ("lower", "upper", "effort", "velocity")),
    "safety_controller": tuple((key, 1) for key in ("soft_lower_limit", "soft_upper_limit")),
    BY_POSITION: tuple((key, 1) for key in ("velocity_offset", "deceleration_limit")),
}


def _demand_numbers(root: ElementTree.Element, path: Path) -> None:
    for part in [*root.findall("link"), *root.findall("joint")]:
        for element in part.iter():
            for key, count in _NUMBERS.get(element.tag, ()):
                text = element.get(key)
                if text is not None and not _are_numbers(text, count):
                    wanted = "a finite number" if count == 1 else f"{count} finite numbers"
                    raise ScenarioError(
                        f'The URDF {path}: {key} of <{element.tag}> in {part.get("name")} is "{text}"; it must be '
                        f"{wanted}."
                    )


def _are_numbers(text: str, count: int) -> bool:
    try:
        numbers = [float(word) for word in text.split()]
    except ValueError:
        return False
    return len(numbers) == count and bool(np.isfinite(numbers).all())


def _links_to(flange: str, joints: Sequence[ElementTree.Element], path: Path) -> list[str]:
    """Links from the root to the flange."""
    to_child: dict[str, ElementTree.Element] = {}
    for joint in joints:
        child = end_of(joint, "child")
        if child in to_child:
            raise ScenarioError(
                f"The URDF {path} closes a chain: the link {child} hangs on the joints {to_child[child].get('name')} "
                f"and {joint.get('name')}; an arm is one open chain, each link on one joint."
            )
        to_child[child] = joint
    links = [flange]
    while links[0] in to_child:
        parent = end_of(to_child[links[0]], "parent")
        if parent in links:
            raise ScenarioError(
                f"The URDF {path} closes a chain: following parents from {flange}, the link {parent} comes again; an "
                "arm is one open chain that begins at a root."
            )
        links.insert(0, parent)
    return links


def _beyond(flange: str, joints: Sequence[ElementTree.Element]) -> set[str]:
    """Links that hang on the flange, directly or not."""
    beyond = {flange}
    while grown := {end_of(j, "child") for j in joints if end_of(j, "parent") in beyond} - beyond:
        beyond |= grown
    return beyond - {flange}


def _on_the_chain(joint: ElementTree.Element, path: Path) -> None:
    """Put a joint between root and flange in the form that salver works with."""
    name, mimic = joint.get("name"), joint.find("mimic")
    if mimic is not None and joint.get("type") != "fixed":
        raise ScenarioError(
            f"The joint {name} of {path} mimics {mimic.get('joint')}, and it lies between root and flange; joints of "
            "an arm must move on their own: describe the linkage by one joint, or fix this one."
        )
    axis, limit, soft = joint.find("axis"), joint.find("limit"), joint.find("safety_controller")
    if joint.get("type") != "fixed" and axis is not None and not any(map(float, axis.get("xyz", "1 0 0").split())):
        raise ScenarioError(
            f'The URDF {path}: xyz of <axis> in {name} is "{axis.get("xyz")}"; it must be a direction, of any length '
            "above 0."
        )
    if limit is not None and joint.get("type") == "revolute":
        for key in ("lower", "upper"):
            value = float(limit.get(key, "0"))
            if DEGREES[0] < abs(value) <= DEGREES[1]:
                raise ScenarioError(
                    f'The URDF {path}: {key} of <limit> in {name} is "{limit.get(key)}"; it must be in rad, at most '
                    f"{DEGREES[0]:.1f} either way ({value:g} deg would be {np.deg2rad(value):.4g}), or the joint "
                    "continuous."
                )
    if limit is not None and soft is not None and joint.get("type") in ("revolute", "prismatic"):
        low, high = (float(soft.get(f"soft_{key}_limit", "0")) for key in ("lower", "upper"))
        if low < high:  # both are 0 where nobody gave them
            limit.set("lower", str(max(low, float(limit.get("lower", "0")))))
            limit.set("upper", str(min(high, float(limit.get("upper", "0")))))
    if joint.get("type") == "continuous":
        joint.set("type", "revolute")
        limit = ElementTree.SubElement(joint, "limit", effort="0", velocity="0") if limit is None else limit
        limit.set("lower", str(-TURNS * 2 * np.pi))
        limit.set("upper", str(TURNS * 2 * np.pi))


def _by_position(joint: ElementTree.Element, path: Path) -> tuple[float, float] | None:
    """velocity_offset and deceleration_limit of a joint with an element `BY_POSITION`."""
    element = joint.find(BY_POSITION)
    if element is None:
        return None
    offset, deceleration = (float(element.get(key, "0")) for key, _ in _NUMBERS[BY_POSITION])
    if not min(offset, deceleration) > 0:
        raise ScenarioError(
            f"The URDF {path}: velocity_offset and deceleration_limit of <{BY_POSITION}> in {joint.get('name')} are "
            f"{offset:g} and {deceleration:g}; both must be above 0."
        )
    return offset, deceleration


def without_shapes(urdf: str) -> ElementTree.Element:
    """A URDF without the shapes of its links: Pinocchio's parser complains of capsules."""
    root = ElementTree.fromstring(urdf)
    for link in root.iter("link"):
        for shape in [*link.findall("visual"), *link.findall("collision")]:
            link.remove(shape)
    return root


def end_of(joint: ElementTree.Element, which: str) -> str:
    """Name of the link at an end of a joint: "parent" or "child"."""
    element = joint.find(which)
    return "" if element is None else element.get("link", "")
