"""The robot of a diagnosis in a browser, with `viser` (extra `view`): what is named in colour, the nominal beside it.

Links are lines from joint to joint, so that no mesh is needed. Where the corrected robot has other placements, it is
drawn at a multiple of its distance from the nominal one; where a link's mass has changed, spheres of equal density
stand at both centres of mass. A recording's motion can be played.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ..errors import InputError, check_kind, check_path
from ..formats.config import load_task
from ..formats.export import load_model
from ..formats.robotfile import load_robot, read_robot
from ..recordings.dataset import read_recordings
from ..results import Diagnosis
from ..rigid.inertia import to_com
from ..rigid.kinematics import forward_kinematics
from ..rigid.model import RobotModel
from .picture import middle_posture, segments
from .provenance import read_provenance
from .wording import effect_title

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]

__all__ = ["RobotView", "serve", "show_diagnosis", "show_run", "view_of"]

_PLAIN, _HIT, _NOMINAL, _BODY = (40, 40, 40), (213, 94, 0), (150, 150, 150), (0, 114, 178)
_DENSITY = 2700.0  # kg/m³, of the spheres that stand for masses
_MASS, _CENTRE = 0.05, 0.02  # relative change of a mass, and share of the robot's size a centre moves, that is drawn
_SIZE = 0.025  # of a joint's sphere, of the robot's size

Motions = Mapping[str, tuple[Float[np.ndarray, " samples"], Float[np.ndarray, "samples nq"]]]


class RobotView:
    """A corrected robot, the nominal one if it is known, and what is named at which joint or link."""

    def __init__(self, model: RobotModel, named: Mapping[str, str], nominal: RobotModel | None = None) -> None:
        self.model, self.nominal, self.named = model, nominal, named
        lines = segments(model, np.zeros(model.nq)) if model.nq == model.nv else np.zeros((1, 2, 3))
        self.size = float(np.ptp(lines.reshape(-1, 3), axis=0).max()) or 1.0
        moved = nominal is not None and not np.allclose(
            np.asarray(nominal.placement), np.asarray(model.placement), rtol=0, atol=1e-9
        )
        self.moved = bool(moved)

    def lines(self, q: Float[np.ndarray, " nq"], magnify: float = 1.0) -> dict[str, Float[np.ndarray, "n 2 3"]]:
        """Segments by what they show: links of the corrected robot, those named, the nominal robot where it differs."""
        drawn = segments(self.model, q)
        before = segments(self.nominal, q) if self.moved and self.nominal is not None else drawn
        shown = before + magnify * (drawn - before)
        hit = np.array([joint.link in self.named for joint in self.model.joints])
        found = {"links": shown[~hit], "named": shown[hit]}
        return found | ({"nominal": before} if self.moved else {})

    def joints(
        self, q: Float[np.ndarray, " nq"], magnify: float = 1.0
    ) -> list[tuple[str, Float[np.ndarray, "3"], str]]:
        """Name, place and what is said there (or nothing) of every joint."""
        drawn = segments(self.model, q)[:, 1]
        if self.moved and self.nominal is not None:
            before = segments(self.nominal, q)[:, 1]
            drawn = before + magnify * (drawn - before)
        said = [self.named.get(joint.name) or self.named.get(joint.link, "") for joint in self.model.joints]
        return [(j.name, place, text) for j, place, text in zip(self.model.joints, drawn, said, strict=True)]

    def bodies(self, q: Float[np.ndarray, " nq"]) -> list[tuple[str, Float[np.ndarray, "3"], float, str]]:
        """Links whose mass or centre has changed: name, centre of mass (world, m), radius, which robot."""
        if self.nominal is None:
            return []
        out = []
        for k, joint in enumerate(self.model.joints):
            pair = [to_com(np.asarray(robot.inertia[k], float))[:2] for robot in (self.nominal, self.model)]
            (m0, c0), (m1, c1) = pair
            moved = np.linalg.norm(np.asarray(c1) - np.asarray(c0)) > _CENTRE * self.size
            if abs(m1 - m0) <= _MASS * abs(m0) and not moved:
                continue
            for which, robot, (mass, centre) in (
                ("nominal", self.nominal, pair[0]),
                ("corrected", self.model, pair[1]),
            ):
                pose = np.asarray(forward_kinematics(robot, q))[k]
                radius = float((3 * max(float(mass), 0.0) / (4 * np.pi * _DENSITY)) ** (1 / 3))
                out.append((joint.link, pose[:3, :3] @ np.asarray(centre) + pose[:3, 3], radius, which))
        return out


def show_diagnosis(diagnosis: Diagnosis, port: int = 8080, *, magnify: float = 20.0) -> viser.ViserServer:
    """Serve the robot of a diagnosis at `http://localhost:port` and return the server; sliders move its joints.

    Raises `InputError` where viser is not installed.
    """
    check_kind("diagnosis", diagnosis, Diagnosis, "`diagnose` gives one")
    nominal = None if diagnosis.baseline is None else diagnosis.baseline.robot
    view = RobotView(diagnosis.model.robot, _said(_causes(diagnosis)), nominal)
    motions = {trace.name: (trace.time, trace.position) for trace in diagnosis.traces}
    return serve(view, motions, port, magnify)


def show_run(folder: str | Path, port: int = 8080, *, magnify: float = 20.0) -> viser.ViserServer:
    """Serve the robot of a finished run as `show_diagnosis` does; the nominal robot is that of the run's task.

    Raises `InputError` where viser is not installed, and for a folder that holds no run with a model.
    """
    return serve(*view_of(folder), port, magnify)


def view_of(folder: str | Path) -> tuple[RobotView, Motions]:
    """The view of a run directory and the motions that its task's recordings hold, as far as they are still there."""
    check_path("folder", folder)
    folder = Path(folder)
    answer = next((folder / name for name in ("answer.json", "result.json") if (folder / name).is_file()), None)
    if answer is None or not (folder / "model").is_dir():
        raise InputError(f"{folder}: holds no run with a model (answer.json or result.json, and model/)")
    try:
        found = json.loads(answer.read_text(encoding="utf-8"))
        causes = [(one["effect"], tuple(one["at"])) for one in found.get("causes", [])]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        raise InputError(f"{answer}: cannot be read; name a run directory as this library writes it") from None
    task = Path(read_provenance(folder)["task"])
    nominal = motions = None
    if task.is_file():
        loaded = load_task(task)
        nominal = load_robot(loaded, kinematic=True)
        motions = _motions(loaded, nominal)
    if (folder / "model" / "effects.yaml").is_file():
        robot = load_model(folder / "model").robot
    else:
        names = None if nominal is None else nominal.joint_names
        files = [folder / "model" / name for name in ("robot.urdf", "robot.xml")]  # of an MJCF there is no URDF
        robot = read_robot(next((one for one in files if one.is_file()), files[0]), names, kinematic=True)
    if nominal is not None and nominal.joint_names != robot.joint_names:
        nominal = None
    return RobotView(robot, _said(causes), nominal), motions or {}


