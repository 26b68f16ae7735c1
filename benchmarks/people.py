"""Simulated people: sizes from markers, segments from two force plates, judged on motion that was not fitted.

    python benchmarks/people.py [--people N] [--seconds S] [--seed K]

Each person is 5-20 % off the model in every segment's length and inertial parameters; markers slide by 5 mm with the
skin and are seen to 2 mm; plates have noise and a zero of their own in every trial. A line is a person: RMS error of
the root's force (% of body weight) and moment (% of its RMS) on an unseen trial, against plates without errors, with
the identified person, the scaled one with the table alone and the unscaled model; error of mass (%) and centre of mass
(mm); share of the parameters within their 95 % intervals. `--load`: one more trial, with 3 to 8 kg at a hand, the head
or the thorax, for `name_payload`: the link that it names of all segments, and the mass. `--motion BASIS`: in place of
all this the motion of the whole person (39 joints) on the left foot that tells most of the segments by the plate below,
within the limits of the joints and in balance: seconds, the largest share of each limit at 1 kHz, what it tells.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from generators import people as simulated

import figaroh_jax as fj
from figaroh_jax.estimation import markers
from figaroh_jax.identification import people
from figaroh_jax.rigid.inertia import to_com

DATA = Path(os.environ.get("FIGAROH_JAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
URDF = DATA / "human_model" / "human.urdf"
CUTOFF = 2.5  # Hz: the motions have nothing above 0.9 Hz
BASES = {
    "fourier": fj.fourier(3, 0.2, 5.0),
    "slow": fj.fourier(3, 0.1, 10.0),
    "long": fj.fourier(5, 0.1, 10.0),
    "spline": fj.spline(6, 6.0),
    "quintic": fj.quintic(6, 10.0),
}
FRAMES = 24  # of each trial, by which sizes are found: skin slides slowly, and one trial is little


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--trials", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tissue", type=float, default=0.005, help="m, how far skin slides")
    parser.add_argument("--noise", type=float, default=0.002, help="m, of a marker")
    parser.add_argument(
        "--exact", choices=["sizes", "all"], help="true sizes, or true sizes and positions: what is left"
    )
    parser.add_argument("--load", action="store_true", help="a load that the person carries is to be named")
    parser.add_argument("--motion", choices=BASES, help="design a motion of all joints")
    parser.add_argument("--starts", type=int, default=1, help="of the design of a motion")
    parser.add_argument("--save", type=Path, help="folder for a file of errors and intervals for each person")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.motion:
        motion(options.motion, options.starts, options.seed)
        return
    print(
        f"{'person':>6}{'':4}{'force % BW':>24}{'moment %':>24}{'mass %':>8}{'com mm':>8}{'size %':>8}{'95 %':>7}   s"
    )
    print(f"{'':10}{'  found   table unscaled':>24}{'  found   table unscaled':>24}")
    for k in range(options.people):
        start = time.perf_counter()
        skin = {"tissue": options.tissue, "noise": options.noise}
        rng = np.random.default_rng(options.seed + k)
        line = study(rng, options.seconds, options.trials, skin, options.exact, options.load)
        force, moment = ("".join(f"{x:8.2f}" for x in line[key]) for key in ("force", "moment"))
        rest = f"{line['mass']:8.2f}{line['com']:8.2f}{line['size']:8.2f}{line['covered']:7.2f}"
        print(f"{options.seed + k:6}{'':4}{force}{moment}{rest}{time.perf_counter() - start:6.0f}", flush=True)
        if options.load:
            print("{:6}  load {:.1f} kg at {}: named {:.1f} +- {:.1f} kg at {}".format(options.seed + k, *line["load"]))
        if options.save is not None:
            options.save.mkdir(parents=True, exist_ok=True)
            np.savez(options.save / f"{options.exact}_{options.tissue}_{options.seed + k}.npz", **line)


def motion(basis: str, starts: int, seed: int) -> None:
    """A motion of all joints on one foot, as a user asks for it."""
    clock = [time.perf_counter()]
    robot = fj.load_urdf(URDF, root="free_flyer")
    upright = np.zeros(robot.nq)
    upright[:7] = [0.0, 0.0, 0.95, np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # the model's y is up
    person = people.standing(robot, "left_foot", upright, support=(0.1, 0.05))
    start = people.balanced(person)
    clock.append(time.perf_counter())
    sigma = dict(zip(people.PLATE, [3.0, 3.0, 3.0, 1.0, 1.0, 1.0], strict=True))  # N, N m
    still = fj.Baseline(viscous=False, coulomb=False)
    learned = fj.learn(person, still, measured=sigma, hold=people.PLATE, trust=0.25)
    limits = fj.limits_of(person, velocity=3.0, acceleration=10.0, scale=0.95)
    clock.append(time.perf_counter())
    found = fj.excite(person, BASES[basis], limits, learned, start=start, starts=starts, seed=seed)
    clock.append(time.perf_counter())
    stage, told = found.stages[0], found.std / found.std_before
    print(
        f"{basis}, {person.nv - 6} joints, {starts} starts, seed {seed}: limits {'met' if stage.met else 'NOT met'};"
        " {:.0f} s to balance, {:.0f} s to learn, {:.0f} s to design,".format(*np.diff(clock)),
        f"{stage.evaluations} evaluations, {time.process_time():.0f} CPU s in all",
    )
    print("  " + ", ".join(f"{use.kind} {use.joint} {100 * use.share:.1f} %" for use in stage.uses))
    print(
        f"  log determinant {stage.logdet:.1f}; of {learned.rank} base parameters {(told < 0.5).sum()} are told better"
        f" than by the table by half, {(told < 0.8).sum()} by a fifth",
        flush=True,
    )


def places(robot: fj.RobotModel) -> dict[str, tuple[str, np.ndarray]]:
    """Four markers on each segment, around its centre of mass and its far end, at places that the model states."""
    found = {}
    mass, com, about = (np.asarray(x) for x in to_com(np.asarray(robot.inertia)))
    for i, joint in enumerate(robot.joints):
        below = [np.asarray(robot.placement[k])[:3, 3] for k, o in enumerate(robot.joints) if o.parent == i]
        if mass[i] <= 0 and len(below) < 2:
            continue
        ends = [way for way in below if np.linalg.norm(way) > 0.05]
        end = ends[0] if ends else 1.6 * com[i]
        size = max(0.04, 0.25 * float(np.linalg.norm(end)))
        for k, way in enumerate(([0.0, 0, 0.6], [0.5, 0, -0.6], [-0.6, 0, 0.2], [0.3, 0.4, 0.3])):
            found[f"{joint.link}_{k}"] = joint.link, (0.1 + 0.3 * k) * end + size * np.array(way)
    return found


def study(
    rng: np.random.Generator,
    seconds: float,
    trials: int,
    skin: dict[str, float] | None = None,
    exact: str | None = None,
    load: bool = False,
) -> dict:
    """One person from end to end."""
    slide, seen = (skin or {}).get("tissue", 0.005), (skin or {}).get("noise", 0.002)
    robot = fj.load_urdf(URDF, root="free_flyer")
    person = simulated.make_person(str(URDF), rng)
    own = places(robot)
    joint_of = {joint.link: joint.name for joint in robot.joints}
    simulated.put_markers(person, {label: (joint_of[link], at) for label, (link, at) in own.items()}, rng)
    fitted = [simulated.record(person, rng, seconds, slide, seen) for _ in range(trials)]
    unseen = simulated.record(person, rng, seconds, slide, seen)
    data = size(robot, own, fitted) if exact is None else true_size(robot, own, person, fitted[0])
    known = person if exact == "all" else None
    captures = [captured(robot, own, data, trial, known)[0] for trial in fitted]
    judge = captured(robot, own, data, unseen, known)
    weight = float(np.mean([np.linalg.norm(c.wrench[:, :3], axis=1).mean() for c in captures]))
    table = people.anthropometric(robot, weight / 9.81, "male", np.asarray(data.scale))
    found = people.identify_segments(captures, table)
    unscaled = captured(robot, own, None, unseen)
    line = judged(person, robot, found, table, judge, unscaled, data, unseen)
    if load:
        link, what = carried(rng)
        joint = joint_of[link]
        trial = simulated.record(person, rng, seconds, slide, seen, (joint, what))
        named = people.name_payload([captured(robot, own, data, trial, known)[0]], found)
        line["load"] = what.mass, link, named.mass, named.std, named.link
    return line


def carried(rng: np.random.Generator) -> tuple[str, Any]:
    """A load and the link that carries it: a dumbbell, a rucksack or a helmet, about the link's frame."""
    import pinocchio as pin  # pyright: ignore[reportMissingImports]

    link, at, size = (
        ("left_hand", [0.0, -0.08, 0.0], 0.1),
        ("right_hand", [0.0, -0.08, 0.0], 0.1),
        ("middle_thorax", [-0.18, 0.15, 0.0], 0.25),
        ("middle_head", [0.0, 0.15, 0.0], 0.15),
    )[rng.integers(4)]
    mass = float(rng.uniform(3.0, 8.0))
    return link, pin.Inertia(mass, np.array(at) + rng.normal(0, 0.02, 3), mass * size**2 / 6 * np.eye(3))


