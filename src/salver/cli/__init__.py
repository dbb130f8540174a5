"""The command `salver`. Each of its commands is a function in its own module; this file collects them.

Modules of commands import what is heavy (CasADi, MuJoCo, Pinocchio, plotting) inside their functions, so that
`salver --help` answers at once.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from functools import lru_cache
from importlib import import_module
from typing import Annotated

import typer

from salver import __version__
from salver.cli.common import ExitCode, handled

# Commands in the order of use, each with its folder; module and function have the command's name.
COMMANDS = {
    "demo": "plans",
    "scenarios": "plans",
    "new": "plans",
    "studio": "plans",
    "plan": "plans",
    "simulate": "checks",
    "campaign": "checks",
    "audit": "checks",
    "retime": "plans",
    "report": "results",
    "render": "results",
    "export": "results",
    "live": "robot",
    "execute": "robot",
    "calibrate": "learning",
    "excite": "learning",
    "identify": "learning",
    "track": "learning",
}


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"salver {__version__}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


def _gathered(names: Iterable[str]) -> typer.Typer:
    """The app with the commands `names`."""
    gathered = typer.Typer(
        name="salver",
        help="Carry loose objects on a tray: plan robustly, simulate, check, report.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode="markdown",
    )
    gathered.callback()(_options)
    for name in names:
        gathered.command(name)(handled(getattr(import_module(f"salver.cli.{COMMANDS[name]}.{name}"), name)))
    return gathered


@lru_cache(maxsize=1)
def _whole() -> typer.Typer:
    return _gathered(COMMANDS)


def __getattr__(name: str) -> typer.Typer:
    """`app` with all commands, made on first use, because a process usually needs only one of them."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _whole()


def main() -> None:
    """Entry point of the console script.

    Linear algebra uses one thread: the matrices are small, and a campaign already has a process for each core. NumPy
    reads this setting when it is imported, which has not happened yet.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")  # it would search all installed packages for plugins
    asked = [name for name in sys.argv[1:2] if name in COMMANDS]
    try:
        (_gathered(asked) if asked else _whole())()
    except OSError as error:  # help or version cannot be printed; commands handle this themselves
        from salver.cli.common import lost

        sys.exit(lost(error))
    except KeyboardInterrupt:  # while the command is being loaded; commands handle this themselves
        sys.exit(ExitCode.INTERRUPTED)
