"""A person who stands on a plate: the model that begins there, and postures in balance, for motions by `excite`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from ..errors import InputError, nearest
from ..rigid.dynamics import inverse_dynamics
from ..rigid.inertia import transform
from ..rigid.kinematics import forward_kinematics
from ..rigid.model import Frame, Joint, RobotModel

__all__ = ["PLATE", "balanced", "standing"]

PLATE: tuple[str, ...] = (
    "plate_Fx",
    "plate_Fy",
    "plate_Fz",
    "plate_Tx",
    "plate_Ty",
    "plate_Tz",
)  # joints of `standing`
_PRESSED = 3e-3  # m of the centre of pressure that weigh as much as a joint's half range


def standing(
    robot: RobotModel,
    link: str,
    posture: Float[np.ndarray, " nq"],
    support: tuple[float, float] = (0.08, 0.04),
    plate: Float[np.ndarray, "4 4"] | None = None,
) -> RobotModel:
    """The person who stands with one link (a foot) on a plate, which does not move: for motions by `excite`.

    The tree begins at the plate with six joints without a mass, `PLATE`, that stand still; their forces (N) and torques
    (N m) are the plate's wrench at and in `plate` (its pose in the world; default: the link's place in `posture`, axes
    of the world). The other joints keep names, limits and their place in v; `posture` is one of the free `robot`, in
    the world. `support` is how far the sole reaches before and behind, and to either side of, the plate's frame (m):
    the centre of pressure of the body's weight stays in it where torques keep the model's limits. Hold both legs'
    joints and make the support larger for a person on two feet. Raises `InputError` for a robot that is not free, an
    unknown link, and joints of several axes. An example: `examples/person_on_a_plate.py`.
    """
    if robot.joints[0].kind != "free" or any(j.kind not in ("revolute", "prismatic") for j in robot.joints[1:]):
        raise InputError("standing: one free root and joints of one axis; load the model with root='free_flyer'")
    q = np.asarray(posture, float)
    if q.shape != (robot.nq,) or not np.isfinite(q).all():
        raise InputError(f"standing: posture has shape {q.shape}; ({robot.nq},) finite numbers are expected")
    first = robot.link_index(link)
    pose = np.asarray(forward_kinematics(robot, q))[first]
    if plate is None:
        plate = np.eye(4)
        plate[:3, 3] = pose[:3, 3]
    inside = np.linalg.inv(np.asarray(plate, float)) @ pose
    tree = _rerooted(robot, first, inside)
    weight = float(np.asarray(robot.inertia)[:, 0].sum() * np.linalg.norm(np.asarray(robot.gravity)))
    effort = np.array(robot.effort_limit, float)
    effort[:6] = [np.inf, np.inf, np.inf, weight * support[1], weight * support[0], np.inf]
    placement = np.array([plate, *[np.eye(4)] * 5, *tree.placement])
    eye = np.eye(3)
    joints = [Joint(PLATE[k], "revolute" if k > 2 else "prismatic", k - 1, k, f"{PLATE[k]}_link") for k in range(6)]
    joints[5] = joints[5]._replace(link=link)
    frames = [Frame(PLATE[5], 5), *tree.frames]
    return eqx.tree_at(
        lambda m: (m.placement, m.axis, m.inertia, m.ratio, m.offset, m.frame_placement, m.effort_limit),
        replace(robot, joints=(*joints, *tree.joints), frames=tuple(frames), name=f"{robot.name} on {link}"),
        (
            placement,
            np.concatenate([eye, eye, tree.axis]),
            np.concatenate([np.zeros((5, 10)), tree.inertia]),
            np.concatenate([np.ones(6), tree.ratio]),
            np.concatenate([np.zeros(6), tree.offset]),
            np.concatenate([np.eye(4)[None], tree.frame_placement]),
            effort,
        ),
    )


def balanced(
    person: RobotModel,
    near: Float[np.ndarray, " nv"] | None = None,
    hold: Sequence[str] = (),
    room: float = 0.1,
) -> Float[np.ndarray, " nv"]:
    """The posture of a `standing` person nearest to `near` whose weight presses on the middle of the support.

    A motion begins at rest, so this is where one may begin (`excite(start=...)`). `near` (rad; default: all zero) is
    measured in shares of the joints' ranges; `hold` names joints that stay as they are there, `room` is the share of
    each range that is left free at either end. Raises `InputError` for a model that is not of `standing`, and where no
    posture within the limits is in balance. An example: `examples/person_on_a_plate.py`.
    """
    if person.dof_names[:6] != PLATE:
        raise InputError(f"balanced: '{person.name}' does not stand on a plate; `standing` makes a model that does")
    given = np.zeros(person.nv) if near is None else np.asarray(near, float)
    if given.shape != (person.nv,) or not np.isfinite(given).all():
        raise InputError(f"balanced: near has shape {given.shape}; ({person.nv},) finite numbers are expected")
    unknown = sorted({*hold} - {*person.dof_names})
    if unknown:
        raise InputError(f"balanced: hold: no moving joint '{unknown[0]}'{nearest(unknown[0], person.dof_names)}")
    moved = np.array([k for k, name in enumerate(person.dof_names) if k > 5 and name not in hold], int)
    low, high = np.clip(np.asarray(person.position_limit, float)[moved].T, -np.pi, np.pi)
    half = (high - low) / 2
    low, high = low + 2 * room * half, high - 2 * room * half
    first = np.clip(given[moved], low + 1e-6 * half, high - 1e-6 * half)
    weight = float(np.asarray(person.inertia)[:, 0].sum() * np.linalg.norm(np.asarray(person.gravity)))
    step, count = 1e-5, len(moved)

    def off(x: np.ndarray) -> np.ndarray:  # of the centre of pressure, m
        q = np.tile(given, (len(x), 1))
        q[:, moved] = x
        return np.asarray(inverse_dynamics(person, q, 0 * q, 0 * q))[:, 3:5] / weight

    def residual(x: np.ndarray) -> np.ndarray:
        return np.concatenate([off(x[None])[0] / _PRESSED, (x - first) / half])

    def slope(x: np.ndarray) -> np.ndarray:
        both = off(np.concatenate([x + step * np.eye(count), x - step * np.eye(count)]))
        return np.concatenate([(both[:count] - both[count:]).T / (2 * step * _PRESSED), np.diag(1 / half)])

    found = least_squares(residual, first, slope, bounds=(low, high), ftol=1e-5)  # pyright: ignore[reportArgumentType]
    left = float(np.abs(off(found.x[None])).max())
    if left > 3 * _PRESSED:
        raise InputError(
            f"balanced: the centre of pressure stays {1e3 * left:.0f} mm off in the best posture within the limits;"
            " free more joints, or let the plate stand elsewhere"
        )
    given = given.copy()
    given[moved] = found.x
    return given


class _Tree(NamedTuple):
    """A tree that begins with the link behind joint 5; its first inertia is that link's."""

    joints: list[Joint]
    frames: list[Frame]
    placement: list[np.ndarray]
    axis: np.ndarray
    inertia: np.ndarray
    ratio: np.ndarray
    offset: np.ndarray
    frame_placement: np.ndarray


