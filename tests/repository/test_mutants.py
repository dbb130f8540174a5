"""The wrong changes that `make mutate` makes: each changes what the code means, and nothing else of the file."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))

from mutants import mutants, signatures  # noqa: E402
from test_map import RECORDER, instrumented  # noqa: E402

sys.path.remove(str(TOOLS))


def becomes(line: str) -> set[str]:
    return {mutant.becomes for mutant in mutants(Path("x.py"), f"{line}\n", KNOWN)}


KNOWN = signatures(["def run(a, b, c=1): ...", "class Thing:\n    x: int\n    y: int = 0"])


@pytest.mark.parametrize(
    ("line", "changes"),
    [
        ("y = a - b", {"y = (a + b)"}),
        ("y = R.T @ x", {"y = R @ x", "y = (x @ R.T)"}),
        ("y = -x", {"y = x"}),
        ("y = np.abs(x)", {"y = x"}),
        ("y = np.minimum(a, b)", {"y = np.maximum(a, b)"}),
        ("y = x[i, j]", {"y = x[j, i]"}),
        ("y = x[k:]", {"y = x[:]"}),
        ("y = a and not b", {"y = (a or not b)", "y = a and b", "y = (not b)", "y = a"}),
        ("y = a or b or c", {"y = (a and b and c)", "y = (a or b)", "y = (a or c)", "y = (b or c)"}),
        ("y = 0.5", {"y = 5.0"}),
        ("y = 3", {"y = 4"}),
        ("y = True", {"y = False"}),
        ("y = a < b", {"y = (a >= b)"}),
        ("y = len(a) < b", {"y = (len(a) >= b)", "y = (len(a) <= b)"}),
        ("y = a if c else b", {"y = (b if c else a)", "y = b"}),
        ("y = f(x, tol=e)", {"y = f(x)"}),
        ("y = [x for x in z if x]", {"y = ([x for x in z])", "y = []"}),
        ("y = [a, b]", {"y = []"}),
        ("y = np.stack([a, b])", set()),
        ("y = {'a': a, 'b': b}", {"y = {'a': a}", "y = {'b': b}"}),
        ("y = a | {'b': b}", {"y = a"}),
        ("y = run(a, b, c)", {"y = run(a, b)"}),
        ("y = run(a, b)", {"y = run(b, a)"}),
        ("y = Thing(x=a, y=b)", {"y = Thing(x=a)"}),
        ("y = f(self.t)", {"y = f(0.5 * self.t)"}),
        ("y = len(self.t)", set()),
        ("y = t - t[0]", {"y = t", "y = (t + t[0])", "y = t - t[1]"}),
        ("y = range(k)", {"y = range(0, k - 1)", "y = range(0 + 1, k)"}),
        ("y = default_rng([s, k])", {"y = default_rng([s])", "y = default_rng([])"}),
        ("y = default_rng(s)", {"y = default_rng(0)"}),
        ("y = np.array(x)", {"y = np.array(x, dtype=np.float32)"}),
        ("y = np.empty(n, dtype=bool)", set()),
        ("if a:\n    b += c\nelse:\n    c", {"if (not a):", "if False:", "b -= c", "pass"}),
        ("x += dx", {"x -= dx", "pass"}),
        ("x.f(a)", {"pass"}),
        # texts, annotations, precautions and what words an error are left alone
        ("y: Literal[3] = x", set()),
        ("Check = Callable[[A, B], C]", set()),
        ("y = x.reshape(-1)", set()),
        ('y = f"{x + 1:.3f}"', set()),
        ("y = list(zip(a, b, strict=True))", set()),
        ('raise ValueError("at most", 3)', {"pass"}),
        ("if TYPE_CHECKING:\n    from a import b", set()),
        ("__all__ = ['a', 'b']", set()),
    ],
)
def test_changes_of_a_line(line, changes):
    assert becomes(line) == changes


SOURCE = '''"""A module with 3 numbers in its words."""

LIMIT = 2


class Thing:
    def turn(self, x):  # keeps its comment
        if x > LIMIT:
            return x.T
        return [
            a - 1
            for a in x
        ]
'''


NESTED = '''

def outer():
    "Words."
    @staticmethod
    def inner(x):
        return 3 * x
    return inner.__func__


def one(): return 1


class Kept:
    @property
    def name(self):
        """What it is called."""
        if True:
            return "a"
'''


def test_each_mutant_is_valid_and_changes_one_place():
    found = mutants(Path("x.py"), SOURCE)
    assert len({mutant.source for mutant in found}) == len(found) >= 7
    for mutant in found:
        assert ast.dump(ast.parse(mutant.source)) != ast.dump(ast.parse(SOURCE))
        assert mutant.was.splitlines()[0] in SOURCE
        assert "# keeps its comment" in mutant.source
    assert {mutant.function for mutant in found if "LIMIT =" in mutant.was} == {""}
    assert {mutant.function for mutant in found if "LIMIT =" not in mutant.was} == {"Thing.turn"}
    assert any(mutant.becomes == "if False:" for mutant in found)


def test_functions_say_that_they_run_and_do_what_they_did(tmp_path, monkeypatch):
    source = SOURCE.replace("LIMIT = 2", "from __future__ import annotations\n\nLIMIT = 2") + NESTED
    (tmp_path / "salver").mkdir()
    (tmp_path / "salver" / "__init__.py").touch()
    (tmp_path / "salver" / "_recorder.py").write_text(RECORDER.format(path=str(tmp_path / "ran.txt")))
    (tmp_path / "salver" / "changed.py").write_text(instrumented(source, "x.py"))
    program = """
import os
os.environ["SALVER_TEST"] = "first"
from salver import _recorder, changed
assert changed.outer.__doc__ == "Words."
inner = changed.outer()
_recorder.begin("second")
assert inner(2) == 6 and changed.one() == 1
if os.fork() == 0:
    changed.Kept().name
    os._exit(0)
os.wait()
"""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    subprocess.run([sys.executable, "-c", program], check=True)
    assert (tmp_path / "ran.txt").read_text().splitlines() == [
        "first\tx.py:outer",
        "second\tx.py:outer",
        "second\tx.py:one",
        "second\tx.py:Kept.name",
    ]


@pytest.mark.parametrize("line", ["y = a + b", "y = a - b", "y = -x", "y = x[-1]", "y += x"])
def test_a_sign_is_told_from_other_changes(line):
    assert "sign" in {mutant.operator for mutant in mutants(Path("x.py"), f"{line}\n")}
    assert "sign" not in {mutant.operator for mutant in mutants(Path("x.py"), "y = a * b ** 2 @ c[i, j].T > 0.5\n")}
