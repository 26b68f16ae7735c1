"""Where the CPU seconds of a diagnosis go, by a sample each millisecond: of functions with all they call, of lines.

    python benchmarks/sampled.py TASK.yaml [--runs 4] [--rows 40]

The diagnosis runs in this process, once to compile and then `--runs` times; unlike a profile, samples cost the small
functions nothing. PYTHONPATH says which version of the package it is.
"""

from __future__ import annotations

import argparse
import signal
import time
from collections import Counter
from pathlib import Path
from types import FrameType

from figaroh_jax.diagnosis.diagnosis import diagnose_task
from figaroh_jax.formats.config import load_task

EVERY = 0.001  # s of CPU


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", type=Path)
    parser.add_argument("--runs", type=int, default=4)
    parser.add_argument("--rows", type=int, default=40)
    options = parser.parse_args()
    task = load_task(options.task)
    diagnose_task(task)
    inclusive, lines = Counter[str](), Counter[str]()

    def seen(_: int, frame: FrameType | None) -> None:
        names: set[str] = set()
        inner = ""
        while frame is not None:
            file = frame.f_code.co_filename
            if "figaroh_jax/" in file:
                name = f"{file.split('figaroh_jax/')[-1]}:{frame.f_code.co_name}"
                inner = inner or f"{name}:{frame.f_lineno}"
                names.add(name)
            frame = frame.f_back
        inclusive.update(names)
        lines[inner] += 1

    signal.signal(signal.SIGPROF, seen)
    start = time.process_time()
    signal.setitimer(signal.ITIMER_PROF, EVERY, EVERY)
    for _ in range(options.runs):
        diagnose_task(task)
    signal.setitimer(signal.ITIMER_PROF, 0)
    each = (time.process_time() - start) / options.runs
    share = each / max(lines.total(), 1)
    print(f"{each:.2f} CPU s a run, {lines.total()} samples")
    for title, counts in (("with what they call", inclusive), ("by innermost line of the package", lines)):
        print(f"\n{title}")
        for name, count in counts.most_common(options.rows):
            print(f"{count * share:8.3f} {name}")


if __name__ == "__main__":
    main()
