"""What mujoco.sysid says of the recordings of `servo_cases.py` and `arm_cases.py` (needs `mujoco[sysid]`).

    python benchmarks/peer_rollouts.py servo --seeds 101 [--cases payload none]
    python benchmarks/peer_rollouts.py arm --seeds 1 [--cases payload none] [--size 0 1 2]

Armature, damping and frictionloss of every joint are fitted from 1.6 times their values, as there, up to 10 times. One
line a case: what its report says of the fit, and the largest error of a number.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import sys
import time
from pathlib import Path
from typing import Any

import mujoco as engine
import numpy as np
from mujoco import sysid as peer
from mujoco.sysid.report.sections.insights import AutomatedInsights

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from generators import servo_arm, servo_arm6

mujoco: Any = engine
WORDS = ("armature", "damping", "frictionloss")


def set_number(joint: Any, name: str, value: float) -> None:
    """Of a joint of a spec; damping is a polynomial of three there."""
    setattr(joint, name, [value, 0.0, 0.0] if name == "damping" else value)


def told(text: str, names: list[str], truth: np.ndarray, recordings: list[dict[str, np.ndarray]]) -> str:
    """The verdict on recordings of a model whose numbers (3, joints) are 1.6 times too large."""
    spec, params = mujoco.MjSpec.from_string(text), peer.ParameterDict()
    rates = "dq" in recordings[0]
    for kind, on in ((mujoco.mjtSensor.mjSENS_JOINTPOS, True), (mujoco.mjtSensor.mjSENS_JOINTVEL, rates)):
        for name in names if on else []:
            spec.add_sensor(name=f"{kind} {name}", type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=name)
    for word, row in zip(WORDS, truth, strict=True):
        for name, value in zip(names, row, strict=True):

            def put_one(s: Any, p: Any, joint: str = name, word: str = word) -> None:
                set_number(s.joint(joint), word, p.value[0])

            params.add(peer.Parameter(f"{word} {name}", value, 0.0, 10 * value, modifier=put_one))
            params[f"{word} {name}"].value[:] = 1.6 * value
    model, parts = spec.compile(), []
    for k, r in enumerate(recordings):
        data = mujoco.MjData(model)
        data.qpos[:] = r["q"][0]
        begin = peer.create_initial_state(model, data.qpos, data.qvel, data.act)
        dt = model.opt.timestep  # row k of a rollout is the state before step k, stamped after it
        read = np.concatenate([r[key] for key in ("q", "dq") if key in r], 1)
        seen = peer.TimeSeries.from_names(r["t"][:-1] + dt, read[:-1], model)
        every = round((r["t"][1] - r["t"][0]) / dt)  # steps that hold a row of the command
        held = peer.TimeSeries(dt * np.arange(every * len(r["t"])), np.repeat(r["u"], every, 0))
        parts.append(peer.ModelSequences(f"run{k}", spec.copy(), f"run{k}", begin, held, seen))
    residual = peer.build_residual_fn(models_sequences=parts)
    start = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        found, _ = peer.optimize(initial_params=params, residual_fn=residual, optimizer="mujoco", verbose=False)
    spent, answer = time.process_time() - start, found.as_vector()
    words = sorted({one["title"] for one in AutomatedInsights("", found)._insights})
    worst = int(np.abs(answer / truth.ravel() - 1).argmax())
    label = found.get_non_frozen_parameter_names()[worst]
    return f"{', '.join(words)}; {label} {100 * (answer[worst] / truth.ravel()[worst] - 1):+.0f} %, {spent:.1f} CPU s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["servo", "arm"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[101])
    parser.add_argument("--cases", nargs="+")
    parser.add_argument("--size", type=int, choices=[0, 1, 2], default=1)
    args = parser.parse_args()
    for seed in args.seeds:
        if args.what == "servo":
            truth = np.array([[0.05], [0.4], [0.3]])
            for case in args.cases or servo_arm.CASES:
                said = told(servo_arm.model_text(), ["joint"], truth, [servo_arm.record(case, seed)])
                print(f"seed {seed} {case}: {said}", flush=True)
            continue
        rng = np.random.default_rng([seed, 3])
        truth = np.array([servo_arm6.ARMATURE, servo_arm6.DAMPING, servo_arm6.FRICTION])
        for case in args.cases or ("none", *servo_arm6.EFFECTS):
            joint = 5 if case == "payload" else int(rng.integers(0, 4))
            hidden = [] if case == "none" else [(case, joint, servo_arm6.EFFECTS[case][args.size])]
            seen = [servo_arm6.record(hidden, seed, k) for k in range(2)]
            said = told(servo_arm6.model_text(), list(servo_arm6.NAMES), truth, seen)
            print(f"seed {seed} {'@'.join([case, servo_arm6.NAMES[joint]] if hidden else [case])}: {said}", flush=True)


if __name__ == "__main__":
    main()
