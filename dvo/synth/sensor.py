"""What a camera does to a clean rendering: exposure, colour, vignetting, blur, noise. Light version.

Everything is drawn from a seed; the drawing and the noise are made on the CPU, so that a clip does not depend on the
device.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F


@dataclass(frozen=True)
class Sensor:
    """Parameters of one clip.

    Attributes:
        exposure: mean brightness to which the clip is exposed, in [0, 1]; None leaves the light as it is.
        gamma, contrast, saturation: 1 changes nothing.
        balance: red, green, blue gains.
        flicker: standard deviation of the frame-to-frame drift of log gain.
        vignette: darkening in the corners, 0 to 1.
        blur: Gaussian radius in pixels, 0 for none.
        shutter: share of the time between frames during which light is gathered, 0 for no motion blur; the blur follows
            the flow between frames (an approximation; poses and depth are those of mid-exposure).
        shot, read: noise deviation at full brightness (grows with the root of brightness) and in the dark.
    """

    exposure: float | None = 0.45
    gamma: float = 1.0
    contrast: float = 1.0
    saturation: float = 1.0
    balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    flicker: float = 0.0
    vignette: float = 0.0
    blur: float = 0.0
    shutter: float = 0.0
    shot: float = 0.0
    read: float = 0.0


def random_intrinsics(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """``(4,)`` fx fy cx cy: horizontal field of view 40-100 degrees, slightly off centre, slightly anisotropic."""
    view = np.deg2rad(rng.uniform(40, 100))
    fx = 0.5 * width / np.tan(view / 2)
    fy = fx * np.exp(rng.normal(0, 0.01))
    cx = (width - 1) / 2 + np.clip(rng.normal(0, 0.012), -0.04, 0.04) * width
    cy = (height - 1) / 2 + np.clip(rng.normal(0, 0.012), -0.04, 0.04) * height
    return np.array([fx, fy, cx, cy])


def random_sensor(rng: np.random.Generator) -> Sensor:
    """Draw a camera: mostly decent, now and then poor."""
    poor = rng.random() < 0.25
    return Sensor(
        exposure=float(np.clip(rng.normal(0.43, 0.09), 0.15, 0.7)),
        gamma=float(np.exp(rng.normal(0, 0.15))),
        contrast=float(np.exp(rng.normal(0, 0.15))),
        saturation=float(0.0 if rng.random() < 0.1 else np.clip(rng.normal(0.8, 0.25), 0.1, 1.4)),
        balance=tuple(np.exp(rng.normal(0, 0.06, 3)).tolist()),
        flicker=float(abs(rng.normal(0, 0.05 if poor else 0.015))),
        vignette=float(rng.uniform(0, 0.35)) if rng.random() < 0.5 else 0.0,
        blur=float(rng.uniform(0.3, 0.9 if poor else 0.6)) if rng.random() < 0.6 else 0.0,
        shutter=float(rng.uniform(0.1, 0.6)) if rng.random() < 0.25 else 0.0,
        shot=float(rng.uniform(0, 0.04 if poor else 0.012)),
        read=float(rng.uniform(0, 0.02 if poor else 0.006)),
    )


def _blurred(images: Tensor, radius: float) -> Tensor:
    half = max(1, int(np.ceil(2.5 * radius)))
    taps = np.exp(-0.5 * (np.arange(half + 1) / radius) ** 2)
    taps /= taps[0] + 2 * taps[1:].sum()
    for axis in (2, 3):
        size = images.shape[axis]
        pad = (0, 0, half, half) if axis == 2 else (half, half, 0, 0)
        padded = F.pad(images, pad, mode="replicate")
        images = images * float(taps[0])
        for k in range(1, half + 1):  # shifted sums: for few taps much faster than a convolution
            images.add_(padded.narrow(axis, half - k, size), alpha=float(taps[k]))
            images.add_(padded.narrow(axis, half + k, size), alpha=float(taps[k]))
    return images


def _smeared(images: Tensor, motion: Tensor, taps: int = 5) -> Tensor:
    """Mean of the images along ``motion (N, H, W, 2)`` pixels, centred."""
    _, _, h, w = images.shape
    size = torch.tensor([2 / (w - 1), 2 / (h - 1)], device=images.device)
    y, x = torch.meshgrid(torch.linspace(-1, 1, h), torch.linspace(-1, 1, w), indexing="ij")
    grid, step = torch.stack([x, y], -1).to(images.device), motion * size
    total = torch.zeros_like(images)
    for k in range(taps):
        place = grid + (k / (taps - 1) - 0.5) * step
        total += F.grid_sample(images, place, padding_mode="border", align_corners=True)
    return total / taps


def expose(images: Tensor, sensor: Sensor, rng: np.random.Generator, flow: Tensor | None = None) -> Tensor:
    """Apply a sensor to clean frames of one clip.

    Args:
        images: ``(N, 3, H, W)`` float RGB in [0, 1].
        sensor: the camera.
        rng: draws flicker and noise.
        flow: ``(N, H, W, 2)`` pixels from each frame to the next, wanted by motion blur.

    Returns:
        ``(N, 3, H, W)`` float RGB in [0, 1].
    """
    n, _, height, width = images.shape
    device = images.device
    if sensor.shutter > 0 and flow is not None:
        images = _smeared(images, flow.to(device) * sensor.shutter)
    if sensor.blur > 0:
        images = _blurred(images, sensor.blur)
    gain = np.exp(np.cumsum(rng.normal(0, 1, n)) * sensor.flicker)[:, None] * np.array(sensor.balance)[None]
    if sensor.exposure is not None:
        gain = gain * (sensor.exposure / max(float(images.mean()), 0.02)) ** 0.8
    grey = images.mean(1, keepdim=True)
    images = grey + sensor.saturation * (images - grey)
    images = images * torch.from_numpy(gain.astype(np.float32)).to(device)[:, :, None, None]
    if sensor.vignette > 0:
        y = torch.linspace(-1, 1, height, device=device)[:, None]
        x = torch.linspace(-1, 1, width, device=device)[None]
        images = images * (1 - sensor.vignette * (x * x + y * y) / 2)
    if sensor.contrast != 1:
        images = 0.45 + sensor.contrast * (images - 0.45)
    images = images.clamp_(0, 4)
    # A soft shoulder instead of hard white.
    images = torch.where(images > 0.75, 0.75 + 0.25 * torch.tanh((images - 0.75) / 0.25), images)
    if sensor.gamma != 1:
        images = images.pow(sensor.gamma)
    if sensor.shot > 0 or sensor.read > 0:
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        noise = torch.randn(images.shape, generator=generator).to(device)
        images = images + noise * (sensor.shot**2 * images + sensor.read**2).sqrt_()
    return images.clamp_(0, 1)
