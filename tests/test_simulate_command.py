"""`figaroh-jax simulate`: a run's model moved by a file of commands, against MuJoCo C and SciPy."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import browser
import jax
import mujoco as engine
import numpy as np
import pytest
from schema import matches
from scipy.integrate import solve_ivp
from test_robot_view import Server
from test_rollout_callback import NUMBERS, TWO, changed

import figaroh_jax as fj
from figaroh_jax.cli import main
from figaroh_jax.errors import InputError
from figaroh_jax.formats.export import write_model
from figaroh_jax.recordings.reading import read_table
from figaroh_jax.reporting.motion_view import show_simulation_run
from figaroh_jax.rollouts.causes import elastic_loop
from figaroh_jax.rollouts.data import Run
from figaroh_jax.rollouts.loop import Loop
from figaroh_jax.rollouts.stored import add_loop
from figaroh_jax.rollouts.task import extended_of, simulated

mujoco: Any = engine
PENDULUM = """<robot name="pendulum"><link name="world"/><link name="rod"><inertial><origin xyz="0 0 -.4"/><mass
value="1.5"/><inertia ixx=".02" iyy=".02" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="hinge"
type="revolute"><parent link="world"/><child link="rod"/><axis xyz="0 1 0"/><limit lower="-9" upper="9" effort="9"
velocity="9"/></joint></robot>"""
STIRRED = TWO.replace(
    "</actuator>", '<general name="c" joint="j1" dyntype="filter" dynprm=".05" gainprm="3"/></actuator>'
)


def written(folder: Path, text: str = TWO, numbers: dict[str, list[float]] | None = None) -> Loop:
    """A run's `model` of this arm, and its loop."""
    folder.mkdir(exist_ok=True)
    (folder / "arm.xml").write_text(text)
    loop = changed(fj.load_loop(folder / "arm.xml")[0], numbers or {})
    write_model(extended_of(loop), folder / "run" / "model")
    add_loop(folder / "run" / "model", loop)
    return loop


def saved(file: Path, **columns: np.ndarray) -> Path:
    """A CSV file with a column for each name."""
    np.savetxt(file, np.column_stack([*columns.values()]), "%.17g", ",", header=",".join(columns), comments="")
    return file


def ran(folder: Path, file: Path, *more: str) -> dict[str, np.ndarray]:
    run, out = folder / "run", folder / "out"
    assert main(["simulate", str(run), "--command", str(file), "--out", str(out), "--quiet", *more]) == 0
    with np.load(out / "simulation.npz") as found:
        return dict(found)


def refused(capsys: pytest.CaptureFixture[str], folder: Path, file: Path, *more: str) -> str:
    """The message of a wrong input, after which nothing is there."""
    out = folder / "refused"
    assert main(["simulate", str(folder / "run"), "--command", str(file), "--out", str(out), "--quiet", *more]) == 2
    assert not out.exists()
    return capsys.readouterr().err


def in_mujoco(file: Path, command: np.ndarray, start: tuple[float, ...] = (0.0, 0.0)) -> np.ndarray:
    """Positions before each step of MuJoCo C with the exported `robot.xml`."""
    model = mujoco.MjModel.from_xml_path(str(file))
    data, seen = mujoco.MjData(model), []
    data.qpos[:] = start
    for row in command:
        data.ctrl[:] = row
        seen.append(data.qpos.copy())
        mujoco.mj_step(model, data)
    return np.array(seen)


def test_a_recording_of_commands_moves_the_arm_as_mujoco_moves_it(tmp_path: Path):
    """Columns in another order than the drives, five steps to a row."""
    written(tmp_path)
    t = 0.01 * np.arange(300)
    u = 0.4 * np.sin(t[:, None] * [4.0, 7.0] + [0.0, 1.0])
    file = saved(tmp_path / "commands.csv", time=t + 17.0, cmd_b=u[:, 1], cmd_a=u[:, 0])
    found = ran(tmp_path, file)
    theirs = in_mujoco(tmp_path / "run" / "model" / "robot.xml", np.repeat(u, 5, 0))[::5]
    np.testing.assert_allclose(found["time"], t + 17.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found["position"], theirs, rtol=0, atol=1e-7)
    assert np.ptp(theirs, axis=0).min() > 0.3
    table = read_table(tmp_path / "out" / "simulation.csv", "motion")
    np.testing.assert_allclose(table.vector("q.j2", "q"), found["position"][:, 1], rtol=0, atol=1e-8)


