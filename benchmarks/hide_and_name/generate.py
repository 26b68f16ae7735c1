"""Writes the cases: families of recordings made by `tests/generators` and `stiction`, in the form of `blackbox`."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .. import blackbox

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

ROBOTS = ("tx40", "panda", "ur10e")
ARMS = ("arm6", "panda")
# those of the contract that `generators` calls foreign to nothing: families that a catalogue should hold
MORE = (
    "link_inertia",
    "torque_lag",
    "torque_saturation",
    "presliding",
    "friction_drift",
    "contact",
    "external_wrench",
    "encoder_offset",
    "encoder_scale",
    "encoder_eccentricity",
    "backlash",
    "clock_error",
)
SIZES = {"inverse": (0.02, 0.05, 0.15), "closed_loop": (0.1,), "kinematic": (3.0, 10.0)}
LAYOUTS = {"repeats": (2, 3), "single": (1, 4)}


class Wish(NamedTuple):
    """One case to be made."""

    kind: str
    family: str  # the hidden effect; "clean": none
    robot: str
    layout: str
    size: float
    number: int = 0

    @property
    def name(self) -> str:
        size = f"-{self.size:g}" if self.size else ""
        number = f"-{self.number}" if self.family == "clean" else ""
        return f"{self.kind}/{self.family}{size}-{self.robot}-{self.layout}{number}"


def wishes(kinds: Sequence[str], clean: int, sizes: Sequence[float] | None = None) -> Iterator[Wish]:
    """All cases of the kinds; `clean` without any effect for each kind."""
    from generators import CLOSED_LOOP_EFFECTS, EFFECTS, FOREIGN, postures

    families = {
        "inverse": tuple(dict.fromkeys((*EFFECTS, *MORE, *FOREIGN))),
        "closed_loop": CLOSED_LOOP_EFFECTS,
        "kinematic": (*postures.EFFECTS, *postures.FOREIGN),
    }
    for kind in kinds:
        robots = ARMS if kind == "kinematic" else ROBOTS
        layouts = ["postures"] if kind == "kinematic" else list(LAYOUTS)
        count = 0
        for family in families[kind]:
            for size in sizes or SIZES[kind]:
                for place in robots if kind != "inverse" else layouts:
                    # inverse dynamics: both layouts, robots in turn; else every robot, layouts in turn
                    count += 1
                    robot = robots[count % len(robots)] if kind == "inverse" else place
                    layout = place if kind == "inverse" else layouts[count % len(layouts)]
                    yield Wish(kind, family, robot, layout, size)
        for number in range(clean):
            yield Wish(kind, "clean", robots[number % len(robots)], layouts[number % len(layouts)], 0.0, number)


def generate(folder: Path, seed: int, kinds: Sequence[str], clean: int, jobs: int, only: Sequence[str]) -> None:
    """Write the cases into `folder`, several at a time; those that are there already stay."""
    wanted = [w for w in wishes(kinds, clean) if not only or any(word in w.name for word in only)]
    with ProcessPoolExecutor(jobs) as pool:
        made = []
        for wish, case in zip(
            wanted, pool.map(_made, [folder] * len(wanted), [seed] * len(wanted), wanted), strict=True
        ):
            print(f"{wish.name}: {'not physical' if case is None else 'made'}", flush=True)
            made += [case] if case else []
    told = {"seed": seed, "commit": blackbox.commit(), "cases": made}
    (folder / "cases.json").write_text(json.dumps(told, indent=1))


def _made(folder: Path, seed: int, wish: Wish) -> dict[str, Any] | None:
    place = folder / wish.name
    known = place / "case.json"
    if known.is_file():
        return json.loads(known.read_text())
    case_seed = blackbox.digest(seed, wish.name)
    try:
        case = (_kinematic if wish.kind == "kinematic" else _dynamic)(folder, wish, case_seed)
    except np.linalg.LinAlgError:  # a ValueError too, but one of this generator's own
        raise
    except ValueError:  # no such size at any place
        return None
    known.write_text(json.dumps(case))
    return case


def _dynamic(folder: Path, wish: Wish, seed: int) -> dict[str, Any]:
    from generators.inverse import draw_case, record_case
    from generators.sensors import COLOURS

    from .stiction import make_stiction_case
    from .visible import Noise, seen, told

    repeats, trajectories = LAYOUTS[wish.layout]
    effects = [] if wish.family == "clean" else [(wish.family, wish.size)]
    drawn = noise = None
    if wish.kind == "closed_loop":
        made = make_stiction_case(effects, wish.robot, repeats, trajectories, seed)
    else:
        rng = np.random.default_rng(seed)
        scale, step = float(rng.choice([0.5, 1.0, 2.0])), float(rng.choice([1e-5, 1e-4]))
        noise = Noise(scale, str(rng.choice(COLOURS)), step)
        drawn = draw_case(effects, wish.robot, trajectories, seed)
        made = record_case(drawn, repeats, noise.scale, colour=noise.colour, encoder_step=noise.step)
    place = folder / wish.name
    task = json.loads(made.write(place).read_text())
    (place / "task.yaml").unlink()
    for entry in task["data"]:
        file = place / entry["file"]
        with np.load(file) as arrays:
            packed = {"t": arrays["t"], "q": arrays["q"], "tau": arrays["tau"].astype(np.float32)}
        np.savez_compressed(file, **packed)  # pyright: ignore[reportArgumentType]
    names = {t.effect: [list(t.at), t.parameters] for t in made.truth}
    truth = [{"effect": e, "at": at, "also": _also(wish.robot, at), "parameters": p} for e, (at, p) in names.items()]
    shown = told(seen(drawn, repeats, noise, task["preprocess"]["cutoff"])) if drawn and noise and drawn.hidden else {}
    return _case(wish, task, [t | {"names": _same(t["effect"])} for t in truth]) | shown


def _same(effect: str) -> list[str]:
    """Names that torque data of a moving robot cannot tell apart, beside those of `blackbox`."""
    from generators import CLASSES

    return sorted(set().union(*(names for names in CLASSES if effect in names)) - {effect})


def _also(robot: str, at: Sequence[str]) -> list[str]:
    """Further names of a link: what is fixed to it."""
    import pinocchio as pin  # pyright: ignore[reportMissingImports]
    from generators import robots

    made = robots.load(robot)
    if not at or at[0] not in made.links:
        return []
    joint = made.links.index(at[0]) + 1
    return [f.name for f in made.model.frames if f.type == pin.FrameType.BODY and f.parentJoint == joint]


def _kinematic(folder: Path, wish: Wish, seed: int) -> dict[str, Any]:
    from generators import postures

    from .. import hidden_kinematics as arms

    place = folder / wish.name
    place.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        arm = arms.arm(wish.robot, Path(scratch))
        hidden = postures.hide(
            arm, None if wish.family == "clean" else wish.family, wish.size, np.random.default_rng(seed)
        )
        (place / "robot.urdf").write_text(arm.path.read_text())
    data = []
    for k, recording in enumerate(hidden.recordings):
        given = postures.arguments(arm, recording, hidden)
        np.savez(place / f"run{k}.npz", t=recording.time, q=recording.q, seen=recording.seen)
        measurement = {given["kind"]: "seen", "unknown": list(hidden.unknown)}
        measurement |= {key: given[key] for key in ("base_frame", "tool_frame")}
        entry = {"file": f"run{k}.npz", "time": "t", "position": "q", "measurement": measurement}
        if given["load"]:
            entry["load"] = {**given["load"], "com": list(given["load"]["com"])}
        data.append(entry)
    task = {"robot": {"model": "robot.urdf", "joints": list(arm.joints)}, "data": data}
    right = [[effect, list(at)] for effect, at in sorted(hidden.right)]
    truth = [{"effect": wish.family, "at": [], "accept": right, "parameters": {}}] if right else []
    return _case(wish, task, truth)


def _case(wish: Wish, task: dict[str, Any], truth: list[dict[str, Any]]) -> dict[str, Any]:
    from generators import FOREIGN, postures

    foreign = wish.family in (*FOREIGN, *postures.FOREIGN)
    task["robot"]["model"] = "robot.urdf"
    for entry in task["data"]:
        entry["file"] = f"{wish.name}/{entry['file']}"
    case: dict[str, Any] = {"name": wish.name, "group": wish.kind, "size": wish.size, "task": task}
    case |= {"model": f"{wish.name}/robot.urdf", "family": wish.family, "truth": [] if foreign else truth}
    if truth and not foreign:
        case["forbid"] = sorted({wish.family, *truth[0].get("names", ()), *_twins(wish)})
    return case


def _twins(wish: Wish) -> set[str]:
    if wish.kind == "kinematic":  # an offset is a part of the link's geometry
        return (
            {"joint_offset", "link_geometry"}
            if wish.family in ("joint_offset", "link_geometry", "base_frame")
            else set()
        )
    return set().union(*(names for names in blackbox.EQUIVALENT if wish.family in names))
