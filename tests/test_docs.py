"""What the documentation lists is what the code has."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from figaroh_jax import DEMO, cli
from figaroh_jax.effects.catalogue import CATALOGUE
from figaroh_jax.effects.kinematic import CATALOGUE as KINEMATIC
from figaroh_jax.formats import reference
from figaroh_jax.formats.config import Limits, Task
from figaroh_jax.formats.taskfile import CONTRACT_EFFECTS
from figaroh_jax.reporting.rollout_effects import NOT_LOOKED_FOR, ROLLOUT_EFFECTS
from figaroh_jax.rollouts.causes import BASELINE, catalogue, with_pairs
from figaroh_jax.rollouts.reading import load_loop

OWN = {name: effect for name, effect in CATALOGUE.items() if effect.__module__.startswith("figaroh_jax.effects.")}
PAGE = (Path(__file__).resolve().parents[1] / "docs" / "effects.md").read_text("utf-8")


@pytest.mark.parametrize("name", OWN)
def test_the_page_of_effects_has_the_row_of_each_effect_of_torques(name: str) -> None:
    effect = OWN[name]
    parameters = ", ".join(f"{key} ({unit or '1'})" for key, unit in effect.units().items())
    apart = effect.separated_by.format(at="it" if effect.acts_on == "robot" else f"the {effect.acts_on}")
    row = f"| `{name}` | {effect.acts_on} | {effect.equation.replace('|', chr(92) + '|')} | {parameters} | {apart} |"
    assert row in PAGE.splitlines(), row


@pytest.mark.parametrize("name", KINEMATIC)
def test_the_page_of_effects_has_the_row_of_each_effect_of_poses(name: str) -> None:
    effect = KINEMATIC[name]
    wording = effect.separated_by_postures or effect.separated_by
    apart = wording.format(at="the joint") or "–"
    row = f"| `{name}` | {effect.acts_on} | {effect.equation} | {apart} |"
    assert row in PAGE.splitlines(), row


@pytest.mark.parametrize("name", ROLLOUT_EFFECTS)
def test_the_page_of_effects_has_the_row_of_each_effect_of_rollouts(name: str) -> None:
    effect = ROLLOUT_EFFECTS[name]
    parameters = ", ".join(f"{key} ({unit})" for key, unit in effect.parameters.items())
    equation, apart = effect.equation.replace("|", chr(92) + "|"), effect.excite.format(at=f"the {effect.acts_on}")
    row = f"| `{name}` | {effect.acts_on} | {equation} | {parameters} | {apart} |"
    assert row in PAGE.splitlines(), row


def test_the_effects_of_rollouts_are_those_that_a_search_looks_for() -> None:
    """The search's candidates, the structures that it tries, and names of the contract that nothing is behind."""
    loop, _ = load_loop(DEMO, {"elbow": {"kind": "position", "kp": 20.0, "kd": 0.5}})
    every = catalogue(with_pairs(loop), np.ones(1), gains_known=False, bodies=[0]).candidates
    looked_for = {one.effect for one in every}
    assert {*ROLLOUT_EFFECTS} - {*NOT_LOOKED_FOR} == looked_for | {*BASELINE, "joint_elasticity", "backlash"}
    known = {*OWN, *KINEMATIC, *ROLLOUT_EFFECTS, "outlier"}
    assert known >= {*CONTRACT_EFFECTS}, {*CONTRACT_EFFECTS} - known


def test_the_page_of_effects_lists_nothing_else() -> None:
    listed = [line.split("`")[1] for line in PAGE.splitlines() if line.startswith("| `")]
    assert sorted(listed) == sorted([*OWN, *KINEMATIC, *ROLLOUT_EFFECTS])


# The site


DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES = sorted(DOCS.glob("*.md")) + [DOCS.parent / "README.md"]


