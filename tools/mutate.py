"""Do the tests notice when the code is wrong? `make mutate`, or: python tools/mutate.py --module salver.models -n 20

Makes a seeded sample of small wrong changes (tools/mutants.py), one at a time, each in a copy of the repository, and
runs the tests that run the changed function (tools/test_map.py), first those of `make quick`, up to the first that
fails. A change that no test notices is printed. What is done is kept in out/mutation/: a run that was interrupted goes
on, and a verdict holds until the module changes, or the test that failed, or one of the tests that passed.

Changes that are no wrong ones stand with their reason in tools/equivalent.toml and do not count.
"""

import argparse
import hashlib
import json
import math
import os
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from typing import Any

from mutants import Mutant, mutants, signatures
from pytest_child import Outcome, run_tests
from test_map import MAP, ROOT, TestMap, copy_of_the_tree, file_of

FOLDERS = [
    "models",
    "sensitivity",
    "dynamics",
    "planning",
    "contact_margins",
    "simulation",
    "control",
    "campaigns",
    "auditing",
    "driver",
    "live",
    "learning",
    "motion_files",
    "scenario",
]
EQUIVALENT = ROOT / "tools" / "equivalent.toml"


class Baseline:
    """Whether tests pass on the code as it is: one that does not kills nothing. Each is asked once, when it kills."""

    def __init__(self) -> None:
        self.passes: dict[str, bool] = {}
        self.loaded: set[str] = set()

    @property
    def broken(self) -> frozenset[str]:
        return frozenset(test for test, passes in self.passes.items() if not passes)

    def trusts(self, test: str, tree: Path) -> bool:
        if test not in self.passes:
            outcome = run_tests(tree, [file_of(test)], [test], limit=7200, slowest=600)
            self.passes[test] = outcome.code == 0
            if outcome.code != 0:
                print(f"{test} fails as it is and judges nothing", file=sys.stderr)
        return self.passes[test]

    def loads(self, files: list[str], tree: Path) -> None:
        """Raise SystemExit if the tests cannot even be collected from the code as it is."""
        if not self.loaded.issuperset(files):
            outcome = run_tests(tree, files, [], limit=7200, slowest=600)
            if outcome.code not in (0, 5):
                raise SystemExit(f"{' '.join(files)}: pytest ends with {outcome.code} on the code as it is.")
            self.loaded.update(files)


def all_mutants(modules: list[str]) -> list[Mutant]:
    found = []
    known = signatures(path.read_text(encoding="utf-8") for path in sorted(ROOT.glob("src/**/*.py")))
    for module in modules:
        path = ROOT / "src" / module.replace(".", "/")
        files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
        for file in files:
            if not file.is_file():
                raise SystemExit(f"There is no module {module} in src/.")
            found += mutants(file.relative_to(ROOT), file.read_text(encoding="utf-8"), known)
    return found


