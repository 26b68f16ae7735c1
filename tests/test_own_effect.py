"""An effect of the user's own: the example is short, and found by the diagnosis like one of the catalogue."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import robots

from figaroh_jax.effects.base import JointEffect, Scalar, amplitude
from figaroh_jax.effects.catalogue import register
from figaroh_jax.effects.kinematic import CATALOGUE, Postures, axis_twist, columns_of

ROOT = Path(__file__).resolve().parents[1]
EXAMPLE = ROOT / "examples" / "own_effect.py"


def test_an_effect_of_ones_own_takes_30_lines_at_most():
    tree = ast.parse(EXAMPLE.read_text())
    (effect,) = (node for node in tree.body if isinstance(node, ast.ClassDef))
    assert effect.end_lineno is not None
    assert effect.end_lineno - effect.lineno + 1 + len(effect.decorator_list) <= 30


def test_the_effect_of_ones_own_is_found_and_nothing_else():
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    run = subprocess.run(
        [sys.executable, str(EXAMPLE)], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    verdict, *causes = run.stdout.splitlines()
    assert verdict == "verdict: named"
    assert len(causes) == 1
    words = causes[0].replace(",", "").split()
    assert words[:2] == ["detent", "(elbow):"]
    assert abs(float(words[words.index("strength") + 1]) - 1.5) < 0.03
    assert abs(float(words[words.index("notch") + 1]) - 0.37) < 0.005


def test_an_effect_of_ones_own_that_errs_in_position_is_one_of_postures(tmp_path: Path):
    class Wear(JointEffect):
        """A gear that has worn where it is used most."""

        name, title, equation = "wear", "wear of the gear", "q_measured = q + depth exp(-q^2)"
        depth: Scalar = amplitude("rad")

        def position_error(self, motion: Any) -> Any:
            return self.depth * np.exp(-(self.here(motion.angle) ** 2))

    model, q = robots.load(robots.ARM, tmp_path), np.random.default_rng(0).uniform(-1.0, 1.0, (5, 2))
    none = np.zeros((5, 2))
    postures = Postures(q, q, none, np.zeros((5, 2, 3)), none, np.arange(5.0), 4.0)
    register(Wear)
    (column,) = columns_of(CATALOGUE["wear"], model, (1,))
    ((joint, field),) = column.pieces
    assert (joint, column.parameter, column.unit) == (1, "depth", "m")  # the joint slides
    # the joint stands behind its reading by the error
    turn = axis_twist(model, 1)[:, None] * -np.exp(-(q[:, 1] ** 2))
    np.testing.assert_allclose(field(postures), turn, rtol=0, atol=1e-15)
