from pathlib import Path

import pytest

from dvo.core.errors import DvoError
from dvo.data.files.root import data_root


def test_the_argument_wins_over_the_variable(tmp_path, monkeypatch):
    (tmp_path / "named").mkdir()
    monkeypatch.setenv("DVO_DATA", str(tmp_path))
    assert data_root(tmp_path / "named") == tmp_path / "named"
    assert data_root(str(tmp_path / "named")) == tmp_path / "named"
    assert data_root() == data_root("") == tmp_path


def test_without_either_it_lies_beside_the_checkout(repository, monkeypatch):
    for value in (None, ""):
        monkeypatch.setenv("DVO_DATA", "") if value == "" else monkeypatch.delenv("DVO_DATA", raising=False)
        assert data_root(required=False) == repository.parent / "shared" / "data"


def test_a_missing_folder_is_an_error_only_where_it_is_required(monkeypatch):
    monkeypatch.setenv("DVO_DATA", "/nowhere/at/all")
    assert data_root(required=False) == Path("/nowhere/at/all")
    with pytest.raises(DvoError, match="no such data folder.*DVO_DATA") as caught:
        data_root()
    assert caught.value.file == Path("/nowhere/at/all") and caught.value.field == "--data"
