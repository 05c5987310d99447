"""Figures of docs/method.md: python docs/figures/make.py [--frames N] [--out FOLDER].

They are of a rendered walk that is tracked: a camera goes round a furnished room 1.4 times. Flow, correlation and
normal equations are those of the window at one frame of the walk, the graph is that of its end. The same machine writes
the same bytes again.
"""

from __future__ import annotations

import argparse
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

import dvo
from dvo.ba.layer.schur import invert_blocks
from dvo.ba.layer.window_equations import window_equations
from dvo.ba.options import BAOptions
from dvo.core.command_line import OneLineParser
from dvo.nets.correlation.correlation import correlate_reference
from dvo.odometry.frames.front_end import encode_image
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.synth import make_sequence
from dvo.viz.plot import ACCENT, INK, PAPER, TRUTH

FOLDER = Path(__file__).resolve().parent
NAMES = "correlation", "flow", "equations", "graph"
CLIP = {"family": "room", "kind": "loop", "speed": 2.0, "fps": 10.0, "width": 320, "height": 240}
SEED, FRAMES, SHOWN = 7, 240, 150
BACK = 3  # keyframes between the two of a pair
FAR = 8.0  # seconds between the keyframes of an edge above which it belongs to a loop
DPI, COLOURS = 120, 256  # of a figure; few colours keep the files small


@dataclass(frozen=True)
class Pair:
    """Two keyframes of the window, and the edges from the older into the newest.

    Attributes:
        images: ``(H, W, 3)`` uint8 RGB, the older first.
        edges: ``(e,)`` positions of the edges in the window.
        stride: image pixels of a feature pixel.
    """

    images: tuple[np.ndarray, np.ndarray]
    edges: torch.Tensor
    stride: int


def newest_pair(odometry: PatchOdometry) -> Pair:
    """Find the newest keyframe and one before it.

    Args:
        odometry: after some frames.
    """
    window = odometry.window
    new = len(window) - 1
    old = max(new - BACK, 0)
    edges = ((window.ii == old) & (window.jj == new)).nonzero()[:, 0]
    first, second = window.frames[old].image, window.frames[new].image
    assert first is not None and second is not None
    return Pair((first, second), edges, odometry.model.config.STRIDE)


def draw_flow(odometry: PatchOdometry) -> Any:
    """Patches of a keyframe, and the positions at which the network measures them in the newest one.

    Args:
        odometry: after some frames.

    Returns:
        The figure.
    """
    from matplotlib.patches import Rectangle

    window, pair = odometry.window, newest_pair(odometry)
    centres = window.patches[window.kk[pair.edges], :2, 1, 1].numpy() * pair.stride
    measured = window.targets[pair.edges].numpy() * pair.stride
    confidence = window.confidence[pair.edges].mean(1).numpy()
    figure, panels = _panels(9.6, 3.5, 2)
    shades = figure.cmap(confidence)
    for panel, image, title in zip(panels, pair.images, ("frame i: patches", "frame j: measured flow"), strict=True):
        _show(panel, image, title)
    side = 3 * pair.stride
    for centre, shade in zip(centres, shades, strict=True):
        panels[0].add_patch(Rectangle(tuple(centre - side / 2), side, side, fill=False, edgecolor=shade, lw=1.6))
    panels[1].scatter(*centres.T, s=12, color=shades, linewidths=0)
    panels[1].quiver(
        *centres.T, *(measured - centres).T, color=shades, angles="xy", scale_units="xy", scale=1, width=0.006
    )
    figure.colorbar(figure.scale, ax=panels, label="confidence", shrink=0.8, pad=0.01)
    return figure


