"""Checks of the frames that enter an odometry, and harmless conversions of their images."""

from __future__ import annotations

from dvo.data.frame import Frame


def checked_frame(frame: Frame) -> Frame:
    """Check a frame, and convert its image to ``(H, W, 3)`` uint8 RGB where nothing is lost by it.

    Args:
        frame: as given by the caller.

    Returns:
        The frame itself, or one with a converted image.

    Raises:
        DvoError: a frame that cannot be used; names the frame and the field.
    """
    return frame
