"""Size and seconds of the installation of each extra in an environment of its own, and of its first use on a CPU.

    python benchmarks/install.py [--extras NAME ...] [--folder DIR]

The library is installed from this checkout without extras into a new environment; then each extra into a copy of that,
by pip with what it keeps of earlier downloads (`pip cache purge` first for a bare machine). MB are what an extra adds
on disk, without compiled Python (`--no-compile`). The first use is a process of its own: it imports the library, makes
the smallest thing that needs the extra and calls it, with an empty store of compiled programs. CPU seconds stand beside
those of the wall, which count what else the machine does. `genesis` needs torch, for which pip takes the build for CUDA
unless a CPU build is installed before it or found by `PIP_FIND_LINKS`.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
BACKEND = """
import numpy as np, figaroh_jax as fj
robot = fj.backend("{name}", fj.load_urdf(fj.DEMO))
q = np.zeros((10, robot.nv))
assert np.isfinite(np.asarray(robot.inverse_dynamics(q, q, q + 1.0))).all()
"""
USD = """
import pathlib, tempfile, figaroh_jax as fj
has = 'prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsCollisionAPI", "PhysicsMassAPI"]'
bodies = [f'def Cube "{name}" ({has})\\n{{\\n float physics:mass = 2\\n}}\\n' for name in ("base", "arm")]
joint = 'def PhysicsRevoluteJoint "j"\\n{\\n rel physics:body0 = </base>\\n rel physics:body1 = </arm>\\n}\\n'
file = pathlib.Path(tempfile.mkdtemp(), "arm.usda")
file.write_text("#usda 1.0\\n" + "".join(bodies) + joint)
assert fj.load_usd(file, root="fixed").nv == 1
"""
MJCF = """
import pathlib, tempfile, figaroh_jax as fj
file = pathlib.Path(tempfile.mkdtemp(), "arm.xml")
body = '<body><joint name="j" axis="0 1 0"/><geom size="0.1" mass="1"/></body>'
file.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
assert fj.load_mjcf(file).nv == 1
"""
USES = {
    "": "import numpy as np, figaroh_jax as fj; r = fj.load_urdf(fj.DEMO); q = np.zeros((10, r.nv)); "
    "fj.inverse_dynamics(r, q, q, q)",
    "parquet": "import figaroh_jax, pyarrow.parquet",
    "hdf5": "import figaroh_jax, h5py",
    "ros": "import figaroh_jax, rosbags.highlevel",
    "mujoco": MJCF,
    "usd": USD,
    "sparse": "import figaroh_jax, sklearn.linear_model",
    "collision": "import figaroh_jax, coal",
    "view": "import figaroh_jax, viser",
    "pinocchio": BACKEND.format(name="pinocchio"),
    "mjx": BACKEND.format(name="mjx"),
    "newton": BACKEND.format(name="newton"),
    "genesis": BACKEND.format(name="genesis"),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--extras", nargs="+", choices=[name for name in USES if name], default=list(USES)[1:])
    parser.add_argument("--folder", type=Path, help="where the environments are made (default: a temporary folder)")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(dir=options.folder, prefix="install_"))
    try:
        base = folder / "base"
        subprocess.run([sys.executable, "-m", "venv", str(base)], check=True)
        print(f"{'extra':12}{'install s':>10}{'CPU s':>7}{'MB more':>9}{'first use s':>13}{'CPU s':>7}", flush=True)
        _line("(none)", _installed(base, ""), size := _megabytes(base), _used(base, "", folder))
        for name in options.extras:
            own = folder / name
            shutil.copytree(base, own, symlinks=True)
            _line(name, _installed(own, f"[{name}]"), _megabytes(own) - size, _used(own, name, folder))
            shutil.rmtree(own)
    finally:
        shutil.rmtree(folder)


def _line(name: str, installed: tuple[float, float], size: float, used: tuple[float, float]) -> None:
    (wall, cpu), (first, busy) = installed, used
    print(f"{name:12}{wall:10.0f}{cpu:7.0f}{size:9.0f}{first:13.1f}{busy:7.1f}", flush=True)


def _timed(command: list[str], **options: Any) -> tuple[subprocess.CompletedProcess[str], tuple[float, float]]:
    """A finished process, and its seconds: of the wall and of CPU."""
    start, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, capture_output=True, text=True, **options)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return done, (time.perf_counter() - start, busy)


def _installed(environment: Path, extra: str) -> tuple[float, float]:
    """Seconds of `pip install '.[extra]'`."""
    pip = [str(environment / "bin" / "python"), "-m", "pip", "install", "--no-compile", "--quiet", f"{ROOT}{extra}"]
    done, seconds = _timed(pip)
    if done.returncode:
        raise SystemExit(f"pip install '.{extra}' failed:\n{done.stderr[-2000:]}")
    return seconds


def _megabytes(environment: Path) -> float:
    files = (Path(at) / name for at, _, names in os.walk(environment) for name in names if not name.endswith(".pyc"))
    return sum(file.lstat().st_size for file in files) / 1e6


def _used(environment: Path, extra: str, folder: Path) -> tuple[float, float]:
    """Seconds of the first process that uses it."""
    home = folder / f"home_{extra}"
    home.mkdir()
    bare = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "JAX_COMPILATION_CACHE_DIR")}
    variables = bare | {"HOME": str(home), "XDG_CACHE_HOME": str(home), "JAX_PLATFORMS": "cpu"}
    done, seconds = _timed([str(environment / "bin" / "python"), "-c", USES[extra]], env=variables, cwd=home)
    if done.returncode:
        print(f"{extra or '(none)'}: its first use failed:\n{done.stderr[-1500:]}", file=sys.stderr, flush=True)
        return float("nan"), float("nan")
    return seconds


if __name__ == "__main__":
    main()
