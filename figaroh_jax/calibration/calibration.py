r"""Calibration: from postures and what a device measured at each to a robot model that predicts new postures.

The level (frames of the device, joint offsets, full geometry) and the effects on top of it are chosen by held-out
postures; so is what is reported (`levels`). Outlier postures are named and left out first.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..effects.kinematic import HISTORY
from ..errors import InputError, check_each, check_kind, check_switch, nearest
from ..estimation import marginal
from ..estimation.gravity import without_far_masses
from ..estimation.posegroups import Measured, assemble, postures_of
from ..estimation.posesolver import Solution, solve
from ..formats.taskfile import check_effects
from ..recordings.poses import PoseRecording, read_pose_recordings
from ..recordings.posture_checks import check_pose_recordings, spread_of
from ..results import Name, Nearest
from ..rigid.chain import chain_between
from ..rigid.model import RobotModel
from . import corrections, levels, thresholds
from .calibrated import Calibration, Error, Outlier
from .candidates import Block, blocks_of, effects_on, empty_columns, geometry_columns, known_frames
from .changes import Change, find_change, frames_told, own_zero, with_own_frames
from .distances import socket_distances
from .kinematic_scores import Tested, row_noise, score_blocks, score_waves
from .outliers import find_outliers
from .shapes import refine

if TYPE_CHECKING:
    from ..formats.config import Task

__all__ = ["Run", "calibrate", "calibrate_task"]


def calibrate_task(
    task: Task,
    progress: Callable[[str, float], None] = lambda phase, share: None,
    *,
    level: str | None = None,
    priors: bool = True,
) -> Calibration:
    """Calibrate the robot of a task from its recordings with a `measurement`; `level`, `priors`: see `calibrate`.

    >>> import pathlib, tempfile, numpy as np, figaroh_jax as fj
    >>> robot, q = fj.load_urdf(fj.DEMO), np.random.default_rng(0).uniform(-1.4, 1.4, (30, 4))
    >>> seen = np.asarray(fj.frame_placement(robot, q + [0.0, 0.02, 0.0, 0.0], "hand"))[:, :3] @ [0.05, 0.02, 0.03, 1.0]
    >>> keys = "{position: seen, base_frame: base, tool_frame: hand, unknown: [base_frame, tool_frame]}"
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.savez(f"{folder}/run.npz", q=q, seen=seen)
    ...     data = f"data: [{{file: run.npz, position: q, measurement: {keys}}}]"
    ...     _ = pathlib.Path(folder, "task.yaml").write_text(f"robot: {{model: {fj.DEMO}}}\\n{data}")
    ...     found = fj.calibrate_task(fj.load_task(f"{folder}/task.yaml"), level="joint_offset")
    >>> round(found.solution.parameters["joint_offset shoulder"].value, 4)
    0.02
    """
    from ..formats.robotfile import impossible_said, load_robot

    model = load_robot(task, kinematic=True)
    recordings = read_pose_recordings(task, model)
    notes = (*impossible_said(task.robot.model), *check_pose_recordings(task, model, recordings))
    found = _calibrated(model, recordings, task.diagnose.forbid, progress, level, priors)
    return replace(found, posture=dict(task.robot.posture), notes=(*notes, *found.notes))


def calibrate(
    model: RobotModel,
    recordings: Sequence[PoseRecording],
    *,
    forbid: Sequence[str] = (),
    level: str | None = None,
    priors: bool = True,
    progress: Callable[[str, float], None] = lambda phase, share: None,
) -> Calibration:
    """The calibrated robot; raises `InputError` where there are too few postures or a frame does not move.

    Level and effects are those that predict best. `level` ("frames", "joint_offset" or "full") asks for one in their
    place, and for no effects: it is fitted, and the notes say so where it predicts worse than the frames alone. Without
    `priors` its identifiable parameters are fitted by plain least squares.

    >>> import numpy as np, figaroh_jax as fj
    >>> robot = fj.load_urdf(fj.DEMO)
    >>> q = np.random.default_rng(0).uniform(-1.4, 1.4, (30, robot.nv))
    >>> seen = np.asarray(fj.frame_placement(robot, q + [0.0, 0.02, 0.0, 0.0], "hand")) @ [0.05, 0.02, 0.03, 1.0]
    >>> run = fj.postures(q=q, position=seen[:, :3], base_frame="base", tool_frame="hand")
    >>> found = fj.calibrate(robot, [run], level="joint_offset")
    >>> round(found.solution.parameters["joint_offset shoulder"].value, 4)
    0.02
    """
    check_kind("model", model, RobotModel, "load_urdf reads one; an ExtendedModel holds one as `.robot`")
    check_each("recordings", recordings, PoseRecording, "`postures` makes one of arrays")
    if not len(recordings):
        raise InputError("recordings is empty: there is nothing to calibrate by")
    check_effects("forbid", forbid)
    notes = check_pose_recordings(None, model, recordings)
    found = _calibrated(model, recordings, forbid, progress, level, priors)
    return replace(found, notes=(*notes, *found.notes))


def _calibrated(
    model: RobotModel,
    recordings: Sequence[PoseRecording],
    forbid: Sequence[str],
    progress: Callable[[str, float], None],
    level: str | None,
    priors: bool,
) -> Calibration:
    """`calibrate` of recordings that were checked."""
    if level is not None and level not in levels.LEVELS:
        raise InputError(f"no level '{level}' of calibration{nearest(level, levels.LEVELS)}")
    check_switch("priors", priors)
    with jax.enable_x64(True):
        return Run(model, recordings, forbid, progress, level, priors).finish()


class Run:
    """One calibration, step by step; `finish` does them all, and what it found on the way stays readable."""

    outliers: tuple[Outlier, ...]
    aside: tuple[int, ...]  # the outliers' postures
    used: Bool[np.ndarray, " rows"]
    blocks: tuple[Block, ...]
    effects: levels.Effects | None
    choice: levels.Choice
    folds: list[levels.Fold]
    named: list[int]
    extension: list[Block]  # the named effects as they are fitted
    history: bool  # whether an error that depends on the posture before was found and has no name
    unsure: list[Nearest]  # effects that predict better and are not named
    changes: list[Change]  # between recordings, that have unknowns of their own
    unlike: Change | None  # what looks most like a change that has none
    fit: tuple[Measured, marginal.Linear, marginal.Posterior, Solution]

    def __init__(
        self,
        model: RobotModel,
        recordings: Sequence[PoseRecording],
        forbid: Sequence[str],
        progress: Callable[[str, float], None],
        level: str | None = None,
        priors: bool = True,
        alpha: float = 0.05,
    ) -> None:
        self.alpha = alpha
        self.model, self.recordings, self.forbid, self.progress = model, tuple(recordings), tuple(forbid), progress
        self.level, self.priors = level, priors
        progress("reading the postures", 0.02)
        weighing, notes = without_far_masses(model)
        self.weighing = weighing
        self.postures = postures_of(weighing, self.recordings)
        self.chain = _chain(model, self.recordings)
        geometry = geometry_columns(model, self.chain)
        self.measured = assemble(weighing, self.recordings, self.postures, geometry, [1e-3] * len(geometry))
        if not priors:
            geometry = corrections.identifiable(self.measured)
            self.measured = assemble(weighing, self.recordings, self.postures, geometry, [1e-3] * len(geometry))
            self.measured = self.measured._replace(plain=True)
        _enough(self.measured, self.recordings)
        self.notes = [*notes, *(note for r in self.recordings for note in r.notes), *_few(self.recordings)]

    def finish(self) -> Calibration:
        """Outliers, level, effects, validation, and the final fit."""
        measured = self.measured
        everything = measured.fitted
        self.progress("choosing among levels", 0.05)
        frames = known_frames(self.model, self.chain, self.recordings)
        self.blocks = blocks_of(self.weighing, self.chain, self.postures, self.forbid, frames)
        extending = bool(self.blocks) and self.level is None and self.priors
        self.effects = effects_on(self.model, self.postures, measured, self.blocks) if extending else None
        choice = levels.choose(measured, everything, self.effects, self.level)
        choice = self._apart(choice)
        measured = self.measured
        everything = measured.fitted
        wide = self._wide(choice)  # with its effects: what they explain is no outlier
        sizes = find_outliers(wide, everything, levels.free_at(choice.level, wide.prior))
        self.outliers = tuple(
            Outlier(str(self.recordings[measured.recording[k]].file.name), int(measured.row[k]), size)
            for k, size in sizes.items()
        )
        self.aside = tuple(sizes)
        self.used = everything & ~np.isin(measured.posture, list(sizes))
        if sizes:
            choice = levels.choose(measured, self.used, self.effects, self.level)
        # of frames alone that were chosen by all rows a fold is one too
        self.choice, self.folds = choice, self._validated("frames" if choice.level == "frames" else self.level)
        if choice.level != "frames" and not _better(self.folds, "plain", self.folds, "frames"):
            if self.level is None:
                self._or_frames_alone()
            else:
                self.notes.append(f"the requested level {self.level} predicts no better than the frames alone")
        self._name()
        alone = self.level is None and self.choice.level != "frames" and not self.named
        if alone and not _better(self.folds, "plain", self.folds, "frames"):  # what it predicted by has no name
            self.choice, self.folds = self._frames_alone()
            self.__dict__.pop("p_effects", None)
            self._name()
        if self.history:
            self.notes.append("the error of a posture depends on the one before it in a way that no effect explains")
        return self._result()

    def _apart(self, choice: levels.Choice) -> levels.Choice:
        """The choice again, after each change between recordings that is found has unknowns of its own."""
        self.changes, self.unlike = [], None
        while self.effects is not None and len(self.changes) < thresholds.CHANGES:
            wide = self._wide(choice._replace(level="full"))
            grid = range(self.effects.grid)
            Z = self.effects.jacobian(choice.fits["full"][0].at, grid)
            blocks = [(self.blocks[k].name, Z[:, s]) for k, s in self.effects.slices(grid).items()]
            chance = thresholds.OF_ALPHA * self.alpha
            change = find_change(self.measured, self.recordings, wide, self.measured.fitted, blocks, chance)
            if change is None:
                return choice
            if change.name is not None and change.name.effect != "joint_offset":
                self.unlike = change
                return choice
            self.changes.append(change)
            self._take_apart(change)
            choice = levels.choose(self.measured, self.measured.fitted, self.effects, self.level)
        return choice

    def _take_apart(self, change: Change) -> None:
        """Give a recording frames of its own, or a joint another zero in it."""
        columns = list(self.measured.columns)
        if change.name is None:
            self.recordings = with_own_frames(self.recordings, change.recording)
        else:
            own = next(c for c in columns if (c.effect, c.at) == change.name)
            columns.append(own_zero(own, self.postures[change.recording], self.recordings[change.recording].name))
        self.measured = assemble(self.weighing, self.recordings, self.postures, columns, [1e-3] * len(columns))
        self.effects = effects_on(self.model, self.postures, self.measured, self.blocks)

    def _changes_told(self, final: Measured, at: Float[np.ndarray, " unknowns"]) -> list[str]:
        """Notes on what was not the same in all recordings."""
        frames, told = corrections.frames_of(final, at), []
        for change in self.changes:
            name = self.recordings[change.recording].name
            if change.name is None:
                told.append(frames_told(self.recordings, change.recording, frames))
            else:
                told.append(f"the recordings differ: {change.name.at[0]} has another zero in {name} than in the others")
        if self.unlike is not None:
            name, least = self.recordings[self.unlike.recording].name, self.unlike.name
            told.append(
                f"the recordings differ: {name} errs in a way that the others do not, most like {least}; diagnose each"
                " alone"
            )
        return told

    def _name(self) -> None:
        """The effects that the folds find again and that are sure, fitted beside the level."""
        recurring = _recurring(self.choice, self.folds, self.blocks)
        self.named = [k for k in recurring if self.blocks[k].effect is not HISTORY]
        self.history = len(self.named) < len(recurring)
        self.progress("fitting", 0.85)
        self._name_the_sure()

    def _name_the_sure(self) -> None:
        """Leave out effects whose gain noise alone may bring, or whose size may be zero, and fit the others."""
        plain, chosen = (levels.pooled([getattr(f, which) for f in self.folds]) for which in ("plain", "chosen"))
        shares = [1.0 - b / a for a, b in zip(plain, chosen, strict=True) if np.isfinite(a) and a > 0.0]
        share = max(shares[0], 0.0) if shares else 0.0
        self.unsure = []
        if self.named and self.p_effects > thresholds.OF_ALPHA * self.alpha:
            names = dict.fromkeys(self.blocks[k].name for k in self.named)
            self.unsure = [Nearest(name, share, "noise alone brings such a gain") for name in names]
            self.named = []
        while True:
            self.extension = self._refined()
            self.fit = self._fit(self.choice.level, self.extension)
            small = self._smallest()
            if small is None:
                return
            self.unsure.append(Nearest(small, share, "its size may be zero"))
            self.named = [k for k in self.named if self.blocks[k].name != small]

    def _smallest(self) -> Name | None:
        """The fitted effect that is nearest to none, where that may be."""
        final, linear, posterior, _ = self.fit
        place = {column.label: k for k, column in enumerate(final.columns)}
        sigma = np.sqrt(np.diag(marginal.honest_covariance(posterior, linear.prior)))
        sizes = {}
        for block in self.extension:
            own = [place[column.label] for column in block.columns]
            sizes[block.name] = float(np.max(np.abs(linear.at[own]) / sigma[own]))
        least = min(sizes, key=lambda name: sizes[name], default=None)
        return least if least is not None and sizes[least] <= thresholds.SIZE_SIGMAS else None

    @cached_property
    def p_effects(self) -> float:
        """p-value of the largest score of an effect beside the level; of what may be named also beside all links."""
        level = self.choice.level
        found = self.p_value(self.choice.fits[level], level)
        if self.named and level != "full":  # few postures may not tell links that are all a little off
            found = max(found, self.p_value(self.choice.fits["full"], "full"))
        return found

    def p_value(self, fit: tuple[marginal.Linear, marginal.Posterior], level: str, named: Sequence[int] = ()) -> float:
        """p-value of the largest score of an effect that is not `named` beside a fit."""
        if self.effects is None:
            return 1.0
        linear, posterior = fit
        columns = len(self.measured.columns)  # behind them those of effects, then the devices'
        extra = len(linear.at) - columns - len(self.measured.own)
        at = np.concatenate([linear.at[:columns], linear.at[columns + extra :]])
        grid = range(self.effects.grid)
        Z = self.effects.jacobian(at, grid)
        blocks = [Z[:, s] for k, s in self.effects.slices(grid).items() if k not in named]
        free = levels.free_at(level, linear.prior)
        tested = Tested(linear, row_noise(linear, posterior), self.used, posterior.precision, free)
        p_grid, p_high = score_blocks(tested, blocks).p_value, score_waves(tested, self.effects.waves(at))
        return min(p_grid, p_high) if p_high == 1.0 else min(1.0, 2.0 * min(p_grid, p_high))

    def _or_frames_alone(self) -> None:
        """Frames and their own effects, but for effects that predict better beside the level that was chosen."""
        alone = self._frames_alone()
        if not (self.choice.effects and _better(self.folds, "chosen", alone[1], "chosen")):
            self.choice, self.folds = alone

    def _frames_alone(self) -> tuple[levels.Choice, list[levels.Fold]]:
        return levels.choose(self.measured, self.used, self.effects, "frames"), self._validated("frames")

    def _validated(self, level: str | None) -> list[levels.Fold]:
        """The outer folds, each with its own choice, or of its own effects beside the given level."""
        progress = lambda share: self.progress("validating", 0.3 + 0.5 * share)  # noqa: E731
        return levels.nested(self.measured, self.used, self.effects, self._extended, level, progress)

    def _extended(self, choice: levels.Choice, rows: Bool[np.ndarray, " rows"]) -> Float[np.ndarray, " rows"]:
        """Residual of all rows for a choice with its effects fitted to `rows`, to first order about its level's fit."""
        wide = self._wide(choice)
        found = marginal.fit(wide, rows, levels.free_at(choice.level, wide.prior), robust=True)
        return wide.residual + wide.jacobian @ (found.unknowns - wide.at)

    def _wide(self, choice: levels.Choice) -> marginal.Linear:
        """The rows at the fit of the choice's level, with the columns of its effects behind the others."""
        linear = choice.linear
        if self.effects is None or not choice.effects:
            return linear
        return levels.widened(linear, self.effects.jacobian(linear.at, choice.effects))

    def _refined(self) -> list[Block]:
        """The named effects, each once, with the best value of their shapes."""
        if not self.named:
            return []
        fit = self.choice.fits[self.choice.level]
        rows = self.used, levels.free_at(self.choice.level, fit[0].prior)
        named = [self.blocks[k] for k in self.named]
        return refine(self.model, self.postures, self.measured, fit, rows, named)

    def _fit(self, level: str, blocks: Sequence[Block]):
        """The level with its effects, exactly; then Levenberg-Marquardt from several starts at those weights."""
        columns = [*self.measured.columns, *(c for b in blocks for c in b.columns)]
        columns += empty_columns(self.chain[0], [c for b in blocks for c in b.columns])
        sizes = np.full(len(columns), 1e-3)
        sizes[len(self.measured.columns) :][: sum(len(b.sizes) for b in blocks)] = [s for b in blocks for s in b.sizes]
        measured = assemble(self.weighing, self.recordings, self.postures, columns, list(sizes))
        measured = measured._replace(plain=not self.priors)
        linear, posterior = levels.fit_level(measured, self.used, level)
        free = levels.free_at(level, linear.prior)
        solution = _polish(measured, linear, posterior, self.used, free)
        return measured, levels.linearise(measured, solution.unknowns), posterior, solution

    def _result(self) -> Calibration:
        final, linear, posterior, solution = self.fit
        self.notes += self._changes_told(final, linear.at)
        level, free = self.choice.level, levels.free_at(self.choice.level, linear.prior)
        frames = self.choice.fits["frames"][0].residual
        gauge, order = corrections.gauge_of(final, linear, self.used, free)
        parameters = corrections.parameters_of(final, linear, posterior, gauge, order)
        table = _table(self.folds, bool(self.named))
        position, orientation, scheme = self._errors(final, frames, linear.residual, table)
        causes = corrections.causes_of(parameters, level, self.extension, self.blocks, table, self.folds)
        rivals = self._rivals()
        causes = tuple(replace(c, ambiguous_with=rivals.get(c.name, ())) for c in causes)
        twists = corrections.twists_of(self.model, final, linear.at)
        names = [c.label for c in final.columns] + [name for name, _ in final.own]
        found = corrections.solution_of(
            self.model, self.recordings, final, linear, posterior, solution, self.used, free, self.extension
        )
        if found.failure:
            self.notes.append(f"{found.failure}: do not trust these values")
        return Calibration(
            solution=found,
            level=level,
            twists=twists,
            frames=corrections.frames_of(final, linear.at),
            parameters=parameters,
            correlations=corrections.correlations_of(final, posterior, parameters),
            position=position,
            orientation=orientation,
            outliers=self.outliers,
            verdict="named" if causes or self.outliers else "nothing",
            causes=(*(corrections.outlier_cause(o) for o in self.outliers), *causes),
            table=table,
            classes=tuple(tuple(names[order[k]] for k in c) for c in gauge.classes),
            rank=gauge.rank,
            condition=gauge.condition,
            noise=(float(posterior.noise[0]), float(posterior.noise[1])),
            scheme=scheme,
            notes=tuple(self.notes),
            unexplained=_unexplained(position, self.recordings),
            distances=socket_distances(
                self.recordings, (self.measured, self.choice.fits["frames"][0]), (final, linear)
            ),
            points=corrections.shown_of(final, self.recordings, frames, linear.residual),
        )

    def _rivals(self) -> dict[Name, tuple[Name, ...]]:
        """Of each effect that joined what gained nearly as much in its place."""
        found = {}
        for k, others in zip(self.choice.effects, self.choice.rivals, strict=True):
            own = self.blocks[k].name
            names = (self.blocks[j].name for j in others if self.blocks[j].effect is not HISTORY)
            found[own] = tuple(dict.fromkeys(name for name in names if name != own))
        return found

    def _errors(
        self, final: Measured, frames: np.ndarray, after: np.ndarray, table: dict[str, tuple[float, float]]
    ) -> tuple[Error | None, Error | None, str]:
        """Errors of position (mm) and orientation (deg) on fitted and on held-out postures, and how those were held."""
        kept, held = np.unique(final.posture[self.used & (final.posture >= 0)]), np.flatnonzero(final.holdout)
        fitted = [levels.errors(final, residual, kept) for residual in (frames, after)]
        if len(held):
            new = [levels.errors(final, corrections.centred(final, x), held) for x in (frames, after)]
            validated = [(levels.rms(a), levels.rms(b)) for a, b in zip(*new, strict=True)]
            scheme = "recordings with role: holdout"
        else:
            validated = list(zip(table["frames"], table["chosen"], strict=True))
            scheme = f"{thresholds.FOLDS} folds of every fifth posture; level and effects are selected within each fold"
        both: list[Error | None] = [None, None]
        for c, (unit, scale) in enumerate((("mm", 1e3), ("deg", 180.0 / np.pi))):
            if len(fitted[0][c]):
                sizes = levels.rms(fitted[0][c]), levels.rms(fitted[1][c]), *validated[c]
                both[c] = Error(unit, *(scale * size for size in sizes))
        return both[0], both[1], scheme


