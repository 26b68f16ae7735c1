"""`figaroh-jax new` on made recordings in other orders, signs, units and clocks, and on those of the public sets.

A draft is right where it reads back the positions (and torques) that were made; else it has to be refused, or its
comments have to say what nothing bears out. `python benchmarks/new.py` counts right, refused, said and wrong;
`--as-they-are` takes the files of the public sets unchanged, first without options, then with what their owners know.
"""

from __future__ import annotations

import argparse
import collections
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))


FORMS = ("npz", "csv", "tsv", "mat", "h5", "parquet")


class Case(NamedTuple):
    """A recording that is known: of a made robot, or of a public set."""

    name: str
    model: Path
    joints: tuple[str, ...]
    straight: np.ndarray  # joints that slide
    arrays: dict[str, np.ndarray]  # t, q, tau


def made(count: int, folder: Path) -> Iterator[Case]:
    from generators import make_case

    for seed in range(count):
        robot = ("small", "tx40", "ur10e", "small")[seed % 4]
        case = make_case(robot=robot, repeats=1, trajectories=1, seed=seed)
        model = folder / f"robot_{seed}.urdf"
        model.write_text(case.urdf)
        run = case.recordings[0]
        arrays = {"t": run["time"], "q": run["position"], "tau": run["torque"]}
        yield Case(f"{seed} {robot}", model, case.joints, np.array([j == "slide" for j in case.joints]), arrays)


def real(each: int) -> Iterator[Case]:
    """Recordings of the public sets, at most `each` of a set."""
    import wrong_recordings

    import figaroh_jax as fj

    seen: collections.Counter[str] = collections.Counter()
    for base in wrong_recordings.real():
        kind = base.name.split("_")[0]
        seen[kind] += 1
        if "tau" not in base.arrays or seen[kind] > each:
            continue
        model = Path(base.robot["model"])
        joints = tuple(base.robot.get("joints") or fj.load_urdf(model).joint_names)
        yield Case(base.name, model, joints, np.zeros(len(joints), bool), base.arrays)


def spoiled(case: Case, rng: np.random.Generator) -> tuple[dict[str, np.ndarray], list[str] | None]:
    """A recording's columns under names, in an order, unit, sign and clock drawn at random, and what --joints says."""
    q, tau, joints = case.arrays["q"], case.arrays["tau"], case.joints
    shown = q if rng.random() < 0.5 else np.where(case.straight, q, np.rad2deg(q))
    sign = np.where(rng.random(len(joints)) < 0.2, -1.0, 1.0)
    factor = rng.choice([1.0, 1e3, 1e6, 1e9])
    time = case.arrays["t"] * factor + rng.choice([0.0, 1e3 * factor])
    if rng.random() < 0.5:  # named, in any order
        columns = {f"{joint}_pos": shown[:, j] for j, joint in enumerate(joints)}
        columns |= {f"{joint}_effort": (tau * sign)[:, j] for j, joint in enumerate(joints)}
        names = list(columns)
        rng.shuffle(names)
        return {"time": time, **{name: columns[name] for name in names}}, None
    order = np.arange(len(joints))
    if rng.random() < 0.5:
        rng.shuffle(order)
    return {"time": time, "q": shown[:, order], "tau": (tau * sign)[:, order]}, list(joints)


def written(columns: dict[str, np.ndarray], form: str, folder: Path) -> Path:
    """The columns in a file of a format."""
    file = folder / f"run.{form}"
    flat = {
        f"{n}{'_' + str(k) if x.ndim > 1 else ''}": c
        for n, x in columns.items()
        for k, c in enumerate(np.atleast_2d(x.T))
    }
    if form == "npz":
        np.savez(file, **columns)  # pyright: ignore[reportArgumentType]
    elif form in ("csv", "tsv"):
        mark = {"csv": ";", "tsv": "\t"}[form]
        np.savetxt(file, np.column_stack([*flat.values()]), "%.17g", mark, header=mark.join(flat), comments="# ")
    elif form == "mat":
        from scipy.io import savemat

        savemat(file, {"log": columns})
    elif form == "h5":
        import h5py

        with h5py.File(file, "w") as opened:
            for name, values in columns.items():
                opened[f"log/{name}"] = values
    else:
        import pandas as pd

        pd.DataFrame(flat).to_parquet(file)
    return file


