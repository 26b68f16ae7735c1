"""Calibration on real sets, and the solver's speed against FIGAROH and against SciPy with finite differences.

    python benchmarks/calibration.py [sets] [speed] [figaroh] [POSTURES ...]

`sets` calibrates the recordings of $FIGAROH_JAX_DATA with everything chosen inside five folds (MUKCa: on tool positions
that were not fitted) and prints error and names. `speed` solves one problem, UR10e poses with its identifiable
parameters, with both (Pinocchio in a Python loop for SciPy), in interleaved rounds, for 50 to 10 000 POSTURES or those
told. `figaroh` does the same with FIGAROH 1.0.2 on its own sets, in the environment that `regressor.py` makes. CPU
seconds; cold is that of a fresh process from its first line to the answer, imports among them, with Python's bytecode
but without any cache of programs; it tells peak memory too.
"""

from __future__ import annotations

import atexit
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pinocchio_calibration import Peer

from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.recordings.poses import PoseRecording

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
BOTH = ("base_frame", "tool_frame")
PANDA = [f"panda_joint{k}" for k in range(1, 8)]
TOOL_POSITIONS = {"panda_2_clean": (0, 3, 7), "panda_3": (2, 4), "panda_4_clean": (0, 1), "panda_1": (0,)}  # fitted


def recording(q: np.ndarray, kind: str, values: np.ndarray, base: str, tool: str, **more) -> PoseRecording:
    """A recording made in memory."""
    unknown = more.pop("unknown", BOTH)
    return PoseRecording("set", Path("set"), np.arange(float(len(q))), q, kind, values, base, tool, unknown, **more)  # pyright: ignore[reportArgumentType]


def talos():
    joints = ["torso_1_joint", "torso_2_joint", *(f"arm_left_{k}_joint" for k in range(1, 8))]
    table = np.genfromtxt(DATA / "talos_contact" / "talos_left_arm_02_10_contact.csv", delimiter=",", skip_header=1)
    seen = recording(table[:, 4:13], "position", table[:, 1:4], "base_link", "gripper_left_base_link")
    return load_urdf(DATA / "talos_contact" / "talos_full_v2.urdf", joints=joints), [seen]


