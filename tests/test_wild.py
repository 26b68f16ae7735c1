"""Rows that no robot made are left out, and nothing else is: what is left is what a user had deleted by hand.

Recordings are those of `generators`, which share no code with the library; rows are drawn and spoiled at run time.
"""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from generators import make_case, make_closed_loop_case
from test_rollout_diagnosis import task as rollout_task

import figaroh_jax as fj
from figaroh_jax.cli import main
from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import load_task
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.checks import check_recordings
from figaroh_jax.recordings.dataset import Recording, read_recordings
from figaroh_jax.recordings.wild import bridged, lost_time, stopped_rows, wild_rows, without_wild_rows
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.rollouts.task import read_rollouts

sys.path.append(str(Path(__file__).resolve().parents[1]))

from benchmarks.wild_rows import KINDS

SEED = int.from_bytes(os.urandom(3), "little")  # told where a test fails
MANY = 8
FOUND = ["position", "lost", "torque"]  # wherever the arm is; a pulse of three times the largest torque as it moves


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[RobotModel, Recording]:
    case = make_case([("stribeck_friction", 0.15)], robot="small", repeats=1, trajectories=1, seed=SEED)
    task = load_task(case.write(tmp_path_factory.mktemp("case")))
    robot = load_robot(task)
    return robot, read_recordings(task, robot)[0]


def spoiled(one: Recording, kind: str, rows: np.ndarray) -> Recording:
    assert one.torque is not None
    position, torque, rng = one.position.copy(), one.torque.copy(), np.random.default_rng(SEED)
    for row in rows.tolist():
        KINDS[kind](position, torque, row, rng)
    return replace(one, position=position, torque=torque)


def drawn(one: Recording) -> np.ndarray:
    """Rows far enough from each other that what lies between them belongs to the motion."""
    places = np.arange(40, len(one.time) - 40, 25)
    return np.sort(np.random.default_rng(SEED).choice(places, MANY, replace=False))


@pytest.mark.parametrize("kind", FOUND)
def test_the_rows_that_were_spoiled_are_left_out_and_no_others(run: tuple[RobotModel, Recording], kind: str):
    robot, one = run
    rows = drawn(one)
    found = wild_rows(spoiled(one, kind, rows), robot)
    assert found is not None and np.flatnonzero(found.rows).tolist() == rows.tolist(), SEED
    assert found.text.startswith(f"{MANY} wild rows are left out: "), found.text
    less = without_wild_rows(spoiled(one, kind, rows), robot)
    for key in ("time", "position", "torque"):
        np.testing.assert_array_equal(getattr(less, key), np.delete(getattr(one, key), rows, axis=0))
    assert less.stamps is not None and len(less.stamps) == len(one.time)


def test_a_row_at_which_friction_turns_beside_a_lost_packet_stays(run: tuple[RobotModel, Recording]):
    robot, one = run
    assert one.torque is not None
    torque, row = one.torque.copy(), 800
    high = np.ptp(torque[:, 0])
    torque[row - 20 : row - 1, 0] = np.linspace(torque[row - 20, 0], 0.0, 19)
    torque[row - 1 : row + 20, 0] = np.linspace(high, torque[row + 20, 0], 21)  # it steps from zero by its range
    turned = replace(one, torque=torque)
    assert wild_rows(turned, robot) is None
    found = wild_rows(spoiled(turned, "lost", np.array([row])), robot)
    assert found is not None and np.flatnonzero(found.rows).tolist() == [row], SEED


def test_a_stretch_at_either_end_and_one_of_several_rows_are_left_out(run: tuple[RobotModel, Recording]):
    robot, one = run
    rng, rows = np.random.default_rng(SEED), np.r_[0:6, 400:407, len(one.time) - 3 : len(one.time)]
    position = one.position.copy()
    position[rows] += rng.uniform(2.0, 3.0, (len(rows), 1)) * rng.choice([-1, 1], position[rows].shape)
    found = wild_rows(replace(one, position=position), robot)
    assert found is not None and np.flatnonzero(found.rows).tolist() == rows.tolist(), SEED


