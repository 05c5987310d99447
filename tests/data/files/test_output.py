"""Output files that are replaced as a whole."""

import os

import pytest

from dvo.data.files.output import replaced


def test_a_replacement_reaches_the_disk_before_it_takes_the_name(tmp_path, monkeypatch):
    calls: list[str] = []
    sync, move = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (calls.append("fsync"), sync(handle))[1])
    monkeypatch.setattr(os, "replace", lambda *paths: (calls.append("replace"), move(*paths))[1])
    with replaced(tmp_path / "a.txt") as part:
        part.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    assert calls == ["fsync", "replace"] and (tmp_path / "a.txt").read_text() == "new"


def test_a_replacement_that_is_interrupted_leaves_nothing_behind(tmp_path):
    with pytest.raises(KeyboardInterrupt), replaced(tmp_path / "a.txt") as part:
        part.write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
