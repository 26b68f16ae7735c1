"""Identification from end to end: simulated truth, files in and out, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import simulated_arm
import tasks
from schema import matches
from simulated_arm import Truth, recording

import figaroh_jax as fj
from figaroh_jax import cli
from figaroh_jax.errors import InputError
from figaroh_jax.estimation import regression as regression_module
from figaroh_jax.estimation.base_parameters import base_parameters
from figaroh_jax.estimation.columns import friction_terms
from figaroh_jax.estimation.regression import Regression, condense
from figaroh_jax.formats.config import Baseline, Load, Preprocess
from figaroh_jax.identification import identification
from figaroh_jax.identification.result import Identification, to_json
from figaroh_jax.recordings.signals import prepare_all
from figaroh_jax.simulators.native import NativeBackend

identify = partial(identification.identify, check=False)  # of arms that no check would let pass

SETTINGS = Preprocess(cutoff=10)


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    return simulated_arm.arm(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def found(truth: Truth) -> Identification:
    held = recording(truth, 10.0, seed=7, role="holdout", name="other")
    return identify(truth.nominal, [recording(truth, seed=1), held], SETTINGS)


def test_held_out_torque_is_predicted_to_the_noise(found: Identification):
    passed = np.sqrt(2 * 10.0 / simulated_arm.RATE)  # of white noise, by a low pass at 10 Hz
    assert (found.holdout["other.npz"].rms < 1.3 * passed * simulated_arm.TORQUE_NOISE).all()
    assert (found.holdout["other.npz"].r2 > 0.99).all()


def test_base_parameters_are_the_truth_within_their_intervals(truth: Truth, found: Identification):
    base = _base(truth)
    assert [one.expression for one in found.base] == list(base.expressions)
    value, std = (np.array([getattr(one, key) for one in found.base]) for key in ("value", "std"))
    score = (value - base.matrix @ truth.theta) / std
    assert np.abs(score).max() < 4.5 and np.sqrt(np.mean(score**2)) < 1.6


def test_friction_is_named_with_its_truth(found: Identification):
    values = {(e.name.effect, e.name.at[0]): next(iter(e.parameters.values())) for e in found.effects}
    for j, joint in enumerate(tasks.JOINTS):
        for effect, true in (("viscous_friction", simulated_arm.VISCOUS), ("coulomb_friction", simulated_arm.COULOMB)):
            estimate = values[effect, joint]
            assert abs(estimate.value - true[j]) < max(5 * estimate.std, 0.06 * true[j])
    assert values["viscous_friction", "slide"].unit.startswith("N s")


def test_every_link_can_exist_and_the_rank_is_the_structural_one(found: Identification):
    assert all(link.consistent for link in found.links)
    assert found.rank == found.structural_rank
    assert {one.status for one in found.base} <= {"identified", "prior only", "on its bound"}
    assert any(p.status == "prior only" and p.absorbed_in for p in found.parameters)


def test_an_identification_is_a_view_of_its_fit(truth: Truth, found: Identification):
    fit, each = found.solution, [(p.value, p.std) for p in found.parameters]
    start = np.zeros(len(each))
    start[: 10 * len(found.links)] = np.asarray(truth.nominal.inertia).reshape(-1)
    np.testing.assert_allclose(fit.values + start, [value for value, _ in each], rtol=0, atol=1e-12)
    np.testing.assert_allclose(fit.std, [std for _, std in each], rtol=1e-12, atol=0)
    assert [one.value for one in fit.parameters.values()] == pytest.approx([value for value, _ in each], abs=1e-12)
    assert fit.parameters["viscous_friction elbow damping"].unit == "N m s/rad" and not fit.reason
    weighted = fit.rows.reshape(-1, len(found.joints))
    assert np.sqrt(np.mean(weighted**2)) == pytest.approx(1.0, abs=0.2)


def test_a_solver_that_gives_up_is_a_result_with_a_reason(truth: Truth, monkeypatch: pytest.MonkeyPatch):
    from figaroh_jax.estimation.conic import NotConverged
    from figaroh_jax.identification import identification

    def gives_up(*arguments: object) -> None:
        raise NotConverged("the constrained fit did not converge")

    monkeypatch.setattr(identification, "physical_fit", gives_up)
    found = identify(truth.nominal, [recording(truth, seed=1)], SETTINGS)
    assert found.solution.reason and any("do not trust" in note for note in found.notes)
    assert not json.loads(to_json(found))["converged"]


def test_parts_left_out_that_could_not_be_fitted_are_told(truth: Truth, monkeypatch: pytest.MonkeyPatch):
    """One of many fits gives up: it counted as predicted by the nominal robot, without a word."""
    from figaroh_jax.estimation.conic import NotConverged
    from figaroh_jax.identification import identification

    solve, calls = identification.physical_fit, []

    def gives_up_once_each_time(*arguments: Any) -> Any:
        calls.append(1)
        if len(calls) % 5 == 2:  # one of the five parts
            raise NotConverged("the constrained fit did not converge")
        return solve(*arguments)

    before = identify(truth.nominal, [recording(truth, seed=1)], SETTINGS)
    monkeypatch.setattr(identification, "physical_fit", gives_up_once_each_time)
    found = identify(truth.nominal, [recording(truth, seed=1)], SETTINGS)
    assert any("1 could not be fitted" in note for note in found.notes), found.notes
    assert not any("could not be fitted" in note for note in before.notes)
    assert found.validated.total > 2 * before.validated.total


def test_result_holds_what_the_contract_asks(found: Identification):
    answer = json.loads(to_json(found))
    assert {"rank", "condition", "base_parameters", "links", "effects", "fit", "holdout"} <= set(answer)
    assert {"expression", "value", "std", "status"} == set(answer["base_parameters"][0])
    assert all(len(link["parameters"]) == 10 and link["consistent"] is True for link in answer["links"])
    assert {"effect", "at", "parameters"} == set(answer["effects"][0])
    assert {"rms", "relative", "r2"} == set(answer["fit"]) == set(answer["holdout"]["other.npz"])


def test_unconstrained_fit_of_the_same_data_is_hardly_better(truth: Truth, found: Identification):
    free = identify(truth.nominal, [recording(truth, seed=1)], SETTINGS, fit="unconstrained")
    assert found.fit.total <= 1.01 * free.unconstrained.total
    assert free.fit.total <= found.fit.total * (1 + 1e-6)


def test_log_cholesky_fit_gives_the_same_robot(truth: Truth, found: Identification):
    other = identify(truth.nominal, [recording(truth, seed=1)], SETTINGS, fit="log_cholesky")
    assert other.fit.total == pytest.approx(found.fit.total, rel=2e-3)
    assert all(link.consistent for link in other.links)


def test_a_dead_torque_is_refused_and_said(truth: Truth):
    one = recording(truth, seed=1)
    assert one.torque is not None
    torque = one.torque.copy()
    torque[:, 1] = 0.02 * (np.abs(torque[:, 1]) > np.quantile(np.abs(torque[:, 1]), 0.9))
    found = identify(truth.nominal, [replace(one, torque=torque)], SETTINGS)
    assert any("torque of elbow is not fitted" in note for note in found.notes)
    assert np.isnan(found.fit.rms[1]) and np.isfinite(found.fit.rms[[0, 2]]).all()
    assert json.loads(to_json(found))["fit"]["rms"][1] is None
    unseen = [e for e in json.loads(to_json(found))["effects"] if e["at"] == ["elbow"]]
    assert [x for e in unseen for x in e["parameters"].values()] == [
        {"value": 0.0, "std": None, "unit": "N m s/rad"},
        {"value": 0.0, "std": None, "unit": "N m"},
    ]


def test_only_the_joints_asked_for_are_fitted(truth: Truth):
    found = identify(truth.nominal, [recording(truth, seed=1)], SETTINGS, joints=["shoulder"])
    assert np.isfinite(found.fit.rms).tolist() == [True, False, False]
    with pytest.raises(InputError, match="no moving joint 'sholder'.*shoulder"):
        identify(truth.nominal, [recording(truth, seed=1)], SETTINGS, joints=["sholder"])
    with pytest.raises(InputError, match="joints is the text 'shoulder'; a list is expected"):
        identify(truth.nominal, [recording(truth, seed=1)], SETTINGS, joints="shoulder")


def test_a_joint_whose_name_begins_like_anothers_is_not_asked_for_with_it(truth: Truth):
    first, second, *others = truth.nominal.joints
    renamed = replace(truth.nominal, joints=(first, second._replace(name=f"{first.name}.j2"), *others))
    found = identify(renamed, [recording(truth, seed=1)], SETTINGS, joints=[first.name])
    assert np.isfinite(found.fit.rms).tolist() == [True, False, False]


def test_a_known_payload_is_no_part_of_the_robot(truth: Truth):
    place = np.array([0.0, 0.05, 0.3])
    loaded = recording(truth, seed=1, payload=(1.5, place), noise="none")
    load = Load(frame="rod", mass=1.5, com=tuple(place))
    bare = recording(truth, seed=1, noise="none")
    options = {"preprocess": SETTINGS, "trust": 1.0}
    first = identify(truth.nominal, [replace(loaded, load=load)], **options)
    second = identify(truth.nominal, [bare], **options)
    values = [np.array([one.value for one in found.base]) for found in (first, second)]
    np.testing.assert_allclose(values[0], values[1], rtol=1e-3, atol=5e-3)


@pytest.mark.parametrize("trust", [0.02, 0.1])
def test_a_payload_that_nobody_told_of_is_found_however_well_the_links_are_believed(truth: Truth, trust: float):
    """Its moments that no torque shows have to grow with the others, or the link would be no body."""
    load = 3.0, np.array([0.2, 0.1, 0.3])
    held = recording(truth, 10.0, seed=7, role="holdout", name="other", payload=load)
    found = identify(truth.nominal, [recording(truth, seed=1, payload=load), held], SETTINGS, trust=trust)
    passed = np.sqrt(2 * 10.0 / simulated_arm.RATE)
    assert (found.holdout["other.npz"].rms < 1.5 * passed * simulated_arm.TORQUE_NOISE).all()
    assert any("clearly better" in note for note in found.notes)
    assert found.trust <= 2.0  # what no torque shows is held by the nominal alone


def test_bounds_of_cad_hold(truth: Truth):
    found = identify(truth.nominal, [recording(truth, seed=1)], SETTINGS, bounds={"fore": {"mass": (2.5, 2.6)}})
    assert 2.5 - 1e-6 <= found.links[1].parameters[0] <= 2.6 + 1e-6
    with pytest.raises(InputError, match="no link 'for'"):
        identify(truth.nominal, [recording(truth, seed=1)], SETTINGS, bounds={"for": {}})


def test_recordings_that_show_nothing_are_refused(truth: Truth):
    still = recording(truth, seed=1)
    still = replace(still, position=np.zeros_like(still.position))
    found = identify(truth.nominal, [still], SETTINGS)
    assert found.rank < 5 < found.structural_rank  # gravity alone
    assert json.loads(to_json(found))
    with pytest.raises(InputError, match="too short|record for longer"):
        identify(truth.nominal, [recording(truth, 0.3, seed=1)], SETTINGS)


def test_pieces_of_a_long_recording_give_the_same_factor(truth: Truth, monkeypatch: pytest.MonkeyPatch):
    signals = prepare_all((recording(truth, 60.0, seed=3),), SETTINGS)
    terms = friction_terms(truth.nominal, Baseline())
    whole = Regression(NativeBackend(truth.nominal), terms, np.zeros(3), signals)
    used = np.ones((3, len(whole.names)), bool)
    one = condense(whole, used)
    monkeypatch.setattr(regression_module, "PIECE_BYTES", 8 * 3 * len(whole.names) * 1500)
    assert len(list(whole.pieces())) > 3
    cut = condense(whole, used)
    assert (one.count == cut.count).all()
    R, S = one.factor(), cut.factor()
    np.testing.assert_allclose(S.T @ S, R.T @ R, rtol=0, atol=1e-7 * np.abs(R.T @ R).max())


@pytest.fixture(scope="module")
def run(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run directory made by the command."""
    folder = tmp_path_factory.mktemp("run")
    for name, one in (("first", recording(truth, seed=1)), ("other", recording(truth, 10.0, seed=7))):
        np.savez(folder / f"{name}.npz", t=one.time, q=one.position, tau=one.torque)  # pyright: ignore
    entry = {"time": "t", "position": "q", "torque": "tau"}
    keys = {
        "robot": {"model": str(truth.file)},
        "data": [{"file": "first.npz", **entry}, {"file": "other.npz", "role": "holdout", **entry}],
        "preprocess": {"cutoff": 10},
        "identify": {"bounds": {"upper": {"mass": [0.1, 20]}}},
    }
    (folder / "task.yaml").write_text(json.dumps(keys))
    assert cli.main(["identify", str(folder / "task.yaml"), "--out", str(folder / "out"), "--quiet"]) == 0
    return folder / "out"


