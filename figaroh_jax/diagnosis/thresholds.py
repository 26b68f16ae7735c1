"""Every number that decides what is named, and what it is compared with.

Squares are those of whitened rows (noise has one a row) unless a comment says otherwise; a gain is the share of squares
that is gone on data that was not fitted.
"""

from __future__ import annotations

__all__: list[str] = []

# Weights of rows by speed (`weights`)
REVERSAL = 0.25  # periods of the cutoff around a change of the velocity's sign in which a joint's rows are left out
REVERSALS_AT_MOST = 1 / 3  # of a joint's rows; a joint that mostly stands still keeps them
SPEED_EDGES = (0.0, 0.015, 0.03, 0.05, 0.08, 0.12, 0.2, 0.35, 1.0)  # of a joint's top speed: the bins
FAST = 0.12  # of a joint's top speed, from which its residual is the measure of slower rows
LOW_SPEEDS = (0.04, 0.08, 0.16)  # of a joint's top speed: widths of friction that slow rows may follow
LEAST_FACTOR = 1.3  # of the mean square: a bin that is worse by less is as good as the fast ones
ROWS_OF_A_BIN = 15.0  # rows at which a bin's own factor and none are believed alike
WEIGHT_ROUNDS = 2  # of weights and spectrum in turn

# The noise and what the fit is weighted by (`floor`, `noise`)
LOWEST_RESOLVED = 2.0  # periods in a recording: below that frequency the spectrum of the noise is held constant
LOWEST_FREQUENCY = 0.02  # Hz, the same for long recordings
WHITE_GAIN = 0.02  # relative fall of the folds' error in N m from which rows are weighted by their residual alone
FEWER = (2.0, 4.0, 8.0, 16.0)  # rows of the answer's fit that may count as one beside what is believed of the links
MOST_OF_RESIDUAL = 0.5  # of a joint's residual (RMS): below, what was found there was most of it
PASSED_FOR_NOISE = 0.45  # of the RMS that noise was told: below, beside what was found, that had passed for noise
OF_ANOTHER_WIDTH = 0.9  # of a joint's residual: where it falls below, its friction reverses over another width
AS_WELL = 1.05  # times the error on held-out data: the answer with such weights anew may not predict worse

# The search (`contenders`, `gates`, `search`)
SHORTLIST = 8  # candidates compared exactly, of the whole robot
SHARE_OF_BEST = 0.35  # of the best rank: what another candidate needs, of the robot or of its own place
BEST_OF_A_PLACE = 2  # candidates compared exactly of each joint, pair or link
SHIFTS = 2  # candidates of a position sensor tried at a step for their own score: each is a fit of its own
GAIN = 0.01  # of the held-out squares of the joints where the cause acts
T_BETTER = 1.64  # t of the blocks: that the cause predicts better
T_ALIKE = 1.7  # t below which two causes predict alike
OVERLAP_SAME = 0.5  # overlap from which two causes explain the same misfit
T_APART = 3.0  # t from which data tell effects apart that are the same while the joint moves
OUTDONE = 0.1  # of the draws of the blocks: in fewer, a cause predicts best of those that could be named in its place
LIKE_ROUGHNESS = 2 / 3  # of what a gear that winds up takes: what a rough position must not take in its place
ROUGH = 0.45  # of the cutoff: a position that is taken down further is not
MOST_OF_A_GAIN = 2 / 3  # of what a body in its place gains: from here a joint's cause is not outdone by it
SHARE_ALIKE = 0.5  # share of the best's drop from which another cause explains much of the same
SMALLEST = 0.0005  # share of the first cause's drop below which a later one may be what the first left over
MOST_CAUSES = 16
SHARE_AGAIN = 1.2  # times its share of its joints' squares when it failed: from here a candidate is tried again
OVERLAP_ELSEWHERE = 0.2  # overlap up to which causes at other joints are taken in at once
SIZE_REGION = 0.95  # of the region of a cause's amplitudes that must not hold zero
SURE_DROP = 300.0  # squares that a cause removes from which no slow noise is asked whether it does as much
ALPHA_OF_A_NAME = 0.2  # of alpha: what a name needs, for p is not uniform under coloured noise

