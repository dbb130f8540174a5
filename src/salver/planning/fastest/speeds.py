"""Motions that are safe at every speed factor from 0 to 1: factors at which one fails are added to its problem."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from salver.contact_margins.time_scaling import TRIED
from salver.models.tray_motion import Speed
from salver.planning.trajopt.constraints.constraints import ContactConstraint, evaluate, worst_of

if TYPE_CHECKING:
    from salver.planning.plan import Plan
    from salver.planning.trajopt.problem import TransportProblem

Found = TypeVar("Found", bound=Any)  # a motion with its `problem`, as `joint_motion()`


def at_every_speed(found: Found, plan: Plan, again: Callable[[Found], tuple[Found, Plan]]) -> tuple[Found, Plan]:
    """A motion and its plan, searched for again until safe at every speed factor, if the scenario asks for that.

    The tray's motion regressor is linear in the square of the factor. Load dynamics and the arm's tracking error have
    their own time scales, so the factors at which they fail are added to those at which the motion must be safe.

    found, plan: the motion and its plan. again: returns a motion and its plan, from one that was found with a problem
    that has more speed factors.
    """
    for _ in range(8):  # each round adds a factor
        lacking = _lacking(found, plan) if plan.status.ok and plan.scenario.motion.speeds == "any" else ()
        if not lacking:
            break
        found, plan = again(replace(found, problem=_with(found.problem, lacking)))
    return found, plan


def _with(problem: TransportProblem, lacking: tuple[Speed, ...]) -> TransportProblem:
    """The problem at more speeds; where it names all of these already, at more nodes: the check looks at more."""
    new = tuple(speed for speed in lacking if speed not in problem.speeds)
    if new:
        return replace(problem, speeds=(*problem.speeds, *new))
    return replace(problem, nodes=tuple(np.linspace(0.0, 1.0, 2 * max(len(problem.nodes), 100) + 1)))


def _lacking(found: Found, plan: Plan) -> tuple[Speed, ...]:
    """Speed factors at which a motion fails: with load dynamics those that its plan names; else, of a few factors,
    those at which it fails with the arm's tracking error."""
    problem = found.problem
    if problem.cases:
        # The steps between nodes are too long for load dynamics and tracking below the slowest factor that is tried:
        # there it stands for the load, and the weight alone for contact.
        slowest = float(TRIED[1])
        lacking = [
            (Speed(factor),) if factor > slowest else (Speed(0.0), Speed(slowest)) for factor in plan.lacking_speeds
        ]
        return tuple(speed for each in lacking for speed in each)
    joint = found.joint_motion()
    t = np.linspace(0.0, joint.duration, 401)
    motion = problem.at(t / t[-1], np.stack([*joint.sample(t), joint.jerk(t)]), joint.duration, imposed=False)
    rates = {speed.rate for speed in problem.speeds}
    factors = (0.2, 0.4, 0.6, 0.7, 0.8, 0.9, 0.95)  # closer where the square of the factor changes most
    between = [Speed(factor, rate) for factor in factors for rate in sorted(rates)]

    def fails(speed: Speed) -> bool:
        contacts = [ContactConstraint(rows, plan.scenario.contact.margin, speed) for rows in problem.contacts]
        return worst_of(evaluate(contacts, motion, margins=False))[0] > 0

    return tuple(speed for speed in between if speed not in problem.speeds and fails(speed))
