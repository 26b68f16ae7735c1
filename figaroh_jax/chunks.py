"""Many samples through a kernel, a chunk at a time, by programs that serve any number of samples.

A kernel takes arrays with the samples last and is compiled once for a chunk: the temporaries of a small chunk stay in
the processor's cache. Outside of JAX's transformations the samples stay on the host as NumPy arrays and go to the
device in blocks of fixed size; under a transformation (jit, grad, vmap) the whole is one program.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.typing import ArrayLike
from jaxtyping import Array, Float

__all__ = ["BLOCK", "chunk_size", "in_chunks", "over_samples", "traced", "two_axes"]

BLOCK = 8  # chunks to a block


def chunk_size(width: int = 1) -> int:
    """Samples to a chunk: few on a CPU, fewer where an answer has many numbers a sample (`width`), many elsewhere."""
    if jax.default_backend() != "cpu":
        return 65536
    return 128 if width <= 640 else 32


def traced(*trees: Any) -> bool:
    """Whether a transformation of JAX (jit, grad, vmap) is at work on any of the arrays."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(trees))


def two_axes(*arrays: ArrayLike, on_host: bool) -> list[Any]:
    """Arrays (*batch, k) as (samples, k) in float64, in NumPy or else in JAX (to be called where 64-bit JAX is on)."""
    library = np if on_host else jnp
    return [library.reshape(library.asarray(x, float), (-1, np.shape(x)[-1])) for x in arrays]


def in_chunks(x: Float[Array, "samples k"], chunk: int) -> Float[Array, "chunks k chunk"]:
    """Samples cut into chunks, last in each; the last chunk is filled up with zeros."""
    padded = jnp.pad(x, ((0, -len(x) % chunk), (0, 0)))
    return jnp.swapaxes(padded.reshape(-1, chunk, x.shape[1]), 1, 2)


def over_samples(kernel: Callable[..., Array], axis: int, chunk: int, model: Any, *arrays: ArrayLike) -> Array:
    """Answers of `kernel(model, *arrays)`, whose samples stand on `axis` (0 or -1), for arrays (*batch, k)."""
    if traced(model, arrays):
        return _chunked(kernel, axis, chunk, model, *two_axes(*arrays, on_host=False))
    return _in_blocks(kernel, axis, chunk, jax.tree.map(jnp.asarray, model), *two_axes(*arrays, on_host=True))


def _in_blocks(kernel: Callable[..., Array], axis: int, chunk: int, model: Any, *arrays: np.ndarray) -> Array:
    samples = len(arrays[0])
    block = chunk if samples <= chunk else BLOCK * chunk
    if samples <= block:
        filled = [np.pad(x, ((0, block - samples), (0, 0))) for x in arrays]
        answer = _program(kernel, axis, chunk, model, *filled)
        return answer if samples == block else jax.lax.slice_in_dim(answer, 0, samples, axis=axis)
    part = _program(kernel, axis, chunk, model, *(x[:block] for x in arrays))
    shape = (samples, *part.shape[1:]) if axis == 0 else (*part.shape[:-1], samples)
    whole = _put(jnp.empty(shape), part, 0, axis)
    for start in [*range(block, samples - block, block), samples - block]:  # the last block overlaps the one before
        part = _program(kernel, axis, chunk, model, *(x[start : start + block] for x in arrays))
        whole = _put(whole, part, start, axis)
    return whole


def _chunked(kernel: Callable[..., Array], axis: int, chunk: int, model: Any, *arrays: Array) -> Array:
    samples = len(arrays[0])
    if samples <= chunk:
        return kernel(model, *(x.T for x in arrays))
    parts = jax.lax.map(lambda part: kernel(model, *part), tuple(in_chunks(x, chunk) for x in arrays))
    if axis == 0:
        return parts.reshape(-1, *parts.shape[2:])[:samples]
    parts = jnp.moveaxis(parts, 0, -2)
    return parts.reshape(*parts.shape[:-2], -1)[..., :samples]


_program = jax.jit(_chunked, static_argnums=(0, 1, 2))


@partial(jax.jit, static_argnums=3, donate_argnums=0)
def _put(whole: Array, part: Array, start: ArrayLike, axis: int) -> Array:
    return jax.lax.dynamic_update_slice_in_dim(whole, part, start, axis)
