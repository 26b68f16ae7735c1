"""Recordings as strangers make them: `diagnose` of a small arm whose length, rates, filter and sensors are drawn.

    python benchmarks/conditions.py clean --seeds 0 40
    python benchmarks/conditions.py rotor --seeds 0 20     # .03 kg m^2 at the elbow that the URDF does not hold
    python benchmarks/conditions.py foreign --seeds 0 20   # a torque that no effect of the catalogue has
    python benchmarks/conditions.py tooth --seeds 0 20     # a spot of a gear that is felt in one direction
    python benchmarks/conditions.py carried --seeds 0 20   # a body that is gripped and let go in each recording
    python benchmarks/conditions.py pushed --seeds 0 20    # a push at the forearm's tip, once in each recording
    python benchmarks/conditions.py changed --seeds 0 20   # a joint's friction, gain or zero is another one for a while
    python benchmarks/conditions.py clean --strange        # with what a stranger's recording has beside

The torques are MuJoCo C's inverse dynamics, with viscous and dry friction that the baseline fits. Drawn are: seconds,
number of recordings, repeats, one that is kept out, sampling rate, jitter of the stamps, counts of the encoder, colour
and level of the noise, speed of the motion, standstill at its end, the row filter's cutoff and the rate of the rows.
`--strange` draws beside: torque from a current of ten bits, stamps in whole milliseconds, samples that are lost or
repeated, recordings of two rates, pauses, a known payload, a tilted base, a wrist that never moves, and CSV in degrees
of four decimals with a driver's velocity that lags.
One line a case, with what was drawn where the answer is not `nothing`; `--out` keeps all of it, a JSON line a case.
"""

from __future__ import annotations

import argparse
import collections
import json
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import figaroh_jax as fj

mj: Any = mujoco  # its stubs lack these names
INERTIA = '<inertia ixx="{0}" iyy="{0}" izz="{0}" ixy="0" ixz="0" iyz="0"/>'
JOINT = (
    '<joint name="{}" type="revolute"><parent link="{}"/><child link="{}"/><origin xyz="{}"/><axis xyz="0 1 0"/>'
    '<limit lower="-9" upper="9" velocity="9" effort="80"/></joint>'
)
FIXED = '<joint name="{}" type="fixed"><parent link="{}"/><child link="{}"/><origin xyz="{}" rpy="{}"/></joint>'
ROTOR = 0.03  # kg m^2
MOTOR = 2.5  # N m an A
LOAD = (0.7, "0.3 0 0.05")  # kg; m in the forearm's frame
WAVES = 6  # harmonics of a motion


@dataclass(frozen=True)
class Conditions:
    """What is drawn of a case: s, Hz, rad/s, and shares of the torque's standard deviation."""

    seconds: float
    recordings: int
    rate: float
    cutoff: float
    rows: float  # Hz, 0: as `diagnose` chooses
    fastest: float
    colour: str
    level: float
    counts: float  # a turn, 0: exact
    jitter: bool
    repeats: bool
    held_out: bool
    stops: bool
    coulomb: bool


def draw(rng: np.random.Generator) -> Conditions:
    """Conditions of one case."""
    seconds, rate = float(rng.choice([4, 8, 20, 60])), float(rng.choice([50, 100, 250, 1000]))
    rate = rate if seconds * rate <= 20000 else 250.0
    cutoff = min(float(rng.choice([5, 10, 15, 0.25 * rate])), 0.3 * rate)
    return Conditions(
        seconds=seconds,
        recordings=int(rng.integers(1, 5)),
        rate=rate,
        cutoff=cutoff,
        rows=float(rng.choice([0, min(int(0.9 * rate), max(40, int(4 * cutoff)))])),
        fastest=float(rng.choice([2, 7, 12])),
        colour=str(rng.choice(["white", "slow", "pink"])),
        level=float(rng.choice([0.003, 0.02, 0.1])),
        counts=float(rng.choice([0, 0, 4096, 65536])),
        jitter=bool(rng.random() < 0.2),
        repeats=bool(rng.random() < 0.35),
        held_out=bool(rng.random() < 0.4),
        stops=bool(rng.random() < 0.3),
        coulomb=bool(rng.random() < 0.7),
    )


