"""Design of motions: FIGAROH's own problem for the UR10, and all limits at once on the UR10e and the Panda.

`python benchmarks/excitation.py` prints CPU seconds of one thread, cold (a fresh process, programs compiled) and warm.
The problem of FIGAROH 1.0.2 (`examples/ur10`): quintic pieces through five waypoints, 8 s, rows at 20 Hz, its limits
with 2 x soft_lim, unweighted rows of the base columns that it keeps. The peer's own result is quoted; `peer_motion.py`
runs it.
"""

from __future__ import annotations

import argparse
import inspect
import itertools
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
import figaroh_jax as fj  # without JAX, which begins below

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "backends"))
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
SOFT = 0.1  # soft_lim
SAME_OPTIMUM = 1e-6  # of a log determinant: steps are the same but for rounding, optima are tenths apart
PEER = {"condition": 22.69, "logdet": 283.45, "CPU s": 18.5}  # its result, evaluated by us in a study
# joint: origin and roll of the joint, mass of the link, its centre, moments about it, effort, range, speed
UR10 = {
    "shoulder_pan": ((0, 0, 0.1807), 0, 7.778, (0, 0, 0), (0.03147, 0.03147, 0.02188), 330, 2 * np.pi, 2 * np.pi / 3),
    "shoulder_lift": (
        (0, 0, 0),
        1,
        12.93,
        (-0.306, 0, 0.175),
        (0.03637, 0.42175, 0.42175),
        330,
        2 * np.pi,
        2 * np.pi / 3,
    ),
    "elbow": ((-0.6127, 0, 0), 0, 3.87, (-0.285775, 0, 0.0393), (0.01088, 0.11079, 0.11079), 150, np.pi, np.pi),
    "wrist_1": ((-0.57155, 0, 0.17415), 0, 1.96, (0, 0, 0), (0.00511, 0.00511, 0.00551), 56, 2 * np.pi, np.pi),
    "wrist_2": ((0, -0.11985, 0), 1, 1.96, (0, 0, 0), (0.00511, 0.00511, 0.00551), 56, 2 * np.pi, np.pi),
    "wrist_3": ((0, 0.11655, 0), -1, 0.474, (0, 0.01, 0.01), (0.002, 0.002, 0.002), 56, 2 * np.pi, np.pi),
}


def urdf() -> str:
    """The UR10e of FIGAROH's example, as far as its dynamics go."""
    parts, parent = ['<link name="base"/>'], "base"
    for name, (xyz, quarter, mass, com, moments, effort, reach, speed) in UR10.items():
        inertia = " ".join(f'{k}="{x}"' for k, x in zip(("ixx", "iyy", "izz"), moments, strict=True))
        body = f'<mass value="{mass}"/><origin xyz="{com[0]} {com[1]} {com[2]}"/>'
        body += f'<inertia {inertia} ixy="0" ixz="0" iyz="0"/>'
        parts.append(f'<link name="{name}"><inertial>{body}</inertial></link>')
        limit = f'<limit effort="{effort}" lower="{-reach}" upper="{reach}" velocity="{speed}"/>'
        roll = f'xyz="{xyz[0]} {xyz[1]} {xyz[2]}" rpy="{quarter * np.pi / 2} 0 0"'
        joint = f'<origin {roll}/><axis xyz="0 0 1"/><parent link="{parent}"/><child link="{name}"/>{limit}'
        parts.append(f'<joint name="{name}_joint" type="revolute">{joint}</joint>')
        parent = name
    return f'<robot name="ur10">{"".join(parts)}</robot>'


def peer_problem() -> tuple[Any, Any, Any, Any]:
    """Model, basis, limits and what is learned in FIGAROH's problem."""
    from figaroh_jax.excitation.limits import Limits

    with tempfile.NamedTemporaryFile("w", suffix=".urdf") as file:
        file.write(urdf())
        file.flush()
        model = fj.load_urdf(file.name)
    low, high = (np.array(model.position_limit)[:, k] for k in (0, 1))
    high = high - SOFT * (high - low)  # the second takes its share of what the first has left, as the peer does
    low = low + SOFT * (high - low)
    left = 1 - 2 * SOFT
    limits = Limits(
        np.stack([low, high], 1),
        left * np.array(model.velocity_limit),
        np.full(model.nv, np.inf),
        left * np.array(model.effort_limit),
    )
    # its order of a link's columns: Ixx Ixy Ixz Iyy Iyz Izz mx my mz m
    order = [10 * k + i for k in range(6) for i in (4, 5, 7, 6, 8, 9, 1, 2, 3, 0)]
    learned = fj.learn(model, fj.Baseline(viscous=False, coulomb=False), sigma=np.ones(6), trust=None, order=order)
    return model, fj.quintic(5, 8.0), limits, learned


def searched(learned: Any, basis: Any, bounds: Any, start: np.ndarray | None = None) -> Any:
    """The problem of a motion of most information, as a design searches it."""
    from figaroh_jax.excitation.objectives import information_objective
    from figaroh_jax.excitation.sampling import Sampler
    from figaroh_jax.excitation.solvers import Problem

    sampler = Sampler(learned.robot, learned.terms, np.asarray(learned.width))
    objective, kept = information_objective(np.asarray(learned.prior)), np.array(learned.independent)
    return Problem(learned, sampler, objective, kept, basis, bounds, start)


def spent(since: float) -> float:
    return time.process_time() - since


def on_peer_problem(starts: int, objective: str = "information", seed: int = 0) -> tuple[Any, float]:
    """A design on FIGAROH's problem and its CPU seconds."""
    model, basis, limits, learned = peer_problem()
    since = time.process_time()
    posture = POSTURE
    found = fj.excite(model, basis, limits, learned, objective=objective, start=posture, starts=starts, seed=seed)  # pyright: ignore
    return found, spent(since)


def told(name: str, found: Any, cpu: float) -> None:
    stage = found.stages[0]
    worst = max(stage.uses, key=lambda use: use.share)
    print(
        f"{name:28s} logdet {found.logdet:7.2f}  condition {found.condition:7.2f}  scaled {found.scaled_condition:6.2f}"
        f"  worst {worst.kind} {worst.share:.4f}  {stage.evaluations} evaluations  {cpu:.2f} CPU s"
    )