def test_a_joint_that_jumps_and_stays_there_is_told_and_stays(run: tuple[RobotModel, Recording]):
    robot, one = run
    position = one.position.copy()
    position[len(position) // 2 :, 0] += 1.5
    jumped = replace(one, position=position)
    assert without_wild_rows(jumped, robot) is jumped
    try:
        said = "; ".join(check_recordings(None, robot, [jumped]))
    except InputError as error:  # where it leaves the joint's limits by far
        said = str(error)
    assert "jumps by" in said or "outside" in said or "limits" in said, (SEED, said)


def test_where_too_many_rows_are_wild_all_of_them_stay(run: tuple[RobotModel, Recording]):
    robot, one = run
    rows = np.arange(30, len(one.time) - 30, 20)
    assert len(rows) > 0.02 * len(one.time)
    assert wild_rows(spoiled(one, "torque", rows), robot) is None


@pytest.mark.parametrize(
    "effect",
    [
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("torque_saturation", "presliding")),
        *("backlash", "contact", "torque_ripple", None),
    ],
)
def test_right_recordings_have_no_wild_rows(effect: str | None, tmp_path: Path):
    case = make_case([(effect, 0.15)] if effect else [], robot="small", repeats=1, trajectories=2, seed=SEED)
    task = load_task(case.write(tmp_path))
    assert [one.wild for one in read_recordings(task, load_robot(task))] == ["", ""], SEED


def test_a_drive_that_sticks_at_reversals_has_no_wild_rows(tmp_path: Path):
    """MuJoCo C in closed loop: quantised encoders, noise of the current, dry friction that holds."""
    task = load_task(make_closed_loop_case([], robot="small", repeats=1, trajectories=2, seed=SEED).write(tmp_path))
    assert not any(one.wild for one in read_recordings(task, load_robot(task))), SEED


@pytest.mark.parametrize("stops", [False, True])
def test_a_pulse_of_the_torque_is_left_out_where_the_motion_goes_on(run: tuple[RobotModel, Recording], stops: bool):
    """Where the robot stops there it may be what has stopped it: it is told and stays."""
    robot, one = run
    assert one.torque is not None
    fast = int(np.argmax(np.linalg.norm(np.diff(one.position[200:-200], axis=0), axis=1)) + 200)
    position, torque = one.position.copy(), one.torque.copy()
    torque[fast, 1] += 1.2 * np.ptp(np.percentile(torque[:, 1], [1, 99]))
    if stops:
        position[fast:] = position[fast]
    alone = replace(one, position=position, torque=torque)
    found = without_wild_rows(alone, robot)
    told = "; ".join(check_recordings(None, robot, [found]))
    if stops:
        assert found is alone and f"in row {fast}" in told and "a sudden stop, or wild samples" in told, (SEED, told)
    else:
        assert "1 wild row is left out" in told and f"in row {fast}" in told, (SEED, told)


def test_rows_are_told_as_the_file_counts_them(run: tuple[RobotModel, Recording]):
    """Eight are left out before the one that is told."""
    robot, one = run
    rows = drawn(one)
    stop = int(rows[-1]) + 20
    wild = spoiled(one, "lost", rows)
    assert wild.torque is not None
    position, torque = wild.position.copy(), wild.torque.copy()
    torque[stop, 1] += 1.2 * np.ptp(np.percentile(torque[:, 1], [1, 99]))
    position[stop:] = position[stop]
    found = without_wild_rows(replace(wild, position=position, torque=torque), robot)
    assert len(found.time) == len(one.time) - MANY
    (told,) = [text for text in check_recordings(None, robot, [found]) if "a sudden stop" in text]
    assert f"in row {stop} " in told, (SEED, told)


@pytest.mark.parametrize("kind", [pytest.param(kind, marks=[pytest.mark.slow] * (kind != "lost")) for kind in FOUND])
def test_a_fit_is_that_of_the_recording_without_these_rows(kind: str, tmp_path: Path):
    case = make_case([], robot="small", repeats=1, trajectories=2, seed=SEED)
    paths = [case.write(tmp_path / name) for name in ("spoiled", "by_hand")]
    files = sorted(path.name for path in paths[0].parent.glob("*.npz"))
    for name in files:
        arrays = dict(np.load(paths[0].parent / name))
        rows = np.sort(np.random.default_rng(SEED).choice(np.arange(40, 900, 25), MANY, replace=False))
        shorter = {key: np.delete(values, rows, axis=0) for key, values in arrays.items()}
        np.savez(paths[1].parent / name, **shorter)  # pyright: ignore[reportArgumentType]
        rng = np.random.default_rng(SEED)
        for row in rows.tolist():
            KINDS[kind](arrays["q"], arrays["tau"], row, rng)
        np.savez(paths[0].parent / name, **arrays)  # pyright: ignore[reportArgumentType]
    found, clean = (fj.identify_task(load_task(path)) for path in paths)
    told = " ".join(note for note in found.notes if "wild rows are left out" in note)
    assert all(name in told for name in files), (SEED, found.notes)
    assert not any("wild rows are left out" in note for note in clean.notes)
    np.testing.assert_array_equal([one.value for one in found.base], [one.value for one in clean.base])


