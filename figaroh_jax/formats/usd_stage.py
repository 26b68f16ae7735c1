"""An open OpenUSD stage: its units, its rigid bodies with what they weigh, and its joints as the file has them.

Everything that asks `pxr` for a prim's place, schema or unit stands here; `usd` makes a robot of it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..rigid import inertia
from ..rigid.model import Kind
from .assembly import displacement, refuse_many
from .files import plain_file

__all__ = [
    "DEGREE",
    "ROTATIONS",
    "TRANSLATIONS",
    "Body",
    "Edge",
    "Stage",
    "body_inertia",
    "name_of",
    "reading",
    "schemas",
    "value",
]

_LARGEST = 200_000_000  # bytes of the root layer; meshes may stand in it
ROTATIONS, TRANSLATIONS = ("rotX", "rotY", "rotZ"), ("transX", "transY", "transZ")
DEGREE = np.pi / 180
_WATER = 1000.0  # kg/m^3, the density that UsdPhysics gives a collider that states none


class Body(NamedTuple):
    """A rigid body of a stage."""

    name: str
    prim: Any
    pose: Float[np.ndarray, "4 4"]  # in the stage, m
    scale: Float[np.ndarray, "3"]  # of its axes: local points are in these units, times the stage's


class Edge(NamedTuple):
    """A joint between two bodies ("" for the world); the frames are in the bodies, in m."""

    name: str
    prim: Any
    kind: Kind | str
    axis: Float[np.ndarray, "3"]  # in the joint's frames, which agree at zero
    ends: tuple[str, str]
    frames: tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "4 4"]]


class reading:
    """Errors of the reader and of `pxr` as one message that names the file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, InputError):
            raise InputError(f"{self.file}: {str(error).removeprefix(f'{self.file}: ')}") from None
        if isinstance(error, Exception) and type(error).__module__.startswith(("pxr", "Boost")):
            raise InputError(f"{self.file}: OpenUSD does not read it: {' '.join(str(error).split())}") from None


def _pxr() -> Any:
    try:
        import pxr.Gf
        import pxr.Tf
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.UsdPhysics
    except ImportError:
        raise InputError("USD is read by usd-core; install it: pip install 'figaroh-jax[usd]'") from None
    return pxr


