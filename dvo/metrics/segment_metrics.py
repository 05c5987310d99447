"""Errors of a trajectory in segments: each in its own world, combined over their frames.

Every world gets an alignment of its own, so cutting a trajectory into pieces lowers its ATE. Three rules limit that. Of
several worlds only those with :data:`SEGMENT_POSES` poses are scored, and at most ``most`` of them, the longest first;
the others are listed, not scored, and :attr:`SegmentMetrics.scored_share` states how much that leaves out. A segment
that stands still is scored against the best fixed position. The number of worlds is part of the result: values of
trajectories with different numbers of worlds are not directly comparable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dvo.core.arguments import checked_arguments
from dvo.data.trajectory import Trajectory
from dvo.metrics import Alignment, Metrics, associate, evaluate, fit_alignment, relative_errors, stands_still, transform
from dvo.odometry.protocol import Segment

SEGMENT_POSES = 10  # matched poses that a world needs to be scored beside others; a Sim(3) has 7 degrees of freedom
FRAMES_PER_WORLD = 100  # of the sequence, for each world that is scored after the first


@dataclass(frozen=True, eq=False)
class World:
    """The segments that share a world and a scale, at the frames that the reference has too.

    Attributes:
        numbers: of the segments, in order of time.
        estimate, reference: ``(M)`` matched frames, camera to world, with the timestamps of the reference.
        labels: ``(M,)`` number of the segment of each frame.
    """

    numbers: tuple[int, ...]
    estimate: Trajectory
    reference: Trajectory
    labels: np.ndarray

    def __len__(self) -> int:
        return len(self.estimate)

    def part(self, number: int) -> tuple[Trajectory, Trajectory]:
        """Estimate and reference of one segment."""
        rows = self.labels == number
        return rows_of(self.estimate, rows), rows_of(self.reference, rows)

    def pairs(self, gap: int) -> np.ndarray:
        """``(M - gap,)`` bool: frames ``i`` and ``i + gap`` belong to the same segment."""
        return self.labels[:-gap] == self.labels[gap:]


@dataclass(frozen=True)
class SegmentMetrics:
    """Errors of a trajectory in segments.

    Attributes:
        metrics: combined: ATE over the frames of the scored worlds, in percent of their path; RPE over the pairs within
            the segments; ``matched`` and ``completeness`` over all segments; ``scale`` and ``scale_drift`` of the
            longest world.
        segments: of each segment, aligned with its world; ``completeness`` is its share of all frames.
        scored: for each segment, whether it counts for the ATE.
        worlds: number of worlds.
        scored_share: share of the matched frames that lie in scored worlds; nan without any.
    """

    metrics: Metrics
    segments: tuple[Metrics, ...]
    scored: tuple[bool, ...]
    worlds: int
    scored_share: float


def worlds_of(segments: Sequence[Segment]) -> list[tuple[int, ...]]:
    """Numbers of the segments that share a world, world by world in order of their first segment.

    Args:
        segments: of a result.

    Example:
        >>> one = Trajectory(np.zeros(1), np.array([[0.0, 0, 0, 0, 0, 0, 1]]))
        >>> worlds_of([Segment(one, 0.0, 0.0), Segment(one, 0.0, 0.0), Segment(one, 0.0, 0.0, joined_to=0)])
        [(0, 2), (1,)]
    """
    roots = []
    for number in range(len(segments)):
        root, seen = number, {number}
        while (above := segments[root].joined_to) is not None and 0 <= above < len(segments) and above not in seen:
            root = above
            seen.add(root)
        roots.append(root)
    return [tuple(n for n, other in enumerate(roots) if other == root) for root in dict.fromkeys(roots)]


def match_worlds(segments: Sequence[Segment], reference: Trajectory, max_dt: float = 0.01) -> list[World]:
    """Match the frames of all segments with a reference, each frame of the reference at most once.

    Poses that are not finite are left out.

    Args:
        segments: of a result.
        reference: camera to world, seconds.
        max_dt: largest difference of matched timestamps, seconds.

    Returns:
        The worlds, those without a matched frame included.
    """
    labels = np.concatenate([np.zeros(0, np.int64), *(np.full(len(s), n) for n, s in enumerate(segments))])
    rows = Trajectory(
        np.concatenate([np.zeros(0), *(s.trajectory.timestamps for s in segments)]),
        np.concatenate([np.zeros((0, 7)), *(s.trajectory.poses_wc for s in segments)]),
    )
    finite = np.isfinite(rows.poses_wc).all(axis=1)
    labels, rows = labels[finite], rows_of(rows, finite)
    i, j = associate(rows, reference, max_dt)
    order = np.argsort(reference.timestamps[j], kind="stable")
    i, j = i[order], j[order]
    found = []
    for numbers in worlds_of(segments):
        mine = np.isin(labels[i], numbers)
        stamps = reference.timestamps[j[mine]]
        found.append(
            World(
                numbers,
                Trajectory(stamps, rows.poses_wc[i[mine]]),
                Trajectory(stamps, reference.poses_wc[j[mine]]),
                labels[i[mine]],
            )
        )
    return found


def scored_worlds(worlds: Sequence[World], most: int | None = None) -> list[World]:
    """Worlds that count for the ATE: the longest ones, :data:`SEGMENT_POSES` poses or more; a single one always.

    Args:
        worlds: of a result.
        most: largest number of worlds; None for any.

    Returns:
        The worlds, the one with the most frames first.
    """
    if len(worlds) == 1:
        return list(worlds)
    ranked = sorted(worlds, key=len, reverse=True)
    return [world for world in ranked if len(world) >= SEGMENT_POSES][:most]


def most_worlds(frames: int, gaps: int = 0) -> int:
    """Number of worlds of a run that are scored: one, one more for each gap, and one more for every hundred frames.

    Args:
        frames: number of frames that were fed.
        gaps: number of stretches of frames without a view.
    """
    return 1 + gaps + frames // FRAMES_PER_WORLD


@checked_arguments
def evaluate_segments(
    segments: Sequence[Segment],
    reference: Trajectory,
    align: Alignment = "sim3",
    *,
    rpe_gap: int = 1,
    max_dt: float = 0.01,
    most: int | None = None,
) -> SegmentMetrics:
    """Compare a trajectory in segments with a reference, each world aligned on its own.

    Of a single segment, the values are those of :func:`dvo.metrics.evaluate`.

    Args:
        segments: of a result (:attr:`dvo.odometry.protocol.Result.segments`).
        reference: ground truth, camera to world ``T_wc``, metres.
        align: transformation to fit to each world first: ``none``, ``scale``, ``se3`` or ``sim3``.
        rpe_gap: frame gap of the relative errors; no pair has its frames in two segments.
        max_dt: largest difference of matched timestamps, seconds.
        most: largest number of worlds that are scored, the longest first (:func:`most_worlds`); None for any.

    Returns:
        Combined errors and those of each segment; an undefined value is nan.

    Raises:
        DvoError: an unknown alignment or a gap below 1.

    Example:
        >>> times = np.arange(20.0)
        >>> poses_wc = np.tile([0.0, 0, 0, 0, 0, 0, 1], (20, 1))
        >>> poses_wc[:, 0], poses_wc[:, 1] = times, np.sin(times)
        >>> truth = Trajectory(times, poses_wc)
        >>> half = poses_wc * [0.5, 0.5, 0.5, 1, 1, 1, 1]
        >>> parts = [Trajectory(times[:10], poses_wc[:10]), Trajectory(times[10:], half[10:])]
        >>> found = evaluate_segments([Segment(p, p.timestamps[0], p.timestamps[-1]) for p in parts], truth)
        >>> round(found.metrics.ate_rmse, 6), [round(one.scale, 6) for one in found.segments]
        (0.0, [1.0, 2.0])
    """
    if len(segments) < 2:
        estimate = segments[0].trajectory if segments else Trajectory(np.zeros(0), np.zeros((0, 7)))
        whole = evaluate(estimate, reference, align, rpe_gap=rpe_gap, max_dt=max_dt)
        count = len(segments)
        share = 1.0 if whole.matched else float("nan")
        return SegmentMetrics(whole, (whole,) * count, (True,) * count, count, share)
    worlds = match_worlds(segments, reference, max_dt)
    scored = scored_worlds(worlds, most)
    matched = sum(map(len, worlds))
    numbers = {number for world in scored for number in world.numbers}
    parts: dict[int, Metrics] = {}
    for world in worlds:
        parts |= _of_segments(world, len(reference), align, rpe_gap)
    return SegmentMetrics(
        metrics=_combine(worlds, scored, len(reference), align, rpe_gap),
        segments=tuple(parts[number] for number in range(len(segments))),
        scored=tuple(number in numbers for number in range(len(segments))),
        worlds=len(worlds),
        scored_share=sum(map(len, scored)) / matched if matched else float("nan"),
    )


def fit_world(
    estimate: np.ndarray, reference: np.ndarray, align: Alignment
) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Alignment of the positions of a world; None where the reference stands still, or there is no position.

    An estimate that stands still has no scale and no rotation; it is placed where it fits best.

    Args:
        estimate, reference: ``(M, 3)`` positions.
        align: transformation to fit.

    Returns:
        Scale, rotation ``(3, 3)`` and translation ``(3,)``.
    """
    if align == "none":
        return fit_alignment(estimate, reference, align) if len(estimate) else None
    if not len(estimate) or stands_still(reference):
        return None
    if stands_still(estimate):
        shift = reference.mean(axis=0) - estimate.mean(axis=0) if align != "scale" else np.zeros(3)
        return 1.0, np.eye(3), shift
    return fit_alignment(estimate, reference, align)


