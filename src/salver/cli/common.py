"""What all commands share: exit codes, errors as one sentence, results for people and for machines."""

from __future__ import annotations

import functools
import itertools
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from salver.errors import SalverError, ScenarioError, UnreachableError

if TYPE_CHECKING:
    from rich.console import Console

    from salver.planning.plan import Plan

ACHIEVED = 0
NOT_ACHIEVED = 1
WRONG_USE = 2
NO_SAFE_PLAN = 3
INTERRUPTED = 130  # 128 + SIGINT, as a shell reports it

Json = Annotated[bool, typer.Option("--json", help="Print the result as one JSON document on standard output.")]

Command = TypeVar("Command", bound=Callable[..., Any])


def handled(command: Command) -> Command:
    """The command, with user mistakes as one sentence on standard error and the exit code that fits.

    Anything else that goes wrong is a defect of salver and keeps its traceback.
    """

    @functools.wraps(command)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        try:
            return command(*args, **kwargs)
        except UnreachableError as error:
            say(f"salver: {error}")
            raise typer.Exit(NO_SAFE_PLAN) from None
        except SalverError as error:
            say(f"salver: {error}")
            raise typer.Exit(WRONG_USE) from None
        except KeyboardInterrupt:
            say("salver: interrupted; what was written to disk before is complete and was kept.")
            raise typer.Exit(INTERRUPTED) from None
        except BrokenPipeError:  # the reader of our output, `head` for one, has seen enough
            sys.stderr.close()
            raise typer.Exit(ACHIEVED) from None

    return wrapper  # type: ignore[return-value]


def say(text: str) -> None:
    """A line for a person, on standard error, never wrapped or coloured: safe to grep."""
    sys.stderr.write(text.rstrip("\n") + "\n")
    sys.stderr.flush()


def save_plans(directory: Path, plans: Mapping[str, Plan]) -> None:
    """Write plans by stem into a run directory, and say what became of another plan that stood there.

    A directory of another scenario is left alone: the plans go beside it, so that they are not lost, and the command
    ends as wrong use, because nothing stands where the next command would look for it.
    """
    from salver.run_directory import EARLIER

    before = set(directory.glob(f"{EARLIER}/*"))
    try:
        for stem, plan in plans.items():
            plan.save(directory, stem)
    except ScenarioError as error:
        beside = next(p for k in itertools.count(1) if not (p := directory.with_name(f"{directory.name}-{k}")).exists())
        for stem, plan in plans.items():
            plan.save(beside, stem)
        say(f"salver: {error}")
        say(f"salver: what was planned is kept in {beside}.")
        raise typer.Exit(WRONG_USE) from None
    for path in sorted(set(directory.glob(f"{EARLIER}/*")) - before):
        say(f"salver: {directory} held another plan; it is kept with its results in {path}.")


def console() -> Console:
    """Console on standard error, for progress and logs."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def result_console() -> Console:
    """Console on standard output, for the result a person asked for (without --json)."""
    from rich.console import Console

    return Console(highlight=False, soft_wrap=not sys.stdout.isatty())


def print_json(obj: Any) -> None:
    """The result for a machine: one JSON document on standard output (`salver.files.to_json`)."""
    from salver.files import to_json

    sys.stdout.write(to_json(obj))
    sys.stdout.flush()
