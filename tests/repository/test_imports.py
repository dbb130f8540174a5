"""Importing salver is cheap and silent: nothing heavy is loaded until it is needed."""

import ast
import graphlib
import importlib
import json
import platform
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest

import salver
from salver.errors import MissingDependencyError, needs

ROOT = Path(__file__).parents[2]
HEAVY = (
    "arro3",
    "casadi",
    "coal",
    "matplotlib",
    "mujoco",
    "numpy",
    "pinocchio",
    "piqp",
    "pydantic",
    "rosbags",
    "scipy",
    "trimesh",
)


def _run(code):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return json.loads(done.stdout)


@pytest.mark.parametrize("module", ["salver", "salver.cli"])
def test_importing_loads_nothing_heavy(module):
    loaded = _run(f"import json, sys; import {module}; print(json.dumps(sorted(sys.modules)))")
    assert module in loaded
    assert not set(HEAVY) & set(loaded)


@pytest.mark.slow
def test_help_loads_nothing_heavy():
    """It reads every command's module."""
    code = """
import contextlib, io, json, sys
from salver.cli import main
sys.argv = ["salver", "--help"]
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    main()
print(json.dumps(sorted(sys.modules)))
"""
    loaded = _run(code)
    assert "salver.cli.learning.track" in loaded
    assert not set(HEAVY) & set(loaded)


@pytest.mark.slow
def test_planning_needs_no_physics_engine_and_no_plotting():
    code = """
import json, sys
from salver.planning.make import make_plan
from salver.scenario import load
plan = make_plan(load("panda-cube"))
assert plan.joint is not None
print(json.dumps(sorted(sys.modules)))
"""
    loaded = _run(code)
    assert not {"mujoco", "matplotlib", "arro3", "rosbags", "trimesh", "scipy.optimize"} & set(loaded)


@pytest.mark.slow
def test_planning_the_object_loads_no_search_and_of_scipy_what_it_calls(tmp_path):
    """A third of the command's time would be theirs."""
    code = f"""
import contextlib, io, json, sys
from salver.cli import main
sys.argv = ["salver", "plan", "panda-cube", "-o", {str(tmp_path / "plan")!r}]
with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
    with contextlib.suppress(SystemExit):
        main()
print(json.dumps(sorted(sys.modules)))
"""
    loaded = set(_run(code))
    assert (tmp_path / "plan" / "plan.json").exists()
    idle = {"scipy.interpolate", "scipy.optimize", "scipy.stats", "salver.planning.fastest.search"}
    assert {"salver.planning.object", "scipy.linalg"} <= loaded
    assert not idle & loaded


@pytest.mark.slow
def test_importing_changes_no_global_state():
    code = """
import json, random, sys, warnings
import numpy as np
before = (np.geterr(), np.get_printoptions(), random.getstate(), np.random.get_state()[1].tolist(), warnings.filters[:])
import salver, salver.cli, salver.scenario
after = (np.geterr(), np.get_printoptions(), random.getstate(), np.random.get_state()[1].tolist(), warnings.filters[:])
print(json.dumps(before == after))
"""
    assert _run(code) is True


@pytest.mark.slow
def test_everything_imported_is_a_declared_dependency():
    """Direct imports of other packages' dependencies would break when those packages drop them."""

    def normal(name):
        return re.sub(r"[-_.]+", "-", name).lower()

    declared = {normal(re.split(r"[^A-Za-z0-9._-]", r, maxsplit=1)[0]) for r in metadata.requires("salver") or []}
    # These install below a prefix of their own, where the metadata does not list the modules.
    cmeel = {"pinocchio": ["pin"], "coal": ["coal"]}
    distributions = metadata.packages_distributions() | cmeel
    optional = {"gymnasium", "imageio_ffmpeg", "pandas", "pylibfranka", "ray", "xarray"}
    for path in Path(salver.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                names.append(node.module)
            for top in {name.split(".")[0] for name in names} - set(sys.stdlib_module_names) - {"salver"} - optional:
                assert {normal(d) for d in distributions[top]} & declared, f"{path.name} imports {top}"


@pytest.mark.slow
def test_there_is_no_circle_of_imports():
    """Those for types alone included: whatever two modules both need is below them."""
    root = Path(salver.__file__).parent.parent
    names = {".".join(path.relative_to(root).with_suffix("").parts): path for path in root.glob("salver/**/*.py")}
    modules = {name.removesuffix(".__init__"): path for name, path in names.items()}
    graph = {}
    for name, path in modules.items():
        nodes = [n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.ImportFrom)]
        found = {f"{n.module}.{alias.name}" for n in nodes for alias in n.names} | {n.module for n in nodes}
        parents = {n.module for n in nodes if {f"{n.module}.{a.name}" for a in n.names} <= modules.keys()}
        graph[name] = (found & modules.keys()) - parents
    assert len(graph) > 100
    tuple(graphlib.TopologicalSorter(graph).static_order())  # raises CycleError, which names the circle


