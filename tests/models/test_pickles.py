"""Pickles that are refused: the reason, and never an advice to read them unchecked."""

from __future__ import annotations

import argparse
import os
import pickle
import tarfile

import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.models.pickles import load_pickle

ADVICE = ("weights_only", "allow_pickle", "add_safe_globals", "unsafe", "trust", "full_load", "re-running", "set to")


class Evil:
    def __reduce__(self):
        return os.mkdir, ("/tmp/dvo-a-pickle-ran",)


OBJECTS = {
    "code": {"a": Evil()}, "namespace": argparse.Namespace(a=1), "array": np.zeros(3), "scalar": np.float64(3),
    "module": torch.nn.Linear(1, 1), "class": int,
}  # fmt: skip


@pytest.mark.parametrize("name", OBJECTS)
@pytest.mark.parametrize("form", ["zip", "old", "pickle 0", "pickle 4"])
def test_objects_are_refused(tmp_path, name, form):
    file, value = tmp_path / "w.pth", OBJECTS[name]
    if form.startswith("pickle"):
        file.write_bytes(pickle.dumps(value, protocol=int(form[-1])))
    else:
        torch.save(value, file, _use_new_zipfile_serialization=form == "zip")
    check_refused(file)
    assert not os.path.exists("/tmp/dvo-a-pickle-ran")


def check_refused(file):
    with pytest.raises(DvoError, match="cannot be read as plain tensors") as raised:
        load_pickle(file, "give weights")
    text = str(raised.value)
    assert not any(word in text.lower() for word in ADVICE), text
    assert text.endswith("Give weights.") and any(map(str.isalpha, text.partition("tensors (")[2].partition(")")[0]))
    assert raised.value.__suppress_context__, "a traceback would quote the advice too"


def test_files_of_other_kinds_are_refused(tmp_path):
    (tmp_path / "text").write_bytes(b"hello" * 100)
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "zeros").write_bytes(bytes(10000))
    np.save(tmp_path / "objects.npy", np.array([{}], dtype=object))
    torch.jit.script(torch.nn.Linear(1, 1)).save(tmp_path / "script")
    with tarfile.open(tmp_path / "tar", "w") as archive:
        archive.add(tmp_path / "text", "storages")
    for name in ("text", "empty", "zeros", "objects.npy", "script", "tar"):
        check_refused(tmp_path / name)


def test_the_object_is_named(tmp_path):
    torch.save(argparse.Namespace(a=1), tmp_path / "w.pth")
    with pytest.raises(DvoError, match=r"holds objects of the type argparse\.Namespace, which could run code"):
        load_pickle(tmp_path / "w.pth", "give weights")
