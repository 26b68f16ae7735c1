"""What an effect is: one immutable object with its equation, its parameters and every form in which it acts.

An effect has whatever forms it has. Identification, diagnosis, export and simulation read the same object:

| form | method | read by |
|---|---|---|
| torque that it adds at the joints | `torque` | torque-level diagnosis, inverse and forward dynamics |
| change of the robot itself | `change` | as above; URDF and MJCF through the changed model |
| what a position sensor reads beside the truth | `position_error` | torque-level diagnosis, simulated sensors |
| what a torque sensor reads beside the truth | `torque_error` | torque-level diagnosis, simulated sensors |
| what a torque sensor makes of a frequency | `torque_response` | torque-level diagnosis, simulated sensors |
| what a drive makes of the torque that it is to give | `delivered` | simulation |
| a state of its own from instant to instant | `step` | simulation; along a record, before `torque` is asked for |
| twist on a link | `twist` | pose calibration |
| native elements of MJCF and URDF | `native` | export |

Fields declared with `amplitude` enter linearly; fields declared with `shape` do not, and are searched between their
bounds from their grid. Torques are those of the drive: what has to be added to the rigid body's to give the measured.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Complex, Float, Int

from ..errors import InputError, check_finite, check_real, check_switch
from ..rigid.dynamics import inverse_dynamics
from ..rigid.model import Leaf, RobotModel
from .loops import InRollouts

__all__ = [
    "Effect",
    "JointEffect",
    "Motion",
    "Native",
    "Parameter",
    "Place",
    "amplitude",
    "changed",
    "exact",
    "fixed",
    "joint_unit",
    "movable",
    "place",
    "shape",
    "smooth_sign",
]

T = TypeVar("T")

# a number; with leading axes where one object holds an effect at many places
Scalar = Float[Leaf, "..."] | float


class Parameter(NamedTuple):
    """Unit of a parameter, and for one that enters nonlinearly its bounds and the points where a search starts."""

    unit: str
    linear: bool
    lower: float = -np.inf
    upper: float = np.inf
    grid: tuple[float, ...] = ()
    choice: bool = False  # one of the grid's values, never anything between (a sign)
    hole: tuple[float, float] | None = None  # values that are another effect
    expected: tuple[float, float] | None = None  # of an amplitude: its value before any data, and its deviation


class Native(NamedTuple):
    """Element of a model format that carries a parameter: `value` is added to `attribute` of the joints `at`."""

    element: Literal["joint", "tendon", "actuator", "body"]
    attribute: str
    value: float
    sign: float = 1.0  # second coefficient of a tendon over a pair of joints


class Motion(eqx.Module):
    """Motion of the robot at `samples` instants, and what the current model makes of it; what an effect is given.

    `time` (s) is (samples,); `position` (rad or m), `velocity` and `acceleration` are (samples, nv); `load`
    (samples, nv) is the torque of the rigid body alone and `total` that of the whole model, friction included (N m or
    N).
    `direction` is the sign of the velocity, smooth within one sample: use it where a law of friction has a sign.
    `angle` is the position of each coordinate, `elapsed` the time since the record began. Within an effect,
    `self.here(motion.velocity)` is the column of its own joint.
    """

    model: RobotModel
    time: Float[Leaf, " samples"]  # s
    position: Float[Leaf, "samples nq"]  # rad or m; quaternions where the robot has any
    velocity: Float[Leaf, "samples nv"]
    acceleration: Float[Leaf, "samples nv"]
    load: Float[Leaf, "samples nv"]  # torque of the rigid body, N m or N
    total: Float[Leaf, "samples nv"]  # torque of the whole current model, friction included
    dt: Float[Leaf, ""] | float  # sampling period, s; 0 for instants that are not a record
    width: Float[Leaf, " nv"]  # half width of a reversal of the joints' dry friction, rad/s or m/s

    __getattribute__ = object.__getattribute__  # see `Effect`

    @property
    def direction(self) -> Float[Array, "samples nv"]:
        """Sign of the velocity, smooth within one sample (`smooth_sign`)."""
        return smooth_sign(self.velocity, self.acceleration, self.dt, self.width)

    @property
    def angle(self) -> Float[Leaf, "samples nv"]:
        """Position of each coordinate, rad or m; zero where no one number tells it (joints of several axes)."""
        return self.by_coordinate(self.position)

    def by_coordinate(self, numbers: Float[Leaf, "samples nq"]) -> Float[Leaf, "samples nv"]:
        """Numbers of q by the columns of v; zero for joints of several axes."""
        space: Any = np if isinstance(numbers, np.ndarray) else jnp  # on the host it costs no program
        if self.model.nq == len(self.model.joint_names):
            return space.asarray(numbers)
        column = np.full(self.model.nv, -1)
        for joint, at in zip(self.model.joints, self.model.dofs.positions, strict=True):
            if joint.kind in ("revolute", "prismatic"):
                column[joint.coordinate] = at.start
        return space.where(column < 0, 0.0, space.asarray(numbers)[:, column])

    @property
    def begins(self) -> Bool[Array, " samples"]:
        """Whether a sample is the first of a recording; every one where the instants are no record."""
        t = jnp.asarray(self.time)
        return jnp.abs(jnp.diff(t, prepend=t[:1] - 2 * jnp.asarray(self.dt)) - self.dt) >= jnp.asarray(self.dt) / 2

    @property
    def elapsed(self) -> Float[Array, " samples"]:
        """Time since the earliest sample of a record, s; the time itself where the instants are no record."""
        t = jnp.asarray(self.time)
        return t - jnp.where(jnp.asarray(self.dt) > 0, t.min(), 0.0)

    def rate(self, signal: Float[Leaf, "samples *rows"]) -> Any:
        """Time derivative of a signal, by five-point central differences; zero at the two ends of each recording."""
        on_host = all(isinstance(x, (np.ndarray, np.generic, float)) for x in (signal, self.time, self.dt))
        space: Any = np if on_host else jnp  # on the host it costs no program
        x, t, dt = space.asarray(signal), space.asarray(self.time), space.asarray(self.dt)
        slope = 8 * (space.roll(x, -1, 0) - space.roll(x, 1, 0)) - (space.roll(x, -2, 0) - space.roll(x, 2, 0))
        inside = abs(space.roll(t, -2) - space.roll(t, 2) - 4 * dt) < dt / 2
        inside = inside.reshape(-1, *(1 for _ in x.shape[1:]))
        return space.where(inside, slope / space.where(dt > 0, 12 * dt, 1.0), 0.0)

    def later(
        self, signal: Float[Leaf, "samples rows"], delay: Float[Leaf, " samples"]
    ) -> Float[Array, "samples rows"]:
        """What a signal is a `delay` (s, of each sample) later in the same record, straight between its samples; at
        its ends it stands still."""
        x, dt, here = jnp.asarray(signal), jnp.asarray(self.dt), jnp.arange(len(self.time))
        begins = self.begins
        first = jax.lax.cummax(jnp.where(begins, here, 0))
        last = jax.lax.cummin(jnp.where(jnp.append(begins[1:], True), here, len(here)), reverse=True)
        place = jnp.clip(here + delay / jnp.where(dt > 0, dt, jnp.inf), first, last)
        low = jnp.clip(jnp.floor(place).astype(int), first, jnp.maximum(last - 1, first))
        share = (place - low)[:, None]
        return x[low] * (1 - share) + x[jnp.minimum(low + 1, last)] * share

    def reversal(
        self, velocity: Float[Array, " samples"], acceleration: Float[Array, " samples"], width: Float[Array, ""]
    ) -> Float[Array, " samples"]:
        """Smooth sign of another velocity, e.g. that of a motor between two joints."""
        return smooth_sign(velocity, acceleration, self.dt, width)


def changed(module: T, **fields: Any) -> T:
    """A module with other fields, as `dataclasses.replace` makes it: equinox's own checks take half a millisecond."""
    other, own = object.__new__(type(module)), vars(module)
    names = type(module).__dataclass_fields__  # pyright: ignore[reportAttributeAccessIssue]
    for name, value in ({name: own[name] for name in names if name in own} | fields).items():
        object.__setattr__(other, name, value)
    return other


