"""Newton, NVIDIA's simulator on Warp, behind the contract of figaroh_jax: float32, one world for each sample.

The model is built from the robot's arrays and replicated, so that a batch is one launch of Newton's kernels on the CPU
or, where Warp finds one, on the GPU. Newton computes in single precision: answers agree with Pinocchio's to about 1e-5
of the largest torque (`Capabilities.precision`). Only its functions of rigid bodies are called (`eval_fk`,
`eval_jacobian`, `eval_inverse_dynamics_passive`, `eval_inverse_dynamics_force`), with armature zero: contacts, limits,
drives and damping never enter. It gives no derivatives of inverse dynamics.

`simulator` is the `newton.Model` that Newton's own importer makes of the file (URDF, MJCF, USD), with its contacts and
drives; where there is no file, the one built from the arrays. `step` integrates that of the arrays by
`newton.solvers.SolverFeatherstone`.
"""

from __future__ import annotations

import os
import warnings
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import newton
import numpy as np
import warp as wp
from jax.typing import ArrayLike
from jaxtyping import Float

from figaroh_jax.errors import InputError
from figaroh_jax.rigid.inertia import from_com, to_com
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.simulators.contract import Capabilities, file_format, host_samples
from figaroh_jax.simulators.host import HostBackend
from figaroh_jax.simulators.parent_axes import numbers, rates, refuse_inner_free_joints, unit_inertias, unit_regressor

__all__ = ["NewtonBackend"]

_LEVEL, wp.config.log_level = wp.config.log_level, wp.LOG_ERROR
wp.init()  # without the list of devices, and without a warning where there is no GPU
wp.config.log_level = max(_LEVEL, wp.LOG_WARNING)  # it prints each kernel's module too
_MOST = int(os.environ.get("FIGAROH_JAX_NEWTON_WORLDS", "1024"))  # replicated robots: larger batches go in turns


class _Worlds:
    """`count` copies of a robot, and what a launch writes."""

    def __init__(self, robot: RobotModel, count: int) -> None:
        self.count = count
        one = _builder(robot)
        many = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, 0.0))
        many.replicate(one, count)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it tells of inertias that it corrects, which are put back
            self.model = many.finalize()
        self.model.set_gravity(tuple(np.asarray(robot.gravity, float)))
        arrays = (self.model.body_mass, self.model.body_com, self.model.body_inertia)
        _weigh(arrays, np.asarray(robot.inertia, float), count)  # Newton has corrected those that no body has
        self.state = self.model.state()
        dofs, width = self.model.joint_dof_count, self.model.max_dofs_per_articulation
        self.mass = wp.zeros((count, width, width), dtype=wp.float32)
        self.gravity, self.bias, self.force, self.acceleration = (wp.zeros(dofs, dtype=wp.float32) for _ in range(4))

    def place(self, q: np.ndarray, qd: np.ndarray | None = None) -> None:
        """Bring the first `len(q)` copies into a state, the others into the first one's."""
        self.state.joint_q.assign(_filled(q, self.count))
        if qd is not None:
            self.state.joint_qd.assign(_filled(qd, self.count))
        else:
            self.state.joint_qd.zero_()
        newton.eval_fk(self.model, self.state.joint_q, self.state.joint_qd, self.state)


