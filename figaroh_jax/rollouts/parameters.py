"""Numbers of a loop by name: what a fit may change, as one vector.

A `Table` lists (name, place) entries; `put` writes a vector of their values into a loop. A place is a coordinate, a
drive or a link, or several of them that share one number.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..effects.base import joint_unit
from ..effects.environment import level_axes
from . import own
from .loop import Loop, turns

__all__ = [
    "BOUNDS",
    "OF_DRIVES",
    "OF_SEVERAL",
    "TEN",
    "TILT",
    "UNITS",
    "Entry",
    "Table",
    "current",
    "of_one_number",
    "put",
    "tilt_slope",
    "tilted",
    "uncoupled",
    "unit_of",
    "unit_payload",
    "values",
]

_PAIRS = {"pair_inertia": "inertia", "pair_damping": "damping", "pair_friction": "friction"}  # fields of `Pairs`
_DRIVES = ("scale", "delay", "dead_band", "voltage", "time_constant")  # fields of `Drives`
OF_DRIVES = (*_DRIVES, "force_limit", "kp", "kd")  # places that are drives
TILT = ("gravity_x", "gravity_y")  # m/s2 of gravity along `level_axes`: it is turned, not made longer
OF_SEVERAL = ("payload", *TILT, *_PAIRS)  # numbers that several joints show


class Entry(NamedTuple):
    """One number: `name` is a field of `Joints` or `Drives`, or kp, kd, force_limit, payload, or one of `TEN`.

    Or that of a number of an effect, "effect.parameter"; its place is one of the loop's `effects`.
    """

    name: str
    at: tuple[int, ...]  # coordinates, drives (names of `Drives`, kp, kd, force_limit), links (payload, `TEN`), pairs


Table = tuple[Entry, ...]


def of_one_number(table: Table, alike: Sequence[tuple[int, ...]]) -> Table:
    """The table with one number where `alike` are several: the first has the places of all, the others have none.

    Each of `alike` are the entries of one place, in the same order of names.
    """
    new = list(table)
    for first, *others in zip(*alike, strict=True):
        new[first] = table[first]._replace(at=tuple(at for k in (first, *others) for at in table[k].at))
        for k in others:
            new[k] = table[k]._replace(at=())
    return tuple(new)


TEN = ("mass", "mass_x", "mass_y", "mass_z",
       "inertia_xx", "inertia_xy", "inertia_yy", "inertia_xz", "inertia_yz", "inertia_zz")  # fmt: skip


class _Known(dict[str, Any]):
    """What is known of numbers by their names; of effects' numbers their class says it."""

    def __init__(self, known: dict[str, Any], of_effect: Callable[[str], Any]):
        super().__init__(known)
        self.of_effect = of_effect

    def __missing__(self, name: str) -> Any:
        if not own.is_own(name):
            raise KeyError(name)
        return self.of_effect(name)


UNITS = _Known({
    "armature": "kg m2", "damping": "N m s/rad", "friction": "N m", "stribeck_force": "N m", "stribeck_speed": "rad/s",
    "load_ratio": "", "stiffness": "N m/rad", "rest": "rad", "play": "rad", "offset": "N m", "ripple_sine": "N m",
    "ripple_cosine": "N m", "ripple_order": "1/rad", "reading": "rad", "scale": "", "delay": "s", "dead_band": "rad",
    "voltage": "N m", "force_limit": "N m", "time_constant": "s", "payload": "kg", "kp": "N m/rad", "kd": "N m s/rad",
    "gravity_x": "m/s2", "gravity_y": "m/s2", "pair_inertia": "kg m2", "pair_damping": "N m s/rad",
    "pair_friction": "N m", "mass": "kg", **dict.fromkeys(TEN[1:4], "kg m"),
    **dict.fromkeys(TEN[4:], "kg m2"),
}, own.unit_of)  # fmt: skip

