"""Rendering of suites ahead of an evaluation, for ``python -m eval prepare axes axes/test``."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np

from dvo.core.errors import DvoError
from dvo.core.text import print_line
from dvo.data.images.images import read_image
from eval.suites.rendered import RECORD, place_of, rendered_folder
from eval.suites.suite import Suite


def prepare(suites: list[Suite]) -> list[Path]:
    """Render every sequence that is not in the cache yet, with a line of output for each.

    Args:
        suites: rendered ones; recordings in them are passed over.

    Returns:
        Folders of the rendered sequences.
    """
    folders = []
    begin, made = time.perf_counter(), 0
    for suite in suites:
        for sequence in suite.sequences:
            if sequence.rendered is None:
                continue
            there = (place_of(*sequence.rendering) / RECORD).is_file()
            folder = rendered_folder(*sequence.rendering)
            facts = json.loads((folder / RECORD).read_text(encoding="utf-8"))
            made += not there
            took = (
                "in the cache" if there else f"{facts['seconds']:.1f} s, {facts['processor_seconds']:.1f} s of a core"
            )
            print_line(
                f"{sequence.name:32} {facts['frames']} frames, {facts['path_m']:.2f} m, {facts['scene']}: {took}"
            )
            folders.append(folder)
    size = sum(file.stat().st_size for folder in folders for file in folder.rglob("*") if file.is_file())
    where = folders[0].parent if folders else "nowhere"
    print_line(
        f"{len(folders)} sequences, {made} rendered now, {size / 1e6:.0f} MB in {where}; "
        f"{time.perf_counter() - begin:.0f} s"
    )
    return folders


def contact_sheet(folders: list[Path], columns: int = 6, width: int = 200) -> np.ndarray:
    """``(H, W, 3)`` uint8 RGB: a row of frames for every sequence.

    Args:
        folders: of rendered sequences.
        columns: frames of a row.
        width: of a frame, pixels.
    """
    import cv2

    rows = []
    for folder in folders:
        files = sorted((folder / "rgb").iterdir(), key=lambda file: float(file.stem))  # in order of time
        chosen = [files[i] for i in np.linspace(0, len(files) - 1, columns).round().astype(int)]
        cells = [cv2.resize(_read(file), (width, width * 3 // 4), interpolation=cv2.INTER_AREA) for file in chosen]
        name = folder.name.rsplit("-", 1)[0]
        cv2.putText(cells[0], name, (3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(cells[0], name, (3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (255, 255, 255), 1, cv2.LINE_AA)
        rows.append(np.concatenate(cells, 1))
    return np.concatenate(rows)


def _read(file: Path) -> np.ndarray:
    image = read_image(file)
    if image is None:
        raise DvoError("cannot be read", file=file, remedy="remove its folder, and prepare the suite again")
    return image


def write_sheet(path: Path, folders: list[Path]) -> None:
    """Write a contact sheet as a picture.

    Args:
        path: a PNG file.
        folders: of rendered sequences.

    Raises:
        DvoError: the file cannot be written, or its suffix names no format.
    """
    import cv2

    try:
        written = cv2.imwrite(str(path), contact_sheet(folders)[..., ::-1])
    except cv2.error:
        written = False
    if not written:
        raise DvoError("cannot write the picture", file=path, remedy="give a path that ends in .png")
