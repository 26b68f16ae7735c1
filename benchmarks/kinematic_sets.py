"""Sets of kinematic errors, and arms that were not the same in all recordings: how `diagnose` of postures does.

`hidden_kinematics.py --several` and `--differs` run it. Causes and hidden effects are paired as well as can be: by name
first, then by the sets of what is said to be alike; what stays of the causes is false. Numbers that have a name are
compared with those that were hidden, in standard deviations.
"""

from __future__ import annotations

import collections
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from generators import posture_sets, postures  # noqa: E402

__all__ = ["CHANGES", "Graded", "graded", "study"]

CHANGES = (*posture_sets.CHANGES, "same")
FRAMES = {"marker": "tool_frame", "tracker": "base_frame"}
FAR = 2.576  # standard deviations: 1 % of right intervals are as far off


class Graded(NamedTuple):
    """What became of every hidden effect (named, set, missed), causes that are none of them, and sizes in sigmas."""

    marks: tuple[str, ...]
    false: tuple[str, ...]
    sigmas: tuple[tuple[str, float], ...]


def graded(case: posture_sets.Hidden, found: Any) -> Graded:
    """The answer beside what was hidden."""
    own = [(cause.name.effect, tuple(cause.name.at)) for cause in found.causes]
    alike = [{(other.effect, tuple(other.at)) for other in cause.ambiguous_with} for cause in found.causes]
    free, marks = set(range(len(own))), dict[int, str]()
    sigmas = list[tuple[str, float]]()
    for k, truth in enumerate(case.truths):
        mine = next((c for c in sorted(free) if own[c] == truth.name), None)
        if mine is not None:
            marks[k] = "named"
            free.remove(mine)
            sigmas += _sigmas(found.causes[mine], truth)
    for k, truth in enumerate(case.truths):
        mine = None if k in marks else next((c for c in sorted(free) if truth.name in alike[c]), None)
        marks.setdefault(k, "missed" if mine is None else "set")
        free -= {mine} if mine is not None else set()
    frames = FRAMES.get(case.changed)
    false = [str(found.causes[c].name) for c in sorted(free) if own[c][0] != frames]
    return Graded(tuple(marks[k] for k in range(len(case.truths))), tuple(false), tuple(sigmas))


def _sigmas(cause: Any, truth: posture_sets.Truth) -> list[tuple[str, float]]:
    """How far each plain number is from the truth, in standard deviations; of waves the amplitude."""
    values = dict(cause.parameters)
    if not values:  # it has no one size
        return []
    values = {
        name.partition(" ")[0]: one for name, one in values.items()
    }  # an offset of the last recording: "change in"
    if "amplitude" in truth.values:
        pair = [values.pop(name) for name in ("sine", "cosine")]
        size = float(np.hypot(*(one.value for one in pair)))
        std = float(np.hypot(*(one.value * one.std for one in pair))) / size
        return [(f"{cause.name} amplitude", (size - truth.values["amplitude"]) / std)]
    both = [name for name in truth.values if name in values]
    return [(f"{cause.name} {n}", (values[n].value - truth.values[n]) / values[n].std) for n in both]


def study(
    robots: Sequence[postures.Arm],
    seeds: Iterable[int],
    several: Sequence[int],
    differs: Sequence[str],
    diagnose: Callable[[postures.Arm, posture_sets.Hidden], Any],
) -> None:
    """Ask about one case for each seed, print a line for each, and tables."""
    counts: dict[str, collections.Counter[str]] = {}
    sigmas = list[tuple[str, float]]()
    for seed in seeds:
        rng = np.random.default_rng([seed, 733])
        robot = robots[int(rng.integers(len(robots)))]
        if differs:
            change = str(rng.choice(differs))
            beside = int(rng.choice([0, 0, 1]))
            kind, case = change, posture_sets.differ(robot, None if change == "same" else change, beside, rng)
        else:
            kind = f"{(number := int(rng.choice(several)))} effects"
            case = posture_sets.hide_several(robot, number, rng)
        start = time.process_time()
        found = diagnose(robot, case)
        grade = graded(case, found)
        sigmas += grade.sigmas
        counts.setdefault(kind, collections.Counter()).update(_counted(case, found, grade))
        print(_line(f"{seed}: {robot.joints[0][:5]} {kind}", case, found, grade), end="")
        print(f" | {time.process_time() - start:.1f} s", flush=True)
    for kind, count in counts.items():
        print(f"{kind:22} " + ", ".join(f"{what} {n}" for what, n in sorted(count.items())))
    if sigmas:
        size = np.abs([s for _, s in sigmas])
        print(f"numbers of what is named: {len(size)}, in the 95 % interval {np.mean(size < 1.96):.3f},", end=" ")
        print(f"beyond {FAR}: " + (", ".join(f"{name} {s:+.1f}" for name, s in sigmas if abs(s) > FAR) or "none"))


def _counted(case: posture_sets.Hidden, found: Any, grade: Graded) -> list[str]:
    blind = found.verdict == "nothing" and bool(case.truths or case.changed)
    untold = case.changed and found.verdict == "named" and not _told(found)
    more = ["blind"] * blind + ["difference untold"] * bool(untold) + ["with a false name"] * bool(grade.false)
    return ["cases", f"verdict {found.verdict}", *grade.marks, *more]


def _told(found: Any) -> bool:
    """Whether a note says that the recordings differ."""
    notes = [*found.calibration.notes, *(cause.note for cause in found.causes)]
    return any("recordings" in note and "differ" in note for note in notes)


def _line(head: str, case: posture_sets.Hidden, found: Any, grade: Graded) -> str:
    truths = [
        f"{t.name[0]} ({', '.join(t.name[1])}) x{t.size:g} {m}" for t, m in zip(case.truths, grade.marks, strict=True)
    ]
    causes = []
    for cause in found.causes:
        alike = "/".join(f"{other.effect} {' '.join(other.at)}" for other in cause.ambiguous_with)
        causes.append(f"{cause.name}" + (f" [{alike}]" if alike else ""))
    far = "".join(f"; {name} off by {s:+.1f} sigma" for name, s in grade.sigmas if abs(s) > FAR)
    false = f" FALSE {', '.join(grade.false)}" if grade.false else ""
    told = f"{found.verdict} p {found.p_value:.3f}: {'; '.join(causes)}"
    return f"{head}: {'; '.join(truths) or 'nothing'} | {told}{far}{false}" + (" TOLD" if _told(found) else "")
