"""What the joints did, on the plan's clock: a log with its time shift and its noise taken off.

Two differentiations of a joint angle turn 20 micro-radians of noise at 1 kHz into tens of rad/s^2. So not the angle is
smoothed, but the *deviation* from the plan, and of that only what does not follow from the plan: first each joint's is
fitted (least squares) with the answers of second-order lags to what the plan asks of that joint, its velocity, its
acceleration and its direction (friction), or with what else is expected of the arm (`Expected`); their derivatives are
exact. The lag that fits best is then made to fit better: its rate, its damping, its delay (Gauss and Newton). What is
left is smoothed in the cosine transform by 1 / (1 + (f / f_c)^6) (Garcia 2010, "Robust smoothing of gridded data").
What of each joint is fitted, and f_c, is what is most likely of a deviation whose spectrum falls so and white noise
(Patterson and Thompson 1971; Schwarz 1978): cross-validation took noise for motion in one of twenty logs. What is left
over then is the noise.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.fft import dct, dst, idct
from scipy.optimize import minimize_scalar

from salver.errors import FileFormatError
from salver.geometry import Array
from salver.models.arm import ArmModel
from salver.motion_files import JointSamples, read
from salver.motion_files.samples import reordered
from salver.sensitivity.filter import LinearFilter
from salver.trajectory import JointMotion

ORDER = 6  # of the smoother: noise falls faster than two differentiations raise it
SLOWEST = 2.0  # Hz, cut-off
FASTEST = 0.4  # of the sampling rate,
OFTEN = 400.0  # samples a second that are enough
SEEN = 80.0  # Hz, and at most: what is faster moves a joint, and the load, by next to nothing
LAGS = (4.0, 6.0, 9.0, 13.0, 20.0, 30.0)  # Hz, of lags whose answers are fitted,
DAMPINGS = (0.4, 0.7, 1.0)  # and of critical
ALIKE = 1e-6  # shapes that differ by less are one
STILL = 0.02  # rad/s around standstill over which friction changes its sign
CUTS = 40  # cut-offs tried
STEPS = 4  # in which a lag is made to fit
RATES, DAMPED = (12.0, 400.0), (0.1, 2.0)  # rad/s, and of critical: of what a lag may be
SPARSE = 90.0  # samples a second; with fewer nothing is known of what shakes a load
LONGEST = 600.0  # s of a log
GAP = 0.03  # s
ASTRAY = 0.5  # rad that a joint may be off the plan: beyond, it is another motion
ALIEN, FAR = 0.3, 0.3  # of its way that a joint may be off, and rad that count as a way
EXACT = 1e-7  # rad from the plan: no arm does that
PACE = 0.03  # by which a run may be slower than planned
RESTS = 0.06  # rad/s at which the arm rests
RESTING = 0.04  # s at the end
AFTER = 0.6  # s after the motion that are looked at
BEFORE = 0.3
UNSEEN = 1e-3  # rad of the motion that may lie beyond an end of the log
MOVES = 0.02  # rad that some joint must move, for a motion


@dataclass(frozen=True, eq=False)
class Executed:
    """K instants t (K,), s on the plan's clock. q, dq, ddq (K, n): smoothed. off (K, n): smoothed deviation from the
    plan, rad. noise (n,): standard deviation of a sample of noisy, rad. cut (n,): Hz, up to which it was followed.

    shift: s by which the log is later than the plan. noisy (K, n): the deviation as it was
    logged, means of `each` samples where there were more than are needed.
    """

    source: str
    t: Array
    q: Array
    dq: Array
    ddq: Array
    off: Array
    noise: Array
    cut: Array
    shift: float
    noisy: Array
    plan: JointMotion
    answers: tuple[Answers, ...]
    each: int

    @property
    def step(self) -> float:
        return float(self.t[1] - self.t[0])

    @property
    def fastest(self) -> float:
        """Hz, above which nothing was looked for."""
        return min(FASTEST / self.step, SEEN)

    def again(self, noisy: Array, wider: float = 1.0) -> Executed:
        """The same with another logged deviation (K, n), smoothed anew; followed up to so many times the frequency that
        validation would have."""
        return _smoothed(self.source, self.t, noisy, self.shift, self.plan, self.answers, self.each, wider)


Shapes = tuple[list[list[Array]], list[list[Array]]]
"""Sets of shapes (3, K, n), deviations with two derivatives: of one multiple for all joints; of one for each."""
Expected = Callable[[Array, JointMotion], Shapes]
"""Of times t (K,) and a plan."""


@dataclass(frozen=True, eq=False)
class Answers:
    """What each joint would deviate for one reason: m shapes (3, n, K, m) with first and second derivatives, the least
    squares by them (n, m, K), and what comes before them (3, K, n)."""

    shapes: Array
    solve: Array
    base: Array

    @classmethod
    def along(cls, t: Array, plan: JointMotion, noisy: Array, expected: Expected | None) -> tuple[Answers, ...]:
        """None; each of some lags, without and with friction; what else is expected; and for each joint the lag that
        fits a deviation noisy (K, n) best. Which it is, is found for each joint."""
        here = np.stack(plan.sample(t))
        out, lags = [cls.of([], here)], [Lag(2 * np.pi * hertz, damping) for hertz in LAGS for damping in DAMPINGS]
        for lag in lags:
            z, friction, _ = lag.answer(t, plan, slice(None))
            jerk = lag.rate**2 * (z.asked[1] - z.z[1]) - lag.kd * z.z[2]
            snap = lag.rate**2 * (z.asked[2] - z.z[2]) - lag.kd * jerk
            shapes = [z.z - here, np.stack([z.z[1], z.z[2], jerk]), np.stack([z.z[2], jerk, snap])]
            out += [cls.of(shapes, here), cls.of([*shapes, friction], here)]
        left = np.array([np.sum((noisy - answer.fitted(noisy)[0]) ** 2, axis=0) for answer in out[1::2]])
        bases, tangents = [], []
        for j, best in enumerate(np.argmin(left, axis=0)):
            base, tangent = lags[best].fitted(t, plan, noisy[:, j], j)
            bases.append(base)
            tangents.append(tangent)
        base, each = np.stack(bases, axis=2), [np.stack(x, axis=2) for x in zip(*tangents, strict=True)]
        out += [cls.of(each[:3], here, base), cls.of(each, here, base)]
        shared, own = ([], []) if expected is None else expected(t, plan)
        for shapes in shared:
            columns = np.stack([x[0].ravel() for x in shapes], axis=1)
            multiples = np.linalg.lstsq(columns / np.linalg.norm(columns, axis=0), noisy.ravel(), rcond=ALIKE)[0]
            base = np.einsum("m,mdkj->dkj", multiples / np.linalg.norm(columns, axis=0), np.stack(shapes))
            out.append(cls.of([], here, base))
        out += [cls.of(shapes, here) for shapes in own]
        return tuple(out)

    @classmethod
    def of(cls, found: list[Array], like: Array, base: Array | None = None) -> Answers:
        shapes = np.moveaxis(np.stack(found, axis=3) if found else like[..., None][..., :0], 1, 2)
        size = np.linalg.norm(shapes[0], axis=1)[None, :, None]
        shapes = shapes / np.where(size > 0, size, 1.0)
        count, width = shapes.shape[2:]
        solve = np.linalg.pinv(shapes[0], rcond=ALIKE) if width else np.zeros((len(shapes[0]), 0, count))
        return cls(shapes, solve, np.zeros_like(like) if base is None else base)

    def fitted(self, off: Array) -> Array:
        """(3, K, n) of a deviation (K, n) what these shapes make of it."""
        by = np.einsum("jmk,kj->jm", self.solve, off - self.base[0])
        return self.base + np.einsum("djkm,jm->dkj", self.shapes, by)


@dataclass(frozen=True, eq=False)
class Answer:
    """asked, z (3, K, m): what a lag was asked, and what it did."""

    asked: Array
    z: Array


@dataclass(frozen=True)
class Lag:
    """Of the second order: rate, rad/s; damping, of critical; delay, s, beyond that of the whole arm."""

    rate: float
    damping: float
    delay: float = 0.0

    @property
    def kd(self) -> float:
        return 2 * self.damping * self.rate

    def answer(self, t: Array, plan: JointMotion, joints: slice) -> tuple[Answer, Array, tuple[Array, Array]]:
        """What it makes of some joints of a plan, of their friction (3, K, m), and its derivatives by the logarithm of
        its rate and by its damping. It was asked so much earlier that it is late by nothing but its delay."""
        lag = LinearFilter.on_nodes(t, self.rate**2, self.kd, 3)

        def respond(drive: Array) -> Array:
            x, v = lag.respond(drive)
            return np.stack([x, v, lag.acceleration(drive, x, v)])

        early = 2 * self.damping / self.rate
        asked = np.stack([x[:, joints] for x in plan.sample(t + early - self.delay)])
        z = asked + respond(-asked[2] - self.kd * asked[1])
        friction = respond(np.tanh(plan.sample(t)[1][:, joints] / STILL))
        # d/d(log rate) and d/d(damping) of z'' + kd z' + rate^2 (z - asked) = 0, with what is asked as early as that.
        by_rate = respond(2 * self.rate**2 * (asked[0] - z[0] - 0.5 * early * asked[1]) - self.kd * z[1])
        by_damping = respond(2 * self.rate * (asked[1] - z[1]))
        return Answer(asked, z), friction, (by_rate, by_damping)

    def fitted(self, t: Array, plan: JointMotion, off: Array, joint: int) -> tuple[Array, list[Array]]:
        """The deviation (3, K) of a lag made to fit that of a joint (K,), and what it changes by (3, K): with the
        logarithm of its rate, its damping, its delay; and friction."""
        here, one = np.stack(plan.sample(t))[:, :, joint], slice(joint, joint + 1)
        lag, found = self, (np.inf, np.zeros_like(here), list[Array]())
        step = np.zeros(3)
        for _ in range(STEPS):
            answer, friction, (by_rate, by_damping) = lag.answer(t, plan, one)
            z = answer.z[:, :, 0]
            jerk = lag.rate**2 * (answer.asked[1, :, 0] - z[1]) - lag.kd * z[2]
            tangents = [by_rate[..., 0], by_damping[..., 0], -np.stack([z[1], z[2], jerk]), friction[..., 0]]
            left = off - (z - here)[0]
            size = float(left @ left)
            if size >= found[0]:
                break
            found = size, z - here, tangents
            step = np.linalg.lstsq(np.stack([x[0] for x in tangents], axis=1), left, rcond=ALIKE)[0]
            rate = float(np.clip(lag.rate * np.exp(np.clip(step[0], -0.3, 0.3)), *RATES))
            damping = float(np.clip(lag.damping + np.clip(step[1], -0.2, 0.2), *DAMPED))
            lag = Lag(rate, damping, lag.delay + float(np.clip(step[2], -0.01, 0.01)))
        return found[1], found[2]


def read_joints(path: str | Path, arm: ArmModel, topic: str | None = None) -> JointSamples:
    """A log of an arm's joints from any motion file. Raises FileFormatError."""
    samples = read(path, lambda: arm.joint_names, topic)
    if not isinstance(samples, JointSamples):  # a table may have the tray and the joints
        samples = read(path, lambda: arm.joint_names, topic, as_path=True)
    if not isinstance(samples, JointSamples):
        raise FileFormatError(f"{path} holds a motion of the tray; the joints' is needed: columns q1 to q{arm.n}, rad.")
    if samples.q.shape[1] < arm.n:
        raise FileFormatError(f"{path} has {samples.q.shape[1]} joints; {arm.name} has {arm.n}.")
    return reordered(samples, tuple(arm.joint_names))


