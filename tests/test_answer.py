"""`answer.json`, `predictions.npz` and the terminal, against the contract's own words."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import fake_diagnosis
import numpy as np
import pytest
from rich.console import Console

from figaroh_jax.reporting import answer, terminal
from figaroh_jax.results import Estimate, Gain


def _strict(text: str) -> dict:
    def refuse(word: str):
        raise AssertionError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_answer_has_the_shape_of_the_contract():
    found = _strict(answer.to_json(fake_diagnosis.named()))
    assert list(found) == ["verdict", "causes", "p_value", "residual", "rest", "holdout", "next_experiment", "notes"]
    first, second = found["causes"]
    assert list(first) == ["effect", "at", "parameters", "found", "confidence", "gain", "ambiguous_with"]
    assert (first["effect"], first["at"]) == ("coupled_transmission", ["joint_5", "joint_6"])
    assert first["parameters"]["friction"] == {"value": 1.957, "std": 0.034, "unit": "N m"}
    assert first["gain"] == {"holdout_before": 0.1392, "holdout_after": 0.0718, "unit": "relative RMS"}
    assert first["ambiguous_with"] == []
    assert second["ambiguous_with"] == [{"effect": "link_inertia", "at": ["link_3"]}]
    assert [len(found["residual"][key]) for key in ("before", "after", "noise")] == [6, 6, 6]
    assert found["next_experiment"]["separates"] == [["rotor_inertia", "link_inertia"]]


@pytest.mark.parametrize("variant", ["nothing", "unknown", "partly"])
def test_answer_carries_the_verdict(variant: str):
    diagnosis = getattr(fake_diagnosis, variant)()
    found = _strict(answer.to_json(diagnosis))
    assert found["verdict"] == diagnosis.verdict and len(found["causes"]) == len(diagnosis.causes)
    if diagnosis.experiment is None:
        assert found["next_experiment"] is None


def test_numbers_that_are_not_finite_become_null():
    clean = fake_diagnosis.named()
    cause = replace(clean.causes[0], parameters={"inertia": Estimate(1.0, float("inf"), "kg m2")}, confidence=np.nan)
    broken = replace(clean, causes=(cause,), p_value=np.float64("nan"), noise=np.full(6, np.nan))
    found = _strict(answer.to_json(replace(broken, holdout=Gain(np.nan, np.nan))))
    assert found["p_value"] is None and found["residual"]["noise"] == [None] * 6
    assert found["causes"][0]["parameters"]["inertia"]["std"] is None and found["causes"][0]["confidence"] is None


def test_predictions_hold_time_and_torque_of_each_recording(tmp_path: Path):
    time, torque = np.linspace(0, 1, 11), np.arange(22.0).reshape(11, 2)
    answer.write_predictions(tmp_path / "predictions.npz", {"run 2": (time, torque), "run3": (time[:4], torque[:4])})
    with np.load(tmp_path / "predictions.npz", allow_pickle=False) as stored:
        assert sorted(stored) == ["run 2_time", "run 2_torque", "run3_time", "run3_torque"]
        np.testing.assert_array_equal(stored["run 2_torque"], torque)
        np.testing.assert_array_equal(stored["run3_time"], time[:4])


def test_predictions_refuse_time_and_torque_that_do_not_belong_together(tmp_path: Path):
    with pytest.raises(ValueError, match=r"'run2'.*\(3,\).*\(4, 2\)"):
        answer.write_predictions(tmp_path / "predictions.npz", {"run2": (np.zeros(3), np.zeros((4, 2)))})
    assert not (tmp_path / "predictions.npz").exists()


@pytest.mark.parametrize("variant", ["named", "partly", "unknown", "nothing"])
def test_summary_is_short_and_says_the_verdict_first(variant: str):
    console = Console(file=io.StringIO(), width=100)
    console.print(terminal.summary(getattr(fake_diagnosis, variant)(), "tx40 [bold]"))
    text = console.file.getvalue()  # pyright: ignore[reportAttributeAccessIssue]
    assert text.startswith(getattr(fake_diagnosis, variant)().verdict)
    assert "tx40 [bold]" in text and "joint_6" in text
    assert text.count("\n") < 40


def test_progress_goes_to_standard_error_and_is_silent_when_asked():
    program = (
        "from figaroh_jax.reporting.terminal import Progress\n"
        "for quiet in (False, True):\n"
        "    with Progress(quiet=quiet) as progress:\n"
        "        for share in (0.0, 0.1, 0.5): progress('reading [red]' if share < 0.5 else 'fitting', share)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == ""
    assert done.stderr.split("\n") == ["  0%  reading [red]", " 50%  fitting", ""]


def test_progress_on_a_terminal_accepts_phases_with_brackets_and_shares_out_of_range():
    with terminal.Progress() as progress:
        progress._live = True
        for share in (-1.0, 0.3, 2.0):
            progress("refit [/x] joint_3", share)
