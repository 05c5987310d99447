"""Calibration files of the form ``fx=525 fy=525 cx=320 cy=240``."""

import pytest

from dvo.core.errors import DvoError
from dvo.data import read_calibration


@pytest.mark.parametrize(
    "text",
    ["fx=525 fy=520 cx=320 cy=240", "cx = 320\ncy = 240 # centre\nfx = 525\nfy = 520\n", "fx=525,fy=520;cx=320,cy=240"],
)
def test_values_by_name(make, text):
    found = read_calibration(make.text("c.txt", text))
    assert (found.fx, found.fy, found.cx, found.cy, found.model) == (525, 520, 320, 240, "none")


def test_distortion_by_name(make):
    found = read_calibration(make.text("c.txt", "fx=525 fy=520 cx=320 cy=240 k1=0.1 p2=0.01"))
    assert found.model == "radtan" and found.coefficients == (0.1, 0, 0, 0.01, 0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fx=525 fy=525", "no cx, cy in it.*near \\(width - 1\\) / 2"),
        ("fx=525 fy=525 cx=320 cy=a", "cy: not a number: 'a'"),
        ("fx=525 fy=525 cx=320 cy=", "cy: not a number"),
        ("fx=525 fx=525 cx=320 cy=240", "'fx' twice"),
        ("fx=525 f=525 cx=320 cy=240", "not name=value: 'f'"),
        ("fx=525 525 320 240", "not name=value: '525'"),
        ("fx=525 fy=525 cx=320 cy=nan", "not a finite number"),
    ],
)
def test_what_is_missing_or_wrong_is_named(make, text, message):
    with pytest.raises(DvoError, match=f"c.txt: .*{message}"):
        read_calibration(make.text("c.txt", text))
