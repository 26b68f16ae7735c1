"""Many robots screened together: torques by Pinocchio, causes by formulas that are written here."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import robots

import figaroh_jax as fj
from figaroh_jax.diagnosis.fleet import CauseInFleet, FleetScreen
from figaroh_jax.errors import InputError

DT, ROBOTS, SAMPLES = 0.01, 12, 600
CAUSES = ("load_dependent_friction", "stribeck_friction", "asymmetric_viscous_friction", "encoder_offset")
ARM = robots.robot(
    *robots.LINKS[:4],
    robots.joint("one", "base", "a", axis="0 0 1", more=robots.LIMIT),
    robots.joint("two", "a", "b", axis="0 1 0", more=robots.LIMIT),
    robots.joint("three", "b", "c", axis="0 1 0", more=robots.LIMIT),
)


Screens = tuple[FleetScreen, FleetScreen]


@pytest.fixture(scope="module")
def screens(tmp_path_factory: pytest.TempPathFactory) -> Screens:
    """Of one recording each, before and after what all lack is in the baseline.

    Robot 3 rubs with its load at joint 2, robot 6 sticks at joint 1, the encoder of robot 9 is off at joint 2.
    """
    folder, random = tmp_path_factory.mktemp("arm"), np.random.default_rng(3)
    model = robots.load(ARM, folder)
    twin = pin.buildModelFromXML(ARM)
    t = np.arange(SAMPLES)[:, None] * DT
    rate, size, phase = random.uniform((0.5, 0.3, 0.0), (3.0, 0.8, 6.0), (ROBOTS, 4, 1, 3, 3)).transpose(4, 0, 1, 2, 3)
    angle = rate * t + phase
    q, v, a = (x.sum(1) for x in (size * np.sin(angle), size * rate * np.cos(angle), -size * rate**2 * np.sin(angle)))
    true = q.copy()
    true[9, :, 1] -= 0.03  # rad; the sensor reads .03 more
    data = twin.createData()
    load = np.array(
        [[pin.rnea(twin, data, *state) for state in zip(*own, strict=True)] for own in zip(true, v, a, strict=True)]
    )
    forward = 0.3 + 0.05 * random.standard_normal((ROBOTS, 1, 3))
    tau = load + 2.0 * v + 0.5 * np.sign(v) + forward * np.abs(v) + 0.02 * random.standard_normal(v.shape)
    tau[3, :, 1] += 0.15 * np.abs(load[3, :, 1]) * np.sign(v[3, :, 1])
    tau[6, :, 0] += 0.6 * np.exp(-((v[6, :, 0] / 0.15) ** 2)) * np.sign(v[6, :, 0])
    terms = fj.columns.friction_terms(model, fj.Baseline(rotor=True, offset=True))
    more = (*terms, fj.CATALOGUE["asymmetric_viscous_friction"](np.arange(3)[:, None], difference=np.zeros(3)))  # pyright: ignore[reportCallIssue]
    before, after = (fj.screen_fleet([model] * ROBOTS, x, q, v, a, tau, DT, CAUSES) for x in (terms, more))
    return before, after


def of(screened: FleetScreen, effect: str, joint: str) -> CauseInFleet:
    return next(c for c in screened.causes if c.name.effect == effect and c.name.at == (joint,))


def test_robots_that_differ_are_flagged_with_what_they_have(screens: Screens):
    screened = screens[1]
    flagged = screened.flagged()
    assert {flag.robot: (flag.cause.effect, flag.cause.at) for flag in flagged} == {
        3: ("load_dependent_friction", ("two",)),
        6: ("stribeck_friction", ("one",)),
        9: ("encoder_offset", ("two",)),
    }
    assert screened.unusual().any(axis=1).nonzero()[0].tolist() == [3, 6, 9]
    assert [flag.beyond for flag in flagged] == sorted((flag.beyond for flag in flagged), reverse=True)
    np.testing.assert_allclose(of(screened, "load_dependent_friction", "two").values[3, 0], 0.15, rtol=0.05)
    offset = of(screened, "encoder_offset", "two")
    np.testing.assert_allclose(offset.values[9, 0], 0.03, rtol=0, atol=3 * offset.std[9, 0])


def test_what_all_robots_have_is_the_populations(screens: Screens):
    screened = screens[0]
    common = screened.common()
    assert not screens[1].common()
    assert {cause.name.effect for cause in common[:3]} == {"asymmetric_viscous_friction"}
    own = of(screened, "asymmetric_viscous_friction", "three")
    np.testing.assert_allclose(own.mean, 0.3, atol=0.05)  # of twelve that are spread by .05
    np.testing.assert_allclose(own.spread, 0.05, rtol=0.5)
    assert not (own.beyond() > 5.0).any()


def test_wrong_requests_are_told():
    robot = fj.load_urdf(fj.DEMO)
    state = np.zeros((1, 20, robot.nv))
    with pytest.raises(InputError, match="no effect 'stribek_friction' in the catalogue.*stribeck_friction"):
        fj.screen_fleet([robot], (), state, state, state, state, 0.01, ["stribek_friction"])
    with pytest.raises(InputError, match="dt is 0.0"):
        fj.screen_fleet([robot], (), state, state, state, state, 0.0)


def test_jobs_run_on_a_scheduler_of_dask():
    """The example's pool of workers, by Dask's own scheduler on this machine."""
    distributed = pytest.importorskip("distributed")
    example = runpy.run_path(str(Path(__file__).parents[1] / "examples" / "fleet.py"))
    cluster = distributed.LocalCluster(n_workers=1, processes=False, dashboard_address=None)
    with cluster:
        found = list(example["everywhere"](str.upper, ["a", "b"], cluster.scheduler_address))
    assert found == ["A", "B"]
