"""Kernels in scalars against Pinocchio: the programs number by number, one kernel without a GPU, both on a GPU."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
import robots
from jax.extend.core import Literal
from test_general_dynamics import random_tree

from figaroh_jax.compiled import executable_cache, kernels
from figaroh_jax.compiled.batching import DRAFT_OPTIONS
from figaroh_jax.compiled.kernels import Number, Straight, launch, straight_answers
from figaroh_jax.rigid import dynamics, looped_kernels, normal_equations, regressor, regrouped, scalar_forms
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.rigid.scalars import known

FORMS = {
    "torques": dynamics._TORQUES,
    "masses": dynamics._MASSES,
    "accelerations": dynamics._ACCELERATIONS,
    "packed": regressor._PACKED,
    "dense": regressor._DENSE,
}
TREES = {
    "mixed": (3, ("revolute", "prismatic", "revolute", "spherical", "planar", "revolute")),
    "free base": (5, ("free", "revolute", "revolute", "prismatic", "revolute")),
}


def by_hand(straight: Straight, codes: bytes, model: RobotModel, *arrays: np.ndarray) -> Any:
    """Answers of the programs with an operation at a time."""
    constants, shape = np.asarray(straight.constants(model)), straight.shape(model)
    many = isinstance(shape, list)
    answers = [np.full((*one, len(arrays[0])), np.nan) for one in (shape if isinstance(shape, list) else [shape])]
    answer = answers[0]

    def write(entries: Any) -> None:
        for place, number in entries:
            (answers[place[0]] if many else answer)[place[1:] if many else place] = number.x

    reads: list[Any] = [lambda k, x=x: Number(jnp.asarray(x[:, k])) for x in arrays]
    reads.append(lambda places: [Number(jnp.asarray(answer[place])) for place in places])
    for program in straight.programs(model, codes):
        program(lambda k: jnp.asarray(constants[k]), reads, write)
    if many:
        return answers
    whole = answer if straight.finish is None else np.asarray(straight.finish(model, jnp.asarray(answer)))
    return whole if straight.last else np.moveaxis(whole, -1, 0)


def states(model: RobotModel, samples: int, seed: int = 0) -> list[np.ndarray]:
    random = np.random.default_rng(seed)
    q, v, a = (random.uniform(-2.0, 2.0, (samples, n)) for n in (model.nq, model.nv, model.nv))
    for joint, at in zip(model.joints, model.dofs.positions, strict=True):
        if joint.kind in ("free", "spherical"):
            quaternion = q[:, at.stop - 4 : at.stop]
            quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    return [q, v, a]


def quick(function: Any) -> Any:
    """The function as one program that is compiled fast and runs slowly."""
    return jax.jit(function, compiler_options=DRAFT_OPTIONS if jax.default_backend() == "cpu" else None)


def plainly(straight: Straight, model: RobotModel, *arrays: Any) -> Any:
    """The plain form, as one program: operation by operation most of the time goes into compiling each."""
    return quick(straight.plain)(model, *map(jnp.asarray, arrays))


def agree(found: Any, expected: Any, limit: float = 1e-13) -> None:
    expected = np.asarray(expected)
    assert np.shape(found) == expected.shape
    np.testing.assert_allclose(found, expected, rtol=0, atol=limit * np.abs(expected).max())


@pytest.mark.parametrize("name", TREES)
def test_programs_of_trees_with_all_joints_are_pinocchios(name: str):
    twin = random_tree(*TREES[name])
    model, data = twin.model, twin.robot.createData()
    q, v, a = states(model, 3)
    found = {
        form: by_hand(one, (one.nothing_known if name == "mixed" else one.known)(model), model, q, v, a)
        for form, one in FORMS.items()
        if form != "packed"
    }
    for k in range(3):
        theirs = twin.theirs(q[k])
        expected = {
            "torques": pin.rnea(twin.robot, data, theirs, v[k], a[k]),
            "accelerations": pin.aba(twin.robot, data, theirs, v[k], a[k]),
            "masses": np.triu(pin.crba(twin.robot, data, theirs)),
            "dense": pin.computeJointTorqueRegressor(twin.robot, data, theirs, v[k], a[k]),
        }
        expected["masses"] = expected["masses"] + np.triu(expected["masses"], 1).T
        for form, answer in expected.items():
            agree(found[form][k], answer, 1e-12)


@pytest.mark.slow
def test_programs_of_a_tree_with_mimic_joints_are_the_plain_kernels(tmp_path: Path):
    """Sliding and turning joints, branches, a mimic joint before the joint that it follows."""
    model = robots.load(robots.TREE, tmp_path)
    for form, straight in FORMS.items():
        arrays = states(model, 4)[: 1 if form == "masses" else 3]
        agree(by_hand(straight, straight.known(model), model, *arrays), plainly(straight, model, *arrays))


def test_kernels_without_a_gpu(tmp_path: Path):
    """The same launch, interpreted; more samples than a block has, and no whole number of blocks."""
    model = robots.load(robots.ARM, tmp_path)
    arrays = [jnp.asarray(x) for x in states(model, 37)]
    torques = FORMS["torques"]
    (program,) = torques.programs(model, torques.known(model))
    shape, columns = torques.shape(model), torques.columns(model)
    found = launch(program, torques.constants(model), arrays, shape, columns, torques.last, interpret=True)
    agree(found, plainly(torques, model, *arrays))


def test_pieces_of_a_tree_are_written_into_one_answer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(scalar_forms, "MOST", 4)
    model, packed = robots.load(robots.TREE, tmp_path), FORMS["packed"]
    arrays = states(model, 3)
    assert len(packed.programs(model, packed.known(model))) == 3
    agree(by_hand(packed, packed.known(model), model, *arrays), plainly(packed, model, *arrays))


def test_torques_limb_by_limb(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """An arm and a tree cut into pieces: what a limb hands over; a coordinate that two pieces share is not cut."""
    monkeypatch.setattr(scalar_forms, "LIMB", 1)
    scalar_forms._limbs.cache_clear()
    try:
        limbs = dynamics._LIMBS
        arm, tree = robots.load(robots.ARM, tmp_path), random_tree(8, ("revolute", "prismatic") * 2).model
        assert len(limbs.programs(arm, limbs.known(arm))) == 2 and len(limbs.programs(tree, limbs.known(tree))) > 2
        for model in (arm, tree):
            arrays = states(model, 3)
            agree(by_hand(limbs, limbs.known(model), model, *arrays), plainly(limbs, model, *arrays))
        arrays, answer = [jnp.asarray(x) for x in states(arm, 3)], None
        shape, columns, constants = limbs.shape(arm), limbs.columns(arm), limbs.constants(arm)
        for program in limbs.programs(arm, limbs.known(arm)):
            answer = launch(program, constants, arrays, shape, columns, True, answer, interpret=True)
        assert answer is not None
        agree(answer[: arm.nv].T, plainly(limbs, arm, *arrays))
        assert not scalar_forms.in_limbs(robots.load(robots.TREE, tmp_path))
    finally:
        scalar_forms._limbs.cache_clear()


@pytest.mark.parametrize("samples", [pytest.param(32, marks=pytest.mark.slow), 33])
def test_accesses_of_a_long_kernel_share_no_constant(samples: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """From a constant Triton's compiler reaches whatever uses the same, for each access anew (minutes for TALOS)."""
    monkeypatch.setattr(kernels, "FEW", 0)
    model, torques = robots.load(robots.TREE, tmp_path), FORMS["torques"]
    shape, columns, constants = torques.shape(model), torques.columns(model), torques.constants(model)
    (program,) = torques.programs(model, torques.known(model))
    arrays = [jnp.asarray(x) for x in states(model, samples)]

    def kernel(*arrays: Any) -> Any:
        return launch(program, constants, arrays, shape, columns, torques.last, interpret=True)

    (call,) = (e for e in jax.make_jaxpr(kernel)(*arrays).jaxpr.eqns if e.primitive.name == "pallas_call")
    loops = [e.params["body_jaxpr"].jaxpr for e in call.params["jaxpr"].eqns if e.primitive.name == "while"]
    assert len(loops) > model.nv
    for loop in loops:
        for step in (e for e in loop.eqns if e.primitive.name not in ("masked_load", "masked_swap")):
            assert not any(isinstance(x, Literal) for x in step.invars) or step.primitive.name == "neg", step
    agree(kernel(*arrays), plainly(torques, model, *arrays))


