"""Links of a model file that are not those of the robot: how large, which, and what they look like.

The arms are Pinocchio's, which shares no code with the library; what is wrong with their files is drawn at run time.
"""

from __future__ import annotations

import secrets
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
import tasks
from simulated_arm import RATE, Truth, arm, recording

import figaroh_jax as fj
from figaroh_jax.diagnosis.diagnosis import diagnose
from figaroh_jax.formats.assembly import welded_bodies
from figaroh_jax.formats.config import Preprocess
from figaroh_jax.formats.urdf import urdf_parts
from figaroh_jax.recordings.dataset import Recording
from figaroh_jax.reporting import answer, wording
from figaroh_jax.results import Cause, Diagnosis, Links, Name

sys.path.append(str(Path(__file__).resolve().parents[1]))


def diagnosed(truth: Truth, recordings: list[Recording]) -> Diagnosis:
    model = fj.load_urdf(truth.file)
    return diagnose(model, recordings, Preprocess(cutoff=10), welded=welded_bodies(model, urdf_parts(truth.file)[1]))


def recordings(truth: Truth, seed: int) -> list[Recording]:
    return [
        recording(truth, 15.0, seed, name="first"),
        recording(truth, 15.0, seed + 1, name="last", role="holdout"),
    ]


def told(found: Diagnosis) -> Links:
    assert found.links is not None
    assert found.links.gain.after == pytest.approx(found.holdout.before, rel=1e-9)
    assert found.links.gain.before > 2 * found.links.gain.after
    assert np.linalg.norm(found.links.filed) > np.linalg.norm(found.before)
    return found.links


def test_a_hand_of_the_file_that_is_not_mounted_is_told_with_its_mass(tmp_path: Path) -> None:
    seed = secrets.randbits(31)
    rng = np.random.default_rng(seed)
    mass, (x, y, z) = rng.uniform(0.3, 0.8), rng.uniform(-0.05, 0.1, 3)
    hand = f"""<link name="hand"><inertial><origin xyz="{x} {y} {z}"/><mass value="{mass}"/>
      <inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="mount" type="fixed"><parent link="tool0"/><child link="hand"/></joint></robot>"""
    truth = arm(tmp_path, 0.02, seed)  # without the hand
    truth.file.write_text(tasks.URDF.replace("</robot>", hand))
    found = diagnosed(truth, recordings(truth, seed))
    first = told(found).moved[0]
    assert first.name == Name("link_inertia", ("rod",)), (seed, found.links)
    assert first.note == f"as if hand ({mass:.3g} kg), which the file fixes to rod, were not there", (seed, first)
    assert first.numbers["mass"].value == pytest.approx(-mass, abs=0.15 * mass), (seed, first)
    assert first.note in wording.sentence(found, "bench")
    kept = answer.answer(found)["links"]
    assert (kept["moved"][0]["effect"], kept["moved"][0]["at"]) == ("link_inertia", ["rod"])


def test_the_link_whose_mass_lies_elsewhere_is_told_with_its_moments(tmp_path: Path) -> None:
    seed = secrets.randbits(31)
    truth = arm(tmp_path, 0.02, seed)
    way = np.random.default_rng(seed).choice([-1, 1], 2) * np.random.default_rng(seed + 1).uniform(0.05, 0.1, 2)
    body = truth.model.inertias[2]  # the forearm
    truth.model.inertias[2] = pin.Inertia(float(body.mass), body.lever + np.append(way, 0.0), body.inertia)
    found = diagnosed(truth, recordings(truth, seed))
    first = told(found).moved[0]
    assert first.name == Name("link_inertia", ("fore",)), (seed, found.links)
    assert "no body" not in first.note
    moved = truth.model.inertias[2].toDynamicParameters() - np.asarray(truth.nominal.inertia)[1]
    for number, place in (("mx", 1), ("my", 2)):
        value, std, unit = first.numbers[number]
        assert unit == "kg m"
        assert value == pytest.approx(moved[place], abs=max(4 * std, 0.05 * abs(moved[place]))), (seed, number, first)