_ANY = (-np.inf, np.inf)
BOUNDS = _Known({  # what such a number can be
    "armature": (1e-6, 1e3), "damping": (0.0, 1e4), "friction": (0.0, 1e4), "stribeck_force": (0.0, 1e4),
    "stribeck_speed": (0.005, 3.0), "load_ratio": (0.0, 0.95), "stiffness": (0.0, 1e7), "play": (0.0, 0.5),
    "ripple_order": (0.5, 40.0), "scale": (1e-3, 1e3), "delay": (0.0, 0.15), "dead_band": (0.0, 0.5),
    "voltage": (1e-4, 1e6), "force_limit": (1e-4, 1e6), "time_constant": (1e-4, 2.0), "payload": (-50.0, 50.0),
    "kp": (1e-6, 1e6), "kd": (0.0, 1e5), "reading": (-0.5, 0.5), "offset": _ANY, "rest": _ANY, "ripple_sine": _ANY,
    "ripple_cosine": _ANY, "gravity_x": (-6.5, 6.5), "gravity_y": (-6.5, 6.5), **dict.fromkeys(_PAIRS, (0.0, 1e4)),
    **dict.fromkeys(TEN, _ANY),
}, own.bounds_of)  # fmt: skip


def unit_of(loop: Loop, entry: Entry) -> str:
    """The unit of a number where it stands: N and m at a joint that slides, N m and rad at one that turns."""
    unit, turning = UNITS[entry.name], turns(loop)
    if entry.name in (*OF_SEVERAL, *TEN) or own.is_own(entry.name):
        return unit
    place = entry.at[0]
    if entry.name in OF_DRIVES:
        place = int(np.abs(np.asarray(loop.drives.transmission)[place]).argmax())
    return joint_unit(unit, not turning[place])


def values(loop: Loop, table: Table) -> np.ndarray:
    """The numbers of the table in a loop (a payload is 0, as are those of `TEN` and `TILT`: they are what is added).

    NaN where an entry has no place (`of_one_number`).
    """
    return np.array([float(_get(loop, entry.name)[entry.at[0]]) if entry.at else np.nan for entry in table])


def current(loop: Loop, table: Table) -> Array:
    """`values` of a loop whose numbers JAX may be tracing."""
    return jnp.stack([jnp.asarray(_get(loop, entry.name, jnp)[entry.at[0]]) for entry in table])


def _get(loop: Loop, name: str, xp: Any = np) -> Any:
    if own.is_own(name):
        return own.read_number(loop.effects, name, xp)
    if name in _PAIRS:
        return xp.asarray(getattr(loop.pairs, _PAIRS[name]))
    drives = loop.drives
    special = {
        "kp": lambda: xp.asarray(drives.gain)[:, 0],
        "kd": lambda: -xp.asarray(drives.bias)[:, 2],
        "force_limit": lambda: xp.asarray(drives.force_range)[:, 1],
        "payload": lambda: xp.zeros(len(loop.robot.joints) if loop.carried is None else len(loop.carried.payload)),
        **dict.fromkeys(TEN, lambda: xp.zeros(len(loop.robot.joints))),
        **dict.fromkeys(TILT, lambda: xp.zeros(1)),
    }
    if name in special:
        return special[name]()
    return xp.asarray(getattr(drives if name in _DRIVES else loop.joints, name))


def put(loop: Loop, table: Table, theta: Array | np.ndarray) -> Loop:
    """The loop with the table's numbers; differentiable in `theta`."""
    with jax.enable_x64(True):
        leans = {entry.name: theta[k] for k, entry in enumerate(table) if entry.name in TILT}
        if leans:
            turned = tilted(loop.robot.gravity, *(leans.get(name, 0.0) for name in TILT))
            loop = eqx.tree_at(lambda m: m.robot.gravity, loop, turned)
        for name in dict.fromkeys(entry.name for entry in table if entry.name not in TILT):
            pairs = [(place, k) for k, entry in enumerate(table) if entry.name == name for place in entry.at]
            at, which = (np.array(x) for x in zip(*pairs, strict=True))
            loop = _put(loop, name, at, theta[which])
    return loop


