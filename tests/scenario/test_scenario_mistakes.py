"""Mistakes in a scenario: each gets one sentence with key, value and what would be accepted."""

import copy
import math
import tomllib

import pytest

from changed_scenario_file import CUBE, GONE, changed
from salver import scenario
from salver.errors import ScenarioError

NUMBER = "must be a finite number"
VECTOR = "must be three finite numbers, each at least -10 and at most 10"
NAME = "must be letters, digits, points, - and _, a letter or digit first, at most 64"
GAINS = "must be two finite numbers, each at least 0.001 and at most 100000"
SIX = "must be three or six finite numbers, each at least -1000 and at most 1000"
RANGE = 'must be a percentage below 100 % such as "10%", or a half-range in SI units, at least 0 and at most 100'
SHAPES = 'must be a table whose type is "box", "cylinder", "cone", "prism", "mesh" or "composite"'
POSE = "must be a table with the keys position, rpy_deg, quat_wxyz"

# key, value, the sentence after the file's name. One sentence each.
BAD = [
    # numbers
    ("motion.duration", math.nan, f"motion.duration = nan: {NUMBER} at least 0.01 and at most 120."),
    ("motion.duration", math.inf, f"motion.duration = inf: {NUMBER} at least 0.01 and at most 120."),
    ("motion.duration", -1, f"motion.duration = -1: {NUMBER} at least 0.01 and at most 120."),
    ("motion.duration", "2.5", f'motion.duration = "2.5": {NUMBER} at least 0.01 and at most 120.'),
    ("motion.duration", True, f"motion.duration = true: {NUMBER} at least 0.01 and at most 120."),
    ("motion.duration", [2], f"motion.duration = [2]: {NUMBER} at least 0.01 and at most 120."),
    ("motion.degree", 4, "motion.degree = 4: must be a whole number at least 5 and at most 30."),
    ("motion.degree", 9.5, "motion.degree = 9.5: must be a whole number at least 5 and at most 30."),
    ("contact.edges", 2, "contact.edges = 2: must be a whole number at least 3 and at most 32."),
    ("seed", -1, "seed = -1: must be a whole number at least 0 and at most 9223372036854775807."),
    ("arm.velocity_scale", 1.5, f"arm.velocity_scale = 1.5: {NUMBER} greater than 0 and at most 1."),
    ("physics.timestep", 0.01, f"physics.timestep = 0.01: {NUMBER} at least 1e-05 and at most 0.005."),
    # what would take more than a machine has, or is lost in the engine
    ("control.kp", [1e6, 300], f"control.kp = [1000000.0, 300]: {GAINS}."),
    ("control.kd", [1e6, 15], f"control.kd = [1000000.0, 15]: {GAINS.removesuffix('00')}."),
    (
        "control.kp",
        [9e4, 300],
        "control.kp = 90000 1/s^2 with control.kd = 25 1/s is unstable when commands are held for "
        "physics.command_period "
        "= 0.001 s; give smaller gains, or kd nearer to 2 sqrt(kp).",
    ),
    ("physics.settle_after", 1e6, f"physics.settle_after = 1000000.0: {NUMBER} at least 0 and at most 60."),
    ("physics.timestep", 1e-9, f"physics.timestep = 1e-09: {NUMBER} at least 1e-05 and at most 0.005."),
    (
        "tray.inertia",
        [1e9, 1e9, 1e9],
        "tray.inertia = [1000000000.0, 1000000000.0, 1000000000.0]: must be three finite numbers, each at least "
        "-1000 and at "
        "most 1000.",
    ),
    (
        "tray.inertia",
        [1.0, 1.0, 1.0],
        "tray: inertia = [1.0, 1.0, 1.0] kg m^2 is too large: 0.15 kg between the flange and the tray's surface, no "
        "wider "
        "than the tray, has at most 0.00338.",
    ),
    (
        "tray.inertia",
        [1e-4, 1e-4, 3e-4],
        "tray: inertia = [0.0001, 0.0001, 0.0003] kg m^2 is impossible: no value may be negative or larger than the "
        "sum of the other two.",
    ),
    (
        "objects.0.inertia",
        [100, 100, 100],
        "objects[0]: inertia of cube = 100 kg m^2 (nominal or half-range) is too large for 0.256 kg of this shape: "
        "at most "
        "0.00123, four times that of the whole mass in the furthest corner.",
    ),
    (
        "objects.0.uncertainty.inertia",
        [0, 0, 1],
        "objects[0]: inertia of cube = 1 kg m^2 (nominal or half-range) is too large for 0.256 kg of this shape: at "
        "most "
        "0.00123, four times that of the whole mass in the furthest corner.",
    ),
    ("arm.model", "a\x00.urdf", 'arm.model = "a\\u0000.urdf": must be a known arm, or the path of a URDF or MJCF.'),
    ("summary", "x" * 20_000, f'summary = "{"x" * 76}...: must be text of at most 10000 letters.'),
    ("obstacles", [{}] * 101, f"obstacles = [{'{}, ' * 19}...: must be a list of tables, at most 100."),
    # names and choices
    ("motion.orientation", "loose", 'motion.orientation = "loose": must be "fixed" or "free".'),
    ("contact.condition", "none", 'contact.condition = "none": must be "paper" or "exact".'),
    ("uncertainty.set", "ball", 'uncertainty.set = "ball": must be "box" or "ellipsoid".'),
    ("name", "a b", 'name = "a b": must be letters, digits, points, - and _, a letter or digit first, at most 64.'),
    (
        "objects.0.name",
        "my cube",
        'objects[0].name = "my cube": must be letters a to z, digits, - and _, a letter first, at most 64.',
    ),
    # vectors
    ("motion.start.position", [0, 1], f"motion.start.position = [0, 1]: {VECTOR}."),
    ("motion.start.position", [0, 1, math.nan], f"motion.start.position = [0, 1, nan]: {VECTOR}."),
    ("motion.start.position", "here", f'motion.start.position = "here": {VECTOR}.'),
    (
        "motion.start.position",
        [0, 1, 370],
        f"motion.start.position = [0, 1, 370]: {VECTOR}.",
    ),
    ("motion.start.quat_wxyz", [1, 1, 0, 0], "motion.start: quat_wxyz has norm 1.414; a rotation has norm 1."),
    ("motion.start", [0, 0, 0], f"motion.start = [0, 0, 0]: {POSE}."),
    ("control.kp", [500], f"control.kp = [500]: {GAINS}."),
    (
        "control.kp",
        [500, -3],
        "control.kp = [500, -3]: must be two finite numbers, each at least 0.001 and at most 100000.",
    ),
    ("tray.size", [0.2], "tray.size = [0.2]: must be two finite numbers, each at least 0.0001 and at most 5."),
    ("arm.start_posture", [1, "a"], 'arm.start_posture = [1, "a"]: must be a list of finite numbers, at most 20.'),
    # missing and unknown keys
    (
        "name",
        GONE,
        f"name is missing; it {NAME}.",
    ),
    ("motion.goal", GONE, f"motion.goal is missing; it {POSE}."),
    ("objects.0.mass", GONE, f"objects[0].mass is missing; it {NUMBER} at least 1e-06 and at most 100."),
    ("motions", {}, "unknown key motions; did you mean motion."),
    ("motion.star", {}, "unknown key motion.star; did you mean start."),
    ("motion.start.positon", [0, 0, 0], "unknown key motion.start.positon; did you mean position."),
    ("objects.0.mas", 1, "unknown key objects[0].mas; did you mean mass."),
    ("objects.0.shape.colour", "red", "unknown key objects[0].shape.colour; accepted are type, size."),
    (
        "objects.0.uncertainty.weight",
        "10%",
        "unknown key objects[0].uncertainty.weight; accepted are mass, com, inertia, friction, position, fill, "
        "length, contents.",
    ),
    ("control.gains", 1, "unknown key control.gains; accepted are kp, kd."),
    # objects
    ("objects", [], "objects = []: must be a list of tables, at least one and at most 20."),
    ("objects", {}, "objects: must be a list of tables, at least one and at most 20."),
    ("objects.0.mass", -1, f"objects[0].mass = -1: {NUMBER} at least 1e-06 and at most 100."),
    ("objects.0.mass", math.nan, f"objects[0].mass = nan: {NUMBER} at least 1e-06 and at most 100."),
    ("objects.0.mass", "10", f'objects[0].mass = "10": {NUMBER} at least 1e-06 and at most 100.'),
    ("objects.0.friction", 0, f"objects[0].friction = 0: {NUMBER} at least 1e-06 and at most 5."),
    ("objects.0.friction", -0.1, f"objects[0].friction = -0.1: {NUMBER} at least 1e-06 and at most 5."),
    (
        "objects.0.inertia",
        [1e-4, 1e-4, 3e-4],
        "objects[0]: inertia of cube has principal moments 0.0001, 0.0001, 0.0003 kg m^2; no mass distribution has "
        "one that is larger than the sum of the other two.",
    ),
    (
        "objects.0.inertia",
        [1e-4, 1e-4, -1e-4],
        "objects[0]: inertia of cube has the principal moment -0.0001 kg m^2; all must be positive.",
    ),
    (
        "objects.0.inertia",
        [1e-4, 1e-4],
        f"objects[0].inertia = [0.0001, 0.0001]: {SIX}.",
    ),
    (
        "objects.0.inertia",
        3e-4,
        f"objects[0].inertia = 0.0003: {SIX}.",
    ),
    (
        "objects.0.com",
        [0.1, 0, 0],
        "objects[0]: com of cube = (0.1, 0.0, 0.0) m lies outside its shape; it must be inside.",
    ),
    ("objects.0.com", [1, 2], f"objects[0].com = [1, 2]: {VECTOR}."),
    (
        "objects.0.at",
        [0.1, 0],
        "cube stands 20.0 mm over the edge of the tray, which is 0.2 x 0.2 m; move it with at, or give the tray a "
        "larger size.",
    ),
    ("objects.0.on", "shelf", 'cube stands on "shelf", which is neither "tray" nor an object listed before it.'),
    (
        "objects.0.support_inset",
        0.02,
        "objects[0]: support_inset of cube = 0.02 m leaves nothing of its base to stand on.",
    ),
    # shapes
    ("objects.0.shape", {"type": "sphere", "radius": 1}, f"objects[0].shape: {SHAPES}."),
    ("objects.0.shape", {"size": [1, 1, 1]}, f"objects[0].shape: {SHAPES}."),
    ("objects.0.shape", "box", f'objects[0].shape = "box": {SHAPES}.'),
    (
        "objects.0.shape",
        {"type": "box"},
        "objects[0].shape.size is missing; it must be three finite numbers, each at least 0.0001 and at most 5.",
    ),
    (
        "objects.0.shape.size",
        [40, 40, 40],
        "objects[0].shape.size = [40, 40, 40]: must be three finite numbers, each at least 0.0001 and at most 5.",
    ),
    (
        "objects.0.shape",
        {"type": "prism", "polygon": [[0, 0], [0.1, 0]], "height": 0.1},
        "objects[0].shape.polygon = [[0, 0], [0.1, 0]]: must be a list of points of two finite numbers, at least "
        "three and at most 64.",
    ),
    *(
        (
            "objects.0.shape",
            {"type": "prism", "polygon": polygon, "height": 0.1},
            "objects[0].shape: polygon must go once round a convex outline, counter-clockwise, without repeated "
            "corners.",
        )
        for polygon in (
            [[0, 0], [0.01, 0], [0.02, 0]],  # no area
            [[0, 0], [0, 0.04], [0.04, 0.04], [0.04, 0]],  # clockwise
            [[0, 0], [0.04, 0], [0.01, 0.01], [0, 0.04]],  # a dent
            [[0, 0], [0.04, 0], [0.04, 0], [0, 0.04]],  # a corner twice
            [[1, 0], [-0.81, 0.59], [0.31, -0.95], [0.31, 0.95], [-0.81, -0.59]],  # a star, twice round
        )
    ),
    # what is uncertain
    (
        "objects.0.uncertainty.mass",
        "10",
        'objects[0].uncertainty.mass: "10" is not a percentage; write "10%", or a half-range in SI units.',
    ),
    (
        "objects.0.uncertainty.mass",
        "ten%",
        'objects[0].uncertainty.mass: "ten%" is not a percentage; write "10%", or a half-range in SI units.',
    ),
    ("objects.0.uncertainty.mass", -0.1, f"objects[0].uncertainty.mass = -0.1: {RANGE}."),
    ("objects.0.uncertainty.mass", "110%", f'objects[0].uncertainty.mass = "110%": {RANGE}.'),
    ("objects.0.uncertainty.mass", math.nan, f"objects[0].uncertainty.mass = nan: {RANGE}."),
    (
        "objects.0.uncertainty.mass",
        0.3,
        "objects[0]: uncertainty.mass = 0.3 is not below mass = 0.256, so that mass could be zero; give less.",
    ),
    (
        "objects.0.uncertainty.friction",
        0.5,
        "objects[0]: uncertainty.friction = 0.5 is not below friction = 0.5, so that friction could be zero; give "
        "less.",
    ),
    (
        "objects.0.uncertainty.com",
        "10%",
        'objects[0].uncertainty.com = "10%": must be three finite numbers, each at least 0 and at most 100.',
    ),
    (
        "objects.0.uncertainty.inertia",
        [1e-5, 1e-5],
        "objects[0].uncertainty.inertia = [1e-05, 1e-05]: must be a percentage below 100 % such as "
        '"10%", or three or six half-ranges in SI units, at least 0 and at most 100.',
    ),
    (
        "uncertainty.correlation",
        {"mass,com_x": 0.5},
        'uncertainty.correlation has the key "mass,com_x"; it must name two uncertain parameters, as in '
        '"mass,com_x"; uncertain here are mass.',
    ),
    (
        "uncertainty.correlation",
        {"mass,com_x": 1.5},
        'uncertainty.correlation: must be numbers between -1 and 1 under keys such as "mass,com_x".',
    ),
    # where it starts and ends
    (
        "motion.start.rpy_deg",
        [30, 0, 0],
        "motion.start tilts the tray by 30 deg, at which cube slides even at rest; its least friction of 0.5 holds "
        "it up to 26.57 deg.",
    ),
    ("obstacles", [{"type": "box", "position": [0, 0, 0]}], "obstacles[0]: a box needs size."),
    (
        "obstacles",
        [{"type": "cylinder", "radius": 0.1, "length": 0.2, "height": 0.3, "position": [0, 0, 0]}],
        "obstacles[0]: a cylinder has radius and height; leave out length.",
    ),
    (
        "obstacles",
        [{"type": "capsule", "radius": 0.1, "length": 0.2, "height": 0.3, "position": [0, 0, 0]}],
        "obstacles[0]: a capsule has radius and length; leave out height.",
    ),
    (
        "obstacles",
        [{"type": "sphere", "position": [0, 0, 0], "radius": 0.1, "size": [0.1, 0.1, 0.1]}],
        "obstacles[0]: a sphere has radius; leave out size.",
    ),
    (
        "obstacles",
        [{"type": "sphere", "position": [0, 0, 0], "radius": "big"}],
        f'obstacles[0].radius = "big": {NUMBER} at least 0.0001 and at most 5.',
    ),
]


