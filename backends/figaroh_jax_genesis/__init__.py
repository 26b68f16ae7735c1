"""Genesis behind the contract of figaroh_jax: its rigid solver on the CPU in float64, one environment for each sample.

The scene is built from the robot's arrays (through MJCF text in memory, inertias set afterwards), with collisions,
limits and constraints switched off. Genesis has no inverse dynamics: torques are `M a + bias` by the terms of its
solver, the mass matrix (`get_mass_mat`) and the bias forces (`qf_bias`) of its forward dynamics, evaluated at the state
without a step. Frames and Jacobians are `get_links_pos`, `get_links_quat` and `get_jacobian`. It gives no derivatives.

`simulator` is the `genesis.Scene` that Genesis's own reader makes of the file (URDF or MJCF), with its contacts; where
there is none, the one built from the arrays. Genesis is set up once in a process (`genesis.init`): a program that has
done so keeps its own settings, and with them its precision.
"""

from __future__ import annotations

import os
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar
from xml.etree import ElementTree as ET  # written, never read

import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from scipy.spatial.transform import Rotation

os.environ.setdefault("QD_LOG_LEVEL", "error")  # its compiler tells of loops on standard error
import genesis as gs
from genesis.utils.misc import qd_to_torch

from figaroh_jax.errors import InputError, NotSupported
from figaroh_jax.formats.xmlfile import read_xml
from figaroh_jax.rigid.inertia import from_com, to_com
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.simulators.contract import Capabilities, file_format, host_samples
from figaroh_jax.simulators.host import HostBackend
from figaroh_jax.simulators.parent_axes import numbers, rates, refuse_inner_free_joints, unit_inertias, unit_regressor

__all__ = ["GenesisBackend"]

_ENVIRONMENTS = int(os.environ.get("FIGAROH_JAX_GENESIS_ENVIRONMENTS", "64"))  # samples of one evaluation
_LEAST = 1e-12  # kg, kg m^2: Genesis takes no link without a mass


