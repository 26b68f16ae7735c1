"""How the cost of a diagnosis grows with the joints: parts of a humanoid, moved by sines, one friction hidden in it.

    python benchmarks/many_joints.py [--only arm arms humanoid] [--seconds 20] [--seed N] [--out DIR]

TALOS (`talos_contact`) on a stand: an arm (7 joints), torso and arms (16), all of it (32). Torque is Pinocchio's with
links of 5 % other masses and levers, viscous and Coulomb friction, noise of 1 % of each joint's torque and a Stribeck
friction of 30 % at a random joint; four recordings, the last kept out. Each is diagnosed by the command line in a
process of its own: CPU seconds and peak memory with imports, programs kept from the runs before.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import yaml

ROBOT = Path(os.environ.get("FIGAROH_JAX_DATA", "../shared/data")).resolve() / "talos_contact" / "talos_full_v2.urdf"
PARTS = {
    "arm": lambda name: name.startswith("arm_left"),
    "arms": lambda name: name.startswith(("arm", "torso")),
    "humanoid": lambda name: True,
}
RATE, RECORDINGS = 200, 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--seconds", type=float, default=20.0, help="of each recording")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder for the cases and the answers")
    args = parser.parse_args()
    print("| part | joints | CPU s | peak MB | hidden | told | held out |\n|---|---|---|---|---|---|---|")
    for part in args.only:
        folder = Path(tempfile.mkdtemp()) if args.out is None else args.out / part
        folder.mkdir(parents=True, exist_ok=True)
        place, force, count = made(folder, part, args.seconds, args.seed)
        command = [sys.executable, "-m", "figaroh_jax", "diagnose", str(folder / "task.yaml"), "--quiet"]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        run = subprocess.run([*command, "--out", str(folder / "run")], capture_output=True, text=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        told, held = run.stderr.strip()[-200:], ""
        if run.returncode == 0:
            answer = json.loads((folder / "run" / "answer.json").read_text())
            told = "; ".join([answer["verdict"], *map(_words, answer["causes"])])
            held = f"{answer['holdout']['before']:.4f} -> {answer['holdout']['after']:.4f}"
        cells = (part, count, f"{used:.0f}", f"{after.ru_maxrss / 1024:.0f}", f"{place} {force:.3g} N m", told, held)
        print("|", " | ".join(map(str, cells)), "|", flush=True)


def _words(cause: dict[str, Any]) -> str:
    sizes = ", ".join(f"{key} {told['value']:.3g}" for key, told in cause["parameters"].items())
    return f"{cause['effect']} {' '.join(cause['at'])} {sizes}"


def made(folder: Path, part: str, seconds: float, seed: int) -> tuple[str, float, int]:
    """Write task and recordings; joint and force of the friction that is hidden, and how many joints there are."""
    rng, whole = np.random.default_rng([seed, *part.encode()]), pin.buildModelFromUrdf(str(ROBOT))
    locked = [whole.getJointId(name) for name in list(whole.names)[1:] if not PARTS[part](name)]
    model = pin.buildReducedModel(whole, locked, pin.neutral(whole)) if locked else whole
    nv, t = model.nv, np.arange(0, seconds, 1 / RATE)
    for k in range(1, nv + 1):
        link, factor = model.inertias[k], 1 + 0.05 * rng.standard_normal()
        lever = link.lever * (1 + 0.05 * rng.standard_normal(3))
        model.inertias[k] = pin.Inertia(link.mass * factor, lever, link.inertia * factor)
    low, high = np.maximum(model.lowerPositionLimit, -2), np.minimum(model.upperPositionLimit, 2)
    damping, dry = rng.uniform(0.5, 2, (2, nv))
    place, data = int(rng.integers(nv)), model.createData()
    scale = np.zeros(nv)
    for run in range(RECORDINGS):
        w, shift = 2 * np.pi * rng.uniform(0.05, 0.35, (5, nv)), rng.uniform(0, 2 * np.pi, (5, nv))
        size = rng.standard_normal((5, nv)) / (1 + 1.3 * w)
        size *= 0.35 * (high - low) / np.abs(size).sum(0)
        phase = t[:, None, None] * w + shift
        q = (low + high) / 2 + (size * np.sin(phase)).sum(1)
        v, a = (size * w * np.cos(phase)).sum(1), -(size * w**2 * np.sin(phase)).sum(1)
        torque = np.array([pin.rnea(model, data, *row) for row in zip(q, v, a, strict=True)])
        scale = torque.std(0) + 0.2 if run == 0 else scale
        sign = np.tanh(v / 0.005)
        torque += np.minimum(1, 0.3 * scale) * (damping * v + dry * sign)
        torque[:, place] += 0.3 * scale[place] * np.exp(-((v[:, place] / 0.15) ** 2)) * sign[:, place]
        torque += 0.01 * scale * rng.standard_normal(torque.shape)
        np.savez(folder / f"run_{run}.npz", t=t, q=np.round(q, 5), tau=torque)
    entries = [
        {"file": f"run_{run}.npz", "time": "t", "position": "q", "torque": "tau"}
        | ({"role": "holdout"} if run == RECORDINGS - 1 else {})
        for run in range(RECORDINGS)
    ]
    names = [str(name) for name in list(model.names)[1:]]
    task = {
        "robot": {"model": str(ROBOT), "joints": names},
        "data": entries,
        "preprocess": {"cutoff": 8, "rate": 50},
    }
    (folder / "task.yaml").write_text(yaml.safe_dump(task, sort_keys=False))
    return names[place], float(0.3 * scale[place]), nv


if __name__ == "__main__":
    main()
