"""Agreement, speed, first call and memory of every installed backend on five robots.

    python benchmarks/backends.py [--robots NAME ...] [--backends NAME ...] [--samples N] [--rounds N] [--diagnose]

Agreement is the largest difference to Pinocchio on 50 random states, relative to the largest number of the answer, over
frames, mass matrix, inverse dynamics and regressor. Speed is samples a second of inverse dynamics and regressor, the
median of the rounds; the first call, with its compilation, is told apart. Each backend has a process of its own, whose
memory is the peak after each robot. Robots are found by FIGAROH_JAX_DATA. MuJoCo C uses all cores, the others what
their library is allowed to. `--diagnose`: the real TX40 diagnosed by each backend instead, its verdict, its causes and
how far numbers are from those of the native one.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import jax
import numpy as np

from figaroh_jax.errors import InputError
from figaroh_jax.formats.robotfile import read_robot
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.simulators import registry

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
ROBOTS = {
    "UR10e": ("ur10e_innopolis/ur10e.urdf", None),
    "Panda": ("panda_gaz2019/panda.urdf", None),
    "TALOS": ("talos_contact/talos_full_v2.urdf", None),
    "quadruped": ("", None),  # that of the tests
    "human": ("human_model/human.urdf", "free_flyer"),
}
FUNCTIONS = {"inverse_dynamics": "q v a", "joint_torque_regressor": "q v a"}
COMPARED = {"frame_placements": "q", "mass_matrix": "q"} | FUNCTIONS
STATES = 50


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS))
    parser.add_argument("--backends", nargs="+", default=list(registry.names()), metavar="NAME")
    parser.add_argument("--samples", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--diagnose", action="store_true")
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)  # one backend, in this process
    options = parser.parse_args()
    if options.here:
        jax.config.update("jax_enable_x64", True)
        for robot in options.robots:
            print(json.dumps(_cell(robot, options.backends[0], options.samples, options.rounds)), flush=True)
        return
    if options.diagnose:
        _diagnosed([name for name in options.backends if name != "native"])
        return
    heads = ("differs by", "first ID s", "ID /s", "first W s", "W /s", "MB")
    print(f"{'backend':11}{'robot':11}" + "".join(f"{head:>12}" for head in heads))
    more = ["--samples", str(options.samples), "--rounds", str(options.rounds), "--robots", *options.robots]
    for name in options.backends:
        command = [sys.executable, __file__, "--here", "--backends", name, *more]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, stderr=subprocess.DEVNULL) as made:
            for line in made.stdout or ():
                if line.startswith("{"):
                    _print(name, json.loads(line))


def _diagnosed(backends: list[str]) -> None:
    """The TX40 by each backend beside the native one: parameters in their own standard deviations."""
    from figaroh_jax.diagnosis.diagnosis import diagnose_task
    from figaroh_jax.formats.config import load_task

    sys.path.insert(0, str(ROOT / "tests"))
    from tx40 import write_task

    task = load_task(write_task(Path(tempfile.mkdtemp()), DATA))
    answers = {}
    for name in ("native", *backends):
        start = time.perf_counter()
        try:
            found = answers[name] = diagnose_task(task, backend=name)
        except InputError as error:
            print(f"{name}: {error}", flush=True)
            continue
        took = time.perf_counter() - start
        native, causes = answers["native"], [cause.name for cause in found.causes]
        same = (found.verdict, causes) == (native.verdict, [cause.name for cause in native.causes])
        print(f"{name}: {found.verdict}, {len(causes)} causes, the native ones: {same}, {took:.0f} s", end="")
        if same:
            pairs = [
                (mine, own.parameters[key])
                for one, own in zip(found.causes, native.causes, strict=True)
                for key, mine in one.parameters.items()
            ]
            value = max(abs(a.value - b.value) / max(abs(b.value), 1e-300) for a, b in pairs)
            sigmas = max(abs(a.value - b.value) / b.std for a, b in pairs if b.std > 0)
            inertia = np.abs(np.asarray(found.model.robot.inertia) - np.asarray(native.model.robot.inertia)).max()
            after = np.abs(np.asarray(found.after) / np.asarray(native.after) - 1).max()
            print(
                f"; parameters differ by {value:.1e} of themselves, {sigmas:.1e} standard deviations, inertias by"
                f" {inertia:.1e} kg m^2, errors by {after:.1e}",
                end="",
            )
        print(flush=True)


def model(robot: str) -> RobotModel:
    """A robot of the table."""
    path, root = ROBOTS[robot]
    if path:
        return read_robot(DATA / path, root=root)  # pyright: ignore[reportArgumentType]
    sys.path.insert(0, str(ROOT / "tests"))
    import robots

    file = Path(tempfile.mkdtemp()) / "quadruped.xml"
    file.write_text(robots.MJCF["quadruped"])
    return read_robot(file)


def _cell(robot: str, name: str, samples: int, rounds: int) -> dict[str, Any]:
    try:
        whole = model(robot)
        backend, reference = _built(name, whole), _built("pinocchio", whole)
    except (InputError, ImportError) as error:
        return {"robot": robot, "error": str(error)}
    state = _state(backend, samples)
    answer: dict[str, Any] = {"robot": robot, "differs": 0.0}
    for function, words in FUNCTIONS.items():
        given = [state[word] for word in words.split()]
        first = _seconds(backend, function, given)
        times = [_seconds(backend, function, given) for _ in range(rounds)]
        answer[function] = first, samples / median(times)
    state = {key: x[:STATES] for key, x in state.items()}
    for function, words in COMPARED.items():
        given = [state[word] for word in words.split()]
        got, want = (np.asarray(getattr(b, function)(*given), float) for b in (backend, reference))
        answer["differs"] = max(answer["differs"], float(np.abs(got - want).max() / np.abs(want).max()))
    return answer | {"MB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def _built(name: str, robot: RobotModel) -> Any:
    """The backend of a robot; one that is not installed from the folder `backends`."""
    if name in registry.names():
        return registry.backend(name, robot)
    sys.path.append(str(ROOT / "backends"))
    return getattr(importlib.import_module(f"figaroh_jax_{name}"), f"{name.capitalize()}Backend").build(robot)


def _state(backend: Any, samples: int) -> dict[str, np.ndarray]:
    q = np.asarray(backend.random_configuration(0, (samples,)))
    v, a = np.random.default_rng(1).uniform(-1.5, 1.5, (2, samples, backend.nv))
    return {"q": q, "v": v, "a": a}


def _seconds(backend: Any, function: str, state: list[np.ndarray]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(getattr(backend, function)(*state))
    return time.perf_counter() - start


def _print(name: str, cell: dict[str, Any]) -> None:
    if "error" in cell:
        print(f"{name:11}{cell['robot']:11} {cell['error']}", flush=True)
        return
    (first, rate), (first_w, rate_w) = (cell[function] for function in FUNCTIONS)
    line = f"{cell['differs']:12.1e}{first:12.2f}{rate:12.0f}{first_w:12.2f}{rate_w:12.0f}{cell['MB']:12.0f}"
    print(f"{name:11}{cell['robot']:11}{line}", flush=True)


if __name__ == "__main__":
    main()
