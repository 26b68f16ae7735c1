"""Many samples through a kernel, a chunk at a time, by programs that serve any number of samples.

A kernel takes parameters and arrays with the samples last, and gives such an array, or several which follow one
another on the second axis. It is compiled once for a chunk: the temporaries of a small chunk stay in the processor's
cache. On a CPU, outside of JAX's transformations, samples and answers stay on the host as NumPy arrays and go through
in blocks of fixed size; under a transformation (jit, grad, vmap) the whole is one program.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import wraps
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from .executable_cache import Program
from .kernels import Straight, straight_answers, usable
from .machine_code import machine_code, own_room

__all__ = [
    "BLOCK",
    "CPU_OPTIONS",
    "aligned",
    "chunk_size",
    "filtered_program",
    "host_blocks",
    "in_one_program",
    "in_chunks",
    "on_host",
    "on_the_host",
    "over_samples",
    "program",
    "sized_program",
    "staged",
    "put",
    "reused",
    "to_device",
    "traced",
    "two_axes",
]

BLOCK, MOST = 1024, 16  # samples to a block, if these are not more chunks

# XLA's older code generator for loops takes half as long to compile our kernels, and the newer one computes gathers
# inside of sums number by number. JAX 0.11 has the newer one alone.
CPU_OPTIONS: dict[str, Any] = {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11) else {}

DRAFT_OPTIONS = CPU_OPTIONS | {"xla_backend_optimization_level": 0}
if CPU_OPTIONS:  # in one piece: at this level pieces cost more to compile and call each other; not tried with JAX 0.11
    DRAFT_OPTIONS |= {"xla_cpu_parallel_codegen_split_count": 1}
FEW = 512  # samples; for these the compiler takes longer to optimise a long program than that saves later


def program(
    function: Callable[..., Any], cpu: Mapping[str, Any] = CPU_OPTIONS, kept: bool = False, **options: Any
) -> Callable[..., Any]:
    """`jax.jit(function, **options)`; on a CPU with the compiler's options `cpu`, unknown to that of other devices.

    `kept`: on a CPU it is kept whole between processes (`executable_cache`), which makes a call a tenth of a
    millisecond longer. Within a program of the caller's, where options cannot be set, it is compiled with the caller's.
    """
    elsewhere = jax.jit(function, **options)
    on_cpu = Program(function, options=dict(cpu)) if kept else jax.jit(function, compiler_options=dict(cpu), **options)

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return (on_cpu if on_host(*arguments) else elsewhere)(*arguments)

    return call


def filtered_program(function: Callable[..., Any], cpu: Mapping[str, Any] = CPU_OPTIONS) -> Callable[..., Any]:
    """`program` of pytrees that hold more than arrays, by `equinox.filter_jit`."""
    import equinox as eqx  # the kernels have no use for it

    elsewhere = eqx.filter_jit(function)
    on_cpu = eqx.filter_jit(function, compiler_options=dict(cpu))  # pyright: ignore[reportCallIssue]

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return (on_cpu if on_host(*arguments) and not staged() else elsewhere)(*arguments)

    return call


def sized_program(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`program` whose last argument has its samples before its last axis: for few of them compiled in a third of the
    time, to run slower."""
    quick, fast = program(function, DRAFT_OPTIONS, **options), program(function, **options)

    @wraps(function)
    def call(*arguments: Any) -> Any:
        return (quick if prod(np.shape(arguments[-1])[:-1]) <= FEW else fast)(*arguments)

    return call


def chunk_size(width: int = 1) -> int:
    """Samples to a chunk: few on a CPU, fewer where an answer has many numbers a sample (`width`), many elsewhere."""
    if jax.default_backend() != "cpu":
        return 65536
    return 128 if width <= 64 else 64 if width <= 640 else 32


def traced(*trees: Any) -> bool:
    """Whether a transformation of JAX (jit, grad, vmap) is at work on any of the arrays."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(trees))


def on_host(*trees: Any) -> bool:
    """Whether the work is done on this machine's CPU, outside of JAX's transformations."""
    return jax.default_backend() == "cpu" and not traced(*trees)


def staged() -> bool:
    """Whether a `jit` (or a loop of JAX) is at work around the caller: new arrays are tracers there, and only there."""
    return traced(jnp.zeros(()))


def on_the_host() -> AbstractContextManager[Any]:
    """What is computed within is computed on this machine's CPU, where JAX has it beside another device."""
    if jax.default_backend() == "cpu":
        return nullcontext()
    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:
        return nullcontext()


