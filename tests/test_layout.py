"""Partners, blocks and folds against the motion itself: rows that repeat have the same position."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import robots
from synthetic import DT, STEP, made_signals, swing

from figaroh_jax.diagnosis import shifts
from figaroh_jax.diagnosis.layout import describe_folds, excitations, held_rows, layout
from figaroh_jax.diagnosis.repeats import repeats_not_said
from figaroh_jax.effects.base import Motion
from figaroh_jax.effects.sensors import EncoderScale
from figaroh_jax.recordings.signals import Signals, apart, kept_out_in_vain
from figaroh_jax.recordings.stacked import Records, open_rows, stack

ROW = STEP * DT


def other(time: np.ndarray) -> np.ndarray:
    return swing(time + 100.0)


def third(time: np.ndarray) -> np.ndarray:
    return swing(time + 200.0)


def by_recording(flat: np.ndarray, signals: list[Signals]) -> list[np.ndarray]:
    """The rows of each recording, without padding, out of an axis of all rows."""
    parts = flat.reshape(*flat.shape[:-1], len(signals), -1)
    return [parts[..., k, : one.rows.kept] for k, one in enumerate(signals)]


def row_positions(signals: list[Signals]) -> np.ndarray:
    """Position at every row of every recording: (recordings x rows, joints)."""
    records = stack(signals)
    sample = records.row_samples()
    position = np.asarray(records.position)
    return np.take_along_axis(position, sample[..., None], axis=1).reshape(-1, position.shape[2])


@pytest.mark.parametrize("late", [0, 7, -12])
def test_a_partner_is_the_row_where_the_other_repeat_is_at_the_same_place(late: int) -> None:
    signals = [
        made_signals(12.0, begin=1.0, repeat="A"),
        made_signals(12.0, other),
        made_signals(11.0, begin=1.0 - late * ROW, repeat="A"),
    ]
    found, position = layout(signals, stack(signals)), row_positions(signals)
    assert found.repeats and found.partner.shape[0] == 1
    (partner,) = found.partner
    have = np.flatnonzero(partner >= 0)
    np.testing.assert_allclose(position[partner[have]], position[have], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(partner[partner[have]], have)
    alone = by_recording(partner, signals)[1]
    assert np.all(alone == -1)
    # the first recording has a partner wherever the second was running
    expected = min(signals[0].rows.kept, signals[2].rows.kept - late) - max(0, -late)
    assert (by_recording(partner, signals)[0] >= 0).sum() == expected
    np.testing.assert_array_equal(found.paired, np.broadcast_to(partner >= 0, found.paired.shape))


def test_each_of_three_repeats_has_the_two_others_as_partners() -> None:
    signals = [made_signals(5.0, repeat="A") for _ in range(3)]
    found, count = layout(signals, stack(signals)), signals[0].rows.kept
    number = found.partner.reshape(2, 3, count) // count
    np.testing.assert_array_equal(
        np.sort(number, axis=0), [[[1] * count, [0] * count, [0] * count]] + [[[2] * count, [2] * count, [1] * count]]
    )
    np.testing.assert_array_equal(found.partner % count, np.broadcast_to(np.tile(np.arange(count), 3), (2, 3 * count)))


def test_a_row_whose_partner_is_gated_takes_no_instruments_from_it() -> None:
    signals = [made_signals(5.0, repeat="A"), made_signals(5.0, repeat="A", gated=slice(20, 30))]
    found = layout(signals, stack(signals))
    first, second = by_recording(found.paired, signals)
    expected = np.ones(signals[0].rows.kept)
    expected[20:30] = 0.0
    np.testing.assert_array_equal(first, [expected] * 2)
    np.testing.assert_array_equal(second, 1.0)
    np.testing.assert_array_equal(by_recording(found.partner[0], signals)[0] >= 0, expected > 0)


def test_a_row_gated_at_one_joint_still_serves_the_other() -> None:
    signals = [made_signals(5.0, repeat="A"), made_signals(5.0, repeat="A", gated=(slice(20, 30), 1))]
    found = layout(signals, stack(signals))
    expected = np.ones((2, signals[0].rows.kept))
    expected[1, 20:30] = 0.0
    np.testing.assert_array_equal(by_recording(found.paired, signals)[0], expected)
    assert np.all(by_recording(found.partner, signals)[0] >= 0)


def test_without_repeats_nothing_has_a_partner_and_all_rows_count() -> None:
    signals = [made_signals(5.0), made_signals(5.0, other)]
    found = layout(signals, stack(signals))
    assert not found.repeats and found.partner.shape == (0, 2 * signals[0].rows.kept)
    np.testing.assert_array_equal(found.paired, 1.0)


@pytest.mark.parametrize(("seconds", "width"), [(14.0, 1.0), (5.0, 0.3)])
def test_blocks_are_runs_of_about_one_length_within_a_recording(seconds: float, width: float) -> None:
    signals = [made_signals(seconds), made_signals(seconds - 1.0, other), made_signals(seconds, role="holdout")]
    found = layout(signals, stack(signals))
    own = by_recording(found.block, signals)
    assert np.all(own[2] == -1)
    np.testing.assert_array_equal(np.unique(np.concatenate(own[:2])), np.arange(own[1].max() + 1))
    assert own[0].max() + 1 == own[1].min()
    for block in own[:2]:
        assert set(np.diff(block)) == {0, 1}
        lengths = np.bincount(block - block[0]) * ROW
        assert lengths.min() > 0.5 * width - 2 * ROW and lengths.max() < 1.5 * width + 2 * ROW
    assert (found.block >= 0).sum() == signals[0].rows.kept + signals[1].rows.kept


def test_three_excitations_are_left_out_one_by_one_with_their_repeats() -> None:
    motions = [("A", swing), (None, other), ("A", swing), ("C", third)]
    signals = [made_signals(5.0 + 0.5 * k, motion, repeat=label) for k, (label, motion) in enumerate(motions)]
    signals.append(made_signals(6.0, role="holdout"))
    found = layout(signals, stack(signals))
    for fold, expected in zip(by_recording(found.fold, signals), [0, 1, 0, 2, -1], strict=True):
        np.testing.assert_array_equal(fold, expected)
    assert (found.fold >= 0).sum() == sum(one.rows.kept for one in signals[:4])
    assert excitations(signals[:4]) == [0, 1, 0, 2]
    assert describe_folds(signals) == "each excitation left out in turn"


@pytest.mark.parametrize("labels", [[None], [None, None], ["A", "A"]], ids=["single", "two", "two repeats"])
def test_fewer_excitations_are_left_out_quarter_by_quarter(labels: list[str | None]) -> None:
    motions = [swing, other if labels[-1] is None else swing]
    signals = [made_signals(8.0, m, repeat=label) for m, label in zip(motions, labels, strict=False)]
    found = layout(signals, stack(signals))
    quarters = 1 + found.part.max()
    assert quarters == (8 if labels == [None, None] else 4)
    sizes = np.bincount(found.part)
    assert sizes.max() - sizes.min() <= 2
    for part in by_recording(found.part, signals):
        assert set(np.diff(part)) == {0, 1} and part[-1] - part[0] == 3
    if labels == ["A", "A"]:  # a quarter is left out of both repeats at once
        first, second = by_recording(found.part, signals)
        np.testing.assert_array_equal(first, second)
    assert describe_folds(signals) == "each recording's quarters left out in turn"


def test_the_search_leaves_out_blocks_in_turn() -> None:
    signals = [made_signals(12.0), made_signals(9.0, other)]
    folds = by_recording(layout(signals, stack(signals)).fold, signals)
    for fold, one, width in zip(folds, signals, (1.0, 0.3), strict=True):  # shorter ones in a short recording
        np.testing.assert_array_equal(fold, np.arange(one.rows.kept) * ROW // width % 5)


def test_held_rows_are_those_of_holdout_recordings_with_torque() -> None:
    signals = [made_signals(5.0), made_signals(4.0, other, role="holdout", gated=slice(0, 5))]
    held = held_rows(signals, stack(signals))
    expected = np.zeros_like(held)
    expected[1, 5 : signals[1].rows.kept] = 1.0
    np.testing.assert_array_equal(held, expected)


def test_short_recordings_stand_in_one_slot_and_every_row_is_as_it_was(tmp_path: Path) -> None:
    """Their rows, partners, blocks, folds and shifted motions are those of recordings with a slot each."""
    rng, model = np.random.default_rng(5), robots.load(robots.ARM, tmp_path)
    seconds, labels = [13.0, 4.0, 12.0, 5.0, 3.0, 4.0], [None, "A", None, "A", None, None]
    signals = []
    for k, (length, label) in enumerate(zip(seconds, labels, strict=True)):
        torque = rng.standard_normal((round(length / DT), 2)).cumsum(0)
        begin, role = 0.0 if label else 50.0 * k, "holdout" if k == 5 else "fit"
        signals.append(made_signals(length, swing, torque, begin=begin, repeat=label, role=role))

    def told(joined: bool) -> tuple[Records, dict[str, np.ndarray]]:
        records = stack(signals, joined=joined)
        n, _, count, nv = records.shape
        found, flat = layout(signals, records), records.flat(np.asarray(records.torque))
        own = np.concatenate([at.slot * count + at.row + np.arange(at.rows) for at in records.spans])
        number = np.full(n * count, -1)  # of each row, whatever the slots
        number[own] = np.arange(len(own))
        rows = {name: getattr(found, name)[own] for name in ("block", "fold", "part")}
        partner = found.partner[:, own]
        rows["partner"] = np.where(partner >= 0, number[partner], -1)
        rows["paired"] = found.paired[:, own]
        rows["held"] = held_rows(signals, records).reshape(-1, nv)[own]
        rows["torque"] = open_rows(records, flat, np.ones(len(records.omega))).reshape(-1, nv)[own]
        kind: Any = EncoderScale
        effect = kind(np.array([[0], [1]]), scale=np.ones(2))
        q, v, a = (records.flat(np.asarray(x)) for x in (records.position, records.velocity, records.acceleration))
        read = Motion(model, records.flat(records.time), q, v, a, np.zeros_like(v), np.zeros_like(v), DT, np.ones(2))
        for one in shifts.shifted(effect, read, records, turns=0).acceleration:
            rows[f"moved {len(rows)}"] = open_rows(records, one, np.ones(len(records.omega))).reshape(-1, nv)[own]
        return records, rows

    with jax.enable_x64(True):
        (apart, before), (joined, after) = told(False), told(True)
    assert (len(apart.kept), len(joined.kept)) == (6, 5)
    assert len({at.slot for at, one in zip(joined.spans, signals, strict=True) if one.role == "holdout"}) == 1
    assert all(joined.spans[5].slot != at.slot for at in joined.spans[:5])
    for name, rows in before.items():
        np.testing.assert_allclose(after[name], rows, rtol=0, atol=1e-9 * max(1.0, np.abs(rows).max()), err_msg=name)


def test_a_recording_kept_out_that_moves_as_a_fitted_one_is_told():
    """Also where it is a part of it; not where it moves otherwise, and not of a robot whose torque is not known."""
    fitted = [made_signals(12.0, name="first", repeat="A"), made_signals(12.0, other, name="second")]
    same = made_signals(12.0, other, begin=3 * ROW, name="same", role="holdout")
    part = made_signals(8.0, begin=2.0, name="part", role="holdout")
    else_ = made_signals(12.0, third, name="else", role="holdout")
    notes = kept_out_in_vain([*fitted, same, part, else_, replace(same, name="silent", torque=None)])
    assert [tuple(word for word in note.split() if word in ("same", "part", "first", "second")) for note in notes] == [
        ("same", "second"),
        ("part", "first"),
    ]


def test_fitted_recordings_that_repeat_each_other_without_a_label_are_told():
    first, second = made_signals(12.0, name="first", repeat="A"), made_signals(12.0, name="second", repeat="A")
    unsaid, moves = made_signals(12.0, begin=2 * ROW, name="unsaid"), made_signals(12.0, other, name="else")
    assert not repeats_not_said([first, second, moves])
    (note,) = repeats_not_said([first, moves, unsaid])
    assert note.startswith("unsaid moves as first does")
    assert not repeats_not_said([first, moves, replace(unsaid, role="holdout")])


def test_recordings_that_have_nothing_in_common_are_far_apart():
    """Of a motion that only drifts no lag is better than the next, so that its minimum lies far outside of both."""
    first, second = (
        made_signals(9.0, lambda t, k=k: np.stack([t + k, t**2 / 9 + 3 * k], 1), name="x") for k in (0, 40)
    )
    assert apart(first, second) > 0.05
