"""A damaged run.json, and other damaged files of a results folder: a page, or one error."""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given as examples
from hypothesis import settings
from hypothesis import strategies as st

from dvo.cli import main
from dvo.core.errors import DvoError
from dvo.session.run_facts import read_facts
from tests.support.command_line import arguments

MISSING = object()
NESTED: Any = []
for _ in range(30):
    NESTED = [NESTED]
VALUES = (
    MISSING, None, True, 0, -1, 3, 1.5, 1e308, float("nan"), float("inf"), 10**400, -(10**30), "", "x", "\ud800",
    "\x1b[2J",
    [], [None], [0], ["x"], [{}], [[]], {}, {"x": None}, {"x": {"y": [1]}}, NESTED,
)  # fmt: skip


@pytest.fixture
def folder(given, image_folder, tmp_path, capsys):
    """A results folder with two segments, a break and ground truth; with entries of other odometries beside them."""
    given(lost=(7,), new_segment=(12,))
    assert main(arguments(image_folder, tmp_path / "out", "--groundtruth", str(image_folder.parent / "truth.txt"))) == 0
    file = tmp_path / "out" / "run.json"
    values = json.loads(file.read_text())
    values["self_calibration"] = {"focal": 320.0, "deviation": 2.0, "source": "images"}
    values["quality"] = {"verdict": "doubtful", "reason": "little parallax", "remedy": "move"}
    values["warnings"] = ["one"]
    values["info"] |= {
        "scale": {"segments": [{"segment": 0, "source": "depth"}]},
        "keyframes": 4,
        "loop_corrections": 1,
    }
    values["info"]["loops"] = [
        {"from": 11.0, "to": 10.0, "kind": "loop", "inliers": 0.5, "edges": 90, "joins_segments": True},
        {"from": 11.5, "to": 3.0, "in_map": True},
    ]
    file.write_text(json.dumps(values))
    assert main(["summary", str(tmp_path / "out")]) == 0
    capsys.readouterr()
    return tmp_path / "out"


def places(value: Any, place: tuple = ()) -> list[tuple]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place] * bool(place) + [found for key, item in items for found in places(item, (*place, key))]


def changed(values: dict, place: tuple, value: Any) -> dict:
    values = copy.deepcopy(values)
    inside = values
    for key in place[:-1]:
        inside = inside[key]
    if value is MISSING:
        del inside[place[-1]]
    else:
        inside[place[-1]] = value
    return values


def outcome(folder, capsys, *commands) -> list[int]:
    """Exit codes of ``dvo summary`` and ``dvo export``, each 0, or 2 with one line."""
    codes = []
    for line in commands or (["summary", str(folder)],):
        code = main(line)
        said = capsys.readouterr()
        assert code in (0, 2) and len(said.err.splitlines()) == (code == 2), said.err
        assert "\x1b" not in said.out + said.err
        codes.append(code)
    return codes


@pytest.mark.long
@pytest.mark.parametrize("value", [MISSING, 10**400, "\ud800", [None], {"x": {"y": [1]}}], ids=lambda v: str(v)[:12])
def test_entries_at_the_top(folder, capsys, value):
    values = json.loads((folder / "run.json").read_text())
    for name in values:
        (folder / "run.json").write_text(json.dumps(changed(values, (name,), value)))
        out = folder.parent / f"{name}-kitti"
        outcome(folder, capsys, ["summary", str(folder)], ["export", str(folder), str(out), "--to", "kitti"])


@pytest.mark.slow
def test_every_entry(folder, capsys):
    """Each entry of run.json, however deep, in each kind of JSON."""
    values = json.loads((folder / "run.json").read_text())
    codes = []
    for place in places(values):
        if place[0] in ("versions", "config", "camera") and len(place) > 1:
            continue
        for value in VALUES:
            (folder / "run.json").write_text(json.dumps(changed(values, place, value)))
            codes += outcome(folder, capsys)
    assert 0 < codes.count(2) < len(codes)


