"""What every backend offers: one simulator behind one set of functions, with conventions that do not depend on it.

A backend is an object that satisfies `Backend`. The easiest way is to inherit from it: the facts about the robot then
come from its `RobotModel`, and a function that the library does not give says so. A package announces its class by an
entry point of the group `figaroh_jax.backends`, `name = "module:Class"`.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar, Literal, NoReturn, Protocol, runtime_checkable

import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Float

from ..errors import InputError, NotSupported, check_real, nearest
from ..formats.files import model_format
from ..rigid.derivatives import TorqueDerivatives
from ..rigid.manifold import difference, integrate, random_configuration
from ..rigid.model import RobotModel

__all__ = [
    "FUNCTIONS",
    "GROUP",
    "Backend",
    "Capabilities",
    "Reference",
    "Samples",
    "announced",
    "as_reference",
    "capabilities_of",
    "file_format",
    "having",
    "host_samples",
    "names",
    "tried",
]

Reference = Literal["local", "world", "local_world_aligned"]

TRACING = "tracing by JAX (jit, grad, vmap)"
_REFERENCES: tuple[Reference, ...] = ("local", "world", "local_world_aligned")
FUNCTIONS = (
    "mass_matrix",
    "coriolis_matrix",
    "gravity_vector",
    "inverse_dynamics",
    "forward_dynamics",
    "frame_placements",
    "frame_jacobian",
    "joint_torque_regressor",
    "dynamics_derivatives",
    "integrate",
    "difference",
    "random_configuration",
)


@dataclass(frozen=True)
class Capabilities:
    """What a backend can do, known without calling it."""

    formats: tuple[str, ...] = ("urdf", "mjcf", "usd", "model")  # of models that it takes
    differentiable: bool = False  # its functions can be differentiated by jax, in their arguments and its leaves
    batch: Literal["vectorised", "threads", "loop"] = "loop"  # how many samples are computed
    gpu: bool = False
    contact: bool = False  # the simulator behind it simulates contact (the functions here are the free rigid body's)
    precision: Literal["float64", "float32"] = "float64"  # of what it computes in; arrays are float64 in any case
    lacking: frozenset[str] = frozenset()  # functions that raise `NotSupported`

    @property
    def functions(self) -> frozenset[str]:
        """Names of the functions that it gives, and `TRACING` where JAX can trace them."""
        traced = (TRACING,) if self.differentiable else ()
        return frozenset(FUNCTIONS + traced) - self.lacking


GROUP = "figaroh_jax.backends"  # entry points by which packages announce their backends


class _ByName(type(Protocol)):  # pyright: ignore[reportGeneralTypeIssues, reportUntypedBaseClass]
    """Members are looked for, not evaluated: Python 3.11 asks an instance for each, a property that fails too."""

    def __instancecheck__(cls, instance: Any) -> bool:
        if cls.__dict__.get("_is_protocol"):
            return all(_has(instance, name) for name in _members(cls))
        return super().__instancecheck__(instance)


def _has(instance: Any, name: str) -> bool:
    nothing = object()
    return inspect.getattr_static(instance, name, nothing) is not nothing


@cache
def _members(protocol: type) -> tuple[str, ...]:
    own = {*vars(protocol), *protocol.__annotations__}
    return tuple(sorted(name for name in own if not name.startswith("_")))


@runtime_checkable
class Backend(Protocol, metaclass=_ByName):
    r"""Dynamics, kinematics and regressor of one robot, by one simulator.

    Conventions, the same for every backend; an adapter translates them once.

    *Arrays.* Any leading batch axes; q has `nq` numbers, v, a and tau have `nv`, in the order of `joint_names`
    (`RobotModel` says what the numbers of a joint with several degrees of freedom are; they are Pinocchio's,
    quaternions x y z w, free joints' velocities and torques in the axes of the moving body, but that a planar joint's
    angle is one number). Metres, radians, kilograms, seconds. float64.

    *Rigid body.* The functions are those of the bodies and of gravity alone. What else stands in a simulator's model -
    armature, damping, springs, dry friction, contacts, constraints, actuators - stays in `simulator` and out of them.

    *Frames.* `world_T_frame` maps points of the frame into the world. Twists and the rows of Jacobians are
    `[linear, angular]`: of the frame's origin in world axes (`local_world_aligned`), of the frame's origin in the
    frame's axes (`local`), or of the point that passes the world's origin, in world axes (`world`).

    *Inertial parameters.* `[m, mx, my, mz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz]` of each moving link, about the origin and in
    the axes of its joint frame, links in tree order (`link_names`), fixed parts counted to the link that carries them.
    """

    name: ClassVar[str]
    capabilities: ClassVar[Capabilities]

    @property
    def robot(self) -> RobotModel:
        """The robot in this library's own form."""
        ...

    @property
    def simulator(self) -> Any:
        """The simulator's own model, for all that this contract does not cover."""
        ...

    @classmethod
    def build(cls, robot: RobotModel, source: Path | None = None) -> Backend:
        """The backend of a robot; `source` is the file that the robot was read from, if there is one."""
        ...

    @property
    def model_format(self) -> str:
        """Format of the file that the robot was read from, `urdf`, `mjcf` or `usd`; `model` where there was none."""
        ...

    @property
    def nq(self) -> int:
        """Numbers in q."""
        return self.robot.nq

    @property
    def nv(self) -> int:
        """Numbers in v, a and tau."""
        return self.robot.nv

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Independent joints, in the order of their columns."""
        return self.robot.joint_names

    @property
    def link_names(self) -> tuple[str, ...]:
        """Moving links, in the order of the regressor's columns."""
        return self.robot.link_names

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Frames, in the order of `frame_placements`."""
        return tuple(frame.name for frame in self.robot.frames)

    def frame_id(self, name: str) -> int:
        """Place of the frame called `name`; raises `InputError` with the nearest known name."""
        return self.robot.frame_index(name)

    @property
    def inertias(self) -> Float[ArrayLike, "links 10"]:
        """Inertial parameters of the moving links, as the simulator has them."""
        return self.robot.inertia

    @property
    def position_limit(self) -> Float[ArrayLike, "nv 2"]:
        """Lower and upper limit of each degree of freedom (rad, m), infinite where there is none."""
        return self.robot.position_limit

    @property
    def velocity_limit(self) -> Float[ArrayLike, " nv"]:
        """Limit of each velocity (rad/s, m/s), infinite where there is none."""
        return self.robot.velocity_limit

    @property
    def effort_limit(self) -> Float[ArrayLike, " nv"]:
        """Limit of each torque (N m, N), infinite where there is none."""
        return self.robot.effort_limit

    def mass_matrix(self, q: Float[ArrayLike, "*batch nq"]) -> Float[ArrayLike, "*batch nv nv"]:
        """Mass matrix M, symmetric."""
        _lacks(self, "mass_matrix")

    def coriolis_matrix(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"]
    ) -> Float[ArrayLike, "*batch nv nv"]:
        r"""Coriolis matrix C: `C @ v` are the Coriolis and centrifugal torques, and $\\dot M = C + C^T$."""
        _lacks(self, "coriolis_matrix")

    def gravity_vector(self, q: Float[ArrayLike, "*batch nq"]) -> Float[ArrayLike, "*batch nv"]:
        """Torques that hold the robot still."""
        _lacks(self, "gravity_vector")

    def inverse_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[ArrayLike, "*batch nv"]:
        """Torques that give the acceleration `a`: `M @ a + C @ v + gravity`."""
        _lacks(self, "inverse_dynamics")

    def forward_dynamics(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], tau: Float[ArrayLike, "*batch nv"]
    ) -> Float[ArrayLike, "*batch nv"]:
        """Acceleration that the torques `tau` give."""
        _lacks(self, "forward_dynamics")

    def frame_placements(self, q: Float[ArrayLike, "*batch nq"]) -> Float[ArrayLike, "*batch frames 4 4"]:
        """Pose `world_T_frame` of every frame."""
        _lacks(self, "frame_placements")

    def frame_jacobian(
        self, q: Float[ArrayLike, "*batch nq"], frame: str, reference: Reference = "local_world_aligned"
    ) -> Float[ArrayLike, "*batch 6 nv"]:
        """Twist of the frame for each velocity."""
        _lacks(self, "frame_jacobian")

    def joint_torque_regressor(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> Float[ArrayLike, "*batch nv columns"]:
        """Regressor W: `W @ inertias.ravel()` are the torques of `inverse_dynamics`; ten columns a link."""
        _lacks(self, "joint_torque_regressor")

    def dynamics_derivatives(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"], a: Float[ArrayLike, "*batch nv"]
    ) -> TorqueDerivatives:
        """Exact derivatives of `inverse_dynamics` by q (along `integrate`), v and a."""
        _lacks(self, "dynamics_derivatives")

    def integrate(
        self, q: Float[ArrayLike, "*batch nq"], v: Float[ArrayLike, "*batch nv"]
    ) -> Float[ArrayLike, "*batch nq"]:
        """Configuration that the velocity v, kept for one second, reaches from q; see `figaroh_jax.rigid.manifold`."""
        return integrate(self.robot, q, v)

    def difference(
        self, q0: Float[ArrayLike, "*batch nq"], q1: Float[ArrayLike, "*batch nq"]
    ) -> Float[ArrayLike, "*batch nv"]:
        """Velocity that reaches q1 from q0 in one second."""
        return difference(self.robot, q0, q1)

    def random_configuration(self, rng: Any = 0, shape: tuple[int, ...] = ()) -> Float[ArrayLike, "*shape nq"]:
        """Configurations within the limits; `rng` is a seed, a `numpy.random.Generator` or a `jax.random` key."""
        return random_configuration(self.robot, rng, shape)


def names() -> tuple[str, ...]:
    """Names of the installed backends, `native` (this library's own) first."""
    return ("native", *sorted({entry.name for entry in metadata.entry_points(group=GROUP)}))


def announced(name: str) -> Any:  # type[Backend]: a protocol, which no run-time check of subclasses takes
    """The class that an installed package announces as `name`, imported now. `InputError` where there is none."""
    found = [entry for entry in metadata.entry_points(group=GROUP) if entry.name == name]
    if not found:
        raise InputError(
            f"no backend '{name}' is installed; installed: {', '.join(names())}. Those of this library are installed "
            f"with: pip install 'figaroh-jax[mujoco,mjx,pinocchio,newton,genesis]'; another needs a package with an "
            f"entry point '{name}' in the group '{GROUP}'"
        )
    try:
        return found[0].load()
    except AttributeError as error:
        raise InputError(f"backend '{name}': its entry point {found[0].value} names no class ({error})") from error
    except ImportError as error:
        missing = error.name or found[0].value
        raise InputError(
            f"backend '{name}' needs the package '{missing}', which cannot be imported ({error}); "
            f"install it with: pip install 'figaroh-jax[{name}]'"
        ) from None
    except Exception as error:  # whatever its module does when it is imported
        raise InputError(
            f"backend '{name}': its package {found[0].value.partition(':')[0]} fails when it is imported"
            f" ({type(error).__name__}: {error}); ask those who made it, or choose another backend"
        ) from error


def capabilities_of(name: str) -> Capabilities:
    """What the backend called `name` can do; raises `InputError` where its class does not say."""
    found = getattr(announced(name), "capabilities", None)
    if not isinstance(found, Capabilities):
        raise InputError(
            f"backend '{name}': its class says no `capabilities` (a figaroh_jax.simulators.contract.Capabilities)"
        )
    return found


def having(function: str) -> tuple[str, ...]:
    """Names of the installed backends that give a function of the contract; `native` gives them all."""
    able = ["native"]
    for name in names()[1:]:
        try:
            capabilities = capabilities_of(name)
        except InputError:
            continue
        if function in capabilities.functions:
            able.append(name)
    return tuple(able)


def tried(backend: Backend) -> Backend:
    """The backend itself once a first call of its dynamics has answered as the contract asks.

    Raises `InputError` for an answer of another shape, one that is not finite, or a regressor that is not that of the
    torques. Backends of this library are passed on as they are: its tests hold them to more than this.
    """
    if type(backend).__module__.partition(".")[0] in _OWN:
        return backend
    q = random_configuration(backend.robot, 0, (2,))
    rates = np.random.default_rng(0).uniform(-1, 1, (2, 2, backend.nv))
    state, square = (q, *rates), (2, backend.nv, backend.nv)
    found = {
        function: _answer(backend, function, arguments, shape)
        for function, arguments, shape in (
            ("inverse_dynamics", state, (2, backend.nv)),
            ("mass_matrix", (q,), square),
            ("joint_torque_regressor", state, (2, backend.nv, 10 * len(backend.link_names))),
        )
        if function in type(backend).capabilities.functions
    }
    if {"inverse_dynamics", "joint_torque_regressor"} <= set(found):
        told = found["joint_torque_regressor"] @ np.ravel(np.asarray(backend.inertias, float))
        off, size = np.abs(told - found["inverse_dynamics"]).max(), np.abs(found["inverse_dynamics"]).max()
        if off > 1e-6 * (1 + size):
            raise InputError(
                f"backend '{backend.name}': its joint_torque_regressor times its inertias differs from its"
                f" inverse_dynamics by {off:.3g} N m; both are the rigid body's torques"
            )
    return backend


_OWN = ("figaroh_jax", *(f"figaroh_jax_{name}" for name in ("mujoco", "mjx", "pinocchio", "newton", "genesis")))


def _answer(backend: Backend, function: str, arguments: tuple[Any, ...], shape: tuple[int, ...]) -> np.ndarray:
    who = f"backend '{backend.name}': {function}"
    try:
        answer = np.asarray(getattr(backend, function)(*arguments), float)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"{who} fails at its first call ({type(error).__name__}: {error})") from error
    if answer.shape != shape:
        raise InputError(f"{who} gives shape {answer.shape} for two samples; {shape} is expected")
    if not np.isfinite(answer).all():
        raise InputError(f"{who} gives {answer[~np.isfinite(answer)][0]} at a configuration within the limits")
    return answer


