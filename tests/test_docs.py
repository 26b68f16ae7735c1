"""What the documentation lists is what the code has."""

from __future__ import annotations

from pathlib import Path

import pytest

from figaroh_jax.effects.catalogue import CATALOGUE
from figaroh_jax.effects.kinematic import CATALOGUE as KINEMATIC

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


def test_the_page_of_effects_lists_nothing_else() -> None:
    listed = [line.split("`")[1] for line in PAGE.splitlines() if line.startswith("| `")]
    assert sorted(listed) == sorted([*OWN, *KINEMATIC])
