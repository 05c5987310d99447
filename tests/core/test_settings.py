"""Settings: every wrong value is refused with its name."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

import dvo
from dvo.core.errors import DvoError
from dvo.core.settings import check_settings, from_table, parse_settings, read_settings
from dvo.odometry.patch.config import TrackerConfig


@pytest.mark.parametrize(
    "name, value",
    [("patches", -3), ("patches", 0), ("patches", 2.5), ("patches", True), ("patches", "many"), ("pixels", -1),
     ("lifetime", 0), ("optimisation", 0), ("initial_frames", 1), ("updates", 0), ("keyframe_index", 1),
     ("motion_damping", 1.5), ("motion_damping", float("nan")), ("lost_confidence", -0.1), ("initial_motion", None),
     ("keyframe_motion", float("inf"))],
)  # fmt: skip
def test_a_value_out_of_range_is_refused_by_name(name, value):
    with pytest.raises(DvoError, match=name):
        TrackerConfig(**{name: value})
    with pytest.raises(DvoError, match=name):
        dvo.load("small", **{name: value})


@given(st.integers(1, 500), st.floats(0, 1, allow_subnormal=False))
def test_text_and_values_agree(patches, damping):
    found = parse_settings([f"patches={patches}", f" motion_damping = {damping:.6f}"])
    assert found == {"patches": patches, "motion_damping": pytest.approx(damping, abs=1e-6)}
    assert TrackerConfig.from_dict(found).patches == patches


@pytest.mark.parametrize("text", ["patches", "patches=", "=3", "a b=3", "a=[", "", "a=2026-13-45", "a=" + "9" * 5000])
def test_text_that_is_no_setting(text):
    with pytest.raises(DvoError, match="NAME=VALUE"):
        parse_settings([text])


@pytest.mark.parametrize("text", ["patch=3", "patches=3.5", "motion_damping=fast"])
def test_settings_that_the_tracker_has_not(text):
    with pytest.raises(DvoError, match=text.split("=")[0]):
        dvo.load("small", **parse_settings([text]))


def test_settings_of_a_file(tmp_path):
    file = tmp_path / "tracker.yaml"
    file.write_text("patches: 48\nupdates: 2\n")
    assert read_settings(file) == {"patches": 48, "updates": 2}
    for text, message in (("- 1\n", "table"), ("a: [\n", "YAML"), ("3: 4\n", "table"), ("a: " + "9" * 5000, "YAML")):
        file.write_text(text)
        with pytest.raises(DvoError, match=message) as error:
            read_settings(file)
        assert str(file) in str(error.value)
    with pytest.raises(DvoError, match="no such file"):
        read_settings(tmp_path / "none.yaml")


@dataclass(frozen=True)
class Part:
    """Inner table."""

    size: tuple[int, int]
    share: float = 0.5


@dataclass(frozen=True)
class Whole:
    """Table of every kind of field."""

    RANGES: ClassVar[dict[str, tuple[float, float]]] = {"count": (1, 10)}

    name: str
    count: int = 1
    on: bool = False
    kind: Literal["a", "b"] = "a"
    note: str | None = None
    rates: tuple[float, ...] = ()
    parts: tuple[Part, ...] = ()
    by_name: dict[str, Part] | None = None
    free: Any = None


FILE = Path("whole.yaml")


def test_a_table_becomes_a_dataclass():
    table = {"name": "x", "count": 3, "on": True, "kind": "b", "note": None, "rates": [1, 2.5], "free": [1, {"a": 2}]}
    parts = {"parts": [{"size": [3, 4]}, {"size": [5, 6], "share": 1}], "by_name": {"one": {"size": [1, 2]}}}
    assert from_table(Whole, table | parts, FILE) == Whole(
        "x", 3, True, "b", None, (1, 2.5), (Part((3, 4)), Part((5, 6), 1)), {"one": Part((1, 2))}, [1, {"a": 2}]
    )


@pytest.mark.parametrize(
    ("entry", "message"),
    [([], "expected a table of settings .whole., got a list"), ({}, "incomplete whole: no name"),
     ({"colour": 1}, "unknown setting 'colour'. Known are by_name, count"), ({1: 2}, "unknown setting 1"),
     ({"name": 3}, "name: must be text, got 3. Put it in quotes"), ({"count": True}, "count: must be a whole number"),
     ({"count": 1.0}, "count: must be a whole number, got 1.0"), ({"count": 11}, "count: out of range: 11. .* 1 to 10"),
     ({"on": 1}, "on: must be true or false, got 1"), ({"on": "yes"}, "on: must be true or false, got 'yes'"),
     ({"kind": "c"}, "kind: unknown: 'c'. Choose one of a, b"), ({"kind": ["a"]}, "kind: unknown: a list"),
     ({"note": 3}, "note: must be text, got 3"), ({"rates": 3}, "rates: must be a list, got 3"),
     ({"rates": ["4e-4"]}, r"rates\[0\]: must be a number, got '4e-4'. .* 4.0e-4"),
     ({"rates": [float("nan")]}, r"rates\[0\]: must be a number, got nan"), ({"rates": {}}, "rates: must be a list"),
     ({"parts": [3]}, r"parts\[0\]: expected a table of settings .part., got 3"),
     ({"parts": [{"size": [1]}]}, r"parts\[0\]: size: must be a list of 2, got a list"),
     ({"parts": [{"size": [1, "2"]}]}, r"parts\[0\]: size\[1\]: must be a whole number, got '2'"),
     ({"by_name": []}, "by_name: must be a table"), ({"by_name": {1: {}}}, "by_name: must be a table"),
     ({"by_name": {"one": {}}}, "by_name: one: incomplete part: no size"), ({"name": "x" * 20_000}, "10000 char")],
)  # fmt: skip
def test_a_table_with_a_wrong_entry(entry, message):
    full = {"name": "x"} | entry if isinstance(entry, dict) and entry else entry
    with pytest.raises(DvoError, match=message) as error:
        from_table(Whole, full, FILE)
    assert str(error.value).startswith("whole.yaml: ") and error.value.remedy and len(str(error.value)) < 250


@pytest.mark.parametrize("value", [(0.2, 0.1), (0.0, 0.5), (0.5, 2.0), (0.5,), "wide", None, (True, 1.0), ("a", "b")])
def test_a_range_out_of_its_limits_is_named(value):
    @dataclass(frozen=True)
    class Span:
        reach: tuple[float, float] = (0.1, 0.5)

        def __post_init__(self) -> None:
            check_settings(self, {"reach": (0.1, 1.0)})

    Span([0.1, 1.0])
    with pytest.raises(DvoError, match="no range") as caught:
        Span(value)
    assert caught.value.field == "reach"
