"""Robots from OpenUSD, as Isaac Sim, Newton and the converters of URDF and MJCF write them, without any mesh.

What UsdPhysics says of rigid bodies and joints is read, with what Newton's, MuJoCo's and PhysX's schemas add to it:
symmetric inertias, armature, damping, dry friction, springs, mimic joints, limits of velocity and effort. Stages may
be in any unit and with any axis up; the model is in metres and kilograms, in the axes of the stage.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError, check_names, check_switch
from ..rigid import inertia
from ..rigid.model import RobotModel
from .assembly import (
    ROOT_JOINT,
    FramePart,
    JointPart,
    LinkPart,
    Posture,
    Root,
    assemble,
    displacement,
    translation,
    wrong_moments,
)
from .usd_stage import DEGREE, ROTATIONS, TRANSLATIONS, Edge, Stage, body_inertia, name_of, reading, schemas, value
from .xmlfile import find_in_packages

__all__ = ["UsdJoint", "load_usd", "usd_joints", "usd_parts"]


class UsdJoint(NamedTuple):
    """What a stage says of a joint beside its motion, in SI units (rad, m, N m, N)."""

    armature: float = 0.0
    damping: float = 0.0
    friction: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    drive: dict[str, Any] | None = None  # kind, kp, kd and force, as a task's `actuator` states a drive


def load_usd(
    path: str | Path,
    joints: Sequence[str] | None = None,
    posture: Posture | None = None,
    gravity: Sequence[float] | None = None,
    root: Root | None = None,
    packages: Sequence[str | Path] = (),
    *,
    kinematic: bool = False,
) -> RobotModel:
    """Model of the robot in an OpenUSD stage (`.usd`, `.usda`, `.usdc`, `.usdz`); needs `usd-core`.

    `joints`, `posture`, `packages` and `kinematic` as in `load_urdf`. `gravity` (m/s^2) is that of the stage's physics
    scene where it is None, and 9.81 against the up axis where there is no scene. `root` None takes the base as the
    stage has it: a tree without a joint to the world moves freely. `fixed` holds it where it stands, `free_flyer` frees
    a base that a fixed joint holds.

    A rigid body is a link; a revolute, prismatic, spherical or fixed joint is one of the model, and so is a generic
    joint whose limits leave one axis, three rotations or all six free. The zero of a joint is where its two frames
    agree (less `mjc:ref`). Bodies, joints, sites and Xforms without shapes are frames. Where a body states no inertia,
    that of its colliders counts, if these are cubes, spheres, cylinders or capsules. A drive's gains are its
    controller's and no part of the robot; its greatest force is the effort limit.

    Raises `InputError` for a stage that does not open, and, with the names of the joints or bodies, for what is no
    tree: loops, two robots in one stage, joints that do not hold their axes; for moments that no body can have.

    >>> import pathlib, tempfile, figaroh_jax as fj
    >>> has = 'prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI"]'
    >>> bodies = [f'def Cube "{name}" ({has})\\n{{\\n float physics:mass = 2\\n}}\\n' for name in ("base", "arm")]
    >>> ends = "rel physics:body0 = </base>\\n rel physics:body1 = </arm>"
    >>> joint = f'def PhysicsRevoluteJoint "hinge"\\n{{\\n {ends}\\n}}\\n'
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = pathlib.Path(folder, "arm.usda").write_text("#usda 1.0\\n" + "".join(bodies) + joint)
    ...     fj.load_usd(f"{folder}/arm.usda", root="fixed").joint_names
    ('hinge',)
    """
    check_names("joints", joints)
    check_switch("kinematic", kinematic)
    file = find_in_packages(path, packages)
    with reading(file):
        stage = Stage(file)
        links, parts, frames, free = _parts(stage, root)
        own = stage.gravity() if gravity is None else gravity
    if free and joints is not None and free not in joints:
        joints = [free, *joints]
    return assemble(str(file), stage.name, (links, parts), joints, posture, own, "fixed", frames, kinematic=kinematic)


def usd_parts(
    path: str | Path, root: Root | None = None, packages: Sequence[str | Path] = ()
) -> tuple[list[LinkPart], list[JointPart]]:
    """Links and joints of the one robot of a stage."""
    file = find_in_packages(path, packages)
    with reading(file):
        return _parts(Stage(file), root)[:2]


def usd_joints(path: str | Path, packages: Sequence[str | Path] = ()) -> tuple[dict[str, UsdJoint], tuple[str, ...]]:
    """What acts at the joints of a stage, by name, and what of the stage acts and is not read."""
    file = find_in_packages(path, packages)
    with reading(file):
        stage = Stage(file)
        notes = [f"tendon '{name_of(prim)}'" for prim in stage.prims if prim.GetTypeName() == "MjcTendon"]
        held = [body.name for body in stage.bodies.values() if value(body.prim, "mjc:body:gravcomp", 0.0)]
        notes += [f"gravcomp of the bodies {', '.join(held)}"] if held else []
        return {edge.name: _acting(stage, edge) for edge in stage.edges}, tuple(notes)


def _parts(stage: Stage, root: Root | None) -> tuple[list[LinkPart], list[JointPart], list[FramePart], str]:
    """Links, joints and frames of the one robot of a stage, and the name of its free joint ("" for none)."""
    base, edges, beside = _tree(stage)
    if beside and root == "free_flyer":
        raise InputError(
            f"root: free_flyer, but the bodies {', '.join(beside)} are welded to the world as well as the base"
        )
    inside = [path for path in stage.bodies if path == base or any(path in edge.ends for edge in edges)]
    offset = {"": np.eye(4)} | {path: np.eye(4) for path in inside}
    for edge in edges:
        if edge.ends[0] or edge.kind != "fixed":  # the frame of a link is that of its last joint, in the body's axes
            offset[edge.ends[1]] = translation(-edge.frames[1][:3, 3])
    names = {path: stage.bodies[path].name for path in inside}
    names[""] = "world" if "world" not in names.values() else "world_of_the_stage"
    start, edges = _start(stage, base, edges, root, names)
    links = [_link(names[path], body_inertia(stage, path), offset[path]) for path in inside]
    parts, inner = _joints(stage, edges, names, offset)
    frames = [
        FramePart(names[path], names[path], offset[path])
        for path in inside if not np.array_equal(offset[path], np.eye(4))
    ]  # fmt: skip
    if any(part.parent == names[""] for part in (*start, *parts)):
        links.insert(0, LinkPart(names[""], np.zeros(10)))
    else:
        names[""] = names[base]
    for path in beside:  # they neither move nor work
        names[path], offset[path] = names[""], stage.bodies[path].pose
        frames.append(FramePart(stage.bodies[path].name, names[""], offset[path]))
    frames += _frames(stage, names, offset)
    return [*links, *inner], [*start, *parts], frames, start[0].name if start and start[0].kind == "free" else ""


def _link(name: str, ten: Float[np.ndarray, "10"], pose: Float[np.ndarray, "4 4"]) -> LinkPart:
    return LinkPart(name, inertia.transform(ten, pose), wrong_moments(inertia.to_com(ten)[2]) if ten[0] > 0 else "")


def _start(
    stage: Stage, base: str, edges: list[Edge], root: Root | None, names: dict[str, str]
) -> tuple[list[JointPart], list[Edge]]:
    """What holds the base or lets it fly, and the other joints."""
    held = [edge for edge in edges if edge.ends[0] == ""]
    if held and held[0].kind != "fixed":
        if root == "free_flyer":
            raise InputError(f"root: free_flyer, but joint '{held[0].name}' joins the base to the world")
        return [], edges
    place = held[0].frames[0] @ np.linalg.inv(held[0].frames[1]) if held else stage.bodies[base].pose
    edges = [edge for edge in edges if edge not in held]
    if root == "free_flyer" or (root is None and not held):
        free = JointPart(ROOT_JOINT, "free", names[""], names[base], np.eye(4), np.zeros(3), neutral=_numbers(place))
        return [free], edges
    if np.allclose(place, np.eye(4), rtol=0, atol=1e-9):
        return [], edges
    return [
        JointPart(held[0].name if held else "world_joint", "fixed", names[""], names[base], place, np.zeros(3))
    ], edges


def _numbers(pose: Float[np.ndarray, "4 4"]) -> tuple[float, ...]:
    """The pose as the numbers of a free joint."""
    from scipy.spatial.transform import Rotation

    return tuple(map(float, (*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_quat())))


def _tree(stage: Stage) -> tuple[str, list[Edge], list[str]]:
    """Base of the robot, its joints from the base outwards, each from parent to child, and bodies welded beside it."""
    groups = list[set[str]]()
    for edge in stage.edges:
        ends = {end for end in edge.ends if end}
        touching = [group for group in groups if group & ends]
        groups = [group for group in groups if group not in touching] + [ends.union(*touching)]
    moving = [g for g in groups if any(e.kind != "fixed" and g & set(e.ends) for e in stage.edges)]
    if not moving:
        raise InputError("no joint that moves joins its rigid bodies; a robot is a tree of them")
    if len(moving) > 1:
        heads = ", ".join(f"'{next(path for path in stage.bodies if path in group)}'" for group in moving)
        raise InputError(
            f"{len(moving)} separate robots begin at the bodies {heads}; a file has one: join or remove them"
        )
    for path, body in stage.bodies.items():
        above = stage.carrier(body.prim.GetParent())
        if above in moving[0] and not any(path in group for group in groups):
            raise InputError(f"no joint carries the body '{body.name}' below '{stage.bodies[above].name}'; join them")
    own = [edge for edge in stage.edges if moving[0] & set(edge.ends)]
    base = _base(stage, moving[0], own)
    beside = [path for group in groups if group is not moving[0] for path in sorted(group)]
    return base, _outwards(base, own), beside


def _outwards(base: str, edges: Sequence[Edge]) -> list[Edge]:
    """The joints turned from parent to child, those of the world first; `InputError` for one that closes a loop."""
    queue, known, found, left = [base], {base, ""}, list[Edge](), list(edges)
    world = [edge if edge.ends[0] == "" else _reversed(edge) for edge in left if "" in edge.ends]
    left = [edge for edge in left if "" not in edge.ends]
    for edge in world:
        if edge.ends[1] != base or (edge is not world[0] and not (_stacks(edge) and _stacks(world[0]))):
            _refuse_loop(edge, world[:1])
    while queue:
        at = queue.pop(0)
        own = [edge for edge in left if at in edge.ends]
        left = [edge for edge in left if at not in edge.ends]
        for edge in own:
            edge = edge if edge.ends[0] == at else _reversed(edge)
            before = [other for other in found if other.ends[1] == edge.ends[1]]
            beside = all(other.ends == edge.ends and _stacks(other) for other in (edge, *before))
            if edge.ends[1] in known and not (before and beside):
                _refuse_loop(edge, before)
            queue += [edge.ends[1]] if edge.ends[1] not in known else []
            known.add(edge.ends[1])
            found.append(edge)
    order = {edge.prim.GetPath(): k for k, edge in enumerate(edges)}
    return world + sorted(found, key=lambda edge: order[edge.prim.GetPath()])


def _refuse_loop(edge: Edge, others: Sequence[Edge]) -> None:
    by = ", ".join(f"'{other.name}'" for other in others) or "the world"
    raise InputError(
        f"joint '{edge.name}' closes a kinematic loop: the body '{edge.ends[1]}' is carried by {by} already; a robot "
        "is a tree: lock the joints of the loop or take this one out"
    )


def _base(stage: Stage, group: set[str], edges: Sequence[Edge]) -> str:
    """The body held to the world, else the one marked as an articulation's root, else the one that nothing carries."""
    ends = [edge.ends for edge in edges]
    held = [max(pair) for pair in ends if "" in pair]
    marked = [
        path for path in stage.bodies
        if path in group and stage.bodies[path].prim.HasAPI(stage.pxr.UsdPhysics.ArticulationRootAPI)
    ]  # fmt: skip
    first = [path for path in stage.bodies if path in group and path not in {pair[1] for pair in ends}]
    return (held or marked or first or [path for path in stage.bodies if path in group])[0]


