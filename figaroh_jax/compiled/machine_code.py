"""Straight programs as code of the processor at hand: eight samples (AVX-512) to a vector, from joint angles to answer.

XLA makes of such a program on a CPU a chain of small products that it computes over and over. Where the machine has a C
compiler (`cc`, or what `$CC` names), the program is written out in C instead, compiled once for a robot's structure and
kept beside JAX's own cache, where that is on. Everything else (no compiler, few samples, an angle beyond 1e5 rad,
transformations of JAX, other devices, `FIGAROH_JAX_MACHINE_CODE=0`) takes the plain form, whose answers it gives to
rounding.

Code that is read from disk is run only where `store` vouches that this user's own processes wrote it.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, partial
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .executable_cache import surroundings
from .kernels import Number, Program, Straight
from .memory import recycled
from .store import Store

__all__ = ["FARTHEST", "FEWEST", "code_of_few", "is_gnu", "library", "machine_code", "own_room"]

FEWEST = 8  # samples: no vector is longer
FROM = 512  # samples; below, handing them over costs as much as it saves
TO_COMPILE = 512  # samples from which a program that is nowhere yet is compiled
SMALL = 700  # constants of a robot (12 joints) up to which this holds; a larger one takes longer to compile than XLA's
PIECE = 4096  # samples of one call, on one core
ALIGNMENT = 64  # bytes; XLA takes such memory over without a copy
FARTHEST = 1e5  # rad, to which `sine_cosine` is exact
PATIENCE = 300.0  # s that a compiler may take
# what -O1 lacks for vectors to be read whole: twice as fast for six joints, no longer to compile; of the reverse -Og is
# as fast as -O1, compiled in half the time
LEVEL = {False: ("-O1", "-ftree-vectorize", "-fexpensive-optimizations"), True: ("-Og",)}
FLAGS = ("-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fPIC", "-shared", "-w", "-x", "c", "-")
LIBRARY_FLAGS = ("-O2", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-fPIC", "-shared", "-w")
if platform.machine() in ("x86_64", "AMD64"):
    LIBRARY_FLAGS += ("-mprefer-vector-width=512",)

_HEAD = """
#include <stddef.h>
#include <string.h>
#if defined(__AVX512F__)
#define W 8
#elif defined(__AVX__)
#define W 4
#else
#define W 2
#endif
typedef double V __attribute__((vector_size(8 * W)));
typedef double U __attribute__((vector_size(8 * W), aligned(8)));
typedef long long I __attribute__((vector_size(8 * W)));
static const double whole = 6755399441055744.0; /* 1.5 * 2^52: sums with it are whole numbers, in their low bits */
static inline V lanes(const double *x, size_t stride) {
  V r;
  for (int l = 0; l < W; l++) r[l] = x[l * stride];
  return r;
}
static inline V choose(I no, V yes, V other) { return (V)(((I)yes & ~no) | ((I)other & no)); }
static inline V down(V x) { V r = (x + whole) - whole; return choose((I)(r > x), r, r - 1.0); }
static inline I bits(V x) { return (I)(x + whole); }
int lanes_of_a_block(void) { return W; }
"""
MOST_WANTED = 32  # robots whose constants are held: they take longer to compute than a hundred samples
TOGETHER = 128  # samples whose answers are collected in the cache, for they go to as many places of memory as numbers


Room = Callable[[tuple[int, ...], float | None], np.ndarray]  # (shape, fill) -> memory for answers


def machine_code(
    straight: Straight, parameters: Any, *arrays: Float[np.ndarray, "samples _"]
) -> Callable[..., np.ndarray] | None:
    """`run(room, *arrays)`: answers for these arrays of the host or pieces of them, at least a vector of samples.

    They are (samples, *shape), or the samples last, in memory from `room`; from `own_room`, memory of answers that were
    given up is used again. None where the plain form has to serve.
    """
    samples = len(arrays[0])
    if samples < FROM or straight.places is None or _compiler() is None or not _near(arrays[0]):
        return None
    wanted, constants = _wanted(straight, parameters, tuple(x.shape[1] for x in arrays))
    code = _code(wanted, samples >= TO_COMPILE * max(1.0, len(wanted.codes) / SMALL))
    if code is None:
        return None
    return partial(_run, code, straight.last, constants)


def code_of_few(
    straight: Straight, parameters: Any, widths: tuple[int, ...], *, back: bool = False
) -> Callable[..., np.ndarray] | None:
    """As `machine_code`, for calls of few samples over and over, of arrays with so many columns.

    `back`: `run(cotangent, *arrays)`, the gradient by each column (columns, samples) of the sum of the cotangent
    (*shape, samples) times the answers, which stand samples last. It is the reverse of the program, statement by
    statement. Angles are below `FARTHEST`, samples at least `FEWEST`. None for a large robot whose code is nowhere
    yet, and without a compiler.
    """
    if straight.places is None or not straight.last or _compiler() is None:
        return None
    wanted, constants = _wanted(straight, parameters, widths)
    code = _code(wanted._replace(back=back), len(wanted.codes) <= SMALL)
    if code is None:
        return None
    return partial(_run_back, code, constants) if back else partial(_run, code, True, constants)


def _wanted(straight: Straight, parameters: Any, widths: tuple[int, ...]) -> tuple[_Wanted, np.ndarray]:
    numbers = b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(parameters))
    key = straight.name, straight.structure(parameters), widths, numbers
    known = _last_wanted.get(key)
    if known is None:
        constants = np.ascontiguousarray(straight.constants(parameters, float, np), float)
        known = _Wanted(straight, parameters, straight.known_lengths(parameters, constants), widths), constants
        if len(_last_wanted) >= MOST_WANTED:
            _last_wanted.clear()
        _last_wanted[key] = known
    return known


def _run(code: _Code, last: bool, constants: np.ndarray, room: Room, *arrays: np.ndarray) -> np.ndarray:
    samples, fill = len(arrays[0]), None if code.complete else 0.0
    shape = (*code.shape, samples) if last else (samples, *code.shape)
    answer = recycled(code.functions, shape) if room is own_room else None
    answer = room(shape, fill) if answer is None else answer
    rows = [np.ascontiguousarray(x, float) for x in arrays]
    _in_pieces(partial(code.run, constants, rows, answer, last), samples, code.lanes)
    return answer


def own_room(shape: tuple[int, ...], fill: float | None) -> np.ndarray:
    """New memory that JAX takes over without a copy, empty or zero."""
    size, spare = prod(shape), ALIGNMENT // 8
    flat = np.empty(size + spare) if fill is None else np.zeros(size + spare)
    start = -(flat.ctypes.data // 8) % spare
    return flat[start : start + size].reshape(shape)


def _run_back(code: _Code, constants: np.ndarray, cotangent: np.ndarray, *arrays: np.ndarray) -> np.ndarray:
    samples, columns = len(arrays[0]), sum(x.shape[1] for x in arrays)
    parts = np.empty((len(code.functions), columns, samples))
    rows = [np.ascontiguousarray(x, float) for x in arrays]
    given = np.ascontiguousarray(cotangent, float)
    _in_pieces(partial(code.run_back, constants, rows, given, parts), samples, code.lanes)
    return parts[0] if len(parts) == 1 else parts.sum(axis=0)


def _near(angle: np.ndarray) -> bool:
    return not angle.size or bool(max(angle.max(), -angle.min()) < FARTHEST)  # false where one is not a number


def _in_pieces(run: Callable[[int, int], None], samples: int, lanes: int) -> None:
    """`run(first, last)` over all samples, in whole vectors: the last one reaches back where samples are too few."""
    starts = range(0, samples, PIECE)
    pieces = [(max(0, min(k, samples - lanes)), min(k + PIECE, samples)) for k in starts]
    cores = min(_cores(), len(pieces))
    if cores == 1:
        for piece in pieces:
            run(*piece)
        return
    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(lambda piece: run(*piece), pieces))


def _cores() -> int:
    """Cores to use: as many as there are, unless OPENBLAS_NUM_THREADS or OMP_NUM_THREADS says how many."""
    told = os.environ.get("OPENBLAS_NUM_THREADS") or os.environ.get("OMP_NUM_THREADS") or ""
    if told.isdigit() and int(told):
        return int(told)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Code(NamedTuple):
    """Functions of one form of one structure of a robot, in memory."""

    functions: tuple[Any, ...]
    shape: tuple[int, ...]
    lanes: int
    complete: bool  # whether every number of the answer is written

    def run(
        self, constants: np.ndarray, arrays: Sequence[np.ndarray], answer: np.ndarray, last: bool, first: int, end: int
    ) -> None:
        """Samples from `first` up to `end`, at least a vector of them."""
        size, total = prod(self.shape), answer.shape[-1] if last else len(answer)
        inside = [x.ctypes.data + 8 * first * x.shape[1] for x in arrays]
        out = answer.ctypes.data + 8 * first * (1 if last else size)
        for function in self.functions:
            function(constants.ctypes.data, *inside, out, end - first, total)

    def run_back(
        self,
        constants: np.ndarray,
        arrays: Sequence[np.ndarray],
        given: np.ndarray,
        parts: np.ndarray,
        first: int,
        end: int,
    ) -> None:
        """As `run`: what each function makes of the cotangent goes into a part of its own."""
        total = parts.shape[-1]
        inside = [x.ctypes.data + 8 * first * x.shape[1] for x in arrays]
        for function, part in zip(self.functions, parts, strict=True):
            places = given.ctypes.data + 8 * first, part.ctypes.data + 8 * first
            function(constants.ctypes.data, *inside, *places, end - first, total)


class _Wanted(NamedTuple):
    """A form for the structure of some parameters, with what is known of their constants and the arrays' columns."""

    straight: Straight
    parameters: Any
    codes: bytes
    widths: tuple[int, ...]
    back: bool = False  # the gradient by the arrays

    @property
    def pointers(self) -> int:
        """Arguments of its functions: constants, arrays, the cotangent, the answer."""
        return len(self.widths) + 2 + self.back


