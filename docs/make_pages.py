"""What the pages take from the program, written into the pages themselves, so that they read the same everywhere.

    python docs/make_pages.py            write it again
    python docs/make_pages.py --check    exit 1, with the names, when a page differs from the program

Each place is `<!-- KIND: NAME -->`, what this command wrote, `<!-- end -->`:

help: plan                 the text of `salver plan --help`
keys: Motion               the keys of a table of the scenario file, from the model that checks it
example: cost              a file of examples/extending or benchmarks
api: salver.trajectory     the public names of a module, each with the first sentence of its docstring (on the site, all
                           of it with signatures: `docs/hooks.py`)
data: stops.findings       a piece of what a module of benchmarks says of the runs in docs/data
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from pydantic_core import PydanticUndefined
from typer.testing import CliRunner

from salver import scenario
from salver.cli import app
from salver.fields import Model
from salver.validation import in_words

DOCS = Path(__file__).parent
PLACE = re.compile(r"<!-- (help|keys|api|example|data): ([\w.-]+) -->(?:\n(?:(?!<!-- ).)*<!-- end -->)?", re.S)


def written(markdown: str) -> str:
    """A page with every place filled from the program."""
    return PLACE.sub(
        lambda place: f"<!-- {place[1]}: {place[2]} -->\n{WRITERS[place[1]](place[2])}\n<!-- end -->", markdown
    )


def help_of(command: str) -> str:
    """What `salver COMMAND --help` prints, 92 characters wide."""
    looks = {"COLUMNS": "92", "NO_COLOR": "1", "TERM": "dumb"}
    done = CliRunner().invoke(app, [command, "--help"], env=looks, prog_name="salver", catch_exceptions=False)
    assert done.exit_code == 0, done.output
    lines = [line.rstrip() for line in done.stdout.strip("\n").splitlines()]
    return "```text\n" + "\n".join(line.removeprefix(" ") for line in lines).strip("\n") + "\n```"


def example_of(name: str) -> str:
    """A file of `examples/extending` or `benchmarks`; `test_examples.py` and `test_peers.py` run them."""
    places = [DOCS.parent / folder / f"{name}.py" for folder in ("examples/extending", "benchmarks")]
    return f"```py\n{next(p for p in places if p.is_file()).read_text(encoding='utf-8')}```"


def keys_of(model: str) -> str:
    """A table of the keys that a scenario's table may have."""
    rows = ["| key | what it must be | default |", "|---|---|---|"]
    for name, field in getattr(scenario, model).model_fields.items():
        of_others = field.default_factory_takes_validated_data  # the default follows from other keys
        default = "see below" if of_others else _default(field.get_default(call_default_factory=True))
        rows.append(f"| `{name}` | {_in_cell(in_words(field))} | {default} |")
    return "\n".join(rows)


def names_of(module: str) -> str:
    """A table of the public names of a module, functions and classes, that have a docstring."""
    found = importlib.import_module(module)
    rows = [_first_sentence(found), "", "| name | what it is |", "|---|---|"]
    for name in getattr(found, "__all__", vars(found)):
        thing = getattr(found, name)
        if name.startswith("_") or not (inspect.isclass(thing) or inspect.isfunction(thing)):
            continue
        sentence = _first_sentence(thing)
        if sentence and (hasattr(found, "__all__") or thing.__module__ == module):
            rows.append(f"| `{name}` | {_in_cell(sentence)} |")
    return "\n".join(rows)


def data_of(name: str) -> str:
    """What `pieces()` of a module of `benchmarks` says of the runs that docs/data keeps."""
    module, piece = name.split(".")
    return _pieces(module)[piece]


@cache
def _pieces(module: str) -> dict[str, str]:
    sys.path[:0] = [str(DOCS.parent / folder) for folder in ("benchmarks", "tests/helpers")]
    return importlib.import_module(module).pieces()


def _first_sentence(thing: object) -> str:
    own = vars(thing).get("__doc__") if isinstance(thing, type) else thing.__doc__
    text = inspect.cleandoc(own or "")
    if isinstance(thing, type) and text.startswith(f"{thing.__name__}("):  # a dataclass without a docstring
        text = ""
    paragraph = " ".join(text.split("\n\n")[0].split())
    return re.split(r"(?<=[^.]\.)\s", paragraph)[0]


def _in_cell(text: str) -> str:
    return text.replace("|", r"\|")


def _default(value: Any) -> str:
    if value is PydanticUndefined:
        return "required"
    if value is None or value == {} or value == []:
        return "none"
    if isinstance(value, Model):
        return "see below"
    if isinstance(value, tuple):
        return f"`[{', '.join(map(str, value))}]`"
    return f'`"{value}"`' if isinstance(value, str) else f"`{value}`"


WRITERS: dict[str, Callable[[str], str]] = {
    "help": help_of,
    "keys": keys_of,
    "api": names_of,
    "example": example_of,
    "data": data_of,
}


def main() -> int:
    check, stale = "--check" in sys.argv[1:], []
    for page in [DOCS.parent / "README.md", *sorted(DOCS.rglob("*.md"))]:
        old = page.read_text(encoding="utf-8")
        new = written(old)
        if new != old:
            stale.append(str(page.relative_to(DOCS.parent)))
            if not check:
                page.write_text(new, encoding="utf-8")
    if check and stale:
        print(f"{', '.join(stale)} differ from the program; write them again with: python docs/make_pages.py")
    return int(check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
