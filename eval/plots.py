"""One picture per sequence: where every system went, and its error over time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.metrics import align_trajectory, associate, relative_rotation_errors
from dvo.viz.plot import INK, PAPER, plan_axes, with_gaps
from eval.sequences import Sequence, Suite

# A system keeps its colour from picture to picture; those without one of their own take the rest in turn.
COLORS = {"dvo-small": "#e4572e", "klt-pnp": "#4a6fa5", "null": "#c79a2b"}
OTHERS = ("#2a9d5c", "#b5679e", "#56b4c8", "#7a5c3e")


def plot_sequence(
    path: Path, suite: Suite, sequence: Sequence, groundtruth: Trajectory, estimates: dict[str, Trajectory]
) -> None:
    """Write a PNG: plan view (the plane of ground truth's two longest axes) and error over time.

    Args:
        groundtruth: camera to world, metres.
        estimates: by the name in the legend; aligned here, as the suite says.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.5, 5.2), dpi=120, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    plan, error = figure.subplots(1, 2, width_ratios=(1.15, 1))
    first, second = plan_axes(groundtruth.positions)
    start = groundtruth.timestamps[0]
    plan.plot(*groundtruth.positions[:, [first, second]].T, color="#aab1ba", lw=4, label="ground truth")
    plan.plot(*groundtruth.positions[0, [first, second]], "o", color=INK, ms=7, zorder=5)
    by_rotation = sequence.judged_by == "rpe_rot_deg"
    others = [name for name in estimates if name not in COLORS]
    for name, estimate in estimates.items():
        color = COLORS[name] if name in COLORS else OTHERS[others.index(name) % len(OTHERS)]
        style: dict[str, Any] = {"color": color, "lw": 1.6}
        if len(estimate) < 2:
            plan.plot([], [], **style, label=f"{name}: no trajectory")
            continue
        aligned = align_trajectory(estimate, groundtruth, suite.alignment)
        plan.plot(*with_gaps(aligned)[:, [first, second]].T, **style, label=name)
        if by_rotation:
            stamps, values = relative_rotation_errors(estimate, groundtruth, suite.rpe_gap)
        else:
            i, j = associate(aligned, groundtruth)
            stamps = aligned.timestamps[i]
            values = np.linalg.norm(aligned.positions[i] - groundtruth.positions[j], axis=1)
        error.plot(stamps - start, values, **style, label=name)
    plan.set_aspect("equal", adjustable="datalim")
    plan.set_xlabel(f"{'xyz'[first]} (m)")
    plan.set_ylabel(f"{'xyz'[second]} (m)")
    plan.set_title(f"{sequence.name}, {suite.alignment} alignment", loc="left", fontsize=11, color=INK)
    error.set_xlabel("time (s)")
    what = f"rotation error over {suite.rpe_gap} frames (degrees)" if by_rotation else "position error (m)"
    error.set_title(what, loc="left", fontsize=11, color=INK)
    error.set_ylim(bottom=0)
    for plot in (plan, error):
        plot.grid(color=INK, alpha=0.1, lw=0.6)
        plot.spines[["top", "right"]].set_visible(False)
    plan.legend(frameon=False, fontsize=9)
    figure.suptitle(f"{suite.label}", fontsize=9, color=INK, x=0.01, ha="left")
    figure.savefig(path, metadata={"Software": None})
