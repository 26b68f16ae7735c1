"""Rows of which each joint has its own columns, beside the same products of dense rows with their zeros (NumPy)."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic import made_rows

from figaroh_jax.estimation.joint_rows import JointRows
from figaroh_jax.estimation.rows import model_sums

NV, COUNT, WIDTH = 4, 30, 9


def sparse(seed: int, width: int = WIDTH) -> np.ndarray:
    """Random dense rows; a joint has every second column or so, the last joint none."""
    rng = np.random.default_rng(seed)
    X = rng.normal(size=(NV, COUNT, width)) * (rng.random((NV, 1, width)) < 0.5)
    X[0, :, 0], X[-1] = 1.0, 0.0
    return X


def close(one: np.ndarray, other: np.ndarray) -> None:
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


def test_no_zero_column_is_stored_and_none_is_lost() -> None:
    X = sparse(0)
    rows = JointRows.of(X)
    assert sum(own.columns.size for own in rows.own) == np.count_nonzero(X)
    assert rows.shape == X.shape
    close(rows.dense(), X)
    close(rows.dense(2, 6), X[:, :, 2:6])
    close(rows.first(4).dense(), X[:, :, :4])
    close(rows.after(4).dense(), X[:, :, 4:])


def test_products_are_those_of_the_dense_rows() -> None:
    X, Z, rng = sparse(1), sparse(2, 5), np.random.default_rng(3)
    rows, others, weight = JointRows.of(X), JointRows.of(Z), rng.random(NV)
    theta, residual = rng.normal(size=(WIDTH, 2)), rng.normal(size=(3, NV, COUNT))
    close(rows @ theta, X @ theta)
    close(rows @ theta[:, 0], X @ theta[:, 0])
    close(rows.pulled(residual), np.einsum("djt,jtp->dp", residual, X))
    close(rows.pulled_at((2, 0), residual[:, :2]), np.einsum("djt,jtp->dp", residual[:, :2], X[[2, 0]]))
    assert rows.pulled(residual.astype(np.float32)).dtype == np.float32
    close(rows.products(others), np.einsum("jtp,jtk->pk", X, Z))
    close(rows.squares(), np.einsum("jtp,jtk->pk", X, X))
    close(rows.squares(weight), np.einsum("j,jtp,jtk->pk", weight, X, X))
    close(rows.lengths, (X**2).sum((0, 1)))


@pytest.mark.parametrize("joints", [[1], [3], [2, 0], [0, 1, 2, 3]])
def test_rows_of_some_joints_below_each_other_have_the_columns_of_any_of_them(joints: list[int]) -> None:
    X = sparse(4)
    tall, place = JointRows.of(X).tall(joints)
    own = X[joints].reshape(-1, WIDTH)
    close(tall, own[:, place])
    assert not np.delete(own, place, axis=1).any()


def test_columns_stand_behind_one_another_and_a_joint_is_replaced_alone() -> None:
    X, Z = sparse(5), np.random.default_rng(6).normal(size=(3, 2, COUNT))
    more = JointRows.at((2, 3), Z, NV)
    full = np.zeros((NV, COUNT, 3))
    full[2:] = np.moveaxis(Z, 0, 2)
    rows = JointRows.of(X)
    close(more.dense(), full)
    close(rows.beside(more, rows).dense(), np.concatenate([X, full, X], axis=2))
    other = sparse(7)
    expected = X.copy()
    expected[1] = other[1]
    close(rows.replaced(1, JointRows.of(other)).dense(), expected)
    close(rows.dense(), X)  # it is as it was


def test_sums_over_blocks_are_those_of_a_loop_over_rows() -> None:
    X, y = sparse(8), np.random.default_rng(9).normal(size=(NV, COUNT))
    rows = made_rows(y, X, blocks=5)
    expected = np.zeros((WIDTH, 5))
    for row, block in enumerate(rows.block):
        expected[:, block] += y[:, row] @ X[:, row]
    close(model_sums(rows, rows.X, y), expected)
