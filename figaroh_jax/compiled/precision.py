"""Float64 inside, whatever JAX is set to: one decorator for every public function of arrays.

| called | with JAX's 64-bit mode on | off (JAX's default) |
|---|---|---|
| on arrays | float64 | float64, in a scope of its own |
| under jit, grad, vmap, jacfwd, jacrev | float64 | float32 in and out, as JAX has it there; float64 between |

JAX cannot hold a scope open while it transposes (reverse mode), so with 64-bit mode off the work under a
transformation is one primitive, whose rules (JVP, transpose, batching, lowering) open the scope again. With 64-bit mode
on it is so too under `grad` and `vmap` without `jit`, for the sake of time: JAX would compile every operation of the
work and of its derivative by itself (gradient of `inverse_dynamics` by a model of four joints: 15 CPU s, so: 3).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache, wraps
from math import prod
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from .batching import CPU_OPTIONS, DRAFT_OPTIONS, FEW, program, traced

__all__ = ["Float32Boundary", "in_float64"]

MANY = 16 * FEW  # numbers of one argument

P = ParamSpec("P")
R = TypeVar("R")


class Float32Boundary(UserWarning):
    """Said once: under a transformation of JAX, with its 64-bit mode off, arrays come in and go out as float32."""


def in_float64(function: Callable[P, R]) -> Callable[P, R]:
    """`function` computed in float64: see the table at the head of the module. Arguments are pytrees of arrays."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        if jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]  # JAX adds it as it runs
            if traced(args, kwargs) and not _staged() and not any(map(callable, jax.tree.leaves((args, kwargs)))):
                return _bridged(function, args, kwargs, narrow=False)
            return function(*args, **kwargs)
        if traced(args, kwargs):
            _say_once()
            return _bridged(function, args, kwargs, narrow=True)
        with jax.enable_x64(True):
            return function(*args, **kwargs)

    return call


def _is_array(x: Any) -> bool:
    return isinstance(x, (jax.Array, np.ndarray, np.generic))


def _staged() -> bool:
    """Whether a `jit` (or a loop of JAX) is at work around the caller: new arrays are tracers there, and only there."""
    return traced(jnp.zeros(()))


def _bridged(function: Callable[..., Any], args: Any, kwargs: Any, *, narrow: bool) -> Any:
    leaves, tree = jax.tree.flatten((args, kwargs))
    place = tuple(_is_array(x) for x in leaves)
    # where it narrows, what a transformation holds is float32, whatever was handed to it; other arrays keep their type
    arrays = [_narrow(x) if narrow and traced(x) else x for x, is_array in zip(leaves, place, strict=True) if is_array]
    avals = tuple((np.shape(x), np.dtype(x.dtype)) for x in arrays)
    fixed = tuple(None if is_array else x for x, is_array in zip(leaves, place, strict=True))
    with jax.enable_x64(True):
        jaxpr, answer = _traced(function, tree, place, fixed, avals, narrow)
        return jax.tree.unflatten(answer, _scoped.bind(*arrays, jaxpr=jaxpr))


@lru_cache(maxsize=1)
def _say_once() -> None:
    warnings.warn(
        "JAX's 64-bit mode is off: under jit, grad or vmap arrays come in and go out as float32, with which no rank"
        " and small residuals are lost; figaroh_jax computes in float64 between. For float64 throughout:"
        " jax.config.update('jax_enable_x64', True) before the first array.",
        Float32Boundary,
        stacklevel=5,
    )


@lru_cache(maxsize=256)
def _traced(
    function: Callable[..., Any],
    tree: Any,
    place: tuple[bool, ...],
    fixed: tuple[Any, ...],
    avals: tuple[Any, ...],
    narrow: bool,
) -> tuple[ClosedJaxpr, Any]:
    """The work as a jaxpr of the arrays, with float32 answers where `narrow`, and the structure of the answer."""
    shapes: list[Any] = []

    def flat(*arrays: Any) -> list[Any]:
        given = iter(_wide(x) for x in arrays)
        leaves = [next(given) if is_array else x for is_array, x in zip(place, fixed, strict=True)]
        args, kwargs = jax.tree.unflatten(tree, leaves)
        out, structure = jax.tree.flatten(function(*args, **kwargs))
        shapes.append(structure)
        return [_narrow(x) if narrow else jnp.asarray(x) for x in out]

    jaxpr = jax.make_jaxpr(flat)(*(jax.ShapeDtypeStruct(*aval) for aval in avals))
    return jaxpr, shapes[0]


def _wide(x: Any) -> Any:
    return x.astype(jnp.float64) if x.dtype == jnp.float32 else x


def _narrow(x: Any) -> Any:
    x = jnp.asarray(x)
    return x.astype({"f": jnp.float32, "i": jnp.int32, "c": jnp.complex64}.get(x.dtype.kind, x.dtype))


_scoped = Primitive("in_float64")
_scoped.multiple_results = True


@lru_cache(maxsize=256)
def _program(jaxpr: ClosedJaxpr) -> Callable[..., Any]:
    # whoever runs it often has a `jit` of his own; for many numbers it pays to optimise all the same
    many = max((prod(aval.shape) for aval in jaxpr.in_avals), default=0) > MANY
    return program(jaxpr_as_fun(jaxpr), CPU_OPTIONS if many else DRAFT_OPTIONS)


@_scoped.def_impl
def _run(*args: Any, jaxpr: ClosedJaxpr) -> Sequence[Any]:
    with jax.enable_x64(True):
        return _program(jaxpr)(*args)