def _lacks(backend: Backend, function: str) -> NoReturn:
    able = ", ".join(having(function)) or "none that is installed"
    raise NotSupported(f"backend '{backend.name}' has no {function}; backends that do: {able}")


class Samples(tuple[np.ndarray, ...]):
    """Arrays of NumPy `(samples, numbers)`, and the batch axes that they had."""

    batch: tuple[int, ...]

    def restore(self, answer: np.ndarray) -> np.ndarray:
        """An answer with one leading axis, with the batch axes in its place."""
        return answer.reshape(*self.batch, *answer.shape[1:])


def check_samples(backend: Backend, **arrays: ArrayLike) -> tuple[int, ...]:
    """Batch axes of the arrays `q=`, `v=`, ...; raises `InputError` where a shape does not fit the robot or another."""
    for name, array in arrays.items():
        check_real(name, array)
    batch = np.shape(next(iter(arrays.values())))[:-1]
    for name, array in arrays.items():
        width, shape = backend.nq if name.startswith("q") else backend.nv, np.shape(array)
        if shape[-1:] != (width,):
            joints = ", ".join(backend.joint_names)
            raise InputError(f"{name} has shape {shape}; its last axis must hold {width} numbers, of {joints}")
        if shape[:-1] != batch:
            raise InputError(
                f"{name} has shape {shape}, but {next(iter(arrays))} has batch axes {batch}; give both alike"
            )
    return batch


def host_samples(backend: Backend, **arrays: ArrayLike) -> Samples:
    """The arrays of a function, for a simulator that computes on the host, batch axes made one.

    Raises `InputError` as `check_samples`, and `NotSupported` inside `jax.jit` or `jax.grad`.
    """
    if any(isinstance(array, Tracer) for array in arrays.values()):
        _lacks(backend, TRACING)
    batch = check_samples(backend, **arrays)
    samples = Samples(np.asarray(array, float).reshape(-1, np.shape(array)[-1]) for array in arrays.values())
    samples.batch = batch
    return samples


def file_format(source: Path | None) -> str:
    """Format of a model file by its name: `urdf`, `mjcf`, `usd`, or `model` where there is none."""
    return "model" if source is None else model_format(source)


def as_reference(reference: str) -> Reference:
    """The reference of a Jacobian, checked; dashes may stand for underscores."""
    name = reference.replace("-", "_")
    for known in _REFERENCES:
        if name == known:
            return known
    raise InputError(f"reference is '{reference}'{nearest(reference, _REFERENCES)}")
