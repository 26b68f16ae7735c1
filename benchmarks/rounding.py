"""Whether what the noise's rich model scores is more than rounding: `python benchmarks/rounding.py TASK.yaml`.

The noise of a task is estimated twice, the second time with 4e-16 of noise (of a filtered array's largest number) in
every row with weight behind the row filter. Printed: the largest relative difference of the five largest scores of
every screening, and whether they belong to the same candidates. A sound answer is a difference near 1e-6, and yes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np

import figaroh_jax as fj
from figaroh_jax.diagnosis import causes, floor
from figaroh_jax.recordings import stacked

FILTERS = ("filter_rows", "filtered_rows", "open_rows")
BEST = 5


class _Estimated(Exception):
    """The noise has been estimated: what comes after it is not asked."""


def scored(task: str, rounding: float) -> list[list[tuple[str, float]]]:
    """The best candidates and their scores, of each screening of the rich model."""
    out: list[list[tuple[str, float]]] = []
    plain = floor.screen

    def screened(*args: Any) -> Any:
        found = plain(*args)
        best = sorted(((float(s.z.max()), str(g.name)) for g, s in zip(found.groups, found.scores, strict=True)))
        out.append([(name, z) for z, name in best[: -BEST - 1 : -1]])
        return found

    def ended(*args: Any, **kwargs: Any) -> Any:
        raise _Estimated

    generator = np.random.default_rng(1)

    def noisy(filtered: Callable[..., Any]) -> Callable[..., Any]:
        def rounded(*args: Any, **kwargs: Any) -> np.ndarray:
            rows = np.asarray(filtered(*args, **kwargs))
            return rows + rounding * np.abs(rows).max() * generator.standard_normal(rows.shape) * (rows != 0)

        return rounded

    modules = [m for name, m in sys.modules.items() if name.startswith("figaroh_jax")]
    held = [(m, name, getattr(stacked, name)) for m in modules for name in FILTERS]
    held = [(m, name, old) for m, name, old in held if getattr(m, name, None) is old]
    search = causes.find_causes
    try:
        floor.screen, causes.find_causes = screened, ended
        for module, name, old in held:
            setattr(module, name, noisy(old) if rounding else old)
        fj.diagnose_task(fj.load_task(task))
    except _Estimated:
        pass
    finally:
        floor.screen, causes.find_causes = plain, search
        for module, name, old in held:
            setattr(module, name, old)
    return out


def main() -> None:
    for task in sys.argv[1:]:
        exact, noisy = (scored(task, size) for size in (0.0, 4e-16))
        pairs = [(a, b) for one, other in zip(exact, noisy, strict=True) for a, b in zip(one, other, strict=True)]
        off = max((abs(a[1] / b[1] - 1) for a, b in pairs), default=0.0)
        same = all(a[0] == b[0] for a, b in pairs)
        print(f"{task}: {len(exact)} screenings, scores within {off:.2g}, the same candidates: {same}")


if __name__ == "__main__":
    main()
