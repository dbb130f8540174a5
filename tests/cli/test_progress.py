"""The progress of long commands: late, hidden while something is printed, silent where nobody looks."""

from __future__ import annotations

import io
import sys
import time

import pytest

from salver.cli import common, progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def on(monkeypatch):
    """A function that makes something standard error. (Within a test: pytest sets its own after the fixtures.)"""

    def stderr(seen: io.StringIO, after: float = 0.05) -> io.StringIO:
        monkeypatch.setattr(sys, "stderr", seen)
        monkeypatch.setattr(progress.Progress, "after", after)
        monkeypatch.setenv("TERM", "xterm")
        return seen

    return stderr


def wait_for(condition) -> bool:
    until = time.monotonic() + 60
    while not condition() and time.monotonic() < until:
        time.sleep(0.01)
    return condition()


def test_a_quick_command_shows_no_progress(on):
    terminal = on(Terminal(), after=60.0)
    with progress.working("plan"):
        progress.step(1, 2)
    assert terminal.getvalue() == ""


def test_a_long_one_shows_what_it_was_told_and_nothing_remains(on):
    terminal = on(Terminal())
    with progress.working("campaign"):
        progress.step(3, 12, "plan holds 3")
        assert wait_for(lambda: "salver campaign: 0 s, 25 %: plan holds 3" in terminal.getvalue())
    assert terminal.getvalue().endswith(progress.ERASE)  # the line is taken away
    assert "\n" not in terminal.getvalue()
    assert progress._now is None


def test_a_line_is_no_longer_than_the_terminal_is_wide(on, monkeypatch):
    terminal = on(Terminal())
    monkeypatch.setenv("COLUMNS", "20")
    with progress.working("campaign"):
        progress.step(3, 12, "x" * 100)
        assert wait_for(lambda: "campaign" in terminal.getvalue())
    assert max(map(len, terminal.getvalue().split(progress.ERASE))) == 19


def test_what_is_printed_stands_alone_and_the_bar_comes_back(on):
    terminal = on(Terminal())
    with progress.working("demo"):
        assert wait_for(lambda: "demo" in terminal.getvalue())
        common.say("salver: a sentence")
        before, _ = terminal.getvalue().split("salver: a sentence\n")
        assert before.endswith("\x1b[2K")
        assert wait_for(lambda: "demo" in terminal.getvalue().split("salver: a sentence\n")[1])


def test_where_nobody_looks_nothing_is_drawn(on):
    seen = on(io.StringIO(), after=0.01)
    with progress.working("plan"):
        time.sleep(0.2)
    assert seen.getvalue() == ""


def test_without_a_terminal_a_line_says_what_is_tried_every_few_seconds(on, monkeypatch):
    monkeypatch.setattr(progress.Progress, "every", 0.02)
    seen = on(io.StringIO())
    with progress.working("plan"):
        time.sleep(0.1)
        assert seen.getvalue() == ""  # nothing was said yet
        progress.step(30, 60, "straight path of the joints; 0.812 s so far")
        assert wait_for(lambda: seen.getvalue().count("\n") > 1)
    lines = seen.getvalue().splitlines()
    assert set(lines) == {"salver plan: 0 s, 50 %: straight path of the joints; 0.812 s so far"}
    time.sleep(0.1)
    assert seen.getvalue().splitlines() == lines