_ready: dict[Any, _Code | None] = {}
_last_wanted: dict[Any, tuple[_Wanted, np.ndarray]] = {}


def _code(wanted: _Wanted, compile_it: bool) -> _Code | None:
    """From memory, from disk, or made now where `compile_it`; None where there is none."""
    key = (
        wanted.straight.name,
        wanted.straight.structure(wanted.parameters),
        wanted.codes,
        wanted.widths,
        *(["back"] if wanted.back else []),
    )
    if key in _ready:
        return _ready[key]
    store = _store()
    name = hashlib.blake2b(
        repr((key, surroundings(), LEVEL[wanted.back], FLAGS, _version())).encode(), digest_size=20
    ).hexdigest()
    library = store.get(f"{name}.so") if store else None
    kept = library is not None
    if library is None:
        if not compile_it:
            return None
        library = _compiled(wanted)
        if library is not None and store is not None:
            store.put(f"{name}.so", library)
    code = None if library is None else _loaded(wanted, library)
    if code is None and kept:  # of another machine, although it has the same name: made anew
        library = _compiled(wanted)
        code = None if library is None else _loaded(wanted, library)
    _ready[key] = code
    return code


def _store() -> Store | None:
    folder = jax.config.values.get("jax_compilation_cache_dir")
    on = folder and jax.config.values.get("jax_enable_compilation_cache")
    return Store(Path(str(folder)) / "programs") if on else None