@pytest.mark.parametrize("interpolate", [pytest.param(False, marks=pytest.mark.slow), True])
def test_set_points_at_uneven_times_are_held_or_joined_by_lines(interpolate: bool, tmp_path: Path):
    written(tmp_path)
    t, u = np.array([0.0, 0.5, 0.6, 1.7]), np.array([[0.0, 0.1], [0.5, -0.2], [0.1, 0.4], [-0.3, 0.0]])
    file = saved(tmp_path / "points.csv", t=t, j1=u[:, 0], j2=u[:, 1])
    found = ran(tmp_path, file, "--start", "j2=-0.3", *(["--interpolate"] if interpolate else []))
    now = 0.002 * np.arange(851)
    held = u[np.searchsorted(t, now + 1e-9, side="right") - 1]
    lines = np.column_stack([np.interp(now, t, column) for column in u.T])
    theirs = in_mujoco(tmp_path / "run" / "model" / "robot.xml", lines if interpolate else held, (0.0, -0.3))
    np.testing.assert_allclose(found["position"], theirs, rtol=0, atol=1e-7)
    np.testing.assert_allclose(found["time"], now, rtol=0, atol=1e-9)


def test_rows_at_twenty_milliseconds_give_rows_at_the_same_instants(tmp_path: Path):
    """5 * .004 s is above .02 s by a rounding."""
    written(tmp_path, TWO.replace('timestep="0.002"', 'timestep="0.004"'))
    t = 5 * 0.004 * np.arange(30)
    found = ran(tmp_path, saved(tmp_path / "commands.csv", time=t, a=0.2 * np.sin(t), b=0.0 * t))
    np.testing.assert_allclose(found["time"], t, rtol=0, atol=1e-9)


def test_a_recording_starts_where_it_started_and_is_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """As the held-out predictions of a run are: the same function gives the same motion, and its error is told."""
    loop = written(tmp_path, numbers=NUMBERS["all"])
    t = 0.01 * np.arange(260)
    u = 0.4 * np.sin(t[:, None] * [4.0, 7.0] + [0.0, 1.0])
    with jax.enable_x64(True):
        seen = np.asarray(fj.rollout(loop, np.repeat(u, 5, 0), np.array([0.1, -0.2])).reading)[::5] + 0.002
    t, u, seen = t[60:], u[60:], seen[60:]  # on the move
    names = [("cmd_j1", u[:, 0]), ("cmd_j2", u[:, 1]), ("pos_j1", seen[:, 0]), ("pos_j2", seen[:, 1])]
    file = saved(tmp_path / "recording.csv", time=t, **dict(names))
    found = ran(tmp_path, file, "--json")
    answer = json.loads(capsys.readouterr().out)
    matches("simulate", answer)
    wanted = simulated(loop, Run("recording", t, u, seen, None))
    np.testing.assert_allclose(found["reading"], wanted, rtol=0, atol=1e-9)
    assert np.abs(found["reading"] - seen).max() < 0.01  # the start is found, and the command holds it near
    error = np.sqrt(np.mean((wanted - seen) ** 2, axis=0))
    np.testing.assert_allclose([answer["error"][j]["rms"] for j in ("j1", "j2")], error, rtol=1e-6)


@pytest.mark.parametrize("text", [TWO, STIRRED])
def test_every_number_of_a_loop_is_read_back(text: str, tmp_path: Path):
    loop = written(tmp_path, text, NUMBERS["friction"] | NUMBERS["torques"])
    again = fj.read_loop(tmp_path / "run" / "model")
    for part in ("joints", "drives"):
        for name, value in vars(getattr(loop, part)).items():
            if name in ("names", "activation", "early"):
                assert getattr(getattr(again, part), name) == value, name
            else:
                np.testing.assert_array_equal(getattr(getattr(again, part), name), value, err_msg=name)
    assert (again.dt, again.integrator, again.law, again.limited) == (loop.dt, loop.integrator, loop.law, loop.limited)
    np.testing.assert_allclose(again.robot.inertia, loop.robot.inertia, rtol=0, atol=1e-12)


