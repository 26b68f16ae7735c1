"""Plain English for what a diagnosis found: the same sentences on the report's first screen and on the terminal."""

from __future__ import annotations

import inspect
import math
import shutil
import sys
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..effects.catalogue import CATALOGUE
from ..estimation.told import ABOUT_JOINT
from ..results import BoundedEstimate, Cause, Diagnosis, Estimate, MovedLink, Name, Nearest, Part
from .rollout_effects import ROLLOUT_EFFECTS

if TYPE_CHECKING:
    from ..calibration.calibrated import Calibration
    from ..calibration.kinematic_diagnosis import PoseDiagnosis

__all__ = [
    "aside",
    "calibration_sentence",
    "dependence",
    "distances",
    "effect_equation",
    "effect_meaning",
    "effect_title",
    "error",
    "fitted",
    "interval",
    "level",
    "links",
    "moved",
    "nearest",
    "number",
    "p_value",
    "phrase",
    "place",
    "pose_sentence",
    "rest",
    "sentence",
    "undecided",
    "unexplained",
    "unit",
]

_NORMAL_95 = 1.96  # standard deviations on each side of a 95 % interval
_MOST = 2 / 3  # of what all links gain: those that come first and take as much are told in the headline
_SURE = 0.05  # p-value below which it stands beside what is not noise alone


def sentence(diagnosis: Diagnosis, robot: str) -> str:
    """The verdict in one sentence, e.g. "The simulation of tx40 is missing rotor inertia at joint_3: ...".

    A second one says so where the links of the model file are others than the torque asks for.
    """
    return " ".join(filter(None, (_verdict(diagnosis, robot), _filed(diagnosis))))


def _filed(diagnosis: Diagnosis) -> str:
    """That the links of the file are not as the torque has them, and what the most of it looks like.

    Empty where they are, or where no link can be told.
    """
    links = diagnosis.links
    if links is None or not links.moved or diagnosis.rest.contradicts:
        return ""
    first = links.moved[: next((k for k, one in enumerate(links.moved, 1) if one.share > _MOST), len(links.moved))]
    gone = [one.note for one in first if one.note.startswith("as if ")]
    looks = _join([phrase(one.name) for one in first], "and")
    plain = any(one.name.effect == "link_inertia" and one.note != ABOUT_JOINT for one in first)
    told = gone[0] if gone else "" if plain else f"by what looks like {looks}"  # plain links stand for much else
    before, after = fall(links.gain.before, links.gain.after, links.gain.unit)
    return (
        "The masses and inertias of the model file do not fit: with fitted ones the error on held-out data is"
        f" {after} in place of {before}{f', mostly {told}' if told else ''}."
    )


def links(diagnosis: Diagnosis) -> list[str]:
    """How far the links of the model file are off and which of them, in sentences; empty where they are as believed."""
    own = diagnosis.links
    if own is None:
        return []
    before, after = fall(own.gain.before, own.gain.after, own.gain.unit)
    return [
        f"With the links of the model file the error on held-out data is {before}, with fitted ones {after}. The torque"
        f" moves them {number(own.far, 2)} times as far as robot.trust ({number(100 * own.trust, 3)} %) lets expect; a"
        " wrong gain of the torque at a joint does that too, and so may what else is missing.",
        *map(moved, own.moved),
    ]


def moved(one: MovedLink) -> str:
    """A link or rotor that is another than the model file has: where, its numbers, what these look like, what else it
    may be, and how much of the gain of all links it takes with those before it."""
    sizes = ", ".join(f"{name} {interval(value)}" for name, value in one.numbers.items())
    instead = f"{_join([phrase(other) for other in one.instead], 'or')} does as well" if one.instead else ""
    share = f"with it {100 * one.share:.0f} % of the difference"
    return f"{phrase(one.name)}: {'; '.join(filter(None, (sizes, one.note, share, instead)))}"


