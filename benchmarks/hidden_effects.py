"""Hide effects in made recordings and count how the diagnosis does: right, in the set, abstained, wrong.

    python benchmarks/hidden_effects.py --seeds 0 1 --robots tx40 panda      # every effect, with and without repeats
    python benchmarks/hidden_effects.py --clean 48                           # false names, p-values on clean recordings
    python benchmarks/hidden_effects.py --left-out --size 0.08               # families missing in the catalogue
    python benchmarks/hidden_effects.py --trusted --clean 12                 # links that the task trusts to 2 %
    python benchmarks/hidden_effects.py --foreign --size 0.08                # laws that no catalogue holds
    python benchmarks/hidden_effects.py --closed-loop --robots ur10e         # MuJoCo C in place of inverse dynamics
    python benchmarks/hidden_effects.py --several 5 --cases 20               # five at once, as in a real robot
    python benchmarks/hidden_effects.py --differs part --size 0.1            # in some of the recordings only

The recordings come from Pinocchio or MuJoCo C (`tests/generators`), which share no code with the library.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import zlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import numpy as np  # noqa: E402
from generators import (  # noqa: E402
    CLASSES,
    CLOSED_LOOP_EFFECTS,
    DIFFERS,
    EFFECTS,
    FOREIGN,
    Case,
    make_case,
    make_closed_loop_case,
    observable,
)
from generators.scoring import Score, judge, named, table, upper_bound  # noqa: E402
from generators.sensors import COLOURS  # noqa: E402

LAYOUTS = {"repeats": (2, 3), "single": (1, 6)}


def main() -> None:
    """Run the study that the arguments ask for and print its table."""
    args = _arguments()
    import jax

    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(ROOT / ".cache" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    scores, seconds, p_values, found = [], [], [], np.zeros(3, dtype=int)
    for label, case, forbid in _cases(args):
        start = time.process_time()
        answer = _diagnose(case, forbid)
        seconds.append(time.process_time() - start)
        scores.append(judge(label, () if forbid or args.foreign else case.truth, answer))
        p_values.append(answer.p_value)
        if args.several:
            found += np.array(_each(case, answer))
        print(f"{table(scores[-1:]).splitlines()[0]}  p {p_values[-1]:.4f}  {seconds[-1]:.1f} CPU s", flush=True)
    print(table(scores).splitlines()[-1])
    print(f"CPU s a case: first {seconds[0]:.1f}, median {sorted(seconds)[len(seconds) // 2]:.1f}")
    _rates(scores)
    if args.several:
        right, alike, hidden = found
        print(f"of {hidden} hidden effects {right} named at their place, {alike} more in a set")
    if args.clean:
        _uniformity(dict(zip((score.case for score in scores), p_values, strict=True)))


def _uniformity(p: dict[str, float]) -> None:
    """How often the p-value of clean cases lies below a level (goal: at most 7 % below .05), and how near to uniform.

    A p-value is right if it lies below a level no more often than the level says.
    """
    from scipy.stats import kstest

    kinds = {"all": "", "with repeats": " repeats ", "without": " single ", "1/f noise": "pink"}
    for title, word in kinds.items():
        own = np.array([value for case, value in p.items() if word in case])
        if not len(own):
            continue
        shares = ", ".join(f"< {level:g}: {np.mean(own < level):.3f}" for level in (0.01, 0.05, 0.1, 0.25, 0.5))
        too_small = kstest(own, "uniform", alternative="greater").pvalue
        print(f"p of {len(own)} clean cases, {title}: {shares}; chance of so many small (one-sided KS) {too_small:.3f}")


def _each(case: Case, answer: Any) -> tuple[int, int, int]:
    """How many of a case's effects are a cause's name, how many only one of a cause's set, and how many there are."""
    causes = named(answer)
    right = [any(name in observable(t) for name, _ in causes) for t in case.truth]
    alike = [any(members & observable(t) for _, members in causes) for t in case.truth]
    for truth, own, one in zip(case.truth, right, alike, strict=True):
        print(f"    {'named' if own else 'set' if one else 'missed':7} {truth.effect} ({', '.join(truth.at)})")
    return sum(right), sum(alike) - sum(right), len(right)


