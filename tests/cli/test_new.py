"""A user-defined scenario, from questions; and the schema with which editors check one."""

import json
import re
import tomllib

import jsonschema
import pytest
from typer.testing import CliRunner

from salver import scenario
from salver.cli import app
from salver.cli.plans import new
from salver.errors import UnreachableError
from salver.models.arm.known_arms import KNOWN_ARMS, robot_file
from salver.planning.make import make_plan
from transport_problems import ROUGH

RUNNER = CliRunner()
ANSWERS = {
    "--load": "box 0.06 0.06 0.1",
    "--mass": "0.4 20%",
    "--friction": "0.5 10%",
    "--arm": "panda",
    "--path": "0.5 -0.25 0.4 to 0.5 0.25 0.4",
}


def options(**changes):
    return [word for pair in {**ANSWERS, **{f"--{k}": v for k, v in changes.items()}}.items() for word in pair]


def test_a_place_that_takes_no_file_is_told_before_anything_is_asked(tmp_path):
    (tmp_path / "file").touch()
    for place in ("/proc/x.toml", str(tmp_path / "file" / "x.toml")):
        done = RUNNER.invoke(app, ["new", place])
        assert done.exit_code == 2
        assert done.stdout == ""
        assert re.fullmatch(r"salver: .* cannot be written to: .*; name a file elsewhere\.\n", done.stderr)


