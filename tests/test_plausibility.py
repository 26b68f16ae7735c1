"""Values of a result that no such robot has are said; right ones are not."""

from __future__ import annotations

from pathlib import Path

import equinox as eqx
import numpy as np
import pytest
from generators import servo_arm
from tasks import URDF

from figaroh_jax.effects.base import Effect, place
from figaroh_jax.effects.catalogue import find
from figaroh_jax.effects.extended import extend
from figaroh_jax.effects.plausibility import implausible
from figaroh_jax.formats.urdf import load_urdf
from figaroh_jax.rigid.model import RobotModel
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.task import extended_of


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotModel:
    path = tmp_path_factory.mktemp("robot") / "robot.urdf"
    path.write_text(URDF)
    return load_urdf(path)


def heavier(robot: RobotModel, link: int, factor: float) -> RobotModel:
    inertia = np.array(robot.inertia)
    inertia[link] *= factor
    return eqx.tree_at(lambda r: r.inertia, robot, inertia)


def test_a_mass_far_from_what_was_trusted_is_named_with_both_values(robot: RobotModel):
    (note,) = implausible(robot, extend(heavier(robot, 1, 7.5)), trust=0.1)
    assert "mass of fore is 15 kg, where 2 kg was trusted to 10 %" in note and "65 sigma" in note


@pytest.mark.parametrize(("factor", "trust"), [(1.4, 0.02), (3.0, 1.0), (0.8, 0.1)])
def test_a_mass_within_what_was_trusted_or_nearly_the_same_is_not(robot: RobotModel, factor: float, trust: float):
    assert implausible(robot, extend(heavier(robot, 1, factor)), trust) == ()


@pytest.mark.parametrize(
    ("effect", "values", "said"),
    [
        ("coulomb_friction", {"friction": 60.0}, "coulomb_friction of elbow: friction 60 N m is above"),
        ("coulomb_friction", {"friction": 6.0}, None),
        ("viscous_friction", {"damping": 11.0}, "damping 11 gives 55 N m at the speed limit"),
        ("viscous_friction", {"damping": 2.0}, None),
        ("torque_offset", {"offset": -70.0}, "70 N m is above the model's effort limit of 50"),
    ],
)
def test_drives_beyond_the_effort_limit_are_named(robot: RobotModel, effect: str, values, said: str | None):
    kind: type[Effect] = find(effect)
    names = kind.amplitudes()
    placed = place(kind, robot, ["elbow"], **dict(zip(names, values.values(), strict=False)))
    notes = implausible(robot, extend(robot, placed), 0.1)
    assert notes == () if said is None else said.split(": ")[-1].split(" ", 1)[1] in notes[0]


def test_a_payload_heavier_than_the_robot_is_named(robot: RobotModel):
    placed = place(find("payload"), robot, ["rod"], mass=8.0)
    assert any("more than the whole robot" in note for note in implausible(robot, extend(robot, placed), 0.1))


def test_frictions_of_a_rollout_are_held_against_the_effort_limit(tmp_path: Path):
    file = tmp_path / "arm.xml"
    file.write_text(servo_arm.model_text().replace('axis="0 1 0"', 'axis="0 1 0" actuatorfrcrange="-30 30"'))
    loop, _ = load_loop(file)
    assert implausible(loop.robot, extended_of(loop), 0.1) == ()
    stuck = eqx.tree_at(lambda loop: loop.joints.friction, loop, np.full(1, 400.0))
    (note,) = implausible(stuck.robot, extended_of(stuck), 0.1)
    assert "400 N m is above the model's effort limit of 30" in note
