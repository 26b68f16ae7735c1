"""The real double pendulum as a newcomer asks it: a task file of its ten runs, torque as the command, every third kept
out.

    python benchmarks/pendulum_command_line.py diagnose|identify --out DIR [--window 0.3]

It prints what the command prints, CPU seconds, and what the set's own identified parameters (about the joints) say
that its URDF has too much of, for the file states them as about the centres of mass. After `identify` also how far
`figaroh-jax simulate` of a recording kept out is from the run's own prediction.
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
from pathlib import Path

import numpy as np
import yaml

import figaroh_jax as fj
from figaroh_jax.cli import main as command_line

sys.path.insert(0, str(Path(__file__).resolve().parent))
from rollouts import DATA  # noqa: E402

SET = DATA / "dfki_double_pendulum"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", choices=["diagnose", "identify"])
    parser.add_argument("--window", type=float, default=0.3)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    args.out.mkdir(parents=True)
    data = [
        {"file": str(f), "time": "t", "command": "tau", "position": "q", "role": "holdout" if k % 3 == 2 else "fit"}
        for k, f in enumerate(sorted(SET.glob("C1_*.npz")))
    ]
    task = {
        "robot": {"model": str(SET / "double_pendulum_C1.urdf")}, "data": data, "rollout": {"window": args.window},
        "actuator": {"Joint1": {"kind": "torque"}, "Joint2": {"kind": "torque"}},
    }  # fmt: skip
    if args.job == "identify":
        task["baseline"] = {"effects": [{"effect": "link_inertia", "at": [name]} for name in ("Link1", "Link2")]}
    (args.out / "task.yaml").write_text(json.dumps(task))
    status = command_line([args.job, str(args.out / "task.yaml"), "--out", str(args.out / "run"), "--quiet"])
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(f"exit status {status}, {used.ru_utime + used.ru_stime:.0f} CPU s with imports")
    if args.job == "identify":
        _simulated(args.out, next(Path(d["file"]) for d in data if d["role"] == "holdout"))
    robot = fj.load_urdf(SET / "double_pendulum_C1.urdf")
    told = yaml.safe_load(next(SET.glob("ref_*.yml")).read_text())
    for k, (name, ten) in enumerate(zip(robot.link_names, np.asarray(robot.inertia), strict=True)):
        print(f"{name}: ixx about the joint by the file {ten[4]:.4f}, by ref_*.yml {told[f'I{k + 1}']:.4f} kg m2:"
              f" {told[f'I{k + 1}'] - ten[4]:+.4f}")  # fmt: skip


def _simulated(out: Path, file: Path) -> None:
    """What `simulate` makes of a recording kept out, beside the run's own prediction; its clock is that file's own."""
    own = ["--columns", "tau", "--out", str(out / "moved"), "--quiet"]
    command_line(["simulate", str(out / "run"), "--command", str(file), *own])
    moved, told = np.load(out / "moved" / "simulation.npz"), np.load(out / "run" / "predictions.npz")
    apart = np.abs(moved["reading"] - told[f"{file.stem}_position"]).max()
    print(f"{file.name}: at most {1e3 * apart:.2g} mrad from the run's prediction")


if __name__ == "__main__":
    main()
