"""`salver new`: write a scenario from answers to questions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

import typer

from salver.cli.common import ExitCode, Json, numbers, print_json, result_console, say
from salver.errors import SalverError, ScenarioError, UnreachableError

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel

QUESTIONS = {
    "load": (
        "The load: box LENGTH WIDTH HEIGHT, cylinder RADIUS HEIGHT, or cone RADIUS TOP_RADIUS HEIGHT, in metres",
        "cylinder 0.03 0.24",
    ),
    "liquid": (
        "An open liquid in it: water, coffee or oil, its height in m, its uncertainty in percent; or none",
        "none",
    ),
    "mass": ("Mass of the load in kg, without an open liquid, and its uncertainty in percent", "0.4 20%"),
    "friction": ("Friction coefficient between load and tray, and its uncertainty in percent", "0.4 10%"),
    "tray": ("Length and width of the tray, in metres", ""),
    "arm": (
        "The arm: a ready-made one such as panda or ur5e, or a URDF file and the link that carries the tray",
        "panda",
    ),
    "path": ("From where to where: x y z to x y z of the load's centre, in metres from the arm's base", ""),
    "obstacles": (
        "Obstacles: box LENGTH WIDTH HEIGHT at x y z, sphere RADIUS at x y z, with ; between several; or none",
        "none",
    ),
}
MAY_BE_LEFT_OUT = ("liquid", "tray", "obstacles")


def new(
    file: Annotated[Path, typer.Argument(help="The scenario file to write, ending in .toml.")],
    load: Annotated[str | None, typer.Option(help=QUESTIONS["load"][0])] = None,
    liquid: Annotated[str | None, typer.Option(help=QUESTIONS["liquid"][0])] = None,
    mass: Annotated[str | None, typer.Option(help=QUESTIONS["mass"][0])] = None,
    friction: Annotated[str | None, typer.Option(help=QUESTIONS["friction"][0])] = None,
    tray: Annotated[str | None, typer.Option(help=QUESTIONS["tray"][0])] = None,
    arm: Annotated[str | None, typer.Option(help=QUESTIONS["arm"][0])] = None,
    path: Annotated[str | None, typer.Option(help=QUESTIONS["path"][0])] = None,
    obstacles: Annotated[str | None, typer.Option(help=QUESTIONS["obstacles"][0])] = None,
    json: Json = False,
) -> None:
    """Write a new scenario, with comments, and plan its fastest safe motion once.

    It asks for what is not given by options. With load, mass, friction, arm and path it asks nothing.

    Example: `salver new bottle.toml --load "cylinder 0.03 0.24" --mass "0.4 20%"`

    Ends with 0 when that plan is safe, with 3 when none was found; the file is written in both cases.
    """
    if file.suffix != ".toml":
        raise ScenarioError(f"{file} does not end in .toml; a scenario is a .toml file.")
    if file.exists():
        raise ScenarioError(f"{file} exists already; choose another name, or remove it.")
    from salver.run_directory import check_writable

    check_writable(file.parent, "name a file elsewhere")  # before anything is asked
    given = {"load": load, "liquid": liquid, "mass": mass, "friction": friction, "tray": tray, "arm": arm}
    given |= {"path": path, "obstacles": obstacles}
    asking = any(given[key] is None for key in QUESTIONS if key not in MAY_BE_LEFT_OUT)
    answers: dict[str, Any] = {}
    for key, (question, default) in QUESTIONS.items():
        default = _proposed(key, default, answers)
        word = default if given[key] is None and not asking else given[key]
        answers[key] = _answer(key, question, default, word)

    import tomllib

    from salver import scenario as scenarios
    from salver.files import write_atomic
    from salver.planning.make import make_plan

    text = written(file.stem, **answers)
    scenarios.parse(tomllib.loads(text), str(file))  # raises before the file is written
    write_atomic(file, text)
    name, runs = quote(str(file)), quote(f"runs/{file.stem}")
    helps = (
        f"What often helps: start and goal higher or further from the arm's base, or a smaller tray ([tray] size), in "
        f"{file}; then salver plan {name}. For this arm a way well within reach is {_in_reach(*answers['arm'])}."
    )
    if not json:
        say(f"Written: {file}. Planning it once ...")
    try:
        plan = make_plan(scenarios.load(file), "fastest")
    except UnreachableError as error:
        raise UnreachableError(f"{error} {helps}") from None
    if json:
        print_json({"file": file, "ok": plan.ok, "duration": plan.duration, "status": plan.status.sentence})
    else:
        result_console().print(plan.status.sentence, markup=False)
        if plan.arm_status is not None:
            result_console().print(plan.arm_status.sentence, markup=False)
        say(
            f"Next: salver plan {name} -o {runs}, then salver simulate and salver report of that directory."
            if plan.ok
            else helps
        )
    if not plan.ok:
        raise typer.Exit(ExitCode.NO_SAFE_PLAN)


def usual(name: str) -> str:
    """The text of a scenario with the proposed answer to every question."""
    answers: dict[str, Any] = {}
    for key, (_, default) in QUESTIONS.items():
        answers[key] = READERS[key](_proposed(key, default, answers))
    return written(name, **answers)


def _proposed(key: str, default: str, answers: dict[str, Any]) -> str:
    """The proposed answer to a question, given the answers before it."""
    if key == "path":
        return _in_reach(*answers["arm"])
    return _room_for(answers["load"]) if key == "tray" else default


def _answer(key: str, question: str, default: str, given: str | None) -> Any:
    """The answer to a question, from an option or asked until it can be parsed."""
    read = READERS[key]
    if given is not None:
        try:
            return read(given)
        except ScenarioError as error:
            raise ScenarioError(f"--{key}: {error}") from None
    while True:
        try:
            return read(typer.prompt(question, default=default, err=True))
        except SalverError as error:
            say(str(error))


def _numbers(words: list[str], what: str, count: int) -> list[float]:
    values = numbers(" ".join(words))
    if len(values) != count:
        raise ScenarioError(f'"{" ".join(words)}" is not {what}; it must be {count} numbers, separated by spaces.')
    return values


Load = tuple[str, list[float]]  # kind, and length, width and height of a box, or radius, or radii, and height


def _load(text: str) -> Load:
    kind, *words = text.split() or [""]
    known = {"box": ("the size of a box", 3), "cylinder": ("the radius and height of a cylinder", 2)}
    known["cone"] = "the radius, the radius at the top and the height of a cone", 3
    if kind not in known:
        wanted = "box LENGTH WIDTH HEIGHT, cylinder RADIUS HEIGHT, or cone RADIUS TOP_RADIUS HEIGHT, in metres"
        raise ScenarioError(f'"{text}" is not a load; write {wanted}.')
    return kind, _numbers(words, *known[kind])


def _room_for(load: Load) -> str:
    """A tray with 2 cm around a load, at least of the usual size."""
    kind, size = load
    length, width = size[:2] if kind == "box" else 2 * [2 * max(size[:-1])]
    return f"{max(0.25, length + 0.04):g} {max(0.25, width + 0.04):g}"


def _liquid(text: str) -> tuple[str, float, str] | None:
    """Kind of liquid, fill height, and range of the fill height; None for "none"."""
    kind, _, rest = text.strip().partition(" ")
    if kind in ("none", ""):
        return None
    from salver.dynamics.liquid.liquid import FLUIDS

    if kind not in FLUIDS:
        raise ScenarioError(f'"{kind}" is not a liquid; write {", ".join(FLUIDS)} or none.')
    return kind, *_value_and_range(rest, "0.06 10%")


def _obstacles(text: str) -> list[str]:
    """For each obstacle, the body of its table in the scenario."""
    if text.strip() in ("none", ""):
        return []
    found = []
    for one in text.split(";"):
        what, at, place = one.partition(" at ")
        kind, *words = what.split() or [""]
        if not at or kind not in ("box", "sphere"):
            raise ScenarioError(f'"{one.strip()}" is not an obstacle; write box LENGTH WIDTH HEIGHT at x y z, or none.')
        size = (
            f"size = {_numbers(words, 'the size of a box', 3)}"
            if kind == "box"
            else (f"radius = {_numbers(words, 'the radius of a sphere', 1)[0]}")
        )
        found.append(f'type = "{kind}"\n{size}\nposition = {_numbers(place.split(), "a position", 3)}')
    return found


def _value_and_range(text: str, example: str = "0.4 20%") -> tuple[float, str]:
    words = text.replace("+-", " ").replace("±", " ").split()
    if len(words) != 2 or not words[1].endswith("%"):
        raise ScenarioError(f'"{text}" must be a number and a percentage, as in "{example}".')
    return _numbers(words[:1], "a number", 1)[0], words[1]


def _arm(text: str) -> tuple[str, str | None]:
    words = text.split()
    urdf = bool(words) and words[0].endswith((".urdf", ".xml"))
    if len(words) != 1 + urdf:
        wanted = "write its name, or a URDF file and the link that carries the tray"
        raise ScenarioError(f'"{text}" is not an arm; {wanted}.')
    chosen = (str(Path(words[0]).resolve()), words[1]) if urdf else (words[0], None)
    _loaded(*chosen)
    return chosen


def _loaded(model: str, flange: str | None) -> ArmModel:
    """Load the arm. Raises ScenarioError when the arm or the link does not exist."""
    from salver.models.arm.arm import load_arm
    from salver.scenario import Arm, Tray

    return load_arm(Arm(model=model, flange=flange), Tray())


def _in_reach(model: str, flange: str | None) -> str:
    """A path across in front of the arm, at a comfortable share of the lengths of its links."""
    joints = _loaded(model, flange).pin_model.jointPlacements.tolist()[2:]
    length = sum(float(sum(x * x for x in joint.translation)) ** 0.5 for joint in joints)
    x, y, z = (round(share * length, 2) for share in (0.55, 0.28, 0.45))
    return f"{x:g} {-y:g} {z:g} to {x:g} {y:g} {z:g}"


def _path(text: str) -> tuple[list[float], list[float]]:
    start, to, goal = text.replace(",", " ").partition(" to ")
    if not to:
        raise ScenarioError(f'"{text}" is not a path; write x y z to x y z, in metres.')
    return _numbers(start.split(), "a position", 3), _numbers(goal.split(), "a position", 3)


READERS: dict[str, Callable[[str], Any]] = {
    "load": _load,
    "liquid": _liquid,
    "mass": _value_and_range,
    "friction": _value_and_range,
    "tray": lambda text: _numbers(text.split(), "length and width of a tray", 2),
    "arm": _arm,
    "path": _path,
    "obstacles": _obstacles,
}


def written(
    name: str,
    load: Load,
    liquid: tuple[str, float, str] | None,
    mass: tuple[float, str],
    friction: tuple[float, str],
    tray: list[float],
    arm: tuple[str, str | None],
    path: tuple[list[float], list[float]],
    obstacles: list[str],
    wall: float = 0.003,
) -> str:
    """The text of a scenario file, with comments on the keys that users often change.

    wall: m, thickness of a container's wall and bottom that is assumed; the file says so.
    """
    model, flange = (_quoted(word) if word is not None else None for word in arm)
    carrier = f"flange = {flange}          # the link that carries the tray" if flange else ""
    kind, size = load
    box, radii, height = kind == "box", size[:-1], size[-1]
    shape = f"size = {size}" if box else f"{', '.join(_radii(radii, 'top_radius'))}, height = {height}"
    contents, fill = "", ""
    if liquid is not None:
        if kind == "cone":
            radii = [radii[0] + (radii[1] - radii[0]) * wall / height, radii[1]]  # the first at the bottom inside
        inside = [round(x - (2 if box else 1) * wall, 6) for x in radii]
        within = f"size = {inside}" if box else "\n".join(_radii(inside, "brim_radius"))
        contents = f"""