def _put(loop: Loop, name: str, at: np.ndarray, new: Array | np.ndarray) -> Loop:
    if own.is_own(name):
        return dataclasses.replace(loop, effects=own.with_numbers(loop.effects, name, at, new))
    if name in _PAIRS and loop.pairs is None:  # taken away where none of them acts: `uncoupled`
        return loop
    if name in _PAIRS:
        old = jnp.asarray(getattr(loop.pairs, _PAIRS[name]))
        return eqx.tree_at(lambda m: getattr(m.pairs, _PAIRS[name]), loop, old.at[at].set(new))
    if name == "payload" and loop.carried is not None:
        whole = jnp.asarray(loop.carried.payload).at[at].set(new)
        return eqx.tree_at(lambda m: m.carried.payload, loop, whole)
    if name == "payload":
        ten = jnp.asarray(loop.robot.inertia)
        chosen = np.eye(len(ten))[at]  # no scatter: XLA mixes up one that adds to the array it is computed from
        return eqx.tree_at(lambda m: m.robot.inertia, loop, ten + chosen.T @ (new[:, None] * unit_payload(loop, at)))
    if name in TEN:
        return eqx.tree_at(
            lambda m: m.robot.inertia, loop, jnp.asarray(loop.robot.inertia).at[at, TEN.index(name)].add(new)
        )
    if name == "force_limit":
        limits = jnp.asarray(loop.drives.force_range).at[at].set(jnp.stack([-new, new], 1))
        return eqx.tree_at(lambda m: m.drives.force_range, loop, limits)
    if name == "kp":
        gain, bias = (jnp.asarray(x) for x in (loop.drives.gain, loop.drives.bias))
        both = gain.at[at, 0].set(new), bias.at[at, 1].set(-new)
        return eqx.tree_at(lambda m: (m.drives.gain, m.drives.bias), loop, both)
    if name == "kd":
        return eqx.tree_at(lambda m: m.drives.bias, loop, jnp.asarray(loop.drives.bias).at[at, 2].set(-new))
    group = "drives" if name in _DRIVES else "joints"
    old = jnp.asarray(getattr(getattr(loop, group), name))
    return eqx.tree_at(lambda m: getattr(getattr(m, group), name), loop, old.at[at].set(new))


def tilted(gravity: Any, x: Any, y: Any) -> Array:
    """Gravity (3,), m/s2, turned so that `x` and `y` of it are along its `level_axes`."""
    g, flat = jnp.asarray(gravity), jnp.stack([jnp.asarray(x), jnp.asarray(y)])
    return _upright(g, flat) * g + level_axes(g) @ flat


def tilt_slope(gravity: Any, x: Any, y: Any) -> Array:
    """Derivatives (3, 2) of `tilted` by its two numbers."""
    g, flat = jnp.asarray(gravity), jnp.stack([jnp.asarray(x), jnp.asarray(y)])
    return level_axes(g) - jnp.outer(g, flat) / (jnp.maximum(g @ g, 1e-300) * _upright(g, flat))


def _upright(g: Array, flat: Array) -> Array:
    """The share of gravity that stays where it was: its length is the same."""
    return jnp.sqrt(jnp.maximum(1 - flat @ flat / jnp.maximum(g @ g, 1e-300), 1e-6))


def uncoupled(loop: Loop, table: Table, thetas: Any, frees: Any) -> Loop:
    """The loop without its couplings where none acts and no number of one is free: each costs a row at every step."""
    mine = [k for k, entry in enumerate(table) if entry.name in _PAIRS]
    if loop.pairs is None or np.asarray(thetas)[..., mine].any() or np.isin(frees, mine).any():
        return loop
    told = {(entry.name, at) for entry in table for at in entry.at}
    if any(np.asarray(getattr(loop.pairs, field))[k] and (name, k) not in told
           for name, field in _PAIRS.items() for k in range(len(loop.pairs.at))):  # fmt: skip
        return loop
    return dataclasses.replace(loop, pairs=None)


def unit_payload(loop: Loop, at: np.ndarray) -> Array:
    """Ten parameters of a unit mass at the centre of mass of each link."""
    xp: Any = np if isinstance(loop.robot.inertia, np.ndarray) else jnp
    own = xp.asarray(loop.robot.inertia)[at]
    c = own[:, 1:4] / xp.maximum(own[:, :1], 1e-9)
    x, y, z = c.T
    inertia = xp.stack([y * y + z * z, -x * y, x * x + z * z, -x * z, -y * z, x * x + y * y], 1)
    return xp.concatenate([xp.ones((len(c), 1)), c, inertia], 1)