@torch.inference_mode()
def draw_correlation(odometry: PatchOdometry) -> Any:
    """Correlation of a patch with the newest keyframe, as it is before the first update of that frame.

    The frame is given the pose of the one before it and edges without a state, as if it had not moved; the window is
    restored afterwards.

    Args:
        odometry: after some frames.

    Returns:
        The figure.
    """
    from matplotlib.patches import Rectangle

    window, pair = odometry.window, newest_pair(odometry)
    before, into = window.snapshot(), window.jj == len(window) - 1
    window.poses_cw = torch.cat([window.poses_cw[:-1], window.poses_cw[-2:-1]])
    window.hidden = torch.where(into[:, None], 0.0, window.hidden)
    revision = odometry.patch_window.revise()
    window.restore(before)
    moved = revision.delta[0, pair.edges].norm(dim=1)
    size = torch.tensor(pair.images[1].shape[1::-1]) / pair.stride
    border = torch.minimum(revision.coords[0, pair.edges, 1, 1], size - revision.coords[0, pair.edges, 1, 1]).amin(1)
    clear = (moved > 1) & (moved < 3) & (border > 2 * max(odometry.model.config.pyramid))
    edge = pair.edges[int((revision.weights[0, pair.edges].mean(1) * (1 + clear)).argmax())]
    coords, patch = revision.coords[:, edge : edge + 1], window.kk[edge]
    maps = encode_image(odometry.model, pair.images[1], odometry.device).matching
    none = torch.zeros(1, dtype=torch.long)
    config = odometry.model.config
    frame, number = divmod(int(patch), window.per_frame)
    matching = window.frames[frame].matching[None, number : number + 1]
    levels = correlate_reference(matching, maps, coords, none, none, config.pyramid, config.radius)
    figure, panels = _panels(10.4, 2.9, 2 + len(levels))
    stride, side = pair.stride, 2 * config.radius + 1
    source = window.patches[patch, :2, 1, 1].numpy() * stride
    predicted = coords[0, 0, 1, 1].numpy() * stride
    delta = revision.delta[0, edge].numpy()
    reach = side * stride * max(config.pyramid) * 0.55
    for panel, image, centre, title in zip(
        panels, pair.images, (source, predicted), ("patch in frame i", "search windows in frame j"), strict=False
    ):
        _show(panel, image, title)
        panel.set_xlim(centre[0] - reach, centre[0] + reach)
        panel.set_ylim(centre[1] + reach, centre[1] - reach)
    boxes = [(0, source, config.patch_size * stride, ACCENT)]
    boxes += [(1, predicted, side * stride * s, c) for s, c in zip(config.pyramid, (ACCENT, TRUTH), strict=False)]
    for number, centre, size, colour in boxes:
        corner = centre - size / 2
        panels[number].add_patch(Rectangle(tuple(corner), size, size, fill=False, edgecolor=colour, lw=1.8))
    _mark(panels[1], predicted, predicted + delta * stride)
    middle = config.patch_size // 2
    for panel, level, scale in zip(panels[2:], levels, config.pyramid, strict=True):
        values = level.view(side, side, config.patch_size, config.patch_size)[:, :, middle, middle].T.numpy()
        r = config.radius
        panel.imshow(values, cmap="magma", extent=(-r - 0.5, r + 0.5, r + 0.5, -r - 0.5))
        _mark(panel, np.zeros(2), delta / scale)
        panel.set_title(f"correlation, s = {scale}", fontsize=9.5, color=INK)
        panel.set_xlabel(f"offset, {scale} feature pixel{'s' * (scale > 1)}", fontsize=8.5, color=INK)
        panel.tick_params(labelsize=8, colors=INK)
    return figure


def draw_equations(odometry: PatchOdometry) -> Any:
    """Normal equations of the window, and what elimination of the depths leaves of them.

    Args:
        odometry: after some frames.

    Returns:
        The figure.
    """
    window, m = odometry.window, odometry.window.per_frame
    source = int(window.kk.min()) // m
    patches = window.patches[source * m :, :, 1, 1].double().unflatten(0, (-1, m))
    poses, intrinsics, targets, weights = (
        x.double() for x in (window.poses_cw, window.intrinsics, window.targets, window.weights)
    )
    found = window_equations(
        poses, patches[..., :2], patches[..., 2], intrinsics, targets, weights, window.jj, window.kk - source * m,
        source, BAOptions(bounds=odometry.patch_window.bounds, kernel=odometry.config.kernel),
    )  # fmt: skip
    b, e, c = found.h_pp[0], found.h_pl[0], found.h_ll[0]
    inverse = invert_blocks(c[None, :, None, None])[0, :, 0, 0]
    seen = b.abs().sum(1) > 0  # the oldest frames may have no edge left
    b, e = b[seen][:, seen], e[seen]
    whole = torch.cat((torch.cat((b, e), 1), torch.cat((e.T, torch.diag(c)), 1))).abs().numpy()
    reduced = (b - (e * inverse) @ e.T).abs().numpy()
    figure, panels = _panels(9.2, 4.6, 2)
    top = np.log10(whole.max())
    titles = f"H: {len(b) // 6} poses, {len(c)} inverse depths", "Schur complement S: the poses alone"
    for panel, matrix, title in zip(panels, (whole, reduced), titles, strict=True):
        shown = np.log10(np.where(matrix > 0, matrix, np.nan))
        image = panel.imshow(shown, cmap="viridis_r", vmin=top - 7, vmax=top, interpolation="nearest")
        panel.set_title(title, fontsize=9.5, color=INK)
        panel.set_xticks([])
        panel.set_yticks([])
    figure.colorbar(image, ax=panels, label="log10 of the absolute value", shrink=0.7, pad=0.01)
    n, size = len(b), len(whole)
    for line in (panels[0].axhline, panels[0].axvline):
        line(n - 0.5, color=ACCENT, lw=1.2)
    middle = (n + size) / 2
    words = {"labels": ["poses", "inverse depths"], "color": INK, "fontsize": 8.5}
    panels[0].set_xticks([n / 2, middle], **words)
    panels[0].set_yticks([n / 2, middle], **words, rotation=90, va="center")
    far = 0.3 * n + 0.7 * size
    for x, y, name in (
        (n / 2, n / 2, "B"),
        (middle, n / 2, "E"),
        (n / 2, middle, "Eᵀ"),
        (far, 0.7 * n + 0.3 * size, "C"),
    ):
        panels[0].text(x, y, name, color=INK, fontsize=13, ha="center", va="center", bbox=_LABEL)
    panels[0].tick_params(length=0)
    panels[1].set_xlabel("poses, 6 rows each", fontsize=8.5, color=INK)
    return figure