[objects.liquid]                # walls and bottom of {1e3 * wall:g} mm are assumed: measure yours
kind = {_quoted(liquid[0])}
{within}
fill = {liquid[1]}              # heights over the bottom inside
brim = {round(height - wall, 6)}
"""
        fill = f"\nfill = {_quoted(liquid[2])}"
    return (
        f"""\
# A scenario for salver. Lengths in metres, masses in kilograms, times in seconds. Every key: docs/scenario-file.md
name = {_quoted("".join(c if c.isalnum() or c in "._-" else "-" for c in name))}
summary = "Written by salver new"

[motion]                        # from rest to rest; poses of the object's centre of mass
start.position = {path[0]}
goal.position = {path[1]}
orientation = "free"            # the tray may tilt on the way; "fixed" keeps it level
goal_yaw = "free"               # any heading at the goal
# duration = 1.5                # leave it out for the shortest safe one

[[objects]]
name = "load"
shape = {{ type = {_quoted(kind)}, {shape} }}
mass = {mass[0]}
friction = {friction[0]}
# com = [0.0, 0.0, 0.0]         # centre of mass, from the middle of the shape
{contents}
[objects.uncertainty]           # half-ranges: the plan is safe for everything within them
mass = {_quoted(mass[1])}
friction = {_quoted(friction[1])}{fill}
com = [0.003, 0.003, 0.005]     # it is hardly known better without measuring
# position = [0.003, 0.003]     # accuracy of its position on the tray

[contact]
condition = "exact"             # "paper" for the sufficient condition of the paper

[tray]
size = {tray}
mass = 0.2                      # weigh yours

[arm]
model = {model}
{carrier}
""".rstrip()
        + "\n"
        + "".join(f"\n[[obstacles]]                   # regions to keep out of\n{one}\n" for one in obstacles)
    )


def _radii(radii: list[float], upper: str) -> list[str]:
    return [f"{key} = {value}" for key, value in zip(("radius", upper), radii, strict=False)]


def _quoted(text: str) -> str:
    import json

    return json.dumps(text, ensure_ascii=False)