def arms() -> dict[str, Any]:
    """UR10e and Panda (fingers locked)."""
    ur10, panda = DATA / "ur10e_innopolis" / "ur10e.urdf", DATA / "panda_gaz2019" / "panda.urdf"
    joints = [f"panda_joint{k}" for k in range(1, 8)]
    return {"UR10e": fj.load_urdf(ur10), "Panda": fj.load_urdf(panda, joints=joints)}


def torso_and_arm() -> Any:
    """TALOS' torso and left arm, nine joints."""
    names = ["torso_1_joint", "torso_2_joint", *(f"arm_left_{k}_joint" for k in range(1, 8))]
    return fj.load_urdf(DATA / "talos_contact" / "talos_full_v2.urdf", joints=names)


MESHES = os.environ.get("FIGAROH_JAX_MESHES")  # `robots` of the package example-robot-data, whose URDF have meshes
TOUCHING = {  # pairs that are nearer than 20 mm by their construction
    "UR10": [("upper_arm_link", "base_link"), ("wrist_1_link", "wrist_3_link"), ("wrist_2_link", "forearm_link")],
    "Panda": [("panda_link5", "panda_link7")],
}


def clearance(seed: int | None = None, cold: bool = False) -> None:
    """All limits, 20 mm between all bodies and the floor, 10 s; one start, three seeds; meshes by coal afterwards.

    `cold`: the first of these alone.
    """
    from figaroh_jax.excitation.clearance import clearance_of
    from figaroh_jax.formats.collision import read_shapes

    if MESHES is None:
        print("FIGAROH_JAX_MESHES does not say where robots with meshes are: left out")
        return
    files = {"UR10": "ur_description/urdf/ur10_robot.urdf", "Panda": "panda_description/urdf/panda.urdf"}
    for name, file in list(files.items())[: 1 if cold else None]:
        joints = None if name == "UR10" else [f"panda_joint{k}" for k in range(1, 8)]
        model = fj.load_urdf(Path(MESHES) / file, joints=joints)
        shapes, _ = read_shapes(Path(MESHES) / file)
        kept = clearance_of(model, shapes, margin=0.02, ignore=TOUCHING[name], floor=-0.05)
        learned, bounds = fj.learn(model, trust=None), fj.limits_of(model, acceleration=8.0, clearance=kept)
        for basis in (fj.fourier(5, 0.1, 10.0), fj.spline(9, 10.0))[: 1 if cold else None]:
            for k in ([0] if cold else range(3)) if seed is None else [seed]:
                since = time.process_time()
                found = fj.excite(model, basis, bounds, learned, starts=1, seed=k)
                told(f"{name} {basis.kind} seed {k}", found, spent(since))
                q = np.asarray(found.stages[0].motion.at(np.arange(0, 10, 0.2))[0])
                near = kept.exact_distances(q, kept.pairs)
                if near is not None:
                    print(f"{'':28s} meshes at 5 Hz: nearest {near.min():.4f} m, {int((near <= 0).sum())} collisions")


def ipopt(iterations: int = 300, seed: int = 0, starts: int = 4, robots: Sequence[str] = ("UR10e", "Panda")) -> None:
    """All limits at once (10 s, five harmonics): ours from one start, three seeds; IPOPT from random motions and ours.

    IPOPT has the same objective, its gradient and the exact Jacobian of all rows at 20 Hz, dense; it needs cyipopt (the
    package `cyipopt-wheels` holds one with IPOPT inside). Its rows are not tightened between samples.
    """
    try:
        from cyipopt import minimize_ipopt  # pyright: ignore[reportMissingImports]
    except ImportError:
        print("cyipopt is not installed: left out")
        return
    for name in robots:
        _beside_ipopt(minimize_ipopt, name, arms()[name], (seed, starts, iterations))


def _beside_ipopt(minimize_ipopt: Any, name: str, model: Any, options: tuple[int, int, int]) -> None:
    seed, starts, iterations = options
    from figaroh_jax.excitation.search import random_motion

    learned, bounds = fj.learn(model, trust=None), fj.limits_of(model, acceleration=8.0)
    basis = fj.fourier(5, 0.1, 10.0)
    problem, theta = searched(learned, basis, bounds), np.asarray(learned.theta)
    sampler = problem.sampler
    A, b = problem.linear_matrix({})

    def room(x: np.ndarray) -> np.ndarray:
        share = sampler.torque(problem.states(x), theta) / bounds.torque
        return np.concatenate([b - A @ x, (1 - share).ravel(), (1 + share).ravel()])

    def slopes(x: np.ndarray) -> np.ndarray:
        states, n = problem.states(x), model.nv
        out = np.zeros((states.shape[1], n, len(x)))
        for j in range(n):
            cotangent = np.zeros((n, len(learned.names), states.shape[1]))
            cotangent[j, : len(theta)] = theta[:, None] / bounds.torque[j]
            by = sampler.back(states, cotangent)
            out[:, j, :n] = by[0]
            out[:, j, n:] = np.einsum("ksb,ksj->sjb", problem.matrix, by).reshape(len(by[0]), -1)
        flat = out.reshape(-1, len(x))
        return np.concatenate([-A, -flat, flat])

    fj.excite(model, basis, bounds, learned, starts=1, seed=9)
    ours = []
    for own in range(seed, seed + 3):
        since = time.process_time()
        ours.append(fj.excite(model, basis, bounds, learned, starts=1, seed=own))
        told(f"{name}: ours, one start, seed {own}", ours[-1], spent(since))
    found = min(ours, key=lambda one: one.logdet)
    generator = np.random.default_rng([seed, 0])
    begins = {f"IPOPT from random motion {k + 1}": random_motion(problem, generator) for k in range(starts)}
    begins["IPOPT from the worst of ours"] = problem.numbers(found.stages[0].motion)
    rows = {"type": "ineq", "fun": room, "jac": slopes}
    for begin, x in begins.items():
        since = time.process_time()
        how = {"max_iter": iterations, "hessian_approximation": "limited-memory", "tol": 1e-5, "print_level": 0}
        end = minimize_ipopt(problem.value, x, jac=problem.slope, constraints=[rows], options=how)
        logdet = -learned.rank * problem.value(end.x)
        std = [np.exp((logdet - one.logdet) / (2 * learned.rank)) - 1 for one in ours]
        print(
            f"{name}: {begin}: logdet {logdet:.2f}, standard deviations"
            f" {' '.join(f'{x:+.2%}' for x in std)} smaller than ours, rows at 20 Hz"
            f" {-room(end.x).min():.1e} over, {end.nit} iterations, {spent(since):.1f} CPU s",
            flush=True,
        )