def executed(plan: JointMotion, samples: JointSamples, expected: Expected | None = None) -> Executed:
    """What a log (in the arm's order of joints) says was done of a plan. Raises FileFormatError, one sentence."""
    t, q, source = samples.t, samples.q, samples.source
    _check(t, q, plan, source)
    shift = lateness(t, q, plan)
    off = q - plan.sample(t - shift)[0]
    first, last = shift, shift + plan.duration
    step = float(np.median(np.diff(t)))
    moving = (t >= first) & (t <= last)
    _is_of(plan, t[moving] - shift, off[moving], source)
    seen = plan.sample(np.array([0.0, t[0] - shift, t[-1] - shift, plan.duration]))[0]
    for k, missing in ((0, f"begins {t[0] - first:.3f} s after"), (2, f"ends {last - t[-1]:.3f} s before")):
        if np.abs(seen[k + 1] - seen[k]).max() > UNSEEN:
            raise FileFormatError(
                f"{source} {missing} the motion does; it must hold the whole motion, with rest around it."
            )
    kept = (t >= first - BEFORE) & (t <= last + AFTER)
    t, off = t[kept] - shift, off[kept]
    even = t[0] + step * np.arange(int((t[-1] - t[0]) / step + 1e-6) + 1)
    if len(even) != len(t) or np.abs(even - t).max() > 0.05 * step:
        off, t = np.stack([np.interp(even, t, column) for column in off.T], axis=1), even
    last_ones = t > t[-1] - RESTING
    speed = float(np.abs(np.polyfit(t[last_ones], off[last_ones] + plan.sample(t[last_ones])[0], 1)[0]).max())
    if speed > RESTS:
        raise FileFormatError(
            f"{source} ends while a joint still moves at {speed:.2g} rad/s; record until the arm rests, some 0.3 s on."
        )
    every = max(1, int(1 / (OFTEN * step)))
    if every > 1:  # means of some samples: what is slower than SEEN stays as it is
        whole = len(t) // every * every
        t, off = t[:whole].reshape(-1, every).mean(axis=1), off[:whole].reshape(-1, every, off.shape[1]).mean(axis=1)
    return _smoothed(source, t, off, shift, plan, Answers.along(t, plan, off, expected), every)


