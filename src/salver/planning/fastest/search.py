"""The fastest motion that stays safe: shortest duration within the arm's limits, contact kept for all parameters.

The decision variables are the coefficients of rest-to-rest joint splines and the duration, so the arm can run
every candidate. `constraints` says what must hold, `starts` where to begin, `sqp` finds a local optimum, `exchange`
checks it between the nodes; here is the search over local optima, from few spline pieces to many.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from salver.errors import Status, UnreachableError
from salver.geometry import Array
from salver.planning.fastest.bound import least_by_friction, least_duration
from salver.planning.fastest.constraints import LEVEL_TOLERANCE, Contact
from salver.planning.fastest.curves import FreeCurve, Grid, united
from salver.planning.fastest.ends import AtPose
from salver.planning.fastest.exchange import ITERATIONS, ROUGH_ITERATIONS, SHORTEST, optimise, rough
from salver.planning.fastest.objectives import Objective
from salver.planning.fastest.problem import TransportProblem, transport_problem, with_missed_cases
from salver.planning.fastest.spline import RestSpline, SplineMotion, min_jerk_blend
from salver.planning.fastest.sqp import Iterate, Solution
from salver.planning.fastest.starts import (
    FEW_LOOKS,
    LOOKS,
    Ends,
    Start,
    around,
    bendable,
    bent,
    between,
    ends,
    open_to,
    straight,
    tray_line,
)
from salver.planning.fastest.watch import INTERRUPTED, WHY, Watch
from salver.planning.follow.forward import tray_motion
from salver.planning.follow.limits import blocked_end
from salver.scenario import Scenario
from salver.sensitivity.arm.terms import motion_terms
from salver.trajectory import JointMotion, MotionSamples, SampledReference
from salver.wording import listed

if TYPE_CHECKING:
    from salver.planning.plan import Plan

DEGREE = 5
REFINED = 0.5  # damping of the first step after pieces have been added,
TURNED = 0.3  # after the last joint has been turned by a right angle,
NEAR = 0.1  # and from the optimum of a similar problem
NEARLY = 1e-2  # violation of a rough optimum that more pieces may mend
BENDS = 3  # detours that are tried at last
AGAIN = 3  # times a motion that nothing hinders is made shorter

MISSED = 4  # times that cases of a liquid are added which a motion does not keep
CHECKED = 401  # instants at which that is looked at


@dataclass(frozen=True)
class FastestOptions:
    """spans: number of polynomial pieces. nodes_per_span: where conditions are imposed.
    pairs: of end postures from which the search begins when the start posture is free; ways: around what stands in the
    way, for each of them. starts: local optima refined, of which the best is taken. iterations: of each at most, as a
    multiple of the usual. seed: of everything random. time_limit: s, None for none: then no clock decides anything.
    """

    spans: int = 20
    nodes_per_span: int = 2
    pairs: int = 2
    ways: int = 2
    starts: int = 1
    iterations: float = 1.0
    seed: int = 0
    time_limit: float | None = None

    def first(self, problem: TransportProblem) -> int:
        """Pairs that are tried first: fewer when one of the two postures is given."""
        return self.pairs if problem.start_posture is None else max(1, self.pairs // 4)


EFFORTS = {
    "quick": FastestOptions(pairs=1, ways=1),
    "normal": FastestOptions(),
    "thorough": FastestOptions(pairs=12, ways=3, starts=4, iterations=3.0),
}


@dataclass(frozen=True)
class FastestMotion:
    """Result. spline, coefficients (size, n), duration: the motion. worst: largest row of each block on the fine
    grid (<= 0: kept). binding: the blocks that hinder a shorter time. wall_time: s. iterations: of all rounds and
    starts. margin: that was sought, when it was (`LeastMargin`).
    """

    problem: TransportProblem
    spline: RestSpline
    coefficients: Array
    duration: float
    status: Status
    worst: dict[str, float]
    binding: tuple[str, ...]
    wall_time: float
    iterations: int
    margin: float = 0.0

    def after(self, *before: FastestMotion) -> FastestMotion:
        """The same motion, with the time and the iterations of the searches before it counted too."""
        every = (self, *before)
        spent, steps = sum(x.wall_time for x in every), sum(x.iterations for x in every)
        return replace(self, wall_time=spent, iterations=steps)

    def sample(self, t: Array) -> tuple[Array, Array, Array, Array]:
        """q, dq, ddq, dddq (T, n) at times t, clamped to rest outside [0, duration]."""
        s = np.clip(np.asarray(t, dtype=float) / self.duration, 0.0, 1.0)
        curve = FreeCurve(self.problem, Grid.of(self.spline, s))
        q, *rates = curve.motion(self.coefficients, self.duration)
        inside = ((t >= 0) & (t <= self.duration))[:, None]
        dq, ddq, dddq = (np.where(inside, rate, 0.0) for rate in rates)
        return q, dq, ddq, dddq

    def joint_motion(self) -> JointMotion:
        """The same motion as samples; exact between them too, as the breaks of the spline are among them."""
        t = self.duration * united(np.linspace(0, 1, 401), self.spline.breaks())
        q, dq, ddq, _ = self.sample(t)
        return JointMotion(t, q, dq, ddq)

    def reference(self) -> SampledReference:
        """The motion of the first object's frame B."""
        joint = self.joint_motion()
        return SampledReference(object_motion(self.problem, joint.t, joint.q, joint.dq, joint.ddq))


