"""Contact sheets."""

from __future__ import annotations

from pathlib import Path

import cv2

from dvo.cli import main


def test_contact_sheet_is_written(tmp_path: Path) -> None:
    out = tmp_path / "sheet.png"
    assert main(["synth", "preview", "clips", "--out", str(out), "--seed", "5", "--rows", "1", "--size", "64x48"]) == 0
    sheet = cv2.imread(str(out))
    assert sheet.shape == (48, 7 * 64, 3)
    assert all(sheet[:, i * 64 : (i + 1) * 64].std() > 1 for i in range(7)), "a cell is empty"
