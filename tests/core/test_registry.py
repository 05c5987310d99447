"""Names that stand for parts, resolved when they are used."""

import sys

import pytest

from dvo.core.errors import DvoError
from dvo.core.registry import Registry, is_target, resolve_target


def test_nothing_is_imported_before_it_is_used(tmp_path, monkeypatch):
    (tmp_path / "a_part_of_mine.py").write_text("class Part: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    registry = Registry("part", targets={"mine": "a_part_of_mine:Part"})
    assert "mine" in registry and list(registry) == ["mine"]
    assert "a_part_of_mine" not in sys.modules
    assert registry.resolve("mine").__name__ == "Part"


def test_unknown_names_list_the_known_ones():
    registry = Registry("reader", targets={"tum": "dvo.data.readers.tum:READER"})
    with pytest.raises(DvoError, match=r"no reader 'kiti'.*tum"):
        registry.resolve("kiti")


def test_a_name_is_not_taken_twice_by_accident():
    registry = Registry("part", targets={"a": "math:pi"})
    registry.register("a", "math:pi")
    with pytest.raises(DvoError, match="another part 'a'"):
        registry.register("a", "math:e")
    registry.register("a", "math:e", replace=True)
    assert registry.resolve("a") == pytest.approx(2.718281828)
    registry.unregister("a")
    assert "a" not in registry


def test_targets_that_lead_nowhere():
    assert is_target("package.module:Name")
    assert not any(is_target(text) for text in ("C:\\file.py", "http://host", "module", "module:", ":Name", "a b:C"))
    with pytest.raises(DvoError, match="no module 'not_there_at_all.deep'"):
        resolve_target("not_there_at_all.deep:Name")
    with pytest.raises(DvoError, match="has no 'nothing'"):
        resolve_target("math:nothing")
    with pytest.raises(DvoError, match="module:attribute"):
        Registry("part").register("x", "not a target")


def test_a_missing_dependency_keeps_its_name(tmp_path, monkeypatch):
    (tmp_path / "wants_more.py").write_text("import surely_not_installed\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="surely_not_installed"):
        resolve_target("wants_more:Name")


def test_entry_points_of_other_packages(monkeypatch):
    from importlib.metadata import EntryPoint

    announced = [EntryPoint("theirs", "math:tau", "dvo.parts"), EntryPoint("module", "math", "dvo.parts")]
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: announced if group == "dvo.parts" else [])
    registry = Registry("part", "dvo.parts", {"ours": "math:pi"})
    assert list(registry) == ["theirs", "ours"]
    assert registry.resolve("theirs") == pytest.approx(6.283185307)
