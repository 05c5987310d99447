"""What a camera does to a clean rendering: exposure, colour, vignetting, blur, noise. Light version.

Everything is drawn from a seed; the drawing and the noise are made on the CPU, so that a clip does not depend on the device.
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
    shot: float = 0.0
    read: float = 0.0


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
        shot=float(rng.uniform(0, 0.04 if poor else 0.012)),
        read=float(rng.uniform(0, 0.02 if poor else 0.006)),
    )


def _blurred(images: Tensor, radius: float) -> Tensor:
    half = max(1, int(np.ceil(2.5 * radius)))
    taps = torch.exp(-0.5 * (torch.arange(-half, half + 1, device=images.device) / radius) ** 2)
    taps = (taps / taps.sum()).view(1, 1, -1)
    n, c, h, w = images.shape
    flat = F.pad(images.reshape(n * c, 1, h, w), (half, half, half, half), mode="replicate")
    return F.conv2d(F.conv2d(flat, taps[..., None, :]), taps[..., None]).view(n, c, h, w)


def expose(images: Tensor, sensor: Sensor, rng: np.random.Generator) -> Tensor:
    """Apply a sensor to clean frames of one clip.

    Args:
        images: ``(N, 3, H, W)`` float RGB in [0, 1].
        sensor: the camera.
        rng: draws flicker and noise.

    Returns:
        ``(N, 3, H, W)`` float RGB in [0, 1].
    """
    n, _, height, width = images.shape
    device = images.device
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