@lru_cache(maxsize=1)
def _compiler() -> list[str] | None:
    """The compiler and what its user adds to it, as make takes `$CC`: "ccache gcc", or one path that holds a space."""
    if os.environ.get("FIGAROH_JAX_MACHINE_CODE", "") == "0" or os.name == "nt":
        return None
    told = os.environ.get("CC") or "cc"
    try:
        words = [told] if shutil.which(told) else shlex.split(told)
    except ValueError:  # a quote that is not closed
        return None
    found = shutil.which(words[0]) if words else None
    return None if found is None else [found, *words[1:]]


@lru_cache(maxsize=1)
def _version() -> str:
    """What the compiler calls itself, and whatever decides about the code that it makes for this machine."""
    compiler = _compiler()
    if compiler is None:
        return ""
    info = os.stat(compiler[0])
    return f"{os.path.realpath(compiler[0])} {compiler[1:]} {info.st_size} {info.st_mtime_ns}"


def _compiled(wanted: _Wanted) -> bytes | None:
    """A shared library; None where the compiler fails."""
    return _built(_source(wanted), *LEVEL[wanted.back], *FLAGS)


def _built(source: str, *flags: str) -> bytes | None:
    """C of standard input as a shared library; None where there is no compiler or it fails."""
    compiler = _compiler()
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory(prefix="figaroh_jax_") as folder:
        out = Path(folder) / "code.so"
        try:
            subprocess.run(  # noqa: S603  (the user's own compiler, with source that is made here)
                [*compiler, "-o", str(out), *flags],
                input=source.encode(),
                check=True,
                capture_output=True,
                timeout=PATIENCE,
            )
            return out.read_bytes()
        except (OSError, subprocess.SubprocessError):
            return None


