"""Torques of published robots: `diagnose` of files that others wrote, with motions, errors and effects that are drawn.

    python benchmarks/torque_files.py FOLDER [FOLDER ...] --seeds 0 60 [--effects nothing payload] [--keep DIR]
    python benchmarks/torque_files.py FOLDER --seeds 0 60 --effects nothing --commands identify

Each case takes a URDF or an MJCF of the folders and draws which joints move (a branch, or any) and where the others are
locked, gravity, how far the robot's links are off what the file says, its friction, the motion, the sampling, the noise
and how the recordings are stored. Torques are those of Pinocchio (URDF) or of MuJoCo C (MJCF: exact inverse dynamics or
a closed loop with friction that sticks). Half of the cases hide nothing, the others one effect.
`identify` is asked of cases without an effect: MuJoCo C moves the `robot.xml` that it writes along a motion that is not
in the data, and the torque is compared with that of the robot itself; it is `off` where the error at some joint is more
than the noise.
One line a case; at the end tables of verdicts, and every case with a name that is neither the truth nor said to be
alike, an error or a warning.
"""

from __future__ import annotations

import argparse
import collections
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.rollout_conditions import asked, diagnosed, tilted
from benchmarks.torque_conditions import ALIKE, EFFECTS, Case, _measured, _moved, _reference, written

MADE: Any = mujoco
HIDDEN = tuple(x for x in EFFECTS if x != "coupled_transmission")  # which joints neighbour each other is the file's
Torque = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]  # (rows, joints) each


class Robot(NamedTuple):
    """A robot as Pinocchio or MuJoCo C reads its file: joints of one axis each, in their order."""

    file: Path
    names: list[str]
    ends: np.ndarray  # (joints, 2) rad or m
    slides: np.ndarray
    gravity: np.ndarray  # m/s^2
    parents: list[int]  # joint that carries a joint, or -1
    links: dict[str, int]  # joint that moves a link
    real: Callable[..., tuple[Torque, Any]]  # (gravity, errors of links, load) -> rigid torque, model of MuJoCo C


class Forward(NamedTuple):
    """A motion that is not in the data, of the joints that move (rows, joints)."""

    names: list[str]
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    torque: np.ndarray
    noise: np.ndarray  # of each joint's torque in the data


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 40], metavar=("FIRST", "END"))
    parser.add_argument("--effects", nargs="+", choices=["nothing", *HIDDEN], default=[])
    parser.add_argument("--commands", nargs="+", choices=["diagnose", "identify"], default=["diagnose"])
    parser.add_argument("--most", type=int, default=6, help="joints that move")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="leave the cases and their runs there")
    args = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)
    files = [f for folder in args.folders for form in ("urdf", "xml") for f in sorted(folder.rglob(f"*.{form}"))]
    count: collections.Counter[tuple[str, str]] = collections.Counter()
    odd = list[str]()
    for seed in range(*args.seeds):
        rng = np.random.default_rng([seed, 173])
        found = None
        while found is None:
            robot = read(files[int(rng.integers(len(files)))])
            found = robot and drawn(robot, rng, args)
        case, same, forward = found
        jobs = [job for job in args.commands if job == "diagnose" or case.truth is None]
        marks, lines = answered(case, same, forward, jobs, args.keep and args.keep / str(seed))
        line = f"{seed}: {case.told}\n    " + "\n    ".join(lines)
        print(line, flush=True)
        for job, mark in zip(jobs, marks, strict=True):
            effect = case.truth[0] if case.truth else "nothing"
            count[effect if job == "diagnose" else job, mark] += 1
        if any(mark in ("wrong", "off", "error", "warning") for mark in marks):
            odd.append(line)
    for (effect, mark), number in sorted(count.items()):
        print(f"{effect:40} {mark:10} {number}")
    print(*odd, sep="\n")


def read(file: Path) -> Robot | None:
    """The robot, or None for a file that another tool does not read, or whose joints are not single axes."""
    try:
        return _of_urdf(file) if file.suffix == ".urdf" else _of_mjcf(file)
    except Exception:  # another tool's
        return None


