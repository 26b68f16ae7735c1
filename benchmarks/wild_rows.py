"""What `diagnose` says of real recordings in which rows are wild or lack: the same as without them?

    python -m benchmarks.wild_rows [--only WORD ...] [--kinds WORD ...] [--rows 8] [--places 3] [--seed N] [--jobs 2]

The sets are those of `hide_in_real`, each recording spoiled as logs are. `--rows` of them are drawn: one joint's
position off by .5 to 3 rad (`position`), position and torque zero at every joint (`lost`), one joint's torque 50 times
its largest (`torque`), three times (`pulse`). `--places`: all columns repeat for .1 to .4 s (`stopped`), torques alone
(`held`), rows of .02 to .2 s lack and the stamps run on evenly (`missing`). One line a kind: the verdict, the error
held out before and after, and how many of the causes of the recordings as they are stand in the answer, with what is
named besides.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from . import blackbox
from .hide_in_real.generate import twin_of
from .hide_in_real.recordings import SETS, RealSet, Recording

Spoil = Callable[[np.ndarray, np.ndarray, int, np.random.Generator], None]  # position, torque (rows, joints), row


def _position(q: np.ndarray, tau: np.ndarray, row: int, rng: np.random.Generator) -> None:
    q[row, rng.integers(q.shape[1])] += rng.choice([-1, 1]) * rng.uniform(0.5, 3.0)


def _lost(q: np.ndarray, tau: np.ndarray, row: int, rng: np.random.Generator) -> None:
    q[row] = tau[row] = 0.0


def _times(factor: float) -> Spoil:
    def spoil(q: np.ndarray, tau: np.ndarray, row: int, rng: np.random.Generator) -> None:
        joint = rng.integers(tau.shape[1])
        low, high = np.percentile(tau[:, joint], [1, 99])  # the pulses that are there already do not count
        tau[row, joint] += rng.choice([-1, 1]) * factor * max(-low, high)

    return spoil


KINDS: dict[str, Spoil] = {"position": _position, "lost": _lost, "torque": _times(50.0), "pulse": _times(3.0)}
LONG = {"stopped": (0.1, 0.4), "held": (0.1, 0.4), "missing": (0.02, 0.2)}  # s


def spoiled(real: RealSet, kind: str, rows: int, places: int, seed: int) -> RealSet:
    """The set with wild rows of a kind in each of its recordings (none for a kind that is no such word)."""
    if kind not in KINDS and kind not in LONG:
        return real
    rng, recordings = np.random.default_rng(seed), []
    for one in real.recordings:
        arrays = {key: np.array(values, float) for key, values in one.arrays.items()}
        if kind in KINDS:
            position, torque = (arrays[one.entry[key]] for key in ("position", "torque"))
            many = len(position)
            for row in rng.choice(np.arange(50, many - 50), rows, replace=False).tolist():
                KINDS[kind](position.reshape(many, -1), torque.reshape(many, -1), row, rng)
        else:
            arrays = _for_a_while(arrays, one, kind, places, rng)
        recordings.append(replace(one, arrays=arrays))
    return replace(real, recordings=tuple(recordings))


def _for_a_while(
    arrays: dict[str, np.ndarray], one: Recording, kind: str, places: int, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """The arrays of a file whose stream stops in some places, or lacks what came there."""
    many, period = len(one.time), float(np.median(np.diff(one.time)))
    kept = np.ones(many, bool)
    for _ in range(places):
        first, rows = int(rng.integers(many // 10, many - many // 10)), int(rng.uniform(*LONG[kind]) / period)
        for key in ("position", "torque") if kind == "stopped" else ("torque",) if kind == "held" else ():
            arrays[one.entry[key]][first : first + rows] = arrays[one.entry[key]][first]
        kept[first : first + rows] = kind != "missing"
    if kind == "missing":
        arrays = {key: values[kept] if len(values) == many else values for key, values in arrays.items()}
        if "time" in one.entry:
            arrays[one.entry["time"]] = one.time[0] + period * np.arange(kept.sum())
    return arrays


def answered(name: str, kind: str, rows: int, seed: int, places: int = 3) -> dict[str, Any]:
    """The answer on one set spoiled in one way; empty where there is none."""
    return answer_on(spoiled(SETS[name](), kind, rows, places, seed))


def answer_on(real: RealSet) -> dict[str, Any]:
    """What the command line answers on a set; empty where it does not."""
    with tempfile.TemporaryDirectory() as scratch:
        cases, runs = Path(scratch, "cases"), Path(scratch, "runs")
        twin = twin_of(cases, real)
        blackbox.run(cases, runs, {twin["name"]: twin}, blackbox.default_command(), 1, 3600, ["named"])
        return blackbox.read(runs / twin["name"] / "all") or {}


def main() -> None:
    """Diagnose each set as it is and in each way spoiled, and print a line of each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[], metavar="WORD")
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS, *LONG], default=[*KINDS, *LONG])
    parser.add_argument("--rows", type=int, default=8, help="that are wild, in each recording")
    parser.add_argument("--places", type=int, default=3, help="in which a stream stops or rows lack")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    names = [name for name in SETS if not args.only or any(word in name for word in args.only)]
    print(f"{blackbox.commit()}, {args.rows} rows or {args.places} places in each recording, seed {args.seed}")
    with ProcessPoolExecutor(args.jobs) as pool:
        work = {
            (name, kind): pool.submit(answered, name, kind, args.rows, args.seed, args.places)
            for name in names
            for kind in ("none", *args.kinds)
        }
        for (name, kind), answer in work.items():
            print(f"{name:22s} {kind:10s} {_line(answer.result(), work[name, 'none'].result())}", flush=True)


def _line(answer: dict[str, Any], clean: dict[str, Any]) -> str:
    if not answer or not clean:
        return "no answer"
    ours, theirs = ({(c["effect"], *c["at"]) for c in told["causes"]} for told in (answer, clean))
    held = answer["holdout"]
    besides = ", ".join(f"{effect} ({', '.join(at)})" for effect, *at in sorted(ours - theirs))
    error = " -> ".join(f"{held[key]:.4f}" for key in ("before", "after"))
    return f"{answer['verdict']:10s} {error}, {len(ours & theirs)} of {len(theirs)} causes" + (
        besides and f"; {besides}"
    )


if __name__ == "__main__":
    main()
