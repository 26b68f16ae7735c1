"""Pages that are made from the code while the site is built: the task file, every effect, FIGAROH's keys, the API."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import jax
import mkdocs_gen_files
import numpy as np

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

import figaroh_jax as fj  # noqa: E402
from figaroh_jax.effects.kinematic import CATALOGUE as KINEMATIC  # noqa: E402
from figaroh_jax.formats import reference  # noqa: E402
from figaroh_jax.recordings.migration import KEYS  # noqa: E402
from figaroh_jax.reporting.rollout_effects import NOT_LOOKED_FOR, ROLLOUT_EFFECTS  # noqa: E402
from figaroh_jax.rollouts.parameters import Entry, put, values  # noqa: E402

jax.config.update("jax_enable_x64", True)
SIZES = {"mass": 0.5, "com_x": 0.05, "com_y": 0.02, "com_z": 0.05, "height": 0.35, "x": 0.1}
SIZES |= {"rate": 1e-3, "speed": 0.4, "limit": 3.0}


def page(path: str, text: str) -> None:
    with mkdocs_gen_files.open(path, "w") as file:
        file.write(text)


def motion() -> tuple[np.ndarray, ...]:
    """Six seconds of the demo's arm: every joint moves, with reversals at many speeds."""
    t = np.arange(0, 6, 0.005)
    q, v, a = (np.zeros((len(t), 4)) for _ in range(3))
    for j, (frequency, size) in enumerate([(0.31, 0.9), (0.43, 0.6), (0.57, 0.8), (0.71, 0.9)]):
        for k, share in ((1, 0.8), (3, 0.2)):
            w = 2 * np.pi * frequency * k
            q[:, j] += size * share * np.sin(w * t + j)
            v[:, j] += size * share * w * np.cos(w * t + j)
            a[:, j] -= size * share * w**2 * np.sin(w * t + j)
    return t, q, v, a


def signature(name: str, effect: Any) -> str | None:
    """What the effect adds to the torque of the elbow of the demo's arm, against time, position and velocity."""
    robot = fj.load_urdf(fj.DEMO)
    base = [fj.place(fj.CATALOGUE["viscous_friction"], robot, [j], damping=0.5) for j in robot.joint_names]
    base += [fj.place(fj.CATALOGUE["coulomb_friction"], robot, [j], force=0.8) for j in robot.joint_names]
    at: dict[str, list[str]] = {"joint": ["elbow"], "pair": ["elbow", "wrist"], "link": [robot.joints[-1].link]}
    sizes = {}
    for key, parameter in effect.parameters().items():
        middle = parameter.grid[len(parameter.grid) // 2] if parameter.grid else 0.2
        sizes[key] = float(np.clip(SIZES.get(key, middle), parameter.lower, parameter.upper))
    placed = fj.place(effect, robot, at.get(effect.acts_on, []), **sizes)
    t, q, v, a = motion()
    without = np.asarray(fj.predict(fj.extend(robot, *base, width=0.02), t, q, v, a, 0.005))
    with_it = np.asarray(fj.predict(fj.extend(robot, *base, placed, width=0.02), t, q, v, a, 0.005))
    j = 3 if effect.acts_on == "link" else 2 if effect.acts_on != "robot" else 1
    added = (with_it - without)[20:-20, j]
    if not np.isfinite(added).all() or np.ptp(added) == 0 and not added.any():
        return None
    axes = [("time, s", t[20:-20]), ("position, rad", q[20:-20, j]), ("velocity, rad/s", v[20:-20, j])]
    text = f"Torque that {escape(name)} adds at the joint {robot.joint_names[j]}, against time, position and velocity"
    return svg(text, [drawing(x, added, label, 8 + 215 * k) for k, (label, x) in enumerate(axes)])


def svg(text: str, parts: Sequence[str]) -> str:
    """Drawings side by side under a text that says what they show."""
    lines = "polyline{fill:none;stroke:#0072b2}path{stroke:#bbb;fill:none}"
    style = f"<style>text{{font:11px sans-serif;fill:#777}}{lines}</style>"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 650 170" role="img" aria-label="{text}">{style}'
        f"{''.join(parts)}</svg>"
    )


