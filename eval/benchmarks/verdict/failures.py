"""Clips that are made to fail: changes of rendered frames, and of the network."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch

from dvo.data.frame import Frame
from dvo.geometry.undistort import undistort

Change = Callable[[np.random.Generator, Sequence[Frame], int], Iterator[Frame]]
"""Frames changed; the number of the trial chooses among the members of a kind."""


def pattern(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """``(height, width, 3)`` float smooth noise of three sizes, 0 to 255."""
    image = np.zeros((height, width, 3))
    for rows, share in ((6, 0.5), (20, 0.3), (60, 0.2)):
        level = rng.uniform(0, 255, (rows, rows * width // height, 3))
        image += share * cv2.resize(level, (width, height), interpolation=cv2.INTER_CUBIC)
    return image.clip(0, 255)


def with_overlay(rng: np.random.Generator, frames: Sequence[Frame], number: int) -> Iterator[Frame]:
    """Something that is fixed to the camera: a dashboard, a round border, a reflection, or text."""
    height, width = frames[0].image.shape[:2]
    cover = np.zeros((height, width), np.uint8)
    if number % 4 == 0:
        cover[int(height * rng.uniform(0.15, 0.4)) :] = 255
    elif number % 4 == 1:
        cv2.circle(cover, (width // 2, height // 2), int(height * rng.uniform(0.2, 0.35)), 255, -1)
        cover = 255 - cover
    elif number % 4 == 2:
        cover[:] = int(255 * rng.uniform(0.55, 0.85))
    else:
        for _ in range(35):
            word = "".join(chr(65 + letter) for letter in rng.integers(0, 26, 8))
            at = int(rng.integers(-40, width)), int(rng.integers(0, height))
            cv2.putText(cover, word, at, cv2.FONT_HERSHEY_SIMPLEX, rng.uniform(0.6, 1.4), 255, 3)
    own, share = pattern(rng, height, width), cover[..., None] / 255
    for frame in frames:
        image = frame.image * (1 - share) + own * share
        yield replace(frame, image=image.round().astype(np.uint8))


def with_crowd(rng: np.random.Generator, frames: Sequence[Frame], _: int) -> Iterator[Frame]:
    """Large bodies that cross the picture."""
    height, width = frames[0].image.shape[:2]
    size = np.array([width, height])
    bodies = [
        (pattern(rng, height, width), rng.uniform(0, 1, 2) * size, rng.normal(0, 3, 2) * [1, 0.3],
         rng.uniform(0.15, 0.35) * height)
        for _ in range(int(rng.integers(6, 13)))
    ]  # fmt: skip
    for index, frame in enumerate(frames):
        image = frame.image.copy()
        for own, start, speed, radius in bodies:
            moved = speed * index
            x, y = ((start + moved) % (1.2 * size) - 0.1 * size).astype(int).tolist()
            cover = np.zeros((height, width), np.uint8)
            cv2.ellipse(cover, (x, y), (int(0.6 * radius), int(radius)), 0, 0, 360, 1, -1)
            image[cover > 0] = np.roll(own, (int(moved[1]), int(moved[0])), (0, 1))[cover > 0]
        yield replace(frame, image=image)


def with_floating_crop(rng: np.random.Generator, frames: Sequence[Frame], _: int) -> Iterator[Frame]:
    """The inner part of the picture, floating as that of stabilised video does."""
    height, width = frames[0].image.shape[:2]
    margin = int(0.08 * width)
    rates, phases = 2 * np.pi / rng.uniform(0.5, 3.0, (4, 2)), rng.uniform(0, 2 * np.pi, (4, 2))
    size = width - 2 * margin, height - 2 * margin
    reach = rng.uniform(0.01, 0.02) * width
    for frame in frames:
        x, y = margin + (reach * np.sin(frame.timestamp * rates + phases).sum(0) / 2**0.5).clip(-margin, margin)
        image = cv2.warpAffine(frame.image, np.array([[1, 0, -x], [0, 1, -y]]), size, flags=cv2.INTER_LINEAR)
        camera = replace(
            frame.camera, cx=frame.camera.cx - margin, cy=frame.camera.cy - margin, width=size[0], height=size[1]
        )
        yield replace(frame, image=image, camera=camera)


def with_waves(rng: np.random.Generator, frames: Sequence[Frame], _: int) -> Iterator[Frame]:
    """A sea that fills most of the picture: travelling waves in perspective, with glitter."""
    height, width = frames[0].image.shape[:2]
    horizon = int(height * rng.uniform(0.05, 0.35))
    y, x = np.mgrid[0 : height - horizon, 0:width].astype(np.float32)
    distance = 0.6 * height / (y + 8)
    waves = [
        (rng.uniform(0.02, 0.15) * rng.choice([-1, 1]), *rng.uniform([6, 0.1, 0], [50, 0.6, 6.3])) for _ in range(14)
    ]
    for index, frame in enumerate(frames):
        level = sum(
            np.sin(a * (x - width / 2) * distance + b * distance + c * index + d) for a, b, c, d in waves
        ) / np.sqrt(len(waves))  # fmt: skip
        glitter = (rng.random(level.shape) < 0.01) & (level > 1)
        colour = 90 + 35 * level[..., None] * np.array([0.7, 0.9, 1.0]) + 150 * glitter[..., None]
        image = frame.image.copy()
        image[horizon:] = colour.clip(0, 255)
        yield replace(frame, image=image)


def with_wrong_focal(_: np.random.Generator, frames: Sequence[Frame], number: int) -> Iterator[Frame]:
    """A focal length 1.5 times too long or too short."""
    factor = 1.5 if number % 2 else 1 / 1.5
    for frame in frames:
        camera = frame.camera
        yield replace(frame, camera=replace(camera, fx=camera.fx * factor, fy=camera.fy * factor))


def through_bent_lens(_: np.random.Generator, frames: Sequence[Frame], number: int) -> Iterator[Frame]:
    """Images of a lens with barrel distortion, whose calibration has the right focal length and no distortion."""
    bend, first = (0.2, 0.35, 0.5)[number % 3], frames[0].camera
    columns, rows = np.meshgrid(np.arange(float(first.width)), np.arange(float(first.height)))
    pixels = np.stack([columns, rows], -1)
    focal, centre = np.array([first.fx, first.fy]), np.array([first.cx, first.cy])
    for zoom in np.arange(1.0, 3.0, 0.02):  # the shortest focal length with which no pixel looks past the picture
        lens = replace(first, fx=first.fx * zoom, fy=first.fy * zoom, model="eucm", coefficients=(bend, 1.0))
        seen = undistort((pixels - centre) / (focal * zoom), lens) * focal + centre
        if np.isfinite(seen).all() and (seen >= 0).all() and (seen <= [first.width - 1, first.height - 1]).all():
            break
    x, y = np.moveaxis(seen.astype(np.float32), -1, 0)
    pinhole = replace(lens, model="none", coefficients=())
    for frame in frames:
        yield replace(frame, image=cv2.remap(frame.image, x, y, cv2.INTER_LINEAR), camera=pinhole)


def before_still_camera(rng: np.random.Generator, frames: Sequence[Frame], number: int) -> Iterator[Frame]:
    """A camera that stands still, before it bodies or waves."""
    first = frames[0].image
    still = [
        replace(frame, image=(first + rng.normal(0, 1.5, first.shape)).clip(0, 255).astype(np.uint8))
        for frame in frames
    ]
    return (with_crowd if number % 2 else with_waves)(rng, still, number)


def spoil(network: torch.nn.Module, number: int) -> None:
    """Add noise to the weights of a network, as if it were an early or a broken one."""
    generator = torch.Generator().manual_seed(number)
    share = (0.8, 1.2, 1.6)[number % 3]
    with torch.no_grad():
        for parameter in network.parameters():
            if parameter.dim() > 1:
                parameter.add_(share * parameter.std() * torch.randn(parameter.shape, generator=generator))
