"""MJCF files as strangers write them, moved by commands: `figaroh-jax simulate` and `export` against MuJoCo C.

    python benchmarks/loop_conditions.py --seeds 0 100 [--rare .03] | --files FOLDER [FOLDER ...]

With `--files` every MJCF in those folders is asked, its contacts switched off in MuJoCo. Else drawn are: a tree with
branches (fixed or free base; hinges, slides, balls, several joints of one body, bodies without a joint), how placements
and inertias are written (Euler angles, axes, quaternions, degrees, geoms, full inertias), classes of defaults, `ref`
and springs, armature, damping, friction with its solref and solimp, limits, ranges of torques, options and flags,
integrators, and actuators of every kind that is said to be simulated, at joints and fixed tendons, with gears, ranges,
activations and delays. With `--rare` each thing that is said not to be simulated is drawn too, one by one. What is read
must move as MuJoCo C moves the file, as `simulate` writes it, and as the exported `robot.xml` with its `callback.py`
moves; what is not simulated must be told or refused. One line a case; at the end whatever is odd.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import importlib.util
import io
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import equinox as eqx
import mujoco
import numpy as np

import figaroh_jax as fj
from figaroh_jax.cli import main as command_line
from figaroh_jax.errors import InputError

MADE: Any = mujoco
SAME = 1e-6  # rad or m, after every step
ROWS, EACH = 40, 5  # rows of commands, steps of each
NEVER = {  # what is not simulated, and a word with which it is told or refused
    "fluid": "fluid",
    "gravcomp": "gravcomp",
    "tendon spring": "tendon",
    "tendon limit": "tendon",
    "tendon armature": "tendon",
    "tendon range": "tendon",
    "muscle": "dyntype",
    "site": "no fixed tendon",
    "cubic delay": "cubic",
    "implicit": "implicit",
    "polynomial": "cubic stiffness",
    "contacts": "contacts",
    "weld": "equality",
    "actuation": "actuation",
    "ball limit": "several axes",
    "ball spring": "several axes",
    "free friction": "free joint",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", nargs=2, type=int, default=[0, 100], metavar=("FIRST", "END"))
    parser.add_argument("--rare", type=float, default=0.03, help="chance of each thing that is not simulated")
    parser.add_argument("--files", nargs="+", type=Path, metavar="FOLDER", help="of MJCF files, in place of drawn ones")
    parser.add_argument("--part", nargs=2, type=int, default=[0, 1], metavar=("K", "N"), help="every N-th file from K")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="write the files there")
    args = parser.parse_args()
    count: collections.Counter[str] = collections.Counter()
    odd = []
    for file in _files(args.files or [])[args.part[0] :: args.part[1]]:
        mark, line = asked(file)
        count[mark] += 1
        print(f"{file}: {mark}  {line}", flush=True)
        if mark in ("odd", "error"):
            odd.append(f"{file}: {mark}  {line}")
    for seed in range(*(args.seeds if not args.files else (0, 0))):
        text, told, rare = drawn(np.random.default_rng([seed, 78]), np.random.default_rng([seed, 80]), args.rare)
        if args.keep:
            args.keep.mkdir(parents=True, exist_ok=True)
            (args.keep / f"{seed}.xml").write_text(text)
        mark, line = answered(text, rare, seed)
        count[mark] += 1
        print(f"{seed}: {mark}  {told}{', ' if rare else ''}{', '.join(rare)}: {line}", flush=True)
        if mark in ("odd", "error", "silent"):
            odd.append(f"{seed}: {mark}  {told}{', ' if rare else ''}{', '.join(rare)}: {line}")
    print(dict(count))
    print(*odd, sep="\n")


def answered(text: str, rare: list[str], seed: int) -> tuple[str, str]:
    """What became of a file, in a word and in a line."""
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("error")
        folder = Path(name)
        file = folder / "robot.xml"
        file.write_text(text)
        try:
            model = MADE.MjModel.from_xml_path(str(file))
        except ValueError as error:
            return "no file", " ".join(str(error).split())[:120]
        try:
            loop, notes = fj.load_loop(file)
        except InputError as error:
            expected = any(NEVER[one] in str(error) for one in rare)
            return ("refused" if expected else "odd"), " ".join(str(error).split())[-150:]
        except Exception as error:  # whatever it is, it is found
            return "error", f"{type(error).__name__}: {' '.join(str(error).split())[:150]}"
        silent = [one for one in rare if not any(NEVER[one] in note for note in notes)]
        if notes:
            return ("silent" if silent else "told"), "; ".join(notes)[:150]
        return compared(model, loop, folder, seed)


def _files(folders: list[Path]) -> list[Path]:
    """Files with a robot or a scene in MJCF; what others include is none."""
    found = [file for folder in folders for file in sorted(folder.rglob("*.xml"))]
    return [file for file in found if b"<mujoco" in (text := file.read_bytes()) and b"<mujocoinclude" not in text]


def asked(file: Path) -> tuple[str, str]:
    """What became of a stranger's file, in a word and in a line."""
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", UserWarning)  # MuJoCo's, of words that it is going to forget
        try:
            spec = MADE.MjSpec.from_file(str(file))
            spec.option.disableflags |= int(MADE.mjtDisableBit.mjDSBL_CONTACT)
            model = spec.compile()
        except ValueError as error:
            return "no file", " ".join(str(error).split())[:120]
        try:
            loop, notes = fj.load_loop(file)
        except InputError as error:
            return "refused", " ".join(str(error).removeprefix(f"{file}: ").split())[:150]
        except Exception as error:  # whatever it is, it is found
            return "error", f"{type(error).__name__}: {' '.join(str(error).split())[:150]}"
        if others := [note for note in notes if not note.startswith("contacts")]:
            return "told", "; ".join(others)[:150]
        if not model.nu:
            return "no drive", ""
        wider = np.array([-0.001, 0.001])  # where a robot starts at a limit rounding decides whether that acts
        model.jnt_range[model.jnt_limited > 0] += wider
        loop = eqx.tree_at(lambda one: one.joints.limit, loop, loop.joints.limit + wider)
        return compared(model, loop, Path(name), 0)


