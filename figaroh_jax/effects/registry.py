"""Effects by their names: `register` adds one, `find` gives it back, `related` tells how it stands to others."""

from __future__ import annotations

from typing import NoReturn

from ..errors import InputError, nearest
from .base import Effect

__all__ = ["CATALOGUE", "POSES", "ROLLOUTS", "find", "one_more", "register", "related"]


class UnknownEffect(InputError, KeyError):
    """A name that no effect has: a `KeyError` of the catalogue, with the nearest known name."""

    __str__ = Exception.__str__  # that of KeyError quotes


class _Named(dict[str, type[Effect]]):
    """Effects by their names; a name that is not there is refused with the nearest one."""

    def __repr__(self) -> str:
        return f"{len(self)} effects: {', '.join(self)}"

    def __missing__(self, name: str) -> NoReturn:
        raise UnknownEffect(f"no effect '{name}' in the catalogue{nearest(name, self)}")


CATALOGUE: dict[str, type[Effect]] = _Named()  # that a diagnosis of torques looks for
POSES: dict[str, type[Effect]] = {}  # that a calibration and a diagnosis of postures look for
ROLLOUTS: dict[str, type[Effect]] = {}  # that a diagnosis of rollouts looks for, as they are called there
_OTHERS: dict[str, type[Effect]] = {}  # known by name, but nothing that a diagnosis looks for


def register(effect: type[Effect]) -> type[Effect]:
    """Add an effect class to the catalogue under its `name` (usable as a decorator); returns it.

    Where another one can imitate it exactly (a power law a square law), `contained_in` names that one, and the simpler
    is preferred. Its `levels` say which diagnoses look for it: of torques, and of postures where it has an error of the
    position that is linear in a parameter, or a twist, and of rollouts where it acts at a joint by a torque.

    >>> import figaroh_jax as fj
    >>> @fj.register
    ... class Drag(fj.Effect):
    ...     name, title, acts_on, equation = "drag", "drag of the air", "joint", "c v |v|"
    ...     drag: float = fj.amplitude("N m s2/rad2", lower=0.0)
    ...     def torque(self, motion):
    ...         return self.drag * self.here(motion.velocity) * abs(self.here(motion.velocity))
    >>> fj.CATALOGUE["drag"] is Drag
    True
    """
    if not isinstance(effect, type) or not hasattr(effect, "levels"):
        raise InputError(f"register is given {effect!r:.100}; a class of effects is expected: class Drag(fj.Effect)")
    if (CATALOGUE | _OTHERS | POSES | ROLLOUTS).get(effect.name, effect).__qualname__ != effect.__qualname__:
        raise InputError(f"an effect called '{effect.name}' is registered already")
    if "torque" in effect.levels:
        (CATALOGUE if effect.searched else _OTHERS)[effect.name] = effect
    linear = effect.has("position_error") and bool(effect.amplitudes())
    if "pose" in effect.levels and effect.searched and (effect.has("twist") or linear):
        POSES[effect.name] = effect
    acts = bool(effect.in_rollouts.numbers) or (effect.acts_on == "joint" and effect.has("torque") and effect.searched)
    if "rollout" in effect.levels and acts:
        ROLLOUTS[effect.in_rollouts.called or effect.name] = effect
    for name in effect.contained_in:
        outer = find(name)
        outer.contains = tuple(dict.fromkeys((*outer.contains, effect.name)))
    return effect


def find(name: str) -> type[Effect]:
    """The effect called `name`; raises `InputError` with the nearest known name."""
    known = CATALOGUE | _OTHERS
    if name not in known:
        raise UnknownEffect(f"no effect '{name}' in the catalogue{nearest(name, known)}")
    return known[name]


def one_more(name: str) -> type[Effect] | None:
    """What is looked for where an effect has been accepted: one more of it at the same place; None for most."""
    return next((effect for effect in _OTHERS.values() if effect.one_more_of == name), None)


def related(name: str, relation: str) -> tuple[str, ...]:
    """Effects that stand in a `relation` to one: `indistinguishable_from` or `excludes`, whichever of them states it.

    A tuple of names, sorted, without the name itself; names that are not registered are left out.
    """
    known = CATALOGUE | _OTHERS
    own = getattr(known[name], relation) if name in known else ()
    back = (other for other, effect in known.items() if name in getattr(effect, relation))
    return tuple(sorted({*own, *back} & set(known) - {name}))
