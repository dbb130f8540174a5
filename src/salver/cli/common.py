"""Shared by all commands: exit codes, errors as one sentence, output of results."""

from __future__ import annotations

import functools
import itertools
import os
import re
import shlex
import sys
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import nullcontext
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from salver.cli.progress import hide, working
from salver.errors import SalverError, ScenarioError, UnreachableError, UnsafeError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from salver.planning.plan import Plan
    from salver.planning.round import MultiLegPlan
    from salver.scenario import Scenario


class ExitCode(IntEnum):
    """How a command ends. NO_SAFE_PLAN also stands for what an audit cannot tell."""

    ACHIEVED = 0
    NOT_ACHIEVED = 1
    WRONG_USE = 2
    NO_SAFE_PLAN = 3
    DEFECT = 70  # EX_SOFTWARE of sysexits.h
    INTERRUPTED = 130  # 128 + SIGINT


Json = Annotated[bool, typer.Option("--json", help="Print the result as one JSON document on standard output.")]
ScenarioName = Annotated[
    str, typer.Argument(help="Name of a ready-made scenario (see `salver scenarios`) or a .toml file.")
]
Stops = Annotated[
    bool,
    typer.Option(
        "--stops",
        help="Plan load-safe stops too: motions to rest from all along the plan; takes several times as long as the "
        "plan, minutes with a liquid.",
    ),
]

Unsafe = Annotated[
    bool,
    typer.Option(
        "--unsafe",
        help="Write also a motion that fails its verdict; its file says UNSAFE first, and in its name.",
    ),
]

Command = TypeVar("Command", bound=Callable[..., Any])


def handled(command: Command) -> Command:
    """Decorate a command: an exception becomes one sentence on standard error and an exit code.

    An exception that is not a mistake of the user and not a problem of the machine (disk, memory) is a defect of
    salver; its traceback is written to a file.
    """

    # Commands that ask questions, and the loop at 1 kHz, have no progress bar.
    alone = command.__name__ in ("new", "execute", "live")

    @functools.wraps(command)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        try:
            with nullcontext() if alone else working(command.__name__):
                result = command(*args, **kwargs)
            sys.stdout.flush()
            return result
        except SalverError as error:
            say(f"salver: {error}")
            if kwargs.get("json"):
                print_json({"error": str(error)})
            raise typer.Exit(
                ExitCode.NO_SAFE_PLAN if isinstance(error, UnreachableError | UnsafeError) else ExitCode.WRONG_USE
            ) from None
        except KeyboardInterrupt:
            say("salver: interrupted; files that were written before are complete.")
            raise typer.Exit(ExitCode.INTERRUPTED) from None
        except BrokenPipeError:  # the reader of the output, such as `head`, has closed it
            sys.stderr.close()
            raise typer.Exit(ExitCode.ACHIEVED) from None
        except (typer.Exit, typer.Abort, typer.BadParameter):
            raise
        except OSError as error:
            raise typer.Exit(lost(error)) from None
        except MemoryError:
            say("salver: out of memory; files that were written before are complete.")
            raise typer.Exit(ExitCode.WRONG_USE) from None
        except Exception as error:
            cause = error.__cause__ or error.__context__
            if isinstance(cause, KeyboardInterrupt):  # while a library was being imported, which says it in its own way
                say("salver: interrupted; files that were written before are complete.")
                raise typer.Exit(ExitCode.INTERRUPTED) from None
            lacking = _LIBRARY.match(str(error)) if isinstance(error, ImportError) else None
            if lacking is not None:
                package = lacking[1].replace(".so.", "").lower()
                say(f"salver: this machine lacks {lacking[1]}; on Debian and Ubuntu: apt-get install {package}.")
                raise typer.Exit(ExitCode.WRONG_USE) from None
            say(f"salver: {_defect(error)}")
            raise typer.Exit(ExitCode.DEFECT) from None

    return wrapper  # type: ignore[return-value]


def lost(error: OSError) -> int:
    """Report an error of the operating system, such as a full disk; returns the exit code.

    If standard output is broken, the rest of it goes to /dev/null, because Python would try to write it at exit.
    """
    say(f"salver: {error.filename or 'the output'}: {(error.strerror or str(error)).lower()}.")
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return ExitCode.WRONG_USE


# The loader's message about a missing system library that a package needs.
_LIBRARY = re.compile(r"(lib\S+\.so\.\d+): cannot open shared object file")


def _defect(error: Exception) -> str:
    """A sentence about an unexpected exception; traceback, command and versions go to a file for the maintainers."""
    import tempfile
    import traceback

    from salver.files import versions

    where = traceback.extract_tb(error.__traceback__)[-1]
    report = [
        f"command: {shlex.join(sys.argv)}",
        f"in: {os.getcwd()}",
        f"versions: {', '.join(f'{name} {version}' for name, version in versions().items())}",
        "".join(traceback.format_exception(error)),
    ]
    text = f"this is a defect of salver ({type(error).__name__} at {Path(where.filename).name}:{where.lineno})"
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="salver-crash-", suffix=".txt", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write("\n".join(report))
    except OSError:
        return f"{text}; it could not be written down."
    return f"{text}; please send {file.name} to the maintainers, with the files that the command was given."


# Control characters, and those that change the direction of writing; in a name, they would control the terminal.
_COMMANDS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def printable(text: str) -> str:
    """The text with characters that control a terminal escaped, as \\x1b."""
    return _COMMANDS.sub(lambda found: ascii(found[0])[1:-1], text)


