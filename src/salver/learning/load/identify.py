"""Identification of mass, centre of mass and inertia of the load from logs, as ranges that contain the true values.

The load's wrench is linear in its inertial parameters phi (`salver.models.tray_motion`). So readings with the load,
minus those along the same motion with the empty tray, are

    torques:  J_E^T Y phi + Z n + E e + noise        wrist:  Y phi + E e + noise,

with E e the systematic errors (`salver.learning.load.systematic`), and Z n the difference of joint friction between the
runs, which changes in between and acts at each run's own velocity. Errors of the arm's model are equal in both runs and
cancel; the inverse dynamics of each run at its own state are subtracted first. Noise is coloured, with the size that
the log shows (`salver.learning.load.noise`): generalised least squares. The prior is the middle of the scenario's
ranges, with the half-ranges as standard deviations; for the inertia it is everything that the shape allows, unless the
scenario has ranges. Ranges are `WIDTH` standard deviations plus the extremes of e (`salver.learning.load.estimate`,
`salver.learning.load.ranges`), or the scenario's own if those are narrower; ranges of `LIKELY` are reported too. The
estimate is the nearest that a mass inside the shape can have.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from salver.errors import FileFormatError, SalverError, ScenarioError
from salver.geometry import Array, interpolated
from salver.learning.load.channels import ChannelReading, SensedMotion, differences
from salver.learning.load.estimate import solve
from salver.learning.load.narrowing import half_ranges, narrowed, not_shown, prior
from salver.learning.load.ranges import NAMES, Range
from salver.learning.load.sensors import at_flange, heavier, tray_wrench
from salver.learning.load.systematic import SensorBounds
from salver.learning.logs import Log, check_times, one_load
from salver.learning.tracking.executed import lateness
from salver.models.interfaces import needed_at_tray
from salver.models.physical import nearest, realisable
from salver.models.uncertain.parameters import INERTIAL, inertial_vector

if TYPE_CHECKING:
    from salver.models.arm.arm import ArmModel
    from salver.planning.plan import Plan
    from salver.scenario import Scenario


@dataclass(frozen=True)
class IdentifyOptions:
    """Options of the identification of one rigid load.

    Attributes:
        bandwidth: Hz, cut-off of the smoothing of measured deviations from the plan; with twice the value noise enters
            the arm's model.
        ends: s at each end of a log that are not used, because smoothing is one-sided there.
        rest: s of rest before and after the motion that are used; with twice the value drift has more effect.
        block, blocks: s over which samples are averaged, and largest number of blocks; twice the number takes eight
            times as long.
        fine: s over which the load's contribution is computed from mean positions, velocities and accelerations.
        same: rad, largest difference between the empty and the loaded run.
        astray: rad, largest deviation of a joint from the plan.
        units: ratio to the wrench of the heaviest load above which the wrist's unit must be another.
        foreign: error of the arm's model, as a share of a joint's largest torque, besides a tenth of its limit.
        strange: ratio of the residual to the assumed noise above which the load is not one rigid body.
        impossible: standard deviations from the nearest load that a mass inside the shape can have.
    """

    bandwidth: float = 10.0
    ends: float = 0.08
    rest: float = 0.5
    block: float = 0.005
    blocks: int = 112
    fine: float = 0.015
    same: float = 0.02
    astray: float = 0.2
    units: float = 20.0
    foreign: float = 0.3
    strange: float = 6.0
    impossible: float = 6.5


OPTIONS = IdentifyOptions()


@dataclass(frozen=True)
class Identified:
    """An identified load.

    ranges: of mass (kg), centre of mass (m from the nominal one, in B) and inertia about it (kg m^2, axes of B). phi
    (10,), covariance (10, 10): in B; phi is realisable inside the shape, the covariance is that of the noise alone.
    residual: largest ratio of a channel's noise to the assumed noise. sensors: names of the sensors. shares:
    contributions of noise and of each kind of systematic error to the mass's half-range, kg.
    """

    scenario: Scenario
    ranges: dict[str, Range]
    phi: Array
    covariance: Array
    residual: float
    sensors: tuple[str, ...]
    shares: dict[str, float]
    told: list[str] = field(default_factory=list)

    def learnt_scenario(self) -> Scenario:
        """The scenario with the new ranges, as a box. Frame B moves with the nominal centre of mass, and start and goal
        with it."""
        item, motion = self.scenario.objects[0], self.scenario.motion
        middle = {name: r.middle for name, r in self.ranges.items()}
        half = {name: r.half for name, r in self.ranges.items()}
        shift = np.array([middle[name] for name in NAMES[1:]])
        changes: dict[str, object] = {
            "uncertainty__set": "box",
            "uncertainty__correlation": {},
            "objects__0__mass": middle["mass"],
            "objects__0__com": (np.array(item.com) + shift).tolist(),
            "objects__0__uncertainty__mass": half["mass"],
            "objects__0__uncertainty__com": [half[name] for name in NAMES[1:]],
        }
        before, values = half_ranges(self.scenario), inertial_vector(self.scenario.payload.first.inertial)
        values *= middle["mass"] / item.mass
        ranged = [INERTIAL.index(p.quantity) for p in self.scenario.payload.uncertain.parameters if p.kind == "inertia"]
        values[ranged] = [middle[INERTIAL[k]] for k in ranged]
        values[1:4] = 0
        if ranged and item.uncertainty.inertia is not None and realisable(self.scenario.payload.first, values)[0]:
            before[ranged] = [half[INERTIAL[k]] for k in ranged]
            changes["objects__0__inertia"] = values[4:].tolist()
            changes["objects__0__uncertainty__inertia"] = before[4:].tolist()
        elif item.inertia is not None and not ranged:
            changes["objects__0__inertia"] = [x * middle["mass"] / item.mass for x in item.inertia]
        for end in ("start", "goal"):
            pose = getattr(motion, end)
            changes[f"motion__{end}__position"] = (np.array(pose.position) + pose.rotation @ shift).tolist()
        return self.scenario.with_changes(**changes)


@dataclass(frozen=True)
class LoggedRun:
    """A plan, with the logs of a run with the load and of a run with the empty tray."""

    plan: Plan
    loaded: Log
    empty: Log


def identify(plan: Plan, loaded: Sequence[Log], empty: Log, bounds: SensorBounds | None = None) -> Identified:
    """Identify the load from logs of a plan's motion.

    Args:
        loaded: logs with the load.
        empty: log of the same motion with the empty tray.
        bounds: bounds of the sensors' systematic errors.

    Raises:
        ScenarioError: the load is not one rigid object on an arm.
        FileFormatError: a log does not belong to the plan, or shows a systematic error beyond its bound.
        SalverError: the logs contradict the scenario's ranges.
    """
    return identify_runs(plan.scenario, [LoggedRun(plan, log, empty) for log in loaded], bounds=bounds)


def identify_runs(scenario: Scenario, runs: Sequence[LoggedRun], bounds: SensorBounds | None = None) -> Identified:
    """Identify a scenario's load from runs of any plans, in which it stood at the same position on the tray.

    Raises as `identify` does.
    """
    one_load(scenario, "identification")
    if any(run.plan.joint is None for run in runs):
        raise ScenarioError(f"{scenario.name}: this plan has no joint motion; identification needs one.")
    _each_its_own(runs)
    sources, bounds = ", ".join(run.loaded.source for run in runs), bounds or SensorBounds()
    readings = _felt(scenario, runs, prior(scenario))
    # n runs minus one empty run have n / (1 + n) of the information of n runs minus a noise-free empty run.
    with_this = Counter(id(run.empty) for run in runs)
    weights = [2 / (1 + with_this[id(run.empty)]) for run in runs]
    found = solve(readings, weights, prior(scenario), bounds)
    if found.residual > OPTIONS.strange:
        raise FileFormatError(
            f"{sources}: {found.noisiest} differ from those of one rigid load by {found.residual:.0f} times the noise: "
            "something slid or was put on late, the sensor was tared with the load, the log's clock jitters, or the "
            "arm or the empty tray is another."
        )
    if found.denied is not None:
        raise FileFormatError(f"{sources}: {found.denied}")
    estimate, body = found.estimate, scenario.payload.first
    inside = bool(
        realisable(body, inertial_vector(body.inertial))[0]
    )  # a scenario's nominal inertia may be impossible for its shape
    possible, off = nearest(body, estimate.phi, estimate.together, within_shape=inside)
    if off > OPTIONS.impossible and estimate.phi[0] > 0:  # a negative mass has its own message
        raise SalverError(
            f"{sources}: the readings are {off:.1f} standard deviations from those of any distribution of mass inside "
            f"{body.name}; at most {OPTIONS.impossible:g} is accepted: check its shape and place, "
            "the log of the empty tray and the sensor's axes."
        )
    ranges = narrowed(scenario, estimate, inside)
    told = not_shown(ranges, found.sensors)
    return Identified(
        scenario,
        ranges,
        possible,
        estimate.covariance,
        found.residual,
        tuple(sorted(found.sensors)),
        found.shares,
        told,
    )


def _felt(scenario: Scenario, runs: Sequence[LoggedRun], known: tuple[Array, Array]) -> list[list[ChannelReading]]:
    """Sensor channels of each run.

    known: prior of phi, and its standard deviations. Raises FileFormatError for logs that do not belong to the runs.
    """
    arm, seen, readings = scenario.load_arm(), dict[int, tuple[Log, SensedMotion]](), []
    for run in runs:
        plan = replace(run.plan, scenario=scenario)
        if id(run.empty) not in seen:
            empty = _timed(plan, run.empty)
            seen[id(run.empty)] = empty, _state(plan, arm, empty)
            _of_this_arm(arm, seen[id(run.empty)][1], empty)
        empty, without = seen[id(run.empty)]
        log = _timed(plan, run.loaded)
        state = _state(plan, arm, log)
        _same_motion(plan, log, empty)
        _in_units(log, state, float(known[0][0] + known[1][0]) + scenario.tray.mass, known[0])
        readings.append(differences(state, without, log, empty))
    return readings


def _each_its_own(runs: Sequence[LoggedRun]) -> None:
    """Raise FileFormatError when two logs are equal, because a run would count twice."""
    for a, b in combinations([run.loaded for run in runs], 2):
        felt = (a.q, b.q), (a.tau, b.tau), (a.wrench_F, b.wrench_F)
        if all(x is y or (x is not None and y is not None and np.array_equal(x, y)) for x, y in felt):
            raise FileFormatError(
                f"{a.source} and {b.source} are the same log, which would count twice; leave one out."
            )


def _timed(plan: Plan, log: Log) -> Log:
    """The log on the plan's clock, without the common delay of all joints."""
    assert plan.joint is not None
    check_times(log.t, log.q, log.source, plan.joint.q)
    if np.abs(log.q - plan.joint.sample(log.t)[0]).max() <= OPTIONS.same:
        return log
    return replace(log, t=log.t - lateness(log.t, log.q, plan.joint))