def compared(model: Any, loop: Any, folder: Path, seed: int) -> tuple[str, str]:
    """MuJoCo C with the file, the motion that `simulate` writes, and MuJoCo C with what `export` writes."""
    rng, dt = np.random.default_rng([seed, 79]), float(model.opt.timestep)
    _solved(model)
    each = max(1, min(EACH, int(0.02 / dt + 1e-6)))  # rows further apart than that are set points
    t = each * dt * np.arange(ROWS)
    size, rate, phase = rng.uniform(0.2, 0.8, model.nu), rng.uniform(3.0, 12.0, model.nu), rng.uniform(0, 6, model.nu)
    u = size * np.sin(t[:, None] * rate + phase)
    u *= np.minimum(1.0, np.arange(ROWS) / 8)[:, None]  # MuJoCo's late drives see zero before the first step
    steps = np.repeat(u, each, axis=0)
    theirs = moved(model, lambda data, row: (data.ctrl.__setitem__(slice(None), row), MADE.mj_step(model, data)), steps)
    if not np.isfinite(theirs).all() or np.abs(theirs).max() > 20:
        return "unstable", ""
    names = [model.actuator(k).name or f"actuator {k}" for k in range(model.nu)]
    file, run = folder / "commands.csv", folder / "run"
    np.savetxt(file, np.column_stack([t, u]), "%.17g", ",", header=",".join(["time", *names]), comments="")
    try:
        fj.write_loop(loop, run / "model")
        said = io.StringIO()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said):
            words = ["simulate", str(run), "--command", str(file), "--out", str(folder / "out"), "--quiet"]
            code = command_line([*words, "--columns", ",".join(names)])
        if code:
            return "odd", f"simulate: {' '.join(said.getvalue().split())[:200]}"
        with np.load(folder / "out" / "simulation.npz") as found:
            ours = found["position"]
        # quaternions of balls and free bases stand x, y, z, w; MuJoCo's w, x, y, z
        want, places = theirs[::each], order(model, loop.robot)
        away = np.abs(aligned(ours, loop.robot) - aligned(want[:, places], loop.robot)).max()
        exported = replayed(run / "model", folder / "export", steps, loop.robot)[::each]
        apart = np.abs(exported - aligned(want[:, places], loop.robot)).max()
    except InputError as error:
        return "odd", " ".join(str(error).split())[-200:]
    except Exception as error:  # whatever it is, it is found
        return "error", f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    line = f"ours {away:.1e}, exported {apart:.1e}, moves {np.ptp(want, axis=0).max():.2g}"
    return ("same" if max(away, apart) < SAME else "odd"), line


