"""A candidate of one shape behind another of the same effect: NumPy's least squares decide which explains most."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from figaroh_jax.diagnosis.bank import Columns
from figaroh_jax.diagnosis.contenders import Contender, next_shape
from figaroh_jax.diagnosis.screening import Group
from figaroh_jax.effects.catalogue import find
from figaroh_jax.results import Name

ORDERS = 3.0 + 0.8 * np.arange(30)


def _behind(amplitude: float) -> tuple[np.ndarray, np.ndarray]:
    """Grid points behind the slowest ripple, and what NumPy says each explains of what that leaves."""
    rng = np.random.default_rng(5)
    q = 1.2 * np.sin(np.linspace(0, 60, 900))  # 2.4 rad: not one and a half periods of order 3
    Z = np.stack([np.stack([np.sin(w * q), np.cos(w * q)]) for w in ORDERS])[:, :, None]
    y = 2 * np.sin(2.7 * q) + amplitude * np.sin(21.0 * q + 0.4) + 0.1 * rng.standard_normal(len(q))
    rest = y - Z[0, :, 0].T @ np.linalg.lstsq(Z[0, :, 0].T, y)[0]
    zeros = np.zeros(30)
    places: Any = np.zeros((30, 1), int)
    effect = find("torque_ripple")(places, **{"sine": zeros, "cosine": zeros, "order": ORDERS})
    group = Group(Name("torque_ripple", ("one",)), effect, Columns((0,), Z))
    best: Any = SimpleNamespace(verdicts=SimpleNamespace(residual=rest[None]))
    told = next_shape(group, cast(Contender, best))
    return told, np.array(
        [rest @ rest - ((rest - z[:, 0].T @ np.linalg.lstsq(z[:, 0].T, rest)[0]) ** 2).sum() for z in Z]
    )


def test_the_shape_that_explains_most_of_what_the_best_leaves_comes_next() -> None:
    told, explained = _behind(1.0)
    assert len(told) == 1
    assert told[0] == np.argmax(explained)
    assert ORDERS[told[0]] == pytest.approx(21.0, abs=0.5)


def test_noise_behind_the_best_shape_is_no_other_one() -> None:
    q = np.linspace(0, 50, 900)
    rng = np.random.default_rng(1)
    Z = np.stack([np.stack([np.sin(w * q), np.cos(w * q)]) for w in ORDERS])[:, :, None]
    effect = find("torque_ripple")(
        np.zeros((30, 1), int), **{"sine": np.zeros(30), "cosine": np.zeros(30), "order": ORDERS}
    )
    group = Group(Name("torque_ripple", ("one",)), effect, Columns((0,), Z))
    for _ in range(20):
        best: Any = SimpleNamespace(verdicts=SimpleNamespace(residual=rng.standard_normal((1, len(q)))))
        assert not len(next_shape(group, cast(Contender, best)))
