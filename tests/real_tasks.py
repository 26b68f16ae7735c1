"""Tasks on recordings of real robots, as `figaroh-jax identify` takes them; they need the data folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import tx40

JOINTS = {"tx40": [f"joint_{k}" for k in range(1, 7)], "panda": [f"panda_joint{k}" for k in range(1, 8)]}
GATE = (0.05009095, 0.05009095, 0.07504916, 0.0715585, 0.05585054, 0.12217305)  # rad/s, of the published processing
TIAGO_GAIN = (13.6, 13.6, -8.7, -8.7)  # N m a unit of effort, arm_1 to arm_4
UR_GAIN = (10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232)  # N m/A
FRICTION = {"rotor": True, "offset": True}


def write(folder: Path, name: str, task: dict[str, Any]) -> Path:
    file = folder / f"{name}.yaml"
    file.write_text(json.dumps(task), encoding="utf-8")  # JSON is YAML, without its aliases
    return file


def tx40_task(folder: Path, data: Path, *, gated: bool = True) -> Path:
    """The corrected pipeline: rows at 50 Hz, gated by speed or not, with the wrist's coupling."""
    coupling = {"effect": "coupled_transmission", "at": JOINTS["tx40"][4:]}
    preprocess = {"cutoff": 20, "rate": 50} | ({"gate": dict(zip(JOINTS["tx40"], GATE, strict=True))} if gated else {})
    return tx40.write_task(folder, data, preprocess=preprocess, baseline=FRICTION | {"effects": [coupling]})


def tiago_task(folder: Path, data: Path) -> Path:
    """arm_1 to arm_4; the first 60 % fitted, the rest held out."""
    with np.load(data / "tiago_dynamic" / "tiago_dynamic.npz") as file:
        t, q, effort = (file[key][921:6791] for key in ("t", "q", "effort"))
    cut = int(0.6 * len(t))
    for part, rows in (("first", slice(0, cut)), ("last", slice(cut, None))):
        np.savez(folder / f"{part}.npz", t=t[rows], q=q[rows, 1:5], tau=effort[rows, 1:5] * TIAGO_GAIN)
    entry = {"time": "t", "position": "q", "torque": "tau"}
    return write(
        folder,
        "tiago",
        {
            "robot": {
                "model": str(data / "tiago_dynamic" / "tiago_no_hand.urdf"),
                "joints": [f"arm_{k}_joint" for k in range(1, 5)],
            },
            "data": [{"file": "first.npz", **entry}, {"file": "last.npz", **entry, "role": "holdout"}],
            "preprocess": {"cutoff": 4, "rate": 10},
            "baseline": FRICTION,
        },
    )


def panda_task(folder: Path, data: Path) -> Path:
    """The first 70 % fitted, the rest held out."""
    with np.load(data / "panda_gaz2019" / "panda_exciting_traj1.npz") as file:
        t, q, tau = (file[key] for key in ("t", "q", "tau"))
    cut = int(0.7 * len(t))
    for part, rows in (("first", slice(0, cut)), ("last", slice(cut, None))):
        np.savez(folder / f"{part}.npz", t=t[rows], q=q[rows], tau=tau[rows])
    entry = {"time": "t", "position": "q", "torque": "tau"}
    return write(
        folder,
        "panda",
        {
            "robot": {"model": str(data / "panda_gaz2019" / "panda.urdf"), "joints": JOINTS["panda"]},
            "data": [{"file": "first.npz", **entry}, {"file": "last.npz", **entry, "role": "holdout"}],
            "preprocess": {"cutoff": 5},
            "baseline": {"offset": True},  # torque is sensed behind the gears: no rotor in it
        },
    )


def ur10e_task(folder: Path, data: Path, every: bool = False) -> Path:
    """Four runs fitted, or every one of 16, and two held out; currents through the published gains."""
    runs = data / "ur10e_innopolis" / "id"
    names = sorted(path.name for path in runs.glob("*.npz"))
    fitted = [n for n in names if any(part in n for part in (("",) if every else FITTED))]
    held = [n for n in names if any(part in n for part in HELD)]
    entry = {"time": "t", "position": "q", "torque": "i", "units": {"torque": "A"}}
    files = {n: str(runs / n) for n in names}
    with np.load(runs / CORRUPT) as arrays:  # its first rows are wild
        files[CORRUPT] = str(folder / CORRUPT)
        np.savez(folder / CORRUPT, **{key: arrays[key][12:] for key in ("t", "q", "i")})  # pyright: ignore[reportArgumentType]
    data_list = [{"file": files[n], **entry} for n in fitted if n not in held]
    data_list += [{"file": files[n], **entry, "role": "holdout"} for n in held]
    return write(
        folder,
        "ur10e",
        {
            "robot": {"model": str(data / "ur10e_innopolis" / "ur10e.urdf")},
            "data": data_list,
            "transmission": {"torque": np.diag(UR_GAIN).tolist()},
            "preprocess": {"cutoff": 5},
            "baseline": FRICTION,
        },
    )


CORRUPT = "19_09_27_11_32_02.npz"
FITTED = ("20_02_06_20sec_10harm", "20_02_10_30sec", "20_02_12_40sec", "20_02_12_50sec")
HELD = ("20_02_10_20sec_7harm", "20_02_05_20sec_8harm")
