"""Where the CPU seconds of `figaroh-jax diagnose` go: each phase without those inside it, and where the memory peaks.

    python benchmarks/phases.py TASK.yaml [--out DIR]

The command runs in this process, some of its functions wrapped by a clock (which costs a few per cent). The first run
after a change of the package compiles; the second one is warm.
"""

from __future__ import annotations

import argparse
import functools
import resource
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from importlib import import_module
from typing import Any

PHASES = {  # functions of the package, by what they are told as
    "reading": ["recordings.dataset.read_recordings", "recordings.checks.check_recordings"],
    "signals, whether slowed": ["diagnosis.setting.prepared_signals"],
    "noise": ["diagnosis.floor.noise_floor"],
    "weights and width of friction": [
        "diagnosis.flexible.friction_width",
        "diagnosis.weights.weighted_by_speed",
        "diagnosis.weights.white_where_better",
    ],
    "search: columns of candidates": ["diagnosis.screening.catalogue"],
    "search: scores": ["diagnosis.screening.screen"],
    "search: chance of the scores": ["diagnosis.search._chance"],
    "search: shapes": ["diagnosis.contenders._exact_columns"],
    "search: position sensors": ["diagnosis.contenders._position_contender"],
    "search: torque sensors": ["diagnosis.contenders._response_contender"],
    "search: judged on folds": ["diagnosis.comparison.judge_grown", "diagnosis.comparison.judge"],
    "search: the rest": ["diagnosis.search.find_causes"],
    "fits of all causes": ["diagnosis.joint.polished"],
    "each cause left out": ["diagnosis.search.eliminate", "diagnosis.naming.standings"],
    "what is left": ["diagnosis.causes._left", "diagnosis.rest.parts_of"],
    "data kept out": ["diagnosis.gaining.without_losses", "diagnosis.answer_fit.as_predicts_best"],
    "next experiment": ["diagnosis.experiment.next_experiment"],
    "the rest of the diagnosis": ["diagnosis.diagnosis.diagnose"],
}
START = "start: Python, imports, JAX; report"


class Clock:
    """CPU seconds and the growth of the peak memory, of the innermost phase at a time."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.calls: Counter[str] = Counter()
        self.grown: Counter[str] = Counter()  # MB
        self._stack, self._last, self._peak = [START], 0.0, 0.0

    def mark(self) -> None:
        """Give what has gone since the last mark to the phase that stands."""
        now, peak = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        self.seconds[self._stack[-1]] += now - self._last
        self.grown[self._stack[-1]] += int(peak - self._peak)
        self._last, self._peak = now, peak

    def wrapped(self, function: Callable[..., Any], phase: str) -> Callable[..., Any]:
        """The function, its seconds counted."""

        @functools.wraps(function)
        def timed(*args: Any, **options: Any) -> Any:
            self.mark()
            self._stack.append(phase)
            self.calls[phase] += 1
            try:
                return function(*args, **options)
            finally:
                self.mark()
                self._stack.pop()

        return timed


def main() -> None:
    """Run the command and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("--out", default=tempfile.mkdtemp())
    options = parser.parse_args()
    clock = Clock()
    wrap(clock)
    command = import_module("figaroh_jax.cli").main
    command(["diagnose", options.task, "--quiet", "--out", options.out])
    clock.mark()
    print(f"\n{'CPU seconds':42}{'s':>8}{'calls':>8}{'peak grew, MB':>16}")
    for phase in [START, *PHASES]:
        calls = clock.calls[phase] or ""
        print(f"{phase:42}{clock.seconds[phase]:8.2f}{calls:>8}{clock.grown[phase]:16d}")
    print(f"{'all':42}{sum(clock.seconds.values()):8.2f}{'':8}{sum(clock.grown.values()):16d}")


def wrap(clock: Clock) -> None:
    """Put the clock around the functions, wherever they have been imported to."""
    for name in ("jobs.commands", "jobs.diagnosis", "diagnosis.diagnosis"):
        import_module(f"figaroh_jax.{name}")
    for phase, names in PHASES.items():
        for name in names:
            where, _, function = f"figaroh_jax.{name}".rpartition(".")
            own = getattr(import_module(where), function)
            timed = clock.wrapped(own, phase)
            for module in [m for n, m in sys.modules.items() if n.startswith("figaroh_jax")]:
                if getattr(module, function, None) is own:
                    setattr(module, function, timed)


if __name__ == "__main__":
    main()
