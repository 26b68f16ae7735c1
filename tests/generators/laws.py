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
from .scene import STEP, Array, Hidden, Scene


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


def _at_joint(d: Draw, joint: int, effect: str, law: Callable[[Scene], Array], parameters: Any, **more: Any) -> Hidden:
    """Effect whose torque at one joint is the scale times `law`."""

    def torque(scene: Scene, scale: float) -> Array:
        out = np.zeros_like(scene.q)
        out[:, joint] = scale * law(scene)
        return out

    return Hidden(effect, (d.robot.joints[joint],), (joint,), parameters, torque=torque, **more)


@family
def rotor_inertia(d: Draw) -> Hidden:
    j = d.joint(first=min(2, d.robot.model.nv - 1))
    return _at_joint(d, j, "rotor_inertia", lambda s: s.a[:, j], lambda k: {"inertia": k})


@family
def torque_offset(d: Draw) -> Hidden:
    j, side = d.joint(), d.sign()
    return _at_joint(d, j, "torque_offset", lambda s: np.full(len(s.time), side), lambda k: {"offset": side * k})


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

    return _at_joint(d, j, "asymmetric_coulomb_friction", law, lambda k: {"difference": side * k})


@family
def asymmetric_viscous_friction(d: Draw) -> Hidden:
    j, side = d.joint(), d.sign()
    law = lambda s: side * np.abs(s.v[:, j])  # noqa: E731
    return _at_joint(d, j, "asymmetric_viscous_friction", law, lambda k: {"difference": side * k})


@family
def stribeck_friction(d: Draw) -> Hidden:
    j, speed = d.joint(), float(np.exp(d.rng.uniform(np.log(0.08), np.log(0.3))))
    law = lambda s: np.exp(-((s.v[:, j] / speed) ** 2)) * s.sign(j)  # noqa: E731
    return _at_joint(d, j, "stribeck_friction", law, lambda k: {"force": k, "speed": speed})


@family
def power_law_friction(d: Draw) -> Hidden:
    j = d.joint()
    exponent = float(d.rng.choice([d.rng.uniform(0.4, 0.6), d.rng.uniform(1.6, 2.8)]))
    law = lambda s: np.abs(s.v[:, j]) ** exponent * s.sign(j)  # noqa: E731
    return _at_joint(d, j, "power_law_friction", law, lambda k: {"strength": k, "exponent": exponent})


@family
def load_dependent_friction(d: Draw) -> Hidden:
    j = d.joint()
    law = lambda s: np.abs(s.load[:, j]) * s.sign(j)  # noqa: E731
    return _at_joint(d, j, "load_dependent_friction", law, lambda k: {"ratio": k}, bounds=(0, 0.5))


@family
def position_dependent_friction(d: Draw) -> Hidden:
    j, phase = d.joint(turning=True), float(d.rng.uniform(-np.pi, np.pi))
    law = lambda s: np.cos(s.q[:, j] + phase) * s.sign(j)  # noqa: E731
    parts = lambda k: {"cosine": k * np.cos(phase), "sine": -k * np.sin(phase)}  # noqa: E731
    return _at_joint(d, j, "position_dependent_friction", law, parts)


@family
def torque_ripple(d: Draw) -> Hidden:
    j, order, phase = d.joint(turning=True), float(d.rng.uniform(8, 22)), float(d.rng.uniform(-np.pi, np.pi))
    law = lambda s: np.sin(order * s.q[:, j] + phase)  # noqa: E731
    parts = lambda k: {"sine": k * np.cos(phase), "cosine": k * np.sin(phase), "order": order}  # noqa: E731
    return _at_joint(d, j, "torque_ripple", law, parts)


@family
def joint_spring(d: Draw) -> Hidden:
    j = d.joint()
    rest = float(d.motions[0].centre[j] + d.rng.uniform(-0.4, 0.4))
    law = lambda s: s.q[:, j] - rest  # noqa: E731
    return _at_joint(d, j, "joint_spring", law, lambda k: {"stiffness": k, "rest": rest})


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


@family
def torque_lag(d: Draw) -> Hidden:
    def record(torque: Array, k: float) -> Array:
        # exact for a torque that is straight between samples
        decay = np.exp(-STEP / k)
        now = 1 - k / STEP * (1 - decay)
        out = np.empty_like(torque)
        out[0] = torque[0]
        for i in range(1, len(torque)):
            out[i] = decay * out[i - 1] + now * torque[i] + (1 - decay - now) * torque[i - 1]
        return out

    return Hidden("torque_lag", (), (), lambda k: {"time": k}, record=record, linear=False, bounds=(2e-4, 0.05))


