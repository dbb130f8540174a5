"""The command `salver`. Each command is a function in a module of its own; this file only gathers them.

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
from salver.cli.common import INTERRUPTED, handled

# In the order of use, each with its folder; it is the function of that name in the module of that name.
COMMANDS = {
    "demo": "plans",
    "scenarios": "plans",
    "new": "plans",
    "studio": "plans",
    "plan": "plans",
    "simulate": "checks",
    "campaign": "checks",
    "audit": "checks",
    "tradeoff": "plans",
    "retime": "plans",
    "report": "results",
    "figures": "results",
    "render": "results",
    "export": "results",
    "live": "robot",
    "execute": "robot",
    "calibrate": "learning",
    "excite": "learning",
    "identify": "learning",
    "learn": "learning",
    "track": "learning",
    "tune": "learning",
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
    """The command with some of its commands."""
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
    """`app`, with all commands: made when it is asked for, as a process needs one of them."""
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _whole()


def main() -> None:
    """Entry point of the console script.

    The matrices here are small: threads of the linear algebra cost more than they give, and a campaign already has a
    process for each core. NumPy reads this when it is first imported, which no command has done yet.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")  # it would look for some in every package that is installed
    asked = [name for name in sys.argv[1:2] if name in COMMANDS]
    try:
        (_gathered(asked) if asked else _whole())()
    except OSError as error:  # where help or the version cannot be printed; commands see to it themselves
        from salver.cli.common import lost

        sys.exit(lost(error))
    except KeyboardInterrupt:  # while the command is still being loaded; commands see to it themselves
        sys.exit(INTERRUPTED)
