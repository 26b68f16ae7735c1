"""How fast `mjx.inverse` itself is on a CPU, with and without XLA's fusion emitters, and how much more it computes.

    PYTHONPATH=.:backends python benchmarks/mjx_inverse.py [--robots NAME ...] [--samples N] [--rounds N]

MJX's own function, without this library's adapter: robots with a fixed root, constraints and contacts off, float64,
samples by `vmap`. `flops` is what the compiled program will do a sample (XLA's own count), which grows where a fusion
computes again what several of its outputs use; `kernels` are its fusions. Robots are found by FIGAROH_JAX_DATA.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import time
from pathlib import Path
from statistics import median
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import figaroh_jax as fj
from figaroh_jax.formats.mujoco_model import compiled

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp is not installed
    from mujoco import mjx

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
ROBOTS = {"UR10e": "ur10e_innopolis/ur10e.urdf", "TALOS": "talos_contact/talos_full_v2.urdf"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--samples", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=3)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{'robot':7}{'fusion emitters':17}{'compile s':>10}{'samples/s':>12}{'flops a sample':>16}{'kernels':>9}")
    for robot in options.robots:
        for emitters in (True, False):
            _row(robot, emitters, options.samples, options.rounds)


def _row(robot: str, emitters: bool, samples: int, rounds: int) -> None:
    c_model = compiled(fj.load_urdf(DATA / ROBOTS[robot])).model
    c_model.opt.disableflags |= 1  # mjDSBL_CONSTRAINT
    model = mjx.put_model(c_model)
    data = mjx.make_data(model)
    q, v, a = np.random.default_rng(0).uniform(-1.5, 1.5, (3, samples, model.nv))

    def torque(model: Any, q: Any, v: Any, a: Any) -> Any:
        return mjx.inverse(model, data.replace(qpos=q, qvel=v, qacc=a)).qfrc_inverse

    start = time.perf_counter()
    lowered = jax.jit(jax.vmap(torque, (None, 0, 0, 0))).lower(model, *(jnp.asarray(x) for x in (q, v, a)))
    program = lowered.compile({"xla_cpu_use_fusion_emitters": emitters})
    compile_s = time.perf_counter() - start
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        jax.block_until_ready(program(model, q, v, a))
        times.append(time.perf_counter() - start)
    flops = dict(program.cost_analysis() or {}).get("flops", float("nan")) / samples
    kernels = (program.as_text() or "").count(" fusion(")
    rate = samples / median(times)
    print(f"{robot:7}{'on' if emitters else 'off':17}{compile_s:10.1f}{rate:12.0f}{flops:16.0f}{kernels:9}", flush=True)


if __name__ == "__main__":
    main()
