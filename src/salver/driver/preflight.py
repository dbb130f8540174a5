"""What must hold before an arm moves: each check is a sentence, whether it passes or not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from salver.driver.franka_limits import FR3, velocity_range
from salver.errors import SalverError
from salver.geometry import Array
from salver.planning.follow.limits import verdict

if TYPE_CHECKING:
    from collections.abc import Sequence

    from salver.control.arm import ArmState
    from salver.models.arm import ArmModel
    from salver.models.arm_limits import JointLimits
    from salver.models.bodies import Body
    from salver.planning.plan import Plan

START_TOLERANCE = 0.01  # rad of each joint
REST_TOLERANCE = 0.01  # rad/s
FRANKA_PERIOD = 1e-3  # s


@dataclass(frozen=True)
class Check:
    name: str
    ok: bool
    sentence: str


def check_plan(plan: Plan, arm: ArmModel, bodies: Sequence[Body]) -> list[Check]:
    """What can be checked without the robot. The plan must have a joint motion."""
    assert plan.joint is not None
    limits = verdict(arm, plan.joint, bodies)
    compared = plan.method == "baseline"  # runs beside a plan, to be compared with it; may well be unsafe
    safe = plan.ok or compared
    _, dq, ddq = plan.joint.sample([0.0, plan.joint.duration])
    still = max(float(np.abs(dq).max()), float(np.abs(ddq).max()))
    return [
        Check("plan", safe, plan.verification.sentence if safe else f"The plan is not safe: {plan.status.sentence}"),
        Check("limits", limits.ok, limits.sentence),
        Check("rest", still < 1e-6, f"The motion starts and ends with a joint rate of {still:.1g} rad/s or rad/s^2."),
    ]


def check_franka(plan: Plan, arm: ArmModel) -> list[Check]:
    """What the Franka Research 3 asks for beyond the Panda, and what its interface cannot do."""
    assert plan.joint is not None
    t = np.linspace(0.0, plan.joint.duration, 2001)
    q, dq, ddq = plan.joint.sample(t)
    physics = plan.scenario.physics
    right_arm = plan.scenario.arm is not None and plan.scenario.arm.model == "panda"
    checks = [
        Check("arm", right_arm, f"The plan is for the arm {arm.name}; --robot franka drives a panda."),
        Check(
            "period",
            physics.command_period == FRANKA_PERIOD,
            f"physics.command_period is {physics.command_period:g} s; the arm wants a torque every "
            f"{FRANKA_PERIOD:g} s.",
        ),
        Check(
            "feedback",
            physics.feedback == "joints",
            f'physics.feedback is "{physics.feedback}"; without a live measurement of the object it must be "joints".',
        ),
    ]
    return checks + (_within(FR3, arm, t, q, dq, ddq, plan) if right_arm else [])


def _within(limits: JointLimits, arm: ArmModel, t: Array, q: Array, dq: Array, ddq: Array, plan: Plan) -> list[Check]:
    low, high = velocity_range(q)
    assert plan.joint is not None
    shares = limits.shares({"position": q, "velocity": dq, "acceleration": ddq, "jerk": plan.joint.jerk(t)})
    # Here the velocity allowed depends on the position.
    shares["velocity"] = np.where(dq > 0, dq / np.maximum(high, 1e-9), dq / np.minimum(low, -1e-9))
    made = []
    for kind, share in shares.items():
        share = np.abs(share)
        k, j = np.unravel_index(int(np.argmax(share)), share.shape)
        made.append(
            Check(
                f"FR3 {kind}",
                bool(share[k, j] <= 1.0),
                f"{arm.joint_names[j]} uses {100 * share[k, j]:.0f} % of the Franka Research 3's {kind} limit "
                f"at t = {t[k]:.2f} s.",
            )
        )
    return made


def check_posture(plan: Plan, arm: ArmModel, state: ArmState) -> list[Check]:
    """Whether the arm stands at the start of the motion, at rest."""
    assert plan.joint is not None
    start = plan.joint.sample(0.0)[0][0]
    error = np.abs(state.q - start)
    j, k = int(np.argmax(error)), int(np.argmax(np.abs(state.dq)))
    return [
        Check(
            "start posture",
            bool(error[j] <= START_TOLERANCE),
            f"{arm.joint_names[j]} is at {state.q[j]:.4f} rad, the motion starts at {start[j]:.4f} rad; "
            f"{START_TOLERANCE:g} rad apart are allowed (--move-to-start takes the arm there, slowly).",
        ),
        Check(
            "at rest",
            bool(abs(state.dq[k]) <= REST_TOLERANCE),
            f"{arm.joint_names[k]} turns at {state.dq[k]:.4f} rad/s; {REST_TOLERANCE:g} rad/s are allowed.",
        ),
    ]


def demand(checks: Sequence[Check]) -> None:
    """Raise SalverError with the sentences of what failed."""
    failed = [check.sentence for check in checks if not check.ok]
    if failed:
        raise SalverError("Not moved. " + " ".join(failed))
