"""Contact sheets of clips: frames, depth, flow, plan of the path. ``python -m dvo.synth.preview --out sheet.png``."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from dvo.errors import DvoError
from dvo.synth.clip import Clip, make_clip
from dvo.synth.poses import inverse, split

Array = np.ndarray


def depth_colours(depth: Array) -> Array:
    """``(H, W)`` depth (unit: median 1) -> ``(H, W, 3)`` uint8 RGB; near is bright, by inverse depth."""
    level = np.clip(1 / np.maximum(depth, 1e-3) / 2.5, 0, 1)
    table = cv2.applyColorMap((level * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.ascontiguousarray(table[..., ::-1])


def flow_between(clip: Clip, i: int, j: int) -> Array:
    """Flow ``(H, W, 2)`` in pixels from frame i to frame j by depth and pose (whether or not it stays in view)."""
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
    """``(H, W, 2)`` -> ``(H, W, 3)`` uint8 RGB: hue is direction, saturation is length."""
    hue = (np.arctan2(flow[..., 1], flow[..., 0]) / (2 * np.pi) % 1) * 179
    length = np.clip(np.hypot(flow[..., 0], flow[..., 1]) / largest, 0, 1)
    hsv = np.stack([hue, 255 * length, np.full_like(hue, 255)], -1).astype(np.uint8)
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)


def plan_view(poses_cw: Array, size: tuple[int, int]) -> Array:
    """Camera centres and viewing directions from above (x right, z up the picture) -> ``(H, W, 3)`` uint8 RGB."""
    height, width = size
    poses_wc = inverse(poses_cw)
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
    """One row ``(H, (columns + 3) W, 3)``: evenly chosen frames, depth and flow of the first, plan view."""
    images = clip.images.cpu().numpy().transpose(0, 2, 3, 1)
    chosen = np.linspace(0, len(images) - 1, columns).round().astype(int)
    flow = flow_between(clip, 0, 1)
    cells = [
        *images[chosen],
        depth_colours(clip.depth[0].cpu().numpy()),
        flow_colours(flow, max(float(np.hypot(*np.moveaxis(flow, -1, 0)).mean()) * 2, 1.0)),
        plan_view(clip.poses_cw.cpu().numpy().astype(float), images.shape[1:3]),
    ]
    return np.concatenate(cells, 1)


def contact_sheet(seed: int = 0, count: int = 12, *, start: int = 0, **options: object) -> Array:
    """Sheet ``(H, W, 3)`` uint8 RGB of ``count`` clips; ``options`` go to :func:`dvo.synth.clip.make_clip`."""
    rows = [clip_row(make_clip(seed, start + i, **options)) for i in range(count)]  # type: ignore[arg-type]
    return np.concatenate(rows, 0)


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="PNG to write")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start", type=int, default=0, help="index of the first clip")
    parser.add_argument("--count", type=int, default=12)
    parser.add_argument("--height", type=int, default=120)
    parser.add_argument("--width", type=int, default=160)
    parser.add_argument("--clean", action="store_true", help="no sensor effects")
    given = parser.parse_args(arguments)
    sheet = contact_sheet(
        given.seed, given.count, start=given.start, height=given.height, width=given.width, sensor=not given.clean,
        clips_per_scene=1,
    )  # fmt: skip
    if not cv2.imwrite(str(given.out), sheet[..., ::-1]):
        raise DvoError("cannot write the picture", file=given.out, remedy="give a path that ends in .png")
    print(f"{given.out}: {given.count} clips of stream {given.seed}")


if __name__ == "__main__":
    main()
