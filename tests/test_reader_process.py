"""Readers in C and C++ run in a process of their own: what ends, stops or bloats them is one message."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from figaroh_jax.errors import InputError
from figaroh_jax.recordings import reader_process
from figaroh_jax.recordings.reading import read_table

LIBRARIES = {  # of a library in the place of h5py, which breaks where it is used
    "crash": "import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)",
    "abort": "import os\nos.abort()",
    "wait": "import time\ntime.sleep(60)",
    "bloat": "import mmap\nx = [mmap.mmap(-1, 1 << 30) for _ in range(100)]",
    "print": "import os\nfor k in (1, 2): os.write(k, b'{}\\nnoise\\n' * 1000)\nraise RuntimeError('cannot')",
}
SAID = {
    "crash": r"crashed \(SIGSEGV\); write the file again",
    "abort": r"crashed \(SIGABRT\)",
    "wait": "was not done after 3 s",
    "bloat": "Cannot allocate memory",
    "print": "is damaged or of another format: cannot",
}


@pytest.fixture
def fresh():
    """No process is there before, none stays."""
    reader_process._end()
    yield
    reader_process._end()


@pytest.mark.parametrize("kind", LIBRARIES)
def test_a_reader_that_breaks_is_one_message_and_the_next_file_is_read(tmp_path: Path, monkeypatch, fresh, kind: str):
    (tmp_path / "h5py").mkdir()
    (tmp_path / "h5py" / "__init__.py").write_text(LIBRARIES[kind])
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(reader_process, "SECONDS", 3.0 if kind == "wait" else 60.0)
    (tmp_path / "run.h5").write_bytes(b"1")
    with pytest.raises(InputError, match=SAID[kind]) as caught:
        read_table(tmp_path / "run.h5", "data[0].file")
    assert "run.h5" in str(caught.value)
    monkeypatch.setattr(reader_process, "SECONDS", 60.0)
    savemat(tmp_path / "run.mat", {"q": np.eye(4)})
    np.testing.assert_array_equal(read_table(tmp_path / "run.mat", "data[1].file").read("q"), np.eye(4))


def test_tables_in_turn_large_arrays_and_a_killed_process(tmp_path: Path, fresh):
    first, second = np.random.default_rng(0).normal(size=(2, 300_000, 2))
    pd.DataFrame(first, columns=["a", "b"]).to_parquet(tmp_path / "run.parquet")
    savemat(tmp_path / "run.mat", {"q": second})
    parquet, mat = (read_table(tmp_path / f"run.{form}", "data") for form in ("parquet", "mat"))
    for _ in range(2):
        np.testing.assert_array_equal(parquet.read("b"), first[:, 1])
        np.testing.assert_array_equal(mat.read("q"), second)
    assert reader_process._reader is not None
    reader_process._reader.process.kill()
    with pytest.raises(InputError, match="SIGKILL"):
        parquet.read("a")
    np.testing.assert_array_equal(parquet.read("a"), first[:, 0])


def test_relative_names_are_those_of_the_folder_at_that_time(tmp_path: Path, monkeypatch, fresh):
    for number, folder in enumerate(("a", "b")):
        (tmp_path / folder).mkdir()
        savemat(tmp_path / folder / "run.mat", {"q": np.full(3, float(number))})
        monkeypatch.chdir(tmp_path / folder)
        np.testing.assert_array_equal(read_table(Path("run.mat"), "data").read("q"), np.full(3, float(number)))


def test_a_forked_process_has_a_reader_of_its_own(tmp_path: Path, fresh):
    savemat(tmp_path / "run.mat", {"q": np.arange(3.0)})
    table = read_table(tmp_path / "run.mat", "data")
    assert reader_process._reader is not None
    before = reader_process._reader.process
    reader_process._reader.owner = -1  # as after a fork: another process's pipes
    np.testing.assert_array_equal(table.read("q"), np.arange(3.0))
    assert reader_process._reader.process.pid != before.pid
    os.waitpid(before.pid, 0)  # it has seen its pipe close


def test_without_an_interpreter_files_are_read_in_place(tmp_path: Path, monkeypatch, fresh):
    """Inside another program, `sys.executable` is that program."""
    monkeypatch.setattr("sys.executable", "/opt/simulator/kit")
    savemat(tmp_path / "run.mat", {"q": np.arange(3.0)})
    np.testing.assert_array_equal(read_table(tmp_path / "run.mat", "data").read("q"), np.arange(3.0))
    assert reader_process._reader is None
