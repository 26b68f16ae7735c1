"""The public benchmarks: any tool through its command line, graded by what it answers; generators of their own."""

from __future__ import annotations

import ast
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT))

from benchmarks import blackbox  # noqa: E402
from benchmarks.hide_in_real.scoring import score  # noqa: E402

TRUTH = {"effect": "torque_delay", "at": [], "parameters": {"delay": 0.01}}
RIPPLE = {"effect": "torque_ripple", "at": ["j1"], "parameters": {"sine": 3.0, "cosine": 4.0, "order": 9.0}}


def answer(*causes: tuple[str, list[str], dict[str, float]], verdict: str = "named+rest") -> dict[str, Any]:
    told = [
        {"effect": e, "at": at, "parameters": {k: {"value": v, "std": 0.1} for k, v in p.items()}}
        for e, at, p in causes
    ]
    return {"verdict": verdict, "causes": told, "p_value": 0.001}


OWN = ("torque_ripple", ["j1"], {"sine": 1.0, "cosine": 0.5, "order": 4.0})
HIDDEN = ("torque_ripple", ["j1"], {"sine": 3.3, "cosine": 4.4, "order": 9.1})
SPRING = ("joint_spring", ["j1"], {"stiffness": 2.0, "rest": 0.0})


@pytest.mark.parametrize(
    ("truth", "told", "twin", "grade"),
    [
        (TRUTH, answer(("torque_lag", [], {"time": 0.011})), answer(), "right"),
        (TRUTH, answer(("torque_lag", [], {"time": 0.011}), SPRING), answer(SPRING), "right"),
        (TRUTH, answer(("torque_lag", [], {"time": 0.011}), SPRING), answer(), "more"),
        (TRUTH, answer(SPRING), answer(), "wrong"),
        (TRUTH, answer(SPRING), answer(SPRING), "silent"),
        (TRUTH, answer(("torque_delay", [], {"delay": 0.01}), verdict="unknown"), answer(), "silent"),
        # a cause that the twin has too counts for what it gained
        (TRUTH, answer(("torque_delay", [], {"delay": 0.03})), answer(("torque_delay", [], {"delay": 0.019})), "right"),
        (TRUTH, answer(("torque_delay", [], {"delay": 0.03})), answer(("torque_delay", [], {"delay": 0.03})), "silent"),
        (RIPPLE, answer(("torque_ripple", ["j2"], {"sine": 3.0, "cosine": 4.0, "order": 9.0})), answer(), "wrong"),
        (TRUTH, None, answer(), "failed"),
        # one more ripple of a joint is new, whichever stands first, and one more than there is is wrong
        (RIPPLE, answer(OWN, HIDDEN), answer(OWN), "right"),
        (RIPPLE, answer(HIDDEN, OWN), answer(OWN), "right"),
        (RIPPLE, answer(OWN, HIDDEN), answer(OWN, HIDDEN), "silent"),
        (RIPPLE, answer(OWN, HIDDEN), answer(), "more"),
        (TRUTH, answer(OWN, HIDDEN), answer(OWN), "wrong"),
    ],
)
def test_an_answer_is_graded_by_what_its_twin_does_not_say(truth: Any, told: Any, twin: Any, grade: str):
    assert blackbox.grade({"truth": [truth], "twin": "t"}, told, twin).grade == grade


def test_a_name_in_the_set_of_another_is_neither_right_nor_wrong():
    told = answer(SPRING)
    told["causes"][0]["ambiguous_with"] = [{"effect": "torque_ripple", "at": ["j1"]}]
    assert blackbox.grade({"truth": [RIPPLE]}, told, None).grade == "set"


def test_sizes_are_amplitudes_whatever_the_phase_and_the_twin_s_are_subtracted():
    found = answer(("torque_ripple", ["j1"], {"sine": 5.5, "cosine": 0.0, "order": 9.1}))
    assert blackbox.grade({"truth": [RIPPLE]}, found, None).sizes == pytest.approx((0.1,), rel=0, abs=1e-12)
    late, twin = ({"parameters": {"delay": {"value": x}}} for x in (0.031, 0.02))
    assert blackbox.size_error(TRUTH, late, twin) == pytest.approx(0.1, rel=0, abs=1e-9)


def test_the_size_of_one_more_ripple_is_its_own():
    graded = blackbox.grade({"truth": [RIPPLE], "twin": "t"}, answer(OWN, HIDDEN), answer(OWN))
    assert graded.sizes == pytest.approx((0.1,), rel=0, abs=1e-9)


TOOL = """
import json, pathlib, sys
import numpy as np

def main(words):
    task = json.loads(pathlib.Path(words[0]).read_text())
    file = pathlib.Path(words[0]).parent / task["data"][0]["file"]
    forbidden = task.get("diagnose", {}).get("forbid", [])
    late = bool(np.load(file)["tau"].sum() > 1) and "torque_delay" not in forbidden
    cause = {"effect": "torque_delay", "at": [], "parameters": {"delay": {"value": 0.0101, "std": 1e-4}}}
    out = pathlib.Path(words[1])
    out.mkdir()
    told = {"verdict": "named" if late else "nothing", "causes": [cause] * late, "p_value": 0.5}
    (out / "answer.json").write_text(json.dumps(told))
    return 0

if __name__ == "__main__":
    main(sys.argv[1:])
"""


