"""The YAML loader: plain values within bounds, and one error for everything else."""

import sys

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.core.yaml_files import MAX_BYTES, parse_yaml, read_yaml

LAUGHS = "a0: &a0 [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 10)
)
MERGES = "a0: &a0 {x: 1}\n" + "".join(f"a{i}: &a{i} {{<<: [{','.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 10))
CHAIN = "a0: &a0 [x]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 2000))
REFUSED = {
    "impossible date": ("a: 2024-13-45", "not a date: 2024-13-45"),
    "impossible hour": ("a: 2024-01-01 99:00:00", "not a date"),
    "whole number of 5,000 digits": ("a: " + "9" * 5000, "a number longer than 100 digits"),
    "number of 5,000 digits": ("a: " + "9" * 5000 + ".5", "a number longer than 100 digits"),
    "hexadecimal number of 5,000 digits": ("a: 0x" + "f" * 5000, "a number longer than 100 digits"),
    "number to the base 60": ("a: " + "59:" * 3000 + "1", "a number longer than 100 digits"),
    "nested lists": ("[" * 100_000, "32 levels"),
    "nested tables": ("{a: " * 100_000, "32 levels"),
    "nested blocks": ("- " * 100_000, "32 levels"),
    "nested keys": ("? " * 100_000, "32 levels"),
    "aliases in aliases": (LAUGHS, "20,000 values"),
    "merged aliases in aliases": (MERGES, "20,000 values"),
    "nested by a chain of aliases": (CHAIN, "32 levels"),
    "many values": ("[" + "1," * 30_000 + "]", "20,000 values"),
    "list in itself": ("&a [*a]", "within its own anchor"),
    "table in itself": ("&a {b: *a}", "within its own anchor"),
    "table merged into itself": ("&a {<<: *a}", "within its own anchor"),
    "unknown alias": ("*a", "undefined alias"),
    "call of a function": ("!!python/object/apply:os.system ['true']", "python/object/apply"),
    "class": ("!!python/name:os.system", "python/name"),
    "a key twice": ("a: 1\nb: 2\na: 3", "line 3.*the key 'a' twice"),
    "a key twice within": ("a: {b: 1, b: 1}", "the key 'b' twice"),
    "two documents": ("a: 1\n---\nb: 2", "another document"),
    "list as a key": ("? [a]\n: 1", "unhashable key"),
    "no number": ("!!int many", "not a whole number"),
    "no truth": ("!!bool perhaps", "not true or false"),
    "tagged text as a date": ("!!timestamp today", "not a date"),
    "half a character": (r'a: "\ud800"', "no file may hold"),
    "NUL": (r'a: "b\0"', "no file may hold"),
    "NUL byte": ("a: \0", "special characters"),
    "open bracket": ("a: [1", "line 1"),
}


@pytest.mark.long
@pytest.mark.parametrize("case", REFUSED)
def test_refused(case):
    text, message = REFUSED[case]
    limit = sys.getrecursionlimit()
    with pytest.raises(DvoError, match=message) as error:
        parse_yaml(text, "settings.yaml")
    assert str(error.value).startswith("settings.yaml: ")
    assert "\n" not in str(error.value) and len(str(error.value)) < 400
    assert sys.getrecursionlimit() == limit


@pytest.mark.parametrize(
    "text",
    ["", "a: 1", "[1, 2.5, yes, null, text]", "a: &x [1]\nb: *x", "a: &x {b: 1}\nc: {<<: *x, d: 2}", "a: 2024-02-29",
     "- 0x1f\n- 0o17\n- 017\n- 1:30\n- -.inf", "a: |\n  lines\n  of text\n", "!!set {a, b}", "{1: a, '1': b}"],
)  # fmt: skip
def test_the_same_as_pyyaml(text):
    assert parse_yaml(text) == yaml.safe_load(text)


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.text("ab:#[]{}&*! \n\"'", max_size=8),
                    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("abc", min_size=1), inner),
                    max_leaves=12))  # fmt: skip
def test_values_survive_writing_and_reading(value):
    assert parse_yaml(yaml.safe_dump(value, allow_unicode=True)) == value


@given(st.text("ab1:-#[]{}&*!?<%@`|>, \n\t\"'.~\0é", max_size=40))
def test_any_text_gives_values_or_the_one_error(text):
    try:
        parse_yaml(text)
    except DvoError as error:
        assert "not valid YAML" in str(error)


def test_opencv_matrix_is_a_table():
    found = parse_yaml("K: !!opencv-matrix {rows: 1, cols: 2, dt: d, data: [1., 2.]}")
    assert found["K"] == {"rows": 1, "cols": 2, "dt": "d", "data": [1.0, 2.0]}


def test_files(tmp_path):
    file = tmp_path / "settings.yaml"
    file.write_bytes("\ufeffname: Zürich\n".encode())
    assert read_yaml(file) == {"name": "Zürich"}
    file.write_bytes("a: 1\nname: Zürich\n".encode("latin-1"))
    with pytest.raises(DvoError, match=r"settings.yaml: line 2: not UTF-8 text \(byte 0xfc\). Save it"):
        read_yaml(file)
    file.write_bytes("name: text\n".encode("utf-16"))
    with pytest.raises(DvoError, match="not UTF-8 text"):
        read_yaml(file)
    file.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(DvoError, match="larger than 1,024 kB"):
        read_yaml(file)
    for place in (tmp_path, tmp_path / "none.yaml"):
        with pytest.raises(DvoError, match="no such file"):
            read_yaml(place)
