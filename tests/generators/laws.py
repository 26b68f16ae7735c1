"""The laws of the hidden effects: each family draws its place, signs and parameters and returns the effect, unscaled.

Equations of diagnosis, torque level, with the names of the contract; foreign families stand in no catalogue.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from . import robots
from .motion import Motion
from .scene import Array, Hidden, Scene


class Draw(NamedTuple):
    """What a family draws from: the robot, its true model, the motions of the case, and a random generator."""

    robot: robots.Robot
    model: pin.Model
    motions: Sequence[Motion]
    rng: np.random.Generator
    at: tuple[str, ...] | None  # the place, where the case asks for one

    def joint(self, first: int = 0, turning: bool = False) -> int:
        """A joint at random, not before `first`; `turning` leaves out slides."""
        if self.at:
            return self.robot.joints.index(self.at[0])
        fit = [j for j in range(first, self.robot.model.nv) if not (turning and self.robot.prismatic[j])]
        return int(self.rng.choice(fit))

    def sign(self) -> float:
        """+1 or -1."""
        return float(self.rng.choice([-1.0, 1.0]))

    def link(self, last: int = 2) -> int:
        """One of the last links: the farther out, the more of it stands in the torque."""
        if self.at:
            return self.robot.links.index(self.at[0])
        return self.robot.model.nv - 1 - int(self.rng.integers(last))


FAMILIES: dict[str, Callable[[Draw], Hidden]] = {}


def family(draw: Callable[[Draw], Hidden]) -> Callable[[Draw], Hidden]:
    """Register a family under the name of its function."""
    FAMILIES[draw.__name__] = draw
    return draw


def at_joint(d: Draw, joint: int, effect: str, law: Callable[[Scene], Array], parameters: Any, **more: Any) -> Hidden:
    """Effect whose torque at one joint is the scale times `law`."""

    def torque(scene: Scene, scale: float) -> Array:
        out = np.zeros_like(scene.q)
        out[:, joint] = scale * law(scene)
        return out

    return Hidden(effect, (d.robot.joints[joint],), (joint,), parameters, torque=torque, **more)


@family
def rotor_inertia(d: Draw) -> Hidden:
    j = d.joint(first=min(2, d.robot.model.nv - 1))
    return at_joint(d, j, "rotor_inertia", lambda s: s.a[:, j], lambda k: {"inertia": k})


@family
def torque_offset(d: Draw) -> Hidden:
    j, side = d.joint(), d.sign()
    return at_joint(d, j, "torque_offset", lambda s: np.full(len(s.time), side), lambda k: {"offset": side * k})


@family
def coupled_transmission(d: Draw) -> Hidden:
    turning = d.robot.prismatic
    pairs = [i for i in range(len(turning) - 1) if not (turning[i] or turning[i + 1])]
    i = d.robot.joints.index(d.at[0]) if d.at else int(d.rng.choice(pairs))
    j, sg = i + 1, d.sign()
    inertia, damping, dry = np.array([0.0096, 0.6, 1.9]) * d.rng.uniform(0.7, 1.3, 3)

    def torque(s: Scene, k: float) -> Array:
        out = np.zeros_like(s.q)
        reversal = np.sign(s.v[:, i] + sg * s.v[:, j])
        out[:, i] = sg * (inertia * s.a[:, j] + damping * s.v[:, j]) + dry * reversal
        out[:, j] = sg * (inertia * s.a[:, i] + damping * s.v[:, i]) + sg * dry * reversal
        return k * out

    def parameters(k: float) -> dict[str, float]:
        return {"inertia": k * inertia, "damping": k * damping, "friction": k * dry, "sign": sg}

    names = (d.robot.joints[i], d.robot.joints[j])
    return Hidden("coupled_transmission", names, (i, j), parameters, torque=torque)


@family
def asymmetric_coulomb_friction(d: Draw) -> Hidden:
    # F+ = Fc + difference where v > 0, F- = Fc - difference where v < 0
    j, side = d.joint(), d.sign()

    def law(s: Scene) -> Array:
        return side * (np.where(s.v[:, j] > 0, 1.0, 0.0) + np.where(s.v[:, j] < 0, 1.0, 0.0))

    return at_joint(d, j, "asymmetric_coulomb_friction", law, lambda k: {"difference": side * k})


@family
def asymmetric_viscous_friction(d: Draw) -> Hidden:
    j, side = d.joint(), d.sign()
    law = lambda s: side * np.abs(s.v[:, j])  # noqa: E731
    return at_joint(d, j, "asymmetric_viscous_friction", law, lambda k: {"difference": side * k})


@family
def stribeck_friction(d: Draw) -> Hidden:
    j, speed = d.joint(), float(np.exp(d.rng.uniform(np.log(0.08), np.log(0.3))))
    law = lambda s: np.exp(-((s.v[:, j] / speed) ** 2)) * s.sign(j)  # noqa: E731
    return at_joint(d, j, "stribeck_friction", law, lambda k: {"force": k, "speed": speed})


@family
def power_law_friction(d: Draw) -> Hidden:
    j = d.joint()
    exponent = float(d.rng.choice([d.rng.uniform(0.4, 0.6), d.rng.uniform(1.6, 2.8)]))
    law = lambda s: np.abs(s.v[:, j]) ** exponent * s.sign(j)  # noqa: E731
    return at_joint(d, j, "power_law_friction", law, lambda k: {"strength": k, "exponent": exponent})


@family
def load_dependent_friction(d: Draw) -> Hidden:
    j = d.joint()
    law = lambda s: np.abs(s.load[:, j]) * s.sign(j)  # noqa: E731
    return at_joint(d, j, "load_dependent_friction", law, lambda k: {"ratio": k}, bounds=(0, 0.5))


@family
def position_dependent_friction(d: Draw) -> Hidden:
    j, phase = d.joint(turning=True), float(d.rng.uniform(-np.pi, np.pi))
    law = lambda s: np.cos(s.q[:, j] + phase) * s.sign(j)  # noqa: E731
    parts = lambda k: {"cosine": k * np.cos(phase), "sine": -k * np.sin(phase)}  # noqa: E731
    return at_joint(d, j, "position_dependent_friction", law, parts)


@family
def torque_ripple(d: Draw) -> Hidden:
    j, order, phase = d.joint(turning=True), float(d.rng.uniform(8, 22)), float(d.rng.uniform(-np.pi, np.pi))
    law = lambda s: np.sin(order * s.q[:, j] + phase)  # noqa: E731
    parts = lambda k: {"sine": k * np.cos(phase), "cosine": k * np.sin(phase), "order": order}  # noqa: E731
    return at_joint(d, j, "torque_ripple", law, parts)


@family
def joint_spring(d: Draw) -> Hidden:
    j = d.joint()
    rest = float(d.motions[0].centre[j] + d.rng.uniform(-0.4, 0.4))
    law = lambda s: s.q[:, j] - rest  # noqa: E731
    return at_joint(d, j, "joint_spring", law, lambda k: {"stiffness": k, "rest": rest})


@family
def gravity_tilt(d: Draw) -> Hidden:
    heading = float(d.rng.uniform(-np.pi, np.pi))

    def change(model: pin.Model, k: float) -> pin.Model:
        # gravity as the tilted base sees it
        turn = pin.exp3(k * np.array([np.cos(heading), np.sin(heading), 0]))
        tilted = model.copy()
        tilted.gravity.linear = turn.T @ model.gravity.linear
        return tilted

    def parameters(k: float) -> dict[str, float]:
        return {"about_x": k * np.cos(heading), "about_y": k * np.sin(heading)}

    return Hidden("gravity_tilt", (), (), parameters, change=change, linear=False, bounds=(1e-5, 0.2))


@family
def payload(d: Draw) -> Hidden:
    j = d.link()
    com = np.array([0.02, -0.01, 0.08]) + 0.03 * d.rng.uniform(-1, 1, 3)
    body = robots.ten_of_body(1.0, com, d.rng.uniform(0.01, 0.04, 3))

    def parameters(k: float) -> dict[str, float]:
        return {"mass": k} | {f"com_{axis}": float(c) for axis, c in zip("xyz", com, strict=True)}

    change = lambda model, k: robots.add_ten(model, j, k * body)  # noqa: E731
    return Hidden("payload", (d.robot.links[j],), (), parameters, change=change, bounds=(1e-3, 20))


@family
def link_inertia(d: Draw) -> Hidden:
    # lighter than the model says: no body that is fixed to the link can be the reason
    j = d.link()
    nominal = robots.ten(d.model, j)
    shift = nominal * d.rng.uniform(0.5, 1.0, 10)
    names = ("mass", "mx", "my", "mz", "ixx", "ixy", "iyy", "ixz", "iyz", "izz")

    def parameters(k: float) -> dict[str, float]:
        return {name: float(-k * s) for name, s in zip(names, shift, strict=True)}

    change = lambda model, k: robots.add_ten(model, j, -k * shift)  # noqa: E731
    return Hidden("link_inertia", (d.robot.links[j],), (), parameters, change=change, bounds=(0, 0.7))


@family
def torque_gain(d: Draw) -> Hidden:
    j, side = d.joint(), d.sign()

    def record(torque: Array, k: float) -> Array:
        return torque * (1 + side * k * (np.arange(torque.shape[1]) == j))

    at = (d.robot.joints[j],)
    return Hidden("torque_gain", at, (j,), lambda k: {"gain": side * k}, record=record, bounds=(0, 0.5))


@family
def torque_delay(d: Draw) -> Hidden:
    warp = lambda time, k: time - k  # noqa: E731
    return Hidden("torque_delay", (), (), lambda k: {"delay": k}, warp=warp, linear=False, bounds=(2e-4, 0.02))


@family
def joint_elasticity(d: Draw) -> Hidden:
    j = d.joint()

    def windup(s: Scene, k: float) -> Array:
        return k * s.load * (np.arange(s.q.shape[1]) == j)

    at, parameters = (d.robot.joints[j],), lambda k: {"compliance": k}
    more: dict[str, Any] = {"motor_side": True, "linear": False, "bounds": (1e-7, 1e-2)}
    return Hidden("joint_elasticity", at, (j,), parameters, position=windup, **more)