class Stage:
    """An open stage: its units, bodies and joints."""

    def __init__(self, file: Path) -> None:
        self.pxr = _pxr()
        usd, geom, physics = self.pxr.Usd, self.pxr.UsdGeom, self.pxr.UsdPhysics
        plain_file(file, str(file), "a robot model", _LARGEST, (".usd", ".usda", ".usdc", ".usdz"))
        self.stage = usd.Stage.Open(str(file))
        missing = self.stage.GetCompositionErrors() if hasattr(self.stage, "GetCompositionErrors") else []
        if missing:
            raise InputError(f"a layer that it names cannot be read: {missing[0]}")
        self.metre = geom.GetStageMetersPerUnit(self.stage)
        self.kilogram = physics.GetStageKilogramsPerUnit(self.stage)
        self.up = np.eye(3)["XYZ".index(geom.GetStageUpAxis(self.stage))]
        self._cache = geom.XformCache(usd.TimeCode.Default())
        self.prims = list(usd.PrimRange.Stage(self.stage, usd.TraverseInstanceProxies()))
        refuse_many("", "prims with a rigid body", sum(p.HasAPI(physics.RigidBodyAPI) for p in self.prims))
        self.scene = next((p for p in self.prims if p.IsA(physics.Scene)), None)
        default = self.stage.GetDefaultPrim()
        self.name = name_of(default) if default else file.stem
        self.bodies = self._bodies()
        self.edges = [edge for prim in self.prims if prim.IsA(physics.Joint) and (edge := self._edge(prim)) is not None]

    def gravity(self) -> list[float]:
        """Of the physics scene in m/s^2, or 9.81 against the up axis."""
        physics, way, size = self.pxr.UsdPhysics, np.zeros(3), -np.inf
        if self.scene is not None:
            scene = physics.Scene(self.scene)
            way = np.array(scene.GetGravityDirectionAttr().Get(), float)
            size = float(scene.GetGravityMagnitudeAttr().Get())
            if not value(self.scene, "newton:gravityEnabled", True):
                return [0.0, 0.0, 0.0]
        way = way / np.linalg.norm(way) if way.any() else -self.up
        return (way * (9.81 if size < 0 else size * self.metre)).tolist()

    def degrees(self) -> bool:
        """Whether MuJoCo's own attributes of hinges are in degrees."""
        return self.scene is None or value(self.scene, "mjc:compiler:angle", "degree") == "degree"

    def pose(self, prim: Any) -> tuple[np.ndarray, np.ndarray]:
        """Pose of a prim in the stage (m) and the scale of its axes; `InputError` where they are skewed."""
        matrix = np.array(self._cache.GetLocalToWorldTransform(prim), float).T
        scale = np.linalg.norm(matrix[:3, :3], axis=0)
        turn = matrix[:3, :3] / np.where(scale > 0, scale, 1.0)
        if not np.allclose(turn.T @ turn, np.eye(3), rtol=0, atol=1e-5):
            raise InputError(f"prim {prim.GetPath()}: its axes are skewed or of no length; a rigid body is not sheared")
        u, _, v = np.linalg.svd(turn)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = u @ v, matrix[:3, 3] * self.metre
        if np.linalg.det(u @ v) < 0:
            raise InputError(f"prim {prim.GetPath()}: its axes are mirrored (a negative scale)")
        return pose, scale

    def carrier(self, prim: Any) -> str:
        """Path of the rigid body that a prim belongs to, "" for none."""
        while prim and str(prim.GetPath()) not in self.bodies:
            prim = prim.GetParent()
        return str(prim.GetPath()) if prim else ""

    def in_body(self, prim: Any) -> tuple[str, np.ndarray, np.ndarray]:
        """Body of a prim, the prim's pose in it (in the stage for none) and the scale of its axes."""
        body = self.carrier(prim)
        pose, scale = self.pose(prim)
        return body, (np.linalg.inv(self.bodies[body].pose) @ pose if body else pose), scale

    def _bodies(self) -> dict[str, Body]:
        api, found = self.pxr.UsdPhysics.RigidBodyAPI, {}
        for prim in self.prims:
            if prim.HasAPI(api) and api(prim).GetRigidBodyEnabledAttr().Get() is not False:
                found[str(prim.GetPath())] = Body(name_of(prim), prim, *self.pose(prim))
        if not found:
            raise InputError("no prim is a rigid body (PhysicsRigidBodyAPI); a robot's links are")
        return found

    def _edge(self, prim: Any) -> Edge | None:
        joint, path = self.pxr.UsdPhysics.Joint(prim), prim.GetPath()
        if joint.GetJointEnabledAttr().Get() is False:
            return None
        ends, frames = [], []
        for side in "01":
            targets = getattr(joint, f"GetBody{side}Rel")().GetTargets()
            if len(targets) > 1:
                raise InputError(f"joint {path}: body{side} has {len(targets)} targets; one is expected")
            target = self.stage.GetPrimAtPath(targets[0]) if targets else None
            if targets and not target:
                raise InputError(f"joint {path}: body{side}, {targets[0]}, does not exist")
            body, pose, scale = self.in_body(target) if target else ("", np.eye(4), np.ones(3))
            local = _pose(
                np.array(getattr(joint, f"GetLocalPos{side}Attr")().Get(), float) * scale * self.metre,
                getattr(joint, f"GetLocalRot{side}Attr")().Get(),
            )
            ends.append(body)
            frames.append(pose @ local)
        if ends[0] == ends[1]:
            raise InputError(f"joint {path}: joins {ends[0] or 'the world'} to itself")
        if joint.GetExcludeFromArticulationAttr().Get():
            raise InputError(
                f"joint {path} closes a kinematic loop (excludeFromArticulation) between {ends[0] or 'the world'} and "
                f"{ends[1] or 'the world'}; a robot is a tree: disable the joint or take it out"
            )
        return Edge(name_of(prim), prim, *self._motion(prim), (ends[0], ends[1]), (frames[0], frames[1]))

    def _motion(self, prim: Any) -> tuple[str, np.ndarray]:
        """Kind and axis of a joint."""
        physics = self.pxr.UsdPhysics
        for schema, kind in ((physics.RevoluteJoint, "revolute"), (physics.PrismaticJoint, "prismatic")):
            if prim.IsA(schema):
                return kind, np.eye(3)["XYZ".index(schema(prim).GetAxisAttr().Get())]
        if prim.IsA(physics.FixedJoint):
            return "fixed", np.zeros(3)
        if prim.IsA(physics.SphericalJoint):
            return "spherical", np.zeros(3)
        if prim.GetTypeName() == "PhysicsJoint":
            return _generic(prim, physics)
        raise InputError(
            f"joint {prim.GetPath()}: a {prim.GetTypeName()} does not hold its bodies to fixed axes; fixed, revolute, "
            "prismatic, spherical and generic joints are read"
        )