def _is_of(plan: JointMotion, t: Array, off: Array, source: str) -> None:
    """Whether a deviation (K, n) from the plan is that of a robot which did it, as planned."""
    worst, each = float(np.abs(off).max()), np.abs(off).max(axis=0)
    if worst > ASTRAY or (each > ALIEN * np.maximum(np.ptp(plan.q, axis=0), FAR)).any():
        raise FileFormatError(
            f"{source}: a joint is {worst:.3g} rad from the plan, and at most {ASTRAY:g} and a third of its way are "
            "accepted: another motion, another speed, another order of joints, or a robot that is not controlled."
        )
    if worst < EXACT:
        raise FileFormatError(
            f"{source} is the plan itself to {worst:.1g} rad: these are joints as commanded; they must be as measured."
        )
    late = plan.sample(t)[1]
    # A slower run is later the longer it lasts.
    rows = [np.einsum("k,kj->kj", (t - t.mean()), late).ravel(), *(_only(late, j) for j in range(late.shape[1]))]
    slower = -float(np.linalg.lstsq(np.stack(rows, axis=1), off.ravel(), rcond=1e-9)[0][0])
    if abs(slower) > PACE:
        raise FileFormatError(
            f"{source} is of a run {100 * abs(slower):.0f} % {'slower' if slower > 0 else 'quicker'} than planned; "
            "carry the plan out at its own speed (no speed override)."
        )


