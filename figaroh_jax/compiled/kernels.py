"""Kernels of a GPU that hold one sample a lane: everything between states and answer stays in registers.

A `Straight` is a plain function of samples with the same function written out in scalars beside it. On an NVIDIA GPU
the scalars become one Pallas kernel, which Triton compiles; any other device, derivatives and batches of robots take
the plain form. The numbers of a robot are arguments of the kernel, which is compiled once for a structure. Where they
are known when it is made, those that are 0, 1 or -1 belong to the structure, and what they leave out is not computed.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import lru_cache, partial
from math import ceil, prod
from types import ModuleType
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from . import executable_cache

__all__ = [
    "Lanes",
    "Load",
    "Number",
    "Program",
    "Read",
    "Straight",
    "Write",
    "in_a_round",
    "kept_here",
    "known_codes",
    "lanes_of",
    "launch",
    "launch_over",
    "rounded",
    "straight_answers",
    "usable",
]

LANES = 32  # samples of a block: one warp, one a lane; with two a lane the registers do not suffice
DIRECT = 32  # numbers of an answer (samples first) that a lane writes side by side; more are written apart and turned
FEW = 48  # columns read and numbers written by a kernel that is short enough to be compiled as one piece


class Number:
    """A number in a kernel: known (a float), the same for all lanes, or an array of lanes.

    Arithmetic leaves out what changes nothing, so that zeros and ones of a robot's structure cost nothing.
    """

    __slots__ = ("x",)

    def __init__(self, x: Any) -> None:
        self.x = x

    @property
    def known(self) -> bool:
        """Whether the number is written into the program."""
        return isinstance(self.x, float)

    def __add__(self, other: Number) -> Number:
        if self.known and self.x == 0.0:
            return other
        if other.known and other.x == 0.0:
            return self
        return _binary(lax.add, self, other)

    def __sub__(self, other: Number) -> Number:
        if other.known and other.x == 0.0:
            return self
        if self.known and self.x == 0.0:
            return -other
        return _binary(lax.sub, self, other)

    def __mul__(self, other: Number) -> Number:
        for one, two in ((self, other), (other, self)):
            if one.known and one.x in (0.0, 1.0, -1.0):
                return Number(0.0) if one.x == 0.0 else two if one.x == 1.0 else -two
        return _binary(lax.mul, self, other)

    def __neg__(self) -> Number:
        return Number(-self.x if self.known else lax.neg(self.x))


_OF_FLOATS = {lax.add: float.__add__, lax.sub: float.__sub__, lax.mul: float.__mul__}


def _binary(operation: Callable[[Any, Any], Any], one: Number, two: Number) -> Number:
    x, y = one.x, two.x
    if one.known and two.known:
        return Number(_OF_FLOATS[operation](x, y))
    shape, dtype = (jnp.shape(x) or jnp.shape(y)), (y.dtype if one.known else x.dtype)
    x, y = (
        lax.full(shape, z, dtype) if isinstance(z, float) else z if z.shape == shape else lax.broadcast(z, shape)
        for z in (x, y)
    )
    return Number(operation(x, y))


Load = Callable[[int], Any]  # place of a constant -> its value
Read = Callable[[int], Number]  # column of an array -> its number
Write = Callable[[Iterable[tuple[tuple[int, ...], Number]]], None]  # takes (place in the answer of a sample, number)
Columns = Sequence[Sequence[tuple[int, int]]]  # (array, column) that are read together
Program = Callable[..., None]  # program(load, reads, write); the arguments give and take numbers
Back = Callable[[Sequence[tuple[int, ...]]], list[Number]]  # places in the answer -> what programs before wrote there


Shape = tuple[int, ...] | list[tuple[int, ...]]  # of a list: of several arrays, the first number of a place says which


class Straight(NamedTuple):
    """A function of samples in two forms. Only `constants` and `known` look at the numbers of its parameters.

    `last`: the samples stand last in the answer, which is then (*shape, samples), else (samples, *shape). In pieces of
    so many samples, a power of two that divides them all, each array (n, k) of a list is (n, pieces, k, samples).
    """

    name: str  # of all forms with the same programs and places
    structure: Callable[[Any], Any]  # what the programs follow from, without `known`; its `repr` tells it from others
    plain: Callable[..., Array]  # answers of (parameters, *arrays), arrays (samples, k)
    constants: Callable[..., Any]  # what the program takes from the parameters, in one row (dtype, NumPy or JAX)
    known: Callable[[Any], bytes]  # which constants are known before; parameters in NumPy
    known_lengths: Callable[[Any, Any], bytes]  # of constants at hand, those that stay when the rest is identified
    nothing_known: Callable[[Any], bytes]
    programs: Callable[[Any, bytes], Sequence[Program]]  # each writes a part of the answer
    shape: Callable[[Any], Shape]  # of what the programs write for a sample
    columns: Callable[[Any], Columns]
    last: bool = False
    finish: Callable[[Any, Array], Array] | None = None  # of what they wrote, the samples last
    answer: Callable[[Any], tuple[int, ...]] = lambda parameters: ()  # shape of a sample's answer, finished
    places: Callable[[Any, tuple[int, ...]], Sequence[int]] | None = None  # in it, flat, of what a program writes
    apart: Callable[[Any], Straight | None] = lambda parameters: None  # the same in smaller kernels, where one is large
    looped: Callable[..., Any] | None = None  # of (parameters, *arrays): what programs write, the samples last, or None
    piece: int = 0  # samples of a piece; 0: all in one


def usable(*arrays: Any) -> bool:
    """Whether there is a GPU that the kernels are for, and none of the arrays is spread over several devices."""
    if jax.default_backend() != "gpu" or not _triton():
        return False
    return all(len(getattr(x, "devices", lambda: ())()) <= 1 for x in arrays if not isinstance(x, Tracer))


@lru_cache(maxsize=1)
def _triton() -> bool:
    """Whether this JAX makes kernels by Triton: 0.11 says that a later one will not."""
    try:
        from jax.experimental.pallas import triton
    except ImportError:
        return False
    _spare_a_search()
    return hasattr(triton, "CompilerParams")


def _spare_a_search() -> None:
    """Have jaxlib find a Python module of Triton's dialect, an empty one, where there is none.

    It looks for one in every folder of the path whenever it makes one of the dialect's types, ten thousand times for
    the kernels of a humanoid: more than half of the time in which they are lowered.
    """
    name = "jaxlib.mlir.dialects.tt"
    with suppress(ImportError, ValueError):
        if name not in sys.modules and importlib.util.find_spec(name) is None:
            sys.modules[name] = ModuleType(name)


def known_codes(straight: Straight, parameters: Any) -> bytes:
    """Which constants of the parameters are known as they stand: none of those that a transformation traces."""
    traced = any(isinstance(x, Tracer) for x in jax.tree.leaves(parameters))
    return straight.nothing_known(parameters) if traced else straight.known(parameters)


def straight_answers(
    straight: Straight, parameters: Any, *arrays: Float[Any, "samples _"], codes: bytes | None = None
) -> Array:
    """Answers of the function in the dtype of the arrays, in any transformation of JAX.

    `codes` of `known_codes`, where parameters that are traced here were seen before.
    """
    leaves = jax.tree.leaves(parameters)
    codes = known_codes(straight, parameters) if codes is None else codes
    if any(isinstance(x, Tracer) for x in [*leaves, *arrays]):
        return _answers(straight, codes, parameters, *arrays)
    samples = len(arrays[0])
    missing = rounded(samples) - samples
    padded = [jnp.pad(x, ((0, missing), (0, 0)), mode="edge") for x in arrays] if missing and samples else arrays
    program = _kept(straight, codes) if kept_here(*padded) else partial(_program, straight, codes)
    answer = program(parameters, *padded)
    return (answer[..., :samples] if straight.last else answer[:samples]) if missing else answer


@lru_cache(maxsize=64)
def _kept(straight: Straight, codes: bytes) -> executable_cache.Program:
    def straight_program(parameters: Any, *arrays: Array) -> Any:
        return _answers(straight, codes, parameters, *arrays)

    return executable_cache.Program(straight_program, key=f"{straight.name} {codes.hex()}")


def kept_here(*arrays: Any) -> bool:
    """Whether programs of these arrays, none of them traced, are kept between processes: on the first device alone."""
    if executable_cache.keeping() is None or jax.config.values.get("jax_default_device") is not None:
        return False
    first = {jax.devices()[0]}
    return all(x.devices() == first for x in arrays if isinstance(x, jax.Array))


def rounded(samples: int) -> int:
    """So many or more: 2^k or 1.5 times that, so that few programs serve all recordings."""
    whole = 1 << max(10, (samples - 1).bit_length()) if samples else 0
    return whole * 3 // 4 if whole > 1024 and samples <= whole * 3 // 4 else whole


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _answers(straight: Straight, codes: bytes, parameters: Any, *arrays: Array) -> Array:
    return _batched(straight, codes)(parameters, *arrays)


@_answers.defjvp
def _(straight: Straight, codes: bytes, primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Array, Array]:
    return _answers(straight, codes, *primals), jax.jvp(straight.plain, primals, tangents)[1]


_program = jax.jit(_answers, static_argnums=(0, 1))


@lru_cache(maxsize=64)
def _batched(straight: Straight, codes: bytes) -> Callable[..., Array]:
    """By the device at hand; a batch of states is so many more samples, a batch of robots takes the plain form."""

    @jax.custom_batching.custom_vmap
    def call(parameters: Any, *arrays: Array) -> Array:
        if not _triton():
            return straight.plain(parameters, *arrays)
        kernel = partial(_kernel, straight, codes)
        return lax.platform_dependent(parameters, *arrays, cuda=kernel, default=straight.plain)

    @call.def_vmap
    def _(size: int, batched: Any, parameters: Any, *arrays: Array) -> tuple[Any, Any]:
        if any(jax.tree.leaves(batched[0])):
            axes = jax.tree.map(lambda b: 0 if b else None, batched)
            found = jax.vmap(straight.plain, in_axes=tuple(axes))(parameters, *arrays)
            return found, jax.tree.map(lambda _: True, found)
        whole = [x if b else jnp.broadcast_to(x, (size, *x.shape)) for x, b in zip(arrays, batched[1:], strict=True)]
        answer = call(parameters, *(x.reshape(-1, x.shape[-1]) for x in whole))
        if straight.piece:
            apart = [jnp.moveaxis(x.reshape(x.shape[0], size, -1, *x.shape[2:]), 1, 0) for x in answer]
            return apart, [True for _ in apart]
        if straight.last:
            apart = jax.tree.map(lambda x: jnp.moveaxis(x.reshape(*x.shape[:-1], size, -1), -2, 0), answer)
            return apart, jax.tree.map(lambda _: True, apart)
        return answer.reshape(size, -1, *answer.shape[1:]), True

    return call


def _kernel(straight: Straight, codes: bytes, parameters: Any, *arrays: Array) -> Array:
    straight = straight.apart(parameters) or straight
    shape, columns = straight.shape(parameters), straight.columns(parameters)
    constants = straight.constants(parameters).astype(arrays[0].dtype)
    last = straight.last or _numbers(shape) > DIRECT or straight.finish is not None
    answer: Any = straight.looped(parameters, *arrays) if straight.looped else None
    if answer is None:
        for program in straight.programs(parameters, codes):
            answer = launch(program, constants, arrays, shape, columns, last, answer, piece=straight.piece)
    assert answer is not None
    if straight.finish is not None:
        answer = straight.finish(parameters, answer)
    return answer if last == straight.last else jnp.moveaxis(answer, -1, 0)


def _numbers(shape: Shape) -> int:
    return sum(map(prod, shape if isinstance(shape, list) else [shape]))


def launch(
    program: Program,
    constants: Float[Array, " constants"],
    arrays: Sequence[Float[Array, "samples _"]],
    shape: Shape,
    columns: Columns,
    last: bool,
    into: Any = None,
    interpret: bool = False,
    piece: int = 0,
) -> Any:
    """Answers of a program for arrays (samples, k): (samples, *shape), or samples `last`, in pieces as of `Straight`.

    The program's `reads` are those of the arrays and, last, a `Back`. `interpret` computes them without a GPU, slowly.
    What the program does not write is as in the answer `into`, which is given away, or anything.
    """
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    samples, many = len(arrays[0]), isinstance(shape, list)
    numbers = shape if isinstance(shape, list) else [shape]
    shapes = [(*one, samples) if last else (samples, *one) for one in numbers]
    if piece:
        shapes = [(prod(one) * samples,) for one in numbers]
    answers = [jax.ShapeDtypeStruct(one, arrays[0].dtype) for one in shapes]
    if not samples:
        empty = [jnp.zeros(one.shape, one.dtype) for one in answers]
        return empty if many else empty[0]
    long = len([x for group in columns for x in group]) + _numbers(shape) > FEW
    # each array in one row, so that a place in it is one number (of 32 bits)
    flat = bool(piece) or (long and max(prod(x.shape) for x in [*arrays, *answers]) < 1 << 31)
    if flat:
        answers = [jax.ShapeDtypeStruct((prod(x.shape),), x.dtype) for x in answers]

    def kernel(*refs: Any) -> None:
        (table, once, *given), outs = refs[: 2 + len(arrays)], refs[-len(answers) :]
        widths = [x.shape[1] for x in arrays]
        layout = _Layout(given, list(outs), widths, numbers, samples, last, piece, many, flat)
        lanes = _Lanes(triton, layout, columns, once[0] if long else None)
        program(
            lambda k: table[k],
            [*(partial(lanes.read, k) for k in range(len(arrays))), lanes.back],
            lanes.write,
        )

    anywhere, before = pl.BlockSpec(memory_space=pl.ANY), jax.tree.leaves(into)
    before, inputs = ([x.reshape(-1) if flat else x for x in some] for some in (before, arrays))
    found = pl.pallas_call(
        kernel,
        out_shape=answers,
        grid=(ceil(samples / LANES),),
        in_specs=[anywhere] * (2 + len(arrays) + len(before)),
        out_specs=[anywhere] * len(answers),
        input_output_aliases={2 + len(arrays) + k: k for k in range(len(before))},
        compiler_params=None if interpret else triton.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name=program.__name__,
    )(constants, jnp.ones(1, jnp.int32), *inputs, *before)
    if piece:
        shapes = [(n, samples // piece, k, piece) for n, k in numbers]
    found = [x.reshape(one) for x, one in zip(found, shapes, strict=True)]
    return found if many else found[0]


class _Place(NamedTuple):
    """Where samples find a number: in an array, at an index beside that of the sample; or, where the array is one row,
    from `first` on, each sample `apart` from the one before; in pieces of `piece` samples, the pieces `apart`.
    """

    ref: Any
    at: Callable[[Array], tuple[Any, ...]]
    first: int = 0
    kind: tuple[int, int] = (0, 0)  # apart, piece


class _Layout(NamedTuple):
    """Arrays (samples, widths) and answers of `launch`; `flat` where each is one row."""

    given: Sequence[Any]
    outs: Sequence[Any]
    widths: Sequence[int]
    shapes: Sequence[tuple[int, ...]]
    samples: int
    last: bool
    piece: int
    many: bool
    flat: bool

    def read(self, array: int, column: int) -> _Place:
        """A column of an array."""
        return _Place(self.given[array], lambda index: (index, column), column, (self.widths[array], 0))

    def write(self, place: tuple[int, ...]) -> _Place:
        """A number of an answer."""
        array, place = (place[0], place[1:]) if self.many else (0, place)
        out, shape, samples = self.outs[array], self.shapes[array], self.samples
        if self.piece:
            row, column = place
            first, kind = row * samples * shape[1] + column * self.piece, (shape[1] * self.piece, self.piece)
            return _Place(out, lambda index: (index,), first, kind)
        number = int(np.ravel_multi_index(place, shape))
        if self.last:
            return _Place(out, lambda index: (*place, index), number * samples, (1, 0))
        return _Place(out, lambda index: (index, *place), number, (prod(shape), 0))


Access = Callable[[list[Any], Array | None, list[Array]], list[Array]]  # of places, which lanes, values: new values


def in_a_round(
    once: Any, whole: Any, access: Callable[[Any, list[Array]], list[Array]], start: list[Array]
) -> list[Array]:
    """What an access makes of whole numbers (a tree) and values, in a loop of one round (`once` is 1, which is read).

    Triton spends its time on how each access goes with every other operation that it can reach from there, cubic in
    their number. It does not look through such a loop: what goes in is written, what comes out is read. Nor may a
    constant stand in it: there is one of each in a kernel, and from it all is reached that uses the same. So whole
    numbers go in, too, and are doubled in a round, for what stays as it is would be taken out.
    """

    def step(carry: tuple[Any, Any, list[Array]]) -> tuple[Any, Any, list[Array]]:
        rounds, given, values = carry
        found = access(given, values)
        return *jax.tree.map(lambda x: x + x, (rounds, given)), found

    # by doubling: a plain count would become a loop through which the compiler does look
    return lax.while_loop(lambda carry: carry[0] < 2 * once, step, (jnp.int32(1), whole, start))[2]


class _Lanes:
    """The samples of one block: where their numbers are read and written; in a long kernel by `in_a_round`."""

    def __init__(self, triton: Any, layout: _Layout, columns: Columns, once: Any) -> None:
        from jax.experimental import pallas as pl

        self.triton, self.layout, self.columns, self.once = triton, layout, columns, once
        self.dtype, self.samples = layout.outs[0].dtype, layout.samples
        self.block, self.lane = pl.program_id(0), lax.iota(jnp.int32, LANES)
        self.index = self.block * LANES + self.lane
        self.seen: dict[tuple[int, int], Number] = {}

    def read(self, array: int, column: int) -> Number:
        if (array, column) not in self.seen:
            group = [(array, column)]
            if self.once is not None:
                group = next(g for g in self.columns if (array, column) in g)
            loaded = self._loaded([self.layout.read(*one) for one in group])
            self.seen.update(zip(group, loaded, strict=True))
        return self.seen[array, column]

    def back(self, places: Sequence[tuple[int, ...]]) -> list[Number]:
        """What programs before this one wrote."""
        return self._loaded([self.layout.write(place) for place in places])

    def _loaded(self, places: Sequence[_Place]) -> list[Number]:
        def load(there: list[Any], mask: Array | None, _: list[Array]) -> list[Array]:
            return [self.triton.load(x, mask=mask, other=None if mask is None else 0.0) for x in there]

        return [Number(x) for x in self._apart(places, load, [jnp.zeros(LANES, self.dtype)] * len(places))]

    def write(self, entries: Iterable[tuple[tuple[int, ...], Number]]) -> None:
        def put(there: list[Any], mask: Array | None, values: list[Array]) -> list[Array]:
            for x, value in zip(there, values, strict=True):
                self.triton.store(x, value, mask=mask)
            return [*values[1:], -values[0]]  # others, or the loop would be seen through

        places, numbers = zip(*entries, strict=True)
        self._apart([self.layout.write(x) for x in places], put, [_in_lanes(x, self.dtype) for x in numbers])

    def _apart(self, places: Sequence[_Place], access: Access, start: list[Array]) -> list[Array]:
        flat, ends = self.layout.flat, [self.samples] if self.samples % LANES else []
        if self.once is None:
            there = [x.ref.at[self._first(x) if flat else x.at(self.index)] for x in places]
            return access(there, self.index < self.samples if ends else None, start)
        first = {x.kind: x for x in reversed(places)} if flat else {}
        numbers = list(dict.fromkeys([*_steps(places), *ends] if flat else ends))

        def walked(whole: Any, values: list[Array]) -> list[Array]:
            index, begin, given = whole
            known = {n: lax.broadcast(x, (LANES,)) for n, x in zip(numbers, given, strict=True)}
            mask = index < known[self.samples] if ends else None
            at, there = dict(zip(first, begin, strict=True)), []
            last = {kind: x.first for kind, x in first.items()}
            for x in places:
                if flat and x.first != last[x.kind]:
                    at[x.kind], last[x.kind] = at[x.kind] + known[x.first - last[x.kind]], x.first
                there.append(x.ref.at[at[x.kind] if flat else x.at(index)])
            return access(there, mask, values)

        begin, given = [self._first(x) for x in first.values()], [jnp.int32(n) for n in numbers]
        return in_a_round(self.once, (self.index, begin, given), walked, start)

    def _first(self, place: _Place) -> Int[Array, " lanes"]:
        """Where the samples of this block find a number."""
        apart, piece = place.kind
        if not piece:
            return (self.index if apart == 1 else self.index * apart) + place.first
        pieces, blocks = jnp.int32((piece // LANES).bit_length() - 1), jnp.int32(piece // LANES - 1)
        first = lax.shift_right_logical(self.block, pieces) * apart + lax.bitwise_and(self.block, blocks) * LANES
        return self.lane + (first + place.first)


def _steps(places: Sequence[_Place]) -> Iterable[int]:
    """From each place to the next of its kind, without those of length zero."""
    last: dict[tuple[int, int], int] = {}
    for x in places:
        if x.first != last.get(x.kind, x.first):
            yield x.first - last[x.kind]
        last[x.kind] = x.first


def _in_lanes(number: Number, dtype: Any) -> Array:
    x = number.x
    return jnp.full(LANES, x, dtype) if number.known or not jnp.shape(x) else x


class Lanes:
    """The samples of one block in a kernel that loops: numbers of arrays (k, samples) and (samples, k) by their place.

    `outs` are the arrays that it writes.
    """

    def __init__(self, triton: Any, outs: Sequence[Any], samples: int) -> None:
        from jax.experimental import pallas as pl

        self.triton, self.outs, self.dtype = triton, outs, outs[0].dtype
        self.index = pl.program_id(0) * LANES + lax.iota(jnp.int32, LANES)
        self.mask = self.index < samples if samples % LANES else None

    def full(self, x: Any) -> Array:
        """The same in all lanes."""
        return jnp.full(LANES, x)

    def read(self, ref: Any, first: Any, k: int) -> Number:
        """Column first + k of an array (samples, _)."""
        return Number(self._load(ref.at[self.index, first + k], self.mask))

    def at(self, ref: Any, row: Any, wanted: Array | None = None) -> Array:
        """A row of an array (_, samples), where it is wanted."""
        return self._load(ref.at[row, self.index], self._both(wanted))

    def put(self, ref: Any, row: Any, numbers: Sequence[Array], wanted: Array | None = None) -> None:
        """Write rows of an array (_, samples) from `row` on, where they are wanted."""
        for k, x in enumerate(numbers):
            self.triton.store(ref.at[row + k, self.index], x, mask=self._both(wanted))

    def _both(self, wanted: Array | None) -> Array | None:
        return self.mask if wanted is None else wanted if self.mask is None else wanted & self.mask

    def _load(self, at: Any, mask: Array | None) -> Array:
        return self.triton.load(at, mask=mask, other=None if mask is None else 0.0)


def lanes_of(number: Number, lanes: Lanes) -> Array:
    """The number in every lane."""
    return _in_lanes(number, lanes.dtype)


def launch_over(
    kernel: Callable[..., None], arrays: Sequence[Array], shapes: Sequence[tuple[int, int]]
) -> list[Float[Array, "rows samples"]]:
    """What `kernel(lanes, *refs)` writes into arrays of these shapes, called once for each block of samples."""
    from jax.experimental import pallas as pl
    from jax.experimental.pallas import triton

    samples, dtype = shapes[0][1], next(x.dtype for x in arrays if jnp.issubdtype(x.dtype, jnp.floating))
    if not samples:
        return [jnp.zeros(shape, dtype) for shape in shapes]
    anywhere = pl.BlockSpec(memory_space=pl.ANY)
    return pl.pallas_call(
        lambda *refs: kernel(Lanes(triton, refs[len(arrays) :], samples), *refs[: len(arrays)]),
        out_shape=[jax.ShapeDtypeStruct(shape, dtype) for shape in shapes],
        grid=(ceil(samples / LANES),),
        in_specs=[anywhere] * len(arrays),
        out_specs=[anywhere] * len(shapes),
        compiler_params=triton.CompilerParams(num_warps=1, num_stages=1),
        name="looped_rows",
    )(*arrays)
