"""A task file drafted from a robot and recordings as they are: what each column is, in which unit, of which joint.

Names decide first; limits, gravity and friction check what the names say, and decide what they leave open where they
can. What stays open is refused, what was assumed is said in the draft's comments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError, nearest
from ..formats.config import RecordingEntry
from ..formats.robotfile import read_robot
from ..rigid.model import DOF_NAMES, RobotModel, prismatic
from .checks import DEGREE, Finding, check_recording, position_findings
from .dataset import Driven, Recording
from .draft_columns import Columns, Undecided, read_columns, read_tables, without_sign
from .draft_postures import draft_postures, looks_measured
from .draft_text import baseline_said, clock_said, locked_said, task_text, unit_said
from .likeness import FEWEST, Sampled, likeness, rigid_torque, sampled
from .torque_checks import TURNED_POSITION

__all__ = ["Draft", "Undecided", "draft_task"]

SMALL = 0.12  # rad: a motion within 7 degrees in all fits any limits, for it is one in rad, read as degrees
CONFIRMED = 0.5  # of a torque's variance that its own joint explains, before it says anything of the order


class Draft(NamedTuple):
    """The text of a task file, and what was assumed, one line each."""

    text: str
    assumed: tuple[str, ...]


def draft_task(
    model: Path,
    files: Sequence[Path],
    *,
    joints: Sequence[str] | None = None,
    rate: float | None = None,
    constants: Sequence[float] | None = None,
    unit: str | None = None,
    topic: str | None = None,
    gains: Sequence[float] | None = None,
    gears: Sequence[float] | None = None,
    drives: Callable[[Sequence[str]], Sequence[Driven]] = lambda joints: (),
    folder: Path | None = None,
    passive: Sequence[str] = (),
) -> Draft:
    """A task for `diagnose` and `identify` on these recordings; `joints` names their columns, `rate` (Hz) their clock.

    `constants` are N m a unit of each torque column, `gears` motor turns a joint turn where positions are those of
    motors, `gains` the proportional gains of the position servos (N m/rad), all in the order of the joints; `unit`
    (rad, deg, m, mm) is that of the positions, `topic` that of bags, `passive` are joints that nothing drives. `drives`
    tells the drives in the model's file of the joints that move; `gains` replace them. `folder` is where the task will
    lie: files in it are named from there.

    Raises `InputError` for what cannot be read, and `Undecided` for what the data do not decide.
    """
    whole = read_robot(model, kinematic=True)  # torques refuse below what postures do without
    for option, given in (("--joints", joints or ()), ("--passive", passive)):
        for name in given:
            if name not in whole.joint_names:
                hint = nearest(name, whole.joint_names)
                raise InputError(f"{option}: robot '{whole.name}' has no joint '{name}'{hint}")
            if list(given).count(name) > 1:
                raise InputError(f"{option}: '{name}' is named twice")
    tables = read_tables(files, topic)
    first = next(tables, None)
    if first is None:
        raise InputError("no recordings given")
    if "format" not in first[1] and looks_measured(first[0], whole):
        return Draft(*draft_postures(model, whole, [first[0], *(table for table, _ in tables)], joints, unit, folder))
    own = drives if gains is None else lambda joints: ()
    reads = read_columns(chain([first], tables), whole, joints, rate, own, passive)
    if len({read.joints for read in reads}) > 1:
        raise InputError("the recordings hold different joints; draft a task for each kind")
    robot = read_robot(model, reads[0].joints)
    many = [joint.name for joint in robot.joints if len(DOF_NAMES[joint.kind]) > 1]
    if many:
        raise InputError(
            f"{model}: joint{'s' * (len(many) > 1)} {', '.join(many)} of several degrees of freedom: `new` drafts for"
            " joints of one; lock them (--joints names the others), or write the task by hand"
        )
    assumed = [*dict.fromkeys(clock_said(reads))]
    _doubt_percent(reads, unit)
    if constants is not None and passive and len(constants) == robot.nv - len(passive):
        of_driven = iter(constants)
        constants = [1.0 if name in passive else next(of_driven) for name in robot.dof_names]
    for option, given in (("--constants", constants), ("--gears", gears)):
        _check_factors(option, given, robot)
    if len({tuple(one.joint for one in read.driven) for read in reads}) > 1:
        raise InputError("the recordings hold commands of different joints; draft a task for each kind")
    reads, motors = _joint_side(robot, reads, gears)
    stated, unit = unit is not None, _unit_of_position(robot, reads) if unit is None else _stated_unit(robot, unit)
    factor = np.where(np.array(prismatic(robot)), {"deg": 1.0, "mm": 1e-3}.get(unit, 1.0), _degrees(unit))
    reads = [_scaled(read, factor) for read in reads]
    reads, passives = _undriven(robot, reads, passive)
    signs, said = _torques(robot, reads) if constants is None else ([*constants], ["torque constants as given"])
    if constants is None and signs is not None:
        _refuse_turned_positions(robot, reads, gears)
    actuator, more = _drives(model, robot, reads, gains)
    said += more
    said += [*passives, *_refuse_what_is_wrong(robot, reads, signs, passive, stated=constants is not None)]
    labels = _repeats(reads)
    assumed += [*locked_said(robot, whole), *motors, unit_said(unit, robot, reads, stated)]
    assumed += [*said, *_repeats_said(reads, labels), baseline_said(reads)]
    listed = joints is not None
    text = task_text(model, robot, whole, reads, unit, signs, labels, assumed, actuator, gears, listed, folder)
    return Draft(text, tuple(assumed))


def _scaled(read: Columns, factor: Float[np.ndarray, " joints"]) -> Columns:
    """Positions, and commands that are positions or velocities, times a factor for each joint."""
    command = read.command
    if command is not None:
        moves = np.array([one.command != "torque" for one in read.driven])
        command = command * np.where(moves, factor[[read.joints.index(one.joint) for one in read.driven]], 1.0)
    return read._replace(position=read.position * factor, command=command)


def _degrees(unit: str) -> float:
    return DEGREE if unit == "deg" else 1.0


# What the values say


def _joint_side(
    robot: RobotModel, reads: Sequence[Columns], gears: Sequence[float] | None
) -> tuple[list[Columns], list[str]]:
    """Positions of the joints where the columns are those of motors, and what is not known of them then."""
    names = ", ".join(robot.dof_names)
    if gears is None:
        motor = next((read for read in reads if read.motor), None)
        if motor is not None:
            raise Undecided(
                "gears",
                f"{motor.file}: the position columns are named after motors: give --gears, motor turns per joint turn"
                f" with their signs, in the order {names} (1 where a column is on the joint side already)",
            )
        return [*reads], []
    return [_scaled(read, 1 / np.asarray(gears)) for read in reads], [
        f"gears as given; order, sign and unit of {names} are taken as they are, and nothing confirms that joints are"
        " uncoupled and share the model's zeros: see transmission.position and transmission.offset"
    ]


def _check_factors(option: str, given: Sequence[float] | None, robot: RobotModel) -> None:
    names = ", ".join(robot.dof_names)
    if given is not None and len(given) != robot.nv:
        raise InputError(f"{option}: {len(given)} numbers, expected one for each of {names}")
    if given is not None and not (np.isfinite(given).all() and np.all(given)):
        raise InputError(f"{option}: expected finite numbers other than zero for {names}")


def _stated_unit(robot: RobotModel, unit: str) -> str:
    """The unit that the user states, as the task says it; rad and m are the same there."""
    straight = prismatic(robot)
    if (unit in ("m", "mm") and not any(straight)) or (unit in ("rad", "deg") and all(straight)):
        kind, right = ("slides", "m or mm") if all(straight) else ("turns", "rad or deg")
        raise InputError(f"--unit {unit}: every joint of '{robot.name}' {kind}; expected {right}")
    return "rad" if unit == "m" else unit


def _unit_of_position(robot: RobotModel, reads: Sequence[Columns]) -> str:
    """rad or deg (m or mm) that fits the model's limits and, where both do, the torque."""
    every = np.concatenate([read.position for read in reads])
    straight = np.array(prismatic(robot))
    wide = {"rad": every, "deg": every * np.where(straight, 1.0, DEGREE), "mm": every * np.where(straight, 1e-3, 1.0)}
    kinds = ["rad", *(["deg"] if not straight.all() else []), *(["mm"] if straight.all() else [])]
    ends = np.cumsum([len(read.position) for read in reads])[:-1]

    def doubts(one: np.ndarray) -> list[Finding]:
        parts = zip(np.split(one, ends), reads, strict=True)
        return [finding for part, read in parts for finding in position_findings(part, robot, "rad", read.time)]

    fits = [u for u in kinds if not doubts(wide[u])]
    if fits == ["deg"]:
        _doubt_small_degrees(reads[0].file, np.ptp(wide["deg"][:, ~straight], axis=0), doubts(every))
    if len(fits) == 1:
        return fits[0]
    if not fits:
        text = "; ".join(dict.fromkeys(finding.text for finding in doubts(every)))
        raise InputError(f"{reads[0].file}: in no unit do the positions fit the model: {text}")
    with_torque = [read for read in reads if read.torque is not None]
    misfit = {unit: float(np.mean([_unlike(robot, read, unit) for read in with_torque] or [0.0])) for unit in fits}
    best, other = sorted(fits, key=misfit.__getitem__)[:2]
    span = float(np.ptp(every, axis=0).max())
    held = np.isfinite(np.ptp(np.asarray(robot.position_limit), axis=1))  # what has no limits may turn for ever
    if misfit[best] < 0.7 * misfit[other] or (best == "rad" and span < 2 * np.pi and misfit[best] <= misfit[other]):
        return best
    if held.any() and np.ptp(every[:, held], axis=0).max() > 20:
        return "deg"
    raise Undecided(
        "unit",
        f"{reads[0].file}: positions span {span:.3g}: rad or degrees? Neither limits nor torque decide; give --unit",
    )