def _rates(scores: list[Score]) -> None:
    wrong = sum(bool(s.false) for s in scores)
    print(f"cases with a false name: {wrong} of {len(scores)} (95 % bound {upper_bound(wrong, len(scores)):.3f})")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effects", nargs="+", help="default: every effect that the catalogue must name")
    parser.add_argument("--robots", nargs="+", default=["tx40", "panda"])
    parser.add_argument("--layouts", nargs="+", choices=list(LAYOUTS), default=list(LAYOUTS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--size", type=float, default=0.05)
    parser.add_argument("--noise", type=float, default=1.0)
    parser.add_argument("--clean", type=int, default=0, metavar="N", help="N clean cases instead, with their p-values")
    parser.add_argument("--trusted", action="store_true", help="inertials 1 %% off and trusted to 2 %% in every case")
    parser.add_argument("--left-out", action="store_true", help="forbid the hidden effect: `unknown` is right")
    parser.add_argument("--foreign", action="store_true", help="hide laws that stand in no catalogue")
    parser.add_argument("--closed-loop", action="store_true", help="MuJoCo C in place of inverse dynamics")
    parser.add_argument("--several", type=int, default=0, metavar="K", help="K effects of 2 to 15 %% at once")
    parser.add_argument("--differs", choices=DIFFERS, help="how the effects change from recording to recording")
    parser.add_argument("--cases", type=int, default=12, help="of several effects (default 12)")
    return parser.parse_args()


def _cases(args: argparse.Namespace) -> Iterator[tuple[str, Case, tuple[str, ...]]]:
    """Label, case and forbidden effects of the study, one after another."""
    make = make_closed_loop_case if args.closed_loop else make_case
    if args.trusted:
        make = partial(make, trusted=True)
    if args.differs:
        make = partial(make, differs=args.differs)
    for number in range(args.clean):
        layout = args.layouts[number % len(args.layouts)]
        robot, seed = args.robots[number // 2 % len(args.robots)], args.seeds[0] + number
        more: dict[str, Any] = {} if args.closed_loop else _noise(number)
        label = f"clean {robot} {layout} seed {seed} {more}"
        yield label, _made(make, [], robot, layout, seed, **more), ()
    if args.clean:
        return
    known = CLOSED_LOOP_EFFECTS if args.closed_loop else EFFECTS
    for number in range(args.cases if args.several else 0):
        layout = args.layouts[number % len(args.layouts)]
        robot, seed = args.robots[number // 2 % len(args.robots)], args.seeds[0] + number
        rng = np.random.default_rng([seed, 7])
        effects = rng.choice(args.effects or known, args.several, replace=False)
        sizes = np.exp(rng.uniform(np.log(0.02), np.log(0.15), args.several))
        try:
            wanted = [(str(effect), float(size)) for effect, size in zip(effects, sizes, strict=True)]
            case = _made(make, wanted, robot, layout, seed, noise=args.noise)
        except ValueError as error:
            print(error)
            continue
        told = ", ".join(f"{t.effect} {size:.2f}" for t, size in zip(case.truth, sizes, strict=True))
        yield f"{robot} {layout} seed {seed}: {told}", case, ()
    if args.several:
        return
    for effect in args.effects or (FOREIGN if args.foreign else known):
        for robot in args.robots:
            for layout in args.layouts:
                for seed in args.seeds:
                    seed += zlib.crc32(f"{effect} {robot} {layout}".encode()) % 100_000
                    try:
                        case = _made(make, [(effect, args.size)], robot, layout, seed, noise=args.noise)
                    except ValueError as error:
                        print(error)
                        continue
                    label = f"{effect} ({', '.join(case.truth[0].at)}) {robot} {layout} seed {seed}"
                    yield label, case, _twins(effect) if args.left_out else ()


def _made(make: Any, effects: list[Any], robot: str, layout: str, seed: int, **more: Any) -> Case:
    repeats, trajectories = LAYOUTS[layout]
    return make(effects, robot=robot, repeats=repeats, trajectories=trajectories, seed=seed, **more)


def _noise(number: int) -> dict[str, Any]:
    """White and coloured noise of three levels, encoders of fine and coarse steps, in turn."""
    return {
        "colour": COLOURS[(number + number // 4) % len(COLOURS)],
        "noise": (0.5, 1.0, 2.0)[number % 3],
        "encoder_step": (1e-5, 1e-4)[number % 2],
    }


def _twins(effect: str) -> tuple[str, ...]:
    """The effect and what cannot be told from it, as far as the library knows the names."""
    from figaroh_jax.effects.catalogue import CATALOGUE

    names = {effect}.union(*(names for names in CLASSES if effect in names))
    return tuple(sorted(names & set(CATALOGUE)))


def _diagnose(case: Case, forbid: tuple[str, ...]) -> Any:
    from figaroh_jax.diagnosis.diagnosis import diagnose_task
    from figaroh_jax.formats import config

    with tempfile.TemporaryDirectory() as folder:
        return diagnose_task(config.load_task(case.write(Path(folder), forbid)))


if __name__ == "__main__":
    main()
