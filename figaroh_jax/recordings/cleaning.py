"""Recordings made better before they become rows: single wild samples, steps of an encoder, torque not to be trusted.

Each function takes a `Recording` and gives another one, with a note of what was done; `signals` then low-passes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from ..errors import InputError
from .dataset import Recording
from .wild import without_wild_rows

__all__ = ["median_filter", "near", "savitzky_golay", "without_spikes", "without_untrusted", "without_wild_rows"]

SPIKE = 8.0  # robust standard deviations from the running median


def median_filter(recording: Recording, samples: int = 5) -> Recording:
    """Position and torque replaced by the median of `samples` (odd) neighbours: single wild samples vanish.

    The recording's ends see the nearest sample repeated. Raises `InputError` for an even or too large number.

    >>> import numpy as np, figaroh_jax as fj
    >>> t = np.arange(500)[:, None] / 250.0
    >>> tau = np.cos(t + np.arange(4))
    >>> tau[100, 2] = 50.0  # a wild sample
    >>> run = fj.recording(q=np.sin(t + np.arange(4)), tau=tau, rate=250)
    >>> float(fj.cleaning.median_filter(run).torque.max()) < 1.01
    True
    """
    from scipy.ndimage import median_filter as running_median

    _odd(recording, samples, 1)

    def smooth(x: Float[np.ndarray, "samples nv"]) -> Float[np.ndarray, "samples nv"]:
        return running_median(x, size=(samples, 1), mode="nearest")

    return _smoothed(recording, smooth, f"median of {samples} samples")


def savitzky_golay(recording: Recording, samples: int, order: int = 3) -> Recording:
    """Position and torque replaced by the value of a polynomial of `order` fitted to `samples` (odd) neighbours.

    It keeps the peaks of a slowly sampled motion better than a low pass does (Savitzky and Golay, 1964). The samples
    must be evenly spaced. Raises `InputError` where the numbers do not fit.

    >>> import numpy as np, figaroh_jax as fj
    >>> t = np.arange(500)[:, None] / 250.0
    >>> tau = np.cos(t + np.arange(4))
    >>> tau += 0.1 * np.random.default_rng(0).normal(size=tau.shape)
    >>> run = fj.recording(q=np.sin(t + np.arange(4)), tau=tau, rate=250)
    >>> smooth = fj.cleaning.savitzky_golay(run, samples=31)
    >>> error = [float(np.abs(one.torque - np.cos(t + np.arange(4))).mean()) for one in (run, smooth)]
    >>> error[1] < 0.5 * error[0]
    True
    """
    from scipy.signal import savgol_filter

    _odd(recording, samples, order + 1)
    return _smoothed(
        recording,
        lambda x: savgol_filter(x, samples, order, axis=0),
        f"Savitzky-Golay filter over {samples} samples, order {order}",
    )


def without_spikes(
    recording: Recording, samples: int = 5, cut: float = SPIKE, joints: Sequence[str] | None = None
) -> Recording:
    """Torque further than `cut` robust standard deviations from its running median is not trusted any more.

    The running median is over `samples` (odd) neighbours; the deviation is 1.48 times the median distance of those that
    lie off it. `joints` limits it to some of them. Nothing is replaced: `trusted` holds the flags, a note their number.

    >>> import numpy as np, figaroh_jax as fj
    >>> t = np.arange(500)[:, None] / 250.0
    >>> tau = np.cos(t + np.arange(4))
    >>> tau[100, 2] = 50.0  # a wild sample
    >>> run = fj.recording(q=np.sin(t + np.arange(4)), tau=tau, rate=250)
    >>> found = fj.cleaning.without_spikes(run)
    >>> np.argwhere(~found.trusted).tolist()  # sample, joint
    [[100, 2]]
    """
    torque = recording.torque
    if torque is None:
        return recording
    for name in joints or ():
        if name not in recording.joints:
            raise InputError(f"{recording.file}: no joint '{name}'; known: {', '.join(recording.joints)}")
    smooth = median_filter(recording, samples).torque
    assert smooth is not None
    distance = np.abs(torque - smooth)
    # where torque rises steadily most samples are their own median: those at a distance tell the noise
    sigma = 1.4826 * np.array([np.median(column[column > 0]) if column.any() else np.inf for column in distance.T])
    wild = distance > cut * sigma
    if joints is not None:
        wild &= np.isin(recording.joints, list(joints))
    counts = {name: int(n) for name, n in zip(recording.joints, wild.sum(axis=0), strict=True) if n}
    if not counts:
        return recording
    note = f"{recording.name}: torque of {', '.join(f'{n} samples of {name}' for name, n in counts.items())}"
    trusted = ~wild if recording.trusted is None else recording.trusted & ~wild
    return replace(
        recording,
        trusted=trusted,
        notes=(*recording.notes, f"{note} is beyond {cut:g} robust standard deviations and is left out"),
    )


def without_untrusted(recording: Recording) -> tuple[Recording, list[Float[np.ndarray, " masked"]]]:
    """The recording with straight lines in place of torque that is not trusted, and its times (s) at each joint.

    A low pass would spread such torque over its neighbours. Raises `InputError` for a mask of another shape, and where
    a joint has nothing left.

    >>> import dataclasses, numpy as np, figaroh_jax as fj
    >>> torque = np.arange(10.0)[:, None] * np.ones(2)
    >>> torque[4, 1], trusted = 99.0, np.arange(20).reshape(10, 2) != 9
    >>> run = dataclasses.replace(fj.recording(q=torque, tau=torque, rate=10), trusted=trusted)
    >>> found, times = fj.cleaning.without_untrusted(run)
    >>> float(found.torque[4, 1]), times[1].tolist()
    (4.0, [0.4])
    """
    torque, trusted = recording.torque, recording.trusted
    if torque is None or trusted is None:
        return recording, []
    if trusted.shape != torque.shape:
        raise InputError(f"{recording.file}: `trusted` has shape {trusted.shape}, but torque {torque.shape}")
    if not trusted.any(axis=0).all():
        name = recording.joints[int(np.argmin(trusted.any(axis=0)))]
        raise InputError(
            f"{recording.file}: no torque of {name} is trusted; leave the joint out with identify.joints instead"
        )
    columns = [
        np.interp(recording.time, recording.time[good], x[good]) for x, good in zip(torque.T, trusted.T, strict=True)
    ]
    masked = [recording.time[~good] for good in trusted.T]
    return replace(recording, torque=np.stack(columns, axis=1), trusted=None), masked


def near(
    rows: Float[np.ndarray, " rows"], masked: Sequence[Float[np.ndarray, "_"]], reach: float
) -> Bool[np.ndarray, "rows nv"] | Bool[np.ndarray, ""]:
    """Which rows (times, s) lie within `reach` (s) of a time that is masked, joint by joint; none for no mask.

    >>> import numpy as np, figaroh_jax as fj
    >>> fj.cleaning.near(np.array([0.0, 0.1, 0.2]), [np.array([0.12])], 0.05).tolist()
    [[False], [True], [False]]
    """
    if not masked:
        return np.array(False)
    out = np.zeros((len(rows), len(masked)), bool)
    for column, times in zip(out.T, masked, strict=True):
        padded = np.concatenate([[-np.inf], times, [np.inf]])
        after = np.searchsorted(padded, rows)
        column[:] = np.minimum(padded[after] - rows, rows - padded[after - 1]) <= reach
    return out


def _odd(recording: Recording, samples: int, least: int) -> None:
    if samples % 2 == 0 or not least <= samples <= len(recording.time):
        raise InputError(
            f"{recording.file}: a filter over {samples} samples: expected an odd number from {least} to"
            f" {len(recording.time)}"
        )


def _smoothed(recording: Recording, smooth, what: str) -> Recording:
    return replace(
        recording,
        position=smooth(recording.position),
        torque=None if recording.torque is None else smooth(recording.torque),
        notes=(*recording.notes, f"{recording.name}: {what} on position and torque"),
    )
