"""Robots from MJCF, MuJoCo's format, read through MuJoCo's own compiler and without any mesh that can be missed.

What the compiler makes of defaults, includes, frames and inertias is what is read: the tree of bodies, their inertias,
joints, sites, couplings and limits. Geoms count where a body has its inertia from them; contacts are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..errors import InputError, check_names, check_switch
from ..rigid import inertia
from ..rigid.model import Kind, RobotModel
from .assembly import (
    ROOT_JOINT,
    FramePart,
    JointPart,
    LinkPart,
    Posture,
    Root,
    assemble,
    displacement,
    refuse_many,
    translation,
    wrong_moments,
)
from .xmlfile import find_in_packages, read_xml

__all__ = [
    "actuator_of",
    "body_name",
    "compile_mjcf",
    "compiled_robot",
    "disabled",
    "engine",
    "joint_names",
    "load_mjcf",
    "mjcf_parts",
]

_KINDS: tuple[Kind, ...] = ("free", "spherical", "prismatic", "revolute")  # in the order of MuJoCo's numbers
_NUMBERS = (7, 4, 1, 1)
_LARGEST_COUNT = 10_000
_COUNTS = {  # attributes that make much of little
    "replicate": ("count",),
    "composite": ("count",),
    "flexcomp": ("count",),
    "hfield": ("nrow", "ncol"),
    "texture": ("width", "height"),
    "numeric": ("size",),
    "size": (
        *("nuser_body", "nuser_jnt", "nuser_geom", "nuser_site", "nuser_cam", "nuser_tendon", "nuser_actuator"),
        *("nuser_sensor", "nkey", "nuserdata"),
    ),
}


def load_mjcf(
    path: str | Path,
    joints: Sequence[str] | None = None,
    posture: Posture | None = None,
    gravity: Sequence[float] | None = None,
    root: Root | None = None,
    packages: Sequence[str | Path] = (),
    *,
    kinematic: bool = False,
) -> RobotModel:
    """Model of the robot in an MJCF file; needs MuJoCo, which a user of MJCF has.

    `joints`, `posture`, `packages` and `kinematic` as in `load_urdf`: for postures alone, moments that MuJoCo refuses
    pass. Locked joints stand at the file's own `qpos0` where `posture` says nothing. `gravity` (m/s^2) is the file's
    where it is None. `root` None takes the base as the file has it; `fixed` locks the free joints of the file;
    `free_flyer` frees a base that the file welds to the world. Free joints that are not locked stand in front of
    `joints` where it does not name them.

    Bodies are links, welded bodies are merged into what carries them, and every body, joint and site is a frame. A body
    with several joints is a chain of them with massless links between. Positions are MuJoCo's `qpos` (a `ref` is in
    the placement), but for quaternions: x y z w here, w x y z in MuJoCo. Velocities are MuJoCo's `qvel`, but for the
    linear part of a free joint: in the axes of the body here, of the world in MuJoCo; angular parts are in the body's
    axes in both. An equality that couples two joints linearly makes one mimic the other, exactly where MuJoCo keeps
    it softly. What stands at the joints besides (armature, damping, ...) is not part of this model: `load_extended`.

    Raises `InputError` for a file that MuJoCo does not compile, for a loop that an equality closes, and for couplings
    that are not linear.

    >>> import tempfile, figaroh_jax as fj
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fj.write_model(fj.extend(fj.load_urdf(fj.DEMO)), folder)
    ...     fj.load_mjcf(f"{folder}/robot.xml").joint_names
    ('waist', 'shoulder', 'elbow', 'wrist')
    """
    check_switch("kinematic", kinematic)
    path = find_in_packages(path, packages)
    mj = compile_mjcf(path, kinematic=kinematic)
    return compiled_robot(str(path), mj, joints, posture, gravity, root, kinematic=kinematic)


def compile_mjcf(path: str | Path, *, kinematic: bool = False, looks: bool = False) -> Any:
    """The compiled `mujoco.MjModel`, without meshes, textures and sensors that say nothing about the dynamics.

    `looks` keeps those. `kinematic`: moments of inertia that MuJoCo refuses are in the model as the file has them.
    """
    mujoco = engine()
    _check_counts(Path(path), read_xml(path, "mujoco"))
    try:
        with _unlogged(mujoco):
            spec = mujoco.MjSpec.from_file(str(path))
        if spec.flexes:
            raise InputError(f"{path}: has a flex, '{spec.flexes[0].name}'; a robot here is a tree of rigid bodies")
        if not looks:
            _drop_looks(mujoco, spec)
        aside = _set_aside(mujoco, spec) if kinematic else []
        mj = spec.compile()
        for body, principal, axes in aside:
            mj.body_inertia[body.id] = principal
            mj.body_iquat[body.id] = mj.body_iquat[body.id] if axes is None else axes
        return mj
    except InputError:
        raise
    except Exception as error:  # MuJoCo's own kinds, and what its Python layer makes of bytes that are no UTF-8
        raise InputError(f"{path}: MuJoCo does not compile it: {' '.join(str(error).split())}") from None


@contextmanager
def _unlogged(mujoco: Any) -> Iterator[None]:
    """MuJoCo writes what it warns of into a file of the working directory, which is the user's."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def _check_counts(path: Path, root: Any) -> None:
    """Refuse numbers by which a short file would become a huge model; included files are looked into as well."""
    waiting, seen, parts = [root], {path.resolve()}, 0
    while waiting:
        for element in waiting.pop().iter(*_COUNTS, "body", "include"):
            parts += _copies(element) if element.tag in ("body", "replicate") else 0
            refuse_many(str(path), "bodies", parts)
            for attribute in _COUNTS.get(element.tag, ()):
                _check_count(path, element, attribute)
            file = path.parent / element.get("file", "") if element.tag == "include" else path
            if file.resolve() not in seen and file.is_file():
                seen.add(file.resolve())
                waiting.append(read_xml(file, None))


