"""A designed motion in a browser, with `viser` (extra `view`): the robot moves, its capsules and the boxes around it.

Links are drawn as lines from joint to joint, so that no mesh is needed; where the design looked at distances, the
capsules that it kept apart are drawn too.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..excitation.clearance import Clearance, link_poses
from ..excitation.design import Design
from ..formats.collision import rotation
from ..rigid.model import RobotModel

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]

__all__ = ["capsule_lines", "show_motion", "skeleton"]

FRAMES = 25.0  # pictures a second
_BODY, _SHELL, _BOX = (0, 114, 178), (150, 150, 150), (213, 94, 0)
_RIM = 12  # corners of a circle


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
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("the view needs viser: pip install 'figaroh-jax[view]'") from None
    if not 1 <= trajectory <= len(design.stages):
        raise InputError(f"trajectory {trajectory}: the design has {len(design.stages)}, counted from 1")
    server = viser.ViserServer(port=port, verbose=False)
    motion, model, clearance = design.stages[trajectory - 1].motion, design.learned.robot, design.limits.clearance
    for box in () if clearance is None else clearance.boxes:
        server.scene.add_line_segments(f"/{box.name}", _edges(box), colors=_BOX)
    slider = server.gui.add_slider("time, s", min=0.0, max=motion.duration, step=1 / FRAMES, initial_value=0.0)

    def draw(_: Any = None) -> None:
        q = np.asarray(motion.at(np.array([slider.value]))[0])[0]
        server.scene.add_line_segments("/robot", skeleton(model, q), colors=_BODY)
        if clearance is not None:
            server.scene.add_line_segments("/capsules", capsule_lines(clearance, q), colors=_SHELL)

    slider.on_update(draw)
    draw()
    ended = threading.Event()

    def run() -> None:
        begun = time.monotonic()
        while not ended.wait(1 / FRAMES):
            slider.value = float((time.monotonic() - begun) % motion.duration)

    if play:
        threading.Thread(target=run, daemon=True).start()
    return server, ended.set


def _edges(box: Any) -> Float[np.ndarray, "12 2 3"]:
    corners = np.array(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij")).reshape(3, -1).T * box.size
    pairs = [(i, j) for i in range(8) for j in range(i) if bin(i ^ j).count("1") == 1]
    return (corners @ rotation(box.turn).T + np.array(box.at))[np.array(pairs)]
