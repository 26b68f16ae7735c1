"""The example with an effect of the user's own: short, and found by the diagnosis like one of the catalogue."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

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
