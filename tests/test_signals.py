"""Filter, derivatives, rates and alignment, against closed forms and scipy.signal."""

from __future__ import annotations

import secrets
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import Preprocess
from figaroh_jax.recordings import resampling, signals
from figaroh_jax.recordings.dataset import Recording
from figaroh_jax.recordings.resampling import differentiate, to_recording_times, unrounded
from figaroh_jax.recordings.rowfilter import filter_rows, frequencies, low_pass, row_filter

JOINTS = ("a", "b", "c")


def motion(t: np.ndarray) -> np.ndarray:
    """Three smooth joints with content up to 1.5 Hz that does not repeat within a recording."""
    return np.stack(
        [np.sin(2 * np.pi * 0.4 * t * (1 + 0.02 * t)), np.cos(2 * np.pi * 0.7 * t) * t / 10, 0.5 * np.sin(9 * t) + 1], 1
    )


def recording(time: np.ndarray, position: np.ndarray, torque: np.ndarray | None = None, **more) -> Recording:
    return Recording("run", Path("run.npz"), JOINTS, time, position, torque=torque, **more)


def moving(late: float = 0.0, rate: float = 500.0, seconds: float = 12.0, **more) -> Recording:
    t = np.arange(int(seconds * rate)) / rate
    return recording(t, motion(t - late), motion(t - late), **more)


def rows_of(prepared: signals.Signals) -> np.ndarray:
    assert prepared.torque is not None
    return np.asarray(filter_rows(prepared.rows, prepared.torque))


@pytest.mark.parametrize(("cutoff", "rate"), [(20.0, 250.0), (5.0, 100.0), (40.0, 1000.0)])
def test_filter_rows_equals_sosfiltfilt_away_from_the_ends(cutoff, rate):
    x = np.cumsum(np.random.default_rng(0).normal(size=(2600, 4)), axis=0) + 30
    rows = row_filter(len(x), 1 / rate, cutoff, step=3, trim=0.5, start=0.0, nv=4)
    butterworth = signal.butter(4, cutoff, fs=rate, output="sos")
    reference = signal.sosfiltfilt(butterworth, x, axis=0, padlen=len(x) - 1)
    inner = slice(int(12 / cutoff * rate / 3), -int(12 / cutoff * rate / 3))  # ends are mirrored, not reflected
    np.testing.assert_allclose(filter_rows(rows, x)[inner], reference[rows.index][inner], rtol=0, atol=1e-6)
    np.testing.assert_allclose(low_pass(x, 1 / rate, cutoff)[rows.index], reference[rows.index], rtol=0, atol=1e-6)


def test_measured_gain_is_half_at_the_cutoff_and_minus_3_db_at_0_896_of_it():
    t = np.arange(20_000) / 1000

    def gain(frequency: float) -> float:
        filtered = low_pass(np.sin(2 * np.pi * frequency * t)[:, None], 1e-3, 20.0)[5000:15_000, 0]
        return float(np.std(filtered) * np.sqrt(2))

    assert gain(20.0) == pytest.approx(0.5, abs=1e-4)
    assert gain(20.0 * (np.sqrt(2) - 1) ** (1 / 8)) == pytest.approx(np.sqrt(0.5), abs=1e-3)
    assert gain(5.0) == pytest.approx(1.0, abs=1e-4)


def test_an_impulse_stays_aligned_in_every_joint_and_symmetric():
    at = [700, 1000, 1301]
    x = np.zeros((2000, 3))
    x[at, range(3)] = 1.0
    rows = row_filter(len(x), 1 / 250, 20.0, step=1, trim=0.1, start=0.0, nv=3)
    filtered = np.asarray(filter_rows(rows, x))
    for joint, sample in enumerate(at):
        row = sample - rows.first
        assert np.argmax(filtered[:, joint]) == row
        left, right = filtered[row - 200 : row, joint][::-1], filtered[row + 1 : row + 201, joint]
        np.testing.assert_allclose(left, right, rtol=0, atol=1e-12)


