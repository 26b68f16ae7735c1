"""The page and the summary of an identification from commands and positions."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import browser
import numpy as np
import pytest

from figaroh_jax import DEMO
from figaroh_jax.effects.extended import extend
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.reporting.rollout_report import show_rollouts, write_rollouts
from figaroh_jax.results import Trace
from figaroh_jax.rollouts.identification import RolloutIdentification
from figaroh_jax.rollouts.rest import parts_of, relative_rest
from figaroh_jax.rollouts.task import one_number_notes


def trace(name: str, role: Any, rng: np.random.Generator) -> Trace:
    t = np.arange(500) * 0.01
    position = np.sin(t[:, None] * [1.0, 2.0, 3.0, 4.0])
    far = position + 0.05 * rng.normal(size=position.shape)
    return Trace(name, role, t, position, np.gradient(position, t, axis=0), position, far, position + 0.001)


def found() -> RolloutIdentification:
    model, rng = extend(load_urdf(DEMO)), np.random.default_rng(1)
    joints = model.robot.joint_names
    numbers = [
        {"expression": f"{kind} {joint}", "value": 0.4, "std": std, "unit": unit, "status": status}
        for kind, unit in (("armature", "kg m2"), ("friction", "N m"))
        for joint, std, status in zip(
            joints, (0.01, 0.02, None, 0.3), ("identified",) * 3 + ("on its bound",), strict=True
        )
    ]
    quality = {"rms": [1e-3] * 4, "relative": [0.02] * 4}
    result = {
        "base_parameters": numbers,
        "fit": quality | {"noise": [1e-4] * 4},
        "holdout": {"b": quality | {"r2": [0.99] * 4}},
        "notes": ["armature waist and friction waist trade off (correlation +0.98)", "<b>simulated</b>"],
    }
    traces = (trace("a", "fit", rng), trace("b", "holdout", rng))
    loop: Any = None
    return RolloutIdentification(result, loop, model, {}, joints, ("rad",) * 4, traces)


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[browser.Page]:
    if browser.find() is None:
        pytest.skip("needs Chromium")
    with browser.page(tmp_path_factory.mktemp("profile")) as page:
        yield page


def test_the_summary_says_the_error_first_and_every_number_with_its_interval(capsys: pytest.CaptureFixture[str]):
    show_rollouts(found(), "the arm", verbose=False)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("identified  Held-out motions are simulated from the command with an error of at most 2")
    assert "6 of 8 numbers of the arm are identified" in lines[0]
    assert any(line.split() == ["Coulomb", "friction", "shoulder", "0.400", "±", "0.039", "N", "m"] for line in lines)
    assert any("on its bound" in line for line in lines) and lines[-1].startswith("2 notes")


@pytest.mark.parametrize(("width", "phone"), [(1300, False), (390, True)])
def test_the_page_is_accessible_draws_positions_and_fits_its_screen(
    tab: browser.Page, tmp_path: Path, width: int, phone: bool
):
    write_rollouts(found(), tmp_path / "report.html", "the arm")
    assert (tmp_path / "report.html").stat().st_size < 1_500_000
    tab.open(tmp_path / "report.html", width, 900, phone=phone)
    assert tab.value("document.documentElement.scrollWidth") <= width
    tab.value("document.querySelector('details.joint').scrollIntoView()")
    tab.wait("document.querySelector('details.joint[data-drawn] .ytitle') !== null")
    assert tab.value("document.querySelector('details.joint .ytitle').textContent") == "position, rad"
    axe = importlib.util.find_spec("axe_core_python")
    assert axe is not None and axe.submodule_search_locations
    tab.value(Path(axe.submodule_search_locations[0], "axe.min.js").read_text("utf-8") + ";undefined")
    rules = "{runOnly: ['wcag2a', 'wcag2aa', 'wcag21a', 'wcag21aa', 'best-practice']}"
    wrong = tab.value(
        f"axe.run({{exclude: ['.main-svg']}}, {rules}).then((r) => r.violations.map((v) => v.id + v.nodes[0].html))"
    )
    assert wrong == [] and tab.problems == []
    rows = tab.value("[...document.getElementById('parameters').rows].map((r) => r.cells[0].dataset.value)")
    assert rows[1:3] == ["armature waist", "armature shoulder"]


def test_what_is_left_goes_with_the_motion_or_a_line():
    """Errors that follow the speed at one joint, a line of 7 Hz at the other, are told as such."""
    rng, traces = np.random.default_rng(0), []
    for k in range(2):
        t = 0.01 * np.arange(2000)
        q = np.stack([np.sin(t + k), np.sin(2 * t)], 1)
        v = np.gradient(q, t, axis=0)
        left = 0.01 * np.stack([np.tanh(8 * v[:, 0]), np.sin(14 * np.pi * t)], 1) + 1e-3 * rng.normal(size=q.shape)
        traces.append(Trace(f"run {k}", "fit", t, q, v, q, q - left, q - left))
    noise = np.full(2, 1e-3)
    size = relative_rest(np.full(2, 0.01), noise, traces)
    np.testing.assert_allclose(size, 0.01 * np.sqrt(2), rtol=0.02, atol=0)
    parts = parts_of(traces, ("a", "b"), noise, size)
    first = {part.at[0]: part for part in parts[::-1]}
    assert (first["a"].kind, first["b"].kind) == ("velocity", "frequency")
    assert first["a"].share > 0.9
    assert first["b"].band is not None
    assert first["b"].band[0] < 7 < first["b"].band[1]


def test_errors_of_joints_that_turn_and_slide_are_told_apart(tmp_path: Path):
    """0.01 rad at three joints and 2 mm at the fourth: two numbers, none of both; names of joints stay as they are."""
    whole = found()
    far = [replace(t, before=t.measured + np.array([0.01, 0.01, 0.01, 0.002])) for t in whole.traces]
    names = ("shoulder_pan", *whole.joints[1:])
    rolled = lambda one: one | {"expression": one["expression"].replace("wrist", "wrist_roll")}  # noqa: E731
    numbers = [rolled(one) for one in whole.result["base_parameters"]]
    result = whole.result | {"base_parameters": numbers}
    mixed = whole._replace(units=("rad", "rad", "rad", "m"), traces=tuple(far), joints=names, result=result)
    write_rollouts(mixed, tmp_path / "report.html", "arm")
    text = re.sub(r"(?s)<script.*?</script>", "", (tmp_path / "report.html").read_text("utf-8"))
    assert "rad or m" not in text and "Joints that turn" in text and "Joints that slide" in text
    assert "10 mrad" in text and "2 mm" in text
    assert "wrist_roll (on its bound)" in text and "wrist roll" not in text


def test_the_answer_says_which_joints_have_one_number_together():
    def named(at: str, entries: tuple[int, ...]) -> Any:
        return SimpleNamespace(candidate=SimpleNamespace(effect="stribeck_friction", entries=entries, at=(at,)))

    found: Any = SimpleNamespace(named=[named("pan", (1, 2)), named("lift", (1, 2)), named("jaw", (3, 4))])
    (text,) = one_number_notes(found)
    assert "one size at pan, lift:" in text
