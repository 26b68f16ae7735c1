"""Positions with errors that no white noise tells: a sensor that shakes within the filter's band, seen in no torque."""

from __future__ import annotations

import math
import secrets
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from generators import robots
from generators.case import Case
from generators.inverse import make_case

import figaroh_jax as fj
from figaroh_jax.formats.config import Preprocess
from figaroh_jax.identification.result import Identification
from figaroh_jax.recordings.bandwidth import Band
from figaroh_jax.recordings.signals import Signals, as_slow_as_torque, joint_by_joint, prepare

LOWEST, HIGHEST = 6.0, 14.0  # Hz, of the shaking; recordings are low-passed at 15 Hz, the robot moves below 2 Hz
needs_robots = pytest.mark.skipif(not robots.available("tx40"), reason="FIGAROH_JAX_DATA has no staubli_tx40")


def shaken(case: Case, rms: float, seed: int) -> Case:
    """The case with an error of every position (rad), another one in each recording."""
    rng, out = np.random.default_rng(seed), []
    for one in case.recordings:
        position = one["position"]
        frequency = np.fft.rfftfreq(len(position), float(one["time"][1] - one["time"][0]))
        wave = rng.standard_normal((2, len(frequency), position.shape[1]))
        wave *= ((frequency > LOWEST) & (frequency < HIGHEST))[:, None]
        error = np.fft.irfft(wave[0] + 1j * wave[1], len(position), axis=0)
        out.append({**one, "position": position + rms * error / error.std(0)})
    return replace(case, recordings=tuple(out))


def asked(case: Case, job: Callable[[fj.Task], object]) -> object:
    with tempfile.TemporaryDirectory() as folder:
        return job(fj.load_task(case.write(Path(folder))))


@cache
def drawn(effect: str = "") -> tuple[Case, Case, int]:
    """A clean recording or one with an effect of a tenth, the same with sensors that shake, and what they grew from."""
    seed = secrets.randbits(31)
    case = make_case([(effect, 0.1)] if effect else [], robot="tx40", repeats=1, trajectories=2, seed=seed)
    return case, shaken(case, float(np.random.default_rng(seed).uniform(1e-4, 3e-4)), seed), seed


@needs_robots
def test_positions_that_shake_are_no_error_of_the_model():
    """Left in the model's torque they were `unknown`, a residual of two to six times the noise."""
    case, bad, seed = drawn()
    sound, found = (asked(one, fj.diagnose_task) for one in (case, bad))
    assert isinstance(sound, fj.Diagnosis) and isinstance(found, fj.Diagnosis)
    assert not isinstance(sound.band, float) or math.isinf(sound.band), seed
    assert isinstance(found.band, float) and found.band < LOWEST, seed
    assert found.verdict == "nothing", seed
    assert (found.before < 1.3 * sound.before).all(), seed


@pytest.mark.slow
@needs_robots
def test_what_is_hidden_beside_positions_that_shake_is_named():
    _, bad, seed = drawn("rotor_inertia")
    found = asked(bad, fj.diagnose_task)
    assert isinstance(found, fj.Diagnosis)
    (truth,) = bad.truth
    assert [tuple(cause.name) for cause in found.causes] == [(truth.effect, truth.at)], seed
    (size,) = truth.parameters.values()
    told = found.causes[0].parameters["inertia"].value
    assert abs(told - size) < 0.1 * size, seed


@pytest.mark.slow
@needs_robots
def test_positions_that_shake_cost_an_identification_little():
    case, bad, seed = drawn()
    sound, found = (asked(one, fj.identify_task) for one in (case, bad))
    assert isinstance(sound, Identification) and isinstance(found, Identification)
    assert found.band is not None and found.band < LOWEST, seed
    assert (found.fit.rms < 1.3 * sound.fit.rms).all(), seed


@dataclass
class Told:
    """A reading whose squares are given by its band."""

    band: Band
    signals: tuple[Signals, ...]
    squares: np.ndarray


