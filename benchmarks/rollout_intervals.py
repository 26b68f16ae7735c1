"""Whether the intervals of a rollout's numbers hold where recordings differ: an arm of six servos in MuJoCo C.

    python benchmarks/rollout_intervals.py --seeds 1 2 3 [--recordings 4 6 12] [--kind drawn drift warming]

Friction and damping of every joint are drawn anew for each recording (10 % of their mean), or change in the course of
each by a drawn slope (`drift`), or fall in the course of all of them alike (`warming`, 10 % in all); recordings are of
4 to 12 s. The arm is fitted with constant numbers, so each recording leaves more than noise. A line says in how many
of the 95 % intervals the mean over the population and over time lies, and how large the error is in standard errors.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from generators import servo_arm6

from figaroh_jax.rollouts.arm import alike_by_recording
from figaroh_jax.rollouts.data import Run, Stretch
from figaroh_jax.rollouts.gates import standing
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.setting import Structure, begun, setting

DIFFER = 0.1  # of the mean, one standard deviation


def record(kind: str, seed: int, number: int) -> Run:
    """One recording of an arm whose friction and damping are its own."""
    mujoco: Any = importlib.import_module("mujoco")  # its stubs name half of it
    rng = np.random.default_rng([seed, number, 31])
    own = 1 + DIFFER * rng.standard_normal((2, 6)) * (kind != "warming")
    slope = DIFFER * rng.standard_normal((2, 6)) * (kind == "drift") - 0.1 * (kind == "warming")
    model = mujoco.MjModel.from_xml_string(servo_arm6.model_text())
    data, u = mujoco.MjData(model), servo_arm6.command(seed, number)
    rows = round(rng.uniform(1 / 3, 1) * len(u)) // servo_arm6.EVERY * servo_arm6.EVERY
    u = np.repeat(u[:: servo_arm6.EVERY], servo_arm6.EVERY, 0)[:rows]
    data.qpos[:] = u[0]
    q = np.zeros_like(u)
    for k in range(rows):
        share = own + slope * (k / rows - 0.5) * 2
        model.dof_frictionloss[:], model.dof_damping[:] = np.array([servo_arm6.FRICTION, servo_arm6.DAMPING]) * share
        q[k] = data.qpos
        data.ctrl[:] = u[k]
        mujoco.mj_step(model, data)
    u, q = u[:: servo_arm6.EVERY], q[:: servo_arm6.EVERY]
    q = q + rng.normal(0, servo_arm6.NOISE, q.shape)
    return Run(f"run {number}", np.arange(len(q)) * servo_arm6.DT * servo_arm6.EVERY, u, q, None)


def errors(kind: str, seed: int, many: int) -> np.ndarray:
    """Error of friction and damping of every joint over its standard error (half of the 95 % interval over 1.96)."""
    with tempfile.NamedTemporaryFile("w", suffix=".xml") as file:
        file.write(servo_arm6.model_text(1.2))
        file.flush()
        loop, _ = load_loop(file.name)
    runs = [record(kind, seed, number) for number in range(many)]
    cut = [
        Stretch(k, f, min(400, len(r.time) - f)) for k, r in enumerate(runs) for f in range(0, len(r.time) - 50, 400)
    ]
    here = setting(loop, runs, baseline=("friction_loss", "joint_damping", "rotor_inertia"), stretches=cut)
    structure = Structure(here.loop, here.known.table, here.data)
    now = standing(here, structure, begun(here), here.baseline, held=False)
    now, spread = alike_by_recording(here, now)
    truth = {"friction": servo_arm6.FRICTION, "damping": servo_arm6.DAMPING, "armature": servo_arm6.ARMATURE}
    last, found = now.model.fit, []
    for column, entry in enumerate(last.free):
        if entry >= 0:
            one = structure.table[entry]
            found.append((last.theta[entry] - truth[one.name][one.at[0]]) / spread[column])
    return np.array(found)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs="+", type=int, required=True)
    parser.add_argument("--recordings", nargs="+", type=int, default=[4, 6, 12])
    parser.add_argument(
        "--kind", nargs="+", choices=["drawn", "drift", "warming"], default=["drawn", "drift", "warming"]
    )
    args = parser.parse_args()
    for kind in args.kind:
        for many in args.recordings:
            start, told = time.process_time(), []
            for seed in args.seeds:
                told.append(errors(kind, seed, many))
            z = np.array(told)
            inside = np.abs(z) < 1.96
            print(f"{kind:<8} {many:>2} recordings: {inside.sum()} of {inside.size} inside ({100 * inside.mean():.1f} "
                  f"%), RMS of the errors {np.sqrt(np.mean(z**2)):.2f} standard errors, "
                  f"{time.process_time() - start:.0f} CPU s", flush=True)  # fmt: skip
