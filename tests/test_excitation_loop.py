"""The loop closed: a pair that recordings leave open, the motion designed for it, MuJoCo C with the truth, the name."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from figaroh_jax.cli import main

ROTOR = 0.1  # kg m^2 at the elbow, which the URDF does not hold
DAMPING, NOISE = np.array([0.8, 0.4]), np.array([0.4, 0.15])  # N m s/rad, N m


def _link(name: str, mass: float, com: str, moment: float) -> str:
    inertia = f'<inertia ixx="{moment}" iyy="{moment}" izz="{moment}" ixy="0" ixz="0" iyz="0"/>'
    return f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{com}"/>{inertia}</inertial></link>'


def _joint(name: str, parent: str, child: str, xyz: str, effort: float) -> str:
    limit = f'<limit lower="-2.5" upper="2.5" velocity="4" effort="{effort}"/><axis xyz="0 1 0"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{xyz}"/>'
    return f'<joint name="{name}" type="revolute">{ends}{limit}</joint>'


URDF = "".join(
    [
        '<robot name="two">',
        _link("base", 1.0, "0 0 0", 0.01) + _link("upper", 4.0, ".2 0 0", 0.05) + _link("fore", 2.0, ".15 0 0", 0.02),
        _joint("shoulder", "base", "upper", "0 0 0", 80) + _joint("elbow", "upper", "fore", ".4 0 0", 30),
        "</robot>",
    ]
)


def measured(
    q: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    seed: int,
    noise: np.ndarray = NOISE,
    rotor: float = ROTOR,
    forearm: float = 1.0,
) -> np.ndarray:
    """Torques of MuJoCo C with a rotor at the elbow, damping, a share of the forearm's inertia, and noise."""
    model = mujoco.MjModel.from_xml_string(URDF)
    model.dof_armature[1], model.dof_damping[:] = rotor, DAMPING
    model.body_mass[-1] *= forearm
    model.body_inertia[-1] *= forearm
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT | mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data, out = mujoco.MjData(model), []
    for state in zip(q, v, a, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = state
        mujoco.mj_inverse(model, data)
        out.append(data.qfrc_inverse.copy())
    return np.array(out) + np.random.default_rng(seed).normal(size=q.shape) * noise


def _task(folder: Path, file: str, runs: list[str]) -> Path:
    entry = "  - {{file: {}.npz, time: t, position: q, torque: tau, role: {}}}\n"
    data = "".join(entry.format(run, "holdout" if run == runs[-1] else "fit") for run in runs)
    keys = "{duration: 10, basis: {fourier: 10, base: 0.1}, limits: {acceleration: 12}, starts: 2}"
    text = f"robot: {{model: robot.urdf, trust: 0.03}}\ndata:\n{data}preprocess: {{cutoff: 10, rate: 50}}\n"
    text += f"excite: {keys}\n"
    (folder / file).write_text(text)
    return folder / file


def _slow(seed: int, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both joints at 1, 2 and 3 rad/s in step: the elbow hardly moves against the shoulder's motion."""
    generator = np.random.default_rng(seed)
    q, v, a = np.zeros((3, len(t), 2))
    for w in (1.0, 2.0, 3.0):
        phase, size = generator.uniform(0, 6), np.array([0.5, 0.6]) / w
        q += size * np.sin(w * t[:, None] + phase)
        v += size * w * np.cos(w * t[:, None] + phase)
        a -= size * w**2 * np.sin(w * t[:, None] + phase)
    return q, v, a


@pytest.mark.slow
def test_the_motion_designed_for_an_open_pair_brings_the_right_name(tmp_path: Path):
    """Slow, noisy recordings leave open whether rotor or link is wrong; the motion designed for the two settles it."""
    (tmp_path / "robot.urdf").write_text(URDF)
    t = np.arange(0, 10, 0.005)
    for seed in range(3):
        states = _slow(seed, t)
        np.savez(tmp_path / f"slow{seed}.npz", t=t, q=states[0], tau=measured(*states, seed, 2 * NOISE))
    first = _task(tmp_path, "first.yaml", [f"slow{k}" for k in range(3)])
    run = tmp_path / "first"
    assert main(["diagnose", str(first), "--out", str(run), "--quiet"]) == 0
    answer = json.loads((run / "answer.json").read_text())
    (open_one,) = answer["causes"]
    open_set = {(one["effect"], *one["at"]) for one in [open_one, *open_one["ambiguous_with"]]}
    assert {("rotor_inertia", "elbow"), ("link_inertia", "fore")} <= open_set
    assert open_set <= {("rotor_inertia", "elbow"), ("link_inertia", "fore"), ("payload", "fore")}
    assert "figaroh-jax excite --from RUN_DIR" in answer["next_experiment"]["text"]
    assert main(["excite", "--from", str(run), "--out", str(tmp_path / "motion"), "--quiet"]) == 0
    told = json.loads((tmp_path / "motion" / "excitation.json").read_text())
    assert told["separated"][0]["cause"] == "rotor_inertia at elbow" and told["separated"][0]["repeats"] <= 3
    with np.load(tmp_path / "motion" / "trajectory_1.npz") as motion:
        time, *states = (motion[name][::5] for name in ("t", "q", "v", "a"))
    for seed in range(3):
        np.savez(
            tmp_path / f"told{seed}.npz", t=time, q=states[0], tau=measured(states[0], states[1], states[2], 10 + seed)
        )
    second = _task(tmp_path, "second.yaml", [f"told{k}" for k in range(3)])
    assert main(["diagnose", str(second), "--out", str(tmp_path / "second"), "--quiet"]) == 0
    answer = json.loads((tmp_path / "second" / "answer.json").read_text())
    (found,) = answer["causes"]
    assert (answer["verdict"], found["effect"], found["at"]) == ("named", "rotor_inertia", ["elbow"])
    assert found["ambiguous_with"] == []
    assert found["parameters"]["inertia"]["value"] == pytest.approx(ROTOR, rel=0.03)