class NewtonBackend(HostBackend):
    """A robot of Newton; `simulator` is its `newton.Model`.

    Mass matrix by `newton.eval_inverse_dynamics_passive`, torques by `newton.eval_inverse_dynamics_force`, poses by
    `newton.eval_fk`, Jacobians by `newton.eval_jacobian`.
    """

    name: ClassVar[str] = "newton"
    capabilities: ClassVar[Capabilities] = Capabilities(
        batch="vectorised", gpu=True, contact=True, precision="float32", lacking=frozenset({"dynamics_derivatives"})
    )

    def __init__(self, robot: RobotModel, source: Path | None = None) -> None:
        refuse_inner_free_joints(robot, self.name)
        super().__init__(robot, source)
        self._worlds: dict[int, _Worlds] = {}

    @property
    def simulator(self) -> Any:
        """The `newton.Model` of the file, by Newton's importer; of the robot's arrays where there is no file.

        Raises `InputError` where the importer fails, a mesh that is not there among the reasons.
        """
        return self._own_simulator

    @cached_property
    def _own_simulator(self) -> Any:
        form = file_format(self._source)
        if form == "model":
            return self._of(1).model
        builder = newton.ModelBuilder()
        try:
            getattr(builder, f"add_{form}")(str(self._source))
            return builder.finalize()
        except Exception as error:
            raise InputError(f"{self._source}: Newton's importer does not read it: {error}") from error

    @property
    def inertias(self) -> Float[np.ndarray, "links 10"]:
        """Inertial parameters of the links in Newton's model: float32."""
        model = self._of(1).model
        mass, com, about = (x.numpy().astype(float) for x in (model.body_mass, model.body_com, model.body_inertia))
        return np.stack([from_com(*link) for link in zip(mass, com, about, strict=True)])

    def joint_torque_regressor(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nv columns"]:
        """Newton's torques of one link at a time with one inertial parameter at a time: see `unit_regressor`."""
        samples = host_samples(self, q=q, v=v, a=a)
        return samples.restore(
            unit_regressor(
                lambda only: self._torques(samples[0], samples[1], samples[2], only), len(self._robot.joints)
            )
        )

    def step(
        self,
        q: Float[ArrayLike, "*batch nq"],
        v: Float[ArrayLike, "*batch nv"],
        tau: Float[ArrayLike, "*batch nv"],
        dt: float = 1e-3,
        steps: int = 1,
    ) -> tuple[Float[np.ndarray, "*batch nq"], Float[np.ndarray, "*batch nv"]]:
        """State after `steps` of `dt` seconds under a constant torque, by Newton's Featherstone solver (float32).

        Semi-implicit Euler: an error of the order of `dt`. Robots with joints of one degree of freedom, none of which
        mimics another; contacts, limits and drives are those of `simulator` alone.
        """
        if self.nv != self._robot.nd or self.nq != self.nv:
            raise InputError("backend 'newton': step takes robots whose joints have one coordinate each")
        samples = host_samples(self, q=q, v=v, tau=tau)
        count = len(samples[0])
        worlds = _Worlds(self._robot, count)
        solver, control = newton.solvers.SolverFeatherstone(worlds.model), worlds.model.control()
        worlds.place(samples[0], samples[1])
        control.joint_f.assign(_filled(samples[2], count))
        before, after = worlds.state, worlds.model.state()
        for _ in range(steps):
            before.clear_forces()
            solver.step(before, after, control, None, dt)
            before, after = after, before
        ends = (before.joint_q.numpy(), before.joint_qd.numpy())
        q, v = (samples.restore(end.reshape(count, -1).astype(float)) for end in ends)
        return q, v

    def _of(self, count: int) -> _Worlds:
        size = min(_MOST, 1 << max(0, count - 1).bit_length())
        if size not in self._worlds:
            self._worlds[size] = _Worlds(self._robot, size)
        return self._worlds[size]

    def _each(self, function: Any, q: np.ndarray, qd: np.ndarray | None = None, *more: np.ndarray) -> np.ndarray:
        """`function(worlds, rows, ...)` of blocks of samples, worlds in their states."""
        own, parts = np.concatenate(numbers(self._robot, q), axis=1), []
        worlds = self._of(len(q))
        for start in range(0, len(q), worlds.count):
            rows = slice(start, start + worlds.count)
            worlds.place(own[rows], None if qd is None else qd[rows])
            parts.append(function(worlds, len(own[rows]), *(x[rows] for x in more)))
        return np.concatenate(parts) if parts else np.zeros((0, *_shape(function, self)))

    def _masses(self, q: np.ndarray) -> np.ndarray:
        def masses(worlds: _Worlds, rows: int) -> np.ndarray:
            newton.eval_inverse_dynamics_passive(worlds.model, worlds.state, mass_matrix=worlds.mass)
            return worlds.mass.numpy()[:rows, : self._robot.nd, : self._robot.nd].astype(float)

        share = rates(self._robot, q, np.zeros((len(q), self.nv)), True).share
        answer = np.swapaxes(share, 1, 2) @ self._each(masses, q) @ share
        return (answer + np.swapaxes(answer, 1, 2)) / 2

    def _torques(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, only: tuple[int, int] | None = None) -> np.ndarray:
        """Torques of the robot, or of one link with one inertial parameter."""
        robot = self._robot
        if only:  # the coordinates of a free joint depend on the centre of mass
            robot = eqx.tree_at(lambda m: m.inertia, robot, unit_inertias(len(robot.joints), only))
        share, drift = rates(robot, q, v, centres=True)
        qd, qdd = (share @ v[..., None])[..., 0], (share @ a[..., None])[..., 0] + drift

        def torques(worlds: _Worlds, rows: int, qdd: np.ndarray) -> np.ndarray:
            worlds.acceleration.assign(_filled(qdd, worlds.count))
            kept = _replaced(worlds, len(self._robot.joints), only) if only else None
            if only:
                newton.eval_fk(worlds.model, worlds.state.joint_q, worlds.state.joint_qd, worlds.state)
            passive = {"mass_matrix": worlds.mass, "gravity_force": worlds.gravity, "coriolis_force": worlds.bias}
            newton.eval_inverse_dynamics_passive(worlds.model, worlds.state, **passive)
            newton.eval_inverse_dynamics_force(
                worlds.model,
                worlds.state,
                mass_matrix=worlds.mass,
                joint_qdd=worlds.acceleration,
                coriolis_force=worlds.bias,
                gravity_force=worlds.gravity,
                joint_f=worlds.force,
            )
            if kept:
                for array, values in kept:
                    array.assign(values)
            return worlds.force.numpy().reshape(worlds.count, -1)[:rows].astype(float)

        return (self._each(torques, q, qd, qdd)[:, None] @ share)[:, 0]

    def _point_jacobian(self, q: np.ndarray, joint: int, joints: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Newton's is of the centre of mass; moved to the points."""

        def link(worlds: _Worlds, rows: int) -> np.ndarray:
            whole = newton.eval_jacobian(worlds.model, worlds.state).numpy()[:rows]
            return whole[:, 6 * joint : 6 * joint + 6, : self._robot.nd].astype(float)

        own = self._each(link, q) @ rates(self._robot, q, np.zeros((len(q), self.nv)), True).share
        centre = np.concatenate([to_com(np.asarray(self._robot.inertia[joint], float))[1], [1.0]])
        way = points - (joints[:, joint] @ centre)[:, :3]
        own[:, :3] += np.cross(own[:, 3:], way[:, :, None], axis=1)
        return own

    def _joint_poses(self, q: np.ndarray) -> np.ndarray:
        def poses(worlds: _Worlds, rows: int) -> np.ndarray:
            flat = worlds.state.body_q.numpy().reshape(worlds.count, -1, 7)[:rows].astype(float)
            return _matrices(flat)

        return self._each(poses, q)


def _replaced(worlds: _Worlds, links: int, only: tuple[int, int]) -> list[tuple[Any, np.ndarray]]:
    """Put the inertias of one link and one parameter in the place of the robot's, which are returned."""
    model = worlds.model
    arrays = (model.body_mass, model.body_com, model.body_inertia)
    kept = [(array, array.numpy().copy()) for array in arrays]
    _weigh(arrays, unit_inertias(links, only), worlds.count)
    return kept


def _weigh(arrays: Any, inertias: np.ndarray, count: int) -> None:
    for array, values in zip(arrays, to_com(inertias), strict=True):
        array.assign(np.tile(values, (count, *[1] * (values.ndim - 1))).astype(np.float32))


def _builder(robot: RobotModel) -> Any:
    """One robot from its arrays: a body at each joint."""
    builder = newton.ModelBuilder(up_axis=newton.Axis.Z, gravity=(0.0, 0.0, 0.0))
    joints, bodies = [], []
    for i, joint in enumerate(robot.joints):
        mass, com, about = to_com(np.asarray(robot.inertia[i], float))
        bodies.append(
            builder.add_link(
                mass=float(mass), com=tuple(com), inertia=wp.mat33(*about.ravel()), label=joint.link, lock_inertia=True
            )
        )
        ends = {"parent": bodies[joint.parent] if joint.parent >= 0 else -1, "child": bodies[i]}
        joints.append(_joint(builder, robot, i, ends))
    builder.add_articulation(joints, label=robot.name)
    return builder


def _joint(builder: Any, robot: RobotModel, index: int, ends: dict[str, int]) -> int:
    joint, first = robot.joints[index], int(robot.dofs.first[index])
    axis = [tuple(map(float, row)) for row in np.asarray(robot.axis)[first:]]
    at = {"label": joint.name, "parent_xform": _transform(np.asarray(robot.placement[index], float))}
    config = newton.ModelBuilder.JointDofConfig.create_unlimited
    if joint.kind == "revolute":
        return builder.add_joint(newton.JointType.REVOLUTE, **ends, **at, angular_axes=[config(axis[0])])
    if joint.kind == "prismatic":
        return builder.add_joint(newton.JointType.PRISMATIC, **ends, **at, linear_axes=[config(axis[0])])
    if joint.kind == "planar":
        plane = {"linear_axes": [config(a) for a in axis[:2]], "angular_axes": [config(axis[2])]}
        return builder.add_joint(newton.JointType.D6, **ends, **at, **plane)
    if joint.kind == "spherical":
        return builder.add_joint_ball(**ends, **at, armature=0.0)
    return builder.add_joint_free(**ends, **at)


def _transform(pose: Float[np.ndarray, "4 4"]) -> Any:
    from scipy.spatial.transform import Rotation

    return wp.transform(wp.vec3(*pose[:3, 3]), wp.quat(*Rotation.from_matrix(pose[:3, :3]).as_quat()))


def _matrices(poses: Float[np.ndarray, "n bodies 7"]) -> Float[np.ndarray, "n bodies 4 4"]:
    from scipy.spatial.transform import Rotation

    answer = np.tile(np.eye(4), (*poses.shape[:2], 1, 1))
    answer[..., :3, :3] = Rotation.from_quat(poses[..., 3:].reshape(-1, 4)).as_matrix().reshape(*poses.shape[:2], 3, 3)
    answer[..., :3, 3] = poses[..., :3]
    return answer


def _filled(rows: np.ndarray, count: int) -> np.ndarray:
    """Rows for all copies, flat: those beyond the samples repeat the first."""
    more = np.repeat(rows[:1], count - len(rows), axis=0)
    return np.concatenate([rows, more]).astype(np.float32).ravel()


def _shape(function: Any, backend: NewtonBackend) -> tuple[int, ...]:
    """Shape of one sample's answer, for an empty batch."""
    worlds = backend._of(1)
    state = np.concatenate(numbers(backend.robot, np.asarray(backend.random_configuration(0, (1,)))), axis=1)
    worlds.place(state)
    more = (np.zeros((1, backend.robot.nd)),) if function.__name__ == "torques" else ()
    return function(worlds, 1, *more).shape[1:]