def is_gnu() -> bool:
    """Whether the compiler takes a level of optimisation at each function; clang knows none."""
    compiler = _compiler()
    return compiler is not None and "clang" not in os.path.realpath(compiler[0])


def library(source: str, *flags: str) -> ctypes.CDLL | None:
    """A file of C as a library in memory, compiled once and kept as robots' programs are; None where none is made."""
    flags = (*LIBRARY_FLAGS, *flags, "-x", "c", "-", "-lm")
    store = _store() if _compiler() is not None else None
    name = hashlib.blake2b(repr((source, surroundings(), flags, _version())).encode(), digest_size=20).hexdigest()
    code = store.get(f"{name}.so") if store else None
    if code is None:
        code = _built(source, *flags)
        if code is not None and store is not None:
            store.put(f"{name}.so", code)
    try:
        return None if code is None else _opened(code)
    except OSError:
        return None


def _loaded(wanted: _Wanted, library: bytes) -> _Code | None:
    try:
        handle = _opened(library)
        functions = tuple(handle[f"straight_{k}"] for k in range(int(handle["programs"]())))
        lanes = int(handle["lanes_of_a_block"]())
        complete = bool(handle["complete"]())
    except (OSError, AttributeError):
        return None
    for function in functions:
        function.restype = None
        function.argtypes = [ctypes.c_void_p] * wanted.pointers + [ctypes.c_size_t] * 2
    return _Code(functions, wanted.straight.answer(wanted.parameters), lanes, complete)


def _opened(library: bytes) -> ctypes.CDLL:
    """The library loaded from memory that only this process writes; a file stands for it where the system needs one."""
    if hasattr(os, "memfd_create"):
        handle = os.memfd_create("figaroh_jax")  # stays open: to the loader a name that it has seen is the same file
        with open(handle, "wb", closefd=False) as file:
            file.write(library)
        return ctypes.CDLL(f"/proc/self/fd/{handle}")
    with tempfile.TemporaryDirectory(prefix="figaroh_jax_") as folder:
        path = Path(folder) / "code.so"
        path.write_bytes(library)
        return ctypes.CDLL(str(path))


def _source(wanted: _Wanted) -> str:
    """C for all programs of a form: constants, arrays, answer, samples to do, samples of the whole answer."""
    straight, parameters, codes, widths, back = wanted
    parts, written = [_HEAD], set[int]()
    programs = straight.programs(parameters, codes)
    heads = "".join(f", const double *x{n}" for n in range(len(widths))) + back * ", const double *restrict given"
    for k, program in enumerate(programs):
        written_out = _Backwards(wanted, program) if back else _Writer(wanted, program)
        written |= set(written_out.places)
        parts.append(
            f"void straight_{k}(const double *restrict c{heads}, double *restrict out, size_t count, size_t total) {{\n"
            f"{written_out.text()}}}\n"
        )
    complete = len(written) == prod(straight.answer(parameters))
    parts += [f"int programs(void) {{ return {len(programs)}; }}\n"]
    parts += [f"int complete(void) {{ return {int(complete)}; }}\n"]
    return "".join(parts)


