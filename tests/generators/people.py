"""Simulated people: a human model in Pinocchio, sized and weighted as nobody's table says, with markers and plates.

Nothing of figaroh_jax is used. A person has segments of other lengths than the model (`spread`), inertial parameters
off the table's, moves every joint by sums of sines about a standing posture, and stands on two force plates whose sum
is what the motion needs. Markers slide with the skin and are seen with noise; the plates have noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

RATE = 100.0  # Hz


@dataclass
class Person:
    """The truth."""

    model: pin.Model
    nominal: pin.Model
    scale: dict[str, float]  # of each joint's link, by the joint's name
    markers: dict[str, tuple[str, np.ndarray]]  # by label the link's joint and its true place on the link, m


@dataclass
class Trial:
    """What is measured, and what was."""

    time: np.ndarray
    markers: dict[str, np.ndarray]  # by label (frames, 3), m
    plates: list[tuple[np.ndarray, np.ndarray]]  # pose, wrench on the person at and in the plate (frames, 6)
    q: np.ndarray  # true
    wrench: np.ndarray  # true, of both plates on the person, at and in the pelvis
    exact: list[tuple[np.ndarray, np.ndarray]]  # the plates without noise and zeros


def make_person(path: str, rng: np.random.Generator, spread: float = 0.12) -> Person:
    """A person with sizes and inertias that differ from the model's by `spread` (one sigma, at least 5 %)."""
    nominal = pin.buildModelFromUrdf(path, pin.JointModelFreeFlyer())
    model = nominal.copy()
    one = lambda: float(np.clip(abs(rng.normal(0, spread)), 0.05, 0.2) * rng.choice([-1, 1]))  # noqa: E731
    size = {name: 1.0 for name in nominal.names}
    for side in ("left", "right"):  # both sides alike but for two per cent
        for joints in ("hip_Y", "knee", "ankle_X", "clavicle_joint_X", "shoulder_Y", "elbow_Y", "wrist_X"):
            name = f"{side}_{joints}"
            size[name] = size["left_" + joints] * rng.normal(1, 0.02) if side == "right" else 1 + one()
    for name in ("root_joint", "middle_lumbar_X", "middle_abdomen_Y", "middle_thoracic_Y", "middle_cervical_Y"):
        size[name] = 1 + one()
    for j in range(1, model.njoints):
        parent = nominal.names[nominal.parents[j]]
        model.jointPlacements[j].translation = nominal.jointPlacements[j].translation * size.get(parent, 1.0)
        inertia, s = nominal.inertias[j], size[nominal.names[j]]
        if inertia.mass > 0:
            mass = inertia.mass * s * (1 + one())
            lever = inertia.lever * s * (1 + one()) + rng.normal(0, 0.004, 3)
            wider = np.diag(1 + np.array([one(), one(), one()]) / 2)  # along each axis: it stays a body that can exist
            values, axes = np.linalg.eigh(np.trace(inertia.inertia) / 2 * np.eye(3) - inertia.inertia)
            spread_out = (axes * np.maximum(values, 1e-3 * values.max())) @ axes.T  # the model's clavicles are none
            spread_out = wider @ spread_out @ wider * (mass / inertia.mass * s * s)
            about = np.trace(spread_out) * np.eye(3) - spread_out
            model.inertias[j] = pin.Inertia(mass, lever, about)
    return Person(model, nominal, size, {})


def put_markers(person: Person, places: dict[str, tuple[str, np.ndarray]], rng: np.random.Generator) -> None:
    """Markers at the model's places on the person's segments, put on with 4 mm of error."""
    for label, (joint, place) in places.items():
        person.markers[label] = joint, np.asarray(place) * person.scale[joint] + rng.normal(0, 0.004, 3)


