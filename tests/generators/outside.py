"""Laws of the families that a library may leave out, and of foreign ones that stand in no catalogue."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from .laws import Draw, at_joint, family
from .scene import STEP, Array, Hidden, Scene

FOREIGN = ("vibration", "cross_joint_product", "bouc_wen_cable", "sticky_tooth")


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
    return at_joint(d, j, "friction_drift", law, parts)


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
    return at_joint(d, j, "vibration", law, lambda k: {"amplitude": k, "frequency": frequency})


@family
def cross_joint_product(d: Draw) -> Hidden:
    # foreign: a torque of two other joints' motion that no rigid body makes
    j, nv = d.joint(), d.robot.model.nv
    i, k = (j + 1) % nv, (j + 2) % nv
    centre = d.motions[0].centre
    law = lambda s: (s.q[:, i] - centre[i]) * s.v[:, k]  # noqa: E731
    return at_joint(d, j, "cross_joint_product", law, lambda size: {"strength": size})


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

    return at_joint(d, j, "bouc_wen_cable", law, lambda k: {"force": k, "reach": reach})


@family
def sticky_tooth(d: Draw) -> Hidden:
    # foreign: one damaged spot of a gear, felt in one direction only
    j = d.joint(turning=True)
    spot = float(d.motions[0].centre[j] + d.rng.uniform(-0.3, 0.3))
    law = lambda s: np.exp(-(((s.q[:, j] - spot) / 0.06) ** 2)) * (s.v[:, j] > 0)  # noqa: E731
    return at_joint(d, j, "sticky_tooth", law, lambda k: {"force": k, "spot": spot})
