"""The regressor against its peers: CPU time on one core in float64, compile time and peak memory, in one run.

Ours (dense, packed, streaming normal matrix) against Pinocchio's `computeJointTorqueRegressor` in a Python loop and
FIGAROH 1.0.2's builder. FIGAROH gets an environment of its own, which the script makes in the cache folder of the
repository; each library works in one process, all on the same core, and a round asks each in turn. Ratios are taken
within a round and their median with minimum and maximum is told. The robots' URDF come from FIGAROH_JAX_DATA.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
FIGAROH = "1.0.2"
ROBOTS = {
    "UR10e": "ur10e_innopolis/ur10e.urdf",
    "Panda": "panda_gaz2019/panda.urdf",
    "TALOS": "talos_contact/talos_full_v2.urdf",
}
LOCKED = ("panda_finger_joint1", "panda_finger_joint2")
OURS, PEERS = ("dense", "packed", "streaming"), ("pinocchio", "figaroh", "figaroh+drives")
LIMIT = 4e9  # bytes that one answer may take
ONE_THREAD = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "JAX_PLATFORMS": "cpu",
    "JAX_COMPILATION_CACHE_DIR": "",
    "PYTHONPATH": str(ROOT),
}


def work() -> None:
    """Answer requests (JSON lines) with our own regressor; the first answer to a method includes its compilation."""
    import jax
    import numpy as np

    from figaroh_jax.compiled.executable_cache import keep_programs
    from figaroh_jax.formats.urdf import load_urdf
    from figaroh_jax.rigid.normal_equations import normal_matrix
    from figaroh_jax.rigid.regressor import joint_torque_regressor, packed_regressor

    if "XDG_CACHE_HOME" in os.environ:
        keep_programs()
    methods: dict[str, Any] = {
        "dense": joint_torque_regressor,
        "packed": packed_regressor,
        "streaming": lambda model, q, v, a: normal_matrix(model, q, v, a, tau=a),
    }
    print(json.dumps({"jax": version("jax"), "numpy": version("numpy")}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        model = load_urdf(request["path"], joints=request["joints"])
        state = np.random.default_rng(0).standard_normal((3, request["samples"], model.nv))
        jax.block_until_ready(jax.numpy.zeros(1) + 1)  # JAX itself is up
        start = time.process_time()
        answer = jax.block_until_ready(methods[request["method"]](model, *state))
        cpu = time.process_time() - start
        peak = peak_mb()
        norm = squared_norm(request["method"], answer) ** 0.5
        del answer
        print(json.dumps({"cpu": cpu, "norm": norm, "peak_mb": peak}), flush=True)


def peak_mb() -> float:
    """Peak resident memory of this process (ru_maxrss would inherit the peak of the one that started it)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def squared_norm(method: str, answer: Any) -> float:
    """Sum of the squares of all entries of W, which no order of rows or columns changes."""
    import numpy as np

    if method == "streaming":
        return float(np.trace(answer.matrix))
    W = np.asarray(answer).ravel()
    return float(W @ W)


class Worker:
    """A process on one core that answers requests."""

    def __init__(self, command: list[str], core: int, kept: str | None = None) -> None:
        environment = {k: v for k, v in os.environ.items() if k != "XDG_CACHE_HOME"} | ONE_THREAD
        environment |= {"XDG_CACHE_HOME": kept} if kept else {}
        pinned = ["taskset", "-c", str(core), *command]
        self.process = subprocess.Popen(
            pinned, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )
        self.versions = self.read()

    def read(self) -> dict[str, Any]:
        assert self.process.stdout
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"{self.process.args} ended with status {self.process.wait()}")
        return json.loads(line)

    def ask(self, method: str, path: str, joints: list[str], samples: int) -> dict[str, float]:
        assert self.process.stdin
        request = {"method": method, "path": path, "joints": joints, "samples": samples}
        print(json.dumps(request), file=self.process.stdin, flush=True)
        return self.read()

    def close(self) -> None:
        assert self.process.stdin
        self.process.stdin.close()
        self.process.wait()


