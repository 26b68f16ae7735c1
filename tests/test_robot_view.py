"""The view of a diagnosis: what is drawn where, against Pinocchio, and what the browser's server is told."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import equinox as eqx
import numpy as np
import pinocchio as pin
import pytest

from figaroh_jax import DEMO
from figaroh_jax.cli import main
from figaroh_jax.effects.extended import extend
from figaroh_jax.errors import InputError
from figaroh_jax.formats.export import model_files, write_model
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.reporting.provenance import provenance
from figaroh_jax.reporting.robot_view import RobotView, serve, show_run, view_of
from figaroh_jax.rigid.model import RobotModel

TASK = Path(DEMO).with_name("task.yaml")


@pytest.fixture(scope="module")
def robots() -> tuple[RobotModel, RobotModel]:
    """The demo's arm, and the same with a moved elbow and a heavier last link."""
    nominal = load_urdf(DEMO)
    placement, inertia = np.array(nominal.placement), np.array(nominal.inertia)
    placement[2, :3, 3] += [0.0, 0.0, 0.002]
    inertia[3] *= 1.5
    return nominal, eqx.tree_at(lambda m: (m.placement, m.inertia), nominal, (placement, inertia))


def test_lines_and_masses_stand_where_pinocchio_has_them(robots: tuple[RobotModel, RobotModel]):
    nominal, corrected = robots
    view = RobotView(corrected, {"elbow": "backlash"}, nominal)
    q = np.array([0.3, -0.4, 0.5, 0.6])
    robot = pin.buildModelFromUrdf(DEMO)
    data = robot.createData()
    pin.forwardKinematics(robot, data, q)
    lines = view.lines(q, magnify=10.0)
    tips = np.array([data.oMi[k].translation for k in range(1, 5)])
    np.testing.assert_allclose(lines["nominal"][:, 1], tips, rtol=0, atol=1e-12)
    near = {name: place for name, place, _ in view.joints(q, magnify=1.0)}
    far = {name: place for name, place, _ in view.joints(q, magnify=10.0)}
    np.testing.assert_allclose(far["elbow"] - tips[2], 10 * (near["elbow"] - tips[2]), rtol=0, atol=1e-12)
    assert np.linalg.norm(far["elbow"] - tips[2]) == pytest.approx(0.02, rel=1e-9)
    assert {name: text for name, _, text in view.joints(q) if text} == {"elbow": "backlash"}
    pin.centerOfMass(robot, data, q)
    link = nominal.joints[3].link
    where = data.oMi[4].act(robot.inertias[4].lever)
    drawn = {(name, which): (place, radius) for name, place, radius, which in view.bodies(q)}
    assert set(drawn) == {(link, "nominal"), (link, "corrected")}
    np.testing.assert_allclose(drawn[link, "nominal"][0], where, rtol=0, atol=1e-12)
    assert drawn[link, "corrected"][1] / drawn[link, "nominal"][1] == pytest.approx(1.5 ** (1 / 3), rel=1e-9)


class Server:
    """A stand-in for viser's server that keeps what it is told."""

    def __init__(self, **options: Any) -> None:
        self.options, self.drawn, self.controls = options, {}, {}
        self.scene = self.gui = self

    def _keep(self, name: str, *values: Any, **more: Any) -> None:
        self.drawn[name] = (values, more)

    add_line_segments = add_icosphere = add_label = add_grid = _keep

    def on_client_connect(self, look: Any) -> None:
        self.look = look

    def add_slider(self, name: str, *, initial_value: float, min: float, max: float, **_: Any) -> Any:
        control = SimpleNamespace(value=initial_value, min=min, max=max, on_update=lambda call: calls.append(call))
        calls = control.calls = []
        self.controls[name] = control
        return control

    def add_dropdown(self, name: str, options: Any) -> Any:
        return self.add_slider(name, initial_value=options[0], min=0, max=0)


