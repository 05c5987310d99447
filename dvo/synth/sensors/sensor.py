"""Camera response to a clean rendering: exposure, colour, vignetting, blur, noise, compression, failures.

All parameters and noise are drawn on the CPU from a seed, so that a clip does not depend on the device.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F


@dataclass(frozen=True)
class Sensor:
    """Parameters of one clip or sequence.

    Attributes:
        exposure: mean brightness to which the clip is exposed, in [0, 1]; None leaves the light as it is.
        gamma, contrast, saturation: 1 changes nothing.
        balance: red, green, blue gains.
        flicker: standard deviation of the frame-to-frame drift of log gain.
        vignette: darkening in the corners, 0 to 1.
        blur: Gaussian radius in pixels, 0 for none.
        shutter: share of the frame interval during which light is gathered, 0 for no motion blur. In sequences the blur
            is integrated along the path; in training clips it follows the flow between frames (an approximation). Poses
            and depth are those of mid-exposure.
        shot, read: standard deviation of the noise at full brightness (grows with the root of brightness) and in the
            dark.
        readout: share of the frame interval during which a rolling shutter reads its rows, 0 for a global one.
        stops: knots ``(second, exposure value)`` of the exposure over time, linear between them and constant outside;
            one more stop is twice as bright. Empty: constant.
        blackout: spans ``(from, to)`` in seconds without light, of which only noise is recorded.
        jpeg: quality of compression, 1 to 100; 0 for none.
        h264: constant rate factor of H.264 compression, 1 to 51; 0 for none.
        crop: knots ``(second, x, y)`` of the offset of the image in shares of its width, linear between them: the crop
            of a stabilised video floats over what the sensor sees. Empty: at rest.
        drop: probability that a frame is lost (sequences only).
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
    readout: float = 0.0
    stops: tuple[tuple[float, float], ...] = ()
    blackout: tuple[tuple[float, float], ...] = ()
    jpeg: int = 0
    h264: int = 0
    crop: tuple[tuple[float, float, float], ...] = ()
    drop: float = 0.0

    def dark(self, times: np.ndarray) -> np.ndarray:
        """Blackout at given times.

        Args:
            times: ``(T,)`` seconds.

        Returns:
            ``(T,)`` bool.
        """
        times = np.asarray(times, float)
        return np.any([(times >= a) & (times < b) for a, b in self.blackout], 0) & np.ones(len(times), bool)

    def crop_offsets(self, times: np.ndarray, width: int) -> np.ndarray:
        """Offset of the principal point by the crop of a stabilised video.

        Args:
            times: ``(T,)`` seconds.
            width: of the image, pixels.

        Returns:
            ``(T, 2)`` pixels.
        """
        if not self.crop:
            return np.zeros((len(times), 2))
        knots = np.array(self.crop)
        return width * np.stack([np.interp(times, knots[:, 0], knots[:, axis]) for axis in (1, 2)], -1)


