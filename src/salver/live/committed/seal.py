"""Seals of verdicts: those of this process, and of the processes that it started, are accepted.

The verdict seals a motion that passed, with a keyed digest of all data of it and of the motion that it continues. The
process that commits it has the same key, which it drew itself and gave only to the planner that it started. So a motion
that was altered after the verdict, belongs to another arm or load, or comes from another source has no valid seal, and
is verified in full before it is committed. A digest takes less than a tenth of a verdict.
"""

from __future__ import annotations

import hmac
import secrets
from dataclasses import fields, is_dataclass
from hashlib import blake2b
from typing import Any

import numpy as np

from salver.live.committed.motion import Committed
from salver.planning.trajopt.problem import TransportProblem

_key = secrets.token_bytes(32)


def key() -> bytes:
    """The key of this process, for a planner that it starts."""
    return _key


def use(given: bytes) -> None:
    """Seal with the key of the process that commands."""
    global _key
    _key = given


def seal_of(found: Committed, before: Committed | None, problem: TransportProblem) -> bytes:
    """The seal of a motion that passed for a problem, as a continuation of the one before."""
    digest = blake2b(key=_key, digest_size=32)
    _feed(digest, [problem.scenario.digest, problem.uncertain])
    _feed(digest, [getattr(found, field.name) for field in fields(found) if field.name != "seal"])
    _feed(digest, None if before is None else before.seal)
    return digest.digest()


def sealed(found: Committed, before: Committed, problem: TransportProblem) -> bool:
    """Whether exactly this motion passed the verdict for a problem, as a continuation of the one before."""
    return bool(before.seal) and hmac.compare_digest(found.seal, seal_of(found, before, problem))


def _feed(digest: Any, value: Any) -> None:
    if isinstance(value, np.ndarray):
        digest.update(f"{value.shape}{value.dtype}".encode())
        digest.update(np.ascontiguousarray(value).data)
    elif isinstance(value, tuple | list):
        digest.update(f"({len(value)}".encode())
        for one in value:
            _feed(digest, one)
    elif is_dataclass(value):
        _feed(digest, [getattr(value, field.name) for field in fields(value)])
    elif isinstance(value, float | int | str | bytes | np.number) or value is None:
        digest.update(repr(value).encode())
