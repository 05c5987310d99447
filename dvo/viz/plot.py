"""Plots of trajectories, written to files without a display."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dvo.core.text import visible
from dvo.data.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, ACCENT, TRUTH, START, PAPER = "#22272e", "#e4572e", "#4a6fa5", "#2a9d5c", "#ffffff"
COLOURS = (ACCENT, "#8e4ec6", "#b08900", "#00838f", "#c2185b", "#5d4037")  # of segments
SIZE_INCHES, DPI = (7.6, 6.0), 150
_LEGEND_COLUMNS = 5
_INSET = 0.36  # side of the enlarged path in a plan view, of that of the view
_WIDTH = 66  # letters in a line of a title


def plan_axes(positions: np.ndarray) -> tuple[int, int]:
    """Coordinate axes of the plan view.

    Args:
        positions: ``(N, 3)``.

    Returns:
        Indices of the two axes of largest extent, in increasing order.
    """
    if len(positions) == 0:
        return 0, 2
    first, second = sorted(np.argsort(-np.ptp(positions, axis=0), kind="stable")[:2])
    return int(first), int(second)


def with_gaps(trajectory: Trajectory) -> np.ndarray:
    """Positions with a row of nan wherever frames are missing, so that no line is drawn across the gap.

    A gap is a time step longer than five median steps.

    Args:
        trajectory: camera to world.

    Returns:
        ``(M, 3)`` positions.
    """
    steps = np.diff(trajectory.timestamps)
    if len(steps) == 0:
        return trajectory.positions
    holes = np.flatnonzero(steps > 5 * np.median(steps)) + 1
    return np.insert(trajectory.positions, holes, np.nan, axis=0)


@dataclass(frozen=True)
class Track:
    """Line of a plot.

    Attributes:
        trajectory: camera to world.
        label: name in the legend.
        colour: number of its colour.
    """

    trajectory: Trajectory
    label: str = "dvo"
    colour: int = 0


@dataclass(frozen=True)
class Panel:
    """Part of a plot with a world of its own.

    Attributes:
        tracks: lines in one world; aligned with the reference if there is one.
        points: ``(M, 3)`` map points in that world, drawn behind the lines; the nearer half is within the view.
        reference: ground truth, camera to world, metres.
        loops: ``(L, 3)`` positions at which a loop was found, in that world.
    """

    tracks: tuple[Track, ...]
    points: np.ndarray | None = None
    reference: Trajectory | None = None
    loops: np.ndarray | None = None


def literal(text: str) -> str:
    """Text that a plot shows letter for letter, without mathematics between dollars and without control characters.

    Args:
        text: any, such as the name of a file; line feeds stay.
    """
    shown = visible(text, lines=True).replace("$", r"\$")
    return f" {shown}" if shown.startswith("_") else shown  # a label with it would be left out of a legend


def plot_trajectory(
    path: Path | str,
    estimate: Trajectory,
    *,
    reference: Trajectory | None = None,
    points: np.ndarray | None = None,
    title: str = "",
    subtitle: str = "",
    label: str = "dvo",
) -> None:
    """Draw the plan view of a trajectory: the plane of the two longest axes, equal scales, the start marked.

    Args:
        path: image to write; the extension selects the format.
        estimate: camera to world, already aligned to the reference if there is one.
        reference: ground truth, camera to world, metres.
        points: ``(M, 3)`` map points in the world of the estimate, drawn behind it.
        title, subtitle: texts above the plot.
        label: name of the estimate in the legend.
    """
    plot_panels(path, [Panel((Track(estimate, label),), points, reference)], title=title, subtitle=subtitle)


def plot_panels(path: Path | str, panels: Sequence[Panel], *, title: str = "", subtitle: str = "") -> None:
    """Draw the plan views of several worlds side by side, each with axes and a scale of its own.

    Args:
        path: image to write; the extension selects the format.
        panels: one or more.
        title, subtitle: texts above the plot.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE_INCHES, dpi=DPI, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    panels = [replace(one, tracks=tuple(replace(t, label=literal(t.label)) for t in one.tracks)) for one in panels]
    if len(panels) == 1:
        _draw_alone(figure, panels[0], title, subtitle)
    else:
        _draw_side_by_side(figure, panels, title, subtitle)
    figure.savefig(path, metadata={"Software": None} if str(path).endswith(".png") else None)


