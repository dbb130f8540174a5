"""Faults that look like readings: smooth, finite, possible; or an arm, a clock that are not as told.

`python tests/helpers/driver_faults.py --lies -n 100` throws a hundred. Not all of them can be told: a position and a
speed that drift together are those of another motion.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from driver_rig import Change, Fault
from salver.control.arm import ArmState
from salver.geometry import Array

STRENGTH = np.array([87.0] * 4 + [12.0] * 3)  # N m


def lie(seed: int) -> list[Fault]:
    """One of the faults that look like readings: smooth, finite, possible; or an arm or a clock that is not as told."""
    rng = np.random.default_rng([seed, 1])
    at = int(rng.choice([0, 1, 20, 48, *rng.integers(50, 1300, 4)]))
    lasts = int(rng.choice([1, 15, 60, 300, 10**6, 10**6, 10**6]))
    words, site, change = _lie(rng)
    faults = [Fault(site, at, lasts, f"{words} from period {at} for {lasts}", change, odd=words.startswith("no"))]
    if rng.random() < 0.3:  # in the midst of it somebody stops the arm
        faults.append(Fault("read", later := at + int(rng.integers(0, 200)), 1, f"stop at {later}", signals=(2,)))
    return faults


def _lie(rng: np.random.Generator) -> tuple[str, str, Change]:
    kind = rng.choice([
        "frozen", "noisy", "late", "speeds", "positions", "drift", "coarse", "every other", "swapped joints", "gaps",
        "clock", "weak", "stiff", "push",
    ])  # fmt: skip
    some = np.arange(7) == int(rng.integers(7)) if rng.random() < 0.6 else np.ones(7, dtype=bool)
    who = f"joint {int(np.argmax(some)) + 1}" if not some.all() else "all joints"
    size, sign = float(10 ** rng.uniform(-1, 0)), float(rng.choice([-1, 1]))
    held: list[Any] = []

    def reading(change: Callable[[ArmState], tuple[Array, Array]]) -> Change:
        def spoil(answer: Any) -> Any:
            state, elapsed = answer
            held.append(state)
            q, dq = change(state)
            return ArmState(np.where(some, q, state.q), np.where(some, dq, state.dq)), elapsed

        return spoil

    def noise(state: ArmState, share: float) -> tuple[Array, Array]:
        return state.q + 1e-5 * share * rng.normal(size=7), state.dq + 2e-3 * share * rng.normal(size=7)

    if kind == "frozen":
        share = float(rng.choice([0.0, 0.0, 1.0, 3.0]))
        return f"{who} frozen, noise {share:g}", "read", reading(lambda s: noise(held[0], share))
    if kind == "noisy":
        share = float(rng.choice([1.0, 10.0, 30.0]))
        return f"{who} noisy, {share:g} times", "read", reading(lambda s: noise(s, share))
    if kind == "late":
        periods = int(rng.choice([2, 5, 10, 20, 50]))
        late = reading(lambda s: (held[max(0, len(held) - 1 - periods)].q, held[max(0, len(held) - 1 - periods)].dq))
        return f"{who} {periods} periods late", "read", late
    if kind == "speeds":
        factor = float(rng.choice([-1.0, 0.0, 0.5, 0.9, 1.1, 1.5, 2.0]))
        return f"speeds of {who} {factor:g} times", "read", reading(lambda s: (s.q, factor * s.dq))
    if kind == "positions":
        factor = float(rng.choice([-1.0, 0.0, 0.5, 0.9, 1.1, 1.5]))
        scaled = reading(lambda s: (held[0].q + factor * (s.q - held[0].q), s.dq))
        return f"ways of {who} {factor:g} times", "read", scaled
    if kind == "drift":
        rate, fast = sign * size, bool(rng.random() < 0.5)
        both = reading(
            lambda s: (
                s.q + 1e-3 * rate * len(held) * (not fast),
                s.dq + (rate if not fast else 1e-3 * rate * len(held)),
            )
        )
        only = reading(lambda s: (s.q + 1e-3 * rate * len(held) * (not fast), s.dq + 1e-3 * rate * len(held) * fast))
        together = bool(rng.random() < 0.3)
        words = f"{'speeds' if fast else 'positions'} of {who} drift by {rate:.2g}/s{' together' * together}"
        return words, "read", both if together else only
    if kind == "coarse":
        step, rate = float(rng.choice([1e-5, 1e-4, 1e-3])), float(rng.choice([1e-3, 1e-2, 0.1]))
        coarse = reading(lambda s: (step * np.round(s.q / step), rate * np.round(s.dq / rate)))
        return f"{who} in steps of {step:g}, {rate:g}", "read", coarse
    if kind == "every other":
        n = int(rng.choice([2, 3, 5, 10]))
        return (
            f"{who} new every {n}",
            "read",
            reading(lambda s: (held[(len(held) - 1) // n * n].q, held[(len(held) - 1) // n * n].dq)),
        )
    if kind == "swapped joints":
        order = rng.permutation(7)
        some[:] = True
        return f"joints in order {order}", "read", reading(lambda s: (s.q[order], s.dq[order]))
    if kind == "gaps":
        share = float(rng.choice([0.02, 0.1, 0.3, 0.6]))

        def gaps(answer: Any) -> Any:
            return None if rng.random() < share else answer

        return f"no answer to {share:g}", "read", gaps
    if kind == "clock":
        factor, jitter = float(rng.choice([0.6, 0.9, 1.0, 1.1, 1.4, 2.0, 4.0])), float(rng.choice([0.0, 0.3]))

        def clock(answer: Any) -> Any:
            return answer[0], answer[1] * factor * (1 + jitter * rng.uniform(-1, 1))

        return f"clock {factor:g} times, {jitter:g} about", "read", clock
    if kind == "weak":
        factor = float(rng.choice([0.0, 0.5, 0.9, 1.1, 1.5]))
        return f"motors of {who} give {factor:g} times", "motor", lambda tau: np.where(some, factor * tau, tau)
    if kind == "stiff":
        share = float(rng.choice([0.003, 0.01, 0.03]))
        return f"{who} held back by {share:g}", "motor", lambda tau: tau - share * STRENGTH * some * np.sign(tau)
    push = sign * float(rng.choice([0.01, 0.03, 0.1]))
    return f"{who} pushed by {push:g} of its torque", "motor", lambda tau: tau + push * some * STRENGTH
