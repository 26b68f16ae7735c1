"""Malformed input for every reader and the command line: no traceback, no hang, no bomb, nothing executed.

    python benchmarks/fuzz.py --count 20000          # nightly; --workers 2 for two processes
    python benchmarks/fuzz.py --minutes 1            # what `make fuzz` runs
    python benchmarks/fuzz.py --replay FOLDER        # what a run has kept of its findings

Each input starts from a right file or from one that reached new lines of the package before (coverage as guide) and is
changed a few times: bytes, words of a dictionary, keys and values of the tree, numbers, shapes and headers of arrays.
Only `InputError` (or status 0 or 2 and one line of message) is an answer; anything else, an input of more than ten
seconds, one that takes more than 2 GB, or one that runs planted code is a finding and kept with its seed.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import io
import json
import logging
import os
import pickle
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
PACKAGE = str(ROOT / "figaroh_jax")
SECONDS, WAITING, BYTES = 10, 300, 2 << 30

WORDS = """
nan inf -inf 1e400 1e200 -1 0 0x1p999 1_0 1:1:1 ~ null true yes !!timestamp !!int !!float !!bool !!set !!binary
!!python/object/apply:os.mkdir !!str !!map !!seq !!omap &a *a <<: {} [] {[]:1} ? - | > % @ ` \x00 \x1b[31m
\ud800 é ä ../ / //// . .. ~root file:///etc/passwd package://x/y /dev/zero /dev/stdin /proc/self/mem robot.urdf
run1.npz task.yaml deg mm ns A rad holdout fit free_flyer fixed joints posture data robot extends preprocess
window cutoff rate gate units position velocity torque command measurement pose plane socket camera baseline
effects at effect transmission offset mass inertia origin axis limit mimic joint link parent child name type
value xyz rpy lower upper effort multiplier body geom site inertial default class include replicate count
composite freejoint equality tendon actuator
""".split()
NUMBERS = [0, -1, 1, 1e-320, 1e200, 1e308, -1e308, 2**31, 2**63, 2**64, 10**40, float("nan"), float("inf"), 0.1]


class Source:
    """Random choices of one input; the seed says them all."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.array = np.random.default_rng(seed)

    def of(self, some: Any) -> Any:
        return self.random.choice(list(some))

    def once_in(self, count: int) -> bool:
        return self.random.randrange(count) == 0


def mutated_bytes(data: bytes, source: Source) -> bytes:
    """A few changes that know nothing of the format."""
    out = bytearray(data)
    for _ in range(source.random.choice((1, 1, 2, 4, 8))):
        at = source.random.randrange(len(out) + 1)
        kind = source.random.randrange(8)
        if kind == 0 and out:
            out[at % len(out)] ^= 1 << source.random.randrange(8)
        elif kind == 1:
            out[at:at] = source.of(WORDS).encode("utf-8", "surrogatepass")
        elif kind == 2:
            del out[at : at + source.random.randrange(1, 40)]
        elif kind == 3:
            out[at:at] = out[at : at + source.random.randrange(1, 60)] * source.random.choice((1, 1, 2, 50))
        elif kind == 4:
            out[at : at + 1] = bytes([source.random.randrange(256)])
        elif kind == 5:
            del out[at:]
        elif kind == 6:
            out[at:at] = str(source.of(NUMBERS)).encode()
        else:
            other = source.random.randrange(len(out) + 1)
            out[at:at] = out[other : other + 30]
    return bytes(out)


def mutated_tree(tree: Any, source: Source) -> Any:
    """A tree of keys and values with one of its nodes changed, removed, doubled or renamed."""
    if isinstance(tree, dict) and tree and not source.once_in(6):
        key = source.of(tree)
        changed = dict(tree)
        kind = source.random.randrange(8)
        if kind == 0:
            del changed[key]
        elif kind == 1:
            changed[source.of(WORDS)] = changed[key]
        elif kind == 2:
            changed[source.of((1, None, True, 2.5, "", "a" * 300))] = junk(source)
        else:
            changed[key] = mutated_tree(tree[key], source)
        return changed
    if isinstance(tree, list) and tree and not source.once_in(6):
        at = source.random.randrange(len(tree))
        kind = source.random.randrange(6)
        if kind == 0:
            return tree[:at] + tree[at + 1 :]
        if kind == 1:
            return tree + [tree[at]] * source.random.choice((1, 2, 500))
        return [*tree[:at], mutated_tree(tree[at], source), *tree[at + 1 :]]
    return junk(source)


def junk(source: Source) -> Any:
    """A value that nobody expects."""
    return source.of(
        [None, True, [], {}, [[]], [{}], "", "a" * 300, "\0", "x/" * 200, {"a": {"b": {"c": []}}}, [None] * 3]
        + NUMBERS
        + [source.of(WORDS), [source.of(NUMBERS)] * source.random.randrange(5), {source.of(WORDS): source.of(NUMBERS)}]
    )


class Bench:
    """A folder with a right task, its robot in both formats and its recordings in three."""

    def __init__(self, folder: Path) -> None:
        import tasks

        self.folder, self.accepted, self.most = folder, 0, 0
        logging.disable(logging.CRITICAL)  # warnings of the check of recordings
        tasks.write(folder)
        from figaroh_jax.effects.extended import extend
        from figaroh_jax.formats.export import write_model
        from figaroh_jax.formats.urdf import load_urdf

        write_model(extend(load_urdf(folder / "robot.urdf")), folder / "model")
        shutil.copy(folder / "model" / "robot.xml", folder / "robot.xml")
        self.arrays = {name: np.asarray(x)[:40] for name, x in tasks.arrays().items()}
        self.columns = {
            f"{name}{'' if x.ndim == 1 else k + 1}": (x if x.ndim == 1 else x[:, k])
            for name, x in self.arrays.items()
            for k in range(1 if x.ndim == 1 else x.shape[1])
        }
        self.task = {**tasks.task(), "transmission": {"position": np.eye(3).tolist(), "offset": [0.0] * 3}}
        self.task["robot"] |= {"root": "fixed", "posture": {}, "joints": ["shoulder", "elbow", "slide"], "trust": 0.1}
        self.task["baseline"] = {"viscous": True, "effects": [{"effect": "joint_spring", "at": ["elbow"]}]}
        self.task["diagnose"] = {"forbid": ["payload"], "alpha": 0.05}
        self.poses = {
            "robot": {"model": "robot.urdf"},
            "data": [{"file": "run1.npz", "position": "q", "measurement": {"position": "dq", "tool_frame": "tool0"}}],
        }
        self.texts = {name: (folder / name).read_bytes() for name in ("robot.urdf", "robot.xml", "task.yaml")}
        self.texts["effects.yaml"] = (folder / "model" / "effects.yaml").read_bytes()
        self.canary = folder / "ran"
        self._rollout()
        self._runs()

    def _rollout(self) -> None:
        """A servo arm: commands and positions, an MJCF with an actuator, a URDF with drives that the task states."""
        from generators import servo_arm

        (self.folder / "arm.xml").write_text(servo_arm.model_text())
        for name, seed in (("servo1", 7), ("servo2", 8)):
            arrays = servo_arm.record("none", seed)
            np.savez(self.folder / f"{name}.npz", **{key: x[:400] for key, x in arrays.items()})  # pyright: ignore
        columns = {"time": "t", "command": "u", "position": "q", "velocity": "dq"}
        self.rollout = {
            "robot": {"model": "arm.xml"},
            "data": [{"file": "servo1.npz", **columns}, {"file": "servo2.npz", "role": "holdout", **columns}],
            "actuator": {"joint": {"kind": "position", "kp": 60.0, "kd": 1.0, "force": 30.0}, "gains": "known"},
        }

    def _runs(self) -> None:
        """Two finished runs, with the files that the commands on runs read."""
        from test_run_tools import ANSWER, CALIBRATION, RESULT, run

        from figaroh_jax.rollouts.reading import load_loop
        from figaroh_jax.rollouts.stored import add_loop

        for name in ("first", "second"):
            run(self.folder / "runs" / name, self.folder / "task.yaml", answer=ANSWER, result=RESULT)
        loop_folder = self.folder / "loop"
        loop_folder.mkdir()
        shutil.copy(self.folder / "arm.xml", loop_folder / "robot.xml")
        add_loop(loop_folder, load_loop(self.folder / "arm.xml")[0])
        first = self.folder / "runs" / "first"
        self.run_files: dict[str, Any] = {
            "answer.json": json.dumps(ANSWER, indent=1),
            "result.json": json.dumps(RESULT, indent=1),
            "calibration.json": json.dumps(CALIBRATION, indent=1),
            "provenance.json": (first / "provenance.json").read_text(),
            "figaroh-jax-run.json": (first / "figaroh-jax-run.json").read_text(),
        }
        self.loop_text = (loop_folder / "loop.json").read_text()
        self.kept = {path: path.read_bytes() for path in self.folder.rglob("*") if path.is_file()}

    def mend(self) -> None:
        """The files as they were."""
        for path, data in self.kept.items():
            with contextlib.suppress(OSError):
                if not path.is_file() or path.read_bytes() != data:
                    path.parent.mkdir(exist_ok=True, parents=True)
                    path.write_bytes(data)

    def planted(self) -> bytes:
        """A pickle that makes the canary when it is read."""

        class Ran:
            def __reduce__(self, file=str(self.canary)):
                return os.mkdir, (file,)

        return pickle.dumps(Ran())


def yaml_input(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
    if source.once_in(2):
        tree = source.of((bench.task, bench.poses, bench.rollout))
        for _ in range(source.random.choice((1, 1, 2, 3))):
            tree = mutated_tree(tree, source)
        text = yaml.dump(tree, allow_unicode=True, sort_keys=False).encode("utf-8", "surrogatepass")
    else:
        text = source.of([bench.texts["task.yaml"], *seen[-200:]])
    return mutated_bytes(text, source) if source.once_in(2) else text.replace(b"ran", str(bench.canary).encode())


def text_input(name: str) -> Callable[[Bench, Source, list[bytes]], bytes]:
    def make(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
        text = source.of([bench.texts[name], *seen[-200:]])
        if source.once_in(2):  # a number or a word in quotes becomes another
            parts = text.split(b'"')
            for _ in range(source.random.choice((1, 2, 5))):
                at = source.random.randrange(len(parts))
                parts[at | 1 if (at | 1) < len(parts) else at] = str(source.of([*NUMBERS, *WORDS])).encode(
                    "utf-8", "replace"
                )
            return b'"'.join(parts)
        lines = text.splitlines(keepends=True)
        if lines and source.once_in(3):  # an element once more, or somewhere else
            lines.insert(source.random.randrange(len(lines)), source.of(lines))
            return b"".join(lines)
        return mutated_bytes(text, source)

    return make


def odd_array(right: np.ndarray, source: Source) -> np.ndarray:
    """The array in another type, shape or with other numbers."""
    kinds: list[Callable[[], Any]] = [
        lambda: right.astype(source.of(("f2", "f4", "i1", "u8", "c16", "?", "S3", "U4", "U0", "S0", "M8[s]", ">f8"))),
        lambda: right[: source.random.randrange(4)],
        lambda: right.T,
        lambda: right[..., None],
        lambda: np.array(source.of([*NUMBERS[:6], "", "x", b"", True])),
        lambda: np.array([], dtype=source.of(("f8", "U1", "S1", "c8"))),
        lambda: np.array([("a", 1.0)] * 3, dtype=[("name", "U4"), ("x", "f8")]),
        lambda: np.zeros(source.of(((0, 3), (3, 0), (40, 0), (1, 1, 1), (40, 3, 0)))),
        lambda: np.where(source.array.random(right.shape) < 0.05, float(source.of(NUMBERS[:9])), right),
        lambda: np.array([[1, "a"], [None, 2]], dtype=object),
        lambda: right,
    ]
    try:
        return np.asarray(source.of(kinds)())
    except (ValueError, TypeError, IndexError, OverflowError):
        return right


def npz_input(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
    arrays = dict(bench.arrays)
    for _ in range(source.random.choice((0, 1, 2))):
        arrays[source.of((*arrays, "", "x/y", "../up", "a" * 300))] = odd_array(arrays[source.of(arrays)], source)
    memory = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with zipfile.ZipFile(memory, "w", source.of((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
            for name, array in arrays.items():
                entry = io.BytesIO()
                np.lib.format.write_array(entry, array, allow_pickle=True)
                data = entry.getvalue()
                if source.once_in(8):
                    size = source.of((10**3, 10**6, 10**10, 10**15, -1))
                    data = data.replace(b"(40,", f"({size},".encode(), 1)
                if source.once_in(10):
                    data = mutated_bytes(data, source)
                if source.once_in(20):
                    data = bench.planted()
                archive.writestr(name + (".npy" if not name or source.random.random() < 0.8 else ""), data)
    data = memory.getvalue()
    return mutated_bytes(data, source) if source.once_in(3) else data


def csv_input(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
    mark = source.of(",;\t |")
    names = list(bench.columns)
    rows = np.stack(list(bench.columns.values()), axis=1)[: source.of((0, 1, 3, 40))]
    lines = [mark.join(names), *(mark.join(map(repr, map(float, row))) for row in rows)]
    for _ in range(source.random.choice((0, 1, 3))):
        at = source.random.randrange(len(lines))
        cells = lines[at].split(mark)
        cells[source.random.randrange(len(cells))] = str(source.of([*NUMBERS, *WORDS, "", '"', "a" * 5000]))
        lines[at] = mark.join(cells[: source.of((len(cells), len(cells), 1))])
    text = source.of(("\n", "\r\n", "\r")).join(lines)
    data = text.encode(source.of(("utf-8", "utf-8", "utf-8-sig", "utf-16", "latin-1")), "replace")
    return mutated_bytes(data, source) if source.once_in(3) else data


def parquet_input(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
    import pyarrow as pa
    from pyarrow import parquet

    columns: dict[str, Any] = {name: pa.array(x) for name, x in bench.columns.items()}
    count = 40
    for _ in range(source.random.choice((0, 1, 2))):
        odd: list[Callable[[], Any]] = [
            lambda: pa.array([None] * count),
            lambda: pa.array(["x"] * count),
            lambda: pa.array([[1.0] * source.random.randrange(3) for _ in range(count)]),
            lambda: pa.array([{"a": 1}] * count),
            lambda: pa.array([2**62] * count, pa.timestamp("ns")),
            lambda: pa.array([b""] * count),
            lambda: pa.array(["a"] * count).dictionary_encode(),
            lambda: pa.array([1] * count, pa.decimal128(38, 5)),
        ]
        columns[source.of((*columns, "", "x" * 300))] = source.of(odd)()
    memory = io.BytesIO()
    parquet.write_table(pa.table(columns), memory, compression=source.of(("snappy", "gzip", "none")))
    return mutated_binary(memory.getvalue(), 4, 8, source)


def mutated_binary(data: bytes, head: int, foot: int, source: Source) -> bytes:
    """As it is, a few changes, or random bytes between a head and a foot that stay: what crashes readers in C."""
    if source.once_in(3):
        return data
    if source.once_in(2) or len(data) <= head + foot:
        return mutated_bytes(data, source)
    inside = np.frombuffer(data[head : len(data) - foot], np.uint8).copy()
    count = source.of((1, 10, 100, len(inside)))
    inside[source.array.integers(0, len(inside), count)] = source.array.integers(0, 256, count)
    return data[:head] + inside.tobytes() + data[len(data) - foot :]


def mat_input(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
    from scipy.io import savemat

    arrays: dict[str, Any] = dict(bench.arrays)
    for _ in range(source.random.choice((0, 1, 2))):
        arrays[source.of((*arrays, "log", "a" * 31))] = odd_array(bench.arrays[source.of(bench.arrays)], source)
    arrays["log"] = {name: arrays[name] for name in list(arrays)[:2]}
    memory = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            savemat(memory, arrays, do_compression=source.once_in(2), format=source.of(("5", "5", "4")))
        except (TypeError, ValueError, AttributeError):  # what MATLAB has no kind for
            savemat(memory := io.BytesIO(), bench.arrays)
    return mutated_binary(memory.getvalue(), 128, 0, source)


def hdf5_input(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
    import h5py

    memory = io.BytesIO()
    with h5py.File(memory, "w") as opened:
        for name, values in bench.arrays.items():
            odd = odd_array(values, source) if source.once_in(3) else values
            try:
                packed = {"compression": "gzip", "chunks": True} if source.once_in(2) and odd.size > 9 else {}
                opened.create_dataset(name, data=odd, **packed)
            except (TypeError, ValueError):  # what HDF5 has no kind for
                opened.create_dataset(name, data=values)
    return mutated_binary(memory.getvalue(), 8, 0, source)


COMMANDS = {  # what may follow each: right words often, wrong ones now and then
    "diagnose": ("task.yaml", "poses.yaml"),
    "identify": ("task.yaml",),
    "calibrate": ("poses.yaml", "task.yaml"),
    "excite": ("task.yaml",),
    "rerun": ("runs/first", "runs/second"),
    "demo": (),
    "verify": ("runs/first", "runs/second"),
    "compare": ("runs/first", "runs/second", "runs/first"),
    "list": (".", "runs"),
    "export": ("loop", "model"),
    "view": ("runs/first", "runs/second"),
    "new": ("robot.urdf", "run1.npz", "run2.npz", "arm.xml", "robot.xml"),
}
OPTIONS = (
    "--out --json --quiet --backend --level --no-priors --no-cache --help --traceback --for --limits --junit --joints"
    " --rate --constants --gears --unit --kp --port --version"
).split()
PLACES = (".", "", "..", "out", "out/../out", "n" * 300, "o/" * 200, "task.yaml", "task.yaml/x", "/", "runs/first")


def argv_input(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
    """Words of a command line; `--out /` and the like stay in the bench's folder or are refused."""
    command = source.of(COMMANDS) if not source.once_in(20) else source.of(("", "x", "--", "-"))
    words = [command]
    known = COMMANDS.get(command, ()) or ("task.yaml",)
    for _ in range(source.random.choice((0, 1, 1, 2, 2, 3))):
        words.append(source.of(known) if not source.once_in(5) else source.of(("", ".", "\1", *PLACES, *WORDS)))
    for _ in range(source.random.choice((0, 0, 1, 2, 3))):
        option = source.of(OPTIONS)
        words.append(option)
        values = {
            "--for": ("mujoco", "newton", "isaaclab", "genesis", "drake", "x"),
            "--limits": ("limits.yaml", "task.yaml"),
            "--joints": ("shoulder,elbow,slide", "shoulder", ",,", "x"),
            "--rate": ("250", "0", "nan", "-1", "1e400", "x"),
            **dict.fromkeys(("--constants", "--gears", "--kp"), ("1,2,3", "nan,1,1", "1", "1e400,0,0", "x")),
            "--unit": ("rad", "deg", "x"),
            "--port": ("0", "8080", "-1", "99999", "x"),
        }
        if option in values:
            words.append(source.of(values[option]))
        elif option in ("--out", "--backend", "--level", "--junit"):
            words.append(source.of((*PLACES, source.of(WORDS))))
    return json.dumps(words).encode()


def json_input(files: Callable[[Bench], dict[str, str]]) -> Callable[[Bench, Source, list[bytes]], bytes]:
    """One of several JSON files changed; its name stands on the first line."""

    def make(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
        texts = files(bench)
        name = source.of(texts)
        if source.once_in(3):
            return name.encode() + b"\n" + mutated_bytes(texts[name].encode(), source)
        tree = json.loads(texts[name])
        for _ in range(source.random.choice((1, 1, 2, 4))):
            tree = mutated_tree(tree, source)
        return name.encode() + b"\n" + json.dumps(tree).encode("utf-8", "replace")

    return make


def limits_input(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
    tree: Any = {
        "verdict": ["named"],
        "consistent": True,
        "fk_parity": 1e-9,
        "holdout": 0.1,
        "holdout_joint": {"j1": 0.05},
        "condition": 1e3,
    }
    for _ in range(source.random.choice((0, 1, 1, 2, 3))):
        tree = mutated_tree(tree, source)
    text = yaml.dump(tree, allow_unicode=True, sort_keys=False).encode("utf-8", "surrogatepass")
    return mutated_bytes(text, source) if source.once_in(3) else text


def call_input(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
    """A call of a function of arrays: the seed says which arrays, so that the input can be replayed."""
    return json.dumps([source.of(CALLS), source.random.randrange(2**32)]).encode()


def draft_input(bench: Bench, source: Source, seen: list[bytes]) -> bytes:
    kind = source.of((npz_input, npz_input, csv_input))
    return (b"npz" if kind is npz_input else b"csv") + b"\n" + kind(bench, source, seen)


def read_task(bench: Bench, file: Path) -> None:
    """Everything that the commands read before they compute."""
    from figaroh_jax.formats.config import load_task
    from figaroh_jax.formats.robotfile import load_robot, stated_baseline
    from figaroh_jax.recordings.checks import check_recordings
    from figaroh_jax.recordings.dataset import read_recordings
    from figaroh_jax.recordings.poses import read_pose_recordings
    from figaroh_jax.recordings.posture_checks import check_pose_recordings
    from figaroh_jax.reporting.run_directory import check_directory, task_inputs

    task = load_task(file)
    check_directory(bench.folder / "out", task_inputs(file))
    from figaroh_jax.rollouts.task import read_rollouts

    if task.of_rollouts:
        read_rollouts(task)
        return
    robot = load_robot(task)
    stated_baseline(task)
    if task.of_postures:
        check_pose_recordings(task, robot, read_pose_recordings(task, robot))
    else:
        from figaroh_jax.recordings.signals import choose_rates, prepare

        recordings = read_recordings(task, robot)
        check_recordings(task, robot, recordings)
        rates = choose_rates(recordings, task.preprocess)
        for recording in recordings:
            prepare(recording, task.preprocess, rates)


def read_robot_file(bench: Bench, file: Path) -> None:
    from figaroh_jax.formats.robotfile import load_extended

    model = load_extended(file, root=None).model.robot
    for leaf in ("placement", "axis", "inertia", "ratio", "offset", "gravity", "frame_placement"):
        values = np.asarray(getattr(model, leaf))
        assert (np.abs(values) <= 1e12).all(), f"{leaf} has {values.ravel()[np.argmax(np.abs(values))]}"


def read_recording(bench: Bench, file: Path) -> None:
    from figaroh_jax.recordings.reading import read_table

    table = read_table(file, "data[0].file")
    joints = ("shoulder", "elbow", "slide")
    for read in (lambda: table.vector("t", "time"), lambda: table.matrix("q", joints, "position")):
        with contextlib.suppress(ValueError):
            read()
    for source in ("tau", ["q1", "q2", "q3"]):
        table.matrix(source, joints, "torque")


def read_model(bench: Bench, file: Path) -> None:
    from figaroh_jax.formats.export import load_model

    shutil.copy(file, bench.folder / "model" / "effects.yaml")
    load_model(bench.folder / "model")


def run_command(bench: Bench, file: Path) -> None:
    """A command line whose jobs read everything and then stop."""
    command_line(bench, json.loads(file.read_bytes()))


def command_line(bench: Bench, words: list[str]) -> None:
    """One command line, in the bench's folder; what it changes there is mended."""
    from figaroh_jax import cli
    from figaroh_jax.errors import InputError
    from figaroh_jax.jobs import commands, run

    def job(task_file: Path, out: Path, progress: Any, backend: str, **options: Any) -> None:
        run.task_for(task_file, out)
        read_task(bench, task_file)
        raise InputError("stop")

    before = {name: entry._replace(run=job) for name, entry in commands.COMMANDS.items()}
    original = dict(commands.COMMANDS)
    commands.COMMANDS.update(before)
    out, error = io.StringIO(), io.StringIO()
    here = os.getcwd()
    os.chdir(bench.folder)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
            status = cli.main(words)
    finally:
        os.chdir(here)
        commands.COMMANDS.update(original)
        changed = [path.name for path, data in bench.kept.items() if _differs(path, data) and path.name not in OURS]
        bench.mend()
    assert not changed, f"files of the user's were changed: {changed}"
    assert status in (0, 2) or (status == 1 and words[0] == "verify"), f"status {status}: {error.getvalue()}"
    told = "internal error" in error.getvalue() or ("Traceback" in error.getvalue() and "--traceback" not in words)
    assert not told, error.getvalue()


OURS = ("verification.json", "figaroh-jax-run.json", "task.yaml", "effects.yaml")  # of runs; inputs themselves


def _differs(path: Path, data: bytes) -> bool:
    return not path.is_file() or path.stat().st_size != len(data) or path.read_bytes() != data


def read_run_files(bench: Bench, file: Path) -> None:
    """The commands on runs, where one file of a run is damaged."""
    name, _, data = file.read_bytes().partition(b"\n")
    name = b"result.json" if name == b"calibration.json" else name
    where = bench.folder / ("loop" if name == b"loop.json" else "runs/second") / name.decode()
    right = where.read_bytes() if where.is_file() else None
    where.write_bytes(data)
    if right is not None:
        bench.kept[where] = data
    lines = [["verify", "runs/second", "--json"], ["compare", "runs/first", "runs/second", "--out", "page.html"]]
    lines += [["list", "runs"], ["rerun", "runs/second", "--quiet"], ["diagnose", "task.yaml", "--out", "runs/second"]]
    lines = random.Random(data).sample(lines, 2)
    if name == b"loop.json":
        lines = [["export", "loop", "--for", simulator] for simulator in ("mujoco", "newton", "isaaclab")]
        lines[0] += ["--out", "exported"]
    try:
        for words in lines:
            command_line(bench, words)
    finally:
        for made in ("page.html", "exported"):
            path = bench.folder / made
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        if right is None:
            where.unlink(missing_ok=True)
        else:
            bench.kept[where] = right
        bench.mend()


def read_limits(bench: Bench, file: Path) -> None:
    command_line(bench, ["verify", "runs/first", "--limits", file.name])


def draft(bench: Bench, file: Path) -> None:
    """`new` on a recording that is malformed."""
    suffix, _, data = file.read_bytes().partition(b"\n")
    recording = bench.folder / f"drafted.{suffix.decode()}"
    recording.write_bytes(data)
    command_line(bench, ["new", "robot.urdf", recording.name])
    command_line(bench, ["new", "robot.urdf", recording.name, "--joints", "shoulder,elbow,slide", "--rate", "250"])


CALLS = (
    "recording postures residual torque_data predict integrate inverse_dynamics mass_matrix regressor normal_matrix"
    " frame_placement gravity effect"
).split()


def call(bench: Bench, file: Path) -> None:
    """A public function on odd arrays; what it gives has the right shape, and no NaN where none went in."""
    import figaroh_jax as fj
    from figaroh_jax.rigid import derivatives, manifold

    name, seed = json.loads(file.read_bytes())
    source = Source(seed)
    model = fj.load_urdf(bench.folder / "robot.urdf")
    given: dict[str, Any] = {key: np.array(bench.arrays[key]) for key in ("q", "dq", "tau")}
    for key in source.random.sample(list(given), source.random.choice((0, 1, 1, 2))):
        given[key] = source.of((odd_array(given[key], source), odd_array(given[key], source), junk(source)))
    q, v, tau = given.values()
    time = odd_array(bench.arrays["t"], source) if source.once_in(3) else bench.arrays["t"]
    units = source.of((None, None, {"position": "deg"}, {"position": source.of(WORDS)}, {source.of(WORDS): "s"}))
    last = model.frames[-1].name if not source.once_in(6) else source.of(WORDS)
    frames = {"base_frame": "base", "tool_frame": last}
    calls: dict[str, Callable[[], Any]] = {
        "recording": lambda: fj.recording(q=q, v=v, tau=tau, time=time, model=model, units=units),
        "postures": lambda: fj.postures(q=q, position=v, units=units, **frames),
        "residual": lambda: fj.residual(model, fj.recording(q=q, tau=tau, time=time)),
        "torque_data": lambda: fj.torque_data(model, fj.recording(q=q, tau=tau, rate=100)),
        "predict": lambda: fj.predict(fj.extend(model), time, q, v, tau, 0.01),
        "integrate": lambda: manifold.integrate(model, q, v),
        "inverse_dynamics": lambda: fj.inverse_dynamics(model, q, v, tau),
        "mass_matrix": lambda: fj.mass_matrix(model, q),
        "regressor": lambda: fj.joint_torque_regressor(model, q, v, tau),
        "normal_matrix": lambda: fj.normal_matrix(model, q, v, tau, tau, weight=source.of((None, v, 1.0, "x"))),
        "frame_placement": lambda: fj.frame_placement(model, q, last),
        "gravity": lambda: derivatives.gravity_vector(model, q),
        "effect": lambda: fj.place(
            fj.CATALOGUE[source.of(tuple(fj.CATALOGUE)) if source.once_in(2) else "viscous_friction"],
            model,
            source.of((["elbow"], ["x"], [], None, "elbow", ["elbow", "elbow"])),
            **source.of(
                ({}, {"damping": source.of(NUMBERS)}, {"damping": source.of(WORDS)}, {"x" + source.of(WORDS): 1})
            ),
        ),
    }
    calls[name]()


KINDS: dict[str, tuple[str, int, Callable[..., bytes], Callable[[Bench, Path], None]]] = {
    "task": ("task.yaml", 8, yaml_input, read_task),
    "urdf": ("fuzzed.urdf", 6, text_input("robot.urdf"), read_robot_file),
    "mjcf": ("fuzzed.xml", 5, text_input("robot.xml"), read_robot_file),
    "npz": ("fuzzed.npz", 5, npz_input, read_recording),
    "csv": ("fuzzed.csv", 5, csv_input, read_recording),
    "parquet": ("fuzzed.parquet", 3, parquet_input, read_recording),
    "mat": ("fuzzed.mat", 3, mat_input, read_recording),
    "hdf5": ("fuzzed.h5", 3, hdf5_input, read_recording),
    "effects": ("effects.yaml", 2, text_input("effects.yaml"), read_model),
    "argv": ("argv.json", 6, argv_input, run_command),
    "run": ("run.bin", 2, json_input(lambda bench: bench.run_files), read_run_files),
    "loop": ("loop.bin", 1, json_input(lambda bench: {"loop.json": bench.loop_text}), read_run_files),
    "limits": ("limits.yaml", 1, limits_input, read_limits),
    "new": ("draft.bin", 2, draft_input, draft),
    "call": ("call.json", 3, call_input, call),
}


class Late(BaseException):
    """An input takes longer than it may."""


@contextlib.contextmanager
def limits() -> Iterator[None]:
    """Ten seconds of the processor for what is inside, and five minutes for what waits (the machine may be busy)."""

    def late(number: int, frame: Any) -> None:
        raise Late

    signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    faulthandler.dump_traceback_later(WAITING, exit=True)  # a library that does not come back
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        faulthandler.cancel_dump_traceback_later()


class Coverage:
    """Lines of the package that inputs have reached."""

    def __init__(self) -> None:
        self.lines: set[tuple[str, int]] = set()

    def __call__(self, frame: Any, event: str, argument: Any) -> Any:
        return self._line if frame.f_code.co_filename.startswith(PACKAGE) else None

    def _line(self, frame: Any, event: str, argument: Any) -> Any:
        self.lines.add((frame.f_code.co_filename, frame.f_lineno))
        return self._line


def tried(bench: Bench, kind: str, data: bytes, coverage: Coverage | None) -> str | None:
    """What is wrong with the answer to an input; None for a right one."""
    from figaroh_jax.errors import InputError

    name, _, _, read = KINDS[kind]
    file = bench.folder / name
    file.write_bytes(data)
    begin = time.process_time()
    found = None
    try:
        with limits(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sys.settrace(coverage)
            read(bench, file)
        bench.accepted += 1
    except InputError as error:
        if len(str(error)) > 100_000:
            found = "a message of more than 100 000 characters"
    except Late:
        found = f"more than {SECONDS} s\n{traceback.format_exc(limit=-8)}"
    except BaseException:
        found = traceback.format_exc(limit=-8)
    finally:
        sys.settrace(None)
    if time.process_time() - begin > SECONDS:
        found = found or f"{time.process_time() - begin:.0f} s"
    if bench.canary.exists():
        bench.canary.rmdir()
        found = "planted code ran"
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if peak > BYTES + bench.most:
        bench.most = peak
        found = found or f"{peak >> 20} MiB of memory"
    return found


def work(args: argparse.Namespace) -> int:
    """One process: inputs until the count or the time is used up; a line of JSON for each finding and at the end."""
    resource.setrlimit(resource.RLIMIT_AS, (12 << 30, 12 << 30))
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    os.environ["XDG_CACHE_HOME"] = str(folder / "cache")
    bench = Bench(folder)
    bench.most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    coverage, corpus, done = Coverage(), {kind: list[bytes]() for kind in KINDS}, Counter[str]()
    kinds = [kind for kind, (_, weight, _, _) in KINDS.items() for _ in range(weight) if kind in args.kinds]
    end = time.monotonic() + 60 * args.minutes
    for number in range(args.count):
        if time.monotonic() > end or (args.keep / "stop").exists():
            break
        seed = args.seed + args.worker + number * args.workers
        source = Source(seed)
        kind = source.of(kinds)
        data = KINDS[kind][2](bench, source, corpus[kind])
        (args.keep / f"last-{args.worker}").write_bytes(kind.encode() + b"\n" + data)
        before = len(coverage.lines)
        found = tried(bench, kind, data, coverage if number % args.guide == 0 else None)
        done[kind] += 1
        if found:
            (args.keep / f"{kind}-{seed}").write_bytes(kind.encode() + b"\n" + data)
            print(json.dumps({"seed": seed, "kind": kind, "found": found}), flush=True)
        elif len(coverage.lines) > before and len(data) < 100_000 and kind not in ("run", "loop", "new", "call"):
            corpus[kind].append(data)
        if kind == "task" or number % 500 == 0:
            bench.mend()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    print(
        json.dumps({"done": done, "accepted": bench.accepted, "lines": len(coverage.lines), "peak_MiB": peak}),
        flush=True,
    )
    shutil.rmtree(folder, ignore_errors=True)
    return 0


def replay(folder: Path) -> int:
    """Try the findings that a run has kept once more."""
    bench = Bench(Path(tempfile.mkdtemp(prefix="fuzz-")))
    bench.most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    wrong = 0
    for file in sorted(folder.iterdir()):
        kind, _, data = file.read_bytes().partition(b"\n")
        found = tried(bench, kind.decode(), data, None)
        wrong += found is not None
        print(f"{file.name}: {'right' if found is None else found}")
    return wrong > 0


def main() -> int:
    """Start the workers, collect what they find; status 1 where anything was found."""
    parser = argparse.ArgumentParser(description="Malformed input for every reader and the command line.")
    parser.add_argument("--count", type=int, default=10**9, help="inputs in all")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=int(time.time()) << 20)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--guide", type=int, default=5, help="of so many inputs one is traced for its coverage")
    parser.add_argument("--keep", type=Path, default=Path(tempfile.gettempdir()) / "fuzz-findings")
    parser.add_argument("--replay", type=Path)
    parser.add_argument("--worker", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.replay:
        return replay(args.replay)
    args.keep.mkdir(parents=True, exist_ok=True)
    if args.worker is not None:
        return work(args)
    passed_on = [f"--{name}={getattr(args, name)}" for name in ("minutes", "seed", "workers", "guide", "keep")]
    passed_on += [f"--count={-(-args.count // args.workers)}", "--kinds", *args.kinds]
    command = [sys.executable, __file__, *passed_on]
    started = [
        subprocess.Popen([*command, f"--worker={k}"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for k in range(args.workers)
    ]
    findings, done = 0, Counter[str]()
    for k, process in enumerate(started):
        out, errors = process.communicate()
        for line in map(json.loads, filter(None, out.splitlines())):
            findings += "found" in line
            done.update(line.get("done", {}))
            print(f"{line['kind']} {line['seed']}: {line['found']}" if "found" in line else line)
        if process.returncode:
            findings += 1
            print(
                f"worker {k} ended with {process.returncode}; last input: {args.keep / f'last-{k}'}\n{errors[-3000:]}"
            )
    print(f"{sum(done.values())} inputs ({dict(done)}), {findings} findings; seed {args.seed}")
    return findings > 0


if __name__ == "__main__":
    sys.exit(main())
