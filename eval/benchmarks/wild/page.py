"""Page with the trajectories of all runs of all videos."""

from __future__ import annotations

import html
from pathlib import Path
from typing import TYPE_CHECKING

from dvo.core.errors import DvoError
from dvo.data.files.output import write_text
from dvo.data.trajectory import Trajectory
from dvo.metrics import align_trajectory
from dvo.viz.plot import Panel, Track, plot_panels
from eval.benchmarks.wild.measures import backward

if TYPE_CHECKING:
    from eval.benchmarks.wild.__main__ import Judged

STYLE = (
    "body{font:15px/1.5 system-ui,sans-serif;margin:2rem;color:#22272e}main{display:grid;gap:2rem;"
    "grid-template-columns:repeat(auto-fill,minmax(26rem,1fr))}figure{margin:0}img{width:100%}pre{overflow:auto}"
)


def write_page(file: Path, judged: list[Judged], table: str) -> None:
    """Write the page, and a picture beside it for each video: the plan of all runs, aligned to the first one.

    Args:
        file: to write.
        judged: videos with their runs.
        table: in Markdown, shown below the pictures.
    """
    figures = []
    for one in judged:
        picture = file.with_name(f"{one.name}.png")
        outcome = ", ".join(one.outcome) or "without a list of what is right"
        plot_panels(picture, [Panel(tuple(_tracks(one)))], title=one.name, subtitle="; ".join(one.faults) or outcome)
        caption = html.escape(f"{one.name}: {outcome}")
        figures.append(f'<figure><img src="{picture.name}" alt="{caption}"><figcaption>{caption}</figcaption></figure>')
    body = f"<h1>Videos without ground truth</h1><main>{''.join(figures)}</main><pre>{html.escape(table)}</pre>"
    text = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Videos</title><style>{STYLE}</style>{body}</html>'
    )
    write_text(file, text)


def _tracks(one: Judged) -> list[Track]:
    tracks: list[Track] = []
    first: Trajectory | None = None
    for key, run in one.runs.items():
        if not len(run.poses):
            continue
        rows = run.trajectory
        if first is None:
            first = rows
        if key.endswith("-backward"):
            rows = backward(rows, float(first.timestamps[0] + first.timestamps[-1]))
        try:
            shown = rows if rows is first else align_trajectory(rows, first, "sim3")
        except DvoError:  # too short, or without motion
            continue
        tracks.append(Track(shown, key.removeprefix(f"{one.name}-"), len(tracks)))
    return tracks
