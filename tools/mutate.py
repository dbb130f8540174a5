"""Do the tests notice when the code is wrong? `make mutate`, or: python tools/mutate.py --module salver.models -n 20

Makes a seeded sample of small wrong changes (tools/mutants.py), one at a time, each in a copy of the repository, and
runs the tests that run the changed function (tools/test_map.py), first those of `make quick`, up to the first that
fails. A change that no test notices is printed. What is done is kept in out/mutation/: a run that was interrupted goes
on, --again runs those once more that nothing noticed before.

Changes that are no wrong ones stand with their reason in tools/equivalent.toml and do not count.
"""

import argparse
import hashlib
import json
import os
import random
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue
from typing import Any

from mutants import Mutant, mutants
from pytest_child import run_tests
from test_map import ROOT, TestMap, copy_of_the_tree

FOLDERS = [
    "models",
    "sensitivity",
    "planning",
    "contact_margins",
    "simulation",
    "control",
    "campaigns",
    "auditing",
    "driver",
]
JOURNAL = ROOT / "out" / "mutation" / "journal.jsonl"
EQUIVALENT = ROOT / "tools" / "equivalent.toml"


@dataclass(frozen=True)
class Rank:
    """The order of the tests for one mutant: everyday ones first, then the quickest file, its fitting tests first."""

    files: tuple[str, ...]
    direct: frozenset[str]
    broken: frozenset[str]

    def __call__(self, node: str, slow: bool) -> tuple[bool, bool, int] | None:
        if node in self.broken:
            return None
        return slow, node not in self.direct, self.files.index(node.partition("::")[0])


@dataclass(frozen=True)
class Alone:
    """Of all tests this one."""

    test: str

    def __call__(self, node: str, _slow: bool) -> int | None:
        return 0 if node == self.test else None


class Baseline:
    """Whether tests pass on the code as it is: one that does not kills nothing. Each is asked once, when it kills."""

    def __init__(self) -> None:
        self.passes: dict[str, bool] = {}

    @property
    def broken(self) -> frozenset[str]:
        return frozenset(test for test, passes in self.passes.items() if not passes)

    def trusts(self, test: str, tree: Path) -> bool:
        if test not in self.passes:
            outcome = run_tests(tree, [test.partition("::")[0]], Alone(test), limit=900, slowest=600)
            self.passes[test] = outcome.code == 0
            if outcome.code != 0:
                print(f"{test} fails as it is and judges nothing", file=sys.stderr)
        return self.passes[test]


def all_mutants(modules: list[str]) -> list[Mutant]:
    found = []
    for module in modules:
        path = ROOT / "src" / module.replace(".", "/")
        files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
        for file in files:
            if not file.is_file():
                raise SystemExit(f"There is no module {module} in src/.")
            found += mutants(file.relative_to(ROOT), file.read_text(encoding="utf-8"))
    return found


def judge(mutant: Mutant, tree: Path, tests: TestMap, baseline: Baseline) -> dict[str, Any]:
    """Run the tests on one mutant in its tree, which is left as it was."""
    files, direct = tests.tests_of(mutant.path.as_posix(), mutant.function)
    target = tree / mutant.path
    original, begun = target.read_text(encoding="utf-8"), time.monotonic()
    while True:
        _write(target, mutant.source)
        try:
            rank = Rank(tuple(files), frozenset(direct), baseline.broken)
            outcome = run_tests(tree, files, rank, limit=300 + 10 * tests.seconds(files), slowest=300)
        finally:
            _write(target, original)
        if outcome.failed is None or baseline.trusts(outcome.failed, tree):
            break
    if outcome.code in (0, 5):  # all pass, or none is left
        verdict = "survived"
    else:
        verdict = "late" if outcome.code == -9 else "killed"
    return {
        "verdict": verdict,
        "by": outcome.failed,
        "quick": verdict != "survived" and not outcome.slow,
        "seconds": round(time.monotonic() - begun, 1),
    }


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


def state_of_the_tree() -> str:
    """Digest of all that a verdict depends on."""
    digest = hashlib.sha256()
    for folder in ("src", "tests", "examples", "docs"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in (".py", ".md", ".toml") and path.is_file():
                digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def describe(mutant: Mutant) -> str:
    was, becomes = mutant.was.replace("\n", "\n  - "), mutant.becomes.replace("\n", "\n  + ")
    return f"{mutant.path}:{mutant.line} {mutant.function} ({mutant.operator})\n  - {was}\n  + {becomes}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--module", action="append", help="salver.models, salver.models.arm ...; default: all folders")
    parser.add_argument("-n", type=int, default=300, help="number of mutants, drawn at random (0: all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tests", action="append", metavar="FILE", help="judge by these test files alone, not by all")
    parser.add_argument("-j", type=int, default=os.cpu_count(), help="mutants at a time")
    parser.add_argument("--again", action="store_true", help="only those that survived when last run")
    parser.add_argument("--map", action="store_true", help="measure anew which tests run which function")
    parser.add_argument("--list", action="store_true", help="print the sample, run nothing")
    options = parser.parse_args()
    os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}

    modules = options.module or [f"salver.{folder}" for folder in FOLDERS]
    population = all_mutants(modules)
    count = min(options.n or len(population), len(population))
    sample = random.Random(options.seed).sample(population, count)
    known = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8")).get("mutant", []) if EQUIVALENT.is_file() else []
    reasons = {mutant.key: equivalent(mutant, known) for mutant in sample}
    sample = [mutant for mutant in sample if reasons[mutant.key] is None]
    if options.list:
        print(*map(describe, sample), sep="\n\n")
        return 0

    state, verdicts, before = f"{state_of_the_tree()} {' '.join(sorted(options.tests or []))}".strip(), {}, {}
    JOURNAL.parent.mkdir(parents=True, exist_ok=True)
    if JOURNAL.is_file():
        for line in JOURNAL.read_text(encoding="utf-8").splitlines():
            entry = json.loads(line)
            before[entry["key"]] = entry["verdict"]
            if entry["state"] == state:
                verdicts[entry["key"]] = entry
    if options.again:
        sample = [mutant for mutant in sample if before.get(mutant.key) == "survived"]
    due = [mutant for mutant in sample if mutant.key not in verdicts]

    tests = TestMap()
    tests.update(options.j, options.map, options.tests)
    if options.tests:
        tests = tests.of_files(options.tests)
    baseline = Baseline()
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(options.j) as pool, JOURNAL.open("a") as journal:
        trees: Queue[Path] = Queue()
        for k in range(min(options.j, len(due))):
            trees.put(copy_of_the_tree(Path(scratch, str(k))))

        def work(mutant: Mutant) -> None:
            tree = trees.get()
            try:
                entry = {"key": mutant.key, "state": state, **judge(mutant, tree, tests, baseline)}
            finally:
                trees.put(tree)
            verdicts[mutant.key] = entry
            journal.write(json.dumps(entry) + "\n")
            journal.flush()
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