def _stacks(edge: Edge) -> bool:
    """Whether joints between the same two bodies add their motions: MuJoCo's do."""
    return edge.kind in ("revolute", "prismatic") and "MjcJointAPI" in schemas(edge.prim)


def _reversed(edge: Edge) -> Edge:
    return edge._replace(axis=-edge.axis, ends=edge.ends[::-1], frames=edge.frames[::-1])


def _chains(edges: Sequence[Edge]) -> Iterator[list[Edge]]:
    """Joints between the same two bodies together."""
    together: dict[tuple[str, str], list[Edge]] = {}
    for edge in edges:
        together.setdefault(edge.ends, []).append(edge)
    yield from together.values()


def _joints(
    stage: Stage, edges: Sequence[Edge], names: dict[str, str], offset: dict[str, np.ndarray]
) -> tuple[list[JointPart], list[LinkPart]]:
    """Joints of the model, those between the same two bodies one after another with massless links between."""
    parts, inner = [], []
    leaders = {str(edge.prim.GetPath()): edge for edge in edges}
    for chain in _chains(edges):
        parent, child = chain[0].ends
        carrier, pose = names[parent], offset[parent] @ chain[0].frames[0] @ np.linalg.inv(chain[0].frames[1])
        for edge in chain:
            link = names[child] if edge is chain[-1] else f"{edge.name}_link"
            if edge is not chain[-1]:
                inner.append(LinkPart(link, np.zeros(10)))
            turn, shift, ref = edge.frames[1][:3, :3], edge.frames[1][:3, 3], _reference(stage, edge)
            axis, placement = turn @ edge.axis, pose @ translation(shift)
            if ref:
                placement = placement @ displacement(edge.kind, axis, np.array([-ref]))
            limit, mimic, neutral = _limit(stage, edge), _mimic(stage, edge, leaders), (ref,) if ref else ()
            parts.append(JointPart(edge.name, edge.kind, carrier, link, placement, axis, limit, mimic, neutral))  # pyright: ignore[reportArgumentType]
            carrier, pose = link, translation(-shift)
    return parts, inner