def random_intrinsics(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Draw intrinsics: horizontal field of view 40-110 degrees, slightly off centre, slightly anisotropic.

    Args:
        rng: draws them.
        height, width: image size, pixels.

    Returns:
        ``(4,)`` fx fy cx cy, pixels.
    """
    view = np.deg2rad(rng.uniform(40, 110))
    fx = 0.5 * width / np.tan(view / 2)
    fy = fx * np.exp(rng.normal(0, 0.01))
    cx = (width - 1) / 2 + np.clip(rng.normal(0, 0.012), -0.04, 0.04) * width
    cy = (height - 1) / 2 + np.clip(rng.normal(0, 0.012), -0.04, 0.04) * height
    return np.array([fx, fy, cx, cy])


def random_sensor(rng: np.random.Generator) -> Sensor:
    """Draw a sensor: of good quality in three of four cases, else poor.

    Args:
        rng: draws it.

    Returns:
        The sensor.
    """
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


def random_degradation(rng: np.random.Generator, sensor: Sensor, duration: float) -> Sensor:
    """Add compression or a change of exposure to one clip in ten, in addition to :func:`random_sensor`.

    Args:
        rng: draws it.
        sensor: without wear.
        duration: of the clip, seconds.

    Returns:
        The sensor, in most cases unchanged.
    """
    draw = rng.random()
    if draw < 0.05:
        return replace(sensor, jpeg=int(rng.integers(30, 95)))
    if draw < 0.1:
        return replace(sensor, stops=exposure_changes(rng, duration, float(rng.uniform(0.3, 1.2))))
    return sensor


def exposure_changes(rng: np.random.Generator, duration: float, strength: float) -> tuple[tuple[float, float], ...]:
    """Draw knots for :attr:`Sensor.stops`.

    There are slow drifts of up to half of ``strength``, and one or two sudden changes of ``strength``, from which an
    automatic exposure recovers most of the way within one or two seconds.

    Args:
        rng: draws them.
        duration: seconds.
        strength: stops.

    Returns:
        Pairs of second and exposure value (stops).
    """
    count = max(3, int(duration / 1.3))
    times = np.linspace(0, duration, count)
    drift = 0.5 * strength * np.clip(rng.normal(0, 0.6, count), -1, 1)
    drift[0] = 0
    sudden = int(rng.integers(1, 3))
    when = (np.arange(sudden) + rng.uniform(0.3, 0.8, sudden)) / sudden * duration
    knots = list(times)
    for t in when:
        knots += [t, t + 1e-3, *(t + s for s in (0.15, 0.3, 0.5, 0.8, 1.2, 1.8))]
    grid = np.unique(np.array(knots))
    level = np.interp(grid, times, drift)
    for t in when:
        jump = strength * float(rng.choice([-1.0, 0.7]))  # into the dark, or into the light
        recovered = 1 - np.exp(-np.maximum(grid - t - 0.15, 0) / 0.5)
        level = level + np.where(grid > t, jump * (1 - 0.8 * recovered), 0)
    return tuple((float(t), float(v)) for t, v in zip(grid, level, strict=True))


def floating_crop(
    rng: np.random.Generator, duration: float, amplitude: float
) -> tuple[tuple[float, float, float], ...]:
    """Draw knots for :attr:`Sensor.crop`: swings of half a second to some seconds along both axes.

    Args:
        rng: draws them.
        duration: seconds.
        amplitude: standard deviation, share of the width.

    Returns:
        Triples of second and offset along x and y.
    """
    times = np.linspace(0, duration, max(2, int(np.ceil(duration / 0.05))))
    rates, phases = 2 * np.pi / rng.uniform(0.5, 3.0, (4, 2)), rng.uniform(0, 2 * np.pi, (4, 2))
    offsets = amplitude * np.sin(times[:, None, None] * rates + phases).sum(1) / 2**0.5
    return tuple((float(time), float(x), float(y)) for time, (x, y) in zip(times, offsets, strict=True))


def low_light(sensor: Sensor, light: float) -> Sensor:
    """Sensor in low light, which amplifies the signal up to 14 times together with the noise.

    The noise is that of photons (variance grows with the amplified signal) and of read-out.

    Args:
        sensor: in usual light.
        light: share of the usual light that arrives, in (0, 1].

    Returns:
        The sensor in low light.
    """
    amplified = float(np.clip(0.8 / light, 1.0, 14.0))
    red, green, blue = (value * light * amplified for value in sensor.balance)
    return replace(
        sensor,
        balance=(red, green, blue),
        saturation=0.7 * sensor.saturation,
        shot=float(np.clip(sensor.shot, 0.008, 0.02)) * amplified**0.5,
        read=float(np.clip(sensor.read, 0.002, 0.005)) * amplified,
    )


def compressed(images: Tensor, quality: int) -> Tensor:
    """Images after JPEG compression.

    Args:
        images: ``(N, 3, H, W)`` float RGB in [0, 1].
        quality: 1 to 100.

    Returns:
        Same shape, device and type.
    """
    frames = (images * 255).round().to(torch.uint8).permute(0, 2, 3, 1).cpu().numpy()
    out = []
    for frame in frames:
        _, code = cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
        out.append(np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR))[..., ::-1])
    again = torch.from_numpy(np.ascontiguousarray(np.stack(out).transpose(0, 3, 1, 2)))
    return again.to(images.device, images.dtype) / 255


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


def expose(
    images: Tensor, sensor: Sensor, rng: np.random.Generator, flow: Tensor | None = None,
    times: np.ndarray | None = None,
) -> Tensor:  # fmt: skip
    """Apply a sensor to clean frames of one clip.

    Args:
        images: ``(N, 3, H, W)`` float RGB in [0, 1].
        sensor: the camera.
        rng: draws flicker and noise.
        flow: ``(N, H, W, 2)`` pixels from each frame to the next, needed for motion blur.
        times: ``(N,)`` seconds, needed for changes of exposure and blackouts.

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
    if times is not None and sensor.stops:
        knots = np.array(sensor.stops)
        gain = gain * 2.0 ** np.interp(times, knots[:, 0], knots[:, 1])[:, None]
    grey = images.mean(1, keepdim=True)
    images = grey + sensor.saturation * (images - grey)
    images = images * torch.from_numpy(gain.astype(np.float32)).to(device)[:, :, None, None]
    if sensor.vignette > 0:
        y = torch.linspace(-1, 1, height, device=device)[:, None]
        x = torch.linspace(-1, 1, width, device=device)[None]
        images = images * (1 - sensor.vignette * (x * x + y * y) / 2)
    if sensor.contrast != 1:
        images = 0.45 + sensor.contrast * (images - 0.45)
    if times is not None and sensor.blackout:
        images = images * torch.from_numpy(~sensor.dark(times)).to(device)[:, None, None, None]
    images = images.clamp_(0, 4)
    # Smooth saturation instead of clipping.
    images = torch.where(images > 0.75, 0.75 + 0.25 * torch.tanh((images - 0.75) / 0.25), images)
    if sensor.gamma != 1:
        images = images.pow(sensor.gamma)
    if sensor.shot > 0 or sensor.read > 0:
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        noise = torch.randn(images.shape, generator=generator).to(device)
        images = images + noise * (sensor.shot**2 * images + sensor.read**2).sqrt_()
    images = images.clamp_(0, 1)
    return compressed(images, sensor.jpeg) if sensor.jpeg else images