def test_command_writes_a_whole_run(run: Path, capsys: pytest.CaptureFixture[str]):
    names = {path.name for path in run.iterdir()}
    tables = {"parameters.csv", "parameters.yaml", "parameters.npz", "predictions.npz"}
    assert names == {"result.json", "report.html", "model", "provenance.json", "figaroh-jax-run.json"} | tables
    answer = json.loads((run / "result.json").read_text())
    matches("identify", answer)
    with np.load(run / "parameters.npz") as file:
        assert file["base_values"].tolist() == [b["value"] for b in answer["base_parameters"]]
    page = (run / "report.html").read_text()
    assert answer["base_parameters"][0]["expression"] in page and "cross-validated" in page
    assert "essential" in page and "free links" in page and "<code>predictions.npz</code>" in page
    told = [e for e in answer["effects"] if e["effect"] == "viscous_friction"]
    assert all(f'<th scope="row">{e["at"][0]}</th>' in page for e in told) and "rows per joint at" in page


def test_predictions_stand_on_the_recordings_own_stamps(run: Path):
    answer = json.loads((run / "result.json").read_text())
    with np.load(run.parent / "other.npz") as measured, np.load(run / "predictions.npz") as told:
        assert set(told.files) == {"other_time", "other_torque"}
        np.testing.assert_allclose(told["other_time"], measured["t"], rtol=0, atol=0)
        error = (told["other_torque"] - measured["tau"])[200:-200]
    # the torque as recorded has all of its noise
    noise = np.array(simulated_arm.TORQUE_NOISE)
    assert (np.sqrt(np.mean(error**2, axis=0)) < np.hypot(answer["holdout"]["other.npz"]["rms"], 1.1 * noise)).all()


