"""Pictures of a tracked clip for the training log: trajectory, patch flow, confidences."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from dvo.data.trajectory import Trajectory
from dvo.geometry.projection import reproject
from dvo.metrics import align_trajectory
from dvo.odometry.frames.gate import working_image
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.odometry.protocol import Odometry
from dvo.viz.plot import ACCENT, INK, PAPER, TRUTH, plan_axes


@dataclass(frozen=True)
class PatchFlow:
    """Motion of the patches of earlier keyframes into the newest one.

    Attributes:
        timestamp: of the newest keyframe, seconds.
        pixels: pixel budget of the working image, 0 for the image as it is.
        tails: ``(E, 2)`` positions in the frame of the patch, pixels of the working image.
        heads: ``(E, 2)`` positions in the newest keyframe.
        confidence: ``(E,)`` mean of both axes.
        all_confidence: of every edge of the window.
    """

    timestamp: float
    pixels: int
    tails: np.ndarray
    heads: np.ndarray
    confidence: np.ndarray
    all_confidence: np.ndarray


@torch.no_grad()
def patch_flow(odometry: Odometry, back: int = 2) -> PatchFlow | None:
    """Flow of the last window of a tracker.

    Args:
        odometry: any; only that of ``patch_vo`` has patches.
        back: greatest age of a patch, keyframes.

    Returns:
        the flow, or None if there is none.
    """
    if not isinstance(odometry, PatchOdometry):
        return None
    window = odometry.window
    newest = len(window) - 1
    edges = (window.jj == newest) & (window.ii < newest) & (window.ii >= newest - back)
    if newest < 1 or not edges.any():
        return None
    seen = reproject(
        window.poses_cw[None], window.patches[None], window.intrinsics[None], window.ii, window.jj, window.kk
    ).coords[0]
    p, stride = seen.shape[1] // 2, odometry.model.config.STRIDE
    tails = window.patches[window.kk[edges], :2, p, p] * stride
    heads = seen[edges, p, p] * stride
    confidence = window.weights.mean(-1)
    found = (x.float().cpu().numpy() for x in (tails, heads, confidence[edges], confidence))
    return PatchFlow(window.frames[newest].timestamp, odometry.config.pixels, *found)


def draw(
    path: Path,
    title: str,
    estimate: Trajectory,
    truth: Trajectory,
    flow: PatchFlow | None,
    image: np.ndarray | None,
) -> np.ndarray:
    """Write the picture of one clip.

    Args:
        path: PNG file.
        title: above the trajectory.
        estimate: as tracked; it is aligned by Sim(3) here.
        truth: ground truth.
        flow: of the last window; None leaves out arrows and histogram.
        image: working image of the newest keyframe, ``(H, W, 3)`` uint8; None leaves it out.

    Returns:
        the picture, ``(H, W, 3)`` uint8.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.5, 4.2), dpi=90, facecolor=PAPER, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    plan, view, histogram = figure.subplots(1, 3, width_ratios=(1.0, 1.3, 0.8))
    axes = plan_axes(truth.positions)
    plan.plot(*truth.positions[:, axes].T, color=TRUTH, lw=2.4, label="ground truth")
    if len(estimate) >= 3:
        plan.plot(*align_trajectory(estimate, truth).positions[:, axes].T, color=ACCENT, lw=1.4, label="tracked")
    plan.set_aspect("equal", adjustable="datalim")
    plan.set_xlabel(f"{'xyz'[axes[0]]} (m)", color=INK)
    plan.set_ylabel(f"{'xyz'[axes[1]]} (m)", color=INK)
    plan.legend(frameon=False, fontsize=8)
    plan.set_title(title, loc="left", fontsize=10, color=INK)
    view.set_axis_off()
    if image is not None:
        view.imshow(image)
        view.set_xlim(0, image.shape[1])
        view.set_ylim(image.shape[0], 0)
    if flow is not None:
        d = flow.heads - flow.tails
        arrows = view.quiver(
            *flow.tails.T, *d.T, flow.confidence, angles="xy", scale_units="xy", scale=1, width=0.004, cmap="plasma",
            clim=(0, 1),
        )  # fmt: skip
        figure.colorbar(arrows, ax=view, shrink=0.8, label="confidence")
        view.set_title("patches of the keyframes before, seen in the last one", loc="left", fontsize=10, color=INK)
        histogram.hist(flow.all_confidence, bins=np.linspace(0, 1, 41), color=TRUTH)
    histogram.set_xlabel("confidence", color=INK)
    histogram.set_ylabel("edges of the last window", color=INK)
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas.draw()
    figure.savefig(path, metadata={"Software": None})
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()


def image_at(frames: list, timestamp: float, pixels: int) -> np.ndarray | None:
    """Working image ``(H, W, 3)`` of the frame of that time, None if there is no such frame."""
    frame = next((f for f in frames if abs(f.timestamp - timestamp) < 1e-9), None)
    return None if frame is None else working_image(frame, pixels)[0]