@pytest.mark.parametrize("name", TREES)
def test_columns_that_are_left_out_follow_from_those_that_are_kept(name: str):
    """Pinocchio's regressor of trees with every joint, along and beside the axes of the links."""
    kinds = (*TREES[name][1], "prismatic", "revolute")
    twin = random_tree(TREES[name][0], kinds)
    model, data = twin.model, twin.robot.createData()
    kept = regrouped.kept_columns(model.joints, known(model))
    assert [10 - len(own) for own, kind in zip(kept, kinds, strict=True) if kind != "revolute"] == [
        {"prismatic": 6, "spherical": 1}.get(kind, 0) for kind in kinds if kind != "revolute"
    ]
    assert regrouped.regrouping(model, tuple(regrouped.ALL for _ in kept)).tolist() == np.eye(10 * len(kept)).tolist()
    of_columns, left = regrouped.regrouping(model, kept), sum(10 - len(own) for own in kept)
    assert of_columns.shape == (10 * len(kept) - left, 10 * len(kept))
    index = [10 * i + k for i, own in enumerate(kept) for k in own]
    q, v, a = states(model, 3)
    for k in range(3):
        whole = pin.computeJointTorqueRegressor(twin.robot, data, twin.theirs(q[k]), v[k], a[k])
        agree(whole[:, index] @ of_columns, whole, 1e-12)


