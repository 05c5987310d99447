"""Addresses without their secrets, and characters that would steer a terminal."""

from __future__ import annotations

import subprocess
import sys
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.core.text import encodable, printable, redacted, visible

PASSWORDS = st.text(st.characters(exclude_categories=("Cs",)), min_size=1, max_size=12).map(
    lambda text: f"Xq9{text}7Zk"
)
SCHEMES = ("rtsp://", "RTSPS://", "http://", "rtmp://", "ftp://", "srt://", "rtps://", " rtsp://", "rtsp:/", "rtsp:///")


@pytest.mark.long
@pytest.mark.parametrize("scheme", SCHEMES)
@given(password=PASSWORDS)
def test_no_password_is_left(scheme, password):
    """Whatever the password and the scheme, in the text of an error, its parts and a chained message."""
    address = f"{scheme}admin:{password}@camera.local:554/live"
    error = DvoError("no such file or folder", file=address, remedy="give a video")
    for text in (
        str(error),
        str(error.file),
        repr(error),
        str(DvoError("cannot go on", file="a.txt", field=str(error))),
    ):
        assert "Xq9" not in text and "7Zk" not in text and "admin" not in text
    assert "camera.local:554/live" in str(error)


@pytest.mark.parametrize(
    "address",
    [
        "http://h/v?token=Xq9", "http://h/v?x=1&access_token=Xq9", "http://h/v?api_key=Xq9&x=1", "http://h/v?sig=Xq9",
        "http://h/v?x=1;auth=Xq9", "http://h/v?AUTHORIZATION=Xq9", "http://h/v?%74oken=Xq9", "http://h/v#id_token=Xq9",
        "rtsp://h/user=Xq9_password=Xq9_channel=1", "http://h/v?X-Amz-Signature=Xq9", "http://h/?key=Xq9:", "x?pwd=Xq9",
        "http://h/v?z=Xq9Xq9Xq9Xq9Xq9Xq9Xq9", "http://h/v?password=a&key=Xq9/@+=", "rtsp://admin:Xq9@h?user=Xq9",
        "http://h/v?refresh=Xq9abc", "http://h/v?a=1&tkn=Xq9", "http://h/v?usr=Xq9", "http://h/v?md5=Xq9abc&e=1",
        "http://h/v?Xq9abc", "http://h/v?a=1&Xq9abc", "http://h/v?token%3DXq9", "srt://h?streamid=Xq9abc",
        "rtmp://h/app/live_Xq9", "http%3A%2F%2Fu%3AXq9%40h", "http://h/v?next=http%3A%2F%2Fu%3AXq9%40h",
        "rtsp:// admin:Xq9@h", "rtsp://admin:Xq9\uff20h", "admin:Xq9@192.168.0.2/live",
        "rtsp//admin:Xq9@h", "rtsp:admin:Xq9@h", "Authorization: Basic Xq9=",
    ],
)  # fmt: skip
@pytest.mark.parametrize("frame", ["{}", "cannot open {}: refused", "'{}' failed", "{}: {}. Try again"])
def test_no_token_is_left(address, frame):
    assert "Xq9" not in redacted(frame.replace("{}", address))


@pytest.mark.parametrize(
    "text",
    [
        "/data/a@b.png: cannot be read", "C:/a@b.png", "D:\\a@b", "x: /tmp/a@b.png", "http://host:554/live?channel=1",
        "see https://example.org/page; write to me@example.org", "keyframes=5, token=3", "bag.mcap:/camera/image",
        "/data/12:30@home/x.png", "/data//a@b.png", "http://[::1]:80/x, a@b", "webcam:0", "", "rtsp://h/v?t=30&v=2",
        "rtsp://h/v?channel=1&subtype=main&size=1920x1080&codec=h264-high", "use rtsp://, http:// or webcam:0",
        "a%3Ab.png",
    ],
)  # fmt: skip
def test_other_texts_stay(text):
    assert redacted(text) == text


def test_a_path_and_a_message_around_an_address():
    from pathlib import Path

    error = DvoError("no such file", file=Path("rtmp://admin:p@ss/word@host/live"))
    assert str(error) == "rtmp:/host/live: no such file."
    assert redacted("rtsp://admin:two words@host/a: no stream") == "rtsp://host/a: no stream"
    assert redacted("one rtsp://a:b@h\ntwo ftp://c:d@h") == "one rtsp://h\ntwo ftp://h"


@pytest.mark.parametrize(
    "text", ["Grüße", "漢字かな", "한국어", "العربية", "😀 👨‍👩‍👧 👩🏽‍🚀 🏳️‍🌈 🇩🇪 ❤️", "e\u0301", "हिन्दी", "a\\b"]
)
def test_letters_and_emoji_stay(text):
    assert visible(text) == text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[2J", r"\x1b[2J"), ("\a\b", r"\x07\x08"), ("\r\n\t", r"\r\n\t"), ("\x9b31m", r"\x9b31m"),
        ("\u202e", r"\u202e"), ("\u2066", r"\u2066"), ("\u200b", r"\u200b"), ("a\u200db", r"a\u200db"),
        ("\ufeff", r"\ufeff"), ("\u2028", r"\u2028"), ("\U000e0041", r"\U000e0041"), ("\udcff", r"\xff"),
        ("\u3164", r"\u3164"), ("\ud800", r"\ud800"), ("\u00ad", r"\xad"), ("\x7f", r"\x7f"),
    ],
)  # fmt: skip
def test_what_steers_a_terminal_is_an_escape(text, shown):
    assert visible(text) == shown and printable(text) == shown
    error = DvoError(
        "unknown", file=f"a{text}b", field="f" + text.replace("\n", ""), remedy="use" + text.replace("\n", "")
    )
    assert f"a{shown}b: f" in str(error)


@pytest.mark.long
@given(st.text())
def test_nothing_that_steers_is_left(text):
    shown = visible(text)
    assert visible(shown) == shown
    assert not any(
        unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") or c in "\u202e\u200b\u2066\ufeff" for c in shown
    )
    shown.encode()


def test_messages_are_one_line():
    assert str(DvoError("one\n  two", remedy="three\nfour")) == "one two. Three four."


def test_an_encoding_that_lacks_a_letter():
    assert encodable("Grüße", "ascii") == r"Gr\xfc\xdfe" and encodable("ü", None) == "ü"


def test_the_traceback_of_an_unknown_error_holds_no_secret(repository):
    """An error that no command expects: names and addresses in it, and in its cause, pass the same door."""
    program = (
        "import argparse, dvo.cli as cli\n"
        "def fail(arguments):\n"
        "    try:\n"
        "        raise KeyError('rtsp://admin:Xq9@host')\n"
        "    except KeyError as error:\n"
        "        raise RuntimeError('\\x1b[2J rtsp://admin:Xq9@host') from error\n"
        "cli.import_module = lambda name: argparse.Namespace(doctor=fail)\n"
        "cli.main(['doctor'])\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=repository, capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and "RuntimeError: \\x1b[2J rtsp://host" in done.stderr
    assert "rtsp://admin:Xq9@host'\n" not in done.stderr and "\x1b" not in done.stderr


@pytest.mark.long
@pytest.mark.parametrize("start", ["x" * 10**5, "x " * 10**5, "a=" * 10**5, "aa:/" * 10**5, "'a:" * 10**5])
def test_long_texts_come_to_an_end(start):
    """Names and files may be of any length."""
    found = redacted(f"{start} rtsp://admin:Xq9@camera/live")
    assert "Xq9" not in found and found.endswith("camera/live")
    assert "Xq9" not in str(DvoError(f"{start} rtsp://admin:Xq9@camera/live"))
