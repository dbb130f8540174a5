"""Runs the speed benchmarks and writes what they print into docs/performance.md.

    python docs/make_performance.py [NAME ...]

Names are those of the blocks in the page; by default all but toppra, which needs that package.
Run it on an idle machine.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import blocks

DOCS = Path(__file__).parent
PAGE = DOCS / "performance.md"
BENCHMARKS = DOCS.parent / "benchmarks"
COMMANDS = {
    "planner": ["bench_planner.py", "--plot", str(DOCS / "images" / "planner.png")],
    "fastest": ["fastest_solve.py"],
    "fastest-ipopt": ["fastest_ipopt.py"],
    "rollouts": ["rollouts.py"],
    "margins": ["bench_margins.py"],
    "controller": ["controller_step.py"],
    "physics": ["physics.py", "--quick"],
    "campaign": ["campaign.py"],
}
PEERS = {
    "toppra": ["peers.py", "--agreement", "--only", "cube, friction 0.4", "tall bottle"],
}
PROCESSES = (
    "salver --help",
    "salver scenarios",
    "salver plan panda-cube -o DIR",
    "salver plan panda-cube --no-arm -o DIR",
    "salver plan panda-cube --fastest -o DIR",
)


def printed(name: str) -> str:
    script, *arguments = {**COMMANDS, **PEERS}[name]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # as the commands do
    words = [sys.executable, str(BENCHMARKS / script), *arguments]
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
    return done.stdout.strip()


def processes(runs: int = 5) -> str:
    """Processor time of whole processes, after one that is not counted."""
    salver = Path(sys.executable).with_name("salver")
    lines = [
        f"{os.cpu_count()} cores; least and median of {runs} processes, after one that is not counted; processor time"
    ]
    for command in PROCESSES:
        seconds = []
        for _ in range(runs + 1):
            with tempfile.TemporaryDirectory() as folder:
                words = [str(salver), *command.replace("DIR", folder).split()[1:]]
                began = _spent()
                subprocess.run(words, capture_output=True, check=True)
                seconds.append(_spent() - began)
        counted = sorted(seconds[1:])
        lines.append(f"  {command:42s} {counted[0]:.2f} s, {counted[runs // 2]:.2f} s")
    return "\n".join(lines)


def _spent() -> float:
    """Processor time of all processes that were waited for, s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    wanted = sys.argv[1:] or ["processes", *COMMANDS]
    for name in wanted:
        text = processes() if name == "processes" else printed(name)
        blocks.replace(PAGE, name, f"```text\n{text}\n```")


if __name__ == "__main__":
    main()