def _only(values: Array, j: int) -> Array:
    out = np.zeros_like(values)
    out[:, j] = values[:, j]
    return out.ravel()


def _check(t: Array, q: Array, plan: JointMotion, source: str) -> None:
    if t[-1] > LONGEST:
        raise FileFormatError(f"{source} is {t[-1]:.0f} s long; at most {LONGEST:.0f} are accepted: cut it.")
    if (len(t) - 1) / t[-1] < SPARSE:
        raise FileFormatError(
            f"{source} has {(len(t) - 1) / t[-1]:.0f} samples a second; at least {SPARSE:.0f} are needed to see what "
            "shakes a load."
        )
    step = np.diff(t)
    if step.max() > GAP:
        k = int(np.argmax(step))
        raise FileFormatError(f"{source} has no samples for {step[k]:.3g} s after t = {t[k]:.3f} s; at most {GAP:g}.")
    if np.ptp(q, axis=0).max() < MOVES:
        raise FileFormatError(f"{source} has no motion in it: no joint moves by {MOVES:g} rad.")
    if np.abs(q).max() > 12 and np.abs(np.ptp(np.deg2rad(q), axis=0) - np.ptp(plan.q, axis=0)).max() < ASTRAY:
        raise FileFormatError(f"{source}: its joint positions are in degrees; they must be in rad.")


