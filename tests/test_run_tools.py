"""Commands on finished runs: verify, compare, list and rerun, on runs that were written by hand."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from figaroh_jax import DEMO, cli
from figaroh_jax.errors import InputError
from figaroh_jax.reporting.provenance import provenance
from figaroh_jax.reporting.run_directory import MARKER, check_directory, whole_directory
from figaroh_jax.reporting.side_by_side import _values_of
from figaroh_jax.rollouts.export import for_simulator

CAUSE = {
    "effect": "torque_offset",
    "at": ["j1"],
    "parameters": {"offset": {"value": 1.5, "std": 0.1, "unit": "N m"}},
    "gain": {"holdout_before": 0.2, "holdout_after": 0.05, "unit": "relative RMS"},
}
ANSWER: dict[str, Any] = {
    "verdict": "named",
    "causes": [CAUSE],
    "p_value": 0.2,
    "holdout": {"before": 0.2, "after": 0.05, "unit": "relative RMS", "joints": {"j1": 0.04, "j2": 0.06}},
}
RESULT: dict[str, Any] = {
    "rank": 40,
    "condition": 120.0,
    "joints": ["j1", "j2"],
    "base_parameters": [
        {"expression": "m1", "value": 2.0, "std": 0.1, "status": "identified"},
        {"expression": "m2", "value": 2.0, "std": 1.9, "status": "prior only"},
    ],
    "links": [{"name": "l1", "consistent": True}, {"name": "l2", "consistent": False}],
    "effects": [],
    "holdout": {"a.npz": {"relative": [0.01, 0.05]}, "b.npz": {"relative": [0.02, None]}},
}
CALIBRATION: dict[str, Any] = {
    "level": "full",
    "verdict": "named+rest",
    "causes": [],
    "parameters": [],
    "position": {"unit": "mm", "validated_after": 0.4},
    "orientation": None,
    "fk_parity": 2e-12,
}


def run(folder: Path, task: Path | None = None, **files: dict[str, Any]) -> Path:
    with whole_directory(folder) as new:
        for name, content in files.items():
            (new / f"{name}.json").write_text(json.dumps(content))
        if task is not None:
            (new / "provenance.json").write_text(provenance("diagnose", task, [task], "native"))
        time = np.linspace(0, 1, 50)
        np.savez(new / "predictions.npz", held_time=time, held_torque=np.sin(time)[:, None])
    return folder


def verified(folder: Path, limits: str, *options: str) -> tuple[int, dict[str, str]]:
    file = folder.parent / "limits.yaml"
    file.write_text(limits)
    status = cli.main(["verify", str(folder), "--limits", str(file), *options])
    checks = json.loads((folder / "verification.json").read_text())
    assert checks["passed"] == (status == 0)
    return status, {check["limit"]: check["status"] for check in checks["limits"]}


@pytest.mark.parametrize(
    ("limits", "name", "status"),
    [
        ("verdict: [nothing, named]", "verdict", "pass"),
        ("verdict: [nothing]", "verdict", "fail"),
        ("holdout_relative: 0.05", "holdout_relative", "pass"),
        ("holdout_relative: {j2: 0.05}", "holdout_relative j2", "fail"),
        ("holdout_relative: {j9: 0.05}", "holdout_relative j9", "skipped"),
        ("gain: 0.7", "gain", "pass"),
        ("gain: 0.8", "gain", "fail"),
        ("p_value: 0.3", "p_value", "fail"),
        ("forbidden_causes: [torque_offset]", "forbidden_causes", "fail"),
        ("forbidden_causes: [torque_delay]", "forbidden_causes", "pass"),
        ("rank: 40", "rank", "skipped"),
    ],
)
def test_a_diagnosis_against_limits(limits: str, name: str, status: str, tmp_path: Path):
    code, checks = verified(run(tmp_path / "run", answer=ANSWER), limits)
    assert checks == {name: status} and code == (status == "fail")


def test_an_identification_and_a_calibration_against_limits(tmp_path: Path):
    limits = "rank: 40\ncondition: 100\nrelative_std: 0.1\nconsistent: true\nholdout_relative: 0.05\nposition_mm: 0.5"
    code, checks = verified(run(tmp_path / "identified", result=RESULT), limits)
    assert code == 1 and checks == {
        "rank": "pass",
        "condition": "fail",
        "relative_std": "pass",
        "consistent": "fail",
        "holdout_relative": "pass",
        "position_mm": "skipped",
    }
    limits = "position_mm: 0.5\norientation_deg: 0.1\nfk_parity: 1.0e-9\nverdict: [named]"
    code, checks = verified(run(tmp_path / "calibrated", result=CALIBRATION), limits)
    assert code == 1 and list(checks.values()) == ["fail", "pass", "skipped", "pass"]


def test_a_line_says_on_which_side_of_its_limit_a_figure_passes(tmp_path: Path, capsys):
    limits = "verdict: [nothing]\nforbidden_causes: [torque_delay]\np_value: 0.3\nholdout_relative: 0.05\nrank: 40"
    verified(run(tmp_path / "run", answer=ANSWER), limits)
    told = {line.split()[1]: line.partition("(limit: ")[2] for line in capsys.readouterr().out.splitlines()}
    assert told == {
        "verdict": "one of nothing)",
        "forbidden_causes": "none of torque_delay)",
        "p_value": "at least 0.3)",
        "holdout_relative": "at most 0.05)",
        "rank": "at least 40)",
    }


def test_junit_counts_what_failed_and_what_was_skipped(tmp_path: Path):
    verified(
        run(tmp_path / "run", answer=ANSWER), "gain: 0.9\nrank: 3\np_value: 0.1", "--junit", str(tmp_path / "j.xml")
    )
    suite = ElementTree.parse(tmp_path / "j.xml").getroot()  # noqa: S314 -- written above
    assert (suite.get("tests"), suite.get("failures"), suite.get("skipped")) == ("3", "1", "1")
    assert [case.get("name") for case in suite if case.find("failure") is not None] == ["gain"]


def test_a_verified_run_can_still_be_replaced(tmp_path: Path):
    folder = run(tmp_path / "run", answer=ANSWER)
    verified(folder, "gain: 0.1")
    check_directory(folder)
    assert "verification.json" in json.loads((folder / MARKER).read_text())["files"]


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ("gian: 0.1", "unknown key 'gian'; did you mean 'gain'?"),
        ("condition: -1", "condition is -1, expected more than 0"),
        ("verdict: [maybe]", "maybe"),
        ("forbidden_causes: [torque_dely]", "torque_delay"),
    ],
)
def test_wrong_limits_are_status_2(limits: str, said: str, tmp_path: Path, capsys):
    (tmp_path / "limits.yaml").write_text(limits)
    folder = run(tmp_path / "run", answer=ANSWER)
    assert cli.main(["verify", str(folder), "--limits", str(tmp_path / "limits.yaml")]) == 2
    assert said in capsys.readouterr().err and not (folder / "verification.json").exists()


@pytest.mark.parametrize("command", [["verify", "."], ["compare", ".", "."], ["rerun", "."], ["list", "nowhere"]])
def test_what_is_no_run_is_status_2(command: list[str], tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(command) == 2
    assert "Traceback" not in capsys.readouterr().err


def test_damaged_json_is_status_2(tmp_path: Path, capsys):
    (tmp_path / "answer.json").write_text("{")
    assert cli.main(["verify", str(tmp_path)]) == 2
    assert "cannot be read as JSON" in capsys.readouterr().err


def test_runs_side_by_side(tmp_path: Path, capsys):
    other = json.loads(json.dumps(ANSWER))
    other["causes"][0]["parameters"]["offset"]["value"] = 2.5
    a, b = run(tmp_path / "first", answer=ANSWER), run(tmp_path / "<second>", answer=other)
    page = tmp_path / "page.html"
    assert cli.main(["compare", str(a), str(b), "--out", str(page)]) == 0
    printed = capsys.readouterr().out
    assert "1.5 ± 0.1 N m" in printed and "2.5 ± 0.1 N m *" in printed
    text = page.read_text()
    assert "&lt;second&gt;" in text and "<second>" not in text and text.count("<polyline") == 2
    assert "http" not in text and len(text) < 1.5e6


def test_the_runs_below_a_folder(tmp_path: Path, capsys):
    task = tmp_path / "task.yaml"
    task.write_text("robot: {}")
    run(tmp_path / "a" / "one", task, answer=ANSWER)
    run(tmp_path / "two", result=RESULT)
    assert cli.main(["list", str(tmp_path), "--json"]) == 0
    (section,) = json.loads(capsys.readouterr().out)
    assert [(Path(row[0]).name, row[1], row[2]) for row in section["rows"]] == [
        ("one", "diagnose", "named"),
        ("two", "?", "-"),
    ]


def test_files_of_the_same_name_that_no_run_wrote_are_passed_over(tmp_path: Path, capsys):
    run(tmp_path / "one", answer=ANSWER)
    for name, text in (("mine", "[1, 2]"), ("yours", '{"causes": 3}')):
        (tmp_path / name).mkdir()
        (tmp_path / name / "answer.json").write_text(text)
    damaged = run(tmp_path / "two", answer=ANSWER)
    (damaged / "answer.json").write_text('{"causes": 3}')
    assert cli.main(["list", str(tmp_path), "--json"]) == 0
    (section,) = json.loads(capsys.readouterr().out)
    assert [(Path(row[0]).name, row[2]) for row in section["rows"]] == [("one", "named"), ("two", "cannot be read")]


def test_a_reader_that_goes_away_and_a_full_disk_at_standard_output(tmp_path: Path):
    command = [sys.executable, "-m", "figaroh_jax", "list", str(tmp_path)]
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True)
    os.close(write)
    assert (done.returncode, done.stderr) == (0, "")
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "No space left" in done.stderr


@pytest.mark.parametrize(
    "made",
    [
        {"command": "verify"},
        {"command": "rerun"},
        {"command": ["diagnose"]},
        {"options": ["--help"]},
        {"options": ["--out", "elsewhere"]},
        {"options": ["--backend"]},
        {"options": ["--interpolate"]},
        {"task": [[]]},
        {"task": "a\0b"},
    ],
)
def test_a_provenance_that_names_no_run_s_command_is_status_2(made: dict[str, Any], tmp_path: Path, capsys):
    task = tmp_path / "task.yaml"
    task.write_text("robot: {}")
    folder = run(tmp_path / "run", task, answer=ANSWER)
    file = folder / "provenance.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | made))
    assert cli.main(["rerun", str(folder), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "provenance.json" in said and "internal" not in said


def test_compare_and_verify_replace_no_file_of_the_user_s(tmp_path: Path, capsys):
    one, two = (run(tmp_path / name, answer=ANSWER) for name in ("one", "two"))
    thesis = tmp_path / "thesis.tex"
    thesis.write_text("years of work")
    assert cli.main(["compare", str(one), str(two), "--out", str(thesis)]) == 2
    assert cli.main(["verify", str(one), "--junit", str(thesis)]) == 2
    assert cli.main(["new", str(one), str(two), "--out", str(thesis)]) == 2
    assert thesis.read_text() == "years of work" and "was not written by this command" in capsys.readouterr().err
    page, junit = tmp_path / "page.html", tmp_path / "checks.xml"
    for _ in range(2):
        assert cli.main(["compare", str(one), str(two), "--out", str(page)]) == 0
        assert cli.main(["verify", str(one), "--junit", str(junit)]) == 0


def test_rerun_uses_the_command_and_the_task_of_the_run(tmp_path: Path, monkeypatch):
    from figaroh_jax.jobs import tools

    task = tmp_path / "task.yaml"
    task.write_text("robot: {}")
    folder = run(tmp_path / "run", task, answer=ANSWER)
    assert tools.command_of(folder) == ("diagnose", str(task))
    made = json.loads((folder / "provenance.json").read_text())
    design = made | {"command": "excite", "options": ["--from", str(folder)]}
    (folder / "provenance.json").write_text(json.dumps(design))
    assert tools.command_of(folder) == ("excite", str(task), "--from", str(folder))
    (folder / "provenance.json").write_text(json.dumps(made))
    assert made["inputs"][0]["bytes"] == 9 and len(made["inputs"][0]["sha256"]) == 64 and "jax" in made["versions"]
    assert cli.main(["rerun", str(folder)]) == 2  # the task is none
    task.unlink()
    with pytest.raises(ValueError, match="not there any more"):
        tools.command_of(folder)


WORKFLOW = Path(__file__).resolve().parents[1] / "examples" / "github_actions.yml"


def steps(folder: Path, *left_out: str) -> dict[str, int]:
    """Exit status of each step of the example that runs a command, but for those left out."""
    job = yaml.safe_load(WORKFLOW.read_text(encoding="utf-8"))["jobs"]["verify"]
    python = folder / "bin"
    python.mkdir()
    command = python / "figaroh-jax"
    command.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m figaroh_jax "$@"\n')
    command.chmod(0o755)
    environment = os.environ | {"PATH": f"{python}{os.pathsep}{os.environ['PATH']}"}
    found = {}
    for step in job["steps"]:
        if "run" in step and step["name"] not in ("install", *left_out):
            done = subprocess.run(["bash", "-e", "-c", step["run"]], cwd=folder, env=environment, capture_output=True)
            found[step["name"]] = done.returncode
    return found


def test_the_steps_of_the_ci_example_run_on_finished_runs(tmp_path: Path):
    (tmp_path / "robot").mkdir()
    (tmp_path / "robot" / "limits.yaml").write_text("gain: 0.7\n")
    run(tmp_path / "robot" / "reference", answer=ANSWER)
    run(tmp_path / "run", answer=ANSWER)
    assert steps(tmp_path, "diagnose") == {"verify": 0, "compare": 0}
    assert (tmp_path / "verify.xml").is_file() and "reference" in (tmp_path / "compare.html").read_text()


@pytest.mark.slow
def test_the_steps_of_the_ci_example_run_from_the_recordings(tmp_path: Path):
    shutil.copytree(Path(DEMO).parent, tmp_path / "robot")
    (tmp_path / "robot" / "limits.yaml").write_text("verdict: [nothing]\n")
    run(tmp_path / "robot" / "reference", answer=ANSWER)
    assert steps(tmp_path) == {"diagnose": 0, "verify": 1, "compare": 0}  # the demo has a cause to be named
    shown = (tmp_path / "compare.html").read_text()
    assert "stribeck_friction (shoulder)" in shown


def test_a_reader_that_has_gone_changes_no_verdict(tmp_path: Path):
    folder = run(tmp_path / "run", answer=ANSWER)
    (tmp_path / "limits.yaml").write_text("gain: 0.9\n")
    command = [sys.executable, "-m", "figaroh_jax", "verify", str(folder), "--limits", str(tmp_path / "limits.yaml")]
    out, into = os.pipe()
    os.close(out)  # nobody reads
    try:
        done = subprocess.run(command, stdout=into, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(into)
    assert (done.returncode, done.stderr) == (1, "")


def test_no_line_is_longer_than_the_terminal(tmp_path: Path):
    import pty

    folder = run(tmp_path / "run", answer=ANSWER)
    command = [sys.executable, "-m", "figaroh_jax", "compare", str(folder), str(folder)]
    leader, follower = pty.openpty()
    done = subprocess.run(command, stdout=follower, env=os.environ | {"COLUMNS": "48"})
    os.close(follower)
    text = b""
    with suppress(OSError):  # a terminal that has ended is an error to read
        while block := os.read(leader, 4096):
            text += block
    os.close(leader)
    assert done.returncode == 0
    assert max(map(len, text.decode().splitlines())) <= 48 and "torque_offset" in text.decode()


def test_rounding_is_no_change_of_a_link():
    assert _values_of((0.01, 0.03, 0.03), (0.01, 0.03, 0.03 + 1e-17)) == "0.01 0.03 0.03"
    assert _values_of((20.5, 10.0, 150.0), (20.0, 10.0 + 1e-14, 150.0)) == "20.5 10 150 (+0.5 0 0)"
    assert _values_of((6e-13, -60.0, 130.0), None) == "0 -60 130"


def test_the_export_of_another_run_says_what_to_take(tmp_path: Path, capsys):
    """A run of torques has no loop: its files are named; of a run's folder its model is taken."""
    model = tmp_path / "run" / "model"
    model.mkdir(parents=True)
    for name in ("robot.urdf", "effects.yaml"):
        (model / name).write_text("")
    for folder in (model, tmp_path / "run"):
        assert cli.main(["export", str(folder), "--for", "mujoco"]) == 2
        assert "the model of this run is in its robot.urdf, effects.yaml" in capsys.readouterr().err
    (model / "loop.json").write_text("{}")
    assert cli.main(["export", str(tmp_path / "run"), "--for", "mujoco"]) == 2
    assert f"{model / 'loop.json'}" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "said"), [("nix", "known: mujoco, "), ("mujocco", "did you mean 'mujoco'?")])
def test_a_simulator_that_is_unknown_is_told_the_others_once(name: str, said: str):
    with pytest.raises(InputError) as refused:
        for_simulator({}, name)
    assert said in str(refused.value) and str(refused.value).count("known: ") <= 1
