"""Identification of the recorded robots: cross-validated and held-out errors, and what it costs that links must exist.

For each recording the task of the tests is identified as a user would. Then the same condensed rows are fitted with
nothing but bodies and friction that dissipates (no prior), so that no robot that can exist has a smaller weighted sum
of squares; SCS, a first-order solver that shares nothing with Clarabel, solves the same problem through CVXPY.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
sys.path.insert(0, str(ROOT / "tests"))
VANISHING = 1e-9  # of the prior: what remains keeps masses finite that no torque shows


def identified(name: str, folder: Path) -> tuple[Any, Any]:
    """The identification of a task of `tests/real_tasks.py`, and the problem that it solved."""
    import real_tasks

    import figaroh_jax as fj
    from figaroh_jax.identification import identification

    options = {"gated": False} if name == "tx40_ungated" else {}
    file = getattr(real_tasks, f"{name.removesuffix('_ungated')}_task")(folder, DATA, **options)
    kept: list[Any] = []
    validate = identification._best
    identification._best = lambda problem, trust: kept.append(problem) or validate(problem, trust)
    try:
        return identification.identify_task(fj.load_task(file)), kept[0]
    finally:
        identification._best = validate


def best_robots(problem: Any) -> dict[str, np.ndarray]:
    """Parameters of the best robot of bodies: by our solver, by SCS, and with friction of any sign."""
    from figaroh_jax.estimation.consistency import physical_fit
    from figaroh_jax.estimation.least_squares import with_prior

    factor = with_prior(
        problem.data.factor(problem.weight), problem.mean, VANISHING * problem.inflation * problem.precision
    )
    return {
        "Clarabel": physical_fit(factor, problem.links, problem.bounded),
        "SCS": by_scs(factor, problem),
        "Clarabel, drives of any sign": physical_fit(factor, problem.links),
    }


def by_scs(factor: np.ndarray, problem: Any) -> np.ndarray:
    """The same convex problem written anew for CVXPY and SCS."""
    cp: Any = importlib.import_module("cvxpy")  # not among the project's dependencies: `pip install cvxpy`

    from figaroh_jax.rigid.inertia import pseudo_inertia

    scale = np.ones(factor.shape[1] - 1)
    for body in problem.links:
        scale[list(body.columns)] = body.mass * body.length ** np.array([0.0, *[1.0] * 3, *[2.0] * 6])
    R = np.asarray(np.linalg.qr(factor, mode="r"))
    unit = np.linalg.norm(R[:, -1])
    x = cp.Variable(len(scale))
    limits = []
    for body in problem.links:
        turn = np.diag([1 / body.length] * 3 + [1.0]) / np.sqrt(body.mass)
        parts = [turn @ pseudo_inertia(e) @ turn for e in np.eye(10)]
        limits.append(sum(x[k] * scale[k] * part for k, part in zip(body.columns, parts, strict=True)) >> 0)
    drives = np.flatnonzero(np.isfinite(problem.bounded))
    limits.append(x[drives] >= problem.bounded[drives])
    question = cp.Problem(cp.Minimize(cp.sum_squares((R[:, :-1] * scale / unit) @ x - R[:, -1] / unit)), limits)
    question.solve(solver=cp.SCS, eps=1e-7, max_iters=200_000)
    return np.asarray(x.value) * scale


def pooled(rms: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.asarray(rms) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("names", nargs="*", default=["tx40", "tx40_ungated", "tiago", "panda", "ur10e"])
    jax.config.update("jax_enable_x64", True)
    for name in parser.parse_args().names:
        start = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            found, problem = identified(name, Path(folder))
        free = pooled(found.unconstrained.rms)
        print(
            f"{name}: rank {found.rank} of {found.structural_rank}, {time.process_time() - start:.1f} CPU s", flush=True
        )
        print(f"  RMSE unconstrained {free:.4f}, cross-validated {pooled(found.validated.rms):.4f}")
        print(
            f"  physical, nominal believed within {100 * found.trust:.0f} %: {pooled(found.fit.rms) / free:.4f} times"
        )
        weight = problem.weight
        least = problem.data.squares(problem_start(problem)) @ weight
        for solver, theta in best_robots(problem).items():
            ratio, cost = pooled(problem.data.rms(theta)) / free, np.sqrt(problem.data.squares(theta) @ weight / least)
            print(f"  best robot of bodies, {solver}: {ratio:.4f} times, weighted {cost:.5f}", flush=True)
        for file, quality in found.holdout.items():
            print(f"  held out {file}: {pooled(quality.rms):.4f}, R2 {np.round(quality.r2, 4)}", flush=True)


def problem_start(problem: Any) -> np.ndarray:
    """The weighted fit of the base parameters alone."""
    from figaroh_jax.estimation.least_squares import solve

    return solve(problem.data, weight=problem.weight, kept=problem.base.independent).parameters


if __name__ == "__main__":
    main()
