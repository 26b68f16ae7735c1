"""The command line: commands, exit statuses, streams, and run directories that are written whole or not at all.

The diagnosis itself is made up here; `make demo` runs the real one.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib import resources
from pathlib import Path

import fake_diagnosis
import jax
import numpy as np
import pytest
from toy_backend import ToyBackend

from figaroh_jax import cli
from figaroh_jax.effects.extended import extend
from figaroh_jax.errors import InputError
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.jobs import diagnosis
from figaroh_jax.reporting.run_directory import MARKER, whole_directory
from figaroh_jax.results import Diagnosis
from figaroh_jax.simulators import registry
from figaroh_jax.simulators.native import NativeBackend

DEMO = Path(str(resources.files("figaroh_jax") / "demo"))
FILES = {MARKER, "provenance.json", "answer.json", "predictions.npz", "report.html", "model"}


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Diagnosis:
    """`diagnose_task` answers at once, and the working directory is empty."""
    answer = replace(fake_diagnosis.named(), model=extend(load_urdf(DEMO / "robot.urdf")))

    def diagnose_task(task, *, progress, backend):
        progress(f"screening with {backend}", 0.5)
        return answer

    monkeypatch.setattr(diagnosis, "diagnose_task", diagnose_task)
    monkeypatch.chdir(tmp_path)
    return answer


@pytest.fixture(autouse=True)
def keep_configuration():
    values = {name: getattr(jax.config, name) for name in ("jax_enable_compilation_cache", "jax_enable_x64")}
    yield
    for name, value in values.items():
        jax.config.update(name, value)


def _diagnose(*options: str) -> int:
    return cli.main(["diagnose", str(DEMO / "task.yaml"), *options])


def test_diagnose_writes_the_files_of_the_contract(made_up: Diagnosis, tmp_path: Path):
    assert _diagnose("--out", "runs/first") == 0
    out = tmp_path / "runs" / "first"
    assert {path.name for path in out.iterdir()} == FILES
    assert {"robot.urdf", "robot.xml", "effects.yaml"} <= {path.name for path in (out / "model").iterdir()}
    assert json.loads((out / "answer.json").read_text())["verdict"] == "named"
    assert [path.name for path in out.parent.iterdir()] == ["first"]  # nothing temporary stays


def test_predictions_stand_on_the_time_stamps_of_the_holdout_recording(made_up: Diagnosis, tmp_path: Path):
    assert _diagnose("--out", "out") == 0
    with np.load(tmp_path / "out" / "predictions.npz") as found, np.load(DEMO / "unseen.npz") as recorded:
        assert set(found.files) == {"unseen_time", "unseen_torque"}
        assert found["unseen_torque"].shape == recorded["tau"].shape
        assert np.isfinite(found["unseen_torque"]).all()
        np.testing.assert_allclose(found["unseen_time"], np.arange(len(recorded["tau"])) / 250, rtol=0, atol=1e-12)


def test_the_run_directory_is_named_after_the_task(made_up: Diagnosis, tmp_path: Path):
    assert _diagnose() == 0
    assert {path.name for path in (tmp_path / "task_diagnosis").iterdir()} == FILES


def test_summary_goes_to_stdout_and_progress_to_stderr(made_up: Diagnosis, capsys: pytest.CaptureFixture[str]):
    assert _diagnose() == 0
    printed = capsys.readouterr()
    assert "named" in printed.out and "task_diagnosis/report.html" in printed.out
    assert "screening" in printed.err


def test_quiet_silences_progress(made_up: Diagnosis, capsys: pytest.CaptureFixture[str]):
    assert _diagnose("--quiet") == 0
    assert capsys.readouterr().err == ""


def test_json_prints_the_answer_and_nothing_else(made_up: Diagnosis, capsys: pytest.CaptureFixture[str]):
    assert _diagnose("--json") == 0
    printed = capsys.readouterr().out
    assert printed == Path("task_diagnosis/answer.json").read_text()
    assert json.loads(printed)["causes"][0]["effect"] == "coupled_transmission"


def test_an_earlier_run_is_replaced_as_a_whole(made_up: Diagnosis, tmp_path: Path):
    with whole_directory(tmp_path / "out") as folder:
        (folder / "stale.txt").write_text("from an earlier version")
    assert _diagnose("--out", "out") == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES


def test_a_directory_with_other_things_is_refused_and_left_alone(made_up: Diagnosis, tmp_path: Path, capsys):
    (tmp_path / "thesis.tex").write_text("years of work")
    assert _diagnose("--out", str(tmp_path)) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]
    assert "holds other things than an earlier run" in capsys.readouterr().err


def test_a_file_in_place_of_the_directory_is_refused(made_up: Diagnosis, tmp_path: Path, capsys):
    (tmp_path / "out").write_text("")
    assert _diagnose("--out", "out") == 2
    assert _diagnose("--out", "out/below") == 2
    assert "Traceback" not in capsys.readouterr().err


def test_a_failure_while_writing_leaves_the_earlier_run(made_up: Diagnosis, tmp_path: Path, monkeypatch, capsys):
    assert _diagnose("--out", "out") == 0
    before = (tmp_path / "out" / "answer.json").stat().st_ino

    def fail(*_):
        raise RuntimeError("the disk caught fire")

    monkeypatch.setattr(diagnosis, "write_model", fail)
    assert _diagnose("--out", "out") == 70
    assert "internal error: RuntimeError: the disk caught fire" in capsys.readouterr().err
    assert (tmp_path / "out" / "answer.json").stat().st_ino == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_wrong_input_gives_one_message_and_status_2(made_up: Diagnosis, tmp_path: Path, capsys):
    assert cli.main(["diagnose", "no_such_task.yaml"]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("figaroh-jax: error: ") and "no_such_task.yaml" in printed.err
    assert "Traceback" not in printed.err
    assert not list(tmp_path.iterdir())


def test_traceback_is_shown_on_request(made_up: Diagnosis, capsys):
    assert cli.main(["diagnose", "no_such_task.yaml", "--traceback"]) == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("argv", [[], ["conjure", "task.yaml"], ["diagnose"], ["demo", "--nonsense"]])
def test_wrong_usage_is_status_2(argv: list[str], capsys):
    assert cli.main(argv) == 2
    assert "usage: figaroh-jax" in capsys.readouterr().err


def test_an_unknown_command_lists_the_known_ones(capsys):
    assert cli.main(["conjure", "task.yaml"]) == 2
    message = capsys.readouterr().err
    assert "identify" in message and "diagnose" in message and "demo" in message


def test_the_backend_that_was_asked_for_is_passed_on(made_up: Diagnosis, capsys):
    assert _diagnose("--backend", "pinocchio") == 0
    assert "screening with pinocchio" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["diagnose", "identify", "calibrate"])
def test_an_unknown_backend_is_refused_with_those_installed(made_up: Diagnosis, command: str, tmp_path: Path, capsys):
    assert cli.main([command, str(DEMO / "task.yaml"), "--backend", "bullet"]) == 2
    assert "no backend 'bullet' is installed; installed: native" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_calibration_by_another_backend_is_refused_with_the_reason(made_up: Diagnosis, tmp_path: Path, capsys):
    assert cli.main(["calibrate", str(DEMO / "task.yaml"), "--backend", "pinocchio"]) == 2
    assert "differentiates by the placements" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_backend_without_a_regressor_is_refused_with_those_that_have_one(made_up, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(registry, "backend_class", lambda name: ToyBackend if name == "toy" else NativeBackend)
    assert _diagnose("--backend", "toy") == 2
    assert "'toy' has no joint_torque_regressor; backends that do: native" in capsys.readouterr().err


def test_an_interrupted_block_leaves_nothing(tmp_path: Path):
    with pytest.raises(KeyboardInterrupt), whole_directory(tmp_path / "out") as folder:
        (folder / "half.txt").write_text("half")
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_a_directory_that_cannot_be_made_is_wrong_input(tmp_path: Path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file"), whole_directory(tmp_path / "file" / "out"):
        pass


def test_compiled_programs_are_kept_in_the_users_cache_folder(tmp_path: Path):
    code = (
        "import jax; from figaroh_jax import cli; cli._set_up_jax(cache=True);"
        "print(jax.config.jax_compilation_cache_dir, jax.config.jax_enable_x64, jax.numpy.zeros(3).dtype)"
    )
    environment = {"XDG_CACHE_HOME": str(tmp_path), "PATH": "/usr/bin"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert run.stdout.split() == [str(tmp_path / "figaroh_jax" / "jax"), "True", "float64"]


@pytest.mark.parametrize("module", ["figaroh_jax", "figaroh_jax.cli"])
def test_the_package_runs_as_a_module(module: str):
    run = subprocess.run([sys.executable, "-m", module, "--version"], capture_output=True, text=True)
    assert (run.returncode, run.stdout[:12], run.stderr) == (0, "figaroh-jax ", "")


@pytest.mark.parametrize(("told", "expected"), [(None, "cpu"), ("cuda,cpu", "cuda,cpu")])
def test_the_command_computes_on_the_cpu_unless_told_otherwise(told: str | None, expected: str, tmp_path: Path):
    environment = {name: value for name, value in os.environ.items() if name != "JAX_PLATFORMS"}
    environment |= {} if told is None else {"JAX_PLATFORMS": told}
    code = "import os, sys; from figaroh_jax import cli; cli.main(sys.argv[1:]); print(os.environ['JAX_PLATFORMS'])"
    program = [sys.executable, "-c", code, "list", str(tmp_path)]
    process = subprocess.run(program, capture_output=True, text=True, env=environment, check=True)
    assert process.stdout.splitlines()[-1] == expected
