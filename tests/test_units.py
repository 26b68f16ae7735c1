"""What differs between robots and between days, against known spreads; the table of `figaroh-jax compare`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from figaroh_jax.errors import InputError
from figaroh_jax.estimation.units import spreads
from figaroh_jax.reporting.side_by_side import compare_runs, comparison_text

PARAMETERS, UNITS, DAYS = 60, 20, 2
DIFFERENT = (7, 23, 41)  # between units


def study(seed: int, daily: tuple[int, ...] = (), understated: float = 1.0) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Estimates of 20 units on two days each; three parameters differ between units by three times their std."""
    rng = np.random.default_rng(seed)
    truth, size = rng.normal(0, 5, PARAMETERS), rng.uniform(0.05, 0.5, PARAMETERS)
    own = np.zeros((UNITS, PARAMETERS))
    own[:, DIFFERENT] = 3.0 * size[list(DIFFERENT)] * rng.normal(size=(UNITS, len(DIFFERENT)))
    std = size * rng.uniform(0.7, 1.4, (UNITS * DAYS, PARAMETERS))
    values = truth + np.repeat(own, DAYS, axis=0) + std * rng.normal(size=std.shape)
    for k in daily:
        values[:, k] += 3 * size[k] * rng.normal(size=len(values))
    return values, understated * std, [f"unit {i}" for i in range(UNITS) for _ in range(DAYS)]


@pytest.mark.parametrize("understated", [1.0, 0.5])
def test_three_parameters_of_sixty_differ_between_twenty_robots(understated: float) -> None:
    """All three in 20 studies but for one in sixty at most; a false one in one study of twenty (3 by chance)."""
    missed = false = 0
    for seed in range(20):
        values, std, labels = study(seed, understated=understated)
        found = spreads([str(k) for k in range(PARAMETERS)], values, std, labels)
        told = {int(s.name) for s in found if s.differs()}
        missed += len(set(DIFFERENT) - told)
        false += bool(told - set(DIFFERENT))
    assert missed <= 1
    assert false <= 3  # 1 of 20 expected at most; 3 are exceeded once in sixty times


def test_a_spread_between_days_is_none_between_robots() -> None:
    values, std, labels = study(1, daily=(3, 50))
    found = spreads([str(k) for k in range(PARAMETERS)], values, std, labels)
    assert {s.name: s.differs() for s in found if s.differs()} == {
        **{str(k): "units" for k in DIFFERENT},
        "3": "days",
        "50": "days",
    }


def test_spreads_means_and_shrunk_values() -> None:
    """Spreads of 200 robots on three days; a shrunk value is nearer to the truth than the robot's own estimate."""
    rng = np.random.default_rng(4)
    unit, day, noise = 0.8, 0.3, 0.2
    truth = 2.0 + unit * rng.normal(size=200)
    values = np.repeat(truth, 3) + rng.normal(0, np.hypot(day, noise), 600)
    labels = [str(i) for i in range(200) for _ in range(3)]
    (one,) = spreads(["a"], values[:, None], np.full((600, 1), noise), labels)
    np.testing.assert_allclose([one.mean, one.units, one.days], [2.0, unit, day], rtol=0.12)
    assert abs(one.mean - 2.0) < 3 * one.std
    own = values.reshape(-1, 3).mean(1)
    shrunk = np.array([one.shrunk[str(i)] for i in range(200)])
    assert np.std(shrunk - truth) < np.std(own - truth)
    assert one.widened == 1.0


def test_wrong_input_is_refused() -> None:
    two = np.ones((2, 1))
    with pytest.raises(InputError, match="two runs or more of 1 parameters"):
        spreads(["a"], two[:1], two[:1])
    with pytest.raises(InputError, match="1 labels"):
        spreads(["a"], two, two, ["x"])
    with pytest.raises(InputError, match="parameter 'a' has a std of zero"):
        spreads(["a"], two, 0 * two)


def run(folder: Path, name: str, values: dict[str, float]) -> Path:
    rows = [{"expression": k, "value": v, "std": 0.1, "status": "identified"} for k, v in values.items()]
    damping = {"value": values["fv1"], "std": 0.1, "unit": "N m s/rad"}
    effect = {"effect": "viscous_friction", "at": ["waist"], "parameters": {"damping": damping}}
    fit = {"rms": [1.0], "relative": [0.1], "r2": [0.9]}
    content = {
        "rank": 2,
        "condition": 3.0,
        "base_parameters": rows,
        "links": [],
        "effects": [effect],
        "fit": fit,
        "holdout": {},
    }
    (folder / name).mkdir()
    (folder / name / "result.json").write_text(json.dumps(content))
    return folder / name


def test_compare_tells_what_differs_between_robots_and_days(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    runs = [
        run(
            tmp_path, f"r{k}", {"Izz1": 1 + 0.1 * rng.normal(), "m2": 5 + 3 * (k // 2) + 0.1 * rng.normal(), "fv1": 1.0}
        )
        for k in range(6)
    ]
    sections = compare_runs(runs, ["a", "a", "b", "b", "c", "c"])
    table = next(section for section in sections if section.title.startswith("Spread between robots"))
    assert {row[0]: row[-1] for row in table.rows} == {
        "viscous_friction (waist) damping": "-",  # fv1 is the same number
        "Izz1": "-",
        "m2": "units",
    }
    assert "between days" in comparison_text(sections)
    assert not any("Spread" in section.title for section in compare_runs(runs[:2]))
    with pytest.raises(InputError, match="at least three runs"):
        compare_runs(runs[:2], ["a", "b"])
    with pytest.raises(InputError, match="--units: 2 labels for 6 runs"):
        compare_runs(runs, ["a", "b"])
