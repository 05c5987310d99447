"""Picture of a calibration with a board: coverage, reprojection errors, and an image without its distortion."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dvo.boards.calibrate import BoardCalibration
from dvo.core.errors import DvoError
from dvo.geometry.undistort import Undistorter
from dvo.viz.plot import ACCENT, INK, PAPER, START, TRUTH, literal

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DPI = 120
_FAINT = "#c9ced6"


def plot_board_calibration(path: Path | str, found: BoardCalibration) -> None:
    """Draw a calibration.

    Four panels: the corners of all views in the image, those of rejected ones grey; the reprojection error of each
    corner, enlarged; the image with the largest view as recorded, with reprojected points; the same without
    distortion, as ``dvo run`` tracks it.

    Args:
        path: PNG to write.
        found: the calibration.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    ratio = found.height / found.width
    figure = Figure(figsize=(11.0, 1.4 + 11.0 * ratio), dpi=DPI, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    (coverage, errors), (recorded, ideal) = figure.subplots(2, 2)
    figure.suptitle(literal(str(found)), fontsize=8.5, color=INK, family="monospace", ha="left", x=0.02)
    _coverage(coverage, found)
    _errors(errors, found)
    _recorded(recorded, found)
    try:
        undistorter = Undistorter(found.calibration.camera(found.width, found.height))
        _show(ideal, undistorter(found.example), "without distortion")
    except DvoError as error:
        ideal.set_axis_off()
        ideal.text(0.5, 0.5, literal(error.message), ha="center", va="center", wrap=True, fontsize=8, color=INK)
    figure.savefig(path, format="png")


def _frame(plot: Axes, found: BoardCalibration, title: str) -> None:
    plot.set_xlim(-0.5, found.width - 0.5)
    plot.set_ylim(found.height - 0.5, -0.5)
    plot.set_aspect("equal")
    plot.set_title(title, fontsize=9, color=INK)
    plot.tick_params(labelsize=7, colors=INK)


def _coverage(plot: Axes, found: BoardCalibration) -> None:
    _frame(plot, found, f"corners of {len(found.views)} views: {found.coverage:.0%} of the cells")
    for column in range(1, 8):
        plot.axvline(column * found.width / 8 - 0.5, color=_FAINT, linewidth=0.5)
    for row in range(1, 6):
        plot.axhline(row * found.height / 6 - 0.5, color=_FAINT, linewidth=0.5)
    for view in found.rejected:
        plot.plot(*view.corners.T, ".", color="#8a929e", markersize=2)
    for view, error in zip(found.views, found.solution.view_rms, strict=True):
        colour = ACCENT if error > 1.5 * np.median(found.solution.view_rms) else TRUTH
        plot.plot(*view.corners.T, ".", color=colour, markersize=2.5)
    plot.plot(*found.solution.values[2:4], "+", color=START, markersize=12, markeredgewidth=2)


def _errors(plot: Axes, found: BoardCalibration) -> None:
    everything = np.concatenate(found.solution.residuals)
    length = 0.03 * found.width / max(float(np.median(np.linalg.norm(everything, axis=1))), 1e-6)
    _frame(plot, found, f"reprojection errors, {length:.0f} times enlarged; RMS {found.solution.rms:.3f} px")
    corners = np.concatenate([view.corners for view in found.views])
    plot.quiver(
        *corners.T, *(length * everything).T, angles="xy", scale_units="xy", scale=1, color=ACCENT, width=0.0018
    )  # fmt: skip


def _recorded(plot: Axes, found: BoardCalibration) -> None:
    _show(plot, found.example, f"frame {found.example_index} with reprojected points")
    for view, residual in zip(found.views, found.solution.residuals, strict=True):
        if view.index == found.example_index:
            plot.plot(*(view.corners + residual).T, "x", color=START, markersize=4, markeredgewidth=0.8)


def _show(plot: Axes, image: np.ndarray, title: str) -> None:
    plot.imshow(image, interpolation="bilinear")
    plot.set_title(title, fontsize=9, color=INK)
    plot.tick_params(labelsize=7, colors=INK)