def test_torque_and_position_of_a_recording_stay_aligned_through_every_change_of_rate():
    for rate, preprocess in [(5000.0, Preprocess()), (1000.0, Preprocess(cutoff=20, rate=100)), (94.0, Preprocess())]:
        prepared = signals.prepare(moving(rate=rate), preprocess)
        index = prepared.rows.index
        np.testing.assert_allclose(prepared.time[index], prepared.rows.row_times, rtol=0, atol=1e-12)
        np.testing.assert_allclose(prepared.position[index], motion(prepared.rows.row_times), rtol=0, atol=1e-5)
        np.testing.assert_allclose(rows_of(prepared), motion(prepared.rows.row_times), rtol=0, atol=1e-5)


def test_differences_are_exact_on_quadratics_at_every_sample_of_every_joint():
    t = np.linspace(-1, 1, 501)[:, None]
    a, b, c = np.array([[1.0, -2.0, 0.5], [0.3, 0.0, -1.0], [2.0, 1.0, -0.7]])
    dt = float(t[1, 0] - t[0, 0])
    np.testing.assert_allclose(differentiate(a * t**2 + b * t + c, dt), 2 * a * t + b, rtol=0, atol=1e-9)
    np.testing.assert_allclose(differentiate(a * t**2 + b * t + c, dt, order=2), 0 * t + 2 * a, rtol=0, atol=1e-9)


def test_differences_are_exact_on_quartics_and_fourth_order_beyond():
    t = np.linspace(0, 1, 101)[:, None]
    np.testing.assert_allclose(differentiate(t**4, 0.01), 4 * t**3, rtol=0, atol=1e-11)
    np.testing.assert_allclose(differentiate(t**4, 0.01, order=2), 12 * t**2, rtol=0, atol=1e-9)
    errors = []
    for n in (101, 201):
        s = np.linspace(0, 1, n)[:, None]
        errors.append(np.abs(differentiate(np.sin(6 * s), 1 / (n - 1)) - 6 * np.cos(6 * s)).max())
    assert errors[0] / errors[1] > 14


def test_velocity_and_acceleration_of_a_recorded_polynomial_are_exact_for_every_joint():
    t = np.arange(3000) / 500 - 3
    q = np.stack([t**2, 0.3 * t**3 - t, 1 - 0.5 * t**2], axis=1)
    prepared = signals.prepare(recording(t, q), Preprocess(cutoff=20))
    s = prepared.time[prepared.rows.index][20:-20]
    velocity, acceleration = (x[prepared.rows.index][20:-20] for x in (prepared.velocity, prepared.acceleration))
    np.testing.assert_allclose(velocity, np.stack([2 * s, 0.9 * s**2 - 1, -s], axis=1), rtol=0, atol=1e-6)
    expected = np.stack([np.full_like(s, 2), 1.8 * s, np.full_like(s, -1)], axis=1)
    np.testing.assert_allclose(acceleration, expected, rtol=0, atol=1e-5)


def test_what_lies_above_the_new_rate_does_not_fold_into_the_rows():
    t = np.arange(60_000) / 5000
    for hidden in (240.0, 263.0, 1000.0, 2400.0):
        disturbed = motion(t) + 0.5 * np.sin(2 * np.pi * hidden * t)[:, None]
        for preprocess in (Preprocess(cutoff=20), Preprocess(cutoff=20, rate=100)):
            prepared = signals.prepare(recording(t, disturbed, disturbed), preprocess)
            expected = motion(prepared.rows.row_times)
            np.testing.assert_allclose(rows_of(prepared), expected, rtol=0, atol=2e-5)
            np.testing.assert_allclose(prepared.position[prepared.rows.index], expected, rtol=0, atol=2e-5)