def _motions(task: Any, robot: RobotModel) -> Motions:

    if any(entry.measurement is not None for entry in task.data):
        return {}
    try:
        rollouts = all(entry.torque is None for entry in task.data)
        return {one.name: (one.time, one.position) for one in read_recordings(task, robot, rollouts=rollouts)}
    except InputError:  # recordings that have gone since: the robot is shown without them
        return {}


def _causes(diagnosis: Diagnosis) -> list[tuple[str, tuple[str, ...]]]:
    return [(cause.name.effect, cause.name.at) for cause in diagnosis.causes]


def _said(causes: Sequence[tuple[str, Collection[str]]]) -> dict[str, str]:
    """What is named at each joint, link or frame."""
    said: dict[str, list[str]] = {}
    for effect, at in causes:
        for name in at:
            said.setdefault(name, []).append(effect_title(effect))
    return {name: ", ".join(titles) for name, titles in said.items()}


def serve(view: RobotView, motions: Motions, port: int, magnify: float) -> viser.ViserServer:
    """The server: sliders for joints and differences, a recording's time where there are motions."""
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("the view needs viser: pip install 'figaroh-jax[view]'") from None
    server = viser.ViserServer(port=port, verbose=False)
    low, high = np.clip(
        np.nan_to_num(np.asarray(view.model.position_limit), posinf=np.pi, neginf=-np.pi), -np.pi, np.pi
    ).T
    start = middle_posture(view.model) if view.model.nq == view.model.nv else np.zeros(view.model.nv)
    sliders = [
        server.gui.add_slider(name, min=float(a), max=float(max(b, a + 0.01)), step=0.01, initial_value=float(x))
        for name, a, b, x in zip(view.model.dof_names, low, high, np.clip(start, low, high), strict=True)
    ]
    size = server.gui.add_slider(
        "differences, times", min=1.0, max=100.0, step=1.0, initial_value=magnify, disabled=not view.moved
    )

    def draw(_: Any = None) -> None:
        q = np.array([slider.value for slider in sliders])
        colours = {"links": _PLAIN, "named": _HIT, "nominal": _NOMINAL}
        for name, lines in view.lines(q, size.value).items():
            if len(lines):
                server.scene.add_line_segments(f"/{name}", lines, colors=colours[name])
        for name, place, text in view.joints(q, size.value):
            scale = 1.6 if text else 1.0
            colour = _HIT if text else _PLAIN
            server.scene.add_icosphere(f"/joints/{name}", _SIZE * scale * view.size, colour, position=tuple(place))
            if text:
                server.scene.add_label(f"/names/{name}", f"{name}: {text}", position=tuple(place))
        for name, place, radius, which in view.bodies(q):
            colour = _NOMINAL if which == "nominal" else _BODY
            server.scene.add_icosphere(f"/mass/{which}/{name}", max(radius, 1e-3), colour, position=tuple(place))

    for control in (*sliders, size):
        control.on_update(draw)
    if motions and view.model.nq == view.model.nv:
        _player(server, sliders, motions)
    draw()
    corners = segments(view.model, np.array([slider.value for slider in sliders])).reshape(-1, 3)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    server.scene.add_grid("/floor", width=4 * view.size, height=4 * view.size, cell_size=0.1)

    def look(client: Any) -> None:
        client.camera.position = tuple(middle + view.size * np.array([1.0, -1.0, 0.5]))
        client.camera.look_at = tuple(middle)  # after the position, which moves both

    server.on_client_connect(look)
    return server


def _player(server: Any, sliders: Sequence[Any], motions: Motions) -> None:
    """A list of recordings and a slider of their time, which moves the joints."""
    chosen = server.gui.add_dropdown("recording", tuple(motions))
    share = server.gui.add_slider("time, %", min=0.0, max=100.0, step=0.1, initial_value=0.0)

    def move(_: Any = None) -> None:
        time, position = motions[chosen.value]
        row = int(np.searchsorted(time, time[0] + share.value / 100 * (time[-1] - time[0])))
        for slider, value in zip(sliders, position[min(row, len(position) - 1)], strict=False):
            slider.value = float(np.clip(value, slider.min, slider.max))

    chosen.on_update(move)
    share.on_update(move)
