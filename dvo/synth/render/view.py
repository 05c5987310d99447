"""Views of a scene: per frame and surface a few linear functions of the pixel, and culling."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from dvo.geometry.poses import compose_rodrigues, invert_rodrigues, split
from dvo.synth.scenes.bodies import Stage
from dvo.synth.scenes.scene import Scene

NEAR = 1e-3  # metres; cameras keep farther away than this from everything
SLACK = 1e-5  # rad by which surfaces are fattened, so that walls sharing an edge leave no crack
Array = np.ndarray


@dataclass
class View:
    """Linear functions of the pixel (x, y, 1) for N frames and the Q surfaces in view of any of them, float64.

    Attributes:
        index: ``(Q,)`` surfaces.
        basis: ``(N, Q, 3, 3)`` rows u/Z, v/Z, 1/Z.
        edges: ``(N, Q, 4, 3)`` positive inside.
        seen: ``(N, Q)`` bool.
        window: ``(N, Q, 4)`` x0 y0 x1 y1 pixel bounds.
    """

    index: Array
    basis: Array
    edges: Array
    seen: Array
    window: Array


def _in_sight(scene: Scene, rotation: Array, centre: Array, intrinsics: Array, size: tuple[int, int] | None) -> Array:
    """Surfaces that may be visible in any frame: facing it, with a bounding sphere that meets the viewing cone."""
    height = -((scene.origin - centre[:, None]) * scene.normal).sum(-1)
    seen = (np.abs(height) > 1e-9) & (scene.two_sided | (height > 0))
    middle, radius = scene.spheres
    local = (middle - centre[:, None]) @ rotation
    seen &= local[..., 2] > NEAR - radius
    if size is not None:
        fx, fy, cx, cy = (column[:, None] for column in intrinsics.T)
        for axis, f, c, extent in ((0, fx, cx, size[1]), (1, fy, cy, size[0])):
            for edge, sign in (((-1.0 - c) / f, 1), ((extent - c) / f, -1)):
                plane = sign * (local[..., axis] - edge * local[..., 2]) / np.hypot(1, edge)
                seen &= plane > -radius
    return seen


def look(scene: Scene, poses_wc: Array, intrinsics: Array, size: tuple[int, int] | None) -> View:
    """View of a static scene.

    Args:
        scene: the surfaces.
        poses_wc: ``(N, 7)`` camera to world.
        intrinsics: ``(N, 4)`` pixels.
        size: height and width of the image, which culls; None keeps all surfaces that face a camera.

    Returns:
        The view.
    """
    rotation, centre = split(poses_wc)  # (N, 3, 3) camera to world, (N, 3)
    seen = _in_sight(scene, rotation, centre, intrinsics, size)
    index = np.flatnonzero(seen.any(0))
    seen = seen[:, index]
    n = len(poses_wc)
    fx, fy, cx, cy = intrinsics.T
    k_inverse = np.zeros((n, 3, 3))
    k_inverse[:, 0, 0], k_inverse[:, 0, 2] = 1 / fx, -cx / fx
    k_inverse[:, 1, 1], k_inverse[:, 1, 2], k_inverse[:, 2, 2] = 1 / fy, -cy / fy, 1
    ray = rotation @ k_inverse  # world direction of a pixel: ray @ (x, y, 1)
    normal, u_axis, v_axis = scene.normal[index], scene.u_axis[index], scene.v_axis[index]
    offset = scene.origin[index] - centre[:, None]  # (N, Q, 3)
    height = (offset * normal).sum(-1)
    inverse_depth = (normal @ ray) / np.where(np.abs(height) < 1e-9, 1e-9, height)[..., None]
    u = u_axis @ ray - (offset * u_axis).sum(-1)[..., None] * inverse_depth
    v = v_axis @ ray - (offset * v_axis).sum(-1)[..., None] * inverse_depth
    basis = np.stack([u, v, inverse_depth], 2)
    # Pixel bounds: the corners in front of the camera and the points where the outline crosses the near plane.
    local = ((scene.corners[index].reshape(-1, 3) - centre[:, None]) @ rotation).reshape(n, -1, 4, 3)
    following = np.roll(local, -1, 2)
    z, z_next = local[..., 2], following[..., 2]
    crosses = (z > NEAR) != (z_next > NEAR)
    share = np.where(crosses, (NEAR - z) / np.where(crosses, z_next - z, 1), 0)
    points = np.concatenate([local, local + share[..., None] * (following - local)], 2)
    usable = np.concatenate([z > NEAR, crosses], 2)
    scale = 1 / np.where(usable, np.maximum(points[..., 2], NEAR), 1)
    x = points[..., 0] * scale * fx[:, None, None] + cx[:, None, None]
    y = points[..., 1] * scale * fy[:, None, None] + cy[:, None, None]
    low = [np.where(usable, c, 1e9).min(-1) for c in (x, y)]
    high = [np.where(usable, c, -1e9).max(-1) for c in (x, y)]
    window = np.stack([*low, *high], -1)
    return View(index, basis, scene.edges[index] @ basis, seen & usable.any(-1), window)


def look_at_stage(stage: Stage, poses_wc: Array, intrinsics: Array, size: tuple[int, int] | None, times: Array) -> View:
    """View of a scene with moving bodies.

    Args:
        stage: scene and bodies.
        poses_wc, intrinsics, size: as for :func:`look`.
        times: ``(N,)`` seconds of the cameras, for the poses of the bodies.

    Returns:
        The view; surfaces are numbered as in :class:`dvo.synth.Stage`.
    """
    views = [look(stage.scene, poses_wc, intrinsics, size)]
    for body, start in zip(stage.bodies, stage.starts[1:-1], strict=True):
        seen_from = compose_rodrigues(invert_rodrigues(body.motion.poses_wc(times)), poses_wc)
        view = look(body.scene, seen_from, intrinsics, size)
        views.append(replace(view, index=view.index + start))
    if len(views) == 1:
        return views[0]
    joined = {f.name: np.concatenate([getattr(v, f.name) for v in views], int(f.name != "index")) for f in fields(View)}
    return View(**joined)
