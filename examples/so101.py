"""One arm, published fits that contradict each other, and motions that no fit has seen ($FIGAROH_JAX_DATA)."""

import os
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

import figaroh_jax as fj

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")) / "so101_sage"
PERIOD, ROWS, STEPS = 0.02006, 1500, 4  # s, rows of each motion, steps to a row
ARM = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
# N m/rad, N m s/rad (gain and joint together), N m, kg m2, s; the last one's intervals: docs/so101.md
MODELS = {
    "as MuJoCo Menagerie says": (998.2, 3.33, 0.052, 0.028, 0.0),
    "no friction, heavy rotors (Playground)": (17.8, 0.6, 1e-4, 0.15, 0.0),
    "friction .35, light rotors (Isaac Lab)": (48.0, 0.6, 0.35, 0.05, 0.0),
    "causes named by this library": (
        (40.6, 12.3, 11.7, 10.2, 35.1, 25.1),
        (2.45, 0.827, 0.713, 0.606, 2.02, 1.99),
        (0.424, 0.396, 0.467, 0.142, 0.377, 0.0),
        *((0.028, 0.028, 0.028, 0.0081, 0.028, 0.028), 0.0),
    ),
}


def arm(gain: Any, damping: Any, friction: Any, armature: Any, delay: Any) -> Any:
    """The arm with these numbers at its servos; friction is the torque that stops a joint within a step."""
    each = zip(ARM, np.broadcast_to(gain, 6), strict=True)
    drives = {name: {"kind": "position", "kp": float(kp), "kd": 0.0, "force": 3.35} for name, kp in each}
    loop, _ = fj.load_loop(DATA / "so101.xml", drives, law="hard", dt=PERIOD / STEPS)
    new = [np.broadcast_to(np.asarray(x, float), 6) for x in (damping, friction, armature, delay)]
    where = lambda m: (m.joints.damping, m.joints.friction, m.joints.armature, m.drives.delay)  # noqa: E731
    return eqx.tree_at(where, loop, new)


def motion(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Command and position (rows, 6), rad; the jaw is told as a share of its range."""
    z = np.load(DATA / f"{name}.npz")
    both = np.array([z["command"][:ROWS], z["q"][:ROWS]], float)
    both[..., 5] = -0.174533 + 1523 * 2 * np.pi / 4096 * both[..., 5]
    return both[0], both[1]


def main() -> None:
    """Error of each model on motions that no fit has seen, from the command alone."""
    if not DATA.is_dir():
        return print(f"skipped: no {DATA}; FIGAROH_JAX_DATA names the folder above")
    for label, numbers in MODELS.items():
        loop, errors = arm(*numbers), []
        for command, position in map(motion, ("step_response", "velocity_ramp", "slow_precision")):
            read = np.asarray(fj.rollout(loop, np.repeat(command, STEPS, axis=0), position[0]).reading)[::STEPS]
            errors.append(1e3 * np.sqrt(np.mean((read - position)[:, :5] ** 2, axis=0)))
        print(f"{label:<40} {np.mean(errors):5.1f} mrad; by joint {np.round(np.mean(errors, axis=0), 1)}")


if __name__ == "__main__":
    main()
