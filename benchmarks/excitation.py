"""Design of motions: FIGAROH's own problem for the UR10, and all limits at once on the UR10e and the Panda.

`python benchmarks/excitation.py` prints CPU seconds of one thread, cold (a fresh process, programs compiled) and warm.
The problem of FIGAROH 1.0.2 (`examples/ur10`): quintic pieces through five waypoints, 8 s, rows at 20 Hz, its limits
with 2 x soft_lim, unweighted rows of the base columns that it keeps. The peer's own result is quoted: its IPOPT has no
wheel, so it does not run here.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
SOFT = 0.1  # soft_lim
PEER = {"condition": 22.69, "logdet": 283.45, "CPU s": 18.5}  # its result, evaluated by us in a study; not run here
# joint: origin and roll of the joint, mass of the link, its centre, moments about it, effort, range, speed
UR10 = {
    "shoulder_pan": ((0, 0, 0.1807), 0, 7.778, (0, 0, 0), (0.03147, 0.03147, 0.02188), 330, 2 * np.pi, 2 * np.pi / 3),
    "shoulder_lift": (
        (0, 0, 0),
        1,
        12.93,
        (-0.306, 0, 0.175),
        (0.03637, 0.42175, 0.42175),
        330,
        2 * np.pi,
        2 * np.pi / 3,
    ),
    "elbow": ((-0.6127, 0, 0), 0, 3.87, (-0.285775, 0, 0.0393), (0.01088, 0.11079, 0.11079), 150, np.pi, np.pi),
    "wrist_1": ((-0.57155, 0, 0.17415), 0, 1.96, (0, 0, 0), (0.00511, 0.00511, 0.00551), 56, 2 * np.pi, np.pi),
    "wrist_2": ((0, -0.11985, 0), 1, 1.96, (0, 0, 0), (0.00511, 0.00511, 0.00551), 56, 2 * np.pi, np.pi),
    "wrist_3": ((0, 0.11655, 0), -1, 0.474, (0, 0.01, 0.01), (0.002, 0.002, 0.002), 56, 2 * np.pi, np.pi),
}


def urdf() -> str:
    """The UR10e of FIGAROH's example, as far as its dynamics go."""
    parts, parent = ['<link name="base"/>'], "base"
    for name, (xyz, quarter, mass, com, moments, effort, reach, speed) in UR10.items():
        inertia = " ".join(f'{k}="{x}"' for k, x in zip(("ixx", "iyy", "izz"), moments, strict=True))
        body = f'<mass value="{mass}"/><origin xyz="{com[0]} {com[1]} {com[2]}"/>'
        body += f'<inertia {inertia} ixy="0" ixz="0" iyz="0"/>'
        parts.append(f'<link name="{name}"><inertial>{body}</inertial></link>')
        limit = f'<limit effort="{effort}" lower="{-reach}" upper="{reach}" velocity="{speed}"/>'
        roll = f'xyz="{xyz[0]} {xyz[1]} {xyz[2]}" rpy="{quarter * np.pi / 2} 0 0"'
        joint = f'<origin {roll}/><axis xyz="0 0 1"/><parent link="{parent}"/><child link="{name}"/>{limit}'
        parts.append(f'<joint name="{name}_joint" type="revolute">{joint}</joint>')
        parent = name
    return f'<robot name="ur10">{"".join(parts)}</robot>'


def peer_problem() -> tuple[Any, Any, Any, Any]:
    """Model, basis, limits and what is learned in FIGAROH's problem."""
    from figaroh_jax.excitation.information import learn
    from figaroh_jax.excitation.limits import Limits
    from figaroh_jax.excitation.motions import quintic
    from figaroh_jax.formats.config import Baseline
    from figaroh_jax.formats.urdf import load_urdf

    with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
        file.write(urdf())
        file.flush()
        model = load_urdf(file.name)
    low, high = (np.array(model.position_limit)[:, k] for k in (0, 1))
    high = high - SOFT * (high - low)  # the second takes its share of what the first has left, as the peer does
    low = low + SOFT * (high - low)
    left = 1 - 2 * SOFT
    limits = Limits(
        np.stack([low, high], 1),
        left * np.array(model.velocity_limit),
        np.full(model.nv, np.inf),
        left * np.array(model.effort_limit),
    )
    # its order of a link's columns: Ixx Ixy Ixz Iyy Iyz Izz mx my mz m
    order = [10 * k + i for k in range(6) for i in (4, 5, 7, 6, 8, 9, 1, 2, 3, 0)]
    learned = learn(model, Baseline(viscous=False, coulomb=False), sigma=np.ones(6), trust=None, order=order)
    return model, quintic(5, 8.0), limits, learned


def spent(since: float) -> float:
    return time.process_time() - since


def on_peer_problem(starts: int, objective: str = "information", seed: int = 0) -> tuple[Any, float]:
    """A design on FIGAROH's problem and its CPU seconds."""
    from figaroh_jax.excitation.design import excite

    model, basis, limits, learned = peer_problem()
    since = time.process_time()
    posture = [0.0, -1.2, 1.0, -0.5, 0.3, 0.0]
    found = excite(model, basis, limits, learned, objective=objective, start=posture, starts=starts, seed=seed)  # pyright: ignore
    return found, spent(since)


def told(name: str, found: Any, cpu: float) -> None:
    stage = found.stages[0]
    worst = max(stage.uses, key=lambda use: use.share)
    print(
        f"{name:28s} logdet {found.logdet:7.2f}  condition {found.condition:7.2f}  scaled {found.scaled_condition:6.2f}"
        f"  worst {worst.kind} {worst.share:.4f}  {stage.evaluations} evaluations  {cpu:.2f} CPU s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--cold", action="store_true", help="one start in a fresh process, programs compiled")
    args = parser.parse_args()
    if args.cold:
        told("one start, cold", *on_peer_problem(1))
        print(f"whole process {time.process_time():.2f} CPU s")
        return
    on_peer_problem(1)
    for seed in range(3):
        told(f"one start, seed {seed}", *on_peer_problem(1, seed=seed))
    told("best of 32", *on_peer_problem(32))
    told("condition, best of 8", *on_peer_problem(8, "condition"))
    print(f"peer, quoted: {PEER}")


if __name__ == "__main__":
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    sys.path.insert(0, str(ROOT))
    import jax

    jax.config.update("jax_enable_x64", True)
    main()
