"""Filters of recordings against SciPy, and torque that is not trusted: it must not be seen by any fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import simulated_arm
from scipy import signal
from simulated_arm import Truth, recording

from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import Preprocess
from figaroh_jax.recordings.cleaning import median_filter, savitzky_golay, without_spikes
from figaroh_jax.recordings.signals import prepare


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Truth:
    return simulated_arm.arm(tmp_path_factory.mktemp("arm"))


def test_median_filter_is_scipys_and_removes_single_spikes(truth: Truth):
    one = recording(truth, 5.0, seed=1)
    assert one.torque is not None
    spiked = one.torque.copy()
    spiked[100::200] += 300.0
    clean = median_filter(replace(one, torque=spiked), 5)
    assert clean.torque is not None and clean.notes[-1].endswith("median of 5 samples on position and torque")
    expected = np.stack([signal.medfilt(column, 5) for column in spiked.T], axis=1)
    np.testing.assert_allclose(clean.torque[2:-2], expected[2:-2], rtol=0, atol=0)
    assert np.abs(clean.torque - one.torque).max() < 10.0


@pytest.mark.parametrize("seed", range(3))
def test_savitzky_golay_passes_polynomials_unchanged(truth: Truth, seed: int):
    one = recording(truth, 3.0, seed=1)
    factors = np.random.default_rng(seed).normal(size=(4, one.position.shape[1]))
    cubic = np.polynomial.polynomial.polyvander(one.time, 3) @ factors
    found = savitzky_golay(replace(one, position=cubic), 21, 3)
    np.testing.assert_allclose(found.position, cubic, rtol=0, atol=1e-10 * np.abs(cubic).max())


@pytest.mark.parametrize(("samples", "order"), [(4, 2), (3, 5), (10**6 + 1, 2)])
def test_filters_that_do_not_fit_are_refused(truth: Truth, samples: int, order: int):
    one = recording(truth, 3.0, seed=1)
    with pytest.raises(InputError, match="odd number"):
        savitzky_golay(one, samples, order)
    if order < samples:
        with pytest.raises(InputError, match="odd number"):
            median_filter(one, samples)


def test_torque_that_is_not_trusted_reaches_no_row(truth: Truth):
    one = recording(truth, 5.0, seed=1)
    assert one.torque is not None
    trusted = np.ones(one.torque.shape, bool)
    trusted[400:450, 1] = False
    wild = one.torque.copy()
    wild[400:450, 1] = 1e6
    signals = [
        prepare(replace(one, torque=torque, trusted=trusted), Preprocess(cutoff=10)) for torque in (one.torque, wild)
    ]
    assert signals[0].torque is not None and signals[1].torque is not None
    np.testing.assert_allclose(signals[1].torque, signals[0].torque, rtol=0, atol=0)
    weight, times = np.asarray(signals[1].rows.weight), signals[1].rows.row_times
    beside = (times > one.time[400] - 0.05) & (times < one.time[449] + 0.05)
    assert (weight[beside, 1] == 0).all() and (weight[~beside, 1] == 1).all() and (weight[:, [0, 2]] == 1).all()


def test_spikes_are_flagged_where_they_were_put(truth: Truth):
    one = recording(truth, 5.0, seed=1)
    assert one.torque is not None
    torque, places = one.torque.copy(), np.random.default_rng().choice(np.arange(20, 900, 15), 12, replace=False)
    torque[places, 0] += 60.0
    found = without_spikes(replace(one, torque=torque))
    assert found.trusted is not None
    flagged = set(np.flatnonzero(~found.trusted[:, 0]))
    assert set(places) <= flagged and len(flagged) <= 14  # a reversal of dry friction may look like one
    assert f"{len(flagged)} samples of shoulder" in found.notes[-1]
    limited = without_spikes(replace(one, torque=torque), joints=["elbow"])
    assert limited.trusted is None or limited.trusted[:, 0].all()
    with pytest.raises(InputError, match="no joint 'wrist'"):
        without_spikes(one, joints=["wrist"])


def test_masks_that_leave_nothing_are_refused(truth: Truth):
    one = recording(truth, 3.0, seed=1)
    nothing = np.zeros(one.position.shape, bool)
    with pytest.raises(InputError, match="no torque of shoulder is trusted"):
        prepare(replace(one, trusted=nothing), Preprocess(cutoff=10))