def _verdict(diagnosis: Diagnosis, robot: str) -> str:
    subject = f"The simulation of {robot}"
    if diagnosis.rest.contradicts:
        first, *others = diagnosis.rest.contradicts
        more = f" (the notes say {len(others)} more)" if others else ""
        return (
            f"First settle what looks wrong: recordings and model of {robot} contradict each other, so that no effect"
            f" can be named. {first}{more}"
        )
    if diagnosis.verdict == "nothing":
        told = f"(error on held-out data {error(diagnosis.holdout.before, diagnosis.holdout.unit)})."
        if diagnosis.rest.undecided:
            return (
                f"No effect can be named that the simulation of {robot} is missing, but these data do not show that it"
                f" is right: {undecided(diagnosis)} {told}"
            )
        agrees = f"{subject} agrees with the data{_once(diagnosis)}: no missing effect is detectable"
        if not diagnosis.rest.tolerated:
            return f"{agrees}, and the residual is consistent with noise {told}"
        surely = f" ({p_value(diagnosis.p_value)})" if diagnosis.p_value < _SURE else ""
        return f"{agrees}. The residual is not noise alone{surely}, but {diagnosis.rest.tolerated} {told}"
    fall = _fall(diagnosis)
    if diagnosis.verdict == "unknown":
        found = f" Adding {_list(diagnosis.causes)} is not enough: {fall}." if diagnosis.causes else ""
        return f"{subject} has an error that no effect in the catalogue explains.{found}"
    rest = ". Part of the residual remains unexplained" if diagnosis.verdict == "named+rest" else ""
    return " ".join(filter(None, (f"{subject} is missing {_list(diagnosis.causes)}: {fall}{rest}.", diagnosis.remark)))


def _once(diagnosis: Diagnosis) -> str:
    """Which numbers of the file had to be others before the simulation agreed; empty where none had to."""
    if diagnosis.links is not None:
        return " once the masses and inertias of its links are fitted"
    refitted = diagnosis.refitted
    more = f" and {len(refitted) - 1} more {'number is' if len(refitted) == 2 else 'numbers are'} fitted"
    return f" once the {refitted[0]}{more if len(refitted) > 1 else ''}" if refitted else ""


def undecided(diagnosis: Diagnosis) -> str:
    """How much may be left at which joint where the data do not tell it from noise, and why they do not; else empty."""
    why = diagnosis.rest.undecided
    return f"up to {_largest(diagnosis)} is left, and {why}" if why else ""


def unexplained(diagnosis: Diagnosis) -> str:
    """How large what no cause explains is at the joint with most of it, and what is known of it; may be empty."""
    left = diagnosis.rest
    size = _largest(diagnosis) if len(left.relative) and max(left.relative) > 0 else ""
    return "; ".join(text for text in (size, left.text) if text)


def _largest(diagnosis: Diagnosis) -> str:
    """What is left at the joint with most of it: "4.0 % of the torque of elbow"."""
    relative = diagnosis.rest.relative
    worst = max(range(len(relative)), key=lambda k: relative[k])
    what = "motion" if diagnosis.of_positions else "torque"
    return f"{error(float(relative[worst]), 'relative RMS')} of the {what} of {diagnosis.joints[worst]}"


def rest(diagnosis: Diagnosis) -> list[str]:
    """What no cause explains, in sentences: how large and where, what it goes with, which causes came near."""
    left = diagnosis.rest
    out = [f"Unexplained residual: {told}."] if (told := unexplained(diagnosis)) else []
    for joint in dict.fromkeys(part.at for part in left.parts):
        own = [part for part in left.parts if part.at == joint]
        shares = ", ".join(f"{dependence(part)} ({100 * part.share:.0f} %)" for part in own)
        out.append(f"The residual at {place(joint)} varies with {shares}.")
    return out


def dependence(part: Part) -> str:
    """What a part of a rest goes with, in words."""
    if part.band is not None:
        return f"a line at {number(part.band[0], 3)} to {number(part.band[1], 3)} Hz"
    return f"the recording {part.file}" if part.file else part.kind