def _draw_alone(figure: Figure, panel: Panel, title: str, subtitle: str) -> None:
    plot = figure.add_subplot()
    _draw_panel(plot, panel, SIZE_INCHES[0] / SIZE_INCHES[1])
    _add_title(plot, title, subtitle)
    if plot.get_legend_handles_labels()[0]:  # below the axes: above them is the title, of any length
        for columns in range(_LEGEND_COLUMNS, 0, -1):
            legend = figure.legend(loc="outside lower left", ncols=columns, frameon=False, fontsize=9.5)
            if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
                break
            legend.remove()


def _draw_side_by_side(figure: Figure, panels: Sequence[Panel], title: str, subtitle: str) -> None:
    columns = 2 if len(panels) <= 4 else 3
    rows = -(-len(panels) // columns)
    for place, panel in enumerate(panels, 1):
        plot = figure.add_subplot(rows, columns, place)
        _draw_panel(plot, panel, SIZE_INCHES[0] / columns / (SIZE_INCHES[1] / rows))
        names = [track.label for track in panel.tracks]
        handles = [line for line in plot.get_lines() if line.get_label() in names or line.get_marker() == "D"]
        plot.legend(handles=handles, loc="lower left", bbox_to_anchor=(0, 1), frameon=False, fontsize=9)
    figure.suptitle(_filled(title), x=0.01, ha="left", fontsize=12, fontweight="bold", color=INK)
    note = "every panel has a world and a scale of its own; a dot marks a start"
    figure.supxlabel(literal(f"{subtitle}\n{note}".strip()), x=0.01, ha="left", fontsize=9.5, color=INK)


def _draw_panel(plot: Axes, panel: Panel, ratio: float) -> None:
    truth = panel.reference if panel.reference is not None and len(panel.reference) else None
    lines = [track.trajectory for track in panel.tracks if len(track.trajectory)]
    shown = lines if truth is None else [truth]
    axes = plan_axes(np.concatenate([line.positions for line in shown]) if shown else np.zeros((0, 3)))
    points = np.zeros((0, 2)) if panel.points is None else panel.points[:, axes]
    points = points[np.isfinite(points).all(axis=1)]
    _limits(plot, [line.positions for line in (*lines, truth) if line is not None], axes, ratio, points)
    if len(points):
        plot.scatter(points[:, 0], points[:, 1], s=7, color=INK, alpha=0.4, linewidths=0, label="map points", zorder=1)
    _draw_lines(plot, panel, truth, axes)
    path = np.concatenate([line.positions for line in shown])[:, axes] if shown else np.zeros((0, 2))
    if len(path) and len(points):
        _enlarge(plot, panel, truth, axes, path, points)
    _decorate(plot, axes, "m" if truth is not None else "unit free")


def _draw_lines(plot: Axes, panel: Panel, truth: Trajectory | None, axes: tuple[int, int]) -> None:
    """Draw trajectories, starts and loops."""
    if truth is not None:
        plot.plot(*with_gaps(truth)[:, axes].T, color=TRUTH, lw=2.6, alpha=0.75, label="ground truth", zorder=2)
    for track in panel.tracks:
        if len(track.trajectory):
            colour = COLOURS[track.colour % len(COLOURS)]
            plot.plot(*with_gaps(track.trajectory)[:, axes].T, color=colour, lw=1.5, label=track.label, zorder=3)
            x, y = track.trajectory.positions[0, axes]
            label = "start" if track is panel.tracks[-1] else None
            plot.plot(x, y, "o", ms=7, color=START, mec=PAPER, mew=1.2, ls="none", label=label, zorder=4)
    if panel.loops is not None and len(panel.loops):
        name = f"{len(panel.loops)} loop{'s' * (len(panel.loops) > 1)}"
        plot.plot(*panel.loops[:, axes].T, "D", ms=5, mfc="none", mec=INK, mew=1.2, ls="none", label=name, zorder=5)


def _enlarge(
    plot: Axes, panel: Panel, truth: Trajectory | None, axes: tuple[int, int], path: np.ndarray, points: np.ndarray
) -> None:
    """Draw a path that is small beside its map once more, enlarged, in the corner with the fewest points."""
    (left, right), (bottom, top) = plot.get_xlim(), plot.get_ylim()
    size = np.array([right - left, top - bottom])
    half = 0.6 * max(float((np.ptp(path, axis=0) / size).max()), 1e-9)  # of the enlarged part, of the view
    if not 0.005 < half < _INSET / 4:
        return
    everything = (np.concatenate([points, path]) - [left, bottom]) / size
    corners = [(x, y) for y in (0.02, 0.98 - _INSET) for x in (0.02, 0.98 - _INSET)]
    covered = [((everything >= c) & (everything <= np.add(c, _INSET))).all(axis=1).sum() for c in corners]
    inset = plot.inset_axes((*corners[int(np.argmin(covered))], _INSET, _INSET), facecolor=PAPER, zorder=6)
    middle = (path.min(axis=0) + path.max(axis=0)) / 2
    inset.set_xlim(middle[0] - half * size[0], middle[0] + half * size[0])
    inset.set_ylim(middle[1] - half * size[1], middle[1] + half * size[1])
    _draw_lines(inset, panel, truth, axes)
    inset.set_xticks([])
    inset.set_yticks([])
    note = f"path, {_INSET / (2 * half):.0f} times"
    inset.text(0.03, 0.97, note, fontsize=8, color=INK, ha="left", va="top", transform=inset.transAxes)
    plot.indicate_inset_zoom(inset, edgecolor=INK, alpha=0.6)


def _limits(plot: Axes, tracks: list[np.ndarray], axes: tuple[int, int], ratio: float, points: np.ndarray) -> None:
    """Set limits around the trajectories and the nearer half of the map: with its far points the path would be
    invisibly small, and without any the map of a camera that moves little would lie outside."""
    if not tracks:
        return
    both = np.concatenate(tracks)[:, axes]
    if len(points):
        far = np.linalg.norm(points - (both.min(axis=0) + both.max(axis=0)) / 2, axis=1)
        both = np.concatenate([both, points[far <= np.median(far)]])
    middle, size = (both.min(axis=0) + both.max(axis=0)) / 2, np.ptp(both, axis=0)
    height = 1.2 * max(float(size[1]), float(size[0]) / ratio, 1e-6)
    plot.set_xlim(middle[0] - height * ratio / 2, middle[0] + height * ratio / 2)
    plot.set_ylim(middle[1] - height / 2, middle[1] + height / 2)


def _decorate(plot: Axes, axes: tuple[int, int], unit: str) -> None:
    plot.set_aspect("equal", adjustable="box")
    plot.set_xlabel(f"{'xyz'[axes[0]]} ({unit})", color=INK)
    plot.set_ylabel(f"{'xyz'[axes[1]]} ({unit})", color=INK)
    plot.tick_params(colors=INK, labelsize=9, length=3)
    plot.grid(color=INK, alpha=0.10, lw=0.6)
    plot.set_axisbelow(True)
    for side, spine in plot.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color("#b8bec6")


def _add_title(plot: Axes, title: str, subtitle: str) -> None:
    plot.set_title(_filled(title), loc="left", fontsize=12, fontweight="bold", color=INK, pad=22 if subtitle else 8)
    if subtitle:
        text = literal(subtitle)
        plot.annotate(
            text, (0, 1), (0, 8), xycoords="axes fraction", textcoords="offset points", fontsize=9.5, color=INK
        )


def _filled(title: str) -> str:
    return literal(textwrap.fill(visible(title), _WIDTH))
