"""The public `fit` on real sets: optimistix's Levenberg-Marquardt beside the block-wise solver, and a torque set.

    python benchmarks/fit.py [talos] [tiago] [tx40]

Recordings from $FIGAROH_JAX_DATA. For each set and level: numbers that are free, rank, error (mm, per measured point),
steps, and CPU seconds of a cold fit (compilation included, no cache) and of the fastest of three warm ones; then how
far the two solvers' costs are apart. `tx40`: base parameters of the linear fit, of the engine's own and of `fit`.
"""

from __future__ import annotations

import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optimistix

import figaroh_jax as fj

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

OFFSETS = {"joint_offset": True, "frames": True}
FULL = {"joint_offset": True, "link_geometry": True, "frames": True}
SOLVERS = {
    "block-wise": fj.BlockLevenbergMarquardt(),
    "optimistix": optimistix.LevenbergMarquardt(rtol=1e-12, atol=1e-12),
}


def sets() -> dict[str, tuple[fj.RobotModel, tuple[fj.PoseData, ...]]]:
    """Models and postures of TALOS and TIAGo, as `benchmarks/calibration.py` reads them."""
    import calibration

    out = {}
    for name, load in (("talos", calibration.talos), ("tiago", calibration.tiago)):
        model, recordings = load()
        points = [replace(one, values=calibration.points_of(one.values)) for one in recordings]
        out[name] = model, fj.pose_data(model, points)
    return out


def millimetres(found: fj.Fit) -> float:
    """Root mean square distance of the measured points."""
    return float(1e3 * np.sqrt(np.sum(np.asarray(found.rows) ** 2) / (len(found.rows) / 3)))


def calibrated(name: str, model: fj.RobotModel, data: Any, level: str, free: dict[str, bool]) -> dict[str, fj.Fit]:
    """Both solvers on one set, told."""
    found = {}
    for solver, method in SOLVERS.items():
        seconds = []
        for _ in range(4):
            start = time.process_time()
            found[solver] = fj.fit(model, data, free, solver=method, max_steps=3000)
            jax.block_until_ready(found[solver].values)
            seconds.append(time.process_time() - start)
        one = found[solver]
        print(
            f"{name} {level} {solver}: {len(one.values)} free, rank {int(one.rank)}, {millimetres(one):.4f} mm,"
            f" {int(one.stats['num_steps'])} steps, cold {seconds[0]:.2f} s, warm {min(seconds[1:]):.3f} s,"
            f" {'converged' if one.result == optimistix.RESULTS.successful else 'NOT converged'}",
            flush=True,
        )
    costs = [float(one.cost) for one in found.values()]
    print(f"    costs apart by {abs(costs[0] - costs[1]) / costs[0]:.1e}")
    return found


def tx40(data_dir: Path, folder: Path) -> tuple[Any, ...]:
    """The TX40's friction model, data, basis, and base parameters in three ways: engine, `fit_linear`, `fit`."""
    import real_tasks

    from figaroh_jax.estimation.columns import friction_terms, structural_columns
    from figaroh_jax.estimation.least_squares import WeightedByJoint, solve
    from figaroh_jax.estimation.regression import Regression, condense
    from figaroh_jax.recordings.signals import prepare_all
    from figaroh_jax.simulators.native import as_backend

    task = fj.load_task(real_tasks.tx40_task(folder, data_dir, gated=False))
    robot, recordings = fj.load_robot(task), fj.read_recordings(task, fj.load_robot(task))
    names = ("viscous_friction", "coulomb_friction", "rotor_inertia", "torque_offset")
    effects = [fj.place(fj.CATALOGUE[name], robot, [joint]) for name in names for joint in robot.joint_names]
    coupled = fj.place(fj.CATALOGUE["coupled_transmission"], robot, robot.joint_names[4:])
    model = fj.extend(robot, *effects, coupled)
    data = fj.torque_data(model, recordings, task.preprocess)
    basis = fj.linear_basis(model, data)
    linear = fj.fit_linear(model, data, basis)
    with jax.enable_x64(True):
        signals = prepare_all(recordings, task.preprocess, band=None, model=robot, sticks=False)
        terms = friction_terms(robot, task.baseline)
        regression = Regression(as_backend(robot), terms, np.zeros(robot.nv), signals)
        used = np.abs(structural_columns(robot, terms)).max(axis=0) > 0
        engine = solve(condense(regression, used), WeightedByJoint(60, 1e-10), kept=np.array(basis.kept))
    weighted = fj.torque_data(model, recordings, task.preprocess, noise=np.asarray(linear.rms))
    own = fj.fit(model, weighted, ("inertia", "effects"), solver=SOLVERS["optimistix"])
    return model, data, basis, linear, engine, own


def main(*which: str) -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    known = sets() if not which or {"talos", "tiago"} & set(which) else {}
    for name, (model, data) in known.items():
        if not which or name in which:
            calibrated(name, model, data, "offsets", OFFSETS)
            calibrated(name, model, data, "full", FULL)
    if not which or "tx40" in which:
        import calibration

        with tempfile.TemporaryDirectory() as folder:
            model, _, basis, linear, engine, own = tx40(calibration.DATA, Path(folder))
        start = np.concatenate([np.asarray(model.robot.inertia).reshape(-1), np.zeros(len(own.values))])
        whole = start[: len(own.values)] + np.asarray(own.values)
        mine, size = np.asarray(linear.values), np.abs(np.asarray(linear.values)).max()
        theirs = engine.parameters[list(basis.kept)]
        print(f"tx40: rank {len(basis.names)}, engine {np.abs(theirs - mine).max() / size:.1e}")
        print(f"tx40: fit {np.abs(basis.matrix @ whole - mine).max() / size:.1e}, {int(own.stats['num_steps'])} steps")


if __name__ == "__main__":
    main(*sys.argv[1:])
