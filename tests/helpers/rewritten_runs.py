"""Run directories rewritten by hand, with a certificate that fits: what a salver with a defect might have written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from salver import scenario
from salver.files import load_npz, npz_bytes, read_json, write_atomic
from salver.planning import certificate
from salver.run_directory import CERTIFICATE


def rewrite(
    directory: Path,
    stem: str = "plan",
    arrays: Callable[[dict[str, np.ndarray]], Any] = lambda arrays: None,
    record: Callable[[dict[str, Any]], Any] = lambda record: None,
    certified: bool = True,
) -> None:
    """Change arrays and record in place; certified: give them a new certificate, else leave the old one."""
    held, told = load_npz(directory / f"{stem}.npz"), read_json(directory / f"{stem}.json")
    arrays(held)
    record(told)
    write_atomic(directory / f"{stem}.npz", npz_bytes(held))
    if certified:
        told[CERTIFICATE] = certificate.certificate(scenario.load(directory / "scenario.toml"), held, told)
    (directory / f"{stem}.json").write_text(json.dumps(told))
