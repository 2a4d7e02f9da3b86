"""Every example in the library's docstrings runs, and every piece that is offered alone has one."""

import doctest
import importlib
import inspect
import pkgutil

import pytest

import jaxplore

PACKAGES = ("beliefs", "signals", "learners", "behaviours")
MODULES = sorted(module.name for module in pkgutil.walk_packages(jaxplore.__path__, "jaxplore."))
WITHOUT = (
    *("behaviours.base", "config", "methods", "parts", "signals.task", *PACKAGES),
    *("_install", "experiments"),
)
"""Modules of shapes, names and tables, without an example."""
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
    assert (results.attempted == 0) == (name.removeprefix("jaxplore.") in WITHOUT)


@pytest.mark.parametrize("name", FACTORIES)
def test_factories_show_an_example(name):
    # what `help(jaxplore.make_sac)` prints tells how to call it
    assert ">>> " in inspect.getdoc(getattr(jaxplore, name))


def test_modules_of_all_packages_are_among_them():
    # so that none is passed over
    assert all(any(name.startswith(f"jaxplore.{package}.") for name in MODULES) for package in PACKAGES)
    assert len(MODULES) > 30


def test_all_names_exist():
    # `from jaxplore import *` works, and the list is sorted as ruff wants it
    assert all(hasattr(jaxplore, name) for name in jaxplore.__all__)
    assert len(set(jaxplore.__all__)) == len(jaxplore.__all__)
    assert len(FACTORIES) >= 7
