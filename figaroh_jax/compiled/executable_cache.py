"""Programs that are kept on disk whole: a later process only reads them.

JAX's persistent cache spares the compilation alone, and only after a function has been traced and lowered, which takes
five times as long as reading a program. Where that cache is on (the command line turns it on), a `Program` stands in
it whole, under a name that changes with everything it was made from: this package's source, the versions of JAX, the
processor, flags, and the types of the arguments. What is no part of this package (an effect of a user) is not kept.

A program from disk is code. It is unpickled only where `store` vouches that this user's own processes wrote it; with
`keep_programs` the same holds of what JAX itself keeps.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import platform
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jaxlib.version
import numpy as np

from .store import Store, cache_home

__all__ = ["Program", "keep_programs", "keeping", "surroundings"]

_PACKAGE = Path(__file__).parents[1]
_PLAIN = (tuple, list, dict, type(None))


class Program:
    """A function of trees of arrays, compiled once for each type of its arguments; to be called outside of any trace.

    The first `static` arguments are functions; the arrays of argument `donate` are given away; `options` are those of
    a CPU's compiler, `tuning` is how far a GPU's products are tried out (0 to 4; XLA's own is 4, which also checks what
    each way gives: more than a second for each shape). For a CPU they are kept; for other devices where a `key` says
    all that the function depends on beside its name, and then they are for arrays of the first device. Where trees
    other than tuples, lists and dicts come out, or types of another package go in, the program lives as long as the
    process.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        static: int = 0,
        donate: int | None = None,
        options: dict[str, Any] | None = None,
        key: str = "",
        tuning: int | None = None,
    ) -> None:
        self.function, self.static, self.donate, self.options, self.key = function, static, donate, options, key
        self.tuning = tuning
        self._ready: dict[Any, tuple[Any, Any]] = {}

    def __call__(self, *args: Any) -> Any:
        """The function's answer, from a program in memory, on disk or made now."""
        leaves, tree = jax.tree.flatten(args[self.static :])
        leaves = [x if hasattr(x, "dtype") else np.asarray(x) for x in leaves]
        key = (
            args[: self.static],
            tree,
            tuple((x.shape, x.dtype) for x in leaves),
            jax.dtypes.canonicalize_dtype(float),
        )
        if key not in self._ready:
            self._ready[key] = self._prepared(args, leaves, tree)
        compiled, out = self._ready[key]
        return jax.tree.unflatten(out, compiled(*leaves))

    def _prepared(self, args: tuple[Any, ...], leaves: list[Any], tree: Any) -> tuple[Any, Any]:
        entry = self._entry(args[: self.static], leaves, tree)
        known = _read(entry, len(leaves)) if entry else None
        if known is None:
            known = self._made(args, leaves, tree)
            if entry and all(x is None or x in _PLAIN for x in _types(known[1])):
                _write(entry, leaves, *known)
        return known

    def _made(self, args: tuple[Any, ...], leaves: list[Any], tree: Any) -> tuple[Any, Any]:
        out = []

        def flat(*leaves: Any) -> list[Any]:
            answer, structure = jax.tree.flatten(self.function(*args[: self.static], *jax.tree.unflatten(tree, leaves)))
            out.append(structure)
            return answer

        given: tuple[int, ...] = ()
        if self.donate is not None:
            before = jax.tree.leaves(args[self.static : self.donate])
            given = tuple(len(before) + k for k in range(len(jax.tree.leaves(args[self.donate]))))
        # Another name each time: what comes from JAX's own cache cannot be kept once more (its code is left out).
        flat.__name__ = f"{self.function.__name__}_{os.urandom(8).hex()}"
        types = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves]
        options = self.options if jax.default_backend() == "cpu" else None
        if self.tuning is not None and jax.default_backend() == "gpu":
            options = {"xla_gpu_autotune_level": str(self.tuning)}
        compiled = jax.jit(flat, donate_argnums=given, compiler_options=options).lower(*types).compile()
        return compiled, out[-1]

    def _entry(self, static: tuple[Any, ...], leaves: list[Any], tree: Any) -> _Entry | None:
        """Where the program is kept; None where it is not."""
        folder, on = keeping(), bool(self.key) or jax.default_backend() == "cpu"
        functions = (self.function, *static)
        if not (folder and on and all(map(_ours, functions)) and all(x is None or _ours(x) for x in _types(tree))):
            return None
        known = str(tree)
        if " at 0x" in known:  # a function of the user's within it: no other process has the same
            return None
        parts = [
            *(f"{f.__module__}.{f.__qualname__}" for f in functions),
            known,
            *(f"{x.shape} {x.dtype}" for x in leaves),
            f"{self.options} {self.donate} {self.key} {self.tuning} {jax.dtypes.canonicalize_dtype(float)}",
            _device(),
            surroundings(),
        ]
        name = hashlib.blake2b("\n".join(parts).encode(), digest_size=20).hexdigest()
        return _Entry(Store(folder / "programs"), name)