def test_a_file_tells_the_motors_of_joints_with_a_spring_behind_them(tmp_path: Path):
    """Where its positions start, and how far the motion is from them; the twist of the spring is no column of it."""
    (tmp_path / "arm.xml").write_text(TWO)
    loop = elastic_loop(fj.load_loop(tmp_path / "arm.xml")[0], 1, 60.0, 0.2)
    fj.write_loop(loop, tmp_path / "model")
    t = 0.002 * np.arange(300)
    u = 0.3 * np.sin(t[:, None] * [5.0, 9.0])
    truth = np.asarray(fj.rollout(loop, u, np.zeros(3)).position)
    np.savez(tmp_path / "run.npz", t=t, u=u, q=truth[:, :2])
    words = ["simulate", str(tmp_path / "model"), "--command", str(tmp_path / "run.npz"), "--columns", "u"]
    assert main([*words, "--out", str(tmp_path / "out"), "--quiet"]) == 0
    with np.load(tmp_path / "out" / "simulation.npz") as found:
        assert np.abs(found["position"] - truth).max() < 1e-3 < np.ptp(truth[:, 2])
    answer = json.loads((tmp_path / "out" / "simulation.json").read_text())
    assert answer["start"] == "the first rows of the file" and [*answer["error"]] == ["j1", "j2"]


def test_torques_move_a_damped_pendulum_as_its_equation_says(tmp_path: Path):
    """SciPy integrates the equation of motion; the model's steps of 1 ms are of first order."""
    (tmp_path / "pendulum.urdf").write_text(PENDULUM)
    with jax.enable_x64(True):
        robot = fj.load_urdf(tmp_path / "pendulum.urdf")
        damped = fj.extend(robot, fj.place(fj.CATALOGUE["viscous_friction"], robot, ["hinge"], damping=0.2))
        write_model(damped, tmp_path / "run" / "model")
    t = 0.005 * np.arange(400)
    file = saved(tmp_path / "torques.csv", t=t, tau=np.sin(3 * t), tau_cmd=5 * np.cos(t))
    found = ran(tmp_path, file, "--start", "hinge=0.7", "--interpolate")
    inertia, weight = 0.02 + 1.5 * 0.4**2, 1.5 * 9.81 * 0.4

    def law(time: float, x: np.ndarray) -> list[float]:
        return [x[1], (np.sin(3 * time) - weight * np.sin(x[0]) - 0.2 * x[1]) / inertia]

    wanted = solve_ivp(law, (0, t[-1]), [0.7, 0.0], t_eval=t, rtol=1e-9, atol=1e-9).y[0]
    np.testing.assert_allclose(found["position"][:, 0], wanted, rtol=0, atol=4e-3)
    assert np.ptp(wanted) > 0.8


def test_wrong_files_are_told_and_nothing_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    written(tmp_path)
    t, zero = 0.01 * np.arange(50), np.zeros(50)
    assert "no column looks like a command" in refused(capsys, tmp_path, saved(tmp_path / "1.csv", t=t, x=zero))
    one = saved(tmp_path / "2.csv", t=t, cmd=zero)
    assert "1 columns of a command (cmd), but the model has 2 drives: a, b" in refused(capsys, tmp_path, one)
    swapped = saved(tmp_path / "6.csv", t=t, second=zero, first=zero, cmd_vel_j1=zero, cmd_pos_j1=zero, cmd_j2=zero)
    assert "cmd_vel_j1 and cmd_pos_j1 look like commands of one" in refused(capsys, tmp_path, swapped)
    wide = saved(tmp_path / "7.csv", t=t, cmd_j1=40 + zero, cmd_j2=zero, pos_j1=zero, pos_j2=zero)
    assert "is it in degrees or counts" in refused(capsys, tmp_path, wide)
    few = saved(tmp_path / "8.csv", t=t, cmd_j1=zero, cmd_j2=zero, q1=zero, q2=zero, q3=zero)
    said = refused(capsys, tmp_path, few)
    assert "3 columns of position" in said and "--joints" not in said and "leave the positions out" in said
    untold = refused(capsys, tmp_path, saved(tmp_path / "9.csv", a=zero, b=zero))
    assert "give --rate HZ" in untold
    assert "a positive number" in refused(capsys, tmp_path, few, "--rate", "0")
    back = saved(tmp_path / "3.csv", t=np.where(np.arange(50) == 20, 0.1, t), cmd_a=zero, cmd_b=zero)
    assert "in row 20 (from 0)" in refused(capsys, tmp_path, back)
    assert "no column 'tau_x'" in refused(capsys, tmp_path, one, "--columns", "tau_x")
    good = saved(tmp_path / "4.csv", t=t, cmd_a=zero, cmd_b=zero)
    assert "not JOINT=VALUE" in refused(capsys, tmp_path, good, "--start", "j9=1")
    assert "does not exist" in refused(capsys, tmp_path, tmp_path / "none.csv")
    late = saved(tmp_path / "5.csv", t=t + 0.5 * (t > 0.3), cmd_a=zero, cmd_b=zero, pos_j1=zero, pos_j2=zero)
    assert "the time stamp jumps in row 31" in refused(capsys, tmp_path, late)
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "thesis.txt").write_text("mine")
    out = ["--out", str(tmp_path / "own"), "--quiet"]
    assert main(["simulate", str(tmp_path / "run"), "--command", str(good), *out]) == 2
    assert (tmp_path / "own" / "thesis.txt").read_text() == "mine"
    (tmp_path / "run" / "model" / "loop.json").write_text("{}")
    assert "the key 'joints' is missing" in refused(capsys, tmp_path, good)