# Naming beside a rest (`naming`)
T_NAMED = 2.25  # t of the held-out squares of the cause's joints, of many blocks; of few as unlikely (Student)
GAIN_NAMED = 0.25  # gain there with all other causes in
GAIN_NAMED_ROBOT = 0.04  # the same of a cause that acts on the whole robot
MODULATION, MODULATION_ROBOT = 0.15, 0.3  # squares that an amplitude which varies gains, over those of the cause
MODULATION_HELD_OUT = 0.2  # the same on data that were not fitted
BY_CHANCE = 0.02  # p-value of what data kept out of the fit want of a cause: above, it is chance
BY_CHANCE_BESIDE = 0.01  # the same beside causes without a name
BY_CHANCE_UNSHOWN = 0.001  # the same where slices of the recordings that are fitted do not surely show it
HELD = (10.0, 100.0, 1e4, 1e8)  # times the stated precision of the links, with which they stay near where they are
RISES = 0.1  # p-value of a rise of the error of all rows kept out: below, the robot is predicted worse
KEPT_OF_CLAIM = 1 / 3  # of what a cause takes in slices: what must be left of it in such a fall
STANDS = SPEED_EDGES[1]  # of a joint's top speed: below, it stands, and its rows say nothing of a law of the motion
BUYS = 0.01  # of the squares that a law of the whole robot removes: what it may surely cost a joint that moves
LAW_LEAVES = 0.05  # of the squares that a cause removes: what may surely stay at its joints where no other has a misfit
ALL_BUT = 0.1  # of the squares that a cause removes: what smooth functions may still find where it is all there is, and
# what an amplitude that varies may surely gain
STANDS_OUT = 2.0  # times what most other joints have: squares at a cause's joints that count as a trace of its own
MARGIN = 4.0  # times what is needed, of t, gain and modulation together (each of them as much at the most)
FEWEST_ALIKE = 3  # other joints that have a part which every drive has: from here a joint's own need not take much
SHARE_NAMED = 0.02  # RMS torque of the cause over that of the joint
WEIGHTLESS = 2.0  # standard deviations below zero of what a link weighs with its cause: above, the cause is none
TURNED_DOWN = 0.05  # of its largest: what friction that a law bends may have lost at the joint's top speed
COUPLED = 2.0  # standard deviations of a part of a coupling (inertia, damping, friction), of which two must be there
LIKELY = 1.0  # of one of them, where another is surely there by the answer's own intervals: below, it is chance
NUMBER = 3.0  # standard deviations of a link's or a body's ten numbers, of which one must be there
MASS = 3.0  # standard deviations of a body's mass: below, what moves is the link that carries it
BESIDE_SMOOTH = 0.05  # gain of a cause of the whole robot beside smooth functions at every joint, or in their place

# Links that are well known (`believed`)
TRUSTED = 0.05  # stated trust in the inertials (relative) up to which the links move no further than that
IMPOSSIBLE = 3.0  # standard deviations below zero of a link's mass: no such body exists
BEYOND_ANY = 30.0  # times its stated one sigma that a fit moves a link's parameter: the recordings are of another robot
# (or unit); UR10e's moments move by 18, the other public sets' by 10
BEYOND_TRUST = 0.01  # p-value of the squares of their deviations: below, they are not as believed
GAIN_OF_A_LINK = 0.02  # of what all links gain on folds left out: what one more must gain, and up to which two do alike
AS_IF_GONE = 0.25  # of a body that the file fixes to a link: how far what is missing may be from all of it
SURELY = 2.0  # standard deviations of a link's number that is told
MOST_MOVED = 4  # links that are told to be others than the file says

# The rest (`rest`)
REST_P = 0.01  # p-value of a rest
LINE_P = 1e-3  # p-value of a line in the spectrum
REPEATED, REPEATED_SHARE = 0.08, 0.05  # excess that repeats: absolute, and as a share of the first excess
OF_REPEATED = 2.0  # times the squares that repeats have in common: what is louder than noise by more is of one alone
FITTED, FITTED_SHARE = 0.03, 0.03  # excess that a flexible model or the catalogue still scores on
UNREPEATED = 0.01  # the same where no recording repeats another
FOLLOWS = 0.5  # of the squares that a joint leaves: what a product of two joints' motion predicts is no slow noise
T_REST = 2.3  # t of the blocks: that smooth functions predict the rest on data they were not fitted to
LEAST_BEYOND = 0.05  # times the noise power: below, nothing is said of what a joint's rest goes with
LEAST_SHARE = 0.05  # of the power beyond the noise: a dependence that is told
FEW_CAUSES = 3  # found together: beyond, the model is wrong in more ways than one, and a stand-in more likely
NO_REST = 0.15  # excess over the noise up to which a cause need only be there to be named
FOR_SURE = 3  # times FEW_CAUSES: of so many that a search finds, more than a few are left in one fit
WEIGHED_ALIKE = 0.3  # of its gain, that a cause of a joint keeps where each joint counts by what it leaves
BY_PLACE = 1.0  # of what a wave over the position has removed: where a table of it takes more, there is no such wave
OWN_SHARE = 0.03  # of what a cause has removed: a rest at its own place that speaks against its law
STANDSTILL = 0.08  # of a joint's top speed: rows at and around rest
CARRIED = 1.0  # periods of the cutoff to which the row filter carries a stick
LEAST_MOVING = 0.25  # of a joint's rows that must be far from rest, or they say nothing of how it moves
ENOUGH_MOVING = 40  # independent rows far from rest that say enough, however long the joint stands
LAW_WIDTHS = (0.04, 0.08)  # of a joint's top speed: friction of low speed that is looked for at rest
LAW_AT_REST = 0.3  # of the squares at rest that it predicts: from there a law is missing, it is no stick