def _chain(model: RobotModel, recordings: Sequence[PoseRecording]) -> list[int]:
    """Joints that move any of the measured frames against its base, in tree order."""
    return sorted({j for r in recordings for j in chain_between(model, r.base_frame, r.tool_frame).joints})


def _enough(measured: Measured, recordings: Sequence[PoseRecording]) -> None:
    used = measured.fitted
    rows, unknowns = int(used.sum()), len(measured.own)
    postures = len(np.unique(measured.posture[used & (measured.posture >= 0)]))
    if rows <= unknowns or postures < thresholds.FOLDS:
        names = ", ".join(str(r.file.name) for r in recordings if r.role == "fit")
        raise InputError(
            f"{names}: {postures} measured postures give {rows} numbers for {unknowns} unknowns of the frames alone;"
            f" measure at least {max(thresholds.FOLDS, unknowns // 2)} postures, better 30 or more"
        )


def _unexplained(position: Error | None, recordings: Sequence[PoseRecording]) -> float | None:
    """Held-out error of position over the spread of the points, where every recording measures points."""
    spreads = [spread_of(r) for r in recordings]
    known = [spread for spread in spreads if spread]
    if position is None or len(known) < len(spreads) or not np.isfinite(position.validated_after):
        return None
    return 1e-3 * position.validated_after / float(np.sqrt(np.mean(np.square(known))))


