"""The command `salver`. Each command is a function in a module of its own; this file only gathers them.

Modules of commands import what is heavy (CasADi, MuJoCo, Pinocchio, plotting) inside their functions, so that
`salver --help` answers at once.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import Annotated

import typer

from salver import __version__
from salver.cli.common import handled

app = typer.Typer(
    name="salver",
    help="Carry loose objects on a tray: plan robustly, simulate, check, report.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)

# In the order of use; each is the function of that name in the module of that name.
COMMANDS = (
    "demo",
    "scenarios",
    "new",
    "plan",
    "simulate",
    "campaign",
    "audit",
    "tradeoff",
    "retime",
    "report",
    "figures",
    "render",
    "export",
    "live",
    "execute",
    "calibrate",
    "excite",
    "identify",
    "learn",
    "track",
    "tune",
)

for _name in COMMANDS:
    app.command(_name)(handled(getattr(import_module(f"salver.cli.{_name}"), _name)))


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"salver {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Entry point of the console script.

    The matrices here are small: threads of the linear algebra cost more than they give, and a campaign already has a
    process for each core. NumPy reads this when it is first imported, which no command has done yet.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    app()
