"""The joint-torque regressor against Pinocchio's, by its own reading of the URDF, and against the library's laws."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
import robots

from figaroh_jax.compiled.batching import BLOCK, chunk_size
from figaroh_jax.errors import InputError
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid.dynamics import inverse_dynamics
from figaroh_jax.rigid.model import Joint, RobotModel
from figaroh_jax.rigid.regressor import joint_torque_regressor, packed_regressor, pairs

CHUNK = chunk_size(200)
LEAVES = ("placement", "axis", "ratio", "offset", "gravity")
MIMIC = '<mimic joint="knee" multiplier="-1.5" offset="0.3"/>'


def reference(path: Path, model: RobotModel, *state: np.ndarray) -> np.ndarray:
    """Pinocchio's regressors (samples, nv, 10 nj) of the whole URDF, in our order; its other joints stand still."""
    robot = pin.buildModelFromUrdf(str(path))
    moved = {joint.name: i for i, joint in enumerate(model.joints)}
    still = [i for i, name in enumerate(robot.names) if i and name not in moved]
    robot = pin.buildReducedModel(robot, still, pin.neutral(robot))
    tree = [moved[name] for name in list(robot.names)[1:]]
    share = np.zeros((len(tree), model.nv))
    share[np.arange(len(tree)), [model.joints[i].coordinate for i in tree]] = np.asarray(model.ratio)[tree]
    data: Any = robot.createData()
    answer = np.zeros((len(state[0]), model.nv, len(tree), 10))
    for k, (q, v, a) in enumerate(zip(*state, strict=True)):
        angle = share @ q + np.asarray(model.offset)[tree]
        turns = zip(list(robot.joints)[1:], angle, strict=True)
        configuration = np.concatenate([[np.cos(x), np.sin(x)] if joint.nq == 2 else [x] for joint, x in turns])
        rows = pin.computeJointTorqueRegressor(robot, data, configuration, share @ v, share @ a)
        answer[k][:, tree] = (share.T @ rows).reshape(model.nv, -1, 10)
    return answer.reshape(*answer.shape[:2], -1)


def unit_states(model: RobotModel, samples: int) -> np.ndarray:
    return np.random.default_rng(samples).standard_normal((3, samples, model.nv))


@pytest.fixture
def arm(tmp_path: Path) -> RobotModel:
    return robots.load(robots.ARM, tmp_path)


@pytest.fixture
def tree(tmp_path: Path) -> RobotModel:
    return robots.load(robots.TREE, tmp_path)


ROBOTS = ["arm", pytest.param("tree", marks=pytest.mark.slow)]  # transformed programs of a tree take long to compile


@pytest.fixture
def robot(request: pytest.FixtureRequest) -> RobotModel:
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in ("panda", "tiago"))) for name in robots.REAL]
)
def test_regressor_of_real_robots_is_pinocchios(name: str, data_dir: Path) -> None:
    path = data_dir / robots.REAL[name]
    model = load_urdf(path)
    state = unit_states(model, 20)
    W = joint_torque_regressor(model, *state)
    np.testing.assert_allclose(W, reference(path, model, *state), rtol=0, atol=1e-12)
    tau = inverse_dynamics(model, *state)
    np.testing.assert_allclose(W @ model.inertia.ravel(), tau, rtol=0, atol=1e-12 * np.abs(tau).max())


@pytest.mark.parametrize("name", robots.INLINE)
def test_regressor_with_prismatic_branched_and_mimic_joints_is_pinocchios(name: str, tmp_path: Path) -> None:
    model = robots.load(robots.INLINE[name], tmp_path)
    path = tmp_path / "plain.urdf"  # for Pinocchio the mimic joint is a joint of its own, and joints need limits
    limited = '<limit lower="-9" upper="9" effort="9" velocity="9"/><axis'
    path.write_text(robots.INLINE[name].replace(MIMIC, "").replace("<axis", limited))
    state = unit_states(model, 20)
    expected = reference(path, model, *state)
    np.testing.assert_allclose(joint_torque_regressor(model, *state), expected, rtol=0, atol=1e-12)


