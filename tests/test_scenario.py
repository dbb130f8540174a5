"""Scenarios: what is wrong gets one sentence with key, value and what would be accepted; what is right is kept."""

import copy
import json
import math
import tomllib

import numpy as np
import pytest

from salver import scenario
from salver.errors import ScenarioError
from salver.planning.plan_files import write_scenario

GONE = object()
CUBE = (scenario.SCENARIO_DIR / "panda-cube.toml").read_text(encoding="utf-8")

NUMBER = "must be a finite number"
VECTOR = "must be three finite numbers, each at least -10 and at most 10"
NAME = "must be letters, digits, points, - and _, a letter or digit first, at most 64"
GAINS = "must be two finite numbers, each at least 0.001 and at most 100000"
SIX = "must be three or six finite numbers, each at least -1000 and at most 1000"
RANGE = 'must be a percentage below 100 % such as "10%", or a half-range in SI units, at least 0 and at most 100'
SHAPES = 'must be a table whose type is "box", "cylinder", "prism", "mesh" or "composite"'
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
        "than the tray, have at most 0.00338.",
    ),
    (
        "tray.inertia",
        [1e-4, 1e-4, 3e-4],
        "tray: inertia = [0.0001, 0.0001, 0.0003] kg m^2 is that of no body: none may be negative, none larger than "
        "the sum "
        "of the other two.",
    ),
    (
        "objects.0.inertia",
        [100, 100, 100],
        "objects[0]: inertia of cube = 100 kg m^2 (nominal or half-range) is too large for 0.256 kg of this shape: "
        "at most "
        "0.00123, four times that of all of it in the furthest corner.",
    ),
    (
        "objects.0.uncertainty.inertia",
        [0, 0, 1],
        "objects[0]: inertia of cube = 1 kg m^2 (nominal or half-range) is too large for 0.256 kg of this shape: at "
        "most "
        "0.00123, four times that of all of it in the furthest corner.",
    ),
    ("arm.model", "a\x00.urdf", 'arm.model = "a\\u0000.urdf": must be a known arm, or the path of a URDF.'),
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
        "contents.",
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
        "objects[0]: uncertainty.mass = 0.3 reaches down to zero from mass = 0.256; it must be less than that.",
    ),
    (
        "objects.0.uncertainty.friction",
        0.5,
        "objects[0]: uncertainty.friction = 0.5 reaches down to zero from friction = 0.5; it must be less than that.",
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
        "motion.start tilts the tray by 30 deg, where cube slides already at rest; with its least friction of 0.5 at "
        "most 26.57 deg hold.",
    ),
    ("obstacles", [{"type": "box", "position": [0, 0, 0]}], "obstacles[0]: a box needs size."),
    (
        "obstacles",
        [{"type": "sphere", "position": [0, 0, 0], "radius": "big"}],
        f'obstacles[0].radius = "big": {NUMBER} at least 0.0001 and at most 5.',
    ),
]


def _changed(*changes):
    data = tomllib.loads(CUBE)
    for key, value in changes:
        *parents, last = key.split(".")
        target = data
        for part in parents:
            target = target[int(part)] if part.isdigit() else target.setdefault(part, {})
        if value is GONE:
            del target[last]
        else:
            target[last] = value
    return data


@pytest.mark.parametrize(
    ("key", "value", "sentence"), BAD, ids=[f"{k}={'gone' if v is GONE else v!s:.30}" for k, v, _ in BAD]
)
def test_bad_input_gets_one_sentence(key, value, sentence):
    with pytest.raises(ScenarioError) as error:
        scenario.parse(_changed((key, value)), "mine.toml")
    assert str(error.value) == f"mine.toml: {sentence}"


def test_two_mistakes_get_two_sentences():
    with pytest.raises(ScenarioError) as error:
        scenario.parse(_changed(("motion.duration", -1), ("objects.0.mass", -1)), "mine.toml")
    first, second = str(error.value).splitlines()
    assert "motion.duration" in first
    assert "objects[0].mass" in second


def test_orientation_twice():
    data = _changed(("motion.start.quat_wxyz", [1, 0, 0, 0]), ("motion.start.rpy_deg", [0, 0, 0]))
    with pytest.raises(
        ScenarioError, match=r"motion\.start: give the orientation by rpy_deg or by quat_wxyz, not by both"
    ):
        scenario.parse(data, "mine.toml")


def test_two_objects_of_one_name():
    data = tomllib.loads(CUBE)
    data["objects"].append(copy.deepcopy(data["objects"][0]))
    with pytest.raises(ScenarioError, match='the name "cube" is used twice; each object needs its own'):
        scenario.parse(data, "mine.toml")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (None, "mine.toml cannot be read (no such file or directory); a scenario is a .toml file."),
        (b"name = ", "mine.toml is not valid TOML: Invalid value (at end of document)."),
        (
            b'name = "a"\nmass = 1\nmass = 2\n',
            "mine.toml is not valid TOML: The same key is given twice (at line 3, column 9): mass = 2.",
        ),
        (b"mass = .5\n", "mine.toml is not valid TOML: Invalid value (at line 1, column 8): mass = .5."),
        (b"\xff\xfe", "mine.toml is not a text file in UTF-8; a scenario is a .toml file."),
    ],
)
def test_files_that_are_no_scenarios(tmp_path, monkeypatch, content, sentence):
    monkeypatch.chdir(tmp_path)
    if content is not None:
        (tmp_path / "mine.toml").write_bytes(content)
    with pytest.raises(ScenarioError) as error:
        scenario.load("mine.toml")
    assert str(error.value) == sentence


