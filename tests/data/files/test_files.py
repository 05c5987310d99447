"""Files within bounds: what no reader may do, whatever the file says."""

import os

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.files.files import (
    MAX_LINE,
    MAX_NUMBER,
    MAX_TABLE,
    is_file,
    parse_nanoseconds,
    parse_number,
    read_image_file,
    read_rows,
)
from dvo.data.files.listing import listed_file


def rows(path):
    return list(read_rows(path, "give a table", "--times"))


def test_rows(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(b"\xef\xbb\xbf# Gr\xc3\xb6\xc3\x9fe\r\n1, 2;3  # last\r\n\n ,\n4")
    assert rows(path) == [(2, ["1", "2", "3"]), (5, ["4"])]


@pytest.mark.parametrize("data", ["# Größe\n1 2\n".encode("latin-1"), "1 2\n".encode("utf-16"), b"1 2\n\xff\n"])
def test_another_encoding_names_the_line(tmp_path, data):
    path = tmp_path / "t.csv"
    path.write_bytes(data)
    line = data[: data.index(max(data))].count(b"\n") + 1
    with pytest.raises(DvoError, match=f"t.csv: line {line}: not UTF-8 text. Save it with the encoding UTF-8"):
        rows(path)


def test_a_long_line_and_a_large_file_are_refused_unread(tmp_path):
    path = tmp_path / "t.csv"
    path.write_text("1 2\n" + "1 " * MAX_LINE + "\n")
    with pytest.raises(DvoError, match="line 2: longer than 65,536 characters"):
        rows(path)
    os.truncate(path, MAX_TABLE + 1)
    with pytest.raises(DvoError, match="--times: larger than 1,024 MB. Give a table"):
        rows(path)


@pytest.mark.parametrize("make_it", [os.mkfifo, os.mkdir, lambda path: os.symlink("/dev/zero", path),
                                     lambda path: os.symlink(path, path), lambda path: None])  # fmt: skip
def test_only_regular_files(tmp_path, make_it):
    path = tmp_path / "t.png"
    make_it(path)
    assert not is_file(path) and read_image_file(path) is None
    with pytest.raises(DvoError, match="--times: no such file. Give a table"):
        rows(path)


def test_names_that_cannot_be_looked_up(tmp_path):
    for name in ("x" * 300, "a\0b", "\ud800"):
        assert not is_file(tmp_path / name)
        assert read_image_file(tmp_path / name) is None


def test_a_link_to_a_file_is_a_file(tmp_path):
    (tmp_path / "a").write_bytes(b"x")
    (tmp_path / "b").symlink_to("a")
    assert is_file(tmp_path / "b") and read_image_file(tmp_path / "b") == b"x"


def test_a_huge_image_file_is_not_read(tmp_path):
    path = tmp_path / "a.png"
    path.touch()
    os.truncate(path, 2**29 + 1)
    assert read_image_file(path) is None


@pytest.mark.parametrize("name", ["/dev/zero", "/a.png", "../a.png", "rgb/../../a.png", "C:\\a.png", "..\\a.png",
                                  "\\\\host\\a.png", "a\0b"])  # fmt: skip
def test_lists_name_files_of_their_folder(tmp_path, name):
    with pytest.raises(DvoError, match="rgb.txt: line 3: .* is not a file of this folder"):
        listed_file(tmp_path / "rgb.txt", tmp_path, name, 3)


def test_listed_names(tmp_path):
    for name in ("a.png", "rgb/a b.png", "./a.png", "rgb/..a.png"):
        assert listed_file(tmp_path / "rgb.txt", tmp_path, name, 1) == tmp_path / name


def test_numbers():
    assert parse_number("-1.5e3") == -1500 and parse_number(str(MAX_NUMBER)) == MAX_NUMBER
    for text in ("nan", "inf", "-inf", "1e999", "9" * 5000, "1.1e12", "x", ""):
        with pytest.raises(ValueError):
            parse_number(text)


def test_nanoseconds():
    assert parse_nanoseconds("1403636579763555584") == 1403636579763555584
    for text in ("9" * 5000, "9" * 400, "9" * 19, "²", "1.5", "", "-" + "9" * 30):
        with pytest.raises(ValueError):
            parse_nanoseconds(text)
    assert isinstance(np.array([parse_nanoseconds("9" * 18)]).dtype, np.dtypes.Int64DType)
