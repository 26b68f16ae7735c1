"""The report: one HTML page that holds all it needs, to be opened from a disk, on a phone, or printed.

The page is a template of `figaroh_jax/page`; plotly.js, which draws the plots, is its basic bundle (npm's
plotly.js-basic-dist-min 4.1.1), packed into the page.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..errors import InputError, check_kind, check_path
from ..results import Candidate, Diagnosis, Part, Trace
from . import wording
from .picture import robot_picture
from .provenance import read_provenance

__all__ = ["BADGES", "page_template", "plot_data", "plotly_source", "write_report"]

_POINTS = 1500  # of a trace at most: more cannot be told apart on a screen
_PAGE_POINTS = 45_000  # of all traces of a channel together, so that a humanoid's page stays light
_STEPS = 32767  # of a channel's range on each side of its middle; finer than any plot shows

BADGES = {
    "nothing": "nothing missing",
    "named": "cause named",
    "named+rest": "cause named, a rest stays",
    "unknown": "wrong, cause unknown",
}
_UNDECIDED = "nothing can be named"


class _Joint(NamedTuple):
    """One joint as the page shows it: RMS of the residual, and of the torque each cause adds (N m or N)."""

    name: str
    unit: str
    filed: float | None  # with the links of the model file, where these are told
    before: float
    after: float
    noise: float
    causes: list[str]
    shares: list[tuple[str, float]]
    open: bool

    @property
    def full(self) -> float:
        return max(_finite(self.before), _finite(self.after), _finite(self.noise))

    @property
    def widest(self) -> float:
        return max([self.full, *(_finite(rms) for _, rms in self.shares)])

    @property
    def floor(self) -> float:
        return _share(self.noise, self.full)


class _Goes(NamedTuple):
    """A share of a joint's rest and what it goes with, in words."""

    share: float
    words: str


class _Left(NamedTuple):
    """What no cause explains at a joint: RMS over that of its torque, and what it goes with."""

    name: str
    relative: float
    parts: list[_Goes]


def write_report(diagnosis: Diagnosis, path: str | Path, title: str) -> None:
    """Write the page of a diagnosis to `path`; `title` is the robot's name, as the verdict's sentence says it.

    >>> import pathlib, tempfile, figaroh_jax as fj
    >>> found = fj.diagnose_task(fj.load_task(fj.DEMO.replace("robot.urdf", "task.yaml")))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fj.write_report(found, pathlib.Path(folder, "report.html"), "bench arm")
    ...     "bench arm" in pathlib.Path(folder, "report.html").read_text()
    True
    """
    check_kind("diagnosis", diagnosis, Diagnosis, "write_report(diagnosis, path, title)")
    check_path("path", path)
    path = Path(path)
    path.write_text(_page(diagnosis, title, path.parent), encoding="utf-8")


def _page(diagnosis: Diagnosis, title: str, folder: Path | None = None) -> str:
    from markupsafe import Markup

    page = resources.files("figaroh_jax") / "page"
    roles = [trace.role for trace in diagnosis.traces]
    gain = diagnosis.holdout
    quantity = "position" if diagnosis.of_positions else "torque"
    return page_template("report.html", folder).render(
        d=diagnosis,
        robot=title,
        picture=Markup(_picture(diagnosis)),
        anatomy=_anatomy(diagnosis),
        badge=_UNDECIDED if diagnosis.rest.undecided else BADGES[diagnosis.verdict],
        undecided=_glued(wording.undecided(diagnosis)),
        links=[*map(_glued, wording.links(diagnosis))],
        unexplained=_glued(wording.unexplained(diagnosis)) if diagnosis.verdict in ("named+rest", "unknown") else "",
        sentence=_glued(wording.sentence(diagnosis, title)),
        largest=max(
            _finite(x) for x in (gain.before, gain.after, diagnosis.links.gain.before if diagnosis.links else 0.0)
        ),
        joints=_joints(diagnosis),
        rests=_rests(diagnosis),
        largest_rest=max([_finite(float(x)) for x in diagnosis.rest.relative], default=0.0),
        recordings=diagnosis.traces,
        shown=roles.index("holdout") if "holdout" in roles else 0,
        doubted=[cause for cause in diagnosis.causes if cause.ambiguous_with],
        candidates=sorted(diagnosis.candidates, key=_rank),
        css=Markup((page / "report.css").read_text("utf-8")),
        js=Markup((page / "report.js").read_text("utf-8")),
        quantity=quantity,
        data=Markup(plot_data(diagnosis.noise, diagnosis.torque_units, diagnosis.traces, quantity)),
        plotly=Markup(plotly_source()),
    )


_KINDS = ("position", "velocity", "load", "standstill", "frequency", "time", "recording")


