"""Every code block of the README and of the documentation runs, in the order of its page, in a directory of its own.

    ```python   executed, one namespace for each page
    ```sh       executed by bash; lines that set up a clone (git, cd, make) are left to .ci/run
    ```toml     written to the file that its first line names: # file: mine.toml
    ```text     right after one of these: the output it must give; `...` stands for anything, numbers may differ by 5 %

A block that needs hardware is preceded by a comment: <!-- not run: reason -->. How-to pages start from a run directory
as docs/commands.md makes it: a block of commands that it shows too is run there alone, unless its output is promised.
Other pages leave out a block of commands whose outputs pages promise: it is run there.
"""

import contextlib
import functools
import importlib
import io
import math
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

import warm_command
from salver.cli import COMMANDS

ROOT = Path(__file__).parents[2]
COMMAND_LIST = ROOT / "docs" / "commands.md"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```$", re.M | re.S)
NUMBER = r"[-+]?(?:\d+\.\d*|\.\d+|\d+)(?:[eE][-+]?\d+)?"
SET_UP = ("git ", "cd ", "make ", "source ")


@dataclass(frozen=True)
class Block:
    language: str
    code: str
    line: int
    expected: str | None


def blocks_of(text):
    found, position, skipped = [], 0, False
    for match in FENCE.finditer(text):
        between = text[position : match.start()]
        position = match.end()
        language, code = match[1], match[2]
        if language == "text" and found and not between.strip() and not skipped:
            last = found[-1]
            found[-1] = Block(last.language, last.code, last.line, code)
            continue
        skipped = "<!-- not run:" in between.rstrip().rsplit("\n\n", 1)[-1]
        if language in ("python", "sh", "toml") and not skipped:
            found.append(Block(language, code, text.count("\n", 0, match.start()) + 2, None))
    return found


def run(block, namespace):
    """Output of a block, run in the current directory."""
    if block.language == "python":
        with contextlib.redirect_stdout(io.StringIO()) as output:
            exec(compile(block.code, "block", "exec"), namespace)
        return output.getvalue()
    if block.language == "toml":
        name = re.match(r"# file: (\S+)\n", block.code)
        if name:
            Path(name[1]).write_text(block.code, encoding="utf-8")
        return ""
    lines = [line for line in block.code.splitlines() if not line.startswith(SET_UP)]
    environment = {**os.environ, "COLUMNS": "100", "NO_COLOR": "1"}
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", "\n".join(lines)], capture_output=True, text=True, env=environment
    )
    assert done.returncode == 0, f"exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def assert_output(output, expected):
    pattern, numbers = "", []
    cut_short = r"(?P<cut>[-+.\d]+?)(?=\.\.\.)"  # 0.2... stands for any number that begins so
    tokens = rf"\.\.\.|{cut_short}|(?P<number>{NUMBER})|(?P<space>\s+)|[^\d\s.+-]+|[.+-]"
    for token in re.finditer(tokens, expected.strip()):
        if token[0] == "...":
            pattern += ".*?"
        elif token["number"]:
            pattern += f"({NUMBER})"
            numbers.append(float(token[0]))
        else:
            pattern += r"\s+" if token["space"] else re.escape(token[0])
    match = re.fullmatch(pattern, output.strip(), re.S)
    assert match, f"the page promises\n{expected}\nbut the block gives\n{output}"
    for promised, given in zip(numbers, match.groups(), strict=True):
        assert math.isclose(promised, float(given), rel_tol=0.05, abs_tol=1e-12), f"{promised} became {given}\n{output}"


def commands(block):
    """The lines of a block without comments, as they are typed."""
    return {" ".join(line.split("#")[0].split()) for line in block.code.splitlines()} - {""}


@functools.cache
def commands_of(*pages, promised=False):
    """Those of all blocks of pages, or of the blocks whose output a page promises."""
    blocks = [block for page in pages for block in blocks_of(page.read_text(encoding="utf-8"))]
    return set().union(*(commands(b) for b in blocks if b.language == "sh" and (b.expected or not promised)))


@pytest.fixture(scope="module")
def on_the_path(tmp_path_factory):
    """`salver`, loaded once for all pages (that it starts by itself is tested in test_cli.py), and `python`."""
    with warm_command.command(tmp_path_factory.mktemp("bin")) as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", f"{folder}:{Path(sys.executable).parent}:{os.environ['PATH']}")
        yield


@pytest.fixture(scope="module")
def planned(tmp_path_factory, on_the_path):
    """The run directory that the how-to pages start from."""
    directory = tmp_path_factory.mktemp("docs") / "cube"
    run(Block("sh", f"salver plan panda-cube -o {directory}", 0, None), {})
    return directory


@pytest.mark.parametrize("page", PAGES, ids=[str(p.relative_to(ROOT)) for p in PAGES])
@pytest.mark.slow
def test_blocks_of_the_page_run(page, planned, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    elsewhere = commands_of(*PAGES, promised=True)
    if page.parent.name == "howto":
        shutil.copytree(planned, "runs/cube")
        elsewhere = commands_of(COMMAND_LIST)
    namespace = {"__name__": "__page__"}
    for block in blocks_of(page.read_text(encoding="utf-8")):
        if block.language == "sh" and block.expected is None and commands(block) <= elsewhere:
            continue
        try:
            output = run(block, namespace)
        except Exception as error:
            raise AssertionError(f"{page.name}, line {block.line}: {error}\n{block.code}") from error
        if block.expected is not None:
            assert_output(output, block.expected)


def test_every_command_is_shown():
    commands = COMMAND_LIST.read_text(encoding="utf-8")
    pages = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "howto").glob("*.md"))
    for name in COMMANDS:
        assert f"`salver {name}" in commands, name
        assert f"<!-- help: {name} -->" in pages or name in ("demo", "scenarios"), name


