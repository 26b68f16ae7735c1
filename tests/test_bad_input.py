"""Wrong models, task files and recordings: exit status 2, one message that names the culprit, nothing written."""

from __future__ import annotations

import dataclasses
import io
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tasks import URDF, arrays, task, write

import figaroh_jax as fj
from figaroh_jax.cli import main
from figaroh_jax.errors import InputError
from figaroh_jax.recordings.checks import refuse_unmeasured

Spoil = Callable[[Path], Any]  # takes the folder of a right task and makes it wrong


def key(path: str, value: Any, **others: Any) -> Spoil:
    """The task with `value` at a path such as `data.0.role`; None removes the key."""

    def spoil(folder: Path) -> None:
        keys: Any = task()
        for where, what in {path: value, **others}.items():
            *parents, last = [int(part) if part.isdigit() else part for part in where.split(".")]
            holder = keys
            for part in parents:
                holder = holder[part] if isinstance(part, int) else holder.setdefault(part, {})
            if what is None:
                del holder[last]
            else:
                holder[last] = what
        write(folder, keys)

    return spoil


def text(content: str, **others: str) -> Spoil:
    """A task file with this text, beside others."""

    def spoil(folder: Path) -> None:
        (folder / "task.yaml").write_text(content)
        for name, other in others.items():
            (folder / f"{name}.yaml").write_text(other)

    return spoil


def urdf(old: str, new: str) -> Spoil:
    """The robot with one piece of its URDF replaced."""
    assert old in URDF
    return lambda folder: (folder / "robot.urdf").write_text(URDF.replace(old, new, 1))


def model(content: str) -> Spoil:
    return lambda folder: (folder / "robot.urdf").write_text(content)


def npz(**changes: Any) -> Spoil:
    """`run1.npz` with arrays replaced, or left out where the change is None, or changed where it is a function."""

    def spoil(folder: Path) -> None:
        data: dict[str, Any] = dict(arrays())
        for name, change in changes.items():
            data[name] = change(data[name]) if callable(change) else change
        np.savez(folder / "run1.npz", **{k: v for k, v in data.items() if v is not None})

    return spoil