def limits(robots: Sequence[str] = ("UR10e", "Panda"), seed: int = 0, starts: int = 1) -> None:
    """All limits at once (position, velocity, 8 rad/s^2, torque), 10 s, five harmonics or nine control points.

    Three seeds from `seed` on.
    """
    for name, model in ((name, arms()[name]) for name in robots):
        learned, bounds = fj.learn(model, trust=None), fj.limits_of(model, acceleration=8.0)
        for basis in (fj.fourier(5, 0.1, 10.0), fj.spline(9, 10.0)):
            for own in range(seed, seed + 3):
                since = time.process_time()
                found = fj.excite(model, basis, bounds, learned, starts=starts, seed=own)
                told(f"{name} {basis.kind} seed {own}", found, spent(since))


def descents(robots: Sequence[str] = ("UR10e", "Panda"), seed: int = 5, starts: int = 24) -> None:
    """All limits at once, five harmonics: where single random motions end, from within and then along the limits.

    The Hessian of the first of both knows six steps, and three and 25 besides.
    """
    from figaroh_jax.excitation import interior
    from figaroh_jax.excitation.search import random_motion
    from figaroh_jax.excitation.solvers import STEPS, polished, within

    for name, remembered in itertools.product(robots, (6, 3, 25)):
        interior.REMEMBERED = remembered
        model = arms()[name]
        learned, bounds = fj.learn(model, trust=None), fj.limits_of(model, acceleration=8.0)
        problem = searched(learned, fj.fourier(5, 0.1, 10.0), bounds)
        ends, since = [], time.process_time()
        for k in range(starts):
            before = problem.evaluations
            x = within(problem, random_motion(problem, np.random.default_rng([seed, k])))
            first, until = -learned.rank * problem.value(x), problem.evaluations
            x = polished(problem, x, {}, STEPS)
            ends.append((first, -learned.rank * problem.value(x), until - before, problem.evaluations - before))
        one, two, evaluations, both = np.mean(ends, axis=0)
        print(
            f"{name}, {remembered} steps remembered: {starts} motions, log determinant {one:.2f} after"
            f" {evaluations:.0f} evaluations, {two:.2f} (deviation {np.std([x[1] for x in ends]):.2f}) after"
            f" {both:.0f}, {spent(since) / starts:.2f} CPU s each",
            flush=True,
        )


def sequence() -> None:
    """Four motions one after another on FIGAROH's problem, weighted, with friction: worth how many repeats."""
    from figaroh_jax.excitation.design import gram_of
    from figaroh_jax.excitation.sampling import Sampler

    model, basis, bounds, _ = peer_problem()
    learned = fj.learn(model, trust=None)
    since = time.process_time()
    found = fj.excite(model, basis, bounds, learned, trajectories=4, starts=6, start=POSTURE)
    cpu = spent(since)
    sampler = Sampler(model, learned.terms, np.asarray(learned.width))
    gram = gram_of(learned, sampler, found.stages[0].motion.states(20.0))
    alone = np.linalg.slogdet(gram)[1]
    for k, stage in enumerate(found.stages[1:], 2):
        repeats = np.exp((stage.logdet - alone) / learned.rank)
        print(f"{k} trajectories: logdet {stage.logdet:.1f}, worth {repeats:.2f} repeats of the first")
    print(f"{cpu:.1f} CPU s for 4 trajectories of 6 starts")


def postures() -> None:
    """30 postures of 500 candidates, moved; the bound is that of 5000 others."""
    from figaroh_jax.excitation.postures import _Calibrated, certified_bound

    cases = {
        "UR10e": ("base", "wrist_3_link"),
        "Panda": ("panda_link0", "panda_link7"),
        "TALOS": ("base_link", "arm_left_7_link"),
    }
    for name, model in {**arms(), "TALOS": torso_and_arm()}.items():
        device = fj.Instrument("pose", *cases[name])
        fj.excite_postures(model, device)
        since = time.process_time()
        found = fj.excite_postures(model, device)
        cpu = spent(since)
        low, high = np.clip(np.array(model.position_limit), -2 * np.pi, 2 * np.pi).T
        q = np.random.default_rng(0).uniform(low, high, (500, model.nv))
        calibrated = _Calibrated(model, device, "full", q)
        more = np.random.default_rng(1).uniform(low, high, (5000, model.nv))
        J = calibrated.rows(more)
        size = np.sqrt((J**2).sum(axis=(0, 1)))
        bound = certified_bound(J / size, 30) + 2 * np.log(size).sum()
        share = np.exp((np.array([found.random_logdet, found.chosen_logdet, found.logdet]) - bound) / J.shape[2])
        print(
            f"{name}: {J.shape[2]} parameters; of the bound of 5000: random {share[0]:.3f}, chosen of 500"
            f" {share[1]:.4f}, moved {share[2]:.4f}; {cpu:.2f} CPU s"
        )


def fresh(draws: int = 8) -> None:
    """Calibrations of simulated robots from 30 designed and 30 random postures: errors in 300 others.

    Each true robot has every joint frame 1 mm and 1 mrad off; poses are measured with noise of 0.1 mm and 1 mrad.
    """
    import equinox as eqx

    def poses(robot: Any, q: np.ndarray, base: str, tool: str) -> np.ndarray:
        return np.linalg.solve(fj.frame_placement(robot, q, base), fj.frame_placement(robot, q, tool))

    frames = {"UR10e": ("base", "wrist_3_link"), "Panda": ("panda_link0", "panda_link7")}
    for name, model in arms().items():
        base, tool = frames[name]
        designed = fj.excite_postures(model, fj.Instrument("pose", base, tool, ())).position
        low, high = np.clip(np.array(model.position_limit), -2 * np.pi, 2 * np.pi).T
        errors: dict[str, list[tuple[float, float]]] = {"designed": [], "random": []}
        for k in range(draws):
            generator = np.random.default_rng([5, k])
            placement = np.array(model.placement)
            for P in placement:
                P[:3, 3] += 1e-3 * generator.normal(size=3)
                P[:3, :3] = P[:3, :3] @ _turn(1e-3 * generator.normal(size=3))
            true = eqx.tree_at(lambda m: m.placement, model, placement)
            q = {"designed": designed, "random": generator.uniform(low, high, (30, model.nv))}
            others = generator.uniform(low, high, (300, model.nv))
            wanted = poses(true, others, base, tool)
            for way, some in q.items():
                seen = poses(true, some, base, tool)
                for T in seen:
                    T[:3, 3] += 1e-4 * generator.normal(size=3)
                    T[:3, :3] = T[:3, :3] @ _turn(1e-3 * generator.normal(size=3))
                run = fj.postures(q=some, pose=seen, base_frame=base, tool_frame=tool, unknown=())
                found = fj.calibrate(model, [run], level="full", priors=False)
                told = poses(found.model, others, base, tool)
                off = np.linalg.norm(told[:, :3, 3] - wanted[:, :3, 3], axis=1)
                errors[way].append((float(np.sqrt((off**2).mean())), float(off.max())))
        for way, both in errors.items():
            rms, most = 1e3 * np.median(both, axis=0)
            print(
                f"{name}, 30 {way} postures: {rms:.4f} mm RMS, {most:.4f} mm at most (medians of {draws})", flush=True
            )