# From JAX 0.11 on, work that holds an operation of a higher level (a solve with a derivative of its own, say) is asked
# for a form without: a program of its own, which `jit` brings down.
_scoped.to_lojax = _run


@_scoped.def_abstract_eval
def _(*args: Any, jaxpr: ClosedJaxpr) -> Sequence[Any]:
    del args
    return jaxpr.out_avals


def _lowered(*args: Any, jaxpr: ClosedJaxpr) -> Sequence[Any]:
    return jaxpr_as_fun(jaxpr)(*args)


_lower = mlir.lower_fun(_lowered, multiple_results=True)


def _lowering(context: Any, *args: Any, jaxpr: ClosedJaxpr) -> Any:
    with jax.enable_x64(True):
        return _lower(context, *args, jaxpr=jaxpr)


mlir.register_lowering(_scoped, _lowering)


def _of(avals: Any) -> list[Any]:
    return [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]


@lru_cache(maxsize=256)
def _forward(jaxpr: ClosedJaxpr, moving: tuple[int, ...]) -> ClosedJaxpr:
    """Tangents of the answers from the arguments and the tangents of those in `moving`: linear in these."""

    def tangents(*values: Any) -> Any:
        fixed = list(values[: len(jaxpr.in_avals)])

        def of(*some: Any) -> Any:
            whole = list(fixed)
            for k, value in zip(moving, some, strict=True):
                whole[k] = value
            return [x for x in jaxpr_as_fun(jaxpr)(*whole) if jnp.issubdtype(x.dtype, jnp.inexact)]

        return jax.jvp(of, tuple(fixed[k] for k in moving), tuple(values[len(jaxpr.in_avals) :]))[1]

    return jax.make_jaxpr(tangents)(*_of(jaxpr.in_avals), *(_of(jaxpr.in_avals)[k] for k in moving))


def _jvp(primals: Any, tangents: Any, *, jaxpr: ClosedJaxpr) -> Any:
    with jax.enable_x64(True):
        # NumPy's arrays under a transformation are still float64 where JAX takes them for float32
        primals = [
            np.asarray(x, a.dtype) if isinstance(x, np.ndarray) else x
            for x, a in zip(primals, jaxpr.in_avals, strict=True)
        ]
        out = _scoped.bind(*primals, jaxpr=jaxpr)
        moving = tuple(k for k, t in enumerate(tangents) if type(t) is not ad.Zero)
        given = (tangents[k] for k in moving)
        found = iter(_scoped.bind(*primals, *given, jaxpr=_forward(jaxpr, moving)))
        floats = [jnp.issubdtype(aval.dtype, jnp.inexact) for aval in jaxpr.out_avals]
        return out, [
            next(found) if f else ad.Zero(aval.to_tangent_aval())
            for f, aval in zip(floats, jaxpr.out_avals, strict=True)
        ]


ad.primitive_jvps[_scoped] = _jvp


@lru_cache(maxsize=256)
def _backward(jaxpr: ClosedJaxpr, linear: tuple[bool, ...]) -> ClosedJaxpr:
    """Cotangents of the linear arguments from the other arguments and the cotangents of the answers."""
    avals = _of(jaxpr.in_avals)
    known = [a for a, is_linear in zip(avals, linear, strict=True) if not is_linear]

    def cotangents(*values: Any) -> Any:
        def of(*some: Any) -> Any:
            given, rest = iter(some), iter(values[: len(known)])
            return jaxpr_as_fun(jaxpr)(*(next(given if is_linear else rest) for is_linear in linear))

        wanted = [a for a, is_linear in zip(avals, linear, strict=True) if is_linear]
        return jax.linear_transpose(of, *wanted)(list(values[len(known) :]))

    return jax.make_jaxpr(cotangents)(*known, *_of(jaxpr.out_avals))


def _transpose(cotangents: Any, *args: Any, jaxpr: ClosedJaxpr) -> Any:
    with jax.enable_x64(True):
        linear = tuple(ad.is_undefined_primal(x) for x in args)
        known = [x for x, is_linear in zip(args, linear, strict=True) if not is_linear]
        full = [ad.instantiate_zeros(x) for x in cotangents]
        found = iter(_scoped.bind(*known, *full, jaxpr=_backward(jaxpr, linear)))
        return [next(found) if is_linear else None for is_linear in linear]


ad.primitive_transposes[_scoped] = _transpose


@lru_cache(maxsize=256)
def _mapped(jaxpr: ClosedJaxpr, size: int, axes: tuple[int | None, ...]) -> ClosedJaxpr:
    avals = [
        a if axis is None else jax.ShapeDtypeStruct((*a.shape[:axis], size, *a.shape[axis:]), a.dtype)
        for a, axis in zip(_of(jaxpr.in_avals), axes, strict=True)
    ]
    return jax.make_jaxpr(jax.vmap(jaxpr_as_fun(jaxpr), in_axes=axes, axis_size=size))(*avals)


def _batch(args: Any, dims: Any, *, jaxpr: ClosedJaxpr) -> Any:
    with jax.enable_x64(True):
        axes = tuple(d if isinstance(d, int) else None for d in dims)
        size = next(x.shape[d] for x, d in zip(args, axes, strict=True) if d is not None)
        out = _scoped.bind(*args, jaxpr=_mapped(jaxpr, size, axes))
        return out, [0] * len(out)


batching.primitive_batchers[_scoped] = _batch
