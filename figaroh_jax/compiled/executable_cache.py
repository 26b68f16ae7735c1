"""Programs for a CPU that are kept on disk whole: a later process only reads them.

JAX's persistent cache spares the compilation alone, and only after a function has been traced and lowered, which takes
five times as long as reading a program. Where that cache is on (the command line turns it on), a `Program` stands in
it whole, under a name that changes with everything it was made from: this package's source, the versions of JAX, the
processor, flags, and the types of the arguments. What is no part of this package (an effect of a user) is not kept.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import platform
from collections.abc import Callable, Iterable
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np

__all__ = ["Program"]

_PACKAGE = Path(__file__).parent
_PLAIN = (tuple, list, dict, type(None))


class Program:
    """A function of trees of arrays, compiled once for each type of its arguments; to be called outside of any trace.

    The first `static` arguments are functions; the arrays of argument `donate` are given away; `options` are those of
    a CPU's compiler. Where trees other than tuples, lists and dicts come out, or types of another package go in, the
    program lives as long as the process.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        static: int = 0,
        donate: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> None:
        self.function, self.static, self.donate, self.options = function, static, donate, options
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
        file = self._file(args[: self.static], leaves, tree)
        known = _read(file, len(leaves)) if file else None
        if known is None:
            known = self._made(args, leaves, tree)
            if file and all(x is None or x in _PLAIN for x in _types(known[1])):
                _write(file, leaves, *known)
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
        compiled = jax.jit(flat, donate_argnums=given, compiler_options=options).lower(*types).compile()
        return compiled, out[-1]

    def _file(self, static: tuple[Any, ...], leaves: list[Any], tree: Any) -> Path | None:
        """Where the program is kept; None where it is not."""
        folder = jax.config.values.get("jax_compilation_cache_dir")
        on = jax.config.values.get("jax_enable_compilation_cache") and jax.default_backend() == "cpu"
        functions = (self.function, *static)
        if not (folder and on and all(map(_ours, functions)) and all(x is None or _ours(x) for x in _types(tree))):
            return None
        parts = [
            *(f"{f.__module__}.{f.__qualname__}" for f in functions),
            str(tree),
            *(f"{x.shape} {x.dtype}" for x in leaves),
            f"{self.options} {self.donate} {jax.dtypes.canonicalize_dtype(float)}",
            _surroundings(),
        ]
        return Path(folder) / "programs" / hashlib.blake2b("\n".join(parts).encode(), digest_size=20).hexdigest()


def _ours(thing: Any) -> bool:
    return thing in _PLAIN or thing.__module__.partition(".")[0] == __package__


def _types(tree: Any) -> Iterable[Any]:
    """Types of all nodes of a tree; None for a leaf."""
    data = tree.node_data()
    yield None if data is None else data[0]
    for child in tree.children():
        yield from _types(child)


@lru_cache(maxsize=1)
def _surroundings() -> str:
    """What a program depends on beside its function and arguments."""
    source = hashlib.blake2b()
    for file in sorted(_PACKAGE.rglob("*.py")):
        source.update(file.read_bytes())
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    processor = sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))})
    versions = (jax.__version__, version("jaxlib"), platform.machine(), platform.processor())
    return repr((source.hexdigest(), versions, processor, os.environ.get("XLA_FLAGS")))


def _read(file: Path, leaves: int) -> tuple[Any, Any] | None:
    try:
        return _loaded(file.read_bytes(), leaves)
    except Exception:  # not there, cut short, or of another version: it is made again
        return None


def _loaded(data: bytes, leaves: int) -> tuple[Any, Any]:
    from jax.experimental.serialize_executable import deserialize_and_load

    program, out = pickle.loads(data)
    arguments = jax.tree.structure(((0,) * leaves, {}))
    return deserialize_and_load(program, arguments, jax.tree.structure([0] * out.num_leaves)), out


def _write(file: Path, leaves: list[Any], compiled: Any, out: Any) -> None:
    from jax.experimental.serialize_executable import serialize

    beside = file.with_name(f"{file.name}.{os.getpid()}")
    try:
        data = pickle.dumps((serialize(compiled)[0], out))
        _loaded(data, len(leaves))[0](*(np.zeros(x.shape, x.dtype) for x in leaves))  # it must run to be worth keeping
        file.parent.mkdir(parents=True, exist_ok=True)
        beside.write_bytes(data)
        beside.replace(file)
    except Exception:  # a full or read-only disk, a program that cannot be kept: only time is lost
        beside.unlink(missing_ok=True)
