"""Ground truth beyond pose and depth: optical flow with occlusions, moving pixels, tracks of points.

Everything follows from depth, poses and surface identity of the frames in the middle of their exposure (see
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
    """Where the pixels of one frame are in another.

    Attributes:
        flow: ``(H, W, 2)`` float64 pixels to the right and down; 0 where nothing is hit.
        inside: ``(H, W)`` bool: lands in the picture, in front of the camera.
        visible: ``(H, W)`` bool: lands in the picture and nothing hides it there; ``inside & ~visible`` is occluded.
    """

    flow: Array
    inside: Array
    visible: Array


@dataclass(frozen=True)
class Tracks:
    """Surface points followed through frames.

    Attributes:
        pixels: ``(F, M, 2)`` float64 x, y, wherever they are (also outside the picture or hidden).
        depth: ``(F, M)`` along the optical axis; not positive behind the camera.
        visible: ``(F, M)`` bool: in the picture and not hidden.
        surface: ``(M,)`` what they lie on.
        dynamic: ``(M,)`` bool: on a body that moves.
        points: ``(M, 3)`` in the world, or in the frame of their body.
    """

    pixels: Array
    depth: Array
    visible: Array
    surface: Array
    dynamic: Array
    points: Array


def optical_flow(shot: Shot, start: float, end: float) -> Flow:
    """Flow and visibility from the frame at time ``start`` to the frame at time ``end``, in seconds."""
    first, last = shot.sharp(start), shot.sharp(end)
    pixels, depth, surface = hits(first)
    points = shot.lift(start, pixels, depth, surface)
    there, z = shot.place(end, points, surface)
    height, width = shot.camera.height, shot.camera.width
    at = tuple(pixels[:, ::-1].astype(int).T)
    flow = np.zeros((height, width, 2))
    inside, visible = np.zeros((2, height, width), bool)
    in_view = shot.inside(there, z)
    flow[at], inside[at] = np.where(z[:, None] > 0, there - pixels, 0.0), in_view
    visible[at] = in_view & shows(shot, end, there, z, surface, last)
    return Flow(flow, inside, visible)


def hits(rendering: Rendering) -> tuple[Array, Array, Array]:
    """Pixels ``(M, 2)``, depth ``(M,)`` float64 and surface ``(M,)`` of what one frame hits, row by row."""
    depth = rendering.depth[0].cpu().numpy().astype(np.float64)
    y, x = np.nonzero(depth > 0)
    return np.stack([x, y], -1).astype(np.float64), depth[y, x], rendering.surface[0].cpu().numpy()[y, x]


def shows(
    shot: Shot, time: float, pixels: Array, depth: Array, surface: Array, frame: Rendering | None = None
) -> Array:
    """``(M,)`` bool: does the frame at ``time`` show these surfaces at these places ``(M, 2)``, or something nearer?

    A place whose four neighbouring pixels all show the surface does (surfaces are convex and a thing in front of them
    that is thinner than a pixel is not in any picture); the others are asked by tracing a ray.
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
    """``(H, W)`` bool: pixels of the frame at ``time`` that show a moving body."""
    surface = (frame or shot.sharp(time)).surface[0].cpu().numpy()
    return surface >= shot.scene.static if isinstance(shot.scene, Stage) else np.zeros(surface.shape, bool)


def tracks(shot: Shot, times: Array, count: int = 200, *, seed: int = 0, sources: int = 4) -> Tracks:
    """Follow points through the frames at ``times (F,)``.

    Args:
        shot: what is filmed.
        times: seconds.
        count: number of points M (fewer where frames hit too little).
        seed: same seed, same points.
        sources: the points are drawn evenly in as many of the frames, spread over the time.
    """
    rng = np.random.default_rng([seed, salts.TRACKS])
    times = np.asarray(times, float)
    frames = np.unique(np.linspace(0, len(times) - 1, min(sources, len(times))).round().astype(int))
    drawn = []
    for number, share in zip(frames, np.array_split(np.arange(count), len(frames)), strict=True):
        pixels, depth, surface = hits(shot.sharp(float(times[number])))
        chosen = np.sort(rng.choice(len(pixels), min(len(share), len(pixels)), replace=False))
        points = shot.lift(float(times[number]), pixels[chosen], depth[chosen], surface[chosen])
        drawn.append((points, surface[chosen]))
    points, surface = (np.concatenate(part) for part in zip(*drawn, strict=True))
    places = [shot.place(float(time), points, surface) for time in times]
    visible = [shows(shot, float(time), *place, surface) for time, place in zip(times, places, strict=True)]
    dynamic = surface >= shot.scene.static if isinstance(shot.scene, Stage) else np.zeros(len(surface), bool)
    pixels, depth = (np.stack(part) for part in zip(*places, strict=True))
    return Tracks(pixels, depth, np.stack(visible), surface, dynamic, points)
