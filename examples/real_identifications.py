"""TX40 and UR10e identified from the folder $FIGAROH_JAX_DATA. Without it: one line, and done."""

import os
from pathlib import Path

import numpy as np

import figaroh_jax as fj

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def tx40() -> tuple[fj.RobotModel, list[fj.Recording], fj.Preprocess]:
    """Motor positions and torques brought to the joints; the gears of joints 5 and 6 are coupled."""
    z, gears = np.load(DATA / "staubli_tx40" / "tx40.npz"), np.diag([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
    position, torque = gears.copy(), gears.copy()
    position[5, 4] = torque[4, 5] = 32.0
    q = np.linalg.solve(position, z["motor_position"].T).T + [0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0]
    run = fj.recording(q=q, tau=z["motor_current"] @ torque.T, rate=5000)
    return fj.load_urdf(DATA / "staubli_tx40" / "tx40.urdf"), [run], fj.Preprocess(window=(0.05, 7.66), cutoff=20)


def identified(name: str, robot: fj.RobotModel, runs: list[fj.Recording], preprocess: fj.Preprocess) -> None:
    """One line of an identification."""
    found = fj.identify(robot, runs, preprocess, fj.Baseline(rotor=True, offset=True), trust=1.0)
    print(f"{name}: {found.rank} base parameters, error {np.round(100 * found.fit.relative, 1)} % by joint")


def main() -> None:
    """Base parameters of each, and the error that is left."""
    if not DATA.is_dir():
        return print(f"skipped: no recordings in {DATA}; FIGAROH_JAX_DATA names the folder")
    identified("TX40", *tx40())
    files = sorted((DATA / "ur10e_innopolis" / "id").glob("*20sec_10harm*.npz"))
    runs = [np.load(file) for file in files]
    gains = (10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232)  # N m/A
    recordings = [fj.recording(q=z["q"], tau=z["i"] * gains, time=z["t"]) for z in runs]
    identified("UR10e", fj.load_urdf(DATA / "ur10e_innopolis" / "ur10e.urdf"), recordings, fj.Preprocess(cutoff=5))


if __name__ == "__main__":
    main()
