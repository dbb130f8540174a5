"""A quick look at a scenario, in milliseconds: its picture, blocked ends, and the straight line's margin."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import asdict
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from salver.contact_margins import margin_model
from salver.contact_margins.time_scaling import TimeScaled
from salver.errors import SalverError, ScenarioError
from salver.geometry import Array, invert
from salver.models.arm.arm import load_arm
from salver.models.arm.arm_geometry import arm_geometry
from salver.planning.fastest import TransportProblem, transport_problem
from salver.planning.follow.limits import unchecked
from salver.planning.postures import REACHED, posture_at
from salver.planning.seeds.blocked import why_blocked, why_touching, why_unreached
from salver.planning.seeds.starts import ends, guess, standing_at
from salver.planning.trajopt.ends import AtPose, End
from salver.reports.pages.meshes import link_meshes, pack
from salver.reports.pages.replay import IDENTITY, joint_poses, stage, still, viewpoint
from salver.reports.style import BLUE, VERMILION
from salver.scenario import Arm, Scenario
from salver.scenario.warnings import warnings_of
from salver.studio.parts import parts, poses
from salver.studio.text import Key, Mistake, changed, checked, mistakes
from salver.studio.words import looked, mistaken
from salver.trajectory import min_jerk_line

Look = dict[str, Any]


def look(
    text: str,
    folder: Path,
    near: Sequence[float] | None = None,
    arm_drawn: str = "",
    leg: int = 0,
    coarse: bool = False,
) -> Look:
    """All that the page shows of a text, ready for JSON: its mistakes, or its picture, parts, warnings and margins.

    near: the posture that was shown last, from which the arm follows. arm_drawn: the arm whose links the page has. leg:
    which one of several is shown, 0 for the first. coarse: draw links with few triangles, for a page that draws without
    a graphics card.
    """
    scenario = checked(text, folder)
    if isinstance(scenario, list):
        return _mistaken(text, scenario)
    try:
        leg = min(max(leg, 0), len(scenario.each_leg) - 1)
        task = scenario.each_leg[leg]
        shown = {
            "text": text,
            "mistakes": [],
            "legs": [len(scenario.legs), leg],
            "parts": parts(scenario, leg),
            "line": _straight_line(task),
            **_drawn(task, near, arm_drawn, coarse),
        }
        return {**shown, "verdict": looked(scenario, shown["blocked"], shown["unchecked"], warnings_of(scenario))}
    except SalverError as error:
        return _mistaken(text, mistakes(error, text, scenario.name))


def _mistaken(text: str, found: Sequence[Mistake]) -> Look:
    return {"text": text, "mistakes": [asdict(one) for one in found], "verdict": mistaken(found)}


def change(text: str, folder: Path, changes: Sequence[tuple[Key, Any]]) -> str:
    """The text with the changes and their consequences: assumed ranges are written into the text before one of them is
    changed, and a start posture follows the start pose, or is left out where no posture reaches it.

    The key ["tray", "flange"], the place (3,) of the flange in the tray's frame, m, changes offset and height."""
    before = checked(text, folder)
    try:
        first = [] if isinstance(before, list) else _first(before, tomllib.loads(text), changes)
        changes = [each for one in changes for each in _placed(before, *one)]
    except (LookupError, TypeError, ValueError) as error:
        raise ScenarioError(f"There is no such change ({error}).") from None
    after = changed(text, [*first, *changes])
    scenario = checked(after, folder)
    if isinstance(scenario, Scenario) and scenario.arm is not None and scenario.arm.start_posture is not None:
        q = _followed(scenario, scenario.arm)
        if q is None or not np.array_equal(q, scenario.arm.start_posture):
            after = changed(after, [(["arm", "start_posture"], None if q is None else np.round(q, 6).tolist())])
    return after


def _first(before: Scenario, data: dict[str, Any], changes: Sequence[tuple[Key, Any]]) -> list[tuple[Key, Any]]:
    """What changes with them: ranges that were assumed, and start and goal with the first object."""
    found: list[tuple[Key, Any]] = []
    for key, value in changes:
        match list(key):
            case ["objects", 0, "at"]:
                moved = np.where(before.bodies[0].pushed, 0.0, np.subtract(value, before.objects[0].at))
                found += _tray_stays(before, np.append(moved, 0.0))
            case ["objects", 0] if value is None:
                found += _tray_stays(before, before.bodies[1].p_EB - before.bodies[0].p_EB)
            case ["objects", int(k), "uncertainty", *_] if "uncertainty" not in data["objects"][k]:
                assumed = before.objects[k].uncertainty.model_dump(mode="json", exclude_defaults=True)
                found += [(["objects", k, "uncertainty", name], _written(half)) for name, half in assumed.items()]
    return found


