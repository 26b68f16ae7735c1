"""The rigid body's derivatives in closed form against Pinocchio's, on a tree of turning and sliding joints."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import robots

from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid.slopes import slopes, within_reach

LIMIT = '<limit lower="-3" upper="3" effort="9" velocity="9"/>'
BRANCHES = robots.robot(
    *robots.LINKS,
    robots.joint("turn", "base", "a", axis="1 2 -1", more=LIMIT),
    robots.joint("slide", "a", "b", "prismatic", "0 3 4", more=LIMIT),
    robots.joint("other", "a", "c", axis="0 1 0", more=LIMIT),
    robots.joint("last", "c", "d", axis="1 0 0", more=LIMIT),
)


def test_torques_and_their_derivatives_are_pinocchios(tmp_path: Path) -> None:
    file = tmp_path / "robot.urdf"
    file.write_text(BRANCHES)
    robot, peer = load_urdf(file), pin.buildModelFromXML(BRANCHES)
    assert within_reach(robot)
    place = [robot.dof_names.index(name) for name in list(peer.names)[1:]]
    rng, data = np.random.default_rng(3), peer.createData()
    q, v = rng.normal(size=(2, robot.nv, 4))
    a = rng.normal(size=(3, robot.nv, 4))
    with jax.enable_x64(True):
        found = jax.tree.map(np.asarray, eqx.filter_jit(slopes)(robot, *map(jnp.asarray, (q, v, a))))
    for k in range(4):
        for m in range(3):
            by_q, by_v, mass = pin.computeRNEADerivatives(peer, data, q[place, k], v[place, k], a[m][place, k])
            order = np.ix_(place, place)
            np.testing.assert_allclose(found.torque[m, place, k], data.tau, rtol=0, atol=1e-11)
            np.testing.assert_allclose(found.by_q[m, ..., k][order], by_q, rtol=0, atol=1e-11)
            np.testing.assert_allclose(found.by_v[..., k][order], by_v, rtol=0, atol=1e-11)
            mass = np.triu(mass) + np.triu(mass, 1).T
            np.testing.assert_allclose(found.mass[..., k][order], mass, rtol=0, atol=1e-11)
