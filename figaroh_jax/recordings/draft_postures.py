"""A task for `calibrate` drafted from measured postures: what each column is, in which unit, seen on which body.

Names say what may be meant. Each meaning is a task of its own; its device and its marker are placed in closed form, and
the meaning by which the robot as it is misses the measurement least is taken. Where none comes near, the draft is
refused, with the task that a user can complete.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..errors import InputError
from ..formats.config import load_task
from ..formats.robotfile import impossible_said, read_robot
from ..rigid.kinematics import poses_on_host
from ..rigid.model import RobotModel, prismatic
from .column_names import holds, words_of
from .draft_columns import column_kinds, of_joints
from .draft_text import locked_said, place_said
from .poses import PoseRecording, read_pose_recordings
from .starts import place_points, place_poses
from .tables import Table

__all__ = ["draft_postures", "looks_measured"]

FITS = 0.15  # of the measurement's spread, that a robot as it is may miss: 9 degrees of a joint, seen along its arm
APART = 2.0  # times as much, that another meaning of the columns misses
AS_GOOD = 1.1  # times the least: a body further out, which moves as well
OWN, OWN_BASE = 1e-4, 1e-3  # m and rad, of the marker and of the base: so near the robot's file a pose is computed
FEWEST = 4  # postures, of which meanings can be compared


def looks_measured(table: Table, model: RobotModel) -> bool:
    """Whether a table holds postures and what a device measured, by its names: no torque, command or velocity."""
    kinds = column_kinds(table, None)
    return bool(_measured(table, model)) and not {"torque", "current", "command", "velocity"} & set(kinds)


class _Meaning(NamedTuple):
    """One reading of the columns as an entry of a task, and how the robot as it is agrees with it."""

    entry: dict[str, Any]
    misses: float = np.inf  # of the measurement's spread, the median over the postures
    metres: float = np.inf  # the same, m
    computed: bool = False  # whether the measurement is what the robot's file says itself
    postures: int = 0
    beside: tuple[str, ...] = ()  # what else looks measured, and agrees as a measurement does
    shape: tuple[int, ...] = ()  # of one measurement: the same device has the same


def draft_postures(
    model: Path,
    whole: RobotModel,
    tables: Iterable[Table],
    joints: Sequence[str] | None = None,
    unit: str | None = None,
    folder: Path | None = None,
) -> tuple[str, tuple[str, ...]]:
    """The text of a task for `calibrate`, and what was assumed, one line each; see `draft_task`.

    Raises `InputError` where a table holds no postures, or where they agree with the robot in no meaning.
    """
    entries: list[dict[str, Any]] = []
    shapes: list[tuple[int, ...]] = []
    assumed: list[str] = []
    arm: _Arm | None = None
    for table in tables:
        if not looks_measured(table, whole):
            raise InputError(f"{table.file}: no measured posture, as the other files hold; draft a task for each kind")
        for source, ways in _positions(table, whole, joints):
            arms = [_arm(model, whole, names) for names in ways] if arm is None else [arm]
            if arm is not None and arm.joints not in ways:
                raise InputError("the recordings hold different joints; draft a task for each kind")
            arm, best = _best(table, whole, arms, source, unit)
            entries.append(best.entry)
            shapes.append(best.shape)
            assumed += _said(table, arm.robot, best)
    if arm is None:
        raise InputError("no recordings given")
    entries = _with_roles(entries, shapes, assumed)
    assumed += [*locked_said(arm.robot, whole), *impossible_said(model)]
    named = joints is None and all(isinstance(entry["position"], list) for entry in entries)
    if not named:
        assumed.append(f"columns belong to {', '.join(arm.joints)}, in this order")
    robot = arm.keys | {"model": place_said(model, folder)}
    for entry in entries:
        entry["file"] = place_said(Path(entry["file"]), folder)
    return _text(robot, entries, assumed), tuple(assumed)


def _text(robot: dict[str, Any], entries: list[dict[str, Any]], assumed: Sequence[str]) -> str:
    from ..formats.export import dump_yaml

    parts = ["# Drafted by `figaroh-jax new`. What was assumed:", *(f"#   {line}" for line in assumed), ""]
    parts += [dump_yaml({"robot": robot}), "# `role: holdout` keeps postures out of the fit and predicts them."]
    parts += ["# `unknown`: where the device stands and where the marker sits are estimated; take out what is known."]
    parts += [dump_yaml({"data": entries})]
    return "\n".join(part.rstrip("\n") for part in parts) + "\n"


def _with_roles(
    entries: list[dict[str, Any]], shapes: Sequence[tuple[int, ...]], assumed: list[str]
) -> list[dict[str, Any]]:
    """Recordings whose names say that they test others are kept out of the fit, where the same device is left in it.

    Predictions are named after the file: of several such sets in one file the first is taken.
    """
    tests = [bool(_TESTS & set(_all_words(entry))) for entry in entries]
    fitted = {shape for shape, test in zip(shapes, tests, strict=True) if not test}
    out: list[dict[str, Any]] = []
    for entry, test, shape in zip(entries, tests, shapes, strict=True):
        held = test and shape in fitted
        if held and any(one["file"] == entry["file"] and one["role"] == "holdout" for one in out):
            said = "predictions of two held-out sets of one file would share a name"
            assumed.append(f"{_name(entry['position'])} is left out: {said}")
            continue
        out.append(entry | {"role": "holdout" if held else "fit"})
    return out


_TESTS = {"test", "val", "valid", "validation", "holdout", "check"}


def _all_words(entry: dict[str, Any]) -> list[str]:
    position = entry["position"]
    return words_of(" ".join([Path(entry["file"]).stem, *([position] if isinstance(position, str) else position)]))


def _said(table: Table, model: RobotModel, best: _Meaning) -> Iterator[str]:
    (kind,) = {"pose", "position", "camera"} & set(best.entry["measurement"])
    units, seen = best.entry.get("units", {}), best.entry["measurement"]
    what = {"pose": "poses", "position": "points", "camera": "poses of what stands still, seen from the robot"}[kind]
    written = ""
    if "orientation" in seen:
        angle = "" if seen["orientation"] == "wxyz" else " in degrees" if "orientation" in units else " in rad"
        written = f", orientations as {seen['orientation']}{angle}"
    straight = all(prismatic(model))
    angle = "mm" if units.get("position") == "mm" else "degrees" if "position" in units else "m" if straight else "rad"
    yield (
        f"{table.file.name}: {best.postures} postures with positions in {angle}, {what} in"
        f" {units.get('measurement', 'm')}{written}: no other reading of the columns agrees with {model.name}"
    )
    if best.computed:
        yield (
            f"{_name(seen[kind])} agrees with the robot's file to {1e3 * best.metres:.2g} mm in its own base: is it"
            " computed from the positions of the joints, and not measured?"
        )
    else:
        yield (
            f"the robot as it is misses {_name(seen[kind])} by {1e3 * best.metres:.3g} mm (median), once the device and"
            f" the marker on {seen['tool_frame']} are placed"
        )
    if best.beside:
        yield f"{', '.join(best.beside)} agrees with the robot less well than {_name(seen[kind])}, and is not used"


def _name(source: str | Sequence[str]) -> str:
    return source if isinstance(source, str) else f"{source[0]} to {source[-1]}"


# What the names allow


def _measured(table: Table, model: RobotModel) -> list[str]:
    return [
        n
        for n in table.names
        if _MEASURED.search(n) and not any(holds(n, j, model.joint_names) for j in model.joint_names)
    ]


_MEASURED = re.compile(
    r"^(?:(?:\w*[_. ])?[xyz]\d*(?:[ _]?[\[(]?(?:mm|m)[\])]?)?|T_\w+|.*(?:pose|xyz|marker|point|board).*)$",
    re.IGNORECASE,
)


def _positions(
    table: Table, model: RobotModel, joints: Sequence[str] | None
) -> list[tuple[Any, list[tuple[str, ...]]]]:
    """What the task says of the positions of each set of postures, and the joints that its columns may belong to."""
    measured, kinds = _measured(table, model), column_kinds(table, None)
    named = [n for n in table.names if any(holds(n, joint, model.joint_names) for joint in model.joint_names)]
    named = [n for n in named if n in kinds.get("position", ())] or named
    rest = [n for n in table.names if n not in measured]
    found = [n for n in kinds.get("position", ()) if n not in measured and n not in _turned(table, model)[0]]
    if not found:
        rest = [n for n in rest if n not in _turned(table, model)[0]]
        count = len(joints or model.joint_names)
        found = rest if len(rest) == count > 1 else _numbered(rest, count)
    found = named or found
    if not found:
        raise _unclear(table, model, "JOINTS", "no column looks like a position of a joint")
    arrays = [] if named else [name for name in found if np.ndim(table.read(name)) == 2]
    sets: list[tuple[Any, list[tuple[str, ...]]]] = []
    for columns in [[name] for name in arrays] or [found]:
        count = np.shape(table.read(columns[0]))[1] if arrays else len(columns)
        chains = _chains(model, count) if not named and joints is None and count < len(model.joint_names) else []
        if chains:
            sets.append((columns[0] if arrays else columns, chains))
        else:
            names, source, _ = of_joints(table, columns, model, joints, "position")
            sets.append((source, [names]))
    return sets


def _numbered(names: Sequence[str], count: int) -> list[str]:
    """The columns that differ in a number alone and are as many as there are joints."""
    sets: dict[str, list[str]] = {}
    for name in names:
        if re.search(r"\d", name):
            sets.setdefault(re.sub(r"\d+", "#", name), []).append(name)
    found = [one for one in sets.values() if len(one) == count > 1]
    return found[0] if len(found) == 1 else []


def _chains(model: RobotModel, count: int) -> list[tuple[str, ...]]:
    """The chains of so many joints, each carried by the one before: an arm without its fingers."""
    above: list[list[str]] = []
    for joint in model.joints:
        above.append([*(above[joint.parent] if joint.parent >= 0 else []), *([] if joint.follows else [joint.name])])
    return list(dict.fromkeys(tuple(names) for names in above if len(names) == count))


def _turned(table: Table, model: RobotModel) -> tuple[list[str], list[str]]:
    """Columns of orientations in their order, and what they may be as `measurement.orientation` says it."""
    joints = model.joint_names
    names = [n for n in table.names if not any(holds(n, joint, joints) for joint in joints)]
    for pattern, ways in (
        (r"(?:.*[_. ])?q?_?({})", ("xyzw", ["xyzw"])),
        (r"(?:.*[_. ])?(?:r|rv|rot|ori|phi)_?({})\d*(?:[ _]?[\[(]?(?:deg|rad)[\])]?)?", ("xyz", ["rpy", "rotvec"])),
        (r"(?:.*[_. ])?({})(?:[ _]?[\[(]?(?:deg|rad)[\])]?)?", ("roll pitch yaw", ["rpy"])),
        (r"(?:.*[_. ])?({})(?:[ _]?[\[(]?(?:deg|rad)[\])]?)?", ("wpr", ["rpy"])),  # Fanuc
        (r"(?:.*[_. ])?({})(?:[ _]?[\[(]?(?:deg|rad)[\])]?)?", ("cba", ["rpy"])),  # KUKA: A turns about z
    ):
        axes, orientation = ways
        parts = axes.split() if " " in axes else [*axes]
        found = [
            [n for n in names if re.fullmatch(pattern.format(axis), n, re.IGNORECASE) and not _is_point(n, axes)]
            for axis in parts
        ]
        if all(len(one) == 1 for one in found):
            return [one[0] for one in found], orientation
    return [], []


def _is_point(name: str, axes: str) -> bool:
    """Whether a column `x` of a quaternion's pattern is that of a point: a quaternion's says so."""
    return axes == "xyzw" and not re.search(r"q_?[xyzw]$|(?:quat|rot|ori)\w*[_. ][xyzw]$", name, re.IGNORECASE)


def _measurements(table: Table, model: RobotModel, postures: int) -> Iterator[dict[str, Any]]:
    """Every measurement that the names allow, without frames."""
    measured = _measured(table, model)
    for name in measured:
        values = np.asarray(table.read(name))
        if len(values) != postures or values.ndim < 2:
            continue
        width = values.shape[1:]
        if width in ((4, 4), (16,), (7,), (6,)):
            ways = {(7,): [None, "wxyz"], (6,): ["rpy", "rotvec"]}.get(width, [None])
            for way, kind in product(ways, ({"pose": name}, {"camera": name, "mount": "hand"})):
                yield kind | ({} if way is None else {"orientation": way})
        listed = values.ndim == 2 and width[0] % 3 == 0 and "pose" not in name.lower()
        if listed or width[-1] == 3:
            yield {"position": name}
    turned, ways = _turned(table, model)
    columns = _by_point([n for n in measured if n not in turned and np.ndim(table.read(n)) == 1])
    if turned and len(columns) == 3:
        for way, kind in product(ways, ("pose", "camera")):
            mount = {"mount": "hand"} if kind == "camera" else {}
            yield {kind: [*columns, *turned], **mount} | ({} if way == "xyzw" else {"orientation": way})
    elif columns:
        yield {"position": columns}


def _by_point(columns: Sequence[str]) -> list[str]:
    """Columns x, y and z of each point beside each other, by the points' numbers; what belongs to none is left out."""
    points: dict[str, dict[str, str]] = {}
    for name in columns:
        found = re.search(r"(?:^|[_. ]|(?<=[a-z0-9]))([xyzXYZ])(?=\d*(?:[ _]?[\[(]?(?:mm|m)[\])]?)?$)", name)
        if found:
            points.setdefault(name[: found.start(1)] + name[found.end(1) :], {})[found[1].lower()] = name
    numbered = sorted(points, key=lambda name: [int(digits) for digits in re.findall(r"\d+", name)])
    return [points[name][axis] for name in numbered if len(points[name]) == 3 for axis in "xyz"]


