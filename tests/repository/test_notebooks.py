"""The notebooks run from top to bottom, each without what another one named, and show what their text says."""

import re
from pathlib import Path

import nbclient
import nbformat
import pytest
from jupyter_client.manager import AsyncKernelManager

pytestmark = pytest.mark.slow
NOTEBOOKS = Path(__file__).parents[2] / "examples" / "notebooks"


@pytest.fixture(scope="module")
def executed():
    """Runs a notebook in a folder; text of all outputs, and the number of pages shown inline. One kernel for all: it
    takes two seconds to start."""
    manager = AsyncKernelManager(kernel_name="python3")
    yield lambda name, folder: _executed(manager, name, folder)
    nbclient.util.run_sync(manager.shutdown_kernel)(now=True)


def _executed(manager, name, folder):
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)
    afresh = nbformat.v4.new_code_cell(f'%reset -f\n__import__("os").chdir({str(folder)!r})')
    notebook.cells.insert(0, afresh)
    nbclient.NotebookClient(notebook, km=manager, timeout=300).execute()
    text, frames = [], 0
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            assert output.output_type != "error"
            assert output.get("name") != "stderr", output.get("text")
            data = output.get("data", {})
            text += [output.get("text", ""), data.get("text/plain", "")]
            frames += data.get("text/html", "").startswith("<iframe srcdoc=")
    return "\n".join(text), frames


def test_every_notebook_is_run_here_and_kept_with_outputs_but_the_page():
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == {
        "reproduce_the_paper", "my_arm_and_bottle", "will_my_trajectory_slip", "your_own_load_and_arm",
    }  # fmt: skip
    for path in NOTEBOOKS.glob("*.ipynb"):
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
        assert outputs, f"{path}: python docs/make_notebooks.py {path.stem}"
        assert path.stat().st_size < 300_000, path


def test_reproduce_the_paper(executed, tmp_path):
    text, frames = executed("reproduce_the_paper", tmp_path)
    assert "<Plan panda-cube, method robust, duration 2.5 s, ok yes>" in text
    assert text.count("'holds'") == 2
    assert frames == 1


def test_my_arm_and_bottle(executed, tmp_path):
    text, frames = executed("my_arm_and_bottle", tmp_path)
    assert "'ranges': 'holds'" in text
    assert "'nominal': 'holds'" not in text
    assert frames == 1
    assert (tmp_path / "my-bottle.yaml").is_file()


def test_will_my_trajectory_slip(executed, tmp_path):
    text, _ = executed("will_my_trajectory_slip", tmp_path)
    assert "<Audit panda-cube, verdict does not hold" in text
    assert "Everything holds in the worst case" in text
    assert "('slides', 'holds')" in text


def test_your_own_load_and_arm(executed, tmp_path):
    text, frames = executed("your_own_load_and_arm", tmp_path)
    assert "{'20 %': 'holds', '5 %': 'slides'}" in text
    took = re.search(r"(\d\.\d+) s with friction known to 20 %, (\d\.\d+) s with 5 %", text)
    assert float(took[2]) < float(took[1])
    costs = dict(re.findall(r"'(\w+)': (0\.\d+)", text[text.index("{'mass': 0.0") :].split("}")[0]))
    assert sorted(costs) == ["com_x", "com_y", "com_z", "friction", "mass"]
    assert all(float(cost) > 0.001 for cost in costs.values())
    assert frames == 1
    assert (tmp_path / "my-lamp.script").is_file()
