"""What of a model is estimated: numbers that change it, zero for the model itself, in one vector with names and units.

| name | numbers | change |
|---|---|---|
| `inertia` | ten for each link | added to the link's ten parameters |
| `friction`, `effects` | parameters of the model's effects (of friction alone) | added to them |
| `joint_offset` | one for each tree joint, rad or m | of the joint's position |
| `link_geometry` | twist of each tree joint in its own frame, m and rad | moves the joint on its link |
| `frames` | what each measuring device leaves open | its base frame, tool frame, markers, sockets |
| `start`, `drives` | what rollouts leave open | state at the start of each, numbers of the drives |
| `tool_frame` | twist of each frame of the model, m and rad | moves the frame on its link |
| `base` | twist at the world's origin, m and rad | moves the whole robot |
| `gravity` | three, m/s^2 | added to gravity |
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from ..effects.base import Effect
from ..effects.extended import ExtendedModel
from ..errors import InputError, check_kind, nearest
from ..rigid import lie
from ..rigid.model import DOF_NAMES, RobotModel

if TYPE_CHECKING:
    from .data import Data

__all__ = ["KINDS", "Free", "Open", "Part", "apply", "chosen_of"]

KINDS = (
    *("inertia", "friction", "effects", "joint_offset", "link_geometry", "frames", "tool_frame", "base", "gravity"),
    *("start", "drives", "segments", "markers"),
)
OPEN = ("frames", "start", "drives", "segments", "markers")  # left open by the data, not by the model
TEN = ("m", "mx", "my", "mz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")
TEN_UNITS = ("kg", *("kg m",) * 3, *("kg m2",) * 6)
TWIST = ("x", "y", "z", "rx", "ry", "rz")
TWIST_UNITS = ("m", "m", "m", "rad", "rad", "rad")
REACH = 0.2  # m: how far from its joint the mass of a link is taken to be, where a size of its moments is needed


@runtime_checkable
class Open(Protocol):
    """Data that leave numbers open, which a fit may estimate: frames of devices, states at the start of rollouts."""

    def unknowns(self) -> tuple[tuple[str, str, float], ...]:
        """Name, unit and typical size of each."""
        ...

    def moved(self, numbers: Float[Array, " unknowns"]) -> Any:
        """The data with the numbers changed by so much."""
        ...


class Part(NamedTuple):
    """Numbers of one array that are estimated; hashable, so that it selects what a program computes."""

    kind: str
    key: tuple[Any, ...]  # which effect and parameter, or which device
    index: tuple[int, ...]  # pyright: ignore[reportIncompatibleMethodOverride]  # in the flat array
    shape: tuple[int, ...]  # of the array
    names: tuple[str, ...]
    units: tuple[str, ...]
    sizes: tuple[float, ...]  # typical size of each number: what the solver counts in
    words: tuple[tuple[str, ...], ...] = ()  # of each name; where empty, those between its spaces


class Free(NamedTuple):
    """Everything that is estimated, part by part."""

    parts: tuple[Part, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each number."""
        return tuple(name for part in self.parts for name in part.names)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each number."""
        return tuple(unit for part in self.parts for unit in part.units)

    @property
    def sizes(self) -> Float[np.ndarray, " numbers"]:
        """Typical size of each number."""
        return np.array([size for part in self.parts for size in part.sizes], float)

    def unnamed(self) -> Free:
        """The same without names, so that one program serves the same numbers at any place."""
        return Free(
            tuple(p._replace(names=("",) * len(p.names), units=("",) * len(p.units), words=()) for p in self.parts)
        )

    def held(self, model: ExtendedModel, values: Float[np.ndarray, " numbers"]) -> Float[np.ndarray, " numbers"]:
        """Each number as the model holds it; where it holds no such number (frames, offsets, drives) its change."""
        out, first = np.array(values, float), 0
        for part in self.parts:
            own = slice(first, first + len(part.index))
            if part.kind == "effect":
                out[own] = np.asarray(getattr(model.effects[part.key[0]], part.key[1])).reshape(-1)
            elif part.kind in ("inertia", "gravity"):
                out[own] = np.asarray(getattr(model.robot, part.kind)).reshape(-1)[list(part.index)]
            first = own.stop
        return out

    def cut(self, values: Float[Array, " numbers"]) -> Iterator[tuple[Part, Array]]:
        """Each part with its numbers in the whole array, zero where nothing is estimated."""
        first = 0
        for part in self.parts:
            last = first + len(part.index)
            whole = jnp.zeros(int(np.prod(part.shape, dtype=int))).at[np.array(part.index)].set(values[first:last])
            yield part, whole.reshape(part.shape)
            first = last


def chosen_of(model: ExtendedModel, data: Sequence[Data], free: Any) -> Free:
    """What `free` names: one or several of `KINDS`, or a mapping from them to True or to the places meant.

    Places are names of links (`inertia`), joints (`joint_offset`, `link_geometry`, `friction`, `effects`), effects or
    frames, or words of the numbers' own names. Raises `InputError` with the nearest name where nothing is meant.
    """
    if isinstance(free, Free):
        return free
    if not isinstance(free, Iterable):
        raise InputError(f"free is {free!r:.100}; one or several of {', '.join(KINDS)} are expected, or a mapping")
    wanted: dict[str, Any] = dict(free) if isinstance(free, Mapping) else {}
    if not wanted:
        wanted = {kind: True for kind in ([free] if isinstance(free, str) else free)}
    if not wanted:
        raise InputError(f"free: nothing is named that is to be fitted; known: {', '.join(KINDS)}")
    parts: list[Part] = []
    for kind, places in wanted.items():
        if kind not in KINDS:
            raise InputError(f"free: nothing is called '{kind}'{nearest(kind, KINDS)}; known: {', '.join(KINDS)}")
        given = list(_parts(kind, model, data))
        _check_places(kind, places, given)
        chosen = given if places is True else [p for p in (_only(part, places) for part in given) if p.index]
        if not chosen:
            what = "the model and the data have none" if places is True or not given else f"none at {places}"
            known = sorted({name for part in given for name in part.names})
            more = f"; known: {', '.join(known[:12])}" if known else ""
            if not given and kind in ("friction", "effects"):
                more = "; give the model some: extend(model, place(CATALOGUE[name], model, at))"
            raise InputError(f"free: {kind}: {what}{more}")
        parts += chosen
    double = {p.kind for p in parts if p.kind == "effect" and sum(q[:2] == p[:2] for q in parts) > 1}
    if double:
        raise InputError("free: 'effects' holds 'friction' already; give one of them")
    return Free(tuple(parts))


def _check_places(kind: str, places: Any, parts: Sequence[Part]) -> None:
    """Refuse what is neither True nor places, and a place among others at which the kind has no number."""
    if places is True or isinstance(places, np.ndarray):
        return
    if not isinstance(places, Iterable):
        raise InputError(
            f"free: {kind} is {places!r:.100}; True is expected, or its places; leave out what is not free"
        )
    words = [own for part in parts for own in part.words or [tuple(name.split()) for name in part.names]]
    for place in [] if isinstance(places, str) else places:
        check_kind(f"free: {kind}", place, str, "a list of names of places")
        if words and not any(_said(place, own) for own in words):
            known = dict.fromkeys(word for own in words for word in own[1:] if word)
            raise InputError(f"free: {kind}: none at '{place}'{nearest(place, known)}")


def _only(part: Part, places: Any) -> Part:
    """The numbers at the places, by the words of their names or by a mask of the array."""
    if isinstance(places, np.ndarray) and places.dtype == bool:
        flat = places.reshape(-1)
        keep = [k for k, i in enumerate(part.index) if flat[i]]
    else:
        wanted = [places] if isinstance(places, str) else list(places)
        words = part.words or [tuple(name.split()) for name in part.names]
        keep = [k for k, own in enumerate(words) if any(_said(place, own) for place in wanted)]
    index, sizes = tuple(part.index[k] for k in keep), tuple(part.sizes[k] for k in keep)
    names, units = (tuple(x[k] for k in keep) for x in (part.names, part.units))
    words = tuple(part.words[k] for k in keep) if part.words else ()
    return Part(part.kind, part.key, index, part.shape, names, units, sizes, words)


def _said(place: str, words: Sequence[str]) -> bool:
    """Whether a place is said by words of a name alone; names of links and joints may hold spaces."""
    rest = f" {' '.join(place.split())} "
    for word in sorted(filter(None, words), key=len, reverse=True):
        rest = rest.replace(f" {' '.join(word.split())} ", " ")
    return not rest.strip()


def _parts(kind: str, model: ExtendedModel, data: Sequence[Data]) -> Iterator[Part]:
    robot = model.robot
    joints = [joint.name for joint in robot.joints]
    if kind == "inertia":
        yield _part(kind, robot.link_names, TEN, TEN_UNITS, _inertia_sizes(robot))
    elif kind == "gravity":
        yield _part(kind, ("",), ("x", "y", "z"), ("m/s2",) * 3, np.full((1, 3), 0.1))
    elif kind == "base":
        yield _part(kind, ("",), TWIST, TWIST_UNITS, np.full((1, 6), 1e-2))
    elif kind in ("joint_offset", "link_geometry"):
        _single_axes(robot, kind)
        slides = [joint.kind == "prismatic" for joint in robot.joints]
        if kind == "joint_offset":
            part = _part(kind, joints, ("",), ("",), np.full((len(joints), 1), 1e-2))
            yield part._replace(units=tuple("m" if s else "rad" for s in slides), shape=(len(joints),))
        else:
            yield _part(kind, joints, TWIST, TWIST_UNITS, np.full((len(joints), 6), 1e-2))
    elif kind == "tool_frame":
        names = [frame.name for frame in robot.frames]
        yield _part(kind, names, TWIST, TWIST_UNITS, np.full((len(names), 6), 1e-2))
    elif kind in OPEN:
        yield from _open_parts(kind, data)
    else:
        yield from _effect_parts(model, friction=kind == "friction")


def _part(kind: str, places: Sequence[str], words: Sequence[str], units: Sequence[str], sizes: Any) -> Part:
    own = tuple(tuple(x for x in (kind, place, word) if x) for place in places for word in words)
    names = [" ".join(one) for one in own]
    shape = (len(places), len(words)) if places != ("",) else (len(words),)
    flat = tuple(np.asarray(sizes, float).reshape(-1).tolist())
    return Part(kind, (), tuple(range(len(names))), shape, tuple(names), tuple(units) * len(places), flat, own)


def _inertia_sizes(robot: RobotModel) -> np.ndarray:
    if isinstance(robot.inertia, Tracer):
        mass = np.ones((len(robot.joints), 1))
    else:
        ten = np.asarray(robot.inertia)
        mass = np.maximum(ten[..., :1].reshape(-1, len(robot.joints), 1)[0], 0.1)
    return 0.1 * mass * np.array([1.0, *(REACH,) * 3, *(REACH**2,) * 6])


def _single_axes(robot: RobotModel, kind: str) -> None:
    wrong = next((joint for joint in robot.joints if len(DOF_NAMES[joint.kind]) != 1), None)
    if wrong is not None:
        raise InputError(f"free: {kind}: joint '{wrong.name}' is {wrong.kind}; joints of one axis have one")


def _open_parts(kind: str, data: Sequence[Data]) -> Iterator[Part]:
    """What the data leave open, by `unknowns` of which the names begin with the kind; of devices all are `frames`."""
    for k, one in enumerate(data):
        unknowns = one.unknowns() if isinstance(one, Open) else ()
        words = ["frames" if hasattr(one, "device") else name.split()[0] for name, _, _ in unknowns]
        mine = [i for i, word in enumerate(words) if word == kind]
        if mine:
            names, units, sizes = zip(*(unknowns[i] for i in mine), strict=True)
            mark = f" {k + 1}" if len(data) > 1 else ""
            marked = tuple(f"{name}{mark}" for name in names)
            yield Part(kind, (k,), tuple(mine), (len(unknowns),), marked, units, sizes)


def _effect_parts(model: ExtendedModel, friction: bool) -> Iterator[Part]:
    robot = model.robot
    for k, effect in enumerate(model.effects):
        if friction and not (effect.dissipative or effect.rubs):
            continue
        known = robot.link_names if effect.acts_on == "link" else robot.dof_names
        places = [known[int(i)] for i in effect.at]
        for name, parameter in effect.parameters().items():
            if parameter.choice:
                continue
            words = (effect.name, *places, name)
            size = _effect_size(effect, name)
            yield Part("effect", (k, name), (0,), (), (" ".join(words),), (parameter.unit,), (size,), (words,))


def _effect_size(effect: Effect, name: str) -> float:
    value = getattr(effect, name)
    known = 0.0 if isinstance(value, Tracer) else float(np.max(np.abs(np.asarray(value))))
    if effect.parameters()[name].linear:
        return 1.0
    return 0.1 * known or 0.1


def apply(
    free: Free, model: ExtendedModel, data: tuple[Data, ...], values: Float[Array, " numbers"]
) -> tuple[ExtendedModel, tuple[Data, ...]]:
    """The model and the data's devices with the numbers in them; to be traced. The only place that knows how."""
    twist = None
    for part, whole in free.cut(values):
        if part.kind == "effect":
            where = lambda m, key=part.key: getattr(m.effects[key[0]], key[1])  # noqa: E731
            model = eqx.tree_at(where, model, jnp.asarray(where(model)) + whole)
        elif part.kind in OPEN:
            one: Any = data[part.key[0]]
            data = (*data[: part.key[0]], one.moved(whole), *data[part.key[0] + 1 :])
        elif part.kind in ("joint_offset", "link_geometry"):
            here = whole if part.kind == "link_geometry" else _along(model.robot, whole)
            twist = here if twist is None else twist + here
        else:
            model = eqx.tree_at(lambda m: m.robot, model, _changed(model.robot, part.kind, whole))
    if twist is not None:
        placement = jnp.asarray(model.robot.placement) @ jax.vmap(lie.twist_pose)(twist)
        model = eqx.tree_at(lambda m: m.robot.placement, model, placement)
    return model, data


def _changed(robot: RobotModel, kind: str, whole: Array) -> RobotModel:
    if kind in ("inertia", "gravity"):
        where = (lambda r: r.inertia) if kind == "inertia" else (lambda r: r.gravity)
        return eqx.tree_at(where, robot, jnp.asarray(where(robot)) + whole)
    if kind == "tool_frame":
        frames = jnp.asarray(robot.frame_placement) @ jax.vmap(lie.exp_se3)(whole)
        return eqx.tree_at(lambda r: r.frame_placement, robot, frames)
    root = np.array([joint.parent < 0 for joint in robot.joints])[:, None, None]
    placement = jnp.asarray(robot.placement)
    return eqx.tree_at(lambda r: r.placement, robot, jnp.where(root, lie.exp_se3(whole) @ placement, placement))


def _along(robot: RobotModel, offset: Float[Array, " nj"]) -> Float[Array, "nj 6"]:
    """Twist of each joint along its own axis."""
    way = offset[:, None] * jnp.asarray(robot.axis)
    turns = np.array([joint.kind == "revolute" for joint in robot.joints])[:, None]
    return jnp.concatenate([jnp.where(turns, 0.0, way), jnp.where(turns, way, 0.0)], axis=1)
