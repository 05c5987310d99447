"""Figure of the study of the family: learning curves, and recall of relative poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dvo.viz.plot import COLOURS, INK, PAPER, TRUTH
from train.studies.family.records import Records
from train.studies.family.summary import LIMITS, Curve, MemberSummary, learning_curve

LINES = (TRUTH, *COLOURS)


def draw(path: Path, records: Records, found: Sequence[MemberSummary]) -> None:
    """Write the figure, of the same bytes for the same tables.

    Args:
        path: file; its suffix gives the format.
        records: of the study.
        found: members to draw.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.5, 4.4), dpi=110, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    area, rotation, recall = figure.subplots(1, 3)
    names = list(records.config.members)
    for one in found:
        colour = LINES[names.index(one.name) % len(LINES)]
        for plot, column in ((area, "auc_10"), (rotation, "rotation_ratio")):
            curve = learning_curve(records, one.name, column)
            if curve is not None:
                _band(plot, curve, colour)
        errors = np.sort(one.errors)
        share = np.arange(1, len(errors) + 1) / max(len(errors), 1)
        recall.step(np.r_[0, errors], np.r_[0, share], where="post", color=colour, lw=1.6, label=one.name)
    rotation.set_yscale("log")
    recall.set_xlim(0, LIMITS[-1])
    recall.set_ylim(bottom=0)
    recall.legend(frameon=False, fontsize=9)
    titles = {area: "AUC at 10°", rotation: "rotation error / motion", recall: "recall of relative poses"}
    for plot, title in titles.items():
        plot.set_title(title, loc="left", fontsize=11, color=INK)
        plot.grid(color=INK, alpha=0.1, lw=0.6, which="both")
        plot.set_xlabel("error, degrees" if plot is recall else "processor hours", color=INK)
        plot.set_xlim(left=0)
        plot.locator_params(axis="x", nbins=6)
    area.set_ylim(bottom=0)
    with matplotlib.rc_context({"svg.hashsalt": "family"}):
        figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else {"Software": None})


def _band(plot: Any, curve: Curve, colour: str) -> None:
    values = np.ma.masked_invalid(curve.values)
    plot.plot(curve.hours, np.ma.median(values, axis=0), color=colour, lw=1.8, marker="o", ms=2.5)
    plot.fill_between(curve.hours, values.min(0), values.max(0), color=colour, alpha=0.15, lw=0)
