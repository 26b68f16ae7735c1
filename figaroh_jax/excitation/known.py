"""What recordings have told already, before an experiment is designed."""

from __future__ import annotations

import jax
import numpy as np

from ..errors import InputError
from ..estimation.base_parameters import base_parameters
from ..estimation.columns import friction_terms, structural_columns
from ..estimation.intervals import coloured_covariance
from ..estimation.least_squares import WeightedByJoint, solve
from ..estimation.regression import Regression, condense
from ..formats.config import Baseline, Task
from ..recordings.checks import check_recordings
from ..recordings.dataset import read_recordings
from ..recordings.signals import prepare_all
from ..rigid.model import RobotModel
from ..simulators.native import NativeBackend
from .information import Learned

__all__ = ["with_recordings"]


def with_recordings(
    task: Task, robot: RobotModel, known: Baseline, learned: Learned, noise_too: bool
) -> tuple[Learned, tuple[str, ...]]:
    """What is known after the recordings, in words too: their information is the prior, their residual the noise."""
    recordings = read_recordings(task, robot)
    warnings = check_recordings(task, robot, recordings)
    for one in recordings:
        if one.torque is None and one.role == "fit":
            raise InputError(f"{one.file}: no torque; recordings of `excite` say what is already known of the dynamics")
    with jax.enable_x64(True):
        terms = friction_terms(robot, known)
        signals = prepare_all(tuple(recordings), task.preprocess, band=None, model=robot)
        regression = Regression(NativeBackend(robot), terms, np.zeros(robot.nv), signals)
        used = np.asarray(np.abs(structural_columns(robot, terms)).max(axis=0) > 0)
        data = condense(regression, used)
        base = base_parameters(data.factor()[:, :-1], data.names)
        found = solve(data, WeightedByJoint(), kept=base.independent)
        covariance = coloured_covariance(regression, found.parameters, base.independent, found.weight)
        A = data.factor(found.weight)
        own = A[:, base.independent]
        inflation = max(1.0, float(np.trace(covariance @ (own.T @ own))) / base.rank)
        seen = A[:, np.array(learned.independent)]
        learned = learned.with_prior(seen.T @ seen / inflation)
    many = len(recordings) > 1
    text = f"{len(recordings)} recording{'s count' if many else ' counts'} as known already"
    if noise_too:
        learned = learned.with_noise(1 / np.sqrt(found.weight))
        text += "; the noise is the residual of their fit"
    return learned, (*warnings, text)