def _doubt_small_degrees(file: Path, span: Float[np.ndarray, " turning"], as_rad: Sequence[Finding]) -> None:
    """Positions that are possible as rad, but outside a limit, are no degrees because those fit every limit."""
    if not any(finding.wrong for finding in as_rad) and span.max() < SMALL:
        raise Undecided(
            "unit",
            f"{file}: rad or degrees? In rad, {'; '.join(dict.fromkeys(finding.text for finding in as_rad))} In degrees"
            f" no joint moves by more than {span.max() / DEGREE:.3g} degrees. Correct the columns, or give --unit",
        )


def _doubt_percent(reads: Sequence[Columns], unit: str | None) -> None:
    """LeRobot may keep positions as degrees or as a share of the range of motion, -100 to 100, which look alike."""
    for read in reads if unit is None else ():
        span = np.abs(read.position).max()
        if "episode" in read.entry and 7.0 < span <= 101.0:
            raise Undecided(
                "unit",
                f"{read.file}: positions reach {span:.3g}: LeRobot keeps degrees or, by default, a share of the range"
                " of motion (-100 to 100), which no file confirms; give --unit deg where they are degrees",
            )


def _unlike(robot: RobotModel, read: Columns, unit: str) -> float:
    """Share of the heavy joints' torque that a reading does not explain."""
    straight = np.array(prismatic(robot))
    factor = np.where(straight, 1e-3 if unit == "mm" else 1.0, _degrees(unit))
    motion = sampled(read.time, read.position * factor, read.torque)
    if motion is None or motion.torque is None:
        return 1.0
    nominal = rigid_torque(robot, motion)
    like = [
        likeness(*each)
        for each in zip(nominal.T, motion.torque.T, motion.velocity.T, motion.acceleration.T, strict=True)
    ]
    size = np.array([one.expected for one in like])
    rest = np.array([1.0 - one.correlation**2 for one in like])
    return float(np.sum(size * rest) / max(np.sum(size), 1e-300))


