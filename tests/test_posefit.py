"""Rows and Jacobians of every device against finite differences; closed-form starts; the solve on synthetic truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import poses
import pytest
from jaxtyping import Array, Float

from figaroh_jax.estimation import posefit
from figaroh_jax.estimation.posehost import HostRows, written_out
from figaroh_jax.estimation.posesolver import solve
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.recordings import starts
from figaroh_jax.recordings.devices import ORIENTATION, Device, Distance, Planes, Points, Poses, Sockets, own_device
from figaroh_jax.rigid import lie
from figaroh_jax.rigid.chain import chain_between
from figaroh_jax.rigid.model import Leaf, RobotModel

N = 4
BOTH = ("base_frame", "tool_frame")


class Camera(Poses):
    """Corners of a board in the image of a camera: `datum` is (corners, 2), in pixels; the tool carries the camera
    (the device's frame is the board's) or, with `mount` "world", the board (the device's frame is the camera's).

    Rows are pixels over the focal length, an angle in rad.
    """

    board: Float[Leaf, "corners 3"] = eqx.field(kw_only=True)  # m, in the board's frame
    intrinsics: Float[Leaf, "3 3"] = eqx.field(kw_only=True)
    mount: str = eqx.field(static=True, default="hand")

    def residual(self, pose: Array, unknown: Array, datum: Leaf) -> Float[Array, " rows"]:
        """Predicted minus measured corners over the focal length (2 corners,): angles in rad; `datum` in pixels."""
        seen = self.device_T_base(unknown) @ pose @ self.tool_T_marker(unknown)
        camera_T_board = lie.inverse_pose(seen) if self.mount == "hand" else seen
        points = self.board @ camera_T_board[:3, :3].T + camera_T_board[:3, 3]
        focal = jnp.array([self.intrinsics[0, 0], self.intrinsics[1, 1]])
        measured = (datum - self.intrinsics[:2, 2]) / focal
        return (points[:, :2] / points[:, 2:] - measured).reshape(-1)

    def channels(self) -> tuple[int, ...]:
        """Angles alone."""
        return (ORIENTATION,) * (2 * len(self.board))


@pytest.fixture(scope="module")
def urdf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("arm") / "robot.urdf"
    path.write_text(poses.urdf())
    return path


@pytest.fixture(scope="module")
def model(urdf: Path) -> RobotModel:
    return load_urdf(urdf)


def turn(rng: np.random.Generator) -> np.ndarray:
    return pin.SE3(pin.exp3(rng.normal(size=3)), rng.normal(size=3)).homogeneous


def devices(rng: np.random.Generator) -> dict[str, tuple[Device, np.ndarray]]:
    """Every device with something for it to have measured."""
    base, centre = turn(rng), rng.normal(size=3)
    near = np.array([turn(rng) for _ in range(N)])
    board = np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]])
    camera = np.array([[600.0, 0, 320], [0, 610, 240], [0, 0, 1]])
    axes = np.array([turn(rng)[:3, :3], turn(rng)[:3, :3]])
    number = np.array([0, 1, 1, 0])
    pair = (((0, 1),), np.array([0.05]), np.array([2.0]))
    return {
        "points": (Points(base, centre, BOTH, rng.normal(size=(2, 3))), rng.normal(size=(N, 2, 3))),
        "poses": (Poses(base, centre, BOTH, turn(rng)), near),
        "poses on the body": (Poses(base, centre, BOTH, turn(rng), "body"), near),
        "poses of a camera": (Poses(base, centre, BOTH, turn(rng), "sight"), near),
        "twists": (Poses(base, centre, BOTH, turn(rng), "twist"), near),
        "camera": (
            Camera(base, centre, BOTH, turn(rng), board=board, intrinsics=camera),
            100.0 * rng.normal(size=(N, 4, 2)),
        ),
        "camera of the world": (
            Camera(base, centre, BOTH, turn(rng), board=board, intrinsics=camera, mount="world"),
            100.0 * rng.normal(size=(N, 4, 2)),
        ),
        "own": (
            own_device(
                lambda pose, u, d: jnp.cos(u[0]) * pose[0, 3:] - u[1] * d, {"a": (0.5, "rad", 0.1), "b": (1, "1", 1)}
            ),
            rng.normal(size=N),
        ),
        "sockets": (Sockets(rng.normal(size=3), ("tool_frame",), rng.normal(size=(2, 3)), *pair), number),
        "planes": (Planes(rng.normal(size=3), ("tool_frame",), axes, rng.normal(size=(2, 3))), number),
        "distance": (Distance(rng.normal(size=3), ("tool_frame",), rng.normal(size=3)), rng.uniform(1.0, 2.0, N)),
    }


def problem(model: RobotModel, device: Device, datum: np.ndarray, q: np.ndarray, rng: np.random.Generator):
    """A problem of one device: a column of any kind at each joint, and one that acts at two."""
    chain = chain_between(model, "base", "tool0")
    fields = rng.normal(size=(8, 6, len(q)))
    fields[[0, 3]] = fields[[0, 3], :, :1]  # the same in all postures
    pieces = zip((0, 1, 2, 3, 4, 5, 6, 6), (0, 1, 2, 3, 4, 5, 1, 4), fields, strict=True)
    measured = np.ones((len(q), len(device.channels())), bool)
    group = posefit.group_of(chain, device, q.T, 7, pieces, datum, measured)
    return posefit.Problem((group,), posefit.sizes([group], [1e-2] * 7), 7)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name in ("poses on the body", "camera of the world")))
        for name in devices(np.random.default_rng(0))
    ],
)
def test_jacobian_of_every_device_is_the_derivative_of_its_rows(name: str, model: RobotModel):
    rng = np.random.default_rng(5)
    device, datum = devices(rng)[name]
    whole = problem(model, device, datum, poses.postures(rng, N), rng)
    y = 0.3 * rng.normal(size=len(whole.scale))
    residual, jacobian = posefit.linearise(whole, y)
    np.testing.assert_allclose(residual, posefit.predict(whole, y), rtol=0, atol=1e-14)
    assert len(posefit.rows_of(whole).group) == len(residual)
    assert_derivative(whole, y, jacobian)
    if written_out(device):
        compiled = posefit.linearise(whole, y, posefit.parts_of(whole))
        np.testing.assert_allclose(residual, compiled[0], rtol=0, atol=1e-13)
        np.testing.assert_allclose(jacobian, compiled[1], rtol=0, atol=1e-12)
    if isinstance(device, Poses) and not isinstance(device, Camera):
        for angle in (0.0, np.pi - 1e-3):
            turned = at_angle(angle, datum, residual[N * 3 :].reshape(3, N).T)
            whole = eqx.tree_at(lambda p: p.groups[0].datum, whole, turned)
            residual, jacobian = posefit.linearise(whole, y)
            size = np.linalg.norm(residual[N * 3 :].reshape(3, N), axis=0)
            np.testing.assert_allclose(size, angle, rtol=0, atol=1e-12)
            assert_derivative(whole, y, jacobian)
            datum = turned


@pytest.mark.parametrize("estimated", [BOTH, BOTH[:1], BOTH[1:], ()])
@pytest.mark.parametrize("name", ["points", "poses", "poses on the body"])
def test_rows_in_c_are_those_in_numpy(name: str, estimated: tuple[str, ...], tmp_path: Path):
    path = tmp_path / "slide.urdf"
    path.write_text(poses.urdf().replace('name="j3" type="revolute"', 'name="j3" type="prismatic"'))
    sliding, rng = load_urdf(path), np.random.default_rng(7)
    device, datum = devices(rng)[name]
    device = replace(device, estimated=estimated)  # pyright: ignore[reportArgumentType]
    whole = problem(sliding, device, datum, poses.postures(rng, N), rng)
    (part,) = posefit.host_parts(whole)
    assert isinstance(part, HostRows)
    assert part.slide is not None
    if part.code is None:
        pytest.skip("no C compiler")
    for size in (1.0, 1e-3):  # turns for the formulas and for their series
        for postures in (1, N):
            twists, own = size * rng.normal(size=(6, 6, postures)), size * rng.normal(size=part.unknowns)
            for found, expected in zip(part._coded(twists, own), part._plain(twists, own), strict=True):
                np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_many_postures_are_solved_by_rows_in_c_as_by_the_compiled_ones(model: RobotModel, monkeypatch):
    rng, many = np.random.default_rng(11), 300
    device, _ = devices(rng)["poses"]
    near = np.array([turn(rng) for _ in range(many)])
    whole = problem(model, device, near, poses.postures(rng, many), rng)
    y = 0.1 * rng.normal(size=len(whole.scale))
    residual, jacobian = posefit.linearise(whole, y)
    compiled = posefit.linearise(whole, y, posefit.parts_of(whole))
    np.testing.assert_allclose(residual, compiled[0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(jacobian, compiled[1], rtol=0, atol=1e-12)
    weights, free = np.ones(len(residual)), np.ones(len(y))
    found = solve(whole, weights, 1e-2 * free, free, 0.0 * y, max_steps=3)
    monkeypatch.setattr(posefit, "MANY", 0)
    monkeypatch.setattr(posefit, "_last", [])
    expected = solve(whole, weights, 1e-2 * free, free, 0.0 * y, max_steps=3)
    np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-9)


def at_angle(angle: float, datum: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Measured poses that are turned by `angle` from the predicted ones, `away` from the ones measured before."""
    turned = datum.copy()
    for k, w in enumerate(away):
        turned[k, :3, :3] = datum[k, :3, :3] @ pin.exp3(w) @ pin.exp3(-angle * np.array([0.6, -0.48, 0.64]))
    return turned


