"""Pages with parts that a command writes: text between `<!-- written: NAME -->` and `<!-- end -->` is replaced.

The words around it are written by hand, and must be read again when the numbers change.
"""

from __future__ import annotations

import re
from pathlib import Path


def replace(page: Path, name: str, text: str) -> None:
    """Put a text in its place in a page, which must have exactly one for it."""
    block = f"<!-- written: {name} -->\n{text}\n<!-- end -->"
    old = page.read_text(encoding="utf-8")
    new, count = re.subn(rf"<!-- written: {name} -->.*?<!-- end -->", lambda _: block, old, flags=re.S)
    if count != 1:
        raise SystemExit(f"{page} has {count} places for {name}; it needs one")
    page.write_text(new, encoding="utf-8")
    print(f"{name}:\n{text}\n", flush=True)
