"""The command line as a user meets it: whole processes, exit codes, both output streams."""

import gc
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from salver import __version__, scenario
from salver.cli import COMMANDS, main
from salver.cli.common import print_table
from salver.planning.plan import load_plan

SALVER = Path(sys.executable).with_name("salver")


def salver(*arguments, **options):
    environment = {**os.environ, "COLUMNS": "120", "NO_COLOR": "1"}
    return subprocess.run([SALVER, *map(str, arguments)], capture_output=True, text=True, env=environment, **options)


@pytest.fixture
def here(monkeypatch, capsys):
    """The same without a process of its own: (exit code, standard output, standard error)."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["salver", *arguments])
        monkeypatch.setenv("COLUMNS", "120")
        monkeypatch.setenv("NO_COLOR", "1")
        looked_for = gc.get_threshold()
        try:
            with pytest.raises(SystemExit) as ended:
                main()
        finally:
            gc.set_threshold(*looked_for)
        return ended.value.code, *capsys.readouterr()

    return run


def test_version():
    done = salver("--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"salver {__version__}\n", "")


def test_help_names_every_command():
    done = salver("--help")
    assert done.returncode == 0
    for name in COMMANDS:
        assert f" {name} " in done.stdout


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_every_command_has_an_example(name, here):
    """As a process would give it that was asked for this command alone."""
    code, said, _ = here(name, "--help")
    assert code == 0
    assert f"salver {name}" in said.split("Example", 1)[1]
    assert "--json" in said


def test_no_command_shows_the_help(here):
    code, said, wrong = here()
    assert code == 2
    assert "Usage:" in said + wrong


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["fly"], ["plan"]])
def test_wrong_use_exits_with_two(arguments):
    done = salver(*arguments)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("arguments", [["--fly"], ["scenarios", "--fly"]])
def test_an_option_that_there_is_not_exits_with_two(arguments, here):
    code, said, wrong = here(*arguments)
    assert (code, said) == (2, "")
    assert "No such option: --fly" in wrong


@pytest.mark.slow
def test_unknown_scenario_is_one_sentence():
    done = salver("plan", "panda-cup")
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith('salver: There is no ready-made scenario "panda-cup"')
    assert "panda-cube" in line


@pytest.mark.slow
def test_scenarios_for_people():
    done = salver("scenarios")
    assert done.returncode == 0
    assert done.stderr == ""
    for name in scenario.names():
        assert name in done.stdout
    assert "2.5 s" in done.stdout


def test_a_mistake_is_json_too_where_json_was_asked_for(here):
    code, said, wrong = here("plan", "nosuch", "--json")
    assert code == 2
    assert json.loads(said)["error"].startswith('There is no ready-made scenario "nosuch"')
    assert "nosuch" in wrong
    assert here("plan", "nosuch")[:2] == (2, "")


@pytest.mark.slow
def test_scenarios_for_machines(here):
    code, said, wrong = here("scenarios", "--json")
    assert (code, wrong) == (0, "")
    records = {record["name"]: record for record in json.loads(said)}
    assert sorted(records) == scenario.names()
    cube = records["panda-cube"]
    assert cube["duration"] == 2.5
    assert cube["objects"] == [{"name": "cube", "shape": "box", "mass": 0.256, "friction": 0.5}]
    assert cube["uncertain"] == {"mass": {"nominal": 0.256, "half_range": pytest.approx(0.0256)}}
    assert cube["digest"] == scenario.load("panda-cube").digest
    assert cube["source"]


@pytest.mark.slow
def test_output_cut_short_by_its_reader_is_no_error():
    done = subprocess.run(
        f"{SALVER} scenarios --json | head -c 1", shell=True, capture_output=True, text=True, executable="/bin/bash"
    )
    assert done.stdout == "["
    assert done.stderr == ""


def _exit_of(function, capfd):
    """Exit code and standard error of a command that runs `function`."""
    import typer
    from typer.testing import CliRunner

    from salver.cli.common import handled

    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(handled(function))
    done = CliRunner().invoke(app)
    return done, done.stderr


def test_errors_map_to_exit_codes(capfd):
    from salver.errors import FileFormatError, UnreachableError

    def foreign():
        raise FileFormatError("plan.npz is truncated.")

    def far():
        raise UnreachableError("The goal is 0.3 m out of reach.")

    def interrupted():
        raise KeyboardInterrupt

    done, text = _exit_of(foreign, capfd)
    assert (done.exit_code, text) == (2, "salver: plan.npz is truncated.\n")
    done, text = _exit_of(far, capfd)
    assert (done.exit_code, text) == (3, "salver: The goal is 0.3 m out of reach.\n")
    done, text = _exit_of(interrupted, capfd)
    assert done.exit_code == 130
    assert text == "salver: interrupted; files that were written before are complete.\n"


def test_a_defect_is_one_sentence_and_a_file_with_its_traceback(capfd, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))

    def broken():
        raise ZeroDivisionError("a \x1b[31mdefect")

    done, text = _exit_of(broken, capfd)
    (crash,) = tmp_path.glob("salver-crash-*.txt")
    assert done.exit_code == 70
    assert text.startswith("salver: this is a defect of salver (ZeroDivisionError at test_cli.py:")
    assert str(crash) in text
    assert text.count("\n") == 1
    told = crash.read_text()
    assert "Traceback" in told
    assert "in broken" in told
    assert f"salver {__version__}" in told


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            OSError(28, "No space left on device", "/there/plan.npz"),
            "salver: /there/plan.npz: no space left on device.",
        ),
        (PermissionError(13, "Permission denied", "/there"), "salver: /there: permission denied."),
        (MemoryError(), "salver: out of memory"),
        (  # as the loader says it in a bare container, where `import pinocchio` fails
            ImportError("libgomp.so.1: cannot open shared object file: No such file or directory"),
            "salver: this machine lacks libgomp.so.1; on Debian and Ubuntu: apt-get install libgomp1.",
        ),
    ],
)
def test_what_the_machine_refuses_is_no_defect(error, words, capfd):
    def refused():
        raise error

    done, text = _exit_of(refused, capfd)
    assert done.exit_code == 2
    assert text.startswith(words)


@pytest.mark.slow
def test_a_full_disk_behind_the_output_is_one_sentence():
    for arguments in (["scenarios", "--json"], ["--version"]):  # more than the buffer holds, or less and no command
        with open("/dev/full", "w") as full:
            buffered = {**os.environ, "COLUMNS": "80", "PYTHONUNBUFFERED": ""}
            done = subprocess.run([SALVER, *arguments], stdout=full, stderr=subprocess.PIPE, text=True, env=buffered)
        assert done.returncode == 2
        assert done.stderr == "salver: the output: no space left on device.\n"


@pytest.mark.slow
def test_interrupting_a_running_command(tmp_path):
    """A real SIGINT at a running process, once it has said what it is doing."""
    process = subprocess.Popen(
        [SALVER, "demo", "-o", tmp_path / "demo"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Tests that are run in the background inherit an ignored SIGINT; a person at a terminal does not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    while not process.stderr.readline().strip():
        assert process.poll() is None
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert errors.splitlines()[-1].startswith("salver: interrupted")
    assert "Traceback" not in errors


def test_ctrl_c_while_a_command_is_loaded_is_no_traceback(monkeypatch, here):
    def loading(names):
        raise KeyboardInterrupt

    monkeypatch.setattr("salver.cli._gathered", loading)
    assert here("plan", "panda-cube") == (130, "", "")


def test_ctrl_c_while_stops_are_planned_keeps_the_plan(monkeypatch, here, tmp_path):
    def planning(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr("salver.planning.stops.with_stops", planning)
    code, _, said = here("plan", "panda-cube", "--stops", "-o", str(tmp_path / "cube"))
    assert (code, said) == (130, "salver: interrupted; files that were written before are complete.\n")
    kept = load_plan(tmp_path / "cube")
    assert kept.ok
    assert kept.stops is None


def test_an_interruption_that_a_library_reports_as_its_own_error_is_one():
    from salver.cli.common import handled

    def importing():
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as stop:
            raise ImportError("initialization failed") from stop

    with pytest.raises(typer.Exit) as ended:
        handled(importing)()
    assert ended.value.exit_code == 130


def test_a_name_in_a_table_is_whole(capsys):
    """In 80 columns `salver track` called each joint panda_joi…"""
    row = ("panda_joint4", "0.097 mrad", "-0.07 ms", "0.003 mrad", "257.0 urad", "28.0 %")
    print_table(
        ("joint", "off the plan", "later than all", "friction", "noise", "margin alone"), [row], left=("joint",)
    )
    assert set(row) <= {cell.strip() for cell in re.split("  +", capsys.readouterr().out.splitlines()[-1])}