def drawn(population: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """A random sample: those whose digests, salted with the seed, are least.

    So a larger sample begins with the smaller one, and a change to the code exchanges mutants of what it changes only.
    """
    return sorted(population, key=lambda mutant: _digest(f"{seed} {mutant.key}"))[:count]


def judge(mutant: Mutant, tree: Path, tests: TestMap, due: list[str], baseline: Baseline) -> dict[str, Any]:
    """Run the tests that are due on one mutant in its tree, which is left as it was."""
    target = tree / mutant.path
    original, begun = target.read_text(encoding="utf-8"), time.monotonic()
    outcome, seconds = Outcome(0), 1.0
    while due:
        batch = first_of(due, tests, seconds)  # most mutants fall at once, and the others need all tests
        seconds *= 6
        _write(target, mutant.source)
        try:
            files = list(dict.fromkeys(map(file_of, batch)))
            hangs = max(25.0, 5 * max(tests.seconds([test]) for test in batch))
            outcome = run_tests(tree, files, batch, limit=1800 + 60 * tests.seconds(batch), slowest=hangs)
        finally:
            _write(target, original)
        if outcome.code in (0, 5):  # all pass, or none is left
            due = due[len(batch) :]
        elif outcome.failed is None:  # the module cannot be loaded any more, or it takes too long as a whole
            baseline.loads(files, tree)
            break
        elif baseline.trusts(outcome.failed, tree):
            break
        else:
            due = [test for test in due if test not in baseline.broken]
    verdict = "survived" if not due else "late" if outcome.code == -9 else "killed"
    return {
        "verdict": verdict,
        "by": outcome.failed,
        "quick": verdict != "survived" and not outcome.slow,
        "seconds": round(time.monotonic() - begun, 1),
    }


def first_of(tests: list[str], known: TestMap, seconds: float) -> list[str]:
    """As many tests as take so long, and half a second for each file, to collect it; at least one."""
    spent, files = 0.0, set()
    for k, test in enumerate(tests):
        spent += known.seconds([test]) + 0.5 * (file_of(test) not in files)
        files.add(file_of(test))
        if k and spent > seconds:
            return tests[:k]
    return tests


def likely_first(mutant: Mutant, order: list[str], verdicts: dict[str, dict[str, Any]], known: TestMap) -> list[str]:
    """Everyday tests still before the others: first the one that noticed the mutant before, then those that noticed
    others of its file, the most often first."""
    last = verdicts.get(mutant.key, {}).get("by")
    beside = [entry["by"] for key, entry in verdicts.items() if key.startswith(f"{mutant.path.as_posix()}:")]
    times = {test: beside.count(test) + len(beside) * (test == last) for test in order}
    return sorted(order, key=lambda test: (known.is_marked(test), -times[test]))


def is_own(test: str, mutant: Mutant) -> bool:
    """Whether the file of a test is named after the module, or its folder."""
    words = Path(file_of(test)).stem.removeprefix("test_").split("_")
    return any(name.split("_") == words[: len(name.split("_"))] for name in (mutant.path.stem, mutant.path.parent.name))


def within(seconds: float, known: TestMap, tests: list[str]) -> Iterator[str]:
    """Those that take no longer together."""
    for test in tests:
        seconds -= known.seconds([test])
        if seconds < 0:
            return
        yield test


def _write(path: Path, text: str, clock: list[int] = [0]) -> None:  # noqa: B006
    """Write a source file so that Python compiles it anew: it tells versions apart by size and full seconds."""
    path.write_text(text, encoding="utf-8")
    clock[0] += 1
    os.utime(path, (1e9 + clock[0], 1e9 + clock[0]))


def equivalent(mutant: Mutant, known: list[dict[str, str]]) -> str | None:
    """Why a mutant is no wrong change, or None."""
    for entry in known:
        if (entry["function"], entry["was"], entry["becomes"]) == (mutant.function, mutant.was, mutant.becomes):
            return entry["reason"]
    return None


def rests(mutant: Mutant, test_files: Iterable[str], passed: Iterable[str] = ()) -> str:
    """Digest of what a verdict rests on: the module, and the file of the test that failed, or all tests that passed and
    their files."""
    files = [mutant.path.as_posix(), *sorted(test_files)]
    texts = [_digest((ROOT / name).read_text(encoding="utf-8")) for name in files]
    return _digest(" ".join([*texts, *sorted(passed)]))


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def describe(mutant: Mutant) -> str:
    was, becomes = mutant.was.replace("\n", "\n  - "), mutant.becomes.replace("\n", "\n  + ")
    return f"{mutant.path}:{mutant.line} {mutant.function} ({mutant.operator})\n  - {was}\n  + {becomes}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--module", action="append", help="salver.models, salver.models.arm.arm ...; default: all folders"
    )
    parser.add_argument("-n", type=int, default=300, help="number of mutants, drawn at random (0: all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tests", action="append", metavar="FILE", help="judge by these test files alone, not by all")
    parser.add_argument("--without", action="append", metavar="FILE", help="judge by all test files but these")
    parser.add_argument(
        "--operator", action="append", help="sign, constant ... as printed beside a mutant; default: all"
    )
    parser.add_argument("--everyday", action="store_true", help="judge by the tests of `make quick` alone")
    parser.add_argument("--patience", type=float, default=math.inf, help="seconds of tests after which one survives")
    parser.add_argument("-j", type=int, default=os.cpu_count(), help="mutants at a time")
    parser.add_argument("--keep", type=Path, default=MAP.parent, metavar="FOLDER", help="where map and journal are")
    parser.add_argument("--map", action="store_true", help="measure anew which tests run which function")
    parser.add_argument("--list", action="store_true", help="print the sample, run nothing")
    options = parser.parse_args()
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

    modules = options.module or [f"salver.{folder}" for folder in FOLDERS]
    population = [m for m in all_mutants(modules) if not options.operator or m.operator in options.operator]
    count = min(options.n or len(population), len(population))
    sample = drawn(population, count, options.seed)
    known = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8")).get("mutant", []) if EQUIVALENT.is_file() else []
    reasons = {mutant.key: equivalent(mutant, known) for mutant in sample}
    sample = [mutant for mutant in sample if reasons[mutant.key] is None]
    if options.list:
        print(*map(describe, sample), sep="\n\n")
        return 0

    tests = TestMap(options.keep / "map.json")
    tests = tests.update(options.j, options.map, options.tests, options.without, options.everyday)
    judges: dict[str, list[str]] = {}
    for mutant in sample:
        order = tests.tests_of(*mutant.place, everyday=options.everyday)
        order.sort(key=lambda test, m=mutant: (tests.is_marked(test), not is_own(test, m)))
        judges[mutant.key] = list(within(options.patience, tests, order))

    def rests_now(mutant: Mutant, by: str | None) -> str:
        if by:
            return rests(mutant, [file_of(by)])
        passed = judges[mutant.key]
        return rests(mutant, {file_of(test) for test in passed}, passed)

    before: dict[str, dict[str, Any]] = {}
    journal_file = options.keep / "journal.jsonl"
    if journal_file.is_file():
        for line in journal_file.read_text(encoding="utf-8").splitlines():
            entry = json.loads(line)
            before[entry["key"]] = entry
    verdicts = {}
    for mutant in sample:
        entry = before.get(mutant.key)
        if entry and entry["rests"] == rests_now(mutant, entry["by"]):
            verdicts[mutant.key] = entry
    due = [mutant for mutant in sample if mutant.key not in verdicts]

    baseline = Baseline()
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(options.j) as pool, journal_file.open("a") as out:
        trees: Queue[Path] = Queue()
        for k in range(min(options.j, len(due))):
            trees.put(copy_of_the_tree(Path(scratch, str(k))))

        def work(mutant: Mutant) -> None:
            order, tree = judges[mutant.key], trees.get()
            order = likely_first(mutant, order, before | verdicts, tests)
            try:
                entry = {"key": mutant.key, **judge(mutant, tree, tests, order, baseline)}
            finally:
                trees.put(tree)
            entry["rests"] = rests_now(mutant, entry["by"])
            verdicts[mutant.key] = entry
            out.write(json.dumps(entry) + "\n")
            out.flush()
            done = sum(other.key in verdicts for other in sample)
            line = f"{done} of {len(sample)}: {entry['verdict']} in {entry['seconds']} s: {mutant.key}"
            print(line.replace("\n", " ")[:150], file=sys.stderr)

        list(pool.map(work, due))

    survivors = [mutant for mutant in sample if verdicts[mutant.key]["verdict"] == "survived"]
    for mutant in survivors:
        print(describe(mutant), end="\n\n")
    print(f"{len(population)} mutants of {', '.join(modules)}; a sample of {count}, seed {options.seed}")
    print(f"{'':<14}{'made':>6}{'killed':>8}{'by quick':>10}")
    groups: dict[str, list[Mutant]] = {}
    for mutant in sample:
        groups.setdefault(mutant.path.parts[2], []).append(mutant)
    for name, group in [*sorted(groups.items()), ("all", sample)]:
        killed = [verdicts[m.key] for m in group if verdicts[m.key]["verdict"] != "survived"]
        print(f"{name:<14}{len(group):>6}{len(killed):>8}{sum(entry['quick'] for entry in killed):>10}")
    print(f"{sum(reason is not None for reason in reasons.values())} more are no wrong changes (tools/equivalent.toml)")
    if sample:
        print(f"score: {100 * (1 - len(survivors) / len(sample)):.1f} %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
