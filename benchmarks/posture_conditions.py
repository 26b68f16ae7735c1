"""Postures as strangers measure them: `diagnose` and `calibrate` of sets whose robot, device and size are drawn.

    python benchmarks/posture_conditions.py --seeds 0 60 [--effects nothing gear] [--kinds plane socket]

Drawn are: robot (TALOS's left arm with and without torso, TIAGo, a Panda), order of the joints' columns, joints that
never move, number and range of the postures, repeats, how far the links are off (in tolerances of a good robot, also
exactly none), noise (also with a heavy tail), and what is measured: poses, one point, three markers, a camera in the
hand, planes, sockets, with frames that are known or not. Half of the sets hide nothing, the others an encoder's zero, a
gear's error or a joint that gives way under gravity. Everything is made by Pinocchio.
One line a case; at the end tables of the verdicts of both commands, and every case with a name that is neither the
truth nor said to be alike, an error or a warning. Outliers are no wrong names where the noise has a heavy tail.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import io
import json
import os
import tempfile
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import yaml

from figaroh_jax.cli import main as command_line

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
ARM = [f"arm_left_{k}_joint" for k in range(1, 8)]
TORSO = ["torso_1_joint", "torso_2_joint"]
TIAGO = ["torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8))]
ROBOTS = {  # file, joints, base and tool
    "talos": ("talos_contact/talos_full_v2.urdf", ARM, "torso_2_link", "gripper_left_base_link"),
    "talos and torso": ("talos_contact/talos_full_v2.urdf", [*TORSO, *ARM], "base_link", "gripper_left_base_link"),
    "tiago": ("tiago_mocap/tiago_no_hand.urdf", TIAGO, "base_footprint", "arm_7_link"),
    "panda": (
        "panda_handeye_board/panda.urdf",
        [f"panda_joint{k}" for k in range(1, 8)],
        "panda_link0",
        "panda_link8",
    ),
}
KINDS = ("pose", "pose, known frames", "position", "position, known frames", "markers", "camera", "plane", "socket")
EFFECTS = {
    "nothing": None,
    "offset": "joint_offset",
    "gear": "gear_transmission_error",
    "compliance": "joint_compliance",
}
TOLERANCE = 5e-4  # m and rad, of a good robot's links
MARKERS = np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.12]])  # m, on the tool
TIP = np.array([0.02, 0.01, 0.1])  # m, what touches planes and sockets


class Arm(NamedTuple):
    """A robot, and the same with its links a little off."""

    file: Path
    joints: list[str]
    frames: tuple[str, str]
    model: Any
    real: Any
    columns: list[int]  # of q, of the joints

    def tool(self, q: np.ndarray) -> pin.SE3:
        """Where the real tool stands in the base frame."""
        data, whole = self.real.createData(), self.whole(q)
        pin.framesForwardKinematics(self.real, data, whole)
        base, tool = (data.oMf[self.real.getFrameId(name)] for name in self.frames)
        return base.inverse() * tool

    def whole(self, q: np.ndarray) -> np.ndarray:
        whole = pin.neutral(self.model)
        whole[self.columns] = q
        return whole

    def load(self, q: np.ndarray, k: int) -> float:
        """Torque that holds joint k against gravity."""
        data = self.model.createData()
        torque = pin.computeGeneralizedGravity(self.model, data, self.whole(q))
        return float(torque[self.model.joints[self.model.getJointId(self.joints[k])].idx_v])


class Case(NamedTuple):
    """What is drawn, in words, the task and its arrays, and the names that are right."""

    told: str
    task: dict[str, Any]
    q: np.ndarray
    seen: np.ndarray
    truth: tuple[str, str] | None
    heavy: bool


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 60], metavar=("FIRST", "END"))
    parser.add_argument("--effects", nargs="+", choices=list(EFFECTS), default=["nothing", *EFFECTS])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    args = parser.parse_args()
    count: collections.Counter[tuple[str, str]] = collections.Counter()
    odd = []
    for seed in range(*args.seeds):
        case = drawn(np.random.default_rng(seed), args.effects, args.kinds)
        if case is None:
            continue
        marks, lines = answered(case)
        line = f"{seed}: {case.told}\n    " + "\n    ".join(lines)
        print(line, flush=True)
        effect = case.told.split(",", 1)[0].split()[0]
        for job, mark in zip(("diagnose", "calibrate"), marks, strict=True):
            count[f"{job} {effect}", mark] += 1
        if any(mark in ("wrong", "error", "warning") for mark in marks):
            odd.append(line)
    for (effect, mark), number in sorted(count.items()):
        print(f"{effect:22} {mark:10} {number}")
    print(*odd, sep="\n")


def drawn(rng: np.random.Generator, effects: list[str], kinds: list[str]) -> Case | None:
    """A case, or None where the robot cannot touch what it is to touch."""
    robot, effect, kind = (str(rng.choice(one)) for one in (list(ROBOTS), effects, kinds))
    off = float(rng.choice([0.0, 0.0, 0.5, 1.0]))
    arm = _arm(rng, robot, off)
    low, high = (np.array(limit)[arm.columns] for limit in (arm.model.lowerPositionLimit, arm.model.upperPositionLimit))
    postures, span, noise = (
        int(rng.choice([15, 25, 40, 80, 150])),
        rng.choice([0.3, 0.7, 1.0]),
        rng.choice([1e-5, 1e-4, 1e-3]),
    )
    q = (low + high) / 2 + span * (high - low) / 2 * rng.uniform(-1.0, 1.0, (postures, len(low)))
    still = rng.random(len(low)) < 0.08
    q[:, still] = q[0, still]
    if rng.random() < 0.2:
        q = np.repeat(q[: max(postures // 3, 8)], 3, axis=0)
    heavy, k = bool(rng.random() < 0.3), int(rng.integers(len(low) - 1))

    def noisy(*shape: int) -> np.ndarray:
        return noise * (rng.standard_t(3, size=shape) if heavy else rng.normal(size=shape))

    if kind in ("plane", "socket"):
        q = _touching(arm, q, kind, noisy(len(q), 3), (low, high))
        if len(q) < 12:
            return None
    true = q + _error(arm, q, effect, k)
    if kind in ("plane", "socket"):  # it is the real robot that touches
        q, true = q - (true - q), q
    seen, measurement = _seen(rng, arm, true, kind, noisy)
    base, tool = arm.frames
    known = kind.endswith("known frames")
    unknown = [] if known else ["tool_frame"] if kind in ("plane", "socket") else ["base_frame", "tool_frame"]
    measurement |= {"base_frame": base, "tool_frame": tool, "unknown": unknown}
    task = {
        "robot": {"model": str(arm.file), "joints": arm.joints},
        "data": [{"file": "postures.npz", "position": "q", "measurement": measurement}],
    }
    name, at = EFFECTS[effect], arm.joints[k]
    place = f" at {at}" if name else ""
    rests = f", {int(still.sum())} joints still" if still.any() else ""
    told = (
        f"{effect}{place}, {robot}, {kind}, {len(q)} postures over {span:.0%}, links {off:g} tolerances off,"
        f" noise {1e3 * noise:g} mm{', heavy tail' * heavy}{rests}"
    )
    return Case(told, task, q, seen, (name, at) if name else None, heavy)


def _arm(rng: np.random.Generator, robot: str, off: float) -> Arm:
    file, joints, *frames = ROBOTS[robot]
    if rng.random() < 0.5:
        joints = [str(name) for name in rng.permutation(joints)]
    model = pin.buildModelFromUrdf(str(DATA / file))
    real = model.copy()
    for name in joints:
        k = real.getJointId(name)
        real.jointPlacements[k] = real.jointPlacements[k] * pin.exp6(off * TOLERANCE * rng.normal(size=6))
    columns = [model.joints[model.getJointId(name)].idx_q for name in joints]
    return Arm(DATA / file, list(joints), (frames[0], frames[1]), model, real, columns)


def _error(arm: Arm, q: np.ndarray, effect: str, k: int) -> np.ndarray:
    """What has to be added to the readings for the truth."""
    error = np.zeros_like(q)
    if effect == "offset":
        error[:, k] = 0.02
    if effect == "gear":
        error[:, k] = 4e-3 * np.sin(3.0 * q[:, k] + 0.4)
    if effect == "compliance":
        error[:, k] = [-1e-4 * arm.load(x, k) for x in q]
    return error


def _seen(
    rng: np.random.Generator, arm: Arm, true: np.ndarray, kind: str, noisy: Any
) -> tuple[np.ndarray, dict[str, Any]]:
    """What the device says, and how a task tells it."""
    if kind in ("plane", "socket"):
        return np.zeros(len(true)), {kind: "seen"}
    device, marker = (pin.SE3(pin.exp3(rng.normal(size=3)), size * rng.normal(size=3)) for size in (1.0, 0.1))
    poses = [arm.tool(x) for x in true]
    if not kind.endswith("known frames"):
        poses = [device * pose * marker for pose in poses]
    if kind == "camera":
        poses = [pose.inverse() for pose in poses]
    if kind == "camera" or kind.startswith("pose"):
        seen = np.array([(pose * pin.SE3(pin.exp3(noisy(3)), noisy(3))).homogeneous for pose in poses])
        return seen, {"camera": "seen", "mount": "hand"} if kind == "camera" else {"pose": "seen"}
    points = MARKERS if kind == "markers" else np.zeros((1, 3))
    seen = np.array([[pose.act(point) for point in points] for pose in poses])
    seen = seen + noisy(*seen.shape)
    return seen if kind == "markers" else seen[:, 0], {"position": "seen"}


def _touching(
    arm: Arm, q: np.ndarray, kind: str, noise: np.ndarray, limits: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Positions near q in which the tip touches a level plane, or a socket, with an error."""
    rows = [2] if kind == "plane" else [0, 1, 2]
    target = arm.tool(q[0]).act(TIP)
    found = []
    for x, error in zip(q, noise, strict=True):
        for _ in range(50):
            miss = (arm.tool(x).act(TIP) - target - error)[rows]
            if np.linalg.norm(miss) < 1e-10:
                break
            step = 1e-6 * np.eye(len(x))
            slope = np.array([(arm.tool(x + s).act(TIP) - arm.tool(x - s).act(TIP))[rows] / 2e-6 for s in step]).T
            x = x - np.linalg.pinv(slope, rcond=1e-3) @ miss
        else:
            continue
        if np.all((x > limits[0]) & (x < limits[1])):
            found.append(x)
    return np.array(found)


