"""Designed and simulated motions in a browser, with `viser` (extra `view`): the robot, its capsules, boxes around it.

Links are drawn as lines from joint to joint, so that no mesh is needed; where the design looked at distances, the
capsules that it kept apart are drawn too.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float

from ..errors import InputError, check_kind, check_switch
from ..excitation.clearance import Clearance, link_poses
from ..excitation.design import Design
from ..excitation.task import clearance_asked, excite_block
from ..formats.collision import rotation
from ..formats.config import load_task
from ..formats.export import load_model
from ..formats.robotfile import load_robot
from ..rigid.model import RobotModel
from ..rollouts.stored import LOOP, read_loop
from .provenance import read_provenance

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]

__all__ = [
    "SIMULATION",
    "Played",
    "capsule_lines",
    "designed",
    "is_design",
    "is_simulation",
    "model_folder",
    "show_design_run",
    "show_motion",
    "show_simulation_run",
    "simulated",
    "skeleton",
]

ANSWER = "excitation.json"
SIMULATION = "simulation"  # what the files of `simulate` are called
FRAMES = 25.0  # pictures a second
_BODY, _SHELL, _BOX = (0, 114, 178), (150, 150, 150), (213, 94, 0)
_RIM = 12  # corners of a circle
_SQUARE = 0.1  # m, of the floor's grid


class Played(NamedTuple):
    """What is shown: the robot, its motions (times in s and positions), and what was kept apart."""

    model: RobotModel
    motions: Mapping[str, tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n nv"]]]
    clearance: Clearance | None
    still: bool = False  # postures, one after another, in place of motions

    def at(self, name: str, moment: float) -> Float[np.ndarray, " nv"]:
        """Positions in a motion at a time (s); in postures the one of that number, from 1."""
        times, q = self.motions[name]
        if self.still:
            return q[int(np.clip(round(moment) - 1, 0, len(q) - 1))]
        return np.array([np.interp(moment, times, column) for column in q.T])


def skeleton(model: RobotModel, q: Float[np.ndarray, " nv"]) -> Float[np.ndarray, "nj 2 3"]:
    """From the parent's joint (or the world's origin) to every joint, m."""
    origins = np.concatenate([np.zeros((1, 3)), link_poses(model, np.asarray(q, float)[None])[:, :3, 3, 0]])
    return np.stack([origins[[joint.parent + 1 for joint in model.joints]], origins[1:]], axis=1)


def capsule_lines(clearance: Clearance, q: Float[np.ndarray, " nv"]) -> Float[np.ndarray, "lines 2 3"]:
    """Circles around both ends of each capsule and lines between them, in the world, m."""
    poses, lines = link_poses(clearance.model, np.asarray(q, float)[None])[..., 0], []
    angle = 2 * np.pi * np.arange(_RIM) / _RIM
    for link in clearance.links:
        pose = np.eye(4) if link.joint < 0 else poses[link.joint]
        for ends, radius in zip(np.stack([link.start, link.end], 1), link.radius, strict=True):
            z = ends[1] - ends[0]
            z = z / np.linalg.norm(z) if np.linalg.norm(z) > 1e-9 else np.array([0.0, 0.0, 1.0])
            x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
            x /= np.linalg.norm(x)
            rim = radius * (np.outer(np.cos(angle), x) + np.outer(np.sin(angle), np.cross(z, x)))
            low, high = ((rim + end) @ pose[:3, :3].T + pose[:3, 3] for end in ends)
            lines += [np.stack([ring, np.roll(ring, 1, 0)], 1) for ring in (low, high)]
            lines.append(np.stack([low, high], 1))
    return np.concatenate(lines) if lines else np.zeros((0, 2, 3))


def show_motion(
    design: Design, trajectory: int = 1, port: int = 8080, *, play: bool = True
) -> tuple[viser.ViserServer, Callable[[], None]]:
    """Serve the view at `http://localhost:port`; returns the server and what ends the playing.

    A slider stands for the time; with `play` the motion repeats. Raises `InputError` where viser is not installed, or
    the design has no such trajectory.
    """
    check_kind("design", design, Design, "`excite` gives one")
    check_switch("play", play)
    if not 1 <= trajectory <= len(design.stages):
        raise InputError(f"trajectory {trajectory}: the design has {len(design.stages)}, counted from 1")
    motion = design.stages[trajectory - 1].motion
    times = motion.basis.instants(4 * FRAMES)
    motions = {f"trajectory {trajectory}": (times, np.asarray(motion.at(times)[0]))}
    return _served(Played(design.learned.robot, motions, design.limits.clearance), port, play)


def is_design(folder: Path) -> bool:
    """Whether the folder holds a run of `excite`."""
    return (folder / ANSWER).is_file()


def show_design_run(
    folder: Path, port: int = 8080, *, play: bool = True
) -> tuple[viser.ViserServer, Callable[[], None]]:
    """The same of a run directory of `excite`: all of its motions, or its postures."""
    return _served(designed(folder), port, play)


def designed(folder: Path) -> Played:
    """The robot, the motions or postures of a run directory of `excite`, and what they keep apart.

    Raises `InputError` where the run cannot be read or the task that it was made from has gone.
    """
    try:
        answer = json.loads((folder / ANSWER).read_text(encoding="utf-8"))
        still, joints = answer["kind"] == "postures", list(answer["joints"])
        if still:
            q = np.asarray(answer["postures"], float)
            motions = {"postures": (np.arange(1.0, len(q) + 1), q)}
        else:
            motions = {}
            for stem in (Path(one["file"]).stem for one in answer["trajectories"]):
                with (folder / f"{stem}.npz").open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                    motions[stem.replace("_", " ")] = np.asarray(arrays["t"]), np.asarray(arrays["q"])
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile):
        raise InputError(f"{folder}: the design cannot be read; name a run directory of `excite`") from None
    task = load_task(Path(read_provenance(folder)["task"]))
    robot = load_robot(task, kinematic=True)
    if list(robot.dof_names) != joints:
        raise InputError(f"{folder}: made for the joints {', '.join(joints)}; {task.file} has others now")
    asked = task.excite if still and task.excite is not None else excite_block(task.excite)
    return Played(robot, motions, clearance_asked(task, asked, robot)[0], still)


def is_simulation(folder: Path) -> bool:
    """Whether the folder holds a run of `simulate`."""
    return (folder / f"{SIMULATION}.json").is_file()


def model_folder(path: Path) -> Path:
    """The folder of a model: `model` in a run directory, or the folder itself."""
    return path / "model" if (path / "model" / "effects.yaml").is_file() else path


def show_simulation_run(
    folder: Path, port: int = 8080, *, play: bool = True
) -> tuple[viser.ViserServer, Callable[[], None]]:
    """The same of a run directory of `simulate`: what its model did."""
    return _served(simulated(folder), port, play)


def simulated(folder: Path) -> Played:
    """The robot and the motion of a run directory of `simulate`; its times begin at zero.

    Raises `InputError` where the run cannot be read, the model that it moved has gone, or a joint has several axes.
    """
    try:
        joints = list(json.loads((folder / f"{SIMULATION}.json").read_text(encoding="utf-8"))["joints"])
        with (folder / f"{SIMULATION}.npz").open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            time, q = np.asarray(arrays["time"], float), np.asarray(arrays["position"], float)
    except (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile):
        raise InputError(f"{folder}: the simulation cannot be read; name a run directory of `simulate`") from None
    model = model_folder(Path(read_provenance(folder)["task"]))
    robot = read_loop(model).robot if (model / LOOP).is_file() else load_model(model).robot
    if list(robot.dof_names) != joints:
        raise InputError(f"{folder}: made of a model with the joints {', '.join(joints)}; {model} has others now")
    if robot.nq != robot.nv:
        raise InputError(
            f"{folder}: view plays robots whose joints have one axis each; the motion is in simulation.csv"
        )
    return Played(robot, {"simulation": (time - time[0], q)}, None)


def _served(shown: Played, port: int, play: bool) -> tuple[viser.ViserServer, Callable[[], None]]:
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("the view needs viser: pip install 'figaroh-jax[view]'") from None
    server = viser.ViserServer(port=port, verbose=False)
    model, clearance, names = shown.model, shown.clearance, list(shown.motions)
    for box in () if clearance is None else clearance.boxes:
        server.scene.add_line_segments(f"/{box.name}", _edges(box), colors=_BOX)
    chosen = server.gui.add_dropdown("motion", tuple(names)) if len(names) > 1 else None
    last = max(float(times[-1]) for times, _ in shown.motions.values())
    first, label, step = (1.0, "posture", 1.0) if shown.still else (0.0, "time, s", 1 / FRAMES)
    slider = server.gui.add_slider(label, min=first, max=last, step=step, initial_value=first)

    def name() -> str:
        return names[0] if chosen is None else str(chosen.value)

    def draw(_: Any = None) -> None:
        q = shown.at(name(), float(slider.value))
        server.scene.add_line_segments("/robot", skeleton(model, q), colors=_BODY, line_width=4.0)
        if clearance is not None:
            server.scene.add_line_segments("/capsules", capsule_lines(clearance, q), colors=_SHELL)

    for control in (slider, *(() if chosen is None else (chosen,))):
        control.on_update(draw)
    draw()
    _look(server, shown)
    ended = threading.Event()

    def run() -> None:
        begun = time.monotonic()
        while not ended.wait(1 / FRAMES):
            slider.value = float((time.monotonic() - begun) % float(shown.motions[name()][0][-1]))

    if play and not shown.still:
        threading.Thread(target=run, daemon=True).start()
    return server, ended.set


def _look(server: Any, shown: Played) -> None:
    """A floor, and a camera that sees the robot as far as it reaches."""
    every = np.concatenate([q[:: max(1, len(q) // 20)] for _, q in shown.motions.values()])
    corners = np.concatenate([skeleton(shown.model, q).reshape(-1, 3) for q in every])
    size = float(np.ptp(corners, axis=0).max()) or 1.0
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    floor = 0.0 if shown.clearance is None or shown.clearance.floor is None else shown.clearance.floor
    server.scene.add_grid("/floor", width=4 * size, height=4 * size, cell_size=_SQUARE, position=(0.0, 0.0, floor))

    def look(client: Any) -> None:
        client.camera.position = tuple(middle + 1.2 * size * np.array([1.0, -1.0, 0.5]))
        client.camera.look_at = tuple(middle)  # after the position, which moves both

    server.on_client_connect(look)


def _edges(box: Any) -> Float[np.ndarray, "12 2 3"]:
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij")).reshape(3, -1).T * box.size
    pairs = [(i, j) for i in range(8) for j in range(i) if bin(i ^ j).count("1") == 1]
    return (corners @ rotation(box.turn).T + np.array(box.at))[np.array(pairs)]
