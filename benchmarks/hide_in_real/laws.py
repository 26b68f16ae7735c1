"""The laws of the hidden effects, as torque that they add at the joints of a recorded motion.

Each family draws its place and its parameters; `scaled` finds the strength at which the effect has the wanted size: the
RMS of the added torque over the RMS torque of its joint in the fitted recordings (of the larger row of a pair; root
mean square over the joints that it moves, where it acts on the whole robot), both low-passed as the task does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

from .motion import Scene

Array = np.ndarray
PEAK = 1.0  # of the joint's RMS torque: more than that is no error of a model any more


@dataclass(frozen=True)
class Law:
    """An effect at a place; `torque(scene, k)` is what strength k adds, (samples, joints)."""

    effect: str
    at: tuple[str, ...]
    rows: tuple[int, ...]  # joints whose torque measures the size; empty: all that it moves
    torque: Callable[[Scene, float], Array]
    parameters: Callable[[float], dict[str, float]]
    bounds: tuple[float, float] = (0.0, np.inf)  # of the strength, where the effect stays physical
    linear: bool = True
    also: tuple[str, ...] = ()  # further names of the place: links that move with the one at the joint
    sizes: str = ""  # how the size of an answer is read, see scoring.py


class Draw(NamedTuple):
    """What a family draws from: the recordings' motions, the joints that move enough, and a random generator."""

    scenes: Sequence[Scene]
    moving: Sequence[int]
    rng: np.random.Generator

    @property
    def names(self) -> tuple[str, ...]:
        return self.scenes[0].joints

    def joint(self) -> int:
        return int(self.rng.choice(self.moving))

    def sign(self) -> float:
        return float(self.rng.choice([-1.0, 1.0]))

    def over(self, joint: int, what: str) -> Array:
        """One column of the fitted motions: "q", "v" or "a"."""
        return np.concatenate([getattr(s, what)[s.kept, joint] for s in self.scenes if s.fitted])


FAMILIES: dict[str, Callable[[Draw], Law | None]] = {}


def family(draw: Callable[[Draw], Law | None]) -> Callable[[Draw], Law | None]:
    """Register a family under the name of its function; it returns None where the draw suits no place."""
    FAMILIES[draw.__name__] = draw
    return draw


def scaled(draw: Draw, effect: str, size: float) -> tuple[Law, float] | None:
    """The effect drawn until it reaches `size` within its bounds, and its strength; None where it never does."""
    for _ in range(40):
        law = FAMILIES[effect](draw)
        if law is None:
            continue
        strength = _strength(law, draw.scenes, size)
        if strength is not None and _peak(law, draw.scenes, strength) < PEAK:
            return law, strength
    return None


def relative_size(law: Law, scenes: Sequence[Scene], strength: float) -> float:
    """Size of the effect at a strength, over the fitted recordings."""
    pairs = [(s.low(law.torque(s, strength))[s.kept], s.low(s.torque)[s.kept]) for s in scenes if s.fitted]
    added, whole = (np.sqrt(np.mean(np.concatenate(parts) ** 2, 0)) for parts in zip(*pairs, strict=True))
    ratio = added / whole
    if law.rows:
        return float(ratio[list(law.rows)].max())
    moved = ratio[ratio > 0.01 * ratio.max()] if ratio.max() > 0 else ratio
    return float(np.sqrt(np.mean(moved**2)))


def _peak(law: Law, scenes: Sequence[Scene], strength: float) -> float:
    """Largest torque that the effect adds at one of its joints, over the joint's RMS torque."""
    fitted = [s for s in scenes if s.fitted]
    added = np.concatenate([law.torque(s, strength)[s.kept] for s in fitted])
    whole = np.sqrt(np.mean(np.concatenate([s.torque[s.kept] for s in fitted]) ** 2, 0))
    rows = list(law.rows)
    return float(np.max(np.abs(added[:, rows]) / whole[rows])) if rows else 0.0


def _strength(law: Law, scenes: Sequence[Scene], size: float) -> float | None:
    low, high = law.bounds
    if law.linear:
        reached = relative_size(law, scenes, 1.0)
        found = size / reached if reached > 1e-12 else np.inf
        return float(found) if low < found < high else None
    ends = [relative_size(law, scenes, k) for k in (low, high)]
    if not ends[0] <= size <= ends[1]:
        return None
    for _ in range(30):  # bisection of the logarithm
        middle = float(np.sqrt(low * high))
        low, high = (middle, high) if relative_size(law, scenes, middle) < size else (low, middle)
    return float(np.sqrt(low * high))


