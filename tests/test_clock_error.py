"""A clock that runs ahead by a good part of the motion's period: the torque of an analytic motion, and a made case."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from generators import available, make_case

from figaroh_jax.diagnosis.diagnosis import diagnose_task
from figaroh_jax.effects.base import Motion, exact
from figaroh_jax.effects.catalogue import find
from figaroh_jax.formats.config import load_task

DT, RATE = 0.005, 0.008


def test_a_clock_ahead_by_half_a_second_reads_the_torque_of_then() -> None:
    """1 Hz over 60 s, twice: half a period ahead at the end, where the first order is off by the torque itself."""
    t = np.tile(DT * np.arange(12000), 2)
    tau = np.sin(2 * np.pi * t)[:, None] * (1 + 0.3 * (np.arange(24000) >= 12000))[:, None]
    still = np.zeros_like(tau)
    motion = Motion(cast(Any, None), t, still, still, still, tau, tau, DT, np.zeros(1))
    clock = find("clock_error")(np.zeros(0, int), **{"rate": np.float64(RATE)})
    ahead = np.sin(2 * np.pi * (1 + RATE) * t)[:, None] * (1 + 0.3 * (np.arange(24000) >= 12000))[:, None]
    known = (t > 0.1) & (t < 59)  # later than that the record ends before what is read then
    error, first = (np.asarray(c.torque_error(motion)) for c in (exact(clock), clock))
    assert np.abs(error - (ahead - tau))[known].max() < 2e-3
    assert np.abs(first - (ahead - tau))[known].max() > 1.0


@pytest.mark.slow
@pytest.mark.skipif(not available("tx40"), reason="the robot's file is not here")
def test_a_fast_clock_is_named_at_its_rate(tmp_path: Path) -> None:
    """15 % of the torque: some 40 ms ahead after 10 s."""
    case = make_case([("clock_error", 0.15)], "tx40", repeats=1, trajectories=4, seed=11, noise=1.0)
    found = diagnose_task(load_task(case.write(tmp_path)))
    assert [one.name.effect for one in found.causes] == ["clock_error"]
    rate = found.causes[0].parameters["rate"]
    assert set(found.causes[0].parameters) == {"rate"}
    assert rate.value == pytest.approx(case.truth[0].parameters["rate"], rel=0.1)