def assert_derivative(whole: posefit.Problem, y: np.ndarray, jacobian: np.ndarray) -> None:
    def central(direction: np.ndarray) -> np.ndarray:
        ahead, behind = (posefit.predict(whole, y + sign * direction) for sign in (1, -1))
        return ahead - behind

    step = 1e-4
    for k, e in enumerate(np.eye(len(y))):  # extrapolated once (Richardson)
        differences = (8.0 * central(step / 2 * e) - central(step * e)) / (6.0 * step)
        scale = max(1.0, float(np.abs(jacobian[:, k]).max()))
        np.testing.assert_allclose(jacobian[:, k], differences, rtol=0, atol=3e-8 * scale)


def test_devices_of_two_kinds_share_the_columns_and_nothing_else(model: RobotModel):
    rng = np.random.default_rng(8)
    q, both = poses.postures(rng, N), devices(rng)
    alone = [problem(model, *both[name], q, np.random.default_rng(9)) for name in ("points", "sockets")]
    groups = tuple(part.groups[0] for part in alone)
    mixed = posefit.Problem(groups, posefit.sizes(groups, [1e-2] * 7), 7)
    y, first = 0.3 * rng.normal(size=len(mixed.scale)), len(alone[0].scale)
    residual, jacobian = posefit.linearise(mixed, y)
    parts = [posefit.linearise(alone[0], y[:first]), posefit.linearise(alone[1], np.r_[y[:7], y[first:]])]
    np.testing.assert_array_equal(residual, np.concatenate([part[0] for part in parts]))
    upper = np.hstack([parts[0][1], np.zeros((len(parts[0][0]), len(y) - first))])
    lower = np.hstack([parts[1][1][:, :7], np.zeros((len(parts[1][0]), first - 7)), parts[1][1][:, 7:]])
    np.testing.assert_allclose(jacobian, np.vstack([upper, lower]), rtol=0, atol=1e-15)
    assert list(np.unique(posefit.rows_of(mixed).group)) == [0, 1]


