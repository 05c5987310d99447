"""Frames of odd types, given to the checks of frames and to an odometry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_frame
from dvo.geometry.camera import Camera
from tests.fuzz.readers_data import HEIGHT, WIDTH, lines, picture
from tests.fuzz.target import Target, require

MODULES = ("torch", "dvo.odometry.load", "dvo.odometry.patch.tracker", "dvo.models.patch_vo", "dvo.data.frame_checks")
CAMERA = Camera(50.0, 51.0, 31.5, 23.5, WIDTH, HEIGHT)


def odd_images() -> list[Any]:
    """Images of types, shapes and values that are not ``(H, W, 3)`` uint8."""
    image = picture(2)
    unit = image.astype(np.float32) / 255
    with_nan = unit.copy()
    with_nan[3, 4] = np.nan
    return [
        image[..., 0], image[..., :1], np.dstack([image, image[..., :1]]), image.astype(np.float64), unit, with_nan,
        unit * np.inf, image.astype(np.uint16) * 257, image.astype(np.int64), image.astype(np.int8), image > 100,
        image.astype(np.complex64), image.astype(object), image[:10], image[:0], image[:, :, :0], image[None],
        np.zeros((3, HEIGHT, WIDTH), np.uint8), np.zeros(5), np.float32(3), None, "image", b"x", image.tolist(), [],
        3.5, {}, image[::2, ::2], image[:, ::-1], np.asfortranarray(image), np.ma.masked_array(image),
        image.astype(">u2"),
        np.zeros((HEIGHT, WIDTH, 3), "datetime64[s]"), np.zeros((HEIGHT, WIDTH, 3), "U3"), np.recarray(3, "u1"),
        np.broadcast_to(np.uint8(0), (40_000, 40_000, 3)), unit.astype(np.float16), -unit,
        unit * 255, unit * 1e30,
    ]  # fmt: skip


def odd_values() -> list[Any]:
    """Values that are neither index, time, camera, depth nor view."""
    return [None, "1", float("nan"), float("inf"), -float("inf"), -1, 10**400, 1e308, [], {}, (), 3 + 4j, b"1",
            np.zeros(3), np.array(2.0), np.float32(7), True, np.datetime64("2024-01-01"), object(), 2.5,
            np.int64(5)]  # fmt: skip


def _nothing(folder: Path) -> None:
    lines(folder / "empty.txt", [])


def _mark(folder: Path, random: np.random.Generator) -> str:
    return "odd frame"


def _frames(random: np.random.Generator | None) -> list[Any]:
    """Three frames, the middle one odd in one or two fields."""
    frames: list[Any] = [Frame(i, 0.1 * i, picture(i), CAMERA) for i in range(3)]
    if random is None:
        return frames
    fields: dict[str, Any] = {"index": 1, "timestamp": 0.1, "image": picture(1), "camera": CAMERA}
    for _ in range(int(random.integers(1, 3))):
        name = ("image", "image", "timestamp", "camera", "index", "depth", "right", "inertial")[int(random.integers(8))]
        options = odd_images() if name in ("image", "depth") else odd_values()
        fields[name] = options[int(random.integers(len(options)))]
    frames[1] = Frame(**fields)
    if random.random() < 0.05:
        frames[1] = odd_values()[int(random.integers(len(odd_values())))]
    if random.random() < 0.1:
        frames[1], frames[2] = frames[2], frames[1]
    return frames


def _checked(folder: Path, random: np.random.Generator | None) -> None:
    for frame in _frames(random):
        found = checked_frame(frame)
        image, camera = found.image, found.camera
        require(isinstance(image, np.ndarray) and image.dtype == np.uint8, "image of another type than uint8")
        require(image.shape == (camera.height, camera.width, 3), f"image of shape {image.shape}")
        require(np.isfinite(found.timestamp), "time that is not finite")


def _tracked(folder: Path, random: np.random.Generator | None) -> None:
    from dvo.odometry.load import load

    odometry = load("small", patches=8, pixels=WIDTH * HEIGHT)
    for frame in _frames(random):
        estimate = odometry.track(frame)
        require(np.isfinite(estimate.timestamp), "time that is not finite")
        pose = estimate.pose_wc
        require(pose is None or np.isfinite(np.asarray(pose)).all(), "pose that is not finite")
    result = odometry.finish()
    require(np.isfinite(result.trajectory.poses_wc).all(), "trajectory that is not finite")


TARGETS = (
    Target("checked_frame", _nothing, _checked, _mark, MODULES),
    Target("track", _nothing, _tracked, _mark, MODULES),
)
