"""Arguments and output of the command ``dvo run`` in tests."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest


def arguments(images: Path, out: Path | str, *more: str) -> list[str]:
    """Command line that tracks a folder of images, with the calibration and the times beside it."""
    beside = images.parent
    return ["run", str(images), "--calib", str(beside / "calib.txt"), "--times", str(beside / "times.txt"),
            "--out", str(out), "--device", "cpu", *more]  # fmt: skip


def without_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs write a white picture in place of their plot, which takes most of the time of a short run."""

    def white(path: Path | str, *_: object, **options: object) -> None:
        cv2.imwrite(str(path), np.full((60, 80, 3), 255, np.uint8))

    monkeypatch.setattr("dvo.commands.picture.plot_panels", white)


def summary(out: Path) -> dict:
    """Content of run.json."""
    return json.loads((out / "run.json").read_text())


def names(folder: Path) -> list[str]:
    """Names of the files in a folder, sorted."""
    return sorted(path.name for path in folder.iterdir())


def errors(text: str) -> list[str]:
    """Lines of stderr without those of the progress bar."""
    assert "Traceback" not in text
    return [line for line in text.splitlines() if line.startswith("dvo: ")]
