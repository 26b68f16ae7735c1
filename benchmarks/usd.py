"""Robots of the data folder and of the tests, through the converters of URDF and MJCF to USD and back in.

    python benchmarks/usd.py [--converters DIR] [--write DIR]

Each line is a robot: the largest difference of its placements (m, 1), axes, limits (relative above 1), inertias
(relative to the link's own largest parameter of that kind) and mimic ratios between the file and the stage made of it.
The converters, `urdf-usd-converter` and `mujoco-usd-converter`, bring an OpenUSD and a MuJoCo of their own, so they
are run as commands, from the folder DIR of another environment where they are not on the path. `--write` keeps the
stages of the tests' robots as text: `tests/stages` is made so.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from figaroh_jax.errors import InputError
from figaroh_jax.formats.robotfile import read_robot
from figaroh_jax.rigid.model import RobotModel

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
LEAVES = ("placement", "axis", "ratio", "offset", "position_limit", "velocity_limit", "effort_limit")
KINDS = (slice(0, 1), slice(1, 4), slice(4, 10))  # mass, first moments, moments


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--converters", type=Path, help="folder of the commands")
    parser.add_argument("--write", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        files = [*sorted(DATA.glob("*/*.urdf")), *sorted(DATA.glob("*/*.xml")), *_own(Path(folder))]
        print(f"{'robot':42}{'joints':>7}{'inertia':>10}" + "".join(f"{leaf:>16}" for leaf in LEAVES))
        for k, file in enumerate(files):
            stage = convert(file, Path(folder) / str(k), options.converters)
            _line(file, stage)
            if options.write and file.is_relative_to(folder):
                _keep(stage, options.write / f"{file.stem}.usda")


def convert(file: Path, folder: Path, converters: Path | None = None) -> Path:
    """The stage that the converter of the file's format makes of it."""
    name = "urdf_usd_converter" if file.suffix == ".urdf" else "mujoco_usd_converter"
    command = [str(converters / name) if converters else name, "--no-layer-structure", str(file), str(folder)]
    made = subprocess.run(command, capture_output=True, text=True)
    if made.returncode:
        raise SystemExit(f"{file}: {made.stdout}{made.stderr}")
    return next(folder.glob("*.usdc"))


def differences(first: RobotModel, second: RobotModel) -> dict[str, float]:
    """Largest difference of each leaf of two models with the same joints."""
    found = {}
    for leaf in LEAVES:
        a, b = (np.asarray(getattr(model, leaf), float) for model in (first, second))
        with np.errstate(invalid="ignore"):
            off = np.where(a == b, 0.0, np.abs(a - b) / np.maximum(1.0, np.abs(a)))
        found[leaf] = float(off.max(initial=0.0))
    a, b = (np.asarray(model.inertia, float) for model in (first, second))
    sizes = [np.maximum(np.abs(a[:, kind]).max(1, keepdims=True), 1e-12) for kind in KINDS]
    parts = [np.abs(a[:, kind] - b[:, kind]) / size for kind, size in zip(KINDS, sizes, strict=True)]
    return {"inertia": max(float(part.max()) for part in parts)} | found


def _line(file: Path, stage: Path) -> None:
    name = f"{file.parent.name}/{file.name}"
    try:
        first, second = read_robot(file), read_robot(stage)
    except InputError as error:
        print(f"{name:42} {error}")
        return
    if [joint.kind for joint in first.joints] != [joint.kind for joint in second.joints]:
        print(f"{name:42} joints {first.joint_names} became {second.joint_names}")
        return
    found = differences(first, second)
    print(f"{name:42}{first.nv:7}" + "".join(f"{v:{10 if k == 'inertia' else 16}.1e}" for k, v in found.items()))


def _own(folder: Path) -> list[Path]:
    sys.path.insert(0, str(ROOT / "tests"))
    import robots

    files = []
    limit = '<limit lower="-2" upper="1.5" velocity="3" effort="40"/>'  # without one the converter writes 0 to 0
    texts = robots.INLINE | {name: robots.MIXED[name] for name in ("beast", "quadruped")} | robots.MJCF
    for name, text in texts.items():
        suffix = "xml" if text.startswith("<mujoco") else "urdf"
        files.append(folder / f"{name}.{suffix}")
        for kind in ("revolute", "prismatic") if suffix == "urdf" else ():
            text = _limited(text, kind, limit)
        files[-1].write_text(text.replace('name="tiny"', f'name="{name}"'))
    return files


def _limited(text: str, kind: str, limit: str) -> str:
    parts = text.split(f'type="{kind}">')
    return f'type="{kind}">'.join([parts[0], *(part.replace("</joint>", f"{limit}</joint>", 1) for part in parts[1:])])


def _keep(stage: Path, target: Path) -> None:
    from pxr import Sdf

    target.parent.mkdir(exist_ok=True)
    layer = Sdf.Layer.FindOrOpen(str(stage))  # pyright: ignore[reportAttributeAccessIssue]
    layer.documentation = ""
    layer.Export(str(target))


if __name__ == "__main__":
    main()
