"""Faults thrown at the driver: every field of every sample, every call, every phase; and what must hold all the same.

`python tests/helpers/driver_faults.py -n 1000` throws a thousand and prints the counts; `test_faults.py` throws some at
every test run. `--robot ur` and `--robot xarm` throw theirs on the wire (`wire_faults.py`). Each fault is a seed: with
`--seed 17 -n 1` number 17 is thrown again. What must hold after each: `driver_rig.py`.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from driver_rig import ONCE, Change, Fault, Rig
from salver.control.arm import ArmState
from salver.driver import execute
from salver.errors import SalverError

PERIODS = 1400  # of an undisturbed run
NUMBERS = (np.nan, np.inf, -np.inf, 1e300, -1e300, 1e9, -3.0, 3.0, 0.3, 0.0)
EXCEPTIONS: tuple[Callable[[], BaseException], ...] = (
    lambda: OSError(5, "Input/output error"),
    lambda: RuntimeError("libfranka: communication_constraints_violation"),
    lambda: SalverError("The arm says: no."),
    lambda: ValueError("shapes"),
    lambda: MemoryError(),
    lambda: ZeroDivisionError("division by zero"),
    lambda: SystemExit(1),
    lambda: StopIteration(),
)
SITES = (
    "read", "write", "look", "start", "stop", "controller", "planned", "stopping", "brake", "braking", "row", "save",
    "record",
)  # fmt: skip


def draw(seed: int) -> list[Fault]:
    """One to three faults; a second one often falls into the stop that the first one causes."""
    rng = np.random.default_rng(seed)
    first = _one(rng, int(rng.choice([0, 1, 30, 60, *rng.integers(60, 1300, 3), 1330, 1399])))
    more = [_one(rng, max(0, first.at + int(rng.integers(-5, 400)))) for _ in range(int(rng.choice([0, 0, 1, 1, 2])))]
    return [first, *more]


def _one(rng: np.random.Generator, at: int) -> Fault:
    lasts = int(rng.choice([1, 1, 2, 9, 10, 11, 40, 10**6]))
    kind = rng.choice(["sample", "sample", "sample", "torque", "raise", "raise", "signal"])
    when = f"from period {at} for {lasts}"
    if kind == "sample":
        words, change = _sample(rng)
        return Fault("read", at, lasts, f"{words} {when}", change, odd=words.startswith(("answer", "q = ")))
    if kind == "torque":
        site = str(rng.choice(["controller", "stopping", "braking"]))
        words, change = _torque(rng)
        return Fault(site, at, lasts, f"{site} gives {words} {when}", change)
    if kind == "signal":
        numbers = tuple(int(n) for n in rng.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP], rng.integers(1, 4)))
        return Fault("read", at, int(rng.choice([1, 3, 200])), f"signals {numbers} {when}", signals=numbers)
    site, error = str(rng.choice(SITES)), EXCEPTIONS[rng.integers(len(EXCEPTIONS))]
    if site in ONCE:
        at, lasts = 0, int(rng.choice([1, 2, 10**6]))
    return Fault(site, at, lasts, f"{site} raises {error()!r} at period {at} for {lasts}", error=error)


def _sample(rng: np.random.Generator) -> tuple[str, Change]:
    what = rng.choice(["q", "dq", "q", "dq", "elapsed", "shape", "nothing", "frozen", "swapped"])
    j, value = int(rng.integers(7)), float(rng.choice(NUMBERS))
    relative = bool(rng.random() < 0.5)
    if what in ("q", "dq"):

        def spoil(answer: Any) -> Any:
            state, elapsed = answer
            values = {name: getattr(state, name).copy() for name in ("q", "dq")}
            with np.errstate(over="ignore"):
                values[what][j] = values[what][j] + value if relative else value
            return ArmState(**values), elapsed

        return f"{what}[{j}] {'+' if relative else ''}= {value}", spoil
    if what == "elapsed":
        odd = (np.nan, np.inf, -np.inf, -1e-3, 0.0, 1e-9, 0.015, 0.3, 5.0, 1e308, None, "soon")[rng.integers(12)]
        return f"elapsed = {odd}", lambda answer: (answer[0], odd)
    if what == "shape":
        odd = (None, [], np.zeros(6), np.zeros((7, 1)), "q", [None] * 7)[rng.integers(6)]
        return f"q = {odd}", lambda answer: (ArmState(odd, answer[0].dq), answer[1])  # type: ignore[arg-type]
    if what == "nothing":
        odd = (None, (), 7, (None, 1e-3))[rng.integers(4)]
        return f"answer = {odd}", lambda answer: odd
    if what == "swapped":
        return "q and dq swapped", lambda answer: (ArmState(answer[0].dq, answer[0].q), answer[1])
    kept: list[Any] = []

    def freeze(answer: Any) -> Any:
        kept.append(answer)
        return kept[0]

    return "frozen", freeze


def _torque(rng: np.random.Generator) -> tuple[str, Change]:
    j, value = int(rng.integers(7)), float(rng.choice((*NUMBERS, 80.0, -200.0)))
    odd = (None, np.zeros(6), "torque", np.full(7, np.nan))[rng.integers(4)]
    if rng.random() < 0.3:
        return str(odd), lambda torque: odd
    return f"torque[{j}] = {value}", lambda torque: np.where(np.arange(7) == j, value, torque)


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    asked.add_argument("-n", type=int, default=1000, help="how many faults")
    asked.add_argument("--seed", type=int, default=0, help="number of the first")
    asked.add_argument("--robot", choices=("franka", "ur", "xarm"), default="franka", help="franka: and the simulated")
    given = asked.parse_args()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        if given.robot != "franka":
            on_the_wire(Path(folder), given, counts)
            given.n = 0
        rigs = Rig(Path(folder) / "cool"), Rig(Path(folder) / "safe", every=0.1)
        for seed in range(given.seed, given.seed + given.n):
            faults = draw(seed)
            outcome = rigs[seed % 2].throw(faults, franka=seed % 3 == 0 and not any(fault.odd for fault in faults))
            wrong = outcome.wrong()
            counts["runs"] += 1
            counts["torques sent"] += len(outcome.robot.sent)
            counts["wrong"] += bool(wrong)
            summary = outcome.result.summary if isinstance(outcome.result, execute.Execution) else {}
            counts["went on to the end"] += not summary.get("stopped", "-")
            counts["stopped"] += bool(summary.get("stopped"))
            counts["stopped, load surely kept"] += bool(summary.get("load_kept_in_stop"))
            counts["states bridged"] += summary.get("bridged", 0)
            if wrong or given.n == 1:
                print(
                    f"{seed}: {'; '.join(f.words for f in faults)}: {'; '.join(wrong) or summary['stopped']}",
                    flush=True,
                )
    for name, count in counts.items():
        print(f"{name}: {count}")
    sys.exit(counts["wrong"] > 0)


def on_the_wire(folder: Path, given: argparse.Namespace, counts: Counter[str]) -> None:
    """Faults of a protocol."""
    from wire_faults import WireRig

    rig = WireRig(folder / "plan", given.robot)
    for seed in range(given.seed, given.seed + given.n):
        faults, wrong, summary = rig.throw(seed)
        counts["runs"] += 1
        counts["wrong"] += bool(wrong)
        counts["went on to the end"] += not summary.get("stopped", "-")
        counts["stopped"] += bool(summary.get("stopped"))
        counts["stopped, load surely kept"] += bool(summary.get("load_kept_in_stop"))
        counts["states bridged"] += summary.get("bridged", 0)
        counts["commands"] += summary.get("timing", {}).get("periods", 0)
        if wrong or given.n == 1:
            print(f"{seed}: {'; '.join(f.words for f in faults)}: {'; '.join(wrong) or summary['stopped']}", flush=True)


if __name__ == "__main__":
    main()
