"""Past what stands in the way, on every side: paths whose middle is moved off the straight one.

Where the straight path is deepest in something, the tray is moved across its way, further and further, in each of eight
directions, level. The rest of the path follows the less, the further away. What comes of it nearly touches nothing; the
optimiser does the rest, and which side is the shortest it alone can tell.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from salver.geometry import Array, exp
from salver.planning.postures import PoseTarget, posture_at
from salver.planning.seeds.starts import ALONG, Ends, Start, straight
from salver.planning.trajopt.ends import AtPose
from salver.planning.trajopt.problem import TransportProblem
from salver.planning.trajopt.spline import min_jerk_blend

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class DetourOptions:
    """Options of the search for detours.

    sides: directions across the way in which the tray is moved; doubled, twice the work, and paths in between.
    step, furthest: m, by which it is moved, and at most; with a doubled step gaps are missed, with half of `furthest`
    ways over what is tall.
    free, deepest: m that a path should be in something at most, and may be if none is better; what is deeper is seldom
    mended by the optimiser.
    """

    sides: int = 8
    step: float = 0.05
    furthest: float = 0.5
    free: float = 0.02
    deepest: float = 0.05


USUAL = DetourOptions()


def past(problem: TransportProblem, pair: Ends, options: DetourOptions = USUAL) -> list[Start]:
    """Paths beside the straight one between a pair of ends, on each side the nearest that is nearly free."""
    keep_out = problem.keep_out
    if keep_out is None:
        return []
    u = np.linspace(0.0, 1.0, ALONG)
    line = straight(pair).path(u)
    middle = (u >= 0.2) & (u <= 0.8)  # nearer to an end a path would have to leave it sideways
    k = int(np.argmin(np.where(middle, keep_out.distances(line).min(axis=1), np.inf)))
    one = np.where(u <= u[k], min_jerk_blend(u / u[k]), min_jerk_blend((1 - u) / (1 - u[k])))[:, None]
    found = []
    for postures in _moved(problem, pair, line[k], options):
        depth, best = options.deepest, None
        for q in postures:
            if np.any(q < problem.limits.q_min) or np.any(q > problem.limits.q_max):
                break
            if keep_out.depth(q[None]) > options.free:
                continue
            for share in (one, one * (2 - one)):
                path = line + share * (q - line[k])
                deep = keep_out.depth(path[::4])  # mostly deep enough to tell
                if deep < depth:
                    deep = keep_out.depth(path)
                if deep < depth:
                    depth, best = deep, path
            if depth < options.free:
                break
        if best is not None:
            found.append(Start("path past what is in the way", best))
    return found


def _moved(problem: TransportProblem, pair: Ends, q: Array, options: DetourOptions) -> Iterator[Iterator[Array]]:
    """For each side: postures (n,) further and further to it from q."""
    arm = problem.arm
    (p_0, _), (p_1, _), (p_SE, R_SE) = (arm.tray_pose(posture) for posture in (pair.start, pair.goal, q))
    along = p_1 - p_0
    aside = np.cross(UP, along)
    if np.linalg.norm(aside) > 1e-3 * np.linalg.norm(along) > 0:
        aside /= np.linalg.norm(aside)
    else:  # straight up, or not at all
        aside = np.array([1.0, 0.0, 0.0])
    over = np.cross(along, aside)
    over = over / np.linalg.norm(over) if np.linalg.norm(over) > 0 else UP
    R_level = exp([0.0, 0.0, np.arctan2(R_SE[1, 0], R_SE[0, 0])])
    for angle in 2 * np.pi * np.arange(options.sides) / options.sides:
        yield _shifted(problem, q, p_SE, np.cos(angle) * aside + np.sin(angle) * over, R_level, options)


def _shifted(
    problem: TransportProblem, q: Array, p_SE: Array, direction: Array, R_SE: Array, options: DetourOptions
) -> Iterator[Array]:
    for away in np.arange(options.step, options.furthest + 1e-9, options.step):
        new = _posture(problem, p_SE + away * direction, R_SE, q)
        if new is None:
            return
        yield new
        q = new


def _posture(problem: TransportProblem, p_SE: Array, R_SE: Array, q: Array) -> Array | None:
    """The posture (n,) near q with the tray at a pose, which way it points left open where the goal leaves it open."""
    yaw_free = isinstance(problem.goal, AtPose) and problem.goal.target.yaw_free
    target = PoseTarget(p_SE, R_SE, yaw_free=yaw_free)
    new, missed = posture_at(problem.arm, target, q, limits=problem.limits, iterations=15)  # from one near by
    return new if missed < 1e-6 and np.abs(new - q).max() < 0.8 else None  # rad; beyond is another branch