def test_uneven_stamps_are_put_on_an_even_grid():
    rng = np.random.default_rng(3)
    t = np.cumsum(0.004 + 0.0015 * rng.uniform(-1, 1, 3000))
    prepared = signals.prepare(recording(t, motion(t), motion(t)), Preprocess(cutoff=10))
    assert prepared.notes == ()
    np.testing.assert_allclose(np.diff(prepared.time), prepared.dt, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        prepared.position[prepared.rows.index], motion(prepared.rows.row_times), rtol=0, atol=1e-4
    )
    np.testing.assert_allclose(rows_of(prepared), motion(prepared.rows.row_times), rtol=0, atol=2e-3)


def test_a_gap_is_reported_and_its_rows_have_no_weight():
    t = np.arange(3000) / 250
    t = np.concatenate([t[:1500], t[1600:]])
    prepared = signals.prepare(recording(t, motion(t), motion(t)), Preprocess(cutoff=10))
    assert "1 gap" in prepared.notes[0] and "0.404 s at 5.996 s" in prepared.notes[0]
    assert prepared.notes[0].endswith("; rows near it are left out")
    dropped = prepared.rows.row_times[prepared.rows.weight[:, 0] == 0]
    assert dropped.min() == pytest.approx(5.996 - 0.05, abs=0.05)
    assert dropped.max() == pytest.approx(6.4 + 0.05, abs=0.05)
    kept = prepared.rows.weight[:, 0] == 1
    np.testing.assert_allclose(rows_of(prepared)[kept], motion(prepared.rows.row_times[kept]), rtol=0, atol=5e-3)


def test_the_gate_drops_slow_rows_of_its_joint_alone():
    prepared = signals.prepare(moving(), Preprocess(cutoff=10, gate={"b": 0.2}))
    slow = np.abs(prepared.velocity[prepared.rows.index, 1]) < 0.2
    np.testing.assert_array_equal(prepared.rows.weight[:, 1], ~slow)
    assert slow.any() and np.all(prepared.rows.weight[:, [0, 2]] == 1)


def test_a_delay_in_the_response_is_the_delayed_signal():
    rows = row_filter(3000, 1 / 250, 20.0, step=4, trim=0.5, start=0.0, nv=1)
    t, late = np.arange(3000) / 250, 0.0123
    omega = frequencies(rows)
    delayed = filter_rows(rows, motion(t), jnp.exp(-1j * omega * late))
    np.testing.assert_allclose(delayed, filter_rows(rows, motion(t - late)), rtol=0, atol=1e-4)
    wave = np.sin(2 * np.pi * 6 * np.stack([t, t - late], axis=1))
    both = filter_rows(rows, wave[:, :1], jnp.exp(-1j * omega * late)) - filter_rows(rows, wave[:, 1:])
    np.testing.assert_allclose(both, 0, rtol=0, atol=1e-9)


def test_a_lag_in_the_response_is_the_lagged_signal():
    rows = row_filter(3000, 1 / 250, 20.0, step=4, trim=0.5, start=0.0, nv=1)
    t, constant, w = np.arange(3000) / 250, 0.03, 2 * np.pi * 3
    lagged = filter_rows(rows, np.sin(w * t)[:, None], 1 / (1 + 1j * frequencies(rows) * constant))
    answer = np.sin(w * t - np.arctan(w * constant)) / np.hypot(1, w * constant)
    np.testing.assert_allclose(lagged[30:, 0], filter_rows(rows, answer[:, None])[30:, 0], rtol=0, atol=1e-6)


def test_the_row_filter_is_jitted_mapped_and_differentiated():
    rows = row_filter(1000, 1 / 250, 20.0, step=4, trim=0.1, start=0.0, nv=2)
    x = np.random.default_rng(1).normal(size=(1000, 2, 3))
    plain = filter_rows(rows, x)
    assert plain.shape == (rows.kept, 2, 3)
    np.testing.assert_allclose(jax.jit(filter_rows)(rows, x), plain, rtol=0, atol=1e-12)
    mapped = jax.jit(jax.vmap(lambda c: filter_rows(rows, c), in_axes=2, out_axes=2))(x)
    np.testing.assert_allclose(mapped, plain, rtol=0, atol=1e-12)

    @jax.jit
    def power(delay):
        return jnp.sum(filter_rows(rows, x[:, 0, 0], jnp.exp(-1j * frequencies(rows) * delay)) ** 3)

    slope = (power(0.01 + 1e-6) - power(0.01 - 1e-6)) / 2e-6
    assert jax.jit(jax.grad(power))(0.01) == pytest.approx(float(slope), rel=1e-3)


