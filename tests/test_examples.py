"""The examples run, are short, and use public names alone."""

from __future__ import annotations

import ast
import runpy
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
# these have tests of their own, or make what the package ships
ELSEWHERE = {"make_demo", "own_device", "own_effect", "own_rollout_effect"}
SLOW = {
    "any_optimiser",
    "batch",
    "calibrate_tracker",
    "design_a_motion",
    "diagnose_arrays",
    "dynamics_and_gradients",
    "fleet",
    "force_plate",
    "free_flyer",
    "friction_by_gradient",
    "identify_arrays",
    "noisy_encoder",
    "own_friction",
    "payload_and_gains",
    "person_on_a_plate",
    "real_calibrations",
    "real_identifications",
    "so101",
}
SAYS = {
    "any_optimiser": "any optimiser: -2",
    "dynamics_and_gradients": "by the mass of each link",
    "batch": "200 resamples",
    "friction_by_gradient": "damping 1.19",
    "export_to_mujoco": "figaroh_jax [",
    "design_a_motion": "own optimiser",
    "calibrate_tracker": "joint_offset elbow: -0.02",
    "diagnose_arrays": "joint_spring (shoulder)",
    "force_plate": "joints and plate: 36 base parameters",
    "free_flyer": "39 of 42 base parameters",
    "identify_arrays": "base parameters",
    "noisy_encoder": "simulated instruments: base parameters 0.",
    "own_friction": "named grease_friction (shoulder)",
    "payload_and_gains": "payload 1.700 kg",
    "person_on_a_plate": "of 44 base parameters",
    "real_calibrations": "TALOS: 16 parameters, 1.430 mm",
    "real_identifications": "TX40",
    "fleet": "robot 5: load_dependent_friction",
    "so101": "causes named by this library",
}
NAMES = sorted(path.stem for path in EXAMPLES.glob("*.py"))


@pytest.mark.parametrize("name", [n for n in NAMES if n != "make_demo"])
def test_an_example_is_short_and_imports_nothing_private(name: str):
    text = (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 60
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.ImportFrom):
            assert not (node.module or "").startswith("figaroh_jax"), f"{name}: {ast.unparse(node)}"
        if isinstance(node, ast.Import):
            assert not any(alias.name.startswith("figaroh_jax.") for alias in node.names)


def test_a_law_of_ones_own_takes_25_lines_at_most():
    """Registered, fitted, diagnosed, exported: what a user writes who has recordings."""
    text = (EXAMPLES / "own_friction.py").read_text(encoding="utf-8")
    own = text[text.rindex("@fj.register") :].splitlines()
    assert len([line for line in own if line.strip() and "__name__" not in line]) <= 25


def cases() -> list:
    return [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in NAMES if n not in ELSEWHERE]


@pytest.mark.parametrize("name", cases())
def test_an_example_runs(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, data_dir: Path
):
    if name == "friction_by_gradient":
        pytest.importorskip("optax")
    monkeypatch.setenv("FIGAROH_JAX_DATA", str(data_dir))
    monkeypatch.setattr("sys.argv", [f"{name}.py"])  # not those of pytest
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    assert SAYS[name] in capsys.readouterr().out
