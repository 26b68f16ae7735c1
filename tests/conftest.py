"""The numerical policy of the tests, and where the recordings are that the repository does not hold."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

# Most of the seconds are the compiler's: here and in the commands that the tests start it does not optimise (a third
# less time in all). `make test-slow` and the benchmarks run what users run.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")

import jax
import pytest

ROOT = Path(__file__).resolve().parents[1]
QUICK = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"

_FLAGS = os.environ.get("XLA_FLAGS", "")
if os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] == "1" and jax.__version_info__ < (0, 11) and QUICK not in _FLAGS:
    os.environ["XLA_FLAGS"] = f"{_FLAGS} {QUICK}"  # later compilers lack the first flag

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


gc.disable()  # nothing of what collecting imports is garbage, and looking for it takes a seventh of the time


def pytest_collection_finish() -> None:
    """What was imported stays: only what the tests make is looked through, and not after every 700 objects."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
    gc.enable()


@pytest.fixture(autouse=True)
def own_effects() -> Iterator[None]:
    """Effects that a test registers are known to it alone: no later test of the same process meets them."""
    import figaroh_jax.effects.catalogue
    import figaroh_jax.effects.kinematic  # noqa: F401  (what the library brings along stays)
    from figaroh_jax.effects import registry

    tables = (registry.CATALOGUE, registry.POSES, registry.ROLLOUTS, registry._OTHERS)  # pyright: ignore[reportPrivateUsage]
    before = [dict(known) for known in tables]
    yield
    for known, old in zip(tables, before, strict=True):
        if known != old:
            known.clear()
            known.update(old)


@pytest.fixture(autouse=True, scope="module")
def few_mappings() -> Iterator[None]:
    """Compiled programs are let go before a process has more mappings than Linux allows (65530): JAX crashes there."""
    yield
    try:
        mappings = len(Path("/proc/self/maps").read_bytes().splitlines())
    except OSError:  # not on Linux
        return
    if mappings > 30_000:
        jax.clear_caches()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Folder of the recordings of real robots; tests that need it are skipped where it is absent."""
    folder = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no recordings in {folder} (FIGAROH_JAX_DATA names the folder)")
    return folder