@pytest.mark.parametrize("late", [0.0, 0.1, -0.0731, 1.3333, -0.3333])
def test_repeats_that_start_late_are_aligned(late):
    first, second = signals.prepare_all([moving(repeat="A"), moving(late, repeat="A")], Preprocess(cutoff=20))
    assert signals.align(first, second) == round(late / (first.rows.step * first.dt))
    one, other = signals.common_rows(first, second)
    assert one.stop - one.start > 500
    difference = rows_of(first)[one] - rows_of(second)[other]
    np.testing.assert_allclose(difference, 0, rtol=0, atol=1e-4)


def test_repeats_of_a_periodic_motion_are_not_shifted_by_a_period():
    t = np.arange(5000) / 250
    q = np.stack([np.sin(2 * np.pi * 0.5 * t)] * 3, axis=1)
    noise = 1e-4 * np.random.default_rng(0).normal(size=(2, *q.shape))
    first, second = (recording(t, q + n, q, repeat="A") for n in noise)
    assert signals.align(*signals.prepare_all([first, second], Preprocess(cutoff=10))) == 0


def test_recordings_of_unlike_rates_share_the_rates_of_the_slowest():
    fast, slow = signals.prepare_all([moving(rate=1000.0), moving(rate=125.0)], Preprocess())
    assert fast.dt == slow.dt and fast.rows.step == slow.rows.step and fast.cutoff == slow.cutoff
    np.testing.assert_allclose(rows_of(fast)[:500], rows_of(slow)[:500], rtol=0, atol=1e-5)


def test_rows_return_to_the_stamps_of_the_recording():
    rng = np.random.default_rng(0)
    stamps = np.sort(rng.uniform(-0.5, 12.5, 4000))
    prepared = signals.prepare(moving(), Preprocess())
    returned = to_recording_times(prepared.rows.row_times, rows_of(prepared), stamps)
    inside = (stamps > 1) & (stamps < 11)
    np.testing.assert_allclose(returned[inside], motion(stamps[inside]), rtol=0, atol=1e-4)
    np.testing.assert_allclose(returned[0], rows_of(prepared)[0], rtol=0, atol=1e-3)
    assert returned.shape == (4000, 3) and np.all(np.isfinite(returned))


def test_defaults_follow_the_rate_of_the_recording():
    prepared = signals.prepare(moving(rate=5000.0), Preprocess())
    assert prepared.cutoff == 20 and 12 <= 1 / (prepared.dt * prepared.cutoff) <= 16
    assert 2.5 <= 1 / (prepared.dt * prepared.rows.step * prepared.cutoff) <= 4
    assert signals.prepare(moving(rate=60.0), Preprocess()).cutoff == pytest.approx(12)


def test_ends_of_short_recordings_lose_a_tenth_of_a_second_and_those_of_long_ones_half_a_second():
    for seconds, trim in ((8.0, 0.1), (10.0, 0.5)):
        prepared = signals.prepare(moving(seconds=seconds, rate=250.0), Preprocess(cutoff=15))
        assert prepared.rows.row_times[0] == pytest.approx(trim, abs=prepared.dt)
        assert prepared.rows.row_times[-1] == pytest.approx(seconds - trim, abs=prepared.dt * (prepared.rows.step + 1))