def nearest(near: Nearest) -> str:
    """A cause that came near and why it is not named: "torque ripple at joint_2: its gain is not sure"."""
    return f"{phrase(near.name)}: {near.why_not}"


def calibration_sentence(calibration: Calibration) -> str:
    """What the calibration gained, in one sentence; a second one where it explains too little to be used."""
    return f"{_gained(calibration)}{_doubt(calibration)}"


def _doubt(calibration: Calibration) -> str:
    """That postures and model do not belong together, where that is so."""
    if not calibration.contradicted or calibration.unexplained is None:
        return ""
    assert calibration.position is not None
    size = _with_unit(number(calibration.position.validated_after, 3), calibration.position.unit)
    return (
        f" Do not use this model: {size} is {number(100 * calibration.unexplained, 2)} % of the spread of the measured"
        " points, and no calibration leaves that much; check files, columns, units and frames."
    )


def _gained(calibration: Calibration) -> str:
    error = calibration.position or calibration.orientation
    if error is None:
        return "nothing was measured"
    before, after = (_with_unit(number(x, 3), error.unit) for x in (error.validated_before, error.validated_after))
    effects = any(c.name.effect not in ("joint_offset", "outlier") for c in calibration.causes)
    found = level(calibration.level)
    if calibration.level == "frames":
        channel, scale = (0, 1e3) if calibration.position is error else (1, 180.0 / math.pi)
        best = min(calibration.table, key=lambda name: calibration.table[name][channel])
        size = scale * calibration.table[best][channel]
        unsure = size < 0.5 * error.validated_after
        nominal = (
            f"No correction of the robot predicts {'surely ' if unsure else ''}better than the nominal kinematics with"
            " base and tool frames fitted"
        )
        if not effects:
            seems = _with_unit(number(size, 3), error.unit)
            more = f"; {level(best)} would leave {seems}, which these postures are too few to bear out"
            return f"{nominal}: {after} on held-out postures{more if unsure else ''}."
        found = "the nominal geometry and what is named"
    told = f"the error on held-out postures falls from {before} (base and tool frames only) to {after}"
    if not error.validated_after < error.validated_before:
        told = f"the error on held-out postures is {after}, no less than with base and tool frames only ({before})"
    return f"With {found}, {told}."


def pose_sentence(diagnosis: PoseDiagnosis, robot: str) -> str:
    """The verdict on measured postures in one sentence."""
    subject = f"The postures of {robot} show"
    if diagnosis.verdict == "nothing":
        if diagnosis.calibration.level == "frames":
            return f"{subject} no error of its kinematics beyond the tolerance."
        doubt = f"surely beyond the tolerance ({p_value(diagnosis.p_value)})"
        return f"{subject} no error of its kinematics that is {doubt}; `calibrate` corrects what there is."
    if diagnosis.verdict == "unknown":
        return f"{subject} an error that no effect in the catalogue explains."
    rest = "; part of the error remains unexplained" if diagnosis.verdict == "named+rest" else ""
    return f"{subject} {_list(diagnosis.causes)}{rest}."


def distances(calibration: Calibration) -> str:
    """How far off the distances of sockets are: in recordings held out, or in all where none is; else nothing."""
    known = [d for d in calibration.distances if d.role == "holdout"] or list(calibration.distances)
    if not known:
        return ""
    which = "held-out " if known[0].role == "holdout" else "fitted "
    before = sum(abs(d.before - d.stated) for d in known) * 1e3 / len(known)
    after = sum(abs(d.after - d.stated) for d in known) * 1e3 / len(known)
    return (
        f"Mean error of the {which}socket distances: {number(before, 3)} mm before,"
        f" {number(after, 3)} mm after calibration."
    )