def grade(task_text: str, assumed: tuple[str, ...], case: Case, folder: Path) -> str:
    from figaroh_jax.formats.config import load_task
    from figaroh_jax.formats.robotfile import load_robot
    from figaroh_jax.recordings.dataset import read_recordings

    (folder / "task.yaml").write_text(task_text)
    task = load_task(folder / "task.yaml")
    rollouts = task.data[0].torque is None
    (recording,) = read_recordings(task, load_robot(task), rollouts=rollouts)
    order = [case.joints.index(name) for name in recording.joints]
    q, tau = case.arrays["q"][:, order], case.arrays["tau"][:, order]
    if recording.stamps is not None and len(q) > 1:  # rows that were left out, told by their stamps
        kept = np.isin(recording.stamps, recording.time)
        q, tau = q[kept], tau[kept]
    off = np.abs(recording.position - q).max(axis=0) > 1e-6
    if not rollouts:
        assert recording.torque is not None
        off |= np.abs(recording.torque - tau).max(axis=0) > 1e-6
    if not off.any():
        return "right"
    unsure = " ".join(line for line in assumed if "nothing confirms" in line or "bear the order out" in line)
    borne = unsure.split("bear the order out at")[-1].split(";")[0] if "bear the order out" in unsure else ""
    names = np.array(recording.joints)[off]
    said = all(name in unsure.split("no column")[0] or (borne and name not in borne) for name in names)
    return "said" if said else f"WRONG at {', '.join(names)}"


UR = [10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232]  # N m/A
TX40 = [32.0, 32.0, 45.0, -48.0, 45.0, 32.0]  # gears of the motor side, whose wrist is coupled: no list can say that
TIAGO_GAINS = [1.0, 13.6, 13.6, -8.7, -8.7, -20.5968, -20.5968, -20.5968]
TIAGO = ["torso_lift_joint", *(f"arm_{k}_joint" for k in range(1, 8))]


class Set(NamedTuple):
    """A public set as it is: what its owner could say of it, and the arrays that hold positions and torque."""

    folder: str
    model: str
    files: str
    known: dict[str, Any] = {}
    arrays: tuple[str, str | None] = ("q", "tau")
    scale: Any = 1.0  # N m a unit


SETS = (
    Set("dfki_double_pendulum", "double_pendulum_C1.urdf", "*.npz", {"unit": "rad", "constants": [1.0, 1.0]}),
    Set("dfki_simple_pendulum", "simple_pendulum.urdf", "*.npz", {"unit": "rad", "constants": [1.0]}),
    Set("irb120_wu2015", "irb120.urdf", "*.npz"),
    Set("kuka_lwr4", "lwr4.urdf", "*.npz"),
    Set("mukca_panda", "panda.urdf", "data/*/*.npz"),
    Set("panda_gaz2019", "panda.urdf", "*.npz", {"joints": [f"panda_joint{k}" for k in range(1, 8)]}),
    Set("panda_handeye_board", "panda.urdf", "*.npz"),
    Set("servo_miuzei", "servo_meshfree.xml", "*.json"),
    Set("so101_sage", "so101.xml", "*.npz", arrays=("q", None)),
    Set(
        "staubli_tx40", "tx40.urdf", "tx40.npz", {"rate": 5000.0, "constants": TX40}, ("no array is on joint side", "")
    ),
    Set("talos_contact", "talos_full_v2.urdf", "*.csv"),
    Set(
        "tiago_dynamic",
        "tiago_no_hand.urdf",
        "*.npz",
        {"joints": TIAGO, "constants": TIAGO_GAINS},
        ("q", "effort"),
        TIAGO_GAINS,
    ),
    Set("tiago_mocap", "tiago_no_hand.urdf", "*.csv"),
    Set("ur10e_innopolis", "ur10e.urdf", "*/*.npz", {"constants": UR}, ("q", "i"), np.array(UR)),
)


