"""A static picture of the robot: an SVG of its links as lines, the joints that a finding names in colour.

Seen from the side that shows most of the robot, with the nominal one beside a corrected one where they differ.
"""

from __future__ import annotations

from collections.abc import Collection
from html import escape

import numpy as np
from jaxtyping import Float

from ..rigid.kinematics import poses_on_host
from ..rigid.manifold import neutral
from ..rigid.model import RobotModel

__all__ = ["middle_posture", "robot_picture", "segments"]

_WIDTH, _HEIGHT, _EDGE = 460.0, 300.0, 34.0
_LETTER, _LINE = 7.0, 16.0  # room of a name: of a letter of 12 px, wide ones counted, and from one to the next
_LEAST = 240.0  # of the width that the robot itself keeps beside long names
_AZIMUTHS = np.deg2rad(np.arange(20, 200, 15))
_ELEVATION = np.deg2rad(18.0)


def segments(model: RobotModel, q: Float[np.ndarray, " nv"]) -> Float[np.ndarray, "nj 2 3"]:
    """From the parent's joint (or the world's origin) to every joint, m."""
    origins = np.concatenate([np.zeros((1, 3)), poses_on_host(model, np.asarray(q, float)[None])[0, :, :3, 3]])
    parents = np.array([joint.parent for joint in model.joints]) + 1
    return np.stack([origins[parents], origins[1:]], axis=1)


def robot_picture(
    model: RobotModel,
    affected: Collection[str] = (),
    nominal: RobotModel | None = None,
    magnify: float = 1.0,
) -> str:
    """SVG of the robot in the middle of its range, the joints and links in `affected` in colour.

    With `nominal` that robot is drawn behind, and `model` is drawn `magnify` times as far from it as it is.
    """
    q = middle_posture(model)
    lines = np.concatenate([segments(model, q), _tips(model, q)])
    behind = None if nominal is None else np.concatenate([segments(nominal, q), _tips(nominal, q)])
    if behind is not None:
        lines = behind + magnify * (lines - behind)
    count = len(model.joints)
    hits = [k for k, joint in enumerate(model.joints) if joint.name in affected or joint.link in affected]
    room = max((_LETTER * len(model.joints[k].name) + _EDGE for k in hits), default=0.0)
    width, height = max(_WIDTH, _LEAST + room), max(_HEIGHT, _LINE * (len(hits) + 1))
    flat = _projected(lines if behind is None else np.concatenate([lines, behind]), (width - room, height))
    parts = [_line(line, "nominal") for line in flat[len(lines) :]]
    parts += [_line(line, "link") for line in flat[count : len(lines)]]
    for joint, line in zip(model.joints, flat[:count], strict=True):
        parts.append(_line(line, "hit" if joint.link in affected and joint.name not in affected else "link"))
    places = flat[:count, 1]
    beside = float(flat[..., 0].max()) + _EDGE / 2
    heights = _heights(places[hits, 1], height)
    parts += [_leader(places[k], beside, y) for k, y in zip(hits, heights, strict=True)]
    drawn = sorted(range(count), key=lambda k: k in hits)  # what is named stays to be seen where joints coincide
    parts += [_joint(model.joints[k].name, places[k], k in hits) for k in drawn]
    parts += [_name(model.joints[k].name, beside + 4, y) for k, y in zip(hits, heights, strict=True)]
    named = ", ".join(model.joints[k].name for k in hits)
    text = f"{model.name}, {count} joints; affected: {named or 'none'}"
    view = f'viewBox="0 0 {width:g} {height:g}"'
    return f'<svg class="robot" {view} role="img" aria-label="{escape(text)}">{"".join(parts)}</svg>'


def _tips(model: RobotModel, q: Float[np.ndarray, " nq"]) -> Float[np.ndarray, "tips 2 3"]:
    """From each joint that carries no other to the farthest frame fixed to it, or to its centre of mass."""
    poses = poses_on_host(model, np.asarray(q, float)[None])[0]
    lines = []
    for k in set(range(len(model.joints))) - {joint.parent for joint in model.joints}:
        places = [
            np.asarray(p)[:3, 3] for f, p in zip(model.frames, model.frame_placement, strict=True) if f.parent == k
        ]
        far = max(places, key=lambda place: float(np.linalg.norm(place)), default=np.zeros(3))
        mass = float(model.inertia[k, 0])
        if np.linalg.norm(far) < 1e-6 and mass > 0:
            far = np.asarray(model.inertia[k, 1:4], float) / mass
        lines.append([poses[k, :3, 3], poses[k, :3, :3] @ far + poses[k, :3, 3]])
    return np.array(lines).reshape(-1, 2, 3)


def middle_posture(model: RobotModel) -> Float[np.ndarray, " nq"]:
    """The middle of every joint's range within half a turn, bent a little, so that no links hide each other."""
    if model.nq != model.nv:
        return np.asarray(neutral(model))
    limits = np.clip(np.nan_to_num(np.asarray(model.position_limit)), -1.2, 1.2)
    middle = limits.mean(axis=1)
    return np.clip(middle + 0.35 * np.resize([1.0, -1.0, 1.0], len(middle)), limits[:, 0], limits[:, 1])


def _projected(lines: Float[np.ndarray, "n 2 3"], size: tuple[float, float]) -> Float[np.ndarray, "n 2 2"]:
    """Screen coordinates in a field of `size` from the direction in which the robot spreads most."""
    views = []
    for azimuth in _AZIMUTHS:
        across = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        into = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        up = np.array([0.0, 0.0, np.cos(_ELEVATION)]) + np.sin(_ELEVATION) * into
        views.append(np.stack([lines @ across, -(lines @ up)], axis=-1))
    flat = max(views, key=lambda view: float(np.linalg.norm(view[:, 1] - view[:, 0], axis=-1).sum()))
    low, high = flat.min(axis=(0, 1)), flat.max(axis=(0, 1))
    room = np.array(size) - 2 * _EDGE
    scale = float(np.min(room / np.maximum(high - low, 1e-9)))
    shift = np.array(size) / 2 - scale * (low + high) / 2
    return scale * flat + shift


def _line(line: Float[np.ndarray, "2 2"], kind: str) -> str:
    (a, b), (c, d) = line
    return f'<path class="{kind}" d="M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}"/>'


def _heights(wanted: Float[np.ndarray, " names"], height: float) -> Float[np.ndarray, " names"]:
    """Where names stand in their column: each as near its joint as those above and below leave room."""
    order = np.argsort(wanted, kind="stable")
    out = np.empty(len(wanted))
    for k, (low, one) in enumerate(zip(_LINE * (0.75 + np.arange(len(order))), order, strict=True)):
        out[one] = max(wanted[one], low, out[order[k - 1]] + _LINE if k else low)
    for k in range(len(order) - 1, -1, -1):
        end = height - _LINE / 2 if k == len(order) - 1 else out[order[k + 1]] - _LINE
        out[order[k]] = min(out[order[k]], end)
    return out


def _leader(at: Float[np.ndarray, "2"], x: float, y: float) -> str:
    """The line from a joint to its name."""
    return f'<path class="leader" d="M{at[0]:.1f} {at[1]:.1f}L{x:.1f} {y:.1f}"/>'


def _name(name: str, x: float, y: float) -> str:
    return f'<text x="{x:.1f}" y="{y + 4:.1f}">{escape(name)}</text>'


def _joint(name: str, at: Float[np.ndarray, "2"], hit: bool) -> str:
    kind, size = ("hit", 7) if hit else ("joint", 4)
    place = f'cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{size}"'
    return f'<circle class="{kind}" {place}><title>{escape(name)}</title></circle>'
