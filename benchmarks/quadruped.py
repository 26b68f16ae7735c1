"""A quadruped of twelve joints that hangs from a stand: its drives' numbers from command and position alone.

    python benchmarks/quadruped.py [--seconds 12] [--seed 1] [--folder DIR] [--soft]

MuJoCo C simulates the robot with its free base, which a weld holds in the air, legs without contact; positions are
read at 100 Hz with .2 mrad of noise. `figaroh-jax identify` gets the MJCF with armature, damping and friction 1.6
times too large and the twelve joints' names (`root: fixed`: the base stays
where it hangs). Printed: error of each kind of number,
how many intervals hold the truth, and the error on a recording that was kept out, beside the noise.

With `--soft` the trunk hangs on springs in all six directions and swings as the legs move: nothing measures it, its
motion is simulated, and its state at each window's start is fitted.
"""

# ruff: noqa: E501 - the robot stands here as lines of XML
from __future__ import annotations

import argparse
import dataclasses
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import mujoco as engine
import numpy as np

from figaroh_jax.cli import main as command_line
from figaroh_jax.rollouts.data import Run, Stretch, windows
from figaroh_jax.rollouts.fit import fit, standard_errors
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.setting import begun, setting

mujoco: Any = engine
DT, EVERY, NOISE = 0.002, 5, 2e-4
LEGS = [f"{side}{end}" for end in ("front", "hind") for side in ("left_", "right_")]
PARTS = ("hip", "thigh", "calf")
KP, KV = (60.0, 60.0, 60.0), (1.0, 1.0, 1.0)
TRUTH = {"armature": (0.010, 0.012, 0.015), "damping": (0.15, 0.2, 0.25), "friction": (0.25, 0.2, 0.3)}
STAND = '<equality><weld body1="trunk" solref=".004 1" solimp=".999 .9999 .001"/></equality>'
SOFT = "".join(
    f'<joint name="trunk_{kind}_{axis}" type="{kind}" axis="{direction}" stiffness="{stiff}" damping="{loss}"/>'
    for kind, stiff, loss in (("slide", 8000, 60), ("hinge", 60, 1.0))
    for axis, direction in zip("xyz", ("1 0 0", "0 1 0", "0 0 1"), strict=True)
)
JOINTS = [f"{leg}_{part}" for leg in LEGS for part in PARTS]


def model_text(scale: float = 1.0, stand: str = "", base: str = '<freejoint name="base"/>') -> str:
    """The robot as an MJCF file, its twelve drives' numbers times `scale`; `stand`: what holds its trunk."""
    legs = ""
    for k, leg in enumerate(LEGS):
        x, y = (0.2 if k < 2 else -0.2), (0.07 if k % 2 == 0 else -0.07)
        own = [
            f'<joint name="{leg}_{part}" axis="{axis}" armature="{scale * TRUTH["armature"][i]:.6g}"'
            f' damping="{scale * TRUTH["damping"][i]:.6g}" frictionloss="{scale * TRUTH["friction"][i]:.6g}"/>'
            for i, (part, axis) in enumerate(zip(PARTS, ("1 0 0", "0 1 0", "0 1 0"), strict=True))
        ]
        legs += (
            f'<body name="{leg}_hip" pos="{x} {y} 0">{own[0]}<inertial pos="0 {y / 5:.4f} 0" mass=".7" diaginertia=".0005 .0008 .0006"/>'
            f'<body name="{leg}_thigh" pos="0 {y:.3f} 0">{own[1]}<inertial pos="-.004 {-y / 4:.4f} -.03" mass="1.1" diaginertia=".006 .006 .001"/>'
            f'<body name="{leg}_calf" pos="0 0 -.2">{own[2]}<inertial pos=".005 0 -.12" mass=".2" diaginertia=".003 .003 .0001"/>'
            "</body></body></body>"
        )
    drives = "".join(
        f'<position name="{leg}_{part}" joint="{leg}_{part}" kp="{KP[i]}" kv="{KV[i]}"/>'
        for leg in LEGS for i, part in enumerate(PARTS)
    )  # fmt: skip
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{DT}" integrator="implicitfast"><flag contact="disable"/></option>'
        '<worldbody><body name="trunk" pos="0 0 1">'
        f'{base}<inertial pos="0 0 0" mass="6" diaginertia=".02 .06 .07"/>'
        f"{legs}</body></worldbody>{stand}"
        f"<actuator>{drives}</actuator></mujoco>"
    )


def record(seed: int, number: int, seconds: float, *, soft: bool = False) -> dict[str, np.ndarray]:
    """`t`, `u`, `q` at 100 Hz; commands are waves and steps about a posture; `trunk` how far that moved, m and rad."""
    rng = np.random.default_rng([seed, number])
    t = DT * np.arange(round(seconds / DT))[:, None]
    middle = np.tile([0.0, 0.8, -1.5], 4)
    waves = sum(
        rng.uniform(0.05, 0.25, 12) * np.sin(2 * np.pi * f * t + rng.uniform(0, 6, 12)) for f in (0.2, 0.7, 1.9)
    )
    steps = np.repeat(rng.uniform(-0.12, 0.12, (round(seconds / 0.5) + 1, 12)), round(0.5 / DT), 0)[: len(t)]
    u = middle + (waves + steps) * np.clip(t, 0, 1)
    u = np.repeat(u[::EVERY], EVERY, 0)[: len(u)]
    text = model_text(base=SOFT) if soft else model_text(stand=STAND)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    at = [model.joint(name).qposadr[0] for name in JOINTS]
    data.qpos[at] = u[0]
    data.ctrl[:] = u[0]
    for _ in range(1500 if soft else 0):  # it hangs at rest when the recording begins
        mujoco.mj_step(model, data)
    q, trunk = np.zeros_like(u), np.zeros((len(u), 6))
    for k, row in enumerate(u):
        q[k], trunk[k], data.ctrl[:] = data.qpos[at], data.qpos[:6], row
        mujoco.mj_step(model, data)
    noisy = q[::EVERY] + NOISE * rng.normal(size=q[::EVERY].shape)
    return {"t": t[::EVERY, 0], "u": u[::EVERY], "q": noisy, "trunk": np.ptp(trunk, axis=0)}


