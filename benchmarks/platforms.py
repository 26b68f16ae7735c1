"""Where the wheel can be installed: wheels of its dependencies by platform and Python, and the demo on Pythons here.

    python benchmarks/platforms.py WHEEL                        # pip resolves wheels alone, nothing is installed
    python benchmarks/platforms.py WHEEL --pythons python3.12   # a fresh environment of each, and the demo in it

Exit status 1 where something cannot be installed or the demo's causes are not found.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PLATFORMS = {
    "Linux x86_64": ["manylinux_2_28_x86_64", "manylinux_2_27_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64"],
    "Linux aarch64": [
        "manylinux_2_28_aarch64",
        "manylinux_2_27_aarch64",
        "manylinux_2_17_aarch64",
        "manylinux2014_aarch64",
    ],
    "macOS arm64": ["macosx_14_0_arm64", "macosx_12_0_arm64", "macosx_11_0_arm64"],
    "macOS x86_64": ["macosx_14_0_x86_64", "macosx_12_0_x86_64", "macosx_10_13_x86_64", "macosx_10_9_x86_64"],
    "Windows x86_64": ["win_amd64"],
}
VERSIONS = ("3.11", "3.12", "3.13")


def resolved(wheel: Path, platform: str, version: str) -> tuple[int, str]:
    """Number of packages that pip would install, or 0 and why not."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        tags = [word for tag in PLATFORMS[platform] for word in ("--platform", tag)]
        options = [
            "--dry-run",
            "--ignore-installed",
            "--only-binary=:all:",
            "--target",
            folder,
            "-q",
            "--report",
            report,
        ]
        command = [sys.executable, "-m", "pip", "install", *options, "--python-version", version, *tags, wheel]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
            return 0, lines[0] if lines else done.stderr[-200:]
        return len(json.loads(report.read_text())["install"]), ""


def demonstrated(wheel: Path, python: str) -> tuple[str, bool]:
    """What the demo says in a fresh environment of an interpreter."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run([python, "-m", "venv", folder], check=True)
        own = str(Path(folder) / "bin" / "python")
        started = time.perf_counter()
        subprocess.run([own, "-m", "pip", "install", "-q", str(wheel)], check=True, stderr=subprocess.DEVNULL)
        seconds = time.perf_counter() - started
        clean = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        command = [own, "-W", "error::DeprecationWarning:figaroh_jax", "-m", "figaroh_jax", "demo", "--json", "--quiet"]
        done = subprocess.run([*command, "--out", "run"], capture_output=True, text=True, env=clean, cwd=folder)
        versions = "import platform, jax, numpy; print(platform.python_version(), jax.__version__, numpy.__version__)"
        said = subprocess.run([own, "-c", versions], capture_output=True, text=True, env=clean).stdout.strip()
        if done.returncode:
            return f"{said}: status {done.returncode}: {done.stderr[-300:]}", False
        answer = json.loads(done.stdout)
        causes = [(cause["effect"], cause["at"]) for cause in answer["causes"]]
        right = ("stribeck_friction", ["shoulder"]) in causes and answer["verdict"] == "named"
        names = ", ".join(f"{effect} at {'+'.join(at)}" for effect, at in causes)
        return f"Python, JAX, NumPy {said}: pip {seconds:.0f} s; {answer['verdict']}: {names}", right


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--pythons", nargs="*", help="interpreters to install into, in place of resolving")
    asked = parser.parse_args()
    wheel, good = asked.wheel.resolve(), True
    for python in asked.pythons or ():
        said, right = demonstrated(wheel, python)
        good &= right
        print(f"{python}: {said}", flush=True)
    for platform in () if asked.pythons else PLATFORMS:
        for version in VERSIONS:
            count, why = resolved(wheel, platform, version)
            good &= count > 0
            print(f"{platform}, Python {version}: {f'{count} packages' if count else why}", flush=True)
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
