"""Training clips: scene, path, intrinsics and sensor drawn from a seed.

A clip is a few frames whose mean induced flow between neighbours is a number drawn from a range, as DPVO samples its
training data (REFERENCE 1.12), with depth normalised to median 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from dvo.errors import DvoError
from dvo.synth.motion.paths import Path, find_start, random_path
from dvo.synth.poses import compose, inverse, split
from dvo.synth.render.renderer import render, render_depth
from dvo.synth.scenes.families import random_scene
from dvo.synth.scenes.scene import Scene
from dvo.synth.sensors.sensor import Sensor, expose, random_intrinsics, random_sensor, random_wear
from dvo.synth.sequence import SyntheticSequence, make_sequence
from dvo.synth.textures.pool import texture_pool

Array = np.ndarray
LOW = 5  # planning looks at images this many times smaller


@dataclass
class Clip:
    """Frames with exact ground truth.

    Attributes:
        images: ``(N, 3, H, W)`` uint8 RGB.
        depth: ``(N, H, W)`` float32 Z along the optical axis; the median over the clip is 1.
        poses_cw: ``(N, 7)`` float32 world to camera, in units of that depth; the first is the identity.
        intrinsics: ``(N, 4)`` float32 fx fy cx cy in pixels of the images.
    """

    images: torch.Tensor
    depth: torch.Tensor
    poses_cw: torch.Tensor
    intrinsics: torch.Tensor


def induced_flow(depth: Array, poses_wc: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Mean flow and visible share between neighbouring frames, by depth and pose.

    Args:
        depth: ``(N, h, w)``, a row per frame; intrinsics ``(4,)`` of that size.
        poses_wc: ``(N, 7)``.

    Returns:
        ``(N-1,)`` mean flow in pixels over pixels that stay in view, ``(N-1,)`` share of pixels that do.
    """
    flow, inside = flow_field(depth, poses_wc, intrinsics)
    length = np.where(inside, np.hypot(flow[..., 0], flow[..., 1]), 0)
    count = inside.sum((1, 2))
    return length.sum((1, 2)) / np.maximum(count, 1), count / inside[0].size


