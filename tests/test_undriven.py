"""Robots with a joint that nothing drives: that its torque is zero is a measurement."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import load_task
from figaroh_jax.recordings.draft import draft_task
from figaroh_jax.recordings.draft_columns import Undecided

LENGTH, RATE = 0.25, 100.0
TRUTH = {"Izz1 + 0.0625 m2": 0.030, "mx1 + 0.25 m2": 0.12, "Izz2": 0.0045, "mx2": 0.024}
DAMPING, KNOWN = np.array([0.02, 0.0006]), 0.6  # N m s/rad; share of link 2 that the model file knows of


def link(k: int, mass: float, first: float, second: float) -> str:
    turns = max(second - first**2 / mass, 1e-5)
    moments = zip(("ixx", "iyy", "izz"), (0.8 * turns, turns, turns), strict=True)
    inertia = " ".join(f'{name}="{x}"' for name, x in moments)
    return (
        f'<link name="l{k}"><inertial><origin xyz="{first / mass} 0 0"/><mass value="{mass}"/>'
        f'<inertia {inertia} ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


def pendubot(path: Path) -> Path:
    """Two links in a vertical plane, of which the second is lighter than the true one."""
    second = link(2, 0.26 * KNOWN, TRUTH["mx2"] * KNOWN, TRUTH["Izz2"] * KNOWN)
    first = link(1, 1.0, TRUTH["mx1 + 0.25 m2"] - LENGTH * 0.26, TRUTH["Izz1 + 0.0625 m2"] - LENGTH**2 * 0.26)
    joints = "".join(
        f'<joint name="j{k}" type="continuous"><parent link="{of}"/><child link="l{k}"/><origin xyz="{x} 0 0"'
        f' rpy="{roll} 0 0"/><axis xyz="0 0 1"/></joint>'
        for k, of, x, roll in ((1, "base", 0, np.pi / 2), (2, "l1", LENGTH, 0))
    )
    path.write_text(f'<robot name="pendubot"><link name="base"/>{first}{second}{joints}</robot>')
    return path


def swung(seconds: float, noise: float, seed: int) -> dict[str, np.ndarray]:
    """Motion under a torque of several sines at the first joint, by the equations of two links in a plane."""
    generator = np.random.default_rng(seed)
    phase, (a, b, c, d) = generator.uniform(0, 2 * np.pi, 3), TRUTH.values()

    def torque(t):
        return 0.9 * sum(np.sin(2 * np.pi * f * t + p) for f, p in zip((0.6, 1.1, 1.7), phase, strict=True))

    def slope(t, state):
        q, v = state[:2], state[2:]
        cross = LENGTH * d * np.array([np.cos(q[1]), np.sin(q[1])])
        mass = np.array([[a + c + 2 * cross[0], c + cross[0]], [c + cross[0], c]])
        bias = cross[1] * np.array([-v[1] * (2 * v[0] + v[1]), v[0] ** 2])
        bias += 9.81 * np.array([b * np.cos(q[0]) + d * np.cos(q.sum()), d * np.cos(q.sum())]) + DAMPING * v
        return np.concatenate([v, np.linalg.solve(mass, [torque(t) - bias[0], -bias[1]])])

    time = np.arange(0.0, seconds, 1 / RATE)
    found = solve_ivp(slope, (0, seconds), [-1.5, 0.1, 0, 0], t_eval=time, rtol=1e-8, atol=1e-8)
    q = found.y[:2].T + noise * generator.normal(size=(len(time), 2))
    return {"t": time, "q1": q[:, 0], "q2": q[:, 1], "tau1": torque(time) + 0.02 * generator.normal(size=len(time))}


def table(path: Path, columns: dict[str, np.ndarray]) -> Path:
    np.savetxt(path, np.column_stack(list(columns.values())), "%.9g", ",", header=",".join(columns), comments="")
    return path


def task(folder: Path, torque: str) -> fj.Task:
    (folder / "task.yaml").write_text(
        f"robot: {{model: pendubot.urdf, trust: 0.4}}\npreprocess: {{cutoff: 10}}\n"
        "baseline: {viscous: true, coulomb: false, offset: true}\n"
        f"data: [{{file: run.csv, time: t, position: [q1, q2], torque: {torque}}}]\n"
    )
    return load_task(folder / "task.yaml")


def test_a_torque_that_is_zero_because_nothing_drives_the_joint_tells_its_link(tmp_path: Path):
    pendubot(tmp_path / "pendubot.urdf")
    table(tmp_path / "run.csv", swung(6.0, 1e-3, 0))
    found = fj.identify_task(task(tmp_path, "[tau1, 0]"))
    base = {one.expression: one.value for one in found.base}
    for name, true in TRUTH.items():
        assert base[name] == pytest.approx(true, rel=0.05), name
    damping = [e.parameters["damping"].value for e in found.effects if e.name.effect == "viscous_friction"]
    np.testing.assert_allclose(np.ravel(damping), DAMPING, atol=0.01)
    assert [e.name.at for e in found.effects if e.name.effect == "torque_offset"] == [
        ("j1",)
    ]  # nothing is sensed at the other
    with pytest.raises(InputError, match=r"nothing drives j2.*`command`, not as `torque`.*j1: \{kind: torque\}"):
        fj.diagnose_task(task(tmp_path, "[tau1, 0]"))
    wrong = task(tmp_path, "[tau1, 0, 0]")
    with pytest.raises(InputError, match="lists 3 columns, expected 2: for each of j1, j2 its column, or 0"):
        fj.read_recordings(wrong, fj.load_robot(wrong))


def test_a_draft_is_told_which_joints_nothing_drives(tmp_path: Path):
    urdf, columns = pendubot(tmp_path / "pendubot.urdf"), swung(3.0, 1e-4, 1)
    run = table(tmp_path / "run.csv", columns)
    with pytest.raises(
        Undecided, match=r"1 column of torque \(tau1\) for 2 joints \(j1, j2\); name by --passive"
    ) as it:
        draft_task(urdf, [run], unit="rad")
    assert it.value.option == "passive"
    draft = draft_task(urdf, [run], unit="rad", passive=["j2"], folder=tmp_path)
    assert "torque: [tau1, 0]" in draft.text and any("nothing drives j2" in line for line in draft.assumed)
    whole = table(tmp_path / "whole.csv", columns | {"tau2": 0 * columns["tau1"]})
    assert any("torque of j2 is 0 in every row" in line for line in draft_task(urdf, [whole], unit="rad").assumed)
    assert "torque: [tau1, 0]" in draft_task(urdf, [whole], unit="rad", passive=["j2"]).text
    with pytest.raises(InputError, match="--passive names j1, but its torque is not zero"):
        draft_task(urdf, [whole], unit="rad", passive=["j1"])
