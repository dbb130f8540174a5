"""Time of a campaign: 100 runs of the paper's move (2.5 s and settling, 0.5 ms steps) on all cores, as a process.

    python benchmarks/campaign.py [-n 100] [--jobs 2]

The bar is 60 s for 100 runs on two cores. Also: the audit of a 10 s joint trajectory at 1 kHz, as a process (bar: 2 s).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from salver.planning.make import make_plan
from salver.scenario import load

SALVER = [sys.executable, "-c", "from salver.cli import main; main()"]
PAPER = load("panda-cube")


def timed(*arguments: str) -> float:
    began = time.perf_counter()
    subprocess.run([*SALVER, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=True)
    return time.perf_counter() - began


def audit_times(folder: Path, repeats: int) -> list[float]:
    """A slow turn of the first joint, with encoder noise."""
    t = np.arange(10001) / 1000
    u = t / 10
    posture = np.array(PAPER.arm.start_posture)  # type: ignore[union-attr]
    q = posture + np.outer(10 * u**3 - 15 * u**4 + 6 * u**5, [0.9, 0.05, -0.05, 0.05, 0.05, 0.05, 0.05])
    q += 1e-5 * np.random.default_rng(0).standard_normal(q.shape)
    path = folder / "joints.csv"
    header = "t," + ",".join(f"panda_joint{i}" for i in range(1, 8))
    np.savetxt(path, np.column_stack([t, q]), delimiter=",", header=header, comments="", fmt="%.9f")
    return [timed("audit", str(path), "--scenario", "panda-cube") for _ in range(repeats)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=os.cpu_count())
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name) / "run"
        make_plan(PAPER, "robust").save(directory)
        wall = timed("campaign", str(directory), "-n", str(options.n), "-j", str(options.jobs), "--plan", "plan")
        print(f"{options.n} runs of 2.5 s at 0.5 ms with {options.jobs} processes: {wall:.1f} s")
        audits = audit_times(Path(name), 5)
        print(f"audit of 10 s at 1 kHz, seven joints: best {min(audits):.2f} s, median {np.median(audits):.2f} s")


if __name__ == "__main__":
    main()
