"""Rendered clip of a wide camera, seen through a fisheye lens (OpenCV's model) and through the pinhole camera that
undistortion gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from dvo.data.trajectory import write_tum
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import undistorted_camera
from dvo.synth.sequence import make_sequence

LENS = Camera(168.0, 168.0, 160.5, 118.5, 320, 240, "fisheye", (0.012, -0.006, 0.003, -0.001))
"""Equidistant lens of about 108 degrees; the rendered view ends before its corners, which stay black."""
_WIDE = Camera(256.0, 256.0, 319.5, 239.5, 640, 480)


def _sampled(image: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Rendered image at rays ``(H, W, 2)`` of another camera."""
    at = (rays * [_WIDE.fx, _WIDE.fy] + [_WIDE.cx, _WIDE.cy]).astype(np.float32)
    return cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR)


def _pixels(camera: Camera) -> np.ndarray:
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(camera.height, dtype=np.float64))
    return np.stack([u, v], -1)


def write_clips(folder: Path, frames: int = 40) -> tuple[Path, Path]:
    """Write the clip twice, with calibration and ground truth.

    Args:
        folder: for the two sequence folders.
        frames: length.

    Returns:
        Folders of the fisheye clip (calibration in Kalibr's layout) and of the pinhole clip.
    """
    sequence = make_sequence(3, frames=frames, family="room", kind="handheld", width=640, height=480, sensor=False)
    sequence = replace(sequence, camera=_WIDE)
    pinhole = undistorted_camera(LENS)
    fisheye_rays = cv2.fisheye.undistortPoints(
        _pixels(LENS).reshape(-1, 1, 2), LENS.matrix, np.array(LENS.coefficients)
    ).reshape(LENS.height, LENS.width, 2)
    pinhole_rays = (_pixels(pinhole) - [pinhole.cx, pinhole.cy]) / [pinhole.fx, pinhole.fy]
    out = folder / "fisheye", folder / "pinhole"
    for path in out:
        (path / "images").mkdir(parents=True)
        write_tum(path / "groundtruth_tum.txt", sequence.groundtruth)
    for frame in sequence:
        for path, rays in zip(out, (fisheye_rays, pinhole_rays), strict=True):
            image = _sampled(frame.image, rays)
            assert cv2.imwrite(str(path / "images" / f"{frame.index:04d}.png"), image[..., ::-1])
    k = LENS
    (out[0] / "calib.yaml").write_text(
        "cam0:\n  camera_model: pinhole\n  distortion_model: equidistant\n"
        f"  distortion_coeffs: {list(k.coefficients)}\n  intrinsics: {[k.fx, k.fy, k.cx, k.cy]}\n"
        f"  resolution: [{k.width}, {k.height}]\n"
    )
    (out[1] / "calib.txt").write_text(" ".join(map(str, pinhole.intrinsics)) + "\n")
    return out
