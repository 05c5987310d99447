"""H.264 compression of rendered frames, as phones and cameras do it: blocks, and details that stand still."""

from __future__ import annotations

import importlib.util
import subprocess

import numpy as np

from dvo.core.errors import DvoError

LENGTH = 30
"""Frames that are coded together; the first of them is a whole picture, the others tell what has changed."""


def compressed_video(images: np.ndarray, crf: int) -> np.ndarray:
    """Images after H.264 compression, as one video that begins with a whole picture.

    Args:
        images: ``(N, H, W, 3)`` uint8 RGB.
        crf: constant rate factor, 1 to 51; the higher, the fewer bits.

    Returns:
        ``(N, H, W, 3)`` uint8 RGB, the same on each call.

    Raises:
        DvoError: ``imageio-ffmpeg``, which brings the encoder, is not installed, or its encoder does not work.
    """
    _, rows, columns, _ = images.shape
    even = np.pad(images, ((0, 0), (0, rows % 2), (0, columns % 2), (0, 0)), mode="edge")
    _, height, width, _ = even.shape
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}"]
    command = [_program(), "-v", "error", "-threads", "1"]
    encode = [*command, *raw, "-r", "30", "-i", "-", "-c:v", "libx264", "-preset", "veryfast", "-threads", "1",
              "-crf", str(crf), "-g", str(LENGTH), "-bf", "0", "-pix_fmt", "yuv420p", "-f", "h264", "-"]  # fmt: skip
    code = _output(encode, even.tobytes())
    # older programs read this stream at 25 frames a second, and repeat frames to write 30
    decode = [*command, "-f", "h264", "-framerate", "30", "-i", "-", "-r", "30", *raw, "-"]
    pixels = _output(decode, code)
    return np.frombuffer(pixels, np.uint8).reshape(even.shape)[:, :rows, :columns].copy()


def _program() -> str:
    """Path of ffmpeg."""
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        raise DvoError(
            "H.264 needs imageio-ffmpeg, which is not installed", field="h264", remedy="pip install 'dvo[synth]'"
        )
    import imageio_ffmpeg

    try:
        return imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[0]
        remedy = "pip install --force-reinstall imageio-ffmpeg"
        raise DvoError(f"no ffmpeg ({reason})", field="h264", remedy=remedy) from error


def _output(command: list[str], data: bytes) -> bytes:
    """What a run of ffmpeg on some data writes."""
    try:
        return subprocess.run(command, input=data, capture_output=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError) as error:
        lines = getattr(error, "stderr", b"").decode(errors="replace").strip().splitlines() or [str(error)]
        remedy = "use an ffmpeg with libx264: unset IMAGEIO_FFMPEG_EXE, or name another one in it"
        raise DvoError(f"{command[0]} failed ({lines[-1]})", field="h264", remedy=remedy) from error
