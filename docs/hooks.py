"""What the pages take from the program when the site is built, so that it cannot go out of date.

<!-- help: plan -->           the text of `salver plan --help`
<!-- keys: Motion -->         the keys of a table of the scenario file, from the model that checks it
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

from pydantic_core import PydanticUndefined

from salver import scenario
from salver.validation import in_words


def on_page_markdown(markdown: str, **_: Any) -> str:
    markdown = re.sub(r"<!-- help: ([\w-]+) -->", lambda m: _help(m[1]), markdown)
    return re.sub(r"<!-- keys: (\w+) -->", lambda m: _keys(m[1]), markdown)


def _help(command: str) -> str:
    environment = {**os.environ, "COLUMNS": "92", "NO_COLOR": "1", "TERM": "dumb"}
    salver = Path(sys.executable).with_name("salver")
    done = subprocess.run([salver, command, "--help"], capture_output=True, text=True, env=environment, check=True)
    lines = [line.rstrip() for line in done.stdout.strip("\n").splitlines()]
    return "```text\n" + "\n".join(line[1:] if line.startswith(" ") else line for line in lines) + "\n```"


def _keys(model: str) -> str:
    rows = ["| key | what it must be | default |", "|---|---|---|"]
    for name, field in getattr(scenario, model).model_fields.items():
        default = field.get_default(call_default_factory=True)
        rows.append(f"| `{name}` | {in_words(field).replace('|', chr(92) + '|')} | {_default(default)} |")
    return "\n".join(rows)


def _default(value: Any) -> str:
    if value is PydanticUndefined:
        return "required"
    if value is None or value == {} or value == []:
        return "none"
    if isinstance(value, scenario.Model):
        return "see below"
    if isinstance(value, tuple):
        return f"`[{', '.join(map(str, value))}]`"
    return f'`"{value}"`' if isinstance(value, str) else f"`{value}`"
