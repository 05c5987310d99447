"""The figures of the report, as small SVG texts: tracks, errors over time, spread over an axis, error against speed.

A system keeps its colour, line and marker from figure to figure. Colours are Okabe and Ito's, which people with any
colour vision tell apart; line and marker tell it once more.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.metrics import align_trajectory, associate, relative_rotation_errors
from dvo.metrics.segment_metrics import World, match_worlds, scored_worlds
from dvo.odometry.protocol import Segment
from dvo.viz.plot import INK, PAPER, literal, plan_axes, with_gaps
from eval.scoring.metric_table import METRICS
from eval.scoring.summary import quartiles
from eval.suites.suite import Suite

OURS = "#d55e00"
PALETTE = ("#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#5b4a3f", "#8c6bb1", "#333333")
NULL_COLOR, TRUTH_COLOR = "#8a8f98", "#c3c9d1"
LINES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (3, 1, 1, 1)), (0, (1, 1)))
MARKERS = "osD^vP*X"
RING: dict[str, Any] = {"mfc": PAPER, "ms": 7, "mew": 1.8, "zorder": 6}  # start of a segment after the first
GAP_STEPS = 4  # median steps of time that are a gap in a curve
MOST_POINTS = 400  # of a curve
LOG_SPREAD = 8.0  # largest over smallest typical error, from which an axis is logarithmic


@dataclass(frozen=True)
class Style:
    """Colour, line and marker of a system."""

    color: str
    line: Any = "-"
    marker: str = "o"
    width: float = 1.5


def styles(systems: Sequence[str]) -> dict[str, Style]:
    """A style for each system: ours in vermilion, the null system in grey, the rest in turn."""
    found: dict[str, Style] = {}
    ours = others = 0
    for name in systems:
        if name == "null":
            found[name] = Style(NULL_COLOR, (0, (2, 2)), "|", 1.3)
        elif name.startswith("dvo"):
            found[name] = Style(OURS, LINES[ours % len(LINES)], MARKERS[ours % len(MARKERS)], 2.0)
            ours += 1
        else:
            line = LINES[(others // len(PALETTE)) % len(LINES)]
            found[name] = Style(PALETTE[others % len(PALETTE)], line, MARKERS[(others + 1) % len(MARKERS)])
            others += 1
    return found


def plot_sequence(
    suite: Suite,
    judged_by: str,
    groundtruth: Trajectory,
    estimates: Mapping[str, Sequence[Segment]],
    dark: Sequence[Sequence[float]] = (),
) -> str:
    """Plan view (the plane of ground truth's two longest axes) and error over time.

    A segment with a world of its own is aligned on its own. Where one begins after another, it has a ring; those too
    short to be scored are counted in the legend, not drawn.

    Args:
        suite: alignment and frame gap.
        judged_by: field of the row; decides which error is drawn.
        groundtruth: camera to world, metres.
        estimates: segments by the name in the legend; aligned here by the alignment of the suite.
        dark: stretches without light, shaded.
    """
    figure = _figure(10.4, 4.3)
    plan, error = figure.subplots(1, 2, width_ratios=(1.1, 1))
    first, second = plan_axes(groundtruth.positions)
    start = groundtruth.timestamps[0]
    shown = _thin(groundtruth.positions)
    plan.plot(*shown[:, [first, second]].T, color=TRUTH_COLOR, lw=4.5, label="ground truth", solid_capstyle="round")
    plan.plot(*groundtruth.positions[0, [first, second]], "o", color=INK, ms=6, zorder=5)
    by_rotation = METRICS[judged_by].unit == "°"
    typical = []
    for name, style in styles(list(estimates)).items():
        look: dict[str, Any] = {"color": style.color, "lw": style.width, "ls": style.line}
        worlds = match_worlds(estimates[name], groundtruth)
        tracks = drawn_tracks(estimates[name], worlds)
        if not tracks:
            plan.plot([], [], **look, label=literal(f"{name}: no trajectory"))
            continue
        left_out = "" if len(worlds) == 1 else f" ({len(worlds)} segments{_left_out(len(worlds) - len(tracks))})"
        label = literal(f"{name}{left_out}")
        medians = []
        for position, track in enumerate(tracks):
            aligned = align_trajectory(track, groundtruth, suite.alignment)
            plan.plot(*_thin(with_gaps(aligned))[:, [first, second]].T, **look, label="" if position else label)
            if by_rotation:
                stamps, values = relative_rotation_errors(track, groundtruth, suite.rpe_gap)
            else:
                i, j = associate(aligned, groundtruth)
                stamps = aligned.timestamps[i]
                values = np.linalg.norm(aligned.positions[i] - groundtruth.positions[j], axis=1)
            if len(values):
                medians.append(values)
                curve = with_breaks(_thin(np.column_stack([stamps - start, values])))
                error.plot(*curve.T, **{**look, "lw": style.width * 0.8})
            if position:
                plan.plot(*aligned.positions[0, [first, second]], "o", color=style.color, **RING)
                if len(values):
                    error.plot(stamps[0] - start, values[0], "o", color=style.color, **RING)
        if medians:
            typical.append(float(np.median(np.concatenate(medians))))
    _frame(plan, groundtruth.positions[:, [first, second]])
    plan.set_xlabel(f"{'xyz'[first]} (m)")
    plan.set_ylabel(f"{'xyz'[second]} (m)")
    _title(plan, f"Plan view, alignment {suite.alignment}")
    error.set_xlabel("time (s)")
    _title(error, f"Rotation error over {suite.rpe_gap} frames (°)" if by_rotation else "Position error (m)")
    for begin, end in dark:
        error.axvspan(begin - start, end - start, color=INK, alpha=0.15, lw=0)
    positive = [value for value in typical if value > 0]
    if positive and max(positive) / min(positive) > LOG_SPREAD:
        error.set_yscale("log")
        error.set_ylim(bottom=min(positive) / 10)
    else:
        error.set_ylim(bottom=0)
    _tidy(plan, error)
    figure.legend(loc="outside lower center", ncols=6, frameon=False, fontsize=9)
    return _svg(figure)


def drawn_tracks(segments: Sequence[Segment], worlds: Sequence[World]) -> list[Trajectory]:
    """Rows of each world that is drawn, in order of time: those that are long enough to be scored.

    Args:
        segments: of a run.
        worlds: of them, see :func:`dvo.metrics.segment_metrics.match_worlds`.
    """
    tracks = []
    for world in scored_worlds(worlds):
        parts = [segments[number].trajectory for number in world.numbers]
        poses = np.concatenate([part.poses_wc for part in parts])
        if len(poses) >= 2:
            tracks.append(Trajectory(np.concatenate([part.timestamps for part in parts]), poses))
    return sorted(tracks, key=lambda track: track.timestamps[0])


def plot_axis(title: str, unit: str, values: Mapping[str, Sequence[float]], null: float) -> str:
    """Every run of an axis as a dot, a box from quartile to quartile, the median as a bar; failed runs at the edge.

    Args:
        values: by system, infinite for a failed run.
        null: median of the null system, drawn as the zero line; nan without one.
    """
    figure = _figure(5.1, 0.62 + 0.27 * max(len(values), 2))
    plot = figure.subplots()
    names = list(values)
    finite = [value for group in values.values() for value in group if math.isfinite(value) and value > 0]
    low, high = (min(finite), max(finite)) if finite else (0.1, 1.0)
    edge = high * (high / low) ** 0.12 * 1.15
    look = styles(names)
    for row, name in enumerate(names):
        group = np.array(list(values[name]), dtype=float)
        known = group[np.isfinite(group)]
        box = quartiles(values[name])
        if box is not None:
            left, middle, right = box
            plot.plot([left, right], [row, row], color=look[name].color, lw=7, alpha=0.3, solid_capstyle="butt")
            plot.plot(known, np.full(len(known), row), look[name].marker, color=look[name].color, ms=4.5, alpha=0.75)
            plot.plot([middle, middle], [row - 0.33, row + 0.33], color=look[name].color, lw=2.4)
        failed = int(np.isinf(group).sum())
        if failed:
            plot.plot(edge, row, "x", color=INK, ms=6, mew=1.6, clip_on=False)
            plot.annotate(f" {failed} failed", (edge, row), xytext=(5, 0), textcoords="offset points", fontsize=8,
                          va="center", annotation_clip=False)  # fmt: skip
        elif not len(group):
            plot.annotate("no runs", (edge, row), fontsize=8, va="center", ha="center", color=NULL_COLOR)
    if math.isfinite(null) and null > 0:
        plot.axvline(null, color=NULL_COLOR, ls=(0, (2, 2)), lw=1.3, zorder=0)
    plot.set_xscale("log")
    plot.set_xlim(low / 1.25, edge * 1.06)
    plot.set_ylim(len(names) - 0.4, -0.6)
    plot.set_yticks(range(len(names)), [literal(name) for name in names], fontsize=9)
    plot.xaxis.set_major_formatter(_number)
    plot.xaxis.set_minor_formatter(_one_two_five if high / low < 30 else (lambda value, place: ""))
    plot.tick_params(axis="x", which="both", labelsize=8)
    _title(plot, f"{title} ({unit})")
    _tidy(plot)
    return _svg(figure)


def plot_speed(points: Mapping[str, Sequence[tuple[float, float]]], unit: str) -> str:
    """Error against speed, both logarithmic: a small dot for each sequence, a large one for the system's medians.

    Args:
        points: by system, (frames a second, error) of each sequence; infinite errors are left out and counted.
    """
    figure = _figure(7.4, 4.4)
    plot = figure.subplots()
    for name, style in styles(list(points)).items():
        table = np.array([pair for pair in points[name] if all(map(math.isfinite, pair)) and min(pair) > 0])
        lost = len(points[name]) - len(table)
        label = literal(f"{name} ({lost} of {len(points[name])} without a figure)" if lost else name)
        marker = "d" if style.marker == "|" else style.marker
        if not len(table):
            plot.plot([], [], marker, color=style.color, label=label)
            continue
        plot.plot(*table.T, marker, color=style.color, ms=4, alpha=0.35, mew=0)
        plot.plot(*np.median(table, axis=0), marker, color=style.color, ms=10, mec=PAPER, mew=1, ls="none", label=label)
    plot.set_xscale("log")
    plot.set_yscale("log")
    for axis in (plot.xaxis, plot.yaxis):
        axis.set_major_formatter(_number)
        axis.set_minor_formatter(lambda value, place: "")
    plot.set_xlabel("frames a second (right is faster)")
    plot.set_ylabel(f"{unit} (down is better)")
    _tidy(plot)
    figure.legend(loc="outside right center", frameon=False, fontsize=9)
    return _svg(figure)


def _figure(width: float, height: float) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _svg(figure: Any) -> str:
    """The figure as SVG text with its words as text, coordinates to a hundredth, the same bytes each time."""
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "dvo"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    # Within tags alone: the numbers of the axes are words.
    text = re.sub(r"<[^>]*>", lambda tag: re.sub(r"(\d+\.\d\d)\d+", r"\1", tag[0]), buffer.getvalue())
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    return text[text.index("<svg") :]


def _left_out(count: int) -> str:
    return f", {count} too short" if count else ""


def _thin(rows: np.ndarray) -> np.ndarray:
    step = -(-len(rows) // MOST_POINTS)
    return rows[::step] if step > 1 and not np.isnan(rows).any() else rows


def with_breaks(curve: np.ndarray) -> np.ndarray:
    """Break a curve where no frame has a value for a while, so that no line is drawn across the gap.

    Args:
        curve: ``(N, 2)`` rows of time and value.

    Returns:
        The rows, with a row of nan in each gap.
    """
    steps = np.diff(curve[:, 0])
    gaps = np.flatnonzero(steps > GAP_STEPS * np.median(steps)) + 1 if len(steps) else np.zeros(0, int)
    return np.insert(curve, gaps, np.nan, axis=0)


def _frame(plot: Any, truth: np.ndarray) -> None:
    """Limits around the ground truth with room to spare: who leaves it has left the picture."""
    middle, half = (truth.max(axis=0) + truth.min(axis=0)) / 2, 0.75 * np.ptp(truth, axis=0).max() or 1.0
    spread = np.maximum(0.85 * np.ptp(truth, axis=0), 0.45 * half)
    plot.set_xlim(middle[0] - spread[0], middle[0] + spread[0])
    plot.set_ylim(middle[1] - spread[1], middle[1] + spread[1])
    plot.set_aspect("equal")


def _tidy(*plots: Any) -> None:
    for plot in plots:
        plot.grid(color=INK, alpha=0.1, lw=0.6)
        plot.spines[["top", "right"]].set_visible(False)


def _title(plot: Any, text: str) -> None:
    plot.set_title(literal(text), loc="left", fontsize=10.5, color=INK)


def _one_two_five(value: float, place: int) -> str:
    return _number(value, place) if f"{value:e}"[0] in "125" else ""


def _number(value: float, _place: int) -> str:
    return f"{value:g}" if value < 1e5 else f"{value:.0e}"