def soft(seconds: float, seed: int, folder: Path) -> None:
    """The trunk swings on springs and is not measured."""
    (folder / "swinging.xml").write_text(model_text(1.6, base=SOFT))
    loop, _ = load_loop(folder / "swinging.xml")
    places = tuple(loop.robot.dof_names.index(name) for name in JOINTS)
    loop = dataclasses.replace(loop, measured=places)
    made = [record(seed, k, seconds, soft=True) for k in range(3)]
    runs = [Run(f"run {k}", r["t"], r["u"], r["q"], None) for k, r in enumerate(made)]
    effects = {"rotor_inertia": "armature", "joint_damping": "damping", "friction_loss": "friction"}
    start, cut = time.process_time(), [Stretch(k, 0, len(r.time)) for k, r in enumerate(runs)]
    more = [(effect, name) for effect in effects for name in JOINTS]
    here = setting(loop, runs[:2], baseline=(), more=more, stretches=cut[:2])
    found = begun(here)
    errors, wrong, inside = standard_errors(found, here.data), dict[str, list[float]](), 0
    for column, entry in enumerate(found.free[found.free >= 0]):
        kind, place = here.known.table[entry].name, here.known.table[entry].at[0]
        truth = TRUTH[kind][PARTS.index(loop.robot.dof_names[place].rsplit("_", 1)[1])]
        wrong.setdefault(kind, []).append(float(abs(found.theta[entry] / truth - 1)))
        inside += abs(found.theta[entry] - truth) <= 1.96 * errors[column]
    moved = np.max([r["trunk"] for r in made], axis=0)
    print(f"trunk moves by {1e3 * moved[:3].max():.0f} mm and {moved[3:].max():.2f} rad, not measured")
    for kind, off in wrong.items():
        print(f"{kind}: median error {100 * np.median(off):.2f} %, largest {100 * np.max(off):.2f} %")
    print(f"95 % intervals that hold the truth: {inside} of {len(more)}; {time.process_time() - start:.0f} CPU s")
    data = windows(loop, runs, cut[2:], [np.full(len(JOINTS), NOISE)], 0.3)
    held = fit(here.loop, here.known.table, data, found.theta[None], [[]], width=1, lanes=1)[0]
    rms = 1e3 * NOISE * np.sqrt(held.squares / (np.asarray(data.weight) > 0).sum())
    print(f"held out: {rms:.3f} mrad, noise {1e3 * NOISE:.3f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=12.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=None)
    parser.add_argument("--soft", action="store_true", help="the trunk swings on springs, not measured")
    args = parser.parse_args()
    folder = args.folder or Path(tempfile.mkdtemp())
    if args.soft:
        return soft(args.seconds, args.seed, folder)
    (folder / "robot.xml").write_text(model_text(1.6))
    for k, name in enumerate(("first", "second", "unseen")):
        made = {key: x for key, x in record(args.seed, k, args.seconds).items() if key != "trunk"}
        np.savez(folder / f"{name}.npz", **made)  # pyright: ignore[reportArgumentType]
    rows = [f"{{file: {n}.npz, time: t, command: u, position: q, role: {r}}}" for n, r in
            (("first", "fit"), ("second", "fit"), ("unseen", "holdout"))]  # fmt: skip
    (folder / "task.yaml").write_text(
        f"robot: {{model: robot.xml, root: fixed, joints: [{', '.join(JOINTS)}]}}\n"
        + "data:\n" + "".join(f"  - {row}\n" for row in rows)
    )  # fmt: skip
    start = time.process_time()
    status = command_line(["identify", str(folder / "task.yaml"), "--out", str(folder / "run"), "--quiet"])
    spent = time.process_time() - start
    result = json.loads((folder / "run" / "result.json").read_text())
    print(f"status {status}, {spent:.0f} CPU s for {2 * args.seconds:.0f} s of twelve joints")
    inside, wrong = 0, dict[str, list[float]]()
    for one in result["base_parameters"]:
        kind, joint = one["expression"].split()
        truth = TRUTH[kind][PARTS.index(joint.rsplit("_", 1)[1])]
        wrong.setdefault(kind, []).append(abs(one["value"] / truth - 1))
        inside += abs(one["value"] - truth) <= 1.96 * (one["std"] or np.inf)
    for kind, errors in wrong.items():
        print(f"{kind}: median error {100 * np.median(errors):.2f} %, largest {100 * np.max(errors):.2f} %")
    print(f"95 % intervals that hold the truth: {inside} of {len(result['base_parameters'])}")
    rms = np.array(
        result["holdout"]["unseen"]["rms"]
        if "unseen" in result["holdout"]
        else next(iter(result["holdout"].values()))["rms"]
    )
    print(f"held out: {1e3 * rms.mean():.3f} mrad (largest joint {1e3 * rms.max():.3f}), noise {1e3 * NOISE:.3f}")


if __name__ == "__main__":
    main()
