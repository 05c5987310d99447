"""The file of the rendered suites: every entry is checked."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

from dvo.core.errors import DvoError
from dvo.core.yaml_files import read_yaml
from eval.suites import suite as suites
from eval.suites.axes import choose, expand, read_axes
from eval.suites.suite import SUITES, read_suites

FILE = SUITES / "axes.yaml"
WRONG: dict[str, tuple[str, Any, str]] = {
    "no tables of axes": ("axes", ["fast"], "axes: must be a table, got a list"),
    "an axis that is a text": ("axes/fast", "kind", "axes: fast: expected a table of settings .axis., got 'kind'"),
    "a boolean for a seed": ("axes/fast/seed", True, "axes: fast: seed: must be a whole number, got True"),
    "a text for a seed": ("splits/test/seed", "4000", "splits: test: seed: must be a whole number, got '4000'"),
    "a seed below 0": ("splits/test/seed", -1, "splits: test: seed: out of range"),
    "a number for a label": ("splits/test/label", 3, "splits: test: label: must be text, got 3"),
    "options that are a list": ("axes/fast/options", ["kind"], "axes: fast: options: must be a table"),
    "options by number": ("axes/fast/options", {1: 2}, "axes: fast: options: must be a table"),
    "a family for families": ("families", "hall", "families: must be a list, got 'hall'"),
    "a number for a family": ("families", ["hall", 3], r"families\[1\]: must be text, got 3"),
    "no family": ("families", [], "families: an empty list"),
    "no family of an axis": ("axes/fast/families", [], "axes: fast: families: an empty list"),
    "very many sequences": ("tiers/mini/count", 10**9, "tiers: mini: count: out of range: 1000000000"),
    "a very long sequence": ("tiers/mini/seconds", 1e12, "tiers: mini: seconds: out of range"),
    "no frame rate": ("tiers/mini/fps", 0, "tiers: mini: fps: out of range: 0"),
    "no size": ("tiers/mini/sizes", [], "tiers: mini: sizes: an empty list"),
    "a size of one number": ("tiers/mini/sizes", [[320]], r"tiers: mini: sizes\[0\]: must be a list of 2"),
    "a size of text": ("tiers/mini/sizes", ["320x240"], r"tiers: mini: sizes\[0\]: must be a list of 2"),
    "an unknown judge": ("axes/fast/judged_by", "beauty", r"sequences\[0\]: judged_by: unknown: 'beauty'"),
    "a list for the version": ("version", [3], "version: must be a whole number, got a list"),
    "an unknown setting": ("axes/fast/colour", "red", "axes: fast: unknown setting 'colour'"),
}


def changed(place: str, value: Any) -> Any:
    table = copy.deepcopy(read_yaml(FILE))
    *folders, name = place.split("/")
    part = table
    for folder in folders:
        part = part[folder]
    part[name] = value
    return table


@pytest.mark.parametrize("case", WRONG)
def test_wrong_entries(monkeypatch: pytest.MonkeyPatch, case: str) -> None:
    place, value, message = WRONG[case]
    monkeypatch.setattr(suites, "read_yaml", lambda file: changed(place, value))
    with pytest.raises(DvoError, match=message) as error:
        read_suites("axes")
    assert str(error.value).startswith(f"{FILE}: ") and error.value.remedy


@pytest.mark.parametrize("group", ["version", "families", "splits", "tiers", "axes"])
def test_missing_groups(group: str) -> None:
    table = read_yaml(FILE)
    del table[group]
    with pytest.raises(DvoError, match=f"incomplete axes: no {group}"):
        read_axes(table, FILE)


def test_common_options_may_be_left_out() -> None:
    table = read_yaml(FILE)
    del table["common"]
    options = expand(read_axes(table, FILE), "fast", "test", "mini")["sequences"][1]["rendered"]
    assert "apart" not in dict(options) and dict(options)["seed"] == 4_000_004_001


def test_default_split_that_the_file_lacks() -> None:
    table = read_yaml(FILE)
    del table["splits"]["validation"]
    with pytest.raises(DvoError, match="no split 'validation'"):
        choose("fast", read_axes(table, Path("axes.yaml")), "axes")