def test_predictions_are_on_all_stamps_of_the_file(tmp_path: Path):
    case = make_case([], robot="small", repeats=1, trajectories=2, seed=SEED)
    path = case.write(tmp_path)
    written = json.loads(path.read_text())
    written["data"][1]["role"] = "holdout"
    path.write_text(json.dumps(written))
    file = tmp_path / written["data"][1]["file"]
    arrays = dict(np.load(file))
    arrays["q"][500] += 2.5
    np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
    out = tmp_path / "run"
    assert main(["identify", str(path), "--out", str(out), "--quiet"]) == 0
    told = np.load(out / "predictions.npz")
    np.testing.assert_allclose(told[f"{file.stem}_time"], arrays["t"], rtol=0, atol=1e-9)
    left = told[f"{file.stem}_torque"] - arrays["tau"]
    assert np.abs(left[490:511]).max() < 1.2 * np.abs(left).max() and np.isfinite(left).all()
    assert np.sqrt(np.mean(left**2)) < 0.1 * np.sqrt(np.mean(arrays["tau"] ** 2))


def test_a_rollout_keeps_its_rows_and_commands(tmp_path: Path):
    """Wild positions count for nothing, and the command there stands; through a lost packet it holds."""
    path = rollout_task(tmp_path, "none")
    arrays = dict(np.load(tmp_path / "seen.npz"))
    spoilt = {key: values.copy() for key, values in arrays.items()}
    spoilt["q"][300] += 2.0
    np.savez(tmp_path / "seen.npz", **spoilt)  # pyright: ignore[reportArgumentType]
    _, (run, other), notes = read_rollouts(load_task(path))
    assert other.trusted is None and run.trusted is not None
    assert np.flatnonzero(~run.trusted).tolist() == [300] and len(run.time) == len(arrays["t"])
    np.testing.assert_array_equal(run.command.ravel(), arrays["u"].ravel())
    halfway = arrays["q"][[299, 301]].mean()
    assert float(run.position[300, 0]) == pytest.approx(float(halfway), rel=0, abs=1e-12)
    assert any("1 wild row is left out" in note for note in notes)


def test_the_command_holds_through_a_lost_packet(run: tuple[RobotModel, Recording]):
    robot, one = run
    rows, ramp = drawn(one), np.tile(np.arange(len(one.time), dtype=float)[:, None], one.position.shape[1])
    found = bridged(replace(spoiled(one, "lost", rows), command=ramp), robot)
    assert found.command is not None and found.trusted is not None
    np.testing.assert_array_equal(found.command[rows], ramp[rows - 1])
    np.testing.assert_array_equal(np.flatnonzero(~found.trusted.any(axis=1)), rows)
    np.testing.assert_allclose(found.position[rows], (one.position[rows - 1] + one.position[rows + 1]) / 2, atol=1e-12)


@pytest.mark.parametrize("alone", [False, True])
def test_a_stream_that_stops_is_left_out(run: tuple[RobotModel, Recording], alone: bool):
    """Positions and torques, or torques alone, repeat for 40 rows while the arm moves on."""
    robot, one = run
    assert one.torque is not None
    fast = np.argmax(np.abs(np.diff(one.position[200:-200], axis=0)).max(axis=1)) + 180
    position, torque = one.position.copy(), one.torque.copy()
    torque[fast + 1 : fast + 41] = torque[fast]
    if not alone:
        position[fast + 1 : fast + 41] = position[fast]
    found = wild_rows(replace(one, position=position, torque=torque), robot)
    assert found is not None and np.flatnonzero(found.rows).tolist() == list(range(fast + 1, fast + 41)), SEED
    assert f"a stream stops in row {fast + 1}" in found.text


def test_a_robot_that_rests_has_no_stream_that_stops(run: tuple[RobotModel, Recording]):
    """It slows down, stands for .4 s with every reading the same, and starts again at half its speed."""
    robot, one = run
    assert one.torque is not None
    t = one.time
    clock = t - np.interp(t, [4.0, 4.4, 4.8, 5.2, t[-1]], [0.0, 0.2, 0.6, 0.8, 0.8])
    rest = np.flatnonzero((t > 4.4) & (t < 4.8))
    clock[rest] = clock[rest[0]]
    position, torque = (np.stack([np.interp(clock, t, x) for x in xs.T], axis=1) for xs in (one.position, one.torque))
    assert len(rest) > 80 and (np.diff(position[rest], axis=0) == 0).all()
    assert wild_rows(replace(one, position=position, torque=torque), robot) is None, SEED


