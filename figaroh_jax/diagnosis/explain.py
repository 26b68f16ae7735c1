"""What the data can say of each candidate before any verdict: identifiable, detectable, nameable."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..estimation.rows import Linear, Rows
from ..results import Candidate
from .screening import Shown

__all__ = ["explain"]

VISIBLE = 4.0  # noise sigmas at which an effect is seen
CUT = 1e-9  # of the largest eigenvalue: below, a direction is rounding


def explain(
    rows: Rows, linear: Linear, found: Sequence[Shown], noise: Float[np.ndarray, " nv"]
) -> tuple[Candidate, ...]:
    """Share outside the current model, smallest torque that would show (N m or N), nearest other effect and angle."""
    starts = np.cumsum([0, *(len(one.Z) for one in found)])
    spans = [slice(a, b) for a, b in zip(starts[:-1], starts[1:], strict=True)]
    raw, ZX = _products(rows, found, spans)
    left = raw - ZX @ linear.inverse @ ZX.T
    angle, near = _angles(left, spans)
    out = []
    for i, (one, own) in enumerate(zip(found, spans, strict=True)):
        share = float(np.clip(np.trace(left[own, own]) / max(np.trace(raw[own, own]), 1e-300), 0, 1))
        count = np.count_nonzero(rows.y[list(one.joints)])
        level = float(np.mean(noise[list(one.joints)]))
        seen = VISIBLE * level / np.sqrt(max(count * share, 1e-12))
        out.append(Candidate(one.name, share, seen, found[near[i]].name, float(angle[i]), one.z))
    return tuple(out)


def _products(
    rows: Rows, found: Sequence[Shown], spans: list[slice]
) -> tuple[Float[np.ndarray, "columns columns"], Float[np.ndarray, "columns P"]]:
    """Z Z' and Z X of the columns of all candidates, joint by joint: all columns in all rows would be large."""
    count = spans[-1].stop if spans else 0
    raw, ZX = np.zeros((count, count)), np.zeros((count, rows.X.width))
    for joint, its in enumerate(rows.X.own):
        there = [
            (one.Z[:, list(one.joints).index(joint)], own)
            for one, own in zip(found, spans, strict=True)
            if joint in one.joints
        ]
        if there:
            at = np.concatenate([np.arange(own.start, own.stop) for _, own in there])
            Z = np.concatenate([columns for columns, _ in there])
            raw[np.ix_(at, at)] += Z @ Z.T
            ZX[np.ix_(at, its.place)] += Z @ its.columns
    return raw, ZX


def _angles(
    left: Float[np.ndarray, "columns columns"], spans: list[slice]
) -> tuple[Float[np.ndarray, " groups"], list[int]]:
    """Smallest angle (degrees) of each group to any other, in the rows with the current model projected out."""
    count = len(spans)
    whiten = np.zeros_like(left)
    for own in spans:
        values, vectors = np.linalg.eigh(left[own, own])
        good = values > CUT * max(values.max(), 1e-300)
        root = vectors[:, good] / np.sqrt(values[good])
        whiten[own, own.start : own.start + root.shape[1]] = root
    together = whiten.T @ left @ whiten
    starts, sizes = [own.start for own in spans], np.array([own.stop - own.start for own in spans])
    # the Frobenius norm of a block bounds its largest singular value, and is it where the block is a row or a column
    cosine = np.sqrt(np.add.reduceat(np.add.reduceat(together**2, starts, axis=0), starts, axis=1))
    cosine[np.diag_indices(count)] = 0.0
    wide = np.minimum(sizes[:, None], sizes) > 1
    bound, cosine = cosine, np.where(wide, 0.0, cosine)
    for i, j in np.argwhere(np.tril(wide, -1)):
        if bound[i, j] > min(cosine[i].max(), cosine[j].max()):
            cosine[i, j] = cosine[j, i] = np.linalg.norm(together[spans[i], spans[j]], 2)
    near = cosine.argmax(1)
    return np.degrees(np.arccos(np.clip(cosine.max(1), 0, 1))), [int(k) for k in near]
