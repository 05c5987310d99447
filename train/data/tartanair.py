"""Folders of TartanAir as a list of recordings."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from dvo.core.errors import DvoError
from dvo.data.readers.tartanair import LAYOUTS

_DEPTH = 5  # levels below the given folder: ENV/ENV/Easy/P000 of the archives as they are unpacked
_POSES = frozenset(layout.poses for layout in LAYOUTS)


def with_trajectories(folders: Sequence[str]) -> list[str]:
    """Replace folders that hold TartanAir's trajectories somewhere below by these.

    Args:
        folders: recordings, of any format, and folders such as ``tartanair``, ``tartanair/ENV`` or
            ``tartanair/ENV/Easy`` of v1, ``tartanair/ENV/Data_easy`` of v2.

    Returns:
        The trajectories ``.../P000`` of a folder in the order of their names; a folder without any as it is.

    Raises:
        DvoError: a folder with hundreds of thousands of folders, which is not one of TartanAir.
    """
    found: list[str] = []
    for folder in folders:
        below = _trajectories(Path(folder))
        found += below or [folder]
    return found


def _trajectories(folder: Path) -> list[str]:
    """Folders with a file of poses below a folder; none if it holds one itself."""
    found, seen = [], 0
    for place, names, files in os.walk(folder, followlinks=True):
        if not _POSES.isdisjoint(files):
            if Path(place) == folder:
                return []
            found.append(place)
            names.clear()  # folders of thousands of images
        elif len(Path(place).relative_to(folder).parts) >= _DEPTH:
            names.clear()
        seen += len(names)
        if seen > 200_000:
            remedy = "name the folder of TartanAir, or its trajectories"
            raise DvoError("holds too many folders", file=folder, field="data.real.folders", remedy=remedy)
    return sorted(found)