def fitted(text: str) -> str:
    """The text with no line longer than the terminal, what is too long continued indented; untouched in a pipe or file.

    A program's own output (`sys.__stdout__`) is looked at, for the text may be collected before it is written.
    """
    real = sys.__stdout__
    if real is None or real.closed or not real.isatty():
        return text
    width = max(shutil.get_terminal_size().columns, 20)
    lines = []
    for line in text.splitlines():
        inner = " " * (len(line) - len(line.lstrip()) + 4)
        whole = (
            textwrap.wrap(line, width, subsequent_indent=inner, drop_whitespace=True) if len(line) > width else [line]
        )
        lines += whole
    return "\n".join(lines) + ("\n" if text.endswith("\n") else "")


def level(name: str) -> str:
    """A level of calibration in words."""
    words = {"joint_offset": "joint offsets", "full": "full geometry", "chosen": "as selected within each fold"}
    return words.get(name, name)


def aside(name: Name, alternatives: Sequence[Name]) -> str:
    """What could not be told from the cause `name`, in words; empty where it stands alone."""
    if not alternatives:
        return ""
    here = [effect_title(other.effect) if other.at == name.at else phrase(other) for other in alternatives]
    return _join(here, "or")


def phrase(name: Name) -> str:
    """Effect and place in words: "Stribeck friction at joint_3"."""
    return f"{effect_title(name.effect)} at {place(name.at)}" if name.at else effect_title(name.effect)


def place(at: Sequence[str]) -> str:
    """Where an effect acts: "joint_5 + joint_6", or "the whole robot"."""
    return " + ".join(at) if at else "the whole robot"


def effect_title(effect: str) -> str:
    """The effect's name in plain words, from the catalogue; its own name with spaces where it is not in there."""
    known = _entry(effect) or ROLLOUT_EFFECTS.get(effect)
    return getattr(known, "title", "") or effect.replace("_", " ")


def effect_meaning(effect: str) -> str:
    """What the effect is, in one line: the first paragraph of its docstring in the catalogue."""
    entry = _entry(effect)
    if not isinstance(entry, type):
        return ROLLOUT_EFFECTS[effect].meaning if entry is None and effect in ROLLOUT_EFFECTS else ""
    text = inspect.cleandoc(entry.__doc__ or "").split("\n\n")[0].replace("\n", " ")
    generated = text.startswith(f"{entry.__name__}(")  # the signature that a dataclass writes
    return "" if generated else text


def effect_equation(effect: str) -> str:
    """The torque that the effect adds, as text; empty where the catalogue gives none."""
    return getattr(_entry(effect) or ROLLOUT_EFFECTS.get(effect), "equation", "")


def interval(estimate: Estimate) -> str:
    """Value with its 95 % interval and unit: "0.0113 ± 0.0004 kg m²"; without an interval where there is none.

    Where half of it would be below what the number can be, it is cut there: "0.42 (0 to 1.6) N m".
    What no row shows has no value, nor has an angle that may lie anywhere on the turn: where a spring rests, beside a
    free torque offset.
    """
    half = _NORMAL_95 * estimate.std
    if math.isinf(half) or (estimate.unit == "rad" and half > 2 * math.pi):
        return "not determined by this data"
    if not (math.isfinite(half) and half > 0.0):
        return _with_unit(number(estimate.value), estimate.unit)
    if isinstance(estimate, BoundedEstimate) and estimate.value - half < estimate.least:
        ends = f"{number(estimate.least)} to {number(estimate.value + half, 2)}"
        return _with_unit(f"{number(estimate.value, 2)} ({ends})", estimate.unit)
    power = math.floor(math.log10(half))
    decimals, large = max(0, 1 - power), max(abs(estimate.value), half)
    scale = math.floor(math.log10(large))
    if scale < -4 or large >= 1e6:
        decimals = max(0, 1 - power + scale)
        pair = _value_and_half(estimate.value / 10.0**scale, half / 10.0**scale, decimals)
        return _with_unit(f"({pair}) × 10{_superscript(scale)}", estimate.unit)
    return _with_unit(_value_and_half(estimate.value, half, decimals), estimate.unit)