@pytest.mark.slow
def test_without_casadi_one_sentence_says_how_to_get_it_and_the_rest_works():
    code = """
import json, sys
sys.modules["casadi"] = None  # as if it were not installed
from salver.errors import MissingDependencyError
import salver.sensitivity.tray, salver.planning.plan
try:
    import salver.sensitivity.engine
except MissingDependencyError as error:
    print(json.dumps(str(error)))
"""
    assert "pip install 'salver[own-loop]'" in _run(code)


def test_each_extra_has_what_is_said_to_need_it():
    """What is imported within `with needs(extra, ...)` is among the packages of that extra."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    packages, seen = metadata.packages_distributions(), set()
    texts = {path: path.read_text(encoding="utf-8") for path in (ROOT / "src" / "salver").rglob("*.py")}
    for path in (path for path, text in texts.items() if "with needs(" in text):
        for block in ast.walk(ast.parse(texts[path])):
            call = block.items[0].context_expr if isinstance(block, ast.With) else None
            if not isinstance(call, ast.Call) or ast.unparse(call.func) != "needs":
                continue
            extra = call.args[0].value
            here = extras[extra] + [x for other in extras if f"salver[{other}]" in extras[extra] for x in extras[other]]
            imports = [node for node in ast.walk(block) if isinstance(node, ast.Import | ast.ImportFrom)]
            names = {getattr(node, "module", None) or node.names[0].name for node in imports}
            for name in {name.split(".")[0] for name in names}:
                provided = packages.get(name, [name])
                assert any(re.match(rf"{p}[>=]", one, re.I) for p in provided for one in here), f"{path.name}: {name}"
            seen.add(extra)
    assert seen == {"bags", "engine", "gym", "own-loop", "plots", "robot", "tables", "xarm"}


def test_what_a_machine_lacks_is_not_a_missing_package():
    """The command line then names the library (test_what_the_machine_refuses_is_no_defect)."""
    lacks = pytest.raises(MissingDependencyError, match="A film needs nowhere, which is not installed")
    with lacks, needs("engine", "A film"):
        importlib.import_module("nowhere.inside")
    with pytest.raises(ImportError, match=r"^libGL"), needs("engine", "A film"):
        raise ImportError("libGL.so.1: cannot open shared object file: No such file or directory")


@pytest.mark.slow
def test_without_the_extras_plans_are_made_checked_shown_and_exported(tmp_path):
    """And what an extra is for says in one sentence how to install it."""
    code = f"""
import json, sys
from importlib import metadata
hidden, known = ("mujoco", "matplotlib", "rosbags", "arro3", "PIL", "pandas", "xarray", "casadi"), metadata.version
def version(name):
    if name in hidden:
        raise metadata.PackageNotFoundError(name)
    return known(name)
metadata.version = version
for name in hidden:
    sys.modules[name] = None  # as if it were not installed
import salver as sv
from salver.errors import MissingDependencyError
from salver.export import write_export
from salver.reports.film import write_film
from salver.studio.server import Studio
plan = sv.plan("panda-cube-1.2s")
folder = plan.save({str(tmp_path / "run")!r})
(path,) = write_export(folder, "csv")
assert sv.audit(path, "panda-cube-1.2s").ok
assert sv.retime(plan).ok
assert "<html" in sv.report(plan).html
said = []
for needed in (
    lambda: sv.simulate(plan),
    lambda: sv.campaign(folder, 2),
    lambda: plan.margins.plot(),
    lambda: plan.to_xarray(),
    lambda: plan.to_pandas(),
    lambda: write_export(folder, "ros2"),
    lambda: write_film(folder, folder / "film.gif"),
):
    try:
        needed()
    except MissingDependencyError as error:
        said.append(str(error))
text = (folder / "scenario.toml").read_text()
with Studio(text, folder / "mine.toml", folder) as page:
    said += [page._say({{"do": "live", "text": text, "window": "w"}})["problem"]]
print(json.dumps(said))
"""
    needed = [("mujoco", "engine")] * 2 + [("matplotlib", "plots"), ("xarray", "tables"), ("pandas", "tables")]
    needed += [("rosbags", "bags"), ("PIL", "engine"), ("mujoco", "engine")]
    for sentence, (package, extra) in zip(_run(code), needed, strict=True):
        install = f"pip install 'salver[{extra}]'"
        assert sentence.endswith(f" needs {package}, which is not installed; install it with: {install}.")


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="how other libraries keep what is freed is theirs")
def test_freed_arrays_are_not_asked_of_the_system_again():
    """Three of a megabyte (more would be given back together), a hundred times: 256 pages of 4096 bytes in each."""
    code = """
import json, resource
import numpy as np
import salver.models
kept = []
for _ in range(101):
    arrays = [np.ones(1 << 17) for _ in range(3)]
    del arrays
    kept.append(resource.getrusage(resource.RUSAGE_SELF).ru_minflt)
print(json.dumps(kept[-1] - kept[0]))
"""
    assert _run(code) < 256
