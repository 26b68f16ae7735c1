"""The row filter against SciPy's forward-backward Butterworth filter and analytic signals; stacking and padding."""

from __future__ import annotations

import equinox as eqx
import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from synthetic import CUTOFF, DT, STEP, made_signals

from figaroh_jax.recordings import stacked
from figaroh_jax.recordings.rowfilter import filtered, frequencies, row_filter
from figaroh_jax.recordings.stacked import Records, filter_rows, stack

SECONDS = 12.0


def rows_of(records: Records, signal: np.ndarray, response: np.ndarray | None = None) -> np.ndarray:
    """Filtered rows of the first recording for a signal (samples, series)."""
    given = None if response is None else response.T
    return filter_rows(records, signal.T[:, None], given)[:, 0].T


def inner_rows(records: Records, seconds: float = 1.2) -> tuple[np.ndarray, np.ndarray]:
    """Rows away from both ends, and their samples."""
    samples = records.row_samples()[0]
    inside = (samples * DT > seconds) & (samples * DT < SECONDS - seconds)
    return np.flatnonzero(inside), samples[inside]


def gain(hertz: float) -> float:
    """Power gain of an order-4 Butterworth filter after the bilinear transformation."""
    return 1 / (1 + (np.tan(np.pi * hertz * DT) / np.tan(np.pi * CUTOFF * DT)) ** 8)


def test_rows_are_those_of_a_butterworth_filter_run_forward_and_backward() -> None:
    records = stack([made_signals(SECONDS)])
    signal = np.random.default_rng(0).standard_normal((records.shape[1], 3))
    expected = sosfiltfilt(butter(4, CUTOFF, fs=1 / DT, output="sos"), signal, axis=0)
    rows, samples = inner_rows(records)
    np.testing.assert_allclose(rows_of(records, signal)[rows], expected[samples], rtol=0, atol=1e-10)


@pytest.mark.parametrize("step", [1, 2, 3, 5, 6])
def test_rows_far_apart_are_those_of_the_whole_record(step: int) -> None:
    rows = row_filter(700, DT, CUTOFF, step=step, trim=0.5, start=0.0, nv=1)
    signal = np.random.default_rng(step).standard_normal((2, 3, 700))
    delay = np.exp(-0.004j * frequencies(rows)) * rows.gain
    whole = np.fft.irfft(np.fft.rfft(signal[..., rows.source]) * delay, len(rows.source))
    place = rows.pad + rows.index
    np.testing.assert_allclose(filtered(signal, rows.source, place, delay), whole[..., place], rtol=0, atol=1e-12)