def drawing(x: np.ndarray, y: np.ndarray, label: str, left: float) -> str:
    low, high = min(float(y.min()), 0.0), max(float(y.max()), 0.0)
    across = left + 200 * (x - x.min()) / np.ptp(x)
    up = 135 - 120 * (y - low) / max(high - low, 1e-12)
    zero = 135 - 120 * (0 - low) / max(high - low, 1e-12)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(across[::2], up[::2], strict=True))
    axis = f'<path d="M{left} {zero:.1f}h200M{left} 15v120"/>'
    return f'{axis}<polyline points="{points}"/><text x="{left + 60}" y="155">{label}</text>'


def words(names: Sequence[str]) -> str:
    return ", ".join(f"`{name}`" for name in names) or "nothing else of the catalogue"


def said_by(effect: Any) -> str:
    """In which simulators' words the effect can be said: by the elements of MJCF and URDF that the export writes."""
    try:
        source = inspect.getsource(effect.native)
    except (TypeError, OSError):
        source = ""
    elements = [
        e for e in ("damping", "frictionloss", "armature", "stiffness", "springref", "bias") if f'"{e}"' in source
    ]
    if effect.inertial or effect.body:
        return "MuJoCo, URDF and every simulator: it is an inertia of a link"
    if not elements:
        return "no simulator's file: `model/effects.yaml` holds it, and `fj.simulate` steps it"
    urdf = [e for e in elements if e in ("damping", "frictionloss")]
    return f"MuJoCo ({', '.join(elements)})" + (
        f", URDF ({', '.join(urdf).replace('frictionloss', 'friction')})" if urdf else ""
    )


def effect_page(name: str, effect: Any, kinematic: bool) -> str:
    rows = [f"| `{key}` | {unit or '1'} |" for key, unit in effect.units().items()]
    apart = (effect.separated_by_postures if kinematic else "") or effect.separated_by or "–"
    hidden = [*effect.contains, *effect.resembles, *effect.indistinguishable_from]
    picture = None if kinematic else signature(name, effect)
    if picture is not None:
        page(f"effect/{name}.svg", picture)
    doc = inspect.getdoc(effect) or ""
    return "\n".join(
        [
            f"# {name}",
            "",
            f"{effect.title[:1].upper()}{effect.title[1:]}. {doc.splitlines()[0] if doc else ''}",
            "",
            f"Acts on a {effect.acts_on}. Seen in {'measured poses' if kinematic else 'recordings of torque'}.",
            "",
            f"    {effect.equation}",
            "",
            *([f"![signature]({name}.svg)", ""] if picture is not None else []),
            "| parameter | unit |",
            "|---|---|",
            *(rows or ["| – | |"]),
            "",
            f"**What hides it**: {words(hidden)}; and whatever the baseline absorbs, which the report lists under"
            " *What this data could reveal*.",
            "",
            f"**How to excite it**: {apart.format(at=f'the {effect.acts_on}')}.",
            "",
            f"**Where it can be said**: {said_by(effect)}.",
            "",
        ]
    )


SERVO = {"elbow": {"kind": "position", "kp": 40.0, "kd": 1.5, "force": 30.0}}


def servo_motion() -> tuple[Any, np.ndarray, np.ndarray]:
    """The elbow of the demo's arm behind a position servo, its command, and where it starts."""
    loop, _ = fj.load_loop(fj.DEMO, SERVO, joints=["elbow"])
    t = np.arange(0, 6, float(loop.dt))
    u = 0.8 * np.sin(2 * np.pi * 0.5 * t) + 0.3 * np.sign(np.sin(2 * np.pi * 0.23 * t + 1.0))
    return loop, u[:, None], np.array([u[0]])


