"""A fleet of robots of one structure, each with its own lengths, masses and friction, identified in one program.

    PYTHONPATH=. python benchmarks/fleet.py [--robots N] [--samples N] [--at-once N] [--screen [EFFECT ...]]

Arms of six joints whose lengths, inertias and drives differ from one to the next. Each has a recording of its own,
made on the device with noise of 0.05 N m. `fit_states` under `jax.vmap` gives base parameters and standard deviations
of every robot, weighed by joint. Told are seconds of the first and of later calls, from arrays on the device and from
the host's, how the errors compare with the standard deviations, the population's mean and spread, and the differences
of the first robots from the same on the host's CPU.

`--screen` makes smooth motions instead, gives one robot in fifty a cause of its own by a formula of this file, and
screens the fleet for every single cause of the catalogue (or those told): which robots are flagged, with what.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from typing import Any

import equinox as eqx
import gpu_identification
import jax
import jax.numpy as jnp
import numpy as np

from figaroh_jax.diagnosis.fleet import screen_fleet
from figaroh_jax.estimation.accelerators import BatchFit, coordinates, fit_states
from figaroh_jax.estimation.base_parameters import BaseParameters
from figaroh_jax.rigid.dynamics import inverse_dynamics
from figaroh_jax.rigid.model import RobotModel

NOISE, DRIVE = gpu_identification.NOISE, gpu_identification.DRIVE
COMPARED = 4  # robots that the host fits too
AT_ONCE = 1.5e9  # bytes of the rows of the robots that are fitted at once


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=int, default=1000)
    parser.add_argument("--samples", type=int, default=10_000)
    parser.add_argument("--at-once", type=int, help="robots whose rows exist at once")
    parser.add_argument("--screen", nargs="*", metavar="EFFECT", help="screen for causes in place of identifying")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.screen is not None:
        _screen(options.robots, options.samples, options.screen or None)
        return
    rows = gpu_identification._Source(gpu_identification.MODELS["arm"]()).states
    base, into = rows.structural, jnp.asarray(coordinates(rows.structure, rows.structural).into)
    fleet, drives = _fleet(rows.model, options.robots)
    start = time.perf_counter()
    state = jax.block_until_ready(_recordings(fleet, jnp.asarray(drives), options.samples))
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}, float64; {options.robots} recordings of"
          f" {options.samples} samples made in {time.perf_counter() - start:.1f} s", flush=True)  # fmt: skip
    memory = jax.devices()[0].memory_stats() or {}
    print(f"peak of the device's memory until here: {memory.get('peak_bytes_in_use', 0) / 1e9:.2f} GB", flush=True)
    bytes_each = 8 * options.samples * rows.model.nv * (sum(into.shape) + 1)
    at_once = options.at_once or max(1, int(AT_ONCE / bytes_each))
    axes = _axes(rows.model)

    @partial(jax.jit, static_argnums=0)
    def identify(at_once: int, fleet: RobotModel, *state: Any) -> BatchFit:
        own, shared = eqx.partition(fleet, axes)

        def one(given: Any) -> BatchFit:
            return fit_states(eqx.combine(given[0], shared), rows.terms, into, *given[1])

        return jax.lax.map(one, (own, state), batch_size=at_once)

    host = [np.asarray(x) for x in state]
    found: Any = None
    for name, given in {"device": state, "host": host}.items():
        seconds = []
        for _ in range(3):
            start = time.perf_counter()
            found = jax.device_get(identify(at_once, fleet, *given))
            seconds.append(time.perf_counter() - start)
        rate = options.robots * options.samples / min(seconds[1:]) / 1e6
        print(
            f"from {name:6}: {min(seconds[1:]):.3f} s, first {seconds[0]:.1f} s; {rate:.2f} M samples/s,"
            f" {at_once} robots at once",
            flush=True,
        )
    _judge(found, base, drives)
    memory = jax.devices()[0].memory_stats() or {}
    print(f"peak of the device's memory: {memory.get('peak_bytes_in_use', 0) / 1e9:.2f} GB", flush=True)
    few = jax.tree.map(lambda x, yes: x[:COMPARED] if yes else x, jax.device_get(fleet), axes)
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        identify(1, few, *(x[:COMPARED] for x in host))
        start = time.perf_counter()
        cpu = jax.device_get(identify(1, few, *(x[:COMPARED] for x in host)))
        seconds = (time.perf_counter() - start) / COMPARED
    apart = np.abs(found.parameters[:COMPARED] - cpu.parameters).max() / np.abs(cpu.parameters).max()
    print(f"host's CPU: {seconds:.3f} s a robot; parameters differ by {apart:.1e} of the largest", flush=True)


DT, ONE_IN = 0.01, 50  # s; robots, of which one has a cause


def _screen(robots: int, samples: int, effects: list[str] | None) -> None:
    rows = gpu_identification._Source(gpu_identification.MODELS["arm"]()).states
    model, nv = rows.model, rows.model.nv
    fleet, drives = _fleet(model, robots)
    axes = jax.tree.map(lambda yes: 0 if yes else None, _axes(model))

    @jax.jit
    def recordings(key: Any) -> tuple[Any, ...]:
        keys = jax.random.split(key, 4)
        t, shape = jnp.arange(samples)[:, None] * DT, (robots, 4, 1, nv)
        rate, size, phase = (jax.random.uniform(k, shape) for k in keys[:3])
        rate, size, angle = 0.5 + 3 * rate, 0.1 + 0.5 * size, (0.5 + 3 * rate) * t + 6.3 * phase
        q, v, a = (size * jnp.sin(angle)).sum(1), (size * rate * jnp.cos(angle)).sum(1), None
        a = -(size * rate**2 * jnp.sin(angle)).sum(1)
        load = jax.vmap(inverse_dynamics, in_axes=(axes, 0, 0, 0))(fleet, q, v, a)
        viscous, coulomb, rotor, offset = (jnp.asarray(drives)[:, None, :, k] for k in range(4))
        drive = viscous * v + coulomb * jnp.sign(v) + rotor * a + offset
        return q, v, a, load, drive + NOISE * jax.random.normal(keys[3], q.shape)

    q, v, a, load, beside = (np.array(x) for x in recordings(jax.random.key(1)))
    tau, hidden = load + beside, {}
    for n, robot in enumerate(range(ONE_IN // 2, robots, ONE_IN)):
        joint = n % nv
        name = ("load_dependent_friction", "stribeck_friction", "torque_ripple", "joint_spring", "torque_delay")[n % 5]
        way, own = np.sign(v[robot, :, joint]), tau[robot, :, joint]
        if name == "load_dependent_friction":
            own += 0.1 * np.abs(load[robot, :, joint]) * way
        if name == "stribeck_friction":
            own += 0.4 * np.exp(-((v[robot, :, joint] / 0.1) ** 2)) * way
        if name == "torque_ripple":
            own += 0.2 * np.sin(20 * q[robot, :, joint])
        if name == "joint_spring":
            own += 0.5 * q[robot, :, joint]
        if name == "torque_delay":
            instants = np.arange(samples) * DT
            tau[robot] = np.stack([np.interp(instants - 0.004, instants, x) for x in tau[robot].T], axis=1)
        hidden[robot] = (name, () if name == "torque_delay" else (model.joint_names[joint],))
    parts = zip(np.asarray(fleet.placement), np.asarray(fleet.inertia), strict=True)
    each = [eqx.tree_at(lambda m: (m.placement, m.inertia), model, part) for part in parts]
    seconds, found = [], None
    for _ in range(2):
        start = time.perf_counter()
        found = screen_fleet(each, rows.terms, q, v, a, tau, DT, effects)
        seconds.append(time.perf_counter() - start)
    assert found is not None
    flags = {flag.robot: (flag.cause.effect, flag.cause.at) for flag in found.flagged()}
    right = sum(flags.get(robot) == cause for robot, cause in hidden.items())
    device = jax.devices()[0].device_kind
    print(
        f"jax {jax.__version__}, {device}, float64; {robots} robots of {samples} samples screened for"
        f" {len(found.causes)} causes in {seconds[1]:.2f} s, first {seconds[0]:.1f} s",
        flush=True,
    )
    print(f"{len(hidden)} robots have a cause: {len(flags.keys() & hidden.keys())} are flagged, {right} with it first;"
          f" {len(flags.keys() - hidden.keys())} others are flagged", flush=True)  # fmt: skip
    for robot, cause in hidden.items():
        if flags.get(robot) != cause:
            print(f"robot {robot} has {cause}, told {flags.get(robot)}", flush=True)


def _fleet(model: RobotModel, robots: int) -> tuple[RobotModel, np.ndarray]:
    """Robots as one model with a leading axis, and their drive parameters (robots, joints, 4)."""
    random = np.random.default_rng(0)
    placement = np.tile(model.placement, (robots, 1, 1, 1))
    placement[..., :3, 3] *= random.uniform(0.99, 1.01, (robots, model.nv, 1))
    inertia = np.asarray(model.inertia) * random.uniform(0.9, 1.1, (robots, model.nv, 1))
    drives = DRIVE * random.uniform(0.8, 1.2, (robots, model.nv, 4))
    fleet: Any = eqx.tree_at(lambda m: (m.placement, m.inertia), model, (placement, inertia))
    return jax.tree.map(jnp.asarray, fleet), drives


def _axes(model: RobotModel) -> Any:
    """True at the arrays that each robot has of its own."""
    none = jax.tree.map(lambda _: False, model)
    return eqx.tree_at(lambda m: (m.placement, m.inertia), none, (True, True))


@partial(jax.jit, static_argnums=2)
def _recordings(fleet: RobotModel, drives: Any, samples: int) -> tuple[Any, ...]:
    robots = len(drives)
    axes = jax.tree.map(lambda yes: 0 if yes else None, _axes(fleet))
    keys = jax.random.split(jax.random.key(0), 4)
    q, v, a = (jax.random.uniform(k, (robots, samples, drives.shape[1]), minval=-2.0, maxval=2.0) for k in keys[:3])
    rigid = jax.vmap(inverse_dynamics, in_axes=(axes, 0, 0, 0))(fleet, q, v, a)
    viscous, coulomb, rotor, offset = (drives[:, None, :, k] for k in range(4))
    noise = NOISE * jax.random.normal(keys[3], q.shape)
    return q, v, a, rigid + viscous * v + coulomb * jnp.sign(v) + rotor * a + offset + noise


def _judge(found: BatchFit, base: BaseParameters, drives: np.ndarray) -> None:
    """Errors in standard deviations, and what the robots have in common. The mean robot's lengths name the groups."""
    kept = base.independent
    values, std = found.parameters[:, kept], found.std[:, kept]
    print(
        f"{len(kept)} base parameters a robot; residual {found.rms.mean():.4f} N m for noise of {NOISE} N m", flush=True
    )
    # drives are base parameters as they are: from the end of the columns, a joint's four or a term's six
    ends = found.parameters[:, -4 * drives.shape[1] :].reshape(len(drives), 4, -1)
    sigma = found.std[:, -4 * drives.shape[1] :].reshape(ends.shape)
    for name, k in (("viscous friction", 0), ("Coulomb friction", 1)):
        score = (ends[:, k] - drives[..., k]) / sigma[:, k]
        spread = np.sqrt(np.maximum(ends[:, k].var(axis=0, ddof=1) - (sigma[:, k] ** 2).mean(axis=0), 0.0))
        print(f"{name}: errors {np.sqrt(np.mean(score**2)):.3f} standard deviations; the population's mean"
              f" {ends[:, k].mean():.4f} ({drives[..., k].mean():.4f}), spread {spread.mean():.4f}"
              f" ({drives[..., k].std(axis=0, ddof=1).mean():.4f})", flush=True)  # fmt: skip
    assert np.isfinite(values).all() and np.isfinite(std).all()


if __name__ == "__main__":
    main()
