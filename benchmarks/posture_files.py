"""Postures of published robots: `calibrate` and `diagnose` of URDFs that others wrote, against Pinocchio.

    python benchmarks/posture_files.py FOLDER [FOLDER ...] --seeds 0 60 [--effects nothing link] [--kinds pose]

Each case takes a URDF of the folders and one of its chains of five to eight joints, columns also in another order, with
base and tool frames that nobody knows, and 30 or 60 postures at which a device measures poses (also with exact
orientations), a point or three markers, with noise. The robot is exact, or built within half a tolerance; one joint is
zeroed wrongly, or all of them, or a link is off.
`calibrate` is judged by postures that it has not seen: Pinocchio reads the `robot.urdf` that it writes, the frames of
`calibration.yaml` are added, and the measured points are compared with those of the robot itself, without noise. It is
`off` where the error is more than twice what `calibrate` says of postures left out, and `worse` where it is beyond that
of frames alone. `diagnose` is `wrong` with a name at another place than the truth or its neighbours.
`--draft` asks `new` alone, of files as strangers write them: arrays or columns in any order and unit, matrices, points,
quaternions or angles, boards seen from the hand. `right`: it reads what was written, on the body that carries the
marker; `wrong`: other numbers.
One line a case; at the end tables, and every case that is not as it should be.
"""

from __future__ import annotations

import argparse
import collections
import json
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
import yaml
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.rollout_conditions import asked

EFFECTS = ("nothing", "offset", "offsets", "link")
KINDS = ("pose", "exact orientation", "position", "markers")
TOLERANCE = 5e-4  # m and rad, of a good robot's links
MARKERS = np.array([[0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.12]])  # m, on the tool
FRESH = 50  # postures that are compared
LEAST = 1e-5  # m: errors below are none


class Chain(NamedTuple):
    """A robot of a file, as Pinocchio reads it, and joints of it that carry a tool one after another."""

    file: Path
    model: Any
    joints: list[str]  # from the base
    frames: tuple[str, str]
    ends: np.ndarray  # (joints, 2) rad or m

    def tools(self, model: Any, q: np.ndarray) -> list[pin.SE3]:
        """Where the tool of a model stands in the base frame, at positions (rows, joints) in the order of `joints`."""
        data, out = model.createData(), []
        base, tool = (model.getFrameId(name, pin.FrameType.BODY) for name in self.frames)
        for row in q:
            whole = pin.neutral(model)
            for name, x in zip(self.joints, row, strict=True):
                joint = model.joints[model.getJointId(name)]
                whole[joint.idx_q : joint.idx_q + joint.nq] = (np.cos(x), np.sin(x)) if joint.nq == 2 else x
            pin.framesForwardKinematics(model, data, whole)
            out.append(data.oMf[base].inverse() * data.oMf[tool])
        return out


class Case(NamedTuple):
    """What is drawn, in words, the task and its arrays, and what Pinocchio says."""

    told: str
    effect: str
    chain: Chain
    truth: list[str]  # joints that err
    noise: float
    task: dict[str, Any]
    q: np.ndarray
    seen: np.ndarray
    fresh: np.ndarray  # positions as read
    points: np.ndarray  # (FRESH, points, 3) m, of the robot itself at `fresh`, in the device's frame
    markers: np.ndarray | None  # on the tool, where a pose is measured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 60], metavar=("FIRST", "END"))
    parser.add_argument("--effects", nargs="+", choices=EFFECTS, default=["nothing", *EFFECTS])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=["pose", "position", "markers"])
    parser.add_argument("--noise", nargs="+", type=float, default=[1e-5, 1e-4, 5e-4], help="m and rad")
    parser.add_argument("--draft", action="store_true", help="`new` alone")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="leave the cases and their runs there")
    args = parser.parse_args()
    files = [f for folder in args.folders for f in sorted(folder.rglob("*.urdf"))]
    count: collections.Counter[tuple[str, str]] = collections.Counter()
    odd = list[str]()
    for seed in range(*args.seeds):
        rng = np.random.default_rng([seed, 211])
        chain = None
        while chain is None:
            chain = read(files[int(rng.integers(len(files)))], rng)
        case = drawn(chain, rng, args)
        if args.draft:
            mark, line = drafted(case, rng)
            print(f"{seed}: {line}", flush=True)
            count["new", mark] += 1
            odd += [f"{seed}: {line}"] if mark == "wrong" else []
            continue
        marks, lines = answered(case, args.keep and args.keep / str(seed))
        line = f"{seed}: {case.told}\n    " + "\n    ".join(lines)
        print(line, flush=True)
        for job, mark in zip(("calibrate", "diagnose"), marks, strict=True):
            count[f"{job} {case.effect}", mark] += 1
        if {"wrong", "off", "worse", "error", "warning"} & set(marks):
            odd.append(line)
    for (effect, mark), number in sorted(count.items()):
        print(f"{effect:22} {mark:10} {number}")
    print(*odd, sep="\n")


