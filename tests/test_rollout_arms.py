"""Arms of several servos, made by MuJoCo C: each joint alone among the measured others, and causes in one of them."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest
from generators import servo_arm6

from figaroh_jax.rollouts.alone import alone, carried_by, separable
from figaroh_jax.rollouts.arm import search_arm
from figaroh_jax.rollouts.data import Run, Stretch, windows
from figaroh_jax.rollouts.faults import faults, without
from figaroh_jax.rollouts.parameters import Entry
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.search import setting
from figaroh_jax.rollouts.sensitivity import predicted

ROWS = 400


def recorded(hidden: list[tuple[str, int, float]], number: int = 0) -> Run:
    r = servo_arm6.record(hidden, 4, number)
    return Run(f"run {number}", r["t"], r["u"], r["q"], None)


def test_a_joint_alone_moves_as_in_the_arm_with_a_payload_beyond_it(tmp_path: Path):
    """The lift and the elbow, the motion of the others taken from their noisy encoders, once the start is forgotten."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text())
    loop, _ = load_loop(tmp_path / "arm.xml")
    assert separable(loop)
    run = recorded([("payload", 5, 0.3)])
    carried = carried_by(loop, [run])
    for joint in (1, 2):
        small, (mine,) = alone(loop, [run], carried, joint)
        data = windows(small, [mine], [Stretch(0, 0, ROWS)], [np.array([2e-4])], 0.3, smooth=True)
        read = {}
        for mass in (0.0, 0.3):
            with jax.enable_x64(True):
                theta = np.array([[mass]])
                found = predicted(small, (Entry("payload", (5,)),), theta, data, np.asarray(data.start)[None])
            read[mass] = np.sqrt(np.mean((np.asarray(found)[0, 100:ROWS, 0, 0] - mine.position[100:ROWS, 0]) ** 2))
        assert read[0.3] < 10 * servo_arm6.NOISE < 30 * servo_arm6.NOISE < read[0.0]


def test_a_clock_that_jumps_and_a_joint_that_is_held_are_told_with_time_and_place(tmp_path: Path):
    """None in a sound recording; one each where all joints are 80 ms late from 14 s on and an elbow is held for 2 s."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text())
    loop, _ = load_loop(tmp_path / "arm.xml")
    both = [recorded([], k) for k in range(2)]
    command, truth = (np.concatenate([getattr(run, name) for run in both]) for name in ("command", "position"))
    sound = Run("sound", 0.01 * np.arange(len(truth)), command, truth, None)
    late = np.where(sound.time[:, None] > 14.0, np.roll(truth, 8, axis=0), truth)
    held, push = truth.copy(), command.copy()
    held[400:600, 2], push[400:600, 2] = truth[400, 2], truth[400, 2] + 0.4
    runs = [sound, sound._replace(position=late), sound._replace(position=held, command=push)]
    assert faults(loop, runs[:1], [truth]) == []
    found = faults(loop, runs, [truth] * 3)
    assert [(one.kind, one.run) for one in found] == [("clock_error", 1), ("contact", 2)]
    clock, contact = found
    assert abs(clock.first - 14.0) <= 2.0 and abs(clock.size - 0.08) <= 0.015
    assert contact.joints == (2,) and abs(contact.first - 4.0) < 0.5 and abs(contact.last - 6.0) < 0.5
    assert "elbow stands against" in contact.text(loop, runs)
    trusted = without(runs, found)[2].trusted
    assert trusted is not None and not trusted[450:550].any()


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [[], [("stribeck_friction", 2, 0.3)]])
def test_an_arm_gets_no_wrong_name(tmp_path: Path, hidden: list):
    """What is named is hidden there; `unknown` is allowed: the rest must be noise in the whole arm's simulation."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text(1.6))
    loop, _ = load_loop(tmp_path / "arm.xml")
    runs = [recorded(hidden, k) for k in range(2)]
    left_out = ("joint_elasticity", "backlash")
    cut = [Stretch(k, f, 400) for k in range(2) for f in (0, 400)]
    found = search_arm(setting(loop, runs, stretches=cut, forbid=left_out), forbid=left_out)
    told = {(n.candidate.effect, n.candidate.at[0]) for n in found.named}
    assert not found.faults
    assert told <= {(effect, servo_arm6.NAMES[joint]) for effect, joint, _ in hidden}