def blocks(language: str) -> list[tuple[str, str]]:
    """Every code block of a language, with the page and the line where it stands."""
    found = []
    for page in PAGES:
        text = page.read_text("utf-8")
        for match in re.finditer(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            found.append((f"{page.name}:{text[: match.start()].count(chr(10)) + 1}", match[1]))
    return found


@pytest.mark.parametrize(("place", "text"), blocks("yaml"), ids=[place for place, _ in blocks("yaml")])
def test_every_yaml_block_holds_keys_that_are_read(place: str, text: str, tmp_path: Path) -> None:
    if text.startswith("--8<--"):
        assert (DOCS.parent / "examples" / "github_actions.yml").is_file()
        return
    content = yaml.safe_load(text)
    if "limits.yaml" in text:
        Limits.model_validate(content)
        return
    whole: dict[str, Any] = {"robot": {"model": "robot.urdf"}}
    whole["data"] = [{"file": "run.csv", "time": "t", "position": "q"}]
    Task.model_validate(whole | content)


@pytest.mark.parametrize(("place", "text"), blocks("console"), ids=[place for place, _ in blocks("console")])
def test_every_command_in_a_console_block_is_one_with_its_options(place: str, text: str) -> None:
    for line in text.splitlines():
        words = shlex.split(line.removeprefix("$ "), comments=True) if line.startswith("$") else []
        if line.startswith("$ figaroh-jax"):
            cli._parser().parse_args(words[1:])
        elif line.startswith("$ make"):
            assert re.search(rf"^{words[1]}:", (DOCS.parent / "Makefile").read_text("utf-8"), re.MULTILINE), place
        elif line.startswith("$"):
            assert words[:2] == ["pip", "install"], f"{place}: {line}"


def test_every_python_block_of_the_readme_runs_on_the_demo() -> None:
    """One after another in one interpreter, with the demo's robot and arrays in place of a user's."""
    texts = [text for place, text in blocks("python") if place.startswith("README")]
    before = (
        "import jax, numpy as np, figaroh_jax as fj\n"
        "rng = np.random.default_rng(0); q, v, a, tau = rng.normal(size=(4, 2500, 4))\n"
        "t = np.arange(2500) / 250.0\n"
        "w = 2 * np.pi * np.array([0.31, 0.43, 0.57, 0.71])\n"
        "q, v, a = np.sin(w * t[:, None]), w * np.cos(w * t[:, None]), -w**2 * np.sin(w * t[:, None])\n"
    )
    script = "\n".join([before, *texts])
    for name in ("robot.urdf", "robot.xml"):
        script = script.replace(f'load_urdf("{name}")', "load_urdf(fj.DEMO)")
    kept = [line for line in script.splitlines() if not _NEEDS_A_RUN.search(line)]
    place = next(k for k, line in enumerate(kept) if "fj.torque_data" in line)
    kept.insert(place, "tau = np.asarray(fj.inverse_dynamics(model, q, v, a))")
    run = subprocess.run([sys.executable, "-c", "\n".join(kept)], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-1500:]


# a minute's diagnosis and files of a user, which tests of their own cover
_NEEDS_A_RUN = re.compile(r'diagnosis|load_model\("run|load_extended\(|^\s+print\(cause')


def test_every_key_has_its_line_in_the_reference() -> None:
    """`reference.keys` raises for a key without one; here the other way round, and the page itself."""
    assert {key.path for key in reference.keys()} == set(reference.KEYS)
    assert {key.path for key in reference.limits_keys()} == set(reference.LIMITS)
    page = reference.markdown()
    assert all(f"| `{path}` |" in page for path in [*reference.KEYS, *reference.LIMITS])


def test_links_between_pages_lead_somewhere() -> None:
    made = {"task.md"} | {f"effect/{name}.md" for name in [*OWN, *KINEMATIC, "outlier", "index"]}
    made |= {f"effect/{name}_rollout.md" for name in ROLLOUT_EFFECTS}
    for page in DOCS.glob("*.md"):
        for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text("utf-8")):
            if target.startswith("https://"):
                continue
            assert target in made or (DOCS / target).is_file(), f"{page.name}: {target}"


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_has_a_page_for_every_effect(tmp_path: Path) -> None:
    pytest.importorskip("material")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-d", str(tmp_path)]
    run = subprocess.run(command, cwd=DOCS.parent, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-2000:]
    made = {path.name for path in (tmp_path / "effect").iterdir()}
    assert {f"{name}.html" for name in [*OWN, *KINEMATIC, "outlier"]} <= made
    assert {f"{name}_rollout.html" for name in ROLLOUT_EFFECTS} <= {
        path.name for path in (tmp_path / "effect").iterdir()
    }
    assert {f"{name}.svg" for name in OWN} <= {path.name for path in (tmp_path / "effect").iterdir()}


