"""Of the tests themselves: each can fail."""

from __future__ import annotations

import ast
from itertools import pairwise
from pathlib import Path

FOLDER = Path(__file__).parent
TREES = {path.stem: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(FOLDER.glob("*.py"))}
REFUSALS = ("raises", "warns", "fail", "check_call", "assert_")


def _called(node: ast.AST) -> set[str]:
    calls = (call.func for call in ast.walk(node) if isinstance(call, ast.Call))
    return {func.attr if isinstance(func, ast.Attribute) else getattr(func, "id", "") for func in calls}


def _asserting() -> set[str]:
    """Functions and methods of tests that may fail, by themselves or by one that they call."""
    functions = [n for tree in TREES.values() for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    calls = [(n.name, _called(n)) for n in functions]
    found = {n.name for n in functions if any(isinstance(part, ast.Assert) for part in ast.walk(n))}
    found |= {name for name, called in calls if any(of.startswith(REFUSALS) for of in called)}
    while more := {name for name, called in calls if name not in found and called & found}:
        found |= more
    return found


def _checked_processes(node: ast.AST) -> bool:
    """Whether a program is run whose failure raises."""
    return any(
        keyword.arg == "check" for call in ast.walk(node) if isinstance(call, ast.Call) for keyword in call.keywords
    )


def test_every_test_can_fail():
    asserting = _asserting()
    silent = [
        f"{name}.{node.name}"
        for name, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
        if node.name not in asserting and not _checked_processes(node)
    ]
    assert silent == []


def _same(assertion: ast.Assert) -> bool:
    """Whether both sides of a comparison are the same words: true whatever the code says."""
    test = assertion.test
    if isinstance(test, ast.Constant):
        return bool(test.value)
    if isinstance(test, ast.Compare):
        sides = [ast.unparse(side) for side in (test.left, *test.comparators)]
        return any(a == b for a, b in pairwise(sides))
    return isinstance(test, ast.Tuple)  # assert (this, "said")


def test_no_assertion_is_true_by_its_words():
    same = [
        f"{name}.py:{node.lineno}"
        for name, tree in TREES.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.Assert) and _same(node)
    ]
    assert same == []