class _Scale(NamedTuple):
    """Torque constant of a joint with its standard error, and what told its sign."""

    value: float
    error: float
    told: str  # "gravity", "friction" or nothing


def _torques(robot: RobotModel, reads: Sequence[Columns]) -> tuple[list[float] | None, list[str]]:
    """Factor from each torque column to N m (None: they are N m already), and what was assumed."""
    motions = [sampled(read.time, read.position, read.torque) for read in reads if read.torque is not None]
    motions = [motion for motion in motions if motion is not None]
    if not motions:
        short = next((read for read in reads if read.torque is not None), None)
        if short is not None:
            raise InputError(f"{short.file}: {len(short.time)} samples are too few to draft from; at least {FEWEST}")
        return None, _without_torque(robot, reads)
    if without_sign(*(read.torque for read in reads if read.torque is not None)):
        raise InputError(f"{reads[0].file}: no joint's torque changes its sign: an absolute value has no direction")
    _order(robot, reads, motions)
    scales = [_scale(robot, motions, j) for j in range(robot.nv)]
    current, zero = any(read.current for read in reads), _zero(robot, reads)
    odd = [s for s in scales if s.told == "gravity" and not 0.3 < abs(s.value) < 3.0]
    names = robot.dof_names
    if current or odd:
        open_joints = [
            n
            for n, s in zip(names, scales, strict=True)
            if n not in zero and (s.told != "gravity" or s.error > 0.3 * abs(s.value))
        ]
        if open_joints:
            raise Undecided(
                "constants",
                f"{reads[0].file}: the torque columns are not in N m, and the motion does not show the constants of"
                f" {', '.join(open_joints)}; {_constants(names, scales)}. Give all of them"
                " by --constants (data sheet: torque constant times gear ratio), N m a unit in the order of the joints",
            )
        said = [f"torque constants by the model's gravity, no surer than its masses; {_constants(names, scales)}"]
        return [1.0 if n in zero else s.value for n, s in zip(names, scales, strict=True)], said
    turned = [n for n, s in zip(names, scales, strict=True) if s.value < 0 and s.told and n not in zero]
    unknown = [n for n, s in zip(names, scales, strict=True) if not s.told and n not in zero]
    said = []
    if turned:
        said.append(f"torque of {', '.join(turned)} has the opposite sign: turned by transmission.torque")
    if unknown:
        said.append(
            f"sign and order of the torque of {', '.join(unknown)} are taken as they are: nothing confirms them"
        )
    if not all(read.named for read in reads):
        told = [n for n, s in zip(names, scales, strict=True) if s.told]
        said.append(f"no column names a joint; gravity or friction confirm the order at {', '.join(told) or 'none'}")
    return ([-1.0 if n in turned else 1.0 for n in names] if turned else None), said


