"""Feeds salver damaged and absurd inputs and counts what becomes of them.

    python tools/fuzz [-n CASES] [--seed SEED] [--minutes M] [--only DOMAIN ...]
    python tools/fuzz --case DOMAIN SEED NUMBER      # one case again, with its traceback

A case is a domain, a seed and a number: nothing else goes into it, so that it can be made again alone. Cases run one
after the other in a process of their own with at most 4 GB; one that takes over a minute of processor time is ended,
and one that waits for ten minutes. What fails is kept in out/fuzz, and the exit code is 1.

Outcomes: refused (a sentence), accepted, DEFECT (any other exception), SLOW, MEMORY, CRASH, and WRONG:
accepted although it should not have been.
"""

from __future__ import annotations

import argparse
import json
import resource
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

SECONDS, BYTES = 60, 4 * 10**9
WAITING = 600  # s by the clock: a case that uses no processor time and does not end either
KEPT = Path("out/fuzz")
FAILURES = ("DEFECT", "SLOW", "MEMORY", "CRASH", "WRONG")


def one(domain: str, seed: int, number: int, folder: Path) -> str:
    """The outcome of a case; DEFECT and WRONG raise."""
    import numpy as np
    from domains import DOMAINS

    from salver.errors import SalverError

    try:
        DOMAINS[domain](np.random.default_rng([seed, number, *domain.encode()]), folder)
    except SalverError as error:
        if not str(error) or len(str(error)) > 20_000:
            raise AssertionError("a refusal without words, or without end") from error
        return "refused"
    return "accepted"


def processor_time() -> float:
    """s, of this process and of those that it has waited for: a busy machine makes no case slower."""
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + ended.ru_utime + ended.ru_stime


def work(domain: str, seed: int, first: int, last: int, folder: Path) -> None:
    """In the child: cases of a domain, a line for each."""
    resource.setrlimit(resource.RLIMIT_DATA, (BYTES, BYTES))
    for number in range(first, last):
        began, case = processor_time(), folder / str(number)
        resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + SECONDS + 1, resource.RLIM_INFINITY))
        case.mkdir()
        outcome, told = "accepted", ""
        try:
            outcome = one(domain, seed, number, case)
        except MemoryError:
            outcome, told = "MEMORY", traceback.format_exc()
        except AssertionError:
            outcome, told = "WRONG", traceback.format_exc()
        except Exception:
            outcome, told = "DEFECT", traceback.format_exc()
        if told:
            (case / "traceback.txt").write_text(told, encoding="utf-8", errors="backslashreplace")
        else:
            shutil.rmtree(case)
        seconds = round(processor_time() - began, 3)
        print(json.dumps([number, outcome, seconds, told.strip().splitlines()[-1:]]), flush=True)


def run(domain: str, seed: int, count: int, until: float, counts: Counter, times: list[float]) -> None:
    """In the parent: all cases of a domain, the child started again after a case that ends it."""
    number = 0
    while number < count and time.time() < until:
        with tempfile.TemporaryDirectory(prefix="salver-fuzz-") as name:
            folder = Path(name)
            command = [sys.executable, __file__, "--work", domain, str(seed), str(number), str(count), name]
            child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
            assert child.stdout is not None
            while number < count and time.time() < until:
                ready, _, _ = select.select([child.stdout], [], [], WAITING)
                line = child.stdout.readline() if ready else b""
                if line:
                    _, outcome, seconds, told = json.loads(line)
                    times.append(seconds)
                    if seconds > SECONDS:
                        outcome = "SLOW"
                else:
                    slow = not ready or child.wait() == -signal.SIGXCPU
                    outcome, told = ("SLOW" if slow else "CRASH"), []
                counts[outcome] += 1
                if outcome in FAILURES:
                    kept = KEPT / f"{domain}-{seed}-{number}"
                    shutil.rmtree(kept, ignore_errors=True)
                    kept.parent.mkdir(parents=True, exist_ok=True)
                    if (folder / str(number)).is_dir():
                        shutil.copytree(folder / str(number), kept)
                    print(f"{outcome}: {domain} {seed} {number} {' '.join(told)[:200]!r}, kept in {kept}", flush=True)
                number += 1
                if not line:
                    break
            child.kill()
            child.wait()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=600, help="cases in all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=600.0, help="stop after so long")
    parser.add_argument("--only", nargs="*", help="these domains alone")
    parser.add_argument("--case", nargs=3, metavar=("DOMAIN", "SEED", "NUMBER"))
    parser.add_argument("--work", nargs=5, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        domain, seed, first, last, folder = options.work
        work(domain, int(seed), int(first), int(last), Path(folder))
        return 0
    if options.case:
        domain, seed, number = options.case
        folder = Path(tempfile.mkdtemp(prefix="salver-fuzz-"))
        print(one(domain, int(seed), int(number), folder), "- its files are in", folder)
        return 0

    from domains import DOMAINS

    names = options.only or list(DOMAINS)
    began, total = time.time(), Counter()
    print(
        f"{'domain':14}{'cases':>7}{'refused':>9}{'accepted':>9}{''.join(f'{f:>8}' for f in FAILURES)}{'longest':>10}"
    )
    for k, name in enumerate(names):
        counts, times = Counter(), [0.0]
        left = (began + 60 * options.minutes - time.time()) / (len(names) - k)
        run(name, options.seed, options.n // len(names), time.time() + left, counts, times)
        shown = "".join(f"{counts[f]:8}" for f in FAILURES)
        print(
            f"{name:14}{counts.total():7}{counts['refused']:9}{counts['accepted']:9}{shown}{max(times):8.1f} s",
            flush=True,
        )
        total += counts
    failed = sum(total[f] for f in FAILURES)
    words = ", ".join(f"{total[key]} {key}" for key in ("refused", "accepted", *FAILURES))
    print(f"{total.total()} cases with seed {options.seed} in {time.time() - began:.0f} s: {words}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