def _placed(before: Scenario | list[Mistake], key: Key, value: Any) -> list[tuple[Key, Any]]:
    """A change as changes of keys that the text has."""
    if list(key) != ["tray", "flange"]:
        return [(key, value)]
    if isinstance(before, list):
        raise ValueError("the text has mistakes")
    x, y, z = np.round(-before.tray.R_FE @ np.array(value, dtype=float), 6).tolist()
    return [(["tray", "offset"], [x, y]), (["tray", "height"], z)]


def _tray_stays(before: Scenario, moved_E: Array) -> list[tuple[Key, Any]]:
    """Start and goal are places of the first object: moved on the tray with it, they leave the tray where it is."""
    found: list[tuple[Key, Any]] = []
    for _, key, pose in poses(before):
        place = pose.position + pose.rotation @ before.bodies[0].R_EB.T @ moved_E
        found.append(([*key, "position"], np.round(place, 6).tolist()))
    return found


def _written(half: Any) -> Any:
    return f"{round(100 * half['relative'], 6):g}%" if isinstance(half, dict) else half


def _followed(scenario: Scenario, arm: Arm) -> Array | None:
    """The posture nearest to the start posture that was given, in which the start is met, or None."""
    given, start, first = np.array(arm.start_posture, dtype=float), scenario.motion.start, scenario.bodies[0]
    try:
        model = scenario.load_arm()
        if len(given) != model.n:
            return None
        p, R = model.object_pose(given, first.p_EB, first.R_EB)
        if np.allclose(p, start.position, rtol=0, atol=1e-5) and np.allclose(R, start.rotation, rtol=0, atol=1e-5):
            return given
        problem = transport_problem(scenario.with_changes(arm__start_posture=None, motion__duration=None), passing=True)
    except SalverError:
        return None
    assert isinstance(problem.start, AtPose)
    q, size = posture_at(problem.arm, problem.start.target, given, limits=problem.limits)
    return q if size < REACHED else None


def _straight_line(scenario: Scenario) -> Look | None:
    """The straight min-jerk line of the load, whatever the arm can: the shortest time in which it holds in the worst
    case, and its margin over durations; None for a load that stays."""
    motion = scenario.motion
    if motion.start.same_as(motion.goal):
        return None
    ends = (
        np.array(motion.start.position),
        np.array(motion.goal.position),
        motion.start.rotation,
        motion.goal.rotation,
    )
    first = scenario.payload.first
    line = min_jerk_line(1.0, *ends).sample(np.linspace(0.0, 1.0, 121)).of_frame(*invert(first.p_EB, first.R_EB))
    scaled = TimeScaled(margin_model(scenario), line, worst=True)
    durations = np.geomspace(
        0.3, 6.0, 13 if scenario.payload.dynamic else 25
    )  # s; what moves inside takes 20 ms for each
    margin = np.array([scaled.slack(1.0 / t) for t in durations])
    found = _shortest(scaled, durations, margin)
    sentence = "A straight line of the load does not hold" + (
        f" in {durations[-1]:g} s or less." if found is None else f" below {found:.3g} s."
    )
    if motion.duration is not None:
        left = 100 * scaled.slack(1.0 / motion.duration)
        sentence += f" In {motion.duration:g} s it " + (
            f"leaves {left:.3g} %." if left >= 0 else f"lacks {-left:.3g} %."
        )
    return {
        "sentence": sentence,
        "shortest": found,
        "t": np.round(durations, 4).tolist(),
        "margin": np.round(100 * margin, 3).tolist(),
    }


def _shortest(scaled: TimeScaled, durations: Array, margin: Array) -> float | None:
    """The shortest duration, s, to 1 ms, from which all that were tried hold; None for none."""
    if margin[-1] < 0:
        return None
    failing = np.flatnonzero(margin < 0)
    if not len(failing):
        return float(durations[0])
    low, high = durations[failing[-1]], durations[failing[-1] + 1]
    while high - low > 1e-3:
        middle = 0.5 * (low + high)
        low, high = (low, middle) if scaled.slack(1.0 / middle) >= 0 else (middle, high)
    return float(high)