@cache
def moved(joints: int) -> Signals:
    wave = np.sin(np.arange(400) / 20)[:, None] * np.ones(joints)
    return prepare(fj.recording(q=wave, rate=100, joints=list("abc"[:joints])), Preprocess(cutoff=16))


def chosen(*squares: list[float], kept_out: float = 1.0) -> int:
    """How many half octaves recordings of 16 Hz are taken down, that leave these squares at each.

    Each takes 1 rad/s^2 of the fitted one's acceleration and `kept_out` of another's.
    """
    joints = len(squares[0])

    def read(band: float) -> Told:
        step = round(2 * math.log2(16 / band))
        roles: tuple[tuple[Literal["fit", "holdout"], float], ...] = (("fit", 1.0), ("holdout", kept_out))
        one = moved(joints)
        both = (replace(one, role=r, acceleration=one.acceleration - step * x) for r, x in roles)
        return Told(band, tuple(both), np.array(squares[step]))

    best = as_slow_as_torque(read(16.0), read).band
    assert isinstance(best, float)
    return round(2 * math.log2(16 / best))


def test_positions_go_down_for_as_long_as_every_joint_is_predicted_better():
    assert chosen([4.0, 4.0], [3.0, 3.0], [2.0, 2.5], [1.9, 2.4], [0.1, 0.1]) == 2
    assert chosen([4.0, 4.0], [3.9, 3.9]) == 0


def test_squares_that_are_no_numbers_end_the_search():
    assert chosen([4.0, 4.0], [math.nan, 2.0]) == 0


def test_friction_that_sticks_is_no_error_of_a_position():
    """Of some joints more is explained where its slips are smoothed away, of others less."""
    assert chosen([4.0, 4.0, 4.0], [1.0, 3.9, 5.6], [0.5, 3.8, 8.0]) == 0


def test_a_faster_motion_that_is_kept_out_keeps_its_band():
    assert chosen([4.0, 4.0], [2.0, 2.0], [2.0, 2.0], kept_out=1.1) == 1
    assert chosen([4.0, 4.0], [2.0, 2.0], [2.0, 2.0], kept_out=1.5) == 0


def by_joint(*squares: list[float]) -> tuple[int, ...]:
    """How many half octaves each joint's position is taken down that leaves these `squares` of its torque at each, and
    .2 more of the joint before it; the last is the band of its motion."""
    count = len(squares)

    def read(bands: Band) -> Told:
        assert isinstance(bands, tuple)
        steps = [0 if band is None else round(2 * math.log2(16 / band)) for band in bands]
        own = [
            each[step] + 0.2 * steps[(j + 1) % count] for j, (each, step) in enumerate(zip(squares, steps, strict=True))
        ]
        one = replace(moved(count), bands=np.array([band or 16.0 for band in bands]))
        return Told(bands, (one,), np.array(own))

    lowest = tuple(16 * 2 ** (-(len(each) - 1) / 2) if len(each) > 1 else None for each in squares)
    best = joint_by_joint(read((None,) * count), read(lowest), read).band
    assert isinstance(best, tuple)
    return tuple(round(2 * math.log2(16 / (band or 16.0))) for band in best)


def test_a_joint_goes_down_alone_where_another_s_motion_is_abrupt():
    """... as far as its own torque follows, and no further than the band of its motion; others lose a little by it."""
    assert by_joint([9.0, 3.0, 2.0, 8.0], [4.0, 9.0, 9.0]) == (2, 0)
    assert by_joint([9.0, 3.0], [4.0]) == (1, 0)  # its motion's own band is one step down
    assert by_joint([9.0], [4.0]) == (0, 0)
    assert by_joint([9.0, math.nan], [4.0, 3.95]) == (0, 0)


def test_a_joint_s_position_that_costs_another_joint_too_much_is_left():
    """By a third of the fall; the second joint's torque rises with the first one's band, as .2 a step."""
    assert by_joint([9.0, 6.0], [1.0]) == (0, 0)
    assert by_joint([9.0, 6.0], [4.0]) == (1, 0)