def test_closed_form_frames_are_exact_without_noise():
    rng = np.random.default_rng(6)
    R, p = np.array([turn(rng)[:3, :3] for _ in range(20)]), rng.normal(size=(20, 3))
    base, tool, markers = turn(rng), turn(rng), rng.normal(size=(2, 3))
    seen = (p[:, None] + np.einsum("nij,kj->nki", R, markers)) @ base[:3, :3].T + base[:3, 3]
    seen[3, 1] = np.nan
    found = starts.place_points(R, p, seen, BOTH)
    np.testing.assert_allclose(found[0], base, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[1], markers, rtol=0, atol=1e-9)
    local = np.tile(np.eye(4), (20, 1, 1))
    local[:, :3, :3], local[:, :3, 3] = R, p
    for unknown in (BOTH, ("base_frame",), ("tool_frame",)):
        b, t = base if "base_frame" in unknown else np.eye(4), tool if "tool_frame" in unknown else np.eye(4)
        found = starts.place_poses(R, p, b @ local @ t, unknown)
        np.testing.assert_allclose(found[0], b, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found[1], t, rtol=0, atol=1e-9)
    point, number = rng.normal(size=3), np.arange(20) % 2
    sockets = rng.normal(size=(2, 3))
    found = starts.place_sockets(R, sockets[number] - R @ point, number, ("tool_frame",))
    np.testing.assert_allclose(found[0], point, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found[1], sockets, rtol=0, atol=1e-9)