def _check_count(path: Path, element: Any, attribute: str) -> None:
    for word in element.get(attribute, "").split():
        count = 0.0
        with suppress(ValueError):  # what is no number is MuJoCo's to refuse
            count = float(word)
        if count > _LARGEST_COUNT:
            raise InputError(
                f"{path}: <{element.tag}> in line {element.sourceline}: {attribute} is {word}; "
                f"at most {_LARGEST_COUNT} is expected"
            )


def _copies(element: Any) -> int:
    """How often an element is there once those around it are replicated."""
    total = 1
    for around in (element, *element.iterancestors("replicate")):
        if around.tag == "replicate":
            with suppress(ValueError, OverflowError):
                total *= max(1, int(float(around.get("count", 1))))
    return total


def engine() -> Any:
    """The module `mujoco`, which loads late; raises `InputError` where it is not installed."""
    try:
        import mujoco
    except ImportError:
        raise InputError("MJCF is read by MuJoCo; install it: pip install 'figaroh-jax[mujoco]'") from None
    return mujoco


def _drop_looks(mujoco: Any, spec: Any) -> None:
    """Leave out what needs files and does not weigh; bodies keep their names though they are welded."""
    spec.compiler.fusestatic = False
    used: set[str] = set()
    from_geoms = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    for body, moves in _bodies(spec):
        weighs = moves and (from_geoms or not body.explicitinertial)
        for geom in body.geoms:
            geom.material = ""
            if weighs and geom.mass != 0 and geom.density != 0:
                used |= {geom.meshname, geom.hfieldname}
            elif geom.meshname or geom.hfieldname:
                geom.meshname = geom.hfieldname = ""
                geom.type, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, [0.01, 0.01, 0.01]
        for site in body.sites:
            site.material = ""
    for tendon in spec.tendons:
        tendon.material = ""
    for assets in (spec.meshes, spec.hfields):
        for asset in assets:
            if asset.name not in used:
                spec.delete(asset)
    for group in (spec.materials, spec.textures, spec.skins, spec.sensors, spec.keys):
        for element in group:
            spec.delete(element)