def size(robot, own, trials):
    """Segments' sizes by a few frames of each trial."""
    pick = np.linspace(0, len(trials[0].time) - 1, FRAMES).astype(int)
    seen = {label: np.concatenate([trial.markers[label][pick] for trial in trials]) for label in trials[0].markers}
    return markers.segment_sizes(robot, markers.marker_data(robot, own, seen)).data


def true_size(robot, own, person, trial):
    """The sizes and the markers' places as they are."""
    data = markers.marker_data(robot, own, {label: at[:2] for label, at in trial.markers.items()})
    joint = {j.link: j.name for j in robot.joints}
    scale = np.array([person.scale[joint[name]] for name in data.names])
    true = [person.markers[label][1] for label in data.labels]
    shift = np.array(true) - np.append(scale, 1.0)[np.array(data.segment)[list(data.link)], None] * data.place
    return eqx.tree_at(lambda d: (d.scale, d.shift), data, (scale, shift))


def captured(robot, own, fitted, trial, known=None) -> tuple[people.Capture, people.Capture]:
    """Positions by inverse kinematics with the sizes found (None: the model's), and two captures.

    The first is of the plates, the second of what plates without noise and zeros would say. `known`: the person whose
    true positions are taken instead.
    """
    if known is not None:
        q, model = np.empty((len(trial.time), robot.nq)), fitted.robot(robot)
        for joint, at in zip(robot.joints, robot.dofs.positions, strict=True):
            there = known.model.joints[known.model.getJointId(joint.name if joint.parent >= 0 else "root_joint")]
            q[:, at] = trial.q[:, there.idx_q : there.idx_q + there.nq]
    else:
        data = markers.marker_data(robot, own, trial.markers)
        if fitted is not None:
            data = eqx.tree_at(lambda d: (d.scale, d.shift), data, (fitted.scale, fitted.shift))
        q, model = markers.joint_positions(robot, data).position, data.robot(robot)
    read, exact = (people.capture(model, trial.time, q, some, CUTOFF) for some in (trial.plates, trial.exact))
    return read, exact


