"""Which experiment would tell apart what these recordings cannot."""

from __future__ import annotations

from collections.abc import Sequence

from ..effects import find
from ..results import Experiment, Name
from .search import Found

__all__ = ["next_experiment"]


def next_experiment(word: str, found: Sequence[Found]) -> Experiment | None:
    """The experiment for the first cause that is not alone in its set, or for a misfit without a name."""
    unsure = [one for one in found if one.ambiguous]
    if unsure:
        one = unsure[0]
        pairs = tuple((one.name.effect, other.effect) for other in one.ambiguous)
        return Experiment(_text(one.name), pairs)
    if word == "unknown":
        return Experiment("the same motion repeated, then each joint alone at several constant speeds")
    return None


def _text(name: Name) -> str:
    where = " and ".join(name.at) or "the robot"
    return find(name.effect).separated_by.format(at=where)