def flow_field(depth: Array, poses_wc: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Flow from each frame to the next ``(N-1, h, w, 2)`` in pixels, and where it stays in view ``(N-1, h, w)``."""
    _, h, w = depth.shape
    fx, fy, cx, cy = intrinsics
    y, x = np.mgrid[:h, :w]
    r, t = split(compose(inverse(poses_wc[1:]), poses_wc[:-1]))
    ray = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones((h, w))])
    points = (r @ ray.reshape(3, -1)).reshape(-1, 3, h, w) * depth[:-1, None] + t[:, :, None, None]
    z = np.where(points[:, 2] > 1e-6, points[:, 2], np.inf)
    u, v = fx * points[:, 0] / z + cx, fy * points[:, 1] / z + cy
    inside = (points[:, 2] > 1e-6) & (u > -0.5) & (u < w - 0.5) & (v > -0.5) & (v < h - 0.5) & (depth[:-1] > 0)
    return np.stack([u - x, v - y], -1), inside


@dataclass
class _Plan:
    path: Path
    times: Array


def _meet(path: Path, rhythm: Array, target: float, speed: float, depth: Array, low: Array) -> float:
    """Speed at which the mean flow over given depth maps meets the target (fixed-point steps on the ratio)."""
    for _ in range(5):
        times, moved = _timing(path, rhythm, speed)
        flow, overlap = induced_flow(depth, moved.poses_wc(times), low)
        mean = float(flow.mean()) * LOW
        if overlap.mean() < 0.2:  # out of sight: the mean says little
            speed *= 0.4
            continue
        ratio = target / max(mean, 1e-3)
        if abs(ratio - 1) < 0.02:
            break
        speed *= float(np.clip(ratio, 0.2, 5.0))
    return speed


def _timing(path: Path, rhythm: Array, speed: float) -> tuple[Array, Path]:
    """Frame times and path at a speed: a longer step while shake is still sampled twice a period, then more gain."""
    longest = 0.45 / (path.frequency.max() / (2 * np.pi))
    return min(speed, longest) * rhythm, path.scaled(max(1.0, speed / longest))


def _between(path: Path, times: Array) -> Array:
    """Poses ``(2N-1, 7)`` at the frames and half way between them."""
    return path.poses_wc(np.interp(np.arange(0, len(times) - 0.99, 0.5), np.arange(len(times)), times))


def _plan(
    scene: Scene, path: Path, rhythm: Array, flow_range: tuple[float, float], target: float, intrinsics: Array,
    size: tuple[int, int],
) -> _Plan | None:  # fmt: skip
    """Choose time step and gain so that the mean flow meets ``target``, or less where space is short; None if none."""
    height, width = size[0] // LOW, size[1] // LOW
    low = (intrinsics + [0, 0, 0.5, 0.5]) / LOW - [0, 0, 0.5, 0.5]
    depth = np.full((len(rhythm), height, width), path.depth)  # a first guess without rendering
    speed = _meet(path, rhythm, target, 0.05, depth, low)
    for _ in range(3):  # ahead, backwards, slower
        times, moved = _timing(path, rhythm, speed)
        if scene.is_free(_between(moved, times)[:, :3]).all():
            break
        if scene.is_free(_between(moved.scaled(-1), times)[:, :3]).all():
            path = path.scaled(-1)
            break
        if target < 1.8 * flow_range[0]:
            return None
        speed, target = speed * 0.6, target * 0.6
    for _ in range(3):
        times, moved = _timing(path, rhythm, speed)
        between = _between(moved, times)
        if not scene.is_free(between[:, :3]).all():
            return None
        poses = between[::2]
        depth = render_depth(scene, poses, low, height, width)[0].numpy()
        flow, overlap = induced_flow(depth, poses, low)
        mean = float(flow.mean()) * LOW
        if abs(np.log(max(mean, 1e-3) / target)) < 0.15 and flow_range[0] * 0.95 < mean < flow_range[1] * 1.05:
            seen = depth[depth > 0]
            median, near = float(np.median(seen)), float(np.quantile(seen, 0.01))
            roomy = near > 0.07 * median and scene.clearance(between[:, :3]).min() > 0.03 * median
            return _Plan(moved, times) if roomy and overlap.min() > 0.5 else None
        if overlap.min() < 0.25:
            return None
        speed = _meet(path, rhythm, target, speed, depth, low)
    return None


@lru_cache(maxsize=4)
def _scene(seed: int, number: int, textures: str | None) -> Scene:
    pool = texture_pool(seed, folder=textures)
    return random_scene(int(np.random.default_rng([seed, number]).integers(2**31)), pool=pool)


def make_clip(
    seed: int,
    index: int,
    *,
    frames: int = 8,
    height: int = 120,
    width: int = 160,
    flow_range: tuple[float, float] = (2.0, 19.0),
    device: torch.device | str = "cpu",
    sensor: bool = True,
    clips_per_scene: int = 2,
    supersample: int = 1,
    textures: str | None = None,
) -> Clip:
    """Draw clip ``index`` of the endless stream ``seed``: same arguments, same bytes (on one machine).

    Args:
        seed: names the stream; also picks its texture pool.
        index: which clip.
        frames, height, width: size of the clip.
        flow_range: the mean induced flow between neighbouring frames, pixels of this image, is drawn from it
            log-uniformly (and met within about a tenth).
        device: where to render; the returned tensors live there.
        sensor: False returns clean renderings.
        clips_per_scene: neighbouring indices that share a scene; more is faster and less varied.
        supersample: rays per pixel edge for the colours.
        textures: folder of photographs to paint with; None: those that scikit-image ships.

    Raises:
        DvoError: sizes or flow range out of order.
    """
    if frames < 2 or height < 16 or width < 16:
        raise DvoError("a clip needs 2 frames or more of 16x16 pixels or more", field="frames, height, width")
    if not 0 < flow_range[0] <= flow_range[1]:
        raise DvoError(f"not a range: {flow_range}", field="flow_range", remedy="give low <= high, in pixels")
    scene = _scene(seed, index // clips_per_scene, textures)
    rng = np.random.default_rng([seed, 7301, index])
    target = float(np.exp(rng.uniform(*np.log(flow_range))))
    rhythm = _rhythm(rng, frames)
    intrinsics = random_intrinsics(rng, height, width)
    plan: _Plan | None = None
    for attempt in range(80):
        if attempt % 5 == 0:
            start = find_start(scene, rng)
        if attempt % 10 == 9:  # perhaps the draw asks too much of this scene
            target = float(np.exp(rng.uniform(*np.log(flow_range))))
            intrinsics, rhythm = random_intrinsics(rng, height, width), np.arange(frames, dtype=float)
        path = random_path(scene, int(rng.integers(2**31)), None if attempt < 50 else "rotation", start=start)
        plan = _plan(scene, path, rhythm, flow_range, target, intrinsics, (height, width))
        if plan is not None:
            break
    if plan is None:
        raise DvoError(
            f"no path in clip {index} meets the flow range {flow_range}", field="flow_range", remedy="ask for less flow"
        )
    poses_wc = plan.path.poses_wc(plan.times)
    rendering = render(
        scene, poses_wc, intrinsics, height, width, supersample=supersample, device=device, coordinates=False
    )
    images = rendering.images
    if sensor:
        camera = random_sensor(rng)
        flow: torch.Tensor | None = None
        if camera.shutter > 0:
            field, _ = flow_field(rendering.depth.cpu().numpy(), poses_wc, intrinsics)
            field = np.clip(np.concatenate([field, field[-1:]]), -width / 3, width / 3)
            flow = torch.from_numpy(field.astype(np.float32))
        times = plan.times - plan.times[0]
        # From a stream of its own: what is drawn above stays what it was before there was wear.
        camera = random_wear(np.random.default_rng([seed, 7302, index]), camera, float(times[-1]))
        images = expose(images, camera, rng, flow, times)
    scale = float(rendering.depth.median())
    relative = compose(inverse(poses_wc), poses_wc[:1])  # world := first camera
    relative[:, :3] /= scale
    relative[0] = [0, 0, 0, 0, 0, 0, 1]
    return Clip(
        images=(images * 255).round_().to(torch.uint8),
        depth=rendering.depth / scale,
        poses_cw=torch.from_numpy(relative.astype(np.float32)).to(device),
        intrinsics=torch.from_numpy(np.tile(intrinsics, (frames, 1)).astype(np.float32)).to(device),
    )


def _rhythm(rng: np.random.Generator, frames: int) -> Array:
    """Frame times in steps: mostly regular, at times uneven, at times with frames that nearly stand still."""
    steps = np.ones(frames - 1)
    draw = rng.random()
    if draw < 0.25:
        steps *= np.exp(rng.normal(0, 0.35, frames - 1))
    elif draw < 0.35:
        steps[rng.random(frames - 1) < 0.3] = rng.uniform(0.0, 0.1)
    steps = steps if steps.sum() > 1 else np.ones(frames - 1)
    return np.concatenate([[0.0], np.cumsum(steps)])


__all__ = [
    "Clip", "Sensor", "SyntheticSequence", "induced_flow", "make_clip", "make_sequence", "random_intrinsics",
]  # fmt: skip