def object_motion(problem: TransportProblem, t: Array, q: Array, dq: Array, ddq: Array) -> MotionSamples:
    """Motion of the first object's frame B at joint states (T, n)."""
    tray = tray_motion(problem.arm, JointMotion(t, q, dq, ddq))
    return tray.of_frame(problem.items[0].p_EB, problem.items[0].R_EB)


def plan_fastest(
    scenario: Scenario, *, robust: bool = True, options: FastestOptions | None = None, watch: Watch | None = None
) -> Plan:
    """The fastest plan of a scenario with an arm. Its contact condition is the exact one, whatever the scenario's.

    robust: safe for the whole uncertain set (with the arm's tracking), or for nominal parameters only. watch: may end
    the search early, with the best so far.
    Raises ScenarioError when the scenario has no arm; a plan that could not be found has a status that says so.
    """
    return plan_problem(transport_problem(scenario, robust=robust), robust=robust, options=options, watch=watch)


def plan_problem(
    problem: TransportProblem,
    *,
    robust: bool = True,
    options: FastestOptions | None = None,
    watch: Watch | None = None,
    near: SplineMotion | None = None,
) -> Plan:
    """The plan of a problem, as `plan_fastest` makes it. near: a motion of a similar problem, tried first."""
    scenario = problem.scenario
    found = fastest(problem, options, near, watch)
    for rounds in range(MISSED + 1):
        more = _missed(found) if found.status.ok else None
        if more is None:
            break
        if rounds == MISSED:
            spilt = "at some fill or damping in its range a liquid spills when the arm gives way to its load"
            found = replace(found, status=Status("unsafe", f"{found.duration:.4f} s is too fast: {spilt}.", False))
            break
        again = fastest(more, options, near=found, watch=watch)
        found = again.after(found)
    if not np.isfinite(found.duration):
        raise UnreachableError(f"{scenario.name}: {found.status.sentence}")
    plan = _planned(scenario, found, robust)
    if robust and plan.status.ok and plan.verification.violation > 0:
        # Rows allow for an arm that misses the motion, and in quick turns even the motion itself lies outside of that.
        exactly = tuple(Contact(rows, scenario.contact.margin, exactly=True) for rows in found.problem.contacts)
        again = fastest(
            replace(found.problem, extra=(*found.problem.extra, *exactly)), options, near=found, watch=watch
        )
        if again.status.ok and _missed(again) is None:
            plan = _planned(scenario, again.after(found), robust)
    if robust and plan.status.ok and not plan.verification.ok:
        said = f"The motion found in {plan.duration:.4f} s fails the check of its plan: {plan.verification.sentence}"
        plan = replace(plan, status=Status("unsafe", said, False))
    return plan