def test_a_calibration_of_an_mjcf_is_drawn_as_mujoco_has_the_robot(tmp_path: Path):
    """Its run holds no URDF. A hidden offset of a joint moves the drawn tips to where MuJoCo has them."""
    mujoco = pytest.importorskip("mujoco")
    (tmp_path / "arm.xml").write_text(model_files(extend(load_urdf(DEMO)))["robot.xml"])
    mj = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    data, hidden = mujoco.MjData(mj), np.array([0.0, 0.02, 0.0, 0.0])
    q = np.random.default_rng(0).uniform(-1.2, 1.2, (30, 4))

    def tips(at: np.ndarray) -> np.ndarray:
        data.qpos[:] = at
        mujoco.mj_kinematics(mj, data)
        return np.array(data.xanchor)

    def marker(at: np.ndarray) -> np.ndarray:
        tips(at)
        return data.site("hand").xpos + data.site("hand").xmat.reshape(3, 3) @ [0.05, 0.02, 0.03]

    np.savez(tmp_path / "run.npz", q=q, seen=[marker(one + hidden) for one in q])
    device = "{position: seen, base_frame: base, tool_frame: hand, unknown: [tool_frame]}"
    entry = f"data: [{{file: run.npz, position: q, measurement: {device}}}]"
    (tmp_path / "task.yaml").write_text(f"robot: {{model: arm.xml}}\n{entry}")
    run = str(tmp_path / "run")
    assert main(["calibrate", str(tmp_path / "task.yaml"), "--level", "joint_offset", "--out", run, "--quiet"]) == 0
    lines = view_of(Path(run))[0].lines(q[0])
    np.testing.assert_allclose(np.concatenate([lines["links"], lines["named"]])[:, 1], tips(q[0] + hidden), atol=1e-5)
    np.testing.assert_allclose(lines["nominal"][:, 1], tips(q[0]), rtol=0, atol=1e-9)


def written(folder: Path, corrected: RobotModel) -> Path:
    cause = {"effect": "stribeck_friction", "at": ["shoulder"], "parameters": {}}
    write_model(extend(corrected), folder / "model")
    (folder / "answer.json").write_text(json.dumps({"verdict": "named", "causes": [cause]}))
    (folder / "provenance.json").write_text(provenance("diagnose", TASK, [TASK], "native"))
    return folder


def test_a_run_is_served_with_its_recordings_and_its_nominal_robot(
    robots: tuple[RobotModel, RobotModel], tmp_path: Path, monkeypatch
):
    monkeypatch.setitem(sys.modules, "viser", SimpleNamespace(ViserServer=Server))
    server: Any = show_run(written(tmp_path, robots[1]), 18081)
    assert server.options["port"] == 18081
    client = SimpleNamespace(camera=SimpleNamespace())
    server.look(client)
    assert np.linalg.norm(np.subtract(client.camera.position, client.camera.look_at)) < 5.0
    assert {"/links", "/nominal", "/joints/shoulder", "/names/shoulder"} <= set(server.drawn)
    assert server.drawn["/names/shoulder"][0] == ("shoulder: Stribeck friction",)
    moved = server.drawn["/links"][0][0]
    server.controls["time, %"].value = 40.0
    server.controls["time, %"].calls[0]()
    assert server.controls["waist"].value != 0.0
    server.controls["waist"].calls[0]()
    assert not np.array_equal(server.drawn["/links"][0][0], moved)


def test_what_is_no_run_and_a_missing_package_are_one_message(robots, tmp_path: Path, monkeypatch, capsys):
    assert main(["view", str(tmp_path)]) == 2
    assert "holds no run with a model" in capsys.readouterr().err
    run = written(tmp_path, robots[1])
    assert main(["view", str(run), "--port", "0"]) == 2
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(InputError, match=r"figaroh-jax\[view\]"):
        show_run(run)
    (run / "answer.json").write_text("[]")
    with pytest.raises(InputError, match="cannot be read"):
        view_of(run)


@pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="needs viser")
def test_viser_takes_what_is_drawn(robots: tuple[RobotModel, RobotModel]):
    serve(RobotView(robots[1], {"elbow": "backlash"}, robots[0]), {}, 18082, 20.0).stop()