def _few(recordings: Sequence[PoseRecording]) -> list[str]:
    fitted = [r for r in recordings if r.role == "fit"]
    if all(r.kind == "socket" for r in fitted) and len(fitted) == 1:
        return [
            "the sockets were at one position of the workspace only: that is too few, the calibrated robot may be right"
            " there and wrong elsewhere; measure at two positions or more"
        ]
    return []


def _recurring(choice: levels.Choice, folds: Sequence[levels.Fold], blocks: Sequence[Block]) -> list[int]:
    """Effects of the choice that most outer folds choose too, or a rival of theirs, if all gain on the outer folds."""
    plain, chosen = (levels.pooled([getattr(f, which) for f in folds]) for which in ("plain", "chosen"))
    gains = [1.0 - c / p for p, c in zip(plain, chosen, strict=True) if np.isfinite(p) and p > 0.0]
    if not gains or np.mean(gains) < thresholds.OUTER_GAIN:
        return []
    # a fold that takes one which it does not tell apart chooses the other too
    places = [[blocks[k] for k in (*f.choice.effects, *sum(f.choice.rivals, ()))] for f in folds]
    return [
        k
        for k in choice.effects
        if sum(any(map(blocks[k].near, place)) for place in places) >= thresholds.FOLDS_THAT_CHOOSE
    ]