def amplitude(
    unit: str, lower: float = -np.inf, upper: float = np.inf, expected: tuple[float, float] | None = None
) -> Any:
    """Declare a parameter in which the torque is linear; outside of its bounds the effect is not one that exists.

    `expected` are its value before any data and the deviation of that (1 and 0.02: all of what is beyond a limit is
    cut off); without them any size is as likely.

    >>> import figaroh_jax as fj
    >>> class Drag(fj.Effect):
    ...     name, title, acts_on, equation = "drag", "drag of the air", "joint", "c v |v|"
    ...     drag: float = fj.amplitude("N m s2/rad2", lower=0.0)
    ...     def torque(self, motion):
    ...         v = self.here(motion.velocity)
    ...         return self.drag * v * abs(v)
    >>> Drag.parameters()["drag"].unit
    'N m s2/rad2'
    """
    _check_bounds("lower and upper", (lower, upper))
    if expected is not None:
        check_finite("expected", expected)
        if np.shape(expected) != (2,):
            raise InputError(f"expected is {expected!r:.100}; a value and its deviation are expected, (1.0, 0.02) say")
    return eqx.field(default=0.0, metadata={"parameter": Parameter(unit, True, lower, upper, expected=expected)})


def shape(
    unit: str,
    grid: Sequence[float],
    bounds: tuple[float, float] | None = None,
    choice: bool = False,
    hole: tuple[float, float] | None = None,
) -> Any:
    """Declare a parameter in which the torque is not linear; `choice` takes the grid's values alone.

    It is searched within `bounds` but not in the `hole`, where the effect is another one.

    >>> import figaroh_jax as fj
    >>> class Notch(fj.Effect):
    ...     name, title, acts_on, equation = "notch", "a notch", "joint", "k q exp(-(q / w)^2)"
    ...     depth: float = fj.amplitude("N m/rad")
    ...     width: float = fj.shape("rad", (0.05, 0.1, 0.2))
    >>> Notch.parameters()["width"].grid
    (0.05, 0.1, 0.2)
    """
    if isinstance(grid, str) or not isinstance(grid, Sequence) or not len(grid):
        raise InputError(f"grid is {grid!r:.100}; the values from which the search starts are expected, (0.1, 0.2) say")
    check_finite("grid", grid)
    check_switch("choice", choice)
    _check_bounds("bounds", bounds)
    lower, upper = bounds or (min(grid), max(grid))
    parameter = Parameter(unit, False, lower, upper, tuple(grid), choice, hole)
    return eqx.field(default=grid[0], metadata={"parameter": parameter})


