"""Old names of modules that the documentation once named."""

import importlib

import pytest

from dvo.moved import MOVED


@pytest.mark.parametrize("name", MOVED)
def test_an_old_name_gives_what_the_new_module_has(name):
    with pytest.warns(DeprecationWarning, match="is now"):
        old = importlib.reload(importlib.import_module(name))
    new = importlib.import_module(MOVED[name])
    public = [key for key in vars(new) if not key.startswith("_")]
    assert all(getattr(old, key) is getattr(new, key) for key in public)


def test_names_that_were_never_there_are_not_found():
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("dvo.odometry.nothing")
