"""Orientations of measured poses as files have them: quaternions in both orders, angles in rad and degrees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import figaroh_jax as fj
from figaroh_jax.formats.robotfile import load_robot
from figaroh_jax.recordings.poses import read_pose_recordings

TURNED = Rotation.from_rotvec(np.random.default_rng(0).normal(size=(12, 3)))
POINTS = np.random.default_rng(1).normal(size=(12, 3))
WRITTEN = {
    "wxyz": TURNED.as_quat()[:, [3, 0, 1, 2]],
    "xyzw": TURNED.as_quat(),
    "rpy": TURNED.as_euler("xyz"),
    "rotvec": TURNED.as_rotvec(),
}


def read(folder: Path, orientation: np.ndarray, keys: str, units: str = "{}", kind: str = "pose"):
    np.savez(folder / "run.npz", q=np.zeros((12, 4)), seen=np.hstack([POINTS, orientation]))
    measurement = f"{{{kind}: seen, base_frame: base, tool_frame: hand{keys}}}"
    (folder / "task.yaml").write_text(
        f"robot: {{model: {fj.DEMO}}}\n"
        f"data: [{{file: run.npz, position: q, units: {units}, measurement: {measurement}}}]"
    )
    task = fj.load_task(folder / "task.yaml")
    return read_pose_recordings(task, load_robot(task))[0].values


@pytest.mark.parametrize("form", WRITTEN)
def test_every_way_to_write_an_orientation_is_read(form: str, tmp_path: Path):
    values = read(tmp_path, WRITTEN[form], f", orientation: {form}")
    np.testing.assert_allclose(values[:, :3, :3], TURNED.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(values[:, :3, 3], POINTS)


@pytest.mark.parametrize("form", ["rpy", "rotvec"])
def test_angles_may_be_degrees_and_what_was_not_measured_is_left_out(form: str, tmp_path: Path):
    degrees = np.rad2deg(WRITTEN[form])
    degrees[3] = np.nan
    values = read(tmp_path, degrees, f", orientation: {form}", "{orientation: deg, measurement: mm}")
    assert np.isnan(values[3, :3, :3]).all()
    seen = np.arange(12) != 3
    np.testing.assert_allclose(values[seen, :3, :3], TURNED.as_matrix()[seen], atol=1e-12)
    np.testing.assert_allclose(values[:, :3, 3], 1e-3 * POINTS)


@pytest.mark.parametrize(
    ("form", "keys", "said"),
    [
        ("rpy", "", "six numbers a posture: add `orientation: rpy`"),
        ("rpy", ", orientation: wxyz", "six numbers a posture: add `orientation: rpy`"),
        ("xyzw", ", orientation: rpy", "seven numbers a posture; `orientation: rpy` has six"),
    ],
)
def test_numbers_that_do_not_fit_are_told(form: str, keys: str, said: str, tmp_path: Path):
    with pytest.raises(fj.InputError, match=said):
        read(tmp_path, WRITTEN[form], keys)


def test_degrees_taken_for_rad_are_told(tmp_path: Path):
    with pytest.raises(fj.InputError, match=r"are they degrees\? add units: {orientation: deg}"):
        read(tmp_path, np.rad2deg(WRITTEN["rpy"]), ", orientation: rpy")


def test_an_orientation_of_points_is_refused(tmp_path: Path):
    with pytest.raises(fj.InputError, match="orientation belongs to the kinds pose and camera"):
        read(tmp_path, WRITTEN["rpy"], ", orientation: rpy", kind="position")


def test_a_camera_in_the_hand_that_sees_no_orientation_is_told():
    seen = np.full((12, 4, 4), np.nan)
    seen[:, :3, 3] = POINTS
    seen[:, 3] = 0.0, 0.0, 0.0, 1.0
    with pytest.raises(fj.InputError, match="no orientation of the board was measured, which a camera"):
        fj.postures(q=np.zeros((12, 4)), camera=seen, mount="hand", base_frame="base", tool_frame="hand")
    seen[4, :3, :3] = np.eye(3)
    run = fj.postures(q=np.zeros((12, 4)), camera=seen, mount="hand", base_frame="base", tool_frame="hand")
    assert np.isfinite(run.values).all(axis=(1, 2)).tolist() == [k == 4 for k in range(12)]
