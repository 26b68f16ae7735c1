"""Calibrate a robot from points that a tracker saw: by `calibrate`, which chooses, and by `fit`, where you choose."""

import numpy as np

import figaroh_jax as fj


def postures(robot: fj.RobotModel) -> fj.PoseRecording:
    """60 postures of an arm whose joints are zeroed wrongly, seen by a tracker at an unknown place; 0.05 mm noise."""
    rng, hand = np.random.default_rng(0), robot.link_names[-1]
    q = rng.uniform(-1.4, 1.4, (60, robot.nv))
    poses = np.asarray(fj.frame_placement(robot, q + [0.0, 0.012, -0.02, 0.0], hand))
    seen = poses[:, :3, :3] @ [0.02, 0.01, 0.06] + poses[:, :3, 3] + [1.0, -0.4, 0.2]
    noise = 5e-5 * rng.normal(size=seen.shape)
    return fj.postures(q=q, position=seen + noise, base_frame="base", tool_frame=hand, name="tracker")


def main() -> None:
    """Both ways."""
    robot = fj.load_urdf(fj.DEMO)
    run = postures(robot)
    found = fj.calibrate(robot, [run])
    assert found.position is not None
    print(f"{found.level}: {found.position.validated_before:.2f} -> {found.position.validated_after:.2f} mm held out")
    for cause in found.causes:
        print(
            cause.name, {key: f"{1e3 * e.value:.2f} +- {1e3 * e.std:.2f} mrad" for key, e in cause.parameters.items()}
        )

    one = fj.fit(robot, run, {"joint_offset": ["shoulder", "elbow"], "frames": True})
    for name, value in one.parameters.items():
        print(f"{name}: {value.value:.5f} +- {value.std:.5f} {value.unit}")
    print("tool", np.round(fj.frame_placement(one.model.robot, np.zeros(robot.nv), "hand")[:3, 3], 4), "m")


if __name__ == "__main__":
    main()
