"""The rows of a motion and the gradient of any function of them, on the host, by programs that serve any motion.

A motion goes through in chunks of fixed size, so that one program of a robot serves all lengths, bases, objectives and
limits. All that a design asks for (information, prediction, torque) is a function of the rows: its gradient by them
goes back through the closed form of `regressor_pullback`, and that of the effects' columns through JAX.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiled.batching import program
from ..effects.base import Effect, Motion, columns
from ..rigid.dynamics import inverse_dynamics
from ..rigid.model import RobotModel
from ..rigid.regressor import dense_rows
from ..rigid.regressor_gradient import pullback_rows

__all__ = ["CHUNK", "Sampler", "smooth_motion", "term_blocks"]

CHUNK = 64  # samples: the temporaries of a chunk stay in the processor's cache


class _SmoothMotion(Motion):
    """Instants of a motion; dry friction reverses as tanh(v / width), which has a gradient at every speed."""

    @property
    def direction(self) -> Float[Array, "samples nv"]:
        return jnp.tanh(self.velocity / (self.width + 1e-9))

    def reversal(
        self, velocity: Float[Array, " samples"], acceleration: Float[Array, " samples"], width: Float[Array, ""]
    ) -> Float[Array, " samples"]:
        return jnp.tanh(velocity / (width + 1e-9))


def smooth_motion(robot: RobotModel, width: Any, load: Any, q: Any, v: Any, a: Any) -> Motion:
    """Instants as effects read them, with the torque `load` of the rigid body (N m or N)."""
    return _SmoothMotion(robot, jnp.zeros(q.shape[0]), q, v, a, load, load, 0.0, width)


def term_blocks(
    robot: RobotModel,
    terms: Sequence[Effect],
    width: Float[Array, " nv"],
    q: Float[Array, "samples nv"],
    v: Float[Array, "samples nv"],
    a: Float[Array, "samples nv"],
) -> list[Float[Array, "samples nv columns"]]:
    """Columns of each effect (a leading axis of its places), in the rows of all joints; to be traced."""
    q, v, a = (jnp.asarray(x) for x in (q, v, a))
    follows = any(type(term).follows_torque for term in terms)
    load = inverse_dynamics(robot, q, v, a) if follows else jnp.zeros_like(v)
    motion = smooth_motion(robot, jnp.asarray(width), load, q, v, a)
    blocks = []
    for term in terms:
        one = jax.vmap(lambda effect: _in_all_rows(effect, motion))(jax.tree.map(jnp.asarray, term))
        blocks.append(jnp.moveaxis(one, 0, 2).reshape(*one.shape[1:3], -1))
    return blocks


def _in_all_rows(effect: Effect, motion: Any) -> Float[Array, "samples nv amplitudes"]:
    torque = jnp.moveaxis(columns(effect, motion), 0, -1)
    if effect.acts_on in ("link", "robot"):
        return torque
    torque = torque.reshape(torque.shape[0], -1, torque.shape[-1])
    return jnp.zeros((*motion.velocity.shape, torque.shape[-1])).at[:, effect.at].add(torque)


def _beside(robot: RobotModel, terms: Any, width: Any, states: Float[Array, "3 nv n"]) -> Float[Array, "nv k n"]:
    q, v, a = (x.T for x in states)
    return jnp.moveaxis(jnp.concatenate(term_blocks(robot, terms, width, q, v, a), axis=2), 0, 2)


def _rows(robot: RobotModel, states: Float[Array, "3 nv n"]) -> Float[Array, "nv columns n"]:
    return dense_rows(robot, states[0], states[1], states[2])


def _back(robot: RobotModel, states: Float[Array, "3 nv n"], cotangent: Array) -> Float[Array, "3 nv n"]:
    return pullback_rows(robot, states[0], states[1], states[2], cotangent)


def _beside_back(robot: RobotModel, terms: Any, width: Any, states: Array, cotangent: Array) -> Array:
    return jax.vjp(lambda x: _beside(robot, terms, width, x), states)[1](cotangent)[0]


_rows_program, _back_program = program(_rows), program(_back)
_beside_program, _beside_back_program = program(_beside), program(_beside_back)


class Sampler:
    """Rows of all columns (links, then effects) at states, and the gradient by the states."""

    def __init__(self, robot: RobotModel, terms: Sequence[Effect], width: Float[np.ndarray, " nv"]) -> None:
        with jax.enable_x64(True):
            self.robot, self.terms, self.width = jax.device_put((robot, tuple(terms), np.asarray(width, float)))
        self.own = 10 * len(robot.joints)

    def rows(self, states: Float[np.ndarray, "3 samples nv"]) -> Float[np.ndarray, "nv columns samples"]:
        """The rows at q, v, a (rad or m, and their rates); N m or N for a unit of each parameter."""
        parts = []
        with jax.enable_x64(True):
            for x in _cut(states):
                part = [np.asarray(_rows_program(self.robot, x))]
                if self.terms:
                    part.append(np.asarray(_beside_program(self.robot, self.terms, self.width, x)))
                parts.append(np.concatenate(part, axis=1))
        return np.concatenate(parts, axis=2)[:, :, : states.shape[1]]

    def torque(
        self, states: Float[np.ndarray, "3 samples nv"], theta: Float[np.ndarray, " columns"]
    ) -> Float[np.ndarray, "samples nv"]:
        """Torques (N m or N) of the parameters `theta` of the first columns."""
        most, parts = 16 * CHUNK, []  # pieces, so that the rows of a second at 1 kHz are all that is held
        for k in range(0, states.shape[1], most):
            parts.append((theta @ self.rows(states[:, k : k + most])[:, : len(theta)]).T)
        return np.concatenate(parts)

    def back(
        self, states: Float[np.ndarray, "3 samples nv"], cotangent: Float[np.ndarray, "nv columns samples"]
    ) -> Float[np.ndarray, "3 samples nv"]:
        """Gradient by q, v and a of a function whose gradient by the rows is `cotangent`."""
        samples = states.shape[1]
        padded = np.pad(cotangent, ((0, 0), (0, 0), (0, -samples % CHUNK)))
        out = np.empty((3, padded.shape[2], states.shape[2]))
        with jax.enable_x64(True):
            for k, x in enumerate(_cut(states)):
                where = slice(k * CHUNK, (k + 1) * CHUNK)
                one = np.asarray(_back_program(self.robot, x, padded[:, : self.own, where]))
                if self.terms:
                    beside = padded[:, self.own :, where]
                    one = one + np.asarray(_beside_back_program(self.robot, self.terms, self.width, x, beside))
                out[:, where] = one.swapaxes(1, 2)
        return out[:, :samples]


def _cut(states: Float[np.ndarray, "3 samples nv"]) -> list[Float[np.ndarray, "3 nv chunk"]]:
    """Samples in chunks, last in each; the last one fills its chunk up."""
    missing = -states.shape[1] % CHUNK
    full = np.concatenate([states, np.repeat(states[:, -1:], missing, axis=1)], axis=1).swapaxes(1, 2)
    return [np.ascontiguousarray(full[:, :, k : k + CHUNK]) for k in range(0, full.shape[2], CHUNK)]