def keeping() -> Path | None:
    """The folder in which programs are kept between processes; None where they are not."""
    folder = jax.config.values.get("jax_compilation_cache_dir")
    return Path(str(folder)) if folder and jax.config.values.get("jax_enable_compilation_cache") else None


def _device() -> str:
    """What a program is made for, where that is no CPU."""
    first = jax.devices()[0]
    return "" if first.platform == "cpu" else f"{first.device_kind} {first.client.platform_version}"


def _ours(thing: Any) -> bool:
    return thing in _PLAIN or thing.__module__.partition(".")[0] == _PACKAGE.name


def _types(tree: Any) -> Iterable[Any]:
    """Types of all nodes of a tree; None for a leaf."""
    data = tree.node_data()
    yield None if data is None else data[0]
    for child in tree.children():
        yield from _types(child)


@lru_cache(maxsize=1)
def surroundings() -> str:
    """What a program depends on beside its function and arguments."""
    source = hashlib.blake2b()
    for file in sorted(_PACKAGE.rglob("*.py")):
        source.update(file.read_bytes())
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    processor = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    versions = (jax.__version__, jaxlib.version.__version__, platform.machine(), platform.processor())
    quick = jax.config.values.get("jax_disable_most_optimizations")
    return repr((source.hexdigest(), versions, processor, os.environ.get("XLA_FLAGS"), quick))


class _Entry(NamedTuple):
    store: Store
    name: str


def _read(entry: _Entry, leaves: int) -> tuple[Any, Any] | None:
    data = entry.store.get(entry.name)
    try:
        return None if data is None else _loaded(data, leaves)
    except Exception:  # of another version after all: it is made again
        return None


def _loaded(data: bytes, leaves: int) -> tuple[Any, Any]:
    from jax.experimental.serialize_executable import deserialize_and_load

    program, out, solves = pickle.loads(data)  # noqa: S301  the store has checked that this user's process wrote it
    if solves:
        _find_lapack()
    arguments = jax.tree.structure(((0,) * leaves, {}))
    return deserialize_and_load(program, arguments, jax.tree.structure([0] * out.num_leaves)), out


@lru_cache(maxsize=1)
def _find_lapack() -> None:
    """Have JAX look up LAPACK's functions, as it does when it lowers one: a program from disk jumps to them unasked."""
    try:
        from jaxlib.lapack import prepare_lapack_call

        prepare_lapack_call("potrf_ffi", np.dtype(float))
    except (ImportError, TypeError, NotImplementedError):  # of a JAX that has it elsewhere
        jax.jit(jax.numpy.linalg.cholesky).lower(np.eye(1))


def _write(entry: _Entry, leaves: list[Any], compiled: Any, out: Any) -> None:
    from jax.experimental.serialize_executable import serialize

    try:
        data = pickle.dumps((serialize(compiled)[0], out, "lapack" in compiled.as_text()))
        _loaded(data, len(leaves))[0](*(np.zeros(x.shape, x.dtype) for x in leaves))  # it must run to be worth keeping
    except Exception:  # a program that cannot be kept: only time is lost
        return
    entry.store.put(entry.name, data)


def keep_programs() -> None:
    """Keep programs between processes, JAX's own included, in the user's cache folder or the one that JAX was told.

    Of what JAX keeps, too, only entries that this user's own processes wrote are read. A folder that cannot be used, or
    a JAX whose cache has another shape, costs time and nothing else.
    """
    told = jax.config.values.get("jax_compilation_cache_dir")
    home = cache_home()
    folder = Path(told) if told else home and home / "jax"
    if folder is None:
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if not told:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    if not _checked_cache(Store(folder / "programs")):
        jax.config.update("jax_enable_compilation_cache", False)


def _checked_cache(store: Store) -> bool:
    """Put the store in the place of JAX's own cache; False where JAX has no such place (it is no public one)."""
    try:
        from jax._src import compilation_cache
        from jax._src.compilation_cache_interface import CacheInterface
    except ImportError:
        return False
    if not (hasattr(compilation_cache, "_cache") and hasattr(compilation_cache, "_cache_initialized")):
        return False

    class Checked(CacheInterface):
        _path = store.folder  # pyright: ignore[reportAssignmentType]  # for a line in JAX's log

        # JAX annotates nothing here, its abstract body returns None
        def get(self, key: str) -> bytes | None:  # pyright: ignore[reportIncompatibleMethodOverride]
            return store.get(key)

        def put(self, key: str, value: bytes) -> None:
            store.put(key, value)

    compilation_cache.reset_cache()
    compilation_cache._cache, compilation_cache._cache_initialized = Checked(), True
    return True