def test_regressor_is_the_derivative_of_the_torque_in_the_inertial_parameters(tree: RobotModel) -> None:
    q, v, a = unit_states(tree, 5)

    def torque(inertia: jax.Array) -> jax.Array:
        return inverse_dynamics(eqx.tree_at(lambda m: m.inertia, tree, inertia), q, v, a)

    derivative = jax.jacfwd(torque)(jnp.asarray(tree.inertia)).reshape(5, tree.nv, -1)
    np.testing.assert_allclose(joint_torque_regressor(tree, q, v, a), derivative, rtol=0, atol=1e-12)


def test_packed_blocks_are_all_that_differs_from_zero(tmp_path: Path) -> None:
    tree = robots.load(robots.TREE.replace(MIMIC, ""), tmp_path)
    state = unit_states(tree, 7)
    index, packed = pairs(tree), np.asarray(packed_regressor(tree, *state))
    assert packed.shape == (len(index), 10, 7) and len(index) < len(tree.joints) ** 2
    row = [tree.joints[j].coordinate for j in index[:, 0]]
    dense = np.zeros((tree.nv, len(tree.joints), 10, 7))
    dense[row, index[:, 1]] = packed
    W = np.moveaxis(np.asarray(joint_torque_regressor(tree, *state)), 0, -1).reshape(dense.shape)
    np.testing.assert_array_equal(W, dense)
    assert (np.abs(packed).max(axis=(1, 2)) > 0.0).all()