def test_files_are_looked_for_beside_the_scenario(tmp_path, monkeypatch):
    import trimesh

    (tmp_path / "mine").mkdir()
    trimesh.creation.box((0.04, 0.04, 0.04)).export(tmp_path / "mine" / "cube.stl")
    text = CUBE.replace('{ type = "box", size = [0.04, 0.04, 0.04] }', '{ type = "mesh", file = "cube.stl" }')
    text = text.replace('model = "panda"', 'model = "arms/mine.urdf"\nflange = "tool0"')
    (tmp_path / "mine" / "scenario.toml").write_text(text)
    monkeypatch.chdir(tmp_path)
    item = scenario.load("mine/scenario.toml")
    assert item.objects[0].shape.file == str(tmp_path / "mine" / "cube.stl")
    assert item.arm.model == str(tmp_path / "mine" / "arms" / "mine.urdf")
    assert scenario.load("panda-cube").arm.model == "panda"


def test_a_name_that_is_slightly_wrong_brings_the_right_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for wrong in ("panda_cube", "Panda-Cube", "panda-cub"):
        with pytest.raises(ScenarioError, match=f'no ready-made scenario "{wrong}"; did you mean panda-cube'):
            scenario.load(wrong)
    (tmp_path / "mine.toml").touch()
    with pytest.raises(ScenarioError, match=r"the file is mine\.toml\."):
        scenario.load("mine")
    with pytest.raises(ScenarioError, match=r"is a directory without scenario\.toml"):
        scenario.load(tmp_path)


def test_the_scenario_of_a_run_directory_is_read_and_a_ready_made_name_stays_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("runs", "panda-cube"):
        write_scenario(scenario.load("ur10-bottle"), tmp_path / name)
    assert scenario.load("runs").digest == scenario.load("ur10-bottle").digest
    assert scenario.load("panda-cube").name == "panda-cube"


def test_unknown_name_lists_the_known_ones():
    with pytest.raises(ScenarioError) as error:
        scenario.load("panda-cup")
    text = str(error.value)
    assert text.startswith('There is no ready-made scenario "panda-cup"')
    for name in scenario.names():
        assert name in text


@pytest.mark.slow
@pytest.mark.parametrize("name", scenario.names())
def test_ready_made_scenarios_are_valid_and_cite_their_source(name):
    item = scenario.load(name)
    assert item.name == name
    assert item.summary
    assert item.source


@pytest.mark.slow
@pytest.mark.parametrize("name", scenario.names())
def test_digest_survives_being_written_out(name):
    item = scenario.load(name)
    again = scenario.parse(item.model_dump(mode="json", exclude_none=True), "again")
    assert again.digest == item.digest


def test_changes_make_a_checked_copy():
    item = scenario.load("panda-cube")
    longer = item.with_changes(motion__duration=3.0, objects__0__mass=0.3, motion__start__rpy_deg=[5, 0, 0])
    assert (longer.motion.duration, longer.objects[0].mass) == (3.0, 0.3)
    assert longer.motion.start.rpy_deg == (5, 0, 0)
    assert (item.motion.duration, item.objects[0].mass) == (2.5, 0.256)
    assert longer.digest != item.digest
    with pytest.raises(ScenarioError, match=r"the changed scenario: motion\.duration = -1"):
        item.with_changes(motion__duration=-1)


def test_whole_numbers_are_fine_where_numbers_are_asked_for():
    item = scenario.parse(_changed(("motion.duration", 2), ("objects.0.uncertainty.mass", 0)), "mine.toml")
    assert item.motion.duration == 2.0
    assert isinstance(item.motion.duration, float)


def test_rest_on_the_steepest_tilt_that_holds():
    """tan(26.565 deg) = 0.5; with friction 10 % uncertain only tan(24.23 deg) = 0.45 is left."""
    scenario.parse(_changed(("motion.goal.rpy_deg", [0, 26.56, 45])), "mine.toml")
    uncertain = ("objects.0.uncertainty.friction", "10%")
    scenario.parse(_changed(("motion.goal.rpy_deg", [0, 24.2, 45]), uncertain), "mine.toml")
    with pytest.raises(ScenarioError, match=r"motion\.goal tilts .* least friction of 0\.45 at most 24\.23 deg hold"):
        scenario.parse(_changed(("motion.goal.rpy_deg", [0, 24.3, 45]), uncertain), "mine.toml")


def test_orientations():
    half = math.sqrt(0.5)
    by_quat = scenario.Pose(position=(0, 0, 0), quat_wxyz=(half, 0, 0, half))
    by_rpy = scenario.Pose(position=(0, 0, 0), rpy_deg=(0, 0, 90))
    np.testing.assert_allclose(by_quat.rotation, by_rpy.rotation, atol=1e-15)
    np.testing.assert_allclose(by_rpy.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_array_equal(scenario.Pose(position=(0, 0, 0)).rotation, np.eye(3))


def test_changes_leave_what_they_are_given_alone():
    """One change may lead into what another one put there."""
    item = scenario.load("panda-cube").model_dump(mode="json", exclude_none=True)["objects"][0]
    before = json.dumps(item)
    made = scenario.load("panda-cube").with_changes(objects=[item], objects__0__mass=0.3, objects__0__uncertainty=None)
    assert made.objects[0].mass == 0.3
    assert json.dumps(item) == before
