"""Importing the package is silent, cheap and changes nothing; measured in processes of their own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

import figaroh_jax as fj

HEAVY = ("jax", "pinocchio", "mujoco", "plotly", "pandas", "yourdfpy", "trimesh", "matplotlib", "pyarrow", "scipy")


def _in_new_process(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)


def test_import_is_silent_and_loads_nothing_heavy():
    run = _in_new_process(f"import sys, figaroh_jax; assert not [name for name in {HEAVY} if name in sys.modules]")
    assert run.stdout == run.stderr == ""


def test_dynamics_load_no_file_format_backend_or_plot():
    heavy = ("pinocchio", "mujoco", "plotly", "pandas", "yourdfpy", "trimesh", "matplotlib", "pyarrow", "pydantic")
    code = "import figaroh_jax as fj, sys; fj.RobotModel, fj.inverse_dynamics, fj.joint_torque_regressor, fj.register"
    run = _in_new_process(f"{code}; assert not [name for name in {heavy} if name in sys.modules], sys.modules.keys()")
    assert run.stdout == run.stderr == ""


def test_the_jobs_load_no_distributions():
    """scipy.stats costs .7 s of every run; its special functions cost nothing more than scipy does."""
    jobs = "diagnosis", "identification", "postures", "rollouts", "excitation"
    code = (
        f"import sys\nfor job in {jobs}: __import__('figaroh_jax.jobs.' + job)\nassert 'scipy.stats' not in sys.modules"
    )
    assert _in_new_process(code).stderr == ""


def test_reading_a_urdf_loads_no_mesh_library(tmp_path: Path):
    box = "<link name='a'><visual><geometry><box size='1 2 3'/></geometry></visual></link>"
    joint = "<link name='b'/><joint name='j' type='continuous'><parent link='a'/><child link='b'/></joint>"
    (tmp_path / "box.urdf").write_text(f"<robot name='r'>{box}{joint}</robot>")
    code = (
        "import sys, figaroh_jax as fj\n"
        "fj.load_urdf('box.urdf')\n"
        "assert not {'trimesh', 'yourdfpy'} & set(sys.modules)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr


def test_use_leaves_the_configuration_of_jax_as_it_was():
    run = _in_new_process(
        "import json, os, jax\n"
        "def state(): return dict(jax.config.values), dict(os.environ)\n"
        "before = state()\n"
        "import figaroh_jax as fj\n"
        "for name in fj.__all__: getattr(fj, name)\n"
        "after = state()\n"
        "print(json.dumps([repr(k) for b, a in zip(before, after) for k in a if a[k] != b.get(k)]))\n"
    )
    assert json.loads(run.stdout) == []
    assert run.stderr == ""


@pytest.mark.parametrize("name", fj.__all__)
def test_every_public_name_is_there_and_documented(name: str):
    assert getattr(fj, name).__doc__


def test_unknown_name_is_refused():
    with pytest.raises(AttributeError, match="'figaroh_jax' has no attribute 'nothing'") as told:
        _ = fj.nothing
    found = told.value  # Python shows the nearest name of its object
    assert found.name == "nothing" and "inverse_dynamics" in dir(found.obj)