def rows_of(trajectory: Trajectory, rows: np.ndarray) -> Trajectory:
    """Some rows of a trajectory, by index or mask."""
    return Trajectory(trajectory.timestamps[rows], trajectory.poses_wc[rows])


def _combine(worlds: list[World], scored: list[World], frames: int, align: Alignment, gap: int) -> Metrics:
    squares, turns, turned, moves, path = [], [], [], [], 0.0
    for world in worlds:
        fitted = fit_world(world.estimate.positions, world.reference.positions, align) if world in scored else None
        if fitted is not None:
            scale, rotation, shift = fitted
            off = scale * world.estimate.positions @ rotation.T + shift - world.reference.positions
            squares.append((off**2).sum(axis=1))
            path += sum(world.part(number)[1].path_length for number in world.numbers)
        both = world.pairs(gap)
        errors, true_turns, wrong = relative_errors(
            world.estimate.poses_wc, world.reference.poses_wc, gap, 1.0 if fitted is None else fitted[0]
        )
        turns.append(errors[both])
        turned.append(true_turns[both])
        if fitted is not None:
            moves.append(wrong[both])
    longest = max(worlds, key=len)
    whole = evaluate(longest.estimate, longest.reference, align, rpe_gap=gap)
    return combined_metrics(
        whole, frames=frames, matched=sum(map(len, worlds)), path=path, squares=squares, turns=turns, turned=turned,
        moves=moves, reason=skipped_reason(worlds, scored),
    )  # fmt: skip