def _solved(model: Any) -> None:
    """MuJoCo solves its constraints to the end: its own tolerance, 1e-8, is up to 1e-6 rad in .4 s."""
    model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, 200, 100


def moved(model: Any, step: Callable[[Any, np.ndarray], Any], commands: np.ndarray) -> np.ndarray:
    data, seen = MADE.MjData(model), []
    for row in commands:
        seen.append(data.qpos.copy())
        step(data, row)
    return np.array(seen)


def order(model: Any, robot: Any) -> list[int]:
    """Where the numbers of our position stand in MuJoCo's."""
    places = []
    for joint in robot.joints:
        many = {"free": 7, "spherical": 4}.get(joint.kind, 1)
        nameless = joint.kind == "free" and joint.name not in [model.joint(k).name for k in range(model.njnt)]
        at = int(model.jnt_qposadr[model.jnt_type == 0][0] if nameless else model.joint(joint.name).qposadr[0])
        if many > 1:
            quaternion = at + many - 4
            places += [*range(at, quaternion), quaternion + 1, quaternion + 2, quaternion + 3, quaternion]
        else:
            places.append(at)
    return places


def aligned(position: np.ndarray, robot: Any) -> np.ndarray:
    """Quaternions with the sign of their scalar part in the first row: both signs are one turn."""
    found, at = position.copy(), 0
    for joint in robot.joints:
        many = {"free": 7, "spherical": 4}.get(joint.kind, 1)
        if many > 1:
            turn = found[:, at + many - 4 : at + many]
            turn *= np.where(turn @ np.array([0.3, 0.4, 0.5, 0.7]) < 0, -1.0, 1.0)[:, None]
        at += many
    return found


def replayed(run: Path, out: Path, steps: np.ndarray, robot: Any) -> np.ndarray:
    """MuJoCo C with the files of `export --for mujoco --out`, as a user reads them."""
    with contextlib.redirect_stdout(io.StringIO()):
        if command_line(["export", str(run), "--for", "mujoco", "--out", str(out)]):
            raise InputError("export failed")
    spec = importlib.util.spec_from_file_location("callback", out / "callback.py")
    assert spec is not None and spec.loader is not None
    written = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(written)
    model = MADE.MjModel.from_xml_path(str(out / "robot.xml"))
    _solved(model)
    rest = written.Rest(model, out / "loop.json")
    return aligned(moved(model, rest.step, steps)[:, order(model, robot)], robot)


def drawn(rng: np.random.Generator, apart: np.random.Generator, rare: float) -> tuple[str, str, list[str]]:
    """A file, what was drawn in words, and what in it is not simulated."""
    odd = [one for one in NEVER if apart.random() < rare]
    degree, euler = bool(rng.random() < 0.5), str(rng.choice(["xyz", "XYZ", "zyx", "ZXZ"]))
    joints: list[tuple[str, str]] = []  # names and kinds
    bodies = int(rng.integers(1, 7))
    texts = {k: _body(rng, k, degree, joints, odd) for k in range(bodies)}
    parents = [-1] + [int(rng.integers(max(0, k - 3), k)) if rng.random() < 0.9 else -1 for k in range(1, bodies)]
    if not any(kind in ("hinge", "slide") for _, kind in joints):  # a drive needs one
        head, inner, tail = texts[0]
        mass = '<inertial pos=".1 0 0" mass=".4" diaginertia=".01 .01 .01"/>'
        tip = f'<body pos="0 .2 0"><joint name="tip" damping=".2" armature=".02"/>{mass}</body>'
        texts[0] = (head, inner + tip, tail)
        joints.append(("tip", "hinge"))

    def nested(k: int) -> str:
        head, inner, tail = texts[k]
        return head + inner + "".join(nested(i) for i in range(bodies) if parents[i] == k) + tail

    world = "".join(nested(k) for k in range(bodies) if parents[k] == -1)
    single = [name for name, kind in joints if kind in ("hinge", "slide")]
    scheme = str(rng.choice(["Euler", "implicitfast", "implicitfast", "RK4"]))
    if "implicit" in odd:
        scheme = "implicit"
    step = float(rng.choice([0.0005, 0.001, 0.002, 0.004]))
    flags = [
        one
        for one in (
            "limit",
            "frictionloss",
            "spring",
            "damper",
            "gravity",
            "clampctrl",
            "refsafe",
            "eulerdamp",
            "constraint",
            "filterparent",
            "warmstart",
        )
        if rng.random() < 0.05
    ]
    words = "".join(f' {one}="disable"' for one in [*flags, *({"actuation"} & {*odd})])
    if "contacts" not in odd:
        words += ' contact="disable"'
    more = ' density="1.2" viscosity=".01"' if "fluid" in odd else ""
    gravity = " ".join(f"{x:.3g}" for x in (rng.normal(0, 4, 3) if rng.random() < 0.3 else (0, 0, -9.81)))
    tendons, actuators = _tendons(rng, single, odd), []
    for k in range(int(rng.integers(1, len(single) + 2))):
        actuators.append(_actuator(rng, k, single, [f"tendon{i}" for i in range(len(tendons))], odd, step))
    equality = '<equality><weld body1="b0"/></equality>' if "weld" in odd else ""
    limits = ' autolimits="false"' if rng.random() < 0.05 else ""
    text = (
        f'<mujoco model="drawn"><compiler angle="{"degree" if degree else "radian"}" eulerseq="{euler}"{limits}/>'
        f'<option timestep="{step}" integrator="{scheme}" gravity="{gravity}"{more}><flag{words}/></option>'
        '<default><joint damping=".2" armature=".03"/><default class="heavy"><joint damping="1.5" frictionloss=".2"/>'
        '<geom density="2000"/><position kp="30"/><default class="light"><joint armature=".01"/></default></default>'
        "</default>"
        f'<worldbody>{world}<site name="world"/></worldbody>'
        + (f"<tendon>{''.join(tendons)}</tendon>" if tendons else "")
        + f"<actuator>{''.join(actuators)}</actuator>{equality}</mujoco>"
    )
    kinds = collections.Counter(kind for _, kind in joints)
    told = f"{dict(kinds)} {scheme} {step}{' off: ' + ' '.join(flags) if flags else ''}"
    return text, told, odd