@pytest.mark.long
@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("frames",), MISSING, "frames: has no valid value: it is"),
        (("info",), [], "info: has no valid value"),
        (("fps",), "fast", "fps: has no valid value"),
        (("metrics",), 3, "metrics: has no valid value"),
        (("warnings",), {}, "warnings: has no valid value"),
        (("quality", "reason"), [], "quality: reason: has no valid value"),
        (("segments", 0, "start"), "x", "segments: 0: start: has no valid value"),
        (("segments", 1, "joined_to"), 7, "segments: 1: joined_to: no such segment"),
        (("breaks", 0, "frames"), 10**12, "breaks: 0: frames: has no valid value"),
        (("info", "loops", 0, "to"), None, "info: loops: 0: to: has no valid value: it is"),
        (("seconds", "reading"), True, "seconds: reading: has no valid value"),
        (("seed",), float("nan"), "seed: not a finite"),
        (("config",), NESTED, "nested too deeply"),
        (("peak_memory_mb",), {}, "peak_memory_mb: has no valid value"),
        (("self_calibration",), {"focal": 3}, "self_calibration: deviation: has no valid value: it is"),
    ],
)
def test_the_error_names_the_entry(folder, capsys, place, value, said):
    values = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(changed(values, place, value)))
    with pytest.raises(DvoError, match="run.json") as raised:
        read_facts(folder / "run.json")
    assert said in str(raised.value)


@pytest.mark.long
@pytest.mark.parametrize("text", ["", "[]", "{", "null", "[" * 100000, '{"a": ' * 100000, "\ud800", "1" * 5000, "{}"])
def test_what_is_no_run(folder, capsys, text):
    (folder / "run.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    assert outcome(folder, capsys) == [2]
    assert outcome(folder, capsys, ["export", str(folder), str(folder.parent / "k"), "--to", "kitti"]) == [0]


def damaged(data: bytes, seed: int) -> bytes:
    """Cut, with some bytes changed, or with numbers in place of others."""
    draw = np.random.default_rng(seed)
    kind = seed % 4
    if kind == 0:
        return data[: draw.integers(len(data))]
    if kind == 1:
        changed = bytearray(data)
        for place in draw.integers(len(data), size=4):
            changed[place] = draw.integers(256)
        return bytes(changed)
    words = data.split(b" " if kind == 2 else b",")
    extreme = (b"1e308", b"nan", b"-1", b"", b"9" * 400, b"inf", b"1e12", b"x", b"\x1b[2J", b"0")
    words[draw.integers(len(words))] = extreme[draw.integers(len(extreme))]
    return (b" " if kind == 2 else b",").join(words)


@pytest.mark.long
@pytest.mark.parametrize("name", ["frames.csv", "trajectory.txt", "trajectory-1.txt", "map.ply"])
def test_other_damaged_files(folder, capsys, name):
    whole = (folder / name).read_bytes()
    for seed in range(60):
        (folder / name).write_bytes(damaged(whole, seed))
        outcome(folder, capsys)
        out = folder.parent / f"{name}-{seed}"
        outcome(folder, capsys, ["export", str(folder), str(out), "--to", "kitti", "--segment", "1"])


@pytest.mark.parametrize("value", [-3e38, float("nan"), float("inf"), 1e30])
def test_extreme_points_of_a_map(folder, capsys, value):
    from dvo.odometry.protocol import SparseMap
    from dvo.session.files import write_ply

    points = np.full((10, 3), value, np.float32)
    write_ply(folder / "map.ply", SparseMap(points, np.zeros((10, 3), np.uint8)))
    outcome(folder, capsys)


@pytest.mark.long
@pytest.mark.parametrize(
    "row", ["10,tracking,0,,,,,1e13,0,0,,", "1e300,tracking,0,,,,,,,,,", "10,tracking,-2,,,,,,,,,", "10,x,,,,,,,,,,",
            "10,tracking,99999999999999999999,,,,,,,,,", "10,lost,,,,,\x1b[2J,,,,,", ",lost,,,,,,,,,,"],
)  # fmt: skip
def test_extreme_rows_of_the_table(folder, capsys, row):
    header = (folder / "frames.csv").read_text().splitlines()[0]
    (folder / "frames.csv").write_text(f"{header}\n{row}\n")
    outcome(folder, capsys)


@settings(max_examples=25)
@examples(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(), lambda x: st.lists(x) | st.dictionaries(st.text(), x)
    )
)
def test_any_json(tmp_path_factory, value):
    file = tmp_path_factory.mktemp("any") / "run.json"
    file.write_text(json.dumps(value))
    with pytest.raises(DvoError):
        read_facts(file)
