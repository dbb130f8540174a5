"""One run of pytest in a process of its own, forked from one that has loaded the libraries but nothing of salver."""

import contextlib
import faulthandler
import json
import os
import resource
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from multiprocessing import get_context
from pathlib import Path
from signal import SIGKILL
from typing import Any

# Loaded once: they take longer than most tests. None of them starts a thread or keeps a state that a test could see.
LIBRARIES = ["pytest", "hypothesis", "numpy", "scipy.optimize", "scipy.signal", "scipy.spatial", "casadi", "mujoco"]
LIBRARIES += ["pinocchio", "coal", "clarabel", "piqp", "trimesh", "pydantic", "typer", "matplotlib.pyplot", "arro3.io"]


@dataclass
class Outcome:
    """What a run of pytest said. `code` is pytest's own, or -9 when it took too long as a whole."""

    code: int
    failed: str | None = None  # the first test that failed
    slow: bool = False  # whether that one is left out of `make quick`
    seconds: dict[str, float] = field(default_factory=dict)  # of processor, by each test and what it set up
    marked: list[str] = field(default_factory=list)  # tests that are left out of `make quick`
    shares: dict[str, list[str]] = field(default_factory=dict)  # by test: fixtures that it has in common with others


def run_tests(
    tree: Path, files: Sequence[str], order: Sequence[str] | None, *, limit: float, slowest: float, marker: str = ""
) -> Outcome:
    """Run tests of some files of a copy of the repository, up to the first that fails.

    `order`: the tests (node ids) to run, one after the other; None is for all, as they are written.
    `slowest`: seconds of processor after which a single test counts as hanging, or ten times as many by the clock: a
    busy machine kills nothing. `limit`: for all together, by the clock. With `marker` ("slow", "not slow") only those
    are measured in a copy that records (`test_map.recording`), to the end, and what they print is kept.
    """
    rank = None if order is None else {node: k for k, node in enumerate(order)}
    context = get_context("forkserver")
    context.set_forkserver_preload(LIBRARIES)
    result = tree / "outcome.json"
    result.unlink(missing_ok=True)
    process = context.Process(target=_child, args=(str(tree), list(files), rank, slowest, marker))
    process.start()
    process.join(limit)
    late = process.is_alive()
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid or 0, SIGKILL)  # with all that the tests left running
    process.join()
    found = json.loads(result.read_text()) if result.is_file() else {}
    return Outcome(**{**found, "code": -9 if late else process.exitcode})


class _Plugin:
    """Orders the tests, stops those that hang, notes the first that fails, and tells the recorder which test runs."""

    def __init__(self, tree: str, rank: Mapping[str, int] | None, slowest: float, measure: bool) -> None:
        self.result, self.rank, self.slowest, self.measure = Path(tree, "outcome.json"), rank, slowest, measure
        self.outcome, self.begun = Outcome(0), 0.0

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        self.outcome.marked = [item.nodeid for item in items if item.get_closest_marker("slow")]
        if self.rank is None:
            self.outcome.shares = {item.nodeid: list(_shared_fixtures(item)) for item in items}
        else:
            items[:] = sorted(
                (item for item in items if item.nodeid in self.rank), key=lambda item: self.rank[item.nodeid]
            )

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        if self.outcome.failed is None:
            self.note(nodeid)  # should the process die
            self.save()
            self.note(None)
        faulthandler.dump_traceback_later(10 * self.slowest, exit=True, file=sys.__stderr__)
        spent = resource.getrusage(resource.RUSAGE_SELF)
        allowed = int(spent.ru_utime + spent.ru_stime + self.slowest) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (allowed, resource.RLIM_INFINITY))
        if self.measure:
            _forget()  # what one test has cached would hide what the next one needs
            os.environ["SALVER_TEST"] = nodeid  # for the processes that it starts
            if "salver._recorder" in sys.modules:
                sys.modules["salver._recorder"].begin(nodeid)
        self.begun = sum(os.times()[:4])  # with the processes that it has waited for

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        self.outcome.seconds[nodeid] = sum(os.times()[:4]) - self.begun

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed and self.outcome.failed is None:
            self.note(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        faulthandler.cancel_dump_traceback_later()
        self.save()

    def note(self, nodeid: str | None) -> None:
        self.outcome.failed, self.outcome.slow = nodeid, nodeid in self.outcome.marked

    def save(self) -> None:
        self.result.write_text(json.dumps(asdict(self.outcome)))


def _shared_fixtures(item: Any) -> Iterator[str]:
    for name, definitions in item._fixtureinfo.name2fixturedefs.items():
        if definitions[-1].scope != "function" and not name.startswith("_") and "tmp_path" not in name:
            yield name


def _forget() -> None:
    """Empty the caches of functions of the repository: of salver, of the tests and of what they share."""
    for module in list(sys.modules.values()):
        if (getattr(module, "__file__", None) or "").startswith(os.getcwd()):
            for value in list(vars(module).values()):
                if hasattr(value, "cache_clear"):
                    value.cache_clear()


def _child(tree: str, files: list[str], rank: Mapping[str, int] | None, slowest: float, marker: str) -> None:
    os.setpgid(0, 0)
    os.chdir(tree)
    sys.path.insert(0, f"{tree}/src")
    os.environ["PYTHONPATH"] = f"{tree}/src"
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False  # the next mutant of this tree changes one file
    sink = os.open(os.devnull if not marker else f"{tree}/output.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(sink, 1)
    os.dup2(sink, 2)
    import pytest

    arguments = ["-q", "-p", "no:faulthandler", "-p", "no:cacheprovider", "--rootdir", tree, *files]
    arguments += ["-m", marker] if marker else ["-x"]
    code = pytest.main(arguments, plugins=[_Plugin(tree, rank, slowest, bool(marker))])
    sys.stdout.flush()
    os._exit(int(code))