def _numbers(values: Any) -> str:
    return " ".join(f"{x:.5g}" for x in np.atleast_1d(values))


def _turned(rng: np.random.Generator, degree: bool) -> str:
    """A rotation, in one of the ways that MJCF has."""
    kind, unit = int(rng.integers(5)), 57.3 if degree else 1.0
    if kind == 0:
        return ""
    if kind == 1:
        return f' euler="{_numbers(rng.normal(0, 0.7, 3) * unit)}"'
    if kind == 2:
        return f' quat="{_numbers(rng.normal(0, 1, 4))}"'
    if kind == 3:
        return f' axisangle="{_numbers(np.r_[rng.normal(0, 1, 3), rng.normal(0, 1) * unit])}"'
    return f' xyaxes="{_numbers(np.r_[rng.normal(0, 1, 3), rng.normal(0, 1, 3)])}"'


def _body(
    rng: np.random.Generator, k: int, degree: bool, joints: list[tuple[str, str]], odd: list[str]
) -> tuple[str, str, str]:
    """Opening, content and closing of a body; its joints are added to `joints`."""
    gravcomp = ' gravcomp=".5"' if "gravcomp" in odd and k == 0 else ""
    child = f' childclass="{rng.choice(["heavy", "light"])}"' if rng.random() < 0.2 else ""
    head = f'<body name="b{k}" pos="{_numbers(rng.normal(0, 0.2, 3))}"{_turned(rng, degree)}{child}{gravcomp}>'
    draw, found = rng.random(), ""
    if k == 0 and (draw < 0.12 or "free friction" in odd):
        loss = ' frictionloss=".1"' if "free friction" in odd else ""
        found = f'<joint name="base" type="free"{loss}/>' if loss or draw > 0.06 else '<freejoint name="base"/>'
        joints.append(("base", "free"))
    elif draw > 0.93 or "ball limit" in odd or "ball spring" in odd:
        more = ' range="0 1" limited="true"' if "ball limit" in odd else ""
        more += ' stiffness="2"' if "ball spring" in odd else ""
        more += f' pos="{_numbers(rng.normal(0, 0.05, 3))}"'
        found = f'<joint name="ball{k}" type="ball" damping=".3" armature=".02" {more}/>'
        joints.append((f"ball{k}", "ball"))
    elif draw > 0.15 or k == 0:
        for i in range(1 if rng.random() < 0.85 else 2):
            kind = "slide" if rng.random() < 0.2 else "hinge"
            found += _joint(rng, f"joint{k}{'ab'[i]}", kind, degree, odd)
            joints.append((f"joint{k}{'ab'[i]}", kind))
    return head, found + _mass(rng, degree), "</body>"


