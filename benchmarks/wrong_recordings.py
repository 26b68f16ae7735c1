"""Wrong recordings: how many kinds are refused or warned of with the right advice, and how often right ones are.

`python benchmarks/wrong_recordings.py` spoils recordings of real and of made robots in 40 ways (`tests/spoiled.py`),
then shows the check every recording of the public sets and 60 made ones, which it must pass.
"""

from __future__ import annotations

import argparse
import logging
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("FIGAROH_JAX_DATA", ROOT.parent / "shared" / "data"))
sys.path.insert(0, str(ROOT / "tests"))

from spoiled import KINDS, POSTURES, Base, said  # noqa: E402

ENTRY = {"time": "t", "position": "q", "torque": "tau"}
UR = (10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232)  # N m/A
TIAGO = (13.6, 13.6, -8.7, -8.7)


def real() -> Iterator[Base]:
    """Every recording of torque of the public sets, on the joint side."""
    lwr = {"model": str(DATA / "kuka_lwr4" / "lwr4.urdf")}
    for file in sorted((DATA / "kuka_lwr4").glob("*.npz")):
        yield _base(f"kuka_{file.stem}", lwr, np.load(file), pair=(1, 3))
    panda = {"model": str(DATA / "panda_gaz2019/panda.urdf"), "joints": [f"panda_joint{k}" for k in range(1, 8)]}
    yield _base("panda", panda, np.load(DATA / "panda_gaz2019" / "panda_exciting_traj1.npz"), pair=(1, 3))
    yield _tx40()
    z = np.load(DATA / "tiago_dynamic" / "tiago_dynamic.npz")
    arm = {"model": str(DATA / "tiago_dynamic/tiago_no_hand.urdf"), "joints": [f"arm_{k}_joint" for k in range(1, 5)]}
    arrays = {"t": z["t"], "q": z["q"][:, 1:5], "dq": z["dq"][:, 1:5], "tau": z["effort"][:, 1:5] * TIAGO}
    yield _base("tiago", arm, arrays, pair=(2, 3), heavy=3)
    ur = {"model": str(DATA / "ur10e_innopolis" / "ur10e.urdf")}
    for file in sorted((DATA / "ur10e_innopolis").glob("*/*.npz")):
        z = np.load(file)
        if re.fullmatch(r".*_p\d+", file.stem):  # postures at rest: they stand beside a motion, alone they are refused
            continue
        yield _base(f"ur10e_{file.stem}", ur, {"t": z["t"], "q": z["q"], "dq": z["dq"], "tau": z["i"] * np.array(UR)})
    for folder, urdf in (("double", "double_pendulum_C1"), ("simple", "simple_pendulum")):
        robot = {"model": str(DATA / f"dfki_{folder}_pendulum" / f"{urdf}.urdf")}
        for file in sorted((DATA / f"dfki_{folder}_pendulum").glob("*.npz")):
            yield _base(f"{folder}_{file.stem}", robot, np.load(file), pair=(0, 1))
    arm = {"model": str(DATA / "so101_sage" / "so101.urdf")}
    for file in sorted((DATA / "so101_sage").glob("*.npz")):
        z = np.load(file)
        yield _base(f"so101_{file.stem}", arm, {"t": z["t"], "q": z["q"], "dq": z["dq"], "tau": z["torque_abs"]})


def _base(name: str, robot: dict[str, Any], z: Any, pair: tuple[int, int] = (1, 2), heavy: int = 1) -> Base:
    arrays = {key: np.asarray(z[key], float) for key in ("t", "q", "dq", "tau") if key in z}
    for key in arrays.keys() - {"t"}:
        arrays[key] = arrays[key].reshape(len(arrays["t"]), -1)
    entry = ENTRY | ({"velocity": "dq"} if "dq" in arrays else {})
    if name.startswith("so101"):
        entry = ENTRY  # its velocity of the jaw is in another unit, which the check says
    return Base(name, robot, arrays, entry, pair=pair, heavy=min(heavy, arrays["q"].shape[1] - 1))


def _tx40() -> Base:
    z = np.load(DATA / "staubli_tx40" / "tx40.npz")
    ratio = np.diag([32.0, 32, 45, -48, 45, 32])
    position, torque = ratio.copy(), ratio.copy()
    position[5, 4] = torque[4, 5] = 32
    q = np.linalg.solve(position, z["motor_position"].T).T + [0, -np.pi / 2, np.pi / 2, 0, 0, 0]
    arrays = {"t": np.arange(len(q)) / 5000, "q": q, "tau": z["motor_current"] @ torque.T}
    return _base("tx40", {"model": str(DATA / "staubli_tx40" / "tx40.urdf")}, arrays)