def _check_bounds(name: str, given: Any) -> None:
    """Refuse all but least and greatest, in this order."""
    if given is None:
        return
    check_real(name, given)
    if np.shape(given) != (2,) or not given[0] <= given[1]:
        raise InputError(f"{name}: {given!r:.100}; least and greatest are expected, (0.0, 1.0) say")


class Place(eqx.Module):
    """Where an effect of a model acts, known when tracing: no leaf, so that `jax.grad` takes the model as it is.

    It reads like the array of indices it stands for. An `Effect` whose `at` is an array instead can be mapped over
    places by `jax.vmap` (`movable`).
    """

    index: tuple[int, ...] = eqx.field(static=True)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self.index, np.int64 if dtype is None else dtype)

    def __jax_array__(self) -> Array:
        return jnp.asarray(np.asarray(self))

    def __getitem__(self, k: Any) -> Any:
        return self.index[k]

    def __iter__(self) -> Iterator[int]:
        return iter(self.index)

    def __len__(self) -> int:
        return len(self.index)

    @property
    def shape(self) -> tuple[int, ...]:
        """As that of an array."""
        return (len(self.index),)


@lru_cache(maxsize=512)
def _declared(cls: type[Effect]) -> Mapping[str, Parameter]:
    own = {f.name: f.metadata["parameter"] for f in dataclasses.fields(cls) if "parameter" in f.metadata}
    if not cls.dissipative:
        return own
    return {n: p._replace(lower=max(p.lower, 0.0)) if p.linear else p for n, p in own.items()}


