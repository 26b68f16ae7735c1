"""Cases by forward simulation (G2): MuJoCo C under a tracking controller; the torque is what the drive applied."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin

from . import plant, robots, scene
from .case import Case, Truth
from .inverse import Wanted, choose, hide, noisy
from .laws import Hidden
from .motion import PERIOD, Motion, excitation, tracked
from .plant import CONTROL, DT, Physics, Structure

CLOSED_LOOP_EFFECTS = (
    "rotor_inertia",
    "torque_offset",
    "coupled_transmission",
    "asymmetric_viscous_friction",
    "stribeck_friction",
    "power_law_friction",
    "load_dependent_friction",
    "position_dependent_friction",
    "torque_ripple",
    "joint_spring",
    "gravity_tilt",
    "payload",
    "torque_gain",
    "torque_delay",
)
WARM_UP = 2.0  # s before the recording
Array = np.ndarray


def make_closed_loop_case(
    effects: Sequence[Wanted] = (),
    robot: str = "tx40",
    repeats: int = 2,
    trajectories: int = 3,
    noise: float = 1.0,
    seed: int = 0,
    *,
    holdout: bool = False,
    trusted: bool | None = None,
    duration: float = PERIOD,
) -> Case:
    """As `inverse.make_case`, the motion and torque being those of a simulated controller (names above).

    Effects are drawn and sized by `inverse` on the desired motion. A coupled transmission gives every joint a rotor,
    which the task then declares in its baseline.
    """
    (wanted, trusted), streams = choose(effects, trusted), np.random.SeedSequence(seed).spawn(4)
    rngs = [np.random.default_rng(s) for s in streams]
    made = robots.load(robot)
    model = robots.true_robot(made.model, 0.01 if trusted else 0.05, rngs[0])
    motions = [excitation(model, rngs[1]) for _ in range(trajectories + holdout)]
    time = scene.grid(duration)
    fit = motions[:trajectories]
    hidden = [_hide_one(made, model, fit, time, rngs[2], item) for item in wanted]
    runs = []
    for number, motion in enumerate(motions):
        held = number >= trajectories
        for repeat in range(1 if held else repeats):
            run = _run(made, model, tracked(motion, rngs[3]), hidden, duration)
            label = chr(ord("A") + number)
            run["name"] = f"holdout_{label}" if held else f"run_{label}{repeat + 1}"
            run |= {"repeat": label if repeats > 1 and not held else None, "role": "holdout" if held else "fit"}
            runs.append(run)
    truth = tuple(Truth(h.effect, h.at, h.parameters(h.scale)) for h in hidden)
    recordings = noisy(runs, rngs[3], noise, "ar20", 1e-5)
    baseline = {"rotor": True} if any(h.effect == "coupled_transmission" for h in hidden) else {}
    trust = 0.02 if trusted else 0.10
    return Case(robot, made.urdf, made.joints, recordings, truth, trust, seed, {}, baseline)


def _hide_one(
    made: robots.Robot, model: pin.Model, fit: list[Motion], time: Array, rng: np.random.Generator, item: Any
) -> Hidden:
    if item[0] not in CLOSED_LOOP_EFFECTS:
        raise ValueError(f"'{item[0]}' has no closed-loop form; known: {', '.join(CLOSED_LOOP_EFFECTS)}")
    return hide(made, model, fit, time, rng, *item)


def _run(made: robots.Robot, model: pin.Model, motion: Motion, hidden: list[Hidden], duration: float) -> dict[str, Any]:
    """One recording at 250 Hz: means over 4 ms of position and of the torque that the drive applied."""
    physics, structure, changed, late, gain = _physics(made, model, hidden)
    compiled = mujoco.MjModel.from_xml_string(plant.mjcf(changed, made, structure))
    time = np.arange(-WARM_UP, duration + 0.1, DT * CONTROL)
    q, v, a = motion.at(time)
    # the controller knows the nominal robot and its friction, not what is hidden
    forward = robots.torque(made.model, q, v, a) + made.viscous * v + made.coulomb * np.clip(v / 0.02, -1, 1)
    inertia = plant.inertia_along(made.model, structure.armature, q)
    reading, torque = plant.track(compiled, physics, (q, v), forward, inertia)
    fine = -WARM_UP + DT * np.arange(len(torque))
    position = (reading[:-1] + reading[1:]) / 2  # in the middle of the step in which the torque acts
    shifted = np.stack([np.interp(fine[:-1] - late, fine[:-1], column) for column in torque[:-1].T], 1)
    window = int(round(4e-3 / DT))
    first = int(round(WARM_UP / DT))
    rows = int(round(duration / 4e-3))

    def mean(x: Array) -> Array:
        return x[first : first + rows * window].reshape(rows, window, -1).mean(1)

    stamps = mean(fine[:-1, None] + DT / 2)[:, 0]
    return {"time": stamps, "position": mean(position), "torque": mean(shifted) * gain}


def _physics(
    made: robots.Robot, model: pin.Model, hidden: list[Hidden]
) -> tuple[Physics, Structure, pin.Model, float, Array]:
    """The plant with the hidden effects in it: physics, structure, bodies; delay and gain of the torque sensor."""
    nv = model.nv
    coupled = any(h.effect == "coupled_transmission" for h in hidden)
    armature = 0.3 * np.diag(pin.crba(model, model.createData(), pin.neutral(model))) if coupled else np.zeros(nv)
    physics = Physics(made.viscous.copy(), [lambda q, v, load: made.coulomb])
    pair, springs, late, gain = None, {}, 0.0, np.ones(nv)
    for h in hidden:
        p = h.parameters(h.scale)
        j = made.joints.index(h.at[0]) if h.at and h.at[0] in made.joints else -1
        here = np.arange(nv) == j
        if h.effect in LEVELS:
            physics.levels.append(_placed_level(LEVELS[h.effect], p, j, here))
            physics.needs_load |= h.effect == "load_dependent_friction"
        elif h.effect in TORQUES:
            physics.torques.append(_placed_torque(TORQUES[h.effect], p, j, here))
        elif h.effect == "coupled_transmission":
            sign = p["sign"]
            pair = (h.rows[0], h.rows[1], sign, p["inertia"])
            physics.coupling, physics.sign = (p["damping"], p["friction"]), sign
        elif h.effect == "rotor_inertia":
            armature = armature + p["inertia"] * here
        elif h.effect == "joint_spring":
            springs[j] = (p["stiffness"], p["rest"])
        elif h.effect == "torque_delay":
            late = p["delay"]
        elif h.effect == "torque_gain":
            gain = gain + p["gain"] * here
        elif h.change:
            model = h.change(model, h.scale)
    return physics, Structure(armature, pair, springs), model, late, gain


# laws of one joint: level of dry friction from (q, v, load), torque of the drive from (q, v)
LEVELS = {
    "stribeck_friction": lambda p, q, v, load: p["force"] * np.exp(-((v / p["speed"]) ** 2)),
    "power_law_friction": lambda p, q, v, load: p["strength"] * abs(v) ** p["exponent"],
    "load_dependent_friction": lambda p, q, v, load: p["ratio"] * abs(load),
    "position_dependent_friction": lambda p, q, v, load: p["cosine"] * np.cos(q) + p["sine"] * np.sin(q),
}
TORQUES = {
    "torque_offset": lambda p, q, v: p["offset"],
    "asymmetric_viscous_friction": lambda p, q, v: p["difference"] * abs(v),
    "torque_ripple": lambda p, q, v: p["sine"] * np.sin(p["order"] * q) + p["cosine"] * np.cos(p["order"] * q),
}


def _placed_level(law: Any, p: dict[str, float], j: int, here: Array) -> Any:
    return lambda q, v, load: here * law(p, q[j], v[j], load[j])


def _placed_torque(law: Any, p: dict[str, float], j: int, here: Array) -> Any:
    return lambda q, v: here * law(p, q[j], v[j])