def _planned(scenario: Scenario, found: FastestMotion, robust: bool) -> Plan:
    """The plan of a motion that was found, with what hinders a shorter one."""
    problem, ends = found.problem, (found.coefficients[0], found.coefficients[-1])
    by_joints = least_duration(problem.limits, *ends)
    tilt = max(problem.max_tilt, np.sqrt(2) * LEVEL_TOLERANCE)  # about each of two axes
    by_friction = 0.0 if problem.moving else least_by_friction(problem.arm, problem.payload, tilt, *ends)
    bound, status = max(by_joints, by_friction), found.status
    if status.ok:
        what = "friction alone takes" if by_friction > by_joints else "the joints' limits alone take"
        status = replace(status, sentence=f"{status.sentence} {_held_by(found, bound, what)}")
    record = {**solver_record(found, robust), "bound": bound}
    return joint_plan(scenario, found.problem, found.joint_motion(), status, record)


def _held_by(found: FastestMotion, bound: float, what: str) -> str:
    """What hinders a shorter time, and a time that nothing can beat, by `what`."""
    held = f"What hinders a shorter one: {listed(found.binding)}. " if found.binding else ""
    above = 100 * (found.duration / bound - 1)
    return (
        f"{held}Between its two end postures {what} {bound:.4f} s: it is at most {above:.1f} % "
        "above the shortest between these."
    )


def solver_record(found: FastestMotion, robust: bool) -> dict[str, Any]:
    """What a plan keeps of how it was found."""
    return {
        "name": "sequential quadratic programming (PIQP)",
        "robust": robust,
        "seconds": found.wall_time,
        "iterations": found.iterations,
        "spans": found.spline.spans,
        "worst": found.worst,
        "binding": found.binding,
        **tracking_record(found),
    }


def _missed(found: FastestMotion) -> TransportProblem | None:
    """The problem with the liquids' cases that the motion does not keep although it keeps those that were asked for."""
    if not found.problem.liquids:
        return None
    s = np.linspace(0.0, 1.0, CHECKED)
    z = np.stack(found.sample(s * found.duration))
    return with_missed_cases(found.problem, found.problem.at(s, z, found.duration, imposed=False))


def joint_plan(
    scenario: Scenario,
    problem: TransportProblem,
    joint: JointMotion,
    status: Status,
    record: Mapping[str, Any],
    method: str = "fastest",
) -> Plan:
    """A motion of the joints as a plan under the exact contact condition, judged by the arm's own verdict."""
    from salver.planning.follow.limits import torques, verdict
    from salver.planning.plan import Plan

    exact = scenario.with_changes(contact__condition="exact")
    reference = SampledReference(object_motion(problem, joint.t, joint.q, joint.dq, joint.ddq))
    parts = None if problem.keep_out is None else problem.keep_out.parts
    plan = Plan(exact, method, reference, status, joint, verdict(problem.arm, joint, problem.items, parts))
    tau = torques(problem.arm, JointMotion(plan.t, *joint.sample(plan.t)), problem.items)
    return replace(plan, tau=tau, solver=record)


def tracking_record(found: FastestMotion) -> dict[str, float]:
    """Peak of what the arm may stray under the uncertain load: the tray's position (m) and orientation (rad)."""
    problem = found.problem
    if problem.tracking is None:
        return {}
    t = np.linspace(0, 1, 201) * found.duration
    q, *rates = found.sample(t)
    terms = motion_terms(problem.model, problem.arm.tray_id, q, rates[0], rates[1])
    position, turn = problem.tracking.along(t, terms, np.stack(rates)).tray_radius()
    return {"tray_position_radius": float(position.max()), "tray_orientation_radius": float(turn.max())}


