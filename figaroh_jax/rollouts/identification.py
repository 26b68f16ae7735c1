"""Identification of a loop from commands and positions: the baseline's numbers, their intervals, what trades off."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from ..effects.catalogue import ROLLOUTS
from ..effects.plausibility import implausible
from ..errors import InputError
from ..estimation.consistency import inconsistencies
from ..results import Trace
from .bodies import EFFECT, consistent, fitted_links, told_alone
from .creep import fitted_with_both
from .data import Run, as_recorded
from .fit import Fit, System, contradicted_errors, fit
from .loop import Loop
from .own import is_own
from .parameters import BOUNDS, OF_DRIVES, TEN, TILT, put, unit_of
from .setting import Setting, Structure, begun, by_readings, coloured, level_of, residuals
from .task import (
    all_slide,
    colour_notes,
    diagnosis_setting,
    diverged,
    extended_of,
    judged_rows,
    read_rollouts,
    simulated,
)

if TYPE_CHECKING:
    from ..effects.extended import ExtendedModel
    from ..formats.config import Task

__all__ = ["RolloutIdentification", "identify_rollout_task"]

_LOOSE = 0.5  # relative standard deviation beyond which a number is not identified
_FAR = 1e3  # rad or m: a simulation that gets there has diverged
_NOT_NOISE = 3.0  # times the noise of the encoder: what is left is the model's error
_TRADE = 0.95  # correlation beyond which two numbers trade off


class RolloutIdentification(NamedTuple):
    """The fitted loop and what `result.json` says of it."""

    result: dict[str, Any]
    loop: Loop
    model: ExtendedModel
    predictions: dict[str, tuple[np.ndarray, np.ndarray]]
    joints: tuple[str, ...]  # those that are measured
    units: tuple[str, ...]  # "rad", or "m" where the joint slides
    traces: tuple[Trace, ...]  # every recording simulated from its first state, as given and as fitted

    def to_json(self) -> str:
        """The text of `result.json`."""
        return json.dumps(self.result, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def identify_rollout_task(
    task: Task, progress: Callable[[str, float], None] = lambda phase, share: None
) -> RolloutIdentification:
    """Fit the baseline of a task of commands and positions: friction, armature, gains, delay and whatever it names.

    The baseline's `effects` may name any rollout effect at a joint. Every number has a standard deviation from the
    exact sensitivities, inflated by the residual's power or by how far parts of the data contradict each other, and a
    verdict: identified, unidentifiable, or on its bound.
    """
    progress("reading", 0.0)
    loop, runs, notes = read_rollouts(task)
    if task.actuator.gains == "free" and not any(one.effect == "actuator_gain" for one in task.baseline.effects):
        notes += (
            "actuator.gains: free lets `diagnose` look for gains that are off; `identify` fits those that the task"
            " names, as in baseline: {effects: [{effect: actuator_gain, at: [" + loop.robot.dof_names[0] + "]}]}",
        )
    here = diagnosis_setting(task, loop, runs)
    with jax.enable_x64(True):
        progress("fitting", 0.2)
        first = begun(here)
        if not np.isfinite(first.cost):
            raise InputError(f"{task.robot.model}: {diverged(here, first)}")
        here, first = told_alone(here, first)
        here, first, more = fitted_with_both(here, first)
        here, first = _by_readings(*_by_colour(here, first))
        first, links = consistent(here, first)
        final = put(here.loop, here.known.table, first.theta)
        rows = judged_rows(here)
        held = {run.name: (run, simulated(final, run, rows)) for run in runs if run.holdout}
        notes = (
            *notes,
            *links,
            *more,
            *colour_notes(here),
            *implausible(loop.robot, extended_of(final), task.robot.trust),
        )
        result = _result(here, first, held, notes)
        progress("simulating the recordings", 0.9)
        traces = _traces(loop, final, runs, rows)
        whole = {name: simulated(final, run) if rows else read for name, (run, read) in held.items()}
    predictions = {name: as_recorded(run, whole[name]) for name, (run, _) in held.items()}
    straight = {name for j in loop.robot.joints if j.kind == "prismatic" for name in (j.name,)}
    joints = tuple(loop.robot.dof_names[k] for k in loop.measured)
    units = tuple("m" if name in straight else "rad" for name in joints)
    return RolloutIdentification(result, final, extended_of(final), predictions, joints, units, traces)


def _by_readings(here: Setting, first: Fit) -> tuple[Setting, Fit]:
    """The fit once more where a counter that stands tells one reading."""
    again = by_readings(here, first)
    if again is None:
        return here, first
    structure = Structure(again.loop, again.known.table, again.data)
    one = fit(*structure, first.theta[None], [again.baseline], first.start[None], width=again.width, lanes=1)[0]
    return (again, one) if np.isfinite(one.cost) else (here, first)


def _by_colour(here: Setting, first: Fit) -> tuple[Setting, Fit]:
    """The fit once more with the colour of the noise, where noise is all that it leaves."""
    again = coloured(here, Structure(here.loop, here.known.table, here.data), first)
    if again is None:
        return here, first
    structure = Structure(again.loop, again.known.table, again.data)
    new = fit(*structure, first.theta[None], [again.baseline], first.start[None], width=again.width, lanes=1)[0]
    return (again, new) if np.isfinite(new.cost) else (here, first)


def _traces(given: Loop, fitted: Loop, runs: Sequence[Run], rows: int | None) -> tuple[Trace, ...]:
    """Every recording simulated by both, as a whole or in windows of `rows`; what diverges is no number."""
    traces = []
    for run in runs:
        found = [simulated(loop, run, rows)[:, : run.position.shape[1]] for loop in (given, fitted)]
        before, after = (np.where(np.abs(x) < _FAR, x, np.nan) for x in found)
        velocity = np.gradient(run.position, run.time, axis=0) if run.velocity is None else run.velocity
        role = "holdout" if run.holdout else "fit"
        traces.append(Trace(run.name, role, run.time, run.position, velocity, run.position, before, after))
    return tuple(traces)


def _result(
    here: Setting, first: Fit, held: dict[str, tuple[Run, np.ndarray]], notes: tuple[str, ...]
) -> dict[str, Any]:
    structure = Structure(here.loop, here.known.table, here.data)
    weight = np.asarray(here.data.weight)[:, : len(here.noise[0])]
    error = residuals(structure, first)[:, : len(here.noise[0])] / np.where(weight > 0, weight, 1.0)
    rms = np.sqrt((error**2).sum((0, 2)) / np.maximum((weight > 0).sum((0, 2)), 1))
    level = max(1.0, level_of(first, here.data))
    covariance = System(first.sums, here.data, first.start).covariance(first.free < 0)
    size = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    free = [k for k in range(len(first.free)) if first.free[k] >= 0]
    told = [k for k in free if np.isfinite(size[k])]
    correlation = covariance[np.ix_(told, told)] / np.outer(size[told], size[told]) if told else np.zeros((0, 0))
    singular = np.linalg.svd(correlation, compute_uv=False) if told else np.array([1.0])
    names = [_expression(here, int(first.free[k])) for k in range(len(first.free)) if first.free[k] >= 0]
    errors = contradicted_errors(first, here.data, level)
    parameters = [_parameter(here, first, k, float(errors[k])) for k in free]
    return {
        "rank": sum(p["status"] == "identified" for p in parameters),
        "condition": float(np.sqrt(singular[0] / max(singular[-1], 1e-300))),
        "base_parameters": parameters,
        "links": _links(here, first),
        "effects": [],
        "fit": {
            "rms": rms.tolist(),
            "relative": _shares(here, rms, np.concatenate([run.position for run in here.runs])),
            "noise": here.spread.tolist(),
        },
        "holdout": {name: _held(here, run, read) for name, (run, read) in held.items()},
        "notes": [*notes, *_left(here, rms, first), *_trades([names[free.index(k)] for k in told], correlation)],
        "unit": "m" if all_slide(here.loop) else "rad",
    }


def _links(here: Setting, first: Fit) -> list[dict[str, Any]]:
    """The ten parameters of the links that were fitted, in the frame of their joints (kg, kg m, kg m2)."""
    robot = put(here.loop, here.known.table, first.theta).robot
    ten, names = np.asarray(robot.inertia), robot.link_names
    return [
        {"name": names[i], "parameters": ten[i].tolist(), "consistent": not inconsistencies(ten[[i]], [names[i]])}
        for i in (link.at for link in fitted_links(here))
    ]


def _expression(here: Setting, entry: int) -> str:
    one = here.known.table[entry]
    names, place = here.loop.robot.dof_names, one.at[0]
    if one.name in TILT:
        return one.name
    if one.name.startswith("pair_") and here.loop.pairs is not None:
        return f"{one.name} {', '.join(names[k] for k in here.loop.pairs.at[place][:2])}"
    if is_own(one.name):
        return f"{one.name} {', '.join(names[k] for k in here.loop.effects[place].places)}"
    if one.name in OF_DRIVES:
        place = int(np.abs(np.asarray(here.loop.drives.transmission)[place]).argmax())
    if one.name in TEN:
        told = {number: name for name, number in ROLLOUTS[EFFECT].in_rollouts.numbers}
        return f"{told[one.name]} {here.loop.robot.link_names[place]}"
    return f"{one.name} {here.loop.robot.link_names[place] if one.name == 'payload' else names[place]}"


def _parameter(here: Setting, first: Fit, column: int, error: float) -> dict[str, Any]:
    entry = int(first.free[column])
    value, name = float(first.theta[entry]), here.known.table[entry].name
    low, high = BOUNDS[name]
    known = np.isfinite(error) and error < _LOOSE * max(abs(value), 1e-12)
    status = "identified" if known else "unidentifiable"
    if value <= low or value >= high:
        status = "on its bound"
    return {
        "expression": _expression(here, entry),
        "value": value,
        "std": error if np.isfinite(error) else None,
        "unit": unit_of(here.loop, here.known.table[entry]),
        "status": status,
    }


def _shares(here: Setting, error: np.ndarray, position: np.ndarray) -> list[float | None]:
    """Errors over the joints' motion; None of a joint that stands: there is no motion that a share could be of."""
    spread, moves = position.std(0), position.std(0) > _NOT_NOISE * here.spread
    return [float(e / s) if moving else None for e, s, moving in zip(error, spread, moves, strict=True)]


