"""Closed-loop recordings with friction that sticks: MuJoCo C under position control, as an industrial drive does it.

Dry friction is MuJoCo's own constraint on every joint, set-valued at rest, its level set anew at every step by the laws
that are hidden. The loop: proportional and derivative action on the encoder's steps; gravity of the nominal model (in
every other case its whole inverse dynamics) and most of the friction as feed-forward; a delay; a limit of the drive.
What is recorded: the encoder, and the drive's torque with the noise and the steps of a current sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import pinocchio as pin  # pyright: ignore[reportMissingImports]
from generators import plant, robots, scene
from generators.case import Case, Truth
from generators.closed_loop import _hide_one, _physics
from generators.inverse import Wanted, choose
from generators.laws import Hidden
from generators.motion import PERIOD, Motion, excitation, tracked
from scipy.signal import butter, sosfiltfilt

Array = np.ndarray
mj: Any = mujoco  # its stubs lack these names
STEP = 5e-4  # s, of the simulation
CONTROL = 2  # steps between two commands
SAMPLE = 8  # steps of a recorded sample: 250 Hz
WARM_UP = 2.0  # s
SPEEDS = (80.0, 50.0, 30.0, 20.0, 12.0)  # rad/s, bandwidth of the position loop: the first with which no joint shakes
SHAKES = 0.02  # RMS speed above 20 Hz over that below, beyond which a joint does: no drive is left tuned so
STUCK = 0.02  # rad or m, error at which the proportional part alone breaks a joint loose
STIFFER = 2.0  # times the bandwidth, at most, that a joint gets for it
SMOOTH = 100.0  # Hz, low pass of the speed that the loop feels


@dataclass(frozen=True)
class Loop:
    """What drive and sensors are like in one case."""

    encoder: float  # rad, one step
    delay: int  # commands
    limit: float  # times the largest torque that the motion asks for
    forward: bool  # the nominal inverse dynamics, not gravity alone, as feed-forward
    noise: float  # of the torque reading, share of the joint's RMS torque
    bits: float  # steps of the torque reading over the joint's largest torque
    speed: float = SPEEDS[0]  # rad/s, bandwidth of the position loop


def loop_of(rng: np.random.Generator) -> Loop:
    """A drive at random."""
    return Loop(
        encoder=float(np.exp(rng.uniform(np.log(2e-6), np.log(2e-5)))),
        delay=int(rng.integers(0, 3)),
        limit=float(rng.uniform(0.95, 2.0)),
        forward=bool(rng.integers(2)),
        noise=float(rng.uniform(0.005, 0.03)),
        bits=float(2.0 ** rng.integers(10, 13)),
    )


def make_stiction_case(
    effects: Sequence[Wanted] = (), robot: str = "tx40", repeats: int = 2, trajectories: int = 3, seed: int = 0
) -> Case:
    """Recordings of `robot` under position control with `effects` hidden, as in `generators.make_closed_loop_case`."""
    wanted, trusted = choose(effects, None)
    rngs = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5)]
    made = robots.load(robot)
    model = robots.true_robot(made.model, 0.01 if trusted else 0.05, rngs[0])
    motions = [excitation(model, rngs[1]) for _ in range(trajectories)]
    time = scene.grid(PERIOD)
    hidden = [_hide_one(made, model, motions, time, rngs[2], item) for item in wanted]
    loop, runs = loop_of(rngs[4]), []
    followed = [[tracked(motion, rngs[3], 1e-4) for _ in range(repeats)] for motion in motions]
    for speed in SPEEDS:
        loop = replace(loop, speed=speed)
        calm, runs = True, []
        for number, motion in ((k, m) for k, each in enumerate(followed) for m in each):
            runs.append({"label": chr(ord("A") + number), **_run(made, model, motion, hidden, loop)})
            calm = not _shaking(runs[-1])
            if not calm:
                break
        if calm:
            break
    else:
        raise ValueError(f"{robot}: its drives shake at every bandwidth")
    for k, run in enumerate(runs):
        label = run.pop("label")
        repeat = label if repeats > 1 else None
        run |= {"name": f"run_{label}{k % repeats + 1}", "repeat": repeat, "role": "fit"}
    _read(runs, loop, rngs[3])
    truth = tuple(Truth(h.effect, h.at, h.parameters(h.scale)) for h in hidden)
    baseline = {"rotor": True} if any(h.effect == "coupled_transmission" for h in hidden) else {}
    return Case(robot, made.urdf, made.joints, tuple(runs), truth, 0.02 if trusted else 0.10, seed, {}, baseline)


def _shaking(run: dict[str, Any]) -> bool:
    """Whether a joint oscillates beside its motion: chatter does away with dry friction, so nothing would be clean."""
    step = run["time"][1] - run["time"][0]
    v = np.diff(run["position"], axis=0) / step
    slow = sosfiltfilt(butter(4, 20.0, fs=1 / step, output="sos"), v, axis=0)
    return bool(np.any(np.std(v - slow, axis=0) > SHAKES * np.std(slow, axis=0)))


def _run(made: robots.Robot, model: pin.Model, motion: Motion, hidden: list[Hidden], loop: Loop) -> dict[str, Any]:
    """One recording before its torque is read: encoder and drive torque at 250 Hz."""
    physics, structure, changed, late, gain = _physics(made, model, hidden)
    compiled = mj.MjModel.from_xml_string(plant.mjcf(changed, made, structure))
    compiled.opt.timestep = STEP
    compiled.dof_solref[:] = (2 * STEP, 1.0)
    compiled.dof_solimp[:, :3] = (0.999, 0.9999, 1e-3)
    compiled.tendon_solref_fri[:] = (2 * STEP, 1.0)
    compiled.tendon_solimp_fri[:, :3] = (0.999, 0.9999, 1e-3)
    time = np.arange(-WARM_UP, PERIOD + 0.1, STEP * CONTROL)
    q, v, a = motion.at(time)
    forward = robots.torque(made.model, q, *((v, a) if loop.forward else (0 * v, 0 * a)))
    forward = forward + 0.8 * (made.viscous * v + made.coulomb * np.tanh(v / 0.02))
    needed = np.abs(robots.torque(made.model, q, v, a)).max(0) + made.viscous * np.abs(v).max(0) + made.coulomb
    # the least that a drive feels while the others give way: on axes that nearly coincide much less than the diagonal;
    # of the true robot, for a nominal link may have no inertia about its own axis
    along = np.linalg.inv(plant.inertia_along(changed, structure.armature, q[::100]))
    inertia = 1 / np.diagonal(along, axis1=1, axis2=2).max(0)
    stiffness = inertia * loop.speed**2
    stiffness = np.clip(made.coulomb / STUCK, stiffness, STIFFER**2 * stiffness)
    gains = stiffness, 2 * np.sqrt(inertia * stiffness)
    reading, torque = _simulate(compiled, physics, (q, v), forward, gains, loop, loop.limit * needed)
    fine = -WARM_UP + STEP * np.arange(len(torque))
    if late:
        torque = np.stack([np.interp(fine - late, fine, column) for column in torque.T], 1)
    first, rows = int(round(WARM_UP / STEP)), int(round(PERIOD / STEP / SAMPLE))

    def mean(x: Array) -> Array:
        return x[first : first + rows * SAMPLE].reshape(rows, SAMPLE, -1).mean(1)

    # the drive's torque acts from a reading to the next: both are told for the middle
    middle = (reading + np.vstack([reading[1:], reading[-1:]])) / 2
    return {"time": mean(fine[:, None] + STEP / 2)[:, 0], "position": mean(middle), "torque": mean(torque) * gain}


def _simulate(
    model: Any,
    physics: plant.Physics,
    desired: tuple[Array, Array],
    forward: Array,
    gains: tuple[Array, Array],
    loop: Loop,
    limit: Array,
) -> tuple[Array, Array]:
    """Encoder reading and drive torque (steps, nv) of a run, one row of `desired` and `forward` a command."""
    data = mj.MjData(model)
    data.qpos[:], data.qvel[:] = desired[0][0], desired[1][0]
    steps, nv = CONTROL * len(forward), model.nv
    q_log, drive_log = np.empty((steps, nv)), np.empty((steps, nv))
    load, drive = np.zeros(nv), forward[0].copy()
    pending = [drive] * (loop.delay + 1)
    kp, kd = gains
    keep = np.exp(-2 * np.pi * SMOOTH * STEP * CONTROL)
    before, speed = np.round(data.qpos / loop.encoder) * loop.encoder, data.qvel.copy()
    pair = model.ntendon > 0
    model.dof_damping[:] = physics.viscous
    if pair:
        model.tendon_damping[:], model.tendon_frictionloss[:] = physics.coupling
    for step in range(steps):
        q, v = data.qpos, data.qvel
        seen = np.round(q / loop.encoder) * loop.encoder
        if step % CONTROL == 0:
            k = step // CONTROL
            if step:
                speed = keep * speed + (1 - keep) * (seen - before) / (STEP * CONTROL)
            before = seen
            wanted = forward[k] + kp * (desired[0][k] - seen) + kd * (desired[1][k] - speed)
            pending = [*pending[1:], np.clip(wanted, -limit, limit)]
            drive = pending[0]
        q_log[step], drive_log[step] = seen, drive
        level = sum(law(q, v, load) for law in physics.levels)
        model.dof_frictionloss[:] = np.maximum(level, 0.0)
        # what a constraint cannot be: friction of the other sign
        data.qfrc_applied[:] = drive - np.minimum(level, 0.0) * np.sign(v) - sum(f(q, v) for f in physics.torques)
        mj.mj_step(model, data)
        if physics.needs_load:
            mj.mj_mulM(model, data, load, data.qacc)
            load += data.qfrc_bias
    return q_log, drive_log


def _read(runs: list[dict[str, Any]], loop: Loop, rng: np.random.Generator) -> None:
    """The torque of all runs as a current sensor reads it."""
    torque = np.concatenate([run["torque"] for run in runs])
    rms, step = np.sqrt(np.mean(torque**2, 0)), np.maximum(np.abs(torque).max(0), 1e-6) / loop.bits
    for run in runs:
        noisy = run["torque"] + loop.noise * rms * rng.standard_normal(run["torque"].shape)
        run["torque"] = np.round(noisy / step) * step