def tiago(keep: bool = False, markers: int = 1):
    joints = ["torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8))]
    model = load_urdf(DATA / "tiago_mocap" / "tiago_no_hand.urdf", joints=joints)
    table = np.genfromtxt(DATA / "tiago_mocap" / "qualysis_base_hand_calibration.csv", delimiter=",", skip_header=1)
    rows = np.arange(len(table)) if keep else np.delete(np.arange(len(table)), 9)
    root = next(frame.name for frame in model.frames if frame.parent < 0)
    points = table[rows, : 3 * markers].reshape(len(rows), markers, 3)
    return model, [recording(table[rows, 12:20], "position", points, root, "arm_7_link")]


def irb120():
    model, z = load_urdf(DATA / "irb120_wu2015" / "irb120.urdf"), np.load(DATA / "irb120_wu2015" / "irb120_wu.npz")
    root = next(frame.name for frame in model.frames if frame.parent < 0)
    return model, [recording(np.deg2rad(z["cali_q_deg"]), "position", 1e-3 * z["cali_xyz_mm"], root, "tool0")]


def handeye():
    folder = DATA / "panda_handeye_board"
    model, z = load_urdf(folder / "panda.urdf", joints=PANDA), np.load(folder / "panda_handeye.npz")
    root = next(frame.name for frame in model.frames if frame.parent < 0)
    return model, [recording(z["q"], "pose", z["T_board_cam"], root, "panda_link8")]


def mukca(name: str):
    model = load_urdf(DATA / "mukca_panda" / "panda.urdf", joints=PANDA)
    root = next(frame.name for frame in model.frames if frame.parent < 0)
    recordings = []
    for k, file in enumerate(sorted((DATA / "mukca_panda" / "data" / name).glob("*.npz"))):
        z = np.load(file)
        q, socket = np.concatenate([z["hole_0"], z["hole_1"]]), np.repeat([0, 1], [len(z["hole_0"]), len(z["hole_1"])])
        role = "fit" if k in TOOL_POSITIONS[name] else "holdout"
        more = {"unknown": ("tool_frame",), "role": role, "distance": 0.05}
        recordings.append(recording(q, "socket", socket, root, "ball_link", **more))
    return model, recordings


SETS: dict[str, Callable] = {
    "talos_contact": talos,
    "tiago_mocap, 34": tiago,
    "tiago_mocap, all 35": lambda: tiago(keep=True),
    "tiago_mocap, three markers": lambda: tiago(markers=3),
    "irb120_wu2015": irb120,
    "panda_handeye_board": handeye,
    **{f"mukca {name}": lambda name=name: mukca(name) for name in TOOL_POSITIONS},
}


def points_of(values: np.ndarray) -> np.ndarray:
    """Points as the library holds them: (postures, markers, 3)."""
    return values[:, None] if values.ndim == 2 else values


def run_sets() -> None:
    from figaroh_jax.calibration.calibration import calibrate
    from figaroh_jax.reporting import wording

    for name, load in SETS.items():
        model, recordings = load()
        recordings = [replace(r, values=points_of(r.values)) if r.kind == "position" else r for r in recordings]
        start = time.process_time()
        found = calibrate(model, recordings)
        error, turn = found.position, found.orientation
        assert error is not None
        angle = f"; {turn.validated_before:.3f} -> {turn.validated_after:.3f} deg" if turn else ""
        print(f"{name}: {error.validated_before:.3f} -> {error.validated_after:.3f} mm{angle}; {found.level}", end="; ")
        print(", ".join(str(c.name) for c in found.causes) or "no cause", end="; ")
        print(f"outliers {[o.row for o in found.outliers]}; {time.process_time() - start:.0f} CPU s", flush=True)
        for note in (*found.notes, wording.distances(found)):
            print(f"    {note}" * bool(note), end="\n" * bool(note))


def run_speed(postures: Sequence[int] = (50, 500, 4000, 10000)) -> None:
    from figaroh_jax.calibration.candidates import geometry_columns
    from figaroh_jax.estimation.posegroups import postures_of

    path, model, frames = _ur10e()
    columns = geometry_columns(model, range(6))
    (zero,) = postures_of(model, [recording(np.zeros((1, 6)), "pose", np.eye(4)[None], *frames)])
    twists = np.array([column.pieces[0][1](zero)[:, 0] for column in columns])
    from pinocchio_calibration import Peer  # beside this file, which others load without its folder

    peer = Peer(path, frames[1], np.array([column.pieces[0][0] for column in columns]), twists)
    for N in postures:
        _compare(N, model, frames, columns, peer)


def _ur10e():
    """URDF, model, and the frames of base and tool."""
    path = next((DATA / "ur10e_innopolis").glob("*.urdf"))
    model = load_urdf(path)
    tool = model.frames[max(k for k, f in enumerate(model.frames) if f.parent == len(model.joints) - 1)].name
    return path, model, (next(f.name for f in model.frames if f.parent < 0), tool)


class Ours:
    """One level fitted by plain least squares: what can be told apart, closed-form start, one solve."""

    def __init__(self, model, records: list[PoseRecording], level: str = "full", weight: float = 1e4) -> None:
        from figaroh_jax.calibration.candidates import geometry_columns
        from figaroh_jax.calibration.gauge import find_gauge
        from figaroh_jax.estimation import posefit
        from figaroh_jax.estimation.posegroups import assemble, postures_of
        from figaroh_jax.rigid.chain import chain_between

        chain = chain_between(model, records[0].base_frame, records[0].tool_frame).joints
        columns = geometry_columns(model, chain)[: len(chain) if level == "joint_offset" else None]
        measured = assemble(model, records, postures_of(model, records), columns, [1e-3] * len(columns))
        jacobian, count = posefit.linearise(measured.problem, np.zeros(len(measured.problem.scale)))[1], len(columns)
        gauge = find_gauge(jacobian, [*range(count, jacobian.shape[1]), *range(count)])
        self.free = np.array([k not in gauge.dependent for k in range(jacobian.shape[1])], float)
        self.problem, self.rank, self.columns, self.postures = measured.problem, gauge.rank, count, len(records[0].time)
        self.weights = np.full(len(jacobian), weight)

    def solve(self):
        from figaroh_jax.estimation.posesolver import solve

        return solve(self.problem, self.weights, 1.0 - self.free, self.free, np.zeros(len(self.free)))


def _compare(N: int, model, frames: tuple[str, str], columns, peer: Peer) -> None:
    rng, exp = np.random.default_rng(N), peer.pin.exp6
    q, x = rng.uniform(-2.5, 2.5, (N, 6)), 1e-3 * rng.normal(size=len(columns))
    near = [exp(np.concatenate([0.3 * rng.normal(size=3), rng.normal(size=3)])) for _ in range(2)]
    seen = [pose * exp(1e-4 * rng.normal(size=6)) for pose in peer.poses(q, x, *near)]
    poses = np.array([pose.homogeneous for pose in seen])
    ours = Ours(model, [recording(q, "pose", poses, *frames)])
    found, picked = ours.solve(), np.flatnonzero(ours.free[: len(columns)])
    with tempfile.TemporaryDirectory() as folder:
        file, told = Path(folder) / "poses.npz", {"urdf": str(_ur10e()[0]), "frame": frames[1], "q": q, "poses": poses}
        told |= {"joint": peer.joint, "twists": peer.twists, "picked": picked}
        np.savez(file, near=np.array([pose.homogeneous for pose in near]), **told)
        cold = _fresh("child", str(file))
        cold_peer = _fresh(str(file), script=Path(__file__).with_name("pinocchio_calibration.py"))
    warm, theirs, cost = [], [], 0.0
    for _ in range(3 if N <= 500 else 1):
        start = time.process_time()
        for _ in range(5):
            ours.solve()
        between = time.process_time()
        cost = peer.solve(q, seen, near, picked)
        warm.append((between - start) / 5)
        theirs.append(time.process_time() - between)
    print(
        f"N {N}: {ours.rank} parameters; SciPy + Pinocchio {min(theirs):.2f}-{max(theirs):.2f} s; ours warm"
        f" {min(warm):.4f}-{max(warm):.4f} s, cold {cold['cpu']:.2f} s, peak {cold['peak_mb']:.0f} MB; ratio"
        f" {np.median(theirs) / np.median(warm):.0f}; SciPy + Pinocchio cold {cold_peer['cpu']:.2f} s, ratio"
        f" {cold_peer['cpu'] / cold['cpu']:.2f}; cost {found.cost:.2f} and {cost:.2f}",
        flush=True,
    )


def _fresh(*arguments: str, script: Path = Path(__file__)) -> dict[str, Any]:
    """The answer of a script in a new process, the second one: Python's bytecode is there, as when installed."""
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false", "PYTHONPYCACHEPREFIX": _bytecode()}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, str(script), *arguments]
    answers = [subprocess.run(command, check=True, capture_output=True, env=environment) for _ in range(2)]
    return json.loads(answers[-1].stdout)


@lru_cache(maxsize=1)
def _bytecode() -> str:
    """A folder for the bytecode of fresh processes, as long as this one lives."""
    folder = tempfile.mkdtemp()
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def solve_child(file: str) -> None:
    """One solve in this process: CPU seconds since it began, and peak memory."""
    path, model, frames = _ur10e()
    with np.load(file) as z:
        Ours(model, [recording(z["q"], "pose", z["poses"], *frames)]).solve()
    _tell()


def calibrate_child(name: str, level: str) -> None:
    """One level of a set in this process."""
    model, records = SETS[name]()
    Ours(model, [replace(r, values=points_of(r.values)) for r in records], level, 1e3).solve()
    _tell()


def _tell() -> None:
    peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    print(json.dumps({"cpu": time.process_time(), "peak_mb": int(peak.split()[1]) / 1024}))


def run_figaroh() -> None:
    """FIGAROH and ours, the same level by plain least squares on the same rows."""
    tiago_files = ("tiago_mocap", "tiago_no_hand.urdf", "qualysis_base_hand_calibration.csv")
    talos_files = ("talos_contact", "talos_full_v2.urdf", "talos_left_arm_02_10_contact.csv")
    tiago_set = (*tiago_files, "universe", "ee_marker", [9])
    talos_set = (*talos_files, "base_link", "gripper_left_base_link", [])
    for name, level, peer in (
        ("tiago_mocap, 34", "joint_offset", tiago_set),
        ("tiago_mocap, 34", "full", tiago_set),
        ("talos_contact", "joint_offset", talos_set),
        ("talos_contact", "full", talos_set),
    ):
        cold = _fresh("level", name, level)
        model, records = SETS[name]()
        records = [replace(r, values=points_of(r.values), tool_frame=peer[4]) for r in records]
        ours = Ours(model, records, level, 1e3)
        found, warm, answers = ours.solve(), [], []
        for _ in range(1 if (name, level) == ("talos_contact", "full") else 3):
            start = time.process_time()
            Ours(model, records, level, 1e3).solve()
            warm.append(time.process_time() - start)
            answers.append(_peer_calibration(*peer, "full_params" if level == "full" else level))
        theirs, first = [answer["cpu"] for answer in answers], answers[0]
        rms = np.sqrt(2.0 * found.cost / ours.postures)
        print(
            f"{name}, {level}: FIGAROH {first['parameters']} parameters, {first['rms']:.4f} mm, {first['evaluations']}"
            f" evaluations, {min(theirs):.2f}-{max(theirs):.2f} s, {first['peak_mb']:.0f} MB; ours {ours.rank}"
            f" parameters, {rms:.4f} mm, {found.steps} steps, warm {min(warm):.3f}-{max(warm):.3f} s, cold"
            f" {cold['cpu']:.1f} s, {cold['peak_mb']:.0f} MB; ratio warm {np.median(theirs) / np.median(warm):.0f},"
            f" cold {np.median(theirs) / cold['cpu']:.2f}",
            flush=True,
        )


def _peer_calibration(folder: str, urdf: str, csv: str, base: str, tool: str, left_out: list[int], level: str) -> Any:
    import regressor  # beside this file

    request = {"urdf": str(DATA / folder / urdf), "csv": str(DATA / folder / csv), "base_frame": base, "level": level}
    request |= {"tool_frame": tool, "left_out": left_out}
    peer = Path(__file__).with_name("peer_calibration.py")
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [regressor.environment(), str(peer), json.dumps(request)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, env=environment).stdout)


if __name__ == "__main__":
    import jax

    jax.config.update("jax_enable_x64", True)
    if sys.argv[1:2] == ["child"]:
        solve_child(sys.argv[2])
    elif sys.argv[1:2] == ["level"]:
        calibrate_child(*sys.argv[2:])
    else:
        told = [int(word) for word in sys.argv[1:] if word.isdigit()]
        speed = partial(run_speed, told) if told else run_speed
        for part in [word for word in sys.argv[1:] if not word.isdigit()] or ["sets", "speed", "figaroh"]:
            {"sets": run_sets, "speed": speed, "figaroh": run_figaroh}[part]()