def _of_urdf(file: Path) -> Robot | None:
    text = file.read_text(errors="replace")
    if "<mimic" in text or not 10 < len(text) < 200_000:
        return None
    model = pin.buildModelFromUrdf(str(file))
    joints = [*model.joints][1:]
    if not 1 <= len(joints) <= 40 or any(joint.nv != 1 for joint in joints):
        return None
    circle = np.array([joint.nq == 2 for joint in joints])
    at = np.array([joint.idx_v for joint in joints])

    def real(pull: np.ndarray, errors: np.ndarray, load: tuple[int, float, np.ndarray] | None) -> tuple[Torque, None]:
        own = pin.buildModelFromUrdf(str(file))
        data = own.createData()
        own.gravity.linear = pull
        for k, (mass, *move, turn) in enumerate(errors):
            one = own.inertias[k + 1]
            own.inertias[k + 1] = pin.Inertia(
                one.mass * (1 + mass), one.lever + np.linalg.norm(one.lever) * np.array(move), one.inertia * (1 + turn)
            )
        if load:
            own.inertias[load[0] + 1] += pin.Inertia(load[1], load[2], np.zeros((3, 3)))

        def torque(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
            out = np.zeros_like(q)
            for k in range(len(q)):
                full, speed, rise = pin.neutral(own), np.zeros(own.nv), np.zeros(own.nv)
                for i, joint in enumerate(joints):
                    turned = (np.cos(q[k, i]), np.sin(q[k, i])) if circle[i] else q[k, i]
                    full[joint.idx_q : joint.idx_q + joint.nq] = turned
                speed[at], rise[at] = v[k], a[k]
                out[k] = pin.rnea(own, data, full, speed, rise)[at]
            return out

        return torque, None

    limits = [(float(model.lowerPositionLimit[j.idx_q]), float(model.upperPositionLimit[j.idx_q])) for j in joints]
    ends = np.where(circle[:, None], [-np.inf, np.inf], limits)
    ends[ends[:, 0] == ends[:, 1]] = -np.inf, np.inf  # urdfdom's zeros, of limits that the file does not give
    slides = np.array(["P" in joint.shortname() for joint in joints])
    links = {f.name: f.parentJoint - 1 for f in model.frames if f.type == pin.FrameType.BODY and f.parentJoint}
    return Robot(
        file,
        [*model.names][1:],
        ends,
        slides,
        np.array([0, 0, -9.81]),
        [x - 1 for x in [*model.parents][1:]],
        links,
        real,
    )


def _of_mjcf(file: Path) -> Robot | None:
    text = file.read_text(errors="replace")
    if "<mujoco" not in text or "<equality" in text or "<tendon" in text or "gravcomp" in text:
        return None
    model = _loaded(file)
    if not 1 <= model.njnt <= 40 or (model.jnt_type < 2).any() or model.opt.density or model.opt.viscosity:
        return None
    if model.jnt_stiffness.any() or model.qpos0.any():
        return None
    names = [model.joint(k).name for k in range(model.njnt)]
    if not all(names):
        return None

    def real(pull: np.ndarray, errors: np.ndarray, load: tuple[int, float, np.ndarray] | None) -> tuple[Torque, Any]:
        own = _loaded(file)
        own.opt.gravity[:], own.dof_damping[:], own.dof_frictionloss[:] = pull, 0.0, 0.0
        for k, (mass, *move, turn) in enumerate(errors):
            body = own.jnt_bodyid[k]
            own.body_mass[body] *= 1 + mass
            own.body_ipos[body] += np.linalg.norm(own.body_ipos[body]) * np.array(move)
            own.body_inertia[body] *= 1 + turn
        if load:
            _carried(own, int(own.jnt_bodyid[load[0]]), *load[1:])
        data = MADE.MjData(own)

        def torque(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
            own.opt.disableflags |= int(MADE.mjtDisableBit.mjDSBL_CONSTRAINT)
            damping, own.dof_damping[:], rows = own.dof_damping.copy(), 0.0, []  # a closed loop has set it
            for one in zip(q, v, a, strict=True):
                data.qpos[:], data.qvel[:], data.qacc[:] = one
                MADE.mj_inverse(own, data)
                rows.append(data.qfrc_inverse.copy())
            own.dof_damping[:] = damping
            own.opt.disableflags &= ~int(MADE.mjtDisableBit.mjDSBL_CONSTRAINT)
            return np.array(rows)

        return torque, own

    ends = np.where(model.jnt_limited[:, None] > 0, model.jnt_range, [-np.inf, np.inf])
    last = {int(body): k for k, body in enumerate(model.jnt_bodyid)}  # the last joint of a body

    def carrier(body: int) -> int:
        while body and body not in last:
            body = int(model.body_parentid[body])
        return last.get(body, -1)

    parents = []
    for k, body in enumerate(model.jnt_bodyid):
        first = k == 0 or model.jnt_bodyid[k - 1] != body
        parents.append(carrier(int(model.body_parentid[body])) if first else k - 1)
    links = {model.body(k).name: carrier(k) for k in range(1, model.nbody) if carrier(k) >= 0 and model.body(k).name}
    return Robot(file, names, ends, model.jnt_type == 2, model.opt.gravity.copy(), parents, links, real)


def _loaded(file: Path) -> Any:
    model = MADE.MjModel.from_xml_path(str(file))
    for flag in ("CONTACT", "LIMIT", "ACTUATION"):
        model.opt.disableflags |= int(getattr(MADE.mjtDisableBit, f"mjDSBL_{flag}"))
    model.opt.timestep, model.opt.integrator = 0.001, MADE.mjtIntegrator.mjINT_IMPLICITFAST
    return model


def _carried(model: Any, body: int, mass: float, place: np.ndarray) -> None:
    """Add a point mass to a body of MuJoCo's."""
    turn = np.zeros(9)
    MADE.mju_quat2Mat(turn, model.body_iquat[body])
    turn, old, com = turn.reshape(3, 3), float(model.body_mass[body]), model.body_ipos[body].copy()
    middle = (old * com + mass * place) / (old + mass)

    def about(m: float, r: np.ndarray) -> np.ndarray:
        return m * (r @ r * np.eye(3) - np.outer(r, r))

    whole = turn @ np.diag(model.body_inertia[body]) @ turn.T + about(old, com - middle) + about(mass, place - middle)
    moments, axes = np.linalg.eigh(whole)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    model.body_mass[body], model.body_ipos[body], model.body_inertia[body] = old + mass, middle, moments
    MADE.mju_mat2Quat(model.body_iquat[body], axes.ravel())


def drawn(
    robot: Robot, rng: np.random.Generator, args: argparse.Namespace
) -> tuple[Case, Callable[[tuple[str, str]], bool], Forward] | None:
    """A case, what counts as its truth and a motion that is not in its data, of all joints with the torque of each that
    moves and its noise; None where nothing weighs on the joints or the loop does not follow."""
    n = len(robot.names)
    effect = str(rng.choice(args.effects or (["nothing"] if rng.random() < 0.5 else list(HIDDEN))))
    some = int(rng.integers(1, min(n, args.most) + 1))
    if rng.random() < 0.7:
        first = int(rng.integers(n - some + 1))
        moving = [*range(first, first + some)]
    else:
        moving = sorted(rng.permutation(n)[:some].tolist())
    low, high = np.clip(robot.ends, -2.5, 2.5).T
    start = np.where((low <= 0) & (high >= 0), 0.0, (low + high) / 2)
    travel = np.zeros(n)
    for k in moving:
        start[k] = (low[k] + high[k]) / 2
        travel[k] = min(0.15 if robot.slides[k] else 1.0, 0.45 * (high[k] - low[k]))
    posture = {}
    for k in set(range(n)) - set(moving):
        if start[k] or rng.random() < 0.3:
            start[k] = round(float(rng.uniform(low[k], high[k])), 3)
            posture[robot.names[k]] = float(start[k])
    pull = robot.gravity
    turned = bool(rng.random() < 0.2)
    if turned:
        pull = 9.81 * np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [0.6, 0, -0.8]][int(rng.integers(4))])
    exact = bool(rng.random() < 0.3)
    errors = rng.standard_normal((n, 5)) * [0.05, 0.02, 0.02, 0.02, 0.08] * (not exact)
    torque, made = robot.real(pull, errors, None)
    inertia, weight = _sizes(torque, start, travel, moving, rng)
    load = weight + inertia * travel * 4.0  # torque that is typical of the joint
    if (load[moving] < 1e-3 * load.max()).any() or load.max() < 1e-3:
        return None
    if (travel[moving] < 0.01).any() or (effect == "gravity_tilt" and not pull.any()):
        return None
    j = int(rng.choice(moving))
    size = float(rng.choice([0.1, 0.2, 0.4]))
    real_pull, carried, at = pull, None, robot.names[j]
    if effect == "payload":
        held = [name for name, joint in robot.links.items() if joint == j]
        if not held:
            return None
        place = rng.uniform(-1, 1, 3) * 0.3 * travel[j]
        lever = 9.81 * np.linalg.norm(place) + 4.0 * travel[j] * (place @ place)
        lever = 9.81 + 4.0 * travel[j] if robot.slides[j] else lever
        at, carried = held[0], (j, 1.5 * size * load[j] / lever, place)
    if effect == "torque_delay":
        at = ""
    if effect == "gravity_tilt":
        real_pull, at = tilted(pull, 0.3 * size), ""
    if effect in ("payload", "gravity_tilt"):
        torque, made = robot.real(real_pull, errors, carried)
    dry = load * rng.uniform(0.03, 0.2, n)
    viscous = np.divide(0.5 * load * rng.uniform(0.02, 0.15, n), travel, out=np.zeros(n), where=travel > 0)
    rotor = np.zeros(n)
    if effect == "rotor_inertia":
        rotor[j] = 0.5 * size * load[j] / travel[j]
    closed = made is not None and bool(rng.random() < 0.5)
    motion = str(rng.choice(["waves", "waves", "one after another", "moves with rests"])) if closed else "waves"
    number, seconds = int(rng.integers(1, 4)), float(rng.choice([8.0, 15.0, 30.0]))
    rate = float(rng.choice([100.0, 200.0, 250.0, 500.0]))
    noise, counts = float(rng.choice([0.003, 0.01, 0.03])), int(rng.choice([0, 0, 2**14, 2**18]))
    fast = float(rng.choice([0.6, 1.0, 1.8]))
    hidden = (effect if effect in ("joint_spring", "torque_ripple") else "", j, size, load)
    recordings = []
    if made is not None:
        made.dof_armature[:] += rotor
    for _ in range(number):
        if closed:
            got = _moved(rng, made, start, moving, travel + 1e-9, motion, seconds, rate, fast, True,
                         (dry, viscous), hidden)  # fmt: skip
            if got is None:
                return None
            q, v, tau = got
            a = np.gradient(v, 1 / rate, axis=0)
        else:
            every = round(1000 / rate)
            q, v, a = (x[::every] for x in _reference(rng, motion, seconds, 0.001, travel, moving, fast))
            q = q + start
            tau = torque(q, v, a) + viscous * v + rotor * a * (made is None)
            tau[:, moving] += (dry * np.tanh(v / (1e-3 * (travel + 1e-9))))[:, moving]
            tau[:, j] -= _push(hidden, q[:, j], start[j], travel[j])
        rigid = torque(q, v, a)
        tau = _measured(tau, q, v, (effect, j, size), load, dry, rate, moving, rigid)
        tau += noise * load * rng.standard_normal(tau.shape)
        step = 2 * np.pi / counts * travel + 1e-12 if counts else None
        read = q.copy()
        if effect == "encoder_offset":
            read[:, j] += 0.1 * size * travel[j]
        read = read if step is None else np.round(read / step) * step
        speed = v + 20 / max(counts, 2**17) * travel * rng.standard_normal(v.shape)
        recordings.append({"q": read, "dq": speed, "tau": tau})
    order = np.array(moving)[rng.permutation(len(moving)) if rng.random() < 0.3 else slice(None)]
    kept, with_speed = bool(rng.random() < 0.4) and number > 1, bool(rng.random() < 0.4)
    entries: list[dict[str, Any]] = []
    for k, one in enumerate(recordings):
        one |= {name: x[:, order] for name, x in one.items()} | {"t": np.arange(len(one["q"])) / rate}
        entry = {"file": f"run{k}.npz", "time": "t", "position": "q", "torque": "tau"}
        entries.append(entry | ({"velocity": "dq"} if with_speed else {}))
    if kept:
        entries[-1]["role"] = "holdout"
    entry = {"model": str(robot.file.resolve()), "joints": [robot.names[k] for k in order]}
    task: dict[str, Any] = {"robot": entry | ({"posture": posture} if posture else {}), "data": entries}
    if turned:
        task["robot"]["gravity"] = pull.tolist()
    cutoff = min(float(rng.choice([0, 10.0, 20.0, 40.0])), 0.3 * rate)
    if cutoff:
        task["preprocess"] = {"cutoff": cutoff}
    if effect != "torque_offset" and rng.random() < 0.3:
        task["baseline"] = {"viscous": True, "coulomb": True, "offset": True}
    told = (
        f"{effect}{f' at {at}' * (effect != 'nothing')} x{size:g}, {robot.file.parent.name}/{robot.file.name},"
        f" {len(moving)} of {n} joints ({' '.join(robot.names[k] for k in order)}), {'exact' if exact else 'off'}"
        f"{', gravity turned' * turned}, {motion} {fast:g}, {'loop' if closed else 'inverse'},"
        f" {number} of {seconds:g} s at {rate:g} Hz, noise {noise:g}{f', {counts} counts' * bool(counts)}"
        f"{', holdout' * kept}{', velocity' * with_speed}, {task.get('preprocess', '')} {task.get('baseline', '')}"
    )
    truth = (effect, at) if effect != "nothing" else None

    def mover(link: str) -> int:
        """The moving joint that carries a link."""
        joint = robot.links.get(link, -1)
        while joint >= 0 and joint not in moving:
            joint = robot.parents[joint]
        return joint

    def same(name: tuple[str, str]) -> bool:
        if truth is None:
            return False
        alike = name[0] == truth[0] or any({name[0], truth[0]} <= names for names in ALIKE)
        return alike and (name[1] == at or (effect == "payload" and mover(name[1]) == mover(at)))

    q, v, a = (x[::5] for x in _reference(rng, "waves", 8.0, 0.001, travel, moving, 0.8 * fast))
    rubbed = torque(q + start, v, a) + viscous * v + dry * np.sign(v)
    names = [robot.names[k] for k in moving]
    q, v, a, rubbed = (x[:, moving] for x in (q + start, v, a, rubbed))
    ahead = Forward(names, q, v, a, rubbed, noise * load[moving])
    return Case(told, task, {}, recordings, "npz", truth, {}), same, ahead