def _unused(read: Columns) -> str:
    """The columns of a recording that the draft has made nothing of, for the user to find the torque among them."""
    return f"; columns of which nothing was made: {', '.join(read.unused[:12])}" if read.unused else ""


def _without_torque(robot: RobotModel, reads: Sequence[Columns]) -> list[str]:
    lacking = next((read for read in reads if read.command is None), None)
    if lacking is not None:
        raise InputError(
            f"{lacking.file}: no column looks like a torque (tau, torque, effort), a current or a command (cmd, u,"
            " target), and `diagnose` and `identify` need one of them; name such columns so, with their joints, as"
            f" tau_{robot.dof_names[0]} or cmd_{robot.dof_names[0]}{_unused(lacking)}"
        )
    said = [
        f"{read.unsigned} never changes its sign, so it is not torque: left out" for read in reads[:1] if read.unsigned
    ]
    said.append("the recordings hold no torque: rollouts of the command")
    driven = reads[0].driven
    passive = [name for name in robot.dof_names if name not in [one.joint for one in driven]]
    if passive:
        said.append(f"commands are of {', '.join(one.joint for one in driven)}; nothing drives {', '.join(passive)}")
    if not all(read.named and read.drives_named for read in reads):
        beyond = " beyond positions that follow their commands within the limits"
        what = "the commands" if all(read.named for read in reads) else ", ".join(robot.dof_names)
        said.append(
            f"order, sign and unit of {what} are taken as they are: no column of theirs names a joint, and nothing"
            f" confirms them{beyond * all(one.command == 'position' for one in driven)}"
        )
    for kind, unit in (("torque", "N m or N"), ("velocity", "positions' unit per s")):
        names = [one.joint for one in driven if one.command == kind]
        if names:
            said.append(f"the command at {', '.join(names)} is a {kind} ({unit}), as the model's actuators take it")
    return said