def aligned(shape: Sequence[int], fill: float | None = None) -> np.ndarray:
    """A new array of float64, empty or zero, in memory that JAX takes over without a copy."""
    return own_room(tuple(shape), fill)


def reused() -> Callable[[tuple[int, ...], float | None], np.ndarray]:
    """`aligned` that gives its last array again where its shape is asked for again."""
    memory = np.empty(0)

    def room(shape: tuple[int, ...], fill: float | None) -> np.ndarray:
        nonlocal memory
        memory = memory if memory.shape == shape else aligned(shape, fill)
        return memory

    return room


def in_chunks(x: Float[Any, "samples k"], chunk: int, chunks: int = 0) -> Float[Any, "chunks k chunk"]:
    """Samples cut into (at least so many) chunks, last in each; the last sample, sure to be in range, fills them up."""
    library, missing = np if isinstance(x, np.ndarray) else jnp, max(-len(x) % chunk, chunk * chunks - len(x))
    padded = library.pad(x, ((0, missing), (0, 0)), mode="edge" if len(x) else "constant") if missing else x
    return library.swapaxes(padded.reshape(-1, chunk, x.shape[1]), 1, 2)


def over_samples(
    kernel: Callable[..., Any],
    parameters: Any,
    *arrays: ArrayLike,
    last: bool = False,
    width: int = 1,
    straight: Straight | None = None,
) -> Array:
    """Answers of `kernel(parameters, *arrays)` for float64 arrays (*batch, k): (*batch, ...), or samples `last`.

    `width` is about how many numbers an answer has for a sample; `straight` the same function written out in scalars,
    for a GPU or a C compiler, where there is one. To be called where 64-bit JAX is on.
    """
    chunk, batch = chunk_size(width), np.shape(arrays[0])[:-1]
    if on_host(parameters, arrays):
        answer = host_answer(kernel, chunk, last, straight, parameters, *two_axes(*arrays, host=True))
        return answer if last else answer.reshape(*batch, *answer.shape[1:])
    flat = two_axes(*arrays, host=False)
    if straight is not None and usable(*arrays):
        answer = straight_answers(straight, parameters, *flat)
        return answer if last else answer.reshape(*batch, *answer.shape[1:])
    if traced(parameters, arrays):
        answer = in_one_program(kernel, width, parameters, *flat)
    else:
        pieces = (tuple(x[k : k + chunk] for x in flat) for k in range(0, max(len(flat[0]), 1), chunk))
        answer = jnp.concatenate([_device_program(kernel, chunk, parameters, *piece) for piece in pieces], axis=-1)
    return answer if last else jnp.moveaxis(answer, -1, 0).reshape(*batch, *answer.shape[:-1])


def in_one_program(kernel: Callable[..., Any], width: int, parameters: Any, *arrays: Array) -> Array:
    """Answers with the samples last for arrays (samples, k), inside of a program."""
    if not len(arrays[0]):  # kernels have one sample at least
        return in_one_program(kernel, width, parameters, *(jnp.zeros((1, x.shape[1])) for x in arrays))[..., :0]
    chunk = chunk_size(width)
    small = len(arrays[0]) <= chunk
    return _joined(kernel(parameters, *(x.T for x in arrays))) if small else _all(kernel, chunk, parameters, *arrays)


def two_axes(*arrays: ArrayLike, host: bool) -> list[Any]:
    """Arrays (*batch, k) as (samples, k) in float64, in NumPy or else in JAX (to be called where 64-bit JAX is on)."""
    library: Any = np if host else jnp
    return [library.reshape(library.asarray(x, float), (-1, np.shape(x)[-1])) for x in arrays]


def _joined(pieces: Any) -> Array:
    return jnp.concatenate(pieces, axis=1) if isinstance(pieces, tuple) else pieces


def _chunks(kernel: Callable[..., Any], parameters: Any, *chunks: Array) -> Any:
    return jax.lax.map(lambda chunk: kernel(parameters, *chunk), chunks)


