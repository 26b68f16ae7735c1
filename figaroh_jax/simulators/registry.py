"""Backends by name, and the robots that they are built for.

A backend is a class that satisfies `figaroh_jax.simulators.contract.Backend`; a package announces it by an entry
point of the group `figaroh_jax.backends`, and it is imported only when asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from ..errors import InputError
from ..formats.robotfile import read_robot
from ..formats.xmlfile import find_in_packages
from ..rigid.model import RobotModel
from .contract import GROUP, Backend, announced, capabilities_of, having, names

__all__ = ["GROUP", "backend", "backend_class", "check_backend", "having", "names"]


def backend(
    name: str,
    model: RobotModel | str | Path | None = None,
    root: Literal["fixed", "free_flyer"] | None = None,
    packages: Sequence[str | Path] = (),
) -> Backend:
    """The backend called `name` for a robot: a `RobotModel`, a URDF file (`.urdf`) or an MJCF file (`.xml`, `.mjcf`).

    `root` says whether the root link is fixed to the world or moves freely; None: as the file has it, which for a URDF
    is fixed. `packages` are the folders of packages by which a path such as `package://my_robot/robot.urdf` is found;
    meshes are never needed. Raises `InputError` where no backend of that name is installed (the message lists those
    that are), where the library that it adapts is missing, or for a wrong model.

    >>> import figaroh_jax as fj
    >>> fj.backend("native", fj.DEMO).robot.nv
    4
    """
    chosen = backend_class(name)
    if model is None:
        raise InputError(f"backend '{name}': for which robot? Give a URDF file, an MJCF file or a RobotModel")
    if isinstance(model, RobotModel):
        free = any(joint.kind == "free" and joint.parent < 0 for joint in model.joints)
        if root is not None and free != (root == "free_flyer"):
            raise InputError(f"robot '{model.name}' is {'free' if free else 'fixed'}; load it with root='{root}'")
        return chosen.build(model)
    return chosen.build(read_robot(model, root=root, packages=packages), find_in_packages(model, packages))


def backend_class(name: str) -> type[Backend]:
    """The class of the backend called `name`, imported now. Raises `InputError` as `backend`."""
    if name == "native":
        from .native import NativeBackend

        return NativeBackend
    return announced(name)


def check_backend(name: str, *functions: str) -> None:
    """Raise `InputError` unless the backend called `name` is installed and gives the functions of the contract."""
    capabilities = getattr(backend_class(name), "capabilities", None) or capabilities_of(name)
    for function in functions:
        if function not in capabilities.functions:
            able = ", ".join(having(function))
            raise InputError(f"backend '{name}' has no {function}; backends that do: {able}")
