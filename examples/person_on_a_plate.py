"""A person on a force plate: the motion that tells most about the arms and the trunk, in balance on both feet."""

import os
from pathlib import Path

import numpy as np

import figaroh_jax as fj

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
MOVING = ["middle_lumbar_X", "middle_lumbar_Z"]
MOVING += [f"{side}_{joint}" for side in ("left", "right") for joint in ("shoulder_Z", "shoulder_X", "elbow_Z")]


def main() -> None:
    """Legs as one with the pelvis, everything else within the limits of the joints."""
    if not DATA.is_dir():
        return print(f"skipped: no model in {DATA}; FIGAROH_JAX_DATA names the folder")
    robot = fj.load_urdf(DATA / "human_model" / "human.urdf", joints=MOVING, root="free_flyer")
    upright = np.zeros(robot.nq)
    upright[:7] = [0.0, 0.0, 0.95, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # the model's y is up
    plate = np.eye(4)  # on the floor, under the middle of the feet
    person = fj.people.standing(robot, "base_link", upright, support=(0.1, 0.15), plate=plate)

    sigma = dict(zip(fj.people.PLATE, [3.0, 3.0, 3.0, 1.0, 1.0, 1.0], strict=True))  # N, N m
    still = fj.Baseline(viscous=False, coulomb=False)
    learned = fj.learn(person, still, measured=sigma, hold=fj.people.PLATE, trust=0.25)
    limits = fj.limits_of(person, velocity=3.0, acceleration=10.0, scale=0.95)
    start = fj.people.balanced(person)
    found = fj.excite(person, fj.fourier(3, 0.2, 5.0), limits, learned, start=start, starts=1)

    for use in found.stages[0].uses:
        print(f"{use.kind:12s} {use.joint:16s} {use.value:7.2f} of {use.limit:6.2f}")
    told = (found.std < 0.5 * found.std_before).sum()
    print(f"{told} of {learned.rank} base parameters are told better than by a table by half")


if __name__ == "__main__":
    main()
