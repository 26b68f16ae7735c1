"""A joint that ripples in two waves, as gears of two stages do, is told with both; what only looks so is not."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import pytest
import yaml
from generators import available, laws, make_case
from generators.case import Case
from generators.scene import Scene

import figaroh_jax as fj
from figaroh_jax.effects.catalogue import find, one_more
from figaroh_jax.formats import config
from figaroh_jax.reporting.wording import sentence
from figaroh_jax.results import Cause, Diagnosis

DRAWN = int.from_bytes(os.urandom(4), "little")


def slow_real(*values: str) -> Any:
    """Of a robot whose model need not be here."""
    lacks = pytest.mark.skipif(
        not available(values[0]), reason=f"{values[0]} is not on this machine (FIGAROH_JAX_DATA)"
    )
    return pytest.param(*values, marks=[pytest.mark.slow, lacks])


def diagnosed(case: Case, folder: Any) -> Diagnosis:
    from figaroh_jax.diagnosis.diagnosis import diagnose_task

    return diagnose_task(config.load_task(case.write(folder)))


def waves(causes: tuple[Cause, ...]) -> np.ndarray:
    """Order and amplitude of each cause, the slowest wave first."""
    each = [{name: one.value for name, one in cause.parameters.items()} for cause in causes]
    return np.array(sorted((p["order"], np.hypot(p["sine"], p["cosine"])) for p in each))


def rippling(seed: int, robot: str, joint: str) -> Case:
    """Two waves of 5 % each at a joint, of orders that lie 4/rad apart or more."""
    twice = [("torque_ripple", 0.05, (joint,))] * 2
    while True:
        case = make_case(twice, robot, seed=seed, holdout=True)
        one, other = (truth.parameters["order"] for truth in case.truth)
        if abs(one - other) > 4:
            return case
        seed += 1


@pytest.mark.parametrize(
    ("robot", "joint"),
    [
        ("small", "lift"),
        slow_real("tx40", "joint_4"),
        slow_real("tx40", "joint_6"),
        slow_real("panda", "panda_joint2"),
        slow_real("panda", "panda_joint6"),
    ],
)
def test_both_waves_of_a_joint_are_named_at_their_size(robot: str, joint: str, tmp_path: Any) -> None:
    seed = DRAWN
    case = rippling(seed, robot, joint)
    found = diagnosed(case, tmp_path / "case")
    assert found.verdict == "named", seed
    assert [tuple(cause.name) for cause in found.causes] == [("torque_ripple", (joint,))] * 2, seed
    assert f"is missing torque ripple at {joint} (twice): its error" in sentence(found, robot)
    truth = sorted((t.parameters["order"], np.hypot(t.parameters["sine"], t.parameters["cosine"])) for t in case.truth)
    np.testing.assert_allclose(waves(found.causes)[:, 0], np.array(truth)[:, 0], rtol=0.01)
    np.testing.assert_allclose(waves(found.causes)[:, 1], np.array(truth)[:, 1], rtol=0.1)
    # the model that is written has both, each with its own deviations, and is read back as it was
    fj.write_model(found.model, tmp_path / "model", found.causes)
    told = [
        e for e in yaml.safe_load((tmp_path / "model/effects.yaml").read_text())["effects"] if "ripple" in e["effect"]
    ]
    stds = sorted(round(e["parameters"]["order"]["std"], 12) for e in told)
    assert [e["effect"] for e in told] == ["torque_ripple"] * 2
    assert stds == sorted(round(c.parameters["order"].std, 12) for c in found.causes)
    again = [e for e in fj.load_model(tmp_path / "model").effects if e.name == "torque_ripple"]
    assert sorted(float(e.order) for e in again) == pytest.approx(list(waves(found.causes)[:, 0]), rel=1e-9)


def by_position(draw: laws.Draw) -> laws.Hidden:
    """A wave that grows with the position: three waves, none of which is there by itself."""
    j, order = draw.joint(turning=True), float(draw.rng.uniform(8, 22))
    centre = float(draw.motions[0].centre[j])

    def law(s: Scene) -> np.ndarray:
        return np.sin(order * s.q[:, j]) * (1 + 0.8 * np.sin(s.q[:, j] - centre))

    return laws.at_joint(draw, j, "by_position", law, lambda k: {"size": k})


def two_notches(draw: laws.Draw) -> laws.Hidden:
    """A dent and a bump at two places of the joint."""
    j = draw.joint(turning=True)
    centre = float(draw.motions[0].centre[j])

    def law(s: Scene) -> np.ndarray:
        at = s.q[:, j] - centre
        return np.exp(-0.5 * ((at - 0.3) / 0.08) ** 2) - np.exp(-0.5 * ((at + 0.2) / 0.1) ** 2)

    return laws.at_joint(draw, j, "two_notches", law, lambda k: {"size": k})


@pytest.mark.parametrize("shape", [by_position, two_notches])
@pytest.mark.parametrize(("robot", "joint"), [slow_real("tx40", "joint_6"), slow_real("panda", "panda_joint4")])
def test_what_two_waves_may_stand_for_has_no_name(
    shape: Any, robot: str, joint: str, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(laws.FAMILIES, shape.__name__, shape)
    case = make_case([(shape.__name__, 0.1, (joint,))], robot, seed=DRAWN, holdout=True)
    found = diagnosed(case, tmp_path)
    assert found.verdict == "unknown" and not found.causes, DRAWN


def test_orders_closer_than_half_a_beat_are_one_wave() -> None:
    """cos(w q) + cos((w + d) q) = 2 cos(d q/2) cos((w + d/2) q): over d q < pi the first factor keeps its sign."""
    second, first = one_more("torque_ripple"), find("torque_ripple")
    assert second is not None and one_more("joint_spring") is None
    low, high = np.zeros(1), np.full(1, 2.0)
    at = np.array([0])
    there = first(at, sine=1.0, cosine=0.0, order=9.0)  # pyright: ignore[reportCallIssue]
    for order, told in ((9.3, False), (7.6, False), (7.4, True), (10.6, True)):
        more = second(at, sine=1.0, cosine=0.0, order=order)  # pyright: ignore[reportCallIssue]
        assert more.apart_from(there, low, high) is told, order
