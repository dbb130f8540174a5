"""What a motion must keep for the sake of a liquid: that it stays below the brim of its container."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from salver.geometry import Array, Indices
from salver.models.bodies import Body
from salver.models.tray_motion import FULL_SPEED, Speed
from salver.planning.fastest.constraints import FINEST, Block, Constraint, Gradient
from salver.planning.fastest.evaluation import MotionEvaluation
from salver.sensitivity.slosh_rows import of_parts
from salver.sensitivity.sloshing import LIGHTEST, Slosh
from salver.sensitivity.wave_gradients import Unknowns


@dataclass(frozen=True, eq=False)
class Brim(Constraint):
    """A body's liquid stays below its brim, during the motion and after it, in all its cases; no wave is steeper than
    the model is valid for. In units of the room that it has, of which `margin` is kept. calm: share of the
    steepest that may be left. speed: at which, above 0."""

    body: Body
    margin: float = 0.0
    calm: float = 1.0
    speed: Speed = FULL_SPEED

    def blocks(self, motion: MotionEvaluation) -> Iterator[Block]:
        parts = motion.at_factor(self.speed.factor).sloshing[self.body.name]
        last, words = motion.nodes[-1:], self.speed.words
        which = [part.waves.cases for part in parts]
        liquid = which[0].liquid

        def block(
            name: str, values: Array, scale: Array, by: Callable[..., Array], bends: Callable[..., Array]
        ) -> Block:
            """values (K, N) and their scale (K,), cases part after part."""

            def history(i: Indices, f: Indices, unknowns: Unknowns) -> Array:
                found = np.zeros((len(i), unknowns.felt.shape[2]))
                for part, case, mine in of_parts(parts, f):
                    found[mine] = by(part, case, i[mine], unknowns)
                return found / scale[f, None]

            def curvature(i: Indices, f: Indices, unknowns: Unknowns) -> Array:
                each = [(mine, bends(part, case, i[mine], unknowns)) for part, case, mine in of_parts(parts, f)]
                found = np.concatenate([factors for _, factors in each])
                found[np.concatenate([mine for mine, _ in each])] = found.copy()
                return found / np.sqrt(scale[f, None, None])

            rows = (values / scale[:, None] - 1).T
            found = Block(
                name + words,
                rows,
                _nothing(motion.n),
                last,
                history=history,
                curvature=curvature,
                kinked=True,
                factor=self.speed.factor,
            )
            if len(rows) == 1:
                return found.having(margins=(0.03 + self.margin, finest))  # all of what follows adds up to what is left
            margins = (5e-3 + self.margin, finest)  # between nodes waves are driven by what was interpolated
            return found.having(points=motion.nodes, margins=margins, most=most, reach=0.1)

        def joined(values: Iterable[Array]) -> Array:
            return np.concatenate(list(values))

        finest = max(self.margin, FINEST)
        most = 2 if len(motion.sloshing) < 2 else 1  # those of a fill and a damping are alike
        name, room = self.body.name, joined(x.room for x in which)
        steepest = joined(x.steepest for x in which)
        yield block(
            f"steepness in {name}", joined(x.free_height for x in parts), steepest, Slosh.free_by, Slosh.free_bends
        )
        light, lightest = joined(x.lightness for x in parts), np.full(len(steepest), LIGHTEST)
        yield block(f"effective gravity in {name}", light, lightest, Slosh.lightness_by, Slosh.lightness_bends)
        after = joined(x.free_left for x in parts)[:, None]
        yield block(f"steepness left in {name}", after, self.calm * steepest, _free_left_by, _free_left_bends)
        if np.isfinite(room).all():
            yield block(f"waves in {name}", joined(x.crest for x in parts), room, Slosh.crest_by, Slosh.crest_bends)
        ends: list[tuple[float | None, str, Array]] = [(None, f"waves left in {name}", room)]
        ends += [(liquid.within, f"settled waves in {name}", np.full(len(room), liquid.settled))]
        for seconds, said, limit in ends:
            if np.isfinite(limit).all():
                left = joined(x.left(seconds) for x in parts)[:, None]
                yield block(said, left, limit, partial(_left_by, seconds), partial(_left_bends, seconds))


def _left_by(seconds: float | None, part: Slosh, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
    return part.left_by(case, unknowns, seconds)


def _free_left_by(part: Slosh, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
    return part.free_left_by(case, unknowns)


def _free_left_bends(part: Slosh, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
    return part.free_left_bends(case, unknowns)


def _left_bends(seconds: float | None, part: Slosh, case: Indices, node: Indices, unknowns: Unknowns) -> Array:
    return part.left_bends(case, unknowns, seconds)


def _nothing(n: int) -> Gradient:
    return lambda i, f: np.zeros((len(i), 4 * n))
