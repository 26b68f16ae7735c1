"""CPU seconds of the start of every command, of several installations in turn, so that a busy machine hits all alike.

`python benchmarks/cold_start.py RUN_DIR PYTHON...`: RUN_DIR is a finished run of the demo, each PYTHON the interpreter
of an environment with the package. Prints the median of user and system time of `--count` processes each.
"""

from __future__ import annotations

import argparse
import os
import resource
import statistics
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DEMO = ROOT / "figaroh_jax" / "demo"


def commands(run: Path) -> dict[str, list[str]]:
    return {
        "--version": ["--version"],
        "--help": ["--help"],
        "new": ["new", str(DEMO / "robot.urdf"), str(DEMO / "first_1.npz"), "--rate", "250"],
        "verify": ["verify", str(run)],
        "compare": ["compare", str(run), str(run)],
        "list": ["list", str(run.parent)],
        "diagnose of a task that is not there": ["diagnose", "none.yaml"],
    }


def cpu(python: str, words: list[str]) -> float:
    """User and system seconds of one process."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([python, "-m", "figaroh_jax", *words], capture_output=True, env=environment, cwd="/")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("pythons", nargs="+")
    parser.add_argument("--count", type=int, default=5)
    asked = parser.parse_args()
    for name, words in commands(asked.run.resolve()).items():
        times = [[cpu(python, words) for python in asked.pythons] for _ in range(asked.count + 1)][1:]
        print(f"{name}: {', '.join(f'{statistics.median(column):.2f}' for column in zip(*times, strict=True))} CPU s")


if __name__ == "__main__":
    main()