def draw_graph(odometry: PatchOdometry) -> Any:
    """Edges between the frames of the walk.

    Args:
        odometry: after the last frame; it is finished here, as loops are looked for once more at the end.

    Returns:
        The figure.
    """
    window = odometry.window
    names = np.array([frame.identifier for frame in window.frames])
    active = np.unique(np.stack([names[window.ii.numpy()], names[window.jj.numpy()]]), axis=1)
    odometry.finish()
    archive = odometry.graph.archive
    edges = archive.edges()
    times = {frame.identifier: frame.timestamp for frame in archive.keyframes}
    first = min(times.values())
    archived = np.unique(np.stack([edges.source, edges.target]), axis=1)
    lookup = np.vectorize(lambda k: times[k] - first, otypes=[float])
    archived, active = lookup(archived), lookup(active)
    loop = np.abs(archived[0] - archived[1]) > FAR
    figure, (panel,) = _panels(5.4, 5.0, 1)
    for points, colour, name, size in (
        (archived[:, ~loop], "#9aa3ad", "archived", 2.0),
        (active, ACCENT, "in the window at the last frame", 4.0),
        (archived[:, loop], TRUTH, "of loops", 9.0),
    ):
        panel.scatter(*points, s=size, color=colour, linewidths=0, label=name)
    panel.set_aspect("equal")
    panel.set_xlabel("time of the frame i of the patch, s", color=INK, fontsize=9)
    panel.set_ylabel("time of the frame j that sees it, s", color=INK, fontsize=9)
    panel.tick_params(labelsize=8, colors=INK)
    panel.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, frameon=False, fontsize=8, markerscale=2)
    for side in ("top", "right"):
        panel.spines[side].set_visible(False)
    return figure


_LABEL = {"boxstyle": "round,pad=0.2", "facecolor": PAPER, "edgecolor": "none", "alpha": 0.85}


def _panels(width: float, height: float, count: int) -> Any:
    """Figure with panels side by side, and a scale of colours for confidence."""
    from matplotlib import colormaps
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    figure.cmap = colormaps["plasma"]
    figure.scale = ScalarMappable(Normalize(0, 1), figure.cmap)
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


def _mark(panel: Any, predicted: np.ndarray, measured: np.ndarray) -> None:
    """Draw a reprojection as a circle and a measurement as a cross, visible on any ground."""
    panel.plot(*predicted, "o", ms=6, color=PAPER, mec=INK, mew=1.2)
    panel.plot(*measured, "x", ms=9, mew=4.2, color=INK)
    panel.plot(*measured, "x", ms=8, mew=1.8, color="#35d0ff")


def _show(panel: Any, image: np.ndarray, title: str) -> None:
    """Draw an image in pale grey, so that what is drawn on it stands out."""
    grey = cv2.GaussianBlur(image.mean(axis=2), (3, 3), 0)
    shown = np.round((0.6 * grey + 0.4 * 255) / 8) * 8  # few levels, so that the file is small
    panel.imshow(shown, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    panel.set_title(title, fontsize=9.5, color=INK)
    panel.set_xticks([])
    panel.set_yticks([])


def write(figure: Any, path: Path) -> None:
    """Write a figure with few colours.

    Args:
        figure: to write.
        path: PNG file.
    """
    from PIL import Image

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", bbox_inches="tight", pad_inches=0.06)
    Image.open(buffer).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)


def main() -> None:
    """Track the walk and write the figures."""
    parser = OneLineParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=FRAMES, help="of the walk (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=FOLDER, help="folder (default: that of this file)")
    arguments = parser.parse_args()
    odometry = dvo.load("small", device="cpu", seed=0)
    assert isinstance(odometry, PatchOdometry)
    figures = {}
    for number, frame in enumerate(make_sequence(SEED, **{**CLIP, "frames": arguments.frames}), 1):
        odometry.track(frame)
        if number == min(SHOWN, arguments.frames):
            draws = {"correlation": draw_correlation, "flow": draw_flow, "equations": draw_equations}
            figures |= {name: draw(odometry) for name, draw in draws.items()}
    figures["graph"] = draw_graph(odometry)
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in NAMES:
        write(figures[name], arguments.out / f"{name}.png")
        print(arguments.out / f"{name}.png", f"{(arguments.out / f'{name}.png').stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