def judged(person, robot, found, table, both, unscaled, data, unseen) -> dict:
    capture, truth = both[0], both[1].wrench  # what plates without errors measure, at the pelvis
    models = (found.model, both[1]), (table, both[1]), (robot, unscaled[1])
    errors = [people.predicted(m, c) - c.wrench for m, c in models]
    read = people.predicted(found.model, capture) - capture.wrench
    bw = 9.81 * sum(i.mass for i in person.model.inertias)
    moment = np.sqrt((truth[:, 3:] ** 2).mean())
    true = np.array(
        [person.model.inertias[person.model.getJointId(j.name)].toDynamicParameters() for j in robot.joints]
    )
    index = [robot.link_names.index(name) for name in found.links]
    off = (found.parameters - true[index]) / found.std
    import pinocchio as pin  # pyright: ignore[reportMissingImports]

    q = unseen.q[len(unseen.q) // 2]
    fitted_q = capture.position[len(capture.position) // 2]
    centre = pin.centerOfMass(person.model, person.model.createData(), q)
    scales = np.array([person.scale[next(j.name for j in robot.joints if j.link == n)] for n in data.names])
    return {
        "force": [100 * np.sqrt((e[:, :3] ** 2).sum(1).mean()) / bw for e in errors],
        "moment": [100 * np.sqrt((e[:, 3:] ** 2).mean()) / moment for e in errors],
        "read": [np.sqrt((read[:, :3] ** 2).sum(1).mean()), np.sqrt((read[:, 3:] ** 2).mean())],  # with plates' errors
        "mass": 100 * abs(found.mass()[0] * 9.81 / bw - 1),
        "com": 1e3 * float(np.linalg.norm(found.centre(fitted_q)[0] - centre)),
        "size": 100 * float(np.abs(np.asarray(data.scale) / scales - 1).mean()),
        "covered": float((np.abs(off) < 1.96).mean()),
        "off": off,
        "seen": found.seen,
        "noise": found.noise,
        "samples": found.samples,
        "links": np.array(found.links),
        "scale": np.asarray(data.scale) / scales - 1,
    }


if __name__ == "__main__":
    main()