@pytest.mark.parametrize("way", ["process", "here"])
def test_any_command_is_run_scored_and_not_run_twice(tmp_path: Path, monkeypatch, way: str):
    cases, runs = tmp_path / "cases", tmp_path / "runs"
    (cases / "r").mkdir(parents=True)
    np.savez(cases / "r" / "one.npz", q=np.zeros((5, 1)), tau=np.zeros((5, 1)))
    added: dict[str, Any] = {"one/tau": np.ones((5, 1), np.float32)}
    np.savez(cases / "r" / "late.npz", **added)
    (cases / "r" / "robot.urdf").write_text("<robot/>")
    twin: dict[str, Any] = {"name": "r/twin", "group": "r", "truth": [], "model": "r/robot.urdf"}
    twin["task"] = {"robot": {"model": "robot.urdf"}, "data": [{"file": "r/one.npz"}]}
    hidden = twin | {"name": "r/late", "twin": "r/twin", "truth": [TRUTH], "added": "r/late.npz", "visible": True}
    hidden |= {"forbid": ["torque_delay", "torque_lag"], "size": 0.1, "left": 0.9, "sigmas": 20.0}
    (cases / "cases.json").write_text(json.dumps({"cases": [twin, hidden]}))
    (tmp_path / "entered_tool.py").write_text(TOOL)
    monkeypatch.syspath_prepend(tmp_path)
    started = {"process": f"{sys.executable} {tmp_path / 'entered_tool.py'}", "here": "here entered_tool:main"}
    command = f"{started[way]} {{task}} {{out}}"
    known, modes = blackbox.load_cases(cases, ["late"]), ("named", "forbidden")
    for limit in (60.0, 0.0):  # the second time nothing is left to do
        blackbox.run(cases, runs, known, command, 2 if way == "process" else 1, limit, modes)
    table = score(known, runs, modes)
    graded = {row["mode"]: row["grade"] for row in json.loads((runs / "results.json").read_text())["cases"]}
    assert graded == {"named": "right", "forbidden": "silent"}
    assert "| r | 10 % | 1 | 1 | 0 | 0 | 0 | 0 | 0 | 0.01 | 1 of 1 |" in table


def test_the_generators_of_the_benchmarks_share_no_code_with_the_library():
    files = [f for name in ("hide_in_real", "hide_and_name") for f in (ROOT / "benchmarks" / name).glob("*.py")]
    for file in [*files, ROOT / "benchmarks" / "blackbox.py"]:
        for node in ast.walk(ast.parse(file.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not any(name.split(".")[0] == "figaroh_jax" for name in names), file


def test_what_is_added_at_the_joints_of_the_tx40_is_added_at_its_motors(data_dir: Path, monkeypatch: Any):
    import tx40

    from benchmarks.hide_in_real import recordings

    monkeypatch.setattr(recordings, "DATA", data_dir)
    real = recordings.tx40()
    added = np.random.default_rng(0).normal(size=(7, 6))
    np.testing.assert_allclose(real.stored(added) @ tx40.TORQUE.T, added, rtol=0, atol=1e-12)
    stored = real.recordings[0]
    np.testing.assert_allclose(stored.arrays["tau"] @ tx40.TORQUE.T, stored.torque, rtol=0, atol=1e-9)
    joint = np.linalg.solve(tx40.POSITION, stored.arrays["q"][0]) + tx40.OFFSET
    np.testing.assert_allclose(joint, stored.position[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("law", "sure"),
    [(lambda s: np.sin(7 * s.q), True), (lambda s: 0.001 * np.sin(7 * s.q), False), (lambda s: 1 + 0 * s.q, False)],
    ids=["large", "small", "a part of the baseline"],
)
def test_the_oracle_believes_what_the_recording_kept_out_shows(
    data_dir: Path, monkeypatch: Any, law: Callable[[Any], np.ndarray], sure: bool
):
    """A ripple of half the torque, of the two-thousandth, and a constant, which the baseline has itself."""
    from benchmarks.hide_in_real import recordings
    from benchmarks.hide_in_real.baseline import fit
    from benchmarks.hide_in_real.motion import scene_of
    from benchmarks.hide_in_real.oracle import Oracle

    monkeypatch.setattr(recordings, "DATA", data_dir)
    real = recordings.simple_pendulum()
    baseline, scenes = fit(real, [scene_of(real, r) for r in real.recordings])
    size = 0.5 * np.sqrt(np.mean(scenes[0].torque ** 2))
    borne = Oracle(baseline, scenes).borne_out([size * law(s) for s in scenes], (0,))
    assert borne.sure is sure
    assert (borne.share > 0.1) is sure
