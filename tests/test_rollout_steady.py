"""Whether a cause of a rollout has one size, or stands in for another: arms by MuJoCo C, least squares by NumPy."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from generators import servo_arm6

from figaroh_jax.rollouts.arm import search_arm
from figaroh_jax.rollouts.data import Run, Stretch
from figaroh_jax.rollouts.found import Search
from figaroh_jax.rollouts.reading import load_loop
from figaroh_jax.rollouts.setting import setting
from figaroh_jax.rollouts.steady import Normal

BLOCKS, WINDOWS, ROWS, OTHERS, SIZES, STATES = 6, 3, 8, 2, 2, 2


def test_what_sizes_of_their_own_explain_is_that_of_a_least_squares_fit():
    """Two sizes beside two numbers and the states at the starts, which have a prior: against a fit of all rows."""
    rng = np.random.default_rng()
    columns = OTHERS + SIZES
    J = rng.standard_normal((BLOCKS, WINDOWS, ROWS, columns + STATES))
    e = rng.standard_normal((BLOCKS, WINDOWS, ROWS))
    prior, start, known = (rng.uniform(0.5, 2, (STATES, WINDOWS)) for _ in range(3))
    theta = rng.standard_normal(columns)
    sums = SimpleNamespace(matrix=np.einsum("bwri,bwrj->bwij", J, J), gradient=np.einsum("bwri,bwr->bwi", J, e))
    fit: Any = SimpleNamespace(free=np.arange(columns), theta=theta, start=start, sums=sums)
    structure: Any = SimpleNamespace(data=SimpleNamespace(precision=prior, start=known))
    parts = rng.integers(0, 3, (BLOCKS, WINDOWS))

    def squares(kinds: np.ndarray, size: tuple[float, ...] | None = None) -> float:
        """Of the best numbers; with sizes of their own by kind, or held at these less the ones that are there."""
        many = len(np.unique(kinds)) if size is None else 0
        rows, right = [], []
        for w in range(WINDOWS):
            for b in range(BLOCKS):
                own = np.zeros((ROWS, OTHERS + SIZES * many + STATES * WINDOWS))
                own[:, :OTHERS] = J[b, w, :, :OTHERS]
                if many:
                    at = OTHERS + SIZES * int(np.searchsorted(np.unique(kinds), kinds[b, w]))
                    own[:, at : at + SIZES] = J[b, w, :, OTHERS:columns]
                at = own.shape[1] - STATES * WINDOWS + STATES * w
                own[:, at : at + STATES] = J[b, w, :, columns:]
                rows.append(own)
                right.append(e[b, w] - (0 if size is None else J[b, w, :, OTHERS:columns] @ np.array(size)))
            own = np.zeros((STATES, rows[-1].shape[1]))
            at = own.shape[1] - STATES * WINDOWS + STATES * w
            own[:, at : at + STATES] = np.diag(prior[:, w])
            rows.append(own)
            right.append(-prior[:, w] * (start - known)[:, w])
        A, y = np.concatenate(rows), np.concatenate(right)
        return float(((y - A @ np.linalg.lstsq(A, y, rcond=None)[0]) ** 2).sum())

    one = np.zeros((BLOCKS, WINDOWS), int)
    best = squares(one)
    A = [squares(one, tuple(x)) - best for x in 1e3 * np.array([[1, 0], [0, 1], [1, 1]])]  # a quadratic form
    matrix = np.array([[A[0], (A[2] - A[0] - A[1]) / 2], [(A[2] - A[0] - A[1]) / 2, A[1]]]) / 1e6
    worth = theta[OTHERS:] @ matrix @ theta[OTHERS:]
    assert Normal(structure, fit, [2, 3]).more(parts) == pytest.approx((best - squares(parts)) / worth, rel=0.02)


def arm(folder: Path, hidden: list[tuple[str, int, float]], seed: int, differ: float = 0.0) -> Search:
    """The search in four recordings of 12 s of the made arm, whose friction and damping may `differ` by a share."""
    (folder / "arm.xml").write_text(servo_arm6.model_text(1.6))
    runs = []
    for number in range(4):
        own = np.random.default_rng([seed, number, 31])
        with pytest.MonkeyPatch.context() as patch:
            for name in ("FRICTION", "DAMPING"):
                other = np.array(getattr(servo_arm6, name)) * (1 + differ * own.standard_normal(6))
                patch.setattr(servo_arm6, name, tuple(other))
            r = servo_arm6.record(hidden, seed, number)
        runs.append(Run(f"run {number}", r["t"], r["u"], r["q"], None))
    cut = [Stretch(k, first, 600) for k in range(4) for first in (0, 600)]
    return search_arm(setting(load_loop(folder / "arm.xml")[0], runs, stretches=cut))


@pytest.mark.slow
def test_a_notch_is_no_ripple(tmp_path: Path):
    """A ball that drops into a notch: a ripple takes two thirds of the squares, in every recording."""
    found = arm(tmp_path, [("detent", 1, 0.25)], int(np.random.default_rng().integers(1, 10**6)))
    assert (found.verdict, found.named) == ("unknown", [])
    assert any("its size differs by the " in why for _, _, why in found.doubtful), found.doubtful


@pytest.mark.slow
@pytest.mark.parametrize(("effect", "joint"), [("command_delay", 0), ("load_dependent_friction", 2)])
def test_a_cause_keeps_its_name_beside_a_notch_at_another_joint(tmp_path: Path, effect: str, joint: int):
    seed = int(np.random.default_rng().integers(1, 10**6))
    found = arm(tmp_path, [(effect, joint, servo_arm6.EFFECTS[effect][1]), ("detent", 4, 0.25)], seed)
    assert found.verdict == "named+rest"
    (named,) = found.named
    assert (named.candidate.effect, named.candidate.at) == (effect, (servo_arm6.NAMES[joint],))


@pytest.mark.slow
def test_a_spring_is_named_at_its_own_joint_beside_a_rest(tmp_path: Path):
    """One at the next joint takes nine tenths of the squares too: the elbow's was told at the lift (1020182)."""
    seed = int(np.random.default_rng().integers(1, 10**6))
    found = arm(tmp_path, [("joint_elasticity", 2, 150.0)], seed, differ=0.05)
    assert {n.candidate.at for n in found.named} <= {("elbow",)}, seed
    assert "joint_elasticity" in {n.candidate.effect for n in found.named or found.proxy}, seed
