"""The joint motion that follows a motion of the object, and whether the arm can follow it.

The start posture is chosen among many (`salver.planning.postures`), the redundancy resolved for each
(`salver.planning.follow.redundancy`), and the best motion that keeps clear of itself and of obstacles is judged against
every limit (`salver.planning.follow.limits`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from salver.errors import ScenarioError, Status
from salver.geometry import Array
from salver.models.arm.arm import ArmModel, load_arm, with_load
from salver.models.arm.arm_geometry import ArmGeometry, arm_geometry
from salver.models.bodies import Body
from salver.models.described import Obstacle, Wall
from salver.planning.follow.limits import COLLISION, blocked_end, verdict
from salver.planning.follow.redundancy import Choice, TrayPath, first_choice, improved, solve_path, tray_path
from salver.planning.postures import PoseTarget, candidate_postures, postures_along, start_posture
from salver.scenario import Scenario
from salver.trajectory import JointMotion, Reference


def follow(
    arm: ArmModel,
    reference: Reference,
    p_EB: Array,
    R_EB: Array,
    *,
    bodies: Sequence[Body] = (),
    obstacles: Sequence[Obstacle | Wall] = (),
    q_start: Sequence[float] | Array | None = None,
    seed: int = 0,
) -> tuple[JointMotion | None, Status]:
    """The joint motion with which the object's frame B follows `reference`.

    arm: the arm. reference: motion of B in S. p_EB, R_EB: pose of B on the tray, m. bodies: all carried bodies; their
    weight counts in the torques and their shape in collisions. obstacles: in the world. q_start: (n,) start posture,
    rad; None to have it chosen. seed: of the choice of the start posture.

    Returns:
        The motion and a status: "within_limits"; "limit_exceeded" or "collision", with the joint or the parts, the time
        and the excess (the motion is returned all the same); or "unreachable", with None.

    Raises:
        ScenarioError: `q_start` is wrong (`salver.planning.postures.start_posture`).
    """
    path = tray_path(reference, p_EB, R_EB, np.linspace(0.0, reference.duration, 31))  # redundancy is smooth
    parts = arm_geometry(arm, bodies, obstacles)
    stuck = blocked_end(parts, {name: (path.p_SE[k], path.R_SE[k]) for name, k in (("start", 0), ("goal", -1))})
    if stuck is not None:
        return None, stuck
    begin = PoseTarget(path.p_SE[0], path.R_SE[0])
    starts = candidate_postures(arm, begin, seed) if q_start is None else [start_posture(arm, q_start, begin)]
    followed = [postures_along(arm, path.p_SE, path.R_SE, q) for q in starts]
    whole = [postures for postures, reached in followed if reached == len(path.t)]
    if not whole:
        return None, _unreachable(arm, path, max((reached for _, reached in followed), default=0))
    if q_start is None:
        whole = [postures for postures in whole if parts.first_touch(postures) is None] or whole

    fallback: tuple[JointMotion, Status] | None = None
    for choice in _choices(with_load(arm, bodies), parts, path, whole, q_start is None):
        motion = _sampled(arm, reference, p_EB, R_EB, path, choice)
        if motion is None:
            continue
        status = verdict(arm, motion, bodies, parts)
        if status.code != COLLISION:
            return motion, status
        fallback = fallback or (motion, status)
    return fallback or (None, _singular(arm))


def follow_scenario(
    scenario: Scenario,
    reference: Reference,
    arm: ArmModel | None = None,
    q_start: Sequence[float] | Array | None = None,
) -> tuple[JointMotion | None, Status]:
    """`follow` for the first object of a scenario, with all its objects as load and its start posture.

    scenario: with an arm. reference: motion of the first object's frame B. arm: the scenario's arm, if it is loaded
    already. q_start: (n,) start posture, rad, instead of the scenario's, if the joint limits allow it: a second motion
    can start where the first one does.

    Returns:
        As `follow`.

    Raises:
        ScenarioError: there is no arm, or the scenario's start posture is wrong.
    """
    if scenario.arm is None:
        raise ScenarioError(
            f"The scenario {scenario.name} has no arm; give it a table [arm] to follow a motion with one."
        )
    carried = scenario.payload.bodies
    arm = load_arm(scenario.arm, scenario.tray) if arm is None else arm
    if q_start is None or not np.all((arm.limits.q_min <= q_start) & (q_start <= arm.limits.q_max)):
        q_start = scenario.arm.start_posture
    return follow(
        arm,
        reference,
        carried[0].p_EB,
        carried[0].R_EB,
        bodies=carried,
        obstacles=scenario.around,
        q_start=q_start,
        seed=scenario.seed,
    )


def _choices(
    load: ArmModel, parts: ArmGeometry, path: TrayPath, whole: list[Array], free_start: bool
) -> Iterator[Choice]:
    """Choices of the redundant joint motion: the most promising ones, improved, best first."""
    choices = [choice for postures in whole if (choice := first_choice(load, parts, path, postures)) is not None]
    choices.sort(key=lambda choice: choice.cost)
    yield from sorted(
        (improved(load, parts, path, choice, free_start) for choice in choices[:2]), key=lambda choice: choice.cost
    )
    yield from choices


def _sampled(
    arm: ArmModel, reference: Reference, p_EB: Array, R_EB: Array, path: TrayPath, choice: Choice
) -> JointMotion | None:
    """The joint motion of a choice, sampled on a fine grid."""
    step = 5e-3  # s, and a sixtieth of the motion, at most; quintic in between
    count = max(2 * len(path.t), int(np.ceil(reference.duration / step)) + 1)
    fine = tray_path(reference, p_EB, R_EB, np.linspace(0.0, reference.duration, count))
    guess, _, _ = JointMotion(path.t, choice.path.q, choice.path.dq, choice.path.ddq).sample(fine.t)
    joints = solve_path(arm, fine, guess, choice.rows, choice.profile(fine.t))
    return None if joints is None else JointMotion(fine.t, joints.q, joints.dq, joints.ddq)


def _unreachable(arm: ArmModel, path: TrayPath, index: int) -> Status:
    p = np.round(path.p_SE[index], 3) + 0.0  # no "-0.000"
    where = f"({p[0]:.3f}, {p[1]:.3f}, {p[2]:.3f}) m"
    when = "where the motion starts" if index == 0 else f"which it should reach at t = {path.t[index]:.2f} s"
    distance = float(np.linalg.norm(path.p_SE[index] - arm.base_position))
    joints = "" if arm.n >= 6 else f", and {arm.n} joints do not turn and tilt a tray every way"
    return Status(
        "unreachable",
        f"{arm.name} cannot put its tray at {where}, {when}; that is {distance:.2f} m from its base{joints}: move the "
        "task or the base (arm.base_position), or choose another arm.",
        False,
        {"time": float(path.t[index]), "p_SE": path.p_SE[index].tolist(), "distance_from_base": distance},
    )


def _singular(arm: ArmModel) -> Status:
    return Status(
        "unreachable",
        f"{arm.name} passes a singular posture on the way and cannot follow the motion there; choose another "
        "arm.start_posture or move the task.",
        False,
    )