def test_rows_of_a_normal_matrix_are_written_by_coordinate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The programs against the plain rows, one kernel interpreted, and the sums that a GPU would make of them."""
    model, arm = robots.load(robots.TREE, tmp_path), robots.load(robots.ARM, tmp_path)
    random, count = np.random.default_rng(1), 3
    q, v, a, tau, weight = random.standard_normal((5, 9, model.nv))
    extra = random.standard_normal((9, model.nv, 2))
    form = normal_equations._row_form(count, None)
    arrays = [q, v, a, np.abs(weight), random.standard_normal((9, model.nv * count))]
    written = by_hand(form, form.known(model), model, *arrays)
    for found, expected in zip(written, plainly(form, model, *arrays), strict=True):
        agree(found, expected)
    some = regrouped.kept_columns(model.joints, form.known(model))
    assert sum(map(len, some)) < 10 * len(some)
    few = normal_equations._row_form(count, some)
    for found, expected in zip(
        by_hand(few, few.known(model), model, *arrays), plainly(few, model, *arrays), strict=True
    ):
        agree(found, expected)
    small = [jnp.asarray(x[:, : arm.nv * (count if k == 4 else 1)]) for k, x in enumerate(arrays)]
    (program,) = form.programs(arm, form.known(arm))
    shape, columns, constants = form.shape(arm), form.columns(arm), form.constants(arm)
    found = launch(program, constants, small, shape, columns, True, interpret=True)
    for one, expected in zip(found, plainly(form, arm, *small), strict=True):
        agree(one, expected)
    arm_kept = regrouped.kept_columns(arm.joints, form.known(arm))
    pieces = normal_equations._row_form(count, arm_kept, 32)
    many = [jnp.asarray(random.standard_normal((64, x.shape[1]))) for x in small]
    (program,) = pieces.programs(arm, pieces.known(arm))
    columns, constants = pieces.columns(arm), pieces.constants(arm)
    found = launch(program, constants, many, pieces.shape(arm), columns, True, interpret=True, piece=32)
    whole = plainly(normal_equations._row_form(count, arm_kept), arm, *many)
    for one, beside, expected in zip(found, plainly(pieces, arm, *many), whole, strict=True):
        agree(one, beside)
        agree(np.moveaxis(one, 1, 2).reshape(expected.shape), expected)
    expected = normal_equations.normal_matrix(model, q, v, a, tau, weight**2, extra)
    monkeypatch.setattr(normal_equations, "usable", lambda *x: True)
    monkeypatch.setattr(normal_equations, "on_host", lambda *x: False)
    for one, other in zip(normal_equations.normal_matrix(model, q, v, a, tau, weight**2, extra), expected, strict=True):
        agree(one, other)


class _ByHand:
    """In place of `kernels.Lanes`: arrays of NumPy, a kernel's loops run in Python."""

    dtype = np.dtype(float)

    def __init__(self, outs: list[np.ndarray]) -> None:
        self.outs = outs

    def full(self, x: Any) -> Any:
        return jnp.full(self.outs[0].shape[1], x)

    def read(self, ref: np.ndarray, first: Any, k: int) -> Number:
        return Number(jnp.asarray(ref[:, int(first) + k]))

    def at(self, ref: np.ndarray, row: Any, wanted: Any = True) -> Any:
        return jnp.where(wanted, jnp.asarray(ref[int(row)]), np.nan)

    def put(self, ref: np.ndarray, row: Any, numbers: Any, wanted: Any = True) -> None:
        for k, x in enumerate(numbers if np.all(wanted) else ()):
            ref[int(row) + k] = x


