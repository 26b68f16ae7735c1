"""Every number that decides what a calibration takes in, names or leaves out, and what it is compared with."""

from __future__ import annotations

__all__: list[str] = []

FOLDS = 5  # of the postures; each is left out once

# Level and effects of a calibration (`levels`, `calibration`): shares of the error on postures left out
OF_ROWS = 0.5  # of the measured numbers, that a level and its effects may take up
LEVEL_GAIN = 0.01  # that a level must take away from the one below it
EFFECT_GAIN = 0.03  # that an effect must take away to be taken in
RIVAL = 0.9  # of the best effect's gain: what gains that much is not told apart from it
MOST_EFFECTS = 6
STARTS = 4  # other effects of a joint, by which a search that took two of it begins anew
FOLDS_THAT_CHOOSE = 4  # of five outer folds, that must choose an effect for it to stay
OUTER_GAIN = 0.05  # that all effects together must take away on the outer folds

# Recordings that differ (`changes`)
OWN_POSTURES = 8  # of a recording that is compared with others
AMONG = 1.0  # standard deviations of a joint's position, by which their means may differ
WORTH = 5.0  # squares that one more column must explain
CHANGES = 4  # that are looked for

# Outliers (`outliers`)
FAR = 8.0  # sizes of the noise; what is nearer may be a heavy tail, which the robust fit bears,
ALONE = 4.5  # unless it is that many standard deviations off the logarithms of the others' sizes
ENOUGH = 20  # postures that show how those spread
OUTLIERS_AT_MOST = 0.1  # of the postures

# What a correction is called (`corrections`)
KNOWN = 0.7  # share of its prior's width: a wider posterior tells nothing new
OFFSET = 1e-3  # rad or m: what a good zeroing leaves; beyond it an offset is a cause
OFFSET_SIGMAS = 3.0  # of the estimate and of a good zeroing together

# Causes at kinematic level (`kinematic_diagnosis`, `kinematic_scores`)
TOLERANCE = (1e-3, 5e-4)  # rad (or m), m: how well a good robot is zeroed and built, where a task does not say
TURN = 1e-3  # rad that a link may be turned where it may be shifted by as much as that
MOST_GEOMETRY = 16  # causes of the geometry
OF_ALPHA = 1 / 5  # share of the error rate of a task that geometry, effects, play and the rest may each spend
SETTLING = 6  # times that the rows are linearised anew about named geometry
LOSS_SIGMAS = 1.0  # standard errors by which left-out postures must be worse without a named geometry
TOLD = 3.0  # logarithm of the odds (20 to 1) by which a correction of the geometry is told from another, or from none
FAR_OFF = 2.5  # tolerances by which all links are off where a name must be the best of all that there are
SIZE_SIGMAS = 3.0  # standard deviations from zero of some amplitude of a named effect, which is one of hundreds
LEAST_PLAY = 0.1  # of an offset's tolerance, by which a joint that plays at random must vary for it to be told
NOISY = 1.5  # times the device's stated accuracy: the rest is no noise
WAVE = 1e-2  # chance that noise alone gives the largest wave of any joint, for it to be looked at