def _unit(stage: Stage, edge: Edge) -> float:
    """Of UsdPhysics' positions of a joint in rad or m: degrees, lengths of the stage."""
    return DEGREE if edge.kind == "revolute" else stage.metre


def _moment(stage: Stage, edge: Edge) -> float:
    """Of a stage's forces (prismatic) or torques in N or N m."""
    return stage.kilogram * stage.metre ** (2 if edge.kind == "revolute" else 1)


def _reference(stage: Stage, edge: Edge) -> float:
    """MuJoCo's `ref` in rad or m: the position of the joint where its frames agree; 0 for other joints."""
    if edge.kind not in ("revolute", "prismatic"):
        return 0.0
    angle = edge.kind == "revolute" and stage.degrees()
    return float(value(edge.prim, "mjc:ref", 0.0)) * (DEGREE if angle else 1.0)


def _limit(stage: Stage, edge: Edge) -> tuple[float, float, float, float]:
    """Lower, upper, velocity and effort limit; infinite where the stage gives none."""
    lower, upper, fast, strong = -np.inf, np.inf, np.inf, np.inf
    if edge.kind not in ("revolute", "prismatic"):
        return lower, upper, fast, strong
    prim, unit = edge.prim, _unit(stage, edge)
    physics = stage.pxr.UsdPhysics
    if prim.GetTypeName() == "PhysicsJoint":
        token = (ROTATIONS if edge.kind == "revolute" else TRANSLATIONS)[int(np.abs(edge.axis).argmax())]
        own = physics.LimitAPI(prim, token)
        bounds = (own.GetLowAttr().Get(), own.GetHighAttr().Get()) if prim.HasAPI(physics.LimitAPI, token) else ()
    else:
        token = "angular" if edge.kind == "revolute" else "linear"
        bounds = (prim.GetAttribute("physics:lowerLimit").Get(), prim.GetAttribute("physics:upperLimit").Get())
    if bounds:
        lower, upper = (float(bound) * unit for bound in bounds)
    if lower > upper:
        raise InputError(f"joint '{edge.name}': its lower limit {lower:g} is above the upper one {upper:g}")
    for name in ("newton:velocityLimit", "physxJoint:maxJointVelocity"):
        fast = min(fast, float(value(prim, name, np.inf)) * unit)
    strong = float(value(prim, f"drive:{token}:physics:maxForce", np.inf)) * _moment(stage, edge)
    strong = min(strong, float(value(prim, "urdf:limit:effort", np.inf)), _mujoco_effort(stage, edge))
    return lower, upper, fast, strong