def test_columns_that_are_stated_keep_their_order(tmp_path: Path):
    """`x2` drives the first joint as stated; numbers in the names do not count."""
    written(tmp_path)
    t = 0.01 * np.arange(50)
    u = 0.3 * np.sin(t[:, None] * [4.0, 7.0])
    file = saved(tmp_path / "stated.csv", t=t, x1=u[:, 1], x2=u[:, 0])
    found = ran(tmp_path, file, "--columns", "x2,x1")
    np.testing.assert_array_equal(found["command"], u)


def test_a_commanded_position_is_no_torque(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "pendulum.urdf").write_text(PENDULUM)
    with jax.enable_x64(True):
        write_model(fj.extend(fj.load_urdf(tmp_path / "pendulum.urdf")), tmp_path / "run" / "model")
    t = 0.01 * np.arange(50)
    assert "no column looks like a torque" in refused(capsys, tmp_path, saved(tmp_path / "1.csv", t=t, q_cmd=t))


def test_a_recording_in_milliseconds_is_one(tmp_path: Path):
    written(tmp_path)
    t, zero = 0.01 * np.arange(50), np.zeros(50)
    file = saved(tmp_path / "ms.csv", t=1e3 * t, cmd_j1=zero, cmd_j2=zero, pos_j1=zero, pos_j2=zero)
    np.testing.assert_allclose(ran(tmp_path, file)["time"], t, rtol=0, atol=1e-9)


def test_a_file_without_a_clock_has_the_rate_that_is_stated(tmp_path: Path):
    written(tmp_path)
    file = saved(tmp_path / "plain.csv", cmd_j1=np.zeros(50), cmd_j2=np.zeros(50))
    np.testing.assert_allclose(ran(tmp_path, file, "--rate", "200")["time"], 0.005 * np.arange(50), rtol=0, atol=1e-9)


def off_by(folder: Path, name: str, off: tuple[float, float], model: Path) -> Path:
    """A recording of what MuJoCo C does with this robot's file, with positions that are off by so much."""
    t = 0.002 * np.arange(600)
    u = 0.3 * np.sin(t[:, None] * [4.0, 7.0])
    q = in_mujoco(model / "robot.xml", u) + off
    return saved(folder / name, time=t, cmd_a=u[:, 0], cmd_b=u[:, 1], q_j1=q[:, 0], q_j2=q[:, 1])


