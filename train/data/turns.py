"""Random turns of the cameras of training clips: other rotations, exactly known, of the same recording.

A rotation ``R`` of a camera about its centre changes its image by the homography ``K R K^-1``, whatever the depth of
the scene (Hartley and Zisserman, "Multiple View Geometry in Computer Vision", section 8.4). So a clip gives as many
clips with other rotations as are drawn.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from dvo.core.context import full_precision
from dvo.core.settings import check_settings
from dvo.geometry import se3, so3
from train.data.augment import random_source

SALT = 0x70A2
"""Makes the draws others than those of the changes of colours for the same seed and step."""
NEAREST = 1e-3  # least third coordinate of a ray: one that looks backwards sees nothing of the image


@dataclass(frozen=True)
class Turns:
    """Distribution of the turns of the cameras of a clip.

    The rotation vectors of the frames are a random walk about the clip's own orientations, with mean zero over the
    clip. Where a turned camera looks past the edge of the image, the edge is continued.

    Attributes:
        probability: of turning a clip.
        degrees: standard deviation of the walk's step from frame to frame, about each axis; drawn for each clip,
            log-uniformly.
        smoothness: correlation of neighbouring steps of the walk, drawn for each clip, uniformly; 0 gives independent
            steps, 1 a steady rotation.
        limit: largest angle between a camera and the turned one, degrees; a walk that goes beyond is scaled down.
        zoom: largest enlargement of a turned clip, at least 1, drawn for each clip, uniformly; it leaves less of the
            turned image beyond the edge, and the focal lengths grow by it.

    Raises:
        DvoError: a value that is out of range.
    """

    probability: float = 0.8
    degrees: tuple[float, float] = (0.2, 4.0)
    smoothness: tuple[float, float] = (0.0, 1.0)
    limit: float = 12.0
    zoom: float = 1.15

    def __post_init__(self) -> None:
        ranges = {"probability": (0, 1), "degrees": (1e-3, 30), "smoothness": (0, 1), "limit": (0, 30), "zoom": (1, 2)}
        check_settings(self, ranges)


def turn_cameras(batch: dict[str, Tensor], settings: Turns, seed: int, step: int) -> dict[str, Tensor]:
    """Turn the cameras of a batch at random, the same for the same seed, step and process.

    Args:
        batch: ``images (B, N, 3, H, W)`` uint8, ``poses_cw (B, N, 7)``, ``intrinsics (B, N, 4)``, perhaps
            ``depth (B, N, H, W)``, and whatever else, which stays as it is.
        settings: distribution of the turns.
        seed: of the draws.
        step: of training.

    Returns:
        The batch as the turned cameras see it, see :func:`turn_clip`.
    """
    from train.engine.ranks import rank

    clips = []
    count, frames = batch["images"].shape[:2]
    for index in range(count):
        number = (seed * 1_000_003 + step) * 8191 + rank() * count + index
        draw = random_source(number ^ SALT)
        clip = {name: value[index] for name, value in batch.items()}
        if torch.rand((), generator=draw) < settings.probability:
            zoom = 1 + (settings.zoom - 1) * torch.rand((), generator=draw).item()
            clip |= turn_clip(clip, random_walk(frames, settings, draw), zoom)
        clips.append(clip)
    return {name: torch.stack([clip[name] for clip in clips]) for name in batch}


def random_walk(frames: int, settings: Turns, draw: torch.Generator) -> Tensor:
    """Draw the turns of the frames of a clip.

    Args:
        frames: number ``N`` of frames.
        settings: their distribution.
        draw: source of random numbers.

    Returns:
        ``(N, 3)`` float64 rotation vectors with mean zero, radians, none longer than the limit.
    """
    u, v = torch.rand(2, generator=draw).tolist()
    (low, high), (rough, smooth) = settings.degrees, settings.smoothness
    deviation = math.radians(low * (high / low) ** u)
    correlation = rough + (smooth - rough) * v
    noise = torch.randn(frames, 3, generator=draw, dtype=torch.float64)
    steps = [noise[0]]
    for new in noise[1:-1]:  # each step has the same variance
        steps.append(correlation * steps[-1] + math.sqrt(1 - correlation**2) * new)
    walk = torch.cat([torch.zeros(1, 3, dtype=torch.float64), deviation * torch.stack(steps).cumsum(0)])[:frames]
    walk = walk - walk.mean(0)
    longest = walk.norm(dim=-1).max().clamp(min=1e-12)
    return walk * (math.radians(settings.limit) / longest).clamp(max=1)


def turn_clip(clip: dict[str, Tensor], turns: Tensor, zoom: float = 1.0) -> dict[str, Tensor]:
    """Turn each camera of a clip about its centre.

    The scene is seen as by a pinhole camera with a global shutter; blur and noise of the images stay what they were.

    Args:
        clip: ``images (N, 3, H, W)`` uint8, ``poses_cw (N, 7)``, ``intrinsics (N, 4)``, perhaps ``depth (N, H, W)``;
            pixel centres at integers.
        turns: ``(N, 3)`` rotation vectors of ``R``, from camera to turned camera, radians.
        zoom: enlargement about the middle of the image, as by :func:`train.data.augment.crop_and_resize`.

    Returns:
        The four that the clip has, new: images (bilinear, the edge continued), poses ``R T_cw``, intrinsics, and depth
        (nearest, along the axis of the turned camera, nan beyond the edge).
    """
    images, k = clip["images"], clip["intrinsics"]
    n, _, h, w = images.shape
    pose = se3.exp(F.pad(turns, (3, 0)).to(k))
    middle = k.new_tensor([w / 2 - 0.5, h / 2 - 0.5])
    zoomed = torch.cat([k[:, :2] * zoom, middle + (k[:, 2:] - middle) * zoom], -1)
    with full_precision(k.device):
        x, y, z = _seen(k, zoomed, so3.matrix(pose[:, 3:]), h, w).unbind(1)
    grid = torch.stack([2 * (x + 0.5) / w - 1, 2 * (y + 0.5) / h - 1], -1).view(n, h, w, 2)
    turned = F.grid_sample(images.float(), grid, mode="bilinear", padding_mode="border", align_corners=False)
    new = {
        "images": turned.round().clamp(0, 255).to(images.dtype),
        "poses_cw": se3.normalise(se3.compose(pose, clip["poses_cw"])),
        "intrinsics": zoomed,
    }
    if "depth" in clip:
        new["depth"] = _turned_depth(clip["depth"], x, y, z)
    return new


def _seen(k: Tensor, zoomed: Tensor, rotation: Tensor, h: int, w: int) -> Tensor:
    """Pixels of the camera as it was that the pixels of the turned one see: ``K R^T K'^-1``.

    Args:
        k, zoomed: ``(N, 4)`` intrinsics before and after.
        rotation: ``(N, 3, 3)`` from camera to turned camera.
        h, w: size of the images, pixels.

    Returns:
        ``(N, 3, HW)``: columns, rows, and the third coordinate of the rays ``R^T K'^-1 u`` unchanged by ``K``, at
        least :data:`NEAREST`.
    """
    v, u = torch.meshgrid(torch.arange(h, device=k.device), torch.arange(w, device=k.device), indexing="ij")
    pixels = torch.stack([u, v, torch.ones_like(u)]).flatten(1).to(k)
    seen = (_matrix(k) @ rotation.mT @ _matrix(zoomed).inverse()) @ pixels
    z = seen[:, 2:].clamp(min=NEAREST)
    return torch.cat([seen[:, :2] / z, z], 1)


def _matrix(intrinsics: Tensor) -> Tensor:
    """Camera matrices ``(N, 3, 3)`` of intrinsics ``(N, 4)``."""
    k = torch.diag_embed(F.pad(intrinsics[:, :2], (0, 1), value=1.0))
    k[:, :2, 2] = intrinsics[:, 2:]
    return k


def _turned_depth(depth: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Depth ``(N, H, W)`` at pixels ``x, y (N, HW)``, of rays whose third coordinate is ``z``; nan outside.

    ``depth`` is along the axis of the camera before it was turned, the result along that of the turned one, in which
    the rays have the third coordinate 1.
    """
    _, h, w = depth.shape
    column, row = x.round(), y.round()
    inside = (column >= 0) & (column <= w - 1) & (row >= 0) & (row <= h - 1) & (z > NEAREST)
    index = (row.clamp(0, h - 1) * w + column.clamp(0, w - 1)).long()
    found = depth.flatten(1).gather(1, index) / z
    return found.masked_fill(~inside, torch.nan).view_as(depth)