@family
def torque_saturation(d: Draw) -> Hidden:
    j = d.joint()

    def record(torque: Array, k: float) -> Array:
        out = torque.copy()
        out[:, j] = np.clip(out[:, j], -1 / k, 1 / k)
        return out

    at, parameters = (d.robot.joints[j],), lambda k: {"limit": 1 / k}
    return Hidden("torque_saturation", at, (j,), parameters, record=record, linear=False, bounds=(1e-3, 10))


@family
def presliding(d: Draw) -> Hidden:
    j = d.joint()

    def torque(s: Scene, k: float) -> Array:
        # z' = (v / k)(1 - z s(v)): exact over a step of constant velocity
        out, z = np.zeros_like(s.q), 0.0
        dry, v = s.robot.coulomb[j], s.v[:, j]
        for i, (way, decay) in enumerate(zip(np.sign(v), np.exp(-np.abs(v) * STEP / k), strict=True)):
            z = way + (z - way) * decay if way else z
            out[i, j] = dry * (z - way)
        return out

    parameters = lambda k: {"force": float(d.robot.coulomb[j]), "distance": k}  # noqa: E731
    at = (d.robot.joints[j],)
    return Hidden("presliding", at, (j,), parameters, torque=torque, linear=False, bounds=(1e-4, 0.3))


@family
def friction_drift(d: Draw) -> Hidden:
    j, time = d.joint(), float(d.rng.uniform(4, 15))
    dry, damping = d.robot.coulomb[j], d.robot.viscous[j]
    law = lambda s: (dry * s.sign(j) + damping * s.v[:, j]) * np.exp(-s.time / time)  # noqa: E731
    parts = lambda k: {"force": k * dry, "damping": k * damping, "time": time}  # noqa: E731
    return _at_joint(d, j, "friction_drift", law, parts)


def _tip(model: pin.Model, rows: Array) -> tuple[Array, Array]:
    """World position of a point .1 m beyond the last joint and its linear Jacobian, for each posture."""
    model = model.copy()
    offset = pin.SE3(np.eye(3), np.array([0, 0, 0.1]))
    tip = model.addFrame(pin.Frame("generator_tip", model.nv, offset, pin.FrameType.OP_FRAME))
    data = model.createData()
    points, jacobians = [], []
    for q in rows:
        jacobians.append(pin.computeFrameJacobian(model, data, q, tip, pin.LOCAL_WORLD_ALIGNED)[:3].copy())
        pin.forwardKinematics(model, data, q)
        pin.updateFramePlacements(model, data)
        points.append(data.oMf[tip].translation.copy())
    return np.array(points), np.array(jacobians)


@family
def contact(d: Draw) -> Hidden:
    times = np.arange(0, 10, 0.05)
    heights = np.concatenate([_tip(d.model, m.at(times)[0])[0][:, 2] for m in d.motions])
    level = float(np.quantile(heights, 0.2))

    def torque(s: Scene, k: float) -> Array:
        points, jacobians = _tip(s.model, s.q)
        return -jacobians[:, 2] * k * np.maximum(0, level - points[:, 2])[:, None]

    parameters = lambda k: {"stiffness": k, "height": level}  # noqa: E731
    return Hidden("contact", (d.robot.links[-1],), (), parameters, torque=torque)


@family
def external_wrench(d: Draw) -> Hidden:
    direction = np.array([0.7, -0.5, 0.4]) * d.sign() + 0.2 * d.rng.uniform(-1, 1, 3)

    def torque(s: Scene, k: float) -> Array:
        return -k * np.einsum("sij,i->sj", _tip(s.model, s.q)[1], direction)

    parameters = lambda k: {f"force_{axis}": float(k * f) for axis, f in zip("xyz", direction, strict=True)}  # noqa: E731
    return Hidden("external_wrench", (d.robot.links[-1],), (), parameters, torque=torque)


