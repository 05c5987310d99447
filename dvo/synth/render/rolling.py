"""Rolling shutter: every row of the image has a camera of its own, at its own time; exact, as for a still camera.

A camera of one row sees the same linear functions of the pixel as any other (see :mod:`dvo.synth.render.renderer`), so
a frame is cast as H cameras of height 1 and shaded at once.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dvo.core.errors import DvoError
from dvo.synth.render.antialias import smooth_outlines
from dvo.synth.render.quality import STANDARD, Quality
from dvo.synth.render.renderer import PIECE, Rendering, cast, named, view_scene
from dvo.synth.render.shading import coordinates_of, functions_of, shade
from dvo.synth.render.view import SLACK, View
from dvo.synth.scenes.bodies import Stage
from dvo.synth.scenes.scene import Scene

Array = np.ndarray


def row_offsets(rows: Array, height: int, readout: float) -> Array:
    """Times of exposure of rows, relative to the frame.

    The sensor reads ``height`` rows in ``readout`` seconds, one after the other from top to bottom; the middle row
    ``(height - 1) / 2`` has offset 0, so that a frame's timestamp and pose are those of its middle row.

    Args:
        rows: of any shape, 0 is the top; need not be integers.
        height: number of rows.
        readout: seconds.

    Returns:
        Seconds from the middle of the frame to the middle of exposure of each row.
    """
    return (np.asarray(rows, float) - (height - 1) / 2) * (readout / height)


def render_rows(
    scene: Scene | Stage, poses_wc: Array, intrinsics: Array, width: int, *, times: Array | None = None,
    quality: Quality = STANDARD, device: torch.device | str = "cpu", coordinates: bool = True,
) -> Rendering:  # fmt: skip
    """Render one frame whose rows have poses of their own.

    Args:
        scene: static, or with moving bodies.
        poses_wc: ``(H, 7)`` camera to world while each row is exposed.
        intrinsics: ``(4,)`` fx fy cx cy in pixels of the ``H`` x ``width`` image.
        width: pixels.
        times: ``(H,)`` seconds, for moving bodies.
        quality, device, coordinates: as for :func:`dvo.synth.render.renderer.render`.

    Returns:
        A batch of one frame. Depth is measured along the optical axis of the row's camera.

    Raises:
        DvoError: arguments of the wrong shape.
    """
    height = len(poses_wc)
    if poses_wc.shape != (height, 7) or np.shape(intrinsics) != (4,):
        raise DvoError("a rolling shutter needs poses (H, 7) and intrinsics (4,)", field="poses_wc, intrinsics")
    painted, view = _look_rows(scene, poses_wc, np.asarray(intrinsics, float), width, times)
    nearest, local, functions = cast(view, 1, width, device)  # (H, 1, W)
    depth = torch.where(local >= 0, 1 / nearest, 0.0)
    if quality.supersample == 1:
        images = _colours(painted, view, local[:, 0], quality.taps)
        if quality.antialias:
            smooth_outlines(images, local.view(1, height, width), functions[None], SLACK, by_row=True)
    else:
        m = quality.supersample
        fine = intrinsics * [m, m, m, m] + np.array([0, 0, 0.5 * m - 0.5, 0.5 * m - 0.5])
        often = None if times is None else np.repeat(times, m)
        _, fine_view = _look_rows(scene, np.repeat(poses_wc, m, 0), fine, width * m, often)
        _, fine_local, _ = cast(fine_view, 1, width * m, device)
        images = torch.nn.functional.avg_pool2d(_colours(painted, fine_view, fine_local[:, 0], quality.taps), m)
    uv = torch.zeros(1, 0, 0, 2, device=device)
    if coordinates:
        uv = coordinates_of(view, local, depth).view(1, height, width, 2)
    shape = (1, height, width)
    return Rendering(images, depth.view(shape), named(view, local).view(shape), uv)


def _look_rows(
    scene: Scene | Stage, poses_wc: Array, intrinsics: Array, width: int, times: Array | None
) -> tuple[Scene, View]:
    """View of one camera per row: row y of the frame is row 0 of a camera with its principal point y higher."""
    k = np.tile(intrinsics, (len(poses_wc), 1))
    k[:, 3] -= np.arange(len(poses_wc))
    return view_scene(scene, poses_wc, k, (1, width), times)


def _colours(scene: Scene, view: View, local: Tensor, taps: int) -> Tensor:
    """Image ``(1, 3, H, W)`` of cast rows ``local (H, W)``."""
    height, width = local.shape
    device = local.device
    images = torch.empty(3, height * width, device=device)
    functions = functions_of(scene, view, device)
    names = torch.from_numpy(view.index).to(device)
    x = torch.arange(width, dtype=torch.float32, device=device).expand(height, width).reshape(-1)
    y = torch.zeros_like(x)
    first = torch.arange(height, device=device)[:, None].expand(height, width).reshape(-1) * len(view.index)
    flat = local.reshape(-1).long()
    hit = flat >= 0
    flat.clamp_min_(0)
    piece = height * width if torch.device(device).type != "cpu" else PIECE
    for a in range(0, flat.numel(), piece):
        part = slice(a, a + piece)
        images[:, part] = shade(scene, functions, flat[part] + first[part], names[flat[part]], x[part], y[part], taps)
    if not hit.all():
        images.masked_fill_(~hit, 0.0)
    return images.view(1, 3, height, width)
