"""Small tests of an installation for ``dvo doctor``: formats, arithmetic, checksums."""

from __future__ import annotations

import base64
import hashlib
import importlib.metadata
import platform
from pathlib import Path

from dvo.data.files.output import scratch_folder


def version_of(distribution: str) -> str | None:
    """Version of an installed distribution, or None."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def checksum_state(path: Path, content: bytes) -> str:
    """Comparison of a file of the package with the checksum that its installation recorded.

    Args:
        path: the file.
        content: of it.

    Returns:
        ``as installed``, ``differs``, or ``no checksum recorded`` (a checkout).
    """
    try:
        files = importlib.metadata.distribution("dvo").files or []
    except importlib.metadata.PackageNotFoundError:
        files = []
    for file in files:
        if file.name == path.name and file.hash is not None and Path(str(file.locate())).resolve() == path.resolve():
            digest = hashlib.new(file.hash.mode, content).digest()
            return (
                "as installed"
                if base64.urlsafe_b64encode(digest).decode().rstrip("=") == file.hash.value
                else "differs"
            )
    return "no checksum recorded"


def video_state(code: str, suffix: str) -> str:
    """Test of a video format.

    Args:
        code: four characters of the codec.
        suffix: of the file.

    Returns:
        ``reads``, ``does not read``, or ``not tested`` where OpenCV cannot write one.
    """
    import cv2
    import numpy as np

    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        with scratch_folder("dvo-doctor") as folder:
            file = str(folder / f"clip{suffix}")
            writer = cv2.VideoWriter(file, cv2.VideoWriter.fourcc(*code), 10.0, (64, 48))
            if not writer.isOpened():
                return "not tested (OpenCV cannot write it)"
            for _ in range(3):
                writer.write(np.full((48, 64, 3), 200, np.uint8))
            writer.release()
            reader = cv2.VideoCapture(file)
            frames = [reader.read() for _ in range(3)]
            reader.release()
    finally:
        cv2.utils.logging.setLogLevel(level)
    return "reads" if all(good and abs(float(image.mean()) - 200) < 10 for good, image in frames) else "does not read"


def image_works(suffix: str) -> bool:
    """True if OpenCV reads an image that it wrote.

    Args:
        suffix: of the format.
    """
    import cv2
    import numpy as np

    try:
        good, data = cv2.imencode(suffix, np.full((16, 16, 3), 200, np.uint8))
        image = cv2.imdecode(data, cv2.IMREAD_COLOR) if good else None
    except cv2.error:
        return False
    return image is not None and abs(float(image.mean()) - 200) < 10


def arithmetic_state(device: str, problems: list[str]) -> str:
    """Test of float32 and float64 on a device.

    Args:
        device: name of it.
        problems: a device without working float32 is added.

    Returns:
        State in words.
    """
    import torch

    failed = {}
    for dtype in (torch.float32, torch.float64):
        try:
            matrix = torch.full((8, 8), 0.5, device=device, dtype=dtype)
            if float((matrix @ matrix).sum()) != 128.0:
                raise ArithmeticError("wrong result")
        except (RuntimeError, TypeError, ArithmeticError, AssertionError) as error:
            failed[str(dtype).removeprefix("torch.")] = sentence_of(error)
    if "float32" in failed:
        problems.append(f"device {device} does not work ({failed['float32']}). Use --device cpu")
        return f"does not work: {failed['float32']}"
    return f"no float64: {failed['float64']}" if failed else "float64 works"


def processor_name() -> str:
    """Model of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(named, platform.processor() or platform.machine())


def sentence_of(error: Exception) -> str:
    """Message of an error on one line, cut short."""
    return (" ".join(str(error).split()) or type(error).__name__)[:200]
