"""Options of the search for the fastest motion."""

from __future__ import annotations

from dataclasses import dataclass

from salver.planning.trajopt.problem import TransportProblem


@dataclass(frozen=True)
class FastestOptions:
    """Options of the search for the fastest motion.

    A rough optimum is a local optimum with few spline pieces; the best of them are refined with all `spans`. Doubling
    `pairs`, `ways` or `starts` at most doubles the computing time and may find a shorter motion in a hard task.

    Attributes:
        spans: polynomial pieces of the motion.
        nodes_per_span: instants per piece at which the constraints are imposed; between them they are checked.
        pairs: pairs of start and goal postures from which the search begins when the start posture is free.
        ways: initial paths around obstacles: the shortest of three times as many random ones.
        starts: rough optima that are refined, and more where one is shorter than the best motion; which is taken.
        patience: the search of rough optima ends after `patience * starts` in a row without improvement.
        rough_gain: relative improvement below which the optimisation of a rough optimum stops, or another is no better.
        mendable: largest constraint violation of a rough optimum that is still refined.
        refined, near: damping of the first step after spline pieces were added, and from the optimum of a similar
            problem; larger values stay closer to it.
        iterations: limit per optimum, as a multiple of the default (60; 25 for a rough one).
        seed: seed of the random number generator.
        time_limit: s; None for no limit, which makes the result independent of the computer's speed.
    """

    spans: int = 20
    nodes_per_span: int = 2
    pairs: int = 2
    ways: int = 2
    starts: int = 1
    patience: int = 6
    rough_gain: float = 1e-2
    mendable: float = 1e-2
    refined: float = 0.5
    near: float = 0.1
    iterations: float = 1.0
    seed: int = 0
    time_limit: float | None = None

    @property
    def most(self) -> int:
        """Largest number of iterations of an optimum."""
        return round(60 * self.iterations)

    @property
    def most_roughly(self) -> int:
        """Largest number of iterations of a rough optimum."""
        return round(25 * self.iterations)

    def first(self, problem: TransportProblem) -> int:
        """Number of posture pairs that are tried first: fewer when one of the two postures is given."""
        return self.pairs if problem.start_posture is None else max(1, self.pairs // 4)


EFFORTS = {
    "quick": FastestOptions(pairs=1, ways=1),
    "normal": FastestOptions(),
    "thorough": FastestOptions(pairs=12, ways=3, starts=4, iterations=3.0),
}
