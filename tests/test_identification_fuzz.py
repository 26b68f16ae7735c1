"""Models and data drawn at random: an identification ends with numbers or with one message, never otherwise."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from robots import joint, link, robot

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.formats.config import Baseline, Preprocess
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.identification import identification
from figaroh_jax.identification.result import to_json
from figaroh_jax.recordings.dataset import Recording

identify = partial(identification.identify, check=False)  # of arms that no check would let pass

SAMPLES = 900  # one length: one program for all draws of a kind
AXES = ("1 0 0", "0 1 0", "0 0 1")


@st.composite
def models(draw: st.DrawFn) -> str:
    """A chain of two joints of any kind, with links from feathers to tons, some of which cannot exist."""
    masses = [draw(st.sampled_from([0.0, 1e-6, 0.5, 3.0, 1e4])) for _ in range(2)]
    kinds = [draw(st.sampled_from(["continuous", "prismatic"])) for _ in range(2)]
    limit = '<limit lower="-9" upper="9" effort="9" velocity="9"/>'
    joints = [
        joint(f"j{k}", parent, child, kind, axis=draw(st.sampled_from(AXES)), more=limit)
        for k, (parent, child, kind) in enumerate(zip(("base", "a"), ("a", "b"), kinds, strict=True))
    ]
    return robot(link("base"), *(link(name, mass) for name, mass in zip("ab", masses, strict=True)), *joints)


CHOICES = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 2**31),
        "motion": st.sampled_from([0.0, 1e-6, 1.0, 30.0]),
        "jitter": st.sampled_from([0.0, 1e-4, 1.0]),
        "torque": st.sampled_from([0.0, 1e-9, 1.0, 1e6]),
        "friction": st.sampled_from([0.0, 5.0]),
        "step": st.sampled_from([0.0, 0.1]),
        "jump": st.sampled_from([0.0, 1e3]),
    }
)


def recording(chosen: dict) -> Recording:
    """Motions and torques of any size, quantised, constant, noisy, with jumps."""
    generator = np.random.default_rng(chosen["seed"])
    t = np.arange(SAMPLES) / 100.0
    q = chosen["motion"] * np.sin(2 * np.pi * generator.uniform(0.1, 3, 2) * t[:, None] + generator.uniform(0, 6, 2))
    q = q + chosen["jitter"] * generator.normal(size=q.shape)
    tau = chosen["torque"] * generator.normal(size=q.shape) + chosen["friction"] * np.sign(q)
    tau = np.round(tau / chosen["step"]) * chosen["step"] if chosen["step"] else tau
    tau[SAMPLES // 2 :, 0] += chosen["jump"]
    return Recording("run", Path("run.npz"), ("j0", "j1"), t, q, None, tau)


def ended(folder: Path, text: str, chosen: dict, drives: bool, fit: Any) -> None:
    """What an identification of the model from the recording ends with."""
    file = folder / "robot.urdf"
    file.write_text(text)
    try:
        model: fj.RobotModel = load_urdf(file)
        found = identify(
            model, [recording(chosen)], Preprocess(cutoff=10), Baseline(rotor=drives, offset=drives), fit=fit
        )
    except InputError as error:
        assert str(error) and "\n" not in str(error)
        return
    answer = json.loads(to_json(found))  # strict: no NaN
    assert all(None not in entry["parameters"] for entry in answer["links"])
    assert all(b["value"] is not None and b["std"] is not None for b in answer["base_parameters"])
    assert all(entry["consistent"] for entry in answer["links"]) or fit == "unconstrained"
    assert all(np.isfinite(value) for value in found.fit.rms[np.isfinite(found.fit.rms)])


DRAWN = given(models(), CHOICES, st.booleans(), st.sampled_from(["physical", "unconstrained", "log_cholesky"]))
UNHURRIED = {"deadline": None, "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]}


@settings(max_examples=5, **UNHURRIED)
@DRAWN
def test_any_data_ends_with_numbers_or_one_message(tmp_path: Path, text: str, chosen: dict, drives: bool, fit: str):
    ended(tmp_path, text, chosen, drives, fit)


@pytest.mark.slow
@settings(max_examples=60, **UNHURRIED)
@DRAWN
def test_any_of_many_data_does(tmp_path: Path, text: str, chosen: dict, drives: bool, fit: str):
    ended(tmp_path, text, chosen, drives, fit)
