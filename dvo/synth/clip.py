"""Training clips: scene, path, intrinsics and sensor drawn from a seed.

A clip is a few frames whose mean induced flow between neighbours is drawn from a range, as in the training of DPVO
(Teed et al., 2023), with depth normalised to median 1.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch

from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.geometry.poses import compose_rodrigues, invert_rodrigues, split
from dvo.synth import salts
from dvo.synth.conditions import Conditions, draw_conditions, stage_clip
from dvo.synth.motion.paths import Path, find_start, random_path
from dvo.synth.render.quality import Quality
from dvo.synth.render.renderer import Rendering, render, render_depth
from dvo.synth.scenes.bodies import Stage
from dvo.synth.scenes.families import random_scene
from dvo.synth.scenes.repaint import reduce_texture
from dvo.synth.scenes.scene import Scene
from dvo.synth.sensors.sensor import (
    Sensor,
    expose,
    floating_crop,
    low_light,
    random_degradation,
    random_intrinsics,
    random_sensor,
)
from dvo.synth.sensors.video_codec import compressed_video
from dvo.synth.sequence import SyntheticSequence, make_sequence
from dvo.synth.specs import check_names, check_share
from dvo.synth.surroundings import Style, draw_over, drawings
from dvo.synth.textures.texture import texture_pool

Array = np.ndarray
MOST_COVERED = 0.8  # share of a frame that surroundings may cover
LOW = 5  # planning renders depth this many times smaller


@dataclass(frozen=True)
class ClipSpec:
    """Length, size and difficulty of training clips.

    Args:
        frames, height, width: size of a clip, frames and pixels.
        flow_range: mean induced flow between neighbouring frames, pixels; a target is drawn from it log-uniformly and
            met within about 10 %.
        sensor: False gives clean renderings.
        clips_per_scene: neighbouring indices that share a scene; more is faster and less varied.
        supersample: rays per pixel edge for the colours.
        textures: folder of photographs to use as textures; those shipped with scikit-image if None.
        movers: probability of a clip with moving bodies, 1 to 8 of them.
        low_light: probability of a clip with 3 to 30 % of the usual light; without a sensor it has no effect.
        surroundings: probability of a clip with one or two kinds of :data:`dvo.synth.surroundings.SURROUNDINGS`, which
            count as moving; clips of which they would cover more than four fifths of a frame stay without. Some of
            these clips are H.264 video, in others the crop of a stabilised video floats.
        bare: probability of a clip whose surfaces keep 5 to 50 % of their texture.
        blurred: probability of a clip with an exposure of 30 to 80 % of the frame interval; without a sensor it has no
            effect.

    Raises:
        DvoError: sizes or flow range out of order, or a probability that is none.
    """

    frames: int = 8
    height: int = 120
    width: int = 160
    flow_range: tuple[float, float] = (2.0, 19.0)
    sensor: bool = True
    clips_per_scene: int = 2
    supersample: int = 1
    textures: str | None = None
    movers: float = 0.0
    low_light: float = 0.0
    surroundings: float = 0.0
    bare: float = 0.0
    blurred: float = 0.0

    def __post_init__(self) -> None:
        if self.frames < 2 or self.height < 16 or self.width < 16:
            raise DvoError("a clip needs 2 frames or more of 16x16 pixels or more", field="frames, height, width")
        if not 0 < self.flow_range[0] <= self.flow_range[1]:
            raise DvoError(f"not a range: {self.flow_range}", field="flow_range", remedy="give low <= high, in pixels")
        for name in ("movers", "low_light", "surroundings", "bare", "blurred"):
            check_share(name, getattr(self, name))


@dataclass
class Clip:
    """Frames with exact ground truth.

    Attributes:
        images: ``(N, 3, H, W)`` uint8 RGB.
        depth: ``(N, H, W)`` float32 Z along the optical axis, of moving bodies too; the median over what does not move
            is 1.
        poses_cw: ``(N, 7)`` float32 world to camera, in units of that depth; the first is the identity.
        intrinsics: ``(N, 4)`` float32 fx fy cx cy in pixels of the images; the same in all frames, unless their crop
            floats.
        moving: ``(N, H, W)`` bool, pixels that show a moving body or surroundings; None if nothing moves.
    """

    images: torch.Tensor
    depth: torch.Tensor
    poses_cw: torch.Tensor
    intrinsics: torch.Tensor
    moving: torch.Tensor | None = None

    @property
    def static_depth(self) -> torch.Tensor:
        """Depth ``(N, H, W)``, nan at pixels that show a moving body or surroundings."""
        return self.depth if self.moving is None else self.depth.masked_fill(self.moving, torch.nan)


def induced_flow(depth: Array, poses_wc: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Mean flow and visible share between neighbouring frames, from depth and poses.

    Args:
        depth: ``(N, h, w)`` along the optical axis, 0 for none.
        poses_wc: ``(N, 7)`` camera to world, in units of the depth.
        intrinsics: ``(4,)`` fx fy cx cy in pixels of the depth map.

    Returns:
        ``(N-1,)`` mean flow in pixels over pixels that stay in view, ``(N-1,)`` share of pixels that do.
    """
    flow, inside = flow_field(depth, poses_wc, intrinsics)
    length = np.where(inside, np.hypot(flow[..., 0], flow[..., 1]), 0)
    count = inside.sum((1, 2))
    return length.sum((1, 2)) / np.maximum(count, 1), count / inside[0].size


