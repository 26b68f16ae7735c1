"""The answer for other programs: `answer.json` and `predictions.npz`, as the contract writes them."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..results import Cause, Diagnosis, Estimate, Gain, Links, Name, Rest, finite

__all__ = ["answer", "cause", "holdout", "links", "rest", "to_json", "write_predictions"]


def answer(diagnosis: Diagnosis) -> dict[str, Any]:
    """The diagnosis as the dictionary of `answer.json`; a number that is not finite becomes None (JSON null)."""
    return {
        "verdict": diagnosis.verdict,
        "causes": [cause(found) for found in diagnosis.causes],
        "p_value": finite(diagnosis.p_value),
        "residual": {
            "before": [finite(value) for value in diagnosis.before],
            "after": [finite(value) for value in diagnosis.after],
            "noise": [finite(value) for value in diagnosis.noise],
        },
        "rest": rest(diagnosis.rest),
        "holdout": holdout(diagnosis),
        **({} if diagnosis.links is None else {"links": links(diagnosis.links)}),
        "next_experiment": _experiment(diagnosis),
        "notes": list(diagnosis.notes),
    }


def holdout(diagnosis: Diagnosis) -> dict[str, Any]:
    """Error on data not fitted, before and after all causes, and of each joint on the recordings that were held out."""
    held = [trace for trace in diagnosis.traces if trace.role == "holdout" and trace.measured is not None]
    gain, joints = diagnosis.holdout, {}
    for j, name in enumerate(diagnosis.joints if held else ()):
        rows = [slice(None) if trace.counted is None else trace.counted[:, j] for trace in held]
        measured = np.concatenate([np.asarray(trace.measured)[at, j] for trace, at in zip(held, rows, strict=True)])
        after = np.concatenate([np.asarray(trace.after)[at, j] for trace, at in zip(held, rows, strict=True)])
        size = float(np.sqrt(np.mean(measured**2))) if len(measured) else 0.0
        joints[name] = finite(np.sqrt(np.mean((measured - after) ** 2)) / size) if size > 0 else None
    return {"before": finite(gain.before), "after": finite(gain.after), "unit": gain.unit, "joints": joints}


def to_json(diagnosis: Diagnosis) -> str:
    """The text of `answer.json`: strict JSON, in UTF-8 characters, with a newline at its end."""
    return json.dumps(answer(diagnosis), indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def write_predictions(
    path: Path,
    predictions: Mapping[str, tuple[Float[np.ndarray, "_"], Float[np.ndarray, "_ nv"]]],
    quantity: str = "torque",
) -> None:
    """Write `predictions.npz`: `<name>_time` (s) and `<name>_torque` (N m or N) for each held-out recording.

    `predictions` maps a recording's name (its file stem) to its own time stamps and the extended model's torque there;
    `quantity` is `position` (rad or m) where it comes from a rollout.
    Raises `ValueError` where the two do not belong together.
    """
    arrays: dict[str, np.ndarray] = {}
    for name, (time, torque) in predictions.items():
        stamps, values = np.asarray(time, np.float64), np.asarray(torque, np.float64)
        if stamps.ndim != 1 or values.ndim != 2 or len(stamps) != len(values):
            raise ValueError(
                f"predictions of '{name}': time has shape {stamps.shape} and torque {values.shape}; "
                "expected (samples,) and (samples, joints)"
            )
        arrays |= {f"{name}_time": stamps, f"{name}_{quantity}": values}
    with path.open("wb") as file:  # an open file, for savez would add a suffix to a name without one
        np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]


def cause(found: Cause) -> dict[str, Any]:
    """A cause as it stands in `answer.json`."""
    return {
        **_name(found.name),
        "parameters": {name: _estimate(estimate) for name, estimate in found.parameters.items()},
        "found": found.found,
        "confidence": finite(found.confidence),
        "gain": _gain(found.gain),
        "ambiguous_with": [_name(other) for other in found.ambiguous_with],
    }


def links(own: Links) -> dict[str, Any]:
    """How far the links of the model file are off, as it stands in `answer.json`."""
    return {
        "residual": [finite(value) for value in own.filed],
        "gain": _gain(own.gain),
        "sigmas": finite(own.far),
        "moved": [
            {
                **_name(one.name),
                "share": finite(one.share),
                "parameters": {name: _estimate(estimate) for name, estimate in one.numbers.items()},
                "instead": [_name(other) for other in one.instead],
                "note": one.note,
            }
            for one in own.moved
        ],
    }


def _gain(gain: Gain) -> dict[str, Any]:
    return {"holdout_before": finite(gain.before), "holdout_after": finite(gain.after), "unit": gain.unit}


def rest(left: Rest) -> dict[str, Any]:
    """What no cause explains, as it stands in `answer.json`."""
    parts = []
    for part in left.parts:
        where = {} if part.band is None else {"band": [finite(edge) for edge in part.band]}
        where |= {} if part.file is None else {"file": part.file}
        parts.append({"kind": part.kind, "at": list(part.at), "share": finite(part.share), **where})
    return {
        "relative": [finite(value) for value in left.relative],
        "parts": parts,
        "nearest": [{**_name(o.name), "share": finite(o.share), "why_not": o.why_not} for o in left.nearest],
    }


def _name(name: Name) -> dict[str, Any]:
    return {"effect": name.effect, "at": list(name.at)}


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return {"value": finite(estimate.value), "std": finite(estimate.std), "unit": estimate.unit}


def _experiment(diagnosis: Diagnosis) -> dict[str, Any] | None:
    experiment = diagnosis.experiment
    if experiment is None:
        return None
    return {"text": experiment.text, "separates": [list(pair) for pair in experiment.separates]}
