"""One fit of torques, postures and a rollout together: where its time goes, and how often intervals hold the truth.

    python benchmarks/joint_fit.py [--seeds 20] [--data torque postures rollout]
    python benchmarks/joint_fit.py --programs      # first and second call of `rollout` and of `fit_linear`

The arm and its recordings are MuJoCo C's (`tests/generators/joint_arm.py`). Prints CPU seconds of the first
fit of the process, of those after it (other noise, same programs), their steps, and of the ten hidden numbers how many
standard deviations each is off: root mean square over the seeds and share within two. Earlier commits: PYTHONPATH.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import figaroh_jax as fj

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from generators import joint_arm  # noqa: E402

SETTINGS = fj.Preprocess(cutoff=10, rate=20)
ROWS = joint_arm.TORQUE_NOISE * (2 * 10 / 250) ** 0.5  # N m: one sigma of noise that is low-passed at 10 of 125 Hz
FREE = {"inertia": ["fore"], "friction": True, "joint_offset": True, "link_geometry": ["elbow x"], "start": True}


def prepared(file: Path, seen: joint_arm.Seen) -> dict[str, Any]:
    """The three kinds of data, of the nominal arm's file."""
    loop, _ = fj.load_loop(file)
    run = fj.recording(q=seen.followed, command=seen.command, rate=100)
    moved = fj.rollout_data(loop, run, noise=joint_arm.ENCODER_NOISE)
    pushed = fj.torque_data(moved.model, fj.recording(q=seen.moved, tau=seen.torque, rate=250), SETTINGS, noise=ROWS)
    points = fj.postures(q=seen.held, position=seen.point, base_frame="world", tool_frame="tip", unknown=[])
    (looked,) = fj.pose_data(moved.model, points, sigma=(joint_arm.TRACKER_NOISE, 1.0))
    return {"torque": pushed, "postures": looked, "rollout": moved}


def fitted(data: dict[str, Any], which: tuple[str, ...] = ("torque", "postures", "rollout")) -> fj.Fit:
    """The nominal arm with what these kinds of data show."""
    free = {key: value for key, value in FREE.items() if key != "start" or "rollout" in which}
    return fj.fit(data["rollout"].model, [data[name] for name in which], free, prior={"inertia": 0.5})


def programs(file: Path) -> None:
    """CPU seconds of the first and the second call, for 400 steps of the arm and for 6 s of the demo's torques."""
    loop, _ = fj.load_loop(file)
    command = np.repeat(joint_arm.record(0).command, 2, 0)
    robot, t = fj.load_urdf(fj.DEMO), np.arange(1500)[:, None] / 250.0
    q, tau = 0.6 * np.sin(2 * np.pi * np.array([0.5, 0.7, 0.9, 1.1]) * t + np.arange(4)), np.cos(t + np.arange(4))
    data = fj.torque_data(robot, fj.recording(q=q, tau=tau, rate=250), SETTINGS)
    basis = fj.linear_basis(robot, data)
    calls = {
        "rollout": lambda: fj.rollout(loop, command, np.zeros(2)).position,
        "fit_linear": lambda: fj.fit_linear(robot, data, basis).values,
    }
    for name, call in calls.items():
        told = []
        for _ in range(2):
            start = time.process_time()
            np.asarray(call())
            told.append(time.process_time() - start)
        print(f"{name}: first {told[0]:.2f} CPU s, second {told[1]:.3f} CPU s")


def main() -> None:
    """Print times and pulls."""
    asked = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    asked.add_argument("--seeds", type=int, default=20)
    asked.add_argument("--data", nargs="+", default=["torque", "postures", "rollout"])
    asked.add_argument("--programs", action="store_true")
    given, pulls, seconds = asked.parse_args(), [], []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arm.xml"
        file.write_text(joint_arm.ARM.format(**joint_arm.NOMINAL))
        if given.programs:
            programs(file)
            return
        for seed in range(given.seeds):
            data = prepared(file, joint_arm.record(seed))
            start = time.process_time()
            found = fitted(data, tuple(given.data))
            told = found.parameters
            seconds.append(time.process_time() - start)
            rms = float(np.sqrt(np.mean(np.asarray(found.rows) ** 2)))
            print(
                f"{seed}: {seconds[-1]:.1f} CPU s, {int(found.stats['num_steps'])} steps, RMS {rms:.2f} {found.reason}"
            )
            pulls.append([(told[k].value - x) / told[k].std for k, x in joint_arm.truth().items()])
    table = np.array(pulls)
    print(f"first fit {seconds[0]:.1f} CPU s, later ones {np.median(seconds[1:] or seconds):.2f} CPU s")
    for name, column in zip(joint_arm.truth(), table.T, strict=True):
        print(f"{name:36} {np.sqrt(np.mean(column**2)):.2f} sigma, {np.mean(np.abs(column) < 2):.0%} within two")
    print(f"{'all':36} {np.sqrt(np.mean(table**2)):.2f} sigma, {np.mean(np.abs(table) < 2):.0%} within two")


if __name__ == "__main__":
    main()
