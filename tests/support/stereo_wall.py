"""A stereo camera that moves along a wall."""

from __future__ import annotations

import cv2
import numpy as np

from dvo.data.frame import Frame, StereoView
from dvo.geometry.camera import Camera


def stereo_wall(count, step=0.05, baseline=0.1, metres=2.0):
    """A camera that moves sideways along a wall, 0.05 m a frame, with its right images."""
    rng = np.random.default_rng(0)
    wall = cv2.resize(rng.integers(0, 255, (30, 90, 3), np.uint8), None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    camera = Camera(160.0, 160.0, 79.5, 59.5, 160, 120)
    mount = np.array([baseline, 0, 0, 0, 0, 0, 1.0])
    found = []
    for k in range(count):
        left, right = (round(160 * (step * k + shift) / metres) for shift in (0, baseline))
        view = StereoView(np.ascontiguousarray(wall[:, right : right + 160]), camera, mount)
        image = np.ascontiguousarray(wall[:, left : left + 160])
        found.append(Frame(k, k / 10, image, camera, right=view))
    return found