def read(file: Path, rng: np.random.Generator) -> Chain | None:
    """A chain of the robot, or None for a file that Pinocchio does not read, or without one."""
    text = file.read_text(errors="replace")
    if "<mimic" in text or not 10 < len(text) < 200_000:
        return None
    try:
        model = pin.buildModelFromUrdf(str(file))
    except Exception:  # another tool's
        return None
    links = [frame for frame in model.frames if frame.type == pin.FrameType.BODY]
    if not links:
        return None
    found = []
    for tool in links:
        joints, at = list[int](), tool.parentJoint
        while at:
            joints.insert(0, at)
            at = model.parents[at]
        if 5 <= len(joints) <= 8 and all(model.joints[k].nv == 1 for k in joints):
            found.append((joints, tool.name))
    if not found:
        return None
    joints, tool = found[int(rng.integers(len(found)))]
    base = next(frame.name for frame in links if not frame.parentJoint)
    ends = []
    for k in joints:
        joint = model.joints[k]
        low, high = (
            float(x[joint.idx_q]) if joint.nq == 1 else np.nan
            for x in (model.lowerPositionLimit, model.upperPositionLimit)
        )
        ends.append((low, high) if low < high else (-np.inf, np.inf))
    names = [str(model.names[k]) for k in joints]
    if len(set(text.split('"')) & set(names)) < len(names):
        return None
    return Chain(file, model, names, (base, tool), np.clip(ends, -2.5, 2.5))


def drawn(chain: Chain, rng: np.random.Generator, args: argparse.Namespace) -> Case:
    n = len(chain.joints)
    effect, kind = str(rng.choice(args.effects)), str(rng.choice(args.kinds))
    built, noise = float(rng.choice([0.0, 0.0, 0.5])), float(rng.choice(args.noise))
    span, postures = float(rng.choice([0.5, 0.9])), int(rng.choice([30, 30, 60]))
    real, k = chain.model.copy(), int(rng.integers(n))
    wrong, truth, size = np.zeros(n), list[str](), ""
    for name in chain.joints:
        at = real.getJointId(name)
        real.jointPlacements[at] = real.jointPlacements[at] * pin.exp6(built * TOLERANCE * rng.normal(size=6))
    if effect == "offset":
        wrong[k], truth = rng.choice([-1, 1]) * float(rng.choice([0.01, 0.03])), [chain.joints[k]]
        size = f" {1e3 * wrong[k]:g} mrad at {chain.joints[k]}"
    if effect == "offsets":
        wrong, truth = 0.015 * rng.normal(size=n), chain.joints
        size = f" {np.round(1e3 * wrong, 1).tolist()} mrad"
    if effect == "link":
        k, truth = max(k, 1), [chain.joints[max(k, 1)]]
        twist = np.array([4e-3, 4e-3, 4e-3, 6e-3, 6e-3, 6e-3]) * rng.normal(size=6)
        at, size = real.getJointId(chain.joints[k]), f" {np.round(1e3 * twist, 1).tolist()} at {chain.joints[k]}"
        real.jointPlacements[at] = real.jointPlacements[at] * pin.exp6(twist)
    middle, half = chain.ends.mean(1), 0.5 * np.ptp(chain.ends, axis=1)
    q, fresh = (middle + span * half * rng.uniform(-1, 1, (rows, n)) for rows in (postures, FRESH))
    device, marker = (pin.SE3(pin.exp3(rng.normal(size=3)), s * rng.normal(size=3)) for s in (1.0, 0.1))
    seen_at, fresh_at = ([device * pose * marker for pose in chain.tools(real, x + wrong)] for x in (q, fresh))
    base, tool = chain.frames
    measurement: dict[str, Any] = {"base_frame": base, "tool_frame": tool, "unknown": ["base_frame", "tool_frame"]}
    markers = MARKERS if kind == "markers" else np.zeros((1, 3))
    points = np.array([[pose.act(point) for point in markers] for pose in fresh_at])
    if kind in ("position", "markers"):
        seen = np.array([[pose.act(point) for point in markers] for pose in seen_at])
        seen = seen + noise * rng.normal(size=seen.shape)
        seen = seen if kind == "markers" else seen[:, 0]
        measurement["position"] = "seen"
    else:
        turns = 0.0 if kind == "exact orientation" else 1.0
        errors = [pin.SE3(pin.exp3(turns * noise * rng.normal(size=3)), noise * rng.normal(size=3)) for _ in seen_at]
        seen = np.array([(pose * error).homogeneous for pose, error in zip(seen_at, errors, strict=True)])
        measurement["pose"] = "seen"
        points = np.array([[pose.act(point) for point in MARKERS] for pose in fresh_at])
    order = rng.permutation(n) if rng.random() < 0.5 else np.arange(n)
    task = {
        "robot": {"model": str(chain.file.resolve()), "joints": [chain.joints[i] for i in order]},
        "data": [{"file": "postures.npz", "position": "q", "measurement": measurement}],
    }
    told = (
        f"{effect}{size}, {chain.file.parent.name}/{chain.file.name}, {base} to {tool}, {n} joints, {kind},"
        f" {postures} postures over {span:.0%}, links {built:g} tolerances off, noise {1e3 * noise:g} mm"
        f"{', columns in another order' * bool((order != np.arange(n)).any())}"
    )
    own = MARKERS if "pose" in measurement else None
    return Case(told, effect, chain, truth, noise, task, q[:, order], seen, fresh, points, own)


