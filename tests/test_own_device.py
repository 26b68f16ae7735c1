"""The example with a measuring device of the user's own: a short function, calibrated with like one of ours."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import poses
import pytest

from figaroh_jax.calibration.calibration import calibrate
from figaroh_jax.errors import InputError
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.recordings.devices import own_device
from figaroh_jax.recordings.poses import PoseRecording

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "own_device.py"


def test_a_device_of_ones_own_takes_15_lines_at_most():
    tree = ast.parse(EXAMPLE.read_text())
    device = next(node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "draw_wire")
    assert device.end_lineno is not None and device.end_lineno - device.lineno + 1 <= 15


def test_offsets_are_found_with_a_device_of_ones_own():
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path}
    run = subprocess.run([sys.executable, str(EXAMPLE)], env=environment, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    verdict, *causes = run.stdout.splitlines()
    before, after = (float(word) for word in verdict.split()[1:4:2])
    assert verdict.startswith("named: ") and before > 1.0 > 0.12 > after  # the noise of three wires is 0.09 mm
    found = {line.split()[1].strip("():"): float(line.split()[3]) for line in causes}
    assert found == pytest.approx({"elbow": -0.02, "shoulder": 0.012}, abs=3e-4)


@pytest.mark.parametrize(
    ("device", "message"),
    [
        (None, "needs its device"),
        (own_device(lambda pose, u, d: pose[:3, 3] - d, {}), r"residual has shape \(3,\), but its channels are \(0,\)"),
    ],
)
def test_a_device_that_does_not_fit_its_channels_is_refused(device, message: str, tmp_path: Path):
    (tmp_path / "robot.urdf").write_text(poses.urdf())
    rng = np.random.default_rng(1)
    q, values = poses.postures(rng, 20), rng.normal(size=(20, 3))
    time, name = np.arange(20.0), Path("own")
    seen = PoseRecording("own", name, time, q, "own", values, "base", "tool0", device=device)
    with pytest.raises(InputError, match=message):
        calibrate(load_urdf(tmp_path / "robot.urdf"), [seen])
