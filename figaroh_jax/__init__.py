"""Names what a robot's simulation gets wrong, extends the model with it and measures the gain.

The names below are loaded when they are first used, so that `import figaroh_jax` costs next to nothing; submodules are
reached as attributes too (`figaroh_jax.rigid.spatial`). Importing changes no setting of JAX.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .calibration.calibration import calibrate as calibrate, calibrate_task as calibrate_task
    from .diagnosis.fleet import screen_fleet as screen_fleet
    from .effects.base import (
        Effect as Effect,
        JointEffect as JointEffect,
        Motion as Motion,
        amplitude as amplitude,
        place as place,
        shape as shape,
    )
    from .effects.catalogue import CATALOGUE as CATALOGUE, register as register
    from .effects.extended import ExtendedModel as ExtendedModel, extend as extend, predict as predict
    from .effects.simulation import simulate as simulate
    from .errors import InputError as InputError
    from .estimation import (
        accelerators as accelerators,
        columns as columns,
        fleets as fleets,
        least_squares as least_squares,
        markers as markers,
        regression as regression,
        states as states,
        units as units,
    )
    from .estimation.blockwise import BlockLevenbergMarquardt as BlockLevenbergMarquardt
    from .estimation.data import (
        PoseData as PoseData,
        TorqueData as TorqueData,
        pose_data as pose_data,
        residual as residual,
        torque_data as torque_data,
    )
    from .estimation.fit import fit as fit
    from .estimation.linear import (
        LinearFit as LinearFit,
        fit_linear as fit_linear,
        linear_basis as linear_basis,
        linear_limits as linear_limits,
    )
    from .estimation.selection import select as select
    from .estimation.solution import Fit as Fit
    from .excitation.design import Design as Design, excite as excite
    from .excitation.information import (
        Learned as Learned,
        expected_std as expected_std,
        information as information,
        learn as learn,
    )
    from .excitation.limits import limits_of as limits_of
    from .excitation.motions import Trajectory as Trajectory, fourier as fourier, quintic as quintic, spline as spline
    from .excitation.postures import (
        Instrument as Instrument,
        PostureDesign as PostureDesign,
        excite_postures as excite_postures,
    )
    from .excitation.task import excite_task as excite_task
    from .formats.config import Baseline as Baseline, Load as Load, Preprocess as Preprocess, load_task as load_task
    from .formats.export import load_model as load_model, write_model as write_model
    from .formats.mjcf import load_mjcf as load_mjcf
    from .formats.robotfile import load_extended as load_extended, load_robot as load_robot
    from .formats.urdf import load_urdf as load_urdf
    from .formats.usd import load_usd as load_usd
    from .identification import (
        acceleration_free as acceleration_free,
        instruments as instruments,
        payloads as payloads,
        people as people,
        wrenches as wrenches,
    )
    from .identification.identification import identify as identify
    from .recordings import cleaning as cleaning, devices as devices
    from .recordings.arrays import postures as postures, recording as recording
    from .recordings.dataset import Recording as Recording, read_recordings as read_recordings
    from .recordings.devices import Device as Device, own_device as own_device
    from .recordings.poses import PoseRecording as PoseRecording
    from .reporting.report import write_report as write_report
    from .results import Cause as Cause, Diagnosis as Diagnosis, Selection as Selection
    from .rigid.dynamics import (
        forward_dynamics as forward_dynamics,
        inverse_dynamics as inverse_dynamics,
        mass_matrix as mass_matrix,
    )
    from .rigid.kinematics import (
        forward_kinematics as forward_kinematics,
        frame_jacobian as frame_jacobian,
        frame_placement as frame_placement,
    )
    from .rigid.model import Frame as Frame, Joint as Joint, RobotModel as RobotModel
    from .rigid.normal_equations import normal_matrix as normal_matrix, triangular_factor as triangular_factor
    from .rigid.regressor import joint_torque_regressor as joint_torque_regressor, packed_regressor as packed_regressor
    from .rollouts.measured import RolloutData as RolloutData, rollout_data as rollout_data
    from .rollouts.reading import load_loop as load_loop
    from .rollouts.simulation import rollout as rollout
    from .rollouts.stored import read_loop as read_loop, write_loop as write_loop
    from .simulators.registry import backend as backend
    from .tasks import diagnose as diagnose, diagnose_task as diagnose_task, identify_task as identify_task

__version__ = "0.1.0"

DEMO = f"{__path__[0]}/demo/robot.urdf"  # a small arm, for examples

_MODULES = {
    "calibration.calibration": ("calibrate", "calibrate_task"),
    "formats.config": ("Baseline", "Load", "Preprocess", "load_task"),
    "estimation.data": ("PoseData", "TorqueData", "pose_data", "residual", "torque_data"),
    "estimation.blockwise": ("BlockLevenbergMarquardt",),
    "estimation.fit": ("fit",),
    "estimation.selection": ("select",),
    "estimation.solution": ("Fit",),
    "estimation.linear": ("LinearFit", "fit_linear", "linear_basis", "linear_limits"),
    "recordings.arrays": ("postures", "recording"),
    "recordings.devices": ("Device", "own_device"),
    "recordings.dataset": ("Recording", "read_recordings"),
    "recordings.poses": ("PoseRecording",),
    "tasks": ("diagnose", "diagnose_task", "identify_task"),
    "rigid.dynamics": ("forward_dynamics", "inverse_dynamics", "mass_matrix"),
    "effects.base": ("Effect", "JointEffect", "Motion", "amplitude", "place", "shape"),
    "effects.catalogue": ("CATALOGUE", "register"),
    "errors": ("InputError",),
    "formats.export": ("load_model", "write_model"),
    "diagnosis.fleet": ("screen_fleet",),
    "effects.extended": ("ExtendedModel", "extend", "predict"),
    "excitation.design": ("Design", "excite"),
    "excitation.information": ("Learned", "expected_std", "information", "learn"),
    "excitation.limits": ("limits_of",),
    "excitation.postures": ("Instrument", "PostureDesign", "excite_postures"),
    "excitation.task": ("excite_task",),
    "excitation.motions": ("Trajectory", "fourier", "quintic", "spline"),
    "identification.identification": ("identify",),
    "rollouts.measured": ("RolloutData", "rollout_data"),
    "rollouts.reading": ("load_loop",),
    "rollouts.stored": ("read_loop", "write_loop"),
    "rollouts.simulation": ("rollout",),
    "rigid.kinematics": ("forward_kinematics", "frame_jacobian", "frame_placement"),
    "formats.mjcf": ("load_mjcf",),
    "rigid.model": ("Frame", "Joint", "RobotModel"),
    "simulators.registry": ("backend",),
    "rigid.regressor": ("joint_torque_regressor", "packed_regressor"),
    "reporting.report": ("write_report",),
    "results": ("Cause", "Diagnosis", "Selection"),
    "formats.robotfile": ("load_extended", "load_robot"),
    "effects.simulation": ("simulate",),
    "rigid.normal_equations": ("normal_matrix", "triangular_factor"),
    "formats.urdf": ("load_urdf",),
    "formats.usd": ("load_usd",),
}
# Namespaces of what few need: modules by a short name.
_SPACES = {
    "acceleration_free": "identification.acceleration_free",
    "accelerators": "estimation.accelerators",
    "cleaning": "recordings.cleaning",
    "columns": "estimation.columns",
    "devices": "recordings.devices",
    "fleets": "estimation.fleets",
    "instruments": "identification.instruments",
    "least_squares": "estimation.least_squares",
    "markers": "estimation.markers",
    "payloads": "identification.payloads",
    "people": "identification.people",
    "regression": "estimation.regression",
    "states": "estimation.states",
    "units": "estimation.units",
    "wrenches": "identification.wrenches",
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        value = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
        globals()[name] = value
        return value
    if name in _SPACES:
        return importlib.import_module(f"{__name__}.{_SPACES[name]}")
    if not name.startswith("_") and importlib.util.find_spec(f"{__name__}.{name}"):
        return importlib.import_module(f"{__name__}.{name}")
    raise AttributeError(f"module '{__name__}' has no attribute '{name}'", name=name, obj=sys.modules[__name__])


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME, *_SPACES])