def _joint(rng: np.random.Generator, name: str, kind: str, degree: bool, odd: list[str]) -> str:
    unit = 57.3 if degree and kind == "hinge" else 1.0
    words = [f'name="{name}" type="{kind}" axis="{_numbers(rng.normal(0, 1, 3))}"']
    add = lambda chance, text: words.append(text) if rng.random() < chance else None  # noqa: E731
    add(0.3, f'pos="{_numbers(rng.normal(0, 0.1, 3))}"')
    add(0.2, f'class="{rng.choice(["heavy", "light"])}"')
    ref = float(rng.normal(0, 0.4)) if rng.random() < 0.25 else 0.0
    if ref:
        words.append(f'ref="{ref * unit:.5g}"')
    add(0.3, f'stiffness="{rng.uniform(1, 8):.4g}" springref="{rng.normal(0, 0.3) * unit:.4g}"')
    add(0.5, f'damping="{rng.uniform(0, 1):.4g}"')
    add(0.5, f'armature="{rng.uniform(0.005, 0.1):.4g}"')
    add(0.5, f'frictionloss="{rng.uniform(0.02, 0.4):.4g}"')
    add(0.15, f'solreffriction="{rng.uniform(0.005, 0.05):.4g} {rng.uniform(0.5, 1.5):.4g}"')
    add(0.08, f'solreffriction="{-rng.uniform(50, 500):.4g} {-rng.uniform(5, 50):.4g}"')
    add(0.15, f'solimpfriction="{rng.uniform(0.3, 0.9):.4g} {rng.uniform(0.9, 0.99):.4g} .002"')
    if rng.random() < 0.4:
        low, high = sorted(ref + rng.uniform(-0.5, 0.5, 2))
        words.append(f'range="{low * unit:.4g} {high * unit:.4g}"')
        add(0.5, 'limited="true"')
        add(0.2, f'margin="{rng.uniform(0, 0.05):.4g}"')
        add(0.3, f'solreflimit="{rng.uniform(0.005, 0.05):.4g} {rng.uniform(0.5, 1.5):.4g}"')
        add(0.2, f'solimplimit="{rng.uniform(0.3, 0.9):.4g} {rng.uniform(0.9, 0.99):.4g} .01 .4 3"')
    add(0.15, f'actuatorfrcrange="-{rng.uniform(1, 5):.4g} {rng.uniform(1, 5):.4g}"')
    if "polynomial" in odd:
        words.append('stiffness="3 .5 .2"')
    # an attribute may stand once
    seen = dict(part.split('="', 1) for part in " ".join(words).replace('" ', '"\n').split("\n"))
    return "<joint " + " ".join(f'{key.strip()}="{value}' for key, value in seen.items()) + "/>"


def _mass(rng: np.random.Generator, degree: bool) -> str:
    kind = int(rng.integers(4))
    if kind == 0:
        along = f'fromto="0 0 0 {_numbers(rng.normal(0, 0.2, 3))}"'
        return f'<geom type="capsule" size=".03" {along} mass="{rng.uniform(0.3, 2):.4g}"/>'
    if kind == 1:
        return (
            f'<geom type="box" size=".05 .08 .04" pos="{_numbers(rng.normal(0, 0.1, 3))}"{_turned(rng, degree)}/>'
            f'<geom type="sphere" size=".04" pos="{_numbers(rng.normal(0, 0.1, 3))}" density="800"/>'
        )
    a = rng.normal(0, 1, (3, 3))
    full = 0.01 * (a @ a.T / 3 + 0.3 * np.eye(3))
    full = np.trace(full) * np.eye(3) - full
    at, mass = _numbers(rng.normal(0, 0.1, 3)), float(rng.uniform(0.3, 3))
    if kind == 2:
        inertia = _numbers([full[0, 0], full[1, 1], full[2, 2], full[0, 1], full[0, 2], full[1, 2]])
        return f'<inertial pos="{at}" mass="{mass:.4g}" fullinertia="{inertia}"/>'
    moments = np.linalg.eigvalsh(full)
    return f'<inertial pos="{at}" mass="{mass:.4g}" diaginertia="{_numbers(moments)}"{_turned(rng, degree)}/>'