def drafted(case: Case, rng: np.random.Generator) -> tuple[str, str]:
    """How `new` reads a case's postures, written in one of the ways of strangers; a mark and a line."""
    from figaroh_jax.errors import InputError
    from figaroh_jax.formats.config import load_task
    from figaroh_jax.formats.robotfile import load_robot
    from figaroh_jax.recordings.draft import draft_task
    from figaroh_jax.recordings.poses import read_pose_recordings

    joints = case.task["robot"]["joints"]
    model = case.chain.model
    turns = np.array([model.joints[model.getJointId(name)].shortname().startswith("JointModelR") for name in joints])
    angle, length = (str(rng.choice(units)) for units in (("rad", "deg"), ("m", "mm")))
    q = np.where(turns, np.rad2deg(case.q), case.q) if angle == "deg" else case.q
    posed, inverse, table = (
        case.seen.ndim == 3 and case.seen.shape[1:] == (4, 4),
        rng.random() < 0.5,
        rng.random() < 0.5,
    )
    columns, arrays, way = {name: q[:, k] for k, name in enumerate(joints)}, {"q": q}, "points"
    scale = 1e3 if length == "mm" else 1.0
    if posed:
        seen = np.linalg.inv(case.seen) if inverse else case.seen.copy()
        seen[:, :3, 3] *= scale
        rotation, place = Rotation.from_matrix(seen[:, :3, :3]), seen[:, :3, 3]
        way = str(rng.choice(["matrices", "quaternions", "w first", "rpy", "rotvec"]))
        quaternion = rotation.as_quat()
        rows = {
            "quaternions": quaternion,
            "w first": quaternion[:, [3, 0, 1, 2]],
            "rpy": rotation.as_euler("xyz", degrees=angle == "deg"),
            "rotvec": rotation.as_rotvec(degrees=angle == "deg"),
        }
        names = {"w first": ("qw", "qx", "qy", "qz"), "rpy": ("roll", "pitch", "yaw"), "rotvec": ("rx", "ry", "rz")}
        told = rows.get(way, quaternion)
        arrays["pose"] = seen if way == "matrices" else np.concatenate([place, told], axis=1)
        columns |= dict(zip(("x", "y", "z"), place.T, strict=True))
        columns |= dict(zip(names.get(way, ("qx", "qy", "qz", "qw")), told.T, strict=True))
    else:
        points = scale * case.seen.reshape(len(q), -1)
        arrays["marker"] = points
        columns |= {
            f"{axis}{k + 1}": points[:, 3 * k + j] for k in range(points.shape[1] // 3) for j, axis in enumerate("xyz")
        }
    written = f"{'a table' if table else 'arrays'}, {way}{' from the hand' * (posed and inverse)}, {angle}, {length}"
    line = f"{case.told}, {written}: "
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / ("run.csv" if table else "run.npz")
        if table:
            order = [*columns]
            rng.shuffle(order)
            values = np.column_stack([columns[column] for column in order])
            np.savetxt(file, values, "%.17g", ",", header=",".join(order), comments="")
        else:
            np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]
        try:
            text = draft_task(case.chain.file, [file], joints=None if table else joints).text
        except InputError as error:
            return "refused", f"{line}refused: {str(error).splitlines()[0][-330:]}"
        (Path(name) / "task.yaml").write_text(text)
        task = load_task(Path(name) / "task.yaml")
        robot = load_robot(task, kinematic=True)
        (read,) = read_pose_recordings(task, robot)
    right = [joints.index(joint) for joint in robot.joint_names]
    seen = case.seen if posed or case.seen.ndim == 3 else case.seen[:, None]
    if read.position.shape != case.q.shape or not np.allclose(read.position, case.q[:, right], rtol=0, atol=1e-9):
        return "wrong", f"{line}wrong positions"
    if read.values.shape != seen.shape or not np.allclose(read.values, seen, rtol=0, atol=1e-6):
        return "wrong", f"{line}wrong measurement"
    carries = {frame.name: frame.parent for frame in robot.frames}
    alike = carries[read.tool_frame] == carries[case.chain.frames[1]]
    return ("right" if alike else "another body"), f"{line}{'right' if alike else f'on {read.tool_frame}'}"