def _picture(diagnosis: Diagnosis) -> str:
    """The robot with the joints that the causes name, or those where most is left, in colour."""
    if diagnosis.model is None:
        return ""
    affected = {name for cause in diagnosis.causes for name in cause.name.at}
    return robot_picture(diagnosis.model.robot, affected=affected or _opened(diagnosis))


def _anatomy(diagnosis: Diagnosis) -> list[tuple[str, list[tuple[float, str]]]]:
    """What is left at each joint by what it goes with: the kinds found as columns, shares as cells."""
    kinds = [kind for kind in _KINDS if any(part.kind == kind for part in diagnosis.rest.parts)]
    if not kinds:
        return []

    def cell(joint: str, kind: str) -> tuple[float, str]:
        parts: list[Part] = [p for p in diagnosis.rest.parts if p.kind == kind and p.at[:1] == (joint,)]
        return (max(p.share for p in parts), "; ".join(wording.dependence(p) for p in parts)) if parts else (0.0, "")

    head = ("", [(0.0, kind) for kind in kinds])
    return [head, *((joint, [cell(joint, kind) for kind in kinds]) for joint in diagnosis.joints)]


def page_template(name: str, folder: Path | None = None) -> Any:
    """The page `name` of `figaroh_jax/page` with the filters that put numbers and names into words.

    What made the run in `folder` stands at its foot.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    pages = PackageLoader("figaroh_jax", "page")
    environment = Environment(loader=pages, autoescape=True, undefined=StrictUndefined)
    environment.filters |= {
        "aside": wording.aside,
        "both": lambda gain: [*map(_glued, wording.fall(gain.before, gain.after, gain.unit))],
        "equation": wording.effect_equation,
        "error": lambda value, unit: _glued(wording.error(value, unit)),
        "fall": lambda gain: " → ".join(map(_glued, wording.fall(gain.before, gain.after, gain.unit))),
        "fixed": lambda value, decimals=0: f"{value:.{decimals}f}" if math.isfinite(value) else "–",
        "first_upper": lambda words: words[:1].upper() + words[1:],
        "interval": lambda estimate: _glued(wording.interval(estimate)),
        "meaning": wording.effect_meaning,
        "nearest_of": wording.nearest,
        "number": wording.number,
        "p_value": lambda value: _glued(wording.p_value(value)),
        "percent": lambda value: f"{value:.0f}" if 10 <= value < 1e4 else wording.number(value, 2),
        "phrase": wording.phrase,
        "place": wording.place,
        "share": _share,
        "spaced": lambda name: name.replace("_", " "),
        "title_of": wording.effect_title,
        "unit": wording.unit,
        "visible": lambda value: "never" if value == math.inf else wording.number(value, 2),
    }
    environment.globals["made"] = None if folder is None else _made_by(folder)
    return environment.get_template(name)


def _joints(diagnosis: Diagnosis) -> list[_Joint]:
    rows = [np.asarray(row, np.float64) for row in (diagnosis.before, diagnosis.after, diagnosis.noise)]
    shares = _shares(diagnosis)
    opened = _opened(diagnosis)
    joints = []
    for index, (name, unit) in enumerate(zip(diagnosis.joints, diagnosis.torque_units, strict=True)):
        before, after, noise = (float(row[index]) for row in rows)
        causes = [wording.effect_title(cause.name.effect) for cause in diagnosis.causes if name in cause.name.at]
        felt = [(label, float(rms[index])) for label, rms in shares.items() if rms[index] > 1e-3 * max(before, 1e-12)]
        filed = None if diagnosis.links is None else float(diagnosis.links.filed[index])
        joints.append(_Joint(name, unit, filed, before, after, noise, causes, felt, name in opened))
    return joints


def _rests(diagnosis: Diagnosis) -> list[_Left]:
    """What no cause explains, joint by joint."""
    goes: dict[str, list[_Goes]] = {name: [] for name in diagnosis.joints}
    for part in diagnosis.rest.parts:
        goes[part.at[0]].append(_Goes(part.share, wording.dependence(part)))
    sizes = zip(diagnosis.joints, diagnosis.rest.relative, strict=False)
    return [_Left(name, float(size), goes[name]) for name, size in sizes]


def _opened(diagnosis: Diagnosis) -> set[str]:
    """The joints whose plots stand open at first: where the first causes act, else the one with most to explain."""
    named = {joint for cause in diagnosis.causes[:3] for joint in cause.name.at}
    if named & set(diagnosis.joints):
        return named
    misfit, noise = np.nan_to_num(diagnosis.before), np.maximum(np.nan_to_num(diagnosis.noise), 1e-12)
    return {diagnosis.joints[int(np.argmax(misfit / noise))]}


def _shares(diagnosis: Diagnosis) -> dict[str, Float[np.ndarray, " nv"]]:
    """RMS over all recordings of the torque that each cause adds, by the cause in words."""
    words = {str(cause.name): wording.phrase(cause.name) for cause in diagnosis.causes}
    samples: dict[str, list[np.ndarray]] = {}
    for trace in diagnosis.traces:
        for name, torque in trace.shares.items():
            samples.setdefault(words.get(name, name), []).append(np.asarray(torque, np.float64))
    return {
        name: np.sqrt(np.mean(np.nan_to_num(np.concatenate(parts)) ** 2, axis=0)) for name, parts in samples.items()
    }


def _rank(candidate: Candidate) -> float:
    return -candidate.score if math.isfinite(candidate.score) else math.inf


def plot_data(
    floor: Float[np.ndarray, " nv"],
    units: Sequence[str],
    traces: Sequence[Trace],
    quantity: str = "torque",
    *,
    alone: bool = False,
) -> str:
    """What the plots are drawn from, as JSON that may stand inside a script element; `quantity` is compared.

    `alone`: one model is shown, in place of one before and one after.
    """
    count = len(units) * max(len(traces), 1)
    points = min(_POINTS, max(60, _PAGE_POINTS // count))
    joints = [
        {"noise": _finite(float(noise)), "unit": unit, "angle": "m" if unit in ("N", "m") else "rad"}
        for noise, unit in zip(floor, units, strict=True)
    ]
    recordings = [_series(trace, points, alone) for trace in traces]
    content = {"quantity": quantity, "joints": joints, "recordings": recordings}
    text = json.dumps(content, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c")


def _series(trace: Trace, points: int, alone: bool) -> list[dict[str, Any]]:
    """The channels of one recording, joint by joint, thinned to `points` samples."""
    wide = {key: getattr(trace, key) for key in ("position", "velocity", "before", "after", "measured")}
    misfit, seen = trace.after, np.zeros(np.shape(trace.after)[1], bool)
    if trace.measured is not None:
        seen = np.asarray(np.isfinite(np.asarray(trace.measured, np.float64)).any(axis=0))
        misfit = np.where(seen, trace.measured - trace.before, trace.after)
    kept = _thinned(np.asarray(misfit, np.float64), points)
    return [
        {"time": _packed(np.asarray(trace.time)[rows])}
        | {
            key: _packed(np.asarray(value)[rows, joint])
            for key, value in wide.items()
            if (seen[joint] or key != "measured") and not (alone and key == "before")
        }
        for joint, rows in enumerate(kept.T)
    ]


def _thinned(signal: Float[np.ndarray, "samples nv"], points: int) -> Int[np.ndarray, "kept nv"]:
    """Rows to keep of each column: the least and the greatest of every stretch, so that no peak gets lost."""
    samples, columns = signal.shape
    if samples <= points:
        return np.tile(np.arange(samples)[:, None], (1, columns))
    length = math.ceil(2 * samples / points)
    stretches = samples // length  # what is left over at the end is shorter than a pixel
    blocks = np.nan_to_num(signal[: stretches * length]).reshape(stretches, length, columns)
    extremes = np.stack([blocks.argmin(axis=1), blocks.argmax(axis=1)], axis=1)
    rows = extremes + length * np.arange(stretches)[:, None, None]
    return np.sort(rows.reshape(2 * stretches, columns), axis=0)


def _packed(values: Float[np.ndarray, " samples"]) -> dict[str, Any]:
    """A channel as scale, offset and 16-bit steps in base64; the lowest step stands for a value that is missing."""
    valid = np.isfinite(values)
    low, high = (float(values[valid].min()), float(values[valid].max())) if valid.any() else (0.0, 0.0)
    middle, scale = (low + high) / 2, (high - low) / (2 * _STEPS) or 1.0
    steps = np.where(valid, np.rint((np.where(valid, values, middle) - middle) / scale), -_STEPS - 1).astype("<i2")
    return {"o": middle, "s": scale, "d": base64.b64encode(steps.tobytes()).decode("ascii")}


def plotly_source() -> str:
    """plotly.js, deflated and in base64: a tenth of the whole library, and the page unpacks it when it draws."""
    packed = (resources.files("figaroh_jax") / "page" / "plotly-basic.min.js.gz").read_bytes()
    return base64.b64encode(packed).decode("ascii")


def _made_by(folder: Path) -> dict[str, Any] | None:
    """What made the run in `folder`, for the foot of its page; None where that is not said."""
    try:
        return read_provenance(folder)
    except InputError:
        return None


def _glued(text: str) -> str:
    """The text with numbers and their percent sign, and both sides of ± and =, kept on one line."""
    for mark in (" %", " ±", "± ", "p = ", "p < "):
        text = text.replace(mark, mark.replace(" ", "\N{NO-BREAK SPACE}"))
    return text


def _share(value: float, full: float) -> float:
    """Percentage of `full`, for the length of a bar."""
    return round(100.0 * _finite(value) / full, 2) if full else 0.0


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0