@pytest.mark.slow  # two diagnoses of the demo
def test_every_console_block_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    """The commands of the site and of the README one after another, on the demo's robot and recordings as files."""
    monkeypatch.chdir(tmp_path)
    _files_of_a_user(tmp_path)
    done = set[str]()
    for place, text in blocks("console"):
        for line in text.splitlines():
            words = shlex.split(line.removeprefix("$ "), comments=True) if line.startswith("$") else []
            if not line.startswith("$ figaroh-jax") or words[1] == "view" or " ".join(words) in done:
                continue  # `view` serves until it is interrupted
            done.add(" ".join(words))
            if words[1] in ("new", "migrate"):
                Path("task.yaml").unlink(missing_ok=True)
            assert cli.main(words[1:]) == 0, f"{place}: {line}: {capsys.readouterr().err}"
            if words[1] == "diagnose":
                shutil.copytree("run", "before")
    assert {"demo", "new", "diagnose", "verify", "compare", "list", "rerun", "migrate"} <= {d.split()[1] for d in done}


def _files_of_a_user(folder: Path) -> None:
    shutil.copy(DEMO, folder / "robot.urdf")
    joints = ("waist", "shoulder", "elbow", "wrist")
    for name, source in (("run", "first_1"), ("run1", "first_1"), ("run2", "first_2")):
        with np.load(Path(DEMO).with_name(f"{source}.npz")) as arrays:
            columns = {"t": np.arange(len(arrays["q"])) / 250.0}
            columns |= {f"q_{joint}": arrays["q"][:, j] for j, joint in enumerate(joints)}
            columns |= {f"tau_{joint}": arrays["tau"][:, j] for j, joint in enumerate(joints)}
        rows = np.column_stack(list(columns.values()))
        np.savetxt(folder / f"{name}.csv", rows, "%.9g", ",", header=",".join(columns), comments="")
    (folder / "limits.yaml").write_text("verdict: [nothing, named, named+rest]\n")
    (folder / "config").mkdir()
    for file in ("config.yaml", "config/robot.yaml"):
        (folder / file).write_text(CONFIG)


CONFIG = """
identification:
  robot_params: [{q_lim_def: 1.57, dq_lim_def: 5.0, fv: [0, 0, 0, 0], fs: [0, 0, 0, 0]}]
  problem_params: [{has_friction: true, has_actuator_inertia: true}]
  processing_params: [{cut_off_frequency_butterworth: 15.0, ts: 0.004}]
"""


@pytest.mark.slow  # half a minute of compilation
def test_the_python_block_for_those_who_come_from_mujoco_runs(tmp_path: Path) -> None:
    from test_rollout_data import MJCF, TRUTH

    (text,) = [text for place, text in blocks("python") if place.startswith("migration")]
    (tmp_path / "robot.xml").write_text(MJCF.format(damping=0.15, armature=0.024))
    (tmp_path / "truth.xml").write_text(MJCF.format(**TRUTH))
    before = (
        "import numpy as np, mujoco\n"
        "model = mujoco.MjModel.from_xml_path('truth.xml'); state = mujoco.MjData(model); state.qpos[:] = 0.2\n"
        "u = np.sign(np.sin(0.07 * np.arange(150)))[:, None] * 0.6; q = np.zeros((150, 1))\n"
        "for k in range(150):\n"
        "    q[k], state.ctrl[:] = state.qpos, u[k]; mujoco.mj_step(model, state, 2)\n"
    )
    run = subprocess.run([sys.executable, "-c", before + text], capture_output=True, text=True, cwd=tmp_path)
    assert run.returncode == 0, run.stderr[-1500:]
    assert float(re.search(r"([-\d.]+) N m s/rad", run.stdout)[1]) == pytest.approx(TRUTH["damping"], abs=0.02)  # pyright: ignore[reportOptionalSubscript]