def _mujoco_effort(stage: Stage, edge: Edge) -> float:
    """Largest torque that MuJoCo's attributes let the drives of a joint give; infinite without a limit."""
    total = _range(edge.prim, "mjc:actuatorfrc", "mjc:actuatorfrcrange")
    sums = []
    for prim in stage.prims:
        if prim.GetTypeName() != "MjcActuator" or prim.GetPath() == edge.prim.GetPath():
            continue
        targets = prim.GetRelationship("mjc:target")
        if targets and edge.prim.GetPath() in targets.GetTargets():
            gain, bias = value(prim, "mjc:gainPrm", [1.0]), [*value(prim, "mjc:biasPrm", []), 0.0, 0.0, 0.0]
            plain = value(prim, "mjc:gainType", "fixed") == "fixed" and not any(bias[1:3])
            force = _range(prim, "mjc:force", "mjc:forceRange")
            control = _range(prim, "mjc:ctrl", "mjc:ctrlRange") * abs(gain[0]) if plain else np.inf
            sums.append(min(force, control) * abs(value(prim, "mjc:gear", [1.0])[0]))
    return float(min(total, sum(sums) if sums else np.inf))


def _range(prim: Any, limited: str, name: str) -> float:
    """Larger bound of one of MuJoCo's ranges; infinite where it is not in force."""
    low, high = float(value(prim, f"{name}:min", 0.0)), float(value(prim, f"{name}:max", 0.0))
    stated = value(prim, f"{limited}limited" if limited.endswith("frc") else f"{limited}Limited", "auto")
    in_force = stated == "true" or (stated == "auto" and low != high)
    return max(abs(low), abs(high)) if in_force else np.inf


