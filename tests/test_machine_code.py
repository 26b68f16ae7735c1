"""Programs of the C compiler against Pinocchio; kept on disk and checked; the plain form where they cannot serve."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import pinocchio as pin
import pytest
import robots
from test_general_dynamics import random_tree
from test_kernels import FORMS, TREES, agree, states

import figaroh_jax as fj
from figaroh_jax.compiled import machine_code as code, memory
from figaroh_jax.compiled.kernels import Straight
from figaroh_jax.rigid import normal_equations
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.rigid.regressor import dense_rows
from figaroh_jax.rigid.regressor_gradient import pullback_rows
from figaroh_jax.rigid.scalar_forms import COLUMNS, straight

pytestmark = pytest.mark.skipif(code._compiler() is None, reason="needs a C compiler")


def answers(straight: Straight, model: RobotModel, *arrays: np.ndarray) -> np.ndarray:
    run = code.machine_code(straight, model, *arrays)
    assert run is not None
    return run(lambda shape, fill: np.full(shape, np.nan if fill is None else fill), *arrays)


@pytest.fixture
def always(monkeypatch: pytest.MonkeyPatch):
    """Code for few samples as well, in memory alone."""
    monkeypatch.setattr(code, "FROM", 16)
    monkeypatch.setattr(code, "TO_COMPILE", 16)
    monkeypatch.setattr(code, "_ready", {})
    monkeypatch.setattr(code, "_store", lambda: None)


@pytest.mark.parametrize("name", TREES)
def test_code_of_trees_with_all_joints_gives_pinocchios_numbers(name: str, always: None):
    """Samples that are no whole number of vectors or rounds; answers that the code does not write are zero."""
    twin = random_tree(*TREES[name])
    model, data = twin.model, twin.robot.createData()
    q, v, a = states(model, 157)
    found = {form: answers(FORMS[form], model, q, v, a) for form in ("torques", "dense", "accelerations")}
    found["masses"] = answers(FORMS["masses"], model, q)
    for k in (0, 1, 127, 128, 155, 156):
        theirs = twin.theirs(q[k])
        agree(found["torques"][k], pin.rnea(twin.robot, data, theirs, v[k], a[k]), 1e-12)
        agree(found["accelerations"][k], pin.aba(twin.robot, data, theirs, v[k], a[k]), 1e-12)
        upper = np.triu(pin.crba(twin.robot, data, theirs))
        agree(found["masses"][k], upper + np.triu(upper, 1).T, 1e-12)
        agree(found["dense"][k], pin.computeJointTorqueRegressor(twin.robot, data, theirs, v[k], a[k]), 1e-12)


def test_code_of_a_tree_with_mimic_joints_is_the_plain_kernels(always: None, tmp_path: Path):
    model = robots.load(robots.TREE, tmp_path)
    arrays = states(model, 200)
    few = [x[:15] for x in arrays]  # so few samples go by the plain form
    agree(answers(FORMS["packed"], model, *arrays)[..., :15], fj.packed_regressor(model, *few))
    agree(answers(FORMS["dense"], model, *arrays)[:15], fj.joint_torque_regressor(model, *few))


def test_memory_is_used_again_when_nobody_holds_the_answer(
    always: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    """A view of an answer holds it; what is used again has its zeros where the program writes none."""
    if memory._FREE is None:
        pytest.skip("a system without MADV_FREE")
    monkeypatch.setattr(memory, "LEAST", 1 << 10)
    memory._shelf.clear()
    model = robots.load(robots.ARM, tmp_path)
    one, two, three = ([x[k : k + 64] for x in states(model, 200)] for k in (0, 64, 128))
    run, plain = code.machine_code(FORMS["dense"], model, *one), FORMS["dense"].plain
    assert run is not None
    first = run(code.own_room, *one)
    place, part = first.ctypes.data, first[5, 1:, 13]
    expected = part.copy()
    del first
    second = run(code.own_room, *two)
    assert second.ctypes.data != place
    np.testing.assert_array_equal(part, expected)
    del part
    third = run(code.own_room, *three)
    assert third.ctypes.data == place
    agree(third, plain(model, *three))
    agree(second, plain(model, *two))
    held = [np.asarray(fj.joint_torque_regressor(model, *x))[3] for x in (one, two, three)]
    for found, x in zip(held, (one, two, three), strict=True):
        agree(found, np.asarray(plain(model, *x))[3])
    del second, third, held
    for _ in range(4):
        run(code.own_room, *one)
    assert len(memory._shelf) <= memory.LATEST


def test_the_reverse_of_a_program_is_the_closed_gradient_of_its_rows(always: None, tmp_path: Path):
    """A tree with mimic joints; samples that are no whole number of vectors, and as few as a vector."""
    model, form = robots.load(robots.TREE, tmp_path), straight(COLUMNS, dense_rows)
    arrays = [x[:61] for x in states(model, 200)]
    forth, back = (code.code_of_few(form, model, (model.nv,) * 3, back=way) for way in (False, True))
    assert forth is not None and back is not None
    rows = forth(lambda shape, fill: np.full(shape, np.nan if fill is None else fill), *arrays)
    agree(np.moveaxis(rows, -1, 0).swapaxes(1, 2), fj.joint_torque_regressor(model, *arrays))
    cotangent = np.random.default_rng(0).normal(size=rows.shape)
    q, v, a = (x.T for x in arrays)
    with jax.enable_x64(True):
        given = (jax.numpy.asarray(x) for x in (q, v, a, cotangent.swapaxes(0, 1)))
        closed = np.asarray(eqx.filter_jit(pullback_rows)(model, *given))
    agree(back(cotangent, *arrays).reshape(closed.shape), closed)
    few = back(np.ascontiguousarray(cotangent[..., : code.FEWEST]), *(x[: code.FEWEST] for x in arrays))
    agree(few.reshape(3, model.nv, -1), closed[..., : code.FEWEST])


def test_pieces_on_several_cores_are_those_of_one(always: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    model = robots.load(robots.ARM, tmp_path)
    monkeypatch.setattr(code, "PIECE", 300)
    arrays = states(model, 1003)
    found = {}
    for cores in ("1", "3"):
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", cores)
        found[cores] = [answers(FORMS[form], model, *arrays) for form in ("torques", "packed")]
    for one, three in zip(found["1"], found["3"], strict=True):
        np.testing.assert_array_equal(one, three)


def test_a_normal_matrix_of_machine_code_is_the_sum_of_the_rows(
    always: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(normal_equations, "AT_ONCE", 64)
    model = robots.load(robots.TREE, tmp_path)
    random, samples = np.random.default_rng(4), 150
    q, v, a = states(model, samples)
    tau, extra = random.normal(size=(samples, model.nv)), random.normal(size=(samples, model.nv, 2))
    weight = random.uniform(0.5, 2.0, (samples, model.nv))
    found = fj.normal_matrix(model, q, v, a, tau, weight=weight, extra=extra)
    factor = np.asarray(fj.triangular_factor(model, q, v, a, tau, weight=weight, extra=extra))
    halves = fj.triangular_factor(model, q[:70], v[:70], a[:70], tau[:70], weight=weight[:70], extra=extra[:70])
    rest = fj.triangular_factor(model, q[70:], v[70:], a[70:], tau[70:], weight[70:], extra[70:], total=halves)
    bare = np.asarray(fj.triangular_factor(model, q, v, a))
    monkeypatch.setattr(code, "FROM", samples + 1)  # now by the plain form
    rows = np.concatenate([np.asarray(fj.joint_torque_regressor(model, q, v, a)), extra], axis=2)
    agree(found.matrix, np.einsum("sij,si,sik->jk", rows, weight, rows), 1e-12)
    agree(found.moment, np.einsum("sij,si,si->j", rows, weight, tau), 1e-12)
    agree(found.square, (weight * tau**2).sum(), 1e-12)
    whole = np.concatenate([rows, tau[..., None]], axis=2)
    products = np.einsum("sij,si,sik->jk", whole, weight, whole)
    for one in (factor, np.asarray(rest)):
        assert np.array_equal(one, np.triu(one)) and (np.diagonal(one) >= 0).all()
        agree(one.T @ one, products, 1e-12)
    agree(bare.T @ bare, np.einsum("sij,sik->jk", rows[..., :-2], rows[..., :-2]), 1e-12)


@pytest.mark.parametrize("angle", [2e5, np.nan])
def test_angles_beyond_the_series_go_by_the_plain_form(angle: float, always: None, tmp_path: Path):
    model = robots.load(robots.ARM, tmp_path)
    arrays = states(model, 20)
    arrays[0][7, 1] = angle
    assert code.machine_code(FORMS["torques"], model, *arrays) is None


def test_without_a_compiler_the_plain_form_answers(always: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    model = robots.load(robots.ARM, tmp_path)
    arrays = states(model, 30)
    with_code = fj.inverse_dynamics(model, *arrays)
    for broken in (None, [str(shutil.which("false"))]):
        monkeypatch.setattr(code, "_ready", {})
        monkeypatch.setattr(code, "_compiler", lambda: broken)  # noqa: B023
        agree(fj.inverse_dynamics(model, *arrays), with_code)
        assert code.machine_code(FORMS["torques"], model, *arrays) is None


@pytest.mark.parametrize(("told", "after"), [("cc -g0", ["-g0"]), ("my cc", []), ("no-such -g0", None), ("'", None)])
def test_the_compiler_is_what_make_takes_it_for(
    told: str, after: list[str] | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "my cc").symlink_to(str(shutil.which("cc")))
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("CC", told)
    found = code._compiler.__wrapped__()
    assert found is None if after is None else found is not None and found[1:] == after


CHILD = """
import numpy as np, figaroh_jax as fj
from figaroh_jax.compiled import machine_code as code
from figaroh_jax.compiled import memory
from figaroh_jax.compiled.executable_cache import keep_programs
made = []
before = code._compiled
code._compiled = lambda wanted: made.append(1) or before(wanted)
keep_programs()
robot = fj.load_urdf(fj.DEMO)
q, v, a = np.random.default_rng(0).normal(size=(3, 3000, robot.nv))
total = np.asarray(fj.inverse_dynamics(robot, q, v, a)).sum()
print(len(made), repr(float(total)))
"""


def test_another_process_compiles_nothing_and_a_damaged_library_is_made_anew(tmp_path: Path):
    def run() -> tuple[int, float]:
        environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path), "JAX_PLATFORMS": "cpu"}
        said: Any = subprocess.run([sys.executable, "-c", CHILD], capture_output=True, text=True, env=environment)
        assert said.returncode == 0, said.stderr
        made, total = said.stdout.split()
        return int(made), float(total)

    first, second = run(), run()
    assert (first[0], second[0]) == (1, 0)
    (library,) = tmp_path.rglob("*.so")
    data = bytearray(library.read_bytes())
    data[len(data) // 2] ^= 1
    library.write_bytes(bytes(data))
    third = run()
    assert third[0] == 1
    assert first[1] == second[1] == third[1]
