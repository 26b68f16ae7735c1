"""Throughput on an accelerator, and that it gives the numbers of the CPU.

    PYTHONPATH=. python benchmarks/gpu.py ROBOT.urdf ... [--tree N] [--ways] [--only WORD ...] [--gpus 0 1]
        [--at-once N] [--out FILE]

Inverse and forward dynamics, mass matrix and regressor (dense, packed; normal matrix and triangular factor, both with
torque) in float64, and the kernels in float32 too. Each function of each robot is a process of its own, begun in the
order of the goals of this library; several are compiled at once, one at a time runs on a GPU. Every figure is printed,
and added to FILE as a line of JSON, as soon as it is taken, so that what is cut off has told what it knew.

A process puts the states on the device, traces and compiles (told apart), compares the first 1000 answers with those of
a process that sees the CPU alone, and calls until half a second has passed: the best call counts ("in a program"); ten
calls that are waited for together are told beside ("in a row"). Two more call the public function as it is ("called"),
for the time of the first call without kept programs and with those that the one before kept. The robot is known when
the function is compiled; "argument" says where it is an argument of the program. `--ways` are other ways to the
triangular factor: columns divided by an inverse in place of a solve, three turns of that, rows of the dense regressor
by QR. `--tree N` adds a random tree of N joints, turning and sliding, its axes and placements at any angle.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

CHECKED = 1000  # samples that are compared with the CPU's
LONGEST = 170.0  # seconds that a process of a function may take with all its compilation
# function: samples for a robot of up to ten joints and for a larger one; in the order of what is to be known first
CASES = {
    "normal matrix": (1 << 22, 1 << 19),
    "triangular factor": (1 << 20, 1 << 17),
    "inverse dynamics": (1 << 22, 1 << 20),
    "packed regressor": (1 << 22, 1 << 17),
    "forward dynamics": (1 << 21, 1 << 17),
    "mass matrix": (1 << 21, 1 << 18),
    "dense regressor": (1 << 20, 1 << 15),
    "inverse dynamics float32": (1 << 22, 1 << 20),
    "packed regressor float32": (1 << 22, 1 << 18),
    "mass matrix float32": (1 << 21, 1 << 18),
    "forward dynamics float32": (1 << 21, 1 << 17),
    "inverse dynamics argument": (1 << 22, 1 << 20),
}
WAYS = {f"triangular factor, {way}": CASES["triangular factor"] for way in ("inverse", "three turns", "QR")}
_PUBLIC = (
    "inverse dynamics",
    "forward dynamics",
    "mass matrix",
    "packed regressor",
    "dense regressor",
    "normal matrix",
    "triangular factor",
)
STAGES = {
    "in a program": (*CASES, *WAYS),
    "called, none kept": _PUBLIC,
    "called, kept": _PUBLIC,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robots", type=Path, nargs="*", metavar="ROBOT.urdf")
    parser.add_argument("--tree", type=int, help="joints of a random tree that is timed too")
    parser.add_argument("--ways", action="store_true", help="other ways to the triangular factor, alone")
    parser.add_argument("--only", nargs="+", default=[""], help="functions, or words that their names hold")
    parser.add_argument("--gpus", nargs="+", default=["0"], help="as CUDA_VISIBLE_DEVICES tells them")
    parser.add_argument("--at-once", type=int, default=8, help="processes that compile beside each other")
    parser.add_argument("--samples", type=int, help="in place of each function's own number")
    parser.add_argument("--out", type=Path, help="file to which each figure is added as a line of JSON")
    parser.add_argument("--child", nargs=3, metavar=("FUNCTION", "FOLDER", "STAGE"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        name, own, stage = options.child
        _child(options.robots[0], name, own, stage, options.samples)
        return
    gpus = cycle(options.gpus)
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.at_once) as pool:
        if options.tree:
            options.robots.append(_tree(options.tree, Path(folder) / f"tree{options.tree}.urdf"))
        jobs = [
            (robot, name, next(gpus))
            for name in (WAYS if options.ways else CASES)
            for robot in options.robots
            if name in options.only or any(word in name for word in options.only if word not in CASES)
        ]
        list(pool.map(lambda job: _case(*job, folder=Path(folder), options=options), jobs))


def _tree(joints: int, file: Path) -> Path:
    """A random tree of so many joints; each hangs on one of the five links before it."""
    random, parts = np.random.default_rng(0), []

    def three(size: float) -> str:
        return " ".join(f"{x:.4f}" for x in random.uniform(-size, size, 3))

    for k in range(joints + 1):
        xx, yy, zz = random.uniform(0.02, 0.03, 3)
        parts.append(
            f'<link name="l{k}"><inertial><origin xyz="{three(0.1)}" rpy="{three(1.5)}"/><mass value="1.5"/>'
            f'<inertia ixx="{xx:.4f}" iyy="{yy:.4f}" izz="{zz:.4f}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        )
        if k:
            kind = "prismatic" if random.random() < 0.1 else "revolute"
            parts.append(
                f'<joint name="j{k}" type="{kind}"><parent link="l{random.integers(max(0, k - 5), k)}"/><child'
                f' link="l{k}"/><origin xyz="{three(0.3)}" rpy="{three(1.5)}"/><axis xyz="{three(1.0)}"/>'
                '<limit lower="-2" upper="2" velocity="3" effort="40"/></joint>'
            )
    file.write_text(f'<robot name="tree{joints}">{"".join(parts)}</robot>', encoding="utf-8")
    return file


def _case(robot: Path, name: str, gpu: str, folder: Path, options: argparse.Namespace) -> None:
    """Processes of one function: the CPU's answers beside its compilation, then again with what it kept."""
    own = folder / f"{robot.stem} {name} {gpu}"
    own.mkdir()
    command = [sys.executable, __file__, str(robot), "--samples", str(options.samples or 0), "--child", name, str(own)]
    here = os.environ | {"XDG_CACHE_HOME": str(own), "CUDA_VISIBLE_DEVICES": gpu}
    here["XLA_PYTHON_CLIENT_PREALLOCATE"] = "false"
    cpu = subprocess.Popen([*command, "cpu"], env=here | {"JAX_PLATFORMS": "cpu"})
    for stage in STAGES if name in STAGES["called, kept"] else list(STAGES)[:1]:
        try:
            done = subprocess.run([*command, stage], env=here, timeout=LONGEST, capture_output=True, text=True)
            found = (
                done.stdout.splitlines()[-1]
                if done.returncode == 0
                else json.dumps({"failed": f"status {done.returncode} {done.stderr[-600:]}"})
            )
        except subprocess.TimeoutExpired:
            found = json.dumps({"failed": f"not done in {LONGEST:.0f} s"})
        _tell({"robot": robot.stem, "function": name, "programs": stage, "gpu": gpu, **json.loads(found)}, options.out)
        if "failed" in found:
            break
    cpu.wait()


