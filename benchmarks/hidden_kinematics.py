"""Hide kinematic effects in postures of two arms and count how the diagnosis does: right, in the set, abstained, wrong.

    python benchmarks/hidden_kinematics.py --seeds 0                        # every effect, three sizes, both arms
    python benchmarks/hidden_kinematics.py --effects gear_transmission_error --orders 20 350   # harmonic drives
    python benchmarks/hidden_kinematics.py --clean 80 --seeds 100           # false names and p-values of good robots
    python benchmarks/hidden_kinematics.py --left-out --sizes 6            # errors with a history, not in the catalogue
    python benchmarks/hidden_kinematics.py --effects random_play --sizes 6  # a law that no catalogue holds
    python benchmarks/hidden_kinematics.py --several 2 3 --seeds 0 20       # sets of effects, seeds 0 to 19
    python benchmarks/hidden_kinematics.py --differs joint_offset marker same --seeds 0 20

The measurements come from Pinocchio (`tests/generators/postures.py`), which shares no code with the library. Sizes are
in sigmas: of the noise, as the RMS that the effect moves a coordinate of a marker; of a good robot's tolerance for
offsets, links and frames. The arms: six joints (`tests/poses.py`), and a Panda of $FIGAROH_JAX_DATA.
Sets, and recordings of which the last differs (`tests/generators/posture_sets.py`), are drawn by seed, arm and all;
every hidden effect is `named`, in the `set` of a cause or `missed`, and a cause that stands for none is `false`.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import poses  # noqa: E402
from generators import posture_sets, postures  # noqa: E402

from benchmarks import kinematic_sets  # noqa: E402

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
HISTORY = ("settling", "reversal_hysteresis")


def arm(name: str, folder: Path) -> postures.Arm:
    """One of the two arms; `folder` takes the file of the first."""
    if name == "panda":
        joints = tuple(f"panda_joint{k}" for k in range(1, 8))
        return postures.load_arm(DATA / "panda_handeye_board" / "panda.urdf", "panda_link0", "panda_link8", joints)
    path = folder / "arm6.urdf"
    path.write_text(poses.urdf())
    return postures.load_arm(path, "base", "tool0")


def diagnose(
    robot: postures.Arm,
    case: postures.Hidden | posture_sets.Hidden,
    forbid: tuple[str, ...] = (),
    held: int = 0,
    **options: Any,
) -> Any:
    """The library's answer to a case, the last `held` of its recordings held out."""
    from figaroh_jax.calibration.kinematic_diagnosis import diagnose_poses
    from figaroh_jax.formats.config import Load
    from figaroh_jax.formats.urdf import load_urdf
    from figaroh_jax.recordings.poses import PoseRecording

    recordings = []
    for k, r in enumerate(case.recordings):
        given = postures.arguments(robot, r, case)
        load = Load(**given.pop("load")) if given["load"] else given.pop("load")
        role = "holdout" if k >= len(case.recordings) - held else "fit"
        more = given | {"unknown": case.unknown, "load": load, "role": role}
        recordings.append(PoseRecording(name=f"run{k}", file=Path(f"run{k}"), time=r.time, position=r.q, **more))
    return diagnose_poses(load_urdf(robot.path, joints=list(robot.joints)), recordings, forbid, **options)


def grade(case: postures.Hidden, found: Any) -> str:
    """right, set (the truth is in the set of the first cause), nothing, unknown or wrong; + where more is named."""
    names = [(cause.name.effect, tuple(cause.name.at)) for cause in found.causes]
    sets = [{(other.effect, tuple(other.at)) for other in cause.ambiguous_with} for cause in found.causes]
    if not names:
        return "nothing" if found.verdict == "nothing" else "unknown"
    extra = (
        "+"
        if any(n not in case.right and not (s & case.right) for n, s in zip(names[1:], sets[1:], strict=True))
        else ""
    )
    if names[0] in case.right:
        return "right" + extra
    return ("set" if sets[0] & case.right else "wrong") + extra


