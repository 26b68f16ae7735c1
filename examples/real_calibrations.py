"""TALOS, TIAGo and IRB120 calibrated from the folder $FIGAROH_JAX_DATA. Without it: one line, and done."""

import os
from pathlib import Path

import numpy as np

import figaroh_jax as fj

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
TALOS = ["torso_1_joint", "torso_2_joint", *(f"arm_left_{k}_joint" for k in range(1, 8))]
TIAGO = ["torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8))]


def tracked(file: str, csv: str, joints: list[str], q: slice, seen: slice, base: str, tool: str) -> fj.Fit:
    """Joint offsets and frames of a robot that a tracker watched."""
    robot = fj.load_urdf(DATA / file, joints=joints)
    table = np.genfromtxt(DATA / csv, delimiter=",", skip_header=1)
    table = np.delete(table, 9, axis=0) if "tiago" in csv else table  # an outlier
    run = fj.postures(q=table[:, q], position=table[:, seen], base_frame=base, tool_frame=tool)
    return fj.fit(robot, run, ("joint_offset", "frames"))


def told(name: str, found: fj.Fit) -> None:
    """One line of a calibration."""
    error = 1e3 * np.sqrt(3 * np.mean(np.asarray(found.rows) ** 2))
    print(f"{name}: {int(found.rank)} parameters, {error:.3f} mm")


def main() -> None:
    """Joint offsets and frames of each, and the error that is left."""
    if not DATA.is_dir():
        return print(f"skipped: no recordings in {DATA}; FIGAROH_JAX_DATA names the folder")
    folder, csv = "talos_contact", "talos_left_arm_02_10_contact.csv"
    frames = ("base_link", "gripper_left_base_link")
    told("TALOS", tracked(f"{folder}/talos_full_v2.urdf", f"{folder}/{csv}", TALOS, np.s_[4:13], np.s_[1:4], *frames))
    folder, csv = "tiago_mocap", "qualysis_base_hand_calibration.csv"
    frames = ("base_footprint_joint", "arm_7_link")
    told("TIAGo", tracked(f"{folder}/tiago_no_hand.urdf", f"{folder}/{csv}", TIAGO, np.s_[12:20], np.s_[:3], *frames))
    z, robot = np.load(DATA / "irb120_wu2015" / "irb120_wu.npz"), fj.load_urdf(DATA / "irb120_wu2015" / "irb120.urdf")
    base = next(frame.name for frame in robot.frames if frame.parent < 0)
    units = {"position": "deg", "measurement": "mm"}
    run = fj.postures(q=z["cali_q_deg"], position=z["cali_xyz_mm"], base_frame=base, tool_frame="tool0", units=units)
    told("IRB120", fj.fit(robot, run, ("joint_offset", "frames")))


if __name__ == "__main__":
    main()
