"""Every example in the library's docstrings runs, and every piece that is offered alone has one."""

import doctest
import importlib
import inspect
import pkgutil

import pytest

import jaxplore

MODULES = sorted(f"jaxplore.{module.name}" for module in pkgutil.iter_modules(jaxplore.__path__))
FACTORIES = sorted(
    name
    for name in jaxplore.__all__
    if inspect.isfunction(getattr(jaxplore, name))
    and (name.startswith("make_") or name in ("rollout", "stein_direction"))
)


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name):
    # as a reader would type them; the pieces that issue 2 offers alone have at least one
    results = doctest.testmod(importlib.import_module(name), raise_on_error=False)
    assert results.failed == 0
    without = ("behaviours", "methods", "types")
    assert results.attempted > 0 or name.removeprefix("jaxplore.") in without


@pytest.mark.parametrize("name", FACTORIES)
def test_factories_show_an_example(name):
    # what `help(jaxplore.make_sac)` prints tells how to call it
    assert ">>> " in inspect.getdoc(getattr(jaxplore, name))


def test_all_names_exist():
    # `from jaxplore import *` works, and the list is sorted as ruff wants it
    assert all(hasattr(jaxplore, name) for name in jaxplore.__all__)
    assert len(set(jaxplore.__all__)) == len(jaxplore.__all__)
    assert len(FACTORIES) >= 7