@pytest.mark.parametrize(("length", "step"), [(1296, 4), (810, 5), (480, 1), (225, 15), (448, 2), (128, 8)])
@pytest.mark.parametrize("at_once", [1, 5000, stacked.AT_ONCE])
def test_rows_of_many_series_are_those_of_whole_records(
    length: int, step: int, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stacked, "AT_ONCE", at_once)
    generator = np.random.default_rng(length)
    records = stack([made_signals(SECONDS)])
    source = generator.integers(0, 100, (3, length))
    place = np.array([[5], [2], [9]]) + step * np.arange(100 // step)
    weight = np.ones((*place.shape, 1)) * np.array([1, 0, 1])[:, None, None]
    given = {"source": source, "kept": place, "weight": weight, "time": np.zeros((3, 100)), "low_pass": 1.0}
    records = eqx.tree_at(lambda r: [getattr(r, name) for name in given], records, list(given.values()))
    signal, of = generator.standard_normal((41, 3, 100)), generator.integers(0, 4, 41)
    for complex_part in (0, 1j, 2j):  # another response of the same size each time
        response = generator.standard_normal((4, length // 2 + 1))
        response = response + complex_part * generator.standard_normal((4, length // 2 + 1))
        found = filter_rows(records, signal, response, fitted=True, of=of)
        assert (found[:, 1] == 0).all()
        for slot in (0, 2):
            whole = np.fft.irfft(np.fft.rfft(signal[:, slot, source[slot]]) * response[of], length)
            np.testing.assert_allclose(found[:, slot], whole[:, place[slot]], rtol=0, atol=1e-12)


def test_no_series_have_no_rows_and_records_without_weight_have_zeros() -> None:
    records = stack([made_signals(SECONDS)])
    unweighted = eqx.tree_at(lambda r: r.weight, records, np.zeros_like(records.weight))
    signal = np.random.default_rng(0).standard_normal((4, 1, records.shape[1]))
    assert filter_rows(records, signal[:0]).shape == (0, 1, records.shape[2])
    assert not filter_rows(unweighted, signal, fitted=True).any()


def test_rows_of_an_uneven_index_are_taken_one_by_one() -> None:
    rows = row_filter(300, DT, CUTOFF, step=1, trim=0.5, start=0.0, nv=1)
    signal, source = (
        np.random.default_rng(0).standard_normal((2, 300)),
        np.random.default_rng(1).permutation(rows.source),
    )
    whole = np.fft.irfft(np.fft.rfft(signal[:, source]) * rows.gain, len(source))
    place = np.sort(np.random.default_rng(2).choice(len(source), 90, replace=False))
    np.testing.assert_allclose(filtered(signal, source, place, rows.gain), whole[:, place], rtol=0, atol=1e-12)


def test_rows_are_every_fourth_sample() -> None:
    records = stack([made_signals(SECONDS)])
    assert set(np.diff(records.row_samples()[0])) == {STEP}
    np.testing.assert_allclose(records.rate, 1 / (STEP * DT), rtol=0, atol=1e-9)


def test_a_constant_passes_up_to_the_ends() -> None:
    records = stack([made_signals(SECONDS)])
    np.testing.assert_allclose(rows_of(records, np.full((records.shape[1], 1), 7.0)), 7.0, rtol=0, atol=1e-12)


@pytest.mark.parametrize("delay", [0.0137, -0.006])
def test_a_delay_response_shifts_an_analytic_signal(delay: float) -> None:
    records = stack([made_signals(SECONDS)])
    time = np.asarray(records.time)[0]

    def signal(at: np.ndarray, low: float = 1.0, high: float = 1.0) -> np.ndarray:
        return (low * np.sin(2 * np.pi * 3 * at) + high * np.cos(2 * np.pi * 11 * at))[:, None]

    response = np.exp(-1j * np.asarray(records.omega) * delay)
    rows, samples = inner_rows(records)
    expected = signal(time[samples] - delay, gain(3.0), gain(11.0))
    np.testing.assert_allclose(rows_of(records, signal(time), response)[rows], expected, rtol=0, atol=1e-8)


def test_a_lag_response_is_the_low_pass_of_a_sine() -> None:
    records = stack([made_signals(SECONDS)])
    time, omega, late = np.asarray(records.time)[0], 2 * np.pi * 4.0, 0.012
    response = 1 / (1 + 1j * np.asarray(records.omega) * late)
    rows, samples = inner_rows(records)
    factor = gain(4.0) / (1 + 1j * omega * late)
    expected = np.imag(factor * np.exp(1j * omega * time[samples]))[:, None]
    found = rows_of(records, np.sin(omega * time)[:, None], response)[rows]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8)


def test_each_joint_takes_its_own_response() -> None:
    records = stack([made_signals(SECONDS)])
    signal = np.random.default_rng(1).standard_normal((records.shape[1], 2))
    response = np.stack([np.ones_like(records.omega), np.exp(-1j * np.asarray(records.omega) * 0.01)], axis=1)
    both = rows_of(records, signal, response)
    for joint in range(2):
        alone = rows_of(records, signal[:, [joint]], response[:, joint])
        np.testing.assert_allclose(both[:, [joint]], alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.01])
def test_a_padded_short_recording_gives_the_rows_that_it_gives_alone(delay: float) -> None:
    short, long = made_signals(4.0), made_signals(SECONDS, begin=2.0)
    alone, together = stack([short]), stack([long, short])
    signal = np.random.default_rng(2).standard_normal((alone.shape[1], 2))
    padded = np.full((2, together.shape[1], 2), 1e3)  # what stands behind the end of a recording must not matter
    padded[1, : len(signal)] = signal
    given = np.exp(-1j * np.asarray(together.omega) * delay)
    found = np.moveaxis(filter_rows(together, np.moveaxis(padded, 2, 0), given), 0, 2)[1, : short.rows.kept]
    expected = rows_of(alone, signal, np.exp(-1j * np.asarray(alone.omega) * delay))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_rows_of_padding_and_of_holdout_recordings_have_no_weight() -> None:
    gated = slice(10, 20)
    short, held = made_signals(4.0, gated=gated), made_signals(SECONDS, role="holdout")
    weight = np.asarray(stack([short, held]).weight)
    expected = np.zeros_like(weight)
    expected[0, : short.rows.kept] = 1.0
    expected[0, gated] = 0.0
    np.testing.assert_array_equal(weight, expected)


def test_rows_do_not_see_the_ends_of_the_record() -> None:
    records = stack([made_signals(SECONDS)])
    signal = np.random.default_rng(3).standard_normal((records.shape[1], 1))
    changed = signal.copy()
    edge = 0.05  # s: less than what is trimmed at either end
    count = int(edge / DT)
    changed[:count], changed[-count:] = 1e6, -1e6
    np.testing.assert_allclose(rows_of(records, changed), rows_of(records, signal), rtol=0, atol=1e-9)
