"""What an extended model predicts of recordings that were kept out of the fit."""

from __future__ import annotations

import equinox as eqx
import numpy as np

from ..effects.extended import ExtendedModel, predict
from ..formats.config import Task
from ..recordings.bandwidth import Band
from ..recordings.dataset import carrying, read_recordings
from ..recordings.signals import choose_rates, prepare, to_recording_times

__all__ = ["predictions"]


def predictions(
    task: Task, extended: ExtendedModel, *, identified: bool = False, band: Band = None
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Time (s) and the extended model's torque (N m or N) of each holdout recording, on its own time stamps.

    The recording's motion is prepared as for the fit (`band` as for `prepare`), but over its whole length, whatever
    window the fit kept. Where the model is an identified one, a known payload is carried in addition.
    """
    if all(entry.role == "fit" for entry in task.data):
        return {}
    recordings = read_recordings(task, extended.robot, floating=identified)
    rates = choose_rates(recordings, task.preprocess)
    whole = task.preprocess.model_copy(update={"window": None, "gate": {}})
    found = {}
    for recording in recordings:
        if recording.role == "holdout":
            motion = prepare(recording, whole, rates, band=band, model=extended.robot)
            robot = carrying(extended.robot, recording.load if identified else None)
            loaded = eqx.tree_at(lambda m: m.robot, extended, robot)
            state = motion.position, motion.velocity, motion.acceleration
            if extended.robot.nq == extended.robot.nv:
                torque = predict(loaded, motion.time, *state, motion.dt)
            else:
                torque = loaded.inverse_dynamics(*state)
            stamps, clock = recording.stamps, recording.clock
            if stamps is None or clock is None:
                stamps = clock = recording.time
            found[recording.name] = stamps, to_recording_times(motion.time, np.asarray(torque), clock)
    return found
