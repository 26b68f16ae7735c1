"""A simulator's compiled model calibrated through its own kinematics, without changing it, gives our parameters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import poses
import pytest

from figaroh_jax.compiled.batching import program
from figaroh_jax.estimation import posefit
from figaroh_jax.estimation.posesolver import solve
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.recordings.devices import Points
from figaroh_jax.rigid import lie
from figaroh_jax.rigid.chain import chain_between

BOTH = ("base_frame", "tool_frame")
JOINTS, COLUMNS = 6, 7


@pytest.mark.slow
def test_calibration_through_mjx_gives_the_same_parameters(tmp_path: Path):
    MjxBackend = pytest.importorskip("figaroh_jax_mjx").MjxBackend
    rng = np.random.default_rng(21)
    path = tmp_path / "robot.urdf"
    path.write_text(poses.urdf())
    model, q = load_urdf(path), poses.postures(rng, 16)
    real = poses.truth(rng, offset=np.array([0.0, 0.05, -0.08, 0.1, -0.04, 0.0]))
    real = real._replace(twists={"j3": np.array([0.0, 0.0, 2e-3, 4e-3, -2e-3, 0.0])})
    seen = poses.points(poses.tool_poses(path, q, real), real, rng)
    device = Points(real.base.homogeneous, seen.mean(axis=(0, 1)), BOTH, np.zeros((3, 3)))
    units = [(k, k + 1, np.eye(6)[5]) for k in range(4)]  # offsets of joints 2 to 5; geometry of joint 3
    units += [(4 + k, 2, np.eye(6)[axis]) for k, axis in enumerate((2, 3, 4))]
    pieces = [(k, joint, np.repeat(unit[:, None], len(q), axis=1)) for k, joint, unit in units]
    chain = chain_between(model, "base", "tool0")
    group = posefit.group_of(chain, device, q.T, COLUMNS, pieces, seen, np.ones((len(q), 9), bool))
    problem = posefit.Problem((group,), posefit.sizes([group], [1e-3] * COLUMNS), COLUMNS)
    count = len(problem.scale)
    ours = solve(problem, np.full(9 * len(q), 1e4), np.zeros(count), np.ones(count), np.zeros(count))
    assert ours.converged

    backend = MjxBackend.build(model)
    before = jax.tree.map(np.array, (backend.simulator.body_pos, backend.simulator.body_quat))
    bodies = np.array(backend.structure.translation.body)
    scale = jnp.asarray(problem.scale)

    def rows(unknowns: jax.Array) -> jax.Array:
        values = unknowns * scale
        twists = jnp.zeros((JOINTS, 6))
        for k, joint, unit in units:
            twists = twists.at[joint].add(values[k] * unit)
        simulator = backend.simulator
        turn, place = jax.vmap(rotation)(simulator.body_quat[bodies]), simulator.body_pos[bodies]
        place = place + jnp.einsum("jab,jb->ja", turn, twists[:, :3])
        turn = turn @ jax.vmap(lie.exp_so3)(twists[:, 3:])
        moved = simulator.replace(
            body_pos=simulator.body_pos.at[bodies].set(place),
            body_quat=simulator.body_quat.at[bodies].set(jax.vmap(quaternion)(turn)),
        )
        frames = replace(backend, model=moved).frame_placements(q)
        base, tool = (frames[:, model.frame_index(name)] for name in ("base", "tool0"))
        pose = jnp.linalg.inv(base) @ tool
        return jax.vmap(lambda pose, datum: device.residual(pose, values[COLUMNS:], datum))(pose, seen).reshape(-1)

    both = program(lambda y: (rows(y), jax.jacfwd(rows)(y)), cpu=posefit.DRAFT_OPTIONS)
    theirs = np.zeros(count)
    for _ in range(5):  # Gauss and Newton
        residual, jacobian = (np.asarray(x) for x in both(jnp.asarray(theirs)))
        theirs = theirs - np.linalg.lstsq(jacobian, residual, rcond=None)[0]
    np.testing.assert_allclose(ours.unknowns * problem.scale, theirs * problem.scale, rtol=0, atol=1e-6)
    np.testing.assert_allclose(ours.unknowns[:4] * 1e-3, real.offset[1:5], rtol=0, atol=1e-3)
    after = (backend.simulator.body_pos, backend.simulator.body_quat)
    jax.tree.map(np.testing.assert_array_equal, before, after)


def rotation(quaternion: jax.Array) -> jax.Array:
    """Matrix of a quaternion w, x, y, z."""
    w, v = quaternion[0], quaternion[1:]
    return jnp.eye(3) + 2.0 * (w * lie.skew(v) + lie.skew(v) @ lie.skew(v))


def quaternion(rotation: jax.Array) -> jax.Array:
    """Quaternion w, x, y, z of a rotation by less than half a turn."""
    half = lie.log_so3(rotation) / 2.0
    angle = jnp.sqrt(half @ half + 1e-300)
    return jnp.concatenate([jnp.cos(angle)[None], jnp.sinc(angle / jnp.pi) * half])
