"""Every number that decides what is named, and what it is compared with.

Squares are those of whitened rows (noise has one a row) unless a comment says otherwise; a gain is the share of squares
that is gone on data that was not fitted, t that of its blocks of time.
"""

from __future__ import annotations

import numpy as np

__all__ = ["t_of", "t_of_places", "t_of_recordings"]

# What a name needs (`search`, `arm`)
GAIN = 0.004  # of the squares
CONFIDENT = 1.64  # t, where more than noise is left to explain
T_WITHOUT_REST = 2.5  # t, where nothing but noise is left
SURE_OF_NOISE = 16.0  # squares over the noise, by which it is better there: four sigmas, for some fifty are asked
T_BESIDE_REST = 3.0  # t, where more than noise stays beside it
GAIN_BESIDE_REST = 0.25  # less may stand in for the rest; not of what every joint has
SMALL = 0.002  # gain below which a cause found with others is not missed
STEADY = (0.004, 0.05)  # of what a cause explains: what sizes by position or speed, by time or recording, explain more
MOST_OF_A_REST = 0.67  # gain of wrong links beside a rest: their numbers make up for half of many another effect
STEADY_OF_A_LINK = 0.1  # of what a wrong link explains: what sizes by position, speed, time or recording explain more
BODY = 0.01  # of what wrong links explain: what links that bodies can have may explain less
SLIGHT = 1e-3  # of the squares that others explain at its joint: less makes up for a law that is not theirs
MOST_OF_IT = 0.9  # gain on held-out data from which places count alike, however large the squares of a few are
LEAST_OF_A_RECORDING = 0.1  # of the mean squares of recordings: gains are told beside so much
FEWEST_JOINTS = 3  # that must bear out together a cause of which none shows enough by itself
COST_OF_A_MISSED = 0.1  # of the squares, by which a cause that is surely missed would make them larger
FITTED_FOR_HELD = 0.7  # of the t that a name needs: what it must have on the rows that it was fitted to
OF_ITS_SIZE = 0.5  # standard deviation of a size that is known, of numbers that cannot be negative
CLEAR_OF_NOTHING = 3.0  # standard deviations of a size from no effect, of numbers of either sign
TOLD = 1.96  # standard deviations, as they are told, of a size from no effect: the interval beside a name holds no zero

# Whether a position moves before its command (`data.ahead_of_command`)
AHEAD_SECONDS = 1.0  # looked at to both sides: the lag of a servo is a tenth of it
AHEAD_ROWS = 2  # a logger may write a command one row late
AHEAD_LIKE = 0.3  # correlation of steps: a servo of 50 Hz has 0.4 to 0.9 on steps and random telegraph signals
AHEAD_MORE = 0.2  # correlation by which it exceeds that of a lag; right recordings of two servos reach 0.01

# What the baseline's fit changed of the file (`task`)
REFITTED = (3.0, 0.1)  # standard deviations as they are told, and share of its size, from which a number is told

# Which of several (`search`, `arm`, `screening`)
USUAL = 0.5  # share of the best gain from which friction, damping and rotor come first while more is left
UNTOLD = 1.7  # t below which two causes are alike
NEAR = 0.1  # of the best gain, within which another may be alike
NO_CHOICE = 6.0  # squares between two fits that leave noise alone, below which neither is the likelier one (20 to 1)
STILL_NEEDED = 9.0  # squares that a cause must be worth beside another, to first order, for the other not to be tried
NO_WORSE = 1.002  # times the squares of what contains it, up to which the simpler cause is taken
RICHER = 1.02  # times the promise of a simpler cause, which a richer one must exceed to be fitted
MAY_WIN = 0.45  # share of the best gain after a few steps from which a candidate is fitted to the end
HOPEFUL = 0.1  # share of a joint's squares that a cause must promise where it must take `GAIN_BESIDE_REST` in the end
UNCHANGED = 0.02  # change of a joint's squares below which nothing new is looked for there
EXPLAINED = 1.1  # squares of a sample up to which nothing is left to explain by a spring

# Whether what is left is noise (`search.excess`)
POWER = 4.0  # sigmas of the mean square: one sigma is the root of 6 over the rows, fourth differences being as rough
SLOW = 5.0  # sigmas of the mean square of means of `SLOW_ROWS` rows
SLOW_ROWS = 25
HALF_A_STEP = 2.5  # of the noise, which is .3 of a counter's step at least: it stands at most 1.7 off, and a fit errs

# Whether it is coloured noise (`colour`)
COLOUR = 4.0  # sigmas by which octaves with levels of their own are likelier than a low pass
BURST = 5.0  # sigmas by which the power of groups of `BURST_ROWS` rows varies more than noise's
TO_TRY = (
    8.0,
    float("inf"),
)  # both of what a fit that takes it for white noise leaves: bent to it, short of what is rare
BURST_ROWS = 25
LOUDER = 4.0  # sigmas of the power over that which the record's fourth differences tell, as `POWER`
LOWEST_CORNER = 0.02  # of the sampling rate: a corner below that is not seen in the data
SHORTEST = 100  # rows one after the other that tell a spectrum
LEAST_OF_A_BAND = 4  # frequencies of an octave that is looked at


def t_of(worse: np.ndarray, better: np.ndarray) -> float:
    """t of the blocks' gain in held-out squares."""
    gain = (worse - better).ravel()
    gain = gain[(worse.ravel() != 0) | (better.ravel() != 0)]
    with np.errstate(over="ignore"):  # of fits that diverge without some rows
        return float(gain.mean() / (gain.std(ddof=1) / np.sqrt(len(gain)) + 1e-300)) if len(gain) > 2 else 0.0


def t_of_places(worse: np.ndarray, better: np.ndarray) -> float:
    """t of the logarithms of the blocks' gains: a limit that is met in a few places is not one large gain by chance."""
    told = (worse.ravel() != 0) | (better.ravel() != 0)
    floor = better.ravel()[told].mean()
    logs = np.log((worse.ravel()[told] + floor) / (better.ravel()[told] + floor))
    return float(logs.mean() / (logs.std(ddof=1) / np.sqrt(len(logs)) + 1e-300)) if len(logs) > 2 else 0.0


def t_of_recordings(worse: np.ndarray, better: np.ndarray, runs: np.ndarray) -> float:
    """t of the logarithms of the recordings' gains, (blocks, windows) with the run (windows,) of each: all count alike.

    Blocks of one recording gain or lose together; a recording in which nothing moves tells nothing.
    """
    sums = np.stack([np.bincount(runs, x.sum(0)) / np.maximum(np.bincount(runs), 1) for x in (worse, better)])
    sums = sums[:, np.bincount(runs) > 0]
    floor = LEAST_OF_A_RECORDING * sums[1].mean()
    logs = np.log((sums[0] + floor) / (sums[1] + floor))
    return float(logs.mean() / (logs.std(ddof=1) / np.sqrt(len(logs)) + 1e-300)) if len(logs) > 2 else 0.0