def _zero(robot: RobotModel, reads: Sequence[Columns]) -> list[str]:
    """Joints whose torque is zero in every row."""
    torques = [read.torque for read in reads if read.torque is not None]
    return [name for j, name in enumerate(robot.dof_names) if torques and not any(x[:, j].any() for x in torques)]


def _undriven(robot: RobotModel, reads: Sequence[Columns], passive: Sequence[str]) -> tuple[list[Columns], list[str]]:
    """The recordings with 0 in the place of the torque of joints that nothing drives, and what was assumed of them."""
    zero = _zero(robot, reads)
    for name in passive:
        if name not in robot.dof_names:
            raise InputError(f"--passive: the recordings hold no position of '{name}'")
        if name not in zero and any(read.torque is not None for read in reads):
            raise InputError(f"{reads[0].file}: --passive names {name}, but its torque is not zero throughout")
    said = [f"nothing drives {name}, as stated: its torque is zero" for name in passive]
    if left := [name for name in zero if name not in passive]:
        said.append(
            f"torque of {', '.join(left)} is 0 in every row: it was not measured, and `identify` leaves it out; where"
            " nothing drives the joint, give --passive, for then the zero is a measurement"
        )
    out = []
    for read in reads:
        source = read.entry.get("torque")
        if passive and isinstance(source, (list, tuple)):
            listed = [0 if n in passive else c for n, c in zip(robot.dof_names, source, strict=True)]
            read = read._replace(entry=read.entry | {"torque": listed})
        out.append(read)
    return out, said


def _constants(names: Sequence[str], scales: Sequence[_Scale]) -> str:
    shown = [
        f"{n} {s.value:.3g} ± {1.96 * s.error:.2g}" for n, s in zip(names, scales, strict=True) if s.told == "gravity"
    ]
    return f"those found: {', '.join(shown)} N m a unit" if shown else "none was found"


def _scale(robot: RobotModel, motions: Sequence[Sampled], joint: int) -> _Scale:
    """N m a unit of a column: by gravity and inertia of the model, else by friction, which must brake."""
    weights, values = [], []
    for motion in motions:
        assert motion.torque is not None
        nominal = rigid_torque(robot, motion)
        one = likeness(
            nominal[:, joint], motion.torque[:, joint], motion.velocity[:, joint], motion.acceleration[:, joint]
        )
        if abs(one.correlation) > 0.8 and one.expected > 0.02 * np.std(nominal) and one.error > 0:
            values.append(1 / one.slope)
            weights.append((one.slope / one.error) ** 2 / values[-1] ** 2)
    if values and (np.sign(values) == np.sign(values[0])).all():
        mean = float(np.average(values, weights=weights))
        return _Scale(mean, float(np.sqrt(1 / np.sum(weights)) + np.std(values) / np.sqrt(len(values))), "gravity")
    share = np.mean([_friction(motion, joint) for motion in motions])
    return _Scale(float(np.sign(share) or 1.0), np.inf, "friction" if abs(share) > 0.6 else "")


def _friction(motion: Sampled, joint: int) -> float:
    """Correlation of a torque with its joint's direction of motion."""
    assert motion.torque is not None
    x, v = motion.torque[:, joint], motion.velocity[:, joint]
    x, s = x - x.mean(), np.tanh(v / (0.1 * (np.sqrt(np.mean(v**2)) or 1.0)))
    s = s - s.mean()
    size = np.sqrt((x @ x) * (s @ s))
    return float(x @ s / size) if size > 0 else 0.0


def _order(
    robot: RobotModel,
    reads: Sequence[Columns],
    motions: Sequence[Sampled],
    at: Sequence[int] | None = None,
    what: str = "torque",
) -> None:
    """Refuse torque columns, of all joints or those `at`, that another one's motion explains much better than its."""
    from scipy.optimize import linear_sum_assignment

    at = range(robot.nv) if at is None else at
    shares = np.mean([_explained(robot, motion) for motion in motions], axis=0)[np.ix_(at, at)]
    _, order = linear_sum_assignment(-shares)
    names = [robot.dof_names[j] for j in at]
    for cycle in _cycles(order.tolist()):
        own, best = shares[cycle, cycle], shares[cycle, order[cycle]]
        if (best > CONFIRMED).all() and np.sum(np.log((1.02 - own) / (1.02 - best))) > np.log(6.0):
            text = ", ".join(f"{names[j]} goes with the {what} given for {names[order[j]]}" for j in cycle)
            raise InputError(f"{reads[0].file}: {what} and position columns are in different orders: {text}")