def _state(plan: Plan, arm: ArmModel, log: Log) -> SensedMotion:
    from scipy.signal import butter, sosfiltfilt

    from salver.sensitivity.arm.terms import motion_terms

    assert plan.joint is not None
    body, step = plan.scenario.payload.first, float(np.median(np.diff(log.t)))
    wanted = plan.joint.sample(log.t)
    off = log.q - wanted[0]
    if np.abs(off).max() > OPTIONS.astray:
        raise FileFormatError(
            f"{log.source}: a joint is {np.abs(off).max():.3g} rad from the plan; this is the log of another motion."
        )
    slow = np.asarray(sosfiltfilt(butter(2, min(0.9, 2 * OPTIONS.bandwidth * step), output="sos"), off, axis=0))
    rate = np.gradient(slow, step, axis=0)
    strayed = slow, rate, np.gradient(rate, step, axis=0)
    q, dq, ddq = (a + b for a, b in zip(wanted[:3], strayed, strict=True))
    near = max(1, round(OPTIONS.ends / step))
    still = [np.abs(strayed[1][end]).max() < 0.01 for end in (slice(near), slice(-near, None))]  # rad/s
    first, last = (OPTIONS.ends / (4 if each else 1) for each in still)
    inside = (log.t > max(log.t[0] + first, -OPTIONS.rest)) & (
        log.t < min(log.t[-1] - last, plan.duration + OPTIONS.rest)
    )
    length = max(OPTIONS.block, np.count_nonzero(inside) * step / OPTIONS.blocks)
    every = max(1, round(length / step))
    parts = min(every, int(np.ceil(length / OPTIONS.fine)))
    every = parts * round(every / parts)
    index = np.flatnonzero(inside)
    blocks = index[: len(index) // every * every].reshape(-1, every)
    if len(blocks) < 20:
        raise FileFormatError(f"{log.source} shows {len(blocks)} instants of the motion; at least 20 are needed.")

    def mean(values: Array) -> Array:
        return np.asarray(values[blocks].mean(axis=1))

    def fine(values: Array) -> Array:
        return np.asarray(values[blocks.reshape(len(blocks) * parts, -1)].mean(axis=1))

    def whole(values: Array) -> Array:
        return np.asarray(values.reshape(len(blocks), parts, *values.shape[1:]).mean(axis=1))

    terms = motion_terms(arm.pin_model, arm.tray_id, fine(q), fine(dq), fine(ddq))
    maps = np.array([needed_at_tray(body, unit) for unit in np.eye(10)])
    at_E, torque = np.einsum("kij,tj->tik", maps, terms.w), whole(terms.torque)
    tau, to_tau, links = None, None, None
    if log.tau is not None:
        links = np.stack([whole(each) for each in _each_link(arm, fine(q), fine(dq), fine(ddq), terms.torque)])
        tau, to_tau = mean(log.tau) - torque, whole(np.einsum("tij,tik->tjk", terms.jacobian, at_E))
    tray, to_wrench = tray_wrench(plan.scenario.tray, arm, whole(terms.w)), at_flange(arm, whole(at_E))
    wrench = None if log.wrench_F is None else mean(log.wrench_F) - tray
    return SensedMotion(mean(log.t), every, mean(q), mean(dq), tau, wrench, torque, tray, to_tau, to_wrench, links)


def _each_link(arm: ArmModel, q: Array, dq: Array, ddq: Array, torque: Array) -> Iterator[Array]:
    """Joint torques (T, n), N m, of each link except the last, which carries the tray."""
    from salver.sensitivity.arm.terms import motion_terms

    for k in range(1, arm.pin_model.njoints - 1):
        model = arm.pin_model.copy()
        heavier(model, {k: 2.0})
        yield motion_terms(model, arm.tray_id, q, dq, ddq).torque - torque


def _in_units(log: Log, state: SensedMotion, heaviest: float, phi_0: Array) -> None:
    """Raise FileFormatError when wrist readings far exceed those of the tray and the heaviest load, kg."""
    if state.wrench is None:
        return
    most = np.linalg.norm((state.to_wrench @ (phi_0 * heaviest / phi_0[0])).reshape(-1, 2, 3), axis=2)
    most[:, 1] += 0.05 * most[:, 0]
    felt = np.linalg.norm(state.wrench.reshape(-1, 2, 3), axis=2)
    times = np.median(felt, axis=0) / np.median(most, axis=0)
    for name, unit, x in zip(("forces", "moments"), ("N", "N m"), times, strict=True):
        if x > OPTIONS.units:
            raise FileFormatError(
                f"{log.source}: wrist {name} are {x:.0f} times what the tray and the heaviest load of the ranges need; "
                f"they must be in {unit}."
            )


def _of_this_arm(arm: ArmModel, without: SensedMotion, empty: Log) -> None:
    """Raise FileFormatError when torques of the empty run differ too much from those of this arm with its tray."""
    if without.tau is None:
        return
    off = np.median(np.abs(without.tau), axis=0)
    allowed = OPTIONS.foreign * np.abs(without.model).max(axis=0) + 0.1 * arm.limits.torque
    j = int(np.argmax(off / allowed))
    if off[j] > allowed[j]:
        raise FileFormatError(
            f"{empty.source}: the torque of {arm.joint_names[j]} is {off[j]:.3g} N m from what {arm.name} needs for "
            f"this motion; at most {allowed[j]:.3g} is accepted: torques of another arm, in another order or unit, or "
            "without gravity."
        )


def _same_motion(plan: Plan, log: Log, empty: Log) -> None:
    first, last = max(0.0, log.t[0], empty.t[0]), min(plan.duration, log.t[-1], empty.t[-1])
    if last - first < 0.8 * plan.duration:
        raise FileFormatError(f"{empty.source} and {log.source} must both hold the whole motion.")
    shared = (log.t >= first) & (log.t <= last)
    apart = float(np.abs(interpolated(empty.t, empty.q, log.t[shared]) - log.q[shared]).max())
    if apart > OPTIONS.same:
        raise FileFormatError(
            f"{empty.source} is of another motion than {log.source}: they are up to {apart:.3g} rad apart; at most "
            f"{OPTIONS.same:g} is accepted."
        )
