"""Which of many robots is different, and in what; then each that stands out is a job for a pool of workers.

python fleet.py                         screens arms that are simulated here
python fleet.py [tcp://HOST:8786] TASK.yaml ...   diagnoses task files, on this machine or by a scheduler of Dask
"""

import sys
from collections.abc import Callable, Iterable, Iterator
from multiprocessing import get_context

import numpy as np

import figaroh_jax as fj


def screen(robots: int = 8, samples: int = 800, dt: float = 0.01) -> fj.fleets.Fleet:
    """Arms of one structure with friction of their own; the shoulder of robot 5 rubs with its load, too."""
    robot, random = fj.load_urdf(fj.DEMO), np.random.default_rng(0)
    t, rate, phase = np.arange(samples)[:, None] * dt, *random.uniform(0.5, 3.0, (2, robots, 3, 1, robot.nv))
    q = np.sin(rate * t + phase).sum(1)
    v, a = (rate * np.cos(rate * t + phase)).sum(1), -(rate**2 * np.sin(rate * t + phase)).sum(1)
    load = np.stack([fj.inverse_dynamics(robot, *state) for state in zip(q, v, a, strict=True)])
    tau = load + random.uniform(1, 2, (robots, 1, robot.nv)) * v + 0.05 * random.standard_normal(v.shape)
    tau[5, :, 1] += 0.2 * np.abs(load[5, :, 1]) * np.sign(v[5, :, 1])
    terms = fj.columns.friction_terms(robot, fj.Baseline(offset=True))
    causes = ("load_dependent_friction", "stribeck_friction", "torque_delay")
    found = fj.screen_fleet([robot] * robots, terms, q, v, a, tau, dt, causes)
    for flag in found.flagged():
        print(f"robot {flag.robot}: {flag.cause}, {flag.beyond:.0f} deviations beyond the others")
    return found.fleet


def everywhere(job: Callable[[str], str], tasks: Iterable[str], scheduler: str = "") -> Iterator[str]:
    """The job's answers, by processes of this machine or by Dask (`pip install "figaroh-jax[dask]"`)."""
    if scheduler:
        from distributed import Client  # pyright: ignore[reportMissingImports]

        with Client(scheduler) as client:
            yield from client.gather(client.map(job, list(tasks)))
        return
    with get_context("spawn").Pool() as pool:
        yield from pool.imap(job, tasks)


def diagnose(task: str) -> str:
    """One robot's verdict and causes."""
    found = fj.diagnose_task(fj.load_task(task))
    return f"{task}: {found.verdict} {', '.join(str(cause.name) for cause in found.causes)}"


if __name__ == "__main__":
    tasks = [word for word in sys.argv[1:] if "://" not in word]
    address = next((word for word in sys.argv[1:] if "://" in word), "")
    for answer in everywhere(diagnose, tasks, address) if tasks else []:
        print(answer)
    if not tasks:
        screen()
