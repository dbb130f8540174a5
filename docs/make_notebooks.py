"""Runs the notebooks of examples/notebooks and keeps them with their outputs: python docs/make_notebooks.py [NAME ...]

The replay page that `sv.report` shows is left out: it is a megabyte, and there when the notebook is run.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import nbclient
import nbformat

NOTEBOOKS = Path(__file__).parents[1] / "examples" / "notebooks"


def main() -> None:
    for name in sys.argv[1:] or sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb")):
        path = NOTEBOOKS / f"{name}.ipynb"
        notebook = nbformat.read(path, as_version=4)
        with tempfile.TemporaryDirectory() as folder:
            resources = {"metadata": {"path": folder}}
            nbclient.NotebookClient(notebook, timeout=300, resources=resources, record_timing=False).execute()
        for cell in notebook.cells:
            for output in cell.get("outputs", []):
                if output.get("data", {}).get("text/html", "").startswith("<iframe"):
                    del output["data"]["text/html"]
        notebook.metadata.pop("widgets", None)
        notebook.metadata["language_info"] = {"name": "python"}
        nbformat.write(notebook, path)
        print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
