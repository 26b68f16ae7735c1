"""How an answer is judged against the truth that a case hides: right, in the set, abstained, wrong.

Answers are read by their public form only: `verdict`, and causes with `name` (`effect`, `at`) and `ambiguous_with`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from scipy.stats import beta

from .case import Truth
from .inverse import observable

Grade = Literal["right", "set", "nothing", "unknown", "wrong"]
Name = tuple[str, tuple[str, ...]]


@dataclass(frozen=True)
class Score:
    """How one case went: the grade of the first cause, and the causes named beside the truth."""

    case: str
    grade: Grade
    false: tuple[Name, ...]  # named, and neither they nor a member of their set is true
    verdict: str
    told: tuple[Name, ...]


def named(answer: Any) -> list[tuple[Name, set[Name]]]:
    """Causes of an answer that stands by them, each with its set; `unknown` and `nothing` name none."""
    if answer.verdict not in ("named", "named+rest"):
        return []
    causes = []
    for cause in answer.causes:
        name = (cause.name.effect, tuple(cause.name.at))
        causes.append((name, {name} | {(other.effect, tuple(other.at)) for other in cause.ambiguous_with}))
    return causes


def judge(case: str, truths: Sequence[Truth], answer: Any) -> Score:
    """Grade the first cause: `right` name and place, truth in its `set`, no name (`nothing`, `unknown`), or `wrong`.

    Names that no torque data can tell apart count as one (`inverse.CLASSES`).
    """
    true: set[Name] = set().union(*(observable(t) for t in truths))
    causes = named(answer)
    false = tuple(name for name, members in causes if not members & true)
    told = tuple(name for name, _ in causes)
    if not causes:
        return Score(case, "nothing" if answer.verdict == "nothing" else "unknown", false, answer.verdict, told)
    first, members = causes[0]
    grade: Grade = "right" if first in true else "set" if members & true else "wrong"
    return Score(case, grade, false, answer.verdict, told)


def upper_bound(failures: int, trials: int, level: float = 0.95) -> float:
    """Clopper-Pearson upper bound of a rate."""
    return 1.0 if failures == trials else float(beta.ppf(level, failures + 1, trials - failures))


def table(scores: Iterable[Score]) -> str:
    """One line a case, then the counts."""
    scores = list(scores)
    width = max((len(s.case) for s in scores), default=4)
    lines = [f"{s.case:<{width}}  {s.grade:<8} {s.verdict:<10} {_told(s)}" for s in scores]
    grades = ("right", "set", "nothing", "unknown", "wrong")
    counts = ", ".join(f"{g} {sum(s.grade == g for s in scores)}" for g in grades)
    return "\n".join([*lines, f"{len(scores)} cases: {counts}; false causes {sum(len(s.false) for s in scores)}"])


def _told(score: Score) -> str:
    said = "; ".join(f"{effect} ({', '.join(at)})" for effect, at in score.told)
    return said + (f"   FALSE: {score.false}" if score.false else "")
