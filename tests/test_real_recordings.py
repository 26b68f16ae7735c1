"""Invariants of a diagnosis on recordings of real robots: it predicts what was kept out no worse than `identify`.

Which effects a real robot has nobody knows; what its model predicts of motion that it was not fitted to is measured.
"""

from __future__ import annotations

import re
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from figaroh_jax.diagnosis.diagnosis import diagnose_task
from figaroh_jax.formats.config import load_task
from figaroh_jax.identification.identification import identify_task
from figaroh_jax.results import Diagnosis, Name

pytest.importorskip("pinocchio")  # the sets are written with it
sys.path.append(str(Path(__file__).resolve().parents[1]))

from benchmarks import blackbox
from benchmarks.hide_in_real.generate import twin_of

SETS = {  # the relative error that causes leave at most, with what it was when this was written
    "ur10e": 0.048,  # .0465; .0468 without the pan's rotor, .0488 without the shoulder's
    "panda": 0.0118,  # .0114
    "tiago": 0.1295,  # .1283
    "kuka": 0.0300,  # .0272
    "dfki_simple_pendulum": 0.470,  # .4651
    "dfki_double_pendulum": 0.283,  # .2792
}
VERDICTS = {"panda": "unknown"}  # 16 % of a torque are left, and what is refused predicts what was kept out
# All joints of a UR10e turn rotors behind gears of 100:1, which its URDF does not have; drives come in three sizes.
DRIVES = {"ur10e": (("shoulder_pan", "shoulder_lift"), ("elbow",), ("wrist_1", "wrist_2", "wrist_3"))}
EXPLAINED = {"kuka": (0.58, 0.999, 0.96, 0.986, 0.37)}  # R2 of each of the first joints, kept out, at least


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_the_error_on_recordings_kept_out_is_no_larger_than_that_of_identify(
    name: str, data_dir: Path, tmp_path: Path
) -> None:
    from benchmarks.hide_in_real.recordings import SETS as REAL

    cases, run = tmp_path / "cases", tmp_path / "run"
    run.mkdir()
    task = load_task(blackbox.write_task(cases, run, twin_of(cases, REAL[name]())))
    found, plain = diagnose_task(task), identify_task(task)
    rms = [np.asarray(kept.rms) for kept in plain.holdout.values()]
    torque = [np.asarray(kept.rms) / np.asarray(kept.relative) for kept in plain.holdout.values()]
    identified = np.sqrt(sum((r**2).sum() for r in rms) / sum((t**2).sum() for t in torque))
    assert found.verdict == VERDICTS.get(name, found.verdict)
    causes = {cause.name: cause for cause in found.causes}
    for alike in DRIVES.get(name, ()):
        rotors = [causes[Name("rotor_inertia", (f"{joint}_joint",))] for joint in alike]
        assert min(one.confidence for one in rotors) > 0.5
        sizes = [one.parameters["inertia"] for one in rotors]
        for one, other in combinations(sizes, 2):  # drives of one size have one rotor
            assert abs(one.value - other.value) <= 1.96 * np.hypot(one.std, other.std)
    assert found.holdout.after <= found.holdout.before
    assert found.holdout.after <= identified
    assert found.holdout.after <= SETS[name]
    kept = [trace for trace in found.traces if trace.role == "holdout" and trace.measured is not None]
    measured, after = (np.concatenate([getattr(trace, key) for trace in kept]) for key in ("measured", "after"))
    explained = 1 - ((measured - after) ** 2).sum(0) / ((measured - measured.mean(0)) ** 2).sum(0)
    goals = EXPLAINED.get(name, ())
    assert np.all(explained[: len(goals)] >= goals), explained