@dataclass(frozen=True)
class Strange:
    """What a stranger's recording has beside; by default nothing of it."""

    adc: bool = False  # torque from a current that is read with ten bits
    whole_ms: bool = False  # stamps in ms without decimals, of a rate that has some
    lost: float = 0.0  # share of the samples
    stale: float = 0.0  # share of the samples that repeat the one before
    two_rates: bool = False
    pauses: bool = False  # at both ends, a sixth to a third of the time each
    payload: bool = False  # known
    tilted: bool = False  # base, as the URDF says
    idle: bool = False  # a wrist that never moves
    text: bool = False  # CSV, degrees, four decimals, a velocity that lags


def draw_strange(rng: np.random.Generator) -> Strange:
    """Each of them in a fifth of the cases."""
    names = list(Strange.__dataclass_fields__)
    yes = dict(zip(names, (rng.random(len(names)) < 0.2).tolist(), strict=True))
    lost, stale = (float(yes.pop(name)) * float(rng.uniform(0.003, 0.03)) for name in ("lost", "stale"))
    return replace(Strange(**yes), lost=lost, stale=stale)


def motion(rng: np.random.Generator, told: Conditions) -> np.ndarray:
    """Rates (rad/s), phases (rad) and speeds (rad/s) of the harmonics of a motion, by joint."""
    fastest = told.fastest
    return np.stack([rng.uniform(a, b, (WAVES, 2)) for a, b in ((0.5, fastest), (0, 6), (0.2, 0.6))])


