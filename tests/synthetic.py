"""Small made data for the tests of the diagnosis: signals of one or two joints, whitened rows of random numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import numpy as np

from figaroh_jax.estimation.joint_rows import JointRows
from figaroh_jax.estimation.rows import Rows
from figaroh_jax.recordings.rowfilter import row_filter
from figaroh_jax.recordings.signals import Signals

DT, STEP, CUTOFF = 1 / 264, 4, 20.0  # the rates of a recording with the default cutoff


def swing(time: np.ndarray) -> np.ndarray:
    """Two joints that never come back to the same state within a minute."""
    first = 0.9 * np.sin(1.3 * time) + 0.4 * np.sin(3.7 * time + 0.3)
    second = 0.7 * np.cos(1.9 * time) + 0.3 * np.sin(5.3 * time + 1.0)
    return np.stack([first, second], axis=1)


def made_signals(
    seconds: float,
    motion: Callable[[np.ndarray], np.ndarray] = swing,
    torque: np.ndarray | None = None,
    *,
    begin: float = 0.0,
    name: str = "made",
    repeat: str | None = None,
    role: Literal["fit", "holdout"] = "fit",
    gated: slice | tuple[slice, int] = slice(0, 0),
) -> Signals:
    """Signals of an analytic motion from `begin` (s) on, its own clock starting at zero; rows `gated` weigh nothing."""
    time = np.arange(round(seconds / DT)) * DT
    half = 1e-4
    here, before, after = (motion(time + begin + late) for late in (0.0, -half, half))
    rows = row_filter(len(time), DT, CUTOFF, step=STEP, trim=0.1, start=0.0, nv=here.shape[1])
    weight = np.array(rows.weight)
    weight[gated] = 0.0
    return Signals(
        name=name,
        file=name + ".npz",
        role=role,
        repeat=repeat,
        time=time,
        position=here,
        velocity=(after - before) / (2 * half),
        acceleration=(after - 2 * here + before) / half**2,
        torque=np.zeros_like(here) if torque is None else torque,
        dt=DT,
        cutoff=CUTOFF,
        bands=np.full(here.shape[1], CUTOFF),
        rows=eqx.tree_at(lambda r: r.weight, rows, weight),
        load=None,
        notes=(),
    )


def made_rows(
    y: np.ndarray,
    X: np.ndarray,
    *,
    blocks: int = 6,
    folds: int = 3,
    repeats: bool = False,
) -> Rows:
    """Rows with blocks and folds of equal length; with `repeats` the second half of the rows repeats the first."""
    nv, count = y.shape
    place = np.arange(count)
    partner = np.roll(place, count // 2)[None] if repeats else np.zeros((0, count), int)
    own = JointRows.of(X)
    Xi = JointRows.of(X[:, partner[0]]) if repeats else own
    return Rows(y, own, Xi, np.ones((nv, count)), partner, place * blocks // count, place * folds // count)
