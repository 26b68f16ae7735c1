"""The numerical policy of the tests, and where the recordings are that the repository does not hold."""

from __future__ import annotations

import os
from pathlib import Path

import jax
import pytest

ROOT = Path(__file__).resolve().parents[1]

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the recordings of real robots; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recordings in {folder} (FIGAROH_JAX_DATA names the folder)")
    return folder