def _traced(wanted: _Wanted, program: Program) -> tuple[Any, list[tuple[int, int]], list[tuple[int, ...]]]:
    """The program as JAX's operations on single numbers: constants, then columns of the arrays; and what it writes."""
    arrays = sorted({one for group in wanted.straight.columns(wanted.parameters) for one in group})
    index, constants = {one: k for k, one in enumerate(arrays)}, len(wanted.codes)
    places: list[tuple[int, ...]] = []

    def numbers(*given: Any) -> list[Any]:
        table, read, out = given[:constants], given[constants:], []

        def write(entries: Iterable[tuple[tuple[int, ...], Number]]) -> None:
            for place, number in entries:
                places.append(place)
                out.append(jnp.full((), number.x, float) if number.known else number.x)

        reads = [lambda column, n=n: Number(read[index[n, column]]) for n in range(len(wanted.widths))]
        program(lambda k: table[k], reads, write)
        return out

    with jax.enable_x64(True):
        scalar = jax.ShapeDtypeStruct((), jnp.float64)
        return jax.make_jaxpr(numbers)(*[scalar] * (constants + len(arrays))).jaxpr, arrays, places


class _Writer:
    """One program as C, statement by statement; an answer is put aside as soon as it is known."""

    def __init__(self, wanted: _Wanted, program: Program) -> None:
        straight, parameters, codes, self.widths = wanted[:4]
        self.size, self.last = prod(straight.answer(parameters)), straight.last
        self.jaxpr, self.arrays, written = _traced(wanted, program)
        jaxpr = self.jaxpr
        self.names = {v: f"c[{k}]" for k, v in enumerate(jaxpr.invars[: len(codes)])}
        self.loads = dict(zip(jaxpr.invars[len(codes) :], self.arrays, strict=True))
        self.targets: list[tuple[Any, list[int]]] = []  # of each number that is asked for, its places in the answer
        self.places: list[int] = []  # in a sample's answer, of each number as it becomes known
        self.lines: list[str] = []
        assert straight.places is not None
        later: dict[Any, list[int]] = {}
        for variable, place in zip(jaxpr.outvars, written, strict=True):
            targets = list(straight.places(parameters, place))
            self.targets.append((variable, targets))
            if hasattr(variable, "val") or variable in self.names or variable in self.loads:
                self._put(f"(V){{}} + {self._operand(variable)}", targets)
            else:
                later.setdefault(variable, []).extend(targets)
        for equation in jaxpr.eqns:
            (result,) = equation.outvars
            operation = self._operation(equation.primitive.name, [self._operand(x) for x in equation.invars])
            name = self.names[result] = f"t{len(self.names)}"
            self.lines.append(f"{'V' if result.aval.dtype == jnp.float64 else 'I'} {name} = {operation};\n")
            self._put(name, later.get(result, []))

    def _operand(self, x: Any) -> str:
        if hasattr(x, "val"):
            return f"{int(x.val)}LL" if np.asarray(x.val).dtype.kind in "ib" else f"({float(x.val)!r})"
        if x not in self.names:
            array, column = self.loads[x]
            width = self.widths[array]
            name = self.names[x] = f"x{array}_{column}"
            self.lines.append(f"V {name} = lanes(x{array} + s * {width} + {column}, {width});\n")
        return self.names[x]

    def _put(self, value: str, targets: Sequence[int]) -> None:
        first = len(self.places)
        self.places += targets
        self.lines += [f"*(U *)(side + {first + k} * R + s - r) = {value};\n" for k in range(len(targets))]

    def _operation(self, kind: str, x: list[str]) -> str:
        if kind in _SIGNS:
            return f"(V){{}} + {x[0]} {_SIGNS[kind]} {x[1]}" if _plain(x) else f"{x[0]} {_SIGNS[kind]} {x[1]}"
        return _CALLS[kind].format(*x)

    def text(self) -> str:
        """The body of the function: rounds of R samples, a vector after the other, whose numbers then go out."""
        count, places = len(self.places), ", ".join(map(str, self.places))
        out = f"for (k = 0; k < {count}; k++) memcpy(out + place[k] * total + r, side + k * R, 8 * n);"
        if not self.last:
            to = f"out[(r + l) * {self.size} + place[k]] = side[k * R + l]"
            out = f"for (l = 0; l < n; l++) for (k = 0; k < {count}; k++) {to};"
        return (
            f"enum {{ R = {TOGETHER if self.last else 'W'} }};\nstatic const size_t place[] = {{{places}}};\n"
            f"double side[{count} * R] __attribute__((aligned(64)));\nsize_t r, s, k, l;\n"
            "for (r = 0; r < count; r += R) {\n"
            "if (r + R > count) r = count > R ? count - R : 0;\nconst size_t n = count < R ? count : R;\n"
            "for (s = r; s < r + n; s += W) {\nif (s + W > r + n) s = r + n - W;\n"
            f"{''.join(self.lines)}}}\n{out}\n}}\n"
        )