def environment() -> str:
    """Python of an environment with FIGAROH in it, made at the first run."""
    folder = ROOT / ".cache" / f"figaroh-{FIGAROH}"
    python = folder / "bin" / "python"
    if not (folder / "complete").exists():
        print(f"installing figaroh {FIGAROH} in {folder}", file=sys.stderr)
        subprocess.run([sys.executable, "-m", "venv", "--clear", folder], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", f"figaroh=={FIGAROH}"], check=True)
        (folder / "complete").touch()
    return str(python)


def spread(values: list[float]) -> dict[str, float]:
    return {"median": median(values), "min": min(values), "max": max(values)}


def bytes_of(method: str, robot: dict[str, int], samples: int) -> float:
    """Size of the method's answer."""
    rows, links = robot["nv"], robot["links"]
    columns = {"packed": 10 * robot["pairs"] / rows, "figaroh+drives": 14 * links, "streaming": 0}
    return 8.0 * samples * rows * columns.get(method, 10 * links)


class Bench:
    """The commands that start a worker of each kind, and the core on which all of them run."""

    def __init__(self, figaroh: str, core: int) -> None:
        peers = [figaroh, "-W", "ignore", str(ROOT / "benchmarks" / "peer_regressor.py")]
        self.command = {m: peers for m in PEERS} | {m: [sys.executable, __file__, "--worker"] for m in OURS}
        self.core = core

    def fresh(self, method: str, *request: Any, kept: str | None = None) -> dict[str, float]:
        """Answer of a process that has done nothing before, with the programs that others kept in a folder."""
        worker = Worker(self.command[method], self.core, kept)
        answer = worker.ask(method, *request)
        worker.close()
        return answer

    def case(self, path: str, joints: list[str], sizes: dict[str, int], samples: int, rounds: int) -> dict[str, Any]:
        """CPU time in interleaved rounds, and peak memory of a fresh process, of each method that fits in memory."""
        big = {m: bytes_of(m, sizes, samples) for m in (*OURS, *PEERS)}
        methods = [m for m in (*OURS, *PEERS) if big[m] <= LIMIT]
        workers = {kind: Worker(self.command[kind], self.core) for kind in (OURS[0], PEERS[0])}
        of = {m: workers[OURS[0] if m in OURS else PEERS[0]] for m in methods}
        warm = {m: of[m].ask(m, path, joints, samples) for m in methods}
        taken = [{m: of[m].ask(m, path, joints, samples)["cpu"] for m in methods} for _ in range(rounds)]
        norms = [warm[m]["norm"] for m in methods if m != "figaroh+drives"]
        assert max(norms) - min(norms) < 1e-9 * max(norms), f"the regressors differ: {norms}"
        for worker in workers.values():
            worker.close()
        return {
            "samples": samples,
            "us_per_sample": {m: spread([1e6 * r[m] / samples for r in taken]) for m in methods},
            "times_faster_than": {
                p: {m: spread([r[p] / r[m] for r in taken]) for m in OURS if m in methods}
                for p in PEERS
                if p in methods
            },
            "peak_mb": {m: self.fresh(m, path, joints, samples)["peak_mb"] for m in methods},
            "skipped": {m: f"its answer takes {big[m] / 1e9:.1f} GB" for m in big if m not in methods},
        }


def machine() -> dict[str, str]:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    name = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), platform.processor())
    load = " ".join(f"{x:.1f}" for x in os.getloadavg())
    return {"cpu": f"{os.cpu_count()} x {name}", "load_at_start": load, "python": platform.python_version()}


def tell(robot: str, case: dict[str, Any]) -> None:
    """Rows of the table: a method each."""
    for m, time_taken in case["us_per_sample"].items():
        ratios = []
        for p in PEERS:
            ratio = case["times_faster_than"].get(p, {}).get(m)
            ratios.append(f"{ratio['median']:6.1f} [{ratio['min']:5.1f}, {ratio['max']:5.1f}]" if ratio else " " * 22)
        print(
            f"{robot:6} {case['samples']:7} {m:14} {time_taken['median']:9.2f} "
            f"[{time_taken['min']:.2f}, {time_taken['max']:.2f}]".ljust(58),
            f"{case['peak_mb'][m]:7.0f} ",
            "  ".join(ratios).rstrip(),
        )
    for m, why in case["skipped"].items():
        print(f"{robot:6} {case['samples']:7} {m:14} skipped: {why}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a thousand samples, three rounds")
    parser.add_argument("--samples", type=int, nargs="+", help="sample counts (default 1000 10000 100000)")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=list(ROBOTS), help="default all")
    parser.add_argument("--rounds", type=int, help="interleaved rounds (default 9)")
    parser.add_argument("--core", type=int, default=max(os.sched_getaffinity(0)), help="core on which all run")
    parser.add_argument("--figaroh", metavar="PYTHON", help="interpreter of an environment that has figaroh")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures here")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        return work()
    if not DATA.is_dir():
        raise SystemExit(f"no robots in {DATA} (FIGAROH_JAX_DATA names the folder)")
    from figaroh_jax.formats.urdf import load_urdf
    from figaroh_jax.rigid.regressor import pairs

    rounds = options.rounds or (3 if options.quick else 9)
    bench = Bench(options.figaroh or environment(), options.core)
    told = machine()
    for kind in (OURS[0], PEERS[0]):
        worker = Worker(bench.command[kind], options.core)
        told |= worker.versions
        worker.close()
    print(f"{told}; {rounds} rounds on core {options.core}; float64; medians [min, max] over the rounds\n")
    cases, compile_time = {}, {}
    print("CPU s of the first call, 1000 samples, in a fresh process: without cache, and with kept programs")
    for name in options.robots:
        path = str(DATA / ROBOTS[name])
        joints = [j for j in load_urdf(path).joint_names if j not in LOCKED]
        compile_time[name] = {
            m: spread([bench.fresh(m, path, joints, 1000)["cpu"] for _ in range(min(3, rounds))]) for m in OURS
        }
        with tempfile.TemporaryDirectory() as folder:
            kept = {m: [bench.fresh(m, path, joints, 1000, kept=folder)["cpu"] for _ in range(4)][1:] for m in OURS}
        for what, times in {"": compile_time[name], "kept": {m: spread(x) for m, x in kept.items()}}.items():
            told_times = (f"{m} {x['median']:.2f} [{x['min']:.2f}, {x['max']:.2f}]" for m, x in times.items())
            print(f"{name:6} {what:5}", "  ".join(told_times), flush=True)
    print(f"\n{'robot  samples method         us a sample, CPU':58} peak MB ", *(f"times faster: {p:9}" for p in PEERS))
    for name in options.robots:
        path = str(DATA / ROBOTS[name])
        joints = [j for j in load_urdf(path).joint_names if j not in LOCKED]
        model = load_urdf(path, joints=joints)
        sizes = {"nv": model.nv, "links": len(model.joints), "pairs": len(pairs(model))}
        cases[name] = []
        for samples in options.samples or ([1_000] if options.quick else [1_000, 10_000, 100_000]):
            cases[name].append(bench.case(path, joints, sizes, samples, rounds))
            tell(name, cases[name][-1])
            sys.stdout.flush()
    if options.json:
        answer = {"machine": told, "rounds": rounds, "first_call_cpu_s": compile_time, "cases": cases}
        options.json.write_text(json.dumps(answer, indent=1) + "\n")


if __name__ == "__main__":
    main()
