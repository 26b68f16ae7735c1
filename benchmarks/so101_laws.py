"""Laws of friction at one joint of a real arm, fitted by hand in MuJoCo C: no code shared with the library.

    python benchmarks/so101_laws.py elbow_flex --laws constant load          # one joint, some laws
    python benchmarks/so101_laws.py shoulder_lift --seconds 60

Data under the folder that FIGAROH_JAX_DATA names (so101_sage). Gain, damping, rotor and friction of the joint are
fitted to nine motions and judged on four that were not fitted; the other joints keep the numbers below. The level of
friction is set before every step:

    constant   F                      load     r |motor + gravity|      both      F + r |motor + gravity|
    motor      r |motor|              weight   r |gravity|              stribeck  F + S exp(-(v / s)^2)

(the library's load-dependent law is `load`: where the joint holds a weight, motor and gravity are alike). One line a
law: RMS of the joint's position by fitted and by unseen motions, mrad, the ratio of the squares to those of `constant`
with t over recordings of its logarithm, and the numbers.
"""

from __future__ import annotations

import argparse
import importlib
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

mujoco: Any = importlib.import_module("mujoco")  # its stubs name half of it
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")) / "so101_sage"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
PERIOD, STEPS = 0.02006, 4
COUNT = 4.4e-4  # rad, rounding to a count of the encoder: no motion is told better
FITTED = {
    "friction_gravity": (0.0,), "prbs_excitation": (0.0,), "chirp_sweep": (0.0,), "multisine": (0.0,),
    "backlash_detection": (0.0,), "single_joint_rotation": (0.0,), "single_joint_wrist_pitch": (0.0,),
    "large_amplitude": (0.0, 60.0), "single_joint_wrist_roll": (0.0,),
}  # fmt: skip
MOST = {"large_amplitude": 30.0, "single_joint_wrist_roll": 41.0, "single_joint_wrist_pitch": 73.0}  # s, each stretch
UNSEEN = ("step_response", "velocity_ramp", "slow_precision", "repetitive_motion")
# what the whole set gave: gain, damping, friction, by joint
OTHERS = (
    (16.1, 12.7, 11.2, 12.8, 28.3, 31.3),
    (1.29, 0.849, 0.762, 0.959, 1.88, 1.93),
    (0.151, 0.403, 0.440, 0.143, 0.279, 0.218),
)
# gain, damping, rotor, then the law's own numbers: starts
LAWS = {
    "constant": [(0.4,)],
    "load": [(0.2,), (0.5,)],
    "motor": [(0.4,), (1.0,)],
    "weight": [(0.4,), (1.0,)],
    "both": [(0.2, 0.2), (0.4, 0.05)],
    "stribeck": [(0.3, 0.15, 0.1), (0.3, 0.15, 0.4)],
}


