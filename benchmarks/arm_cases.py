"""Hidden effects in an arm of six servos: verdicts from command and position alone.

    python benchmarks/arm_cases.py --seeds 1 2 [--effects payload none] [--sizes 0 1 2] [--noise white|coloured|counts]
    python benchmarks/arm_cases.py --seeds 1 --pairs
    python benchmarks/arm_cases.py --seeds 1 2 3 --several 4 [--recordings 4]  # of any sizes
    python benchmarks/arm_cases.py --seeds 1 --forbid
    python benchmarks/arm_cases.py --seeds 1 --own            # a detent, an effect that a user registers
    python benchmarks/arm_cases.py --seeds 1 --registered     # it is looked for, but not there

Each arm is made by MuJoCo C (`tests/generators/servo_arm6.py`, no code shared with the library) and diagnosed with a
model whose armature, damping and frictionloss are 1.6 times too large, on two recordings of 12 s. The joint follows
from the seed. One line a run; `wrong` is a name that is neither hidden nor told to be alike. `--forbid` leaves the true
effect out of the catalogue: the answer must be `unknown` then.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from generators import servo_arm6

import figaroh_jax as fj
from figaroh_jax.rollouts.arm import search_arm
from figaroh_jax.rollouts.bodies import searched_with_bodies
from figaroh_jax.rollouts.creep import searched_with_both
from figaroh_jax.rollouts.data import Run, Stretch
from figaroh_jax.rollouts.found import Named
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.search import search
from figaroh_jax.rollouts.setting import setting


class Detent(fj.JointEffect):
    """A ball that drops into a notch of the joint and has to be pushed out of it."""

    name, title, equation = "detent", "a detent", "strength x exp(-x^2 / 2), x = (q - notch) / 0.1 rad"
    separated_by = "slow passes of {at} through the notch in both directions"
    strength: float = fj.amplitude("N m")
    notch: float = fj.shape("rad", tuple(np.linspace(-0.3, 1.2, 16)))

    def torque(self, motion: fj.Motion) -> Any:
        """strength x exp(-x^2 / 2), N m."""
        x = (self.here(motion.position) - self.notch) / 0.1
        return self.strength * x * jnp.exp(-(x**2) / 2)


def run(
    hidden: list[tuple[str, int, float]], seed: int, noise: str, *, whole: bool, known: bool, forbid: bool = False,
    holds: bool = False, recordings: int = 2, rest: str = "none",
) -> tuple[str, str, float]:  # fmt: skip
    """Verdict with its names, what was found, CPU seconds."""
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(servo_arm6.model_text(1.6))
        file.flush()
        loop, _ = load_loop(file.name)
    runs = []
    for number in range(recordings):
        r = _recorded(hidden, seed, number, noise, holds, rest)
        runs.append(Run(f"run {number}", r["t"], r["u"], r["q"], None))
    cut = [Stretch(k, f, 600) for k in range(recordings) for f in range(0, 1200, 600)]
    start = time.process_time()
    left_out = tuple(effect for effect, _, _ in hidden) if forbid else ()
    left_out += ("link_inertia",) if "payload" in left_out else ("payload",) if "link_inertia" in left_out else ()
    here = setting(loop, runs, gains_known=known, stretches=cut, forbid=left_out)
    seek = search if whole else search_arm
    found = searched_with_both(seek, here, forbid=left_out)
    found = searched_with_bodies(seek, here, found, forbid=left_out)
    causes = [n for n in found.named if not (holds and n in found.creeps)]
    names = {(n.candidate.effect, *n.candidate.at) for n in causes}
    alike = {(a.effect, *a.at) for n in causes for a in n.alike}
    truth = {(effect, *_place(effect, j)) for effect, j, _ in hidden}
    told, also = ({_any_link(name) for name in some} for some in (names, alike))
    if left_out:
        silent = ("unknown", "named+rest") if found.creeps else ("unknown",)
        word = "wrong" if names else "right" if found.verdict in silent else "missed"
    elif not hidden:
        due = "unknown" if rest != "none" else "named" if holds else "nothing"
        word = "wrong" if names else "right" if found.verdict == due else found.verdict
    elif told == truth or (truth <= told | also and all(_true(n, truth) for n in causes)):
        word = "right"
    elif not told:
        word = "missed" if found.verdict == "nothing" else "unknown"
    else:
        word = "part" if told < truth else "wrong"
    if holds:
        at = ", ".join(n.candidate.at[0] for n in found.creeps)
        word += f" (friction holds at {at})" if at else " (friction that holds not seen)"
    names_text = "+".join(_text(name) for name in sorted(names)) or "-"
    names_text += "".join(f" alike {_text(name)}" for name in sorted(alike))
    proxy = "+".join(f"{n.candidate.effect}({', '.join(n.candidate.at)})" for n in found.proxy) or "-"
    levels = " -> ".join(f"{x:.3f}" for _, x in found.table)
    return word, f"{found.verdict} {names_text}, chi2/N {levels}, proxy {proxy}", time.process_time() - start


def _recorded(
    hidden: list[tuple[str, int, float]], seed: int, number: int, noise: str, holds: bool, rest: str
) -> dict[str, np.ndarray]:
    """A recording, with something beside that no effect explains: a notch, or friction of each recording's own."""
    mine = [joint for _, joint, _ in hidden][:1]
    rng = np.random.default_rng([seed, 19])
    if rest == "notch" or (rest == "same" and not mine):
        mine = [int(rng.choice([j for j in range(5) if j not in mine]))]
    if rest in ("notch", "same"):
        hidden = [*hidden, ("detent", mine[0], float(rng.choice(servo_arm6.DETENT)))]
    if rest != "differ":
        return servo_arm6.record(hidden, seed, number, noise, holds)
    own, kept = np.random.default_rng([seed, number, 31]), (servo_arm6.FRICTION, servo_arm6.DAMPING)
    servo_arm6.FRICTION, servo_arm6.DAMPING = (tuple(np.array(x) * (1 + 0.05 * own.standard_normal(6))) for x in kept)
    try:
        return servo_arm6.record(hidden, seed, number, noise, holds)
    finally:
        servo_arm6.FRICTION, servo_arm6.DAMPING = kept