def test_a_simulation_is_a_run_that_is_listed_repeated_and_compared(tmp_path: Path, capsys):
    """The distances on its page are those by which the recording was moved."""
    written(tmp_path)
    file = off_by(tmp_path, "recording.csv", (0.01, -0.03), tmp_path / "run" / "model")
    one = ran(tmp_path, file, "--start", "j1=0,j2=0", "--interpolate")
    page = (tmp_path / "out" / "report.html").read_text().replace("\N{NO-BREAK SPACE}", " ")
    assert "j2 is farthest from its measured position, 30 mrad RMS" in page and "figaroh-jax rerun" in page
    assert '<td class="n" data-value="0.0' in page
    assert main(["rerun", str(tmp_path / "out"), "--out", str(tmp_path / "again"), "--quiet"]) == 0
    with np.load(tmp_path / "again" / "simulation.npz") as arrays:
        np.testing.assert_array_equal(arrays["position"], one["position"])
    off = off_by(tmp_path, "other.csv", (0.05, 0.0), tmp_path / "run" / "model")
    words = ["simulate", str(tmp_path / "run"), "--command", str(off), "--start", "j1=0.1", "--quiet"]
    assert main([*words, "--out", str(tmp_path / "third")]) == 0
    capsys.readouterr()
    assert main(["list", str(tmp_path), "--json"]) == 0
    (section,) = json.loads(capsys.readouterr().out)
    assert [(Path(row[0]).name, row[1]) for row in section["rows"]] == [
        (name, "simulate") for name in ("again", "out", "third")
    ]
    runs = [str(tmp_path / name) for name in ("out", "again", "third")]
    assert main(["compare", *runs, "--json", "--out", str(tmp_path / "page.html")]) == 0
    answer = json.loads(capsys.readouterr().out)
    matches("compare", answer)
    tables = {section["title"]: {row[0]: row[1:] for row in section["rows"]} for section in answer}
    far = tables["RMS distance from the positions of the file"]
    assert [float(far[j][0].split()[0]) for j in ("j1", "j2")] == pytest.approx([0.01, 0.03], abs=2e-4)
    with np.load(tmp_path / "third" / "simulation.npz") as arrays:
        apart = np.sqrt(np.mean((arrays["position"] - one["position"]) ** 2, axis=0))
    between = tables["RMS distance from the first simulation (rad or m)"]
    assert between["j1"][1] == "0" and float(between["j1"][2]) == pytest.approx(apart[0], rel=1e-3)
    assert main(["compare", *runs, "--units", "a,a,b"]) == 2
    assert "simulations hold no parameters" in capsys.readouterr().err
    assert main(["compare", str(tmp_path / "out"), str(tmp_path / "run")]) == 2
    assert "simulations are compared with simulations" in capsys.readouterr().err
    assert main(["verify", str(tmp_path / "out")]) == 2
    assert "runs of diagnose, identify and calibrate are verified" in capsys.readouterr().err
    whole = (tmp_path / "third" / "simulation.npz").read_bytes()
    for part in (b"", whole[: len(whole) // 2]):
        (tmp_path / "third" / "simulation.npz").write_bytes(part)
        assert main(["compare", *runs]) == 2
        assert "simulation.npz: cannot be read" in capsys.readouterr().err
    (tmp_path / "run").rename(tmp_path / "moved")
    assert main(["rerun", str(tmp_path / "out")]) == 2
    assert "is not there any more" in capsys.readouterr().err


def test_the_view_plays_a_simulation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The joints stand where MuJoCo C has the bodies."""
    loop = written(tmp_path)
    t = 0.002 * np.arange(600)
    u = 0.3 * np.sin(t[:, None] * [4.0, 7.0])
    ran(tmp_path, saved(tmp_path / "commands.csv", time=t + 5.0, cmd_a=u[:, 0], cmd_b=u[:, 1]))
    monkeypatch.setitem(sys.modules, "viser", SimpleNamespace(ViserServer=Server))
    server: Any = show_simulation_run(tmp_path / "out", play=False)[0]
    server.controls["time, s"].value = 0.8
    server.controls["time, s"].calls[0]()
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "run" / "model" / "robot.xml"))
    data = mujoco.MjData(model)
    data.qpos[:] = in_mujoco(tmp_path / "run" / "model" / "robot.xml", u)[400]
    mujoco.mj_kinematics(model, data)
    places = [data.xanchor[model.joint(name).id] for name in loop.robot.dof_names]
    np.testing.assert_allclose(server.drawn["/robot"][0][0][:, 1], places, rtol=0, atol=1e-6)
    (tmp_path / "out" / "simulation.npz").write_bytes(b"")
    with pytest.raises(InputError, match="the simulation cannot be read"):
        show_simulation_run(tmp_path / "out")


def test_browser_draws_a_simulation_with_and_without_positions(tmp_path: Path):
    if browser.find() is None:
        pytest.skip("no Chromium on this machine")
    written(tmp_path)
    file = off_by(tmp_path, "recording.csv", (0.01, -0.03), tmp_path / "run" / "model")
    ran(tmp_path, file, "--start", "j1=0,j2=0")
    columns = read_table(file, "recording")
    few = {name: columns.vector(name, name) for name in ("time", "cmd_a", "cmd_b")}
    words = ["simulate", str(tmp_path / "run"), "--command", str(saved(tmp_path / "few.csv", **few))]
    assert main([*words, "--out", str(tmp_path / "bare"), "--quiet"]) == 0
    assert "which holds no positions to compare with" in (tmp_path / "bare" / "report.html").read_text()
    drawn = "document.querySelector('[data-joint=\"0\"] .plot').data"
    with browser.page(tmp_path / "profile") as tab:
        for folder, lines in (("out", ["measured", "simulated", "residual"]), ("bare", ["simulated"])):
            tab.open(tmp_path / folder / "report.html", 1100, 900)
            tab.wait(f"Boolean({drawn})")
            assert tab.value(f"{drawn}.map(line => line.name)") == lines
            assert tab.problems == []
            if folder == "out":
                residual = tab.value(f"{drawn}[2].y")
                np.testing.assert_allclose(residual, 0.01, rtol=0, atol=2e-4)
