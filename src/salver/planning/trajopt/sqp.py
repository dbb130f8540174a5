"""Sequential quadratic programming on the coefficients of a motion and the scalar of its objective.

Each iteration takes the step of a quadratic programme (`programme`). A second-order correction (the same rows with
their true values at the trial point; Fletcher 1982) allows long steps. It includes rows that were left out because
they were far from their limit, and rows behind kinks.
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

    iterations: at most. watch: may end the search early. gain: relative improvement below which the search ends;
    doubled, it ends up to twice as far from the optimum. violation: largest violation of a row, with its margin, that
    counts as converged; doubled, more is left to added nodes. penalty: initial penalty on the violation, in the unit of
    the objective; it is adapted at every step. least_damping: of the proximal term. mending: whether to end with the
    first step that satisfies all rows. thorough: whether the search goes on after a step that was predicted to worsen
    the objective, as those are that remove a violation; it need not be near the optimum. poor, bent: a second-order
    correction is tried when a step brings less than the share `poor` of the predicted improvement, or violates rows by
    `bent` more than the subproblem predicts. kept: a row that was added is removed when it is further from its limit
    than this; doubled, programmes have more rows. beat: the search ends when no objective below this is to be expected.
    """

    iterations: int = 60
    watch: Watch = field(default_factory=Watch)
    gain: float = 1e-4
    violation: float = 5e-4
    penalty: float = 20.0
    least_damping: float = 1e-5
    mending: bool = False
    thorough: bool = False
    poor: float = 0.8
    bent: float = 2e-4
    kept: float = 0.3
    beat: float = np.inf

    def beaten(self, path: Iterate, hoped: float) -> bool:
        """Whether an almost feasible iterate, with a predicted improvement `hoped`, is unlikely to get below `beat`."""
        if path.violation >= 0.05:  # repairing it mostly takes a longer duration, but how long is unknown
            return False
        striding = hoped > 0.15 * abs(path.cost)  # a step of the largest size: the total improvement is still unknown
        likely = max(hoped, 0.5 * hoped)  # a predicted increase is an overestimate far from the optimum
        return not striding and path.cost - likely > self.beat


@dataclass(frozen=True)
class SqpSolution:
    """Result: last accepted iterate, status, numbers of iterations and of quadratic programmes, wall time in s."""

    iterate: Iterate
    status: Status
    iterations: int
    programmes: int
    wall_time: float


@dataclass(frozen=True)
class Attempt:
    """The result of an iteration.

    trial: the new iterate, or None. predicted, gained: predicted and actual improvement of the merit function. hoped:
    predicted improvement of the objective alone. slack: predicted remaining violation. share: of the step that was
    taken. unseen: rows that were left out and came near their limit. programmes: number solved. beaten: whether the
    search ends here (see `SqpOptions`).
    """

    trial: Iterate | None
    predicted: float
    gained: float
    hoped: float
    slack: float
    share: float
    unseen: tuple[Mask, ...]
    programmes: int
    beaten: bool = False

    @property
    def ratio(self) -> float:
        return self.gained / max(self.predicted, 1e-12)


def minimise(programme: Programme, start: Iterate, options: SqpOptions, trust: Trust | None = None) -> SqpSolution:
    """Local optimum from a start, which may violate constraints. trust: initial trust region."""
    begun = time.perf_counter()
    trust = replace(trust or Trust(), penalty=options.penalty, least_damping=options.least_damping)
    path, forced = start, tuple(np.zeros(block.values.shape, dtype=bool) for block in start.blocks)
    code, idle, programmes, done = "iteration_limit", 0, 0, 0
    while done < options.iterations:
        done += 1
        depth = np.broadcast_to(trust.depth, len(path.blocks))
        masks = [block.near(d) | more for block, d, more in zip(path.blocks, depth, forced, strict=True)]
        attempt = _attempt(programme, path, masks, trust, options)
        if attempt is None:
            programmes += 1
            trust.failed()
            if trust.hopeless:
                code = "stalled"
                break
            continue
        programmes += attempt.programmes
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
        little = (3.0 if path is attempt.trial else 6.0) * enough  # a rejected step is weaker evidence
        hoped = abs(attempt.hoped) if options.thorough else attempt.hoped
        if path.violation <= options.violation and (mended or hoped < little):
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


@np.errstate(over="ignore", invalid="ignore")  # a diverging trial is rejected
def _attempt(
    programme: Programme, path: Iterate, masks: Sequence[Mask], trust: Trust, options: SqpOptions
) -> Attempt | None:
    """One iteration: the step of the quadratic programme, with a second-order correction if it brings less than a share
    of the predicted improvement; None if the programme failed."""
    rows = programme.linearised(path, masks)
    subproblem = programme.subproblem(path, trust)
    solved = subproblem.solve(rows)
    if solved is None:
        return None
    step, slack, worth = solved
    trust.priced(slack, float(worth.sum()))
    hoped = path.cost - programme.objective.expected(programme.curve, path.point, path.cost, step)
    predicted = hoped + trust.penalty * (path.violation - slack)
    merit = path.merit(trust.penalty)
    unseen = tuple(np.zeros(block.values.shape, dtype=bool) for block in path.blocks)
    if options.beaten(path, hoped):
        return Attempt(None, predicted, -np.inf, hoped, slack, 1.0, unseen, 1, beaten=True)
    trial, share, programmes = programme.moved(path, step), 1.0, 1
    if (
        trial is not None
        and merit - trial.merit(trust.penalty) < options.poor * predicted
        and trial.violation > max(options.bent, 2 * slack)
    ):
        # Rows that were left out as far from their limit are added, linearised at the same iterate.
        unseen = tuple(b.joining(m) for b, m in zip(trial.blocks, masks, strict=True))
        rows = rows.and_also(programme.linearised(path, unseen))
        bent = programme.corrected(rows, trial, step).and_also(programme.beyond_kinks(path, trial))
        second = subproblem.solve(bent)
        programmes = 2
        trial, share = _along_arc(programme, path, trial, step, second, slack, predicted, trust.penalty)
    gained = -np.inf if trial is None else merit - trial.merit(trust.penalty)
    return Attempt(trial, predicted, gained, hoped, slack, share, unseen, programmes)


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
    """The best of the step, the corrected step, and a point on the arc x + a d + a^2 (d_c - d); and its share a.

    Along that arc the violation shrinks like a^3, along a straight line like a^2.
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
    """Largest change (B,) of the rows near their limit, in each block."""
    pairs = zip(before.blocks, after.blocks, strict=True)
    return np.array([np.abs(b.values - a.values)[a.values > -min(1.0, a.reach)].max(initial=0.0) for a, b in pairs])


def _status(code: str, path: Iterate, options: SqpOptions, sought: str) -> Status:
    value, name = path.worst
    if value <= options.violation:
        return Status(code, f"At the nodes the {sought} motion takes {path.duration:.4f} s.", True)
    sentence = f"No safe motion was found: the best attempt violates {violated(path.blocks)}."
    code = "beaten" if code == "beaten" else "infeasible"
    return Status(code, sentence, False, {"worst": name, "violation": value})
