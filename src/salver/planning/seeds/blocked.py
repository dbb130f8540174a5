"""Reasons why an end of the motion is impossible: the load falls even at rest, the pose is out of reach, the tray is
inside an obstacle, or every posture that was found has a collision."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from salver.errors import Status
from salver.geometry import GRAVITY_S, Array
from salver.models.arm.arm_geometry import ArmGeometry
from salver.models.described import Floor, Wall
from salver.models.tray_motion import N_MOTION
from salver.models.uncertain.worst_case import WorstCase
from salver.planning.follow.limits import COLLISION, blocked_end
from salver.planning.postures import REACHED, START_DISTANCE, PoseTarget, posture_at
from salver.planning.seeds.starts import Ends, fine, guess, room, slid_free
from salver.planning.trajopt.ends import AtPose, AtPosture, End
from salver.planning.trajopt.problem import TransportProblem

HEADINGS = 36  # tried at an end with free heading


def why_blocked(problem: TransportProblem) -> Status | None:
    """Why an end is impossible whatever the arm's posture (load or obstacle), or because the given start posture has a
    collision; None if neither holds."""
    falling = _falling(problem)
    if falling is not None or problem.keep_out is None:
        return falling
    parts = problem.keep_out.parts
    return blocked_at(parts, "start", problem.start) or blocked_at(parts, "goal", problem.goal)


def blocked_at(parts: ArmGeometry, name: str, end: End) -> Status | None:
    """Why the arm cannot be at an end of the motion: the tray whatever its posture, or the arm in the given posture;
    None if it can."""
    found = None
    if isinstance(end, AtPose):
        headings = end.target.headings(HEADINGS)
        whatever = f" whichever way it points (at {len(headings)} headings)" if end.target.yaw_free else ""
        for turned in headings:
            found = blocked_end(parts, {name: turned.tray_pose}, whatever)
            if found is None:
                break
    if isinstance(end, AtPosture) and (touch := parts.first_touch(end.q[None])):
        where = " (surroundings.floor says where it is)" if touch.second == Floor.name else ""
        says = f"{touch.first} and {touch.second} touch{where}"
        if touch.second == Wall.name:
            says = f"{touch.first} is not inside the {Wall.name}"
        found = Status(COLLISION, f"In the {name} posture {says}.", False)
    return found


def _falling(problem: TransportProblem) -> Status | None:
    """Why the load falls at an end even at rest; None if it does not."""
    for name, end in (("start", problem.start), ("goal", problem.goal)):
        if isinstance(end, AtPose):
            R_SE = end.target.tray_pose[1]
        elif isinstance(end, AtPosture) and not end.moving:
            R_SE = problem.arm.tray_pose(end.q)[1]
        else:
            continue
        still = np.append(-GRAVITY_S @ R_SE, np.zeros(N_MOTION - 3))[None]
        for rows in problem.contacts:
            lacking = float(WorstCase.of(rows, still).values.max()) + problem.scenario.contact.margin
            if lacking > 0:
                carried = " and ".join(body.name for body in rows.network.bodies)
                told = f"At the {name} {carried} cannot stay even at rest: in the worst case contact lacks "
                return Status("falls", f"{told}{100 * lacking:.3g} % of the weight.", False)
    return None


def why_unreached(problem: TransportProblem) -> Status:
    """Status that names the end that no posture reaches, the error of the nearest posture, and another heading that can
    be reached, if there is one; or the end that no posture reaches without a collision."""
    told = "No posture within the joint limits was found at the goal that goes with one at the start."
    for name, end in (("start", problem.start), ("goal", problem.goal)):
        if not isinstance(end, AtPose):
            continue
        found = list(_sought(problem, end.target))
        reached = [q for q, missed in found if missed < REACHED]
        if reached:
            touching = _touching(problem, name, np.stack(reached))
            if touching is not None:
                return touching
            continue
        q, _ = min(found, key=_missed)
        error = end.target.residual(problem.arm, q)[0]
        distance, turn = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
        mm = np.format_float_positional(1e3 * distance, 4, fractional=False, trim="-")
        by = f"{mm} mm and {np.rad2deg(turn):.3g} deg"
        told = f"No posture within the joint limits reaches the {name}: the nearest found misses it by {by}."
        if turn < REACHED < distance < START_DISTANCE:  # such as the height of a tray that nothing lifts
            told += f" Position {np.round(end.target.p_SB - error[:3], 12).tolist()} is reached."
        q, missed = min(_sought(problem, replace(end.target, yaw_free=True)), key=_missed)
        if missed < REACHED and not end.target.yaw_free:
            turn = np.rad2deg(end.target.residual(problem.arm, q)[0][5])
            told += f" Turned by {-turn:.0f} deg about its vertical it is reached."
        break
    return Status("unreachable", told, False)


def _sought(problem: TransportProblem, target: PoseTarget) -> Iterator[tuple[Array, float]]:
    """Postures from many guesses, each with its pose error (m, rad): enough of them to call the target out of reach."""
    rng = np.random.default_rng(0)
    for attempt in range(48):
        yield posture_at(problem.arm, target, guess(problem, rng, attempt), limits=problem.limits)


def _missed(found: tuple[Array, float]) -> float:
    return found[1]


def why_touching(problem: TransportProblem, pairs: list[Ends]) -> Status | None:
    """Status that names the least overlap among all pairs of end postures, at an end that is free in none of them; None
    if one pair is free."""
    if any(pair.free for pair in pairs):
        return None
    assert problem.keep_out is not None
    left = np.array([[room(problem, pair.start), room(problem, pair.goal)] for pair in pairs])
    blocked = left.max(axis=0) <= 0.0
    left = np.where(blocked | ~blocked.any(), left, np.inf)
    best = int(left.min(axis=1).argmax())
    end = int(left[best].argmin())
    return _touching(problem, ("start", "goal")[end], np.stack([pairs[best].start, pairs[best].goal])[end : end + 1])


def _touching(problem: TransportProblem, where: str, postures: Array) -> Status | None:
    """Status that names what touches in the best of postures (N, n) at an end; None if nothing does in one of them."""
    if problem.keep_out is None:
        return None
    left = [room(problem, q) for q in postures]
    if max(left) > 0.0:
        return None
    best = _nearest(problem, postures[int(np.argmax(left))], "in the best")
    told = f"No posture was found at the {where} in which nothing touches: {best}{_higher(problem, where)}."
    return Status(COLLISION, told, False)


def _nearest(problem: TransportProblem, q: Array, where: str) -> str:
    """In words, the two parts that come nearest to each other in a posture (n,) that is not free. where: "in ..."."""
    assert problem.keep_out is not None
    parts = problem.keep_out.parts
    distance = parts.clearance(q[None])[0]
    first, second = (parts.names[k] for k in parts.pairs[int(distance.argmin())])
    near = float(distance.min())
    strays = 1e3 * (near - room(problem, q))
    apart = f"are {1e3 * near:.2g} mm apart {where}, where the arm strays by {strays:.2g} mm"
    return f"{first} and {second} {apart if near > 0.0 else f'touch {where}'}"


def why_roundabout(problem: TransportProblem, pair: Ends) -> str:
    """A sentence that says what touches in a goal posture that is nearer to the start posture than the goal posture of
    a pair, if the joints take far longer between the two than friction requires; "" if nothing does."""
    near = None if fine(problem, pair) else problem.goal.nearest(problem.arm, problem.limits, pair.start)
    near = None if near is None else slid_free(problem, problem.goal, near)
    if near is None or problem.keep_out is None or room(problem, near) > 0.0:
        return ""
    told = _nearest(problem, near, "in the goal posture that is nearest to the start's")
    return f" The motions that were tried end in another posture, since {told}."


def _higher(problem: TransportProblem, where: str) -> str:
    """In words, how much higher the end must be for a posture without collision; tried in steps of 5 cm up to 0.5 m."""
    end = problem.start if where == "start" else problem.goal
    if not isinstance(end, AtPose) or problem.keep_out is None:
        return ""
    for rise in np.linspace(0.05, 0.5, 10):
        raised = replace(end.target, p_SB=end.target.p_SB + np.array([0.0, 0.0, rise]))
        for q, missed in _sought(problem, raised):
            if missed < REACHED and room(problem, q) > 0.0:
                return f"; {rise:.2g} m higher one was found"
    return ""