@pytest.mark.parametrize("samples", [0, 1, 2, CHUNK - 1, CHUNK, CHUNK + 1, BLOCK, BLOCK + 1, 3000])
def test_chunks_and_blocks_leave_no_trace(samples: int, arm: RobotModel) -> None:
    """Each sample alone gives what it gives among many, in the arrays' own order."""
    state = unit_states(arm, samples)
    W, packed = joint_torque_regressor(arm, *state), packed_regressor(arm, *state)
    assert W.shape == (samples, 2, 20) and packed.shape == (3, 10, samples)
    for k in {0, samples // 2, CHUNK - 1, CHUNK, samples - 2, samples - 1} & set(range(samples)):
        alone = joint_torque_regressor(arm, *(x[k] for x in state))
        assert alone.shape == (2, 20)
        np.testing.assert_allclose(W[k], alone, rtol=0, atol=1e-14)
        alone = packed_regressor(arm, *(x[k : k + 1] for x in state))
        np.testing.assert_allclose(packed[..., k], alone[..., 0], rtol=0, atol=1e-14)


def test_any_batch_axes(arm: RobotModel) -> None:
    q, v, a = (x.reshape(2, 3, 2) for x in unit_states(arm, 6))
    W = joint_torque_regressor(arm, q, v, a)
    assert W.shape == (2, 3, 2, 20)
    np.testing.assert_array_equal(W[1, 2], joint_torque_regressor(arm, q[1, 2], v[1, 2], a[1, 2]))


@pytest.mark.parametrize("robot", ROBOTS, indirect=True)
def test_transformations_agree_with_plain_calls(robot: RobotModel) -> None:
    state = unit_states(robot, CHUNK + 5)
    W = joint_torque_regressor(robot, *state)
    np.testing.assert_allclose(jax.jit(joint_torque_regressor)(robot, *state), W, rtol=0, atol=1e-13)
    mapped = jax.vmap(joint_torque_regressor, (None, 0, 0, 0))(robot, *state)
    np.testing.assert_allclose(mapped, W, rtol=0, atol=1e-13)
    packed = jax.jit(packed_regressor)(robot, *state)
    np.testing.assert_allclose(packed, packed_regressor(robot, *state), rtol=0, atol=1e-13)


@pytest.mark.parametrize("robot", ROBOTS, indirect=True)
def test_derivatives_in_leaves_and_states_are_central_differences(robot: RobotModel) -> None:
    """Forward mode against differences and reverse mode against forward, over more than one chunk.

    Placements change by turns and shifts, axes by turns: only of rotations the forms of devices are one function.
    """
    rng = np.random.default_rng(1)
    point = dict(zip("qva", unit_states(robot, CHUNK + 3), strict=True))
    point |= {leaf: np.asarray(getattr(robot, leaf)) for leaf in LEAVES}
    weight = rng.standard_normal((CHUNK + 3, robot.nv, 10 * len(robot.joints)))

    @jax.jit
    def value(point: dict[str, jax.Array]) -> jax.Array:
        changed = eqx.tree_at(lambda m: [getattr(m, k) for k in LEAVES], robot, [point[k] for k in LEAVES])
        return jnp.mean(weight * joint_torque_regressor(changed, *(point[k] for k in "qva")))

    forward, backward = jax.jit(lambda x, d: jax.jvp(value, (x,), (d,))[1]), jax.grad(value)(point)
    for name, x in point.items():
        step = {k: np.zeros_like(y) for k, y in point.items()} | {name: rng.standard_normal(x.shape)}
        if name == "placement":
            step[name][:, :3, :3] = x[:, :3, :3] @ (step[name][:, :3, :3] - np.swapaxes(step[name][:, :3, :3], 1, 2))
            step[name][:, 3] = 0.0
        if name == "axis":
            step[name] -= x * np.sum(x * step[name], axis=1, keepdims=True)
        ahead, behind = ({k: point[k] + h * step[k] for k in point} for h in (1e-5, -1e-5))
        derivative = forward(point, step)
        assert derivative != 0.0, name
        difference = (value(ahead) - value(behind)) / 2e-5
        np.testing.assert_allclose(derivative, difference, rtol=0, atol=1e-7, err_msg=name)
        reverse = np.sum(backward[name] * step[name])
        np.testing.assert_allclose(reverse, derivative, rtol=0, atol=1e-12, err_msg=name)


def test_float64_whatever_the_global_setting(arm: RobotModel) -> None:
    state = unit_states(arm, 4)
    W = joint_torque_regressor(arm, *state)
    with jax.enable_x64(False):
        narrow = joint_torque_regressor(arm, *state)
    assert narrow.dtype == jnp.float64
    np.testing.assert_array_equal(narrow, W)


def compilations(caplog: pytest.LogCaptureFixture) -> int:
    return sum("Finished XLA compilation" in record.getMessage() for record in caplog.records)


@pytest.mark.skipif(jax.default_backend() == "gpu", reason="its kernels leave out zeros: others, another one")
def test_changed_masses_lengths_and_sample_counts_compile_no_kernel(
    arm: RobotModel, caplog: pytest.LogCaptureFixture
) -> None:
    heavier = eqx.tree_at(lambda m: m.inertia, arm, 2.0 * arm.inertia)
    longer = eqx.tree_at(lambda m: m.placement, arm, arm.placement + np.pad([[0.1], [0.2], [0.3]], ((0, 1), (3, 0))))
    joint_torque_regressor(arm, *unit_states(arm, 700))
    with jax.log_compiles(), caplog.at_level("WARNING"):
        joint_torque_regressor(heavier, *unit_states(arm, 700))
        joint_torque_regressor(longer, *unit_states(arm, 700))
        assert compilations(caplog) == 0
        joint_torque_regressor(arm, *unit_states(arm, 651))
        assert compilations(caplog) == 0


def test_wrong_shapes_are_named(arm: RobotModel) -> None:
    q = np.zeros((4, 2))
    with pytest.raises(InputError, match="turn, slide"):
        joint_torque_regressor(arm, q[:, :1], q[:, :1], q[:, :1])


def sample_manipulator() -> tuple[RobotModel, pin.Model]:
    """Pinocchio's example robot as a model of ours: six revolute joints about axes of their frames."""
    robot = pin.buildSampleModelManipulator()
    axes = {"X": [1.0, 0.0, 0.0], "Y": [0.0, 1.0, 0.0], "Z": [0.0, 0.0, 1.0]}
    moving = range(1, robot.njoints)
    joints = tuple(Joint(robot.names[i], "revolute", robot.parents[i] - 1, i - 1, f"link_{i}") for i in moving)
    return RobotModel(
        placement=np.array([robot.jointPlacements[i].homogeneous for i in moving]),
        axis=np.array([axes[robot.joints[i].shortname()[-1]] for i in moving]),
        inertia=np.array([robot.inertias[i].toDynamicParameters() for i in moving]),
        ratio=np.ones(6),
        offset=np.zeros(6),
        gravity=robot.gravity.linear.copy(),
        frame_placement=np.zeros((0, 4, 4)),
        position_limit=np.zeros((6, 2)),
        velocity_limit=np.zeros(6),
        effort_limit=np.zeros(6),
        joints=joints,
        frames=(),
        name="manipulator",
    ), robot


def test_golden_numbers_of_the_sample_manipulator() -> None:
    """Rank and effort error of a least-squares fit to filtered states, found by two independent implementations."""
    from scipy.signal import butter, filtfilt

    model, robot = sample_manipulator()
    rng = np.random.default_rng(0)
    f, A, t = rng.uniform(0.2, 0.8, (3, 6)), rng.uniform(0.3, 1.0, (3, 6)), np.arange(400)[:, None, None] / 100.0
    rate = 2.0 * np.pi * f
    state = [(A * rate**k * wave(rate * t)).sum(1) for k, wave in ((0, np.sin), (1, np.cos))]
    state.append(-(A * rate**2 * np.sin(rate * t)).sum(1))
    data: Any = robot.createData()
    tau = np.array([pin.rnea(robot, data, *x) for x in zip(*state, strict=True)])
    deviations = [189.555343, 164.726164, 119.022653, 89.967928, 52.225450, 51.008909]
    np.testing.assert_allclose(tau.std(axis=0), deviations, rtol=0, atol=1e-6)
    b, a = np.array(butter(4, 10.0 / 50.0))
    smooth = [filtfilt(b, a, x, axis=0, padtype="odd", padlen=12) for x in state]
    W = np.asarray(joint_torque_regressor(model, smooth[0], smooth[1], smooth[2])).reshape(-1, 60)
    assert np.sum(np.linalg.norm(W, axis=0) > 1e-6) == 51
    assert np.linalg.matrix_rank(W, tol=1e-9 * np.linalg.norm(W, 2)) == 38
    error = tau.ravel() - W @ np.linalg.lstsq(W, tau.ravel(), rcond=1e-10)[0]
    np.testing.assert_allclose(np.sqrt(np.mean(error**2)), 0.09574368495, rtol=1e-9, atol=0)


@pytest.mark.parametrize(("offset", "filled"), [(True, 51), (False, 49)])
def test_structural_rank_of_a_ur10_like_arm(offset: bool, filled: int, data_dir: Path) -> None:
    """36 base parameters; 49 of 60 columns are not zero where, as in the UR10, the second axis meets the first."""
    model = load_urdf(data_dir / robots.REAL["ur10e"])
    if not offset:
        placement = np.array(model.placement)
        placement[1, :2, 3] = 0.0
        model = eqx.tree_at(lambda m: m.placement, model, placement)
    W = np.asarray(joint_torque_regressor(model, *unit_states(model, 200))).reshape(-1, 60)
    assert np.sum(np.linalg.norm(W, axis=0) > 1e-9) == filled
    assert np.linalg.matrix_rank(W, tol=1e-10 * np.linalg.norm(W, 2)) == 36