class _Arm(NamedTuple):
    """The joints of the columns, the robot of them alone as a task says it, and two of its frames."""

    joints: tuple[str, ...]
    keys: dict[str, Any]
    robot: RobotModel
    base: str  # a frame that stands still
    frames: tuple[str, ...]  # of each link


def _arm(model: Path, whole: RobotModel, joints: tuple[str, ...]) -> _Arm:
    keys = {"model": str(model.resolve())} | ({} if joints == whole.joint_names else {"joints": [*joints]})
    robot = read_robot(model, joints, kinematic=True)
    still = [f.name for f in robot.frames if f.parent < 0]
    base = next((name for name in ("base_link", "base", "world") if name in still), None)
    base = base or next((name for name in still if "joint" not in name), still[0] if still else robot.frames[0].name)
    own = [[f.name for f in robot.frames if f.parent == k] for k in range(len(robot.joints))]
    links = [j.link if j.link in names else names[-1] for j, names in zip(robot.joints, own, strict=True)]
    return _Arm(joints, keys, robot, base, tuple(links))


def _best(
    table: Table, whole: RobotModel, arms: Sequence[_Arm], position: Any, unit: str | None
) -> tuple[_Arm, _Meaning]:
    """The joints and the meaning of the columns that agree best with the robot."""
    words = {word for name in ([position] if isinstance(position, str) else position) for word in words_of(name)}
    found: list[tuple[_Arm, _Meaning]] = []
    for arm in arms:
        postures = len(table.matrix(position, arm.joints, "position"))
        angles = [unit] if unit else ["deg"] if "deg" in words else ["rad"] if "rad" in words else ["rad", "deg"]
        angles = [unit or ("mm" if "mm" in words else "m")] if all(prismatic(arm.robot)) else angles
        for angle, seen in product(angles, _measurements(table, arm.robot, postures)):
            (kind,) = {"pose", "position", "camera"} & set(seen)
            names = [seen[kind]] if isinstance(seen[kind], str) else seen[kind]
            lengths = ["mm"] if "mm" in {word for name in names for word in words_of(name)} else ["m", "mm"]
            turns = ["rad", "deg"] if seen.get("orientation") in ("rpy", "rotvec") else ["rad"]
            for length, turn in product(lengths, turns):
                units = {"position": angle, "measurement": length, "orientation": turn}
                units = {name: one for name, one in units.items() if one not in ("rad", "m")}
                entry = {"file": str(table.file.resolve()), "position": position} | ({"units": units} if units else {})
                frames = {"base_frame": arm.base, "tool_frame": arm.frames[-1]}
                frames |= {"unknown": ["base_frame", "tool_frame"]}
                found.append((arm, _judged(arm, entry | {"measurement": {**seen, **frames}})))
    found.sort(key=lambda one: (one[1].computed, one[1].misses))
    meanings = [meaning for _, meaning in found]
    _refuse_unsure(table, whole, meanings, position)
    taken = _source(meanings[0])
    beside = dict.fromkeys(_source(one) for one in meanings if one.misses <= FITS and not one.computed)
    return found[0][0], meanings[0]._replace(beside=tuple(name for name in beside if name != taken))