def _tendons(rng: np.random.Generator, single: list[str], odd: list[str]) -> list[str]:
    rare = [one for one in odd if one.startswith("tendon")]
    if not rare and rng.random() > 0.25:
        return []
    words = {
        "tendon spring": 'stiffness="2" damping=".1" springlength="0"',
        "tendon limit": 'range="-.1 .1" limited="true"',
        "tendon armature": 'armature=".05"',
        "tendon range": 'actuatorfrcrange="-.3 .3" actuatorfrclimited="true"',
    }
    at = rng.choice(single, size=min(len(single), int(rng.integers(1, 3))), replace=False)
    parts = "".join(f'<joint joint="{name}" coef="{rng.uniform(0.3, 1.5) * rng.choice([-1, 1]):.4g}"/>' for name in at)
    return [f'<fixed name="tendon0" {" ".join(words[one] for one in rare)}>{parts}</fixed>']


def _actuator(
    rng: np.random.Generator, k: int, single: list[str], tendons: list[str], odd: list[str], step: float
) -> str:
    """One actuator; the first one carries what is rare, and a tendon's where there is one."""
    at = f'joint="{rng.choice(single)}"'
    if tendons and (k == 0 or rng.random() < 0.3):
        at = f'tendon="{tendons[0]}"'
    elif rng.random() < 0.1:
        at = at.replace("joint=", "jointinparent=")
    name = f'name="{rng.choice(["act", "servo ", "m/"])}{k}"' if rng.random() < 0.85 else ""
    if k == 0 and "muscle" in odd:
        return f'<muscle {name} {at} lengthrange="0 1"/>'
    if k == 0 and "site" in odd:
        return f'<general {name} site="world" gear="1 0 0 0 0 0"/>'
    words = [name, at]
    add = lambda chance, text: words.append(text) if rng.random() < chance else None  # noqa: E731
    add(0.3, f'gear="{rng.uniform(0.3, 3) * rng.choice([-1, 1]):.4g}"')
    add(0.3, f'forcerange="-{rng.uniform(0.5, 6):.4g} {rng.uniform(0.5, 6):.4g}" forcelimited="true"')
    add(0.3, f'ctrlrange="-{rng.uniform(0.1, 0.6):.4g} {rng.uniform(0.1, 0.6):.4g}" ctrllimited="true"')
    late = "cubic" if k == 0 and "cubic delay" in odd else str(rng.choice(["zoh", "linear"]))
    add(1.0 if late == "cubic" else 0.12, f'delay="{rng.uniform(1, 4) * step:.5g}" nsample="8" interp="{late}"')
    kind = str(rng.choice(["position", "position", "motor", "velocity", "general", "intvelocity", "damper"]))
    if kind == "position":
        add(0.7, f'kp="{rng.uniform(5, 40):.4g}"')
        words.append(
            f'kv="{rng.uniform(0.1, 2):.4g}"' if rng.random() < 0.7 else f'dampratio="{rng.uniform(0.3, 1):.3g}"'
        )
        add(0.2, f'timeconst="{rng.uniform(0.01, 0.1):.4g}"')
    elif kind == "velocity":
        words.append(f'kv="{rng.uniform(0.2, 2):.4g}"')
    elif kind == "intvelocity":
        words.append(f'kp="{rng.uniform(5, 40):.4g}" kv="{rng.uniform(0.2, 1):.4g}" actrange="-.5 .5"')
    elif kind == "damper":
        words = [w for w in words if not w.startswith("ctrlrange")]
        words.append(f'kv="{rng.uniform(0.2, 2):.4g}" ctrlrange="0 1"')
    elif kind == "general":
        affine = rng.random() < 0.5
        words.append(f'gainprm="{_numbers(rng.uniform(1, 6, 1) if not affine else np.r_[3.0, rng.normal(0, 0.5, 2)])}"')
        words.append(f'gaintype="{"affine" if affine else "fixed"}"')
        add(0.7, f'biastype="affine" biasprm="{_numbers([rng.normal(), -rng.uniform(1, 20), -rng.uniform(0.1, 1)])}"')
        dynamic = str(rng.choice(["none", "filter", "filterexact", "integrator"]))
        if dynamic != "none":
            words.append(f'dyntype="{dynamic}" dynprm="{rng.uniform(0.01, 0.1):.4g}"')
            add(0.4, 'actlimited="true" actrange="-.4 .4"')
            add(0.3, 'actearly="true"')
    return f"<{kind} {' '.join(word for word in words if word)}/>"


if __name__ == "__main__":
    main()
