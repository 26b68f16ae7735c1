"""The SO-101 as a newcomer asks it: a task file of its recordings, the command line, the exported model in MuJoCo C.

    python benchmarks/so101_command_line.py diagnose|identify [--model so101.xml|so101.urdf] --out DIR

The motions are cut as `rollouts.py` cuts them; `velocity_ramp` and `slow_precision` are kept out. Gains and damping are
fitted, friction (and rotors, of the MJCF) by default. It prints what the command prints, CPU seconds, and how far
MuJoCo C, by its own options and by those of the set's file, is from our own motion of the exported `robot.xml`.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import figaroh_jax as fj
from figaroh_jax.cli import main as command_line

sys.path.insert(0, str(Path(__file__).resolve().parent))
from rollouts import DATA, PERIOD, SO101, TEST, TRAIN, so101_runs  # noqa: E402

KEPT_OUT = ("velocity_ramp", "slow_precision")
MADE: Any = mujoco


def task(folder: Path, model: str) -> Path:
    """Recordings and task file of the whole set."""
    data, of = [], dict(TRAIN) | {name: TEST[name] for name in KEPT_OUT}
    for run in so101_runs(of):
        name = run.name.replace(" ", "_")
        np.savez(folder / f"{name}.npz", t=run.time, u=run.command, q=run.position)
        role = "holdout" if name in KEPT_OUT else "fit"
        data.append({"file": f"{name}.npz", "time": "t", "command": "u", "position": "q", "role": role})
    shutil.copy(DATA / "so101_sage" / model, folder / model)
    drive = {"kind": "position", "kp": 17.8, "kd": 0.6, "force": 3.35}
    effects = [{"effect": e, "at": [joint]} for e in ("joint_damping", "actuator_gain") for joint in SO101]
    content = {
        "robot": {"model": model}, "data": data, "baseline": {"effects": effects},
        "actuator": {"gains": "free"} | dict.fromkeys(SO101, drive),
    }  # fmt: skip
    (folder / "task.yaml").write_text(json.dumps(content))
    return folder / "task.yaml"


def replayed(file: Path, command: np.ndarray, start: np.ndarray, options: tuple[int, int]) -> np.ndarray:
    model = MADE.MjModel.from_xml_path(str(file))
    model.opt.iterations, model.opt.ls_iterations = options
    model.opt.disableflags |= int(MADE.mjtDisableBit.mjDSBL_CONTACT)
    data, found = MADE.MjData(model), np.zeros_like(command)
    data.qpos[:] = start
    for k, row in enumerate(command):
        found[k], data.ctrl[:] = data.qpos, row
        MADE.mj_step(model, data)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", choices=["diagnose", "identify"])
    parser.add_argument("--model", choices=["so101.xml", "so101.urdf"], default="so101.xml")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    args.out.mkdir(parents=True)
    file = task(args.out, args.model)
    status = command_line([args.job, str(file), "--out", str(args.out / "run"), "--verbose", "--quiet"])
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(f"exit status {status}, {used.ru_utime + used.ru_stime:.0f} CPU s with imports")
    out = args.out / "run" / "model" / "robot.xml"
    hard = "hard" if args.model.endswith("urdf") else None
    loop, _ = fj.load_loop(out, law=hard)
    (run,) = so101_runs({"multisine": TRAIN["multisine"]})
    u = np.repeat(run.command, round(PERIOD / float(loop.dt)), 0)[:20000]
    ours = np.asarray(fj.rollout(loop, u, run.position[0]).reading)
    for options in ((100, 50), (10, 20)):
        away = np.abs(replayed(out, u, run.position[0], options) - ours).max()
        print(
            f"MuJoCo C, {options[0]} iterations and {options[1]} of the line search: {1e3 * away:.3g} mrad off at most"
        )


if __name__ == "__main__":
    main()