def _reading(d: Draw, effect: str, parameters: Any, law: Callable[[Array], Array], j: int, limit: float) -> Hidden:
    """Error of one joint's position reading: the scale times `law` of the position."""

    def position(s: Scene, k: float) -> Array:
        out = np.zeros_like(s.q)
        out[:, j] = k * law(s.q[:, j])
        return out

    at = (d.robot.joints[j],)
    return Hidden(effect, at, (j,), parameters, position=position, linear=False, bounds=(1e-6, limit))


@family
def encoder_offset(d: Draw) -> Hidden:
    j, side = d.joint(first=1), d.sign()
    return _reading(d, "encoder_offset", lambda k: {"offset": side * k}, lambda q: np.full_like(q, side), j, 0.1)


@family
def encoder_scale(d: Draw) -> Hidden:
    j, side = d.joint(first=1), d.sign()
    return _reading(d, "encoder_scale", lambda k: {"scale": side * k}, lambda q: side * q, j, 0.1)


@family
def encoder_eccentricity(d: Draw) -> Hidden:
    j, phase = d.joint(first=1, turning=True), float(d.rng.uniform(-np.pi, np.pi))
    parts = lambda k: {"sine": k * np.cos(phase), "cosine": k * np.sin(phase)}  # noqa: E731
    return _reading(d, "encoder_eccentricity", parts, lambda q: np.sin(q + phase), j, 0.02)


@family
def backlash(d: Draw) -> Hidden:
    j = d.joint(first=1)

    def gap(s: Scene, k: float) -> Array:
        # the play is crossed in about 10 ms
        side = np.sign(s.load[:, j])
        kernel = np.hanning(21)[1:-1]
        out = np.zeros_like(s.q)
        out[:, j] = k / 2 * np.convolve(np.pad(side, 9, mode="edge"), kernel / kernel.sum(), "valid")
        return out

    at, parameters = (d.robot.joints[j],), lambda k: {"width": k}
    more: dict[str, Any] = {"motor_side": True, "linear": False, "bounds": (1e-6, 0.02)}
    return Hidden("backlash", at, (j,), parameters, position=gap, **more)


@family
def clock_error(d: Draw) -> Hidden:
    side = d.sign()
    warp = lambda time, k: time * (1 + side * k)  # noqa: E731
    parameters = lambda k: {"rate": side * k}  # noqa: E731
    return Hidden("clock_error", (), (), parameters, warp=warp, linear=False, bounds=(1e-6, 5e-3))


@family
def vibration(d: Draw) -> Hidden:
    # foreign: a machine nearby; its phase differs in each recording
    j, frequency = d.joint(), float(d.rng.uniform(3, 9))
    law = lambda s: np.sin(2 * np.pi * (frequency * s.time + s.phase))  # noqa: E731
    return _at_joint(d, j, "vibration", law, lambda k: {"amplitude": k, "frequency": frequency})


@family
def cross_joint_product(d: Draw) -> Hidden:
    # foreign: a torque of two other joints' motion that no rigid body makes
    j, nv = d.joint(), d.robot.model.nv
    i, k = (j + 1) % nv, (j + 2) % nv
    centre = d.motions[0].centre
    law = lambda s: (s.q[:, i] - centre[i]) * s.v[:, k]  # noqa: E731
    return _at_joint(d, j, "cross_joint_product", law, lambda size: {"strength": size})


@family
def bouc_wen_cable(d: Draw) -> Hidden:
    # foreign: hysteresis of a cable or hose
    j, reach = d.joint(), float(d.rng.uniform(0.1, 0.3))

    def law(s: Scene) -> Array:
        out, z = np.zeros(len(s.time)), 0.0
        for i, v in enumerate(s.v[:, j]):
            z += STEP * (v - 0.6 * abs(v) * abs(z) * z / reach**2 - 0.4 * v * z * z / reach**2)
            out[i] = z / reach
        return out

    return _at_joint(d, j, "bouc_wen_cable", law, lambda k: {"force": k, "reach": reach})


@family
def sticky_tooth(d: Draw) -> Hidden:
    # foreign: one damaged spot of a gear, felt in one direction only
    j = d.joint(turning=True)
    spot = float(d.motions[0].centre[j] + d.rng.uniform(-0.3, 0.3))
    law = lambda s: np.exp(-(((s.q[:, j] - spot) / 0.06) ** 2)) * (s.v[:, j] > 0)  # noqa: E731
    return _at_joint(d, j, "sticky_tooth", law, lambda k: {"force": k, "spot": spot})
