"""Errors of two kinds: mistakes of the user, and outcomes of a computation.

A *mistake of the user* (a wrong key, a file of another plan, a robot that is not installed) is an
exception below `SalverError`; its message is one sentence that names the key or file, the value and
what would be accepted. An *outcome of numerics* (infeasible, out of iterations) is a `Status`, carried
by the result, because it is not exceptional and callers need to read it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any


class SalverError(Exception):
    """Base of every error that salver raises on purpose; the message is one sentence for a person."""


class ScenarioError(SalverError):
    """A scenario is written wrongly or asks for something impossible."""


class FileFormatError(SalverError):
    """A file is truncated, was not written by salver, or has a version that this salver cannot read."""


class MissingDependencyError(SalverError):
    """An optional package, a renderer or a robot interface is needed but not installed."""


@contextmanager
def needs(extra: str, what: str) -> Iterator[None]:
    """Around imports of the packages of an extra (pyproject.toml): one that is not installed raises
    MissingDependencyError, whose sentence says that `what` needs it and how to install it."""
    try:
        yield
    except ModuleNotFoundError as error:  # other errors of an import are no missing package
        package = (error.name or str(error)).split(".")[0]
        raise MissingDependencyError(
            f"{what} needs {package}, which is not installed; install it with: pip install 'salver[{extra}]'."
        ) from None


class UnsafeError(SalverError):
    """A motion that failed verification would be exported to a format that cannot carry the warning."""


class UnreachableError(SalverError):
    """The arm cannot take the posture or follow the motion that was asked for."""


def reason(error: BaseException) -> str:
    """The message of an exception in lower case, without the system's error number and file name."""
    return str(getattr(error, "strerror", None) or "").lower() or str(error)


@dataclass(frozen=True, repr=False)
class Status:
    """The outcome of a computation.

    code: a short machine-readable word: "optimal", "infeasible", "iteration_limit", ...
    sentence: the same for a person, with figures: which constraint, when, by how much.
    ok: whether what was asked for was achieved.
    details: the figures of the sentence, for machines.
    """

    code: str
    sentence: str
    ok: bool
    details: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Status {self.code}, ok {'yes' if self.ok else 'no'}: {self.sentence}>"

    def __str__(self) -> str:
        return self.sentence
