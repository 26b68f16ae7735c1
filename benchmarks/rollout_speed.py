"""Speed of rollouts with exact derivatives: a fit against mujoco.sysid's, and many rollouts on an accelerator.

    python benchmarks/rollout_speed.py sysid [--rows N]       # one process, CPU: both fit 21 numbers to 4 recordings
    python benchmarks/rollout_speed.py gpu [--rollouts 1024]  # squares, gradients and normal matrix of as many

The arm is the Panda of data/panda_gaz2019 ($FIGAROH_JAX_DATA) with a position drive, damping, armature and friction
at each of seven joints: 21 numbers, known within a factor of 1.6. Recordings are MuJoCo C's, 2499 steps of 2 ms,
positions with .2 mrad and rates with 2 mrad/s of noise. On the accelerator the figure beside is one core of MuJoCo C
that takes as many rollouts again for each number (one-sided differences), timed on 20 of them.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import mujoco as engine
import numpy as np

from figaroh_jax.rollouts.data import Run, Stretch, windows
from figaroh_jax.rollouts.fit import fit, standard_errors, start_of
from figaroh_jax.rollouts.loop import Loop
from figaroh_jax.rollouts.parameters import Entry, Table
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.sensitivity import linear_sums

mujoco: Any = engine
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
KP, KV = (600.0, 600.0, 500.0, 400.0, 150.0, 120.0, 60.0), (30.0, 30.0, 25.0, 20.0, 7.0, 6.0, 3.0)
TRUTH = {
    "armature": (0.2, 0.2, 0.15, 0.15, 0.1, 0.1, 0.06),
    "damping": (1.5, 1.5, 1.0, 1.0, 0.5, 0.5, 0.3),
    "friction": (1.2, 1.2, 1.0, 0.9, 0.5, 0.4, 0.25),
}
WORDS = {"armature": "armature", "damping": "damping", "friction": "frictionloss"}
HOME = np.array([0.0, -0.4, 0.0, -2.0, 0.0, 1.7, 0.5])
DT, ROWS, NOISE = 0.002, 2499, (2e-4, 2e-3)


def arm(scale: float = 1.0) -> Any:
    """The Panda without its hand's fingers and meshes; its 21 numbers times `scale`."""
    text = (DATA / "panda_gaz2019" / "panda.urdf").read_text()
    text = re.sub(r"<(visual|collision)\b.*?</\1>", "", text, flags=re.DOTALL)
    text = re.sub(r'(<joint name="panda_finger_joint\d" type=)"prismatic"', r'\1"fixed"', text)
    spec = mujoco.MjSpec.from_string(text)
    spec.option.timestep, spec.option.integrator = DT, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_CONTACT
    for k, joint in enumerate(spec.joints):
        for name in TRUTH:
            set_number(joint, name, scale * TRUTH[name][k])
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        drive = spec.add_actuator(name=f"drive{k}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint.name)
        drive.gaintype, drive.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        drive.gainprm[0], drive.biasprm[1], drive.biasprm[2] = KP[k], -KP[k], -KV[k]
    for kind, label in ((mujoco.mjtSensor.mjSENS_JOINTPOS, "p"), (mujoco.mjtSensor.mjSENS_JOINTVEL, "v")):
        for k, joint in enumerate(spec.joints):
            spec.add_sensor(name=f"{label}{k}", type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=joint.name)
    return spec


def set_number(joint: Any, name: str, value: float) -> None:
    """Of a joint of a spec; damping is a polynomial of three there."""
    setattr(joint, WORDS[name], [value, 0.0, 0.0] if name == "damping" else value)


def command(seed: int, rows: int) -> np.ndarray:
    """Sums of sines and steps about the home posture, (rows, 7) rad."""
    rng = np.random.default_rng([seed, 11])
    t = DT * np.arange(rows)[:, None]
    waves = sum(
        0.15 * np.sin(2 * np.pi * rng.uniform(0.15, 0.8, 7) * t + rng.uniform(0, 6, 7)) - 0.05 * (k == 0)
        for k in range(3)
    )
    steps = np.repeat(rng.uniform(-0.08, 0.08, (rows // 250 + 1, 7)), 250, 0)[:rows]
    return HOME + (waves + steps) * np.clip(t / 0.5, 0, 1)


def record(model: Any, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions and rates at the instants at which the rows of the command are written, (rows, 7) each."""
    data = mujoco.MjData(model)
    data.qpos[:] = u[0]
    q, v = np.zeros_like(u), np.zeros_like(u)
    for k, row in enumerate(u):
        q[k], v[k], data.ctrl[:] = data.qpos, data.qvel, row
        mujoco.mj_step(model, data)
    return q, v


def loop_of(spec: Any, folder: Path) -> Loop:
    file = folder / "panda.xml"
    spec.compile()
    file.write_text(spec.to_xml())
    return load_loop(file)[0]


def table_of(loop: Loop) -> Table:
    return tuple(Entry(name, (k,)) for name in TRUTH for k in range(loop.robot.nv))


def sysid(rows: int, folder: Path) -> None:
    """Both fits, each cold and warm; the same recordings, start and bounds."""
    model, truth = arm().compile(), np.concatenate([TRUTH[name] for name in TRUTH])
    rng, seen = np.random.default_rng(5), []
    for k in range(4):
        u = command(k, rows)
        q, v = record(model, u)
        seen.append((u, q + NOISE[0] * rng.normal(size=q.shape), v + NOISE[1] * rng.normal(size=v.shape)))
    loop = loop_of(arm(1.6), folder)
    runs = [Run(f"run {k}", DT * np.arange(rows), u, q, v) for k, (u, q, v) in enumerate(seen)]
    table = table_of(loop)

    def ours() -> tuple[np.ndarray, np.ndarray]:
        noise = [np.full(7, NOISE[0]), np.full(7, NOISE[1])]
        data = windows(loop, runs, [Stretch(k, 0, rows) for k in range(4)], noise, 0.3)
        found = fit(loop, table, data, 1.6 * truth[None], [list(range(21))], width=21, lanes=1)[0]
        return found.theta, standard_errors(found, data)

    for label in ("cold", "warm", "warm"):
        (theta, errors), wall, spent = _timed(ours)
        inside = int((np.abs(theta - truth) <= 1.96 * errors).sum())
        print(
            f"figaroh-jax {label}: {wall:.2f} s, {spent:.2f} CPU s; median error {_wrong(theta, truth)}, {inside} of 21"
            f" in their 95 % intervals, peak {_peak()}",
            flush=True,
        )
    for _ in range(2):
        theta, wall, spent = _timed(lambda: _peer(rows, seen))
        print(
            f"mujoco.sysid: {wall:.2f} s, {spent:.2f} CPU s; median error {_wrong(theta, truth)}, peak {_peak()}",
            flush=True,
        )


def _peer(rows: int, seen: list[tuple[np.ndarray, ...]]) -> np.ndarray:
    """The fit of mujoco.sysid: its sensors hold positions, then rates, each divided by its noise."""
    from mujoco import sysid as peer

    spec, params = arm(), peer.ParameterDict()
    for name in TRUTH:
        for k in range(7):

            def put_one(s: Any, p: Any, joint: str = f"panda_joint{k + 1}", name: str = name) -> None:
                set_number(s.joint(joint), name, p.value[0])

            value = TRUTH[name][k]
            params.add(peer.Parameter(f"{name}{k}", value, 1e-6, 50.0, modifier=put_one))
            params[f"{name}{k}"].value[:] = 1.6 * value
    model, parts = spec.compile(), []
    for number, (u, q, v) in enumerate(seen):
        data = mujoco.MjData(model)
        data.qpos[:] = u[0]
        begin = peer.create_initial_state(model, data.qpos, data.qvel, data.act)
        time = DT * np.arange(rows)
        # the sensors of a step are read at its beginning: row k of a rollout is the state before step k, stamped after
        readings = peer.TimeSeries.from_names(time[1:], np.concatenate([q, v], 1)[:-1], model)
        parts.append(
            peer.ModelSequences(f"run{number}", arm(), f"run{number}", begin, peer.TimeSeries(time, u), readings)
        )
    residual = peer.build_residual_fn(models_sequences=parts)
    found, _ = peer.optimize(initial_params=params, residual_fn=residual, optimizer="mujoco", verbose=False)
    return found.as_vector()


def gpu(count: int, rows: int, folder: Path) -> None:
    """Squares, gradient and normal matrix of many rollouts by 21 numbers and by their starts, in one program."""
    model, spec = arm().compile(), arm(1.1)
    distinct = [record(model, command(k, rows)) for k in range(8)]
    core = _core_seconds(model, rows)
    loop = loop_of(spec, folder)
    runs = [
        Run(f"run {k}", DT * np.arange(rows), command(k, rows), *_noisy(distinct[k % 8], k))
        for k in range(min(count, 64))
    ]
    cut = [Stretch(k % len(runs), 0, rows) for k in range(count)]
    data = windows(loop, runs, cut, [np.full(7, x) for x in NOISE], 0.1)
    theta = 1.1 * np.concatenate([TRUTH[name] for name in TRUTH])
    device = jax.devices()[0].device_kind
    print(f"jax {jax.__version__}, {device}; MuJoCo C: {1e3 * core:.2f} ms a rollout of {rows} steps", flush=True)
    with jax.enable_x64(True):
        held = jax.device_put(data)
        given = jax.device_put((theta[None], np.arange(21)[None], start_of(data)))

        def call() -> Any:
            found = linear_sums(loop, table_of(loop), given[0], given[1], held, given[2])
            return jax.block_until_ready(found)

        first = _timed(call)[1]
        print(f"first call: {first:.1f} s", flush=True)
        best = min(_timed(call)[1] for _ in range(3))
    memory = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0) / 1e9
    peer = count * 22 * core
    print(
        f"{count} rollouts of {rows} steps with gradients: {best:.3f} s; one core of MuJoCo C, differences: {peer:.1f}"
        f" s, {peer / best:.0f}x; device memory {memory:.1f} GB",
        flush=True,
    )


def _core_seconds(model: Any, rows: int) -> float:
    """Seconds of one rollout of MuJoCo C in one thread, no Python between its steps."""
    from mujoco import rollout

    data, u = mujoco.MjData(model), np.stack([command(k, rows) for k in range(20)])
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
    begin = np.zeros((20, mujoco.mj_stateSize(model, full)))
    begin[:, 1:8] = u[:, 0]
    rollout.rollout(model, data, begin[:2], u[:2])
    start = time.perf_counter()
    rollout.rollout(model, data, begin, u)
    return (time.perf_counter() - start) / 20


def _noisy(seen: tuple[np.ndarray, np.ndarray], seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q, v = (x + s * rng.normal(size=x.shape) for x, s in zip(seen, NOISE, strict=True))
    return q, v


def _timed(call: Callable[[], Any]) -> tuple[Any, float, float]:
    wall, spent = time.perf_counter(), _spent()
    found = call()
    return found, time.perf_counter() - wall, _spent() - spent


def _spent() -> float:
    """CPU seconds so far, the C compiler's included."""
    mine, others = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return mine.ru_utime + mine.ru_stime + others.ru_utime + others.ru_stime


def _wrong(theta: np.ndarray, truth: np.ndarray) -> str:
    return (
        f"{100 * np.median(np.abs(theta / truth - 1)):.2f} %, largest {100 * np.max(np.abs(theta / truth - 1)):.2f} %"
    )


def _peak() -> str:
    return f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6:.1f} GB"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["sysid", "gpu"])
    parser.add_argument("--rows", type=int, default=ROWS)
    parser.add_argument("--rollouts", type=int, default=1024)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()), help="for the arm's MJCF")
    args = parser.parse_args()
    if args.what == "sysid":
        sysid(args.rows, args.folder)
    else:
        gpu(args.rollouts, args.rows, args.folder)


if __name__ == "__main__":
    main()
