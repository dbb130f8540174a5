"""Two things that the site has and the pages' own text has not.

All docstrings and signatures of a module, where the text has a table:
    its heading, <!-- api: salver.contact_margins --> ... <!-- end -->    becomes    ::: salver.contact_margins

The notebooks of examples/notebooks, to which pages link, beside the pages.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).parents[1] / "examples" / "notebooks"


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File

    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{notebook.name}", abs_src_path=str(notebook)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    markdown = re.sub(r"\]\((?:\.\./)+examples/notebooks/", "](../notebooks/", markdown)
    return re.sub(r"## `salver[\w.]*`\n\n<!-- api: ([\w.]+) -->\n.*?<!-- end -->", r"::: \1", markdown, flags=re.S)
