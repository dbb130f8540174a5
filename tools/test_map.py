"""Which tests run which function of salver, and how long they take: measured with coverage.py, kept in out/.

Each test file is measured in a process of its own, and functions forget what they have cached before each test. Tests
that share a fixture share what it holds too, so that they stand together. The map is measured again for the test files
that changed; a function that it does not know yet is taken to be run by all tests that run its module.
"""

import ast
import hashlib
import json
import shutil
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue
from subprocess import check_output
from typing import Any

from pytest_child import run_tests

ROOT = Path(__file__).resolve().parents[1]
MAP = ROOT / "out" / "mutation" / "map.json"
SETTINGS = """\
[run]
source = {tree}/src/salver
data_file = {tree}/.coverage
parallel = true
patch = subprocess, fork, _exit
sigterm = true
"""


def copy_of_the_tree(folder: Path) -> Path:
    """The files of the repository as they are now, without what git ignores."""
    names = check_output(["git", "ls-files", "-zco", "--exclude-standard"], cwd=ROOT, text=True).split("\0")
    for name in filter(None, names):
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


class TestMap:
    """What is known of each test file: processor seconds of its tests, which are left out of `make quick` (`marked`),
    which fixtures they share (`shares`), and `covers[source file][function]`, those that ran the function."""

    def __init__(self, path: Path = MAP) -> None:
        self.path = path
        self.files: dict[str, dict[str, Any]] = json.loads(path.read_text()) if path.is_file() else {}

    def update(
        self, workers: int, again: bool = False, only: list[str] | None = None, without: list[str] | None = None
    ) -> "TestMap":
        """Measure test files that are new or have changed, or all of them `again`; the map of these test files."""
        present = {path.relative_to(ROOT).as_posix(): _digest(path) for path in sorted(ROOT.glob("tests/**/test_*.py"))}
        for name in [*(only or []), *(without or [])]:
            if name not in present:
                raise SystemExit(f"There is no test file {name}; give it as in tests/test_geometry.py.")
        wanted = [name for name in only or present if name not in (without or [])]
        self.files = {name: entry for name, entry in self.files.items() if name in present}
        due = [name for name in wanted if again or self.files.get(name, {}).get("digest") != present[name]]
        if due:
            self._measure_all(due, present, workers)
        part = TestMap(self.path)
        part.files = {name: self.files[name] for name in wanted if name in self.files}
        return part

    def _measure_all(self, due: list[str], digests: dict[str, str], workers: int) -> None:
        print(f"measuring which functions {len(due)} test files run", file=sys.stderr)
        due.sort(key=lambda name: -(ROOT / name).stat().st_size)
        with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(workers) as pool:
            trees: Queue[Path] = Queue()
            for k in range(workers):
                trees.put(copy_of_the_tree(Path(scratch, str(k))))

            def measure(name: str) -> None:
                tree = trees.get()
                try:
                    found = _measure(tree, name)
                finally:
                    trees.put(tree)
                if found is not None:
                    self.files[name] = {"digest": digests[name], **found}
                    self.save()
                    print(f"{name}: {sum(found['tests'].values()):.1f} s", file=sys.stderr)

            list(pool.map(measure, due))

    def save(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(self.files, indent=0, sort_keys=True))

    def tests_of(self, source: str, function: str, everyday: bool = False) -> list[str]:
        """The tests that a function may matter to, in the order in which to run them, or those of `make quick` alone.

        First those of `make quick`, file by file, the quickest first; in each file first those that were seen to run
        it, then those that share a fixture with these.
        """
        known = function and any(function in entry["covers"].get(source, {}) for entry in self.files.values())
        quick, slow = [], []
        for entry in self.files.values():
            functions = entry["covers"].get(source, {})
            seen = set(functions.get(function, [])) if known else {test for ran in functions.values() for test in ran}
            touched = {fixture for test in seen for fixture in entry["shares"].get(test, [])}
            beside = [test for test in entry["tests"] if touched.intersection(entry["shares"].get(test, []))]
            tests = [*sorted(seen, key=entry["tests"].get), *(test for test in beside if test not in seen)]
            quick.append([test for test in tests if test not in entry["marked"]])
            slow.append([test for test in tests if test in entry["marked"]])
        return [
            test
            for part in ([quick] if everyday else [quick, slow])
            for group in sorted(part, key=self.seconds)
            for test in group
        ]

    def seconds(self, tests: Sequence[str]) -> float:
        """Of processor, for these tests."""
        return sum(self.files[file_of(test)]["tests"][test] for test in tests)


def file_of(test: str) -> str:
    return test.partition("::")[0]


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _measure(tree: Path, name: str) -> dict[str, Any] | None:
    """What the tests of a file take and run; None, said on standard error, when they fail as they are."""
    import coverage

    (tree / "output.txt").unlink(missing_ok=True)
    settings = tree / "coverage.ini"
    settings.write_text(SETTINGS.format(tree=tree))
    outcome = run_tests(tree, [name], None, limit=3600, slowest=900, coverage=str(settings))
    if outcome.code != 0:
        output = (tree / "output.txt").read_text()[-3000:]
        print(f"{output}\n{name} fails at {outcome.failed}: no mutant is judged by it", file=sys.stderr)
        return None
    combined = coverage.CoverageData(str(tree / ".coverage"))
    for part in tree.glob(".coverage.*"):
        data = coverage.CoverageData(str(part))
        data.read()
        combined.update(data)
        part.unlink()
    covers: dict[str, dict[str, list[str]]] = {}
    for file in combined.measured_files():
        source = Path(file).relative_to(tree).as_posix()
        contexts = combined.contexts_by_lineno(file)
        covers[source] = {}
        for function, lines in function_lines(Path(file).read_text()).items():
            tests = {test for line in lines for test in contexts.get(line, [])}
            if "" in tests:  # when the module is imported: it may matter to all tests that use the module
                tests.update(test for every in contexts.values() for test in every)
            if tests:
                covers[source][function] = sorted(tests - {""})
    combined.erase()
    return {"tests": outcome.seconds, "marked": outcome.marked, "shares": outcome.shares, "covers": covers}


def function_lines(text: str) -> dict[str, range]:
    """Lines of the body of each function "f" and method "Class.f" of a file."""
    found = {}

    def visit(body: list[ast.stmt], prefix: str) -> None:
        for node in body:
            if isinstance(node, ast.ClassDef):
                visit(node.body, f"{prefix}{node.name}.")
            elif isinstance(node, ast.FunctionDef):
                found[f"{prefix}{node.name}"] = range(node.body[0].lineno, (node.end_lineno or 0) + 1)

    visit(ast.parse(text).body, "")
    return found