def _at(draw: Draw, j: int, law: Callable[[Scene], Array], parameters: Callable[[float], dict[str, float]]) -> dict:
    """The fields of an effect whose torque at joint `j` is its strength times `law`."""

    def torque(scene: Scene, k: float) -> Array:
        out = np.zeros_like(scene.q)
        out[:, j] = k * law(scene)
        return out

    return {"at": (draw.names[j],), "rows": (j,), "torque": torque, "parameters": parameters}


@family
def rotor_inertia(d: Draw) -> Law:
    j = d.joint()
    return Law("rotor_inertia", **_at(d, j, lambda s: s.a[:, j], lambda k: {"inertia": k}), bounds=(0, 3))


@family
def torque_offset(d: Draw) -> Law:
    j, side = d.joint(), d.sign()
    return Law("torque_offset", **_at(d, j, lambda s: np.full(len(s.time), side), lambda k: {"offset": side * k}))


@family
def coupled_transmission(d: Draw) -> Law | None:
    taken = d.scenes[0].baseline_pair
    pairs = [(i, i + 1) for i in d.moving if i + 1 in d.moving and (i, i + 1) != taken]
    if not pairs:
        return None
    i, j = pairs[int(d.rng.integers(len(pairs)))]
    sg = d.sign()
    # the three parts weigh alike on this motion, up to a factor of two
    share = np.exp(d.rng.uniform(-0.35, 0.35, 3))
    rms = [np.sqrt(np.mean([np.mean(d.over(k, what) ** 2) for k in (i, j)])) for what in ("a", "v")]
    inertia, damping, dry = share / np.array([*rms, 1.0])

    def torque(s: Scene, k: float) -> Array:
        out = np.zeros_like(s.q)
        reversal = s.sign_of(s.v[:, i] + sg * s.v[:, j], (s.width[i] + s.width[j]) / 2)
        out[:, i] = sg * (inertia * s.a[:, j] + damping * s.v[:, j]) + dry * reversal
        out[:, j] = sg * (inertia * s.a[:, i] + damping * s.v[:, i]) + sg * dry * reversal
        return k * out

    def parameters(k: float) -> dict[str, float]:
        return {"inertia": k * inertia, "damping": k * damping, "friction": k * dry, "sign": sg}

    return Law("coupled_transmission", (d.names[i], d.names[j]), (i, j), torque, parameters)


@family
def asymmetric_viscous_friction(d: Draw) -> Law:
    j, side = d.joint(), d.sign()
    parts = lambda k: {"difference": side * k}  # noqa: E731
    return Law("asymmetric_viscous_friction", **_at(d, j, lambda s: side * np.abs(s.v[:, j]), parts))


@family
def stribeck_friction(d: Draw) -> Law:
    j = d.joint()
    top = np.quantile(np.abs(d.over(j, "v")), 0.98)
    speed = float(np.clip(top * np.exp(d.rng.uniform(np.log(0.06), np.log(0.2))), 0.03, 0.4))
    law = lambda s: np.exp(-((s.v[:, j] / speed) ** 2)) * s.sign[:, j]  # noqa: E731
    return Law("stribeck_friction", **_at(d, j, law, lambda k: {"force": k, "speed": speed}))


@family
def power_law_friction(d: Draw) -> Law:
    j = d.joint()
    exponent = float(d.rng.choice([d.rng.uniform(0.4, 0.6), d.rng.uniform(1.6, 2.8)]))
    law = lambda s: np.abs(s.v[:, j]) ** exponent * s.sign[:, j]  # noqa: E731
    return Law("power_law_friction", **_at(d, j, law, lambda k: {"strength": k, "exponent": exponent}))


@family
def load_dependent_friction(d: Draw) -> Law:
    j = d.joint()
    law = lambda s: np.abs(s.load[:, j]) * s.sign[:, j]  # noqa: E731
    return Law("load_dependent_friction", **_at(d, j, law, lambda k: {"ratio": k}), bounds=(0, 0.5))


@family
def position_dependent_friction(d: Draw) -> Law:
    j, phase = d.joint(), float(d.rng.uniform(-np.pi, np.pi))
    law = lambda s: np.cos(s.q[:, j] + phase) * s.sign[:, j]  # noqa: E731
    parts = lambda k: {"cosine": k * np.cos(phase), "sine": -k * np.sin(phase)}  # noqa: E731
    return Law("position_dependent_friction", **_at(d, j, law, parts))


