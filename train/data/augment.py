"""Random changes of training clips: photometric ones through kornia, and crop-and-resize with the intrinsics carried
along, which widens the range of fields of view (TartanVO's random crop-resize; DPVO's recipe)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from dvo.core.settings import check_settings


@dataclass(frozen=True)
class Augmentation:
    """Distribution of the changes; one draw for all frames of a clip, but for the exposure. The defaults are DPVO's.

    Attributes:
        colour: probability of a change of colours.
        brightness, contrast, saturation: factors from ``[1 - x, 1 + x]``.
        hue: shift from ``[-x, x]``, radians.
        grey, invert: probabilities, given a change of colours.
        zoom: probability of crop-and-resize.
        zoom_range: the window is the image over ``2^u``, ``u`` from ``[0, zoom_range]``.
        off_centre: draw the position of the window; otherwise it is in the middle, as in DPVO.
        exposure: probability of an exposure that drifts from frame to frame and jumps once, as automatic exposure does.
        exposure_range: lowest and highest size of the jump, stops; the drift is a third of it over the clip.
    """

    colour: float = 0.5
    brightness: float = 0.4
    contrast: float = 0.4
    saturation: float = 0.4
    hue: float = 0.4
    grey: float = 0.1
    invert: float = 0.1
    zoom: float = 0.8
    zoom_range: float = 0.5
    off_centre: bool = True
    exposure: float = 0.0
    exposure_range: tuple[float, float] = (-1.5, 0.8)

    def __post_init__(self) -> None:
        check_settings(self, {})


def random_source(number: int) -> torch.Generator:
    """Source of random numbers on the CPU.

    Args:
        number: that it starts from; of one beyond 64 bits, the lower bits count.
    """
    return torch.Generator().manual_seed(number % 2**64)


def augment(batch: dict[str, Tensor], settings: Augmentation, seed: int, step: int) -> dict[str, Tensor]:
    """Change a batch at random, the same for the same seed, step and process.

    Args:
        batch: ``images (B, N, 3, H, W)`` uint8, ``depth (B, N, H, W)``, ``intrinsics (B, N, 4)``, and whatever else.
        settings: distribution of the changes.
        seed: of the draws.
        step: of training.
    """
    from train.engine.ranks import rank

    clips = []
    count = len(batch["images"])
    for index in range(count):
        draw = random_source((seed * 1_000_003 + step) * 8191 + rank() * count + index)
        clip = {name: value[index] for name, value in batch.items()}
        if torch.rand((), generator=draw) < settings.zoom:
            clip |= _zoom(clip, settings, draw)
        if torch.rand((), generator=draw) < settings.colour:
            clip["images"] = _colour(clip["images"], settings, draw)
        if settings.exposure > 0 and torch.rand((), generator=draw) < settings.exposure:
            clip["images"] = _reexpose(clip["images"], settings, draw)
        clips.append(clip)
    return {name: torch.stack([clip[name] for clip in clips]) for name in batch}


def _zoom(clip: dict[str, Tensor], settings: Augmentation, draw: torch.Generator) -> dict[str, Tensor]:
    h, w = clip["images"].shape[-2:]
    exponent, left, top = torch.rand(3, generator=draw).tolist()
    scale = 2.0 ** (settings.zoom_range * exponent)
    if not settings.off_centre:
        left = top = 0.5
    return crop_and_resize(clip, scale, left * (w - w / scale), top * (h - h / scale))


def crop_and_resize(clip: dict[str, Tensor], scale: float, left: float, top: float) -> dict[str, Tensor]:
    """Enlarge a window of a clip to the size of the clip.

    Args:
        clip: ``images (N, 3, H, W)`` uint8, ``depth (N, H, W)``, ``intrinsics (N, 4)``; pixel centres at integers.
        scale: at least 1; the window measures ``H / scale`` by ``W / scale``.
        left, top: of the window's upper left corner (not of its first pixel centre) from the image's, pixels.

    Returns:
        New images (bicubic), depth (nearest, never mixed over an edge) and intrinsics: a ray that was seen at pixel
        ``u`` is now seen at ``(u + 0.5 - left) scale - 0.5``.
    """
    images, depth = clip["images"], clip["depth"]
    n, _, h, w = images.shape
    x = (torch.arange(w, device=images.device) + 0.5) / scale + left - 0.5
    y = (torch.arange(h, device=images.device) + 0.5) / scale + top - 0.5
    grid = torch.stack(torch.meshgrid(2 * (x + 0.5) / w - 1, 2 * (y + 0.5) / h - 1, indexing="xy"), -1)
    grid = grid.expand(n, -1, -1, -1).float()
    enlarged = F.grid_sample(images.float(), grid, mode="bicubic", padding_mode="border", align_corners=False)
    rows, columns = y.round().long().clamp(0, h - 1), x.round().long().clamp(0, w - 1)
    fx, fy, cx, cy = clip["intrinsics"].unbind(-1)
    intrinsics = torch.stack(
        [fx * scale, fy * scale, (cx + 0.5 - left) * scale - 0.5, (cy + 0.5 - top) * scale - 0.5], -1
    )
    return {
        "images": enlarged.round().clamp(0, 255).to(images.dtype),
        "depth": depth[:, rows][:, :, columns],
        "intrinsics": intrinsics,
    }


def _reexpose(images: Tensor, settings: Augmentation, draw: torch.Generator) -> Tensor:
    """``(N, 3, H, W)`` uint8, each frame brightened or darkened as a whole; what gets too bright is cut off."""
    low, high = settings.exposure_range
    n = len(images)
    jump, drift, when = torch.rand(3, generator=draw)
    frame = torch.arange(n)
    stops = (low + (high - low) * jump) * (frame > when * (n - 1)) + (low + (high - low) * drift) / 3 * frame / n
    gain = (2.0**stops).to(images.device)[:, None, None, None]
    return (images.float() * gain).round().clamp(0, 255).to(images.dtype)


def _colour(images: Tensor, settings: Augmentation, draw: torch.Generator) -> Tensor:
    from kornia import enhance
    from kornia.color import rgb_to_grayscale

    def around_one(reach: float) -> float:
        return 1 + reach * (2 * torch.rand((), generator=draw).item() - 1)

    brightness, contrast, saturation = (around_one(x) for x in
                                        (settings.brightness, settings.contrast, settings.saturation))  # fmt: skip
    hue = around_one(settings.hue) - 1
    grey, invert = (torch.rand((), generator=draw) < p for p in (settings.grey, settings.invert))
    x = images.float() / 255
    x = enhance.adjust_brightness_accumulative(x, brightness)
    x = enhance.adjust_contrast_with_mean_subtraction(x, contrast)
    x = enhance.adjust_saturation_with_gray_subtraction(x, saturation)
    x = enhance.adjust_hue(x, hue)
    if grey:
        x = rgb_to_grayscale(x).expand_as(x)
    if invert:
        x = 1 - x
    return (x * 255).round().clamp(0, 255).to(images.dtype)