def test_a_log_faster_than_its_stream_has_none_that_stops(run: tuple[RobotModel, Recording]):
    _, one = run
    assert one.torque is not None
    rows = np.arange(len(one.time)) // 5 * 5
    assert not stopped_rows(one.position[rows], one.torque[rows]).any()


def test_rows_that_lack_under_even_stamps_are_given_their_time(run: tuple[RobotModel, Recording]):
    robot, one = run
    assert one.torque is not None
    fast = int(np.argmax(np.abs(np.diff(one.position[200:-200], axis=0)).max(axis=1)) + 190)
    rows = np.r_[fast : fast + 20]
    position, torque = (np.delete(x, rows, axis=0) for x in (one.position, one.torque))
    lacking = replace(one, time=one.time[:-20], position=position, torque=torque)
    found = without_wild_rows(lacking, robot)
    assert f"rows lack before row {fast} " in found.wild, (SEED, found.wild)
    period = one.time[1] - one.time[0]
    np.testing.assert_allclose(found.time, np.delete(one.time, rows), rtol=0, atol=3 * period)
    assert found.stamps is not None and found.clock is not None
    np.testing.assert_array_equal(found.stamps, one.time[:-20])
    even = np.delete(one.time, rows)
    assert lost_time(position, even)[0] is even  # where the stamps tell it, nothing is moved


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*FOUND, "stopped", "held"])
def test_a_real_robot_is_told_what_it_is_told_of_where_these_rows_are_deleted_by_hand(kind: str, data_dir: Path):
    """A UR10e, each of three recordings with eight wild rows, or three places where the stream stops as it moves.

    Of its ten causes four, seven, one, three and eight were left in such recordings before.
    """
    from benchmarks.hide_in_real.recordings import SETS
    from benchmarks.wild_rows import answer_on

    real, rng = SETS["ur10e"](), np.random.default_rng(SEED)
    spoilt, by_hand = [], []
    for one in real.recordings:
        arrays = {key: values.copy() for key, values in one.arrays.items()}
        position, torque = (arrays[one.entry[key]] for key in ("position", "torque"))
        if kind in FOUND:
            rows = np.sort(rng.choice(np.arange(50, len(one.time) - 50, 25), MANY, replace=False))
            for row in rows.tolist():
                KINDS[kind](position, torque, row, rng)
        else:
            way = np.abs(position[30:] - position[:-30]) / np.percentile(np.abs(np.diff(position, axis=0)), 98, axis=0)
            fast = np.flatnonzero(way.max(axis=1) > 15)  # half of the top speed, over 30 rows
            firsts = [rng.choice(part[part > 50]) for part in np.array_split(fast[fast < len(one.time) - 100], 3)]
            rows = np.concatenate([first + np.arange(1, 26) for first in firsts])
            for first in firsts:
                torque[first + 1 : first + 26] = torque[first]
                if kind == "stopped":
                    position[first + 1 : first + 26] = position[first]
        spoilt.append(replace(one, arrays=arrays))
        deleted = {key: np.delete(values, rows, axis=0) for key, values in one.arrays.items()}
        by_hand.append(replace(one, arrays=deleted))
    found, clean = (answer_on(replace(real, recordings=tuple(each))) for each in (spoilt, by_hand))
    names, told = ([(c["effect"], *c["at"]) for c in one["causes"]] for one in (clean, found))
    assert names and told == names, SEED
    for key in ("before", "after"):
        assert found["holdout"][key] == pytest.approx(clean["holdout"][key], rel=0, abs=1e-9), SEED


@pytest.mark.slow
def test_what_real_recordings_have_of_it(data_dir: Path, tmp_path: Path):
    """In the Panda's alone a stream stops: three and four rows repeat, and the next step makes up for them."""
    from benchmarks.hide_in_real.recordings import SETS

    for name, real in SETS.items():
        made = real()
        (tmp_path / f"{name}.urdf").write_text(made.urdf)
        robot = fj.load_urdf(tmp_path / f"{name}.urdf", joints=list(made.joints))
        for one in made.recordings:
            read = Recording(one.name, Path(one.name), robot.dof_names, one.time, one.position, torque=one.torque)
            found = without_wild_rows(read, robot)
            assert ("a stream stops in row" in found.wild) if name == "panda" else found is read, (name, one.name)
