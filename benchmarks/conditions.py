"""Recordings as strangers make them: `diagnose` of a small arm whose length, rates, filter and sensors are drawn.

    python benchmarks/conditions.py clean --seeds 0 40
    python benchmarks/conditions.py rotor --seeds 0 20     # .03 kg m^2 at the elbow that the URDF does not hold
    python benchmarks/conditions.py foreign --seeds 0 20   # a torque that no effect of the catalogue has

The torques are MuJoCo C's inverse dynamics, with viscous and dry friction that the baseline fits. Drawn are: seconds,
number of recordings, repeats, one that is kept out, sampling rate, jitter of the stamps, counts of the encoder, colour
and level of the noise, speed of the motion, standstill at its end, the row filter's cutoff and the rate of the rows.
One line a case, with what was drawn where the answer is not `nothing`.
"""

from __future__ import annotations

import argparse
import collections
import tempfile
from dataclasses import asdict, dataclass
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
ROTOR = 0.03  # kg m^2
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


def motion(rng: np.random.Generator, told: Conditions) -> np.ndarray:
    """Rates (rad/s), phases (rad) and speeds (rad/s) of the harmonics of a motion, by joint."""
    fastest = told.fastest
    return np.stack([rng.uniform(a, b, (WAVES, 2)) for a, b in ((0.5, fastest), (0, 6), (0.2, 0.6))])


def moved(t: np.ndarray, waves: np.ndarray, told: Conditions) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity and acceleration at the stamps; with `stops` it slows down smoothly and stands."""
    clock, pace, slowing = t, np.ones_like(t), np.zeros_like(t)
    if told.stops:
        start, length = 0.6 * told.seconds, 0.2 * told.seconds
        x = np.clip((t - start) / length, 0, 1)
        pace, slowing = 1 - x**2 * (3 - 2 * x), -6 * x * (1 - x) / length
        clock = np.minimum(t, start) + length * (x - x**3 + x**4 / 2)
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


def make(folder: Path, seed: int, hidden: str) -> Conditions:
    """A task and its files, drawn from the seed."""
    rng = np.random.default_rng(seed)
    told = draw(rng)
    links = [("base", 1.0, "0 0 0", 0.01), ("upper", 4.0, ".2 0 0", 0.05), ("fore", 2.0, ".15 0 0", 0.02)]
    joints = [("shoulder", "base", "upper", "0 0 0"), ("elbow", "upper", "fore", ".4 0 0")]
    parts = [*(_link(*link) for link in links), *(JOINT.format(*joint) for joint in joints)]
    urdf = f'<robot name="two">{"".join(parts)}</robot>'
    (folder / "robot.urdf").write_text(urdf)
    model = mj.MjModel.from_xml_string(urdf)
    model.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_LIMIT | mj.mjtDisableBit.mjDSBL_CONTACT)
    model.dof_armature[1] = ROTOR if hidden == "rotor" else 0.0
    viscous, dry = rng.uniform(0.1, 1, 2), rng.uniform(0.2, 2, 2) * told.coulomb
    waves, lines = motion(rng, told), []
    for run in range(told.recordings):
        again = told.repeats and run % 2 == 1
        waves = waves if again else motion(rng, told)
        t = np.arange(0, told.seconds, 1 / told.rate)
        t = t + told.jitter * rng.uniform(-0.1, 0.1, len(t)) / told.rate
        q, v, a = moved(t, waves, told)
        tau = _inverse(model, q, v, a) + viscous * v + dry * np.sign(v)
        if hidden == "foreign":
            tau[:, 1] += 0.15 * tau[:, 1].std() * np.sin(3 * q[:, 0]) * np.tanh(2 * v[:, 1] * q[:, 1])
        tau = tau + told.level * tau.std(0) * noise(rng, len(t), told.colour)
        step = 2 * np.pi / told.counts if told.counts else 0.0
        np.savez(folder / f"{run}.npz", t=t, q=np.round(q / step) * step if step else q, tau=tau)
        last = told.held_out and told.recordings > 1 and run == told.recordings - 1
        pair = told.repeats and not last and (again or run + 1 < told.recordings - told.held_out)
        label = f", repeat: m{run // 2}" if pair else ""
        role = "holdout" if last else "fit"
        lines.append(f"  - {{file: {run}.npz, time: t, position: q, torque: tau, role: {role}{label}}}\n")
    rows = f", rate: {told.rows}" if told.rows else ""
    head = "robot: {model: robot.urdf, trust: 0.03}\ndata:\n"
    (folder / "task.yaml").write_text(f"{head}{''.join(lines)}preprocess: {{cutoff: {told.cutoff}{rows}}}\n")
    return told


def _link(name: str, mass: float, com: str, moment: float) -> str:
    inertia = INERTIA.format(moment)
    return f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{com}"/>{inertia}</inertial></link>'


def _inverse(model: Any, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    data, out = mj.MjData(model), np.empty_like(q)
    for row, state in enumerate(zip(q, v, a, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = state
        mj.mj_inverse(model, data)
        out[row] = data.qfrc_inverse
    return out


def main() -> None:
    """Diagnose the cases in turn, a line each, and count the verdicts."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("hidden", choices=["clean", "rotor", "foreign"])
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 20], metavar=("FIRST", "NUMBER"))
    args = parser.parse_args()
    first, number = args.seeds
    verdicts: collections.Counter[str] = collections.Counter()
    p: list[float] = []
    for seed in range(first, first + number):
        with tempfile.TemporaryDirectory() as scratch:
            told = make(Path(scratch), seed, args.hidden)
            found = fj.diagnose_task(fj.load_task(f"{scratch}/task.yaml"))
        assert isinstance(found, fj.Diagnosis)
        names = [f"{cause.name.effect} at {', '.join(cause.name.at)}" for cause in found.causes]
        wrong = [n for n in names if args.hidden != "rotor" or n != "rotor_inertia at elbow"]
        grade = f"wrong ({found.verdict})" if wrong else found.verdict
        verdicts[grade] += 1
        p.append(found.p_value)
        drawn = "" if grade == "nothing" else f"  {asdict(told)}"
        print(
            f"{seed} {grade} p {found.p_value:.3f} {names} {found.rest.text if found.rest else ''}{drawn}", flush=True
        )
    print(args.hidden, dict(verdicts), f"p < .05 in {np.mean(np.array(p) < 0.05):.0%}")


if __name__ == "__main__":
    main()