def _tell(row: dict[str, Any], out: Path | None) -> None:
    print(
        f"{row['robot']:14} {row['function']:26} {row['programs']:17}",
        f"failed: {row['failed']}"
        if "failed" in row
        else f"{row['samples']:8d} samples {row['rate']:10.2f} M/s; first call {row['first']:6.2f} s"
        f" (traced {row['traced']:.2f}, compiled {row['compiled']:.2f}); {row['difference']:.1e} from the CPU;"
        f" peak {row['peak'] / 1e9:.2f} GB" + (f"; {row['in a row']:.2f} M/s in a row" if "in a row" in row else ""),
        flush=True,
    )
    if out is not None:
        with out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")


def _child(robot: Path, name: str, folder: str, stage: str, samples: int) -> None:
    import jax

    import figaroh_jax as fj
    from figaroh_jax.compiled.executable_cache import keep_programs

    jax.config.update("jax_enable_x64", True)
    model = fj.load_urdf(robot)
    reference = Path(folder) / "cpu.npz"
    if stage == "cpu":
        found = _answer(jax.jit(_function(model, name))(*_states(model, name, CHECKED)), name)
        np.save(reference.with_suffix(".tmp.npy"), found)
        reference.with_suffix(".tmp.npy").replace(reference)
        return
    if stage.startswith("called"):
        keep_programs()
    samples = samples or (CASES | WAYS)[name][model.nv > 10]
    jax.block_until_ready(jax.device_put(np.zeros(8)) + 1.0)  # the device is there and has run something
    if stage.startswith("called"):
        print(json.dumps(_called(model, name, samples)))
        return
    types = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in _states(model, name, samples, lengths_alone=True)]
    begin = time.perf_counter()
    lowered = jax.jit(_function(model, name)).lower(*types)
    traced = time.perf_counter() - begin
    function = lowered.compile()
    compiled = time.perf_counter() - begin - traced
    state = _states(model, name, samples)
    with _alone():
        state = [jax.block_until_ready(jax.device_put(x)) for x in state]
        begin = time.perf_counter()
        found = jax.block_until_ready(function(*state))
        first = time.perf_counter() - begin + traced + compiled
        row = {"samples": samples, "first": first, "traced": traced, "compiled": compiled}
        if _sums(name):  # the same program, of which the first samples alone count
            found = function(*state[:-1], state[-1].at[CHECKED:].set(0.0))
        sample = _first_samples(found, name)
        del found
        best, row["in a row"] = _best(function, state), samples / _in_a_row(function, state) / 1e6
        peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
    row |= {"rate": samples / best / 1e6, "peak": peak, "device": jax.devices()[0].device_kind, "jax": jax.__version__}
    print(json.dumps(row | {"difference": _difference(sample, reference)}))


