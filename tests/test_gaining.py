"""A cause that predicts kept-out data no better is not named; one that does is not lost to a larger joint's chance."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from figaroh_jax.diagnosis import gaining, holdout
from figaroh_jax.diagnosis.gaining import Fall, beside_all, kept_squares, predicts_better, surely_less, without_losses
from figaroh_jax.diagnosis.holdout import Held

BLOCKS = 12


def squares(rng: np.random.Generator, *joints: float) -> np.ndarray:
    """Squares of each block and joint, of the sizes `joints`: of all rows, and of those that move, all of them."""
    return np.stack([np.array(joints) * rng.uniform(0.8, 1.2, (BLOCKS, len(joints)))] * 2)


def held(before: np.ndarray, after: np.ndarray) -> Held:
    """What such squares are of errors that a cause makes larger or smaller, block by block, all in one direction."""
    return Held(after, before[1] - np.sqrt(before[1] * after[1]))


def fall(before: np.ndarray, after: np.ndarray, joints: Sequence[int]) -> Fall:
    """The fall of a cause with such squares."""
    return gaining.fall(held(before, before), held(before, after), joints)


def in_turn(*squares: np.ndarray) -> list[Held]:
    """The same of causes that come in one after another."""
    return [held(a, b) for a, b in zip((squares[0], *squares), squares, strict=False)]


@pytest.mark.parametrize("factor", [1.0, 1.02, 1.5])
def test_what_does_not_lower_the_error_of_its_joint_is_never_named(factor: float):
    """Nor where another joint happens to gain by it."""
    before = squares(np.random.default_rng(0), 100.0, 4.0)
    one = fall(before, before * [0.9, factor], [1])
    assert one.own == pytest.approx(1 - factor)
    assert not one.gains


def test_a_fall_that_chance_makes_is_none():
    """One block in twelve gains, the others lose a little: the sum falls."""
    before = squares(np.random.default_rng(1), 4.0)
    after = 1.01 * before
    after[:, 0] *= 0.6
    one = fall(before, after, [0])
    assert one.own > 0
    assert not one.gains


def test_a_fall_in_few_blocks_may_be_chance_however_large():
    before = squares(np.random.default_rng(1), 4.0)
    after = before.copy()
    after[:, :2] *= 0.1  # two blocks of twelve: a chance of one in four
    one = fall(before, after, [0])
    assert one.chance == pytest.approx(0.25)
    assert not one.gains


def test_a_fall_in_every_block_is_sure_however_unlike_they_are():
    """Most of it in one block: mean over deviation is 1, and yet it is a chance of 2^-12."""
    before = squares(np.random.default_rng(1), 4.0)
    before[:, 0] *= 50
    one = fall(before, 0.5 * before, [0])
    assert one.chance == pytest.approx(2.0**-BLOCKS)
    assert one.gains


@pytest.mark.parametrize(
    ("left", "blocks", "sure"), [(0.05, 8, True), (0.3, 8, False), (0.05, 5, False), (0.05, 12, True), (0.3, 12, True)]
)
def test_in_few_blocks_a_cause_is_beyond_doubt_where_it_takes_nearly_all_in_every_one(
    left: float, blocks: int, sure: bool
):
    """Signs of eight blocks are never less likely than 1 in 256; stand-ins have taken .7 in every one of them."""
    before = squares(np.random.default_rng(4), 4.0)[:, :blocks]
    after = left * before
    one = fall(before, after, [0])
    assert one.own == pytest.approx(1 - left)
    assert one.certainly(0.5) is sure
    after[:, 2] = 1.1 * before[:, 2]
    assert not fall(before[:, :8], after[:, :8], [0]).certainly(0.5)


def test_a_cause_that_is_not_there_is_sure_as_often_as_the_level_says():
    """Its size is chance, made in other data; what these have of it is chance too, whether squares fall or not."""
    rng, chances = np.random.default_rng(4), []
    for _ in range(400):
        error, column = rng.standard_normal((2, 30, 8))
        after = error - 0.1 * rng.standard_normal() * column
        before, wanted = (error**2).sum(1)[:, None], (error * (error - after)).sum(1)[:, None]
        now = Held(np.stack([(after**2).sum(1)[:, None]] * 2), wanted)
        chances.append(gaining.fall(Held(np.stack([before] * 2), 0 * wanted), now, [0]).chance)
    assert 0.02 < np.mean(np.array(chances) < 0.05) < 0.08


def test_a_cause_of_half_its_size_is_sure_though_the_squares_hardly_fall():
    """Kept-out data have half of what was fitted: the squares say nothing, their products with it say it is there."""
    rng = np.random.default_rng(5)
    column = rng.standard_normal((BLOCKS, 40))
    noise = 0.5 * rng.standard_normal(column.shape)
    error = 0.52 * column + noise - column * (noise * column).sum() / (column**2).sum()
    before, after = (np.stack([(x**2).sum(1)[:, None]] * 2) for x in (error, error - column))
    one = gaining.fall(Held(before, 0 * before[0]), Held(after, (error * column).sum(1)[:, None]), [0])
    assert abs(one.own) < 0.1
    assert one.chance == pytest.approx(2.0**-BLOCKS)


def test_a_small_joint_gains_though_chance_moves_a_large_one_by_more():
    rng = np.random.default_rng(2)
    before = squares(rng, 1000.0, 1.0)
    moved = 1 + 0.01 * rng.standard_normal(BLOCKS)
    moved *= 1.0005 / np.mean(moved)  # the large joint's squares rise, by less than their blocks differ
    one = fall(before, before * np.stack([moved, np.full(BLOCKS, 0.7)], 1), [1])
    assert one.whole < 0
    assert one.gains


def test_a_robot_that_is_surely_predicted_worse_is_no_gain():
    before = squares(np.random.default_rng(3), 1000.0, 1.0)
    one = fall(before, before * [1.05, 0.7], [1])
    assert one.own > 0
    assert not one.gains


def test_rows_in_which_a_joint_stands_do_not_decide():
    """Dry friction holds any torque there: the error of a right law may rise by chance where most of it is."""
    rng = np.random.default_rng(5)
    moving = 1 + 0.1 * rng.uniform(-1, 1, (BLOCKS, 1))
    standing = 10 * rng.uniform(0.5, 1.5, (BLOCKS, 1))
    moved = standing * (1 + 0.3 * rng.standard_normal((BLOCKS, 1)))
    moved *= 1.05 * standing.sum() / moved.sum()
    one = fall(np.stack([standing + moving, moving]), np.stack([moved + 0.5 * moving, 0.5 * moving]), [0])
    assert one.own == pytest.approx(0.5)
    assert one.gains


def test_two_causes_that_show_only_beside_each_other_stay_when_a_third_goes(monkeypatch: pytest.MonkeyPatch):
    """The first of the two loses alone, the second gains little alone; a third one, in between, gains nothing."""
    base = squares(np.random.default_rng(6), 4.0)
    left = {"": 1.0, "a": 1.04, "b": 0.9, "ab": 0.5}  # of the squares, by which of the two are in; c adds a hundredth

    def by_gain(problem: Any, start: Any, whitening: Any, causes: Sequence[str], later: Sequence[bool]) -> Any:
        order = sorted(range(len(causes)), key=lambda k: (later[k], causes[k]))
        inside, out = "", [base]
        for k in order:
            inside += causes[k]
            known = "".join(sorted(c for c in inside if c in "ab"))
            noise = 1 + 0.6 * np.random.default_rng(len(known)).standard_normal(base.shape) * (known == "b")
            out.append(base * left[known] * noise * (1.01 if "c" in inside else 1.0))
        return order, in_turn(*out), base.sum(1)

    kept = stood_by(monkeypatch, by_gain, "abc")
    assert [f.name for f in kept.named] == ["a", "b"]
    assert kept.worse == ["c"]
    assert kept.holdout.after == pytest.approx(np.sqrt(0.5) * kept.holdout.before)


def to_other(base: np.ndarray, other: np.ndarray) -> Any:
    """Every cause brings the squares from `base` to `other`."""

    def by_gain(problem: Any, start: Any, whitening: Any, causes: Sequence[str], later: Sequence[bool]) -> Any:
        return list(range(len(causes))), in_turn(base, *[other for _ in causes]), base.sum(1)

    return by_gain


def test_causes_that_raise_the_error_of_all_rows_by_chance_are_not_handed_over(monkeypatch: pytest.MonkeyPatch):
    """The joint is predicted better while it moves, worse where it stands: all rows are what users see."""
    moving = squares(np.random.default_rng(7), 1.0)[1]
    standing = np.random.default_rng(8).uniform(9.0, 11.0, moving.shape)
    moved = 1 + 0.3 * np.random.default_rng(9).standard_normal(moving.shape)
    moved *= (standing.sum() + 0.6 * moving.sum()) / (standing * moved).sum()  # a tenth of what moves is lost in all
    base, other = np.stack([standing + moving, moving]), np.stack([standing * moved + 0.5 * moving, 0.5 * moving])
    assert fall(base, other, [0]).gains

    assert stood_by(monkeypatch, to_other(base, other), "a").worse == ["a"]


@pytest.mark.parametrize(("moved", "strict", "kept"), [(0.97, True, True), (0.97, False, False), (1.01, True, False)])
def test_a_cause_that_is_sure_beside_what_has_no_name_is_named_where_it_does_not_harm(
    monkeypatch: pytest.MonkeyPatch, moved: float, strict: bool, kept: bool
):
    """Among the named causes alone its fall is small and chance; where that is a rise, it is not handed over."""
    base = squares(np.random.default_rng(10), 1.0)
    noise = 1 + 0.3 * np.random.default_rng(11).standard_normal(base.shape[1:])
    other = base * noise
    other *= moved * base.sum() / other.sum()
    assert not fall(base, other, [0]).gains

    assert stood_by(monkeypatch, to_other(base, other), "a").worse == ["a"]
    assert stood_by(monkeypatch, to_other(base, other), "a", strict, borne_out="a").worse == ([] if kept else ["a"])


@pytest.mark.parametrize(("left", "claim", "sure"), [(0.7, 0.6, True), (0.8, 0.95, False), (0.97, 0.02, False)])
def test_a_fall_beside_all_that_was_found_is_sure_and_a_good_part_of_the_claim(
    monkeypatch: pytest.MonkeyPatch, left: float, claim: float, sure: bool
):
    bare = squares(np.random.default_rng(12), 1.0, 1.0)
    full = bare * np.array([left, 1.0]) * (1 + 0.3 * np.random.default_rng(13).standard_normal(bare.shape))
    full *= bare.sum(1, keepdims=True) / full.sum(1, keepdims=True) * np.array([left, 0.999])
    monkeypatch.setattr(gaining, "stood_without", lambda problem, start, found, one, whitening: "bare")
    monkeypatch.setattr(gaining, "weighted_squares", lambda problem, bare_step, step: in_turn(bare, full))
    one, whole, nothing = cast(Any, SimpleNamespace(joints=(0,))), cast(Any, "full"), cast(Any, None)
    assert beside_all(nothing, nothing, np.zeros((1, 2)), [one], whole, one).surely(claim) is sure


def test_of_two_laws_the_one_that_surely_predicts_their_joints_better_is_preferred(monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(14)
    first = squares(rng, 1.0, 1.0)
    second = first * np.array([0.6, 1.8]) * (1 + 0.1 * rng.standard_normal(first.shape))
    monkeypatch.setattr(gaining, "weighted_of_errors", lambda problem, before, after: in_turn(before, after))
    problem, one, other = (cast(Any, x) for x in (None, first, second))
    assert predicts_better(problem, one, other, [0])
    assert not predicts_better(problem, one, other, [1])
    assert not predicts_better(problem, other, one, [0])
    even = first * (1 + 0.3 * rng.standard_normal(first.shape))
    assert not predicts_better(problem, one, cast(Any, even), [0, 1])
    assert not predicts_better(problem, one, cast(Any, 0.995 * first), [0, 1])  # in every block, and no more


def test_a_fit_of_another_weight_is_taken_where_all_rows_kept_out_surely_prefer_it(monkeypatch: pytest.MonkeyPatch):
    """By the robot's error in N m: a small joint that is worse does not keep a large one's gain."""
    rng = np.random.default_rng(5)
    first = squares(rng, 100.0, 4.0)
    second = first * np.array([0.8, 1.5]) * (1 + 0.1 * rng.standard_normal(first.shape))
    even = first * (1 + 0.3 * rng.standard_normal(first.shape))
    monkeypatch.setattr(gaining, "weighted_squares", lambda problem, before, after: in_turn(before, after))
    one, other, third = (kept_squares(cast(Any, None), cast(Any, x)) for x in (first, second, even))
    np.testing.assert_allclose(one, first[0].sum(1))
    assert surely_less(one, other)
    assert not surely_less(other, one)
    assert not surely_less(one, third)


@pytest.mark.parametrize(("claim", "kept"), [(None, True), (0.1, True), (0.5, False)])
def test_what_any_rest_looks_like_must_keep_a_part_of_what_it_takes_in_slices(
    claim: float | None, kept: bool, monkeypatch: pytest.MonkeyPatch
):
    base = squares(np.random.default_rng(3), 4.0)
    claims = {} if claim is None else {"a": claim}
    assert stood_by(monkeypatch, to_other(base, 0.95 * base), "a", claims=claims).worse == ([] if kept else ["a"])


def stood_by(
    monkeypatch: pytest.MonkeyPatch,
    by_gain: Any,
    causes: str,
    strict: bool = True,
    borne_out: str = "",
    claims: dict[str, float] | None = None,
) -> gaining.Gaining:
    """What stays of causes with such squares on the data held out, some of them `borne_out` beside all else."""

    def joint(causes: Sequence[str]) -> Any:
        return SimpleNamespace(causes=list(causes))

    monkeypatch.setattr(gaining, "_by_gain", by_gain)
    monkeypatch.setattr(gaining, "polished", lambda problem, start, causes, whitening: joint(causes))
    found: Any = [SimpleNamespace(name=c, effect=c, joints=(0,)) for c in causes]
    problem: Any = SimpleNamespace(model=SimpleNamespace(joint_names=("one",)), bounded=True)  # no other links
    start, whitening, sure = cast(Any, None), np.zeros((1, 1)), cast(Any, borne_out.__contains__)
    return without_losses(problem, start, whitening, found, joint(causes), strict, sure, cast(Any, claims or {}))


@pytest.mark.parametrize(
    ("seconds", "cutoff", "blocks"),
    [(6.0, 15.0, 16), (6.0, 5.0, 8), (4.0, 2.0, 8), (30.0, 15.0, 30)],
    ids=["as many as are independent", "alike through the filter", "at least eight", "of a second"],
)
def test_a_short_recording_kept_out_has_as_many_blocks_as_the_filter_leaves(seconds: float, cutoff: float, blocks: int):
    rate, rows = 50.0, round(seconds * 50)
    span = SimpleNamespace(slot=0, row=0, rows=rows)
    records = SimpleNamespace(rate=rate, cutoff=cutoff, spans=(span,), judged=np.ones((1, rows, 1)))
    problem: Any = SimpleNamespace(records=records, held=np.ones((1, rows, 1)))
    block = holdout._blocks(problem)  # pyright: ignore[reportPrivateUsage]
    assert block.max() + 1 == blocks
    assert np.bincount(block[0]).min() >= min(rows / blocks, rate) - 1