def test_solve_finds_offsets_from_far_away_and_says_that_it_converged(model: RobotModel, urdf: Path):
    rng = np.random.default_rng(7)
    real = poses.truth(rng, offset=np.array([0.0, 0.05, -0.08, 0.1, -0.04, 0.0]))
    q = poses.postures(rng, 40)
    chain = chain_between(model, "base", "tool0")
    pieces = [(k, k + 1, np.repeat(np.eye(6)[5:].T, len(q), axis=1)) for k in range(4)]
    reference = poses.points(poses.tool_poses(urdf, q, real), real, rng, noise=0.0)
    device = Points(real.base.homogeneous, reference.mean(axis=(0, 1)), BOTH, np.zeros((3, 3)))
    measured = np.ones((len(q), 9), bool)
    group = posefit.group_of(chain, device, q.T, 4, pieces, reference, measured)
    whole = posefit.Problem((group,), posefit.sizes([group], [1e-3] * 4), 4)
    count = len(whole.scale)
    weights, start = np.full(len(q) * 9, 1e4), np.zeros(count)
    start[4:10] = 30.0
    found = solve(whole, weights, np.zeros(count), np.ones(count), start)
    assert found.converged
    np.testing.assert_allclose(found.unknowns[:4] * 1e-3, real.offset[1:5], rtol=0, atol=1e-9)
    held = solve(whole, weights, np.ones(count), np.where(np.arange(count) < 4, 0.0, 1.0), start)
    np.testing.assert_array_equal(held.unknowns[:4], 0.0)
    stopped = solve(whole, weights, np.zeros(count), np.ones(count), start, max_steps=2)
    assert not stopped.converged


def test_poses_that_turn_about_one_axis_place_device_and_marker():
    """A planar robot: orientations leave a turn about the axis open, which its positions tell (1.6 m off before)."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(-2, 2, 40)
    body = np.tile(np.eye(4), (40, 1, 1))
    body[:, 0, 0], body[:, 0, 1], body[:, 1, 0], body[:, 1, 1] = (
        *(np.cos(angle), -np.sin(angle)),
        *(np.sin(angle), np.cos(angle)),
    )
    body[:, :2, 3] = rng.normal(size=(40, 2))
    device, marker = (np.eye(4) for _ in range(2))
    for pose in (device, marker):
        pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        pose[:3, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
        pose[:3, 3] = rng.normal(size=3)
    seen = device @ body @ marker
    base, tool = starts.place_poses(body[:, :3, :3], body[:, :3, 3], seen, ("base_frame", "tool_frame"))
    np.testing.assert_allclose(base @ body @ tool, seen, rtol=0, atol=1e-12)
