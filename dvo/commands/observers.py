"""Observers that the options of ``dvo run`` ask for."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from pathlib import Path

from dvo.commands.view_options import VIEWER
from dvo.odometry.observer import Observer


@contextlib.contextmanager
def open_observers(arguments: argparse.Namespace, name: str) -> Iterator[list[Observer]]:
    """Open the observers for the time of a run.

    Args:
        arguments: of the command line.
        name: of the clip.

    Yields:
        Observers, closed at the end.

    Raises:
        DvoError: a package is missing, or a file cannot be written.
    """
    with contextlib.ExitStack() as stack:
        found: list[Observer] = []
        if arguments.rerun is not None:
            from dvo.viz.rerun_log import RerunLog

            found.append(RerunLog(None if arguments.rerun == VIEWER else Path(arguments.rerun), name))
            stack.callback(found[-1].close)
        if arguments.overlay is not None:
            from dvo.viz.overlay import OverlayVideo

            found.append(OverlayVideo(Path(arguments.overlay)))
            stack.callback(found[-1].close)
        yield found
