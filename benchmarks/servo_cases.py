"""Seven cases of a servo arm: one hidden effect, command and position alone; verdicts over fresh seeds.

    python benchmarks/servo_cases.py --seeds 101 102 103 [--cases payload none] [--forbid]

Each case is made by MuJoCo C (`tests/generators/servo_arm.py`, no code shared with the library) and diagnosed with
a model whose armature, damping and frictionloss are 1.6 times too large. `--forbid` leaves the true effect out of the
catalogue, and what is the same torque in this arm: the answer must be `unknown` then. One line a run; a table at the
end.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from generators import servo_arm

from figaroh_jax.rollouts.creep import searched_with_both
from figaroh_jax.rollouts.data import Run
from figaroh_jax.rollouts.fit import standard_errors
from figaroh_jax.rollouts.found import Search
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.search import search
from figaroh_jax.rollouts.setting import setting

TRUTH = {"armature": 0.05, "damping": 0.4, "friction": 0.3}
EFFECT = {
    "stribeck_friction": {"friction": 0.3, "stribeck_force": 0.5, "stribeck_speed": 0.25},
    "load_dependent_friction": {"friction": 0.15, "load_ratio": 0.25},
    "joint_elasticity": {"armature": 0.0501},
    "command_delay": {"delay": 0.008},
    "encoder_offset": {"reading": 0.03},
    "payload": {"payload": 0.3},
}
# Left out with the true effect: beside a constant torque a tilt of one joint's gravity is an offset of its encoder.
EQUIVALENT = {"encoder_offset": ("gravity_tilt",)}


def run(case: str, seed: int, *, forbid: bool) -> tuple[str, Search, float]:
    """Verdict in words, what was found, CPU seconds."""
    recording = servo_arm.record(case, seed)
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(servo_arm.model_text(0.08, 0.64, 0.48))
        file.flush()
        loop, _ = load_loop(file.name)
    start = time.process_time()
    left_out = (case, *EQUIVALENT.get(case, ())) if forbid else ()
    t, u, q, dq = (recording[k] for k in ("t", "u", "q", "dq"))
    here = setting(loop, [Run(case, t, u, q, dq)], forbid=left_out)
    found = searched_with_both(search, here, forbid=left_out)
    names = "+".join(n.candidate.effect for n in found.named)
    return f"{found.verdict} {names}".strip(), found, time.process_time() - start


def intervals(case: str, found: Search) -> tuple[int, int]:
    """How many of the 95 % intervals of the true structure's numbers hold the truth."""
    truth, inside, all_of = TRUTH | EFFECT.get(case, {}), 0, 0
    errors = standard_errors(found.last, found.structure.data)
    for column, entry in enumerate(found.last.free):
        name = found.structure.table[entry].name if entry >= 0 else ""
        if entry >= 0 and entry < len(found.first.theta) and name in truth:
            all_of += 1
            inside += abs(found.last.theta[entry] - truth[name]) <= 1.96 * errors[column]
    return inside, all_of


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[101])
    parser.add_argument("--cases", nargs="+", choices=servo_arm.CASES, default=list(servo_arm.CASES))
    parser.add_argument("--forbid", action="store_true")
    args = parser.parse_args()
    right, wrong, held = dict.fromkeys(args.cases, 0), dict.fromkeys(args.cases, 0), np.zeros(2, int)
    for seed in args.seeds:
        for case in args.cases:
            verdict, found, seconds = run(case, seed, forbid=args.forbid)
            expected = "unknown" if args.forbid else ("nothing" if case == "none" else f"named {case}")
            right[case] += verdict == expected
            wrong[case] += verdict.startswith("named") and verdict != expected
            if verdict == expected and not args.forbid:
                held += intervals(case, found)
            alike = [str(a) for n in found.named for a in n.alike]
            proxy = "+".join(n.candidate.effect for n in found.proxy)
            level = found.last.squares / (np.asarray(found.structure.data.weight) > 0).sum()
            print(
                f"seed {seed} {case}: {verdict}, chi2/N {found.table[0][1]:.3f} -> {level:.3f}, alike {alike},"
                f" proxy {proxy or '-'}, {seconds:.0f} CPU s",
                flush=True,
            )
    print(f"\n{'hidden':<26} right  wrong names  of {len(args.seeds)}")
    for case in args.cases:
        print(f"{case:<26} {right[case]:5d} {wrong[case]:12d}")
    print(f"95 % intervals that hold the truth: {held[0]} of {held[1]}")


if __name__ == "__main__":
    main()
