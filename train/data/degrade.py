"""Random degradation of training images: little light, noise, blur. Strong on purpose: the view of a student."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from dvo.core.errors import DvoError
from dvo.core.settings import check_settings
from train.data.augment import random_source


@dataclass(frozen=True)
class Degradation:
    """Distribution of the degradations; one draw for all frames of a clip, but for the noise itself.

    Attributes:
        light: probability of little light: the images are dimmed, get noise, and are amplified again by a part.
        light_range: share of the light that is left.
        noise: probability of noise without little light.
        noise_range: standard deviation, grey levels of 0 to 255; that of little light is the same before amplification.
        blur: probability of blur.
        blur_range: length of a motion blur in a random direction, pixels.

    Raises:
        DvoError: a probability or a range that is none.
    """

    light: float = 0.3
    light_range: tuple[float, float] = (0.1, 0.5)
    noise: float = 0.3
    noise_range: tuple[float, float] = (1.0, 6.0)
    blur: float = 0.3
    blur_range: tuple[float, float] = (1.0, 5.0)

    def __post_init__(self) -> None:
        check_settings(self, {"light": (0, 1), "noise": (0, 1), "blur": (0, 1)})
        for name, least, most in (("light_range", 1e-3, 1.0), ("noise_range", 0.0, 255.0), ("blur_range", 0.0, 64.0)):
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                raise DvoError(
                    f"{low:g} to {high:g} is no range", field=name, remedy=f"give low <= high, {least:g} to {most:g}"
                )


def degrade(images: Tensor, settings: Degradation, seed: int, step: int) -> Tensor:
    """Degrade the clips of a batch at random, the same for the same seed, step and process.

    Args:
        images: ``(B, N, 3, H, W)`` uint8.
        settings: distribution of the degradations.
        seed: of the draws.
        step: of training.

    Returns:
        Images of the same shape and type.
    """
    from train.engine.ranks import rank

    count = len(images)
    clips = []
    for index, clip in enumerate(images):
        number = (seed * 1_000_003 + step) * 8191 + rank() * count + index
        draw = random_source(number ^ 0x5E1F)
        clips.append(_degraded(clip, settings, draw))
    return torch.stack(clips)


def _degraded(clip: Tensor, settings: Degradation, draw: torch.Generator) -> Tensor:
    uniform = torch.rand(8, generator=draw).tolist()  # all of them each time: one effect does not move the others

    def between(limits: tuple[float, float], u: float) -> float:
        return limits[0] + (limits[1] - limits[0]) * u

    x = clip.float()
    if uniform[0] < settings.blur:
        x = motion_blurred(x, between(settings.blur_range, uniform[1]), math.pi * uniform[2])
    spread = between(settings.noise_range, uniform[3])
    dark = uniform[4] < settings.light
    left = between(settings.light_range, uniform[5]) if dark else 1.0
    if dark or uniform[6] < settings.noise:
        noise = torch.randn(clip.shape, generator=draw).to(clip.device)
        x = (x * left + spread * noise) * left ** -uniform[7]  # from no amplification to that of the usual brightness
    return x.round().clamp(0, 255).to(clip.dtype)


def motion_blurred(images: Tensor, length: float, angle: float) -> Tensor:
    """Mean of images along a line through each pixel.

    Args:
        images: ``(N, C, H, W)`` float.
        length: of the line, pixels; 0 changes nothing.
        angle: of the line to the x axis, radians.

    Returns:
        Images of the same shape; pixels beyond the border are those of the border.
    """
    half = max(1, math.ceil(length / 2))
    size = 2 * half + 1
    kernel = torch.zeros(size, size)
    taps = 4 * half + 1
    for tap in range(taps):
        along = (tap / (taps - 1) - 0.5) * length
        x, y = half + along * math.cos(angle), half + along * math.sin(angle)
        column, row = min(int(x), size - 2), min(int(y), size - 2)
        u, v = x - column, y - row
        kernel[row : row + 2, column : column + 2] += torch.tensor(
            [[(1 - u) * (1 - v), u * (1 - v)], [(1 - u) * v, u * v]]
        )
    kernel = (kernel / kernel.sum()).to(images)
    padded = F.pad(images, (half,) * 4, mode="replicate")
    return F.conv2d(padded.flatten(0, 1)[:, None], kernel[None, None]).view_as(images)
