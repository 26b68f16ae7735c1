"""A measuring device of your own: a function of a few lines, and `calibrate` takes it like one of its own.

A draw-wire encoder stands beside the robot, its wire hooked to the tool: it reads how far the hook is from the eyelet
that the wire comes out of, plus what its counter said at the start. Neither place is known. Here three of them watch
an arm whose joints are zeroed wrongly, in simulated postures with noise.
Run `python examples/own_device.py`; it takes about a quarter of a minute.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import figaroh_jax as fj


# the device: predicted minus measured, m
def draw_wire(pose: jax.Array, unknown: jax.Array, reading: jax.Array) -> jax.Array:
    eyelets, hook, zeros = unknown[:9].reshape(3, 3), unknown[9:12], unknown[12:]
    return jnp.linalg.norm(pose[:3, :3] @ hook + pose[:3, 3] - eyelets, axis=1) + zeros - reading


OFFSET = {"shoulder": 0.012, "elbow": -0.02}  # rad
EYELETS = np.array([[1.5, 0.2, 0.1], [-0.3, 1.4, 0.2], [0.2, -1.2, 1.5]])
HOOK, ZEROS = np.array([0.02, 0.01, 0.06]), np.array([0.3, 0.31, 0.28])


def main() -> None:
    """Make postures and readings, calibrate, print what was found."""
    robot = fj.load_urdf(fj.DEMO)
    rng = np.random.default_rng(1)
    q = rng.uniform(-1.5, 1.5, (60, robot.nv))
    error = np.array([OFFSET.get(name, 0.0) for name in robot.joint_names])
    tool = np.asarray(fj.frame_placement(robot, q + error, robot.link_names[-1]))
    length = np.linalg.norm((tool[:, :3, :3] @ HOOK + tool[:, :3, 3])[:, None] - EYELETS, axis=2)
    reading = length + ZEROS + 5e-5 * rng.standard_normal(length.shape)
    guess = np.round(np.concatenate([EYELETS.ravel(), HOOK, ZEROS]), 1)  # with a tape measure
    names = [f"{what} {axis}" for what in ("eyelet 1", "eyelet 2", "eyelet 3", "hook") for axis in "xyz"]
    names += [f"zero {k}" for k in (1, 2, 3)]
    device = fj.own_device(draw_wire, {n: (g, "m", 0.05) for n, g in zip(names, guess, strict=True)}, (0, 0, 0))
    hand = robot.link_names[-1]
    seen = fj.postures(q=q, device=device, measured=reading, base_frame="base", tool_frame=hand, name="wire")
    found = fj.calibrate(robot, [seen])
    assert found.position is not None
    print(f"{found.verdict}: {found.position.validated_before:.2f} -> {found.position.validated_after:.2f} mm")
    for cause in found.causes:
        values = ", ".join(f"{key} {e.value:.4f} +- {e.std:.4f} {e.unit}" for key, e in cause.parameters.items())
        print(f"{cause.name}: {values}")


if __name__ == "__main__":
    main()
