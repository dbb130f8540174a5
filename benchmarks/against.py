"""The fastest motion of this checkout against that of another commit: processor times, the two taking turns.

    python benchmarks/against.py COMMIT [-n 5] [--unheld]

The four cases of fastest_solve.py, each solved by a process of either checkout in turn, so that what else the machine
does slows both. The other commit is unpacked from git into a temporary folder. With --unheld this checkout also solves
what commits before e9c30aa solve: where nothing is uncertain these leave out that commands are held for a period.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
WORKER = """
import dataclasses, runpy, sys, time
names = runpy.run_path(sys.argv[1])
for line in sys.stdin:
    friction, orientation, *unheld = line.split()
    began = time.process_time()
    problem = names["transport_problem"](names["cube"](float(friction), orientation))
    found = names["fastest"](dataclasses.replace(problem, tracking=None) if unheld else problem)
    print(time.process_time() - began, found.duration, found.status.ok, flush=True)
"""


@contextmanager
def worker(checkout: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that solves cases with the code of a checkout."""
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-c", WORKER, str(checkout / "benchmarks" / "fastest_solve.py")]
    environment = {**os.environ, **one_thread, "PYTHONPATH": str(checkout / "src")}
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()


def solve(process: subprocess.Popen[str], case: str, whose: str) -> tuple[float, float]:
    """Processor time, s, and duration, s, of a case."""
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        process.stdin.write(f"{case}\n")
        process.stdin.flush()
    except BrokenPipeError:
        pass  # it has ended already, and says why
    answer = process.stdout.readline()
    if not answer:
        raise SystemExit(f"{whose} does not run in this environment: {_last_words(process)}")
    seconds, duration, ok = answer.split()
    if ok != "True":
        raise SystemExit(f"{case}: not solved")
    return float(seconds), float(duration)


def _last_words(process: subprocess.Popen[str]) -> str:
    """Why a process ended; with what to install, where it lacked a package."""
    assert process.stderr is not None
    said = process.stderr.read().strip().rpartition("\n")[2] or "it ended without a word"
    missing = re.search(r"No module named '(\w+)", said)
    return f"{said}; pip install {missing[1].replace('_', '-')}" if missing else said


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("commit", help="what to compare with")
    options.add_argument("-n", type=int, default=5, help="times that each of the four cases is solved by either")
    options.add_argument("--unheld", action="store_true", help="also what commits before e9c30aa solve")
    chosen = options.parse_args()
    unpacked = subprocess.run(["git", "-C", str(ROOT), "archive", chosen.commit], check=False, capture_output=True)
    if unpacked.returncode:
        raise SystemExit(f"{chosen.commit}: {unpacked.stderr.decode().strip()}")
    packed = unpacked.stdout
    asked = ["", " unheld"] if chosen.unheld else [""]
    ratios = []
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=BytesIO(packed)) as archive:
            archive.extractall(folder, filter="data")
        print(f"processor times, N = {chosen.n}, in turns: {chosen.commit}, and this checkout")
        if chosen.unheld:
            print("(last: this checkout, where it too leaves out that commands are held for a period)")
        with worker(Path(folder)) as other, worker(ROOT) as this:
            for friction in (0.4, 0.2):
                for orientation, name in (("fixed", "level"), ("free", "tilting")):
                    case = f"{friction} {orientation}"
                    runs = []
                    for _ in range(chosen.n + 1):
                        runs.append([solve(other, case, chosen.commit)])
                        runs[-1] += [solve(this, case + more, "this checkout") for more in asked]
                    times, durations = np.moveaxis(np.array(runs), 2, 0)
                    before, *now = np.median(times[1:], axis=0)
                    ratios.append(before / np.array(now))
                    times_as_quick = " and ".join(f"{x:.2f}" for x in ratios[-1])
                    print(
                        f"friction {friction}, {name:8s} {_listed(durations[0], '.4f')}; median "
                        f"{_listed([before, *now], '.2f')}: {times_as_quick} times as quick",
                        flush=True,
                    )
    means = np.exp(np.mean(np.log(ratios), axis=0))
    print(f"geometric mean of the four ratios: {means[0]:.2f}")
    if chosen.unheld:
        print(f"and of those where both leave out that commands are held: {means[1]:.2f}")


def _listed(seconds: Sequence[float], digits: str) -> str:
    return ", ".join(f"{x:{digits}} s" for x in seconds)


if __name__ == "__main__":
    main()
