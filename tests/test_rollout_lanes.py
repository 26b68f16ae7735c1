"""Rollouts written out for a GPU, on a CPU: one step in scalars, and the whole kernel interpreted."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from generators import servo_arm6

from figaroh_jax.rollouts import lanes, sensitivity
from figaroh_jax.rollouts.data import Run, Stretch, windows
from figaroh_jax.rollouts.fit import start_of
from figaroh_jax.rollouts.loop import Loop, State, advance, mobility
from figaroh_jax.rollouts.parameters import Entry, values
from figaroh_jax.rollouts.reading import load_loop

STEPS, SAMPLES = 3, 5
CHAIN = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<worldbody>{}</worldbody><actuator>{}</actuator></mujoco>"""


def chain(folder: Path, joints: int) -> Loop:
    """An arm on which everything acts that the kernel knows."""
    body, drives = "", ""
    for k in range(joints):
        axis = ("0 0 1", "0 1 0", "1 0 0")[k]
        body += (
            f'<body pos="0.02 0.01 {0.1 * (k > 0)}"><joint name="j{k}" axis="{axis}" armature="0.02" damping="0.2"'
            ' frictionloss="0.2"/><inertial pos="0.01 0.02 0.1" mass="1.0" diaginertia="0.01 0.008 0.004"/>'
        )
        drives += f'<position name="j{k}" joint="j{k}" kp="40" kv="0.7"/>'
    (folder / "chain.xml").write_text(CHAIN.format(body + "</body>" * joints, drives))
    loop, _ = load_loop(folder / "chain.xml")
    full = np.ones(joints)
    return eqx.tree_at(
        lambda m: (m.joints.load_ratio, m.joints.stribeck_force, m.joints.stribeck_speed, m.drives.voltage,
                   m.drives.dead_band, m.drives.delay),
        loop, (0.05 * full, 0.1 * full, 0.3 * full, 5.0 * full, 0.01 * full, 0.0033 * full),
    )  # fmt: skip


def test_steps_in_scalars_are_those_of_the_loop(tmp_path: Path):
    """Six joints with friction, some held and some slipping, from states at random: positions and rates to rounding."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text())
    loop, _ = load_loop(tmp_path / "arm.xml")
    program, given = lanes.program_of(loop, ())
    assert lanes.known_to_it(loop, ()) and not len(given)
    rng, once = np.random.default_rng(3), eqx.filter_jit(advance)
    with jax.enable_x64(True):
        q, v = jnp.asarray(rng.normal(0, 0.5, (6, SAMPLES))), jnp.asarray(rng.normal(0, 0.02, (6, SAMPLES)))
        u = q + jnp.asarray(rng.normal(0, 0.01, (STEPS, 6, SAMPLES)))
        state, weight, warm = State(q, v, jnp.zeros((6, SAMPLES))), mobility(loop), jnp.zeros_like(v)
        step = lanes.Step(program, lambda k: program.numbers.literal[k])
        mine, a, slip, held = (list(q), list(v)), list(warm), list(warm), 0
        for row in u:
            state, found = once(loop, state, row, weight, warm)
            warm = found.a
            a, whole, slip = step.solved(*mine, list(row), a, slip)
            rate = [x + program.dt * y for x, y in zip(mine[1], whole, strict=True)]
            mine = ([x + program.dt * y for x, y in zip(mine[0], rate, strict=True)], rate)
            held += int(sum((x == 0).sum() for x in slip))
            np.testing.assert_allclose(np.stack(mine[0]), state.q, atol=1e-13)
            np.testing.assert_allclose(np.stack(mine[1]), state.v, atol=1e-11)
    assert 0 < held < 6 * SAMPLES * STEPS


@pytest.mark.slow
@pytest.mark.parametrize("joints", [1, 2])
def test_the_interpreted_kernel_gives_the_sums_of_the_loop(tmp_path: Path, joints: int):
    """Every number that a table may free there, two windows: all to 1e-12."""
    loop = chain(tmp_path, joints)
    rng = np.random.default_rng(1)
    u = np.cumsum(rng.normal(0, 0.03, (40, joints)), 0)
    run = Run("run", 0.002 * np.arange(40), u, u + 0.01 * rng.normal(size=u.shape), None)
    data = windows(loop, [run], [Stretch(0, 0, 40), Stretch(0, 3, 37)], [np.full(joints, 1e-3)], 0.01)
    names = ("armature", "damping", "friction", "load_ratio", "stribeck_force", "stribeck_speed", "offset")
    table = tuple(Entry(x, (k,)) for x in (*names, "delay", "dead_band", "voltage", "kp") for k in range(joints))
    table = (*table, Entry("reading", (0,)))
    theta, free = values(loop, table), np.arange(len(table))
    start = start_of(data)
    at = np.maximum(free, 0)[None]
    found = sensitivity.by_kernel(loop, table, theta[None], at, data, start, interpret=True)
    wanted = sensitivity.linear_sums(loop, table, theta[None], at, data, start)
    for one, other in zip(found, wanted, strict=True):
        scale = np.abs(np.asarray(other)).max()
        np.testing.assert_allclose(np.asarray(one) / scale, np.asarray(other) / scale, atol=1e-12)
