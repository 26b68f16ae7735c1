"""Nominal against calibrated robot in a browser, posture by posture, with `viser` (extra `view`).

The robots are drawn as lines from joint to joint, so that no mesh is needed; differences are magnified.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import equinox as eqx
import numpy as np

from ..calibration.calibrated import Calibration
from ..calibration.corrections import twist_pose
from ..errors import InputError
from ..rigid.model import RobotModel
from .picture import segments

if TYPE_CHECKING:
    import viser  # pyright: ignore[reportMissingImports]

__all__ = ["nominal_of", "show"]

_COLOURS = {"nominal": (213, 94, 0), "calibrated": (0, 114, 178)}


def nominal_of(calibration: Calibration) -> RobotModel:
    """The robot before its corrections."""
    placement = np.array(calibration.model.placement)
    for k, joint in enumerate(calibration.model.joints):
        if joint.name in calibration.twists:
            placement[k] = placement[k] @ np.linalg.inv(twist_pose(calibration.twists[joint.name]))
    return eqx.tree_at(lambda m: m.placement, calibration.model, placement)


def show(calibration: Calibration, magnify: float = 20.0, port: int = 8080) -> viser.ViserServer:
    """Serve the view at `http://localhost:port` and return the server; sliders move the joints.

    Raises `InputError` where viser is not installed.
    """
    try:
        import viser  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError("the view needs viser: pip install 'figaroh-jax[view]'") from None
    server = viser.ViserServer(port=port, verbose=False)
    nominal = nominal_of(calibration)
    sliders = [
        server.gui.add_slider(name, min=-np.pi, max=np.pi, step=0.01, initial_value=0.0)
        for name in calibration.model.joint_names
    ]
    size = server.gui.add_slider("differences, times", min=1.0, max=100.0, step=1.0, initial_value=magnify)

    def draw(_: object = None) -> None:
        q = np.array([slider.value for slider in sliders])
        before, after = segments(nominal, q), segments(calibration.model, q)
        drawn = {"nominal": before, "calibrated": before + size.value * (after - before)}
        for name, lines in drawn.items():
            server.scene.add_line_segments(f"/{name}", lines, colors=_COLOURS[name])

    for control in (*sliders, size):
        control.on_update(draw)
    draw()
    return server