def _set_aside(mujoco: Any, spec: Any) -> list[tuple[Any, np.ndarray, np.ndarray | None]]:
    """Give bodies whose moments the compiler refuses others: each with its principal moments (kg m^2) and their axes.

    The axes are a quaternion (w x y z); None where the spec keeps them. Postures ask for neither.
    """
    found, compiler = [], spec.compiler
    if compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        return []
    for body, _ in _bodies(spec):
        if not body.explicitinertial:
            continue
        principal, axes, bound = np.array(body.inertia), None, compiler.boundinertia
        if not np.isnan(body.fullinertia[0]):
            xx, yy, zz, xy, xz, yz = body.fullinertia
            principal, turn = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            axes, bound = np.zeros(4), 0.0  # its eigenvalues are asked for before the bound
            mujoco.mju_mat2Quat(axes, (turn * np.linalg.det(turn)).ravel())
        least, middle, most = np.sort(np.maximum(principal, bound))
        if least < mujoco.mjMINVAL or (least + middle < most and not compiler.balanceinertia):
            body.fullinertia, body.inertia = np.full(6, np.nan), np.ones(3)
            found.append((body, principal, axes))
    return found


def _bodies(spec: Any) -> Iterator[tuple[Any, bool]]:
    """Every body and whether it moves."""
    stack = [(spec.worldbody, False)]
    while stack:
        body, moves = stack.pop()
        yield body, moves
        stack += [(child, moves or bool(child.joints)) for child in body.bodies]


def compiled_robot(
    source: str,
    mj: Any,
    joints: Sequence[str] | None = None,
    posture: Posture | None = None,
    gravity: Sequence[float] | None = None,
    root: Root | None = None,
    *,
    kinematic: bool = False,
) -> RobotModel:
    """Model of a compiled `mujoco.MjModel`; `source` names it in messages. See `load_mjcf`."""
    check_names("joints", joints)
    try:
        with np.errstate(all="ignore"):  # `assemble` checks what comes of it
            links, parts, frames = mjcf_parts(mj, root)
        free = [part.name for part in parts if part.kind == "free"]
        if root == "fixed" and (named := [name for name in joints or () if name in free]):
            raise InputError(f"joints: joint '{named[0]}' is free, but root is fixed")
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
    posture = dict(posture or {})
    if root == "fixed" and joints is None:
        posture = {name: () for name in free} | posture
    elif root != "fixed" and joints is not None:
        joints = [*(name for name in free if name not in joints and name not in posture), *joints]
    own = [0.0, 0.0, 0.0] if disabled(mj, "GRAVITY") else mj.opt.gravity.tolist()
    name = mj.names[: mj.names.index(b"\0")].decode() or Path(source).stem
    down = own if gravity is None else gravity
    model = assemble(source, name, (links, parts), joints, posture, down, "fixed", frames, kinematic=kinematic)
    _refuse_loops(source, mj, model)
    return model


def disabled(mj: Any, flag: str) -> bool:
    """Whether an option of the file switches something off (`GRAVITY`, `DAMPER`, ...)."""
    mujoco = engine()
    return bool(mj.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))


def joint_names(mj: Any) -> list[str]:
    """Name of every joint of the compiled model; one without a name has its body's."""
    names = [mj.joint(i).name for i in range(mj.njnt)]
    for i, name in enumerate(names):
        if not name:
            free = mj.jnt_type[i] == 0 and ROOT_JOINT not in names
            names[i] = ROOT_JOINT if free else _unused(f"{body_name(mj, int(mj.jnt_bodyid[i]))}_joint", names)
    return names


def body_name(mj: Any, index: int) -> str:
    """Name of a body of the compiled model; one without a name has its number."""
    return mj.body(index).name or f"body_{index}"


def actuator_of(mj: Any, index: int, kind: str) -> int:
    """The actuator that adds its armature and damping to a joint (`jnt`) or a `tendon`; -1 for none."""
    return int(getattr(mj, f"{kind}_actuatorid")[index])


def _unused(name: str, taken: Sequence[str]) -> str:
    number, start = 2, name
    while name in taken:
        name, number = f"{start}_{number}", number + 1
    return name