def put(row: int, column: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(x: np.ndarray) -> np.ndarray:
        x[row, column] = value
        return x

    return change


def content(file: str, data: bytes) -> Spoil:
    """A recording file with these bytes, and the task that reads it."""

    def spoil(folder: Path) -> None:
        key("data.0.file", file)(folder)
        (folder / file).write_bytes(data)

    return spoil


def directory(name: str) -> Spoil:
    def spoil(folder: Path) -> None:
        (folder / name).unlink()
        (folder / name).mkdir()

    return spoil


def missing(name: str) -> Spoil:
    return lambda folder: (folder / name).unlink()


def swap(x: np.ndarray) -> np.ndarray:
    x[[40, 41]] = x[[41, 40]]
    return x


def bomb(folder: Path) -> None:
    """An array whose header promises a hundred million times what the file holds."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**11, 3)})
    npz(q=None)(folder)
    with zipfile.ZipFile(folder / "run1.npz", "a") as archive:
        archive.writestr("q.npy", header.getvalue())


LAUGHS_XML = """<?xml version="1.0"?>
<!DOCTYPE robot [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">]>
<robot name="&c;"><link name="base"/></robot>"""
LAUGHS_YAML = "a: &a [x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(['*' + before] * 8)}]\n" for before, name in zip("abcdef", "bcdefg", strict=True)
)
SECOND_ROOT = '<link name="stray"/></robot>'
CYCLE = """<robot name="ring"><link name="a"/><link name="b"/><link name="root"/>
<joint name="there" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>
<joint name="back" type="revolute"><parent link="b"/><child link="a"/><axis xyz="0 0 1"/></joint></robot>"""
HEADER = b"t,q1,q2,q3,tau1,tau2,tau3\n"

TASKS: dict[str, tuple[Spoil, list[str]]] = {
    "unknown key at the top": (key("preproces", {}), ["task.yaml", "'preproces'", "'preprocess'"]),
    "unknown key of robot": (key("robot.modle", "x"), ["robot", "'modle'", "'model'"]),
    "unknown key of data": (key("data.0.torqe", "x"), ["data[0]", "'torqe'", "'torque'"]),
    "unknown key of load": (key("data.0.load", {"frame": "tool0", "mas": 1}), ["data[0].load", "'mas'", "'mass'"]),
    "unknown key of units": (key("data.0.units", {"angle": "deg"}), ["data[0].units", "'angle'", "position"]),
    "unknown key of transmission": (key("transmission", {"ofset": [0]}), ["transmission", "'ofset'", "'offset'"]),
    "unknown key of preprocess": (key("preprocess.cutof", 20), ["preprocess", "'cutof'", "'cutoff'"]),
    "unknown key of baseline": (key("baseline", {"viscos": True}), ["baseline", "'viscos'", "'viscous'"]),
    "unknown key of a baseline effect": (
        key("baseline", {"effects": [{"effect": "torque_offset", "on": []}]}),
        ["baseline.effects[0]", "'on'"],
    ),
    "unknown key of diagnose": (key("diagnose", {"alfa": 0.1}), ["diagnose", "'alfa'", "'alpha'"]),
    "unknown key of actuator": (key("actuator", {"gain": "known"}), ["actuator", "'gain'", "'gains'"]),
    "unknown key of measurement": (
        key("data.0.measurement", {"pose": "T", "frame": "x"}),
        ["data[0].measurement", "'frame'"],
    ),
    "two kinds of measurement": (
        key("data.0.measurement", {"pose": "T", "plane": "p"}),
        ["data[0].measurement", "exactly one", "pose, plane"],
    ),
    "robot missing": (key("robot", None), ["task.yaml", "robot", "missing"]),
    "model missing": (key("robot.model", None), ["robot.model", "missing"]),
    "data missing": (key("data", None), ["data", "missing"]),
    "no recording": (key("data", []), ["data", "at least one recording"]),
    "robot is no mapping": (key("robot", "robot.urdf"), ["robot", "model", "trust"]),
    "no fit recording": (key("data.0.role", "holdout"), ["data", "role: fit"]),
    "role misspelt": (key("data.0.role", "ftt"), ["data[0].role", "'ftt'", "'fit'"]),
    "fit recording without torque": (key("data.0.torque", None), ["run1.npz", "torque"]),
    "time and rate": (key("data.0.rate", 250), ["data[0]", "time", "rate", "one of them"]),
    "neither time nor rate": (key("data.0.time", None), ["data[0]", "time", "rate"]),
    "rate zero": (key("data.0.rate", 0, **{"data.0.time": None}), ["data[0].rate", "0"]),
    "unit unknown": (key("data.0.units", {"position": "grad"}), ["data[0].units.position", "'grad'", "'rad'"]),
    "ampere without a transmission": (key("data.0.units", {"torque": "A"}), ["units.torque", "transmission.torque"]),
    "load in no frame": (key("data.0.load", {"frame": "tool1", "mass": 1}), ["load.frame", "'tool1'", "'tool0'"]),
    "load of negative mass": (key("data.0.load", {"frame": "tool0", "mass": -1}), ["data[0].load.mass", "-1"]),
    "cutoff negative": (key("preprocess.cutoff", -3), ["preprocess.cutoff", "-3"]),
    "cutoff is a word": (key("preprocess.cutoff", "low"), ["preprocess.cutoff", "'low'"]),
    "cutoff is a truth value": (key("preprocess.cutoff", True), ["preprocess.cutoff", "number"]),
    "cutoff above Nyquist": (key("preprocess.cutoff", 130), ["preprocess.cutoff", "130", "250"]),
    "rate of rows zero": (key("preprocess.rate", 0), ["preprocess.rate", "0"]),
    "rate of rows above the recording's": (key("preprocess.rate", 500), ["preprocess.rate", "500", "250"]),
    "window reversed": (key("preprocess.window", [3, 1]), ["preprocess.window", "[3, 1]"]),
    "window outside the recording": (key("preprocess.window", [9, 12]), ["preprocess.window", "run1.npz", "[9, 12]"]),
    "window of three numbers": (key("preprocess.window", [0, 1, 2]), ["preprocess.window"]),
    "window too short": (key("preprocess.window", [1, 1.2]), ["run1.npz", "too short"]),
    "gate of no joint": (key("preprocess.gate", {"elbo": 0.1}), ["preprocess.gate", "'elbo'", "'elbow'"]),
    "alpha above one": (key("diagnose", {"alpha": 5}), ["diagnose.alpha", "5"]),
    "trust zero": (key("robot.trust", 0), ["robot.trust", "0"]),
    "gravity of two numbers": (key("robot.gravity", [0, 0]), ["robot.gravity"]),
    "unknown effect forbidden": (
        key("diagnose", {"forbid": ["stribek_friction"]}),
        ["diagnose.forbid[0]", "'stribek_friction'", "'stribeck_friction'"],
    ),
    "unknown effect in the baseline": (
        key("baseline", {"effects": [{"effect": "ofset"}]}),
        ["baseline.effects[0].effect", "'ofset'"],
    ),
    "baseline effect at no joint": (
        key("baseline", {"effects": [{"effect": "torque_offset", "at": ["elbw"]}]}),
        ["baseline.effects[0].at", "'elbw'", "'elbow'"],
    ),
    "transmission of wrong shape": (
        key("transmission", {"position": [[32, 0], [0, 32]]}),
        ["task.yaml", "transmission.position", "(2, 2)", "(3, 3)", "shoulder"],
    ),
    "transmission not square": (key("transmission", {"torque": [[1, 0, 0]]}), ["transmission.torque", "square"]),
    "transmission singular": (
        key("transmission", {"position": [[1, 0, 0], [0, 1, 1], [0, 1, 1]]}),
        ["transmission.position", "singular"],
    ),
    "transmission offset of wrong length": (
        key("transmission", {"offset": [0.1]}),
        ["task.yaml", "transmission.offset", "(1,)", "(3,)"],
    ),
    "joint not in the model": (key("robot.joints", ["shouldr", "elbow"]), ["'shouldr'", "'shoulder'"]),
    "joint named twice": (key("robot.joints", ["elbow", "elbow"]), ["robot.joints", "'elbow'", "twice"]),
    "posture of no joint": (key("robot.posture", {"finger": 0.1}), ["posture", "'finger'"]),
    "two holdouts of one name": (
        key("data", [*task()["data"], {**task()["data"][1], "file": "other/run2.npz"}]),
        ["data", "two holdout recordings", "'run2'"],
    ),
    "empty task": (text(""), ["task.yaml", "empty"]),
    "a list as a task": (text("- robot\n- data\n"), ["task.yaml", "list", "robot:"]),
    "tab in a task": (text("robot:\n\tmodel: robot.urdf\n"), ["task.yaml", "line 2", "tab"]),
    "unclosed bracket": (text("robot: {model: robot.urdf\ndata: []\n"), ["task.yaml", "line 2"]),
    "key twice": (text("robot: {model: a.urdf}\nrobot: {model: b.urdf}\n"), ["line 2", "'robot'", "twice"]),
    "billion laughs in YAML": (text(LAUGHS_YAML), ["task.yaml", "line", "aliases", "50000 values"]),
    "Python object in YAML": (text("robot: !!python/object/apply:os.getcwd []\n"), ["task.yaml", "line 1"]),
    "deeply nested YAML": (text("[" * 50_000), ["task.yaml", "nested"]),
    "huge task": (text("# " + "x" * (1 << 20)), ["task.yaml", "262144"]),
    "task of bytes": (lambda folder: (folder / "task.yaml").write_bytes(b"\xff\xfe\x00robot"), ["task.yaml"]),
    "extends missing": (text("extends: bse.yaml\n", base="robot: {}\n"), ["bse.yaml", "task.yaml", "'base.yaml'"]),
    "extends in a circle": (text("extends: b.yaml\n", b="extends: task.yaml\n"), ["extends", "circle"]),
    "extends is a number": (text("extends: 3\n"), ["extends", "3"]),
    "mistake in the file extended": (
        text("extends: b.yaml\n", b="robot: {model: robot.urdf, trust: -1}\ndata: []\n"),
        ["b.yaml", "robot.trust", "-1"],
    ),
    "task missing": (missing("task.yaml"), ["task.yaml", "does not exist"]),
    "directory as a task": (directory("task.yaml"), ["task.yaml", "directory"]),
}

MODELS: dict[str, tuple[Spoil, list[str]]] = {
    "missing file": (missing("robot.urdf"), ["robot.urdf"]),
    "directory": (directory("robot.urdf"), ["robot.urdf", "directory"]),
    "empty": (model(""), ["robot.urdf", "empty"]),
    "not XML": (model("robot: arm"), ["robot.urdf", "XML"]),
    "cut short": (model(URDF[:900]), ["robot.urdf", "XML"]),
    "xacro": (
        model(URDF.replace('"bench">', '"bench" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:include file="a"/>')),
        ["robot.urdf", "line 1", "<xacro:include>", "xacro robot.urdf > expanded.urdf"],
    ),
    "another XML": (model("<svg/>"), ["robot.urdf", "<svg>", "<robot>"]),
    "billion laughs": (model(LAUGHS_XML), ["robot.urdf"]),
    "two roots": (urdf("</robot>", SECOND_ROOT), ["stray", "root"]),
    "cycle": (model(CYCLE), ["robot.urdf", "there", "back"]),
    "negative mass": (urdf('value="2.0"', 'value="-2.0"'), ["fore", "-2", "mass"]),
    "mass is a word": (urdf('value="2.0"', 'value="heavy"'), ["fore", "heavy"]),
    "infinite mass": (urdf('value="2.0"', 'value="inf"'), ["fore", "inf"]),
    "negative inertia": (urdf('ixx="0.02"', 'ixx="-0.02"'), ["fore", "inertia"]),
    "zero axis": (urdf('<axis xyz="1 0 0"/>', '<axis xyz="0 0 0"/>'), ["elbow", "axis"]),
    "axis of two numbers": (urdf('<axis xyz="1 0 0"/>', '<axis xyz="1 0"/>'), ["elbow", "axis"]),
    "parent missing": (urdf('<parent link="upper"/>', '<parent link="uper"/>'), ["elbow", "'uper'", "'upper'"]),
    "child missing": (urdf('<child link="rod"/>', '<child link="rood"/>'), ["slide", "'rood'", "'rod'"]),
    "joint without parent": (urdf('<parent link="upper"/>', ""), ["elbow", "parent"]),
    "joint name twice": (urdf('joint name="elbow"', 'joint name="shoulder"'), ["shoulder"]),
    "link name twice": (urdf('link name="fore"', 'link name="upper"'), ["upper"]),
    "joint of unknown type": (urdf('"elbow" type="revolute"', '"elbow" type="hinge"'), ["elbow", "hinge"]),
    "mimics nothing": (
        urdf('<child link="rod"/>', '<child link="rod"/><mimic joint="elbw"/>'),
        ["slide", "'elbw'", "'elbow'"],
    ),
    "no joint moves": (model('<robot name="r"><link name="base"/></robot>'), ["robot.urdf", "joint"]),
}

RECORDINGS: dict[str, tuple[Spoil, list[str]]] = {
    "missing file": (missing("run1.npz"), ["run1.npz", "data[0].file", "'run2.npz'"]),
    "directory": (directory("run1.npz"), ["run1.npz", "directory"]),
    "empty file": (lambda folder: (folder / "run1.npz").write_bytes(b""), ["run1.npz", "empty"]),
    "unknown format": (key("data.0.file", "run1.xls"), ["run1.xls", ".npz", ".csv", ".parquet"]),
    "no npz": (content("run.npz", b"PK but not a zip"), ["run.npz", ".npz"]),
    "pickle called npz": (content("run.npz", pickle.dumps({"q": [1, 2]})), ["run.npz"]),
    "object array": (npz(q=np.array([[1, "a"], [None, 2]], dtype=object)), ["run1.npz", "'q'", "objects"]),
    "array that promises terabytes": (bomb, ["run1.npz", "'q'"]),
    "array missing": (npz(tau=None), ["run1.npz", "'tau'", "data[0].torque"]),
    "words for numbers": (npz(q=np.array([["a", "b", "c"]] * 1000)), ["run1.npz", "'q'", "'a'"]),
    "NaN": (npz(q=put(12, 1, np.nan)), ["run1.npz", "position", "row 12", "column 1", "elbow"]),
    "NaN says what to do": (npz(tau=put(7, 2, np.nan)), ["run1.npz", "torque", "leave such rows out"]),
    "infinite torque": (npz(tau=put(7, 2, np.inf)), ["run1.npz", "torque", "inf", "row 7", "slide"]),
    "NaN in time": (npz(t=lambda t: np.where(t > 1, np.nan, t)), ["run1.npz", "time", "row 251"]),
    "time unsorted": (npz(t=swap), ["run1.npz", "time", "row 41"]),
    "time repeated": (npz(t=lambda t: np.round(t, 2)), ["run1.npz", "time", "repeats", "row"]),
    "time of another length": (npz(t=lambda t: t[:-1]), ["run1.npz", "time", "999", "1000"]),
    "time in two columns": (npz(t=lambda t: np.stack([t, t], 1)), ["run1.npz", "'t'", "(1000, 2)"]),
    "too few columns": (npz(q=lambda q: q[:, :2]), ["run1.npz", "position", "(1000, 2)", "shoulder, elbow, slide"]),
    "too many columns": (npz(tau=lambda x: np.hstack([x, x])), ["run1.npz", "torque", "(1000, 6)", "(samples, 3)"]),
    "transposed": (npz(q=lambda q: q.T), ["run1.npz", "position", "(3, 1000)"]),
    "torque of another length": (npz(tau=lambda x: x[:500]), ["run1.npz", "torque", "500", "1000"]),
    "a torque of zeros": (npz(tau=lambda x: x * [1, 0, 1]), ["run1.npz", "elbow is 0 in every row", "identify leaves"]),
    "one sample": (npz(t=lambda t: t[:1], q=lambda q: q[:1], tau=lambda x: x[:1]), ["run1.npz", "1 sample"]),
    "no sample": (npz(t=lambda t: t[:0], q=lambda q: q[:0], tau=lambda x: x[:0]), ["run1.npz", "0 samples"]),
    "a few samples": (npz(t=lambda t: t[:9], q=lambda q: q[:9], tau=lambda x: x[:9]), ["run1.npz", "too short"]),
    "CSV without its column": (content("run.csv", b"t,q1,q2,q3\n0,1,2,3\n1,1,2,3\n"), ["run.csv", "'tau'"]),
    "CSV with too few columns": (
        content("run.csv", b"t,q1,q2,tau1,tau2,tau3\n0,1,2,3,1,2\n1,1,2,3,2,3\n"),
        ["run.csv", "prefix 'q'", "q1, q2", "3"],
    ),
    "word in a CSV": (content("run.csv", HEADER + b"0,1,2,3,4,5,6\n1,1,oops,3,4,5,6\n"), ["q2", "row 1", "oops"]),
    "empty cell in a CSV": (content("run.csv", HEADER + b"0,1,2,3,4,5,6\n1,1,,3,4,5,6\n"), ["run.csv", "row 1", "nan"]),
    "CSV line of other length": (content("run.csv", HEADER + b"0,1,2,3,4,5,6\n1,1,2\n"), ["run.csv", "7"]),
    "CSV column twice": (content("run.csv", b"t,q1,q1\n0,1,2\n"), ["run.csv", "'q1'", "twice"]),
    "empty CSV": (content("run.csv", b""), ["run.csv", "empty"]),
    "no Parquet": (content("run.parquet", b"PAR0 nothing of the kind"), ["run.parquet", "Parquet"]),
}

CASES = [
    pytest.param(*case, id=f"{kind}: {name}")
    for kind, table in (("task", TASKS), ("model", MODELS), ("recording", RECORDINGS))
    for name, case in table.items()
]


def diagnose(folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    status = main(["diagnose", str(folder / "task.yaml"), "--out", str(folder / "out"), "--quiet"])
    return status, capsys.readouterr().err


@pytest.mark.parametrize(("spoil", "words"), CASES)
def test_wrong_input_is_refused_with_the_culprit_named(tmp_path, capsys, spoil, words):
    write(tmp_path)
    spoil(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    status, message = diagnose(tmp_path, capsys)
    assert status == 2, message
    assert all(word in message for word in words), message
    assert "Traceback" not in message and "pydantic" not in message
    assert len(message.strip().splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_there_are_enough_cases():
    assert len(CASES) >= 45


def test_a_joint_that_rests_in_one_recording_is_no_reason_to_refuse_the_others() -> None:
    """Its torque may have one value there, as a coarse sensor has it; in all of them it was not measured."""
    robot = fj.load_urdf(fj.DEMO)
    q, tau = np.random.default_rng(0).standard_normal((2, 50, 4))
    moved = [fj.recording(q=q, tau=tau, rate=100) for _ in range(2)]
    dead = [dataclasses.replace(one, torque=tau * [1, 1, 1, 0] + 0.3) for one in moved]
    refuse_unmeasured(robot, [dead[0], moved[1]])
    with pytest.raises(InputError, match=r"torque of wrist is 0\.3 in every row"):
        refuse_unmeasured(robot, dead)
