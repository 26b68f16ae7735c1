"""`figaroh-jax excite`: what it writes, its exit status, and the messages for what is wrong in a task."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import reference
import yaml
from schema import matches
from test_excitation import ARM
from test_robot_view import Server

from figaroh_jax.cli import main
from figaroh_jax.errors import InputError
from figaroh_jax.excitation import design, solvers
from figaroh_jax.excitation.task import excite_task, read_motion
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.reporting.motion_view import show_design_run

BASIS = "basis: {quintic: 3}, duration: 2"


def task_of(folder: Path, keys: str, more: str = "") -> Path:
    (folder / "robot.urdf").write_text(ARM)
    file = folder / "task.yaml"
    file.write_text(f"robot: {{model: robot.urdf}}\nexcite: {{{keys}}}\n{more}")
    return file


def moves_in_the_view(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second motion of a run, as the view draws it at half its time."""
    monkeypatch.setitem(sys.modules, "viser", SimpleNamespace(ViserServer=Server))
    server: Any = show_design_run(run, play=False)[0]
    server.controls["motion"].value = "trajectory 2"
    server.controls["time, s"].value = 1.0
    server.controls["time, s"].calls[0]()
    with np.load(run / "trajectory_2.npz") as motion:
        middle = motion["q"][1000]
    tips = reference.forward_kinematics(load_urdf(run.parent / "robot.urdf"), middle)[:, :3, 3]
    np.testing.assert_allclose(server.drawn["/robot"][0][0][:, 1], tips, rtol=0, atol=1e-9)
    (run.parent / "task.yaml").write_text("robot: {model: robot.urdf, joints: [bend]}\nexcite: {duration: 2}")
    with pytest.raises(InputError, match="made for the joints turn, bend"):
        show_design_run(run)
    whole = (run / "trajectory_2.npz").read_bytes()
    for part in (b"", whole[: len(whole) // 2]):
        (run / "trajectory_2.npz").write_bytes(part)
        with pytest.raises(InputError, match="the design cannot be read"):
            show_design_run(run)


def test_the_run_holds_the_motion_at_1_khz_with_its_torques_and_a_joint_trajectory(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    file = task_of(tmp_path, f"{BASIS}, limits: {{acceleration: 7.0}}, starts: 1, trajectories: 2, noise: 0.02")
    assert main(["excite", str(file), "--out", str(tmp_path / "run"), "--json", "--quiet"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer == json.loads((tmp_path / "run" / "excitation.json").read_text())
    matches("excite", answer)
    assert answer["met"] and answer["objective"] == "information" and len(answer["trajectories"]) == 2
    model = load_urdf(tmp_path / "robot.urdf")
    for k, told in enumerate(answer["trajectories"]):
        with np.load(tmp_path / "run" / f"trajectory_{k + 1}.npz") as motion:
            t, q, v, a, torque = (motion[name] for name in ("t", "q", "v", "a", "torque"))
        assert t.shape == (2001,) and t[-1] == 2.0
        np.testing.assert_allclose(torque, reference.inverse_dynamics(model, q, v, a), rtol=0, atol=1e-9)
        assert np.abs(a).max() <= 7.0 * 1.001
        share = next(use["share"] for use in told["use_at_1_kHz"] if use["limit"] == "acceleration")
        assert share == pytest.approx(np.abs(a).max() / 7.0, rel=1e-6)
        table = np.loadtxt(tmp_path / "run" / f"trajectory_{k + 1}.csv", delimiter=",", skiprows=1)
        np.testing.assert_allclose(table, np.column_stack([t, q, v, a, torque]), rtol=1e-7, atol=1e-8)
        message = yaml.safe_load((tmp_path / "run" / f"trajectory_{k + 1}.yaml").read_text())
        assert message["joint_names"] == ["turn", "bend"] and len(message["points"]) == 101
        last = message["points"][50]
        assert last["time_from_start"] == {"sec": 1, "nanosec": 0}
        np.testing.assert_allclose(last["positions"], q[1000], rtol=1e-7, atol=1e-8)
    for one in answer["parameters"]:
        assert one["std"] < one["std_before"]
    page = (tmp_path / "run" / "report.html").read_text()
    assert "within limits" in page and "1 kHz" in page and page.count("<polyline") == 16
    units = re.findall(r"<td>(position|velocity|acceleration|torque)</td>.*?</td><td>([^<]+)</td>", page)
    assert set(units) == {("position", "rad"), ("velocity", "rad/s"), ("acceleration", "rad/s²"), ("torque", "N\xa0m")}
    moves_in_the_view(tmp_path / "run", monkeypatch)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("ignore: [[a, b]]", "ignore: distances are looked at where limits.clearance"),
        ("limits: {speed: 2}", "unknown key 'speed'"),
        ("basis: {fourier: 5, spline: 3}", "exactly one of fourier, spline, quintic; given: fourier, spline"),
        ("objective: prediction", "needs `predict`"),
        ("objective: separate", "needs `separate`"),
        ("trajectories: 0", "excite.trajectories is 0, expected at least 1"),
        ("noise: -1", "more than 0"),
        (
            "limits: {velocity: 0.0}",
            "excite.limits.velocity is 0.0, expected 'model' or 'none', more than 0 or keys and values",
        ),
        ("limits: {position: {turn: [1, a]}}", "excite.limits.position.turn[1] is 'a', expected a number"),
        ("basis: {fourier: 2.5}", "excite.basis.fourier is 2.5, expected a whole number"),
        (
            "limits: {torque: true}",
            "excite.limits.torque is True, expected 'model' or 'none', a number or keys and values",
        ),
    ],
)
def test_a_mistake_in_the_block_is_named_with_its_key(tmp_path: Path, keys: str, message: str):
    with pytest.raises(InputError) as error:
        load_task(task_of(tmp_path, keys))
    assert message in str(error.value), error.value


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_motion_that_shows_nothing_says_so(tmp_path: Path):
    """In a twentieth of a second within 8 rad/s^2 joints move by 5 mrad at most; the condition number is infinite."""
    found = excite_task(load_task(task_of(tmp_path, "duration: 0.05, limits: {acceleration: 8.0}")))
    assert not np.isfinite(found.scaled_condition)
    assert any("do not show at all in this motion" in note for note in found.notes)


def test_a_task_without_recordings_is_for_excite_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = task_of(tmp_path, "duration: 4")
    assert main(["identify", str(file), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    assert "data is missing: this command needs recordings" in capsys.readouterr().err
    file.write_text("robot: {model: robot.urdf}\n")
    assert main(["excite", str(file), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    assert "data is missing" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("limits: {torque: 0.05, position: {turn: [0.5, 1.0], bend: [0.2, 0.5]}}", "holding still takes"),
        ("start: [0.0, 3.0]", "start: 'bend' at 3 is outside of its limits"),
        ("start: [1.0, 0.5], limits: {torque: {turn: 3.0}}", "start: holding still there takes"),
        ("start: [0.0]", "start: 1 numbers for the 2 joints turn, bend"),
        ("limits: {velocity: {bent: 1.0}}", "no moving joint 'bent'; did you mean 'bend'?"),
        ("basis: {fourier: 3, base: 0.3}, duration: 4", "a base of 0.25 Hz fits"),
        (
            "objective: separate,"
            " separate: [[{effect: joint_elasticity, at: [turn]}, {effect: rotor_inertia, at: [bend]}]]",
            "'joint_elasticity' has no torque of an instant",
        ),
        (
            "objective: separate, separate:"
            " [[{effect: viscous_friction, at: [turn]}, {effect: coulomb_friction, at: [turn]}]]",
            "no motion distinguishes viscous_friction at turn from coulomb_friction at turn: what is fitted anyway",
        ),
        ("objective: prediction, predict: [no.npz]", "no.npz (excite.predict) does not exist"),
    ],
)
def test_what_cannot_be_designed_ends_in_one_message_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], keys: str, message: str
):
    file = task_of(tmp_path, keys if "basis" in keys else f"{BASIS}, {keys}")
    assert main(["excite", str(file), "--out", str(tmp_path / "run"), "--quiet"]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_limit_that_is_not_met_at_1_khz_ends_with_status_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(solvers, "STEPS", 5)  # it cannot be met; a short search for it will do
    monkeypatch.setattr(design, "check_start", lambda *given: None)  # which would refuse it before any search
    # standing still at this start takes more torque than is allowed, so no motion from there meets the limit
    model = load_urdf(task_of(tmp_path, "duration: 2").with_name("robot.urdf"))
    start = np.array([1.0, 0.5])
    held = np.abs(reference.inverse_dynamics(model, start[None], 0 * start[None], 0 * start[None]))[0]
    easy = np.abs(reference.inverse_dynamics(model, *np.zeros((3, 1, 2))))[0]
    assert held[0] > easy[0] + 0.5
    limit = float((held[0] + easy[0]) / 2)
    keys = f"{BASIS}, starts: 1, start: [1.0, 0.5], limits: {{torque: {{turn: {limit}, bend: 60.0}}}}"
    file = task_of(tmp_path, keys)
    assert main(["excite", str(file), "--out", str(tmp_path / "run"), "--quiet"]) == 1
    said = capsys.readouterr().err
    assert "limit not met: trajectory 1: " in said and "torque of 'turn' is" in said and "over its limit" in said
    assert json.loads((tmp_path / "run" / "excitation.json").read_text())["met"] is False


def test_a_diagnosis_that_could_not_tell_two_causes_apart_gets_the_motion_that_does(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    file = task_of(tmp_path, f"{BASIS}, starts: 1")
    run = tmp_path / "diagnosis"
    run.mkdir()
    cause = {"effect": "rotor_inertia", "at": ["turn"], "parameters": {"inertia": {"value": 0.3, "std": 0.1}}}
    cause |= {"ambiguous_with": [{"effect": "link_inertia", "at": ["a"]}]}
    (run / "answer.json").write_text(json.dumps({"causes": [cause]}))
    (run / "provenance.json").write_text(json.dumps({"command": "diagnose", "task": str(file), "options": []}))
    assert main(["excite", "--from", str(run), "--out", str(tmp_path / "run"), "--quiet", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["objective"] == "separate"
    first = answer["separated"][0]
    assert (first["cause"], first["rival"]) == ("rotor_inertia at turn", "link_inertia at a")
    assert first["size"] == {"inertia": 0.3} and first["seconds"] == 2.0 * first["repeats"]
    (run / "answer.json").write_text(json.dumps({"causes": [cause | {"ambiguous_with": []}]}))
    assert main(["excite", "--from", str(run), "--out", str(tmp_path / "other"), "--quiet"]) == 2
    assert "no cause of this diagnosis is ambiguous" in capsys.readouterr().err
    assert main(["excite", "--out", str(tmp_path / "other"), "--quiet"]) == 2
    assert "excite needs a TASK.yaml, or --from" in capsys.readouterr().err


@pytest.mark.slow
def test_recordings_count_as_known_and_give_the_noise(tmp_path: Path):
    """A recording with a known noise, its torques Pinocchio's."""
    generator = np.random.default_rng(0)
    t = np.arange(0, 20, 0.01)
    waves = [(0.5 * k, generator.normal(size=2) / k, generator.uniform(0, 6, 2)) for k in range(1, 5)]
    q, v, a = (sum(w**d * c * np.sin(w * t[:, None] + p + d * np.pi / 2) for w, c, p in waves) for d in range(3))
    model = load_urdf(task_of(tmp_path, "duration: 2").with_name("robot.urdf"))
    noise = np.array([0.3, 0.1])
    torque = reference.inverse_dynamics(model, q, v, a) + 0.5 * v + noise * generator.standard_normal(q.shape)
    np.savez(tmp_path / "run.npz", t=t, q=q, torque=torque)
    data = "data: [{file: run.npz, time: t, position: q, torque: torque}]\npreprocess: {cutoff: 10}\n"
    alone = excite_task(load_task(task_of(tmp_path, f"{BASIS}, starts: 1, noise: 0.01")))
    after = excite_task(load_task(task_of(tmp_path, f"{BASIS}, starts: 1", data)))
    sigma = 1 / np.sqrt(np.asarray(after.learned.weight))
    # what a low pass at 10 Hz leaves of white noise at 100 Hz
    np.testing.assert_allclose(sigma, noise * np.sqrt(10 / 50), rtol=0.25)
    assert (after.std_before < alone.std_before).all() and (after.std < after.std_before).all()
    assert "1 recording counts as known already; the noise is the residual of their fit" in after.notes


def test_a_motion_that_matters_is_read_with_its_derivatives_or_refused_by_name(tmp_path: Path):
    (tmp_path / "robot.urdf").write_text(ARM)
    robot, t = load_urdf(tmp_path / "robot.urdf"), np.linspace(0.0, 2.0, 400)
    q = np.sin(np.outer(t, [2.0, 3.0]))

    def read(**arrays: np.ndarray) -> tuple[np.ndarray, ...]:
        np.savez(tmp_path / "motion.npz", **arrays)  # pyright: ignore[reportArgumentType]
        return read_motion(tmp_path / "motion.npz", robot)

    _, v, a = read(t=t, q=q)
    np.testing.assert_allclose(v, np.array([2.0, 3.0]) * np.cos(np.outer(t, [2.0, 3.0])), rtol=0, atol=1e-6)
    np.testing.assert_allclose(a, -np.array([4.0, 9.0]) * q, rtol=0, atol=1e-4)
    for wrong, message in (
        ({"t": t[::-1], "q": q}, "t must increase"),
        ({"t": np.where(t > 1, np.nan, t), "q": q}, "motion.npz"),
        ({"t": t, "q": np.where(t[:, None] > 1, np.nan, q)}, "motion.npz"),
        ({"q": q}, "q, v, a or t, q are expected"),
        ({"t": t, "q": q[:, :1]}, "expected"),
        ({"q": q, "v": q[:5], "a": q}, "v has shape"),
    ):
        with pytest.raises(InputError, match=message):
            read(**wrong)


def test_limits_that_nobody_gives_and_ranges_in_degrees_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A file whose velocity and effort are 0, as drawing programs write; what the task states is not asked for."""
    limits = "{acceleration: 10, velocity: {turn: 2}, position: {turn: [-90, 90]}}"
    file = task_of(tmp_path, f"{BASIS}, limits: {limits}")
    text = re.sub(r'(effort|velocity)="[^"]*"', r'\1="0"', ARM)
    (tmp_path / "robot.urdf").write_text(text)
    assert main(["excite", str(file), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    said = json.loads((tmp_path / "run" / "excitation.json").read_text())["notes"]
    assert any("nothing limits the velocity of bend (" in note and "limits.velocity" in note for note in said), said
    assert any("nothing limits the torque of turn, bend (" in note for note in said)
    assert any("'turn' may move from -90 to 90 rad: are its limits in degrees?" in note for note in said)
    file.write_text(file.read_text().replace("velocity: {turn: 2}", "velocity: 20, torque: 1000"))
    assert main(["excite", str(file), "--out", str(tmp_path / "other"), "--quiet"]) == 0
    said = json.loads((tmp_path / "other" / "excitation.json").read_text())["notes"]
    assert not any("nothing limits" in note for note in said)


def test_a_limit_is_waived_by_a_word_and_never_by_an_empty_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Without the torque's the motion may pass the model's; a note says so; a joint or key that is wrong has a file."""
    text = re.sub(r'effort="[^"]*"', 'effort="0.05"', ARM)
    largest, notes = {}, {}
    for stated, status in (("model", 0), ("", 2), ("none", 0)):
        file = task_of(tmp_path, f"{BASIS}, starts: 1, limits: {{acceleration: 10, torque: {stated}}}")
        out = tmp_path / f"run{stated}"
        (tmp_path / "robot.urdf").write_text(text)
        assert main(["excite", str(file), "--out", str(out), "--quiet"]) == status
        assert out.exists() == (status == 0)
        if status == 0:
            notes[stated] = json.loads((out / "excitation.json").read_text())["notes"]
            largest[stated] = np.abs(np.load(out / "trajectory_1.npz")["torque"]).max()
    waived = "limits.torque: none: the motion keeps no limit of the torque"
    assert waived in notes["none"] and waived not in notes["model"]
    assert largest["model"] < 0.0501 < largest["none"]
    file = task_of(tmp_path, f"{BASIS}, limits: {{velocity: {{trun: 1}}}}")
    capsys.readouterr()
    assert main(["excite", str(file), "--out", str(tmp_path / "other"), "--quiet"]) == 2
    assert "task.yaml: excite.limits.velocity: no moving joint 'trun'; did you mean 'turn'" in capsys.readouterr().err
