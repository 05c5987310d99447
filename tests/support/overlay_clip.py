"""Rendered clip with a textured region that does not move with the scene, as a bonnet or a watermark."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.synth.sequence import make_sequence


def used_pixels(height: int = 240, width: int = 320) -> np.ndarray:
    """``(H, W)`` bool, False in the overlay: the lowest part of the image and a plate in a corner."""
    used = np.ones((height, width), bool)
    used[round(0.82 * height) :] = False
    used[: height // 5, : width // 4] = False
    return used


def overlay_clip(frames: int = 48) -> tuple[list[Frame], list[Frame], list[Frame], Trajectory]:
    """Render the clip.

    Args:
        frames: length.

    Returns:
        Frames without the overlay, with it, and with it and its mask; and the ground truth.
    """
    sequence = make_sequence(5, frames=frames, family="room", kind="handheld", sensor=False)
    used = used_pixels()
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    plate = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
    clean = list(sequence)
    covered = [replace(frame, image=np.where(used[..., None], frame.image, plate)) for frame in clean]
    masked = [replace(frame, mask=used) for frame in covered]
    return clean, covered, masked, sequence.groundtruth
