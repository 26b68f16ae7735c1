"""The condensed regressor against the dense one in NumPy, in pieces, with weights, and in bounded memory."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import robots

from figaroh_jax.compiled.batching import BLOCK, chunk_size
from figaroh_jax.errors import InputError
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.rigid.normal_equations import (
    NormalMatrix,
    _factor_by_kernels,
    _joined,
    _Rows,
    normal_matrix,
    triangular_factor,
)
from figaroh_jax.rigid.regressor import joint_torque_regressor

CHUNK = chunk_size()


@pytest.fixture
def tree(tmp_path: Path) -> RobotModel:
    return robots.load(robots.TREE, tmp_path)


def data(model: RobotModel, samples: int) -> list[Any]:
    """q, v, a, tau and weights."""
    *state, weight = np.random.default_rng(samples).standard_normal((5, samples, model.nv))
    return [*state, weight**2]


def rows(model: RobotModel, q: np.ndarray, v: np.ndarray, a: np.ndarray, *beside: np.ndarray) -> np.ndarray:
    """Dense rows of [W beside]."""
    dense = np.concatenate([np.asarray(joint_torque_regressor(model, q, v, a)), *beside], axis=2)
    return dense.reshape(-1, dense.shape[2])


def assembled(normal: NormalMatrix) -> np.ndarray:
    G, b, square = (np.asarray(x) for x in normal)
    return np.block([[G, b[:, None]], [b, square]])


def assert_relatively_equal(got: np.ndarray, expected: np.ndarray, tolerance: float = 1e-13) -> None:
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance * np.abs(expected).max())


@pytest.mark.parametrize("samples", [1, 63, 64, 65, CHUNK + 1, BLOCK + 7])
def test_normal_matrix_and_factor_are_those_of_the_dense_rows(samples: int, tree: RobotModel) -> None:
    q, v, a, tau, weight = data(tree, samples)
    extra = np.random.default_rng(0).standard_normal((samples, tree.nv, 3))
    dense = rows(tree, q, v, a, extra, tau[..., None]) * np.sqrt(weight).reshape(-1, 1)
    expected = dense.T @ dense
    assert_relatively_equal(assembled(normal_matrix(tree, q, v, a, tau, weight, extra)), expected)
    R = np.asarray(triangular_factor(tree, q, v, a, tau, weight, extra))
    np.testing.assert_array_equal(R, np.triu(R))
    assert (np.diagonal(R) >= 0.0).all()
    assert_relatively_equal(R.T @ R, expected)


@pytest.mark.parametrize("name", ["tx40", *(pytest.param(name, marks=pytest.mark.slow) for name in ("panda", "talos"))])
def test_normal_matrix_and_factor_of_real_robots(name: str, data_dir: Path) -> None:
    from figaroh_jax.formats.urdf import load_urdf

    model = load_urdf(data_dir / robots.REAL[name])
    q, v, a, tau, _ = data(model, 300)
    dense = rows(model, q, v, a, tau[..., None])
    assert_relatively_equal(assembled(normal_matrix(model, q, v, a, tau)), dense.T @ dense)
    R = np.asarray(triangular_factor(model, q, v, a))
    assert_relatively_equal(R.T @ R, dense[:, :-1].T @ dense[:, :-1])


@pytest.mark.parametrize(("size", "beside"), [(1.0, 1), (1e-3, 1), (1.0, 0)])
def test_the_factor_of_products_is_that_of_the_rows(size: float, beside: int, tmp_path: Path) -> None:
    """As a GPU makes it, here by the plain form of its kernels; small motions leave directions 1e6 times smaller."""
    arm = robots.load(robots.INLINE["arm"], tmp_path)
    q, v, a, tau, weight = data(arm, 700)
    q, v, a = size * q + 0.3, size * v, size * a
    root = jnp.asarray(np.sqrt(weight))
    given = _Rows(jnp.asarray(q), jnp.asarray(v), jnp.asarray(a), root, jnp.asarray(tau) if beside else None, None)
    columns = 10 * len(arm.joints) + beside
    got = np.asarray(_joined(jnp.zeros((columns, columns)), _factor_by_kernels(arm, columns, given)))
    dense = rows(arm, q, v, a, *([tau[..., None]] if beside else [])) * np.sqrt(weight).reshape(-1, 1)
    assert_relatively_equal(got.T @ got, dense.T @ dense)
    values, expected = (np.linalg.svd(x, compute_uv=False) for x in (got, dense))
    seen = expected > 1e-13 * expected[0]
    np.testing.assert_allclose(values[seen], expected[seen], rtol=1e-7)
    assert (values[~seen] < 1e-13 * values[0]).all()


def test_pieces_add_up_to_the_whole(tree: RobotModel) -> None:
    """Pieces of any length, as an iterator over files would give them."""
    whole, normal, factor = data(tree, 500), None, None
    for piece in zip(*(np.split(x, [1, 130, 131, 400]) for x in whole), strict=True):
        normal = normal_matrix(tree, *piece, total=normal)
        factor = triangular_factor(tree, *piece, total=factor)
    assert normal is not None and factor is not None
    assert_relatively_equal(assembled(normal), assembled(normal_matrix(tree, *whole)))
    assert_relatively_equal(np.asarray(factor.T @ factor), assembled(normal))


def test_a_weight_for_each_joint_is_the_same_weight_in_every_sample(tree: RobotModel) -> None:
    q, v, a, tau, _ = data(tree, 70)
    weight = np.arange(1.0, 1.0 + tree.nv)
    expected = normal_matrix(tree, q, v, a, tau, np.broadcast_to(weight, q.shape))
    assert_relatively_equal(assembled(normal_matrix(tree, q, v, a, tau, weight)), assembled(expected))


def test_no_samples_give_zero(tree: RobotModel) -> None:
    none = np.zeros((0, tree.nv))
    assert not assembled(normal_matrix(tree, none, none, none, none)).any()


@pytest.mark.parametrize("name", ["arm", pytest.param("tree", marks=pytest.mark.slow)])
def test_normal_matrix_under_jit_grad_and_vmap(name: str, tmp_path: Path) -> None:
    tree = robots.load(robots.INLINE[name], tmp_path)
    q, v, a, tau, weight = data(tree, 2 * CHUNK + 1)
    expected = assembled(normal_matrix(tree, q, v, a, tau, weight))
    jitted = jax.jit(normal_matrix)(tree, q, v, a, tau, weight)
    assert_relatively_equal(assembled(jitted), expected)

    def square(scale: float | jax.Array) -> jax.Array:
        longer = eqx.tree_at(lambda m: m.placement, tree, tree.placement.at[:, :3, 3].multiply(scale))
        return jnp.sum(normal_matrix(longer, q, v, a, tau, weight).matrix)

    tree = jax.tree.map(jnp.asarray, tree)
    h = 1e-5
    difference = (square(1.0 + h) - square(1.0 - h)) / (2 * h)
    np.testing.assert_allclose(jax.grad(square)(1.0), difference, rtol=1e-6, atol=0)
    two: list[Any] = [np.stack([x, 2.0 * x]) for x in (q, v, a, tau)]
    mapped = jax.vmap(normal_matrix, (None, 0, 0, 0, 0))(tree, *two).matrix[1]
    assert_relatively_equal(np.asarray(mapped), np.asarray(normal_matrix(tree, *(x[1] for x in two)).matrix))


def test_wrong_shapes_are_named(tree: RobotModel) -> None:
    q = np.zeros((5, tree.nv))
    with pytest.raises(InputError, match="weight has shape"):
        normal_matrix(tree, q, q, q, q, weight=np.ones(7))
    with pytest.raises(InputError, match="last axis must hold"):
        triangular_factor(tree, q[:, :2], q[:, :2], q[:, :2])


PEAK = """
import sys
from pathlib import Path
import numpy as np, jax
from figaroh_jax.rigid.normal_equations import normal_matrix, triangular_factor
from figaroh_jax.formats.urdf import load_urdf
model, rng = load_urdf(sys.argv[1]), np.random.default_rng(0)
piece = rng.standard_normal((4, 20_000, model.nv))
for count in (5, 50):
    total = None
    for _ in range(count):
        total = {"normal": normal_matrix, "factor": triangular_factor}[sys.argv[2]](model, *piece, total=total)
    jax.block_until_ready(total)
    status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    print(int(status["VmHWM"].split()[0]) // 1024)  # ru_maxrss would inherit the peak of the process that tests
"""


@pytest.mark.parametrize("kind", ["normal", pytest.param("factor", marks=pytest.mark.slow)])
def test_memory_does_not_grow_from_a_hundred_thousand_samples_to_a_million(kind: str, data_dir: Path) -> None:
    """Peak resident memory in MB; the dense regressor of the million would take 2880."""
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", PEAK, str(data_dir / robots.REAL["ur10e"]), kind]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    small, large = map(int, done.stdout.split())
    assert large - small < 100
    assert large < 1000
