"""Random motions of random cameras before the depth maps of a batch, as further pairs for the pose network.

The flow of a motion follows from the depth, with nothing to be rendered or matched, so that the pose network sees many
more motions and cameras than the clips hold. It reads these flows with errors of the sizes that matching leaves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from dvo.core.settings import check_settings
from dvo.geometry import so3
from dvo.losses.two_frame import true_flow
from train.data.augment import random_source

_RANGES = {
    "pairs": (0, 4096),
    "centre": (0, 0.5),
    "share_rotation_only": (0, 1),
    "reach": (0, math.inf),
    "rotation": (1e-9, math.pi / 2),
    "translation": (1e-9, 1e3),
    "focal": (1e-2, 20),
    "noise": (1e-9, 1e3),
}
_FAR = 20.0  # depth of pixels of unknown depth (the sky of a rendering), median depths
_BLOCK = 4  # pixels of the map to a value of the errors that neighbouring pixels share
_LEAST_VALID = 0.7  # share of the pixels that must be in front of both cameras


@dataclass(frozen=True)
class VirtualMotions:
    """Distribution of the motions, cameras and errors; a range is drawn from log-uniformly.

    Attributes:
        pairs: number of pairs a step; 0: none.
        rotation: range of the angle, radians; the axis is drawn uniformly.
        translation: range of the length, median depths; the direction is drawn uniformly.
        share_rotation_only: share of the pairs whose translation is a hundredth of that, as of a camera that turns.
        focal: range of the focal length, image widths.
        centre: largest offset of the principal point from the middle, image sides.
        noise: range of the standard deviation of the errors of the flow, feature pixels; half of the variance is that
            of single pixels, half is drawn for every fourth pixel along each axis and interpolated between them.
        reach: mean length of the flow, in widths of the map, above which a pair is left out.

    Raises:
        DvoError: a value of another type or out of range.
    """

    pairs: int = 48
    rotation: tuple[float, float] = (0.001, 0.15)
    translation: tuple[float, float] = (0.003, 0.4)
    share_rotation_only: float = 0.1
    focal: tuple[float, float] = (0.4, 1.6)
    centre: float = 0.08
    noise: tuple[float, float] = (0.005, 0.3)
    reach: float = 0.25

    def __post_init__(self) -> None:
        check_settings(self, _RANGES)


@dataclass(frozen=True)
class VirtualPairs:
    """Pairs of views of one scene, of which the flow is known.

    Attributes:
        flow: ``(K, 2, h, w)`` from the first view to the second, feature pixels, with errors.
        intrinsics: ``(K, 4)`` ``fx fy cx cy`` in image pixels.
        translation, rotation: ``(K, 3)`` of ``T_ab``, median depths and radians.
        valid: ``(K,)`` bool, pairs that count.
    """

    flow: Tensor
    intrinsics: Tensor
    translation: Tensor
    rotation: Tensor
    valid: Tensor


def virtual_pairs(
    depth: Tensor, stride: int, settings: VirtualMotions, seed: int, step: int, extent: tuple[int, int]
) -> VirtualPairs:
    """Draw pairs, the same for the same seed and step.

    Args:
        depth: ``(M, h, w)`` depth maps in median depths of their scene, nan where it is not known.
        stride: image pixels to a pixel of the map.
        settings: of the draws.
        seed, step: of training.
        extent: height and width of the image, pixels.

    Returns:
        Pairs, each from a depth map that is drawn, mirrored at random and stretched along its axis.
    """
    count, (height, width) = settings.pairs, extent
    source = random_source((seed * 1_000_003 + step) * 8191 + 4093)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=source).to(depth)

    def ranged(limits: tuple[float, float]) -> Tensor:
        low, high = limits
        return low * (high / low) ** uniform(count)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=source).to(depth)

    drawn = depth[torch.randint(len(depth), (count,), generator=source).to(depth.device)].float()
    mirrored = uniform(count, 2) < 0.5
    drawn = torch.where(mirrored[:, :1, None], drawn.flip(2), drawn)
    drawn = torch.where(mirrored[:, 1:, None], drawn.flip(1), drawn)
    drawn = torch.where(torch.isfinite(drawn) & (drawn > 0), drawn, torch.full_like(drawn, _FAR))
    drawn = drawn / drawn.flatten(1).median(1).values[:, None, None]
    drawn = drawn ** (2 ** (2 * uniform(count) - 1))[:, None, None]

    focal = ranged(settings.focal) * width
    offset = settings.centre * (2 * uniform(count, 2) - 1)
    cx, cy = (0.5 + offset[:, 0]) * width - 0.5, (0.5 + offset[:, 1]) * height - 0.5
    intrinsics = torch.stack([focal, focal, cx, cy], -1)

    rotation = F.normalize(normal(count, 3), dim=-1) * ranged(settings.rotation)[:, None]
    length = ranged(settings.translation) * torch.where(uniform(count) < settings.share_rotation_only, 0.01, 1.0)
    translation = F.normalize(normal(count, 3), dim=-1) * length[:, None]
    flow, ahead = true_flow(drawn, torch.cat([translation, so3.exp(rotation)], -1), intrinsics / stride)

    h, w = depth.shape[-2:]
    blocks = normal(count, 2, -(-h // _BLOCK) + 1, -(-w // _BLOCK) + 1)
    shared = F.interpolate(blocks, (h, w), mode="bilinear", align_corners=True)
    error = (normal(count, 2, h, w) + shared) * math.sqrt(0.5) * ranged(settings.noise)[:, None, None, None]
    mean = flow.norm(dim=1).flatten(1).mean(1)
    valid = (ahead.float().flatten(1).mean(1) > _LEAST_VALID) & (mean < settings.reach * w)
    return VirtualPairs((flow + error).clamp(-w, w), intrinsics, translation, rotation, valid)
