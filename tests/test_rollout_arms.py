"""Arms of several servos, made by MuJoCo C: each joint alone among the measured others, and causes in one of them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import equinox as eqx
import jax
import mujoco
import numpy as np
import pytest
from generators import servo_arm, servo_arm6
from scipy import stats

from figaroh_jax.rollouts.alone import alone, carried_by, separable
from figaroh_jax.rollouts.arm import search_arm
from figaroh_jax.rollouts.data import Run, Stretch, windows
from figaroh_jax.rollouts.faults import faults, without
from figaroh_jax.rollouts.fit import System, _freedom, fit, spread_of_recordings, standard_errors  # pyright: ignore[reportPrivateUsage]
from figaroh_jax.rollouts.parameters import Entry, values
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.sensitivity import Sums, Windows, predicted
from figaroh_jax.rollouts.setting import Structure, begun, evened, setting
from figaroh_jax.rollouts.simulation import rollout
from figaroh_jax.rollouts.thresholds import t_of, t_of_places

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
    assert "elbow is held against" in contact.text(loop, runs)
    trusted = without(runs, found)[2].trusted
    assert trusted is not None and not trusted[450:550].any()


def test_an_arm_that_rests_on_something_is_told_where_several_joints_stand_off_at_once(tmp_path: Path):
    """Each of three joints is off by less than a lone one must be; two at once are not enough."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text())
    loop, _ = load_loop(tmp_path / "arm.xml")
    sound = recorded([])
    theirs = mujoco.MjModel.from_xml_string(servo_arm6.model_text())  # pyright: ignore[reportAttributeAccessIssue]
    state = mujoco.MjData(theirs)  # pyright: ignore[reportAttributeAccessIssue]
    state.qpos[:] = sound.position[400]
    mujoco.mj_forward(theirs, state)  # pyright: ignore[reportAttributeAccessIssue]
    command = sound.command.copy()
    command[400:600] = sound.position[400] + state.qfrc_bias / np.array(servo_arm6.KP)  # what gravity asks for
    sound = sound._replace(command=command)
    model = sound.position + 2e-3 * np.random.default_rng(1).normal(size=sound.position.shape)
    found: dict = {}
    for joints in ((1, 2), (1, 2, 3)):
        position = sound.position.copy()
        position[400:600] = position[400]
        read = np.where((np.arange(len(position)) // 200 == 2)[:, None], position, model)
        position[400:600, joints] += 0.012
        found[joints] = faults(loop, [sound, sound._replace(position=position)], [model, read])
        still = command.copy()  # joints that are not moved in this recording stand where they stood at first
        still[:, joints] = command[400, joints]
        found["still", joints] = faults(loop, [sound, sound._replace(position=position, command=still)], [model, read])
    assert found[1, 2] == found["still", (1, 2)] == []
    assert [one for one in found["still", (1, 2, 3)] if len(one.joints) > 2] == []
    (one,) = found[1, 2, 3]
    assert (one.kind, one.run, one.joints) == ("contact", 1, (1, 2, 3))
    assert abs(one.first - 4.0) < 0.5 and abs(one.last - 6.0) < 0.5
    assert one.size == pytest.approx(0.012 * servo_arm6.KP[1], rel=0.2)
    assert "lift, elbow, flex stand off the model's motion at once" in one.text(loop, [sound, sound])


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


@pytest.mark.slow
def test_what_a_later_cause_made_needless_is_not_named(tmp_path: Path):
    """A lift that its drive's voltage limits: a torque offset makes up for a part of it until the limit is found."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text(1.6))
    loop, _ = load_loop(tmp_path / "arm.xml")
    recordings = [servo_arm6.record([("voltage_saturation", 1, 0.6)], 56694, k) for k in range(2)]
    runs = [Run(f"run {k}", r["t"], r["u"], r["q"], None) for k, r in enumerate(recordings)]
    found = search_arm(setting(loop, runs, stretches=[Stretch(k, f, 600) for k in range(2) for f in (0, 600)]))
    assert [n.candidate[:2] for n in found.named] == [("voltage_saturation", ("lift",))]


@pytest.mark.slow
@pytest.mark.parametrize(("joint", "share", "seed"), [(1, 0.4, 1001381), (2, 0.35, 12)])
def test_a_drive_that_lets_its_joint_fall_is_told_by_its_limit(tmp_path: Path, joint: int, share: float, seed: int):
    """A lift whose drive is at its limit nearly always, and an elbow for a quarter of the time: a baseline without the
    limit holds the lift up with friction a hundred times too large, from which no step leads to the limit."""
    (tmp_path / "arm.xml").write_text(servo_arm6.model_text(1.6))
    loop, _ = load_loop(tmp_path / "arm.xml")
    recordings = [servo_arm6.record([("voltage_saturation", joint, share)], seed, k) for k in range(2)]
    runs = [Run(f"run {k}", r["t"], r["u"], r["q"], None) for k, r in enumerate(recordings)]
    found = search_arm(setting(loop, runs, stretches=[Stretch(k, f, 600) for k in range(2) for f in (0, 600)]))
    (one,) = found.named
    assert one.candidate[:2] == ("voltage_saturation", (servo_arm6.NAMES[joint],))
    limit = found.last.theta[one.candidate.entries[0]]
    assert limit == pytest.approx(share * 0.25 * servo_arm6.KP[joint], rel=1e-3)


def test_one_linear_step_promises_what_least_squares_gives():
    """Numbers of all windows and the states at each window's start; columns that are left out stay where they are."""
    rng, numbers, states, windows_, rows = np.random.default_rng(5), 4, 2, 3, 30
    slope = rng.normal(size=(windows_, rows, numbers + states))
    error = rng.normal(size=(windows_, rows)) + slope[:, :, 0] - 0.5 * slope[:, :, 2]
    gradient, matrix = np.einsum("wrc,wr->wc", slope, error), np.einsum("wrc,wrd->wcd", slope, slope)
    sums = Sums((error**2).sum(1)[None, :, None], gradient[None], matrix[None])  # pyright: ignore[reportArgumentType]
    nothing = np.zeros((states, windows_))
    data = Windows(None, None, None, nothing, nothing, None, 1, 0, rows)
    subsets = [np.arange(numbers), np.array([0]), np.array([2, 3]), np.array([], int)]
    promised = System(sums, data, nothing).promises(subsets)
    for subset, promise in zip(subsets, promised, strict=True):
        own = [np.zeros((windows_, rows, states)) for _ in range(windows_)]
        for k in range(windows_):
            own[k][k] = slope[k, :, numbers:]
        columns = np.concatenate([slope[:, :, subset], *own], 2).reshape(windows_ * rows, -1)
        left = error.ravel() - columns @ np.linalg.lstsq(columns, error.ravel(), rcond=None)[0]
        assert promise == pytest.approx((error**2).sum() - (left**2).sum(), rel=1e-4)


SWING = """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
<body pos="0 0 1"><joint name="swing" axis="0 1 0" stiffness="25" damping="0.4"/>
<inertial pos="0 0 0" mass="2" diaginertia=".05 .05 .05"/>
<body pos="0 0 -0.1">
<joint name="leg" axis="0 1 0" armature="{armature}" damping="{damping}" frictionloss="{friction}"/>
<inertial pos="0 0 -0.15" mass="0.8" diaginertia=".006 .006 .001"/></body></body></worldbody>
<actuator><position name="leg" joint="leg" kp="40" kv="0.8"/></actuator></mujoco>"""


def test_a_base_that_swings_unmeasured_is_simulated_and_the_leg_identified(tmp_path: Path):
    """The leg's numbers from its encoder alone; MuJoCo C made the motion of both."""
    truth = {"armature": 0.012, "damping": 0.2, "friction": 0.25}
    theirs = mujoco.MjModel.from_xml_string(SWING.format(**truth))  # pyright: ignore[reportAttributeAccessIssue]
    state, rows = mujoco.MjData(theirs), 400  # pyright: ignore[reportAttributeAccessIssue]
    t = 0.01 * np.arange(rows)
    u, q, swing = 0.4 * np.sin(6 * t) + 0.2 * np.sign(np.sin(2.3 * t)), np.zeros(rows), np.zeros(rows)
    for k in range(rows):
        q[k], swing[k], state.ctrl[0] = state.qpos[1], state.qpos[0], u[k]
        mujoco.mj_step(theirs, state, 5)  # pyright: ignore[reportAttributeAccessIssue]
    assert np.ptp(swing) > 0.1
    (tmp_path / "leg.xml").write_text(SWING.format(**{name: 1.6 * value for name, value in truth.items()}))
    loop = dataclasses.replace(load_loop(tmp_path / "leg.xml")[0], measured=(1,))
    noisy = q + 2e-4 * np.random.default_rng(0).normal(size=rows)
    more = [(effect, "leg") for effect in ("rotor_inertia", "joint_damping", "friction_loss")]
    here = setting(loop, [Run("swing", t, u[:, None], noisy[:, None], None)], baseline=(), more=more)
    assert not any(c.effect == "encoder_offset" and c.at == ("swing",) for c in here.known.candidates)
    found = begun(here)
    for entry, error in zip(found.free[found.free >= 0], standard_errors(found, here.data), strict=False):
        value = truth[here.known.table[entry].name]
        assert abs(found.theta[entry] - value) < 4 * error < 0.1 * value
    assert 0.8 < found.squares / rows < 1.2


def test_a_limit_that_is_met_in_a_few_places_is_told_by_places():
    """Three of forty blocks gain, one of them most of all; blocks of noise alone gain nothing but by chance."""
    rng = np.random.default_rng(8)
    after = rng.chisquare(30, 40)
    before = after.copy()
    before[[3, 17, 30, 31]] += [90.0, 700.0, 20000.0, 150.0]
    assert t_of(before, after) < 1.64 < t_of_places(before, after)
    chance = [t_of_places(*(rng.chisquare(30, 40) for _ in range(2))) for _ in range(400)]
    assert np.mean(np.array(chance) > 1.64) < 0.09


def test_recordings_that_tell_alike_weigh_by_what_is_left_of_them(tmp_path: Path):
    """Three recordings whose misfits are 1, 10 and 50 mrad: each tells as much, all together as before."""
    (tmp_path / "arm.xml").write_text(servo_arm.model_text())
    loop, _ = load_loop(tmp_path / "arm.xml")
    t, u = servo_arm.command()
    u, runs = u[:1000, None], []
    read = np.asarray(rollout(loop, u, np.zeros(1)).reading)
    for k, size in enumerate((1e-3, 1e-2, 5e-2)):
        noise = np.random.default_rng(k).normal(0, 2e-4, read.shape)
        runs.append(Run(f"run {k}", t[:1000], u, read + noise + size * np.sin(9 * t[:1000, None]), None))
    here = setting(loop, runs)
    structure = Structure(loop, here.known.table, here.data)
    at = values(loop, here.known.table)[None]
    start = np.zeros((1, 2, 3))
    one = fit(*structure, at, [here.baseline], start, width=here.width, lanes=1, iterations=0)[0]
    even = evened(here, structure, one)
    other = fit(loop, here.known.table, even.data, at, [here.baseline], start, width=here.width, lanes=1, iterations=0)
    each, plain = (x.sums.cost.sum((0, 2)) for x in (other[0], one))
    np.testing.assert_allclose(each, plain.sum() / 3, rtol=1e-9)
    assert even.plain().even is None
    np.testing.assert_array_equal(even.plain().data.weight, here.data.weight)


def test_recordings_that_tell_numbers_differently_widen_their_intervals(tmp_path: Path):
    """Four recordings of arms whose friction differs by far more than noise tells: half of the interval is theirs."""
    (tmp_path / "arm.xml").write_text(servo_arm.model_text())
    loop, _ = load_loop(tmp_path / "arm.xml")
    t, u = servo_arm.command()
    u, runs, levels = u[:500, None], [], np.array([0.2, 0.25, 0.35, 0.4])
    for k, level in enumerate(levels):
        other = eqx.tree_at(lambda m: m.joints.friction, loop, np.array([level]))
        read = np.asarray(rollout(other, u, np.zeros(1)).reading)
        noisy = read + np.random.default_rng(k).normal(0, 2e-4, read.shape)
        runs.append(Run(f"run {k}", t[:500], u, noisy, None))
    here = setting(loop, runs, baseline=("friction_loss",))
    found = begun(here)
    spread = spread_of_recordings(here.known.table, found, here.folds)
    (column,) = np.flatnonzero(found.free >= 0)
    without = [(levels.sum() - one) / 3 for one in levels]  # were all recordings to tell as much
    expected = np.sqrt(3 / 4 * np.var(without) * 4) * 3.182 / 1.96
    assert found.theta[found.free[column]] == pytest.approx(levels.mean(), abs=0.02)
    assert spread[column] == pytest.approx(expected, rel=0.2)
    assert spread[column] > 100 * standard_errors(found, here.data)[column]


def test_intervals_hold_where_a_few_recordings_tell_most_of_a_number():
    """Means of six groups that differ, 5000 times: right as often as said where all tell alike, no less else."""
    rng, found = np.random.default_rng(5), []
    for share in (np.full(6, 1 / 6), np.array([5, 1, 1, 1, 1, 1]) / 10):
        own = rng.normal(size=(5000, 6))
        mean = own @ share
        away = (mean[:, None] - own) * share / (1 - share)
        error = np.sqrt(5 / 6 * ((away - away.mean(1, keepdims=True)) ** 2).sum(1))
        free = float(_freedom(share[:, None])[0])
        found.append((free, np.mean(np.abs(mean) > stats.t.ppf(0.975, free) * error)))
    (alike, missed), (few, seldom) = found
    assert alike == pytest.approx(5)
    assert 0.04 < missed < 0.06
    assert 2 <= few < 3
    assert seldom < 0.05