class GenesisBackend(HostBackend):
    """A robot of Genesis; `simulator` is its `genesis.Scene`.

    Mass matrix by `get_mass_mat`, torques `M a + bias` by the terms of its forward dynamics, poses by `get_links_pos`
    and `get_links_quat`, Jacobians by `get_jacobian`.
    """

    name: ClassVar[str] = "genesis"
    capabilities: ClassVar[Capabilities] = Capabilities(
        batch="vectorised", contact=True, lacking=frozenset({"dynamics_derivatives"})
    )

    def __init__(self, robot: RobotModel, source: Path | None = None) -> None:
        refuse_inner_free_joints(robot, self.name)
        super().__init__(robot, source)

    @property
    def simulator(self) -> Any:
        """The built `genesis.Scene` of the file, or of the robot's arrays where there is no URDF or MJCF.

        Raises `InputError` where Genesis does not read the file, a mesh that is not there among the reasons.
        """
        return self._own_simulator

    @cached_property
    def _own_simulator(self) -> Any:
        form = file_format(self._source)
        if form not in ("urdf", "mjcf"):
            return self._scene[0]
        _set_up()
        try:
            scene = gs.Scene(show_viewer=False)
            path = Path(str(self._source)).resolve()
            scene.add_entity(getattr(gs.morphs, form.upper())(file=_with_limits(path) if form == "urdf" else str(path)))
            scene.build()
            return scene
        except Exception as error:
            raise InputError(f"{self._source}: Genesis does not read it: {error}") from error

    @property
    def inertias(self) -> Float[np.ndarray, "links 10"]:
        """Inertial parameters of the links in Genesis's model."""
        _, entity, links = self._scene
        read = (entity.get_links_mass, entity.get_links_COM, entity.get_links_inertia)
        parts = [np.asarray(one().cpu(), float)[links] for one in read]
        return np.stack([from_com(*link) for link in zip(*parts, strict=True)])

    def _point_jacobian(self, q: np.ndarray, joint: int, joints: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Genesis's is of the link's origin; moved to the points. It leaves the columns of spherical joints zero."""
        if round := [joint.name for joint in self._robot.joints if joint.kind == "spherical"]:
            raise NotSupported(
                f"backend 'genesis' has no frame_jacobian of spherical joints ('{round[0]}'); backends that do: "
                "native, mujoco, pinocchio"
            )
        _, entity, links = self._scene
        own = self._each(lambda: _numpy(entity.get_jacobian(entity.links[links[joint]])), q)[..., self._back]
        own = own @ rates(self._robot, q, np.zeros((len(q), self.nv))).share  # its own: turning in the parent's axes
        own[:, :3] += np.cross(own[:, 3:], (points - joints[:, joint, :3, 3])[:, :, None], axis=1)
        return own

    def joint_torque_regressor(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[np.ndarray, "*batch nv columns"]:
        """The torques of a robot of one link at a time, with one inertial parameter at a time: see `unit_regressor`."""
        samples = host_samples(self, q=q, v=v, a=a)
        try:
            columns = unit_regressor(
                lambda only: self._torques(samples[0], samples[1], samples[2], only), len(self._robot.joints)
            )
        finally:
            self._weigh(np.asarray(self._robot.inertia, float))
        return samples.restore(columns)

    def step(
        self,
        q: Float[ArrayLike, "*batch nq"],
        v: Float[ArrayLike, "*batch nv"],
        tau: Float[ArrayLike, "*batch nv"],
        steps: int = 1,
    ) -> tuple[Float[np.ndarray, "*batch nq"], Float[np.ndarray, "*batch nv"]]:
        """State after `steps` of a millisecond under a constant torque, by `genesis.Scene.step`.

        Semi-implicit Euler: an error of the order of the step. Robots with joints of one degree of freedom, none of
        which mimics another; contacts, limits and drives are those of `simulator` alone.
        """
        if self.nv != self._robot.nd or self.nq != self.nv:
            raise InputError("backend 'genesis': step takes robots whose joints have one coordinate each")
        samples = host_samples(self, q=q, v=v, tau=tau)
        scene, entity, _ = self._scene

        answers = []
        for start in range(0, len(samples[0]), _ENVIRONMENTS):
            own = [x[start : start + _ENVIRONMENTS] for x in samples]
            self._place(own[0], own[1])
            force = self._filled(own[2][:, self._dofs()])
            for _ in range(steps):
                entity.control_dofs_force(force)
                scene.step()
            ends = np.stack([_numpy(entity.get_qpos()), _numpy(entity.get_dofs_velocity())], axis=1)
            answers.append(ends[: len(own[0])][..., self._back])
        ends = np.concatenate(answers)
        return samples.restore(ends[:, 0]), samples.restore(ends[:, 1])

    @cached_property
    def _scene(self) -> tuple[Any, Any, list[int]]:
        """The scene from the arrays, its entity and its link of each of ours."""
        _set_up()
        free = {"enable_collision": False, "enable_joint_limit": False, "disable_constraint": True}
        scene = gs.Scene(
            show_viewer=False,
            sim_options=gs.options.SimOptions(dt=1e-3, gravity=tuple(map(float, self._robot.gravity))),
            rigid_options=gs.options.RigidOptions(integrator=gs.integrator.Euler, **free),
        )
        entity = scene.add_entity(gs.morphs.MJCF(file=_mjcf(self._robot), align=False))
        scene.build(n_envs=_ENVIRONMENTS)
        entity.set_dofs_armature(np.zeros(entity.n_dofs))
        names = [link.name for link in entity.links]
        links = [names.index(f"link_{i}") for i in range(len(self._robot.joints))]
        self._write(entity, links, np.asarray(self._robot.inertia, float))
        return scene, entity, links

    def _weigh(self, inertias: Float[np.ndarray, "links 10"]) -> None:
        _, entity, links = self._scene
        self._write(entity, links, inertias)

    @staticmethod
    def _write(entity: Any, links: list[int], inertias: Float[np.ndarray, "links 10"]) -> None:
        mass, com, about = to_com(inertias)
        entity.set_links_mass(np.maximum(mass, _LEAST), links)
        entity.set_links_COM(com, links)
        entity.set_links_inertia(about, links)

    def _filled(self, rows: np.ndarray) -> np.ndarray:
        return np.concatenate([rows, np.repeat(rows[:1], _ENVIRONMENTS - len(rows), axis=0)])

    def _place(self, q: np.ndarray, qd: np.ndarray) -> None:
        _, entity, _ = self._scene
        parts = numbers(self._robot, q)
        for i, joint in enumerate(self._robot.joints):
            if joint.kind in ("free", "spherical"):  # w x y z
                parts[i] = np.concatenate([parts[i][:, :-4], parts[i][:, -1:], parts[i][:, -4:-1]], axis=1)
        order = _order(entity, self._robot)
        entity.set_qpos(self._filled(np.concatenate([parts[i] for i in order], axis=1)), zero_velocity=False)
        entity.set_dofs_velocity(self._filled(qd[:, self._dofs()]))

    def _dofs(self) -> np.ndarray:
        """Our degree of freedom of each of Genesis's."""
        first, widths = self._robot.dofs.first, np.bincount(self._robot.dofs.joint)
        return np.concatenate([np.arange(first[i], first[i] + widths[i]) for i in _order(self._scene[1], self._robot)])

    @cached_property
    def _back(self) -> np.ndarray:
        """Genesis's degree of freedom of each of ours."""
        return np.argsort(self._dofs())

    def _each(self, read: Any, q: np.ndarray, qd: np.ndarray | None = None) -> np.ndarray:
        """`read()` of blocks of samples, the environments in their states."""
        answers = []
        qd = np.zeros((len(q), self._robot.nd)) if qd is None else qd
        for start in range(0, max(1, len(q)), _ENVIRONMENTS):
            rows = slice(start, start + _ENVIRONMENTS)
            own = q[rows] if len(q) else np.asarray(self.random_configuration(0, (1,)))
            self._place(own, qd[rows] if len(q) else np.zeros((1, self._robot.nd)))
            answers.append(read()[: len(q[rows])])
        return np.concatenate(answers)

    def _terms(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Mass matrix and, below it, bias forces in Genesis's coordinates: (n, nd + 1, nd)."""
        scene, entity, _ = self._scene
        solver = scene.sim.rigid_solver

        def read() -> np.ndarray:
            solver._func_forward_dynamics()
            bias = qd_to_torch(solver.dyn_state.dofs.qf_bias, None, transpose=True)
            return np.concatenate([_numpy(entity.get_mass_mat()), _numpy(bias)[:, None]], axis=1)

        terms = self._each(read, q, qd)[..., self._back]
        return np.concatenate([terms[:, self._back], terms[:, -1:]], axis=1)

    def _masses(self, q: np.ndarray) -> np.ndarray:
        share = rates(self._robot, q, np.zeros((len(q), self.nv)), own_turning=True).share
        return np.swapaxes(share, 1, 2) @ self._terms(q, np.zeros((len(q), self._robot.nd)))[:, :-1] @ share

    def _torques(self, q: np.ndarray, v: np.ndarray, a: np.ndarray, only: tuple[int, int] | None = None) -> np.ndarray:
        """Torques of the robot, or of one link with one inertial parameter (the links keep it)."""
        if only:
            self._weigh(unit_inertias(len(self._robot.joints), only))
        share, drift = rates(self._robot, q, v, own_turning=True)
        qd, qdd = (share @ v[..., None])[..., 0], (share @ a[..., None])[..., 0] + drift
        terms = self._terms(q, qd)
        force = (terms[:, :-1] @ qdd[..., None])[..., 0] + terms[:, -1]
        return (force[:, None] @ share)[:, 0]

    def _joint_poses(self, q: np.ndarray) -> np.ndarray:
        _, entity, links = self._scene

        def read() -> np.ndarray:
            return np.concatenate([_numpy(entity.get_links_pos()), _numpy(entity.get_links_quat())], axis=2)[:, links]

        flat = self._each(read, q)
        answer = np.tile(np.eye(4), (*flat.shape[:2], 1, 1))
        turns = Rotation.from_quat(flat[..., 3:].reshape(-1, 4), scalar_first=True)
        answer[..., :3, :3] = turns.as_matrix().reshape(*flat.shape[:2], 3, 3)
        answer[..., :3, 3] = flat[..., :3]
        return answer


def _set_up() -> None:
    if not gs._initialized:
        gs.init(backend=gs.cpu, precision="64", logging_level="error")


def _with_limits(path: Path) -> str:
    """The URDF file, or its text with an infinite limit where a joint has none, which Genesis refuses."""
    missing, root = False, read_xml(path, "robot")
    for joint in root.iter("joint"):
        if joint.get("type") in ("revolute", "prismatic") and joint.find("limit") is None:
            missing = True
            joint.append(joint.makeelement("limit", {"effort": "inf", "velocity": "inf"}))
    if not missing:
        return str(path)
    for mesh in root.iter("mesh"):  # a text has no folder
        name = mesh.get("filename", "")
        if name and "://" not in name:
            mesh.set("filename", str(path.parent / name))
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]

    return etree.tostring(root, encoding="unicode")


def _numpy(tensor: Any) -> np.ndarray:
    return np.asarray(tensor.cpu(), float)


def _order(entity: Any, robot: RobotModel) -> list[int]:
    """Our tree joint of each of Genesis's links that move, in Genesis's order."""
    names = {f"link_{i}": i for i in range(len(robot.joints))}
    return [names[link.name] for link in entity.links if link.name in names]


def _mjcf(robot: RobotModel) -> str:
    """The robot's tree as MJCF text; the inertias but for the centres of mass are set afterwards."""
    root = ET.Element("mujoco", model="robot")
    ET.SubElement(root, "compiler", angle="radian", autolimits="false")
    bodies = {-1: ET.SubElement(root, "worldbody")}
    for i, joint in enumerate(robot.joints):
        pose, first = np.asarray(robot.placement[i], float), int(robot.dofs.first[i])
        turn = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
        body = ET.SubElement(bodies[joint.parent], "body", name=f"link_{i}", pos=_text(pose[:3, 3]), quat=_text(turn))
        centre = _text(to_com(np.asarray(robot.inertia[i], float))[1])
        ET.SubElement(body, "inertial", mass="1", pos=centre, diaginertia="1 1 1")
        axes = np.asarray(robot.axis, float)[first:]
        kinds = {"revolute": "hinge", "prismatic": "slide", "spherical": "ball", "free": "free"}
        if joint.kind == "planar":
            for k, kind in enumerate(("slide", "slide", "hinge")):
                ET.SubElement(body, "joint", name=f"joint_{i}_{k}", type=kind, axis=_text(axes[k]))
        else:
            ET.SubElement(body, "joint", name=f"joint_{i}", type=kinds[joint.kind], axis=_text(axes[0]))
        bodies[i] = body
    return ET.tostring(root, encoding="unicode")


def _text(values: Float[np.ndarray, " n"]) -> str:
    return " ".join(repr(float(x)) for x in values)