def test_the_window_keeps_its_part_on_the_recordings_clock():
    prepared = signals.prepare(moving(), Preprocess(window=(2.0, 7.0), cutoff=10))
    assert prepared.time[0] == pytest.approx(2.0) and prepared.time[-1] <= 7.0
    np.testing.assert_allclose(rows_of(prepared)[20:-20], motion(prepared.rows.row_times)[20:-20], rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("preprocess", "words"),
    [
        (Preprocess(window=(20, 30)), "window"),
        (Preprocess(cutoff=300), "cutoff"),
        (Preprocess(rate=900), "rate"),
        (Preprocess(window=(1.0, 1.2)), "too short"),
    ],
)
def test_preprocessing_that_does_not_fit_the_recording_is_refused(preprocess, words):
    with pytest.raises(InputError, match=words) as error:
        signals.prepare(moving(), preprocess)
    assert "run.npz" in str(error.value)


@pytest.mark.parametrize(("factor", "unit"), [(1e9, "ns"), (1e6, "us"), (1e3, "ms")])
def test_stamps_in_another_unit_are_refused_before_the_memory_is_asked_for(factor: float, unit: str):
    t = np.arange(40_000 if unit == "ms" else 2000) / 250
    q = np.sin(t)[:, None] * np.ones(3)
    wild = recording(t * factor, q, q)
    with pytest.raises(InputError, match=rf"run.npz: its stamps span .* add units: {{time: {unit}}}"):
        signals.prepare(wild, Preprocess(cutoff=15), signals.Rates(180.0, 4, 15.0))


def test_an_interpolation_in_blocks_is_the_same_to_the_last_bit(monkeypatch: pytest.MonkeyPatch):
    x = np.random.default_rng(0).standard_normal((500, 2))
    at = np.linspace(0.3, 4.5, 700)
    whole = resampling.band_limited(x, at, start=0.0, rate=100.0, passed=20.0, stopped=60.0)
    monkeypatch.setattr(resampling, "_AT_ONCE", 1000)
    pieces = resampling.band_limited(x, at, start=0.0, rate=100.0, passed=20.0, stopped=60.0)
    np.testing.assert_array_equal(pieces, whole)


@pytest.mark.parametrize("rate", [60.0, 240.0, 333.0])
@pytest.mark.parametrize("lost", [0.0, 0.03])
def test_stamps_in_whole_milliseconds_are_those_of_the_even_clock_behind_them(rate: float, lost: float):
    seed = secrets.randbits(32)
    true = 3.7 + np.arange(0, 8, 1 / rate)
    true = true[np.random.default_rng(seed).random(len(true)) >= lost]
    found = unrounded(np.round(true, 3))
    assert np.abs(found - true).max() < 5e-5, seed  # .5 ms before


def test_stamps_of_a_clock_that_shakes_are_left_alone():
    rng = np.random.default_rng(0)
    even = np.arange(0, 8, 0.01)
    for shaken in (even + rng.uniform(-1e-3, 1e-3, 800), np.round(even + rng.uniform(-4e-3, 4e-3, 800), 3), even):
        assert unrounded(shaken) is shaken


def test_samples_that_repeat_the_one_before_are_those_of_a_logger_and_not_of_the_robot():
    rng = np.random.default_rng(secrets.randbits(32))
    t = np.arange(3000) / 250
    q, tau = motion(t), motion(t) + 1e-4 * rng.standard_normal((3000, 3))
    for late in np.flatnonzero(rng.random(3000) < 0.02)[1:]:  # in turn: two in a row are one message
        q[late], tau[late] = q[late - 1], tau[late - 1]
    prepared = signals.prepare(recording(t, q, tau), Preprocess(cutoff=10))
    read = prepared.position[prepared.rows.index] - motion(prepared.rows.row_times)
    assert np.abs(read).max() < 1e-4 and prepared.notes == ()  # rad; .008 with the samples as they are
    q[1000:1200], tau[1000:1200] = q[1000], tau[1000]  # a robot that stands
    assert np.shape(signals.prepare(recording(t, q, tau), Preprocess(cutoff=10)).time) == prepared.time.shape
