"""All errors of one run: its segments, aligned world by world, against the reference.

Rules for a run of several segments (:mod:`dvo.metrics.segment_metrics` says how values are combined): cutting a
trajectory lowers its ATE, so only as many worlds are scored as :func:`dvo.metrics.segment_metrics.most_worlds` allows,
the longest first, each of ten poses or more, and a run whose scored part is too small fails
(:func:`eval.scoring.score.score`). Pairs of frames of a relative error never lie in two segments; the relative-pose AUC
counts those in two worlds as missed.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dvo.data.trajectory import Trajectory
from dvo.metrics import Alignment, Metrics, evaluate, transform
from dvo.metrics.relative_pose import join_segments
from dvo.metrics.segment_metrics import (
    SegmentMetrics,
    World,
    evaluate_segments,
    fit_world,
    match_worlds,
    scored_worlds,
)
from dvo.odometry.protocol import Segment
from eval.scoring.blackout import BlackoutErrors, blackout_errors
from eval.scoring.metrics import (
    Aligned,
    PathErrors,
    absolute_rmse,
    align_pair,
    evo_trajectory,
    metrics_of,
    path_errors,
)
from eval.scoring.protocols import SegmentErrors, kitti_errors, per_frame_scale, relative_pose_auc
from eval.suites.suite import Suite


@dataclass(frozen=True)
class Errors:
    """Everything that the segments of a run and their reference give.

    Attributes:
        metrics: ATE, RPE and so on; None without a reference.
        worlds: number of segments, those that share a world counted once.
        scored: share of the matched frames that count for the ATE; nan without any.
        scale_error: percent by which the scale of the longest world is wrong; nan where the alignment fits it.
        shape: ATE after a Sim(3) alignment of each world, metres; nan where the alignment is not SE(3).
    """

    metrics: Metrics | None = None
    path: PathErrors = PathErrors()
    kitti: SegmentErrors = SegmentErrors()
    blackout: BlackoutErrors = BlackoutErrors()
    pose_auc: dict[float, float] = field(default_factory=dict)
    rotation: float = math.nan
    per_frame_scale: float = math.nan
    worlds: int = 0
    scored: float = math.nan
    scale_error: float = math.nan
    shape: float = math.nan


@dataclass(frozen=True)
class Pieces:
    """Segments of a run after the alignment of their worlds.

    Attributes:
        scored: pieces that count for the ATE.
        unscored: the others, not aligned.
        worlds: estimate and reference of the worlds that are scored.
        scaled: estimate and scale of each scored piece.
        whole: the errors that dvo itself finds.
    """

    scored: tuple[Aligned, ...]
    unscored: tuple[Aligned, ...]
    worlds: tuple[tuple[Trajectory, Trajectory], ...]
    scaled: tuple[tuple[Trajectory, float], ...]
    whole: SegmentMetrics


def all_errors(
    segments: Sequence[Segment],
    reference: Trajectory,
    suite: Suite,
    dark: Sequence[Sequence[float]],
    most: int | None = None,
) -> Errors:
    """Compare the segments of a run with the reference of the frames that were fed, under the protocol of a suite.

    Args:
        segments: of the run.
        reference: camera to world, metres and seconds.
        suite: alignment and frame gap.
        dark: stretches without light, see :func:`eval.scoring.blackout.dark_spans`.
        most: largest number of worlds that are scored; None for any.
    """
    align = suite.alignment
    pieces = align_segments(segments, reference, align, rpe_gap=suite.rpe_gap, most=most)
    whole = pieces.whole
    pairs = [align_pair(per_frame_scale(*world), world[1], align) for world in pieces.worlds]
    rescaled = [pair for pair in pairs if isinstance(pair, Aligned)]
    scored = pieces.scored
    return Errors(
        metrics=metrics_of(*scored, unscored=pieces.unscored) if scored else whole.metrics,
        path=path_errors(*scored) if scored else PathErrors(),
        kitti=kitti_errors(pieces.scaled, reference) if scored else SegmentErrors(),
        blackout=blackout_errors(segments, reference, [(begin, end) for begin, end in dark], align),
        pose_auc=_pose_auc(segments, reference, suite.rpe_gap),
        rotation=absolute_rmse(*scored, angle=True) if scored else math.nan,
        per_frame_scale=absolute_rmse(*rescaled) if rescaled else math.nan,
        worlds=whole.worlds,
        scored=whole.scored_share,
        scale_error=_scale_error(pieces, align),
        shape=_shape(pieces, align),
    )


def _scale_error(pieces: Pieces, align: Alignment) -> float:
    """Percent by which lengths of the longest world differ from those of the reference, under SE(3)."""
    if align != "se3" or not pieces.worlds:
        return math.nan
    estimate, reference = max(pieces.worlds, key=lambda world: len(world[0]))
    return 100 * abs(1 / evaluate(estimate, reference, "sim3").scale - 1)


def _shape(pieces: Pieces, align: Alignment) -> float:
    """ATE of the worlds after Sim(3) alignment, the error without that of the scale, metres; nan unless under SE(3)."""
    if align != "se3":
        return math.nan
    pairs = [align_pair(estimate, reference, "sim3") for estimate, reference in pieces.worlds]
    aligned = [pair for pair in pairs if isinstance(pair, Aligned)]
    return absolute_rmse(*aligned) if aligned else math.nan


def align_segments(
    segments: Sequence[Segment],
    reference: Trajectory,
    align: Alignment = "sim3",
    *,
    rpe_gap: int = 1,
    max_dt: float = 0.01,
    most: int | None = None,
) -> Pieces:
    """Align every world with evo, and cut it into its segments.

    Args:
        segments: of a run.
        reference: camera to world, metres and seconds.
        align, rpe_gap, max_dt: see :func:`eval.scoring.metrics.align_pair`.
        most: largest number of worlds that are scored, the longest first; None for any.
    """
    whole = evaluate_segments(segments, reference, align, rpe_gap=rpe_gap, max_dt=max_dt, most=most)
    if len(segments) == 1:
        estimate = segments[0].trajectory
        only = align_pair(estimate, reference, align, rpe_gap=rpe_gap, max_dt=max_dt)
        if not isinstance(only, Aligned):
            return Pieces((), (), ((estimate, reference),), (), whole)
        return Pieces((only,), (), ((estimate, reference),), ((estimate, only.scale),), whole)
    worlds = match_worlds(segments, reference, max_dt)
    chosen = scored_worlds(worlds, most)
    scored: list[Aligned] = []
    unscored: list[Aligned] = []
    scaled: list[tuple[Trajectory, float]] = []
    for world in worlds:
        pair = _place(world, align) if world in chosen else None
        if pair is not None:
            scored += _cut(world, replace(pair, ours=whole.metrics))
            scaled += [(world.part(number)[0], pair.scale) for number in world.numbers]
        elif len(world):
            raw = Aligned(evo_trajectory(world.reference), evo_trajectory(world.estimate), 1.0, whole.metrics)
            unscored += _cut(world, raw)
    return Pieces(
        tuple(scored), tuple(unscored), tuple((w.estimate, w.reference) for w in chosen), tuple(scaled), whole
    )


def _place(world: World, align: Alignment) -> Aligned | None:
    """A world aligned by evo; one that stands still where it fits best; None where the reference stands still."""
    pair = align_pair(world.estimate, world.reference, align)
    if isinstance(pair, Aligned):
        return pair
    fitted = fit_world(world.estimate.positions, world.reference.positions, align)
    if fitted is None:
        return None
    return Aligned(
        evo_trajectory(world.reference),
        evo_trajectory(transform(world.estimate, *fitted)),
        fitted[0],
        evaluate(world.estimate, world.reference, align),
    )


def _cut(world: World, pair: Aligned) -> list[Aligned]:
    """The segments of an aligned world."""
    if len(world.numbers) == 1:
        return [pair]
    cuts = []
    for number in world.numbers:
        rows = np.flatnonzero(world.labels == number)
        if len(rows):
            cuts.append(replace(pair, truth=_some(pair.truth, rows), track=_some(pair.track, rows)))
    return cuts


def _some(trajectory: Any, rows: np.ndarray) -> Any:
    """Some rows of evo's trajectory, a copy."""
    part = copy.deepcopy(trajectory)
    part.reduce_to_ids(rows)
    return part


def _pose_auc(segments: Sequence[Segment], reference: Trajectory, gap: int) -> dict[float, float]:
    rows, labels = join_segments(segments, reference)
    return relative_pose_auc(rows, reference, gap, labels=labels)
