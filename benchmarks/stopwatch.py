"""From files as they are to a named cause, as a new user goes: the seconds and the commands of eight formats.

`python benchmarks/stopwatch.py` makes robots with a hidden cause and writes their recordings in the formats that users
have, by the libraries that make them; then it runs `figaroh-jax new` and `figaroh-jax diagnose` on the command line,
edits no file, and checks the cause. `--wheel FILE` first installs that wheel with its extras into a fresh environment.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))

CONSTANTS = (11.5, 9.25, 8.75)  # N m a unit, from the data sheet
START = 1_700_000_000_000_000_000  # ns


def csv(file: Path, columns: dict[str, np.ndarray], mark: str = ",", form: str = "%.12g") -> Path:
    np.savetxt(file, np.column_stack(list(columns.values())), form, mark, header=mark.join(columns), comments="")
    return file


def degrees_ns(folder: Path, k: int, joints: tuple[str, ...], run: dict[str, Any]) -> Path:
    turns = np.array([joint != "slide" for joint in joints])
    shown = np.where(turns, np.rad2deg(run["position"]), run["position"])
    columns = {"timestamp": START + np.round(run["time"] * 1e9)}
    columns |= {f"{joint}_pos": shown[:, j] for j, joint in enumerate(joints)}
    columns |= {f"{joint}_torque": run["torque"][:, j] for j, joint in enumerate(joints)}
    return csv(folder / f"run{k}.csv", columns, form="%.17g")


def mcap(folder: Path, k: int, joints: tuple[str, ...], run: dict[str, Any]) -> Path:
    from test_recording_formats import bag

    whole = bag(folder / f"bag{k}", joints, run, "MCAP")
    return next(file for file in whole.iterdir() if file.suffix == ".mcap").rename(folder / f"run{k}.mcap")


def db3(folder: Path, k: int, joints: tuple[str, ...], run: dict[str, Any]) -> Path:
    from test_recording_formats import bag

    return bag(folder / f"bag{k}", joints, run, "SQLITE3")


def lerobot(folder: Path, k: int, joints: tuple[str, ...], run: dict[str, Any]) -> Path:
    """One folder of all recordings: an episode each, written anew with every one."""
    import pandas as pd

    data = folder / "dataset"
    (data / "meta").mkdir(parents=True, exist_ok=True)
    (data / "data" / "chunk-000").mkdir(parents=True, exist_ok=True)
    names = {"observation.state": "pos", "observation.effort": "effort"}
    features = {n: {"dtype": "float64", "names": [f"{joint}.{end}" for joint in joints]} for n, end in names.items()}
    (data / "meta" / "info.json").write_text(json.dumps({"codebase_version": "v2.1", "features": features}))
    frame = pd.DataFrame({"timestamp": run["time"] - run["time"][0], "episode_index": k})
    frame["observation.state"], frame["observation.effort"] = list(run["position"]), list(run["torque"])
    frame.to_parquet(data / "data" / "chunk-000" / f"episode_{k:06d}.parquet")
    return data


def hdf5(folder: Path, k: int, joints: tuple[str, ...], run: dict[str, Any]) -> Path:
    import h5py

    with h5py.File(folder / f"run{k}.h5", "w") as file:
        for name, key in (("time", "time"), ("joint_positions", "position"), ("joint_torques", "torque")):
            file[f"log/{name}"] = run[key]
    return folder / f"run{k}.h5"


def rtde(folder: Path, k: int, joints: tuple[str, ...], run: dict[str, Any]) -> Path:
    columns = {"timestamp": run["time"] + 4e3}
    columns |= {f"actual_q_{j}": run["position"][:, j] for j in range(len(joints))}
    columns |= {f"actual_current_{j}": run["torque"][:, j] / CONSTANTS[j] for j in range(len(joints))}
    return csv(folder / f"robot_data{k}.csv", columns, " ")


def current(folder: Path, k: int, joints: tuple[str, ...], run: dict[str, Any]) -> Path:
    columns = {"t_ms": run["time"] * 1e3}
    columns |= {f"q_{joint}": run["position"][:, j] for j, joint in enumerate(joints)}
    columns |= {f"current_{joint}": run["torque"][:, j] / CONSTANTS[j] for j, joint in enumerate(joints)}
    return csv(folder / f"run{k}.tsv", {"time" if n == "t_ms" else n: x for n, x in columns.items()}, "\t")


def reordered(folder: Path, k: int, joints: tuple[str, ...], run: dict[str, Any]) -> Path:
    order = np.random.default_rng(5).permutation(2 * len(joints))
    columns = [(f"{joint}/position", run["position"][:, j]) for j, joint in enumerate(joints)]
    columns += [(f"{joint}/effort", run["torque"][:, j]) for j, joint in enumerate(joints)]
    return csv(folder / f"run{k}.csv", dict([columns[n] for n in order] + [("time", run["time"])]), ";")


FORMATS: dict[str, Callable[..., Path]] = {
    "CSV, degrees, ns": degrees_ns,
    "MCAP": mcap,
    "rosbag2 db3": db3,
    "LeRobot folder": lerobot,
    "HDF5": hdf5,
    "RTDE": rtde,
    "current in A": current,
    "columns in another order": reordered,
}
HIDDEN = ("stribeck_friction", "position_dependent_friction", "torque_ripple", "joint_spring")


def installed(wheel: Path, folder: Path) -> tuple[list[str], float]:
    """The command of a fresh environment with the wheel and its extras, and the seconds that installing took."""
    started = time.perf_counter()
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = str(folder / "bin" / "python")
    subprocess.run([python, "-m", "pip", "install", "-q", f"{wheel.resolve()}[parquet,hdf5,ros]"], check=True)
    return [python, "-m", "figaroh_jax"], time.perf_counter() - started


def tried(command: list[str], name: str, write: Callable[..., Path], seed: int, folder: Path) -> tuple[float, int, str]:
    """Seconds and commands from the files to the answer, and what it says."""
    from generators import make_case
    from generators.inverse import observable

    case = make_case([(HIDDEN[seed % len(HIDDEN)], 0.12)], robot="small", repeats=2, trajectories=2, seed=7000 + seed)
    (folder / "robot.urdf").write_text(case.urdf)
    files = list(dict.fromkeys(write(folder, k, case.joints, run) for k, run in enumerate(case.recordings)))
    known = ["--constants", ",".join(map(str, CONSTANTS))] if name in ("RTDE", "current in A") else []
    steps = [
        [*command, "new", "robot.urdf", *map(str, files), "--out", "task.yaml", *known],
        [*command, "diagnose", "task.yaml", "--out", "run", "--quiet"],
    ]
    started = time.perf_counter()
    environment = {
        key: value for key, value in os.environ.items() if command[0] == sys.executable or key != "PYTHONPATH"
    }
    for count, step in enumerate(steps, 1):
        done = subprocess.run(step, cwd=folder, capture_output=True, text=True, env=environment)
        if done.returncode:
            return time.perf_counter() - started, count, f"refused: {done.stderr.strip()[-200:]}"
    seconds = time.perf_counter() - started
    answer = json.loads((folder / "run" / "answer.json").read_text())
    named = [
        [(c["effect"], tuple(c["at"])), *((o["effect"], tuple(o["at"])) for o in c["ambiguous_with"])]
        for c in answer["causes"]
    ]
    right = set().union(*(observable(truth) for truth in case.truth))
    hidden = ", ".join(f"{t.effect} at {'+'.join(t.at)}" for t in case.truth)
    found = any(right & set(names) for names in named)
    told = "; ".join(f"{names[0][0]} at {'+'.join(names[0][1])}" for names in named)
    return seconds, len(steps), f"{'right' if found else 'NOT FOUND'}: hidden {hidden}; {answer['verdict']}: {told}"


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--wheel", type=Path, help="install this wheel into a fresh environment first")
    asked = parser.parse_args()
    command, extra = [sys.executable, "-m", "figaroh_jax"], 0.0
    good = 0
    with tempfile.TemporaryDirectory() as top:
        if asked.wheel:
            command, extra = installed(asked.wheel, Path(top) / "venv")
            print(f"pip install: {extra:.0f} s, load {os.getloadavg()[0]:.1f}", flush=True)
        for seed, (name, write) in enumerate(FORMATS.items()):
            folder = Path(top) / f"case{seed}"
            folder.mkdir()
            seconds, commands, said = tried(command, name, write, seed, folder)
            within = extra + seconds <= 300 and commands + 1 <= 3
            good += said.startswith("right") and within
            print(
                f"{name}: {seconds:.0f} s ({extra + seconds:.0f} s from pip install), {commands + 1} commands,"
                f" load {os.getloadavg()[0]:.1f}; {said}",
                flush=True,
            )
    print(f"{good} of {len(FORMATS)} within 300 s and 3 commands, no file edited")
    return int(good < 6)


if __name__ == "__main__":
    sys.exit(main())