def value(prim: Any, name: str, default: Any = None) -> Any:
    """An attribute that the file gives, in whatever schema; `default` where it gives none."""
    attribute = prim.GetAttribute(name)
    found = attribute.Get() if attribute and attribute.HasAuthoredValue() else None
    return default if found is None else found


def name_of(prim: Any) -> str:
    """What the robot's own file called it, where the name is no identifier of USD."""
    return prim.GetDisplayName() or prim.GetName()


def _pose(position: Float[np.ndarray, "3"], quaternion: Any) -> Float[np.ndarray, "4 4"]:
    numbers = np.array([*quaternion.GetImaginary(), quaternion.GetReal()], float)
    if not np.linalg.norm(numbers) > 0.5:  # a zero quaternion is USD's "none given"
        numbers = np.array([0.0, 0.0, 0.0, 1.0])
    return displacement("free", np.zeros(3), np.concatenate([position, numbers]))


def _generic(prim: Any, physics: Any) -> tuple[str, np.ndarray]:
    """Kind and axis of a generic (D6) joint by the axes that its limits leave free."""
    free = []
    for token in (*TRANSLATIONS, *ROTATIONS):
        limit = physics.LimitAPI(prim, token)
        low, high = limit.GetLowAttr().Get(), limit.GetHighAttr().Get()
        if not (prim.HasAPI(physics.LimitAPI, token) and low is not None and high is not None and low > high):
            free.append(token)
    turning, sliding = [t for t in free if t in ROTATIONS], [t for t in free if t in TRANSLATIONS]
    kinds = {(0, 0): "fixed", (1, 0): "revolute", (0, 1): "prismatic", (3, 0): "spherical", (3, 3): "free"}
    kind, axis = kinds.get((len(turning), len(sliding))), np.zeros(3)
    if len(free) == 1 or (len(turning), len(sliding)) == (1, 2) and turning[0][-1] not in {t[-1] for t in sliding}:
        axis["XYZ".index((turning or sliding)[0][-1])] = 1.0
        kind = kind or "planar"
    if kind is None:
        raise InputError(f"joint {prim.GetPath()}: its limits leave {', '.join(free)} free; no kind of joint does")
    return kind, axis


def schemas(prim: Any) -> list[str]:
    """Names of the API schemas that are applied to a prim, such as `PhysicsRigidBodyAPI`."""
    return list(prim.GetPrimTypeInfo().GetAppliedAPISchemas())


