"""Scenarios: files that are none are told, what is right is kept."""

import json
import math

import numpy as np
import pytest

from changed_scenario_file import CUBE, changed
from salver import scenario
from salver.errors import ScenarioError
from salver.models.shapes.obstacle_shapes import obstacle_shapes
from salver.planning.plan_files import write_scenario


def test_a_scenario_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "mine.toml").write_text(CUBE, encoding="utf-8-sig")
    read, shipped = scenario.load(tmp_path / "mine.toml"), scenario.load("panda-cube")
    assert read.model_dump() == shipped.model_dump()


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


def test_a_cylinder_in_the_world_has_a_height():
    post = {"type": "cylinder", "radius": 0.03, "height": 0.4, "position": (0.5, 0.0, 0.3)}
    ((shape, _),) = obstacle_shapes(scenario.load("panda-cube").with_changes(obstacles=[post]).obstacles[0])
    assert (shape.radius, 2 * shape.halfLength) == (0.03, 0.4)


def test_changes_make_a_checked_copy():
    item = scenario.load("panda-cube")
    longer = item.with_changes(motion__duration=3.0, objects__0__mass=0.3, motion__start__rpy_deg=[5, 0, 0])
    assert (longer.motion.duration, longer.objects[0].mass) == (3.0, 0.3)
    assert longer.motion.start.rpy_deg == (5, 0, 0)
    assert (item.motion.duration, item.objects[0].mass) == (2.5, 0.256)
    assert longer.digest != item.digest
    bases = [[0, 0, 30], [5, 0, 30], [0, -5, 30]]  # and each base has its own, however it leans
    leaning = [item.with_changes(arm__base_rpy_deg=base, surroundings__floor="none") for base in bases]
    assert len({each.digest for each in leaning}) == 3
    for nowhere in ({"objects__3__mass": 1.0}, {"objects__mass": 1.0}, {"name__first": "a"}, {"seed__x__y": None}):
        with pytest.raises(ScenarioError, match=r"__\w+ is no place in"):
            item.with_changes(**nowhere)
    with pytest.raises(ScenarioError, match=r"the changed scenario: motion\.duration = -1"):
        item.with_changes(motion__duration=-1)


def test_whole_numbers_are_fine_where_numbers_are_asked_for():
    item = scenario.parse(changed(("motion.duration", 2), ("objects.0.uncertainty.mass", 0)), "mine.toml")
    assert item.motion.duration == 2.0
    assert isinstance(item.motion.duration, float)


def test_rest_on_the_steepest_tilt_that_holds():
    """tan(26.565 deg) = 0.5; with friction 10 % uncertain only tan(24.23 deg) = 0.45 is left."""
    scenario.parse(changed(("motion.goal.rpy_deg", [0, 26.56, 45])), "mine.toml")
    uncertain = ("objects.0.uncertainty.friction", "10%")
    scenario.parse(changed(("motion.goal.rpy_deg", [0, 24.2, 45]), uncertain), "mine.toml")
    with pytest.raises(ScenarioError, match=r"motion\.goal tilts .* least friction of 0\.45 holds it up to 24\.23 deg"):
        scenario.parse(changed(("motion.goal.rpy_deg", [0, 24.3, 45]), uncertain), "mine.toml")


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
    made = scenario.load("panda-cube").with_changes(
        objects=[item], objects__0__mass=0.3, objects__0__uncertainty="none"
    )
    assert made.objects[0].mass == 0.3
    assert json.dumps(item) == before


# ---- what nobody said --------------------------------------------------------------------------------------------


def bottle(**more):
    """A file that says nothing of how exactly the load is known."""
    shape = {"type": "cylinder", "radius": 0.033, "height": 0.2}
    item = {"name": "bottle", "shape": shape, "mass": 0.4, "friction": 0.35, **more}
    ends = {"start": {"position": [0.5, -0.25, 0.4]}, "goal": {"position": [0.5, 0.25, 0.4]}}
    return scenario.parse({"name": "newcomer", "motion": ends, "objects": [item]}, "newcomer")


def test_where_nothing_is_said_ranges_are_assumed():
    made = bottle()
    half = dict(zip(made.uncertain.names, made.uncertain.half_range, strict=True))
    assert half == pytest.approx(
        {"mass": 0.04, "friction": 0.0525, "com_x": 0.003, "com_y": 0.003, "com_z": 0.01}
        | {"position_x": 0.002, "position_y": 0.002}
    )
    small = bottle(shape={"type": "box", "size": [0.02, 0.05, 0.02]})
    assert small.objects[0].uncertainty.com == pytest.approx((0.002, 0.002, 0.001))


@pytest.mark.parametrize("said", ["none", {}, {"mass": "10%"}])
def test_what_is_said_is_all_and_stays_through_changes(said):
    made = bottle(uncertainty=said)
    names = ("mass",) if said == {"mass": "10%"} else ()
    assert made.uncertain.names == names
    assert made.with_changes(motion__duration=2.0).uncertain.names == names
    assert bottle().with_changes(objects__0__uncertainty=said).uncertain.names == names


def test_of_a_liquid_its_height_is_assumed_and_its_place_exact():
    """10 % of 5 cm; half of the 4 mm to the brim where that is less. What stands on something stays in its place."""
    for fill, brim, half in ((0.05, 0.1, 0.005), (0.05, 0.054, 0.002)):
        liquid = {"radius": 0.03, "fill": fill, "brim": brim}
        made = bottle(shape={"type": "cylinder", "radius": 0.033, "height": brim + 0.002}, liquid=liquid)
        known = made.objects[0].uncertainty
        assert known.fill == pytest.approx(half)
        assert known.position is None
    base = {"name": "base", "shape": {"type": "box", "size": [0.1, 0.1, 0.02]}, "mass": 0.3, "friction": 0.5}
    made = bottle().with_changes(objects=[base, {**base, "name": "lid", "on": "base"}])
    assert [item.uncertainty.position for item in made.objects] == [(0.002, 0.002), None]


def test_a_wrong_shape_is_the_only_mistake_where_ranges_would_be_assumed():
    with pytest.raises(ScenarioError) as refused:
        bottle(shape={"type": "ball"})
    assert str(refused.value).count("\n") == 0
