"""Programs kept on disk: another process reads them, gives the same numbers, and makes anew what it cannot read."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np

from figaroh_jax.compiled.executable_cache import Program

ARM = """<robot name='arm'><link name='base'/>
<link name='upper'><inertial><origin xyz='.1 0 .2'/><mass value='2'/>
<inertia ixx='.1' iyy='.2' izz='.3' ixy='0' ixz='0' iyz='0'/></inertial></link>
<joint name='shoulder' type='continuous'><parent link='base'/><child link='upper'/><axis xyz='0 1 0'/></joint>
</robot>"""
RUN = """
import json, sys
import jax
import numpy as np
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", "cache")
traced = []
jax.monitoring.register_event_duration_secs_listener(lambda name, *_, **__: traced.append(name))
import figaroh_jax as fj
model = fj.load_urdf("arm.urdf")
q, v, a = np.random.default_rng(0).standard_normal((3, 2000, 1))
print(json.dumps([
    np.asarray(fj.inverse_dynamics(model, q, v, a)).tolist(),
    np.asarray(fj.joint_torque_regressor(model, q, v, a)).tolist(),
    sum("jaxpr_trace" in name for name in traced),
]))
"""


def _run(folder: Path) -> tuple[np.ndarray, np.ndarray, int]:
    run = subprocess.run([sys.executable, "-c", RUN], cwd=folder, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    torque, regressor, traces = json.loads(run.stdout)
    return np.array(torque), np.array(regressor), traces


def test_another_process_traces_nothing_and_a_damaged_file_is_made_anew(tmp_path: Path):
    (tmp_path / "arm.urdf").write_text(ARM)
    first = _run(tmp_path)
    files = sorted((tmp_path / "cache" / "programs").iterdir())
    second = _run(tmp_path)
    assert first[2] > 0 == second[2]
    for file in files:
        file.write_bytes(file.read_bytes()[:100])
    third = _run(tmp_path)
    assert third[2] > 0
    assert sorted((tmp_path / "cache" / "programs").iterdir()) == files
    assert min(len(file.read_bytes()) for file in files) > 1000
    for other in (second, third):
        np.testing.assert_array_equal(other[0], first[0])
        np.testing.assert_array_equal(other[1], first[1])


def test_what_is_not_of_the_package_is_never_kept(tmp_path: Path):
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    try:
        twice = Program(lambda x: {"twice": 2 * x["one"]})
        assert twice({"one": np.arange(3.0)})["twice"].tolist() == [0.0, 2.0, 4.0]
        assert twice({"one": np.arange(4.0)})["twice"].tolist() == [0.0, 2.0, 4.0, 6.0]
    finally:
        jax.config.update("jax_compilation_cache_dir", before)
    assert not (tmp_path / "programs").exists()