def answered(case: Case) -> tuple[list[str], list[str]]:
    """How both commands did, in a word and in a line."""
    marks, lines = [], []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.savez(folder / "postures.npz", q=case.q, seen=case.seen)
        (folder / "task.yaml").write_text(yaml.safe_dump(case.task))
        for job in ("diagnose", "calibrate"):
            said = io.StringIO()
            with (
                contextlib.redirect_stdout(said),
                contextlib.redirect_stderr(said),
                warnings.catch_warnings(record=True) as noted,
            ):
                warnings.simplefilter("always")
                status = command_line([job, str(folder / "task.yaml"), "--out", str(folder / job), "--quiet"])
            if status:
                marks.append("error")
                lines.append(f"{job}: {status} {' '.join(said.getvalue().split())[-300:]}")
                continue
            file = "answer.json" if job == "diagnose" else "result.json"
            answer = json.loads((folder / job / file).read_text())
            names = [(c["effect"], " ".join(c["at"])) for c in answer["causes"]]
            sets = [[(o["effect"], " ".join(o["at"])) for o in c["ambiguous_with"]] for c in answer["causes"]]
            fair = [one == case.truth or case.truth in also for one, also in zip(names, sets, strict=True)]
            others = [n for n, f in zip(names, fair, strict=True) if not f and not (n[0] == "outlier" and case.heavy)]
            mark = "right" if case.truth in names else "set" if any(fair) else answer["verdict"]
            mark = "warning" if noted else "wrong" if others else mark
            marks.append(mark)
            lines.append(f"{job}: {answer['verdict']}, {', '.join(' '.join(one) for one in names) or 'no cause'}")
            lines[-1] += "".join(f"; {one.message}" for one in noted[:1])
    return marks, lines


if __name__ == "__main__":
    main()
