"""A calibration file of one row, ``FOCAL f width height``."""

from pathlib import Path

from dvo.data.calibration.calibration import Calibration, Dialect


def read(path: Path, text: str, camera: int | None) -> Calibration:
    """Square pixels, the principal point in the middle."""
    focal, width, height = map(float, text.split()[1:])
    return Calibration(focal, focal, (width - 1) / 2, (height - 1) / 2, file=path)


DIALECT = Dialect(lambda path, text: text.startswith("FOCAL "), read)