def flow_field(depth: Array, poses_wc: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Flow from each frame to the next, from depth and poses.

    Args:
        depth: ``(N, h, w)`` along the optical axis, 0 for none.
        poses_wc: ``(N, 7)`` camera to world, in units of the depth.
        intrinsics: ``(4,)`` fx fy cx cy in pixels of the depth map.

    Returns:
        ``(N-1, h, w, 2)`` pixels, and ``(N-1, h, w)`` bool: stays in view.
    """
    _, h, w = depth.shape
    fx, fy, cx, cy = intrinsics
    y, x = np.mgrid[:h, :w]
    r, t = split(compose_rodrigues(invert_rodrigues(poses_wc[1:]), poses_wc[:-1]))
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
    flow: float  # mean between neighbouring frames, pixels


def _match_flow(path: Path, rhythm: Array, target: float, speed: float, depth: Array, low: Array) -> float:
    """Speed at which the mean flow over given depth maps meets the target (fixed-point steps on the ratio)."""
    for _ in range(5):
        times, moved = _timing(path, rhythm, speed)
        flow, overlap = induced_flow(depth, moved.poses_wc(times), low)
        mean = float(flow.mean()) * LOW
        if overlap.mean() < 0.2:  # little overlap: the mean is not reliable
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
    speed = _match_flow(path, rhythm, target, 0.05, depth, low)
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
            return _Plan(moved, times, mean) if roomy and overlap.min() > 0.5 else None
        if overlap.min() < 0.25:
            return None
        speed = _match_flow(path, rhythm, target, speed, depth, low)
    return None


@lru_cache(maxsize=4)
def _scene(seed: int, number: int, textures: str | None) -> Scene:
    pool = texture_pool(seed, folder=textures)
    return random_scene(int(np.random.default_rng([seed, number]).integers(2**31)), pool=pool)


def make_clip(
    seed: int, index: int, spec: ClipSpec | None = None, *, device: torch.device | str = "cpu", **options: Any
) -> Clip:
    """Clip ``index`` of the endless stream ``seed``.

    Args:
        seed: of the stream; also selects its texture pool. Same arguments, same bytes (on one machine).
        index: of the clip.
        spec: length, size and difficulty; the defaults if None.
        device: where to render; the returned tensors live there.
        options: single fields of :class:`ClipSpec` that replace those of ``spec``.

    Returns:
        The clip.

    Raises:
        DvoError: an unknown option, sizes or flow range out of order, or no camera path that meets the flow range.

    Example:
        >>> clip = make_clip(0, 7, frames=6, height=120, width=160)
        >>> clip.images.shape
        torch.Size([6, 3, 120, 160])
    """
    check_names(options, (option.name for option in fields(ClipSpec)))
    spec = replace(spec or ClipSpec(), **options)
    scene = _scene(seed, index // spec.clips_per_scene, spec.textures)
    rng = np.random.default_rng([seed, salts.CLIP, index])
    plan, intrinsics = _draw_plan(scene, rng, spec, index)
    poses_wc = plan.path.poses_wc(plan.times)
    conditions = draw_conditions(seed, index, spec.movers, spec.low_light, spec.surroundings, spec.bare, spec.blurred)
    if conditions.texture < 1:
        scene = reduce_texture(scene, conditions.texture, conditions.seed)
    seconds = (plan.times - plan.times[0]) * (conditions.step * (spec.frames - 1) / (plan.times[-1] - plan.times[0]))
    every = np.tile(intrinsics, (spec.frames, 1))
    if conditions.stabilised:
        swings = floating_crop(
            np.random.default_rng([conditions.seed, salts.CLIP_CROP]), seconds[-1], conditions.stabilised
        )
        every[:, 2:] += Sensor(crop=swings).crop_offsets(seconds, spec.width)
    rendering, moving = _render(scene, plan, poses_wc, every, spec, conditions, device)
    images = rendering.images
    if conditions.surroundings:
        images, moving = _surround(rendering, moving, seconds, poses_wc, every, conditions)
    if spec.sensor:
        camera = random_sensor(rng)
        flow: torch.Tensor | None = None
        if conditions.light < 1:
            camera = low_light(camera, conditions.light)
        if conditions.shutter:
            camera = replace(camera, shutter=conditions.shutter)
        if camera.shutter > 0:
            # Bodies are blurred as if they stood still: by the motion of the camera at their depth.
            field, _ = flow_field(rendering.depth.cpu().numpy(), poses_wc, intrinsics)
            field = np.clip(np.concatenate([field, field[-1:]]), -spec.width / 3, spec.width / 3)
            flow = torch.from_numpy(field.astype(np.float32))
        times = plan.times - plan.times[0]
        # From a stream of its own, so that the draws above do not depend on degradation.
        camera = random_degradation(
            np.random.default_rng([seed, salts.CLIP_DEGRADATION, index]), camera, float(times[-1])
        )
        images = expose(images, camera, rng, flow, times)
    pixels = (images * 255).round_().to(torch.uint8)
    if spec.sensor and conditions.h264:
        coded = compressed_video(pixels.permute(0, 2, 3, 1).cpu().numpy(), conditions.h264)
        pixels = torch.from_numpy(coded).permute(0, 3, 1, 2).contiguous().to(pixels.device)
    depth = rendering.depth if moving is None or moving.all() else rendering.depth[~moving]
    scale = float(depth.median())
    relative = compose_rodrigues(invert_rodrigues(poses_wc), poses_wc[:1])  # world := first camera
    relative[:, :3] /= scale
    relative[0] = [0, 0, 0, 0, 0, 0, 1]
    return Clip(
        images=pixels,
        depth=rendering.depth / scale,
        poses_cw=torch.from_numpy(relative.astype(np.float32)).to(device),
        intrinsics=torch.from_numpy(every.astype(np.float32)).to(device),
        moving=moving,
    )


def _render(
    scene: Scene, plan: _Plan, poses_wc: Array, intrinsics: Array, spec: ClipSpec, conditions: Conditions,
    device: torch.device | str,
) -> tuple[Rendering, torch.Tensor | None]:  # fmt: skip
    """Clean frames, and the pixels ``(N, H, W)`` that show moving bodies; None without bodies."""
    stage: Scene | Stage = scene
    times: Array | None = None
    if conditions.bodies:
        stage, times = stage_clip(scene, plan.path, plan.times, conditions, plan.flow, float(intrinsics[0, 0]))
    rendering = render(
        stage, poses_wc, intrinsics, spec.height, spec.width, quality=Quality(spec.supersample), device=device,
        coordinates=False, times=times,
    )  # fmt: skip
    return rendering, rendering.surface >= stage.static if isinstance(stage, Stage) else None


def _surround(
    rendering: Rendering, moving: torch.Tensor | None, seconds: Array, poses_wc: Array, intrinsics: Array,
    conditions: Conditions,
) -> tuple[torch.Tensor, torch.Tensor | None]:  # fmt: skip
    """Images with the surroundings over them, and the pixels without rigid truth; as they were where little is left."""
    _, height, width = rendering.depth.shape
    drawn = drawings(conditions.surroundings, conditions.seed, poses_wc[:, :3].mean(0), Style(training=True))
    frames = [
        draw_over(drawn, image, depth, pose, Camera(fx, fy, cx, cy, width, height), float(time))
        for image, depth, pose, (fx, fy, cx, cy), time in zip(
            rendering.images, rendering.depth, poses_wc, intrinsics.tolist(), seconds, strict=True
        )
    ]
    covered = np.stack([cover for _, cover in frames])
    if covered.mean((1, 2)).max() > MOST_COVERED:
        return rendering.images, moving
    there = torch.from_numpy(covered).to(rendering.depth.device)
    return torch.stack([image for image, _ in frames]), there if moving is None else there | moving


def _draw_plan(scene: Scene, rng: np.random.Generator, spec: ClipSpec, index: int) -> tuple[_Plan, Array]:
    """Path, frame times and intrinsics ``(4,)`` of a clip."""
    target = float(np.exp(rng.uniform(*np.log(spec.flow_range))))
    rhythm = _rhythm(rng, spec.frames)
    intrinsics = random_intrinsics(rng, spec.height, spec.width)
    for attempt in range(80):
        if attempt % 5 == 0:
            start = find_start(scene, rng)
        if attempt % 10 == 9:  # the target may be out of reach in this scene
            target = float(np.exp(rng.uniform(*np.log(spec.flow_range))))
            intrinsics, rhythm = random_intrinsics(rng, spec.height, spec.width), np.arange(spec.frames, dtype=float)
        path = random_path(scene, int(rng.integers(2**31)), None if attempt < 50 else "rotation", start=start)
        plan = _plan(scene, path, rhythm, spec.flow_range, target, intrinsics, (spec.height, spec.width))
        if plan is not None:
            return plan, intrinsics
    raise DvoError(
        f"no path in clip {index} meets the flow range {spec.flow_range}", field="flow_range",
        remedy="set a lower flow range",
    )  # fmt: skip


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