def test_model_with_links_that_cannot_exist_is_written_only_if_told(truth: Truth, tmp_path: Path):
    one = recording(truth, 10.0, seed=1)
    np.savez(tmp_path / "run.npz", t=one.time, q=one.position, tau=-one.torque)  # pyright: ignore
    task = {
        "robot": {"model": str(truth.file)},
        "data": [{"file": "run.npz", "time": "t", "position": "q", "torque": "tau"}],
        "preprocess": {"cutoff": 10},
    }
    for told in ("refuse", "write"):
        keys = {"fit": "unconstrained", "infeasible": told}
        (tmp_path / "task.yaml").write_text(json.dumps(task | {"identify": keys}))
        assert cli.main(["identify", str(tmp_path / "task.yaml"), "--out", str(tmp_path / told), "--quiet"]) == 0
        answer = json.loads((tmp_path / told / "result.json").read_text())
        assert not all(link["consistent"] for link in answer["links"])
        assert (tmp_path / told / "model").exists() == (told == "write")
        assert any("model/ is not written" in note for note in answer["notes"]) == (told == "refuse")


def test_what_was_dropped_is_said(truth: Truth):
    one = recording(truth, seed=1)
    assert one.torque is not None
    torque = one.torque.copy()
    torque[2000:2040, 0] += 500.0
    found = identify(truth.nominal, [replace(one, torque=torque)], Preprocess(cutoff=10, gate={"elbow": 0.05}))
    assert any("rows per joint at" in note and "elbow" in note for note in found.notes)
    spike = next(note for note in found.notes if "robust standard deviations" in note and "shoulder" in note)
    assert float(spike.split()[-2]) == pytest.approx(one.time[2020], abs=0.3)