@pytest.mark.slow
def test_every_cause_that_the_search_found_is_named_or_told_with_the_reason_why_not(
    data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A double pendulum, of which a scale of an encoder is found first and made needless by what comes in behind it."""
    from benchmarks.hide_in_real.recordings import SETS as REAL
    from figaroh_jax.diagnosis import causes

    found_by, find = [], causes.find_causes
    monkeypatch.setattr(causes, "find_causes", lambda *a, **more: found_by.append(find(*a, **more)) or found_by[-1])
    cases, run = tmp_path / "cases", tmp_path / "run"
    run.mkdir()
    task = load_task(blackbox.write_task(cases, run, twin_of(cases, REAL["dfki_double_pendulum"]())))
    answer = diagnose_task(task)
    told = {cause.name for cause in answer.causes} | {near.name for near in answer.rest.nearest}
    # of the searches after the first the one that is answered with: another may have been tried and lost
    assert any(search.found and {one.name for one in search.found} <= told for search in found_by[1:])
    like_a_rest = {one.name for search in found_by for one in search.found if one.effect.name == "presliding"}
    assert like_a_rest and like_a_rest <= told  # the search had been taken up again without it, and it was not told
    assert all(near.why_not for near in answer.rest.nearest)


@pytest.mark.slow
def test_a_spring_that_a_recording_kept_out_shows_is_no_slow_noise(data_dir: Path, tmp_path: Path) -> None:
    """15 s of a Panda, which show slow noise as readily as a spring; the 6 s kept out tell these apart."""
    from benchmarks.hide_in_real.recordings import SETS as REAL

    cases, run = tmp_path / "cases", tmp_path / "run"
    run.mkdir()
    stiffness, at_rest = np.random.default_rng().uniform((0.6, -1.0), (0.8, 1.0))
    path = blackbox.write_task(cases, run, twin_of(cases, REAL["panda"]()))
    for file in run.glob("*.npz"):
        with np.load(file) as read:
            arrays = dict(read)
        arrays["tau"][:, 0] += stiffness * (arrays["q"][:, 0] - at_rest)
        np.savez(file, **arrays)
    found = diagnose_task(load_task(path))
    (spring,) = [c for c in found.causes if c.name.effect == "joint_spring" and c.name.at == ("panda_joint1",)]
    assert spring.parameters["stiffness"].value == pytest.approx(stiffness, rel=0.15)


@pytest.mark.slow
def test_a_spring_that_the_second_of_two_runs_has_alone_is_no_noise(data_dir: Path, tmp_path: Path) -> None:
    """A KUKA's two runs of one motion, as they were recorded and with a spring at the third joint in the second."""
    from benchmarks.hide_in_real.recordings import SETS as REAL

    cases, run = tmp_path / "cases", tmp_path / "run"
    run.mkdir()
    path = blackbox.write_task(cases, run, twin_of(cases, REAL["kuka"]()))
    plain = diagnose_task(load_task(path))
    (second,) = run.glob("*measurements_2*.npz")
    with np.load(second) as read:
        arrays = dict(read)
    moved, torque = arrays["q"][:, 2] - arrays["q"][:, 2].mean(), arrays["tau"][:, 2]
    arrays["tau"][:, 2] = torque + np.random.default_rng().uniform(0.15, 0.25) * torque.std() * moved / moved.std()
    np.savez(second, **arrays)
    changed = diagnose_task(load_task(path))
    assert not any("another one" in note for note in plain.notes)
    assert any("the torque of lwr_2_joint is another one" in note for note in changed.notes), changed.notes
    assert changed.verdict in ("unknown", "named+rest")
    assert "the torque of lwr_2_joint is another one" in changed.rest.text


@pytest.mark.slow
def test_a_zero_that_the_second_of_two_runs_has_alone_is_told(data_dir: Path, tmp_path: Path) -> None:
    """A KUKA's two runs, the torque of the fourth joint zeroed anew for the second: told, and no other name for it."""
    from benchmarks.hide_in_real.recordings import SETS as REAL

    cases, run = tmp_path / "cases", tmp_path / "run"
    run.mkdir()
    path = blackbox.write_task(cases, run, twin_of(cases, REAL["kuka"]()))
    (second,) = run.glob("*measurements_2*.npz")
    with np.load(second) as read:
        arrays = dict(read)
    by = np.random.default_rng().uniform(0.15, 0.25) * arrays["tau"][:, 3].std()
    arrays["tau"][:, 3] += by
    np.savez(second, **arrays)
    found = diagnose_task(load_task(path))
    (note,) = [note for note in found.notes if "does not have one constant" in note]
    assert note.startswith("the torque of lwr_3_joint") and found.verdict in ("unknown", "named+rest")
    (low, half), (high, _) = [map(float, x) for x in re.findall(r"([+-][\d.e-]+) \+- ([\d.e-]+) N m", note)]
    assert high - low == pytest.approx(by, abs=2 * half + 0.1 * by)
    at = {(c.name.effect, c.name.at) for c in found.causes if "lwr_3_joint" in c.name.at}
    assert at <= {("torque_offset", ("lwr_3_joint",))}


@pytest.mark.slow
def test_a_ripple_of_many_periods_is_found_beside_a_slow_misfit_of_its_joint(data_dir: Path, tmp_path: Path) -> None:
    """A KUKA's last joint, where a ripple so slow that the motion shows no period of it explains more."""
    from benchmarks.hide_in_real.recordings import SETS as REAL

    cases, run = tmp_path / "cases", tmp_path / "run"
    run.mkdir()
    order, phase = np.random.default_rng().uniform((18.0, -np.pi), (22.5, np.pi))
    path = blackbox.write_task(cases, run, twin_of(cases, REAL["kuka"]()))
    for file in run.glob("*.npz"):
        with np.load(file) as read:
            arrays = dict(read)
        arrays["tau"][:, 6] += 0.2 * np.sin(order * arrays["q"][:, 6] + phase)
        np.savez(file, **arrays)
    found = diagnose_task(load_task(path))
    (ripple,) = [c for c in found.causes if c.name.effect == "torque_ripple" and c.name.at == ("lwr_6_joint",)]
    assert ripple.parameters["order"].value == pytest.approx(order, abs=0.6)


def hidden_in(
    folder: Path, robot: str, effect: str, seed: int, forbid: bool = False, size: float = 0.2
) -> tuple[Diagnosis, dict]:
    """The answer to a case of `benchmarks.hide_in_real`, and what was hidden."""
    from benchmarks.hide_in_real.generate import generate

    run = folder / "run"
    run.mkdir()
    generate(folder, seed, [robot], [effect], [size])
    case = blackbox.load_cases(folder)[f"{robot}/{effect}-{100 * size:.0f}"]
    found = diagnose_task(load_task(blackbox.write_task(folder, run, case, case["forbid"] if forbid else ())))
    assert isinstance(found, Diagnosis)
    return found, case["truth"][0]


@pytest.mark.slow
@pytest.mark.parametrize("robot, seed", [("tiago", 1004121), ("panda", 1002121)])
def test_a_coupling_is_named_though_links_that_move_with_it_predict_large_joints_worse(
    robot: str, seed: int, data_dir: Path, tmp_path: Path
) -> None:
    """It takes .4 of what is kept out at its joints; in N m those of the shoulder lost more than that, by chance."""
    found, truth = hidden_in(tmp_path, robot, "coupled_transmission", seed)
    (coupling,) = [c for c in found.causes if c.name == Name(truth["effect"], tuple(truth["at"]))]
    for name, told in coupling.parameters.items():
        assert abs(told.value - truth["parameters"][name]) <= 2.5 * told.std, name
    assert found.holdout.after < found.holdout.before
    if robot == "panda":  # TIAGo's links predict its large joints no worse since rows at rest are not judged
        assert any("links of the extended model" in note for note in found.notes)


@pytest.mark.slow
def test_a_tilt_that_is_seldom_the_best_is_no_stand_in_for_a_spring(data_dir: Path, tmp_path: Path) -> None:
    """In one of 17 draws of the blocks it predicted best of what could be named in its place."""
    found, _ = hidden_in(tmp_path, "tiago", "joint_spring", 1005121, forbid=True)
    assert "gravity_tilt" not in [cause.name.effect for cause in found.causes]


@pytest.mark.slow
def test_a_joint_that_slow_rows_leave_most_of_counts_by_its_fast_rows(data_dir: Path, tmp_path: Path) -> None:
    """A KUKA's joints stick: slow rows were weighted down, and each joint once more by what it leaves in them."""
    found, truth = hidden_in(tmp_path, "kuka", "rotor_inertia", 1005121, size=0.1)
    assert tuple(truth["at"]) == ("lwr_2_joint",)
    (rotor,) = [c for c in found.causes if c.name == Name("rotor_inertia", ("lwr_2_joint",))]
    told = rotor.parameters["inertia"]
    assert abs(told.value - truth["parameters"]["inertia"]) <= 2.5 * told.std
    assert found.holdout.after < 0.058  # .061 before


@pytest.mark.slow
def test_what_was_found_beside_presliding_is_kept_where_that_predicts_better(data_dir: Path, tmp_path: Path) -> None:
    """A KUKA's joints stick, so that presliding comes in; the search without it came by other causes to a dead end.

    The rotor is about the base's vertical axis: to every torque it is the same as the first link's moment.
    """
    found, truth = hidden_in(tmp_path, "kuka", "rotor_inertia", 1010121)
    assert tuple(truth["at"]) == ("lwr_0_joint",)
    (rotor,) = [c for c in found.causes if c.name == Name("rotor_inertia", ("lwr_0_joint",))]
    told = rotor.parameters["inertia"]
    assert abs(told.value - truth["parameters"]["inertia"]) <= 2.5 * told.std
    assert found.holdout.after < 0.6 * found.holdout.before


@pytest.mark.slow
def test_a_drive_s_limit_is_not_lost_as_all_causes_are_put_in_at_once(data_dir: Path, tmp_path: Path) -> None:
    """What a KUKA's fifth joint is cut to depends on a coupling beside it, as large as it was before or after."""
    found, truth = hidden_in(tmp_path, "kuka", "torque_saturation", 997321)
    assert tuple(truth["at"]) == ("lwr_5_joint",)
    (limit,) = [c for c in found.causes if c.name == Name("torque_saturation", ("lwr_5_joint",))]
    assert limit.parameters["limit"].value == pytest.approx(truth["parameters"]["limit"], rel=0.05)


@pytest.mark.slow
def test_a_law_that_a_rival_outdid_in_slices_is_named_where_recordings_kept_out_reject_the_rival(
    data_dir: Path, tmp_path: Path
) -> None:
    """A KUKA's tilt, in whose place a force at the tip followed more of the misfits that were still to be found.

    Without the tilt's name the springs had none, and the limit was lost as the error on held-out data rose.
    """
    found, truth = hidden_in(tmp_path, "kuka", "torque_saturation", 1131201)
    assert tuple(truth["at"]) == ("lwr_2_joint",)
    (limit,) = [c for c in found.causes if c.name == Name("torque_saturation", ("lwr_2_joint",))]
    assert limit.parameters["limit"].value == pytest.approx(truth["parameters"]["limit"], rel=0.05)
    named = {c.name for c in found.causes}
    assert named >= {Name("gravity_tilt", ()), Name("joint_spring", ("lwr_6_joint",))}  # what its twin has
    assert found.holdout.after < 0.6 * found.holdout.before


@pytest.mark.slow
def test_a_coupling_of_inertia_alone_is_no_stand_in_for_a_tilt(data_dir: Path, tmp_path: Path) -> None:
    """Its inertia was surely there, its damping and friction were below zero."""
    found, _ = hidden_in(tmp_path, "panda", "gravity_tilt", 1009121, forbid=True)
    assert "coupled_transmission" not in [cause.name.effect for cause in found.causes]


@pytest.mark.slow
def test_recordings_of_one_robot_that_have_nothing_in_common_tell_the_same_of_it(
    data_dir: Path, tmp_path: Path
) -> None:
    """A UR10e in four groups of three recordings: friction by load and the rotors of its drives, each of one size."""
    from benchmarks import same_robot

    told = [same_robot.answered("ur10e", k, task, tmp_path) for k, task in enumerate(same_robot.ur10e())]
    sizes = [
        {(c["effect"], *c["at"]): next(iter(c["parameters"].values())) for c in answer["causes"]} for answer in told
    ]
    common = set.intersection(*map(set, sizes))
    for cause in common:
        for one, other in combinations([own[cause] for own in sizes], 2):
            assert abs(one["value"] - other["value"]) <= 2.5 * np.hypot(one["std"], other["std"]), cause
    drives = {
        ("rotor_inertia", f"{joint}_joint") for joint in ("shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    }
    loads = {("load_dependent_friction", f"{joint}_joint") for joint in ("shoulder_lift", "elbow")}
    assert common >= drives | loads
    assert all(("rotor_inertia", "shoulder_pan_joint") in own for own in sizes[:3])
    seen = {cause[0] for own in sizes for cause in own}
    assert seen <= {"rotor_inertia", "load_dependent_friction", "power_law_friction", "torque_gain"}