def lateness(t: Array, q: Array, plan: JointMotion) -> float:
    """By how much the log is later, least squares of all joints; the arm is held still beyond both ends."""
    at = np.linspace(0.0, plan.duration, 60)
    wanted = plan.sample(at)[0]

    def miss(shifts: Array) -> Array:
        when = at[:, None] + shifts
        return np.asarray(
            sum(np.sum((np.interp(when, t, x) - y[:, None]) ** 2, axis=0) for x, y in zip(q.T, wanted.T, strict=True))
        )

    tried = np.arange(t[0] - 0.5 * plan.duration, t[-1] - 0.5 * plan.duration, 0.005)
    best = float(
        tried[int(np.argmin(np.concatenate([miss(part) for part in np.array_split(tried, 1 + len(tried) // 4000)])))]
    )
    found = minimize_scalar(
        lambda s: float(miss(np.array([s]))[0]), bounds=(best - 0.01, best + 0.01), method="bounded"
    )
    return float(found.x)


def _smoothed(
    source: str,
    t: Array,
    noisy: Array,
    shift: float,
    plan: JointMotion,
    answers: tuple[Answers, ...],
    each: int,
    wider: float = 1.0,
) -> Executed:
    count, step = len(t), float(t[1] - t[0])
    f = np.arange(count) / (2 * count * step)
    cuts = np.geomspace(SLOWEST, min(FASTEST / step, SEEN), CUTS)
    gains = 1 / (1 + (f / cuts[:, None]) ** ORDER)  # (cuts, K)
    fits = np.stack([answer.fitted(noisy) for answer in answers])  # (models, 3, K, n)
    coefficients = dct(noisy - fits[:, 0], axis=1, norm="ortho")
    slow = (f[1:] / cuts[:, None]) ** ORDER
    lost = slow / (1 + slow)  # 1 - gains, which is 0 to rounding in a long log; the constant is free
    left = lost @ coefficients[:, 1:] ** 2  # (models, cuts, n)
    left = np.maximum(left, np.finfo(float).tiny)  # a joint may have done exactly what was planned
    taken = np.array([answer.shapes.shape[3] for answer in answers])[:, None, None]
    free = np.maximum(count - 1 - taken, 1)
    unlikely = free * np.log(left / free) - np.log(lost).sum(axis=1)[:, None] + taken * np.log(count)
    likely = np.exp(0.5 * (unlikely.min(axis=(0, 1)) - unlikely))
    likely /= likely.sum(axis=(0, 1))
    noise = np.sqrt(np.sum(likely * left / free, axis=(0, 1)))
    followed = np.minimum(wider * cuts, cuts[-1])
    gains = 1 / (1 + (f / followed[:, None]) ** ORDER)
    kept = np.einsum("mcj,cf,mfj->fj", likely, gains, coefficients, optimize=True)
    omega = 2 * np.pi * f[:, None]
    rate = np.zeros_like(kept)
    rate[:-1] = (-omega * kept)[1:]
    off = np.einsum("mcj,mdkj->dkj", likely, fits, optimize=True) + np.stack(
        [
            idct(kept, axis=0, norm="ortho"),
            dst(rate, type=3, axis=0) / np.sqrt(2 * count),
            idct(-(omega**2) * kept, axis=0, norm="ortho"),
        ]
    )
    cut = np.exp(np.einsum("mcj,c->j", likely, np.log(followed)))
    q, dq, ddq = plan.sample(t) + off
    return Executed(source, t, q, dq, ddq, off[0], noise, cut, shift, noisy, plan, answers, each)