def test_written_model_is_the_one_that_was_fitted(run: Path, truth: Truth):
    answer = json.loads((run / "result.json").read_text())
    again = pin.buildModelFromUrdf(str(run / "model" / "robot.urdf"))
    for k, link in enumerate(answer["links"], 1):
        np.testing.assert_allclose(again.inertias[k].toDynamicParameters(), link["parameters"], rtol=0, atol=1e-9)
    loaded = fj.load_model(run / "model")
    q, v, a = np.random.default_rng(0).normal(size=(3, 20, 3))
    ours = np.asarray(loaded.robot.inertia)
    np.testing.assert_allclose(ours, [link["parameters"] for link in answer["links"]], rtol=0, atol=1e-12)
    torque = np.array([pin.rnea(again, again.createData(), *s) for s in zip(q, v, a, strict=True)])
    viscous, coulomb = (
        np.array([next(iter(e["parameters"].values()))["value"] for e in answer["effects"] if e["effect"] == name])
        for name in ("viscous_friction", "coulomb_friction")
    )
    far = np.abs(v) > 0.2  # beyond every reversal
    expected = torque + viscous * v + coulomb * np.sign(v)
    np.testing.assert_allclose(np.asarray(loaded.inverse_dynamics(q, v, a))[far], expected[far], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"fit": "magic"}, "identify.fit"),
        ({"joint": ["shoulder"]}, "unknown key 'joint'.*joints"),
        ({"bounds": {"upper": {"weight": [0, 1]}}}, "unknown key 'weight'"),
        ({"bounds": {"uper": {"mass": [0, 1]}}}, "no link 'uper'"),
        ({"bounds": {"upper": {"mass": [2, 1]}}}, "least, greatest"),
        ({"joints": ["elbows"]}, "no moving joint 'elbows'"),
    ],
)
def test_wrong_keys_get_one_message_and_no_output(keys: dict, message: str, tmp_path: Path, capsys):
    import re

    file = tasks.write(tmp_path, tasks.task() | {"identify": keys})
    assert cli.main(["identify", str(file), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert re.search(message, said) and said.count("\n") == 1
    assert not (tmp_path / "out").exists()


def _base(truth: Truth):
    """Base parameters from Pinocchio's regressor at random states."""
    data, rng = truth.model.createData(), np.random.default_rng(3)
    rows = []
    for q, v, a in rng.normal(size=(100, 3, 3)):
        rigid = pin.computeJointTorqueRegressor(truth.model, data, q, v, a)
        rows.append(np.concatenate([rigid, np.diag(v), np.diag(np.sign(v))], axis=1))
    links = [f"{name}{k}" for k in (1, 2, 3) for name in "m mx my mz Ixx Ixy Iyy Ixz Iyz Izz".split()]
    return base_parameters(np.concatenate(rows), [*links, *(f"{n}{k}" for n in ("fv", "fc") for k in (1, 2, 3))])
