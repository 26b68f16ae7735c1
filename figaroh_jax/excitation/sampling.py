"""The rows of a motion and the gradient of any function of them, on the host.

All that a design asks for (information, prediction, torque) is a function of the rows: its gradient by them goes back
through the reverse of their machine code, or without a C compiler through `rigid.regressor_gradient` in chunks of fixed
size, so that one program of a robot serves all lengths, bases, objectives and limits; that of the effects' columns goes
through JAX, but for the usual friction, whose columns and slopes are written out here.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..compiled.batching import aligned, program
from ..compiled.machine_code import FARTHEST, FEWEST, code_of_few
from ..effects.base import Effect, Motion, columns
from ..effects.friction import CoulombFriction, ViscousFriction
from ..effects.sensors import TorqueOffset
from ..effects.transmission import RotorInertia
from ..rigid.dynamics import inverse_dynamics
from ..rigid.model import RobotModel
from ..rigid.regressor import dense_rows
from ..rigid.regressor_gradient import pullback_rows
from ..rigid.scalar_forms import COLUMNS, straight

__all__ = ["CHUNK", "Sampler", "smooth_motion", "term_blocks"]

CHUNK = 64  # samples: the temporaries of a chunk stay in the processor's cache
_SHARP = 1e-9  # rad/s, so that a reversal without a width has a slope


def _viscous(q: np.ndarray, v: np.ndarray, a: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, int, Any]:
    return v, 1, 1.0


def _coulomb(q: np.ndarray, v: np.ndarray, a: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, int, Any]:
    sign = np.tanh(v / (width + _SHARP))
    return sign, 1, (1.0 - sign**2) / (width + _SHARP)


def _rotor(q: np.ndarray, v: np.ndarray, a: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, int, Any]:
    return a, 2, 1.0


def _offset(q: np.ndarray, v: np.ndarray, a: np.ndarray, width: np.ndarray) -> tuple[np.ndarray, int, Any]:
    return np.ones_like(v), 0, 0.0


# column of an effect on a joint, by which of q, v, a it changes, and how fast
_PLAIN = {ViscousFriction: _viscous, CoulombFriction: _coulomb, RotorInertia: _rotor, TorqueOffset: _offset}


class _SmoothMotion(Motion):
    """Instants of a motion; dry friction reverses as tanh(v / width), which has a gradient at every speed."""

    @property
    def direction(self) -> Float[Array, "samples nv"]:
        return jnp.tanh(self.velocity / (self.width + _SHARP))

    def reversal(
        self, velocity: Float[Array, " samples"], acceleration: Float[Array, " samples"], width: Float[Array, ""]
    ) -> Float[Array, " samples"]:
        return jnp.tanh(velocity / (width + _SHARP))


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


def _rows(robot: RobotModel, states: Float[Array, "3 nv n"]) -> Float[Array, "columns nv n"]:
    return dense_rows(robot, states[0], states[1], states[2]).swapaxes(0, 1)


def _back(robot: RobotModel, states: Float[Array, "3 nv n"], cotangent: Array) -> Float[Array, "3 nv n"]:
    return pullback_rows(robot, states[0], states[1], states[2], cotangent.swapaxes(0, 1))


def _beside(robot: RobotModel, terms: Any, width: Any, states: Float[Array, "3 nv n"]) -> Float[Array, "k nv n"]:
    q, v, a = (x.T for x in states)
    return jnp.moveaxis(jnp.concatenate(term_blocks(robot, terms, width, q, v, a), axis=2), 0, 2).swapaxes(0, 1)


def _beside_back(robot: RobotModel, terms: Any, width: Any, states: Array, cotangent: Array) -> Array:
    return jax.vjp(lambda x: _beside(robot, terms, width, x), states)[1](cotangent)[0]


_COLUMNS = straight(COLUMNS, lambda robot, q, v, a: _rows(robot, jnp.stack([q, v, a])))
_rows_program, _back_program = program(_rows), program(_back)
_beside_program, _beside_back_program = program(_beside), program(_beside_back)


class Sampler:
    """Rows of all columns (links, then effects) at states, and the gradient by the states."""

    def __init__(self, robot: RobotModel, terms: Sequence[Effect], width: Float[np.ndarray, " nv"]) -> None:
        self.robot, self.terms, self.width = robot, tuple(terms), np.asarray(width, float)
        self.own = 10 * len(robot.joints)
        self.plain: list[tuple[Any, int, int]] = []  # column of an effect on a joint, its place, the joint
        others: list[Effect] = []
        self.columns, other = self.own, []
        for term in terms:
            at = np.asarray(term.at)
            count = len(at) * len(term.amplitudes())
            where = range(self.columns, self.columns + count)
            if type(term) in _PLAIN:
                rows = zip(where, at[:, 0].tolist(), strict=True)
                self.plain += [(_PLAIN[type(term)], place, joint) for place, joint in rows]
            else:
                others.append(term)
                other += where
            self.columns += count
        self.other = np.array(other, int)
        self.codes: dict[bool, Any] = {}  # machine code of the links' rows and of their gradient
        with jax.enable_x64(True):
            self.on_device, self.others, self.widths = jax.device_put((robot, tuple(others), self.width))

    def _code(self, states: Float[np.ndarray, "3 samples nv"], back: bool) -> Any:
        """Machine code of the links' rows, or of their gradient; None where JAX has to serve."""
        if states.shape[1] < FEWEST or not np.abs(states[0]).max() < FARTHEST:
            return None
        if back not in self.codes:
            self.codes[back] = code_of_few(_COLUMNS, self.robot, (self.robot.nv,) * 3, back=back)
        return self.codes[back]

    def rows(
        self, states: Float[np.ndarray, "3 samples nv"], out: Float[np.ndarray, "columns nv samples"] | None = None
    ) -> Float[np.ndarray, "nv columns samples"]:
        """The rows at q, v, a (rad or m, and their rates); N m or N for a unit of each parameter.

        `out`: memory for them, of zeros or earlier rows of this sampler.
        """
        samples, nv = states.shape[1:]
        out = np.zeros((self.columns, nv, samples)) if out is None else out
        code = self._code(states, False)
        if code is not None:
            code(lambda shape, fill: out[: self.own], *states)
        with jax.enable_x64(True):
            for piece, x in () if code is not None and not len(self.other) else _cut(states):
                count = len(range(samples)[piece])
                if code is None:
                    out[: self.own, :, piece] = np.asarray(_rows_program(self.on_device, x))[:, :, :count]
                if len(self.other):
                    beside = _beside_program(self.on_device, self.others, self.widths, x)
                    out[self.other, :, piece] = np.asarray(beside)[:, :, :count]
        for column, place, joint in self.plain:
            out[place, joint] = column(*states[:, :, joint], self.width[joint])[0]
        return out.swapaxes(0, 1)

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
        by, samples = cotangent.swapaxes(0, 1), states.shape[1]
        out = np.zeros(states.shape)
        code = self._code(states, True)
        if code is not None:
            out += code(by[: self.own], *states).reshape(3, -1, samples).swapaxes(1, 2)
        with jax.enable_x64(True):
            for piece, x in () if code is not None and not len(self.other) else _cut(states):
                count = len(range(samples)[piece])
                if code is None:
                    one = np.asarray(_back_program(self.on_device, x, _filled(by[: self.own, :, piece])))
                    out[:, piece] += one[:, :, :count].swapaxes(1, 2)
                if len(self.other):
                    beside = _filled(by[self.other, :, piece])
                    one = np.asarray(_beside_back_program(self.on_device, self.others, self.widths, x, beside))
                    out[:, piece] += one[:, :, :count].swapaxes(1, 2)
        for column, place, joint in self.plain:
            _, which, slope = column(*states[:, :, joint], self.width[joint])
            out[which, :, joint] += slope * by[place, joint]
        return out


def _cut(states: Float[np.ndarray, "3 samples nv"]) -> Iterator[tuple[slice, Float[np.ndarray, "3 nv chunk"]]]:
    """Samples in chunks, last in each; the last one fills its chunk up."""
    for k in range(0, states.shape[1], CHUNK):
        some = states[:, k : k + CHUNK].swapaxes(1, 2)
        missing = CHUNK - some.shape[2]
        full = np.concatenate([some, np.repeat(some[:, :, -1:], missing, axis=2)], axis=2) if missing else some
        yield slice(k, k + CHUNK), np.ascontiguousarray(full)


def _filled(x: Float[np.ndarray, "columns nv samples"]) -> Float[np.ndarray, "columns nv chunk"]:
    """A chunk with zeros behind."""
    out = aligned((*x.shape[:2], CHUNK), None if x.shape[2] == CHUNK else 0.0)
    out[:, :, : x.shape[2]] = x
    return out