def fastest(
    problem: TransportProblem,
    options: FastestOptions | None = None,
    near: FastestMotion | SplineMotion | None = None,
    watch: Watch | None = None,
) -> FastestMotion:
    """Shortest safe motion that is found of a problem (see `transport_problem`). Never raises for numerical reasons:
    see `status`.

    near: a motion of a similar problem, tried first. watch: may end the search early.
    """
    options = options or FastestOptions()
    watch = watch or Watch(options.time_limit)
    begun = time.perf_counter()
    if near is not None:
        found = _optimum(problem, options, SplineMotion(near.spline, near.coefficients, near.duration), watch, NEAR)
        if found.status.ok:
            return found
    blocked = _blocked(problem)
    rng = np.random.default_rng(options.seed)
    pairs = [] if blocked is not None else ends(problem, rng, few=2 * options.first(problem))
    if not pairs:
        spline = RestSpline(DEGREE, options.spans)
        unreached = "No posture within the joint limits reaches the start or the goal pose."
        status = blocked or Status("unreachable", unreached, False)
        wall = time.perf_counter() - begun
        return FastestMotion(problem, spline, np.zeros((spline.size, problem.n)), np.inf, status, {}, (), wall, 0)
    return replace(_Search(problem, options, watch, pairs, rng).best(), wall_time=time.perf_counter() - begun)


Begin = tuple[TransportProblem, Start]