def _better(folds: Sequence[levels.Fold], one: str, others: Sequence[levels.Fold], other: str) -> bool:
    """Whether what the outer folds have as `one` predicts them better than what others have as `other`.

    "plain" is the chosen level, "chosen" that with its effects; else the name of a level.
    """

    def of(folds: Sequence[levels.Fold], which: str) -> tuple[float, float]:
        found = [f.levels[which] if which in levels.LEVELS else getattr(f, which) for f in folds]
        return levels.pooled(found)

    ratio = [a / b for a, b in zip(of(folds, one), of(others, other), strict=True) if np.isfinite(b) and b > 0.0]
    return bool(ratio) and bool(np.mean(ratio) < 1.0)


def _table(folds: Sequence[levels.Fold], effects: bool) -> dict[str, tuple[float, float]]:
    """Error on the outer folds of every level, and of what was chosen inside each fold."""
    table = {level: levels.pooled([f.levels[level] for f in folds]) for level in levels.LEVELS}
    return table | {"chosen": levels.pooled([f.chosen if effects else f.plain for f in folds])}


def _polish(measured, linear, posterior, used, free) -> Solution:
    """Levenberg-Marquardt from the fit, from the closed-form start and from turned base frames; the least cost wins."""
    weight = np.where(linear.posture >= 0, posterior.weight[linear.posture], 1.0)
    rows = np.where(used, np.sqrt(weight) / posterior.noise[linear.channel], 0.0)
    precision = np.where(free, posterior.precision, 1.0)
    starts = [linear.at, np.zeros_like(linear.at)]
    turned = np.zeros_like(linear.at)
    for k, (name, _) in enumerate(measured.own):
        if name.startswith("base_frame r"):
            turned[len(measured.columns) + k] = 0.7 / np.asarray(measured.problem.scale)[len(measured.columns) + k]
    starts += [turned, -turned] if turned.any() else []
    found = [solve(measured.problem, rows, precision, free, start) for start in starts]
    return min(found, key=lambda solution: solution.cost)