def _refuse_unsure(table: Table, model: RobotModel, found: list[_Meaning], position: Any) -> None:
    """`InputError` where the best meaning, the first, does not agree with the robot, or another does as well."""
    if not found or not np.isfinite(found[0].misses):
        raise _unclear(table, model, position, "they are of no shape that a measurement has")
    best = found[0]
    if best.postures < FEWEST:
        raise _unclear(table, model, position, f"{best.postures} postures are too few to see what they are")
    if best.misses > FITS:
        raise _unclear(
            table,
            model,
            position,
            "in no unit and on no body do they agree with the robot: at best it misses them by"
            f" {1e3 * best.metres:.3g} mm, {100 * best.misses:.0f} % of their spread; --joints names the joints of the"
            " columns in their order",
        )
    alike = [one for one in found[1:] if one.misses < APART * best.misses and not one.computed]
    if any(_source(one) == _source(best) for one in alike):
        raise _unclear(table, model, position, "they agree with the robot in more than one meaning")


def _source(meaning: _Meaning) -> str:
    seen = meaning.entry["measurement"]
    return _name(next(seen[kind] for kind in ("pose", "position", "camera") if kind in seen))


def _judged(arm: _Arm, entry: dict[str, Any]) -> _Meaning:
    """How well the robot as it is agrees with an entry of a task, on the body that moves as what was measured."""
    try:
        (recording,) = read_pose_recordings(load_task({"robot": arm.keys, "data": [entry]}), arm.robot)
    except InputError:
        return _Meaning(entry)
    bodies = poses_on_host(arm.robot, recording.position)
    judged = [_misses(recording, bodies[:, k]) for k in range(len(arm.frames))]
    least = min(judged)[0]
    body = max(k for k, one in enumerate(judged) if one[0] <= AS_GOOD * least)
    measurement = entry["measurement"] | {"tool_frame": arm.frames[body]}
    misses, metres, computed = judged[body]
    shape = recording.values.shape
    return _Meaning(entry | {"measurement": measurement}, misses, metres, computed, shape[0], shape=shape[1:])


