"""Page of a run: one HTML file with a 3-D view, charts over time and tables, which needs no other file and no network.

The view and the charts are drawn by the scripts in ``assets`` from the data in the page. The number of points is
limited, so that the page stays small however long the run is.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from dvo.core.text import in_utf8, visible
from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import quaternion_to_matrix
from dvo.session.frame_table import SKIPPED, FrameRow
from dvo.viz.plot import COLOURS

ASSETS = Path(__file__).resolve().parent / "assets"
MAX_FRAMES, MAX_POINTS, MAX_KEYFRAMES = 2400, 6000, 1500
_DATA = '<script type="application/json" id="data">'
_FAR = 20.0  # points further than this many radii of the trajectory are left out: they would only be specks


@dataclass(frozen=True)
class TrackLine:
    """Trajectory of a segment in a world.

    Attributes:
        trajectory: camera to world.
        segment: its number.
    """

    trajectory: Trajectory
    segment: int


@dataclass(frozen=True)
class World:
    """Things that share a world.

    Attributes:
        name: for the list of worlds.
        tracks: one or more.
        metric: True if lengths are metres.
        truth: ``(M, 3)`` true positions of the camera, nan where unknown.
        points: ``(P, 3)`` map.
        colors: ``(P, 3)`` uint8 RGB of the map.
        loops: ``(L, 2, 3)`` positions of the two visits of each loop.
    """

    name: str
    tracks: tuple[TrackLine, ...]
    metric: bool = False
    truth: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.float32))
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    loops: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 3)))


@dataclass(frozen=True)
class RunPage:
    """Content of the page.

    Attributes:
        title, subtitle: texts at the top.
        verdict: word (``good``, ``doubtful`` or ``failed``) and reason of the verdict; empty without one.
        notices: warnings, a sentence each.
        facts: name and value of the figures at the top.
        tables: HTML of the tables.
        worlds: to choose from; the first is shown.
        rows: of the frames, in order of time.
        errors: ``(N,)`` distance from the true position of each frame, metres, nan where unknown.
        loops: times of the two visits of each loop, seconds.
        images: time (seconds) and JPEG file of some frames, in order of time; small ones.
    """

    title: str
    subtitle: str
    notices: Sequence[str]
    facts: Sequence[tuple[str, str]]
    tables: str
    worlds: Sequence[World]
    rows: Sequence[FrameRow]
    errors: np.ndarray
    loops: Sequence[tuple[float, float]]
    verdict: tuple[str, str] = ("", "")
    images: Sequence[tuple[float, bytes]] = ()


def write_page(path: Path, page: RunPage) -> None:
    """Write the page.

    Args:
        path: file to write.
        page: its content.
    """
    template = Template((ASSETS / "page.html").read_text(encoding="utf-8"))
    scripts = "\n".join((ASSETS / f"{name}.js").read_text(encoding="utf-8") for name in ("view", "charts", "page"))
    facts = (f"<div><dt>{_shown(name)}</dt><dd>{_shown(value)}</dd></div>\n" for name, value in page.facts)
    data = json.dumps(page_data(page), separators=(",", ":"), allow_nan=False)
    text = in_utf8(
        template.substitute(
            title=_shown(page.title),
            subtitle=_shown(page.subtitle),
            verdict=_verdict(*page.verdict),
            notices="".join(f'<p class="notice">{_shown(text)}</p>\n' for text in page.notices),
            facts="".join(facts),
            tables=visible(page.tables, lines=True),
            style=(ASSETS / "page.css").read_text(encoding="utf-8"),
            script=scripts,
            data=data.replace("<", "\\u003c"),  # a text may hold "</script>"
        )
    )
    path.write_text(text, encoding="utf-8")


def _shown(text: str) -> str:
    return escape(visible(text))


def _verdict(word: str, reason: str) -> str:
    if not word:
        return ""
    kind = word if word in ("good", "doubtful", "failed") else "doubtful"
    return f'<p class="verdict {kind}"><strong>verdict: {_shown(word)}</strong> {_shown(reason)}</p>\n'


def read_images(path: Path) -> list[tuple[float, bytes]]:
    """Images of the frames in a page, for one that is written anew.

    Args:
        path: of the page; may be missing.

    Returns:
        As ``images`` of :class:`RunPage`; none of what is not a page of a run, or has none.
    """
    try:
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        data = json.loads(text.split(_DATA, 1)[1].split("</script>", 1)[0])
        start = float(data["start"])
        found = [(start + float(time), base64.b64decode(jpeg, validate=True)) for time, jpeg in data["images"]]
    except (OSError, ValueError, LookupError, TypeError):
        return []
    return [(time, jpeg) for time, jpeg in found if math.isfinite(time) and jpeg.startswith(b"\xff\xd8")]


def page_data(page: RunPage) -> dict[str, Any]:
    """Data that the scripts draw.

    Args:
        page: content of the page.

    Returns:
        Plain JSON values; arrays as base64 text of little-endian float32. Times are seconds since the first frame.
    """
    start = page.rows[0].timestamp if page.rows else 0.0
    keyframes = np.array([row.timestamp for row in page.rows if row.keyframe])
    return {
        "start": start,
        "frames": _frames(page.rows, page.errors, start),
        "states": _states(page.rows, start),
        "ribbons": _ribbons(page.rows, start),
        "keyframes": encode(keyframes[:: _every(len(keyframes), MAX_KEYFRAMES)] - start),
        "loops": [[new - start, old - start] for new, old in page.loops],
        "images": [[round(time - start, 6), base64.b64encode(jpeg).decode("ascii")] for time, jpeg in page.images],
        "worlds": [_world(world, keyframes, start) for world in page.worlds],
    }


def encode(values: np.ndarray) -> str:
    """Base64 text of an array as little-endian float32, or of bytes.

    Args:
        values: of any shape, uint8 for bytes.

    Returns:
        The text.
    """
    kind = "u1" if values.dtype == np.uint8 else "<f4"
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode("ascii")


def colour_of(segment: int | None) -> int:
    """Number of the colour of a segment; -1 for no segment."""
    return -1 if segment is None else segment % len(COLOURS)


def _every(count: int, limit: int) -> int:
    return max(1, math.ceil(count / limit))


def _frames(rows: Sequence[FrameRow], errors: np.ndarray, start: float) -> dict[str, Any]:
    """Curves; of a long run, the largest value of several frames."""
    every = _every(len(rows), MAX_FRAMES)
    seconds = np.array([np.nan if row.seconds is None else row.seconds for row in rows])
    chosen = rows[::every]
    return {
        "count": len(rows),
        "every": every,
        "time": encode(np.array([row.timestamp - start for row in chosen])),
        "seconds": encode(_largest(seconds, every)),
        "error": encode(_largest(errors, every)),
        "segment": encode(np.array([-1 if row.segment is None else row.segment for row in chosen])),
        "colour": encode(np.array([colour_of(row.segment) for row in chosen])),
        "fed": encode(np.array([row.status != SKIPPED for row in chosen])),
    }


def _largest(values: np.ndarray, every: int) -> np.ndarray:
    padded = np.concatenate([values, np.full(-len(values) % every, np.nan)]).reshape(-1, every)
    known = np.isfinite(padded)
    return np.where(known.any(axis=1), np.where(known, padded, -np.inf).max(axis=1), np.nan)


def _states(rows: Sequence[FrameRow], start: float) -> list[list[Any]]:
    """Start, end, status, reason and number of frames of each stretch of equal frames; skipped frames follow others."""
    found: list[list[Any]] = []
    for row in rows:
        if found and (row.status == SKIPPED or (row.status, row.reason) == (found[-1][2], found[-1][3])):
            found[-1][4] += 1
        else:
            if found:
                found[-1][1] = row.timestamp - start
            found.append([row.timestamp - start, None, row.status, row.reason, 1])
    if found:
        found[-1][1] = rows[-1].timestamp - start
    return found


def _ribbons(rows: Sequence[FrameRow], start: float) -> list[list[Any]]:
    """Start, end, number and colour of each stretch of one segment without a frame that has no pose."""
    found: list[list[Any]] = []
    last: int | None = None
    for row in rows:
        if row.segment is not None and row.segment == last:
            found[-1][1] = row.timestamp - start
        elif row.segment is not None:
            found.append([row.timestamp - start, row.timestamp - start, row.segment, colour_of(row.segment)])
        last = row.segment
    return found


def _world(world: World, keyframes: np.ndarray, start: float) -> dict[str, Any]:
    positions = np.concatenate([np.zeros((0, 3)), *(track.trajectory.positions for track in world.tracks)])
    truth = world.truth[:: _every(len(world.truth), MAX_FRAMES)]
    known = np.isfinite(truth).all(axis=1)
    extent = np.concatenate([positions, truth[known]])
    centre = (extent.min(axis=0) + extent.max(axis=0)) / 2 if len(extent) else np.zeros(3)
    reach = float(np.linalg.norm(extent - centre, axis=1).max()) if len(extent) else 1.0
    points, colors = _near_points(world, centre, reach)
    if len(points):  # the view holds the path and the nearer half of the map
        far = np.linalg.norm(points - centre, axis=1)
        shown = np.concatenate([extent, points[far <= np.median(far)]])
        centre = (shown.min(axis=0) + shown.max(axis=0)) / 2
        reach = float(np.linalg.norm(shown - centre, axis=1).max())
    reach = max(reach, 1e-6)
    basis = view_basis(world.tracks, extent - centre)
    total = sum(len(track.trajectory) for track in world.tracks)
    rows = [row for track in world.tracks for row in _keyframe_positions(track.trajectory, keyframes)]
    return {
        "name": world.name,
        "unit": "m" if world.metric else "",
        "centre": centre.tolist(),
        "radius": reach,
        "basis": basis.ravel().tolist(),
        "grid": _grid((extent - centre) @ basis.T, reach),
        "tracks": [_track(track, start, _every(total, MAX_FRAMES)) for track in world.tracks],
        "truth": encode(truth[known]),
        "truthStarts": _starts(known),
        "points": encode(points),
        "colors": encode(colors),
        "keyframes": encode(np.array(rows[:: _every(len(rows), MAX_KEYFRAMES)])),
        "loops": encode(world.loops),
    }


def _near_points(world: World, centre: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    points = np.asarray(world.points, float)
    far = np.linalg.norm(points - centre, axis=1)
    finite = np.isfinite(far)
    middle = float(np.median(far[finite])) if finite.any() else 0.0
    keep = np.flatnonzero(finite & (far < _FAR * max(reach, middle / 4)))
    keep = keep[:: _every(len(keep), MAX_POINTS)]
    return points[keep], world.colors[keep]


def _starts(known: np.ndarray) -> list[int]:
    """Numbers of the known rows that follow an unknown one."""
    return (np.flatnonzero(np.diff(np.flatnonzero(known)) > 1) + 1).tolist()


def _track(track: TrackLine, start: float, every: int) -> dict[str, Any]:
    times = track.trajectory.timestamps
    steps = np.diff(times)
    gaps = np.flatnonzero(steps > 5 * np.median(steps)) + 1 if len(steps) else np.zeros(0, int)
    chosen = np.union1d(np.arange(0, len(times), every), [len(times) - 1] if len(times) else []).astype(int)
    return {
        "segment": track.segment,
        "colour": colour_of(track.segment),
        "time": encode(times[chosen] - start),
        "poses": encode(track.trajectory.poses_wc[chosen]),
        "starts": sorted({int(k) for k in np.searchsorted(chosen, gaps)}),
    }


def _keyframe_positions(trajectory: Trajectory, keyframes: np.ndarray) -> list[np.ndarray]:
    rows = np.flatnonzero(np.isin(np.round(trajectory.timestamps, 6), np.round(keyframes, 6)))
    return [trajectory.positions[row] for row in rows]


def view_basis(tracks: Sequence[TrackLine], extent: np.ndarray) -> np.ndarray:
    """Axes of the view: up is where the images are up on average, and the path is widest from left to right.

    Args:
        tracks: of a world.
        extent: ``(N, 3)`` positions relative to a centre.

    Returns:
        ``(3, 3)`` orthonormal rows right, forward, up in the world.
    """
    upward = [-quaternion_to_matrix(q)[:, 1] for track in tracks for q in track.trajectory.poses_wc[::10, 3:]]
    up = np.sum(upward, axis=0) if upward else np.array([0.0, -1, 0])
    length = float(np.linalg.norm(up))
    up = up / length if length > 1e-6 else np.array([0.0, -1, 0])
    flat = extent - np.outer(extent @ up, up)
    right = np.linalg.svd(flat, full_matrices=False)[2][0] if len(flat) >= 3 else np.array([1.0, 0, 0])
    right = right - up * (right @ up)
    if np.linalg.norm(right) < 0.5:  # nothing is wide: any direction across
        other = np.eye(3)[int(np.argmin(np.abs(up)))]
        right = other - up * (other @ up)
    right = right / np.linalg.norm(right)
    if right[int(np.argmax(np.abs(right)))] < 0:  # a sign that does not depend on rounding
        right = -right
    return np.stack([right, np.cross(up, right), up])


def _grid(scene: np.ndarray, reach: float) -> dict[str, Any]:
    """Grid under the path, in coordinates of the view: its step, cells to each side, height and middle."""
    raw = reach / 4
    power = 10.0 ** math.floor(math.log10(raw))
    step = power * next(factor for factor in (1, 2, 5, 10) if factor * power >= raw * 0.999)
    low = float(scene[:, 2].min()) if len(scene) else 0.0
    middle = (scene[:, :2].min(axis=0) + scene[:, :2].max(axis=0)) / 2 if len(scene) else np.zeros(2)
    return {
        "step": float(f"{step:.3g}"),
        "cells": 6,
        "height": low - 0.15 * reach,
        "x": float(middle[0]),
        "y": float(middle[1]),
    }
