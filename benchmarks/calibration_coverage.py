"""How often the truth lies in the 95 % interval of each parameter: kinematics perturbed in Pinocchio, noise of 0.1 mm.

    python benchmarks/calibration_coverage.py --runs 200 [--robots arm6 panda] [--seed 0] [--chosen]

Links are off by 1 mm and 1 mrad, joints by 5 mrad, drawn anew in each run. Full geometry is asked for;
with `--chosen` the level and the effects are chosen. Prints the coverage of every parameter, by its status, and gauge
classes. A parameter of a gauge class may say nothing of its own: its interval must be as wide as its prior.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "benchmarks")]

from generators import postures  # noqa: E402
from hidden_kinematics import arm  # noqa: E402


def calibrated(robot: postures.Arm, model: Any, made: postures.Perturbed, level: str | None) -> Any:
    """The library's calibration of a made robot."""
    from figaroh_jax.calibration.calibration import calibrate
    from figaroh_jax.recordings.poses import PoseRecording

    both, clock = ("base_frame", "tool_frame"), np.arange(float(len(made.q)))
    seen = PoseRecording("made", Path("made"), clock, made.q, "position", made.points, robot.base, robot.tool, both)
    return calibrate(model, [seen], level=level)


def misses(model: Any, robot: postures.Arm, made: postures.Perturbed, found: Any) -> dict[str, tuple[float, str]]:
    """By parameter: its error in its own standard deviations, and its status."""
    import pinocchio as pin  # pyright: ignore[reportMissingImports]

    from figaroh_jax.calibration.candidates import geometry_columns
    from figaroh_jax.effects.kinematic import Postures

    none = np.zeros((1, 0))
    still = Postures(none, none, none, none, none, np.zeros(1), 1.0)
    truth = {}
    for column in geometry_columns(model, range(len(robot.joints))):
        ((joint, field),) = column.pieces
        truth[column.label] = field(still)[:, 0] @ made.twists[joint]
    error = {p.name: p.value - truth[p.name] for p in found.parameters if p.name in truth}
    about = pin.SE3(np.eye(3), made.points.mean(axis=(0, 1)))
    base = pin.SE3(found.frames["base_frame"])
    turned = pin.log6(about.inverse() * base * made.device.inverse() * about).vector
    error |= {f"base_frame {axis}": turned[k] for k, axis in enumerate(("x", "y", "z", "rx", "ry", "rz"))}
    spots = found.frames["tool_frame"] - postures.MARKERS
    error |= {f"tool_frame {m + 1} {axis}": spots[m, k] for m in range(len(spots)) for k, axis in enumerate("xyz")}
    return {p.name: (error[p.name] / p.std, p.status) for p in found.parameters if p.name in error}


def main() -> None:
    """Run the study that the arguments ask for and print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--robots", nargs="+", default=["arm6"], choices=["arm6", "panda"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--chosen", action="store_true", help="let the library choose level and effects")
    args = parser.parse_args()
    import jax

    jax.config.update("jax_enable_x64", True)
    from figaroh_jax.formats.urdf import load_urdf

    with tempfile.TemporaryDirectory() as folder:
        for name in args.robots:
            robot = arm(name, Path(folder))
            model = load_urdf(robot.path, joints=list(robot.joints))
            start, errors, status, classes, levels = time.process_time(), {}, {}, set(), []
            for k in range(args.runs):
                made = postures.perturb(robot, np.random.default_rng(args.seed + k))
                found = calibrated(robot, model, made, None if args.chosen else "full")
                levels.append(found.level)
                classes |= set(found.classes)
                for label, (miss, state) in misses(model, robot, made, found).items():
                    errors.setdefault(label, []).append(miss)
                    status.setdefault(label, []).append(state)
            _table(name, args.runs, errors, status, classes)
            print(f"levels {sorted(set(levels))}; {(time.process_time() - start) / args.runs:.2f} CPU s a run")


def _table(name: str, runs: int, errors: dict[str, list[float]], status: dict[str, list[str]], classes: set) -> None:
    print(f"{name}, {runs} runs")
    pooled: dict[str, list[float]] = {}
    outside = []
    for label, misses in errors.items():
        state = max(set(status[label]), key=status[label].count)
        share = float(np.mean(np.abs(misses) < 1.96))
        pooled.setdefault(state, []).append(share)
        outside += [label] if not 0.92 <= share <= 0.98 else []
        print(f"  {label:40} {state:12} {share:.3f}  rms {np.sqrt(np.mean(np.square(misses))):.2f}")
    for state, shares in pooled.items():
        print(
            f"{state}: {len(shares)} parameters, covered {np.mean(shares):.3f}, {min(shares):.3f} to {max(shares):.3f}"
        )
    print(f"outside .92 to .98: {', '.join(outside) or 'none'}")
    for members in sorted(classes, key=len):
        print(f"class: {members[0]} with {', '.join(members[1:])}")


if __name__ == "__main__":
    main()