@family
def torque_ripple(d: Draw) -> Law | None:
    # at least two periods over the range; most of it slow enough to pass the task's low pass
    j = d.joint()
    low = max(4 * np.pi / np.ptp(d.over(j, "q")), 3.2)
    high = min(2 * np.pi * 0.7 * d.scenes[0].cutoff / np.sqrt(np.mean(d.over(j, "v") ** 2)), 26.0)
    if high < low:
        return None
    order, phase = float(d.rng.uniform(low, high)), float(d.rng.uniform(-np.pi, np.pi))
    law = lambda s: np.sin(order * s.q[:, j] + phase)  # noqa: E731
    parts = lambda k: {"sine": k * np.cos(phase), "cosine": k * np.sin(phase), "order": order}  # noqa: E731
    return Law("torque_ripple", **_at(d, j, law, parts))


@family
def joint_spring(d: Draw) -> Law:
    j = d.joint()
    q = d.over(j, "q")
    rest = float(np.mean(q) + d.rng.uniform(-0.4, 0.4) * np.ptp(q) / 2)
    return Law("joint_spring", **_at(d, j, lambda s: s.q[:, j] - rest, lambda k: {"stiffness": k, "rest": rest}))


@family
def gravity_tilt(d: Draw) -> Law:
    # a pendulum feels a tilt about its own axis alone
    heading = float(d.rng.choice([0.0, np.pi])) if len(d.names) < 3 else float(d.rng.uniform(-np.pi, np.pi))

    def torque(s: Scene, k: float) -> Array:
        # gravity as the tilted base sees it
        turn = pin.exp3(k * np.array([np.cos(heading), np.sin(heading), 0]))
        return s.with_gravity(turn.T @ s.gravity) - s.load

    parts = lambda k: {"about_x": k * np.cos(heading), "about_y": k * np.sin(heading)}  # noqa: E731
    return Law("gravity_tilt", (), (), torque, parts, bounds=(1e-4, 0.3), linear=False)


@family
def payload(d: Draw) -> Law:
    j = len(d.names) - 1 - int(d.rng.integers(min(2, len(d.names))))
    com = np.array([0.02, -0.01, 0.08]) + 0.03 * d.rng.uniform(-1, 1, 3)
    radius = d.rng.uniform(0.01, 0.04, 3)
    spread = np.diag(radius**2) + np.outer(com, com)
    inertia = np.trace(spread) * np.eye(3) - spread
    ten = np.array([1.0, *com, *(inertia[i, k] for i, k in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))])
    links = d.scenes[0].links[j]

    def parameters(k: float) -> dict[str, float]:
        return {"mass": k} | {f"com_{axis}": float(c) for axis, c in zip("xyz", com, strict=True)}

    torque = lambda s, k: k * s.of_body(j, ten)  # noqa: E731
    return Law("payload", links[:1], (), torque, parameters, bounds=(1e-3, 20), also=links[1:])


@family
def torque_delay(d: Draw) -> Law:
    def torque(s: Scene, k: float) -> Array:
        return np.stack([np.interp(s.time - k, s.time, column) for column in s.torque.T], 1) - s.torque

    return Law("torque_delay", (), (), torque, lambda k: {"delay": k}, bounds=(2e-4, 0.05), linear=False)


@family
def torque_saturation(d: Draw) -> Law:
    j = d.joint()
    top = float(max(np.abs(s.torque[s.kept, j]).max() for s in d.scenes if s.fitted))

    def torque(s: Scene, k: float) -> Array:
        out = np.zeros_like(s.q)
        out[:, j] = np.clip(s.torque[:, j], -top / k, top / k) - s.torque[:, j]
        return out

    bounds, parts = (1.0, 6.0), lambda k: {"limit": top / k}
    return Law("torque_saturation", (d.names[j],), (j,), torque, parts, bounds, linear=False)


@family
def friction_drift(d: Draw) -> Law:
    # friction that fades while the gear warms up; a recording that is the end of another one begins warm
    j = d.joint()
    time = float(d.rng.uniform(4, 15))
    law = lambda s: (s.sign[:, j] + s.v[:, j]) * np.exp(-(s.time - s.began) / time)  # noqa: E731
    return Law("friction_drift", **_at(d, j, law, lambda k: {"force": k, "damping": k, "time": time}))


# twelve for every robot; the others stand in where a robot has no place for one of them, or are asked for
TWELVE = (
    "rotor_inertia",
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
    "torque_delay",
)
