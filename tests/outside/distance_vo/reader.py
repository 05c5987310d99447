"""Reader of a folder with all images in one file ``frames.npy``, ``(N, H, W, 3)`` uint8, taken at 10 frames/s."""

from pathlib import Path

import numpy as np

from dvo.data.calibration.read import read_calibration
from dvo.data.recording import Log, RawFrame, Reader, Request


class ArrayRecording:
    """Images of ``frames.npy``, read one at a time; ``calib.txt`` beside it."""

    kind, groundtruth, stereo, inertial = "array", None, None, None

    def __init__(self, path: Path, request: Request) -> None:
        self.path, self.name, self.warnings = path, path.name, []
        self._images = np.load(path / "frames.npy", mmap_mode="r")
        self.frame_count = len(self._images)
        self.calibration = read_calibration(path / "calib.txt")

    def frames(self, log: Log, stride: int = 1):
        for index in range(0, self.frame_count, stride):
            yield RawFrame(index, index / 10, np.array(self._images[index]), f"frames.npy[{index}]")


READER = Reader("array", lambda path: (path / "frames.npy").is_file(), ArrayRecording)