def launch_by_hand(kernel: Any, arrays: Any, shapes: list[tuple[int, int]]) -> Any:
    outs = [np.full(shape, np.nan) for shape in shapes]
    with jax.disable_jit():
        kernel(_ByHand(outs), *map(np.asarray, arrays))
    return [jnp.asarray(out) for out in outs]


@pytest.mark.parametrize("name", [*TREES, "TREE"])
def test_looped_kernels_write_what_the_plain_ones_do(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Weighted rows with columns beside; none where joints share a coordinate."""
    monkeypatch.setattr(scalar_forms, "MOST", 1)
    monkeypatch.setattr(looped_kernels, "launch_over", launch_by_hand)
    monkeypatch.setattr(looped_kernels, "lanes_of", lambda x, lanes: jnp.broadcast_to(x.x, lanes.outs[0].shape[1]))
    model = random_tree(*TREES[name]).model if name in TREES else robots.load(getattr(robots, name), tmp_path)
    arrays, random = states(model, 3), np.random.default_rng(2)
    shared = len(model.dofs.column) > model.nv
    beside = normal_equations._row_form(2, None)
    weighted = [*arrays, np.abs(random.standard_normal((3, model.nv))), random.standard_normal((3, 2 * model.nv))]
    assert beside.looped
    blocks = regressor.BLOCK_FORM
    assert blocks.looped
    if shared:
        assert beside.looped(model, *weighted) is None and blocks.looped(model, *arrays) is None
    else:
        agree(blocks.looped(model, *arrays), plainly(blocks, model, *arrays))
        for one, expected in zip(beside.looped(model, *weighted), plainly(beside, model, *weighted), strict=True):
            agree(one, expected)


def test_a_kernel_is_kept_between_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    model = robots.load(robots.ARM, tmp_path)
    arrays = [jnp.asarray(x) for x in states(model, 5)]
    monkeypatch.setattr(executable_cache, "keeping", lambda: tmp_path / "kept")
    kernels._kept.cache_clear()
    found = straight_answers(FORMS["masses"], model, arrays[0])
    kernels._kept.cache_clear()  # as in a new process
    monkeypatch.setattr(executable_cache.Program, "_made", None)
    np.testing.assert_array_equal(straight_answers(FORMS["masses"], model, arrays[0]), found)
    kernels._kept.cache_clear()


def test_transformations(tmp_path: Path):
    """Away from a GPU the plain form answers, through the same derivatives and batches."""
    model = robots.load(robots.ARM, tmp_path)
    q, v, a = states(model, 6)
    torques, rest = FORMS["torques"], (jnp.asarray(v[:3]), jnp.asarray(a[:3]))

    def total(model: RobotModel, q: Any) -> Any:
        return jnp.sum(straight_answers(torques, model, q, *rest) ** 2)

    plain = quick(jax.grad(lambda q: jnp.sum(torques.plain(model, q, *rest) ** 2)))
    agree(quick(jax.grad(total, argnums=1))(model, q[:3]), plain(jnp.asarray(q[:3])))
    batches = [jnp.asarray(x).reshape(2, 3, -1) for x in (q, v, a)]
    for form in ("torques", "packed"):
        both = quick(jax.vmap(lambda *x: straight_answers(FORMS[form], model, *x)))(*batches)  # noqa: B023
        for k in range(2):
            agree(both[k], plainly(FORMS[form], model, *(x[k] for x in batches)))
    many = jax.tree.map(lambda x: jnp.stack([x, 1.1 * x]), model)
    answers = quick(jax.vmap(lambda m: straight_answers(torques, m, q, v, a)))(many)
    agree(answers[0], plainly(torques, model, q, v, a))


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated")
def test_a_jax_without_triton_takes_the_plain_form_on_a_gpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    model = robots.load(robots.ARM, tmp_path)
    q, v, a = states(model, 7)

    def lowered() -> str:
        kernels._triton.cache_clear()
        kernels._batched.cache_clear()
        program = jax.jit(lambda *x: straight_answers(FORMS["torques"], model, *x)).trace(q, v, a)
        return program.lower(lowering_platforms=("cuda",)).as_text()

    assert "triton" in lowered()
    monkeypatch.setitem(sys.modules, "jax.experimental.pallas.triton", None)
    monkeypatch.delattr("jax.experimental.pallas.triton", raising=False)
    try:
        assert "triton" not in lowered()
    finally:
        monkeypatch.undo()
        kernels._triton.cache_clear()
        kernels._batched.cache_clear()


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated")
@pytest.mark.skipif(jax.default_backend() != "gpu", reason="needs an NVIDIA GPU")
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("robot", ["ARM", "TREE", "GENERAL"])
def test_kernels_on_a_gpu(robot: str, dtype: Any, tmp_path: Path):
    model = robots.load(getattr(robots, robot), tmp_path)
    arrays = states(model, 1000)
    limit = 1e-13 if dtype is np.float64 else 1e-5
    for form, straight in FORMS.items():
        given = arrays[:1] if form == "masses" else arrays
        with jax.default_device(jax.devices("cpu")[0]):
            expected = np.asarray(straight.plain(model, *map(jnp.asarray, given)))
        given = [jnp.asarray(x, dtype) for x in given]
        off = limit if form != "accelerations" else 1000 * limit  # a solve with the mass matrix
        agree(straight_answers(straight, model, *given), expected, off)
        agree(jax.jit(lambda m, *x: straight_answers(straight, m, *x))(model, *given), expected, off)  # noqa: B023


@pytest.mark.filterwarnings("ignore:The Pallas Triton backend is deprecated")
@pytest.mark.skipif(jax.default_backend() != "gpu", reason="needs an NVIDIA GPU")
@pytest.mark.parametrize("name", [*TREES, "TREE"])
def test_looped_kernels_on_a_gpu(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(scalar_forms, "MOST", 1)
    model = random_tree(*TREES[name]).model if name in TREES else robots.load(getattr(robots, name), tmp_path)
    arrays, random = states(model, 1000), np.random.default_rng(2)
    weighted = [*arrays, np.abs(random.standard_normal((1000, model.nv))), random.standard_normal((1000, 2 * model.nv))]
    form = normal_equations._row_form(2, None)
    if not scalar_forms.looped(model):
        return
    with jax.default_device(jax.devices("cpu")[0]):
        expected = jax.tree.leaves(form.plain(model, *map(jnp.asarray, weighted)))
    found = jax.jit(lambda *x: form.looped(model, *x))(*map(jnp.asarray, weighted))  # pyright: ignore
    for one, other in zip(jax.tree.leaves(found), expected, strict=True):
        agree(one, other)
