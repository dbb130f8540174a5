"""The motion of a plan for motion files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from salver.errors import SalverError
from salver.files import versions
from salver.geometry import Array, interpolated, quat_wxyz_from_matrix
from salver.motion_files import MotionSeries
from salver.motion_files.samples import MOST_SAMPLES
from salver.planning.plan import Plan
from salver.planning.round import MultiLegPlan, load

PAUSE = 5.0  # s between two legs in a file, unless another is given


def read_motion(
    directory: str | Path, stem: str = "plan", rate: float | None = None, pause: float = PAUSE, still: float = 100.0
) -> MotionSeries:
    """The motion `stem` of a run directory, at its own instants or at `rate` samples per second; of a plan of several
    legs all of them, with the arm at rest for `pause` s between two.

    still: samples per second of a pause without a rate; an audit takes no recording with gaps of over 20 ms.
    Raises FileFormatError for a directory without such a plan, SalverError for a rate or a pause that cannot be.
    """
    if rate is not None and not 0 < rate <= 1e5:
        raise SalverError(
            f"A rate of {rate:g} samples per second was asked for; it must be above 0 and at most 100000."
        )
    if not 0 <= pause < np.inf:
        raise SalverError(f"A pause of {pause:g} s between two legs was asked for; it must be a number, 0 or more.")
    plan = load(directory, stem)
    legs = plan.legs if isinstance(plan, MultiLegPlan) else (plan,)
    count = (plan.duration + pause * (len(legs) - 1)) * (rate or still)
    if count > MOST_SAMPLES:
        raise SalverError(
            f"{rate or still:g} samples per second make {count:.2g} samples of this motion; at most {MOST_SAMPLES:.2g} "
            "are written."
        )
    parts = [_series(leg, rate) for leg in legs]
    motion = MotionSeries.in_turn(parts, pause, 1 / (rate or still)) if len(parts) > 1 else parts[0]
    arm = plan.scenario.arm
    about = {"scenario": plan.scenario.name, "arm": arm.model if arm else "none", "salver": versions()["salver"]}
    return replace(motion, about=about, verdict=plan.verdict)


def _series(plan: Plan, rate: float | None) -> MotionSeries:
    """One motion, without what its file says of it."""
    ns = _instants(plan.t, plan.duration, rate)
    t = ns * 1e-9
    samples = plan.reference.sample(t)
    first = plan.scenario.payload.first
    R_SE = samples.R_SB @ first.R_EB.T
    p_SE = samples.p_SB - np.einsum("tij,j->ti", R_SE, first.p_EB)
    names, (q, dq, ddq), tau = _joints(plan, t)
    return MotionSeries(
        ns=ns,
        joint_names=names,
        q=q,
        dq=dq,
        ddq=ddq,
        tau=tau,
        p_SE=p_SE,
        quat_SE_wxyz=quat_wxyz_from_matrix(R_SE),
        p_SB=samples.p_SB,
        quat_SB_wxyz=samples.quat_SB_wxyz,
        v_S=samples.v_S,
        a_S=samples.a_S,
        omega_B=samples.omega_B,
        alpha_B=samples.alpha_B,
        stops=_stops(plan, names, rate),
    )


def _stops(plan: Plan, names: tuple[str, ...], rate: float | None) -> tuple[tuple[int, MotionSeries], ...]:
    """The stops of a plan. At a rate, their samples are at the instants of the plan's."""
    if plan.stops is None or not names:
        return ()
    made = []
    for k in plan.stops.taken:
        motion, begins = plan.stops.motion(k), float(plan.stops.t[k])
        t = motion.t
        if rate is not None:
            count = np.arange(np.floor(begins * rate + 1e-6) + 1, np.ceil((begins + motion.duration) * rate - 1e-6))
            t = np.concatenate([[0.0], count / rate - begins, [motion.duration]])
        ns: Any = np.round(t * 1e9).astype(np.int64)
        q, dq, ddq = motion.sample(ns * 1e-9)
        made.append((round(begins * 1e9), MotionSeries(ns, names, q, dq, ddq)))
    return tuple(made)


def _instants(t: Array, duration: float, rate: float | None) -> Array:
    """Whole nanoseconds; the end of the motion is always the last instant."""
    if rate is not None:
        t = np.arange(int(np.floor(duration * rate)) + 1) / rate
        t = t if duration - t[-1] < 1e-9 else np.append(t, duration)
    return np.unique(np.round(t * 1e9).astype(np.int64))


def _joints(plan: Plan, t: Array) -> tuple[tuple[str, ...], tuple[Array, Array, Array], Array]:
    """Joint names, (q, dq, ddq), and feed-forward torque, between its samples by straight lines."""
    none = np.zeros((len(t), 0))
    if plan.joint is None or plan.scenario.arm is None:
        return (), (none, none, none), none
    tau = none if plan.tau is None else interpolated(plan.t, plan.tau, t)
    return plan.scenario.load_arm().joint_names, plan.joint.sample(t), tau
