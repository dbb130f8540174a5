"""`salver new`: a scenario of one's own, by five questions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from salver.cli.common import NO_SAFE_PLAN, Json, print_json, result_console, say
from salver.errors import SalverError, ScenarioError

if TYPE_CHECKING:
    from salver.models.arm import ArmModel

T = TypeVar("T")

QUESTIONS = {
    "load": ("What is carried: box LENGTH WIDTH HEIGHT, or cylinder RADIUS HEIGHT, in metres", "cylinder 0.03 0.24"),
    "mass": ("Its mass in kg, and how far that may be wrong", "0.4 20%"),
    "friction": ("Friction coefficient between it and the tray, and how far that may be wrong", "0.4 10%"),
    "arm": (
        "The arm: a ready-made one such as panda or ur10, or a URDF file and the link that carries the tray",
        "panda",
    ),
    "path": ("From where to where: x y z to x y z of the object's centre, in metres from the arm's base", ""),
}


def new(
    file: Annotated[Path, typer.Argument(help="The scenario file to write, ending in .toml.")],
    load: Annotated[str | None, typer.Option(help=QUESTIONS["load"][0])] = None,
    mass: Annotated[str | None, typer.Option(help=QUESTIONS["mass"][0])] = None,
    friction: Annotated[str | None, typer.Option(help=QUESTIONS["friction"][0])] = None,
    arm: Annotated[str | None, typer.Option(help=QUESTIONS["arm"][0])] = None,
    path: Annotated[str | None, typer.Option(help=QUESTIONS["path"][0])] = None,
    json: Json = False,
) -> None:
    """Write a scenario of your own, with comments: what is not given as an option is asked.

    The scenario is planned once, as fast as it is safe, so that you know it can be done.

    Example: `salver new bottle.toml --load "cylinder 0.03 0.24" --mass "0.4 20%"`

    Ends with 0 when that plan is safe, with 3 when none was found; the file is written all the same.
    """
    if file.suffix != ".toml":
        raise ScenarioError(f"{file} does not end in .toml; a scenario is a .toml file.")
    if file.exists():
        raise ScenarioError(f"{file} exists already; choose another name, or remove it.")
    from salver.run_directory import check_writable

    check_writable(file.parent, "name a file elsewhere")  # before anything is asked
    given = {"load": load, "mass": mass, "friction": friction, "arm": arm, "path": path}
    answers: dict[str, Any] = {}
    for key in QUESTIONS:
        default = _in_reach(*answers["arm"]) if key == "path" else QUESTIONS[key][1]
        answers[key] = _answer(QUESTIONS[key][0], default, given[key], READERS[key])

    from salver import scenario as scenarios
    from salver.files import write_atomic
    from salver.planning.make import make_plan

    text = written(file.stem, **answers)
    scenarios.parse(_data(text, file), str(file))  # what is wrong with it is said before there is a file
    write_atomic(file, text)
    if not json:
        say(f"Written: {file}. Planning it once ...")
    try:
        plan = make_plan(scenarios.load(file), "fastest")
    except SalverError:
        say(f"For this arm a way well within reach is {_in_reach(*answers['arm'])}.")
        raise
    if json:
        print_json({"file": file, "ok": plan.ok, "duration": plan.duration, "status": plan.status.sentence})
    else:
        result_console().print(plan.status.sentence, markup=False)
        if plan.arm_status is not None:
            result_console().print(plan.arm_status.sentence, markup=False)
        name, runs = quote(str(file)), quote(f"runs/{file.stem}")
        say(
            f"Next: salver plan {name} -o {runs}, then salver simulate and salver report of that directory."
            if plan.ok
            else f"What often helps: start and goal higher or further from the arm's base, or a smaller tray ([tray] "
            f"size), in {file}; then salver plan {name}."
        )
    if not plan.ok:
        raise typer.Exit(NO_SAFE_PLAN)


def _answer(question: str, default: str, given: str | None, read: Callable[[str], T]) -> T:
    """The answer to a question, given or asked; asked again until it can be read."""
    if given is not None:
        return read(given)
    while True:
        try:
            return read(typer.prompt(question, default=default, err=True))
        except SalverError as error:
            say(str(error))


def _numbers(words: list[str], what: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count:
        raise ScenarioError(f'"{" ".join(words)}" is not {what}; it must be {count} numbers with spaces between.')
    return values


def _load(text: str) -> str:
    kind, *words = text.split() or [""]
    if kind == "box":
        return f'{{ type = "box", size = {_numbers(words, "the size of a box", 3)} }}'
    if kind == "cylinder":
        radius, height = _numbers(words, "the radius and height of a cylinder", 2)
        return f'{{ type = "cylinder", radius = {radius}, height = {height} }}'
    raise ScenarioError(f'"{text}" is no load; write box LENGTH WIDTH HEIGHT, or cylinder RADIUS HEIGHT, in metres.')


def _value_and_range(text: str) -> tuple[float, str]:
    words = text.replace("+-", " ").replace("±", " ").split()
    if len(words) != 2 or not words[1].endswith("%"):
        raise ScenarioError(f'"{text}" must be a number and a percentage, as in "0.4 20%".')
    return _numbers(words[:1], "a number", 1)[0], words[1]


def _arm(text: str) -> tuple[str, str | None]:
    words = text.split()
    urdf = bool(words) and words[0].endswith((".urdf", ".xml"))
    if len(words) != 1 + urdf:
        raise ScenarioError(f'"{text}" is no arm; write its name, or a URDF file and the link that carries the tray.')
    chosen = (str(Path(words[0]).resolve()), words[1]) if urdf else (words[0], None)
    _loaded(*chosen)
    return chosen


def _loaded(model: str, flange: str | None) -> ArmModel:
    """The arm. Raises ScenarioError when there is no such arm or link."""
    from salver.models.arm import load_arm
    from salver.scenario import Arm, Tray

    return load_arm(Arm(model=model, flange=flange), Tray())


def _in_reach(model: str, flange: str | None) -> str:
    """A way across in front of the arm, at a comfortable share of the lengths of its links."""
    joints = _loaded(model, flange).pin_model.jointPlacements.tolist()[2:]
    length = sum(float(sum(x * x for x in joint.translation)) ** 0.5 for joint in joints)
    x, y, z = (round(share * length, 2) for share in (0.55, 0.28, 0.45))
    return f"{x:g} {-y:g} {z:g} to {x:g} {y:g} {z:g}"


def _path(text: str) -> tuple[list[float], list[float]]:
    start, to, goal = text.replace(",", " ").partition(" to ")
    if not to:
        raise ScenarioError(f'"{text}" is no way; write x y z to x y z, in metres.')
    return _numbers(start.split(), "a position", 3), _numbers(goal.split(), "a position", 3)


READERS: dict[str, Callable[[str], Any]] = {
    "load": _load,
    "mass": _value_and_range,
    "friction": _value_and_range,
    "arm": _arm,
    "path": _path,
}


def _data(text: str, file: Path) -> dict[str, Any]:
    import tomllib

    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{file} would not be valid TOML: {error}.") from None


def written(
    name: str,
    load: str,
    mass: tuple[float, str],
    friction: tuple[float, str],
    arm: tuple[str, str | None],
    path: tuple[list[float], list[float]],
) -> str:
    """The scenario file, with a comment on all that one may want to change."""
    model, flange = (_quoted(word) if word is not None else None for word in arm)
    carrier = f"flange = {flange}          # the link that carries the tray" if flange else ""
    return (
        f"""\