def _push(hidden: tuple[str, int, float, np.ndarray], q: np.ndarray, start: float, travel: float) -> np.ndarray:
    """Torque that an effect of the robot itself adds to the drive's."""
    effect, j, size, load = hidden
    if effect == "joint_spring":
        return -1.5 * size * load[j] / travel * (q - start - 0.1 * travel)
    return -1.2 * size * load[j] * np.sin(12.0 * q / travel + 0.9) * (effect == "torque_ripple")


def _sizes(
    torque: Torque, start: np.ndarray, travel: np.ndarray, moving: list[int], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Typical inertia and weight felt at each joint that moves."""
    n, rest = len(start), np.zeros((20, len(start)))
    q = start + travel * rng.uniform(-1, 1, (20, n))
    weights = torque(q, rest, rest)
    inertia = np.zeros(n)
    for k in moving:
        inertia[k] = (torque(q, rest, rest + np.eye(n)[k]) - weights)[:, k].mean()
    still = np.isin(np.arange(n), moving)
    return inertia, np.abs(weights).mean(0) * still


def answered(
    case: Case,
    same: Callable[[tuple[str, str]], bool],
    forward: Forward,
    jobs: list[str],
    keep: Path | None,
) -> tuple[list[str], list[str]]:
    """How each command did, in a word and in a line."""

    def judged(folder: Path, job: str) -> tuple[str, str]:
        return diagnosed(folder / job, same) if job == "diagnose" else _predicts(folder / job, forward)

    with written(case, keep) as folder:
        return asked(folder, jobs, lambda job: judged(folder, job))


def _predicts(run: Path, forward: Forward) -> tuple[str, str]:
    """Whether the identified robot, as MuJoCo C reads its file, has the torque of the robot itself."""
    model = MADE.MjModel.from_xml_path(str(run / "model" / "robot.xml"))
    model.opt.disableflags |= int(MADE.mjtDisableBit.mjDSBL_CONSTRAINT)
    data, at = MADE.MjData(model), [forward.names.index(model.joint(k).name) for k in range(model.njnt)]
    rows = []
    for q, v, a in zip(forward.position, forward.velocity, forward.acceleration, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[at], v[at], a[at]
        MADE.mj_inverse(model, data)
        rows.append(data.qfrc_inverse + model.dof_frictionloss * np.sign(v[at]))
    error = np.sqrt(np.mean((np.array(rows) - forward.torque[:, at]) ** 2, axis=0)) / forward.noise[at]
    told = ", ".join(f"{x:.2g}" for x in error)
    return "off" if error.max() > 1 else "right", f"error on another motion, of the noise: {told}"


if __name__ == "__main__":
    main()
