"""Programs kept on disk: another process reads them, gives the same numbers, and makes anew what it cannot read."""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pytest

from figaroh_jax.compiled import store as stores
from figaroh_jax.compiled.executable_cache import Program
from figaroh_jax.compiled.store import Store

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
few = fj.forward_dynamics(model, q[:100], v[:100], a[:100])  # by LAPACK, which a process that traces nothing must find
print(json.dumps([
    np.concatenate([np.asarray(fj.inverse_dynamics(model, q, v, a)), np.asarray(few)]).tolist(),
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
    assert len(files) > 1
    for k, file in enumerate(files):  # cut, and what unpickling it would do
        file.write_bytes(pickle.dumps(_Planted(tmp_path / "ran")) if k % 2 else file.read_bytes()[:100])
    third = _run(tmp_path)
    assert third[2] > 0
    assert not (tmp_path / "ran").exists()
    assert sorted((tmp_path / "cache" / "programs").iterdir()) == files
    assert min(len(file.read_bytes()) for file in files) > 1000
    for other in (second, third):
        np.testing.assert_array_equal(other[0], first[0])
        np.testing.assert_array_equal(other[1], first[1])


class _Planted:
    """Unpickled, it makes a file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self):
        return os.mkdir, (str(self.file),)


COMMAND = """
import os, sys, jax, numpy as np
from figaroh_jax import cli
cli._set_up_jax(cache=True)
from figaroh_jax.compiled.batching import _room
jax.jit(lambda x: 2 * x + 1)(np.arange(3.0)).block_until_ready()
"""


def _command(home: Path, **environment: str) -> str:
    env = {**os.environ, "XDG_CACHE_HOME": str(home), **environment}
    env.pop("JAX_COMPILATION_CACHE_DIR", None)
    run = subprocess.run([sys.executable, "-W", "always", "-c", COMMAND], env=env, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return run.stdout + run.stderr


def test_what_jax_keeps_is_read_only_where_this_user_wrote_it_and_trouble_is_silent(tmp_path: Path):
    home = tmp_path / "home"
    assert _command(home) == ""
    folder = home / "figaroh_jax" / "jax" / "programs"
    entries = list(folder.iterdir())
    assert entries and all(path.stat().st_mode & 0o777 == 0o600 for path in entries)
    assert [path.stat().st_mode & 0o777 for path in (folder, home / "figaroh_jax")] == [0o700] * 2
    for path in entries:
        path.write_bytes(b"damaged")
    assert _command(home) == ""
    assert {path.read_bytes() for path in entries} != {b"damaged"}
    for path in entries:  # reading a pipe would wait for ever
        path.unlink()
        os.mkfifo(path)
    assert _command(home) == ""
    (tmp_path / "file").write_text("")
    assert _command(tmp_path / "file") == ""  # no folder can be made below it


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    stores._key_in.cache_clear()
    return tmp_path / "home" / "figaroh_jax"


SPOIL: dict[str, Callable[[Path], object]] = {
    "content": lambda entry: entry.write_bytes(entry.read_bytes()[:-1] + b"!"),
    "cut": lambda entry: os.truncate(entry, 20),
    "empty": lambda entry: os.truncate(entry, 0),
    "huge": lambda entry: os.truncate(entry, 1 << 40),
    "another's name": lambda entry: entry.with_name("other").replace(entry),
    "link": lambda entry: (entry.rename(entry.with_name("real")), entry.symlink_to("real")),
    "pipe": lambda entry: (entry.unlink(), os.mkfifo(entry)),
    "folder": lambda entry: (entry.unlink(), entry.mkdir()),
    "gone": lambda entry: entry.unlink(),
    "open to others": lambda entry: entry.parent.chmod(0o777),
    "folder is a link": lambda entry: (
        entry.parent.rename(entry.parent.with_name("real")),
        entry.parent.symlink_to("real"),
    ),
}


@pytest.mark.parametrize("kind", SPOIL)
def test_a_store_gives_nothing_that_it_did_not_write(home: Path, tmp_path: Path, kind: str):
    store = Store(tmp_path / "folder" / "programs")
    store.put("one", b"first")
    store.put("other", b"second")
    assert (store.get("one"), store.get("other"), store.get("none")) == (b"first", b"second", None)
    SPOIL[kind](tmp_path / "folder" / "programs" / "one")
    assert store.get("one") is None
    store.put("one", b"again")
    assert store.get("one") == (None if kind in ("folder", "folder is a link") else b"again")


def test_an_entry_of_another_user_is_absent(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Another key (another user's), another owner of the folder."""
    store = Store(tmp_path / "programs")
    store.put("one", b"first")
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    assert store.get("one") is None
    store.put("one", b"second")
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert store.get("one") == b"first"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "another home"))
    assert store.get("one") is None


@pytest.mark.parametrize("spoil", [lambda key: key.write_bytes(b"short"), lambda key: key.chmod(0o644)])
def test_a_key_that_others_could_know_is_replaced(home: Path, tmp_path: Path, spoil: Callable[[Path], object]):
    store = Store(tmp_path / "programs")
    store.put("one", b"first")
    key = home / "key"
    before = key.read_bytes()
    assert key.stat().st_mode & 0o777 == 0o600
    spoil(key)
    stores._key_in.cache_clear()
    assert store.get("one") is None
    assert key.read_bytes() != before and len(key.read_bytes()) == 32 and key.stat().st_mode & 0o777 == 0o600
    assert [path.name for path in home.iterdir()] == ["key"]


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