def _cycles(order: list[int]) -> Iterator[list[int]]:
    """The cycles of a permutation that move something."""
    left = {j for j, c in enumerate(order) if j != c}
    while left:
        cycle = [left.pop()]
        while order[cycle[-1]] in left:
            cycle.append(order[cycle[-1]])
            left.remove(cycle[-1])
        yield cycle


def _explained(robot: RobotModel, motion: Sampled) -> Float[np.ndarray, "nv nv"]:
    """Share of each torque column (second) that a joint's (first) nominal torque, friction and rotor explain."""
    assert motion.torque is not None
    nominal, out = rigid_torque(robot, motion), np.zeros((robot.nv, robot.nv))
    for j in range(robot.nv):
        v = motion.velocity[:, j]
        speed = np.sqrt(np.mean(v**2)) or 1.0
        columns = np.column_stack(
            [np.ones(len(v)), nominal[:, j], v, np.tanh(v / (0.1 * speed)), motion.acceleration[:, j]]
        )
        scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        rest = motion.torque - scaled @ np.linalg.lstsq(scaled, motion.torque, rcond=1e-8)[0]
        out[j] = 1 - rest.var(axis=0) / np.maximum(motion.torque.var(axis=0), 1e-300)
    return out


def _refuse_turned_positions(robot: RobotModel, reads: Sequence[Columns], gears: Sequence[float] | None) -> None:
    """Refuse a torque that seems to be turned where its joint's position is: the other joints' torques tell."""
    for read in reads if robot.nv > 1 else ():
        recording = Recording(read.file.stem, read.file, robot.dof_names, read.time, read.position, torque=read.torque)
        found = check_recording(recording, robot, RecordingEntry(file=read.file, position="q", rate=1.0))
        texts = [finding.text for finding in found]
        for j, name in enumerate(robot.dof_names):
            if any(text.endswith(f"the opposite sign of the position of {name} {TURNED_POSITION}") for text in texts):
                ratio = [1.0] * robot.nv if gears is None else [*gears]
                ratio[j] = -ratio[j]
                raise Undecided(
                    "gears",
                    f"{read.file}: the position of {name} seems to have the opposite sign: with it turned, the torque"
                    f" of all joints follows the model as it stands. Turn it by --gears"
                    f" {','.join(f'{x:g}' for x in ratio)}, or take the torque as it is by --constants",
                )


def _refuse_what_is_wrong(
    robot: RobotModel, reads: Sequence[Columns], signs: list[float] | None, passive: Sequence[str], *, stated: bool
) -> list[str]:
    """The check of recordings on the draft's own reading: a draft that it would warn of is not written.

    Where the user has `stated` signs and constants, what the model says against the torque is said, and no more.
    """
    factor, said = np.ones(robot.nv) if signs is None else np.array(signs), list[str]()
    for read in reads:
        torque = None if read.torque is None else read.torque * factor
        of_all = (read.file.stem, read.file, robot.dof_names, read.time, read.position)
        recording = Recording(*of_all, torque=torque, undriven=tuple(passive))
        entry = RecordingEntry(file=read.file, position="q", rate=1.0)
        grave = [f for f in check_recording(recording, robot, entry) if f.wrong or _decides(f)]
        doubts = [f for f in grave if not f.wrong and f.text.startswith("torque")]
        if grave and doubts != grave:
            raise InputError(f"{read.file}: {'; '.join(finding.text for finding in grave)}")
        text = "; ".join(finding.text for finding in doubts)
        text += "" if text.endswith("?") else "."
        if doubts and not stated:
            raise Undecided(
                "constants",
                f"{read.file}: {text} If the columns are right, confirm that with --constants (N m per unit, in the"
                " order of the joints; 1 for N m), and the torque is taken as it is",
            )
        said += [f"{read.file.name}: {text} Signs and constants are as given; nothing confirms them"] if doubts else []
    return said


