"""The executed joint motion on the plan's clock: a log without its time shift and its noise.

Two differentiations of a joint angle turn 20 micro-radians of noise at 1 kHz into tens of rad/s^2. Therefore the
*deviation* from the plan is smoothed, and only the part that no model explains
(`salver.learning.tracking.deviations`); models have exact derivatives. The rest is smoothed in the cosine transform by
1 / (1 + (f / f_c)^6) (Garcia 2010, "Robust smoothing of gridded data"). Model and f_c of each joint are those under
which a deviation with this spectrum plus white noise is most likely (Patterson and Thompson 1971; Schwarz 1978). The
residual is the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.fft import dct, dst, idct
from scipy.optimize import minimize_scalar

from salver.errors import FileFormatError
from salver.geometry import Array, interpolated
from salver.learning.logs import check_times
from salver.learning.tracking.deviations import DeviationFit, Fitted, of_lags
from salver.models.arm.arm import ArmModel
from salver.motion_files import JointSamples, read
from salver.motion_files.samples import reordered
from salver.trajectory import JointMotion


@dataclass(frozen=True)
class TrackingOptions:
    """Options of reading a log of a plan.

    Attributes:
        astray: largest deviation of a joint from the plan, as a share of its travel (of at least 0.3 rad); with twice
            the value logs of other motions pass.
        pace: relative slowdown of a run that is accepted; with twice the value a speed override of 5 % passes.
        rest: rad/s, below which the arm is at rest at the end of the log; with twice the value the end of the motion is
            cut off.
        sparsest: least samples per second of a log; with half the value vibration of the load at 20 Hz is missed.
        before, after: s around the motion that are checked.
        rate: samples per second that suffice; a log with more samples is averaged to this rate. With twice the rate the
            computation takes twice as long.
        slowest, fastest: Hz, limits of the smoother's cut-off. Motion above 80 Hz hardly moves a joint or the load;
            with twice the value more noise remains.
        slowest_shake: Hz, below which an unexplained deviation is no vibration of the tray: the arm's own motion.
        window: duration of the window of a vibration spectrum, s; with half the value 12 and 18 Hz cannot be separated.
        lever: m, distance of loads from the tray's middle, at which a rotation accelerates them; with twice the value
            smaller rotations are reported.
        negligible: m/s^2, acceleration below which a vibration is not reported, 0.2 % of the weight.
        false_alarm: probability that noise alone is reported as a vibration.
    """

    astray: float = 0.3
    pace: float = 0.03
    rest: float = 0.06
    sparsest: float = 90.0
    before: float = 0.3
    after: float = 0.6
    rate: float = 400.0
    slowest: float = 2.0
    fastest: float = 80.0
    slowest_shake: float = 5.0
    window: float = 0.5
    lever: float = 0.1
    negligible: float = 0.02
    false_alarm: float = 0.005


OPTIONS = TrackingOptions()


@dataclass(frozen=True, eq=False)
class Executed:
    """The executed motion at K instants t (K,), s on the plan's clock.

    q, dq, ddq (K, n): smoothed. off (K, n): smoothed deviation from the plan, rad. noise (n,): standard deviation of a
    sample of noisy, rad. shift: s, delay of the log relative to the plan. noisy (K, n): the logged deviation, means of
    `each` samples. fastest: Hz, largest cut-off. unexplained: (K, n) rad, part of `noisy` that no model explains.
    """

    t: Array
    q: Array
    dq: Array
    ddq: Array
    off: Array
    noise: Array
    shift: float
    noisy: Array
    plan: JointMotion
    fits: list[DeviationFit]
    each: int
    fastest: float
    slowest: float
    unexplained: Array

    @property
    def step(self) -> float:
        return float(self.t[1] - self.t[0])

    @property
    def states(self) -> tuple[Array, Array, Array]:
        return self.q, self.dq, self.ddq

    def again(self, noisy: Array) -> Executed:
        """The executed motion for another logged deviation (K, n), smoothed likewise."""
        off, noise, explained = _most_likely(noisy, self.fits, self.step, (self.slowest, self.fastest))
        q, dq, ddq = self.plan.sample(self.t) + off
        rest = noisy - explained
        return replace(self, q=q, dq=dq, ddq=ddq, off=off[0], noise=noise, noisy=noisy, unexplained=rest)

    def without_vibration(self) -> Executed:
        """The executed motion without unexplained deviations from `TrackingOptions.slowest_shake` on."""
        fast = dct(self.unexplained, axis=0, norm="ortho")
        fast[np.arange(len(fast)) < 2 * len(fast) * self.step * OPTIONS.slowest_shake] = 0.0
        return replace(self.again(self.noisy - idct(fast, axis=0, norm="ortho")), noise=self.noise)


def read_joints(path: str | Path, arm: ArmModel, topic: str | None = None) -> JointSamples:
    """Read a log of an arm's joints from any motion file. Raises FileFormatError."""
    samples = read(path, lambda: arm.joint_names, topic, as_path=True)  # a table may have the tray too
    if not isinstance(samples, JointSamples):
        raise FileFormatError(
            f"{path} holds a motion of the tray; give one of the joints: columns q1 to q{arm.n}, rad."
        )
    if samples.q.shape[1] < arm.n:
        raise FileFormatError(f"{path} has {samples.q.shape[1]} joints; {arm.name} has {arm.n}.")
    return reordered(samples, tuple(arm.joint_names))


