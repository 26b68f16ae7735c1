"""Rows of low speed lose weight for what no law of the velocity predicts, and for nothing else."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from figaroh_jax.diagnosis import weights
from figaroh_jax.estimation.joint_rows import JointRows

ROWS, TOP = 4000, 2.0


def factors(monkeypatch: pytest.MonkeyPatch, torque: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Mean squares by speed over those of fast rows, of one joint with friction in its baseline; rows are samples."""
    s = np.sign(v)
    rows = SimpleNamespace(y=torque[None], X=JointRows.of(np.stack([v, s], 1)[None]))
    prior = SimpleNamespace(precision=np.zeros(2), mean=np.zeros(2))
    motion = SimpleNamespace(velocity=v[:, None], direction=s[:, None])
    records = SimpleNamespace(
        weight=np.ones((1, ROWS, 1)),
        fitted=np.ones((1, ROWS, 1)),
        velocity=v[None, :, None],
        row_samples=lambda: np.arange(ROWS)[None],
    )
    problem: Any = SimpleNamespace(records=records)
    monkeypatch.setattr(weights, "whitened", lambda problem, state, whitening: rows)
    monkeypatch.setattr(weights, "smooth_functions", lambda motion: [np.stack([np.ones(ROWS), np.abs(v)])])
    monkeypatch.setattr(weights, "_whitened_rows", lambda problem, state, columns, whitening, joint: columns.T)
    state: Any = SimpleNamespace(motion=motion, prior=prior)
    return weights.speed_factors(problem, state, np.ones((1, 1)))[0]


@pytest.mark.parametrize("speed", [0.05, 0.08, 0.12, 0.16])
def test_friction_that_falls_with_speed_keeps_its_weight(monkeypatch: pytest.MonkeyPatch, speed: float):
    """A hundred times the noise, of any speed that the recordings resolve."""
    rng = np.random.default_rng(0)
    v = TOP * np.sin(np.linspace(0, 60, ROWS))
    torque = np.sign(v) * (1 + 10 * np.exp(-((v / (speed * TOP)) ** 2))) + 0.1 * rng.standard_normal(ROWS)
    assert factors(monkeypatch, torque, v).max() < 10


def test_sticks_do_not(monkeypatch: pytest.MonkeyPatch):
    """At rest dry friction takes any value up to its limit, another one each time."""
    rng = np.random.default_rng(1)
    v = TOP * np.sin(np.linspace(0, 60, ROWS))
    stop = np.abs(v) < 0.015 * TOP
    held = rng.uniform(-3, 3, ROWS)[np.cumsum(np.diff(stop, prepend=False))]
    torque = np.where(stop, held, np.sign(v)) + 0.1 * rng.standard_normal(ROWS)
    found = factors(monkeypatch, torque, v)
    assert found[0] > 30 and found[-3:].max() == 1