def _called(model: Any, name: str, samples: int) -> dict[str, Any]:
    """The public function called as it is, first and then."""
    import jax

    function, state = _function(model, name), _states(model, name, samples)
    with _alone():
        state = [jax.block_until_ready(jax.device_put(x)) for x in state]
        begin = time.perf_counter()
        jax.block_until_ready(function(*state))
        first = time.perf_counter() - begin
        rate = samples / _best(function, state) / 1e6
        peak = (jax.devices()[0].memory_stats() or {}).get("peak_bytes_in_use", 0)
    nothing = dict.fromkeys(("traced", "compiled", "difference"), -1.0)
    return {"samples": samples, "first": first, "rate": rate, "peak": peak, **nothing}


def _difference(found: Any, reference: Path) -> float:
    """Largest difference from the CPU's answers, over the largest number."""
    while not reference.exists():
        time.sleep(0.2)
    cpu = np.load(reference)
    return float(np.abs(found - cpu).max() / np.abs(cpu).max())


def _sums(name: str) -> bool:
    """Whether it is over all samples: then it is told weights, too."""
    return name.startswith(("normal matrix", "triangular factor"))


def _function(model: Any, name: str) -> Callable[..., Any]:
    """The function of (q, v, a), for accelerations of (q, v, tau), for sums of (q, v, a, weight)."""
    import figaroh_jax as fj
    from figaroh_jax.compiled.kernels import straight_answers
    from figaroh_jax.rigid import dynamics, regressor

    known = {
        "inverse dynamics": fj.inverse_dynamics,
        "forward dynamics": fj.forward_dynamics,
        "mass matrix": lambda model, q, v, a: fj.mass_matrix(model, q),
        "packed regressor": fj.packed_regressor,
        "dense regressor": fj.joint_torque_regressor,
        "normal matrix": lambda model, q, v, a, weight: fj.normal_matrix(model, q, v, a, tau=a, weight=weight),
        "triangular factor": lambda model, q, v, a, weight: fj.triangular_factor(model, q, v, a, tau=a, weight=weight),
    }
    kernels = {
        "inverse dynamics float32": lambda *x: straight_answers(dynamics._TORQUES, model, *x),
        "packed regressor float32": lambda *x: straight_answers(regressor._PACKED, model, *x),
        "mass matrix float32": lambda q, v, a: straight_answers(dynamics._MASSES, model, q),
        "forward dynamics float32": lambda *x: straight_answers(dynamics._ACCELERATIONS, model, *x),
    }
    if name in kernels:
        return kernels[name]
    if name == "inverse dynamics argument":
        nothing = dynamics._TORQUES.nothing_known(model)
        return lambda *x: straight_answers(dynamics._TORQUES, model, *x, codes=nothing)
    public, _, way = name.partition(", ")
    if way:
        _take(way)
    return partial(known[public], model)