def _place(effect: str, joint: int) -> tuple[str, ...]:
    """Where a hidden effect is to be named."""
    own = {
        "payload": ("payload",),
        "link_inertia": ("link_inertia",),
        "gravity_tilt": (),
        "coupled_transmission": servo_arm6.NAMES[joint : joint + 2],
    }
    return tuple(own.get(effect, (servo_arm6.NAMES[joint],)))


def _any_link(name: tuple[str, ...]) -> tuple[str, ...]:
    """A payload and a wrong link may be named at any link: those next to each other move alike."""
    return (name[0], name[0]) if name[0] in ("payload", "link_inertia") else name


def _text(name: tuple[str, ...]) -> str:
    return f"{name[0]}({', '.join(name[1:])})"


def _true(named: Named, truth: set[tuple[str, ...]]) -> bool:
    """Whether a name, or one that it is told to be alike, is hidden."""
    told = [(named.candidate.effect, *named.candidate.at), *((a.effect, *a.at) for a in named.alike)]
    return any(_any_link(name) in truth for name in told)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument(
        "--effects",
        nargs="+",
        choices=["none", *servo_arm6.EFFECTS, *servo_arm6.MORE],
        default=["none", *servo_arm6.EFFECTS],
    )
    parser.add_argument("--sizes", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--noise", choices=["white", "coloured", "counts"], default="white")
    parser.add_argument("--pairs", action="store_true", help="two effects at a time, of the middle size")
    parser.add_argument("--several", type=int, default=0, metavar="K", help="K effects at a time, of any sizes")
    parser.add_argument("--own", action="store_true", help="an effect that is no one of the library's, registered here")
    parser.add_argument("--registered", action="store_true", help="that effect is registered, but not hidden")
    parser.add_argument("--forbid", action="store_true", help="leave the true effect out of the catalogue")
    parser.add_argument("--holds", action="store_true", help="the arm's friction holds, the file's creeps")
    parser.add_argument("--recordings", type=int, default=2)
    parser.add_argument(
        "--rest",
        choices=["none", "notch", "same", "differ"],
        default="none",
        help="what no effect explains besides"
        " (give four recordings): a notch at another joint, at the same, friction that differs by recording",
    )
    parser.add_argument("--whole", action="store_true", help="one cause after another, as for other robots")
    args = parser.parse_args()
    count: dict[str, int] = {}
    if args.own or args.registered:
        fj.register(Detent)
    for seed in args.seeds:
        for hidden in _cases(args, np.random.default_rng([seed, 3])):
            given: dict[str, Any] = {"whole": args.whole, "known": True, "forbid": args.forbid}
            given |= {"holds": args.holds, "recordings": args.recordings, "rest": args.rest}
            word, text, seconds = run(hidden, seed, args.noise, **given)
            count[word] = count.get(word, 0) + 1
            label = "+".join(f"{e}@{servo_arm6.NAMES[j]}:{size:g}" for e, j, size in hidden) or "none"
            print(f"seed {seed} {args.noise} {label}: {word}; {text}, {seconds:.0f} CPU s", flush=True)
    print(", ".join(f"{word} {n}" for word, n in sorted(count.items())))


def _cases(args: argparse.Namespace, rng: np.random.Generator) -> list[list[tuple[str, int, float]]]:
    def one(effect: str, size: int) -> tuple[str, int, float]:
        sprung = effect in ("joint_elasticity", "backlash")  # the wrist's roll is too light for a spring at 2 ms
        joint = 5 if effect == "payload" else int(rng.integers(0, 4 if sprung else 5))
        if effect == "link_inertia":  # gravity shows it
            joint = int(rng.integers(1, 4))
        if effect in ("torque_ripple", "coupled_transmission"):  # the roll and the jaw do not move far enough
            joint = int(rng.integers(0, 4))
        return effect, joint, (servo_arm6.EFFECTS | servo_arm6.MORE)[effect][size]

    if args.own:
        return [[("detent", int(rng.integers(0, 5)), servo_arm6.DETENT[size])] for size in args.sizes]
    if args.several:
        return [_several(args.several, rng, one)]
    effects = list(servo_arm6.EFFECTS)
    if args.pairs:
        pairs = [rng.choice(len(effects), 2, replace=False) for _ in range(3)]
        return [[one(effects[a], 1), one(effects[b], 1)] for a, b in pairs if {a, b} != {2, 3}]
    cases: list[list[tuple[str, int, float]]] = []
    for effect in args.effects:
        cases += [[]] if effect == "none" else [[one(effect, size)] for size in args.sizes]
    return cases


def _several(
    count: int, rng: np.random.Generator, one: Callable[[str, int], tuple[str, int, float]]
) -> list[tuple[str, int, float]]:
    """Effects of which the generator can hide all at once: one spring, and one that changes a joint's friction."""
    apart = ({"joint_elasticity", "backlash"}, {"stribeck_friction", "load_dependent_friction"})
    hidden: list[tuple[str, int, float]] = []
    for effect in rng.permutation([*servo_arm6.EFFECTS, *servo_arm6.MORE]):
        new = one(str(effect), int(rng.integers(3)))
        others = {x for x, joint, _ in hidden if joint == new[1] or x in apart[0]}
        if not any(new[0] in pair and pair & others for pair in apart):
            hidden.append(new)
        if len(hidden) == count:
            break
    return hidden


if __name__ == "__main__":
    main()
