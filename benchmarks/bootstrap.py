"""Bootstrap of the TX40's identification: one call of `jax.vmap` over all resamples beside a loop of single calls.

    python benchmarks/bootstrap.py [resamples]           # plain python, a minute; recordings from $FIGAROH_JAX_DATA

Base parameters with friction, rotors, offsets and the coupled wrist; blocks of half a second are drawn with
replacement. With a GPU in JAX's list of devices the call runs there too. Prints seconds (compilation apart), their
ratio, and how far the bootstrap's standard deviations lie from those of white residuals.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests"), str(ROOT / "benchmarks")]
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its threads cost more than they gain on matrices of this size

import jax  # noqa: E402
import numpy as np  # noqa: E402

import figaroh_jax as fj  # noqa: E402


def problem(folder: Path) -> tuple[fj.ExtendedModel, fj.TorqueData]:
    """Robot with the effects that its task's baseline asks for, and its recording."""
    import calibration
    import real_tasks

    task = fj.load_task(real_tasks.tx40_task(folder, calibration.DATA, gated=False))
    robot = fj.load_robot(task)
    names = ("viscous_friction", "coulomb_friction", "rotor_inertia", "torque_offset")
    effects = [fj.place(fj.CATALOGUE[name], robot, [joint]) for name in names for joint in robot.joint_names]
    coupled = fj.place(fj.CATALOGUE["coupled_transmission"], robot, robot.joint_names[4:])
    model = fj.extend(robot, *effects, coupled)
    return model, fj.torque_data(model, fj.read_recordings(task, robot), task.preprocess)


def main(resamples: int = 1000) -> None:
    """Time both ways on every kind of device there is."""
    jax.config.update("jax_enable_x64", True)
    with tempfile.TemporaryDirectory() as folder:
        model, data = problem(Path(folder))
    basis = fj.linear_basis(model, data)
    blocks = -(-data.torque.shape[1] // data.together)
    drawn = np.random.default_rng(0).multinomial(blocks, np.full(blocks, 1 / blocks), size=resamples).astype(float)
    lower, upper = fj.linear_limits(model, basis)
    kinds = dict.fromkeys(["cpu", jax.default_backend()])
    for kind in kinds:
        with jax.default_device(jax.devices(kind)[0]):
            for name, limits in (("free", {}), ("bounded", {"lower": lower, "upper": upper})):

                def one(counts: jax.Array, limits: dict = limits) -> fj.LinearFit:
                    return fj.fit_linear(model, data, basis, counts=counts, **limits)

                single, many = jax.jit(one), jax.jit(jax.vmap(one))
                begin = time.perf_counter()
                found = jax.block_until_ready(many(drawn))
                cold = time.perf_counter() - begin
                begin = time.perf_counter()
                jax.block_until_ready(many(drawn))
                batch = time.perf_counter() - begin
                jax.block_until_ready(single(drawn[0]))
                begin = time.perf_counter()
                for counts in drawn[:20]:
                    jax.block_until_ready(single(counts))
                loop = (time.perf_counter() - begin) / 20 * resamples
                finite = np.isfinite(found.values).all(axis=1)
                spread = np.asarray(found.values)[finite].std(axis=0) / np.asarray(single(np.ones(blocks)).std)
                print(
                    f"{kind} {name}: {resamples} resamples of {len(basis.names)} base parameters, {blocks} blocks:"
                    f" one call {batch:.2f} s (first {cold:.1f} s), a loop {loop:.1f} s (from 20), {loop / batch:.0f}"
                    f" times; bootstrap over white sigma, median {np.median(spread):.2f}; {(~finite).sum()} not finite,"
                    f" {int((~np.asarray(found.converged)).sum())} without their limits",
                    flush=True,
                )


if __name__ == "__main__":
    main(*(int(x) for x in sys.argv[1:]))
