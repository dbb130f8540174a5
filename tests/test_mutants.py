"""The wrong changes that `make mutate` makes: each changes what the code means, and nothing else of the file."""

import ast
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[1] / "tools"
sys.path.insert(0, str(TOOLS))

from mutants import mutants  # noqa: E402
from test_map import function_lines  # noqa: E402

sys.path.remove(str(TOOLS))


def becomes(line: str) -> set[str]:
    return {mutant.becomes for mutant in mutants(Path("x.py"), f"{line}\n")}


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
        ("y = a and not b", {"y = (a or not b)", "y = a and b"}),
        ("y = 0.5", {"y = 5.0"}),
        ("y = 3", {"y = 4"}),
        ("y = True", {"y = False"}),
        ("y = a < b", {"y = (a >= b)"}),
        ("y = len(a) < b", {"y = (len(a) >= b)", "y = (len(a) <= b)"}),
        ("y = a if c else b", {"y = (b if c else a)"}),
        ("y = f(x, tol=e)", {"y = f(x)"}),
        ("y = [x for x in z if x]", {"y = ([x for x in z])"}),
        ("x += dx", {"x -= dx", "pass"}),
        ("x.f(a)", {"pass"}),
        # texts, annotations, precautions and what words an error are left alone
        ("y: Literal[3] = x", set()),
        ('y = f"{x + 1:.3f}"', set()),
        ("y = list(zip(a, b, strict=True))", set()),
        ('raise ValueError("at most", 3)', {"pass"}),
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


def test_lines_of_functions_and_methods():
    assert function_lines(SOURCE) == {"Thing.turn": range(8, 14)}


@pytest.mark.parametrize("line", ["y = a + b", "y = a - b", "y = -x", "y = x[-1]", "y += x"])
def test_a_sign_is_told_from_other_changes(line):
    assert "sign" in {mutant.operator for mutant in mutants(Path("x.py"), f"{line}\n")}
    assert "sign" not in {mutant.operator for mutant in mutants(Path("x.py"), "y = a * b ** 2 @ c[i, j].T > 0.5\n")}