def answered(case: Case, keep: Path | None) -> tuple[list[str], list[str]]:
    """How both commands did, in a word and in a line."""
    with tempfile.TemporaryDirectory() as name:
        folder = keep or Path(name)
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(folder / "postures.npz", q=case.q, seen=case.seen)
        (folder / "task.yaml").write_text(yaml.safe_dump(case.task))

        def judged(job: str) -> tuple[str, str]:
            mark, line = (calibrated if job == "calibrate" else named)(case, folder / job)
            return mark, f"{mark}: {line}"

        return asked(folder, ["calibrate", "diagnose"], judged)


def calibrated(case: Case, run: Path) -> tuple[str, str]:
    """How far the points of postures that were not measured are from where Pinocchio puts them by the run's files."""
    result = json.loads((run / "result.json").read_text())
    told = yaml.safe_load((run / "model" / "calibration.yaml").read_text())
    levels = {name: one["position"] for name, one in result["levels"].items()}
    what = f"{result['level']}, {_names(result) or 'no cause'}"
    unsettled = "" if result["converged"] else ", not converged"
    if told["effects"]:
        return "effects", f"{what}{unsettled}"
    frames = {name: np.array(one) for name, one in told["frames"].items()}
    tool, points = frames["tool_frame"], case.markers
    if points is None:  # the points themselves are what was found
        tool, points = np.eye(4), np.atleast_2d(tool)
    tools = case.chain.tools(pin.buildModelFromUrdf(str(run / "model" / "robot.urdf")), case.fresh)
    found = [[(frames["base_frame"] @ pose.homogeneous @ tool @ [*x, 1.0])[:3] for x in points] for pose in tools]
    error = 1e3 * float(np.sqrt(((np.array(found) - case.points) ** 2).sum(-1).mean()))
    mark = "good"
    if error > 1e3 * LEAST and error > 2 * levels["chosen"]:
        mark = "off"
    if error > 1e3 * LEAST and error > 1.1 * levels["frames"]:
        mark = "worse"
    says = f"frames {levels['frames']:.3g} mm, says {levels['chosen']:.3g} mm, is {error:.3g} mm"
    return mark, f"{what}{unsettled}, {says}"


def named(case: Case, run: Path) -> tuple[str, str]:
    """Whether the names of a diagnosis are the truth, beside it, or wrong."""
    answer = json.loads((run / "answer.json").read_text())
    order = case.chain.joints
    kind = {"offset": "joint_offset", "offsets": "joint_offset", "link": "link_geometry"}.get(case.effect, "")
    beside = {order[min(max(order.index(x) + d, 0), len(order) - 1)] for x in case.truth for d in (-1, 0, 1)}
    causes = [
        [(c["effect"], *c["at"]), *((o["effect"], *o["at"]) for o in c["ambiguous_with"])] for c in answer["causes"]
    ]
    right = [any(one[0] == kind and one[1:] == (x,) for x in case.truth for one in names[:1]) for names in causes]
    alike = [any(one[0] == kind and one[1] in case.truth for one in names if len(one) > 1) for names in causes]
    near = [names[0][0] in ("joint_offset", "link_geometry") and names[0][1] in beside for names in causes]
    fair = [r or a or x for r, a, x in zip(right, alike, near, strict=True)]
    mark = "right" if any(right) else "set" if any(alike) else "near" if any(near) else answer["verdict"]
    return "wrong" if not all(fair) else mark, f"{answer['verdict']}, {_names(answer) or 'no cause'}"


def _names(answer: dict[str, Any]) -> str:
    return ", ".join(f"{c['effect']} {' '.join(c['at'])}" for c in answer["causes"])


if __name__ == "__main__":
    main()
