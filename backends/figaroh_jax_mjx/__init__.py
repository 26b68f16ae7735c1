"""MJX, MuJoCo in JAX, behind the contract of figaroh_jax: compiled, vectorised and differentiable.

The backend is a pytree around an `mjx.Model`: its functions can be differentiated by that model's leaves
(`jax.grad` of its float leaves, `equinox.filter_grad` of all), mapped over them and compiled with them as arguments.
Only MJX's functions of rigid bodies are called (`kinematics`, `com_pos`, `com_vel`, `rne`, `crb`), with armature zero:
contacts, constraints, damping, springs and actuators never enter. The model, the translation of coordinates and what
is static about them come from `figaroh_jax.formats.mujoco_model`; robots with one tree share one static model, so a
changed mass compiles nothing.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from figaroh_jax.compiled.batching import sized_program
from figaroh_jax.errors import InputError
from figaroh_jax.formats.mujoco_model import (
    Compiled,
    Translation,
    compiled,
    drift,
    frame_poses,
    joint_poses,
    link_inertias,
    positions,
    rates,
    spatial_inertias,
)
from figaroh_jax.rigid.derivatives import TorqueDerivatives, coriolis_from_bias
from figaroh_jax.rigid.manifold import integrate
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.simulators.contract import Backend, Capabilities, Reference, as_reference, check_samples, file_format

with contextlib.redirect_stdout(io.StringIO()):  # it prints that Warp, which is not used here, is not installed
    from mujoco import mjx

__all__ = ["MjxBackend"]

_LEAVES = (  # of a model built from a robot's arrays, which differ between robots with one tree
    "body_pos body_quat body_mass body_subtreemass body_ipos body_iquat body_inertia jnt_axis".split()
)


@dataclass(frozen=True, eq=False)
class _Structure:
    """What is static: compared by identity, so the programs of backends that share it are shared too."""

    translation: Translation
    data: Any  # mjx.Data of the neutral state


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MjxBackend(Backend):
    """An `mjx.Model` (`model`, the `simulator`) with the robot's frames and limits (`description`)."""

    name: ClassVar[str] = "mjx"
    capabilities: ClassVar[Capabilities] = Capabilities(differentiable=True, batch="vectorised", gpu=True, contact=True)

    model: Any
    description: RobotModel
    structure: _Structure = field(metadata={"static": True})
    file_format: str = field(default="model", metadata={"static": True})

    @classmethod
    def build(cls, robot: RobotModel, source: Path | None = None) -> MjxBackend:
        """The backend of a robot; of the model compiled from `source` where that is MJCF.

        Raises `InputError` where MJX does not support something in the MJCF.
        """
        made = compiled(robot, source)
        with jax.enable_x64(True):
            if made.from_file:
                model, structure = _put(made)
            else:
                model, structure = _shared(robot, made)
        return cls(model, robot, structure, file_format(source))

    @property
    def robot(self) -> RobotModel:
        """The robot."""
        return self.description

    @property
    def simulator(self) -> Any:
        """The `mjx.Model`."""
        return self.model

    @property
    def model_format(self) -> str:
        """Format of the file that the robot was read from."""
        return self.file_format

    @property
    def inertias(self) -> Float[Array, "links 10"]:
        """Inertial parameters of the links in MJX's model."""
        with jax.enable_x64(True):
            return _own_inertias(self)

    def mass_matrix(self, q: Float[ArrayLike, "*batch nq"]) -> Float[Array, "*batch nv nv"]:
        """Composite bodies (`mjx.crb`)."""
        return self._each(_mass, q=q)

    def coriolis_matrix(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"]
    ) -> Float[Array, "*batch nv nv"]:
        """From differences of the quadratic bias torques of `mjx.rne`: exact, see `coriolis_from_bias`."""
        return self._each(_coriolis, q=q, v=v)

    def gravity_vector(self, q: Float[ArrayLike, "*batch nq"]) -> Float[Array, "*batch nv"]:
        """`mjx.rne` at rest."""
        rest = np.zeros((*np.shape(q)[:-1], self.nv))
        return self._each(_torque, q=q, v=rest, a=rest)

    def inverse_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[Array, "*batch nv"]:
        """`mjx.rne`."""
        return self._each(_torque, q=q, v=v, a=a)

    def forward_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], tau: Float[ArrayLike, "*batch nv"]
    ) -> Float[Array, "*batch nv"]:
        """Cholesky solve with the mass matrix of `mjx.crb`, as in the core."""
        return self._each(_acceleration, q=q, v=v, tau=tau)

    def frame_placements(self, q: Float[ArrayLike, "*batch nq"]) -> Float[Array, "*batch frames 4 4"]:
        """`mjx.kinematics`."""
        return self._each(_frames, q=q)

    def frame_jacobian(
        self, q: Float[ArrayLike, "*batch nq"], frame: str, reference: Reference = "local_world_aligned"
    ) -> Float[Array, "*batch 6 nv"]:
        """`mjx.jac` of the frame's origin, or of the world's."""
        index, axes = self.frame_id(frame), as_reference(reference)
        at = (np.int32(index), np.bool_(axes == "local"), np.bool_(axes == "world"))
        return self._each(_jacobian, *at, q=q)

    def joint_torque_regressor(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[Array, "*batch nv columns"]:
        """`mjx.rne` pulled back to the spatial inertias, in which it is linear, and from them to the ten parameters."""
        return self._each(_regressor, q=q, v=v, a=a)

    def dynamics_derivatives(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> TorqueDerivatives:
        """Forward derivatives of `mjx.rne`, and the mass matrix of `mjx.crb`."""
        return self._each(_derivatives, q=q, v=v, a=a)

    def _each(self, one: Callable[..., Any], *which: Any, **arrays: ArrayLike) -> Any:
        """`one((backend, *which), q, ...)` of every sample."""
        check_samples(self, **arrays)
        with jax.enable_x64(True):
            states = [jnp.asarray(array, jnp.float64) for array in arrays.values()]
            return _mapped(one, (self, *which) if which else self, *states)


def _over_batch(one: Callable[..., Any], fixed: Any, *states: Array) -> Any:
    for _ in range(states[0].ndim - 1):
        one = jax.vmap(one, in_axes=(None, *[0] * len(states)))
    return one(fixed, *states)


# XLA's fusion emitters for CPUs compute a chain of small products again for each of its uses: MJX's unrolled tree then
# runs hundreds of times slower and compiles twenty times longer. Within a caller's program options cannot be set; there
# XLA_FLAGS=--xla_cpu_use_fusion_emitters=false helps.
_mapped = sized_program(_over_batch, static_argnums=0)


@jax.jit
def _own_inertias(backend: MjxBackend) -> Array:
    return link_inertias(backend.structure.translation, backend.model)


def _put(made: Compiled) -> tuple[Any, _Structure]:
    try:
        model = mjx.put_model(made.model)
        return model, _Structure(made.translation, mjx.make_data(model))
    except NotImplementedError as error:
        raise InputError(f"MJX does not take this MJCF: {error}; the backend 'mujoco' does") from None


_SHARED: dict[Any, tuple[Any, _Structure]] = {}


def _shared(robot: RobotModel, made: Compiled) -> tuple[Any, _Structure]:
    """The static model of the robot's tree, with the robot's own leaves."""
    t = made.translation
    key = (robot.joints, *(x.tobytes() for x in (made.model.jnt_type, t.index, t.scale, t.shift)))
    if key not in _SHARED:
        _SHARED[key] = _put(made)
    model, structure = _SHARED[key]
    leaves = {name: jnp.asarray(getattr(made.model, name)) for name in _LEAVES}
    gravity = jnp.asarray(made.model.opt.gravity)
    return model.replace(opt=model.opt.replace(gravity=gravity), **leaves), structure


def _placed(backend: MjxBackend, q: Array) -> Any:
    data = backend.structure.data.replace(qpos=positions(backend.structure.translation, q))
    return mjx.com_pos(backend.model, mjx.kinematics(backend.model, data))


def _moving(backend: MjxBackend, q: Array, v: Array, a: Array) -> Any:
    t = backend.structure.translation
    share = jnp.asarray(rates(t, q))
    data = _placed(backend, q).replace(qvel=share @ v, qacc=share @ a + drift(t, q, v))
    return mjx.com_vel(backend.model, data)


def _torque(backend: MjxBackend, q: Array, v: Array, a: Array) -> Array:
    forces = mjx.rne(backend.model, _moving(backend, q, v, a), flg_acc=True).qfrc_bias
    return forces @ rates(backend.structure.translation, q)


def _mass(backend: MjxBackend, q: Array) -> Array:
    model = backend.model.replace(dof_armature=jnp.zeros_like(backend.model.dof_armature))
    share = jnp.asarray(rates(backend.structure.translation, q))
    return share.T @ mjx.full_m(model, mjx.crb(model, _placed(backend, q))) @ share


def _coriolis(backend: MjxBackend, q: Array, v: Array) -> Array:
    bias = jax.vmap(lambda x: _torque(backend, q, x, jnp.zeros_like(x)))
    return coriolis_from_bias(backend.robot, bias, _mass(backend, q), v)


def _acceleration(backend: MjxBackend, q: Array, v: Array, tau: Array) -> Array:
    bias = _torque(backend, q, v, jnp.zeros_like(v))
    factor = jnp.linalg.cholesky(_mass(backend, q))
    return jax.scipy.linalg.cho_solve((factor, True), tau - bias)


def _frames(backend: MjxBackend, q: Array) -> Array:
    data = _placed(backend, q)
    return frame_poses(backend.robot, joint_poses(backend.structure.translation, data.xmat, data.xpos))


def _jacobian(which: tuple[MjxBackend, Array, Array, Array], q: Array) -> Array:
    """Of the frame `index` in one of three references, all by one program."""
    backend, index, local, world = which
    t, data = backend.structure.translation, _placed(backend, q)
    pose = frame_poses(backend.robot, joint_poses(t, data.xmat, data.xpos))[index]
    bodies = [t.body[frame.parent] if frame.parent >= 0 else 0 for frame in backend.robot.frames]
    point = jnp.where(world, 0.0, pose[:3, 3])
    parts = mjx.jac(backend.model, data, point, jnp.asarray(bodies)[index])
    share = jnp.asarray(rates(t, q))
    turn = jnp.where(local, pose[:3, :3].T, jnp.eye(3))
    return jnp.concatenate([turn @ part.T @ share for part in parts])


def _regressor(backend: MjxBackend, q: Array, v: Array, a: Array) -> Array:
    t, model, data = backend.structure.translation, backend.model, _moving(backend, q, v, a)

    def forces(spatial: Array) -> Array:
        return mjx.rne(model, data.tree_replace({"_impl.cinert": spatial}), flg_acc=True).qfrc_bias

    none = jnp.zeros_like(data._impl.cinert)
    rows = jax.vmap(jax.vjp(forces, none)[1])(jnp.eye(model.nv))[0][:, t.body]
    about = data.subtree_com[np.asarray(model.body_rootid)[t.body]]
    units = spatial_inertias(joint_poses(t, data.xmat, data.xpos), about)
    dofs = jnp.einsum("dlc,lkc->dlk", rows, units, precision=jax.lax.Precision.HIGHEST)
    return jnp.asarray(rates(t, q)).T @ dofs.reshape(model.nv, -1)


def _derivatives(backend: MjxBackend, q: Array, v: Array, a: Array) -> TorqueDerivatives:
    along_q = jax.jacfwd(lambda step: _torque(backend, integrate(backend.robot, q, step), v, a))(jnp.zeros_like(v))
    along_v = jax.jacfwd(lambda x: _torque(backend, q, x, a))(v)
    return TorqueDerivatives(along_q, along_v, _mass(backend, q))