@pytest.mark.slow
def test_answers_become_a_scenario_that_plans(tmp_path):
    file = tmp_path / "my box.toml"
    done = RUNNER.invoke(app, ["new", str(file), *options(), "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["ok"] is True
    made = scenario.load(file)
    item = made.objects[0]
    assert (item.shape.size, item.mass, item.friction) == ((0.06, 0.06, 0.1), 0.4, 0.5)
    assert (item.uncertainty.mass.relative, item.uncertainty.friction.relative) == (0.2, 0.1)
    assert (made.motion.start.position, made.motion.goal.position) == ((0.5, -0.25, 0.4), (0.5, 0.25, 0.4))


@pytest.mark.parametrize(("load", "inside"), [("box 0.1 0.08 0.12", (0.094, 0.074)), ("cylinder 0.04 0.12", 0.037)])
def test_liquid_tray_and_obstacles_become_tables(tmp_path, monkeypatch, load, inside):
    """A container has walls and a bottom of 3 mm. The file is there also where no plan is."""
    monkeypatch.setattr("salver.planning.make.make_plan", refusing)
    file = tmp_path / "cup.toml"
    tables = {"tray": "0.3 0.2", "obstacles": "box 0.1 0.2 0.3 at 0.5 0 0.2; sphere 0.1 at 0.9 0 0.4"}
    done = RUNNER.invoke(app, ["new", str(file), *options(load=load, liquid="coffee 0.08 20%", **tables)])
    assert done.exit_code == 3, done.output
    made = scenario.load(file)
    liquid = made.objects[0].liquid
    assert (liquid.kind, liquid.fill, liquid.brim, liquid.radius or liquid.size) == ("coffee", 0.08, 0.117, inside)
    assert made.objects[0].uncertainty.fill.relative == 0.2
    assert made.tray.size == (0.3, 0.2)
    assert [(o.type, o.size or o.radius, o.position) for o in made.obstacles] == [
        ("box", (0.1, 0.2, 0.3), (0.5, 0.0, 0.2)),
        ("sphere", 0.1, (0.9, 0.0, 0.4)),
    ]


def test_a_tray_that_is_not_given_has_room_for_the_load(tmp_path, monkeypatch):
    monkeypatch.setattr("salver.planning.make.make_plan", refusing)
    for name, load, tray in (("long", "box 0.3 0.1 0.1", (0.34, 0.25)), ("wide", "cylinder 0.15 0.1", (0.34, 0.34))):
        RUNNER.invoke(app, ["new", str(tmp_path / f"{name}.toml"), *options(load=load)])
        assert scenario.load(tmp_path / f"{name}.toml").tray.size == tray


def refusing(*_):
    raise UnreachableError("nothing is found here")


@pytest.mark.slow
def test_what_cannot_be_carried_comes_with_what_helps(tmp_path):
    """So near to a UR5 it touches itself; each of the three things that are said does help."""
    file = tmp_path / "near.toml"
    words = options(load="cylinder 0.03 0.24", friction="0.4 10%", arm="ur5", path="0.2 -0.15 0.4 to 0.2 0.15 0.4")
    done = RUNNER.invoke(app, ["new", str(file), *words])
    assert done.exit_code == 3, done.output
    assert "start and goal higher or further from the arm's base, or a smaller tray" in done.stderr
    near = scenario.load(file)
    for changes in (
        {"motion__start__position": [0.2, -0.15, 0.5], "motion__goal__position": [0.2, 0.15, 0.5]},
        {"motion__start__position": [0.6, -0.15, 0.4], "motion__goal__position": [0.6, 0.15, 0.4]},
        {"tray__size": [0.15, 0.15]},
    ):
        assert make_plan(near.with_changes(**changes), "fastest", options=ROUGH).ok


def test_an_arm_without_its_meshes_is_all_that_is_said(tmp_path):
    """No other start and goal would help; the file is there, for arm.package_dirs."""
    urdf = robot_file(KNOWN_ARMS["ur5"]).read_text(encoding="utf-8").replace("package://", "package://not_here_")
    (tmp_path / "mine.urdf").write_text(urdf)
    file = tmp_path / "mine.toml"
    done = RUNNER.invoke(app, ["new", str(file), *options(arm=f"{tmp_path / 'mine.urdf'} tool0")])
    assert done.exit_code == 2, done.output
    assert "the shape of base_link is not known" in done.stderr.splitlines()[-1]
    assert "often helps" not in done.stderr
    assert file.exists()


@pytest.mark.slow
def test_what_is_out_of_reach_comes_with_what_is_not(tmp_path):
    """The way that is named then can be planned."""
    done = RUNNER.invoke(app, ["new", str(tmp_path / "far.toml"), *options(path="2 0 0.4 to 2 0.2 0.4")])
    assert done.exit_code == 3, done.output
    assert "No posture within the joint limits reaches the start: the nearest found misses it by " in done.stderr
    (way,) = re.findall(r"a way well within reach is (.*)\.", done.stderr)
    assert RUNNER.invoke(app, ["new", str(tmp_path / "near.toml"), *options(path=way)]).exit_code == 0


@pytest.mark.slow
def test_what_is_not_given_is_asked_and_asked_again_until_it_can_be_read(tmp_path):
    file = tmp_path / "asked.toml"
    answers = ["ball 3", "cylinder 0.03 0.2", "tea", "", "heavy", "0.4 20%", "", "", "nope", "panda", "", "tree", ""]
    done = RUNNER.invoke(app, ["new", str(file), "--json"], input="\n".join(answers) + "\n")
    assert done.exit_code == 0, done.output
    for sentence in (
        '"ball 3" is not a load',
        '"tea" is not a liquid',
        '"heavy" must be a number and a percentage',
        '"tree" is not an obstacle',
        'arm.model = "nope" is not known',
    ):
        assert sentence in done.stderr
    assert scenario.load(file).objects[0].shape.height == 0.2


def test_a_conical_cup_has_walls_of_one_thickness():
    """Of 3 mm: at the bottom inside the cup is wider than at its base."""
    load, liquid = new.READERS["load"]("cone 0.03 0.04 0.1"), new.READERS["liquid"]("coffee 0.06 10%")
    assert new._room_for(("cone", [0.03, 0.2, 0.1])) == "0.44 0.44"
    text = new.written(
        "cup", load, liquid, (0.02, "10%"), (0.4, "10%"), [0.25, 0.25], ("panda", None), ([0.5, -0.3, 0.4],) * 2, []
    )
    (item,) = scenario.parse(tomllib.loads(text), "cup").objects
    assert (item.shape.type, item.shape.radius, item.shape.top_radius, item.shape.height) == ("cone", 0.03, 0.04, 0.1)
    assert (item.liquid.radius, item.liquid.brim_radius, item.liquid.brim) == (0.0273, 0.037, 0.097)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"load": "box 1 2"}, "must be 3 numbers"),
        ({"load": "cone 1 2"}, "must be 3 numbers"),
        ({"mass": "-1 10%"}, "objects[0].mass = -1.0: must be a finite number at least 1e-06 and at most 100"),
        ({"path": "0 0 0"}, "write x y z to x y z"),
        ({"tray": "0.3"}, "it must be 2 numbers"),
        ({"liquid": "water 0.06 0.005"}, '--liquid: "0.06 0.005" must be a number and a percentage, as in "0.06 10%"'),
        ({"liquid": "milk 0.05 20%"}, '--liquid: "milk" is not a liquid; write water, coffee, oil or none'),
        ({"obstacles": "box 1 1 1"}, "is not an obstacle"),
        ({"arm": "arm.urdf"}, "the link that carries the tray"),
        ({"friction": "0.4 x%"}, "is not a percentage"),
    ],
)
def test_a_wrong_option_is_one_sentence_and_nothing_is_written(tmp_path, changes, sentence):
    file = tmp_path / "wrong.toml"
    done = RUNNER.invoke(app, ["new", str(file), *options(**changes)])
    assert done.exit_code == 2
    assert sentence in done.stderr
    assert not file.exists()


def test_no_file_is_overwritten(tmp_path):
    file = tmp_path / "mine.toml"
    file.write_text("precious")
    done = RUNNER.invoke(app, ["new", str(file), *options()])
    assert (done.exit_code, file.read_text()) == (2, "precious")


def test_the_schema_accepts_what_salver_accepts_and_refuses_what_it_refuses():
    done = RUNNER.invoke(app, ["scenarios", "--schema"])
    check = jsonschema.Draft202012Validator(json.loads(done.stdout))
    check.check_schema(check.schema)
    files = sorted(scenario.SCENARIO_DIR.glob("*.toml"))
    assert len(files) > 20
    for file in files:
        assert list(check.iter_errors(tomllib.loads(file.read_text(encoding="utf-8")))) == [], file.name
    wrong = tomllib.loads(files[0].read_text(encoding="utf-8"))
    wrong["motion"]["durration"] = 2.0
    assert any("durration" in error.message for error in check.iter_errors(wrong))