def rollout_signature(name: str, effect: Any) -> str | None:
    """By what the effect moves the elbow away from where it would be, against time, position and velocity."""
    if not effect.number:
        return None
    loop, u, start = servo_motion()
    plain = tuple(Entry(number, (0,)) for number in ("friction", "damping", "armature"))
    base = put(loop, plain, np.array([0.5, 0.3, 0.05]))
    table = (Entry(effect.number, (0,)),)
    more = effect.size + (float(values(base, table)[0]) if table[0] in plain else 0.0)
    without, with_it = (fj.rollout(one, u, start) for one in (base, put(base, table, np.array([more]))))
    step = slice(None, None, max(1, len(u) // 1200))
    t, q, v = (np.asarray(x)[step] for x in (without.time, without.position[:, 0], without.velocity[:, 0]))
    moved = np.asarray(with_it.reading - without.reading)[step, 0]
    axes = [("time, s", t), ("position, rad", q), ("velocity, rad/s", v)]
    text = f"By what {escape(name)} moves the elbow of a position servo, rad, against time, position and velocity"
    return svg(text, [drawing(x, moved, label, 8 + 215 * k) for k, (label, x) in enumerate(axes)])


def rollout_page(name: str, effect: Any) -> str:
    """A page like those of the other effects."""
    picture = rollout_signature(name, effect)
    if picture is not None:
        page(f"effect/{name}_rollout.svg", picture)
    at = f"the {effect.acts_on}"
    unknown = ["", "A task may say this name; no diagnosis looks for it yet."] if name in NOT_LOOKED_FOR else []
    return "\n".join(
        [
            f"# {name}, in rollouts" if name in fj.CATALOGUE or name in KINEMATIC else f"# {name}",
            "",
            f"{effect.title[:1].upper()}{effect.title[1:]}. {effect.meaning}",
            *unknown,
            "",
            f"Acts on a {effect.acts_on}. Seen in recordings of a command and a position, without torque.",
            "",
            f"    {effect.equation}",
            "",
            *([f"![signature]({name}_rollout.svg)", ""] if picture is not None else []),
            "| parameter | unit |",
            "|---|---|",
            *(f"| `{key}` | {unit} |" for key, unit in effect.parameters.items()),
            "",
            f"**What hides it**: {effect.hidden_by}.",
            "",
            f"**How to excite it**: {effect.excite.format(at=at)}.",
            "",
            f"**Where it can be said**: {effect.said_by}.",
            "",
        ]
    )


OUTLIER = """# outlier

A posture that was measured wrongly: a swapped marker, a bumped tripod, a robot still moving.

Acts on single rows. Seen in measured poses; the answer names the file and the row.

    the row's error, by a fit to the other rows, is larger than its noise allows

**What hides it**: too few postures, so that every row pulls the fit towards itself.

**How to excite it**: measure the posture again.

**Where it can be said**: nowhere in a model: the row is left out of the fit.
"""


def api(name: str, what: Any) -> str:
    """The entry of a public name; an example in a docstring is code, not text."""
    doc = inspect.getdoc(what) or ""
    if ">>>" in doc:
        return f"## {name}\n\n```text\n{doc}\n```"
    return f"## {name}\n\n::: {what.__module__}.{what.__qualname__}"


def main() -> None:
    page("task.md", reference.markdown())
    index = ["# Effects, page by page", "", "| effect | in |", "|---|---|"]
    own = {n: e for n, e in fj.CATALOGUE.items() if e.__module__.startswith("figaroh_jax.")}
    for name, effect in own.items():
        page(f"effect/{name}.md", effect_page(name, effect, kinematic=False))
        index.append(f"| [{name}]({name}.md) | torque |")
    for name, effect in KINEMATIC.items():
        if name not in own:
            page(f"effect/{name}.md", effect_page(name, effect, kinematic=True))
        index.append(f"| [{name}]({name}.md) | poses |")
    for name, effect in ROLLOUT_EFFECTS.items():
        page(f"effect/{name}_rollout.md", rollout_page(name, effect))
        index.append(f"| [{name}]({name}_rollout.md) | rollouts |")
    page("effect/outlier.md", OUTLIER)
    index.append("| [outlier](outlier.md) | poses |")
    page("effect/index.md", "\n".join([*index, ""]))
    table = ["| key of FIGAROH | here |", "|---|---|", *(f"| `{key}` | {text} |" for key, text in KEYS.items())]
    text = (ROOT / "docs" / "migration.md").read_text(encoding="utf-8")
    page("migration.md", text.replace("<!-- keys -->", "\n".join(table)))
    names = [n for n in sorted(fj.__all__) if inspect.isclass(getattr(fj, n)) or callable(getattr(fj, n))]
    blocks = [api(name, getattr(fj, name)) for name in names]
    text = (ROOT / "docs" / "api.md").read_text(encoding="utf-8")
    page("api.md", text.replace("<!-- names -->", "\n\n".join(blocks)))
    text = (ROOT / "docs" / "ci.md").read_text(encoding="utf-8")
    example = (ROOT / "examples" / "github_actions.yml").read_text(encoding="utf-8").rstrip()
    page("ci.md", text.replace('--8<-- "github_actions.yml"', example))


main()