def test_a_rotor_that_looks_like_its_link_is_told_as_one(tmp_path: Path) -> None:
    seed = secrets.randbits(31)
    truth, size = arm(tmp_path, 0.005, seed), float(np.random.default_rng(seed).uniform(0.3, 0.8))
    found = diagnosed(truth, [_turning(one, size) for one in recordings(truth, seed)])
    shoulder = Name("rotor_inertia", ("shoulder",))
    first = found.causes[0] if found.links is None else found.links.moved[0]  # the search itself may tell it
    assert first.name == shoulder, (seed, found.causes, found.links)
    numbers = first.parameters if isinstance(first, Cause) else first.numbers
    assert numbers["inertia"].value == pytest.approx(size, abs=max(4 * numbers["inertia"].std, 0.1 * size)), seed


def _turning(one: Recording, inertia: float) -> Recording:
    """The recording of an arm whose shoulder turns a rotor besides."""
    torque = np.array(one.torque)
    torque[:, 0] += inertia * np.gradient(np.gradient(one.position[:, 0], 1 / RATE), 1 / RATE)
    return replace(one, torque=torque)


def test_one_gain_of_all_torques_is_told_or_told_to_be_alike(tmp_path: Path) -> None:
    seed = secrets.randbits(31)
    truth, gain = arm(tmp_path, 0.02, seed), float(np.random.default_rng(seed).uniform(1.5, 2.0))
    found = diagnosed(truth, [replace(one, torque=gain * np.array(one.torque)) for one in recordings(truth, seed)])
    first, gained = told(found).moved[0], Name("torque_gain", ())  # a heavier forearm may do as well, if one can be so
    assert first.name == gained or gained in first.instead, (seed, found.links)
    if first.name == gained:
        assert first.numbers["gain"].value == pytest.approx(gain, rel=0.1), (seed, first)


def test_links_that_are_as_believed_are_not_told(tmp_path: Path) -> None:
    seed = secrets.randbits(31)
    truth = arm(tmp_path, 0.05, seed)
    found = diagnosed(truth, recordings(truth, seed))
    assert found.links is None, (seed, found.links)
    assert "links" not in answer.answer(found)
    assert wording.links(found) == []


REAL = {  # what is known of the sets from elsewhere: see the README of each and what it says of its model
    "panda": (Name("link_inertia", ("panda_link7",)), "as if panda_hand"),
    "dfki_double_pendulum": (Name("link_inertia", ("Link2",)), "state it about the joint"),
    "tx40": (Name("rotor_inertia", ("joint_2",)), ""),
}


@pytest.mark.parametrize("name", REAL)
def test_what_is_wrong_with_the_links_of_real_robots_files_is_told(name: str, data_dir: Path, tmp_path: Path) -> None:
    """The Panda's file has a hand that was not mounted, the pendulum's its inertias about the joints, as the set's own
    yml has them; the TX40's has no rotors."""
    from benchmarks import blackbox
    from benchmarks.hide_in_real.generate import twin_of
    from benchmarks.hide_in_real.recordings import SETS
    from figaroh_jax.diagnosis.diagnosis import diagnose_task

    cases, run = tmp_path / "cases", tmp_path / "run"
    run.mkdir()
    found: Any = diagnose_task(fj.load_task(blackbox.write_task(cases, run, twin_of(cases, SETS[name]()))))
    first, note = REAL[name]
    moved = told(found).moved
    assert moved[0].name == first
    assert note in moved[0].note
    if name == "panda":
        assert moved[0].numbers["mass"].value == pytest.approx(-0.73, abs=0.04)  # Franka's hand without its fingers
    if name == "tx40":
        assert moved[1].name == Name("rotor_inertia", ("joint_1",))
