"""Several kinematic errors at once in one arm, and recordings of an arm that was not the same in all of them.

`hide_several` adds two or three effects of `postures` at places drawn at random, sometimes at one joint, and `differ`
lets one thing be different in the last recording: a joint's zero after a crash, a sensor that errs since, a marker that
was stuck on again or a tracker that was moved. Both know what is true, number by number. Pinocchio alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from . import postures
from .postures import NOISE, TOLERANCE, Arm, Name, Recording

SEVERAL = (
    "joint_offset",
    "link_geometry",
    "encoder_scale",
    "encoder_eccentricity",
    "gear_transmission_error",
    "joint_compliance",
    "link_compliance",
    "reversal_hysteresis",
    "backlash",
    "joint_coupling",
)
CHANGES = ("joint_offset", "encoder_eccentricity", "joint_compliance", "marker", "tracker")
AT_ONE_JOINT = 0.3  # of the sets have all their effects at one joint
SIZES = (3.0, 6.0, 15.0)  # sigmas of the noise
OFF = (6.0, 15.0)  # tolerances, of what a fit estimates anyway
MOVED = ((2e-3, 5e-3), (1e-3, 1e-2))  # m and rad, least and most, by which a marker or a tracker moves


class Truth(NamedTuple):
    """One effect that was hidden, and its numbers as far as they are plain: in rad, m and their units."""

    name: Name
    size: float
    values: Mapping[str, float]


class Hidden(NamedTuple):
    """What a case hides, and its recordings; `changed`: what the last recording has and the others do not."""

    truths: tuple[Truth, ...]
    changed: str
    recordings: tuple[Recording, ...]
    unknown: tuple[str, ...] = ("base_frame", "tool_frame")


def hide_several(arm: Arm, several: int, rng: np.random.Generator, count: int = 80, off: float = 0.6) -> Hidden:
    """`several` effects at once in `count` postures of an arm that is `off` tolerances off everywhere."""
    q, built = postures._postures(arm, rng, count), _built(arm, rng, off)
    joint = int(rng.integers(1, len(arm.joints) - 1)) if rng.random() < AT_ONE_JOINT else None
    truths, error = _several(arm, several, rng, q, built, joint)
    device = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3))
    seen = _seen([device * pose for pose in postures._poses(arm, q, built, error)], rng)
    return Hidden(truths, "", (Recording(postures.INTERVAL * np.arange(count), q, seen, False),))


def differ(arm: Arm, change: str | None, beside: int, rng: np.random.Generator, count: int = 40) -> Hidden:
    """Two or three recordings of `count` postures; the last has a `change`, all have `beside` effects."""
    runs = int(rng.integers(2, 4))
    q, built = postures._postures(arm, rng, runs * count), _built(arm, rng, 0.6)
    lasting = tuple(effect for effect in SEVERAL if effect != "reversal_hysteresis")  # the first posture has no history
    truths, error = _several(arm, beside, rng, q, built, None, lasting)
    device, tool = pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3)), pin.SE3.Identity()
    late = np.arange(len(q)) >= (runs - 1) * count
    if change in postures.EFFECTS:
        name, values, extra = _one(arm, str(change), _size(str(change), rng), rng, q, built)
        while name in [truth.name for truth in truths]:
            name, values, extra = _one(arm, str(change), _size(str(change), rng), rng, q, built)
        error = _sum(error, extra._replace(shift=extra.shift * late[:, None], twist=extra.twist * late[:, None, None]))
        if change == "joint_offset":
            by = float(extra.shift[0].sum())
            values = {"offset": values["offset"] - by, "change": by}
        truths = (*truths, Truth(name, 0.0, values))
    moved = _moved(rng) if change in ("marker", "tracker") else pin.SE3.Identity()
    places = {"marker": (device, moved), "tracker": (device * moved, tool)}.get(str(change), (device, tool))
    poses = postures._poses(arm, q, built, error)
    seen = _seen([places[0] * p * places[1] if last else device * p for p, last in zip(poses, late, strict=True)], rng)
    parts = [slice(k * count, (k + 1) * count) for k in range(runs)]
    time = postures.INTERVAL * np.arange(count)
    return Hidden(truths, change or "", tuple(Recording(time, q[p], seen[p], False) for p in parts))


def _several(
    arm: Arm,
    several: int,
    rng: np.random.Generator,
    q: np.ndarray,
    built: np.ndarray,
    joint: int | None,
    effects: tuple[str, ...] = SEVERAL,
):
    """`several` different effects, all at one `joint` where it is given, and the error of the postures."""
    truths, total = list[Truth](), postures._Error(np.zeros_like(q), np.zeros((*q.shape, 6)))
    while len(truths) < several:
        effect = str(rng.choice(effects))
        size = _size(effect, rng)
        name, values, error = _one(arm, effect, size, rng, q, built)
        there = joint is None or name[1][-1] == arm.joints[joint]
        if there and name not in [truth.name for truth in truths]:
            truths.append(Truth(name, size, values))
            total = _sum(total, error)
    return tuple(truths), total


def _size(effect: str, rng: np.random.Generator) -> float:
    return float(rng.choice(OFF if effect in postures.GEOMETRY else SIZES))


def _one(arm: Arm, effect: str, size: float, rng: np.random.Generator, q: np.ndarray, built: np.ndarray):
    """An effect at a place drawn at random: its name, its numbers with those of the robot as built, its error."""
    right, error = postures._placed(arm, effect, size, rng, q, np.zeros(len(q), bool), (2.5, 11.0))
    (name,) = right
    j = arm.joints.index(name[1][-1])
    return name, _values(arm, name, j, q, built[j], error), error


def _values(arm: Arm, name: Name, j: int, q: np.ndarray, built: np.ndarray, error) -> dict[str, float]:
    """The numbers of an effect that are plain; bendings are told in axes of the library's choice and left out."""
    effect, shift, axis = name[0], error.shift[:, j], postures._axis(arm, j)
    if effect == "joint_offset":
        return {"offset": float(shift[0] + built[3:] @ axis)}
    if effect == "link_geometry":
        twist = error.twist[0, j] + built
        across = [k for k in range(3) if np.abs(axis[k]) < 1e-9]
        return dict(zip("xyz", twist[:3].tolist(), strict=True)) | {"r" + "xyz"[k]: float(twist[3 + k]) for k in across}
    if effect in ("encoder_eccentricity", "gear_transmission_error"):
        order = error.order if effect == "gear_transmission_error" else 1.0
        waves = np.column_stack([np.sin(order * q[:, j]), np.cos(order * q[:, j])])
        sine, cosine = np.linalg.lstsq(waves, shift, rcond=None)[0].tolist()
        return {"amplitude": float(np.hypot(sine, cosine))}
    other = arm.joints.index(name[1][0])
    torque, _ = postures._gravity(arm, q, np.zeros(len(q), bool))
    before = np.vstack([q[:1], q[:-1]])
    field = {
        "encoder_scale": ("scale", q[:, j]),
        "joint_coupling": ("ratio", q[:, other]),
        "joint_compliance": ("compliance", torque[:, j]),
        "backlash": ("width", np.sign(torque[:, j])),
        "reversal_hysteresis": ("width", np.sign((q - before)[:, j])),
    }.get(effect)
    if field is None:
        return {}
    return {field[0]: float(field[1] @ shift / (field[1] @ field[1]))}


def _built(arm: Arm, rng: np.random.Generator, off: float) -> np.ndarray:
    """(joints, 6) how far each link is off, m and rad."""
    unit = np.array([TOLERANCE["m"]] * 3 + [TOLERANCE["rad"]] * 3)
    return off * unit * rng.normal(size=(len(arm.joints), 6))


def _moved(rng: np.random.Generator) -> pin.SE3:
    """How far a marker or a tracker moved."""
    (least, most), (low, high) = MOVED
    way, turn = rng.normal(size=3), rng.normal(size=3)
    place = rng.uniform(least, most) * way / np.linalg.norm(way)
    return pin.SE3(pin.exp3(rng.uniform(low, high) * turn / np.linalg.norm(turn)), place)


def _sum(one, other):
    return one._replace(shift=one.shift + other.shift, twist=one.twist + other.twist)


def _seen(poses: list[pin.SE3], rng: np.random.Generator) -> np.ndarray:
    """(postures, 3, 3) the three markers, m, with the noise of the tracker."""
    return postures._points(poses) + NOISE * rng.normal(size=(len(poses), 3, 3))