@dataclass(eq=False)
class _Search:
    """Rough optima with few pieces, the best of them refined with all."""

    problem: TransportProblem
    options: FastestOptions
    watch: Watch
    pairs: list[Ends]
    rng: np.random.Generator
    iterations: int = 0

    def best(self) -> FastestMotion:
        """The best of the first few rough optima is refined; when none is feasible, the next that is; at last the
        others."""
        first, further = self._first(), self._further()
        steps = len(first) + self.options.starts
        roughs: list[tuple[TransportProblem, Solution]] = []
        for done, begin in enumerate(first, 1):
            roughs.append(self._rough(*begin))
            self.watch.share = done / steps
            if self.watch.over():
                break
        best: FastestMotion | None = None
        refined = 0
        while True:
            roughs.sort(key=_merit)
            hopeful = bool(roughs) and roughs[0][1].iterate.violation < NEARLY
            more = None if hopeful or self.watch.over() else next(further, None)
            if more is not None:
                roughs.append(self._rough(*more))
                continue
            if not roughs:
                break
            problem, rough = roughs.pop(0)
            if refined == 0 and isinstance(problem.goal, AtPose) and problem.goal.target.yaw_free:
                turned = [(problem, rough), *((problem, other) for other in self._turned(problem, rough))]
                (problem, rough), *others = sorted(turned, key=_merit)
                roughs += others
            found, begun = self._refined(problem, rough.iterate), (problem, rough.iterate)
            refined += 1
            if best is None or (found.status.ok, -found.duration) > (best.status.ok, -best.duration):
                best = found
                self.watch.best = best.duration if best.status.ok else None
            self.watch.share = min(1.0, (len(first) + refined) / steps)
            enough = refined >= self.options.starts
            if (best.status.ok and enough) or (not hopeful and enough) or self.watch.over():
                break
        assert best is not None
        if self.watch.ended == INTERRUPTED and not best.status.ok:
            # What was begun is mended, in a moment, before it is given back.
            briefly = replace(self.options, iterations=0.25 * self.options.iterations)
            mended = replace(self, options=briefly, watch=Watch())._refined(*begun)
            best = mended if mended.status.ok else best
        return replace(best, status=_ended(best.status, self.watch), iterations=self.iterations)

    def _first(self) -> list[Begin]:
        """Straight paths between the most promising ends, or, where those cannot be gone along, the shortest of the
        ways around that are found."""
        count = self.options.first(self.problem)
        lines = [(between(self.problem, pair), straight(pair)) for pair in self.pairs[: 2 * count]]
        free = [open_to(problem, line) for problem, line in lines]
        if all(free[:count]):
            return lines[:count]
        found = [line for (_, line), is_free in zip(lines, free, strict=True) if is_free]
        found += self._ways([pair for pair, is_free in zip(self.pairs, free, strict=False) if not is_free])
        return self._promising(found)[: self.options.pairs + 1]

    def _ways(self, pairs: list[Ends]) -> list[Start]:
        """Ways around between the ends of each of some pairs, and from any start to any goal that is known."""
        found = [around(self.problem, [pair], self.rng, FEW_LOOKS) for pair in pairs]
        found += [around(self.problem, self.pairs, self.rng, LOOKS) for _ in range(self.options.ways)]
        return [way for way in found if way is not None]

    def _promising(self, found: list[Start]) -> list[Begin]:
        """Paths with the problem between their ends, the shortest first; without those that can be bent into one that
        is shorter."""
        kept: list[Begin] = []
        for start in sorted(found, key=lambda start: start.least(self.problem)):
            problem = between(self.problem, Ends(start.postures[0], start.postures[-1], 0.0, True))
            if not any(bendable(problem, start, other) for _, other in kept):
                kept.append((problem, start))
        return kept

    def _further(self) -> Iterator[Begin]:
        """What is tried when those fail."""
        if self.problem.start_posture is not None:  # so far only the first of them were sought
            self.pairs = ends(self.problem, self.rng)
        few = self.pairs[: max(2, self.options.pairs)]
        for pair in few:
            line = tray_line(self.problem, pair)
            if line is not None:
                yield between(self.problem, pair), line
        self.pairs = ends(self.problem, self.rng, more=True)
        yield from self._promising(self._ways(self.pairs[: len(few)]))
        for pair in self.pairs[: 2 * len(few)]:
            yield between(self.problem, pair), straight(pair)
        for _ in range(BENDS):
            yield between(self.problem, self.pairs[0]), bent(self.pairs[0], self.rng)

    def _rough(self, problem: TransportProblem, start: Start) -> tuple[TransportProblem, Solution]:
        """A first optimum with few spline pieces, from a comfortable duration."""
        return problem, self._rough_from(problem, start.motion(problem, self._few), 1.0)

    def _rough_from(self, problem: TransportProblem, start: SplineMotion, damping: float) -> Solution:
        iterations = round(self.options.iterations * ROUGH_ITERATIONS)
        found = rough(problem, FreeCurve, start, self.options.nodes_per_span, self.watch, damping, iterations)
        self.iterations += found.iterations
        return found

    def _turned(self, problem: TransportProblem, found: Solution) -> Iterator[Solution]:
        """The same motion ending a quarter turn of the last joint away, optimised again: a local optimum does not
        turn."""
        few = self._few
        ramp = min_jerk_blend(np.linspace(0, 1, few.size))
        for turn in (0.5 * np.pi, -0.5 * np.pi):
            coefficients = found.iterate.coefficients.copy()
            coefficients[:, -1] += turn * ramp
            within = problem.limits.q_min[-1] < coefficients[-1, -1] < problem.limits.q_max[-1]
            longer = least_duration(problem.limits, coefficients[0], coefficients[-1]) > found.iterate.duration
            if within and not (longer and found.iterate.violation < NEARLY and not problem.moving):
                yield self._rough_from(problem, SplineMotion(few, coefficients, found.iterate.duration), TURNED)

    def _refined(self, problem: TransportProblem, found: Iterate) -> FastestMotion:
        """The optimum with all pieces. Where nothing hinders a shorter time it is none: then on from there."""
        start = refitted(SplineMotion(self._few, found.coefficients, found.duration), self.options.spans)
        spline, grid = start.spline, found.curve.grid
        also = np.setdiff1d(grid.s[grid.nodes], self._few.nodes(self.options.nodes_per_span))
        best = _optimum(problem, self.options, start, self.watch, REFINED, also=also)
        self.iterations += best.iterations
        for _ in range(AGAIN):
            if not best.status.ok or best.binding or self.watch.over():
                break
            start = SplineMotion(spline, best.coefficients, best.duration)
            again = _optimum(problem, self.options, start, self.watch, REFINED)
            self.iterations += again.iterations
            if not again.status.ok or again.duration >= best.duration:
                break
            best = again
        return best

    @property
    def _few(self) -> RestSpline:
        return few_pieces(self.options)


