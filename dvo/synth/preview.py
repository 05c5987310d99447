"""Contact sheets of clips: frames, depth, flow, plan view of the path (``dvo synth preview``)."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import torch

from dvo.geometry.poses import compose_rodrigues, invert_rodrigues, split
from dvo.synth.clip import Clip, make_clip
from dvo.synth.sequence import SyntheticSequence, make_sequence

Array = np.ndarray


def depth_colours(depth: Array) -> Array:
    """Colours of a depth map, by inverse depth; near is bright.

    Args:
        depth: ``(H, W)`` in units of its median, 0 for none.

    Returns:
        ``(H, W, 3)`` uint8 RGB.
    """
    level = np.clip(1 / np.maximum(depth, 1e-3) / 2.5, 0, 1)
    table = cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    table[depth <= 0] = 0  # nothing there
    return np.ascontiguousarray(table[..., ::-1])


def flow_between(clip: Clip, i: int, j: int) -> Array:
    """Flow from one frame of a clip to another, from depth and poses, whether or not it stays in view.

    Args:
        clip: with depth and poses.
        i, j: frames.

    Returns:
        ``(H, W, 2)`` pixels.
    """
    depth = clip.depth[i].cpu().numpy()
    fx, fy, cx, cy = clip.intrinsics[i].cpu().numpy().astype(float)
    poses = clip.poses_cw.cpu().numpy().astype(float)
    (ri, ti), (rj, tj) = split(poses[i]), split(poses[j])
    y, x = np.mgrid[: depth.shape[0], : depth.shape[1]]
    points = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x, float)], -1) * depth[..., None]
    moved = ((points - ti) @ ri) @ rj.T + tj
    z = np.maximum(moved[..., 2], 1e-6)
    return np.stack([fx * moved[..., 0] / z + cx - x, fy * moved[..., 1] / z + cy - y], -1)


def flow_colours(flow: Array, largest: float) -> Array:
    """Colours of a flow field: hue is direction, saturation is length.

    Args:
        flow: ``(H, W, 2)`` pixels.
        largest: length of full saturation, pixels.

    Returns:
        ``(H, W, 3)`` uint8 RGB.
    """
    hue = (np.arctan2(flow[..., 1], flow[..., 0]) / (2 * np.pi) % 1) * 179
    length = np.clip(np.hypot(flow[..., 0], flow[..., 1]) / largest, 0, 1)
    hsv = np.stack([hue, 255 * length, np.full_like(hue, 255)], -1).astype(np.uint8)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def plan_view(poses_cw: Array, size: tuple[int, int]) -> Array:
    """Camera centres and viewing directions from above (x right, z up the image).

    Args:
        poses_cw: ``(N, 7)`` world to camera.
        size: height and width of the image, pixels.

    Returns:
        ``(H, W, 3)`` uint8 RGB.
    """
    height, width = size
    poses_wc = invert_rodrigues(poses_cw)
    centre, forward = poses_wc[:, [0, 2]], split(poses_wc)[0][:, [0, 2], 2]
    extent = max(float(np.ptp(centre, 0).max()), 0.05)
    scale = 0.6 * min(size) / extent
    middle = (centre.max(0) + centre.min(0)) / 2
    points = (centre - middle) * scale * [1, -1] + [width / 2, height / 2]
    picture = np.full((height, width, 3), 255, np.uint8)
    cv2.polylines(picture, [points.astype(np.int32)], False, (60, 60, 60), 1, cv2.LINE_AA)
    for k, (p, f) in enumerate(zip(points, forward, strict=True)):
        tint = tuple(int(c) for c in depth_colours(np.array([[1 / (0.3 + 2 * k / len(points))]]))[0, 0])
        tip = p + f * [1, -1] * 0.12 * min(size)
        cv2.line(picture, (int(p[0]), int(p[1])), (int(tip[0]), int(tip[1])), tint, 1, cv2.LINE_AA)
        cv2.circle(picture, (int(p[0]), int(p[1])), 2, tint, -1, cv2.LINE_AA)
    label = f"{extent:.2f}"
    cv2.putText(picture, label, (3, height - 4), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (0, 0, 0), 1, cv2.LINE_AA)
    return picture


def clip_row(clip: Clip, columns: int = 4) -> Array:
    """Row of images of a clip: evenly chosen frames, depth and flow of the first, plan view.

    Args:
        clip: to show.
        columns: number of frames.

    Returns:
        ``(H, (columns + 3) W, 3)`` uint8 RGB.
    """
    images = clip.images.cpu().numpy().transpose(0, 2, 3, 1)
    chosen = np.linspace(0, len(images) - 1, columns).round().astype(int)
    flow = flow_between(clip, 0, 1) * (clip.depth[0] > 0).cpu().numpy()[..., None]
    cells = [
        *images[chosen],
        depth_colours(clip.depth[0].cpu().numpy()),
        flow_colours(flow, max(float(np.hypot(*np.moveaxis(flow, -1, 0)).mean()) * 2, 1.0)),
        plan_view(clip.poses_cw.cpu().numpy().astype(float), images.shape[1:3]),
    ]
    return np.concatenate(cells, 1)


def contact_sheet(seed: int = 0, count: int = 12, *, start: int = 0, **options: object) -> Array:
    """Rows of training clips.

    Args:
        seed: of the stream.
        count: number of clips.
        start: index of the first.
        options: of :func:`dvo.synth.clip.make_clip`.

    Returns:
        ``(count H, 7 W, 3)`` uint8 RGB.
    """
    rows = [clip_row(make_clip(seed, start + i, **options)) for i in range(count)]  # type: ignore[arg-type]
    return np.concatenate(rows, 0)


def sequence_rows(sequence: SyntheticSequence, columns: int = 4) -> Array:
    """Row of images of a sequence, as :func:`clip_row`; the flow is that over a tenth of a second.

    Args:
        sequence: to show.
        columns: number of frames.

    Returns:
        ``(H, (columns + 3) W, 3)`` uint8 RGB.
    """
    poses_wc, times = sequence.groundtruth.poses_wc, sequence.groundtruth.timestamps
    chosen = np.linspace(0, len(sequence) - 1, columns).round().astype(int)
    pictures = [sequence.rendering(int(index)) for index in chosen]
    depth = torch.cat([picture.depth for picture in pictures])
    seen = depth[depth > 0]
    scale = float(seen.median()) if len(seen) else 1.0
    near = int(np.searchsorted(times, times[0] + 0.1).clip(1, len(sequence) - 1)) if len(sequence) > 1 else 0
    shown = np.unique(np.concatenate([[0, near], np.linspace(0, len(sequence) - 1, 24).round().astype(int)]))
    relative = compose_rodrigues(invert_rodrigues(poses_wc[shown]), poses_wc[:1])
    relative[:, :3] /= scale
    # The frames for the pictures, two poses for the flow, some more for the plan.
    images = torch.cat([(picture.images * 255).round().to(torch.uint8) for picture in pictures]).cpu()
    picture_clip = Clip(
        images, depth.cpu() / scale, torch.from_numpy(relative),
        torch.from_numpy(np.tile(np.asarray(sequence.camera.intrinsics, float), (len(shown), 1))),
    )  # fmt: skip
    return clip_row(picture_clip, columns)


def family_sheet(
    names: Sequence[str], seeds: Sequence[int], height: int, width: int, *, textures: str | None = None
) -> Array:
    """Rows of clean sequences of six seconds, one per family and seed, each labelled with the family.

    Args:
        names: families.
        seeds: of the sequences, as many.
        height, width: of one image, pixels.
        textures: folder of photographs to use as textures.

    Returns:
        ``(rows H, 7 W, 3)`` uint8 RGB.
    """
    rows = []
    for name, seed in zip(names, seeds, strict=True):
        sequence = make_sequence(
            seed, frames=60, height=height, width=width, fps=10, family=name, sensor=False, textures=textures
        )
        row = np.ascontiguousarray(sequence_rows(sequence))
        for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(row, name, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, thickness, cv2.LINE_AA)
        rows.append(row)
    return np.concatenate(rows)
