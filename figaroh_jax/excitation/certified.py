r"""Distances that a motion keeps at every instant, not at samples alone.

The distance of two bodies changes no faster than their points move against each other. A joint between them moves any
point of the one by at most $|\dot q| R$, with R the length of the chain from the joint to the farthest point, so
$$|\dot d| \le L = \sum_{\text{joints that move one of the two}} R_k |\dot q_k|$$
An instant with distance d keeps the margin for $(d - \text{margin}) / L$ before and after. Intervals for which this is
too short are cut in four, down to a few microseconds; a distance that is too small itself is a violation. Capsules come
first, whose distance is never above that of the shapes; where it is below the margin, the shapes themselves.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..rigid.kinematics import ancestors
from .clearance import Clearance, farthest
from .motions import Trajectory

__all__ = ["Nearest", "nearest_approaches"]

RATE = 100.0  # Hz of the first intervals
DEEPEST = 8  # times that an interval is cut in four: then 0.15 microseconds are left
_PARTS = np.array([-0.75, -0.25, 0.25, 0.75])
_DENSE = 2000  # instants at which the largest acceleration of a function of the basis is looked for
_ABOVE = 1.01  # times what is found there


class Nearest(NamedTuple):
    """How near two bodies come in a motion."""

    row: int  # contact: pairs of capsules, pairs looked at by their shapes alone, then floor and boxes
    bodies: str
    distance: float  # m, the least that was seen; the shapes' where `exact`
    time: float  # s
    exact: bool  # whether the shapes themselves had to be looked at
    kept: bool  # at every instant


class _Contact(NamedTuple):
    """Two bodies: rows of their capsules, their links where their shapes can be asked, and what moves them."""

    name: str
    rows: np.ndarray  # none where capsules are too coarse
    pair: tuple[int, int] | None
    reach: Float[np.ndarray, " nv"]  # m by a rad (m by a m) of each coordinate


def nearest_approaches(clearance: Clearance, motion: Trajectory, margin: float) -> list[Nearest]:
    """The least distance of each two bodies that are kept apart, and whether `margin` (m) is kept all the time."""
    contacts = _contacts(clearance)
    count = max(1, int(np.ceil(motion.duration * RATE)))
    half = motion.duration / count / 2
    time = (2 * np.arange(count) + 1) * half
    best = [(np.inf, 0.0, False, True)] * len(contacts)
    # acceleration of each coordinate at any instant
    dense = np.abs(motion.basis.at(np.linspace(0.0, motion.duration, _DENSE))[2]).max(axis=0)
    fastest = _ABOVE * np.abs(np.asarray(motion.weights)) @ dense
    unsure = np.ones((count, len(contacts)), bool)
    for level in range(DEEPEST + 1):
        q, v, _ = (np.asarray(x) for x in motion.at(time))
        near = clearance.capsule_distances(q)
        speed = np.abs(v) + fastest * half
        following = np.zeros_like(unsure)
        for k, contact in enumerate(contacts):
            some = np.flatnonzero(unsure[:, k])
            if not len(some):
                continue
            distance, exact = _distance(clearance, contact, q[some], near[some], margin)
            at = int(distance.argmin())
            bad = distance < margin
            short = ~bad & (distance - speed[some] @ contact.reach * half < margin)
            following[some[short], k] = True
            least, when, shapes, kept = best[k]
            if distance[at] < least:
                least, when = float(distance[at]), float(time[some[at]])
            kept = kept and not bad.any() and not (short.any() and level == DEEPEST)
            best[k] = (least, when, shapes or bool(exact.any()), kept)
        cells = np.flatnonzero(following.any(axis=1))
        if not len(cells):
            break
        time = (time[cells, None] + half * _PARTS).ravel()
        unsure, half = np.repeat(following[cells], len(_PARTS), axis=0), half / len(_PARTS)
    return [Nearest(k, contact.name, *own) for k, (contact, own) in enumerate(zip(contacts, best, strict=True))]


def _distance(
    clearance: Clearance,
    contact: _Contact,
    q: Float[np.ndarray, "samples nv"],
    near: Float[np.ndarray, "samples rows"],
    margin: float,
) -> tuple[Float[np.ndarray, " samples"], np.ndarray]:
    """Of the capsules; of the shapes where these are too near; and where that was."""
    distance = near[:, contact.rows].min(axis=1, initial=np.inf) if len(contact.rows) else np.full(len(q), -np.inf)
    close = distance < margin
    if contact.pair is None or not close.any():
        return distance, np.zeros(len(q), bool)
    exact = clearance.exact_distances(q[close], [contact.pair])
    if exact is None:
        return distance, np.zeros(len(q), bool)
    distance[close] = exact[:, 0]
    return distance, close


def _contacts(clearance: Clearance) -> list[_Contact]:
    """The pairs that are kept apart, then links over the floor and beside boxes."""
    rows, links, found = clearance.rows, clearance.links, []
    for k, pair in enumerate([*clearance.pairs, *clearance.exact]):
        own = np.flatnonzero(rows.pair == k) if k < len(clearance.pairs) else np.zeros(0, int)
        name = " - ".join(links[i].name for i in pair)
        found.append(_Contact(name, own, pair, _reach(clearance, pair)))
    first = len(rows.both)
    for row in range(first, len(rows.names)):
        link = int(rows.owner[rows.first[row]])
        found.append(_Contact(rows.names[row], np.array([row]), None, _reach(clearance, (link,))))
    return found


def _reach(clearance: Clearance, bodies: tuple[int, ...]) -> Float[np.ndarray, " nv"]:
    """How far the points of one of the bodies move against the other for a unit of each coordinate, at the most."""
    model = clearance.model
    above, ratio = ancestors(model.joints), np.abs(np.asarray(model.ratio, float))
    out, degrees = np.zeros(model.nv), model.dofs
    ends = [clearance.links[i].joint for i in bodies]
    moved = [above[:, end] > 0 if end >= 0 else np.zeros(len(above), bool) for end in ends]
    for dof, (joint, column) in enumerate(zip(degrees.joint.tolist(), degrees.column.tolist(), strict=True)):
        by = [m[joint] for m in moved]
        if all(by) and len(bodies) > 1:
            continue  # both together
        for i, moves in zip(bodies, by, strict=True):
            if moves:
                length = _length(clearance, joint, i) if degrees.turns[dof] else 1.0
                out[column] += ratio[joint] * length
    return out


def _length(clearance: Clearance, joint: int, body: int) -> float:
    """Of the chain from a joint to the farthest point of a body, m."""
    model, link = clearance.model, clearance.links[body]
    total, at = farthest(link), link.joint
    while at != joint:
        total += float(np.linalg.norm(np.asarray(model.placement)[at][:3, 3])) + _slide(clearance, at)
        at = model.joints[at].parent
    return total


def _slide(clearance: Clearance, joint: int) -> float:
    """How far a prismatic joint moves what it carries, m; zero for those that turn."""
    model = clearance.model
    if model.dofs.turns[int(model.dofs.first[joint])]:
        return 0.0
    low, high = np.asarray(model.position_limit, float)[model.joints[joint].coordinate]
    span = max(abs(low), abs(high))
    ratio, offset = (abs(float(np.asarray(x)[joint])) for x in (model.ratio, model.offset))
    return ratio * (span if np.isfinite(span) else 10.0) + offset
