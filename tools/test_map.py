"""Which tests run which function of salver, and how long they take: measured in a copy in which every function says so
the first time that a test runs it, in whichever process. Kept in out/.

Each test file is measured in a process of its own, and functions forget what they have cached before each test. Tests
that share a fixture share what it holds too, so that they stand together. The map is measured again for the test files
that changed; a function that it does not know yet is taken to be run by all tests that run its module. For everyday
tests alone the others need not be measured.
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
RECORDER = """\
import os

_write = os.write  # tests replace it by one that fails
_file = os.open({path!r}, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
_test, _seen = os.environ.get("SALVER_TEST", ""), set()


def begin(test):
    global _test
    _test = test
    _seen.clear()


def ran(function):
    if function not in _seen:
        _seen.add(function)
        _write(_file, f"{{_test}}\\t{{function}}\\n".encode())
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
        self,
        workers: int,
        again: bool = False,
        only: list[str] | None = None,
        without: list[str] | None = None,
        everyday: bool = False,
    ) -> "TestMap":
        """Measure test files that are new or have changed, or all of them `again`; the map of these test files."""
        present = {path.relative_to(ROOT).as_posix(): _digest(path) for path in sorted(ROOT.glob("tests/**/test_*.py"))}
        for name in [*(only or []), *(without or [])]:
            if name not in present:
                raise SystemExit(f"There is no test file {name}; give it as in tests/models/arm/test_arm.py.")
        wanted = [name for name in only or present if name not in (without or [])]
        self.files = {name: entry for name, entry in self.files.items() if name in present}
        for name in wanted:
            if again or self.files.get(name, {}).get("digest") != present[name]:
                self.files.pop(name, None)
        for marker in ["not slow"] if everyday else ["not slow", "slow"]:
            due = [name for name in wanted if marker not in self.files.get(name, {}).get("measured", [])]
            if due:
                self._measure_all(due, present, workers, marker)
        part = TestMap(self.path)
        part.files = {name: self.files[name] for name in wanted if name in self.files}
        return part

    def _measure_all(self, due: list[str], digests: dict[str, str], workers: int, marker: str) -> None:
        print(f"measuring which functions {len(due)} test files run ({marker})", file=sys.stderr)
        due.sort(key=lambda name: -(ROOT / name).stat().st_size)
        with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(workers) as pool:
            trees: Queue[Path] = Queue()
            for k in range(workers):
                trees.put(recording(copy_of_the_tree(Path(scratch, str(k)))))

            def measure(name: str) -> None:
                tree = trees.get()
                try:
                    found = _measure(tree, name, marker)
                finally:
                    trees.put(tree)
                if found is not None:
                    known = self.files.setdefault(name, {"digest": digests[name], "measured": [], **NOTHING})
                    self.files[name] = _merged(known, found, marker)
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

    def is_marked(self, test: str) -> bool:
        """Whether `make quick` leaves it out."""
        return test in self.files[file_of(test)]["marked"]

    def seconds(self, tests: Sequence[str]) -> float:
        """Of processor, for these tests."""
        return sum(self.files[file_of(test)]["tests"][test] for test in tests)


def file_of(test: str) -> str:
    return test.partition("::")[0]


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


NOTHING: dict[str, Any] = {"tests": {}, "marked": [], "shares": {}, "covers": {}}


def _measure(tree: Path, name: str, marker: str) -> dict[str, Any] | None:
    """What the tests of a file take and run; None, said on standard error, when they fail as they are."""
    output, record = tree / "output.txt", tree / "ran.txt"
    output.unlink(missing_ok=True)
    record.write_text("")
    outcome = run_tests(tree, [name], None, limit=3600, slowest=900, marker=marker)
    if outcome.code not in (0, 5):
        said = output.read_text()[-3000:]
        print(f"{said}\n{name} fails at {outcome.failed}: no mutant is judged by it", file=sys.stderr)
        return None
    ran: dict[str, dict[str, set[str]]] = {}
    for line in record.read_text().splitlines():
        test, place = line.split("\t")
        source, _, function = place.partition(":")
        ran.setdefault(source, {}).setdefault(function, set()).add(test)
    for functions in ran.values():
        everyone = set().union(*functions.values())
        for function, tests in functions.items():
            if "" in tests:  # when the module is imported: it may matter to all tests that use the module
                functions[function] = everyone
    covers = {source: {f: sorted(tests - {""}) for f, tests in found.items()} for source, found in ran.items()}
    return {"tests": outcome.seconds, "marked": outcome.marked, "shares": outcome.shares, "covers": covers}


def _merged(known: dict[str, Any], found: dict[str, Any], marker: str) -> dict[str, Any]:
    covers = {source: dict(functions) for source, functions in known["covers"].items()}
    for source, functions in found["covers"].items():
        before = covers.setdefault(source, {})
        for function, tests in functions.items():
            before[function] = sorted({*before.get(function, []), *tests})
    both = {key: known[key] | found[key] for key in ("tests", "shares")}
    return known | both | {"measured": [*known["measured"], marker], "marked": found["marked"], "covers": covers}


def recording(tree: Path) -> Path:
    """Let each function of a copy of the repository say that it runs."""
    for path in sorted(tree.glob("src/salver/**/*.py")):
        source = path.relative_to(tree).as_posix()
        path.write_text(instrumented(path.read_text(encoding="utf-8"), source), encoding="utf-8")
    (tree / "src" / "salver" / "_recorder.py").write_text(RECORDER.format(path=str(tree / "ran.txt")))
    return tree


def instrumented(text: str, source: str) -> str:
    """A module whose functions call `_ran("source:function")` first; functions within a function say its name."""
    lines = text.splitlines(keepends=True)
    module, added = ast.parse(text), []  # (line, column, what to insert)

    def visit(node: ast.AST, inside: str, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.ClassDef) and not inside:
                visit(child, "", f"{prefix}{child.name}.")
            elif isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                name = inside or f"{prefix}{child.name}"
                added.append((*_first(child.body), f'_ran("{source}:{name}")'))
                visit(child, name, prefix)
            else:
                visit(child, inside, prefix)

    visit(module, "", "")
    if not added:
        return text
    imports = [node for node in module.body if isinstance(node, ast.ImportFrom) and node.module == "__future__"]
    begin = imports[-1].lineno + 1 if imports else _first(module.body)[0]
    added.append((begin, 0, "from salver._recorder import ran as _ran"))
    for line, column, call in sorted(added, reverse=True):
        old = lines[line - 1] if line <= len(lines) else ""
        before, after = old.encode()[:column].decode(), old.encode()[column:].decode()
        lines[line - 1 : line] = [
            f"{before}{call}\n{before}{after}" if not before.strip() else f"{before}{call}; {after}"
        ]
    return "".join(lines)


def _first(body: list[ast.stmt]) -> tuple[int, int]:
    """Line and column at which the first statement after the documentation begins."""
    words = isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant) and len(body) > 1
    first = body[1] if words else body[0]
    lines = [first.lineno, *(decorator.lineno for decorator in getattr(first, "decorator_list", []))]
    return min(lines), first.col_offset
