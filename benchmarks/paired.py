"""CPU seconds and peak memory of `diagnose`, `identify` and `calibrate` by two versions, cold and warm, in turns.

    python benchmarks/paired.py before=/path/a now=/path/b [--rounds 3] [--only calibrate] [--task TASK.yaml]

`diagnose` and `identify` on the TX40, `calibrate` on TALOS ($FIGAROH_JAX_DATA); `--task` takes the place of these, for
the commands that `--only` names, or for `diagnose` (`parity.py make` writes those of the public sets). In each round
every version runs cold (no program kept) and warm, one after the other, the first one alternating. Both have byte code
of what they import, as an installed package has it, whatever PYTHONDONTWRITEBYTECODE says. Printed are medians, and
the ratio of the second version to the first as median of the rounds, with the smallest and the largest.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import parity  # beside this file

COMMANDS = ("diagnose", "identify", "calibrate")


def tasks(folder: Path) -> dict[str, Path]:
    """Task file of each command."""
    sys.path[:0] = [str(parity.ROOT), str(parity.ROOT / "tests")]
    import calibration
    import tx40

    file = tx40.write_task(folder, calibration.DATA)
    joints = ["torso_1_joint", "torso_2_joint", *(f"arm_left_{k}_joint" for k in range(1, 8))]
    talos = calibration.DATA / "talos_contact"
    measurement = {"position": ["x", "y", "z"], "base_frame": "base_link", "tool_frame": "gripper_left_base_link"}
    lines = (talos / "talos_left_arm_02_10_contact.csv").read_text().splitlines()
    header = [name.strip() for name in lines[0].split(",")]
    measurement["position"] = header[1:4]
    data = [{"file": str(talos / "talos_left_arm_02_10_contact.csv"), "position": header[4:13]}]
    task: dict[str, Any] = {"robot": {"model": str(talos / "talos_full_v2.urdf"), "joints": joints}}
    task["data"] = [one | {"measurement": measurement | {"unknown": ["base_frame", "tool_frame"]}} for one in data]
    (folder / "talos.yaml").write_text(json.dumps(task))
    return {"diagnose": file, "identify": file, "calibrate": folder / "talos.yaml"}


def measured(command: str, task: Path, source: Path, cache: Path) -> tuple[float, float]:
    """CPU seconds and peak MB of one process."""
    environment = os.environ | parity.ONE_THREAD | {"PYTHONPATH": parity.path_of(source), "JAX_PLATFORMS": "cpu"}
    environment |= {"XDG_CACHE_HOME": str(cache), "PYTHONPYCACHEPREFIX": str(cache.parent / "bytecode")}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    with tempfile.TemporaryDirectory() as out:
        words = [sys.executable, "-m", "figaroh_jax", command, str(task), "--out", f"{out}/run", "--quiet"]
        process = subprocess.Popen(words, env=environment, cwd=out, stdout=subprocess.DEVNULL)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            raise SystemExit(f"{command} by {source} ended with {process.returncode}")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sides", nargs=2, metavar="NAME=FOLDER")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--task", type=Path, help="a task in place of these")
    args = parser.parse_args()
    sides = [one.split("=", 1) for one in args.sides]
    with tempfile.TemporaryDirectory() as scratch:
        files = tasks(Path(scratch))
        for _, source in sides:
            words = [sys.executable, "-m", "compileall", "-q", str(Path(source).resolve() / "figaroh_jax")]
            subprocess.run(words, env=os.environ | {"PYTHONPYCACHEPREFIX": f"{scratch}/bytecode"}, check=True)
        if args.task:
            named = args.only if len(args.only) < len(COMMANDS) else ["diagnose"]
            task: Path = args.task.resolve()
            files |= dict.fromkeys(named, task)
        for command in args.only:
            found: dict[tuple[str, str], list[tuple[float, float]]] = {}
            for k in range(args.rounds):
                for name, source in sides if k % 2 == 0 else sides[::-1]:
                    cache = Path(scratch) / f"{command}{name}{k}"
                    for kind in ("cold", "warm"):
                        one = measured(command, files[command], Path(source).resolve(), cache)
                        found.setdefault((name, kind), []).append(one)
            for kind in ("cold", "warm"):
                _told(f"{command} {kind}", *(found[name, kind] for name, _ in sides))


def _told(title: str, first: list[tuple[float, float]], second: list[tuple[float, float]]) -> None:
    for k, unit in enumerate(("CPU s", "MB")):
        a, b = ([one[k] for one in each] for each in (first, second))
        ratios = [y / x for x, y in zip(a, b, strict=True)]
        middle = f"{statistics.median(a):8.1f} -> {statistics.median(b):8.1f} {unit}"
        print(
            f"{title:16}{middle}  ratio {statistics.median(ratios):.2f} [{min(ratios):.2f}, {max(ratios):.2f}]",
            flush=True,
        )


if __name__ == "__main__":
    main()