def few_pieces(options: FastestOptions) -> RestSpline:
    """Of rough optima."""
    return RestSpline(DEGREE, max(4, options.spans // 3))


def refitted(motion: SplineMotion, spans: int) -> SplineMotion:
    """The same motion, as near as may be, with so many pieces."""
    spline, s = RestSpline(DEGREE, spans), np.linspace(0, 1, 201)
    return SplineMotion(spline, spline.fit(s, motion.spline.matrices(s)[0] @ motion.coefficients), motion.duration)


def _merit(found: tuple[TransportProblem, Solution]) -> tuple[bool, float]:
    return found[1].iterate.violation >= NEARLY, found[1].iterate.duration


def _ended(status: Status, watch: Watch) -> Status:
    """The status of a search that was ended before it was done says so."""
    if not watch.ended:
        return status
    why = f"The search was ended by {WHY[watch.ended]} before it was done."
    return replace(status, code=watch.ended if status.ok else status.code, sentence=f"{status.sentence} {why}")


def nearby(
    found: FastestMotion,
    objective: Objective,
    duration: float,
    options: FastestOptions | None = None,
    *,
    begin: Start | None = None,
    watch: Watch | None = None,
) -> FastestMotion:
    """The motion with the least objective at a duration (s), near one that was found; under the same constraints.

    begin: a path between the same ends to begin from instead.
    """
    options = options or FastestOptions()
    start, damping = SplineMotion(found.spline, found.coefficients, duration), NEAR
    if begin is not None:
        start, damping = replace(begin.motion(found.problem, found.spline), duration=duration), REFINED
    return _optimum(found.problem, options, start, watch or Watch(options.time_limit), damping, objective)


def _blocked(problem: TransportProblem) -> Status | None:
    """Why no motion can begin or end as it should, or None."""
    if problem.keep_out is None:
        return None
    ends = {"start": problem.start, "goal": problem.goal}
    poses = {name: end.target for name, end in ends.items() if isinstance(end, AtPose) and not end.target.yaw_free}
    stuck = blocked_end(problem.keep_out.parts, {name: target.tray_pose for name, target in poses.items()})
    if stuck is not None or problem.start_posture is None:
        return stuck
    touch = problem.keep_out.parts.first_touch(problem.start_posture[None])
    if touch is None:
        return None
    return Status("collision", f"In the start posture {touch.first} and {touch.second} touch.", False)


def straight_start(problem: TransportProblem, spline: RestSpline) -> SplineMotion:
    """Where the search begins: the most promising straight line in joint space, at a comfortable duration.

    Raises UnreachableError when no posture reaches an end.
    """
    pairs = ends(problem, np.random.default_rng(FastestOptions().seed))
    if not pairs:
        raise UnreachableError("No posture within the joint limits reaches the start or the goal pose.")
    return straight(pairs[0]).motion(problem, spline)


def _optimum(
    problem: TransportProblem,
    options: FastestOptions,
    start: SplineMotion,
    watch: Watch,
    damping: float,
    objective: Objective = SHORTEST,
    also: Array | None = None,
) -> FastestMotion:
    """The optimum from a start that is near it, checked between the nodes. also: nodes beside the usual ones."""
    begun = time.perf_counter()
    iterations = round(options.iterations * ITERATIONS)
    per_span = options.nodes_per_span
    found = optimise(problem, FreeCurve, start, per_span, watch, damping, objective, iterations, also=also)
    wall, result = time.perf_counter() - begun, (found.coefficients, found.duration, found.status, found.worst)
    return FastestMotion(found.problem, start.spline, *result, found.binding, wall, found.iterations, found.margin)
