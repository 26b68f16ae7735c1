"""Writes the cases: untouched recordings once a robot, and for every effect and size the torque that it adds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .. import blackbox
from .baseline import fit, seen
from .laws import TWELVE, Draw, Law, scaled
from .motion import Scene, scene_of
from .oracle import Borne, Oracle
from .recordings import SETS, RealSet

MOVES = 0.15  # rad, least range of a joint that an effect is put on
STANDBY = ("torque_saturation", "friction_drift", "torque_offset")  # where one of the twelve finds no place


def generate(
    folder: Path,
    seed: int,
    robots: Sequence[str] | None = None,
    effects: Sequence[str] | None = None,
    sizes: Sequence[float] = (0.05, 0.1, 0.2),
) -> None:
    """Write `cases.json` and what it names into `folder`."""
    cases: list[dict[str, Any]] = []
    for name in robots or SETS:
        real = SETS[name]()
        own = _robot(folder, real, seed, effects, sizes)
        shown = sum(case.get("visible", False) for case in own)
        print(f"{name}: {len(own) - 1} cases, {shown} visible", flush=True)
        cases += own
    told = {"seed": seed, "commit": blackbox.commit(), "cases": cases}
    (folder / "cases.json").write_text(json.dumps(told, indent=1))


def _robot(
    folder: Path, real: RealSet, seed: int, effects: Sequence[str] | None, sizes: Sequence[float]
) -> list[dict[str, Any]]:
    """The twin and the cases of one robot."""
    twin = twin_of(folder, real)
    baseline, scenes = fit(real, [scene_of(real, r) for r in real.recordings])
    oracle = Oracle(baseline, scenes)
    cases = [twin]
    for effect in effects or _twelve(real, scenes, seed):
        for size in sizes:
            draw = Draw(scenes, _moving(scenes), np.random.default_rng([seed, blackbox.digest(real.name, effect)]))
            found = scaled(draw, effect, size)
            if found is None:
                print(f"{real.name}: no {effect} of {100 * size:g} % would be physical", flush=True)
                continue
            law, strength = found
            shown = seen(baseline, scenes, law, strength)
            name = f"{real.name}/{effect}-{100 * size:g}"
            added = [law.torque(s, strength) for s in scenes]
            _save(folder / f"{name}.npz", _added(real, added))
            cases.append(
                twin
                | {"name": name, "twin": twin["name"], "size": size, "added": f"{name}.npz"}
                | {"truth": [_truth(draw, law, strength)], "forbid": _forbidden(effect)}
                | {"left": shown.left, "sigmas": shown.sigmas, "visible": shown.visible}
                | {"oracle": told_by(oracle.borne_out(added, law.rows))}
            )
    return cases


def twin_of(folder: Path, real: RealSet) -> dict[str, Any]:
    """Write the untouched recordings and the robot; the case that holds them."""
    place = folder / real.name
    place.mkdir(parents=True, exist_ok=True)
    (place / "robot.urdf").write_text(real.urdf)
    for recording in real.recordings:
        _save(place / f"{recording.name}.npz", recording.arrays)
    model = f"{real.name}/robot.urdf"
    return {"name": f"{real.name}/twin", "group": real.name, "task": _task(real), "truth": [], "model": model}


def _save(path: Path, arrays: dict[str, Any]) -> None:
    np.savez_compressed(path, **arrays)


def _task(real: RealSet) -> dict[str, Any]:
    task = json.loads(json.dumps(real.task))
    task["robot"]["model"] = "robot.urdf"
    task["data"] = [{"file": f"{real.name}/{r.name}.npz"} | r.entry for r in real.recordings]
    return task


def _moving(scenes: Sequence[Scene]) -> list[int]:
    kept = np.concatenate([s.q[s.kept] for s in scenes if s.fitted])
    return [int(j) for j in np.flatnonzero(np.ptp(kept, axis=0) > MOVES)]


def _twelve(real: RealSet, scenes: Sequence[Scene], seed: int) -> list[str]:
    """The twelve effects that find a place on this robot at a tenth."""
    found = []
    for effect in (*TWELVE, *STANDBY):
        draw = Draw(scenes, _moving(scenes), np.random.default_rng([seed, blackbox.digest(real.name, effect)]))
        if scaled(draw, effect, 0.1) is not None:
            found.append(effect)
    return found[:12]


def told_by(borne: Borne) -> dict[str, Any]:
    """What the oracle says of a case, as it stands in `cases.json`."""
    return {"share": borne.share, "chance": borne.chance, "sure": borne.sure}


def with_oracle(folder: Path) -> None:
    """Ask the oracle of cases that were made without it."""
    told = json.loads((folder / "cases.json").read_text())
    for group in dict.fromkeys(case["group"] for case in told["cases"]):
        real = SETS[group]()
        baseline, scenes = fit(real, [scene_of(real, r) for r in real.recordings])
        oracle, back = Oracle(baseline, scenes), np.linalg.inv(real.stored(np.eye(len(real.joints))))
        for case in told["cases"]:
            if case["group"] == group and case["truth"]:
                with np.load(folder / case["added"]) as file:
                    added = [np.asarray(file[f"{r.name}/tau"], float) @ back for r in real.recordings]
                own = max(float(np.abs(x).max()) for x in added)
                joints = [j for j in range(len(real.joints)) if any(np.abs(x[:, j]).max() > 1e-6 * own for x in added)]
                case["oracle"] = told_by(oracle.borne_out(added, joints))
    (folder / "cases.json").write_text(json.dumps(told, indent=1))


def _added(real: RealSet, added: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """What the effect adds to the torque of each file, in the file's words."""
    pairs = zip(real.recordings, added, strict=True)
    return {f"{r.name}/tau": real.stored(torque).astype(np.float32) for r, torque in pairs}


def _truth(draw: Draw, law: Law, strength: float) -> dict[str, Any]:
    """The hidden effect in the words of the contract, and what its size is judged by."""
    truth: dict[str, Any] = {"effect": law.effect, "at": law.at, "also": law.also}
    truth["parameters"] = {k: float(v) for k, v in law.parameters(strength).items()}
    if len(law.rows) == 1:
        speeds = np.abs(draw.over(law.rows[0], "v"))
        truth["speeds"] = [float(x) for x in np.quantile(speeds, np.linspace(0.05, 0.95, 19))]
    if law.effect == "coupled_transmission":
        rms = {k: np.sqrt(np.mean([np.mean(draw.over(j, w) ** 2) for j in law.rows])) for k, w in _PAIR.items()}
        truth["scale"] = {k: float(v) for k, v in rms.items()}
    return truth


_PAIR = {"inertia": "a", "damping": "v"}


def _forbidden(effect: str) -> list[str]:
    names = {effect}.union(*(names for names in blackbox.EQUIVALENT if effect in names))
    return sorted(names)