def body_inertia(stage: Stage, path: str) -> Float[np.ndarray, "10"]:
    """Inertia of a body in its own frame: what its mass schema states, else what its colliders weigh."""
    body, api = stage.bodies[path], stage.pxr.UsdPhysics.MassAPI(stage.bodies[path].prim)
    mass = float(value(body.prim, "physics:mass", 0.0)) * stage.kilogram
    com = np.array(value(body.prim, "physics:centerOfMass", [-np.inf] * 3), float) * body.scale * stage.metre
    moments = _moments(stage, body.prim, api)
    if mass < 0:
        raise InputError(f"body '{body.name}': its mass is {mass:g} kg; it cannot be negative")
    if mass > 0 and moments is not None and np.isfinite(com).all():
        return inertia.from_com(mass, com, moments)
    shapes = _colliders(stage, path)
    if shapes is None:  # nothing has a shape: a mass without extent, or none
        return inertia.from_com(
            mass, np.where(np.isfinite(com), com, 0.0), np.zeros((3, 3)) if moments is None else moments
        )
    weight, centre, about = inertia.to_com(shapes)
    if mass > 0 and weight > 0:
        weight, about = mass, about * (mass / weight)
    return inertia.from_com(
        weight, com if np.isfinite(com).all() else centre, about if moments is None else moments
    )  # fmt: skip


def _moments(stage: Stage, prim: Any, api: Any) -> Float[np.ndarray, "3 3"] | None:
    """Moments about the centre of mass in the body's axes; None where the stage gives none."""
    unit = stage.kilogram * stage.metre**2
    full = np.array(value(prim, "newton:inertia", []), float)
    if full.size == 6:
        xx, yy, zz, xy, xz, yz = full * unit
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    diagonal = np.array(value(prim, "physics:diagonalInertia", np.zeros(3)), float) * unit
    if not diagonal.any():
        return None
    turn = _pose(np.zeros(3), api.GetPrincipalAxesAttr().Get())[:3, :3]
    return turn @ np.diag(diagonal) @ turn.T


def _colliders(stage: Stage, path: str) -> Float[np.ndarray, "10"] | None:
    """What the colliders of a body weigh together, in the body's frame; None where it has none."""
    physics, body = stage.pxr.UsdPhysics, stage.bodies[path]
    solid = [p for p in stage.prims if p.HasAPI(physics.CollisionAPI) and value(p, "physics:collisionEnabled", True)]
    found = [prim for prim in solid if stage.carrier(prim) == path]
    if not found:
        return None
    total = np.zeros(10)
    for prim in found:
        volume, moments = _shape(stage, prim, body.name)
        density = float(value(prim, "physics:density", 0.0)) or float(value(body.prim, "physics:density", 0.0))
        density = density * stage.kilogram / stage.metre**3 or _WATER
        mass = float(value(prim, "physics:mass", 0.0)) * stage.kilogram or density * volume
        pose = stage.in_body(prim)[1]
        total = total + inertia.transform(inertia.from_com(mass, np.zeros(3), mass * moments), pose)
    return total


def _shape(stage: Stage, prim: Any, body: str) -> tuple[float, Float[np.ndarray, "3 3"]]:
    """Volume (m^3) of a solid collider and its moments for a unit of mass, about its own origin."""
    kind, scale = str(prim.GetTypeName()), stage.pose(prim)[1] * stage.metre
    get = lambda name: float(prim.GetAttribute(name).Get())  # noqa: E731
    if kind == "Cube":
        x, y, z = get("size") * scale
        return x * y * z, np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) / 12
    if kind == "Sphere":
        radius = get("radius") * scale[0]
        return 4 / 3 * np.pi * radius**3, 0.4 * radius**2 * np.eye(3)
    if kind in ("Cylinder", "Capsule"):
        along = "XYZ".index(prim.GetAttribute("axis").Get())
        r, h = get("radius") * scale[along - 1], get("height") * scale[along]
        middle, ends = np.pi * r * r * h, 4 / 3 * np.pi * r**3 if kind == "Capsule" else 0.0
        axial = middle * r * r / 2 + ends * 0.4 * r * r
        across = middle * (h * h / 12 + r * r / 4) + ends * (0.4 * r * r + 0.375 * r * h + h * h / 4)
        moments = np.full(3, across)
        moments[along] = axial
        return middle + ends, np.diag(moments) / (middle + ends)
    raise InputError(
        f"body '{body}' states no inertia, and that of its collider {prim.GetPath()}, a {kind}, is not computed; "
        "give the body physics:mass, physics:centerOfMass and physics:diagonalInertia"
    )
