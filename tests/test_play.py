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
    columns = (x[:, None] for x in (0 * t, velocity, 0 * t, read, read))
    motion = Motion(cast(Any, None), t, *columns, DT, np.zeros(1))
    span = SimpleNamespace(slot=0, sample=0, samples=len(t))
    records = cast(Any, SimpleNamespace(shape=(1, len(t), 0, 1), dt=DT, cutoff=CUTOFF, spans=(span,)))
    play = find("backlash")(np.array([0]), width=np.float64(WIDTH))
    nearest = np.abs(t[:, None] - 1.25 * np.arange(10)).min(1)
    away = (nearest > 0.1) & (t > 0.2) & (t < 11.8)
    near = (nearest < 0.03) & (t > 0.2) & (t < 11.8)
    assert_allclose(_read_beside(play, motion, records)[away], WIDTH / 2 * np.sign(load)[away], atol=0.02 * WIDTH)
    direct = np.asarray(play.position_error(motion))
    assert np.mean(np.sign(direct[near]) == np.sign(load[near])) < 0.7  # as read, it is as often on the wrong side
    assert np.mean(np.sign(_read_beside(play, motion, records)[near]) == np.sign(load[near])) > 0.9


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