def executed(plan: JointMotion, samples: JointSamples, fitted: Fitted = of_lags) -> Executed:
    """The executed motion of a plan from its log, with joints in the arm's order. Raises FileFormatError."""
    t, q, source = samples.t, samples.q, samples.source
    check_times(t, q, source, plan.q)
    if (len(t) - 1) / t[-1] < OPTIONS.sparsest:
        raise FileFormatError(
            f"{source} has {(len(t) - 1) / t[-1]:.0f} samples a second; at least {OPTIONS.sparsest:.0f} are needed to "
            "see what shakes a load."
        )
    shift, step = lateness(t, q, plan), float(np.median(np.diff(t)))
    t = t - shift
    off = q - plan.sample(t)[0]
    moving = (t >= 0) & (t <= plan.duration)
    _is_of(plan, t[moving], off[moving], source)
    seen = plan.sample(np.array([0.0, t[0], t[-1], plan.duration]))[0]
    for k, missing in ((0, f"begins {t[0]:.3f} s after"), (2, f"ends {plan.duration - t[-1]:.3f} s before")):
        if np.abs(seen[k + 1] - seen[k]).max() > 1e-3:
            raise FileFormatError(
                f"{source} {missing} the motion does; it must hold the whole motion, with rest around it."
            )
    kept = (t >= -OPTIONS.before) & (t <= plan.duration + OPTIONS.after)
    every = max(1, int(1 / (OPTIONS.rate * step)))
    even = t[kept][0] + step * np.arange(int(np.ptp(t[kept]) / step + 1e-6) + 1)
    even = even[: len(even) // every * every]
    off = interpolated(t, off, even)
    speed = np.abs(np.polyfit(even[even > even[-1] - 0.04], (off + plan.sample(even)[0])[even > even[-1] - 0.04], 1)[0])
    if speed.max() > OPTIONS.rest:
        raise FileFormatError(
            f"{source} ends while a joint still moves at {speed.max():.2g} rad/s; record until the arm rests, some "
            "0.3 s on."
        )
    t, off = even.reshape(-1, every).mean(axis=1), off.reshape(-1, every, off.shape[1]).mean(axis=1)
    fits = [DeviationFit.known(np.zeros((3, *off.shape))), *fitted(t, plan, off)]
    fastest = min(0.4 / (every * step), OPTIONS.fastest)
    found = Executed(t, off, off, off, off, off[0], shift, off, plan, fits, every, fastest, OPTIONS.slowest, off)
    return found.again(off)


def _is_of(plan: JointMotion, t: Array, off: Array, source: str) -> None:
    """Raise FileFormatError when a deviation (K, n) is too large, too small or too slow for a run of the plan."""
    each = np.abs(off).max(axis=0) / np.maximum(np.ptp(plan.q, axis=0), 0.3)
    if each.max() > OPTIONS.astray:
        raise FileFormatError(
            f"{source}: a joint is {100 * each.max():.0f} % of its way from the plan, and at most "
            f"{100 * OPTIONS.astray:.0f} % are accepted: another motion, another speed, another order of joints, or a "
            "robot that is not controlled."
        )
    if np.abs(off).max() < 1e-7:
        raise FileFormatError(
            f"{source} is the plan itself to {np.abs(off).max():.1g} rad: these are joints as commanded; they must be "
            "as measured."
        )
    dq = plan.sample(t)[1]  # the delay of a slower run grows over time
    rows = np.stack([dq.ravel(), ((t - t.mean())[:, None] * dq).ravel()], axis=1)
    slower = -float(np.linalg.lstsq(rows, off.ravel(), rcond=None)[0][1])
    if abs(slower) > OPTIONS.pace:
        raise FileFormatError(
            f"{source} is of a run {100 * abs(slower):.0f} % {'slower' if slower > 0 else 'quicker'} than planned; "
            "carry the plan out at its own speed (no speed override)."
        )


def lateness(t: Array, q: Array, plan: JointMotion) -> float:
    """Delay of the log relative to the plan, s, by least squares over all joints; the plan rests beyond both ends."""
    at = np.linspace(0.0, plan.duration, 60)
    wanted = plan.sample(at)[0]

    def miss(shift: float) -> float:
        return float(np.sum((interpolated(t, q, at + shift) - wanted) ** 2))

    best = min(np.arange(t[0] - 0.5 * plan.duration, t[-1] - 0.5 * plan.duration, 0.005), key=miss)
    return float(minimize_scalar(miss, bounds=(best - 0.01, best + 0.01), method="bounded").x)


def _rates(coefficients: Array, step: float) -> Array:
    """Values and two derivatives (3, K, n) of a cosine transform (K, n)."""
    omega = np.pi * np.arange(len(coefficients))[:, None] / (len(coefficients) * step)
    rate = np.append(-(omega * coefficients)[1:], np.zeros_like(coefficients[:1]), axis=0)
    return np.stack(
        [
            idct(coefficients, axis=0, norm="ortho"),
            dst(rate, type=3, axis=0) / np.sqrt(2 * len(coefficients)),
            idct(-(omega**2) * coefficients, axis=0, norm="ortho"),
        ]
    )


def _most_likely(
    noisy: Array, fits: list[DeviationFit], step: float, band: tuple[float, float]
) -> tuple[Array, Array, Array]:
    """A deviation (K, n) without its noise, with two derivatives (3, K, n), as the mean over all fits and cut-offs
    weighted by likelihood; its noise (n,); and the part (K, n) that the fits explain."""
    count = len(noisy)
    cuts = np.geomspace(*band, 40)
    known, taken = (
        np.stack([fit.to(noisy) for fit in fits]),
        np.array([fit.tangent.shape[3] for fit in fits])[:, None, None],
    )
    coefficients = dct(noisy - known[:, 0], axis=1, norm="ortho")
    f = np.arange(count) / (2 * count * step)
    slow = (f[1:] / cuts[:, None]) ** 6
    lost = slow / (1 + slow)  # share that the filter removes; the constant is not penalised
    left = np.maximum(lost @ coefficients[:, 1:] ** 2, np.finfo(float).tiny)  # (fits, cuts, n)
    free = count - 1 - taken
    unlikely = free * np.log(left / free) - np.log(lost).sum(axis=1)[:, None] + taken * np.log(count)
    likely = np.exp(0.5 * (unlikely.min(axis=(0, 1)) - unlikely))
    likely /= likely.sum(axis=(0, 1))
    kept = np.einsum("mcj,cf,mfj->fj", likely, 1 / (1 + (f / cuts[:, None]) ** 6), coefficients, optimize=True)
    explained = np.einsum("mcj,mdkj->dkj", likely, known, optimize=True)
    noise = np.sqrt(np.sum(likely * left / free, axis=(0, 1)))
    return explained + _rates(kept, step), noise, explained[0]
