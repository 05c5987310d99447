"""Sizes, counts and files that ``dvo synth`` refuses before it renders anything."""

from __future__ import annotations

import pytest

from dvo.cli import main

EXPORT = {
    "a huge size": (["--size", "100000x100000"], "expected WIDTHxHEIGHT from 16 to 8192 pixels"),
    "a size of 5,000 digits": (["--size", "9" * 5000 + "x64"], "expected WIDTHxHEIGHT from 16 to 8192 pixels"),
    "a size of other digits": (["--size", "\u00b2\u00b3x64"], "expected WIDTHxHEIGHT from 16 to 8192 pixels"),
    "a tiny size": (["--size", "15x64"], "expected WIDTHxHEIGHT from 16 to 8192 pixels"),
    "largest edges": (["--size", "8192x8192"], "height, width: too large: 67,108,864 rays"),
    "frames": (["--frames", "1000000000"], "frames: out of range: 1000000000"),
    "hours": (["--frames", "100000", "--fps", "1"], "frames, fps: too long: 100,000 s"),
    "a slow rate": (["--fps", "1e-300"], "fps: out of range"),
    "no rate": (["--fps", "nan"], "must be more than 0"),
    "a seed below 0": (["--seed", "-1"], "must be 0 or more"),
    "a huge seed": (["--seed", "9" * 100], "must be 0 or more and below 2^63"),
    "a mesh of the network": (["--mesh", "http://host/mesh.glb"], "no such file"),
    "a device": (["--mesh", "/dev/zero"], "no such file"),
}


@pytest.mark.parametrize("case", EXPORT)
def test_export(case, tmp_path, capsys):
    options, message = EXPORT[case]
    assert main(["synth", "export", "--out", str(tmp_path / "out"), *options]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [(["clips", "--rows", "1000000000"], "must be 1000 or less"), (["--size", "8000x8000"], "rows of 8000x8000 pixels"),
     (["clips", "--rows", "1000", "--size", "1000x1000"], "too large: 1000 rows of 1000x1000 pixels")],
)  # fmt: skip
def test_preview(options, message, tmp_path, capsys):
    assert main(["synth", "preview", "--out", str(tmp_path / "sheet.png"), *options]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line and not (tmp_path / "sheet.png").exists()
