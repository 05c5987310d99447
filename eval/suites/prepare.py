"""Render suites ahead of an evaluation: ``python -m eval.suites.prepare axes axes/test``."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from dvo.errors import DvoError
from eval.suites.rendered import RECORD, place_of, rendered_folder
from eval.suites.suite import Suite, read_suites


def prepare(suites: list[Suite]) -> list[Path]:
    """See to it that every rendered sequence is in the cache; prints what it did. Returns the folders."""
    folders = []
    begin, made = time.perf_counter(), 0
    for suite in suites:
        for sequence in suite.sequences:
            if sequence.rendered is None:
                continue
            options = dict(sequence.rendered)
            there = (place_of(sequence.name, options) / RECORD).is_file()
            folder = rendered_folder(sequence.name, options)
            facts = json.loads((folder / RECORD).read_text(encoding="utf-8"))
            made += not there
            took = (
                "in the cache" if there else f"{facts['seconds']:.1f} s, {facts['processor_seconds']:.1f} s of a core"
            )
            print(f"{sequence.name:32} {facts['frames']} frames, {facts['path_m']:.2f} m, {facts['scene']}: {took}")
            sys.stdout.flush()
            folders.append(folder)
    size = sum(file.stat().st_size for folder in folders for file in folder.rglob("*") if file.is_file())
    where = folders[0].parent if folders else "nowhere"
    print(
        f"{len(folders)} sequences, {made} rendered now, {size / 1e6:.0f} MB in {where}; "
        f"{time.perf_counter() - begin:.0f} s"
    )
    return folders


def contact_sheet(folders: list[Path], columns: int = 6, width: int = 200) -> np.ndarray:
    """``(H, W, 3)`` uint8 RGB: a row of frames for every sequence."""
    import cv2

    rows = []
    for folder in folders:
        files = sorted((folder / "rgb").iterdir())
        chosen = [files[i] for i in np.linspace(0, len(files) - 1, columns).round().astype(int)]
        cells = [cv2.resize(cv2.imread(str(f)), (width, width * 3 // 4), interpolation=cv2.INTER_AREA) for f in chosen]
        name = folder.name.rsplit("-", 1)[0]
        cv2.putText(cells[0], name, (3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(cells[0], name, (3, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (255, 255, 255), 1, cv2.LINE_AA)
        rows.append(np.concatenate(cells, 1))
    return np.concatenate(rows)[..., ::-1]


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit code: 0, or 2 for an input that the user can mend."""
    line = argparse.ArgumentParser(prog="python -m eval.suites.prepare", description=__doc__)
    line.add_argument("suites", nargs="+", help="axes, axes/test, fast, fast/test/large, ...")
    line.add_argument("--sheet", type=Path, metavar="PNG", help="write a contact sheet too")
    given = line.parse_args(arguments)
    try:
        folders = prepare([suite for name in given.suites for suite in read_suites(name)])
        if given.sheet and folders:
            import cv2

            if not cv2.imwrite(str(given.sheet), contact_sheet(folders)[..., ::-1]):
                raise DvoError("cannot write the picture", file=given.sheet, remedy="give a path that ends in .png")
    except DvoError as error:
        print(f"eval: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
