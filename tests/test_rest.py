"""What is said of causes by their size and by what they leave: amplitudes with zero in reach, laws that do not fit."""

from __future__ import annotations

import numpy as np
import pytest

from figaroh_jax.diagnosis.estimates import Fitted
from figaroh_jax.diagnosis.joint import has_size
from figaroh_jax.diagnosis.rest import Rest, verdict, wrong_law
from figaroh_jax.effects.catalogue import find
from figaroh_jax.results import Name

NOISE, REST = Rest(False, 0.0, ""), Rest(True, 0.2, "")


def sized(name: str, deviation: list[float], **values: float) -> bool:
    effect = find(name)(np.array([0]), **{key: np.float64(value) for key, value in values.items()})
    count = len(deviation)
    return has_size(effect, Fitted(np.zeros(count), np.diag(deviation) ** 2, ()), tuple(range(count)))


@pytest.mark.parametrize(("force", "there"), [(0.5, False), (1.9, False), (2.0, True), (-2.0, True)])
def test_a_size_is_there_where_its_interval_excludes_zero(force: float, there: bool) -> None:
    assert sized("torque_offset", [1.0], offset=force) == there


def test_a_spring_without_stiffness_is_an_offset_and_no_spring() -> None:
    assert not sized("joint_spring", [1.0, 0.1], stiffness=0.5, offset=30.0)
    assert sized("joint_spring", [0.1, 10.0], stiffness=0.5, offset=3.0)


def test_two_amplitudes_are_judged_together() -> None:
    # chi-square of two: 5.99 at 95 %
    assert not sized("position_dependent_friction", [1.0, 1.0], cosine=1.7, sine=1.7)
    assert sized("position_dependent_friction", [1.0, 1.0], cosine=1.8, sine=1.8)


def test_a_law_is_wrong_where_it_leaves_a_rest_at_its_own_place() -> None:
    rest = (0.001, Name("friction", ("elbow",)), 50.0)
    assert wrong_law(("elbow",), 1000.0, rest)
    assert wrong_law((), 1000.0, rest)  # the whole robot
    assert not wrong_law(("elbow",), 10_000.0, rest)  # a small share of what was removed
    assert not wrong_law(("wrist",), 1000.0, rest)
    assert not wrong_law(("elbow",), 1000.0, (0.02, *rest[1:]))


def test_verdicts_follow_causes_and_rest() -> None:
    assert verdict(False, NOISE, 1.0) == "nothing"
    assert verdict(False, REST, 1.0) == "unknown"
    assert verdict(True, NOISE, 1.0) == "named"
    assert verdict(True, NOISE, 1.0, wrong=True) == "unknown"
    assert verdict(True, REST, 1.0) == "unknown"  # four fifths explained
    assert verdict(True, REST, 10.0) == "named+rest"
