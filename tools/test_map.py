"""Which tests run which function of salver, and how long they take: measured with coverage.py, kept in out/.

Each test file is measured in a process of its own: what one file has cached hides nothing from the next. The map is
measured again for the test files that changed; functions that it does not know yet are taken to be run by every file.
"""

import ast
import hashlib
import json
import shutil
import sys
import tempfile
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
patch = subprocess
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
    """`covers[test file][source file][function]` is the list of the tests of that file that ran the function."""

    def __init__(self, path: Path = MAP) -> None:
        self.path = path
        self.files: dict[str, dict[str, Any]] = json.loads(path.read_text()) if path.is_file() else {}

    def update(self, workers: int, again: bool = False, only: list[str] | None = None) -> None:
        """Measure the test files (or `only` some) that are new or have changed, or all of them again."""
        present = {path.relative_to(ROOT).as_posix(): _digest(path) for path in sorted(ROOT.glob("tests/**/test_*.py"))}
        for name in only or []:
            if name not in present:
                raise SystemExit(f"There is no test file {name}; give it as in tests/test_geometry.py.")
        self.files = {name: entry for name, entry in self.files.items() if name in present}
        due = [
            name
            for name, digest in present.items()
            if (again or self.files.get(name, {}).get("digest") != digest) and (not only or name in only)
        ]
        if not due:
            return
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
                    self.files[name] = {"digest": present[name], **found}
                    self.save()
                    print(f"{name}: {sum(found['tests'].values()):.1f} s", file=sys.stderr)

            list(pool.map(measure, due))

    def save(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self.path.write_text(json.dumps(self.files, indent=0, sort_keys=True))

    def of_files(self, names: list[str]) -> "TestMap":
        """A part of the map, not saved."""
        part = TestMap(self.path)
        part.files = {name: self.files[name] for name in names if name in self.files}
        return part

    def tests_of(self, source: str, function: str) -> tuple[list[str], set[str]]:
        """Test files that run a function, the quickest first, and their tests that were seen to run it."""
        known = any(function in entry["covers"].get(source, {}) for entry in self.files.values()) and function
        files, direct = [], set()
        for name, entry in self.files.items():
            functions = entry["covers"].get(source)
            if functions is not None and (not known or function in functions):
                files.append(name)
                direct.update(functions.get(function, []))
        if not files:  # a module that the map does not know
            files = list(self.files)

        def cost(name: str) -> float:
            tests = self.files[name]["tests"]
            return sum(tests[test] for test in direct if test in tests) or sum(tests.values())

        return sorted(files, key=cost), direct

    def seconds(self, files: list[str]) -> float:
        return sum(sum(self.files[name]["tests"].values()) for name in files)


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def _measure(tree: Path, name: str) -> dict[str, Any] | None:
    """What the tests of a file take and run; None, said on standard error, when they fail as they are."""
    import coverage

    (tree / "output.txt").unlink(missing_ok=True)
    settings = tree / "coverage.ini"
    settings.write_text(SETTINGS.format(tree=tree))
    outcome = run_tests(tree, [name], _as_written, limit=3600, slowest=900, coverage=str(settings))
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
            if any(line in contexts for line in lines):
                covers[source][function] = sorted(tests - {""})
    combined.erase()
    return {"tests": outcome.seconds, "covers": covers}


def _as_written(_node: str, _slow: bool) -> int:
    return 0


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