def _all(kernel: Callable[..., Any], chunk: int, parameters: Any, *arrays: Array) -> Array:
    """Answers with the samples last, a chunk at a time."""
    chunks = _chunks(lambda *x: _joined(kernel(*x)), parameters, *(in_chunks(x, chunk) for x in arrays))
    parts = jnp.moveaxis(chunks, 0, -2)
    return parts.reshape(*parts.shape[:-2], -1)[..., : len(arrays[0])]


_device_program = jax.jit(_all, static_argnums=(0, 1))


def _zeros(kernel: Callable[..., Any], parameters: Any, *chunks: Array) -> Array:
    """Zeros of the shape of the answers, a chunk behind the other."""
    answer = jax.eval_shape(lambda *x: _joined(kernel(parameters, *x)), *(x[0] for x in chunks))
    return jnp.zeros((len(chunks[0]), *answer.shape), answer.dtype)


def _filled(kernel: Callable[..., Any], room: Array, parameters: Any, *chunks: Array) -> Array:
    """Answers written over those of the last block, each piece to its place: no new memory, no copy."""

    def fill(k: Array, room: Array) -> Array:
        pieces, first = kernel(parameters, *(x[k] for x in chunks)), 0
        for piece in pieces if isinstance(pieces, tuple) else (pieces,):
            place = (k, 0, first, *[0] * room.ndim)[: room.ndim]
            room = jax.lax.dynamic_update_slice(room, piece[None], place)
            first += piece.shape[1]
        return room

    return jax.lax.fori_loop(0, len(room), fill, room)


_room = Program(_zeros, static=1)
_fill = Program(_filled, static=1, donate=1, options=CPU_OPTIONS)


def host_blocks(
    kernel: Callable[..., Any], chunk: int, parameters: Any, *arrays: Float[np.ndarray, "samples _"]
) -> Iterator[tuple[slice, np.ndarray]]:
    """Blocks of samples and their answers (..., chunks, chunk), which the next block overwrites; blocks may overlap.

    Fewer samples than a block has are answered with some more behind them.
    """
    samples, room = len(arrays[0]), None
    chunks = 1 if samples <= chunk else min(MOST, max(1, BLOCK // chunk))
    block = chunk * chunks
    if samples > 4 * block:  # putting the leaves there once costs as much as handing them over four times
        parameters = jax.device_put(parameters)
    for start in [*range(0, samples - block, block), max(0, samples - block)]:
        where = slice(start, min(start + block, samples))
        rows = [in_chunks(x[where], chunk, chunks) for x in arrays]
        room = _fill(kernel, _room(kernel, parameters, *rows) if room is None else room, parameters, *rows)
        yield where, np.moveaxis(np.asarray(room), 0, -2)


def host_answer(
    kernel: Callable[..., Any],
    chunk: int,
    last: bool,
    straight: Straight | None,
    parameters: Any,
    *arrays: Float[np.ndarray, "samples _"],
) -> Array:
    """Answers for arrays of the host, by machine code of the `straight` form where there is some."""
    code = None if straight is None else machine_code(straight, parameters, *arrays)
    return _assembled(kernel, chunk, last, parameters, *arrays) if code is None else to_device(code(own_room, *arrays))


def _assembled(kernel: Callable[..., Any], chunk: int, last: bool, parameters: Any, *arrays: np.ndarray) -> Array:
    """Answers put together in NumPy: JAX's own memory comes in small pages, which cost more than the numbers."""
    samples, whole, view = len(arrays[0]), np.empty(0), None
    for where, parts in host_blocks(kernel, chunk, parameters, *arrays):
        if view is None:
            whole = aligned((*parts.shape[:-2], samples) if last else (samples, *parts.shape[:-2]))
            view = whole if last else np.moveaxis(whole, 0, -1)
        put(view[..., where], parts)
    return to_device(whole)


def to_device(whole: np.ndarray) -> Array:
    """The array as JAX's, without a copy; inside of somebody's `jit`, too, a constant."""
    with jax.ensure_compile_time_eval():
        return jax.device_put(whole, may_alias=True)


def put(target: Float[np.ndarray, "*lead samples"], parts: Float[np.ndarray, "*lead chunks chunk"]) -> None:
    """Write chunks of samples one behind the other; what is beyond the last sample is dropped."""
    if target.shape[-1] < parts.shape[-2] * parts.shape[-1]:
        target[...] = parts.reshape(*target.shape[:-1], parts.shape[-2] * parts.shape[-1])[..., : target.shape[-1]]
    else:
        target.reshape(parts.shape)[...] = parts
