"""Sequential quadratic programming on the coefficients of a motion and the scalar of its objective.

Each iteration takes the step of a quadratic programme (`programme`). A second-order correction (the same rows with
their true values at the trial point; Fletcher 1982) keeps steps long: rows that were left out as too far away, and the
far side of kinks, come in with it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from salver.errors import Status
from salver.geometry import Array, Mask
from salver.planning.trajopt.constraints.constraints import violated
from salver.planning.trajopt.programme import Iterate, Programme
from salver.planning.trajopt.trust import Trust
from salver.planning.trajopt.watch import Watch


@dataclass(frozen=True)
class SqpOptions:
    """Options of sequential quadratic programming.

    iterations: at most. watch: may end the search sooner.
    gain: relative improvement that counts as none; doubled, a search ends with less work, up to twice as far from its
    optimum.
    violation: largest violation of a margin-tightened row that counts as converged; doubled, more is left to the rounds
    of adding nodes.
    penalty: first price of a unit of violation, in the unit of the objective; it is adapted at every step.
    least_damping: of the proximal term. mending: to end with the first step that keeps all rows.
    poor: share of the improvement that was hoped for below which a second-order correction is tried; doubled, at every
    step. bent: violation of a trial, beyond the programme's own, that is worth one; doubled, there are fewer.
    kept: a row that joined stays until it is further from its edge than this; doubled, programmes have more rows.
    beat: the search ends where nothing below this is to be expected.
    """

    iterations: int = 60
    watch: Watch = field(default_factory=Watch)
    gain: float = 1e-4
    violation: float = 5e-4
    penalty: float = 20.0
    least_damping: float = 1e-5
    mending: bool = False
    poor: float = 0.8
    bent: float = 2e-4
    kept: float = 0.3
    beat: float = np.inf

    def beaten(self, path: Iterate, hoped: float) -> bool:
        """Whether a path that nearly keeps its rows, and of which a step promises so much, will not come below."""
        if path.violation >= 0.05:  # it mostly becomes longer, but how much is not known yet
            return False
        striding = hoped > 0.15 * abs(path.cost)  # a step at its longest: no telling yet how far it goes
        likely = max(hoped, 0.5 * hoped)  # what it is said to become longer by is too much, from afar
        return not striding and path.cost - likely > self.beat


@dataclass(frozen=True)
class SqpSolution:
    """Last accepted iterate, how it ended, iterations and quadratic programmes used, wall time in s."""

    iterate: Iterate
    status: Status
    iterations: int
    programmes: int
    wall_time: float


@dataclass(frozen=True)
class Attempt:
    """The result of an iteration.

    trial: where it leads, None if nowhere. predicted: improvement of the merit that was hoped for, gained: that it
    brought, hoped: of the objective alone. slack: violation that was to be left. share: of the step that was taken.
    unseen: rows that were left out and came near. prices: (N, m) of the rows of each block, if they are asked for.
    programmes: that were solved. beaten: whether the search ends here (see `SqpOptions`).
    """

    trial: Iterate | None
    predicted: float
    gained: float
    hoped: float
    slack: float
    share: float
    unseen: tuple[Mask, ...]
    prices: tuple[Array, ...]
    programmes: int
    beaten: bool = False

    @property
    def ratio(self) -> float:
        return self.gained / max(self.predicted, 1e-12)


def minimise(programme: Programme, start: Iterate, options: SqpOptions, trust: Trust | None = None) -> SqpSolution:
    """Local optimum from a start, which may violate conditions. trust: how far the first steps may go."""
    begun = time.perf_counter()
    trust = replace(trust or Trust(), penalty=options.penalty, least_damping=options.least_damping)
    path, forced = start, tuple(np.zeros(block.values.shape, dtype=bool) for block in start.blocks)
    prices: tuple[Array, ...] = ()
    code, idle, programmes, done = "iteration_limit", 0, 0, 0
    while done < options.iterations:
        done += 1
        depth = np.broadcast_to(trust.depth, len(path.blocks))
        masks = [block.near(d) | more for block, d, more in zip(path.blocks, depth, forced, strict=True)]
        attempt = _attempt(programme, path, masks, trust, prices, options)
        if attempt is None:
            programmes += 1
            trust.failed()
            if trust.hopeless:
                code = "stalled"
                break
            continue
        programmes, prices = programmes + attempt.programmes, attempt.prices
        if attempt.beaten:
            code = "beaten"
            break
        enough = options.gain * programme.objective.scale(path.point, path.cost)
        forced = tuple(mask | more for mask, more in zip(forced, attempt.unseen, strict=True))
        if attempt.trial is not None and attempt.ratio > 0.01:
            before, path = path, attempt.trial
            forced = tuple(mask & (b.values > -options.kept) for mask, b in zip(forced, path.blocks, strict=True))
            trust.accepted(attempt.ratio, attempt.share, _change(before, path))
            idle = idle + 1 if attempt.gained < enough else 0
            mended = options.mending
        else:
            trust.rejected()
            idle += attempt.predicted < enough
            mended = False
        little = (3.0 if path is attempt.trial else 6.0) * enough  # a step that led nowhere says less
        if path.violation <= options.violation and (mended or attempt.hoped < little):
            idle = 2
        if idle >= 2 or trust.hopeless:
            if path.violation > options.violation and trust.dearer():
                idle = 0
                continue
            code = "optimal" if idle >= 2 else "stalled"
            break
        if options.watch.over():
            code = options.watch.ended
            break
    sought = programme.objective.sought
    return SqpSolution(path, _status(code, path, options, sought), done, programmes, time.perf_counter() - begun)


@np.errstate(over="ignore", invalid="ignore")  # a trial that went far astray is not taken
def _attempt(
    programme: Programme,
    path: Iterate,
    masks: Sequence[Mask],
    trust: Trust,
    prices: Sequence[Array],
    options: SqpOptions,
) -> Attempt | None:
    """One iteration: the step of the quadratic programme, corrected where the rows bend, if it brings less than a
    share of what was hoped for; None without a step."""
    rows = programme.linearised(path, masks)
    subproblem = programme.subproblem(path, trust, prices)
    solved = subproblem.solve(rows)
    if solved is None:
        return None
    step, slack, worth = solved
    trust.priced(slack, float(worth.sum()))
    priced = rows.by_block(worth, path.blocks)
    hoped = path.cost - programme.objective.expected(programme.curve, path.point, path.cost, step)
    predicted = hoped + trust.penalty * (path.violation - slack)
    merit = path.merit(trust.penalty)
    unseen = tuple(np.zeros(block.values.shape, dtype=bool) for block in path.blocks)
    if options.beaten(path, hoped):
        return Attempt(None, predicted, -np.inf, hoped, slack, 1.0, unseen, priced, 1, beaten=True)
    trial, share, programmes = programme.moved(path, step), 1.0, 1
    if (
        trial is not None
        and merit - trial.merit(trust.penalty) < options.poor * predicted
        and trial.violation > max(options.bent, 2 * slack)
    ):
        # Rows that were thought to be far away join, linearised where the others were.
        unseen = tuple(b.joining(m) for b, m in zip(trial.blocks, masks, strict=True))
        rows = rows.and_also(programme.linearised(path, unseen))
        bent = programme.corrected(rows, trial, step).and_also(programme.beyond_kinks(path, trial))
        second = subproblem.solve(bent)
        programmes = 2
        trial, share = _along_arc(programme, path, trial, step, second, slack, predicted, trust.penalty)
    gained = -np.inf if trial is None else merit - trial.merit(trust.penalty)
    return Attempt(trial, predicted, gained, hoped, slack, share, unseen, priced, programmes)


def _along_arc(
    programme: Programme,
    path: Iterate,
    trial: Iterate,
    step: Array,
    second: tuple[Array, float, Array] | None,
    slack: float,
    predicted: float,
    penalty: float,
) -> tuple[Iterate, float]:
    """The best of a step, of the corrected one, and of a point on the way x + a d + a^2 (d_c - d); and its share a.

    Along that arc the violation left at its end shrinks like a^3, along a straight line like a^2.
    """
    bend, power = np.zeros_like(step), 2
    corrected = None if second is None else programme.moved(path, second[0])
    if second is not None and corrected is not None and corrected.merit(penalty) < trial.merit(penalty):
        trial, bend, power = corrected, second[0] - step, 3
    if path.merit(penalty) - trial.merit(penalty) >= 0.3 * predicted:
        return trial, 1.0
    left = max(trial.violation - max(path.violation, slack), 1e-12)
    best = (max(predicted, 0.0) / (power * penalty * left)) ** (1 / (power - 1))
    share = float(np.clip(best, 0.1, 0.8))
    third = programme.moved(path, share * step + share**2 * bend)
    if third is not None and third.merit(penalty) < trial.merit(penalty):
        return third, share
    return trial, 1.0


def _change(before: Iterate, after: Iterate) -> Array:
    """(B,) largest change of a row of each block that was not far from its edge."""
    pairs = zip(before.blocks, after.blocks, strict=True)
    return np.array([np.abs(b.values - a.values)[a.values > -min(1.0, a.reach)].max(initial=0.0) for a, b in pairs])


def _status(code: str, path: Iterate, options: SqpOptions, sought: str) -> Status:
    value, name = path.worst
    if value <= options.violation:
        return Status(code, f"At the nodes the {sought} motion takes {path.duration:.4f} s.", True)
    sentence = f"No safe motion was found: the best attempt violates {violated(path.blocks)}."
    return Status("infeasible", sentence, False, {"worst": name, "violation": value})
