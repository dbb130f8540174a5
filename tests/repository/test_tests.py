"""Of the tests themselves: each can fail."""

from __future__ import annotations

import ast
from itertools import pairwise
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1]
REFUSALS = ("raises", "warns", "fail", "check_call", "assert_")

Nodes = dict[str, list[ast.AST]]


@pytest.fixture(scope="module")
def every() -> Nodes:
    """Every node of every file."""
    return {x.stem: list(ast.walk(ast.parse(x.read_text(encoding="utf-8")))) for x in sorted(FOLDER.rglob("*.py"))}


def _called(nodes: list[ast.AST]) -> set[str]:
    calls = (call.func for call in nodes if isinstance(call, ast.Call))
    return {func.attr if isinstance(func, ast.Attribute) else getattr(func, "id", "") for func in calls}


def _asserting(every: Nodes) -> set[str]:
    """Functions and methods of tests that may fail, by themselves or by one that they call."""
    functions = [
        (n.name, list(ast.walk(n))) for nodes in every.values() for n in nodes if isinstance(n, ast.FunctionDef)
    ]
    calls = [(name, _called(nodes)) for name, nodes in functions]
    found = {name for name, nodes in functions if any(isinstance(part, ast.Assert) for part in nodes)}
    found |= {name for name, called in calls if any(of.startswith(REFUSALS) for of in called)}
    while more := {name for name, called in calls if name not in found and called & found}:
        found |= more
    return found


def _checked_processes(node: ast.AST) -> bool:
    """Whether a program is run whose failure raises."""
    return any(
        keyword.arg == "check" for call in ast.walk(node) if isinstance(call, ast.Call) for keyword in call.keywords
    )


@pytest.mark.slow
def test_every_test_can_fail(every: Nodes) -> None:
    asserting = _asserting(every)
    silent = [
        f"{name}.{node.name}"
        for name, nodes in every.items()
        for node in nodes
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


@pytest.mark.slow
def test_no_assertion_is_true_by_its_words(every: Nodes) -> None:
    same = [
        f"{name}.py:{node.lineno}"
        for name, nodes in every.items()
        for node in nodes
        if isinstance(node, ast.Assert) and _same(node)
    ]
    assert same == []


@pytest.mark.slow
def test_no_test_imports_from_a_test(every: Nodes) -> None:
    """What two of them need is in a file of its own."""
    modules = [
        (name, node.module) for name, nodes in every.items() for node in nodes if isinstance(node, ast.ImportFrom)
    ]
    assert [pair for pair in modules if pair[1] in every and pair[1].startswith("test_")] == []