def record(
    person: Person,
    rng: np.random.Generator,
    seconds: float = 20.0,
    tissue: float = 0.005,
    noise: float = 0.002,
    load: tuple[str, pin.Inertia] | None = None,
) -> Trial:
    """A trial: skin slides by `tissue` (m, with the motion and slowly), markers are seen to `noise` (m).

    `load`: a joint, and what the person carries on its link, about the joint's frame.
    """
    model, t = person.model, np.arange(int(seconds * RATE)) / RATE
    if load is not None:
        model = model.copy()
        model.inertias[model.getJointId(load[0])] += load[1]
    data, nv = model.createData(), model.nv
    lower, upper = model.lowerPositionLimit[7:], model.upperPositionLimit[7:]
    reach = np.minimum(0.45 * (upper - lower), 0.5)
    middle = np.clip(np.zeros_like(lower), lower + 0.5 * reach, upper - 0.5 * reach)
    terms = [
        (2 * np.pi * rng.uniform(0.1, 0.9, nv), rng.uniform(0, 6, nv), rng.uniform(0.2, 0.5, nv)) for _ in range(3)
    ]
    wave = sum(size * np.sin(np.outer(t, w) + phase) for w, phase, size in terms)
    amplitude = np.concatenate([[0.06, 0.06, 0.06], np.full(3, 0.25), 0.9 * reach / 2])
    v_of = lambda y: np.gradient(y, 1 / RATE, axis=0, edge_order=2)  # noqa: E731
    y = wave * amplitude
    q = np.zeros((len(t), model.nq))
    upright = pin.exp3(np.array([np.pi / 2, 0, 0]))  # the model's y is up, the world's z
    for k in range(len(t)):
        q[k, :3] = [0.1, 0.2, 1.0] + y[k, :3]
        q[k, 3:7] = pin.Quaternion(upright @ pin.exp3(y[k, 3:6])).coeffs()
    q[:, 7:] = middle + y[:, 6:]
    way = np.cumsum([np.zeros(nv)] + [pin.difference(model, a, b) for a, b in zip(q[:-1], q[1:], strict=True)], axis=0)
    v = v_of(way)
    a = v_of(v)
    root, pelvis = [], []
    seen = {label: np.empty((len(t), 3)) for label in person.markers}
    skin = {label: _skin(t, rng, tissue) for label in person.markers}
    for k in range(len(t)):
        root.append(pin.rnea(model, data, q[k], v[k], a[k])[:6])
        pin.forwardKinematics(model, data, q[k])
        pelvis.append(data.oMi[1].copy())
        for label, (joint, place) in person.markers.items():
            pose = data.oMi[model.getJointId(joint)]
            seen[label][k] = pose.act(place + skin[label][k]) + rng.normal(0, noise, 3)
    plates, exact = _plates(np.array(root), pelvis, t, rng)
    return Trial(t, seen, plates, q, np.array(root), exact)


def _skin(t: np.ndarray, rng: np.random.Generator, size: float) -> np.ndarray:
    """Sliding of a marker with the skin: a few slow waves, RMS `size` of the three axes together."""
    waves = [np.sin(2 * np.pi * np.outer(t, rng.uniform(0.1, 1.0, 3)) + rng.uniform(0, 6, 3)) for _ in range(3)]
    total = sum(waves)
    return size / np.sqrt(3) * total / total.std(0)


def _plates(root: np.ndarray, pelvis: list, t: np.ndarray, rng: np.random.Generator) -> tuple[list, list]:
    """Two plates under the feet that share the wrench, with noise (1.5 N, 0.4 N m) and a small zero; and without."""
    poses = [np.eye(4), np.eye(4)]
    poses[0][:3, 3], poses[1][:3, 3] = [0.0, 0.0, 0.0], [0.0, 0.4, 0.0]
    poses[1][:3, :3] = pin.exp3(np.array([0, 0, np.pi / 2]))
    share = 0.5 + 0.2 * np.sin(2 * np.pi * 0.23 * t)
    out, exact = [], []
    for pose, part in zip(poses, (share, 1 - share), strict=True):
        back = pin.SE3(pose).inverse()
        wrench = [(back * m).act(pin.Force(w * f)).vector for m, w, f in zip(pelvis, root, part, strict=True)]
        error = rng.normal(0, [1.5] * 3 + [0.4] * 3, (len(t), 6)) + rng.normal(0, [1.0] * 3 + [0.2] * 3)
        out.append((pose, np.array(wrench) + error))
        exact.append((pose, np.array(wrench)))
    return out, exact
