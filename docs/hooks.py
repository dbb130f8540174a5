"""Two things that the site has and the pages' own text has not.

All docstrings and signatures of a module, where the text has a table:
    its heading, <!-- api: salver.contact_margins --> ... <!-- end -->    becomes    ::: salver.contact_margins

The notebooks of examples/notebooks as pages, with the outputs that they are kept with.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

NOTEBOOKS = Path(__file__).parents[1] / "examples" / "notebooks"


def on_files(files: Any, config: Any) -> Any:
    from mkdocs.structure.files import File

    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        text = "\n\n".join(parts_of(json.loads(notebook.read_text(encoding="utf-8"))))
        files.append(File.generated(config, f"notebooks/{notebook.stem}.md", content=text))
    return files


def parts_of(notebook: dict[str, Any]) -> Iterator[str]:
    """Markdown of each cell and of what it printed and drew."""
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            yield source.replace("](../../docs/", "](../")
            continue
        yield f"```python\n{source}\n```"
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/png" in data:
                yield f'<img alt="" src="data:image/png;base64,{"".join(data["image/png"]).strip()}">'
            else:
                text = "".join(output.get("text") or data.get("text/plain", "")).rstrip()
                yield f"```{{.text .output}}\n{text}\n```"


def on_page_markdown(markdown: str, **_: Any) -> str:
    markdown = re.sub(r"\]\((?:\.\./)+examples/notebooks/(\w+)\.ipynb", r"](../notebooks/\1.md", markdown)
    return re.sub(r"## `salver[\w.]*`\n\n<!-- api: ([\w.]+) -->\n.*?<!-- end -->", r"::: \1", markdown, flags=re.S)