def _held(here: Setting, run: Run, read: np.ndarray) -> dict[str, list[Any]]:
    error = np.sqrt(((run.position - read) ** 2).mean(0))
    shares = _shares(here, error, run.position)
    return {"rms": error.tolist(), "relative": shares, "r2": [None if x is None else 1 - x**2 for x in shares]}


def _left(here: Setting, rms: np.ndarray, first: Fit) -> list[str]:
    """Where the fit leaves much more than the encoders' noise, and what that means for the numbers beside it."""
    share = rms / np.maximum(here.spread, 1e-12)
    worst = int(np.argmax(share))
    if share[worst] < _NOT_NOISE:
        return []
    at = here.loop.measured[worst]
    joint = here.loop.robot.dof_names[at]
    text = (
        f"the fit leaves {share[worst]:.0f} times the encoder's noise at {joint}: the loop lacks something, which"
        " `diagnose` looks for, and the intervals do not count it"
    )
    fitted = {here.known.table[int(k)].name for k in first.free if k >= 0}
    if np.asarray(here.loop.drives.transmission)[:, at].any() and "scale" not in fitted:
        gain = f"{{effect: actuator_gain, at: [{joint}]}}"
        text += (
            "; or the gain of a drive is off: gains are taken as the model has them, and friction, damping and rotors"
            f" follow one that is wrong. `baseline: {{effects: [{gain}]}}` fits it"
        )
    return [text]


def _trades(names: list[str], correlation: np.ndarray) -> list[str]:
    """Pairs that the data hardly tell apart, in words."""
    return [
        f"{names[i]} and {names[j]} trade off (correlation {correlation[i, j]:+.3f}): only a combination is identified"
        for i in range(len(names))
        for j in range(i)
        if abs(correlation[i, j]) > _TRADE
    ]
