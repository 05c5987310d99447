"""Options of ``dvo run`` that show the run, in a module that imports nothing heavy."""

from __future__ import annotations

import argparse

VIEWER = ""  # value of --rerun without a file


def add_view_options(parser: argparse.ArgumentParser) -> None:
    """Add the options.

    Args:
        parser: of the command.
    """
    viewer = parser.add_mutually_exclusive_group()
    viewer.add_argument(
        "--rerun",
        nargs="?",
        const=VIEWER,
        type=_recording,
        metavar="FILE.rrd",
        help="log images, patches, edges and poses for the viewer Rerun: into FILE, or start the viewer (dvo[viz])",
    )
    viewer.add_argument(
        "--rerun-connect",
        metavar="ADDRESS",
        help="log for a viewer that runs on another machine, as HOST:PORT (there: rerun; dvo[viz] here)",
    )
    parser.add_argument(
        "--overlay", type=_video, metavar="FILE.mp4", help="video of the frames with the tracked patches"
    )


def _video(text: str) -> str:
    if not text.lower().endswith((".mp4", ".avi")):
        raise argparse.ArgumentTypeError(f"--overlay needs a file named .mp4 or .avi, got {text[:200]!r}")
    return text


def _recording(text: str) -> str:
    if text != VIEWER and not text.endswith(".rrd"):
        hint = "to start the viewer, put --rerun after SOURCE or write '--rerun -- SOURCE'"
        raise argparse.ArgumentTypeError(f"expected a file named .rrd, got {text[:60]!r} ({hint})")
    return text