def as_they_are(folder: Path) -> None:
    """Every file of every set, alone, with and without what is known of it; counts of each set."""
    import wrong_recordings

    from figaroh_jax.errors import InputError
    from figaroh_jax.formats.robotfile import read_robot
    from figaroh_jax.recordings.draft import draft_task

    total: collections.Counter[str] = collections.Counter()
    for one in SETS:
        model = wrong_recordings.DATA / one.folder / one.model
        counts: collections.Counter[str] = collections.Counter()
        messages: collections.Counter[str] = collections.Counter()
        for file in sorted((wrong_recordings.DATA / one.folder).glob(one.files)):
            for known in ({}, one.known) if one.known else ({},):
                try:
                    draft = draft_task(model, [file], **known)
                    joints = tuple(one.known.get("joints") or read_robot(model).joint_names)
                    found = grade(draft.text, draft.assumed, _true(one, file, joints), folder)
                except InputError as error:
                    found = "refused"
                    messages[str(error).removeprefix(str(file)).splitlines()[0][:150]] += 1
                counts[found.split()[0] + (" with options" if known else "")] += 1
                if found.startswith("WRONG"):
                    print(f"  {file.name} {[*known]}: {found}")
        total.update(counts)
        print(f"{one.folder}: {dict(counts)}", flush=True)
        for message, count in messages.most_common():
            print(f"    {count} x {message}")
    print(dict(total))


def _true(one: Set, file: Path, joints: tuple[str, ...]) -> Case:
    with np.load(file) as arrays:
        position, torque = (None if not name or name not in arrays else arrays[name] for name in one.arrays)
    if position is None:  # of motors, coupled and with other zeros: a draft has to say so
        none = np.full((1, len(joints)), np.inf)
        return Case(file.stem, file, joints, np.zeros(len(joints), bool), {"q": none, "tau": none})
    q = np.asarray(position, float).reshape(len(position), -1)
    if one.folder == "so101_sage":  # its jaw is a share of the range
        q = np.column_stack([q[:, :5], -0.174533 + 1523 * 2 * np.pi / 4096 * q[:, 5]])
    tau = (
        np.full(q.shape, np.nan) if torque is None else np.asarray(torque, float).reshape(q.shape) * np.array(one.scale)
    )
    return Case(file.stem, file, joints, np.zeros(len(joints), bool), {"q": q, "tau": tau})


def main() -> None:
    from figaroh_jax.errors import InputError
    from figaroh_jax.recordings.draft import draft_task

    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--cases", type=int, default=40, help="made recordings")
    parser.add_argument("--each", type=int, default=3, help="recordings of each public set")
    parser.add_argument("--as-they-are", action="store_true", help="the files of the public sets, unchanged")
    asked = parser.parse_args()
    if asked.as_they_are:
        with tempfile.TemporaryDirectory() as name:
            as_they_are(Path(name))
        return
    counts: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for k, case in enumerate([*made(asked.cases, folder), *real(asked.each)]):
            rng = np.random.default_rng(k)
            columns, joints = spoiled(case, rng)
            form = FORMS[k % len(FORMS)]
            file = written(columns, form, folder)
            try:
                draft = draft_task(case.model, [file], joints=joints if case.name[0].isalpha() else None)
                found = grade(draft.text, draft.assumed, case, folder)
            except InputError as error:
                found = f"refused: {str(error)[:160]}"
            counts[("real " if case.name[0].isalpha() else "made ") + found.split()[0].rstrip(":")] += 1
            print(f"{case.name} {form}: {found}", flush=True)
    print(dict(counts))


if __name__ == "__main__":
    main()