# A scenario for salver. Lengths in metres, masses in kilograms, times in seconds. Every key: docs/scenario-file.md
name = {_quoted("".join(c if c.isalnum() or c in "._-" else "-" for c in name))}
summary = "Written by salver new"

[motion]                        # from rest to rest; poses of the object's centre of mass
start.position = {path[0]}
goal.position = {path[1]}
orientation = "free"            # the tray may tilt on the way; "fixed" keeps it level
goal_yaw = "free"               # any heading will do at the goal
# duration = 1.5                # leave it out for the shortest safe one

[[objects]]
name = "load"
shape = {load}
mass = {mass[0]}
friction = {friction[0]}
# com = [0.0, 0.0, 0.0]         # centre of mass, from the middle of the shape

[objects.uncertainty]           # half-ranges: the plan is safe for everything within them
mass = {_quoted(mass[1])}
friction = {_quoted(friction[1])}
com = [0.003, 0.003, 0.005]     # nobody knows it better than that without measuring
# position = [0.003, 0.003]     # how exactly it is put on the tray

[contact]
condition = "exact"             # "paper" for the sufficient condition of the paper

[tray]
size = [0.25, 0.25]
mass = 0.2

[arm]
model = {model}
{carrier}
""".rstrip()
        + "\n"
    )


def _quoted(text: str) -> str:
    import json

    return json.dumps(text, ensure_ascii=False)
