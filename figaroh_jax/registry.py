"""Backends by name: other rigid body libraries behind the core's own signatures.

A backend is a *module* with the functions of `Backend`; it announces itself by an entry point of the group
`figaroh_jax.backends`, `name = "module"`, and is imported only when asked for.
"""

from __future__ import annotations

import importlib
from importlib import metadata
from types import ModuleType
from typing import Protocol, runtime_checkable

from jax.typing import ArrayLike
from jaxtyping import Float

from .errors import InputError
from .model import RobotModel

__all__ = ["GROUP", "Backend", "backend", "names"]

GROUP = "figaroh_jax.backends"
_NATIVE = ("figaroh_jax.kinematics", "figaroh_jax.dynamics", "figaroh_jax.regressor")


@runtime_checkable
class Backend(Protocol):
    """What a backend's module offers; shapes, units and frames are those of the core's functions of the same names."""

    def forward_kinematics(
        self, model: RobotModel, q: Float[ArrayLike, "*batch nv"]
    ) -> Float[ArrayLike, "*batch nj 4 4"]:
        """Poses of all tree joints in the world."""
        ...

    def inverse_dynamics(
        self,
        model: RobotModel,
        q: Float[ArrayLike, "*batch nv"],
        v: Float[ArrayLike, "*batch nv"],
        a: Float[ArrayLike, "*batch nv"],
    ) -> Float[ArrayLike, "*batch nv"]:
        """Torques of the rigid body."""
        ...

    def mass_matrix(self, model: RobotModel, q: Float[ArrayLike, "*batch nv"]) -> Float[ArrayLike, "*batch nv nv"]:
        """Mass matrix of the rigid body."""
        ...

    def forward_dynamics(
        self,
        model: RobotModel,
        q: Float[ArrayLike, "*batch nv"],
        v: Float[ArrayLike, "*batch nv"],
        tau: Float[ArrayLike, "*batch nv"],
    ) -> Float[ArrayLike, "*batch nv"]:
        """Accelerations of the rigid body."""
        ...

    def joint_torque_regressor(
        self,
        model: RobotModel,
        q: Float[ArrayLike, "*batch nv"],
        v: Float[ArrayLike, "*batch nv"],
        a: Float[ArrayLike, "*batch nv"],
    ) -> Float[ArrayLike, "*batch nv columns"]:
        """Matrix that the links' inertial parameters map to the torques."""
        ...


def names() -> tuple[str, ...]:
    """Names of the installed backends, `native` (this library's own) first."""
    return ("native", *sorted({entry.name for entry in metadata.entry_points(group=GROUP)}))


def backend(name: str) -> Backend:
    """The backend called `name`, imported now.

    Raises `InputError` where none of that name is installed (the message lists those that are), or where the library
    that it adapts is missing.
    """
    if name == "native":
        return _native()
    found = [entry for entry in metadata.entry_points(group=GROUP) if entry.name == name]
    if not found:
        raise InputError(
            f"no backend '{name}' is installed; installed: {', '.join(names())}. "
            f"A backend is a package with an entry point '{name}' in the group '{GROUP}'"
        )
    try:
        return found[0].load()
    except ImportError as error:
        missing = error.name or found[0].value
        raise InputError(
            f"backend '{name}' needs the package '{missing}', which cannot be imported ({error}); "
            f"install it with: pip install 'figaroh-jax[{name}]'"
        ) from None


def _native() -> Backend:
    native = ModuleType("figaroh_jax.native")
    for module in map(importlib.import_module, _NATIVE):
        vars(native).update({word: getattr(module, word) for word in module.__all__})
    return native  # pyright: ignore[reportReturnType]
