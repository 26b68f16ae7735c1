"""Backends of third parties: a broken one is named in one message, and a wrong answer is caught at the first call."""

from __future__ import annotations

from importlib import resources

import numpy as np
import pytest

import figaroh_jax as fj
from figaroh_jax.errors import InputError
from figaroh_jax.simulators import contract, registry
from figaroh_jax.simulators.native import NativeBackend, as_backend


class _Entry:
    """An entry point whose module does what a broken package does when it is imported."""

    def __init__(self, name: str, load) -> None:
        self.name, self.value, self.load = name, f"{name}_package:Backend", load


def _raises(error: BaseException):
    def load():
        raise error

    return load


def test_a_broken_package_is_named_and_breaks_no_other_message(monkeypatch: pytest.MonkeyPatch):
    broken = [
        _Entry("bullet", _raises(RuntimeError("no licence"))),
        _Entry("drake", _raises(SyntaxError("invalid syntax"))),
        _Entry("dart", lambda: object()),
    ]
    monkeypatch.setattr(contract.metadata, "entry_points", lambda group: broken)
    with pytest.raises(InputError, match="'bullet': its package bullet_package fails .*RuntimeError: no licence"):
        contract.announced("bullet")
    with pytest.raises(InputError, match="'dart': its class says no `capabilities`"):
        contract.capabilities_of("dart")
    assert contract.having("mass_matrix") == ("native",)
    with pytest.raises(InputError, match="'drake': its package drake_package fails"):
        registry.check_backend("drake", "mass_matrix")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda torque: torque[..., :-1], "inverse_dynamics gives shape"),
        (lambda torque: torque * np.nan, "inverse_dynamics gives nan"),
        (lambda torque: 2 * torque, "differs from its inverse_dynamics"),
        (lambda torque: torque["none"], "inverse_dynamics fails at its first call"),
    ],
)
def test_wrong_answers_of_a_backend_are_caught_at_the_first_call(spoil, words: str):
    class Wrong(NativeBackend):
        def inverse_dynamics(self, q, v, a):
            return spoil(np.asarray(super().inverse_dynamics(q, v, a)))

    Wrong.__module__ = "somebody"
    robot = fj.load_urdf(str(resources.files("figaroh_jax") / "demo" / "robot.urdf"))
    with pytest.raises(InputError, match=words):
        as_backend(Wrong(robot))