def made(count: int, folder: Path) -> Iterator[Base]:
    """Made recordings of four robots, one trajectory each, no effect hidden."""
    from generators import make_case

    for seed in range(count):
        name = ("small", "tx40", "panda", "ur10e")[seed % 4]
        case = make_case(robot=name, repeats=1, trajectories=1, seed=seed)
        urdf = folder / f"{name}.urdf"
        urdf.write_text(case.urdf)
        run = case.recordings[0]
        arrays = {"t": run["time"], "q": run["position"], "tau": run["torque"]}
        pair = {"small": (0, 1), "panda": (1, 3)}.get(name, (1, 2))
        yield _base(f"made_{name}_{seed}", {"model": str(urdf), "joints": list(case.joints)}, arrays, pair=pair)


def postures() -> Iterator[Base]:
    """Postures of two public sets."""
    z = np.load(DATA / "irb120_wu2015" / "irb120_wu.npz")
    keys = {"position": "q", "measurement": {"position": "p", "tool_frame": "tool0", "unknown": _UNKNOWN}}
    arrays = {"q": np.deg2rad(z["cali_q_deg"]), "p": z["cali_xyz_mm"][:, 0] * 1e-3}
    yield Base("irb120", {"model": str(DATA / "irb120_wu2015" / "irb120.urdf")}, arrays, keys)
    z = np.load(DATA / "panda_handeye_board" / "panda_handeye.npz")
    robot = {"model": str(DATA / "panda_handeye_board/panda.urdf"), "joints": [f"panda_joint{k}" for k in range(1, 8)]}
    keys = {"position": "q", "measurement": {"pose": "p", "tool_frame": "panda_link8", "unknown": _UNKNOWN}}
    yield Base("panda_board", robot, {"q": z["q"], "p": z["T_board_cam"]}, keys, pair=(1, 3))


_UNKNOWN = ["base_frame", "tool_frame"]


def wrong(bases: list[Base], kinds: dict[str, Any], folder: Path) -> tuple[int, list[str]]:
    """Kinds that are told on every base, and one line for each kind."""
    right, lines = 0, []
    for kind, (spoil, advice) in kinds.items():
        missed, refused = [], 0
        for base in bases:
            if kind == "mm on a revolute arm" and base.name.startswith("made_small"):
                continue  # it has a slide
            what, text = said(base, spoil, folder)
            refused += what == "refused"
            if not re.search(advice, text):
                missed.append(f"{base.name}: {what} {text[:160]}")
        right += not missed
        lines.append(f"{'ok  ' if not missed else 'MISS'} {kind:36} refused on {refused} of {len(bases)}")
        lines += [f"        {one}" for one in missed]
    return right, lines


def main() -> None:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--kind", action="append", default=[], help="this kind alone, silent on right recordings")
    parser.add_argument("--made", type=int, default=60, help="made recordings that must pass")
    args = parser.parse_args()
    logging.disable(logging.WARNING)
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recordings, simulated = list(real()), list(made(args.made, folder))
        chosen = ("kuka_measurements_3", "panda", "tx40", "ur10e_20_02_06_20sec_10harm", "ur10e_20_02_10_30sec_12harm")
        spoiled = [base for base in recordings if base.name in chosen] + simulated[:4]
        if args.kind:
            print("\n".join(wrong(spoiled, {kind: KINDS[kind] for kind in args.kind}, folder)[1]))
            return
        right, lines = wrong(spoiled, KINDS, folder)
        right_postures, more = wrong(list(postures()), POSTURES, folder)
        print("\n".join([*lines, *more]))
        total = len(KINDS) + len(POSTURES)
        print(f"kinds told with the right advice on every recording: {right + right_postures} of {total}")
        for title, group in (("public", [*recordings, *postures()]), ("made", simulated)):
            found = [(base.name, *said(base, None, folder)) for base in group]
            refusals = [(n, text) for n, what, text in found if what == "refused"]
            warned = [(n, text) for n, what, text in found if what == "warned"]
            print(f"{title}: {len(group)} right recordings, refused {len(refusals)}, warned of {len(warned)}")
            for n, text in [*refusals, *warned]:
                print(f"    {n}: {text.replace(chr(10), ' | ')[:220]}")
    print(f"{time.process_time() - begin:.0f} CPU s")


if __name__ == "__main__":
    main()