def _misses(recording: PoseRecording, body: Float[np.ndarray, "n 4 4"]) -> tuple[float, float, bool]:
    """What a body's motion leaves of a measurement once device and marker are placed: of its spread, and in m.

    The third says whether neither has to be placed. An orientation counts as the spread's length times its angle.
    """
    both, R, p = ("base_frame", "tool_frame"), body[:, :3, :3], body[:, :3, 3]
    whole = np.isfinite(recording.values.reshape(len(p), -1))
    if not whole.any(axis=1).any() or (recording.kind == "pose" and not whole.all(axis=1).any()):
        return np.inf, np.inf, False
    if recording.kind == "pose":
        base, tool = place_poses(R, p, recording.values, both)
        told = base @ body @ tool
        turned = np.einsum("nji,njk->nik", told[:, :3, :3], recording.values[:, :3, :3])
        angle = np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))
        off = np.linalg.norm(told[:, :3, 3] - recording.values[:, :3, 3], axis=1)
        points = recording.values[:, None, :3, 3]
    else:
        points, (base, markers) = recording.values, place_points(R, p, recording.values, both)
        told = np.einsum("nij,kj->nki", R, markers) + p[:, None]
        told = told @ base[:3, :3].T + base[:3, 3]
        off, angle = np.linalg.norm(told - points, axis=2), np.zeros(1)
    spread = float(np.sqrt(np.nansum(np.nanvar(points.reshape(len(points), -1, 3), axis=0).mean(axis=0))))
    off, angle = float(np.nanmedian(off)), float(np.nanmedian(angle))
    computed = off < OWN and angle < OWN and bool(np.abs(base - np.eye(4)).max() < OWN_BASE)
    missed = np.hypot(off, spread * angle)
    return (float(missed / spread) if spread > 0 else np.inf), off, computed


