"""Every public function has a docstring; the examples in them run."""

from __future__ import annotations

import doctest
import inspect
from operator import attrgetter

import pytest

import figaroh_jax as fj

LONG = {"calibrate", "diagnose", "diagnose_task", "identify", "identify_task", "linear_basis", "linear_limits"}
LONG |= {
    "accelerators.fit_states",
    "calibrate_task",
    "expected_std",
    "fit_linear",
    "information",
    "residual",
    "screen_fleet",
}
LONG |= {"excite", "excite_postures", "excite_task", "write_report"}
LONG |= {"rollout", "rollout_data", "select", "simulate", "triangular_factor"}
FUNCTIONS = [n for n in fj.__all__ if callable(getattr(fj, n)) and not inspect.isclass(getattr(fj, n))]
SPACES = [
    f"{space}.{name}"
    for space in fj._SPACES
    for name in getattr(fj, space).__all__
    if inspect.isfunction(getattr(fj, space).__dict__[name])
    and ">>>" in (getattr(fj, space).__dict__[name].__doc__ or "")
]
CLASSES = [n for n in fj.__all__ if inspect.isclass(getattr(fj, n)) and ">>>" in (getattr(fj, n).__doc__ or "")]
SHOWN = [*sorted(set(FUNCTIONS)), *CLASSES, *SPACES]


def test_every_public_function_and_class_says_what_it_is():
    bare = [name for name in fj.__all__ if callable(getattr(fj, name)) and not inspect.getdoc(getattr(fj, name))]
    assert bare == []


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n in LONG)) for n in SHOWN])
def test_the_example_in_a_docstring_runs_and_is_short(name: str):
    found = attrgetter(name)(fj)
    found = inspect.unwrap(found) if inspect.isfunction(found) else found
    (test,) = doctest.DocTestFinder(recurse=False).find(found, name, globs={})
    assert 0 < sum(one.source.count("\n") for one in test.examples) <= 10
    assert "from figaroh_jax" not in test.docstring  # public names alone
    failed = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test).failed
    assert failed == 0