@pytest.mark.parametrize("page", PAGES, ids=[str(p.relative_to(ROOT)) for p in PAGES])
def test_a_page_reads_the_same_in_a_file_as_on_the_site(page):
    """Every place for what a command writes is filled and ended, and no stub is left that only the site would fill."""
    text = page.read_text(encoding="utf-8")
    assert not re.search(r"^:::", text, re.M)
    places = re.findall(r"<!-- ([\w -]+): ([^>]*?) -->(.*?)(?=<!-- |\Z)(<!-- end -->)?", text, re.S)
    for kind, name, content, end in places:
        assert kind in ("help", "keys", "api", "example", "data", "written", "not run"), f"{kind}: {name}"
        if kind != "not run":
            assert content.strip(), f"{kind}: {name} is empty"
            assert end, f"{kind}: {name} does not end"
    assert text.count("<!-- end -->") == len([kind for kind, *_ in places if kind != "not run"])


@pytest.mark.slow
def test_what_pages_take_from_the_program_is_what_it_says_now():
    done = subprocess.run(
        [sys.executable, ROOT / "docs" / "make_pages.py", "--check"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_the_page_of_the_engine_is_made_of_a_campaign(planned, tmp_path, monkeypatch):
    """No other test takes the figures of the page from a campaign."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    page = importlib.import_module("make_physics")
    monkeypatch.setattr(page, "RUNS", 2)
    written = page.campaign(shutil.copytree(planned, tmp_path / "run"))
    assert re.search(r"\| holds \| 2 of 2 \(.*\| 2 of 2 \(", written)
    low, high = map(float, re.search(r"\(from ([-+.\d]+) to ([-+.\d]+) µm\)", written).groups())
    assert -50 < low <= high < 50


@pytest.mark.parametrize("name", ["performance", "physics", "reproduction"])
def test_findings_written_by_hand_are_numbers_of_their_page(name):
    """Each number of the list that opens the page stands in what a command wrote into it, too."""
    _, opening, rest = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8").split("\n\n", 2)
    measured = set(re.findall(NUMBER, "".join(re.findall(r"<!-- written: .*?<!-- end -->", rest, re.S))))
    stated = {number for number in re.findall(rf"(?<![\w.]){NUMBER}", opening) if len(number) > 2}
    assert stated
    assert stated <= measured, stated - measured


def test_the_readme_says_of_real_robots_what_their_page_says():
    written = [
        re.search(rf"<!-- written: {block} -->(.*?)<!-- end -->", (ROOT / page).read_text(encoding="utf-8"), re.S)[1]
        for page, block in (("README.md", "reality"), ("docs/reality.md", "findings"))
    ]
    ours, theirs = (set(re.findall(NUMBER, text)) for text in written)
    assert len(ours) > 3
    assert ours <= theirs, ours - theirs


def anchors(page):
    """The anchors of a page's headings, as the site makes them."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text(encoding="utf-8")), re.M)
    plain = (re.sub(r"[^\w\s-]", "", re.sub(r"\]\([^)]*\)", "", heading)) for heading in headings)
    return {re.sub(r"[-\s]+", "-", heading.strip().lower()) for heading in plain}


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120


def test_links_between_pages_lead_somewhere():
    for page in PAGES:
        text = FENCE.sub("", page.read_text(encoding="utf-8"))
        for target, anchor in re.findall(r"\]\((?!https?:|mailto:)([^)#\s]*)(?:#([^)\s]+))?\)", text):
            there = page.parent / target if target else page
            assert there.exists(), f"{page.name} links to {target}"
            assert not anchor or anchor in anchors(there), f"{page.name} links to {target}#{anchor}"


def test_every_how_to_is_at_most_two_clicks_from_the_home_page():
    """By the links in the text of the pages, without the site's menu."""
    near = [ROOT / "docs" / "index.md"]
    for _ in range(2):
        texts = [(page.parent, FENCE.sub("", page.read_text(encoding="utf-8"))) for page in near]
        near += {(folder / at).resolve() for folder, text in texts for at in re.findall(r"\]\(([\w./-]+\.md)", text)}
    assert not {*(ROOT / "docs" / "howto").glob("*.md")} - set(near)


def test_the_comparison_of_outputs_notices_differences():
    assert_output("mass 0.256 kg\n in 12.1 ms", "mass 0.25 kg in ... ms")
    assert_output("mass 0.256 kg in 12.1 ms", "mass 0.2... kg in 1... ms")
    for output in ("mass 0.3 kg in 1 ms", "mass kg in 1 ms", "mass 0.256 g in 1 ms"):
        with pytest.raises(AssertionError):
            assert_output(output, "mass 0.256 kg in ... ms")


def test_the_files_to_read_first_are_an_evening_of_reading():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").partition("## Layers")[0]
    files = re.findall(r"^\| `([\w/]+\.py)`", text, flags=re.MULTILINE)
    assert len(files) == 8
    assert sum(len((ROOT / "src" / "salver" / file).read_text(encoding="utf-8").splitlines()) for file in files) < 2500


@pytest.mark.slow
def test_the_table_of_equations_names_things_that_exist():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    names = re.findall(r"`(salver\.[\w.]+)`", text)
    assert len(names) > 20
    names += [
        f"salver.{name}"
        for name in re.findall(r"`((?:dynamics|live|models|planning|scenario|sensitivity)\.[\w.]+)`", text)
    ]
    for name in names:
        parts = name.split(".")
        for split in range(len(parts), 0, -1):
            try:
                found = importlib.import_module(".".join(parts[:split]))
            except ModuleNotFoundError:
                continue
            for attribute in parts[split:]:
                found = getattr(found, attribute)
            break
    for file, test in re.findall(r"`(test_\w+\.py)(?:::(\w+))?`", text):
        (path,) = (ROOT / "tests").rglob(file)
        content = path.read_text(encoding="utf-8")
        assert not test or f"def {test}(" in content, f"{file}::{test}"
