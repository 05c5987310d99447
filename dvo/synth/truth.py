"""Ground truth beyond pose and depth: optical flow with occlusions, moving pixels, tracks of points.

All of it follows from depth, poses and surface identity of the frames in the middle of their exposure (see
:mod:`dvo.synth.render.shot`): exact for sharp frames, for blurred ones that of mid-exposure, row by row with a
rolling shutter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvo.synth import salts
from dvo.synth.render.renderer import Rendering
from dvo.synth.render.shot import Shot
from dvo.synth.scenes.bodies import Stage

Array = np.ndarray
CLOSE = 1e-4  # relative difference of depth below which two hits are the same point (touching surfaces share edges)


@dataclass(frozen=True)
class Flow:
    """Positions of the pixels of one frame in another.

    Attributes:
        flow: ``(H, W, 2)`` float64 pixels to the right and down; 0 where nothing is hit.
        inside: ``(H, W)`` bool: lands in the image, in front of the camera.
        visible: ``(H, W)`` bool: lands in the image and is not occluded there; ``inside & ~visible`` is occluded.
    """

    flow: Array
    inside: Array
    visible: Array


@dataclass(frozen=True)
class Tracks:
    """Surface points followed through frames.

    Attributes:
        pixels: ``(F, M, 2)`` float64 x, y, also outside the image or occluded.
        depth: ``(F, M)`` along the optical axis; not positive behind the camera.
        visible: ``(F, M)`` bool: in the image and not occluded.
        surface: ``(M,)`` surface of each point.
        dynamic: ``(M,)`` bool: on a moving body.
        points: ``(M, 3)`` in the world, or in the frame of their body.
    """

    pixels: Array
    depth: Array
    visible: Array
    surface: Array
    dynamic: Array
    points: Array


def optical_flow(shot: Shot, start: float, end: float) -> Flow:
    """Flow and visibility from one frame to another.

    Args:
        shot: scene, path and camera.
        start, end: times of the two frames, seconds.

    Returns:
        The flow of every pixel of the first frame.
    """
    first, last = shot.sharp(start), shot.sharp(end)
    pixels, depth, surface = hit_pixels(first)
    points = shot.lift(start, pixels, depth, surface)
    there, z = shot.place(end, points, surface)
    height, width = shot.camera.height, shot.camera.width
    at = tuple(pixels[:, ::-1].astype(int).T)
    flow = np.zeros((height, width, 2))
    inside, visible = np.zeros((2, height, width), bool)
    in_view = shot.inside(there, z)
    flow[at], inside[at] = np.where(z[:, None] > 0, there - pixels, 0.0), in_view
    visible[at] = in_view & visible_points(shot, end, there, z, surface, last)
    return Flow(flow, inside, visible)


def hit_pixels(rendering: Rendering) -> tuple[Array, Array, Array]:
    """Pixels of one frame that hit a surface, row by row.

    Args:
        rendering: batch of one.

    Returns:
        Pixels ``(M, 2)``, depth ``(M,)`` float64 and surface ``(M,)``.
    """
    depth = rendering.depth[0].cpu().numpy().astype(np.float64)
    y, x = np.nonzero(depth > 0)
    return np.stack([x, y], -1).astype(np.float64), depth[y, x], rendering.surface[0].cpu().numpy()[y, x]


def visible_points(
    shot: Shot, time: float, pixels: Array, depth: Array, surface: Array, frame: Rendering | None = None
) -> Array:
    """Visibility of surface points in a frame.

    A point is visible if its four neighbouring pixels all show its surface (surfaces are convex, and objects in front
    of them thinner than a pixel are in no image); the others are decided by tracing a ray.

    Args:
        shot: scene, path and camera.
        time: of the frame, seconds.
        pixels: ``(M, 2)`` projections of the points.
        depth, surface: ``(M,)`` of the points.
        frame: sharp rendering at that time; rendered if None.

    Returns:
        ``(M,)`` bool.
    """
    frame = frame or shot.sharp(time)
    names = frame.surface[0].cpu().numpy()
    height, width = names.shape
    inside = shot.inside(pixels, depth)
    x, y = (
        np.clip(np.floor(np.where(inside, pixels[:, i], 0)).astype(int), 0, n) for i, n in ((0, width), (1, height))
    )
    right, below = np.minimum(x + 1, width - 1), np.minimum(y + 1, height - 1)
    around = np.stack([names[y, x], names[y, right], names[below, x], names[below, right]])
    seen = inside & (around == surface).all(0)
    doubt = np.flatnonzero(inside & ~seen)
    chunk = 64 if shot.readout > 0 else 2048
    for a in range(0, len(doubt), chunk):
        part = doubt[a : a + chunk]
        traced, name, _ = shot.trace(time, pixels[part])
        seen[part] = (name == surface[part]) | (np.abs(traced - depth[part]) < CLOSE * depth[part])
    return seen


def dynamic_mask(shot: Shot, time: float, frame: Rendering | None = None) -> Array:
    """Pixels that show a moving body.

    Args:
        shot: scene, path and camera.
        time: of the frame, seconds.
        frame: sharp rendering at that time; rendered if None.

    Returns:
        ``(H, W)`` bool.
    """
    surface = (frame or shot.sharp(time)).surface[0].cpu().numpy()
    return surface >= shot.scene.static if isinstance(shot.scene, Stage) else np.zeros(surface.shape, bool)


def tracks(shot: Shot, times: Array, count: int = 200, *, seed: int = 0, sources: int = 4) -> Tracks:
    """Follow surface points through frames.

    Args:
        shot: scene, path and camera.
        times: ``(F,)`` seconds.
        count: number of points M (fewer where frames hit too little).
        seed: same seed, same points.
        sources: number of frames, spread evenly over the time, in which the points are drawn.

    Returns:
        The tracks.
    """
    rng = np.random.default_rng([seed, salts.TRACKS])
    times = np.asarray(times, float)
    frames = np.unique(np.linspace(0, len(times) - 1, min(sources, len(times))).round().astype(int))
    drawn = []
    for number, share in zip(frames, np.array_split(np.arange(count), len(frames)), strict=True):
        pixels, depth, surface = hit_pixels(shot.sharp(float(times[number])))
        chosen = np.sort(rng.choice(len(pixels), min(len(share), len(pixels)), replace=False))
        points = shot.lift(float(times[number]), pixels[chosen], depth[chosen], surface[chosen])
        drawn.append((points, surface[chosen]))
    points, surface = (np.concatenate(part) for part in zip(*drawn, strict=True))
    places = [shot.place(float(time), points, surface) for time in times]
    visible = [visible_points(shot, float(time), *place, surface) for time, place in zip(times, places, strict=True)]
    dynamic = surface >= shot.scene.static if isinstance(shot.scene, Stage) else np.zeros(len(surface), bool)
    pixels, depth = (np.stack(part) for part in zip(*places, strict=True))
    return Tracks(pixels, depth, np.stack(visible), surface, dynamic, points)