def _mimic(stage: Stage, edge: Edge, leaders: dict[str, Edge]) -> tuple[str, float, float] | None:
    """Joint that it follows, ratio and offset, by Newton's schema (and MuJoCo's, which builds on it) or PhysX's."""
    prim = edge.prim
    relation, found = prim.GetRelationship("newton:mimicJoint"), None
    if relation and relation.GetTargets() and value(prim, "newton:mimicEnabled", True):
        if any(value(prim, f"mjc:coef{k}", 0.0) for k in (2, 3, 4)):
            raise InputError(
                f"joint '{edge.name}' follows another by a curve (mjc:coef2 and above); a line is expected"
            )
        ratio, offset = value(prim, "newton:mimicCoef1", 1.0), value(prim, "newton:mimicCoef0", 0.0)
        found = str(relation.GetTargets()[0]), float(ratio), float(offset) * _unit(stage, edge)
    for schema in schemas(prim):
        if schema.startswith("PhysxMimicJointAPI"):  # q + gearing * leader + offset = 0
            own = f"physxMimicJoint:{schema.partition(':')[2]}"
            targets = prim.GetRelationship(f"{own}:referenceJoint").GetTargets()
            gearing, offset = float(value(prim, f"{own}:gearing", 1.0)), float(value(prim, f"{own}:offset", 0.0))
            found = str(targets[0]) if targets else "", -gearing, -offset * _unit(stage, edge)
    if found is None:
        return None
    path, ratio, offset = found
    if path not in leaders:
        raise InputError(f"joint '{edge.name}' mimics '{path}', which is not a joint of the robot")
    leader = leaders[path]
    return leader.name, ratio, offset + _reference(stage, edge) - ratio * _reference(stage, leader)