@pytest.mark.parametrize(
    ("key", "value", "sentence"), BAD, ids=[f"{k}={'gone' if v is GONE else v!s:.30}" for k, v, _ in BAD]
)
def test_bad_input_gets_one_sentence(key, value, sentence):
    with pytest.raises(ScenarioError) as error:
        scenario.parse(changed((key, value)), "mine.toml")
    assert str(error.value) == f"mine.toml: {sentence}"


def test_two_mistakes_get_two_sentences():
    with pytest.raises(ScenarioError) as error:
        scenario.parse(changed(("motion.duration", -1), ("objects.0.mass", -1)), "mine.toml")
    first, second = str(error.value).splitlines()
    assert "motion.duration" in first
    assert "objects[0].mass" in second


def test_orientation_twice():
    data = changed(("motion.start.quat_wxyz", [1, 0, 0, 0]), ("motion.start.rpy_deg", [0, 0, 0]))
    with pytest.raises(
        ScenarioError, match=r"motion\.start: give the orientation by rpy_deg or by quat_wxyz, not by both"
    ):
        scenario.parse(data, "mine.toml")


def test_two_objects_of_one_name():
    data = tomllib.loads(CUBE)
    data["objects"].append(copy.deepcopy(data["objects"][0]))
    with pytest.raises(ScenarioError, match='the name "cube" is used twice; each object needs its own'):
        scenario.parse(data, "mine.toml")