def main() -> None:
    """Run the study that the arguments ask for and print its table."""
    args = _arguments()
    import jax

    jax.config.update("jax_enable_x64", True)
    if args.cache:
        jax.config.update("jax_compilation_cache_dir", str(args.cache))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if args.several or args.differs:
        with tempfile.TemporaryDirectory() as folder:
            robots = [arm(name, Path(folder)) for name in args.robots]
            kinematic_sets.study(robots, range(*args.seeds), args.several, args.differs, diagnose)
        return
    grades: dict[tuple[str, float], list[str]] = {}
    p_values, seconds = [], []
    with tempfile.TemporaryDirectory() as folder:
        for name in args.robots:
            robot = arm(name, Path(folder))
            for effect, size, seed in _cases(args):
                rng = np.random.default_rng(seed + zlib.crc32(f"{effect} {name} {size}".encode()) % 100_000)
                case = postures.hide(robot, effect, size, rng, args.postures, tuple(args.orders), args.off)
                start = time.process_time()
                found = diagnose(robot, case, (effect,) if effect and args.left_out else ())
                seconds.append(time.process_time() - start)
                mark = grade(case, found)
                grades.setdefault((case.effect, size), []).append(mark)
                p_values.append(found.p_value)
                told = "; ".join(_told(cause) for cause in found.causes)
                right = "; ".join(f"{n} ({', '.join(at)})" for n, at in case.right)
                print(f"{name} {right or 'clean'} x{size:g} seed {seed}: {mark:8} {found.verdict:11}", end=" ")
                print(f"p {found.p_value:.3f} | {told} | {seconds[-1]:.1f} s", flush=True)
    _table(grades)
    below = np.mean(np.array(p_values) < 0.05)
    print(f"p < .05 in {below:.3f} of {len(p_values)}; CPU s: first {seconds[0]:.1f}, median {np.median(seconds):.1f}")


def _told(cause: Any) -> str:
    rivals = "/".join(f"{other.effect} {' '.join(other.at)}" for other in cause.ambiguous_with)
    return f"{cause.name}" + (f" [{rivals}]" if rivals else "")


def _cases(args: argparse.Namespace) -> list[tuple[str | None, float, int]]:
    if args.clean:
        return [(None, 0.0, args.seeds[0] + k) for k in range(args.clean // len(args.robots))]
    effects = args.effects or (HISTORY if args.left_out else postures.EFFECTS)
    return [(effect, size, seed) for effect in effects for size in args.sizes for seed in args.seeds]


def _table(grades: dict[tuple[str, float], list[str]]) -> None:
    for (effect, size), marks in grades.items():
        print(f"{effect:26} x{size:<5g} {', '.join(marks)}")
    for size in sorted({size for _, size in grades}):
        marks = [mark for (_, s), found in grades.items() if s == size for mark in found]
        counts = {g: sum(m.rstrip("+") == g for m in marks) for g in ("right", "set", "nothing", "unknown", "wrong")}
        more = sum(m.endswith("+") for m in marks)
        print(f"x{size:g}: {len(marks)} cases: " + ", ".join(f"{g} {n}" for g, n in counts.items()), end="")
        print(f"; a false name beside the true one in {more}")


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--effects", nargs="+", choices=(*postures.EFFECTS, *postures.FOREIGN))
    parser.add_argument("--robots", nargs="+", default=["arm6", "panda"], choices=["arm6", "panda"])
    parser.add_argument("--sizes", nargs="+", type=float, default=[1.5, 3.0, 10.0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--clean", type=int, default=0, metavar="N", help="N robots within their tolerance instead")
    parser.add_argument("--left-out", action="store_true", help="forbid the hidden effect: `unknown` is right")
    parser.add_argument("--orders", nargs=2, type=float, default=[2.5, 11.0], help="range of a gear error's order")
    parser.add_argument("--off", type=float, default=postures.BUILT, help="tolerances by which all links are off")
    parser.add_argument("--postures", type=int, default=80)
    parser.add_argument("--several", nargs="+", type=int, default=[], metavar="K", help="K effects at once")
    parser.add_argument(
        "--differs", nargs="+", default=[], choices=kinematic_sets.CHANGES, help="in the last recording"
    )
    parser.add_argument("--cache", type=Path, help="folder of compiled programs")
    return parser.parse_args()


if __name__ == "__main__":
    main()