def _pose(position: Float[np.ndarray, "3"], quaternion: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4 4"]:
    return displacement("free", np.zeros(3), np.concatenate([position, np.roll(quaternion, -1)]))


def mjcf_parts(mj: Any, root: Root | None) -> tuple[list[LinkPart], list[JointPart], list[FramePart]]:
    """Links, joints and frames of a compiled `mujoco.MjModel`."""
    names, bodies = joint_names(mj), [body_name(mj, i) for i in range(mj.nbody)]
    followers = _followers(mj, names)
    links, joints, frames = [LinkPart("world", np.zeros(10))], [], []
    offset = [np.eye(4)]  # pose of each body in its link's frame
    for b in range(1, mj.nbody):
        parent = mj.body_parentid[b]
        carrier, pose = bodies[parent], offset[parent] @ _pose(mj.body_pos[b], mj.body_quat[b])
        own = range(mj.body_jntadr[b], mj.body_jntadr[b] + mj.body_jntnum[b])
        for j in own:
            link = bodies[b] if j == own[-1] else _unused(f"{names[j]}_link", bodies)
            if j != own[-1]:
                links.append(LinkPart(link, np.zeros(10)))
            joints.append(_joint(mj, j, names[j], (carrier, link), pose, followers.get(names[j])))
            carrier, pose = link, translation(-mj.jnt_pos[j])
        if not own:
            name = bodies[b]
            if name in names:  # MuJoCo's joints may have the names of its bodies
                name = _unused(f"{name}_fixed", [*names, *bodies])
            joints.append(JointPart(name, "fixed", carrier, bodies[b], pose, np.zeros(3)))
            pose = np.eye(4)
        moments = np.diag(mj.body_inertia[b])
        about_body = inertia.transform(
            inertia.from_com(mj.body_mass[b], np.zeros(3), moments), _pose(mj.body_ipos[b], mj.body_iquat[b])
        )
        links.append(LinkPart(bodies[b], inertia.transform(about_body, pose), wrong_moments(moments, sums=True)))
        offset.append(pose)
        if not np.array_equal(pose, np.eye(4)):
            frames.append(FramePart(bodies[b], bodies[b], pose))
    if root == "free_flyer":
        _free_root(joints)
    own = {body: (body, offset[b]) for b, body in enumerate(bodies)}
    own = {link.name: (link.name, np.eye(4)) for link in links} | own
    own = {joint.name: (joint.child, np.eye(4)) for joint in joints} | own
    for s in range(mj.nsite):
        b, name = mj.site_bodyid[s], mj.site(s).name or f"site_{s}"
        pose = offset[b] @ _pose(mj.site_pos[s], mj.site_quat[s])
        if name in own and own[name][0] == bodies[b] and np.allclose(own[name][1], pose, rtol=0, atol=1e-9):
            continue  # a frame that stands there anyway
        frames.append(FramePart(_unused(f"{name}_site", list(own)) if name in own else name, bodies[b], pose))
    return links, joints, frames


def _joint(
    mj: Any, j: int, name: str, ends: tuple[str, str], body: np.ndarray, follow: tuple[str, float, float] | None
) -> JointPart:
    """Joint whose position is MuJoCo's: what `ref` says is taken out of the placement."""
    kind, start = _KINDS[mj.jnt_type[j]], mj.jnt_qposadr[j]
    at_zero = mj.qpos0[start : start + _NUMBERS[mj.jnt_type[j]]]
    if kind == "free":
        neutral = (*at_zero[:3], *np.roll(at_zero[3:], -1))
        return JointPart(name, kind, *ends, np.eye(4), np.zeros(3), neutral=tuple(map(float, neutral)))
    placement = body @ translation(mj.jnt_pos[j])
    if kind == "spherical":
        last = mj.body_jntadr[mj.jnt_bodyid[j]] + mj.body_jntnum[mj.jnt_bodyid[j]] - 1
        if j != last:
            raise InputError(f"ball joint '{name}' comes before other joints of its body; give those their own body")
        return JointPart(name, kind, *ends, placement, np.zeros(3))
    axis = mj.jnt_axis[j]
    placement = placement @ displacement(kind, axis, -at_zero)
    if follow is not None and not follow[0]:  # held where an equality says
        return JointPart(name, "fixed", *ends, placement @ displacement(kind, axis, np.array([follow[2]])), axis)
    lower, upper = mj.jnt_range[j] if mj.jnt_limited[j] else (-np.inf, np.inf)
    limit = (float(lower), float(upper), np.inf, _effort(mj, j))
    return JointPart(name, kind, *ends, placement, axis, limit, follow, (float(at_zero[0]),))


def _effort(mj: Any, j: int) -> float:
    """Largest torque that the file lets the drives of a joint give; infinite where it sets no limit."""
    mujoco = engine()
    limits = []
    for a in range(mj.nu):
        if mj.actuator_trntype[a] == mujoco.mjtTrn.mjTRN_JOINT and mj.actuator_trnid[a, 0] == j:
            fixed = mj.actuator_gaintype[a] == mujoco.mjtGain.mjGAIN_FIXED
            plain = fixed and not mj.actuator_biasprm[a, 1:3].any()
            by_control = np.abs(mj.actuator_ctrlrange[a]).max() * abs(mj.actuator_gainprm[a, 0])
            by_force = np.abs(mj.actuator_forcerange[a]).max()
            force = by_force if mj.actuator_forcelimited[a] else np.inf
            control = by_control if mj.actuator_ctrllimited[a] and plain else np.inf
            limits.append(min(force, control) * abs(mj.actuator_gear[a, 0]))
    total = np.abs(mj.jnt_actfrcrange[j]).max() if mj.jnt_actfrclimited[j] else np.inf
    return float(min(total, sum(limits) if limits else np.inf))


def _followers(mj: Any, names: list[str]) -> dict[str, tuple[str, float, float]]:
    """Joints that an equality couples: leader ("" for none), ratio, offset, in MuJoCo's positions."""
    mujoco = engine()
    found: dict[str, tuple[str, float, float]] = {}
    for e in _equalities(mj):
        if mj.eq_type[e] != mujoco.mjtEq.mjEQ_JOINT:
            continue
        first, second = mj.eq_obj1id[e], mj.eq_obj2id[e]
        name, data = names[first], mj.eq_data[e]
        if data[2:5].any() and second >= 0:
            raise InputError(f"joint '{name}' follows '{names[second]}' by a curve (polycoef); a line is expected")
        if name in found:
            raise InputError(f"joint '{name}' is coupled by two equalities; one of them is read")
        start = mj.qpos0[mj.jnt_qposadr[first]] + data[0]
        ratio = float(data[1])
        if second < 0 or ratio == 0:
            found[name] = ("", 0.0, float(start))
        else:
            found[name] = (names[second], ratio, float(start - ratio * mj.qpos0[mj.jnt_qposadr[second]]))
    return found


def _equalities(mj: Any) -> list[int]:
    return [] if disabled(mj, "EQUALITY") else [e for e in range(mj.neq) if mj.eq_active0[e]]


def _free_root(joints: list[JointPart]) -> None:
    """Free the body that the file welds to the world, in place; a file with a free joint is left as it is."""
    base = [(i, joint) for i, joint in enumerate(joints) if joint.parent == "world"]
    if any(joint.kind == "free" for _, joint in base):
        return
    if len(base) != 1 or base[0][1].kind != "fixed":
        names = ", ".join(f"'{joint.child}'" for _, joint in base)
        raise InputError(f"root: free_flyer needs one body welded to the world to free; the world carries {names}")
    index, weld = base[0]
    joints[index] = JointPart(ROOT_JOINT, "free", "world", weld.child, weld.placement, np.zeros(3))


def _refuse_loops(source: str, mj: Any, model: RobotModel) -> None:
    """Equalities other than couplings of joints are refused unless they hold what is locked anyway."""
    mujoco = engine()
    kinds = mujoco.mjtEq
    carrier = {frame.name: frame.parent for frame in model.frames}
    for e in _equalities(mj):
        kind, name = kinds(int(mj.eq_type[e])), mj.equality(e).name or f"number {e}"
        if kind == kinds.mjEQ_JOINT:
            continue
        if kind not in (kinds.mjEQ_CONNECT, kinds.mjEQ_WELD):
            raise InputError(f"{source}: equality '{name}' couples tendons or flexes; couplings of joints are read")
        ends = [int(mj.eq_obj1id[e]), int(mj.eq_obj2id[e])]
        if mj.eq_objtype[e] == mujoco.mjtObj.mjOBJ_SITE:
            ends = [int(mj.site_bodyid[end]) for end in ends]
        bodies = [body_name(mj, end) for end in ends]
        if carrier[bodies[0]] != carrier[bodies[1]]:
            what = "connect" if kind == kinds.mjEQ_CONNECT else "weld"
            raise InputError(
                f"{source}: the {what} '{name}' between bodies '{bodies[0]}' and '{bodies[1]}' closes a kinematic "
                "loop; a robot is a tree: lock the joints of the loop, or take the equality out"
            )
