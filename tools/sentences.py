"""A seeded sample of what a reader reads, to be rated by a person who did not write it.

    python tools/sentences.py --seed 0                          100 of docs, 60 of docstrings, 60 messages, 40 legends
    python tools/sentences.py --seed 0 --docs 30 --only howto   of pages and modules whose path has "howto" in it

Rate each: clear, awkward (read twice), or hard (cannot be parsed, or says nothing alone). Wanted: 90 % clear, 0 hard.
"""

from __future__ import annotations

import argparse
import ast
import inspect
import random
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
NOT_PROSE = re.compile(r"<!-- (?!not run).*?<!-- end -->|<!--.*?-->|^```.*?^```$|^\|.*?$|^#.*?$", re.M | re.S)
HEADING = re.compile(r"^#+ (.*)$", re.M)
SENTENCE = re.compile(r"(?<=[^.\d\s][.!?])\s+(?=[A-Z`*\"])")
SAY = {"say", "tell", "print", "refused", "Status"}
LEGENDS = {"label", "title", "xlabel", "ylabel"}


def pages() -> Iterator[tuple[str, str]]:
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        yield str(page.relative_to(ROOT)), page.read_text(encoding="utf-8")


def modules() -> Iterator[tuple[str, ast.Module]]:
    for module in sorted((ROOT / "src").rglob("*.py")):
        yield str(module.relative_to(ROOT)), ast.parse(module.read_text(encoding="utf-8"))


def split(text: str) -> Iterator[str]:
    """Sentences of four words or more."""
    for sentence in SENTENCE.split(" ".join(text.split())):
        if len(sentence.split()) > 3:
            yield sentence


def docs() -> Iterator[tuple[str, str]]:
    for name, text in pages():
        for paragraph in re.split(r"\n\s*\n|^\s*(?:[-*]|\d+\.) ", NOT_PROSE.sub("\n\n", text), flags=re.M):
            yield from ((name, sentence) for sentence in split(paragraph))


def docstrings() -> Iterator[tuple[str, str]]:
    for name, tree in modules():
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
                for paragraph in inspect.cleandoc(text).split("\n\n"):
                    yield from ((name, sentence) for sentence in split(paragraph))


def words_of(node: ast.AST) -> str:
    """A string or f-string as it stands, "{}" for what is filled in; else nothing."""
    if isinstance(node, ast.JoinedStr):
        return "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""


def messages() -> Iterator[tuple[str, str]]:
    for name, tree in modules():
        for node in ast.walk(tree):
            call = node.exc if isinstance(node, ast.Raise) else node
            if not isinstance(call, ast.Call):
                continue
            called = getattr(call.func, "id", getattr(call.func, "attr", ""))
            if isinstance(node, ast.Raise) or called in SAY:
                yield from ((name, text) for arg in call.args if len((text := words_of(arg)).split()) > 3)


def legends() -> Iterator[tuple[str, str]]:
    for name, text in pages():
        yield from (
            (name, heading) for heading in HEADING.findall(re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S))
        )
    for name, tree in modules():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call):
                given = [k.value for k in node.keywords if k.arg in LEGENDS]
                given += node.args[:2] if getattr(node.func, "id", "") == "time_chart" else []
                yield from ((name, text) for value in given if (text := words_of(value)))


def main() -> None:
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--only", default="", help="part of the path")
    kinds = {"docs": (docs, 100), "docstrings": (docstrings, 60), "messages": (messages, 60), "legends": (legends, 40)}
    for kind, (_, count) in kinds.items():
        options.add_argument(f"--{kind}", type=int, default=count)
    chosen = options.parse_args()
    for kind, (find, _) in kinds.items():
        found = [pair for pair in find() if chosen.only in pair[0]]
        drawn = random.Random(chosen.seed).sample(found, min(getattr(chosen, kind), len(found)))
        print(f"\n{kind}: {len(drawn)} of {len(found)}")
        for k, (name, sentence) in enumerate(drawn, 1):
            print(f"{k:3d} {name}: {sentence}")


if __name__ == "__main__":
    main()
