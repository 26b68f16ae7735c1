"""Cases by inverse dynamics (G1): Pinocchio's RNEA along an analytic motion, with hidden effects and sensor noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.optimize import brentq

from . import outside, robots, scene, sensors
from .case import Case, Truth
from .laws import FAMILIES, Draw
from .motion import PERIOD, Motion, excitation, tracked
from .scene import Hidden

# Effects that the catalogue of the library must name.
EFFECTS = (
    "rotor_inertia",
    "torque_offset",
    "coupled_transmission",
    "asymmetric_coulomb_friction",
    "asymmetric_viscous_friction",
    "stribeck_friction",
    "power_law_friction",
    "load_dependent_friction",
    "position_dependent_friction",
    "torque_ripple",
    "joint_spring",
    "gravity_tilt",
    "payload",
    "torque_gain",
    "torque_delay",
    "joint_elasticity",
    "presliding",
    "friction_drift",
    "torque_saturation",
    "contact",
    "external_wrench",
    "clock_error",
    "encoder_offset",
    "encoder_scale",
    "encoder_eccentricity",
    "backlash",
)
FOREIGN = outside.FOREIGN
DIFFERS = ("part", "size", "repeat")  # how effects change from recording to recording

# Pairs of names that torque data of a moving robot cannot tell apart, at the same place.
CLASSES = (
    {"torque_offset", "asymmetric_coulomb_friction"},
    {"payload", "link_inertia"},
    {"torque_delay", "torque_lag"},
)
TRUSTED = {"payload", "link_inertia", "torque_gain"}  # only seen where the inertials are well known
AVERAGED = 4  # samples at 1 kHz in one of the recording

Wanted = str | tuple[str, float] | tuple[str, float, tuple[str, ...]]


def make_case(
    effects: Sequence[Wanted] = (),
    robot: str = "tx40",
    repeats: int = 2,
    trajectories: int = 3,
    noise: float = 1.0,
    seed: int = 0,
    *,
    colour: str = "ar20",
    encoder_step: float = 1e-5,
    holdout: bool = False,
    trusted: bool | None = None,
    duration: float = PERIOD,
    differs: str = "",
    **motion: Any,
) -> Case:
    """Recordings of `robot` with `effects` hidden: names, (name, size) or (name, size, at); size .05 if left out.

    The size is the RMS of the torque that the effect brings about over the RMS torque of its joint (of its larger row
    for a pair, root mean square of all rows otherwise). Equal seeds give equal robots, motions and noise whatever is
    hidden. `noise` scales the noise of both sensors (0: none, and no encoder steps), `colour` is one of
    `sensors.COLOURS`; `holdout` adds one more trajectory with that role; `trusted` makes the true inertials 1 % off
    instead of 5 %; `differs` is how effects change from recording to recording, one of `DIFFERS`; `motion` goes to
    `motion.excitation` (amplitude, speed, harmonics).
    """
    drawn = draw_case(effects, robot, trajectories, seed, holdout=holdout, trusted=trusted, duration=duration, **motion)
    return record_case(drawn, repeats, noise, colour=colour, encoder_step=encoder_step, differs=differs)


def record_case(
    drawn: Drawn,
    repeats: int = 2,
    noise: float = 1.0,
    *,
    colour: str = "ar20",
    encoder_step: float = 1e-5,
    differs: str = "",
) -> Case:
    """The recordings of what was drawn, once: its random numbers go on from there."""
    made, model, hidden = drawn.robot, drawn.model, drawn.hidden
    shares = _shares(differs, len(drawn.motions), repeats, np.random.default_rng([drawn.seed, 11]))
    runs = _runs(made, model, drawn.motions, len(drawn.fit), repeats, drawn.time, hidden, drawn.rng, shares)
    recordings = noisy(runs, drawn.rng, noise, colour, encoder_step)
    truth = tuple(Truth(h.effect, h.at, h.parameters(h.scale)) for h in hidden)
    induced = {h.effect: _size(made, model, drawn.fit, drawn.time, h) for h in hidden} if noise == 0 else {}
    trust = 0.02 if drawn.trusted else 0.10
    for h in hidden:
        model = h.change(model, h.scale) if h.change else model
    links = tuple(tuple(robots.ten(model, j).tolist()) for j in range(model.nv))
    return Case(made.name, made.urdf, made.joints, recordings, truth, trust, drawn.seed, induced, links=links)


class Drawn(NamedTuple):
    """What a case is made of, before anything is recorded."""

    robot: robots.Robot
    model: pin.Model  # as it really is, without the effects
    motions: list[Motion]
    fit: list[Motion]  # those that are not held out
    time: np.ndarray
    hidden: list[Hidden]
    trusted: bool  # whether the inertials are well known
    seed: int
    rng: np.random.Generator  # of the recordings


def draw_case(
    effects: Sequence[Wanted] = (),
    robot: str = "tx40",
    trajectories: int = 3,
    seed: int = 0,
    *,
    holdout: bool = False,
    trusted: bool | None = None,
    duration: float = PERIOD,
    **motion: Any,
) -> Drawn:
    """What `make_case` records."""
    wanted, trusted = choose(effects, trusted)
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(4)]
    made = robots.load(robot)
    model = robots.true_robot(made.model, 0.01 if trusted else 0.05, streams[0])
    motions = [excitation(model, streams[1], **motion) for _ in range(trajectories + holdout)]
    time = scene.grid(duration)
    fit = motions[:trajectories]
    hidden = [hide(made, model, fit, time, streams[2], *item) for item in wanted]
    return Drawn(made, model, motions, fit, time, hidden, trusted, seed, streams[3])


def observable(truth: Truth) -> set[tuple[str, tuple[str, ...]]]:
    """Every (effect, at) that is right for the hidden effect: itself and what cannot be told from it."""
    names = {truth.effect}.union(*(c for c in CLASSES if truth.effect in c))
    return {(name, truth.at) for name in names}


def choose(effects: Sequence[Wanted], trusted: bool | None) -> tuple[list[tuple[str, float, Any]], bool]:
    """The wanted effects as (name, size, at), and whether the inertials are to be well known."""
    wanted = [_wanted(item) for item in effects]
    return wanted, bool(TRUSTED & {name for name, _, _ in wanted}) if trusted is None else trusted


def _wanted(item: Wanted) -> tuple[str, float, tuple[str, ...] | None]:
    name, size, at, *_ = (*((item,) if isinstance(item, str) else item), None, None)
    if name not in FAMILIES:
        raise ValueError(f"no family '{name}'; known: {', '.join(FAMILIES)}")
    return str(name), 0.05 if size is None else float(size), None if at is None else tuple(at)  # type: ignore[arg-type]


def hide(
    robot: robots.Robot,
    model: pin.Model,
    motions: list[Motion],
    time: np.ndarray,
    rng: np.random.Generator,
    name: str,
    size: float,
    at: tuple[str, ...] | None,
) -> Hidden:
    """The effect at a random place with random parameters, drawn again until its size is physical there."""
    for _ in range(40):
        drawn = FAMILIES[name](Draw(robot, model, motions, rng, at))
        scaled = _scaled(robot, model, motions, time, drawn, size)
        if scaled is not None:
            return scaled
    raise ValueError(f"'{name}' of size {size} is not physical anywhere on {robot.name}")


def _scaled(
    robot: robots.Robot, model: pin.Model, motions: list[Motion], time: np.ndarray, drawn: Hidden, size: float
) -> Hidden | None:
    """The effect with the scale that gives it its size, None where that scale is out of its bounds."""
    lower, upper = drawn.bounds

    def size_at(scale: float) -> float:
        return _size(robot, model, motions, time, replace(drawn, scale=scale))

    if drawn.linear:
        unit = 1e-2 if drawn.change else 1.0  # a body small enough to leave the link one that can exist
        reached = size_at(unit) / unit
        scale = size / reached if reached > 1e-9 else np.inf
    else:
        scale = _solve(size_at, size, lower, upper)
    return replace(drawn, scale=float(scale)) if lower < scale < upper else None


def _solve(size_at: Callable[[float], float], size: float, lower: float, upper: float) -> float:
    """Scale at which the size is reached within .5 %: proportional steps, which suit most laws, else bisection."""
    scale = float(np.sqrt(lower * upper))
    for _ in range(5):
        reached = max(size_at(scale), 1e-12)
        if abs(reached / size - 1) < 5e-3:
            return scale
        scale *= size / reached
        if not lower < scale < upper:
            break
    miss = lambda log: np.log(max(size_at(float(np.exp(log))), 1e-12) / size)  # noqa: E731
    ends = np.log([lower, upper])
    if miss(ends[0]) > 0 or miss(ends[1]) < 0:
        return np.inf
    root: Any = brentq(miss, *ends, xtol=2e-3)
    return float(np.exp(root))


def _size(robot: robots.Robot, model: pin.Model, motions: list[Motion], time: np.ndarray, hidden: Hidden) -> float:
    pairs = [scene.induced(robot, model, motion, time, hidden) for motion in motions]
    return scene.relative_size(hidden, pairs)


def _runs(
    robot: robots.Robot,
    model: pin.Model,
    motions: list[Motion],
    trajectories: int,
    repeats: int,
    time: np.ndarray,
    hidden: list[Hidden],
    rng: np.random.Generator,
    shares: np.ndarray,
) -> list[dict[str, Any]]:
    """Runs at the recording's rate, before sensor noise: every trajectory `repeats` times, a held-out one once.

    `shares` (trajectories, repeats) are those of the effects' sizes that a run has.
    """
    runs = []
    for number, motion in enumerate(motions):
        held = number >= trajectories
        for repeat in range(1 if held else repeats):
            followed = tracked(motion, rng)
            here = [replace(h, scale=h.scale * share) for h in hidden if (share := shares[number, repeat])]
            q, tau = scene.run(robot, model, followed, time, here, rng.uniform())
            label = chr(ord("A") + number)
            run: dict[str, Any] = {
                "time": _averaged(time, time),
                "position": _averaged(time, q),
                "torque": _averaged(time, tau),
            }
            run["name"] = f"holdout_{label}" if held else f"run_{label}{repeat + 1}"
            run |= {"repeat": label if repeats > 1 and not held else None, "role": "holdout" if held else "fit"}
            runs.append(run)
    return runs


def shares_of(case: Case, differs: str, trajectories: int, repeats: int) -> np.ndarray:
    """Which share of its size the effect of a case without held-out recordings has in each of its recordings."""
    return _shares(differs, trajectories, repeats, np.random.default_rng([case.seed, 11])).ravel()


def _shares(differs: str, trajectories: int, repeats: int, rng: np.random.Generator) -> np.ndarray:
    """Which share of its size an effect has in each run, (trajectories, repeats)."""
    shares = np.ones((trajectories, repeats))
    if differs == "part":  # a tool that is not always on the flange
        shares[rng.permutation(trajectories)[: rng.integers(1, trajectories)]] = 0
    elif differs == "size":  # friction by the temperature of the day
        shares *= rng.uniform(0.4, 1.6, (trajectories, 1))
    elif differs == "repeat" and repeats > 1:  # what was done again was done otherwise
        shares[:, repeats // 2 :] = 0
    elif differs:
        raise ValueError(f"effects do not differ by '{differs}' in {repeats} repeats; known: {', '.join(DIFFERS)}")
    return shares


def _averaged(time: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Means of four samples at 1 kHz from t = 0 on."""
    kept = x[np.searchsorted(time, -1e-9) :]
    kept = kept[: len(kept) // AVERAGED * AVERAGED]
    return kept.reshape(-1, AVERAGED, *x.shape[1:]).mean(1)


def noisy(
    runs: list[dict[str, Any]], rng: np.random.Generator, noise: float, colour: str, step: float
) -> tuple[dict[str, Any], ...]:
    """The runs as their sensors read them: torque noise relative to each joint's RMS, encoder noise and steps."""
    fit = [run["torque"] for run in runs if run["role"] == "fit"]
    rms = np.sqrt(np.mean(np.concatenate(fit) ** 2, 0))
    out = []
    for run in runs:
        position, torque = run["position"], run["torque"]
        if noise > 0:
            torque = torque + sensors.torque_noise(len(torque), rms, rng, colour, noise)
            position = sensors.encoder(position, rng, noise, step)
        out.append(run | {"position": position, "torque": torque})
    return tuple(out)
