"""Collision shapes of a robot's file: boxes, spheres, cylinders, capsules and meshes, each in the frame of its link.

Models of motion and torque need none of this; a design that keeps distances does. Meshes (STL, OBJ, PLY) are read by
trimesh; one that is missing or cannot be read is left out and told.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..errors import InputError
from .files import model_format
from .mjcf import body_name, compile_mjcf, engine
from .xmlfile import find_in_packages, read_xml

__all__ = ["Shape", "enclosed_points", "read_shapes", "rotation"]

_LARGEST_MESH = 100_000_000  # bytes
_ROUND = 16  # corners of a circle
_MOST = 10_000  # shapes

Kind = Literal["box", "sphere", "cylinder", "capsule", "mesh"]


class Shape(NamedTuple):
    """A collision shape: about its own origin, the axis of cylinders and capsules along z, in m."""

    frame: str  # of the robot: a link
    pose: Float[np.ndarray, "4 4"]  # of the shape in that frame
    kind: Kind
    size: tuple[float, ...] = ()  # box: half edges; sphere: radius; cylinder and capsule: radius, half length
    vertices: Float[np.ndarray, "n 3"] | None = None  # of a mesh
    faces: Int[np.ndarray, "m 3"] | None = None


def read_shapes(path: str | Path, packages: Sequence[str | Path] = ()) -> tuple[tuple[Shape, ...], tuple[str, ...]]:
    """The collision shapes of a `.urdf` or `.xml` (MJCF) file, and what could not be read (all of a USD stage).

    Paths such as `package://name/rest` are looked for in `packages` and in the folders above the file. Raises
    `InputError` as the readers of robots do.
    """
    path = find_in_packages(path, packages)
    form = model_format(path)
    if form == "usd":
        return (), (f"{path}: collision shapes of USD are not read; give the robot as URDF or MJCF where they matter",)
    return _of_urdf(path, packages) if form == "urdf" else _of_mjcf(path)


def enclosed_points(shape: Shape) -> Float[np.ndarray, "n 3"]:
    """Points, in the frame of the link, whose convex hull encloses the shape; of a sphere or capsule its axis alone."""
    if shape.kind == "mesh":
        assert shape.vertices is not None
        points = shape.vertices
    elif shape.kind == "box":
        points = np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T * shape.size
    elif shape.kind == "cylinder":
        angle = 2 * np.pi * np.arange(_ROUND) / _ROUND
        rim = shape.size[0] / np.cos(np.pi / _ROUND) * np.stack([np.cos(angle), np.sin(angle)], 1)
        points = np.concatenate([np.column_stack([rim, np.full(_ROUND, z)]) for z in (-shape.size[1], shape.size[1])])
    else:
        half = shape.size[1] if shape.kind == "capsule" else 0.0
        points = np.array([[0.0, 0.0, -half], [0.0, 0.0, half]])
    return points @ shape.pose[:3, :3].T + shape.pose[:3, 3]


def rotation(rpy: Sequence[float] | Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Turned about fixed x, then y, then z (rad), as URDF has it."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def _numbers(element: Any, name: str, count: int, default: str | None, where: str) -> Float[np.ndarray, " n"]:
    text = element.get(name, default)
    try:
        values = np.array([float(word) for word in (text or "").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{where}: {name} of <{element.tag}> is '{text}'; {count} finite numbers are expected")
    return values


def _of_urdf(path: Path, packages: Sequence[str | Path]) -> tuple[tuple[Shape, ...], tuple[str, ...]]:
    found: list[Shape] = []
    notes: list[str] = []
    for link in read_xml(path, "robot").iterchildren("link"):
        for element in link.iterchildren("collision"):
            where = f"{path}: collision of link '{link.get('name')}'"
            pose, origin = np.eye(4), element.find("origin")
            if origin is not None:
                pose[:3, :3] = rotation(_numbers(origin, "rpy", 3, "0 0 0", where))
                pose[:3, 3] = _numbers(origin, "xyz", 3, "0 0 0", where)
            geometry = next(iter(element.iterfind("geometry/*")), None)
            if geometry is None:
                notes.append(f"{where} has no geometry; it is left out")
                continue
            shape = _urdf_shape(link.get("name"), pose, geometry, where, path, packages)
            notes += [f"{where}: {shape}; it is left out"] if isinstance(shape, str) else []
            found += [] if isinstance(shape, str) else [shape]
            if len(found) > _MOST:
                raise InputError(f"{path}: more than {_MOST} collision shapes")
    return tuple(found), tuple(notes)


def _urdf_shape(
    link: str, pose: np.ndarray, geometry: Any, where: str, path: Path, packages: Sequence[str | Path]
) -> Shape | str:
    """The shape, or why there is none."""
    if geometry.tag == "box":
        return _positive(Shape(link, pose, "box", tuple(_numbers(geometry, "size", 3, None, where) / 2)), where)
    if geometry.tag == "sphere":
        return _positive(Shape(link, pose, "sphere", tuple(_numbers(geometry, "radius", 1, None, where))), where)
    if geometry.tag in ("cylinder", "capsule"):
        radius, length = (_numbers(geometry, name, 1, None, where)[0] for name in ("radius", "length"))
        return _positive(Shape(link, pose, geometry.tag, (float(radius), float(length) / 2)), where)
    if geometry.tag != "mesh":
        return f"<{geometry.tag}> is none of box, sphere, cylinder, capsule, mesh"
    file = _mesh_file(geometry.get("filename", ""), path, packages)
    if file is None:
        return f"no file {geometry.get('filename')}"
    mesh = _mesh(file)
    if isinstance(mesh, str):
        return mesh
    return Shape(link, pose, "mesh", (), mesh[0] * _numbers(geometry, "scale", 3, "1 1 1", where), mesh[1])


def _positive(shape: Shape, where: str) -> Shape:
    if min(shape.size) <= 0:
        raise InputError(f"{where}: the size of its {shape.kind} is {shape.size}; more than 0 is expected")
    return shape


def _mesh_file(name: str, path: Path, packages: Sequence[str | Path]) -> Path | None:
    """The file of a mesh: beside the robot's, in a package, or below a folder above the robot's file."""
    for lead in ("package://", "model://"):
        if name.startswith(lead):
            package, _, rest = name[len(lead) :].partition("/")
            roots = [Path(p) for p in packages] + [p / package for p in map(Path, packages)]
            near = [p for p in roots if p.name == package] + [p / package for p in path.resolve().parents]
            near += [p for p in path.resolve().parents if p.name == package]
            return next((p / rest for p in near if (p / rest).is_file()), None)
    file = path.parent / name.removeprefix("file://")
    return file if name and file.is_file() else None


def _mesh(file: Path) -> tuple[np.ndarray, np.ndarray] | str:
    """Vertices (m) and triangles, or why they cannot be had."""
    if file.stat().st_size > _LARGEST_MESH:
        return f"{file} is larger than {_LARGEST_MESH // 1_000_000} MB"
    import trimesh  # slow to import

    try:
        mesh: Any = trimesh.load(str(file), force="mesh")
        vertices, faces = np.asarray(mesh.vertices, float), np.asarray(mesh.faces, int)
    except Exception as error:  # whatever a broken mesh makes of its reader
        return f"{file.name} cannot be read ({type(error).__name__}: {' '.join(str(error).split())[:80]})"
    if len(vertices) < 4 or len(faces) < 1 or not np.isfinite(vertices).all():
        return f"{file.name} holds no solid"
    return vertices, faces


def _of_mjcf(path: Path) -> tuple[tuple[Shape, ...], tuple[str, ...]]:
    mujoco, notes = engine(), []
    try:
        mj = compile_mjcf(path, kinematic=True, looks=True)
    except InputError:  # meshes are missing, most often
        mj = compile_mjcf(path, kinematic=True)
        notes.append(f"{path}: its meshes cannot be read; shapes that need them are left out")
    kinds: dict[int, Kind] = {
        int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
        int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
        int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
        int(mujoco.mjtGeom.mjGEOM_BOX): "box",
        int(mujoco.mjtGeom.mjGEOM_MESH): "mesh",
    }
    counts = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "mesh": 0}
    found = []
    for g in range(mj.ngeom):
        kind = kinds.get(int(mj.geom_type[g]))
        if kind is None or not (mj.geom_contype[g] or mj.geom_conaffinity[g]):
            continue
        pose, turned = np.eye(4), np.zeros(9)
        mujoco.mju_quat2Mat(turned, mj.geom_quat[g])
        pose[:3, :3], pose[:3, 3] = turned.reshape(3, 3), mj.geom_pos[g]
        arrays = _mj_mesh(mj, int(mj.geom_dataid[g])) if kind == "mesh" else (None, None)
        size = tuple(float(x) for x in mj.geom_size[g, : counts[kind]])
        found.append(Shape(body_name(mj, int(mj.geom_bodyid[g])), pose, kind, size, *arrays))
    return tuple(found), tuple(notes)


def _mj_mesh(mj: Any, index: int) -> tuple[np.ndarray, np.ndarray]:
    first, count = mj.mesh_vertadr[index], mj.mesh_vertnum[index]
    begin, faces = mj.mesh_faceadr[index], mj.mesh_facenum[index]
    return np.array(mj.mesh_vert[first : first + count], float), np.array(mj.mesh_face[begin : begin + faces], int)
