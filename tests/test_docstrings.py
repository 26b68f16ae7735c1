"""Every public function has a docstring; the examples in them run."""

from __future__ import annotations

import doctest
import inspect

import pytest

import figaroh_jax as fj

SHOWN = ("recording", "postures", "torque_data", "residual", "fit", "fit_linear", "BlockLevenbergMarquardt")


def test_every_public_function_and_class_says_what_it_is():
    bare = [name for name in fj.__all__ if callable(getattr(fj, name)) and not inspect.getdoc(getattr(fj, name))]
    assert bare == []


@pytest.mark.parametrize("name", SHOWN)
def test_the_example_in_a_docstring_runs_and_is_short(name: str):
    found = getattr(fj, name)
    found = inspect.unwrap(found) if inspect.isfunction(found) else found
    (test,) = doctest.DocTestFinder(recurse=False).find(found, name, globs={})
    assert 0 < len(test.examples) <= 10
    failed = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test).failed
    assert failed == 0