def combined_metrics(
    whole: Metrics,
    *,
    frames: int,
    matched: int,
    path: float,
    squares: Sequence[np.ndarray],
    turns: Sequence[np.ndarray],
    turned: Sequence[np.ndarray],
    moves: Sequence[np.ndarray],
    reason: str,
) -> Metrics:
    """Metrics from the errors of several worlds.

    Args:
        whole: of the longest world; gives the alignment, the gap, the scale and its drift.
        frames: of the reference.
        matched: frames of all segments.
        path: of the scored worlds, metres.
        squares: squared distances of the aligned frames of each scored world, metres squared.
        turns, turned: relative rotation errors and relative rotations of each world, degrees.
        moves: relative translation errors of each scored world, metres.
        reason: what was left out; empty if nothing was.
    """
    off, turn, move = (np.concatenate([np.zeros(0), *parts]) for parts in (squares, turns, moves))
    rotation = float(np.concatenate([np.zeros(0), *turned]).sum())
    nan = float("nan")
    ate = float(np.sqrt(off.mean())) if len(off) else nan
    return replace(
        whole,
        ate_rmse=ate,
        ate_percent=100 * ate / path if path > 0 else nan,
        rpe_trans=float(np.median(move)) if len(move) else nan,
        rpe_trans_rmse=float(np.sqrt((move**2).mean())) if len(move) else nan,
        rpe_rot_deg=float(np.median(turn)) if len(turn) else nan,
        rpe_rot_deg_rmse=float(np.sqrt((turn**2).mean())) if len(turn) else nan,
        rotation_error_ratio=float(turn.sum()) / rotation if rotation > 1e-9 else nan,
        matched=matched,
        reference_frames=frames,
        completeness=matched / frames if frames else nan,
        path_length=path,
        reason=reason or None,
    )


def skipped_reason(worlds: Sequence[World], scored: Sequence[World]) -> str:
    """Sentence on the worlds that are not scored; empty if all are."""
    left = [len(world) for world in worlds if world not in scored]
    if not left:
        return ""
    return f"{len(left)} of {len(worlds)} segments not scored ({sum(left)} of {sum(map(len, worlds))} poses)"


def _of_segments(world: World, frames: int, align: Alignment, gap: int) -> dict[int, Metrics]:
    """Metrics of each segment of a world, by number."""
    shared: dict[str, int | float] = {"reference_frames": frames}
    fitted = fit_world(world.estimate.positions, world.reference.positions, align) if len(world.numbers) > 1 else None
    found = {}
    for number in world.numbers:
        estimate, reference = world.part(number)
        if fitted is None:
            metrics = evaluate(estimate, reference, align, rpe_gap=gap)
        else:
            placed = evaluate(transform(estimate, *fitted), reference, "none", rpe_gap=gap)
            metrics = replace(placed, alignment=align, scale=fitted[0])
        share = {"completeness": metrics.matched / frames if frames else float("nan")}
        found[number] = replace(metrics, **shared, **share)  # type: ignore[arg-type]
    return found
