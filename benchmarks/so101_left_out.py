"""What the SO-101's joints have beside friction, asked of motions that were left out.

    FIGAROH_JAX_DATA=DIR python benchmarks/so101_left_out.py [--most 60] [--models F FR FS FSR FL] [--motions NAME ...]

Each of the set's motions is left out in turn. Gains, damping and friction of every joint are fitted to the others, and
with them, by the letters of a model, what the five arm joints may have more: R rotors, S Stribeck friction, L friction
that follows the load. Each recording weighs alike at each joint. The motion left out is then simulated from its first
measured position by its command alone. It prints the RMS by joint, mrad, the share of the squares that is gone beside
friction alone, and t over motions of the logarithm of that, each motion's squares with a tenth of their mean.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import numpy as np
from rollouts import PERIOD, SO101, TEST, TRAIN, _shorter, so101_loop, so101_runs

from figaroh_jax.rollouts.data import Run, Stretch
from figaroh_jax.rollouts.fit import Fit, fit
from figaroh_jax.rollouts.loop import Loop
from figaroh_jax.rollouts.parameters import put, values
from figaroh_jax.rollouts.setting import Setting, Structure, evened, free_entries, setting
from figaroh_jax.rollouts.task import simulated

WINDOW = 750  # rows of the windows that are simulated at once
NUMBERS = {"R": ("armature",), "S": ("stribeck_force", "stribeck_speed"), "L": ("load_ratio",)}
BEGIN = {
    "friction": (0.15, 0.4, 0.44, 0.14, 0.3, 0.1),
    "scale": (1.5, 0.7, 0.66, 0.57, 1.5, 1.0),
    "damping": (0.6,) * 6,
}
FIRST = {"stribeck_speed": 0.05, "load_ratio": 0.02}  # where such numbers start; a rotor at the file's


def fitted(runs: Sequence[Run], models: Sequence[str]) -> dict[str, tuple[Loop, dict[str, float]]]:
    """The arm of each model as these recordings have it, and the numbers of its five joints."""
    cut = [Stretch(k, f, min(WINDOW, len(r.time) - f)) for k, r in enumerate(runs)
           for f in range(0, len(r.time) - 100, WINDOW)]  # fmt: skip
    here = setting(so101_loop(), runs, baseline=("joint_damping", "friction_loss"), gains_known=False,
                   more=[("actuator_gain", name) for name in SO101], stretches=cut)  # fmt: skip
    table = here.known.table
    begin = values(here.loop, table)
    for k, entry in enumerate(table):
        begin[k] = BEGIN[entry.name][entry.at[0]] if entry.name in BEGIN else begin[k]
    fits: dict[str, Fit] = {}
    out = {}
    for model in models:
        less = max((m for m in fits if set(m) < set(model)), key=len, default=None)
        new = [x for letter in model if letter not in (less or "F") for x in NUMBERS[letter]]
        mine = [k for k, e in enumerate(table) if e.at[0] < 5 and e.name in new]
        had = [k for letter in (less or "") for k, e in enumerate(table)
               if e.at[0] < 5 and e.name in NUMBERS.get(letter, ())]  # fmt: skip
        theta = (begin if less is None else fits[less].theta).copy()
        for k in mine:
            theta[k] = FIRST.get(table[k].name, theta[k])
            if table[k].name == "stribeck_force":
                friction = here.known.entry("friction", table[k].at[0])
                theta[k], theta[friction] = 0.3 * theta[friction], 0.85 * theta[friction]
        fits[model] = _alike(here, theta, None if less is None else fits[less].start, [*had, *mine])
        numbers = {f"{table[k].name} {SO101[table[k].at[0]]}": float(fits[model].theta[k]) for k in mine}
        out[model] = put(here.loop, table, fits[model].theta), numbers
    return out


def _alike(here: Setting, theta: np.ndarray, start: np.ndarray | None, more: Sequence[int]) -> Fit:
    """The fit in which each recording weighs alike."""
    free, structure = free_entries(here.baseline, more), Structure(here.loop, here.known.table, here.data)
    about = {"width": len(free), "lanes": 1, "rough": 1e-3}
    one = fit(*structure, theta[None], [free], None if start is None else start[None], iterations=25, **about)[0]
    for _ in range(2):
        data = evened(here, structure, one).data
        one = fit(*structure._replace(data=data), one.theta[None], [free], one.start[None], iterations=15, **about)[0]
    return one


def t_of(falls: np.ndarray) -> float:
    """Student's t of their mean."""
    return float(falls.mean() / (falls.std(ddof=1) / np.sqrt(len(falls)) + 1e-300))


def main() -> None:
    """Leave out each motion, then compare the models on all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--most", type=float, default=60.0, help="s of each recording")
    parser.add_argument("--models", nargs="+", default=["F", "FR", "FS", "FSR", "FL"])
    parser.add_argument("--motions", nargs="+", help="those to leave out; default: all")
    args = parser.parse_args()
    runs = [_shorter(r, args.most) for r in so101_runs({**TRAIN, **TEST})]
    motion = [r.name.split()[0] for r in runs]
    names = [n for n in dict.fromkeys(motion) if args.motions is None or n in args.motions]
    squares: dict[str, list[np.ndarray]] = {m: [] for m in args.models}
    for name in names:
        start = time.process_time()
        models = fitted([r for r, n in zip(runs, motion, strict=True) if n != name], args.models)
        for model, (loop, _) in models.items():
            left = [(simulated(loop, r)[:, :5] - r.position[:, :5]) ** 2
                    for r, n in zip(runs, motion, strict=True) if n == name]  # fmt: skip
            squares[model].append(np.concatenate(left).mean(0))
        told = ", ".join(f"{m} {1e3 * np.sqrt(x[-1]).mean():.2f}" for m, x in squares.items())
        print(f"{name:<28} {told} mrad, {time.process_time() - start:.0f} CPU s", flush=True)
    base = np.array(squares[args.models[0]])
    seconds = sum(len(r.time) for r in runs) * PERIOD
    print(f"{seconds:.0f} s of {len(names)} motions, {', '.join(SO101[:5])}:")
    for model, rows in squares.items():
        own = np.array(rows)
        floor = 0.1 * own.mean(0)
        falls = np.log((base + floor) / (own + floor))
        gone = 1 - own.sum(0) / base.sum(0)
        t = [t_of(x) if np.any(x) else 0.0 for x in falls.T]
        print(
            f"{model:<4} {1e3 * np.sqrt(own).mean():.2f} mrad, by joint {np.round(1e3 * np.sqrt(own).mean(0), 2)},"
            f" gone {np.round(gone, 2)}, t {np.round(t, 1)}, of all {t_of(falls.mean(1)) if np.any(falls) else 0:.1f}"
        )


if __name__ == "__main__":
    main()