def moved(
    t: np.ndarray, waves: np.ndarray, told: Conditions, pause: float = 0.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and acceleration at the stamps; with `stops` it slows down smoothly and stands.

    With a `pause` (share of the time) it stands at both ends.
    """
    clock, pace, slowing = t, np.ones_like(t), np.zeros_like(t)
    ramps = [(1, pause, 0.1), (-1, 0.9 - pause, 0.1)] if pause else [(-1, 0.6, 0.2)] if told.stops else []
    if pause:
        clock, pace = np.zeros_like(t), np.zeros_like(t)
    for sign, start, length in ramps:
        x = (t / told.seconds - start) / length
        rising, seconds = np.clip(x, 0, 1), sign * length * told.seconds
        clock = clock + seconds * (rising**3 - rising**4 / 2 + np.maximum(x - 1, 0))
        pace = pace + sign * rising**2 * (3 - 2 * rising)
        slowing = slowing + 6 * rising * (1 - rising) / seconds
    rate, phase, speed = waves[:, :, None]
    angle = rate * clock[:, None] + phase
    forward = (speed * np.cos(angle)).sum(0)
    bend = -(speed * rate * np.sin(angle)).sum(0)
    q = (speed / rate * np.sin(angle)).sum(0)
    return q, forward * pace[:, None], bend * pace[:, None] ** 2 + forward * slowing[:, None]


def noise(rng: np.random.Generator, count: int, colour: str) -> np.ndarray:
    """Noise of unit variance at two joints: white, of first order, or with a power of 1/f."""
    white = rng.standard_normal((count, 2))
    if colour == "white":
        return white
    shape = np.fft.rfftfreq(count)[:, None]
    shape[0] = shape[1]
    gain = shape**-0.5 if colour == "pink" else 1 / np.abs(1 - 0.95 * np.exp(-2j * np.pi * shape))
    out = np.fft.irfft(np.fft.rfft(white, axis=0) * gain, count, axis=0)
    return out / out.std(0)


def make(folder: Path, seed: int, hidden: str, strange: bool = False) -> tuple[Conditions, Strange]:
    """A task and its files, drawn from the seed."""
    rng = np.random.default_rng(seed)
    told, beside = draw(rng), Strange()
    other = np.random.default_rng([seed, 1])
    if strange:
        beside = draw_strange(other)
        if beside.whole_ms:
            told = replace(told, rate={50: 60.0, 100: 120.0, 250: 240.0, 1000: 333.0}[int(told.rate)], jitter=False)
            told = replace(told, cutoff=min(told.cutoff, 0.25 * told.rate), rows=0.0)
    model = _robot(folder, beside)
    model.dof_armature[1] = ROTOR if hidden == "rotor" else 0.0
    viscous, dry = rng.uniform(0.1, 1, 2), rng.uniform(0.2, 2, 2) * told.coulomb
    waves, lines, spot = motion(rng, told), [], None
    pause = float(other.uniform(0.15, 0.3)) * beside.pauses
    for run in range(told.recordings):
        again = told.repeats and run % 2 == 1
        waves = waves if again else motion(rng, told)
        rate = told.rate / (2 if beside.two_rates and run % 2 and 0.5 * told.rate > 2.5 * told.cutoff else 1)
        t = np.arange(0, told.seconds, 1 / rate)
        t = t + told.jitter * rng.uniform(-0.1, 0.1, len(t)) / rate
        q, v, a = moved(t, waves, told, pause)
        tau = _inverse(model, q, v, a)
        tau[:, :2] += viscous * v + dry * np.sign(v)
        if hidden == "foreign":
            tau[:, 1] += 0.15 * tau[:, 1].std() * np.sin(3 * q[:, 0]) * np.tanh(2 * v[:, 1] * q[:, 1])
        if hidden == "tooth":
            spot = np.quantile(q[:, 1], np.random.default_rng((seed, 1)).uniform(0.3, 0.7)) if spot is None else spot
            tau[:, 1] += 0.4 * tau[:, 1].std() * np.exp(-(((q[:, 1] - spot) / 0.06) ** 2)) * (v[:, 1] > 0)
        if hidden in ("carried", "pushed"):
            tau[:, :2] += _held(folder, hidden, np.random.default_rng((seed, 2, run)), t / told.seconds, (q, v, a))
        if hidden == "changed":
            _change(tau, v, np.random.default_rng((seed, 3)), np.random.default_rng((seed, 3, run)), t / told.seconds)
        tau[:, :2] += told.level * tau[:, :2].std(0) * noise(rng, len(t), told.colour)
        if beside.idle:
            q, v = (np.column_stack([x, value * np.ones(len(t))]) for x, value in ((q, 0.4), (v, 0.0)))
            tau[:, 2] += told.level * tau[:, 2].std() * noise(other, len(t), told.colour)[:, 0]
        step = 2 * np.pi / told.counts if told.counts else 0.0
        arrays = {"t": t, "q": np.round(q / step) * step if step else q, "tau": tau, "dq": v}
        keys = _write(folder, run, arrays, beside, other)
        last = told.held_out and told.recordings > 1 and run == told.recordings - 1
        pair = told.repeats and not last and (again or run + 1 < told.recordings - told.held_out)
        label = f", repeat: m{run // 2}" if pair else ""
        load = ", load: {frame: fore, mass: 0.7, com: [0.3, 0, 0.05]}" if beside.payload else ""
        role = "holdout" if last else "fit"
        lines.append(f"  - {{{keys}, role: {role}{label}{load}}}\n")
    most = (0.45 if beside.two_rates else 0.9) * told.rate
    rows = f", rate: {min(told.rows, most)}" if told.rows else ""
    head = "robot: {model: robot.urdf, trust: 0.03}\ndata:\n"
    gears = f"transmission: {{torque: {[MOTOR] * model.nv}}}\n" if beside.adc else ""
    text = f"{head}{''.join(lines)}{gears}preprocess: {{cutoff: {told.cutoff}{rows}}}\n"
    (folder / "task.yaml").write_text(text)
    return told, beside


def _robot(folder: Path, beside: Strange, load: float = LOAD[0]) -> Any:
    """The URDF that the task names, and the MuJoCo model of the true robot (`load`, kg, where it has a payload)."""
    links = [("base", 1.0, "0 0 0", 0.01), ("upper", 4.0, ".2 0 0", 0.05), ("fore", 2.0, ".15 0 0", 0.02)]
    joints = [("shoulder", "base", "upper", "0 0 0"), ("elbow", "upper", "fore", ".4 0 0")]
    if beside.idle:
        links.append(("hand", 0.5, ".05 0 .02", 0.002))
        joints.append(("wrist", "fore", "hand", ".3 0 0"))
    parts = [*(_link(*link) for link in links), *(JOINT.format(*joint) for joint in joints)]
    if beside.tilted:
        parts.append('<link name="floor"/>' + FIXED.format("mount", "floor", "base", "0 0 0", "0.5 0.3 0"))
    (folder / "robot.urdf").write_text(f'<robot name="two">{"".join(parts)}</robot>')
    if beside.payload:
        parts.append(_link("load", load, "0 0 0", 1e-9) + FIXED.format("grip", "fore", "load", LOAD[1], "0 0 0"))
    model = mj.MjModel.from_xml_string(f'<robot name="two">{"".join(parts)}</robot>')
    model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_LIMIT | mj.mjtDisableBit.mjDSBL_CONTACT)
    return model


def _write(folder: Path, run: int, arrays: dict[str, np.ndarray], beside: Strange, rng: np.random.Generator) -> str:
    """The file of a recording; the keys of its entry in the task."""
    units, t, tau = {}, arrays["t"], arrays["tau"]
    if beside.adc:
        step = 4 * np.abs(tau).max() / 1024 / MOTOR
        arrays["tau"], units["torque"] = np.round(tau / MOTOR / step) * step, "A"
    if beside.whole_ms:
        arrays["t"], units["time"] = np.round(1e3 * t), "ms"
    again = np.flatnonzero(rng.random(len(t)) < beside.stale)
    for name in ("q", "tau", "dq"):
        arrays[name][again[again > 0]] = arrays[name][again[again > 0] - 1]
    kept = rng.random(len(t)) >= beside.lost
    arrays = {name: x[kept] for name, x in arrays.items()}
    if not beside.text:
        np.savez(folder / f"{run}.npz", allow_pickle=False, **arrays)
        told = "".join(f", {key}: {unit}" for key, unit in units.items())
        units_key = f", units: {{{told[2:]}}}" if units else ""
        return f"file: {run}.npz, time: t, position: q, torque: tau{units_key}"
    nv, lag = tau.shape[1], np.exp(-np.diff(t, prepend=t[0]) / 0.02)[kept]
    late = arrays["dq"].copy()
    for row in range(1, len(late)):
        late[row] = late[row - 1] * lag[row] + late[row] * (1 - lag[row])
    groups = {"angle": np.degrees(arrays["q"]), "rate": np.degrees(late), "moment": arrays["tau"]}
    names = {key: [f"{key}_{k + 1}" for k in range(nv)] for key in groups}
    head = ",".join(["stamp", *(name for each in names.values() for name in each)])
    table = np.column_stack([arrays["t"], *groups.values()])
    forms = ["%.0f" if beside.whole_ms else "%.6f", *["%.4f"] * (3 * nv)]
    np.savetxt(folder / f"{run}.csv", table, delimiter=",", header=head, comments="", fmt=forms)
    units |= {"position": "deg"}
    told = ", ".join(f"{key}: {unit}" for key, unit in units.items())
    keys = f"position: {names['angle']}, velocity: {names['rate']}, torque: {names['moment']}"
    return f"file: {run}.csv, time: stamp, {keys}, units: {{{told}}}".replace("'", "")


def _link(name: str, mass: float, com: str, moment: float) -> str:
    inertia = INERTIA.format(moment)
    return f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{com}"/>{inertia}</inertial></link>'


def _held(
    folder: Path, what: str, rng: np.random.Generator, course: np.ndarray, motion: tuple[np.ndarray, ...]
) -> np.ndarray:
    """Torque (N m) of a body that is carried for a part of a recording, or of a push that rises and falls.

    `course` is the share of the recording's time that has gone by.
    """
    if what == "pushed":
        peak, width = rng.uniform(0.2, 0.8), rng.uniform(0.02, 0.05)
        force = rng.uniform(10, 30) * np.exp(-(((course - peak) / width) ** 2))
        q = motion[0]
        reach = np.stack([0.4 * np.cos(q[:, 0]) + 0.3 * np.cos(q.sum(1)), 0.3 * np.cos(q.sum(1))], 1)
        return force[:, None] * reach
    start = rng.uniform(0.1, 0.5)
    while_held = (course > start) & (course < start + rng.uniform(0.2, 0.4))
    mass = LOAD[0] * rng.uniform(0.4, 2)
    bare, loaded = (_robot(folder, beside, mass) for beside in (Strange(), Strange(payload=True)))
    return (_inverse(loaded, *motion) - _inverse(bare, *motion))[:, :2] * while_held[:, None]


def _change(
    tau: np.ndarray, v: np.ndarray, of: np.random.Generator, rng: np.random.Generator, course: np.ndarray
) -> None:
    """Let a joint have another friction, gain or zero of its torque for a part of a recording."""
    joint, what, size = int(of.integers(2)), of.choice(["friction", "gain", "zero"]), of.uniform(0.1, 0.5)
    start = rng.uniform(0.1, 0.5)
    there = (course > start) & (course < start + rng.uniform(0.2, 0.4))
    own = {"friction": tau[:, joint].std() * np.sign(v[:, joint]), "gain": tau[:, joint], "zero": tau[:, joint].std()}
    tau[:, joint] += size * own[str(what)] * there


def _inverse(model: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    data, out = mj.MjData(model), np.empty((len(q), model.nv))
    data.qpos[2:] = 0.4  # of the wrist that never moves
    for row, state in enumerate(zip(q, v, a, strict=True)):
        data.qpos[:2], data.qvel[:2], data.qacc[:2] = state
        mj.mj_inverse(model, data)
        out[row] = data.qfrc_inverse
    return out


def graded(seed: int, hidden: str, strange: bool = False) -> dict[str, Any]:
    """The answer to one case, as it is printed and kept."""
    with tempfile.TemporaryDirectory() as scratch:
        told, beside = make(Path(scratch), seed, hidden, strange)
        begun, found, text = time.process_time(), None, ""
        try:
            found = fj.diagnose_task(fj.load_task(f"{scratch}/task.yaml"))
        except fj.InputError as refused:
            text = str(refused).replace(scratch, "")
    drawn = asdict(told) | {name: value for name, value in asdict(beside).items() if value}
    out: dict[str, Any] = {"seed": seed, "hidden": hidden, "drawn": drawn, "cpu": time.process_time() - begun}
    if found is None:
        return out | {"grade": "refused", "names": [], "text": text, "p": 1.0}
    assert isinstance(found, fj.Diagnosis)
    names = [f"{cause.name.effect} at {', '.join(cause.name.at)}" for cause in found.causes]
    truth = {"rotor": "rotor_inertia at elbow", "carried": "payload at fore"}.get(hidden)
    wrong = [name for name in names if name != truth]
    out |= {"grade": f"wrong ({found.verdict})" if wrong else found.verdict, "names": names, "p": found.p_value}
    if found.rest is not None:
        near = [f"{one.name.effect} at {', '.join(one.name.at)}: {one.why_not}" for one in found.rest.nearest]
        out |= {"text": found.rest.text, "relative": [float(x) for x in found.rest.relative], "nearest": near}
    out["said"] = [cause.note for cause in found.causes]
    out |= {name: [float(x) for x in getattr(found, name)] for name in ("noise", "before", "after")}
    return out | {"notes": list(found.notes)}


def main() -> None:
    """Diagnose the cases in turn, a line each, and count the verdicts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("hidden", choices=["clean", "rotor", "foreign", "tooth", "carried", "pushed", "changed"])
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 20], metavar=("FIRST", "NUMBER"))
    parser.add_argument("--strange", action="store_true", help="with what a stranger's recording has beside")
    parser.add_argument("--out", type=Path, help="file to which all of each answer is added, a JSON line a case")
    parser.add_argument("--seconds", type=float, default=np.inf, help="no case is begun later")
    args = parser.parse_args()
    first, number = args.seeds
    begun, verdicts, p = time.monotonic(), collections.Counter[str](), []
    for seed in range(first, first + number):
        if time.monotonic() - begun > args.seconds:
            break
        one = graded(seed, args.hidden, args.strange)
        verdicts[one["grade"]] += 1
        p.append(one["p"])
        drawn = "" if one["grade"] == "nothing" else f"  {one['drawn']}"
        print(f"{seed} {one['grade']} p {one['p']:.3f} {one['names']} {one.get('text', '')}{drawn}", flush=True)
        if args.out:
            with args.out.open("a") as kept:
                kept.write(json.dumps(one) + "\n")
    print(args.hidden, dict(verdicts), f"p < .05 in {np.mean(np.array(p) < 0.05):.0%}")


if __name__ == "__main__":
    main()
