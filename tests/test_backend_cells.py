"""Each cell of the table of `benchmarks/backends.py` is called: six backends on five robots, against Pinocchio."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))
import backends as table

PRECISION = {"newton": 1e-5}  # of the largest number of an answer; the others compute in float64


@pytest.mark.slow
@pytest.mark.parametrize("robot", table.ROBOTS)
@pytest.mark.parametrize("name", ["native", "mujoco", "mjx", "pinocchio", "newton", "genesis"])
def test_a_cell(name: str, robot: str, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if name in ("newton", "genesis"):
        pytest.importorskip(name, reason=f"{name} is not installed (the extra `{name}`)")
    monkeypatch.setattr(table, "DATA", data_dir)
    cell = table._cell(robot, name, 4, 1)
    if "error" in cell:
        pytest.skip(f"{name} on {robot}: {cell['error']}")
    assert cell["differs"] < PRECISION.get(name, 1e-9)
    assert all(cell[function][1] > 0 for function in table.FUNCTIONS)