def _acting(stage: Stage, edge: Edge) -> UsdJoint:
    """What acts at a joint, by Newton's, MuJoCo's or PhysX's attributes, whichever the stage gives."""
    if edge.kind == "fixed":
        return UsdJoint()
    prim, angle, moment = edge.prim, edge.kind in ("revolute", "spherical"), _moment(stage, edge)
    per = 1.0 / DEGREE if angle else 1.0 / stage.metre  # of gains that count degrees
    mass = stage.kilogram * (stage.metre**2 if angle else 1.0)
    armature = value(prim, "newton:armature", value(prim, "mjc:armature", value(prim, "physxJoint:armature", 0.0)))
    friction = value(prim, "newton:friction", value(prim, "mjc:frictionloss", 0.0))
    damping = (
        float(value(prim, "newton:damping", 0.0)) * per * moment or float(value(prim, "mjc:damping", 0.0)) * moment
    )
    rest = float(value(prim, "mjc:springref", 0.0)) * (DEGREE if angle and stage.degrees() else 1.0)
    stiffness, drive, token = float(value(prim, "mjc:stiffness", 0.0)), None, "angular" if angle else "linear"
    if prim.HasAPI(stage.pxr.UsdPhysics.DriveAPI, token):
        own = f"drive:{token}:physics"
        if value(prim, f"{own}:type", "force") != "force":
            raise InputError(f"joint '{edge.name}': its drive is of type acceleration; a drive of type force is read")
        kp, kd = (float(value(prim, f"{own}:{gain}", 0.0)) * per * moment for gain in ("stiffness", "damping"))
        force = float(value(prim, f"{own}:maxForce", np.inf)) * moment
        kind = "position" if kp else "velocity"
        drive = {"kind": kind, "kp": kp or None, "kd": kd, "force": force if np.isfinite(force) else None}
    return UsdJoint(float(armature) * mass, damping, float(friction) * moment, stiffness, rest, drive)


def _frames(stage: Stage, names: dict[str, str], offset: dict[str, np.ndarray]) -> list[FramePart]:
    """Xforms without shapes and sites, each once, at the link that carries them."""
    shaped = set[str]()
    for prim in stage.prims:
        site = bool({"MjcSiteAPI", "NewtonSiteAPI"} & set(schemas(prim)))
        if prim.IsA(stage.pxr.UsdGeom.Gprim) and not site:
            while prim and str(prim.GetPath()) not in shaped and str(prim.GetPath()) not in stage.bodies:
                shaped.add(str(prim.GetPath()))
                prim = prim.GetParent()
    default, frames = stage.stage.GetDefaultPrim(), dict[str, FramePart]()
    taken = {*names.values(), *(edge.name for edge in stage.edges)}
    for prim in stage.prims:
        path = str(prim.GetPath())
        plain = (
            prim.GetTypeName() == "Xform" and path not in shaped and not (prim.IsInstance() or prim.IsInstanceProxy())
        )
        site = bool({"MjcSiteAPI", "NewtonSiteAPI"} & set(schemas(prim)))
        if not (plain or site) or path in stage.bodies or prim == default or name_of(prim) in taken:
            continue
        body, pose, _ = stage.in_body(prim)
        if body in names:
            frames.setdefault(name_of(prim), FramePart(name_of(prim), names[body], offset[body] @ pose))
    return list(frames.values())
