"""Files of dvo whose code runs while one frame is tracked: `python -m eval.benchmarks.traced_frame [SEQUENCE]`.

The frames before it are tracked first; what runs once for a sequence, or now and then, is not part of the list unless
it falls on that frame. Printed are the files with the number of their functions that ran, by room.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from itertools import islice
from pathlib import Path
from types import FrameType
from typing import Any

import dvo
from dvo.core.command_line import OneLineParser
from dvo.data.files.root import data_root

LIBRARY = Path(dvo.__file__).resolve().parent


class Traced:
    """Context in which calls of functions of the library are noted.

    Attributes:
        functions: names of functions that ran, by file relative to the library.
    """

    def __init__(self) -> None:
        self.functions: dict[Path, set[str]] = defaultdict(set)

    def __enter__(self) -> Traced:
        sys.setprofile(self._note)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)

    def _note(self, frame: FrameType, event: str, _: Any) -> None:
        file = Path(frame.f_code.co_filename)
        if event == "call" and LIBRARY in file.parents:
            self.functions[file.relative_to(LIBRARY)].add(frame.f_code.co_qualname)


def main(given: list[str] | None = None) -> None:
    """Command line."""
    parser = OneLineParser(
        prog="python -m eval.benchmarks.traced_frame", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("sequence", nargs="?", help="video, folder or data set (7scenes_redkitchen_400)")
    parser.add_argument("--frame", type=int, default=100, metavar="N", help="number of the frame (%(default)s)")
    options = parser.parse_args(given)
    source = dvo.open(options.sequence or data_root() / "7scenes_redkitchen_400")
    odometry = dvo.load("small", device="cpu")
    frames = iter(source)
    for frame in islice(frames, options.frame):
        odometry.track(frame)
    last = next(frames, None)
    if last is None:
        parser.error(f"--frame {options.frame}: the sequence is shorter")
    with Traced() as traced:
        odometry.track(last)
    for file, functions in sorted(traced.functions.items()):
        print(f"{file.as_posix():48} {len(functions):3}")
    print(f"{len(traced.functions)} files, {sum(map(len, traced.functions.values()))} functions")


if __name__ == "__main__":
    main()
