"""Table and curves of :mod:`train.studies.study`."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dvo.data.files.output import write_text
from dvo.viz.plot import ACCENT, INK, PAPER, START, TRUTH
from train.studies.config import StudyConfig

COLOURS = (TRUTH, ACCENT, START, INK)
WIDTH = 128  # characters of a line of the page


def curves(results: list[dict[str, Any]], arm: str, rate: float, measure: str) -> tuple[np.ndarray, np.ndarray]:
    """Curve of a measure.

    Args:
        results: of :func:`train.studies.study.run_arm`.
        arm, rate: of the runs.
        measure: key of a row.

    Returns:
        steps ``(S,)`` and values ``(seeds, S)``.
    """
    rows = [r["curve"] for r in sorted(results, key=lambda r: r["seed"]) if (r["arm"], r["rate"]) == (arm, rate)]
    steps = np.array([row["step"] for row in rows[0]])
    return steps, np.array([[row[measure] for row in curve] for curve in rows])


def steps_to(steps: np.ndarray, values: np.ndarray, target: float) -> float:
    """First step at which a curve is at or below a value; infinity if never."""
    below = np.flatnonzero(values <= target)
    return float(steps[below[0]]) if len(below) else float("inf")


def table(results: list[dict[str, Any]], config: StudyConfig) -> str:
    """Markdown: error after the last step by arm and rate, the paired difference to the first arm, and the step at
    which the first arm's final error is reached."""
    arms, rates = list(config.arms), list(config.rates)
    judged, *others = config.measures
    labels = [re.sub(r" \(.*\)", "", label) for label in config.measures.values()]
    head = ["learning rate", "arm", f"{labels[0]} after the last step: median [min-max] over seeds", *labels[1:]]
    head += [f"better than {arms[0]}, paired, %", f"steps to {arms[0]}'s final error", "skipped steps"]
    lines = [row_text(head), row_text("---" if name == "arm" else "--:" for name in head)]
    for rate in rates:
        steps, first = curves(results, arms[0], rate, judged)
        for arm in arms:
            _, error = curves(results, arm, rate, judged)
            ends = [curves(results, arm, rate, measure)[1][:, -1] for measure in others]
            end = error[:, -1]
            gain = 100 * (1 - end / first[:, -1])
            reach = [steps_to(steps, mine, theirs) for mine, theirs in zip(error, first[:, -1], strict=True)]
            reached = ", ".join("never" if np.isinf(r) else f"{r:.0f}" for r in reach)
            skipped = sum(r["skipped"] for r in results if (r["arm"], r["rate"]) == (arm, rate))
            cells = [f"{rate:g}", arm, f"{np.median(end):.4f} [{end.min():.4f}-{end.max():.4f}]"]
            cells += [f"{np.median(other):.3f}" for other in ends]
            cells += ["" if arm == arms[0] else _spread(gain), reached, f"{skipped}"]
            lines.append(row_text(cells))
    return "\n".join(lines)


def row_text(cells: Iterable[str]) -> str:
    """Row of a table in Markdown."""
    return f"| {' | '.join(cells)} |"


def _options(options: Mapping[str, Any]) -> str:
    return ", ".join(f"`{name}: {value}`" for name, value in options.items())


def _spread(values: np.ndarray) -> str:
    return f"{np.median(values):+.1f} [{values.min():+.1f}, {values.max():+.1f}]"


def write_report(
    results: list[dict[str, Any]], config: StudyConfig, file: Path = Path("configs/train/study.yaml")
) -> list[Path]:
    """Write ``OUT.md`` and ``OUT.png``.

    Args:
        results: of :func:`train.studies.study.run_arm`.
        config: the study.
        file: that the study was read from.

    Returns:
        the files written.
    """
    out = Path(config.out)
    out.parent.mkdir(parents=True, exist_ok=True)
    picture = out.with_suffix(".png")
    _plot(picture, results, config)
    start = f"{config.start_steps} steps that are shared" if not config.state else f"the state `{config.state}`"
    about = "\n".join(textwrap.fill(line, WIDTH, break_on_hyphens=False) for line in config.about.splitlines())
    own = "".join(f";\nthe clips of `{arm}` have {_options(found)}" for arm, found in config.arm_clips.items())
    seconds = np.mean([r["seconds_a_step"] for r in results])
    text = f"""# {config.title}

{about}
Preset `{config.model}`, clips of {config.frames} frames of {config.size[1]}x{config.size[0]} pixels,
{config.updates} updates, {config.steps} steps of one OneCycle after {start}. For a
seed all arms see the same clips and draw the same random numbers{own}. Errors are taken on {config.validation_clips}
held-out clips. Reproduced by

    python -m train study --config {file.as_posix()}

{table(results, config)}

![validation error against steps]({picture.name})

Lines are medians over {len(config.seeds)} seeds, bands their range. A step took {seconds:.2f} s of the processor.
"""
    report = out.with_suffix(".md")
    write_text(report, text)
    return [report, picture]


def _plot(path: Path, results: list[dict[str, Any]], config: StudyConfig) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    measures = config.measures
    figure = Figure(figsize=(5.2 * len(config.rates), 7.0), dpi=110, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(len(measures), len(config.rates), sharex=True, sharey="row", squeeze=False)
    for row, (measure, label) in enumerate(measures.items()):
        for column, rate in enumerate(config.rates):
            plot = plots[row, column]
            for arm, colour in zip(config.arms, COLOURS, strict=False):
                steps, values = curves(results, arm, rate, measure)
                plot.plot(steps, np.median(values, 0), color=colour, lw=1.8, label=arm)
                plot.fill_between(steps, values.min(0), values.max(0), color=colour, alpha=0.15, lw=0)
            plot.set_yscale("log")
            plot.grid(color=INK, alpha=0.1, lw=0.6, which="both")
            if row == 0:
                plot.set_title(f"learning rate {rate:g}", loc="left", fontsize=11, color=INK)
            else:
                plot.set_xlabel("steps", color=INK)
            if column == 0:
                plot.set_ylabel(label, color=INK)
    plots[0, 0].legend(frameon=False, fontsize=9)
    figure.savefig(path, metadata={"Software": None})