def motion(name: str, first: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    z = np.load(DATA / f"{name}.npz")
    rows = slice(round(first / PERIOD), round((first + min(seconds, MOST.get(name, 108.0))) / PERIOD))
    both = [np.array(z[k][rows], float) for k in ("command", "q")]
    for x in both:
        x[:, 5] = -0.174533 + 1523 * 2 * np.pi / 4096 * x[:, 5]
    return both[0], both[1]


def arm() -> Any:
    model = mujoco.MjModel.from_xml_path(str(DATA / "so101.xml"))
    model.opt.timestep, model.opt.integrator = PERIOD / STEPS, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 50, 100, 1e-12  # 20 of the file: it creeps
    model.dof_solref[:], model.dof_solimp[:] = (2 * PERIOD / STEPS, 1.0), (0.9999, 0.9999, 1e-3, 0.5, 2.0)
    model.actuator_forcerange[:] = (-3.35, 3.35)
    model.actuator_forcelimited[:] = 1
    model.actuator_ctrllimited[:] = 0
    model.jnt_limited[:] = 0
    model.dof_armature[:] = 0.028
    kp, damping, friction = OTHERS
    for k in range(6):
        servo(model, k, kp[k], damping[k], 0.028)
    model.dof_frictionloss[:] = friction
    return model


def servo(model: Any, k: int, kp: float, damping: float, rotor: float) -> None:
    model.actuator_gainprm[k, 0], model.actuator_biasprm[k, :3] = kp, (0.0, -kp, 0.0)
    model.dof_damping[k], model.dof_armature[k] = damping, rotor


def level(law: str, own: np.ndarray, motor: float, gravity: float, rate: float) -> float:
    if law == "stribeck":
        return own[0] + own[1] * np.exp(-((rate / own[2]) ** 2))
    load = abs({"motor": motor, "weight": gravity}.get(law, motor + gravity))
    constant, ratio = {"constant": (own[0], 0.0), "both": own}.get(law, (0.0, own[0]))
    return constant + ratio * load


def run(model: Any, k: int, law: str, own: np.ndarray, command: np.ndarray, begin: np.ndarray) -> np.ndarray:
    """Position of joint `k` at every row."""
    data, found = mujoco.MjData(model), np.empty(len(command))
    data.qpos[:] = begin
    fixed, levels, step, kp = law == "constant", model.dof_frictionloss, mujoco.mj_step, model.actuator_gainprm[k, 0]
    levels[k] = own[0]
    mujoco.mj_forward(model, data)
    for row, u in enumerate(command):
        found[row] = data.qpos[k]
        data.ctrl[:] = u
        for _ in range(STEPS):
            if not fixed:
                motor = float(np.clip(kp * (u[k] - data.qpos[k]), -3.35, 3.35))
                gravity, rate = float(data.qfrc_bias[k]), float(data.qvel[k])  # gravity is that of 5 ms before
                levels[k] = max(level(law, own, motor, gravity, rate), 1e-6)
            step(model, data)
    return found


def errors(k: int, law: str, theta: np.ndarray, motions: list[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    model = arm()
    servo(model, k, *theta[:3])
    return [run(model, k, law, theta[3:], command, position[0]) - position[:, k] for command, position in motions]


def cost(k: int, law: str, theta: np.ndarray, motions: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Root of the mean square, mrad: every motion counts alike."""
    return 1e3 * float(np.sqrt(np.mean([np.mean(e**2) for e in errors(k, law, theta, motions)])))


def _simplex(count: int) -> np.ndarray:
    """Corners of the first simplex, logarithms: each number up by a fifth, the law's by a third."""
    return np.concatenate([np.zeros((1, count)), np.diag([0.2, 0.2, 0.4, *[0.3] * (count - 3)])])


def main(joint: str, laws: list[str], seconds: float, most: int) -> None:
    k = JOINTS.index(joint)
    fitted = [motion(name, first, seconds) for name, firsts in FITTED.items() for first in firsts]
    unseen = [motion(name, 0.0, seconds) for name in UNSEEN]
    base: list[np.ndarray] = []
    for law in dict.fromkeys(["constant", *laws]):
        begin, best = time.process_time(), (np.inf, np.zeros(3))
        for start in LAWS[law]:
            first = np.array([OTHERS[0][k], OTHERS[1][k], 0.028, *start])
            told = lambda x, law=law, first=first: cost(k, law, np.exp(x) * first, fitted)  # noqa: E731
            one = minimize(told, np.zeros(len(first)), method="Nelder-Mead", options={
                "maxfev": most, "xatol": 3e-3, "fatol": 1e-4, "initial_simplex": _simplex(len(first))})  # fmt: skip
            print(f"  {law} from {start}: {one.fun:.3f}, {one.nfev} runs, {time.process_time() - begin:.0f} CPU s",
                  flush=True)  # fmt: skip
            if one.fun < best[0]:
                best = one.fun, np.exp(one.x) * first
        squares = [
            np.array([np.mean(e**2) + COUNT**2 for e in errors(k, law, best[1], part)]) for part in (fitted, unseen)
        ]
        base = base or squares
        ratio = [np.log(new / old) for new, old in zip(squares, base, strict=True)]
        t = [x.mean() / (x.std(ddof=1) / np.sqrt(len(x))) if x.any() else 0.0 for x in ratio]
        rms = [1e3 * np.sqrt(x.mean()) for x in squares]
        times = [new.sum() / old.sum() for new, old in zip(squares, base, strict=True)]
        print(f"{joint} {law:<9} fitted {rms[0]:.2f} mrad, squares {times[0]:.2f} times, t {t[0]:.1f}; "
              f"unseen {rms[1]:.2f} mrad, {times[1]:.2f} times, t {t[1]:.1f}; "
              f"gain, damping, rotor, law {np.round(best[1], 4)}; by motion, mrad "
              f"{np.round(1e3 * np.sqrt(np.concatenate(squares)), 1)}", flush=True)  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("joint", choices=JOINTS)
    parser.add_argument("--laws", nargs="+", choices=list(LAWS), default=list(LAWS))
    parser.add_argument("--seconds", type=float, default=20.0, help="of each motion")
    parser.add_argument("--most", type=int, default=100, help="simulations of a fit")
    args = parser.parse_args()
    main(args.joint, args.laws, args.seconds, args.most)