def _unclear(table: Table, model: RobotModel, position: Any, why: str) -> InputError:
    """The refusal of postures, with the task that a user can complete."""
    from ..formats.export import dump_yaml

    measured, (turned, ways) = _measured(table, model), _turned(table, model)
    columns = [position] if isinstance(position, str) else [*position]
    named = [j for n in columns for j in model.joint_names if holds(n, j, model.joint_names)]
    robot = {"model": "MODEL"} | ({"joints": named} if named and named != [*model.joint_names] else {})
    whole = np.ndim(table.read(measured[0])) > 1
    places = [n for n in measured if n not in turned]
    turned = turned if len(places) == 3 and not whole else []
    shown: Any = measured[0] if whole else [*places[:12], *turned]
    posed = "pose" in measured[0].lower() or measured[0].startswith("T_") if whole else bool(turned)
    asked = (("position", "deg", columns), ("measurement", "mm", places), ("orientation", "deg", turned))
    units = {key: unit for key, unit, names in asked if any(unit in words_of(name) for name in names)}
    frames = {"base_frame": "BASE", "tool_frame": "TOOL", "unknown": ["base_frame", "tool_frame"]}
    entry = {"file": table.file.name, "position": position if isinstance(position, str) else columns}
    entry |= {"units": units} if units else {}
    orientation = {"orientation": ways[0]} if turned and ways[0] != "xyzw" else {}
    kind = "pose" if posed else "position"
    task = {"robot": robot, "data": [entry | {"measurement": {kind: shown, **orientation, **frames}}]}
    return InputError(
        f"{table.file}: {', '.join(measured[:6])} look like measured poses or points, but {why}. Postures are a task"
        " for `calibrate`. The task is\n"
        f"  {dump_yaml(task, line=True).strip()}\n"
        "where MODEL is the robot's file, and BASE and TOOL are frames of it; the measurement is a `pose`, `position`,"
        " `plane`, `socket` or `camera`."
        + " Angles are roll, pitch, yaw about fixed x, y, z (`rpy`), or an axis times an angle (`rotvec`)."
        * bool(orientation)
    )
