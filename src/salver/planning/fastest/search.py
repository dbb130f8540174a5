"""Search for the fastest safe motion: least duration within the arm's limits, with contact kept for all parameters.

The decision variables are the coefficients of rest-to-rest joint splines and the duration. `constraints` has what must
hold, `starts` the initial guesses, `sqp` finds a local optimum, `exchange` checks it between the nodes. This module
searches over local optima, first with few spline pieces, then with many.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array
from salver.planning.fastest.optimum import DEGREE, few_pieces, optimum, refitted
from salver.planning.fastest.options import FastestOptions
from salver.planning.seeds.blocked import why_blocked, why_roundabout, why_touching, why_unreached
from salver.planning.seeds.starts import (
    Ends,
    Start,
    around,
    between,
    ends,
    open_to,
    straight,
    touches,
)
from salver.planning.trajopt.curves import FreeCurve
from salver.planning.trajopt.exchange import rough
from salver.planning.trajopt.found import FastestMotion
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.programme import Iterate
from salver.planning.trajopt.spline import RestSpline, SplineMotion
from salver.planning.trajopt.sqp import SqpSolution
from salver.planning.trajopt.watch import WHY, Watch


def fastest(
    problem: TransportProblem,
    options: FastestOptions | None = None,
    near: FastestMotion | None = None,
    watch: Watch | None = None,
    pair: Ends | None = None,
) -> FastestMotion:
    """Find the shortest safe motion of a problem (`transport_problem`). Never raises for numerical reasons: see
    `status`.

    problem: what to solve. options: of the search. near: a motion of a similar problem, which is tried first. watch:
    may end the search early, with the best motion so far. pair: possible end postures between which it begins.
    """
    options = options or FastestOptions()
    watch = watch or Watch(options.time_limit)
    begun = time.perf_counter()
    if near is not None:
        # It is completed even when the search is ended: all else is slower by far.
        found = optimum(problem, options, near, Watch(), options.near)
        if found.status.ok:
            return found
    watch.trying = "postures at both ends"
    rng = np.random.default_rng(options.seed)
    pairs, blocked = possible_ends(problem, options, rng) if pair is None else ([pair], None)
    if blocked is not None:
        spline, wall = RestSpline(DEGREE, options.spans), time.perf_counter() - begun
        none = np.zeros((spline.size, problem.n))
        return FastestMotion(spline, none, np.inf, problem, blocked, wall_time=wall)
    best = _Search(problem, options, watch, pairs, rng).best()
    if not best.status.ok:
        told = best.status.sentence + why_roundabout(problem, pairs[0])
        best = replace(best, status=replace(best.status, sentence=told))
    return replace(best, wall_time=time.perf_counter() - begun)


def possible_ends(
    problem: TransportProblem, options: FastestOptions, rng: np.random.Generator
) -> tuple[list[Ends], Status | None]:
    """Pairs of end postures, or why there is none without a collision."""
    blocked = why_blocked(problem)
    if blocked is not None:
        return [], blocked
    pairs = ends(problem, rng, few=2 * options.first(problem))
    return pairs, why_touching(problem, pairs) if pairs else why_unreached(problem)


Begin = tuple[TransportProblem, Start]
Rough = tuple[Begin, SqpSolution]


@dataclass(eq=False)
class _Search:
    """A search: rough optima with few spline pieces, of which the best are refined with all.

    tried: paths that were begun. given_up: starts, each for a duration, s. iterations: so far. dynamic: whether rough
    optima have load dynamics.
    """

    problem: TransportProblem
    options: FastestOptions
    watch: Watch
    pairs: list[Ends]
    rng: np.random.Generator
    tried: list[Array] = field(default_factory=list)
    given_up: list[tuple[float, Begin]] = field(default_factory=list)
    iterations: int = 0
    dynamic: bool = False

    def best(self) -> FastestMotion:
        """The best motion: `starts` rough optima are refined, in order of merit, and more as long as one is shorter
        than the best motion; further starts are tried while no rough optimum is feasible. Where the first refined is
        not safe, too far from one without load dynamics, starts are ranked anew, by rough optima with them."""
        first, further = list(self._new(self._first())), self._new(self._further())
        steps = len(first) + self.options.starts
        roughs: list[Rough] = []
        self._tried(first, roughs, steps)
        best: FastestMotion | None = None
        begun, hoped = 0, True
        while True:
            enough, safe = begun >= self.options.starts, best is not None and best.status.ok
            if enough:
                self._again(roughs, best)
            roughs.sort(key=self._merit)
            hopeful = bool(roughs) and self._hopeful(roughs[0], best)
            if best is not None and ((enough and not (hopeful if safe else hoped)) or self.watch.over()):
                break
            more = None if hopeful or safe or self.watch.over() else next(further, None)
            if more is not None:
                roughs.append(self._rough(*more))
                continue
            if not roughs:
                break
            hoped = hopeful
            begin, rough = roughs.pop(0)
            beat = best.duration if best is not None and best.status.ok else np.inf
            found, begun = self._refined(*begin, rough.iterate, beat), begun + 1
            if best is None or (found.status.ok, -found.duration) > (best.status.ok, -best.duration):
                best = found
                self.watch.best = best.duration if best.status.ok else None
            if self.problem.cases and not (best.status.ok or self.dynamic):
                self.dynamic, roughs, self.given_up, begun = True, [], [], 0
                self._tried(first, roughs, steps)
            self.watch.reached(min((len(first) + begun) / steps, 1.0))
        assert best is not None
        if not best.status.ok:
            best = self._line() or best
        return replace(best, status=_ended(best.status, self.watch), iterations=self.iterations)

    def _line(self) -> FastestMotion | None:
        """The fallback when nothing was found: a straight path that is safe at low speed and, if time is left, the
        optimum near it. It is completed even when the search was ended early."""
        spline, at_once = RestSpline(DEGREE, self.options.spans), replace(self.options, iterations=0.0)
        for pair in self.pairs[: self.options.first(self.problem)]:
            problem = between(self.problem, pair)
            line = straight(pair, self.problem.arm)
            begin = line.motion(problem, spline)
            for slower in 2.0 ** np.arange(5):  # sixteen times the comfortable time at most
                self.watch.trying = f"{line.name}, slowly"
                slow = replace(begin, duration=slower * begin.duration)
                found = optimum(problem, at_once, slow, Watch(), self.options.near)
                self.iterations += found.iterations
                if found.status.ok:
                    return self._shorter(problem, found, line.name)
        return None

    def _shorter(self, problem: TransportProblem, line: FastestMotion, name: str) -> FastestMotion:
        """The optimum near a safe straight path, or that path itself when there is no time or no optimum."""
        if not self.watch.over():
            found = optimum(problem, self.options, line, self.watch, self.options.near)
            self.iterations += found.iterations
            if found.status.ok:
                return found
        sentence = f"{line.status.sentence} It is the {name}, gone along slowly: nothing else was found."
        return replace(line, status=replace(line.status, sentence=sentence))

    def _tried(self, first: list[Begin], roughs: list[Rough], steps: int) -> None:
        """Add the rough optima of these starts, as long as one of them may become the best."""
        vain = 0
        for done, begin in enumerate(first, 1):
            beat = self._beat(roughs)
            roughs.append(self._rough(*begin, beat=beat))
            vain = vain + 1 if self._beat(roughs) == beat else 0
            self.watch.reached(done / steps)
            if self.watch.over() or (vain >= self.options.patience * self.options.starts and np.isfinite(beat)):
                break

    def _again(self, roughs: list[Rough], best: FastestMotion | None) -> None:
        """Add the rough optima of starts that were given up for another one, whose motion takes longer than it did."""
        beat = min(self._better(best), self._beat(roughs))
        for given_up in [each for each in self.given_up if each[0] < beat]:
            if not self.watch.over():
                self.given_up.remove(given_up)
                roughs.append(self._rough(*given_up[1]))

    def _better(self, best: FastestMotion | None) -> float:
        """The duration, s, of an improvement over the best motion; infinite if it is not safe."""
        return (1 - self.options.rough_gain) * best.duration if best is not None and best.status.ok else np.inf

    def _hopeful(self, rough: Rough, best: FastestMotion | None = None) -> bool:
        """Whether a rough optimum is almost feasible, and shorter than the best motion."""
        found = rough[1].iterate
        return found.violation < self.options.mendable and found.duration < self._better(best)

    def _beat(self, roughs: list[Rough]) -> float:
        """The duration, s, below which another rough optimum would be an improvement."""
        hopeful = sorted(rough[1].iterate.duration for rough in roughs if self._hopeful(rough))
        enough = self.options.starts
        return (1 - self.options.rough_gain) * hopeful[enough - 1] if len(hopeful) >= enough else np.inf

    def _new(self, begins: Iterable[Begin]) -> Iterator[Begin]:
        """The starts whose paths were not tried before: without obstacles a path around them is the straight one."""
        for problem, start in begins:
            path = start.sampled
            if all(np.abs(path - other).max() > 0.01 for other in self.tried):  # rad; nearer ones end alike
                self.tried.append(path)
                yield problem, start

    def _first(self) -> list[Begin]:
        """First starts: straight paths between the most promising ends. Where these are blocked: the shortest paths
        around obstacles, then straight paths between these and other ends."""
        count = self.options.first(self.problem)
        lines = [(between(self.problem, pair), straight(pair, self.problem.arm)) for pair in self.pairs]
        free = [open_to(problem, line) for problem, line in lines[:count]]
        if all(free):
            return lines[:count]
        free += [open_to(problem, line) for problem, line in lines[count:]]
        found = [line for k, line in enumerate(lines) if free[k] or k < 2 * count]
        return [*self._ways(), *sorted(found, key=_promise)]

    def _ways(self) -> list[Begin]:
        """The shortest of three times as many random paths around obstacles, from any known start to any known goal."""
        count = self.options.ways
        drawn = [around(self.problem, self.pairs, self.rng) for _ in range(3 * count)]
        found = sorted((way for way in drawn if way is not None), key=lambda way: way.least(self.problem))[:count]
        return [(between(self.problem, Ends(way.postures[0], way.postures[-1], 0.0, True)), way) for way in found]

    def _further(self) -> Iterator[Begin]:
        """Further initial guesses, for when the first ones fail."""
        yield from self._ways()
        if self.problem.start_posture is not None:  # so far only the first of them were sought
            self.pairs = ends(self.problem, self.rng)
        self.pairs = ends(self.problem, self.rng, more=True)
        yield from self._ways()
        for pair in self.pairs[: 2 * max(2, self.options.pairs)]:
            yield between(self.problem, pair), straight(pair, self.problem.arm)

    def _rough(self, problem: TransportProblem, start: Start, beat: float = np.inf) -> Rough:
        """The rough optimum, with few spline pieces, of a start, from a long duration."""
        self.watch.trying = start.name
        begin, o = start.motion(problem, few_pieces(self.options)), self.options
        less = problem.roughly(self.dynamic)
        found = rough(less, FreeCurve, begin, o.nodes_per_span, self.watch, o.rough_gain, o.most_roughly, beat)
        self.iterations += found.iterations
        if found.status.code == "beaten":
            self.given_up.append((beat, (problem, start)))
        return (problem, start), found

    def _refined(self, problem: TransportProblem, start: Start, found: Iterate, beat: float) -> FastestMotion:
        """The optimum with all spline pieces near the rough one of a start, unless it takes longer than `beat`, s; with
        load dynamics in rough optima from the start itself, which is slow."""
        self.watch.trying = f"a motion of {found.duration:.3f} s, refined"
        if self.dynamic:
            begin, damping = start.motion(problem, RestSpline(DEGREE, self.options.spans)), 1.0
        else:
            rough = SplineMotion(few_pieces(self.options), found.coefficients, found.duration)
            begin = refitted(rough, self.options.spans)
            damping = 0.7 if problem.cases else self.options.refined  # rough optima ignore load dynamics
        best = optimum(problem, self.options, begin, self.watch, damping, beat=beat)
        self.iterations += best.iterations
        return best

    def _merit(self, found: Rough) -> tuple[bool, float]:
        return found[1].iterate.violation >= self.options.mendable, found[1].iterate.duration


def _promise(begin: Begin) -> float:
    """Estimated duration, s, of a motion from a start: longer, the deeper its path is inside obstacles."""
    problem, start = begin
    return start.least(problem) * (1 + 8.0 * touches(problem, start))  # 1/m: by 8 % for each centimetre


def _ended(status: Status, watch: Watch) -> Status:
    """The status of a search, which says so if the search was ended early."""
    if not watch.ended:
        return status
    why = f"The search was ended by {WHY[watch.ended]} before it was done."
    return replace(status, code=watch.ended if status.ok else status.code, sentence=f"{status.sentence} {why}")
