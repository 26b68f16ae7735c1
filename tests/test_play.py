"""The side of a play in the data of a motor's encoder, whose step makes a load of its own."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from generators import available, make_case
from numpy.testing import assert_allclose
from scipy.signal import butter, sosfiltfilt

from figaroh_jax.diagnosis.diagnosis import diagnose_task
from figaroh_jax.diagnosis.shifts import _read_beside
from figaroh_jax.effects.base import Motion
from figaroh_jax.effects.catalogue import find
from figaroh_jax.formats.config import load_task

DT, CUTOFF, WIDTH = 0.005, 15.0, 0.01


def test_the_load_of_a_plays_own_step_does_not_decide_on_its_side() -> None:
    """A load of .4 Hz, and what inertia times the step's acceleration adds to it, twice as large, as it is read."""
    t = DT * np.arange(2400)
    load = np.sin(2 * np.pi * 0.4 * t)
    filtered = butter(4, CUTOFF, fs=1 / DT, output="sos")
    step = np.asarray(sosfiltfilt(filtered, np.sign(load)))
    push = np.gradient(np.gradient(step, DT), DT)
    read = load + 2 * push / np.abs(push).max()
    velocity = np.cos(2 * np.pi * 0.5 * t)
    still, moves, read = (x[:, None] for x in (0 * t, velocity, read))
    motion = Motion(cast(Any, None), t, still, moves, still, read, read, DT, np.zeros(1))
    span = SimpleNamespace(slot=0, sample=0, samples=len(t))
    records = cast(Any, SimpleNamespace(shape=(1, len(t), 0, 1), dt=DT, cutoff=CUTOFF, bands=None, spans=(span,)))
    play = find("backlash")(np.array([0]), **{"width": np.float64(WIDTH)})
    nearest = np.abs(t[:, None] - 1.25 * np.arange(10)).min(1)
    away = (nearest > 0.1) & (t > 0.2) & (t < 11.8)
    near = (nearest < 0.03) & (t > 0.2) & (t < 11.8)
    assert_allclose(_read_beside(play, motion, records)[away], WIDTH / 2 * np.sign(load)[away], atol=0.02 * WIDTH)
    direct = np.asarray(play.position_error(motion))
    assert np.mean(np.sign(direct[near]) == np.sign(load[near])) < 0.7  # as read, it is as often on the wrong side
    assert np.mean(np.sign(_read_beside(play, motion, records)[near]) == np.sign(load[near])) > 0.9


def test_a_plays_step_is_let_through_as_the_positions_were() -> None:
    """Two recordings, the positions of the second taken down to 4 Hz: what is left of a step is no step of either.

    The smoothing by its definition, min |x - q|^2 + |D^3 x|^2 / (2 sin(pi band dt))^6, solved with full matrices.
    """
    count, band = 500, 4.0
    t = DT * np.arange(count)
    load = np.sin(2 * np.pi * 0.5 * (t + 0.2 * DT))  # no sample on a change of side
    two = np.concatenate([load, load])[:, None]
    moves = np.tile(np.cos(np.pi * t), 2)[:, None]
    motion = Motion(cast(Any, None), np.tile(t, 2), 0 * two, moves, 0 * two, two, two, DT, np.zeros(1))
    spans = tuple(SimpleNamespace(slot=k, sample=0, samples=count) for k in range(2))
    bands = np.array([[CUTOFF], [band]])
    records = SimpleNamespace(shape=(2, count, 0, 1), dt=DT, cutoff=CUTOFF, bands=bands, spans=spans)
    play = find("backlash")(np.array([0]), **{"width": np.float64(WIDTH)})
    fast, slow = _read_beside(play, motion, cast(Any, records)).reshape(2, -1)
    third = np.diff(np.eye(count), 3, axis=0)
    expected = np.linalg.solve(
        np.eye(count) + third.T @ third / (2 * np.sin(np.pi * band * DT)) ** 6, WIDTH / 2 * np.sign(load)
    )
    inside = (t > 0.3) & (t < 2.2)
    assert_allclose(slow[inside], expected[inside], atol=0.03 * WIDTH)
    step = sosfiltfilt(butter(4, CUTOFF, fs=1 / DT, output="sos"), WIDTH / 2 * np.sign(load))
    assert_allclose(fast[inside], np.asarray(step)[inside], atol=0.06 * WIDTH)  # the play is crossed in 10 ms
    assert np.abs(np.gradient(fast)).max() > 2 * np.abs(np.gradient(slow)).max()


@pytest.mark.slow
@pytest.mark.skipif(not available("ur10e"), reason="the robot's file is not here")
def test_a_play_has_its_size_where_positions_are_taken_down_to_the_motion(tmp_path: Path) -> None:
    """Coarse encoders: the step of the play is slowed with the positions, which had halved its width."""
    hidden = [("backlash", 0.15, ("elbow_joint",))]
    case = make_case(hidden, "ur10e", repeats=2, trajectories=3, seed=12, noise=1.0, colour="white", encoder_step=1e-4)
    found = diagnose_task(load_task(case.write(tmp_path)))
    assert [(one.name.effect, one.name.at) for one in found.causes] == [("backlash", ("elbow_joint",))]
    width, truth = found.causes[0].parameters["width"], case.truth[0].parameters["width"]
    assert width.value == pytest.approx(truth, rel=0.3)


@pytest.mark.slow
@pytest.mark.skipif(not available("tx40"), reason="the robot's file is not here")
def test_a_play_is_found_by_torque_with_the_sign_that_it_has(tmp_path: Path) -> None:
    """8.4 mrad in the TX40's third gear, read at the motor; it is not named for what friction leaves at reversals."""
    hidden = [("backlash", 0.15, ("joint_3",))]
    case = make_case(hidden, "tx40", repeats=1, trajectories=4, seed=3, noise=0.5, colour="white")
    found = diagnose_task(load_task(case.write(tmp_path)))
    told = {one.name: one.why_not for one in found.rest.nearest} | {one.name: "" for one in found.causes}
    assert [name.effect for name in told] == ["backlash"] and [name.at for name in told] == [("joint_3",)]
    assert "sign" not in "".join(told.values())
    assert all(one.share > 0.15 for one in found.rest.nearest)  # of the joint's squares, where its column had none
