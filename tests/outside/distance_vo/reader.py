"""Reader of a folder with all images in one file ``frames.npy``, ``(N, H, W, 3)`` uint8, taken at 10 frames/s."""

from pathlib import Path

import numpy as np

from dvo.data.calibration.read import read_calibration
from dvo.data.recording import EVERYTHING, Log, RawFrame, Reader, Recording, Request, Selection


class ArrayRecording(Recording):
    """Images of ``frames.npy``, read one at a time; ``calib.txt`` beside it."""

    kind, groundtruth = "array", None

    def __init__(self, path: Path, request: Request) -> None:
        self.path, self.name, self.warnings = path, path.name, []
        self._images = np.load(path / "frames.npy", mmap_mode="r")
        self.frame_count = len(self._images)
        self.calibration = read_calibration(path / "calib.txt")

    def frames(self, log: Log, selection: Selection = EVERYTHING):
        numbered = ((index, index / 10) for index in range(self.frame_count))
        for index, _ in selection.interval.select(numbered, lambda item: item[1], selection.stride, self.path):
            yield RawFrame(index, index / 10, np.array(self._images[index]), f"frames.npy[{index}]")


READER = Reader("array", lambda path: (path / "frames.npy").is_file(), ArrayRecording)