@lru_cache(maxsize=4)
def _links(arm: str, coarse: bool) -> list[Look]:
    """Links of an arm, given as JSON, for the viewer: half a second."""
    model = load_arm(Arm.model_validate_json(arm), Scenario.model_fields["tray"].default)
    return [pack(mesh) for mesh in (link_meshes(model, 600) if coarse else link_meshes(model))]


def _drawn(task: Scenario, near: Sequence[float] | None, arm_drawn: str, coarse: bool) -> Look:
    """The scene at start and goal, what touches there, and the sentence of what is blocked, "" for nothing."""
    bodies, ends = task.payload.bodies, (task.motion.start, task.motion.goal)
    line = [list(pose.position) for pose in ends]
    red: list[list[str]] = [[], []]
    arm, name = (task.load_arm(), task.arm.model_dump_json()) if task.arm else (None, "")
    scene: Look = stage(task, bodies, arm, _links(name, coarse) if name else [])
    if arm is None:
        first = task.payload.first
        turns = [pose.rotation @ first.R_EB.T for pose in ends]
        trays = [(np.array(p) - R_SE @ first.p_EB, R_SE) for p, R_SE in zip(line, turns, strict=True)]
        joints = np.tile(IDENTITY, (2, 1, 1))
        found: Look = {"blocked": "", "unchecked": [], "posture": None, "arm": name}
        reach = np.zeros((0, 3))
    else:
        problem = transport_problem(task.with_changes(motion__duration=None), passing=True)
        postures, blocked = _postures(problem, near)
        trays = [arm.tray_pose(q) for q in postures]
        joints = joint_poses(np.stack(postures), arm)
        shapes = problem.keep_out.parts if problem.keep_out else arm_geometry(arm, bodies, task.around)
        found = {"blocked": blocked, "unchecked": unchecked(arm, shapes), "posture": postures[0].tolist(), "arm": name}
        reach = np.vstack([arm.base_position, joints[:, :, :3].reshape(-1, 3)])
        red = [_touching(problem, q) for q in postures]
    scene["variants"] = [
        {**still(key, colour, bodies, tray, q, line), "red": touching}
        for key, colour, tray, q, touching in zip(("start", "goal"), (BLUE, VERMILION), trays, joints, red, strict=True)
    ]
    if found["arm"] == arm_drawn and arm_drawn:  # the page keeps the links, and looks from where it did
        del scene["meshes"]
    else:
        scene |= viewpoint([np.array(line)], reach, task)
    return {"scene": scene, **found}


def _postures(problem: TransportProblem, near: Sequence[float] | None) -> tuple[list[Array], str]:
    """At start and goal, and why no motion can lead from one to the other, "" where nothing is known against it.

    Near those of the last picture where they do; else those that the planner would try first; out of reach, as near
    as the arm comes."""
    arm, limits = problem.arm, problem.limits
    falls = why_blocked(problem)
    rng = np.random.default_rng(0)
    last = guess(problem, rng, 0) if near is None or len(near) != problem.n else np.array(near)
    if falls is None and near is not None:
        start = problem.start.nearest(arm, limits, last)
        goal = None if start is None else problem.goal.nearest(arm, limits, start)
        if start is not None and goal is not None:
            touch = problem.keep_out and problem.keep_out.parts.first_touch(np.stack([start, goal]))
            if touch is None:
                return [start, goal], ""
    pairs = ends(problem, rng, few=1)
    why = falls or (why_touching(problem, pairs) if pairs else why_unreached(problem))
    if pairs:
        return [pairs[0].start, pairs[0].goal], why.sentence if why else ""
    return [_standing(problem, end, last) for end in (problem.start, problem.goal)], why.sentence if why else ""


def _standing(problem: TransportProblem, end: End, last: Array) -> Array:
    """A posture at an end that is looked at alone, in which nothing touches if one is at hand; out of reach, as near as
    the arm comes."""
    found = list(islice(standing_at(problem, end, np.random.default_rng(0)), 3))
    if not found and isinstance(end, AtPose):
        return posture_at(problem.arm, end.target, last, limits=problem.limits)[0]
    return min(found, key=lambda q: len(_touching(problem, q)))


def _touching(problem: TransportProblem, q: Array) -> list[str]:
    """Names of the parts that overlap another one in a posture."""
    if problem.keep_out is None:
        return []
    parts = problem.keep_out.parts
    overlap = np.flatnonzero(parts.clearance(q[None])[0] <= 0)
    return sorted({parts.names[i] for pair in overlap for i in parts.pairs[pair]})