class _Backwards(_Writer):
    """The reverse of a program as C: behind its own statements, from the last one to the first, what each is worth.

    A number's worth is the derivative of the sum of the cotangent times the answers. It is followed through the numbers
    that depend on the arrays; wholes and choices between numbers have no derivative of their own.
    """

    def __init__(self, wanted: _Wanted, program: Program) -> None:
        super().__init__(wanted, program)
        self.worth: dict[Any, str] = {}
        moved = set(self.loads)
        for equation in self.jaxpr.eqns:
            of_arrays = any(not hasattr(x, "val") and x in moved for x in equation.invars)
            if of_arrays and equation.primitive.name not in _STILL:
                moved.update(equation.outvars)
        self.moved = moved
        for variable, targets in self.targets:
            for target in targets:
                self._add(variable, f"*(const U *)(given + {target} * total + s)")
        for equation in reversed(self.jaxpr.eqns):
            worth = self.worth.get(equation.outvars[0])
            if worth is not None:
                self._pull(equation, worth)
        for k, load in enumerate(self.loads):
            self.lines.append(f"*(U *)(out + {k} * total + s) = (V){{}} + {self.worth.get(load, '0.0')};\n")

    def _put(self, value: str, targets: Sequence[int]) -> None:
        """The answers themselves are not asked for."""

    def _add(self, variable: Any, part: str) -> None:
        if hasattr(variable, "val") or variable not in self.moved:
            return
        name = self.worth.get(variable)
        if name is None:
            name = self.worth[variable] = f"w{len(self.worth)}"
            self.lines.append(f"V {name} = {part};\n")
        else:
            self.lines.append(f"{name} += {part};\n")

    def _pull(self, equation: Any, worth: str) -> None:
        x, kind = equation.invars, equation.primitive.name
        if kind in ("add", "sub"):
            self._add(x[0], worth)
            self._add(x[1], worth if kind == "add" else f"-{worth}")
        elif kind == "mul":
            self._add(x[0], f"{worth} * {self._operand(x[1])}")
            self._add(x[1], f"{worth} * {self._operand(x[0])}")
        elif kind == "div":
            self._add(x[0], f"{worth} / {self._operand(x[1])}")
            self._add(x[1], f"-{worth} * {self.names[equation.outvars[0]]} / {self._operand(x[1])}")
        elif kind == "select_n":
            no = self._operand(x[0])
            self._add(x[1], f"choose({no}, {worth}, (V){{}})")
            self._add(x[2], f"choose({no}, (V){{}}, {worth})")
        else:
            self._add(x[0], {"neg": f"-{worth}", "broadcast_in_dim": worth}[kind])

    def text(self) -> str:
        """The body of the function: a vector after the other."""
        return (
            "size_t s;\nfor (s = 0; s < count; s += W) {\nif (s + W > count) s = count - W;\n"
            f"{''.join(self.lines)}}}\n"
        )


_STILL = ("floor", "convert_element_type", "and", "ne")  # whole numbers: no derivative
_SIGNS = {"mul": "*", "add": "+", "sub": "-", "div": "/"}
_CALLS = {
    "select_n": "choose({0}, {1}, {2})",
    "neg": "-({0} + (V){{}})",
    "floor": "down({0} + (V){{}})",
    "convert_element_type": "bits({0} + (V){{}})",
    "and": "{0} & {1}",
    "ne": "({0} != {1})",
    "broadcast_in_dim": "(V){{}} + {0}",
}


def _plain(operands: Sequence[str]) -> bool:
    """Whether no operand is a vector: then C would compute one number."""
    return all(x[0] in "c(" for x in operands)