class Effect(eqx.Module):
    """A physical effect at a place; subclass it, declare its parameters and write at least one form.

    A subclass gives its `name`, a `title` in plain words, its `equation` as text and the kind of place that it
    `acts_on`: "joint", "pair" (of joints), "link" or "robot". Parameters are fields made by `amplitude` (the torque is
    linear in them) or `shape` (it is not). The forms are methods: `torque(motion)` for what is added at the joints,
    positive as the drives' torque is (friction is positive where the joint moves forwards); the table at the head of
    `figaroh_jax.effects.base` lists the others. Use `jax.numpy` in them. Relations to other effects (`contains`,
    `excludes`, `resembles`, ...) and what physics asks (`dissipative`) are attributes of the class.

    `at` holds the indices of the place: one coordinate (`joint`), two (`pair`), a tree link (`link`), none (`robot`);
    in a model they are static (`Place`).

    >>> import figaroh_jax as fj, jax.numpy as jnp
    >>> class Wind(fj.Effect):
    ...     name, title, acts_on, equation = "wind", "a gust of wind", "robot", "push sin(2 pi t)"
    ...     push: float = fj.amplitude("N m")
    ...     def torque(self, motion):
    ...         return self.push * jnp.sin(2 * jnp.pi * motion.time)[:, None] * jnp.ones_like(motion.velocity)
    >>> float(fj.place(Wind, fj.load_urdf(fj.DEMO), push=2.0).push)
    2.0
    """

    at: Int[Leaf, "*many places"] | Place

    name: ClassVar[str]
    title: ClassVar[str]  # in plain words, for people
    equation: ClassVar[str]  # as text
    acts_on: ClassVar[Literal["joint", "pair", "link", "robot", "frame"]]  # frame: of base or tool, in postures
    follows_torque: ClassVar[bool] = False  # whether its torque depends on the current model's (load or total)
    follows_total: ClassVar[bool] = False  # whether it depends on all torque together, as a drive or a sensor does
    reverses: ClassVar[bool] = True  # whether its torque may follow how dry friction reverses (`Motion.direction`)
    inertial: ClassVar[bool] = False  # whether its amplitudes are ten parameters of its link: the regressor's columns
    body: ClassVar[bool] = False  # whether these are a body's that exists: mass > 0, pseudo-inertia >= 0
    levels: ClassVar[tuple[str, ...]] = ("torque", "pose", "rollout")  # of diagnoses that look for it
    in_rollouts: ClassVar[InRollouts] = InRollouts()  # how it stands in a rollout
    correction: ClassVar[float] = 1.0  # its linear parameters behind one of what a calibration of postures reports
    searched: ClassVar[bool] = True  # whether a diagnosis looks for it, that is, whether it is in the catalogue
    # relations to other effects, by name; the last two hold both ways, whichever class states them (`related`)
    contains: ClassVar[tuple[str, ...]] = ()  # simpler effects that it can imitate exactly: they are preferred
    contained_in: ClassVar[tuple[str, ...]] = ()  # the same from the other side, for an effect of yours: see `register`
    resembles: ClassVar[tuple[str, ...]] = ()  # simpler effects, anywhere, that it can all but imitate: see `gates`
    indistinguishable_from: ClassVar[tuple[str, ...]] = ()  # the same torque in a moving joint
    one_more_of: ClassVar[str] = ""  # the effect of which a place has one already where this one is looked for
    excludes: ClassVar[tuple[str, ...]] = ()  # not looked for any more once this one has been accepted
    # what physics asks of it; for a single parameter see the bounds of `amplitude` and `shape`
    dissipative: ClassVar[bool] = False  # whether amplitudes below zero would feed energy to the robot
    rubs: ClassVar[bool] = False  # whether it is friction though not `dissipative`, a correction of another law say
    speed_law: ClassVar[bool] = False  # whether it is a law of dry friction over the speed, one of several alike
    bends: ClassVar[bool] = False  # whether it may bend what viscous friction makes rise, but not turn it down
    of_position: ClassVar[bool] = False  # whether it follows the position of its joint alone, as weight may
    waves: ClassVar[bool] = False  # whether it rises and falls along its joint's position: a spot looks like some of it
    beside_rest: ClassVar[bool] = True  # whether it can be told from a rest that stays; no law of what any rest does
    fades: ClassVar[bool] = False  # whether it goes by the time since the start: another recording has it no more
    vanishes: ClassVar[tuple[str, ...]] = ()  # shapes at whose zero it adds nothing, whatever its amplitudes
    about: ClassVar[tuple[str, str] | None] = None  # a shape about which its torque is linear in an amplitude: `exact`
    abrupt: ClassVar[bool] = False  # whether its `position_error` steps where the load changes its side
    winds_up: ClassVar[bool] = False  # whether its `position_error` is the load's, as of a spring
    one_rotor: ClassVar[
        tuple[str, ...]
    ] = ()  # of a rotor that turns two joints: inertia, then what tells it from links
    in_every_drive: ClassVar[bool] = False  # whether a robot whose file lacks it at most joints lacks it at all of them
    like_links: ClassVar[bool] = False  # whether its torque is much of what links other than believed would add
    needs_trust: ClassVar[float] = np.inf  # trust in the inertials (relative) above which it is no cause
    separated_by: ClassVar[str] = ""  # the experiment that tells it from what looks alike; {at} stands for the place
    separated_by_postures: ClassVar[str] = ""  # the same of postures, where it is another one

    # methods as Python has them: of each, whenever it is asked for, equinox makes a module, which takes 50 us
    __getattribute__ = object.__getattribute__

    def __repr__(self) -> str:
        fields = ((f.name, getattr(self, f.name)) for f in dataclasses.fields(self) if f.name != "at")
        told = "".join(f", {name}={_short(value)}" for name, value in fields if value is not None)
        return f"{type(self).__name__}(at={_short(self.at)}{told})"

    def torque(self, motion: Motion) -> Float[Array, "samples *rows"]:
        """Torque added, N m or N: `(samples,)` at a joint, `(samples, 2)` at a pair, else `(samples, nv)`."""
        q, v, a = motion.position, motion.velocity, motion.acceleration
        return inverse_dynamics(self.change(motion.model), q, v, a) - inverse_dynamics(motion.model, q, v, a)

    def possible(self) -> bool:
        """Whether physics allows its numbers together; for a single one see the bounds of `amplitude` and `shape`."""
        return True

    def change(self, model: RobotModel) -> RobotModel:
        """The robot with the effect in it, for effects that change its inertia, gravity or geometry."""
        return model

    def position_error(self, motion: Motion) -> Float[Leaf, "samples *joints"]:
        """What the position sensor of the (last) joint `at` reads minus the truth, rad or m; of the robot: of each."""
        raise NotImplementedError(f"{self.name} has no form at the position sensor")

    @staticmethod
    def twist(model: RobotModel, at: tuple[int, ...], shape: float, /) -> Iterator[tuple[str, str, Sequence[Any]]]:
        """Small twists of joint frames that postures show: name, unit and (tree joint, field of the postures) of each.

        See `kinematic.Column`; `shape` is the value of the parameter that is not linear.
        """
        raise NotImplementedError("the effect has no form as a twist")

    def torque_error(self, motion: Motion) -> Float[Array, "samples *rows"]:
        """What the torque sensors read beside the torque of the drives, N m or N; columns as in `torque`."""
        raise NotImplementedError(f"{self.name} has no form at the torque sensor of a record")

    def delivered(self, torque: Float[Array, " nv"]) -> Float[Array, " nv"]:
        """What the drives give of the torques that they are to give, N m or N."""
        return torque

    def through(self, motion: Motion) -> Float[Leaf, " samples"]:
        """What is left, at the joint where it acts, of a small change of all torque together (`follows_total`)."""
        raise NotImplementedError(f"{self.name} leaves the torque as it is")

    def step(self, velocity: Float[Array, " nv"], dt: Float[Array, ""]) -> Effect:
        """The effect with its state after `dt` seconds at a velocity, for effects that have a state.

        The state is the field `memory: Any = eqx.field(default=None, kw_only=True)`; the library puts it in, in a
        simulation and along a record, before `torque` is asked for. Return `dataclasses.replace(self, memory=...)`.
        """
        return self

    def along(self, motion: Motion) -> Float[Array, " samples"]:
        """Its state at each sample of a record, by `step` from the one before; `begin` where a recording begins.

        So `torque` of an effect with a state may use `self.memory`: it is put in before `torque` is asked for.
        """
        own = cast(Any, self)

        def follow(z: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
            velocity, begins = now
            z = jnp.where(begins, self.begin(velocity), changed(own, memory=z).step(velocity, motion.dt).memory)
            return z, z

        return jax.lax.scan(follow, jnp.zeros(()), (jnp.asarray(motion.velocity, float), motion.begins))[1]

    def remembering(self, motion: Motion) -> Effect:
        """The effect with its state along a record, where it has one that is not known."""
        if not self.has("step") or getattr(self, "memory", None) is not None:
            return self
        return changed(self, memory=self.along(motion))

    def begin(self, velocity: Float[Array, " nv"]) -> Float[Array, ""]:
        """The state where a simulation begins at a velocity: the sign of its joint's, sliding; yours may be another."""
        return jnp.sign(velocity[self.at[0]])

    def torque_response(self, omega: Float[Array, " freqs"]) -> Complex[Array, " freqs"]:
        """Factor of the torque sensor at the angular frequencies `omega` (rad/s)."""
        raise NotImplementedError(f"{self.name} has no form at the torque sensor")

    def physical(self) -> dict[str, Scalar]:
        """Parameters as they are reported; a function of the fields where those are not what an engineer reads."""
        return {name: getattr(self, name) for name in self.parameters()}

    @classmethod
    def may_act(cls, model: RobotModel, place: int) -> bool:
        """Whether a diagnosis looks for it at a place: the index of a joint, a link or the first joint of a pair."""
        return True

    @classmethod
    def starts(cls, motion: Motion, place: int) -> dict[str, tuple[float, ...]]:
        """Grids of shapes that depend on the recordings: their motion, its `total` the torque as measured."""
        return {}

    def apart_from(self, other: Effect, low: Float[np.ndarray, " nv"], high: Float[np.ndarray, " nv"]) -> bool:
        """Whether motion between the positions `low` and `high` tells it from the other of which it is one more."""
        return True

    def shown_by(self, low: Float[np.ndarray, " nv"], high: Float[np.ndarray, " nv"]) -> bool:
        """Whether motion between the positions `low` and `high` can tell the effect from a smooth torque at all."""
        return True

    def allows(self, torque: Float[np.ndarray, " rows"]) -> bool:
        """Whether the joint where it acts can have had the torques (N m or N) that were measured there."""
        return True

    def native(self) -> tuple[Native, ...]:
        """Elements of MJCF that carry the effect (URDF takes `damping` and `frictionloss` of a joint)."""
        return ()

    @classmethod
    def parameters(cls) -> dict[str, Parameter]:
        """Declared parameters by field name, in order; amplitudes of a dissipative effect are not below zero."""
        return dict(_declared(cls))

    @classmethod
    def amplitudes(cls) -> list[str]:
        """Names of the parameters that its torque is linear in, in order: without them it does nothing."""
        return [name for name, parameter in _declared(cls).items() if parameter.linear]

    @classmethod
    def units(cls) -> dict[str, str]:
        """Units of `physical()`, for a revolute joint."""
        return {name: parameter.unit for name, parameter in cls.parameters().items()}

    @classmethod
    def has(cls, form: str) -> bool:
        """Whether the effect has the form, the name of one of the methods above."""
        return getattr(cls, form) is not getattr(Effect, form)

    @property
    def places(self) -> Int[Leaf, "*many places"]:
        """`at` as an array."""
        return np.asarray(self.at) if isinstance(self.at, Place) else self.at

    def here(self, signal: Float[Leaf, "samples nv"], place: int = 0) -> Float[Leaf, " samples"]:
        """Column of `signal` at the joint where the effect acts (`place` 1: the second of a pair)."""
        if isinstance(self.at, Place) or (isinstance(signal, np.ndarray) and isinstance(self.at, np.ndarray)):
            return signal[:, self.at[place]]
        return jax.lax.dynamic_index_in_dim(signal, self.at[place], 1, keepdims=False)  # traced at once, unlike `[]`

    def joint_torque(self, motion: Motion) -> Float[Array, "samples nv"]:
        """`torque` in the columns of all joints, zero elsewhere."""
        torque = self.remembering(motion).torque(motion)
        return self.in_joints(torque, motion) if self.has("torque") else torque  # a change is felt at every joint

    def in_joints(self, torque: Float[Array, "samples *rows"], motion: Motion) -> Float[Array, "samples nv"]:
        """A torque or an error of a torque at the effect's own joints in the columns of all."""
        if self.acts_on in ("link", "robot"):
            return torque
        return jnp.zeros_like(motion.velocity).at[:, self.places].add(torque.reshape(torque.shape[0], -1))


def _short(value: Any) -> str:
    """A number in six digits, a place by its indices, all else by its shapes."""
    if isinstance(value, Place) or (isinstance(value, np.ndarray) and value.dtype.kind == "i" and value.size <= 2):
        return str(tuple(np.asarray(value).tolist()))
    if isinstance(value, Tracer) or np.ndim(value) or not isinstance(value, (int, float, jax.Array, np.ndarray)):
        return eqx.tree_pformat(value)
    return f"{float(value):.6g}"


class JointEffect(Effect):
    """An effect at one joint: `torque(motion)` is one number a sample, (samples,), N m or N; see `Effect`.

    >>> import figaroh_jax as fj, jax.numpy as jnp
    >>> class Grease(fj.JointEffect):
    ...     name, title, equation = "grease", "friction of grease", "force s(v) log(1 + |v| / speed)"
    ...     dissipative = True  # a negative force would drive the robot
    ...     force: float = fj.amplitude("N m")
    ...     speed: float = fj.shape("rad/s", (0.01, 0.03, 0.1))  # where a search begins
    ...     def torque(self, motion):
    ...         v = self.here(motion.velocity)
    ...         return self.force * self.here(motion.direction) * jnp.log1p(abs(v) / self.speed)
    >>> float(fj.place(Grease, fj.load_urdf(fj.DEMO), ["elbow"], force=0.5, speed=0.1).speed)
    0.1
    """

    acts_on = "joint"


def smooth_sign(
    velocity: Float[Array, "samples *rows"],
    acceleration: Float[Array, "samples *rows"],
    dt: Float[Array, ""] | float,
    width: Float[Array, "*rows"] | float = 0.0,
) -> Float[Array, "samples *rows"]:
    """Sign of the velocity averaged over one sample: clip(v / max(|a| dt / 2, width), -1, 1).

    `width` (rad/s or m/s) is the half width of the reversal where the friction of the joint itself is smooth; the
    wider of the two ramps is the reversal's.
    """
    # operators and methods that NumPy's arrays have too: on the host it costs no program
    ramp = abs(acceleration) * dt / 2
    wider = (ramp + width + abs(ramp - width)) / 2
    return (velocity / (wider + 1e-9)).clip(-1.0, 1.0)


def place(effect: type[Effect], model: Any, at: Sequence[str] | str = (), **parameters: Any) -> Effect:
    """The effect at the joints, pair or link named in `at`, with parameters by name (the others at their default).

    A parameter is a number, also one that `jax.grad`, `jax.vmap` or `jax.jit` traces. What an effect of yours has as
    further fields (a network of equinox) is taken as it is.

    >>> import figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> friction = fj.place(fj.CATALOGUE["viscous_friction"], robot, ["elbow"], damping=1.5)
    >>> float(friction.damping)
    1.5
    """
    if not (isinstance(effect, type) and issubclass(effect, Effect)):
        told = f"'{effect}'" if isinstance(effect, str) else f"a {type(effect).__name__}"
        raise InputError(
            f"place takes an effect, then the model: fj.place(fj.CATALOGUE[name], model, at); got {told} first"
        )
    model = getattr(model, "robot", model)  # of an extended model
    if not isinstance(model, RobotModel):
        raise InputError(
            "place takes an effect, then the model: fj.place(fj.CATALOGUE[name], model, at); got"
            f" {type(model).__name__} in place of the model"
        )
    wanted = {"joint": 1, "pair": 2, "link": 1, "robot": 0}[effect.acts_on]
    at = [at] if isinstance(at, str) or not isinstance(at, Iterable) else [*at]
    for one in at:
        if not isinstance(one, str):
            raise InputError(f"`at` takes names, got {str(one)[:60]!r}; joints are {', '.join(model.dof_names)}")
    if len(at) != wanted:
        raise InputError(f"effect '{effect.name}' acts on a {effect.acts_on}: `at` takes {wanted} names, got {len(at)}")
    index = model.link_index if effect.acts_on == "link" else model.joint_index
    numbers, fields = effect.parameters(), [f.name for f in dataclasses.fields(effect) if f.name != "at"]
    unknown = set(parameters) - set(fields)
    if unknown:
        known = ", ".join(numbers or fields)
        raise InputError(f"effect '{effect.name}' has no parameter '{sorted(unknown)[0]}'; known: {known}")
    indices = np.asarray([index(name) for name in at], dtype=np.int64)
    if effect.has("step"):
        _check_memory(effect)
    given = {name: _number(effect, name, x) if name in numbers else x for name, x in parameters.items()}
    return effect(indices, **given)


def _check_memory(effect: type[Effect]) -> None:
    """Refuse a state that would stand still along a record."""
    memory = next((f for f in dataclasses.fields(effect) if f.name == "memory"), None)
    if memory is None or memory.default is not None:
        raise InputError(
            f"effect '{effect.name}' has a `step`, so its state is a field `memory: Any = eqx.field(default=None,"
            " kw_only=True)`, which the library puts in"
        )


def _number(effect: type[Effect], name: str, value: Any) -> Any:
    if isinstance(value, Tracer) and value.ndim == 0:
        return value
    try:
        number = None if np.asarray(value).dtype.kind in "SU" else np.float64(value)  # of text it would read a number
    except (TypeError, ValueError):
        number = None
    if number is None or np.ndim(number) or np.isnan(number):
        raise InputError(f"effect '{effect.name}': {name} is {str(value)[:60]!r}; a number is expected")
    return number


def fixed(effect: Effect) -> Effect:
    """The effect with its place static, where it stands at one known place."""
    if isinstance(effect.at, (Place, Tracer)) or np.ndim(effect.at) != 1:
        return effect
    return eqx.tree_at(lambda e: e.at, effect, Place(tuple(np.asarray(effect.at).tolist())))


def movable(effect: Effect) -> Effect:
    """The effect with its place an array: programs then serve every place, and `jax.vmap` maps over places."""
    return changed(effect, at=effect.places) if isinstance(effect.at, Place) else effect


def exact(effect: T) -> T:
    """The effect with its torque linear about its own size, where that matters (`Effect.about`)."""
    if not isinstance(effect, Effect) or effect.about is None:
        return effect
    where, size = effect.about
    return changed(effect, **{where: getattr(effect, size)})


def joint_unit(unit: str, prismatic: bool) -> str:
    """The unit at a prismatic joint: N for N m, m for rad, kg for kg m2."""
    return unit.replace("N m", "N").replace("rad", "m").replace("kg m2", "kg") if prismatic else unit


def columns(effect: Effect, motion: Motion) -> Float[Array, "amplitudes samples *rows"]:
    """Torque (read or added) of a unit of each amplitude: the exact columns of the regressor, for the given shape."""
    names, effect = effect.amplitudes(), effect.remembering(motion)

    def torque(values: Float[Array, " amplitudes"]) -> Float[Array, "samples *rows"]:
        one = eqx.tree_at(lambda e: [getattr(e, n) for n in names], effect, list(values))
        return one.torque_error(motion) if one.has("torque_error") else one.torque(motion)

    # linear and zero at zero, so the torque of a unit is the derivative, with half the work to trace
    if len(names) == 1:
        return torque(jnp.ones(1))[None]
    return jax.vmap(torque)(jnp.eye(len(names)))