def _turn(by: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(by).as_matrix()


def views() -> None:
    """30 postures of TALOS' torso and left arm (9 joints, poses measured), and of a Panda with a camera in its hand.

    The camera looks at a board on the table at 0.2 to 1 m, within 0.35 rad of its axis and 0.9 rad of the normal.
    """
    from figaroh_jax.excitation.postures import View

    board = View((0.5, 0.0, 0.0), (0.0, 0.0, 1.0), "hand", cone=0.35, tilt=0.9, near=0.2, far=1.0)
    cases = {
        "TALOS": (torso_and_arm(), fj.Instrument("pose", "base_link", "arm_left_7_link")),
        "Panda, camera": (arms()["Panda"], fj.Instrument("pose", "panda_link0", "panda_link7", view=board)),
    }
    for name, (model, device) in cases.items():
        fj.excite_postures(model, device)
        since = time.process_time()
        found = fj.excite_postures(model, device)
        print(
            f"{name}: {len(found.parameters)} parameters, {found.candidates} candidates; of their bound: random"
            f" {found.random_efficiency:.3f}, chosen {found.chosen_efficiency:.4f}, moved {found.efficiency:.4f};"
            f" {spent(since):.2f} CPU s",
            flush=True,
        )


PAIRS = {
    "rotor / link": (("rotor_inertia", ("elbow_joint",), {"inertia": 0.1}), ("link_inertia", ("forearm_link",), {})),
    "gain / link": (("torque_gain", ("elbow_joint",), {"gain": 0.02}), ("link_inertia", ("forearm_link",), {})),
    "delay / lag": (("torque_delay", (), {"delay": 0.01}), ("torque_lag", (), {"time": 0.01})),
    "Stribeck / power law": (
        ("stribeck_friction", ("elbow_joint",), {"force": 2.1, "speed": 0.1}),
        ("power_law_friction", ("elbow_joint",), {}),
    ),
}


def separation(names: Sequence[str] = tuple(PAIRS), seed: int = 0, starts: int = 2) -> None:
    """Pairs of causes at the UR10e's elbow, 10 s: sigmas of random, D-optimal and designed motions, both ways."""
    from figaroh_jax.excitation.design import gram_of
    from figaroh_jax.excitation.search import random_motion
    from figaroh_jax.excitation.separation import causes, separated

    model = arms()["UR10e"]
    learned, bounds, basis = fj.learn(model), fj.limits_of(model, acceleration=8.0), fj.fourier(10, 0.1, 10.0)
    problem = searched(learned, basis, bounds)
    states = [problem.states(random_motion(problem, np.random.default_rng(k))) for k in range(11)]
    most = fj.excite(model, basis, bounds, learned, starts=2).stages[0].motion.states(20.0)
    for pair in (PAIRS[name] for name in names):
        given = causes(learned, [pair], states[0])

        def both(motion: Any, given: Any = given) -> np.ndarray:
            G = gram_of(learned, given.sampler, motion, given.columns)
            return np.array([one.sigmas for one in separated(given, G, np.asarray(learned.prior))])

        since = time.process_time()
        options: dict[str, Any] = {"starts": starts, "seed": seed}
        found = fj.excite(model, basis, bounds, learned, objective="separate", separate=[pair], **options)
        cpu = spent(since)
        usual, best = np.median([both(motion) for motion in states], axis=0), both(most)
        for k, one in enumerate(found.separated):
            print(
                f"{one.truth.split()[0]:20s} random {usual[k]:5.2f}  D-optimal {best[k]:5.2f}  designed"
                f" {one.sigmas:5.2f} sigmas ({one.repeats} repeats)  {cpu:.1f} CPU s",
                flush=True,
            )


def chooser(
    draws: int = 100, names: Sequence[str] = tuple(PAIRS), seed: int = 0, starts: int = 3, harmonics: int = 20
) -> None:
    """Four pairs of causes at the UR10e's elbow, 10 s, 20 harmonics: 100 simulated runs with either as the truth.

    Torques are Pinocchio's; each run has its own link errors (10 % of the inertias), noise of 1 % of the largest torque
    at 50 Hz. Both causes are fitted with all links (believed within 10 %) and friction by least squares in NumPy, and
    the larger evidence names. Sigmas measured: root of the mean difference of the penalised squares, freedoms counted.
    """
    model = arms()["UR10e"]
    learned, bounds, basis = fj.learn(model), fj.limits_of(model, acceleration=8.0), fj.fourier(harmonics, 0.1, 10.0)
    for name, pair in ((name, PAIRS[name]) for name in names):
        since = time.process_time()
        options = {"starts": starts, "rate": 50.0, "seed": seed}
        found = fj.excite(model, basis, bounds, learned, objective="separate", separate=[pair], **options)
        cpu = spent(since)
        runs = _Runs(model, learned, found.stages[0].motion, pair)
        said = []
        for way, told in zip((0, 1), found.separated, strict=True):
            right, measured, both = runs.tried(way, told.size, 1, draws)
            text = f"{told.sigmas:.2f} sigmas predicted, {measured:.2f} measured, right {right:.2f} (sure {both:.2f})"
            if told.repeats is None:
                text += ", no repeats suffice"
            elif told.repeats > 1:
                right, _, both = runs.tried(way, told.size, told.repeats, draws)
                text += f", after {told.repeats} repeats {right:.2f} (sure {both:.2f})"
            said.append(f"{told.truth.split()[0]}: {text}")
        print(f"{name:22s} {'; '.join(said)}; {cpu:.1f} CPU s", flush=True)


class _Runs:
    """Simulated runs of a motion and the fits of two causes to them, without any code of the library."""

    def __init__(self, model: Any, learned: Any, motion: Any, pair: Any) -> None:
        from figaroh_jax_pinocchio import PinocchioBackend

        self.robot, self.pair = PinocchioBackend.build(model), pair
        t = np.arange(round(motion.duration * 50) + 1) / 50
        self.q, self.v, self.a = (np.asarray(x) for x in motion.at(t))
        self.sigma = 1 / np.sqrt(np.asarray(learned.weight))
        self.inertia, self.kept = np.asarray(model.inertia).ravel(), np.array(learned.independent)
        self.elbow, self.forearm = model.joint_index("elbow_joint"), model.link_index("forearm_link")
        self.W = np.asarray(self.robot.joint_torque_regressor(self.q, self.v, self.a))
        eye = np.eye(model.nv)
        dry = np.tanh(self.v / 0.03)
        friction = np.concatenate([eye * self.v[:, None], eye * dry[:, None]], axis=2)
        self.X = self._flat(np.concatenate([self.W, friction], axis=2)[:, :, self.kept])
        self.prior = np.asarray(learned.prior)
        fine = np.arange(round(motion.duration * 400)) / 400  # the motion is periodic
        tau = np.asarray(self.robot.inverse_dynamics(*(np.asarray(x) for x in motion.at(fine))))
        self.waves, self.omega = np.fft.rfft(tau, axis=0), 2 * np.pi * np.fft.rfftfreq(len(fine), 1 / 400)
        self.dry = dry[:, self.elbow]
        # one sigma of each parameter of a link, as `rigid_prior` has it: how far an inertia is believed
        from figaroh_jax.estimation.priors import rigid_prior

        self.spread = 1 / np.sqrt(rigid_prior(model, 0.1)[1])

    def _flat(self, rows: np.ndarray) -> np.ndarray:
        return (rows / self.sigma[:, None]).reshape(-1, rows.shape[2])

    def _at_elbow(self, columns: list[np.ndarray]) -> np.ndarray:
        rows = np.zeros((*self.q.shape, len(columns)))
        rows[:, self.elbow] = np.stack(columns, 1)
        return self._flat(rows)

    def _filtered(self, response: np.ndarray) -> np.ndarray:
        tau = np.fft.irfft(self.waves * (response - 1)[:, None], 2 * (len(self.waves) - 1), axis=0)
        return self._flat(np.concatenate([tau, tau[:1]])[::8, :, None])

    def columns(self, side: int, sizes: dict[str, float] | None) -> list[tuple[np.ndarray, np.ndarray | None]]:
        """Columns of a cause and the prior of their amplitudes (None: the first is there as it stands), each shape."""
        name, speed = self.pair[side][0], np.abs(self.v[:, self.elbow])
        free = np.array([1e-6])
        if name == "rotor_inertia":
            return [(self._at_elbow([self.a[:, self.elbow]]), free)]
        if name == "torque_gain":
            total = (self.W @ self.inertia)[:, self.elbow]
            return [(self._at_elbow([total]), free)]
        if name == "link_inertia":
            own = slice(10 * self.forearm, 10 * self.forearm + 10)
            return [(self._flat(self.W[:, :, own]), 1 / (5 * self.spread[own]) ** 2)]
        if name == "stribeck_friction":
            grid = [sizes["speed"]] if sizes else [0.03, 0.06, 0.1, 0.15, 0.25, 0.4]
            return [(self._at_elbow([np.exp(-((speed / x) ** 2)) * self.dry]), free) for x in grid]
        if name == "power_law_friction":
            grid = [sizes["exponent"]] if sizes else [0.4, 0.6, 1.5, 2.0, 2.5, 3.0]
            return [(self._at_elbow([speed**x * self.dry]), free) for x in grid]
        delay = name == "torque_delay"
        grid = [sizes["delay" if delay else "time"]] if sizes else 0.01 * np.geomspace(1 / 3, 3, 41)
        kinds = ((np.exp(-1j * self.omega * x) if delay else 1 / (1 + 1j * self.omega * x)) for x in grid)
        return [(self._filtered(response), None) for response in kinds]

    def tried(self, side: int, size: dict[str, float], repeats: int, draws: int) -> tuple[float, float, float]:
        """Share of right names, measured sigmas, share of right names by more than 8 in twice the log evidence."""
        ((Z, precision),) = self.columns(side, size)
        if precision is None:
            amplitude = np.ones(1)
        elif Z.shape[1] == 10:
            amplitude = 0.2 * self.inertia[10 * self.forearm : 10 * self.forearm + 10]
        else:
            amplitude = np.array([next(x for key, x in size.items() if key not in ("speed", "exponent"))])
        links = len(self.prior) - 2 * self.q.shape[1]
        spread = np.linalg.cholesky(np.linalg.inv(self.prior))[:, :links]
        fits = [[_Fit(self.X, self.prior, *one, repeats) for one in self.columns(k, None)] for k in (side, 1 - side)]
        right, better, sure = 0, [], 0
        for k in range(draws):
            noise = np.random.default_rng([3, side, repeats, k])
            y = self.X @ (spread @ noise.standard_normal(links)) + Z @ amplitude
            y = y + noise.standard_normal((repeats, len(y))).mean(0)
            (a, sse_a), (b, sse_b) = (_best(some, y) for some in fits)
            right, sure = right + (a > b), sure + (a > b + 4)
            better.append(sse_b - sse_a)
        own, other = fits[0][0], fits[1][0]
        mean = np.mean(better) + other.freedom - own.freedom
        mean += float(amplitude @ own.taken @ amplitude) if own.fixed is None else 0.0
        return right / draws, float(np.sqrt(max(mean, 0.0))), sure / draws


class _Fit:
    """Penalised least squares of one shape of a cause."""

    def __init__(
        self, X: np.ndarray, prior: np.ndarray, Z: np.ndarray, precision: np.ndarray | None, repeats: int
    ) -> None:
        self.fixed = Z[:, 0] if precision is None else None
        self.A = X if precision is None else np.concatenate([X, Z], axis=1)
        k = 0 if precision is None else Z.shape[1]
        P = np.zeros((len(prior) + k,) * 2)
        P[: len(prior), : len(prior)] = prior
        if precision is not None:
            P[len(prior) :, len(prior) :] = np.diag(precision)
        M = repeats * self.A.T @ self.A + P
        size = np.sqrt(np.diag(M))
        self.inverse, self.repeats = np.linalg.inv(M / np.outer(size, size)) / np.outer(size, size), repeats
        gone = np.linalg.slogdet(P / np.outer(size, size))[1] - np.linalg.slogdet(M / np.outer(size, size))[1]
        self.volume = 0.5 * gone
        # beside the links' own prior: what the columns take of the squares, and what a true size adds to them
        self.freedom, self.taken = 0.0, np.zeros((k, k))
        if precision is not None:
            base = repeats * X.T @ X + prior
            V = repeats * Z.T @ Z - repeats**2 * (Z.T @ X) @ np.linalg.solve(base, X.T @ Z)
            precision = np.asarray(precision)
            root = 1 / np.sqrt(precision)
            inner = np.maximum(np.linalg.eigvalsh(root[:, None] * (V + V.T) / 2 * root), 0.0)
            self.freedom = float((inner / (1 + inner)).sum())
            self.taken = V - V @ np.linalg.solve(V + np.diag(precision), V)

    def __call__(self, y: np.ndarray) -> tuple[float, float]:
        y = y if self.fixed is None else y - self.fixed
        c = self.repeats * (self.A.T @ y)
        squares = self.repeats * float(y @ y) - float(c @ self.inverse @ c)
        return self.volume - 0.5 * squares, squares


def _best(fits: list[_Fit], y: np.ndarray) -> tuple[float, float]:
    """Evidence over the shapes, and the smallest squares among them."""
    told = [fit(y) for fit in fits]
    most = max(evidence for evidence, _ in told)
    return most + float(np.log(np.mean([np.exp(e - most) for e, _ in told]))), min(squares for _, squares in told)


POSTURE = [0.0, -1.2, 1.0, -0.5, 0.3, 0.0]


def pays(draws: int = 60, seed: int = 0, starts: int = 8, peer: str | None = None) -> None:
    """Simulated identifications on FIGAROH's problem with friction: error of the torque predicted on unseen motions.

    All is told against FIGAROH's own motion where `peer` names its file (`peer_motion.py` makes it), else against ours
    of the smallest condition number.

    The truth is Pinocchio's, with Coulomb and viscous friction, 30 % more Coulomb friction at rest (Stribeck), torque
    noise of 1 % of the largest torque and an encoder error of 2 mrad; the fit is plain weighted least squares in NumPy.
    """
    from figaroh_jax_pinocchio import PinocchioBackend

    from figaroh_jax.excitation.search import random_motion

    model, basis, bounds, plain = peer_problem()
    learned, robot = fj.learn(model, trust=None), PinocchioBackend.build(model)
    sigma = 1 / np.sqrt(np.asarray(learned.weight))
    kept = np.array(learned.independent)
    problem = searched(learned, basis, bounds, np.array(POSTURE))
    generator = np.random.default_rng(7)
    randoms = [problem.states(random_motion(problem, generator)) for _ in range(25)]
    unseen, randoms = randoms[:10], randoms[10:]
    level = 3.0 * sigma

    def torque(states: np.ndarray, stribeck: float) -> np.ndarray:
        q, v, a = states
        dry = level * np.tanh(v / 0.03) * (1 + stribeck * np.exp(-((v / 0.1) ** 2)))
        return np.asarray(robot.inverse_dynamics(q, v, a)) + dry + 0.5 * level * v

    def rows(states: np.ndarray) -> np.ndarray:
        q, v, a = states
        friction = np.concatenate([np.eye(6) * v[:, None], np.eye(6) * np.tanh(v / 0.03)[:, None]], axis=2)
        return np.concatenate([np.asarray(robot.joint_torque_regressor(q, v, a)), friction], axis=2)[:, :, kept]

    def error(states: np.ndarray, stribeck: float, encoder: float) -> tuple[float, float]:
        """RMS error on the unseen motions, sigmas, and the share of 95 % intervals that hold the true parameter."""
        squares, held = [], []
        clean = (rows(states) / sigma[:, None]).reshape(-1, len(kept))
        scale = np.linalg.norm(clean, axis=0)
        true = np.linalg.lstsq(clean / scale, (torque(states, 0.0) / sigma).ravel(), rcond=None)[0]
        for k in range(draws):
            noise = np.random.default_rng([11, k])
            read = states + np.array([encoder, 0, 0])[:, None, None] * noise.standard_normal(states.shape)
            y = torque(states, stribeck) + sigma * noise.standard_normal(states.shape[1:])
            A = (rows(read) / sigma[:, None]).reshape(-1, len(kept))
            size = np.linalg.norm(A, axis=0)
            fit = np.linalg.lstsq(A / size, (y / sigma).ravel(), rcond=None)[0] / size
            left = (y / sigma).ravel() - A @ fit
            spread = np.linalg.inv((A / scale).T @ (A / scale)) * (left @ left) / (len(left) - len(kept))
            held.append(np.mean(np.abs(fit * scale - true) < 1.96 * np.sqrt(np.diag(spread))))
            for motion, (W, truth) in zip(unseen, tests[stribeck], strict=True):
                squares.append((((W @ fit - truth) / sigma) ** 2).mean() if motion is not None else 0.0)
        return float(np.sqrt(np.mean(squares))), float(np.mean(held))

    tests = {s: [(rows(motion), torque(motion, s)) for motion in unseen] for s in (0.0, 0.3)}
    seen = [tuple(motion) for motion in randoms]  # motions of the kind that matters, none of them judged on
    same = {"start": POSTURE, "starts": starts, "seed": seed}
    designs = {
        "condition": fj.excite(model, basis, bounds, plain, objective="condition", **same),
        "information": fj.excite(model, basis, bounds, learned, **same),
        "prediction": fj.excite(model, basis, bounds, learned, objective="prediction", predict=seen, **same),
    }
    motions = {name: np.stack(found.stages[0].motion.states(20.0)) for name, found in designs.items()}
    against = "condition"
    if peer is not None:
        file, against = np.load(peer), "FIGAROH"
        motions = {against: np.stack([file[key] for key in "qva"]), **motions}
    kinds = {"noise": (0.0, 0.0), "+ Stribeck": (0.3, 0.0), "+ encoder": (0.0, 2e-3)}
    table = {"random, median": [np.median([error(m, *k) for m in randoms[:7]], axis=0) for k in kinds.values()]}
    table |= {name: [error(m, *k) for k in kinds.values()] for name, m in motions.items()}
    print(f"condition number of the condition design in FIGAROH's columns: {designs['condition'].condition:.2f}")
    for name, values in table.items():
        cells = (
            f"{key} {x:.3f} ({x / y - 1:+.0%}), covered {held:.3f}"
            for key, (x, held), (y, _) in zip(kinds, values, table[against], strict=True)
        )
        print(f"{name:16s} {'  '.join(cells)}", flush=True)


def ranking(triples: int = 200) -> None:
    """Real runs of a UR10e: does the information of three of the 18 rank the error on the other 15?

    Weighted least squares of base parameters and friction, the nominal links believed within 100 %; the noise is the
    residual of a fit to all runs. The design criterion sees positions alone, no torque of the runs that it ranks.
    """
    from scipy.stats import spearmanr

    from figaroh_jax.estimation.base_parameters import base_parameters
    from figaroh_jax.estimation.columns import structural_columns
    from figaroh_jax.estimation.regression import Regression, condense
    from figaroh_jax.recordings.signals import prepare_all
    from figaroh_jax.simulators.native import NativeBackend

    model = arms()["UR10e"]
    gains = (10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232)  # N m/A, published with the data
    learned = fj.learn(model, trust=1.0)
    kept, own = np.array(learned.independent), 10 * len(model.joints)
    structure = structural_columns(model, learned.terms)
    used = np.asarray(np.abs(structure).max(axis=0) > 0)
    base = base_parameters(structure.reshape(-1, structure.shape[2]), learned.names)
    assert tuple(base.independent) == learned.independent
    nominal = base.matrix[:, :own] @ np.asarray(model.inertia).ravel()
    data = []
    for file in sorted((DATA / "ur10e_innopolis" / "id").glob("*.npz")):
        z = np.load(file)
        try:
            run = fj.recording(q=z["q"], tau=z["i"] * gains, time=z["t"], name=file.stem)
            signals = prepare_all((run,), fj.Preprocess(cutoff=5), band=None, model=model)
            data.append(condense(Regression(NativeBackend(model), learned.terms, np.zeros(6), signals), used))
        except fj.InputError as refused:
            print(f"left out: {refused}")
    count = len(data)

    def fit(some: Any, weight: np.ndarray) -> np.ndarray:
        G, b = np.array(learned.prior), np.asarray(learned.prior) @ nominal
        for k in some:
            A = data[k].factor(weight)
            G, b = G + A[:, kept].T @ A[:, kept], b + A[:, kept].T @ A[:, -1]
        size = np.sqrt(np.diag(G))
        theta = np.zeros(len(learned.names))
        theta[kept] = np.linalg.solve(G / np.outer(size, size), b / size) / size
        return theta

    def error(some: Any) -> float:
        """RMS on the other runs, in that of the fit to all runs there: some runs are harder than others."""
        others = [data[k] for k in range(count) if k not in some]
        squares = [
            (np.sum([one.squares(theta) for one in others], axis=0) * weight).sum()
            for theta in (fit(some, weight), fit(range(count), weight))
        ]
        return float(np.sqrt(squares[0] / squares[1]))

    weight = np.ones(6)
    for _ in range(5):
        theta = fit(range(count), weight)
        weight = np.sum([one.rows for one in data], axis=0) / np.sum([one.squares(theta) for one in data], axis=0)
    grams = [one.factor(weight)[:, kept] for one in data]
    grams = [A.T @ A for A in grams]

    every_gram, rows = sum(grams), float(np.sum([one.rows for one in data]))

    def told_by(some: Any) -> float:
        return float(np.linalg.slogdet(np.asarray(learned.prior) + sum(grams[k] for k in some))[1])

    def foreseen(some: Any) -> float:
        """Less the mean square of the error on all runs that the noise of these makes, sigmas."""
        G = np.asarray(learned.prior) + sum(grams[k] for k in some)
        size = np.sqrt(np.diag(G))
        return -float(np.trace(np.linalg.solve(G / np.outer(size, size), every_gram / np.outer(size, size)))) / rows

    every = list(itertools.combinations(range(count), 3))
    some = [every[k] for k in np.random.default_rng(0).permutation(len(every))[:triples]]
    errors = np.array([error(t) for t in some])
    print(f"{count} runs; errors on the others beside those of a fit to all")
    print(f"{triples} random triples: median {np.median(errors):.3f}, best {min(errors):.3f}, worst {max(errors):.3f}")
    alone = [error((k,)) for k in range(count)]
    for name, score in (("information", told_by), ("prediction", foreseen)):
        best, worst = max(every, key=score), min(every, key=score)
        scores = np.array([score(t) for t in some])
        halves = [np.median(errors[scores >= np.median(scores)]), np.median(errors[scores < np.median(scores)])]
        print(
            f"{name}: best 3 {error(best):.3f}, worst 3 {error(worst):.3f}; medians of the better and the worse half"
            f" {halves[0]:.3f} {halves[1]:.3f}; rank correlation {spearmanr(scores, errors)[0]:.2f}, of single runs"
            f" {spearmanr([score((k,)) for k in range(count)], alone)[0]:.2f}",
            flush=True,
        )


def gpu(starts: int = 256, outer: int = 5, inner: int = 100, compared: int = 4) -> None:
    """FIGAROH's problem from many starts at once, one program on the device, beside the same on the CPU.

    An augmented Lagrangian of the linear rows, minimised by Adam; all starts step together. Needs no package beside
    JAX's own and optax; `compared` of the starts are run on the CPU too, whose optima have to be the same, and the best
    is improved there by SLSQP. Without a GPU all starts run on the CPU (minutes: give `--starts 8`), the same way.
    """
    import jax
    import jax.numpy as jnp

    from figaroh_jax.excitation.search import random_motion
    from figaroh_jax.excitation.solvers import solve
    from figaroh_jax.rigid.regressor import joint_torque_regressor

    model, basis, bounds, learned = peer_problem()
    kept, start = np.array(learned.independent), np.array(POSTURE)
    problem = searched(learned, basis, bounds, start)
    A, b = problem.linear_matrix({})
    generator = np.random.default_rng(0)
    x0 = np.stack([random_motion(problem, generator) for _ in range(starts)])

    def lagrangian(x: Any, lam: Any, mu: float) -> Any:
        q, v, a = (jnp.asarray(phi) @ x.reshape(model.nv, -1).T for phi in problem.matrix)
        W = joint_torque_regressor(model, q + start, v, a)[..., kept].reshape(-1, len(kept))
        value = -jnp.linalg.slogdet(W.T @ W)[1] / len(kept)
        push = jnp.maximum(0.0, lam + mu * (A @ x - b))
        return value + jnp.sum(push**2 - lam**2) / (2 * mu)

    def improved(x: Any) -> Any:
        def step(carry: Any, k: Any) -> Any:
            x, m, s, lam, mu = carry
            g = jax.grad(lagrangian)(x, lam, mu)
            m, s = 0.9 * m + 0.1 * g, 0.999 * s + 0.001 * g**2
            rate = 0.03 * 0.02 ** (k / (outer * inner))
            x = x - rate * (m / (1 - 0.9 ** (k + 1))) / (jnp.sqrt(s / (1 - 0.999 ** (k + 1))) + 1e-9)
            last = (k + 1) % inner == 0
            lam = jnp.where(last, jnp.maximum(0.0, lam + mu * (A @ x - b)), lam)
            return (x, m, s, lam, jnp.where(last, 2 * mu, mu)), None

        zero = jnp.zeros_like(x)
        begin = (x, zero, zero, jnp.zeros(len(b)), jnp.asarray(3.0))
        return jax.lax.scan(step, begin, jnp.arange(outer * inner, dtype=float))[0][0]

    backend, ends = jax.default_backend(), []
    for device, given in ((backend, x0), ("cpu", x0[:compared])):
        with jax.default_device(jax.devices(device)[0]):
            run = jax.jit(jax.vmap(improved))
            since = time.perf_counter()
            run(jnp.asarray(given)).block_until_ready()
            first = time.perf_counter() - since
            ends.append(np.asarray(run(jnp.asarray(given)).block_until_ready()))
            took = time.perf_counter() - since - first
        print(f"{device}: {len(given)} starts in {took:.2f} s ({first:.1f} s the first time, with compilation)")
    every = ends[0]
    values = [np.array([-learned.rank * problem.value(x) for x in end[:compared]]) for end in ends]
    apart = np.abs(values[0] - values[1]).max()
    print(f"log determinants of the same {len(values[1])} starts, {backend} and cpu: {apart:.2e} apart at most")
    if not apart < SAME_OPTIMUM:
        raise SystemExit(f"not the same optima: {values[0]} and {values[1]}")
    over = (every @ A.T - b).max(axis=1)
    told = np.array([-learned.rank * problem.value(x) for x in every])
    best = int(np.argmax(np.where(over < 0.02, told, -np.inf)))
    final = solve(problem, every[best])
    print(
        f"best of {len(every)}: {told[best]:.2f} (rows {over[best]:.1e} over), improved by SLSQP"
        f" {-learned.rank * problem.value(final):.2f}; median {np.median(told):.2f}"
    )


def peer(seeds: int = 20, seed: int = 0) -> None:
    """FIGAROH's problem: information and condition number, warm; so many seeds from `seed` on."""
    on_peer_problem(1)
    every = range(seed, seed + seeds)
    many = [on_peer_problem(1, seed=own) for own in every]
    for own, one in zip(every, many[:3], strict=False):
        told(f"one start, seed {own}", *one)
    for starts in (1, 2, 3):
        if starts > 1:
            many = [on_peer_problem(starts, seed=own) for own in every]
        logdet, cpu = (np.percentile(x, (25, 50, 75)) for x in zip(*((a.logdet, b) for a, b in many), strict=True))
        print(f"{seeds} seeds, {starts} starts, quartiles: logdet {np.round(logdet, 2)}, CPU s {np.round(cpu, 3)}")
    told("best of 32", *on_peer_problem(32))
    told("condition, best of 8", *on_peer_problem(8, "condition"))
    print(f"peer, quoted: {PEER}")


PARTS = {
    "peer": peer,
    "limits": limits,
    "clearance": clearance,
    "ipopt": ipopt,
    "descents": descents,
    "sequence": sequence,
    "postures": postures,
    "fresh": fresh,
    "views": views,
    "separation": separation,
    "chooser": chooser,
    "pays": pays,
    "ranking": ranking,
    "gpu": gpu,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS], help=f"default: all of {', '.join(PARTS)}")
    parser.add_argument("--cold", action="store_true", help="one start in a fresh process, programs compiled")
    parser.add_argument("--seed", type=int, help="of the random starts, where a part takes one")
    parser.add_argument("--starts", type=int, help="random starts, where a part takes them")
    parser.add_argument("--robots", nargs="+", choices=["UR10e", "Panda"], help="where a part takes them")
    parser.add_argument("--draws", type=int, help="simulations, where a part takes them")
    parser.add_argument("--harmonics", type=int, help="of the motions of `chooser`, of 0.1 Hz")
    parser.add_argument("--peer", help="FIGAROH's motion, of `peer_motion.py`, that `pays` compares with")
    parser.add_argument("--names", nargs="+", choices=list(PAIRS), help="pairs of causes, where a part takes them")
    args = parser.parse_args()
    assert fj.excite  # loaded before any clock starts
    if args.cold:
        if "clearance" in args.parts:
            clearance(args.seed, cold=True)
        else:
            told("one start, cold", *on_peer_problem(1))
        spent_by = os.times()
        compiler = spent_by.children_user + spent_by.children_system
        print(f"whole process {time.process_time():.2f} CPU s, C compiler {compiler:.2f}")
        return
    for part in args.parts or [name for name in PARTS if name != "gpu"]:
        print(f"== {part}")
        wanted = {name: getattr(args, name) for name in inspect.signature(PARTS[part]).parameters if name in args}
        PARTS[part](**{name: value for name, value in wanted.items() if value is not None})


if __name__ == "__main__":
    if "gpu" not in sys.argv:
        os.environ.setdefault("JAX_PLATFORMS", "cpu")
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
    import jax

    jax.config.update("jax_enable_x64", True)
    main()