def say(text: str) -> None:
    """Print a line on standard error, without wrapping and colours, so that it can be searched."""
    hide()
    sys.stderr.write(printable(text).rstrip("\n") + "\n")
    sys.stderr.flush()


def headed(name: str, text: object) -> Text:
    """The text "name: text" for a console, with the name in bold."""
    from rich.text import Text

    return Text.assemble((printable(name), "bold"), f": {printable(str(text))}")


def save_plans(directory: Path, plans: Mapping[str, Plan | MultiLegPlan], force: bool = False) -> None:
    """Write plans, by name, into a run directory, and say where earlier plans were moved.

    Plans of an earlier version of the scenario are replaced, with force also those of another scenario. Otherwise a
    directory of another scenario is not changed: the plans are written beside it, so that they are not lost, and the
    command ends as wrong use, because the directory does not hold what the next command needs.
    """
    from salver.planning.plan_files import make_way
    from salver.run_directory import EARLIER

    before = set(directory.glob(f"{EARLIER}/*"))
    try:
        make_way(next(iter(plans.values())).scenario, directory, force=force)
        for stem, plan in plans.items():
            plan.save(directory, stem)
    except ScenarioError as error:
        beside = next(p for k in itertools.count(1) if not (p := directory.with_name(f"{directory.name}-{k}")).exists())
        for stem, plan in plans.items():
            plan.save(beside, stem)
        say(f"salver: {error}")
        say(f"salver: the new plans are in {beside}.")
        raise typer.Exit(ExitCode.WRONG_USE) from None
    for path in sorted(set(directory.glob(f"{EARLIER}/*")) - before):
        say(f"salver: the earlier plan in {directory} and its results are now in {path}.")


def numbers(text: str) -> list[float]:
    """The numbers in a text, separated by commas or blanks; an empty list if a word is not a number."""
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return []


def named_numbers(texts: Sequence[str], option: str, example: str) -> dict[str, float]:
    """Numbers by name from texts such as "mass=0.3". Raises ScenarioError, which names the option."""
    values = {}
    for text in texts:
        name, _, number = text.partition("=")
        given = numbers(number)
        if len(given) != 1:
            raise ScenarioError(f'{option} "{text}" must be a name, an equals sign and a number, as in {example}.')
        values[name.strip()] = given[0]
    return values


def of_a_run(path: Path) -> None:
    """Raise ScenarioError for a motion file without a scenario; only run directories have one."""
    from salver.run_directory import SCENARIO

    if path.is_file() and not (path.parent / SCENARIO).is_file():
        raise ScenarioError(f"{path} is a file; for a motion file, name the scenario too: --scenario.")


def result_console() -> Console:
    """Console on standard output, for results without --json."""
    return _console(soft_wrap=not sys.stdout.isatty())


def print_table(titles: Sequence[str], rows: Iterable[Sequence[str]], left: Collection[str] = ("",)) -> None:
    """Print a table on standard output. left: titles of left-aligned columns; others are right-aligned."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 3, 0, 0))
    cells = [titles, *rows]
    for title, *column in zip(*cells, strict=True):
        longest = max((len(word) for text in (title, *column) for word in text.split()), default=0)
        table.add_column(title, justify="left" if title in left else "right", min_width=longest)  # no word is cut
    for row in cells[1:]:
        table.add_row(*row)
    result_console().print(table)


def check_no_plan(out: Path) -> None:
    """Raise ScenarioError when a run directory holds a plan already."""
    if (out / "plan.npz").exists():
        raise ScenarioError(f"--out = {out} holds a plan already; give another directory.")


def check_new_toml(out: Path | None) -> None:
    """Raise ScenarioError unless `out` is the name of a new .toml file."""
    if out is not None and (out.suffix != ".toml" or out.exists()):
        raise ScenarioError(f"--out = {out} must be a .toml file that does not exist yet.")


def save_scenario(scenario: Scenario, out: Path) -> None:
    import tomli_w

    from salver.files import write_atomic

    write_atomic(out, tomli_w.dumps(scenario.model_dump(mode="json", exclude_none=True)))


def save_test_motion(plan: Plan, out: Path, then: str, json: bool) -> None:
    """Write a test motion into a run directory. then: the next commands, for the user."""
    plan.save(out)
    if json:
        print_json({"duration": plan.duration, "sentence": plan.status.sentence, "directory": str(out)})
        return
    result_console().print(plan.status.sentence)
    say(f"Written to {out}; next: {then}.")


def _console(**options: Any) -> Console:
    """A console that prints strings literally, also in tables: no markup, no emoji, no terminal control."""
    from rich.console import Console

    class PlainConsole(Console):
        def print(self, *things: Any, **how: Any) -> None:
            hide()
            super().print(*things, **how)

        def render_str(self, text: str, **more: Any) -> Text:
            return super().render_str(printable(text), **{**more, "markup": False, "emoji": False})

    return PlainConsole(highlight=False, **options)


def print_json(obj: Any) -> None:
    """Print a result as one JSON document on standard output (`salver.files.to_json`)."""
    from salver.files import to_json

    hide()
    # Control characters can only be inside strings, where JSON can escape them.
    sys.stdout.write(re.sub("[\x7f-\x9f]", lambda found: f"\\u{ord(found[0]):04x}", to_json(obj)))
    sys.stdout.flush()