_UNLIKE = "does not follow"


def _decides(finding: Finding) -> bool:
    """Whether a warning is about how the columns are read, not about the motion or its quality."""
    words = ("does not belong", "as read", _UNLIKE, "clock", "times what", "outside the")
    return any(word in finding.text for word in words)


def _repeats(reads: Sequence[Columns]) -> list[str | None]:
    """One label for recordings whose positions are the same motion."""
    shapes = [_shape(read) for read in reads]
    labels: list[str | None] = [None] * len(reads)
    for i in range(len(reads)):
        for j in range(i):
            seconds = reads[i].time[-1] / max(reads[j].time[-1], 1e-9)
            if abs(seconds - 1) < 0.03 and np.corrcoef(shapes[i], shapes[j])[0, 1] > 0.995:
                labels[j] = labels[j] or chr(ord("A") + len({label for label in labels if label}))
                labels[i] = labels[j]
                break
    return labels


def _repeats_said(reads: Sequence[Columns], labels: Sequence[str | None]) -> list[str]:
    """Which files repeat one motion, a line for each label."""
    alike = {
        label: [str(read.file) for read, own in zip(reads, labels, strict=True) if own == label] for label in labels
    }
    return [
        f"{', '.join(files[:-1])} and {files[-1]} repeat one motion (repeat: {label})"
        for label, files in alike.items()
        if label is not None
    ]


def _shape(read: Columns) -> Float[np.ndarray, " _"]:
    grid = np.linspace(0.0, read.time[-1], 200)
    x = np.column_stack([np.interp(grid, read.time, column) for column in read.position.T])
    return ((x - x.mean(axis=0)) / (x.std(axis=0).max() or 1.0)).ravel()


def _drives(
    model: Path, robot: RobotModel, reads: Sequence[Columns], gains: Sequence[float] | None
) -> tuple[dict[str, Any], list[str]]:
    """The `actuator` block of rollouts, which have a command in place of torque."""
    if any(read.torque is not None or read.command is None for read in reads):
        return {}, []
    for read in reads:
        assert read.command is not None
        for one, u in zip(read.driven, read.command.T, strict=True):
            q = read.position[:, robot.joint_names.index(one.joint)]
            if one.command == "position" and np.std(u) > 1e-3 and not np.corrcoef(u, q)[0, 1] >= 0.5:
                servo = f"its drive {one.drives[0]} takes" if one.drives else "a servo of --kp takes"
                raise InputError(
                    f"{read.file}: the position of {one.joint} does not follow its command: order, sign or unit?"
                    f" {servo[0].upper()}{servo[1:]} a position. Name each column after its joint, as cmd_{one.joint};"
                    f" where the command is a torque, the model needs a `motor` at {one.joint} (MJCF), or a task"
                    " `kind: torque` under `actuator`"
                )
    _order_of_motors(robot, reads)
    names = [one.joint for one in reads[0].driven]
    if gains is not None:
        if len(gains) != len(names):
            raise InputError(f"--kp: {len(gains)} numbers, expected one for each of {', '.join(names)}")
        return {n: {"kind": "position", "kp": k} for n, k in zip(names, gains, strict=True)}, []
    if any(one.drives for one in reads[0].driven):
        return {}, ["the drives are the model's actuators"]
    raise Undecided(
        "kp",
        f"{model}: a command without torque is simulated with its drives, and this file has none: give the gains of"
        f" the position servos by --kp (N m/rad, in the order {', '.join(names)}), or an MJCF with actuators",
    )


def _order_of_motors(robot: RobotModel, reads: Sequence[Columns]) -> None:
    """Refuse commands of motors that another joint's motion explains much better than their own."""
    at = [robot.joint_names.index(one.joint) for one in reads[0].driven]
    gain = [one.gain for one in reads[0].driven if one.command == "torque" and one.gain is not None]
    if len(gain) < max(len(at), 2):
        return
    motions = []
    for read in reads:
        torque = np.zeros_like(read.position)
        torque[:, at] = np.asarray(read.command) * gain
        motion = sampled(read.time, read.position, torque)
        motions += [] if motion is None else [motion]
    if motions:
        _order(robot, reads, motions, at, "command")
