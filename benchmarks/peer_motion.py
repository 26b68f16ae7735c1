"""FIGAROH's own exciting motion of its UR10 problem, by its own code: `python benchmarks/peer_motion.py OUT.npz`.

Runs in an environment with FIGAROH 1.0.2 (`benchmarks/regressor.py` makes one) and cyipopt (`cyipopt-wheels`), which
`benchmarks/excitation.py pays --peer OUT.npz` then compares with. The problem is that of its `examples/ur10`: quintics
through five waypoints, 8 s, 20 Hz, soft limits .1, the start of `excitation.py`.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from excitation import POSTURE, UR10, urdf
from figaroh.optimal.base_optimal_trajectory import BaseOptimalTrajectory, BaseTrajectoryIPOPTProblem  # pyright: ignore[reportMissingImports]
from figaroh.tools.robot import Robot  # pyright: ignore[reportMissingImports]

SETTINGS = {"n_wps": 5, "freq": 20, "t_s": 2.0, "soft_lim": 0.1, "max_attempts": 1000, "max_iterations": 200}
PLAIN = ("is_joint_torques", "is_external_wrench", "has_friction", "has_actuator_inertia", "has_joint_offset")


class Design(BaseOptimalTrajectory):
    def __init__(self, robot, joints: list[str], start: list[float]) -> None:
        self.robot, self.model, self.active_joints, self.start = robot, robot.model, joints, np.array(start)
        self.trajectory_config = dict(SETTINGS, segment_attempts=3)
        self.identif_config = {name: name == "is_joint_torques" for name in PLAIN}
        self.identif_config |= {"has_coupled_wrist": False, "is_external_wrench": False, "force_torque": None}
        self.identif_config |= {"act_idxv": list(range(6)), "act_idxq": list(range(6)), "active_joints": joints}
        self.results = {name: [] for name in ("T_F", "P_F", "V_F", "A_F", "iteration_data")}
        import logging

        self.logger = logging.getLogger("figaroh")

    def create_ipopt_problem(self, *given):
        return BaseTrajectoryIPOPTProblem(self, *given)


def main(out: str, seed: int = 0) -> None:
    np.random.seed(seed)
    with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
        file.write(urdf())
        file.flush()
        robot = Robot(file.name, package_dirs=str(Path(file.name).parent))
    since = time.process_time()
    design = Design(robot, [f"{name}_joint" for name in UR10], POSTURE)
    design.initialize()
    design.WP.gen_rand_pool(design.soft_lim_pool)
    zero = np.zeros(6)
    if not design._solve_segment(0, np.array(POSTURE), zero, zero, None):
        sys.exit("FIGAROH found no motion")
    q, v, a = (np.asarray(design.results[name][0]) for name in ("P_F", "V_F", "A_F"))
    cond = np.linalg.cond(design._stack_base_regressors(q, v, a))
    np.savez(out, q=q, v=v, a=a)
    cpu = time.process_time() - since
    print(f"FIGAROH: {len(design.idx_b)} base parameters, condition {cond:.2f}, {len(q)} rows, {cpu:.1f} CPU s")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 0)