def _take(way: str) -> None:
    """Another way to the triangular factor on a GPU than the library's."""
    import jax
    import jax.numpy as jnp

    from figaroh_jax.rigid import normal_equations as own

    if way == "QR":
        own.usable = lambda *arrays: False
        return

    def inverse(rows: Any, factor: Any) -> Any:
        unit = jnp.broadcast_to(jnp.eye(factor.shape[-1]), factor.shape)
        divided = jax.lax.linalg.triangular_solve(factor, unit, left_side=True, lower=False, transpose_a=True)
        letters = "ckl,cpls->cpks" if rows.ndim > 3 else "ckl,cls->cks"
        return jnp.einsum(letters, divided, rows, precision=jax.lax.Precision.HIGHEST)

    def turns(total: Any, rows: Any) -> Any:
        before, factor = jnp.swapaxes(total, 1, 2), None
        for turn in range(3 if way == "three turns" else 2):
            new = own._shifted_factor(own.row_products(before) + own._products(rows), own.SHIFTS[min(turn, 1)])
            before, rows = inverse(before, new), inverse(rows, new)
            factor = new if factor is None else jnp.matmul(new, factor, precision=jax.lax.Precision.HIGHEST)
        return factor

    own._with_factor = turns


def _states(model: Any, name: str, samples: int, lengths_alone: bool = False) -> list[np.ndarray]:
    """q, v, a (and weights) of which the first thousand are the same for all numbers; in the function's precision."""
    dtype = np.float32 if "float32" in name else np.float64
    if lengths_alone:
        return [np.broadcast_to(dtype(0), (samples, model.nv))] * (4 if _sums(name) else 3)
    random = np.random.default_rng(0)
    checked = [random.uniform(-1.5, 1.5, (CHECKED, model.nv)) for _ in range(3)]
    rest = [random.random((max(0, samples - CHECKED), model.nv), np.float32) * 3.0 - 1.5 for _ in range(3)]
    states = [np.concatenate([x, y]).astype(dtype)[:samples] for x, y in zip(checked, rest, strict=True)]
    return [*states, np.ones((samples, model.nv))] if _sums(name) else states


def _first_samples(found: Any, name: str) -> np.ndarray:
    if _sums(name):
        return _answer(found, name)
    return _answer(found[..., :CHECKED] if name.startswith("packed") else found[:CHECKED], name)


def _answer(found: Any, name: str) -> np.ndarray:
    """All numbers; of a factor those of its products, since what no sample moves may stand in it anyhow."""
    import jax

    if name.startswith("triangular factor"):
        found = np.asarray(found).T @ np.asarray(found)
    return np.concatenate([np.ravel(np.asarray(x, np.float64)) for x in jax.tree.leaves(found)])


def _best(function: Callable[..., Any], state: list[Any]) -> float:
    """Seconds of the fastest call."""
    import jax

    seconds, begin = [], time.perf_counter()
    while len(seconds) < 3 or time.perf_counter() - begin < 0.5:
        start = time.perf_counter()
        jax.block_until_ready(function(*state))
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def _in_a_row(function: Callable[..., Any], state: list[Any], calls: int = 10) -> float:
    """Seconds of a call among several that are waited for together, so that the host's share hides behind them.

    The best of three rounds: memory for two answers is found in the first.
    """
    import jax

    rounds = []
    for _ in range(3):
        found, start = None, time.perf_counter()
        for _ in range(calls):
            found = function(*state)  # the one before is given back
        jax.block_until_ready(found)
        rounds.append((time.perf_counter() - start) / calls)
    return min(rounds)


@contextmanager
def _alone() -> Iterator[None]:
    """Alone on this GPU among the processes of this benchmark."""
    import fcntl

    name = f"figaroh_jax_gpu_{os.environ.get('CUDA_VISIBLE_DEVICES', '')}.lock"
    with (Path(tempfile.gettempdir()) / name).open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


if __name__ == "__main__":
    main()
