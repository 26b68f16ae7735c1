"""The loop of a finished run, read back from its `model` folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..effects.base import Effect, place
from ..effects.registry import find
from ..errors import InputError, check_kind, check_path
from ..formats.export import load_model, mark_written, model_files, refuse_others, write_model
from ..rigid.manifold import neutral
from ..rigid.model import RobotModel
from .causes import motor_of, rigid, with_motor
from .export import described, described_text, with_drives
from .loop import Drives, Joints, Loop, Pairs, acts_across
from .reading import plain_joints
from .task import extended_of

__all__ = ["LOOP", "add_loop", "read_loop", "write_loop"]

LOOP = "loop.json"


def write_loop(loop: Loop, directory: str | Path) -> None:
    """Write the model of a loop into `directory`, as a run does: robot, effects, `loop.json`, drives in `robot.xml`.

    It is what `read_loop`, `figaroh-jax simulate` and `figaroh-jax export` read.

    >>> import tempfile, figaroh_jax as fj
    >>> from pathlib import Path
    >>> loop, _ = fj.load_loop(fj.DEMO, {"elbow": {"kind": "position", "kp": 20.0, "kd": 0.5}}, joints=["elbow"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fj.write_loop(loop, folder)
    ...     sorted(file.name for file in Path(folder).iterdir())
    ['effects.yaml', 'loop.json', 'robot.urdf', 'robot.xml']
    """
    check_kind("loop", loop, Loop, "`load_loop` makes one; write_loop(loop, directory)")
    check_path("directory", directory)
    refuse_others(Path(directory) / LOOP, described_text(loop), "write_loop")
    write_model(extended_of(rigid(loop)), directory)
    add_loop(Path(directory), loop)


def add_loop(folder: Path, loop: Loop) -> None:
    """`loop.json`, every number of the loop, and the drives in the `robot.xml` of a model that is written.

    A spring between motor and link stands in both of these; the robot of `effects.yaml` and `robot.urdf` is rigid.
    """
    (folder / LOOP).write_text(described_text(loop), encoding="utf-8")
    mjcf = folder / "robot.xml"
    if motor_of(loop.robot) is not None:
        mjcf.write_text(model_files(extended_of(loop))[mjcf.name], encoding="utf-8")
    mjcf.write_text(with_drives(mjcf, described(loop)), encoding="utf-8")
    mark_written(mjcf, folder / LOOP)


def read_loop(folder: str | Path) -> Loop:
    """The loop that a run of rollouts wrote: `loop.json` on the robot of `effects.yaml`, every number as it was fitted.

    Effects of your own must have been registered (`register`) before. Raises `InputError` for a folder without such a
    loop, and for joints, drives or effects that the robot does not have.

    >>> import tempfile, figaroh_jax as fj
    >>> loop, _ = fj.load_loop(fj.DEMO, {"elbow": {"kind": "position", "kp": 20.0, "kd": 0.5}}, joints=["elbow"])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     fj.write_loop(loop, folder)
    ...     fj.read_loop(folder).drives.names
    ('elbow',)
    """
    check_path("folder", folder)
    file = Path(folder) / LOOP
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        raise InputError(f"{folder}: no readable {LOOP}; name the `model` folder of a rollout's run") from None
    robot = load_model(folder).robot
    try:
        return _loop(content, robot)
    except InputError as error:
        raise InputError(f"{file}: {error}") from None
    except KeyError as error:
        raise InputError(f"{file}: the key {error} is missing; the file is written by figaroh-jax") from None
    except (TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(f"{file}: not as figaroh-jax writes it: {error}") from None


def _loop(content: Mapping[str, Any], robot: RobotModel) -> Loop:
    stiff = robot.nv
    motors = [i for i, j in enumerate(robot.joints) if [*content["joints"]] == [*robot.dof_names, f"{j.name}_spring"]]
    robot = with_motor(robot, motors[0]) if motors else robot
    names = robot.dof_names
    if [*content["joints"]] != [*names]:
        raise InputError(
            f"its joints are {', '.join(content['joints'])}, those of effects.yaml {', '.join(names)}; the files are"
            " of one run"
        )
    return Loop(
        robot=robot,
        drives=_drives(content["drives"], robot),
        joints=_joints(content, robot),
        start=np.asarray(content["start"], float) if "start" in content else neutral(robot),
        dt=np.float64(content["dt"]),
        integrator=content["integrator"],
        law=content["law"],
        limited=any(one["range"] is not None for one in content["limits"].values()),
        measured=tuple(range(stiff)),  # no encoder reads the twist of a spring
        pairs=_pairs(content.get("pairs", ()), names),
        effects=tuple(_effect(one, robot) for one in content.get("effects", ())),
    )


def _joints(content: Mapping[str, Any], robot: RobotModel) -> Joints:
    numbers = {
        name: [one[name] for one in content["joints"].values()] for name in next(iter(content["joints"].values()))
    }
    told = [content["limits"][name] for name in robot.dof_names]
    ends = {key: [_range(one[key]) for one in told] for key in ("range", "torque_range")}
    found = {name: np.array(values, float) for name, values in numbers.items()}
    found |= {"limit": np.array(ends["range"]), "torque_range": np.array(ends["torque_range"])}
    found |= {f"limit_{key}": np.array([one[key] for one in told], float) for key in ("margin", "solref", "solimp")}
    if unknown := found.keys() - vars(plain_joints(robot)).keys():
        raise InputError(f"joints have no number '{min(unknown)}'")
    return Joints(**found)


def _drives(content: Mapping[str, Any], robot: RobotModel) -> Drives:
    each, names = [*content.values()], robot.dof_names
    way = np.zeros((len(each), len(names)))
    for k, one in enumerate(each):
        for joint, gear in one["transmission"].items():
            way[k, names.index(joint)] = gear
    rows = lambda *keys: np.array([[one[key] for key in keys] for one in each], float).reshape(len(each), len(keys))  # noqa: E731
    sides = lambda key: np.array([_range(one[key]) for one in each]).reshape(-1, 2)  # noqa: E731
    voltage = [np.inf if one["voltage"] is None else one["voltage"] for one in each]
    return Drives(
        transmission=way,
        gain=rows("kp", "gain_of_length", "gain_of_rate"),
        bias=rows("constant", "length", "kd") * [1.0, 1.0, -1.0],
        scale=np.ones(len(each)),
        command_range=sides("command_range"),
        force_range=sides("force_range"),
        voltage=np.array(voltage, float),
        dead_band=rows("dead_band")[:, 0],
        delay=rows("delay")[:, 0],
        time_constant=rows("time_constant")[:, 0],
        activation_range=sides("activation_range"),
        names=tuple(content),
        activation=tuple(one["activation"] for one in each),
        early=tuple(bool(one["early"]) for one in each),
        across=acts_across(robot, way),
    )


def _range(ends: Any) -> tuple[float, float]:
    low, high = (None, None) if ends is None else ends
    return -np.inf if low is None else float(low), np.inf if high is None else float(high)


def _pairs(content: Any, names: tuple[str, ...]) -> Pairs | None:
    if not content:
        return None
    numbers = {
        key: np.array([one["parameters"][key] for one in content], float) for key in ("inertia", "damping", "friction")
    }
    at = tuple((names.index(one["at"][0]), names.index(one["at"][1]), int(one["sign"])) for one in content)
    return Pairs(**numbers, at=at)


def _effect(content: Mapping[str, Any], robot: RobotModel) -> Effect:
    return place(find(content["effect"]), robot, content["at"], **content["parameters"])