def _rerooted(robot: RobotModel, first: int, inside: Float[np.ndarray, "4 4"]) -> _Tree:
    """The tree of a free robot from another link on, whose frame stands at `inside` in the one that joint 5 moves.

    A joint on the way to the old root carries the link that carried it, by the opposite axis; that link's frame is then
    the joint's, so that what stands on it moves into that frame.
    """
    old = np.asarray(robot.placement, float)
    frame = {i: np.eye(4) for i in range(len(robot.joints))} | {first: inside}  # old frame of a link in its new one
    turned, link = [], first
    while link:  # joint `link` will carry its old parent
        turned.append(link)
        frame[robot.joints[link].parent] = np.linalg.inv(old[link])
        link = robot.joints[link].parent
    carries = {link: robot.joints[link].parent for link in turned}  # of each joint of the old tree
    below = {i: [k for k, j in enumerate(robot.joints) if j.parent == i and k not in carries] for i in frame}
    for link in turned:
        below[link].insert(0, link)  # the joint itself, towards the old root
    order, number, open_ = [], {first: 5}, [(joint, first) for joint in reversed(below[first])]
    while open_:  # depth first
        joint, parent = open_.pop()
        link = carries.get(joint, joint)
        number[link] = 6 + len(order)
        order.append((joint, link, parent))
        more = [k for k in below[link] if k != joint]
        open_ += [(k, link) for k in reversed(more)]
    pick = np.array([joint for joint, _, _ in order], int)
    axes = np.asarray(robot.axis, float)[robot.dofs.first[pick]]
    axes[[k for k, (joint, _, _) in enumerate(order) if joint in carries]] *= -1.0
    links = [first, *(link for _, link, _ in order)]
    inertia = [transform(np.asarray(robot.inertia[link], float), frame[link]) for link in links]
    places = [frame[parent] @ (np.eye(4) if joint in carries else old[joint]) for joint, _, parent in order]
    own = [frame[f.parent] if f.parent >= 0 else np.eye(4) for f in robot.frames]
    return _Tree(
        [
            robot.joints[joint]._replace(parent=number[parent], link=robot.joints[link].link)
            for joint, link, parent in order
        ],
        [f._replace(parent=number[f.parent] if f.parent >= 0 else -1) for f in robot.frames],
        places,
        axes,
        np.array(inertia),
        np.asarray(robot.ratio, float)[pick],
        np.asarray(robot.offset, float)[pick],
        np.stack([a @ b for a, b in zip(own, np.asarray(robot.frame_placement, float), strict=True)]),
    )