def _value_and_half(value: float, half: float, decimals: int) -> str:
    """Both with as many decimals as the half width has two digits; six at most, which is more than anybody reads."""
    if decimals > 6:
        return _minus(f"{value:.6f} ± {half:.1g}")
    return _minus(f"{value:.{decimals}f} ± {half:.{decimals}f}")


def error(value: float, of: str, more: int = 0) -> str:
    """An error in words: a relative one in percent, a small angle or length in mrad or mm, any other with its unit.

    `more`: how many digits beyond those that a reader needs of one error alone.
    """
    if not math.isfinite(value):
        return "unknown"
    if of in ("rad", "m") and abs(value) < 0.1:
        return f"{number(1e3 * value, 3 + more)} m{of}"
    if not of.startswith("relative"):
        return _with_unit(number(value, 4 + more), of)
    percent = 100.0 * value
    return f"{percent:.{1 + more}f} %" if abs(percent) >= 1.0 else f"{number(percent, 2 + more)} %"


def fall(before: float, after: float, of: str) -> tuple[str, str]:
    """Two errors in words, with as many digits as show that they differ, two more at the most."""
    told = [(error(before, of, more), error(after, of, more)) for more in range(3)]
    return next((pair for pair in told if pair[0] != pair[1]), told[0])


def number(value: float, digits: int = 4) -> str:
    """A number with `digits` significant digits, never more than a reader needs."""
    if not math.isfinite(value):
        return "–" if math.isnan(value) else _minus(f"{value:.0f}".replace("inf", "∞"))
    text = f"{value:.{digits}g}"
    return _minus(f"{float(text):.0f}" if "e+" in text and abs(value) < 1e6 else text)  # 100, not 1e+02


def p_value(value: float) -> str:
    """A p-value as it deserves to be read: below 0.01 its digits mean nothing."""
    if not math.isfinite(value):
        return "p unknown"
    return "p < 0.01" if value < 0.01 else f"p = {value:.2f}"


def unit(text: str) -> str:
    """A unit as it is printed: "kg m²" for "kg m2"."""
    return text.replace("m2", "m²").replace("s2", "s²").replace("m3", "m³")


def _fall(diagnosis: Diagnosis) -> str:
    gain = diagnosis.holdout
    before, after = fall(gain.before, gain.after, gain.unit)
    return f"its error on held-out data falls from {before} to {after}"


def _list(causes: Sequence[Cause]) -> str:
    if len(causes) == 2 and causes[0].name == causes[1].name:
        return f"{phrase(causes[0].name)} (twice)"
    shown = [_counted(cause) for cause in causes[: 2 if len(causes) == 2 else 1]]
    more = len(causes) - len(shown)
    if more:
        shown.append(f"{more} more {'effect' if more == 1 else 'effects'}")
    return _join(shown, "and")


def _counted(cause: Cause) -> str:
    others = len(cause.ambiguous_with)
    if others == 1:
        return f"{phrase(cause.name)} (or {aside(cause.name, cause.ambiguous_with)})"
    return phrase(cause.name) + (
        f" (or one of {others} effects that this data cannot distinguish from it)" if others else ""
    )


def _join(words: Sequence[str], last: str) -> str:
    return f" {last} ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def _with_unit(text: str, of: str) -> str:
    return text if of in ("", "1") else f"{text} {unit(of)}"  # a pure number has none


def _minus(text: str) -> str:
    return text.replace("-", "−")


def _superscript(power: int) -> str:
    return "".join("⁰¹²³⁴⁵⁶⁷⁸⁹"[int(digit)] if digit != "-" else "⁻" for digit in str(power))


def _entry(effect: str) -> Any:
    if effect in CATALOGUE:
        return CATALOGUE[effect]
    from ..effects.kinematic import CATALOGUE as OF_POSTURES  # slow to import

    return OF_POSTURES.get(effect)
