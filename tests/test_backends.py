"""Backends: found by name, with the core's signatures and the core's answers."""

from __future__ import annotations

from pathlib import Path

import figaroh_jax_pinocchio
import numpy as np
import pytest
import robots

from figaroh_jax import registry
from figaroh_jax.errors import InputError
from figaroh_jax.registry import Backend

pinocchio: Backend = figaroh_jax_pinocchio  # one line a backend: the type checker compares the signatures

FUNCTIONS = {"forward_kinematics": 1, "inverse_dynamics": 3, "mass_matrix": 1, "forward_dynamics": 3}


@pytest.mark.parametrize("name", robots.INLINE)
@pytest.mark.parametrize("function", [*FUNCTIONS, "joint_torque_regressor"])
def test_every_backend_gives_the_cores_answer(function: str, name: str, tmp_path: Path) -> None:
    model = robots.load(robots.INLINE[name], tmp_path)
    state = [x.reshape(2, 3, -1) for x in robots.states(model, 6)][: FUNCTIONS.get(function, 3)]
    native = getattr(registry.backend("native"), function)(model, *state)
    other = getattr(pinocchio, function)(model, *state)
    np.testing.assert_allclose(other, native, rtol=0, atol=1e-10)


def test_an_installed_backend_is_imported_by_its_name() -> None:
    if "pinocchio" not in registry.names():
        pytest.skip("figaroh-jax is not installed here, so no entry point names its backends")
    assert registry.backend("pinocchio") is figaroh_jax_pinocchio
    assert isinstance(registry.backend("pinocchio"), Backend)


def test_an_unknown_backend_is_refused_with_those_installed() -> None:
    with pytest.raises(InputError, match="no backend 'bullet' is installed; installed: native"):
        registry.backend("bullet")


def test_a_backend_whose_library_is_missing_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = registry.metadata.EntryPoint("bullet", "no_such_library", registry.GROUP)
    monkeypatch.setattr(registry.metadata, "entry_points", lambda group: [entry])
    with pytest.raises(InputError, match=r"'bullet' needs the package 'no_such_library'.*pip install"):
        registry.backend("bullet")
