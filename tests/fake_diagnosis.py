"""Diagnoses made up for the tests of the report, the terminal and `answer.json`: plausible signals, no model behind."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from figaroh_jax.results import (
    Candidate,
    Cause,
    Diagnosis,
    Estimate,
    Experiment,
    Gain,
    Name,
    Nearest,
    Part,
    Rest,
    Trace,
)

JOINTS = tuple(f"joint_{number}" for number in range(1, 7))
COUPLING = Name("coupled_transmission", ("joint_5", "joint_6"))
ROTOR = Name("rotor_inertia", ("joint_3",))
_SCALE = np.array([30.0, 25.0, 12.0, 4.0, 3.0, 2.0])  # torque of each joint, N m


def named() -> Diagnosis:
    """Two causes, the second with an alternative; a fit recording and a held-out one."""
    rng = np.random.default_rng(7)
    traces = (_trace("exciting run", "fit", 4000, rng), _trace("held_out", "holdout", 900, rng))
    before, after = (np.sqrt(np.mean((traces[0].measured - x) ** 2, 0)) for x in (traces[0].before, traces[0].after))
    return Diagnosis(
        verdict="named",
        causes=_causes(),
        p_value=0.0025,
        joints=JOINTS,
        before=before,
        after=after,
        noise=0.95 * after,
        holdout=Gain(0.1392, 0.0551),
        holdout_scheme="the recording held_out, which no fit and no choice has seen",
        experiment=Experiment(
            "joint_3 alone, slow and fast, in two postures of the joints beyond it",
            (("rotor_inertia", "link_inertia"),),
        ),
        candidates=_candidates(rng),
        traces=traces,
        baseline=None,
        model=None,
        notes=("exciting run: 12 samples before the motion left out", "joint_1: the encoder steps by 3e-5 rad"),
    )


def left(text: str) -> Rest:
    """A rest at two joints, with a cause that came near."""
    parts = (
        Part("standstill", ("joint_2",), 0.62),
        Part("frequency", ("joint_2",), 0.1, band=(3.0, 3.4)),
        Part("recording", ("joint_4",), 0.2, file="exciting run"),
    )
    near = Nearest(
        Name("torque_ripple", ("joint_2",)), 0.18, "its gain on held-out data is not significant: t = 1.9, 2.3 needed"
    )
    return Rest(np.array([0.0, 0.024, 0.0, 0.011, 0.0, 0.0]), parts, (near,), text)


def partly() -> Diagnosis:
    """A cause is named and a part of the error stays without a name."""
    rest = left("joint_2, 0.4 N m, mostly with its position")
    return replace(named(), verdict="named+rest", causes=named().causes[:1], rest=rest)


def unknown() -> Diagnosis:
    """Something is wrong, and the catalogue has no name for it."""
    rest = "joint_4: 0.31 N m above the noise, strongest against its velocity"
    clean = named()
    same = tuple(replace(trace, after=trace.before, shares={}) for trace in clean.traces)
    holdout = Gain(0.1392, 0.1392)
    return replace(
        clean,
        verdict="unknown",
        causes=(),
        after=clean.before,
        holdout=holdout,
        experiment=None,
        rest=left(rest),
        traces=same,
    )


def nothing() -> Diagnosis:
    """Nothing is missing."""
    clean = named()
    return replace(
        clean,
        verdict="nothing",
        causes=(),
        p_value=0.43,
        before=clean.after,
        holdout=Gain(0.052, 0.052),
        experiment=None,
        traces=tuple(replace(trace, before=trace.after, shares={}) for trace in clean.traces),
    )


def _causes() -> tuple[Cause, ...]:
    coupling = {
        "inertia": Estimate(0.01127, 0.00021, "kg m2"),
        "damping": Estimate(0.6087, 0.0113, "N m s/rad"),
        "friction": Estimate(1.957, 0.034, "N m"),
        "sign": Estimate(1.0, 0.0, ""),
    }
    return (
        Cause(COUPLING, coupling, 0.97, Gain(0.1392, 0.0718), note="URDF has no form for it; MJCF: a fixed tendon"),
        Cause(
            ROTOR,
            {"inertia": Estimate(0.0931, 0.0041, "kg m2")},
            0.81,
            Gain(0.0718, 0.0551),
            ambiguous_with=(Name("link_inertia", ("link_3",)),),
        ),
    )


def _candidates(rng: np.random.Generator) -> tuple[Candidate, ...]:
    single = ("rotor_inertia", "torque_offset", "stribeck_friction", "joint_spring", "torque_gain", "joint_elasticity")
    names = [COUPLING] + [Name(effect, (joint,)) for effect in single for joint in JOINTS] + [Name("gravity_tilt", ())]
    values = rng.uniform(size=(len(names), 4))
    return tuple(
        Candidate(
            name,
            identifiable=float(share),
            detectable=float("inf") if share < 0.05 else float(0.02 + threshold),
            nearest=None if name == COUPLING else ROTOR,
            angle=float(90 * angle),
            score=float(40 * score**6) if name != COUPLING else 62.0,
        )
        for name, (share, threshold, angle, score) in zip(names, values, strict=True)
    )


def _trace(name: str, role: str, samples: int, rng: np.random.Generator) -> Trace:
    time = np.arange(samples) / 100.0
    phase = rng.uniform(0, 2 * np.pi, (3, len(JOINTS)))
    speeds = 2 * np.pi * np.array([0.1, 0.23, 0.37])
    position = (np.sin(speeds * time[:, None, None] + phase.T) / np.arange(1, 4)).sum(axis=-1)
    velocity = np.gradient(position, time, axis=0)
    acceleration = np.gradient(velocity, time, axis=0)
    rigid = _SCALE * (0.6 * np.sin(position + 0.4) + 0.1 * acceleration + 0.2 * np.tanh(velocity / 0.02))
    rotor = np.zeros_like(rigid)
    rotor[:, 2] = 0.9 * acceleration[:, 2]
    coupling = np.zeros_like(rigid)
    motor = velocity[:, 4] + velocity[:, 5]
    coupling[:, 4] = 0.25 * velocity[:, 5] + 0.8 * np.tanh(motor / 0.02)
    coupling[:, 5] = 0.25 * velocity[:, 4] + 0.8 * np.tanh(motor / 0.02)
    noise = 0.012 * _SCALE * rng.standard_normal(rigid.shape)
    return Trace(
        name,
        role,  # pyright: ignore[reportArgumentType]
        time,
        position,
        velocity,
        measured=rigid + rotor + coupling + noise,
        before=rigid,
        after=rigid + rotor + coupling,
        shares={str(COUPLING): coupling, str(ROTOR): rotor},
    )
