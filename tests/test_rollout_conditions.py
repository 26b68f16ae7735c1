"""Command and position as strangers record them: cases that MuJoCo C makes, through the command line.

They are drawn by `benchmarks/rollout_conditions.py`; each was `unknown`, or had a wrong name, for a reason of its own.
"""

from __future__ import annotations

import sys
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks import rollout_conditions
from benchmarks.rollout_conditions import answered, drawn
from figaroh_jax.rollouts.data import noise_of, told_by
from figaroh_jax.rollouts.setting import excess

PLAIN = ("position", "general", "stated")
DRIVES = ("position", "position", "limited", "geared", "general", "stated")


@pytest.mark.parametrize(
    ("seed", "most", "effects", "drives", "mark"),
    [
        pytest.param(30024, 3, [], DRIVES, "nothing", id="a counter that stands between steps"),
        pytest.param(
            30022,
            3,
            [],
            DRIVES,
            "right",
            id="friction, joints that move one after another",
            marks=pytest.mark.slow,
        ),
        pytest.param(30052, 3, [], DRIVES, "right", id="a tilt behind a drive that saturates"),
        pytest.param(32002, 3, ["nothing"], ("limited",), "nothing", id="drives that saturate", marks=pytest.mark.slow),
        pytest.param(
            70007, 3, [], ("position", "limited", "geared", "general"), "right", id="a zero for a weak spring"
        ),
        pytest.param(40210, 4, [], DRIVES, "nothing", id="a baseline that ends early", marks=pytest.mark.slow),
        pytest.param(
            41206, 4, [], DRIVES, "right", id="a tilt that shows along the joint's axis too", marks=pytest.mark.slow
        ),
        pytest.param(
            31007, 2, ["payload"], PLAIN, "right", id="a load at the tip, with its own inertia", marks=pytest.mark.slow
        ),
        pytest.param(
            31019, 2, ["payload"], PLAIN, "right", id="a load that three causes imitate", marks=pytest.mark.slow
        ),
    ],
)
def test_a_strangers_rollout_gets_its_cause(seed: int, most: int, effects: list[str], drives: list[str], mark: str):
    case = drawn(np.random.default_rng([seed, 77]), _asked(effects, most, drives, differ=False))
    assert case is not None
    marks, lines = answered(case, ["diagnose"])
    assert marks == [mark], (case.told, lines)


@pytest.mark.parametrize(
    ("seed", "of"),
    [
        pytest.param(5, "encoder_offset", id="another zero"),
        pytest.param(12, "battery", id="a battery that has drained"),
        pytest.param(1, "encoder_offset", id="a zero that all others have", marks=pytest.mark.slow),
    ],
)
def test_a_recording_kept_out_of_another_robot_is_no_agreement(seed: int, of: str):
    """Noise alone is left of the recordings that are fitted; the last one, kept out, has more or less of an effect."""
    drives = ("position", "limited", "geared", "general")
    case = drawn(np.random.default_rng([seed, 77]), _asked([], 2, drives, differ=True))
    assert case is not None and case.told.startswith(of) and case.task["data"][-1]["role"] == "holdout"
    marks, lines = answered(case, ["diagnose"])
    assert marks == ["unknown"], (case.told, lines)


def test_a_cause_that_predicts_another_robot_better_stays_named(monkeypatch: pytest.MonkeyPatch):
    """A recording kept out has twice the delay: with the delay of the others it is predicted better, not well."""
    monkeypatch.setattr(rollout_conditions, "_shares", lambda rng, effect: (2, np.array([1.0, 2.0])))
    case = drawn(np.random.default_rng([301, 77]), _asked(["command_delay"], 1, ["position", "general"], differ=True))
    assert case is not None and case.task["data"][-1]["role"] == "holdout"
    marks, lines = answered(case, ["diagnose"])
    assert marks == ["right"] and "named+rest, command_delay j0" in lines[0], (case.told, lines)


def _asked(effects: list[str], most: int, drives: Sequence[str], *, differ: bool) -> Namespace:
    return Namespace(
        effects=effects, most=most, drives=list(drives), integrators=["implicitfast", "Euler"], differ=differ
    )


def test_a_counter_that_stands_tells_one_reading():
    """A motion that rests between steps, read in counts: the truth is noise, and .9 of a step beside it is not."""
    step, rng = 1e-3, np.random.default_rng(5)
    rests = np.repeat(rng.uniform(-0.5, 0.5, 60), 100)  # each of 100 rows, one after another
    moved = np.convolve(rests, np.ones(20) / 20, mode="same")[:, None]
    read = np.round(moved / step) * step
    share, noise = told_by(read), noise_of(read)
    assert share[1000:1100].sum() < 30 and 20 * 60 * 0.8 < share.sum() < 22 * 60
    assert noise[0] == pytest.approx(0.3 * step, rel=0.2)

    def beyond(model: np.ndarray) -> float:
        error = (read - model) * np.sqrt(share) / noise
        return excess(error[..., None], share[..., None])

    assert beyond(moved) < 0.5
    assert beyond(moved + 0.9 * step) > 1.0
    assert excess(((read - moved) / noise)[..., None], np.ones((*read.shape, 1))) > 1.0  # as if each row told its own


def test_a_counter_is_seen_though_it_hardly_repeats():
    """Whole steps alone are those of a counter, be they 400 of 500 rows."""
    moved = np.sin(np.linspace(0, 6, 500))[:, None]
    step = 2e-3
    read = np.round(moved / step) * step
    assert len(np.unique(read)) > 0.5 * len(read)
    assert noise_of(read)[0] == pytest.approx(0.3 * step, rel=0.1)
    smooth = moved + 1e-6 * np.random.default_rng(1).normal(size=moved.shape)
    assert noise_of(smooth)[0] < 2e-6
