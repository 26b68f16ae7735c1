"""CPU seconds of the import and of `figaroh-jax diagnose`, cold (no compiled programs kept) and warm.

    python benchmarks/diagnose.py [--runs N] [--task TASK.yaml | --eighteen]

The task is the TX40 recording where it is there (FIGAROH_JAX_DATA, default ../shared/data), else the embedded demo.
`--eighteen` takes the UR10e's 18 recordings of `ur10e_innopolis`, 8.6 minutes in all.
Every run is a process of its own; its user and system seconds are counted, not the time it waited. Python keeps the
byte code of what it imports, as an installed package has it, whatever PYTHONDONTWRITEBYTECODE says here.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import statistics
import subprocess
import sys
import tempfile
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests")]
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))

USE = "import jax, figaroh_jax as fj; fj.RobotModel, fj.inverse_dynamics, fj.joint_torque_regressor, fj.register"


def main() -> None:
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3, help="runs of each kind; medians are printed (default 3)")
    parser.add_argument("--task", type=Path, help="a task file in place of the TX40's")
    many = "the UR10e's 18 recordings, 8.6 minutes, in place of the TX40's"
    parser.add_argument("--eighteen", action="store_true", help=many)
    options = parser.parse_args()
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("jax", "numpy", "scipy", "equinox"))
    print(f"{_processor()}, {os.cpu_count()} cores; Python {platform.python_version()}, {versions}; CPU seconds\n")
    print(f"{'':44}{'median':>8}{'min':>8}{'max':>8}   runs")
    _imports(2 * options.runs + 1)
    with tempfile.TemporaryDirectory() as folder:
        task = options.task
        if options.eighteen:
            from real_tasks import ur10e_task

            task = ur10e_task(Path(folder), DATA, every=True)
        _diagnose(Path(folder), task, options.runs)


def _imports(runs: int) -> None:
    lines = {"import jax": "import jax", "and import figaroh_jax": "import jax, figaroh_jax", "and its dynamics": USE}
    cpu_seconds([sys.executable, "-c", "import figaroh_jax.jobs.commands, figaroh_jax.jobs.diagnosis"])  # byte code
    rounds = [{name: cpu_seconds([sys.executable, "-c", line]) for name, line in lines.items()} for _ in range(runs)]
    _row("import jax", [r["import jax"] for r in rounds])
    for name in list(lines)[1:]:
        _row(f"  {name} adds", [r[name] - r["import jax"] for r in rounds])


def _diagnose(folder: Path, task: Path | None, runs: int) -> None:
    file = task or _tx40(folder)
    command = [sys.executable, "-m", "figaroh_jax", *(["diagnose", str(file)] if file else ["demo"])]
    command += ["--quiet", "--out", str(folder / "out")]
    cold, warm, memory = [], [], []
    for k in range(runs):
        environment = os.environ | {"XDG_CACHE_HOME": str(folder / f"cache{k}")}
        for seconds in (cold, warm):
            spent, peak = cost(command, environment)
            seconds.append(spent)
            memory.append(peak)
    name = f"diagnose {file.stem}" if file else "demo"
    _row(f"{name}, cold", cold)
    _row(f"{name}, warm", warm)
    _row("  MB", memory)
    answer = json.loads((folder / "out" / "answer.json").read_text(encoding="utf-8"))
    print(f"\nanswer: {answer['verdict']}")
    for cause in answer["causes"]:
        gain = cause["gain"]
        at = ", ".join(cause["at"])
        print(f"  {cause['effect']} ({at}): {gain['holdout_before']:.4f} -> {gain['holdout_after']:.4f} {gain['unit']}")


def _tx40(folder: Path) -> Path | None:
    if not (DATA / "staubli_tx40").is_dir():
        return None
    from tx40 import write_task

    return write_task(folder, DATA)


def cost(command: list[str], environment: dict[str, str] | None = None) -> tuple[float, float]:
    """User and system seconds of a process, and its peak memory (MB); raises where it failed."""
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def cpu_seconds(command: list[str]) -> float:
    """User and system seconds of a process and all that it started; raises `CalledProcessError` where it failed."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime


def _row(name: str, seconds: list[float]) -> None:
    median, low, high = statistics.median(seconds), min(seconds), max(seconds)
    print(f"{name:44}{median:8.2f}{low:8.2f}{high:8.2f}{len(seconds):7}", flush=True)


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.machine())


if __name__ == "__main__":
    main()
