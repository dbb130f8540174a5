"""Mass, centre of mass and inertia of the load from logs of its being carried, as ranges that cover the truth.

The load's wrench is linear in its inertial parameters phi (`salver.models.rigid_body`), so what sensors read with the
load, less what they read along the same motion with the empty tray, is

    torques:  J_E^T Y phi + Z n + E e + noise        wrist:  Y phi + E e + noise,

with E e what is wrong in all logs alike (`salver.learning.load.systematic`), Z n what joint friction is in one run and
not in the other: it changes in between, and acts at each run's own velocity. The arm's own model errs the same in both
runs, and cancels; of each run its inverse dynamics at its own state is taken off first. Noise is coloured
(`salver.learning.load.noise`), as large as the log shows it: generalised least squares. The middle of the scenario's
ranges is the prior, with their half-ranges as standard deviations; of inertia it is whatever the shape allows, unless
the scenario has ranges of it. Ranges are `WIDTH` standard deviations and the extremes of e
(`salver.learning.load.estimate`, `salver.learning.load.ranges`), and the scenario's own where those are narrower.
Those of `LIKELY` are told beside them. The estimate is the nearest that a mass inside the shape can have.
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
from salver.learning.load.sensors import at_flange, tray_wrench
from salver.learning.load.systematic import SensorBounds
from salver.learning.logs import Log, check_times
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
        bandwidth: Hz, of what is believed of a measured deviation from the plan; doubled, noise shakes the arm's model.
        ends: s left out at each end of a log, where smoothing has only one side.
        rest: s before and after the motion of which a log is used too; doubled, drift counts for more.
        block, blocks: s over which samples are averaged, and how many blocks at most; doubled, eight times the time.
        fine: s over which what a load adds may be taken at the mean of positions, velocities and accelerations.
        same: rad by which the empty run may differ from the loaded one.
        astray: rad that a joint may be off the plan.
        units: times what the heaviest load needs, beyond which a wrist is read in another unit.
        foreign: share of a joint's largest torque by which the arm's model may err, with a tenth of its limit.
        strange: times the noise that was told, in the residual, beyond which it is not one rigid load.
        impossible: standard deviations from anything that a mass inside the shape can have.
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
    """ranges: of mass (kg), centre of mass (m from the nominal one, in B) and inertia about it (kg m^2, axes of B). phi
    (10,), covariance (10, 10): in B; phi is of a mass inside the shape, the covariance of noise alone.

    residual: by how much the worst channel is noisier than was told. sensors: what was used. shares: kg of the mass's
    half-range for which noise and each kind of systematic error account.
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
        """The scenario with the new ranges, as a box. B moves with the nominal centre of mass, and so do start and
        goal."""
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
    """A plan carried out with the load, and with nothing on the tray."""

    plan: Plan
    loaded: Log
    empty: Log


def identify(plan: Plan, loaded: Sequence[Log], empty: Log, bounds: SensorBounds | None = None) -> Identified:
    """Identify the load from logs of a plan's motion.

    empty: the same motion with nothing on the tray. bounds: of the sensors' systematic errors.

    Raises ScenarioError for a scenario that this cannot be asked of, FileFormatError for logs that do not belong to it
    or show a systematic error beyond its bound, SalverError when the logs contradict the scenario's ranges.
    """
    return identify_runs(plan.scenario, [LoggedRun(plan, log, empty) for log in loaded], bounds=bounds)


def identify_runs(
    scenario: Scenario, runs: Sequence[LoggedRun], within: Scenario | None = None, bounds: SensorBounds | None = None
) -> Identified:
    """Identify a scenario's load from runs of any plans, in which it stood at the same place.

    within: a scenario of the same load whose ranges are known to hold it too (the scenario's own unless given): what is
    told lies within these. Raises as `identify` does.
    """
    _one_rigid_load(scenario, runs)
    _each_its_own(runs)
    sources, bounds = ", ".join(run.loaded.source for run in runs), bounds or SensorBounds()
    readings = _felt(scenario, runs, prior(scenario))
    # n runs of one motion less the same empty run know n / (1 + n) of what one run without noise in that would.
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
    )  # a scenario may say more than its shape can have
    possible, off = nearest(body, estimate.phi, estimate.together, within_shape=inside)
    if off > OPTIONS.impossible and estimate.phi[0] > 0:  # a mass below 0 is told as such
        raise SalverError(
            f"{sources}: what was felt is {off:.1f} standard deviations from any distribution of mass inside "
            f"{body.name}; at most {OPTIONS.impossible:g} is accepted: its shape or its place, the "
            "empty tray or the sensor's axes are others."
        )
    ranges = narrowed(scenario, estimate, scenario if within is None else within, inside)
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


def _one_rigid_load(scenario: Scenario, runs: Sequence[LoggedRun]) -> None:
    """Raise ScenarioError where no arm carries the load, or what it carries is not one rigid load."""
    if scenario.arm is None or any(run.plan.joint is None for run in runs):
        raise ScenarioError(
            f"{scenario.name} has no joint motion; a load is identified from the torques of the arm that carries it."
        )
    if len(scenario.objects) > 1:
        raise ScenarioError(
            f"{scenario.name} carries {len(scenario.objects)} objects, and an arm feels only their sum; load them one "
            "by one, each in a scenario of its own."
        )
    if scenario.payload.dynamic:
        raise ScenarioError(
            f"{scenario.name}: {scenario.payload.dynamic[0].inside} moves, and what is identified is one "
            "rigid load; identify the container empty."
        )


def _felt(scenario: Scenario, runs: Sequence[LoggedRun], known: tuple[Array, Array]) -> list[list[ChannelReading]]:
    """Sensor channels of each run.

    known: what the scenario says of phi, and its spread. Raises FileFormatError for logs that belong to no such run.
    """
    from salver.models.arm.arm import load_arm

    assert scenario.arm is not None
    arm = load_arm(scenario.arm, scenario.tray)
    seen, readings = dict[int, tuple[Log, SensedMotion]](), []
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
    """Raise FileFormatError when two runs are one: what was felt once would count twice."""
    for a, b in combinations([run.loaded for run in runs], 2):
        felt = (a.q, b.q), (a.tau, b.tau), (a.wrench_F, b.wrench_F)
        if all(x is y or (x is not None and y is not None and np.array_equal(x, y)) for x, y in felt):
            raise FileFormatError(
                f"{a.source} and {b.source} are the same log, which would count twice; leave one out."
            )


def _timed(plan: Plan, log: Log) -> Log:
    """The log on the plan's clock: by what all its joints together are late, its times are less."""
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
    """(T, n) N m that joints need for each link but the last, which carries the tray."""
    from salver.sensitivity.arm.terms import motion_terms

    for k in range(1, arm.pin_model.njoints - 1):
        model = arm.pin_model.copy()
        link = model.inertias[k]
        link.mass, link.inertia = 2 * link.mass, 2 * link.inertia
        model.inertias[k] = link
        yield motion_terms(model, arm.tray_id, q, dq, ddq).torque - torque


def _in_units(log: Log, state: SensedMotion, heaviest: float, phi_0: Array) -> None:
    """Raise FileFormatError when a wrist feels far more than the heaviest load and tray, kg, can make it feel."""
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
    """Raise FileFormatError when torques of the empty run are not what this arm needs, roughly, to move its tray."""
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
