"""What a verdict on a result rests on (:mod:`dvo.odometry.quality`), measured when a sequence has ended."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from dvo.geometry import se3, so3
from dvo.geometry.projection import reproject
from dvo.map.map import Map
from dvo.map.recordings import increasing_times
from dvo.odometry.checks.check_pairs import (
    CheckPair,
    CheckPairs,
    epipolar_distances,
    median_displacement,
    relief,
    turn_parallax,
)
from dvo.odometry.checks.floating_crop import looked_at, shift_gain
from dvo.odometry.global_ba.rolling_shutter import PoseTrack, Shutter, as_global_shutter
from dvo.odometry.protocol import Result
from dvo.odometry.quality import Quality, judge
from dvo.odometry.window.pose_validation import AGREEMENT, CONFIDENT

FIELDS = (4, 3)
"""Fields of the image, across and down, in which the spread of the measurements is counted."""
NEAR_LINE = 1.0
"""Distance of a corner from its epipolar line that agrees, pixels."""
ROLLING_SHARE = 0.5
"""Share that counts of what shifts explain under a rolling shutter, whose correction for corners is approximate."""
STANDING = 0.1
"""Speed over the median one below which a camera stands."""
MOST_RELIEFS = 32
"""Pairs whose relief is measured, evenly over the sequence."""
MOST_TURNS = 8
"""The same of those that a turn of the camera is fitted to."""
JUMP = 6.0
"""Length of a step over those before and after, the longer of their medians, and over the median of all, of a jump."""
JUMP_STEPS = 5
"""Steps before and after: a few poses in a row that are astray do not hide each other."""

_Placed = tuple[CheckPair, np.ndarray, np.ndarray]


def measure_quality(
    graph: Map,
    result: Result,
    segments: Collection[int],
    checks: CheckPairs,
    *,
    stride: int,
    shutter: Shutter,
    first: float | None,
    fixed: float,
) -> Quality:
    """Measure what a result rests on, and find the verdict.

    Args:
        graph: everything is archived and adjusted.
        result: of its last recording.
        segments: numbers of those that were initialised.
        checks: measurements that have no part in the poses.
        stride: of the feature maps, pixels of the working image.
        shutter: of the camera, or as it was estimated.
        first: timestamp of the first measured pose; None if there is none.
        fixed: share of the image that was left out as fixed to the camera.

    Returns:
        The quality.
    """
    cause = next((found.reason for found in result.breaks if found.reason), "")
    quality = Quality("failed", initialised_at=first, fixed=fixed, jumps=count_jumps(result))
    if len(result.trajectory):
        seen = len(result.trajectory) - int(np.isin(result.trajectory.timestamps, result.inertial).sum())
        quality = replace(quality, tracked=seen / max(result.frames_read, 1))
    found = [
        part for segment in sorted({graph.world_of(k) for k in segments}) if (part := _inliers(graph, segment, shutter))
    ]
    if found:
        total = np.array([part[0] for part in found]).sum(0)
        longest = max(found, key=lambda part: part[0][0])
        agreement = float(total[2] / total[1]) if total[1] else float("nan")
        residual = float(np.median(np.concatenate([part[1] for part in found]))) * stride if total[1] else float("nan")
        quality = replace(
            quality, inliers=float(total[2] / total[0]), agreement=agreement, residual=residual, spread=longest[2]
        )
    placed = list(_placed(graph, checks.pairs))
    pairs = [(epipolar_distances(pair, *poses), median_displacement(pair.points)) for pair, *poses in placed]
    if pairs:
        distances = np.concatenate([away for away, _ in pairs])
        deviation = float(np.median(np.concatenate([away / moved for away, moved in pairs])))
        agreed = float((distances < NEAR_LINE).mean())
        quality = replace(quality, checks=len(pairs), deviation=deviation, check=agreed)
        quality = replace(quality, crop=_shift_gain(graph, placed, shutter, stride))
        some = placed[:: math.ceil(len(placed) / MOST_RELIEFS)]
        reliefs = [value for pair, *poses in some if not math.isnan(value := relief(pair, *poses))]
        quality = replace(quality, relief=float(np.median(reliefs)) if reliefs else math.nan)
        turns = turn_parallax(placed[:: math.ceil(len(placed) / MOST_TURNS)])
        quality = replace(quality, turn_parallax=turns)
    quality = replace(quality, still=_still(graph, checks))
    verdict, reason, remedy = judge(quality, result.frames_read, cause)
    return replace(quality, verdict=verdict, reason=reason, remedy=remedy)


def _inliers(graph: Map, segment: int, shutter: Shutter) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Numbers of measurements, confident ones and those that agree; residuals; spread. None without a measurement."""
    p = graph.problem(segment=segment)
    across = p.ii != p.jj
    if len(p.poses_cw) < 2 or not bool(across.any()):
        return None
    if shutter.readout > 0:
        track = PoseTrack.through(increasing_times(graph, graph.members(segment)), p.poses_cw)
        depths, rows = p.patches[:, 2, 0, 0].reshape(len(p.poses_cw), -1), torch.arange(len(p.poses_cw))
        p = as_global_shutter(p, p.poses_cw, depths, rows, track, shutter)
    ii, jj, kk = p.ii[across], p.jj[across], p.kk[across]
    centre = reproject(p.poses_cw[None], p.patches[None], p.intrinsics[None], ii, jj, kk).coords[0, :, 0, 0]
    residual = (p.targets[across] - centre).norm(dim=-1)
    confident = p.weights[across].mean(-1) > CONFIDENT
    agree = confident & (residual < AGREEMENT)
    counts = np.array([len(ii), int(confident.sum()), int(agree.sum())])
    size = 2 * p.intrinsics[:, 2:][jj]
    place = (p.targets[across] / size * torch.tensor(FIELDS)).long().clamp(min=0)
    fields = (place[:, 0].clamp(max=FIELDS[0] - 1) * FIELDS[1] + place[:, 1].clamp(max=FIELDS[1] - 1))[agree]
    pairs = torch.unique(jj[agree] * 100 + fields)
    spread = torch.bincount(pairs // 100, minlength=len(p.poses_cw)).double().median() / (FIELDS[0] * FIELDS[1])
    return counts, residual[confident].numpy(), float(spread)


def _placed(graph: Map, pairs: Sequence[CheckPair]) -> Iterator[_Placed]:
    """Pairs whose frames have poses in one world, with these, ``T_cw``."""
    pose = cache(graph.log.pose)
    for pair in pairs:
        first, second = (pose(number) for number in (pair.first, pair.second))
        if _world(graph, pair.first, pair.second) is not None and first is not None and second is not None:
            yield pair, first, second


def _world(graph: Map, *numbers: int) -> int | None:
    """World of frames; None if one is lost, or they are of several."""
    frames = [graph.log.frames[number] for number in numbers]
    worlds = {graph.world_of(frame.segment) for frame in frames}
    return worlds.pop() if len(worlds) == 1 and not any(frame.lost for frame in frames) else None


def _still(graph: Map, checks: CheckPairs) -> float:
    """Share of the frames of the checks through which corners hardly move though the poses do."""
    spans = [(pair.first, pair.second, False) for pair in checks.pairs] + [(*span, True) for span in checks.still]
    pose, found = cache(graph.log.pose), dict[int, list[tuple[float, int, bool]]]()
    for first, second, still in spans:
        world, start, end = _world(graph, first, second), pose(first), pose(second)
        if world is not None and start is not None and end is not None:
            speed = float(np.linalg.norm(_centre(end) - _centre(start))) / (second - first)
            found.setdefault(world, []).append((speed, second - first, still))
    counts = np.zeros(2)
    for looks in found.values():
        speeds, frames, still = np.array(looks).T
        moving = speeds > STANDING * np.median(speeds)
        counts += (frames[moving] @ still[moving], frames[moving].sum())
    return float(counts[0] / max(counts[1], 1))


def _centre(pose_cw: np.ndarray) -> np.ndarray:
    """Centre of a camera in the world."""
    return se3.inverse(torch.as_tensor(pose_cw, dtype=torch.float64))[:3].numpy()


def _shift_gain(graph: Map, placed: Sequence[_Placed], shutter: Shutter, stride: int) -> float:
    """What shifts of the images explain of the corners, see :func:`dvo.odometry.checks.floating_crop.shift_gain`."""
    chosen = [placed[at] for at in looked_at([pair for pair, *_ in placed])]
    if not chosen:
        return math.nan
    pairs = [pair for pair, *_ in chosen]
    poses = torch.from_numpy(np.array([ends for _, *ends in chosen], dtype=np.float64))
    motions = se3.relative(poses[:, 0], poses[:, 1])
    if shutter.readout > 0:
        pairs = _as_read_at_once(graph, pairs, motions, shutter, stride)
    return shift_gain(pairs, list(se3.matrix(motions).numpy())) * (ROLLING_SHARE if shutter.readout > 0 else 1.0)


def _as_read_at_once(
    graph: Map, pairs: Sequence[CheckPair], motions: Tensor, shutter: Shutter, stride: int
) -> list[CheckPair]:
    """Corners of pairs without what a rolling shutter adds: turns, and steps as if the camera moved evenly."""
    counts = [len(pair.points) for pair in pairs]
    owner = torch.arange(len(pairs)).repeat_interleave(torch.tensor(counts))
    ends = torch.from_numpy(np.concatenate([pair.points for pair in pairs]).astype(np.float64)).split(2, 1)
    focal, centre = torch.from_numpy(np.stack([pair.intrinsics for pair in pairs]))[owner].split(2, 1)

    def turned(xy: Tensor, turn: Tensor) -> Tensor:
        rays = so3.rotate(turn, torch.cat([(xy - centre) / focal, torch.ones_like(xy[:, :1])], 1))
        return rays[:, :2] / rays[:, 2:] * focal + centre

    offsets = [shutter.offsets(xy[:, 1] / stride) for xy in ends]
    numbers = torch.tensor([(pair.first, pair.second) for pair in pairs])
    first, second = (
        turned(xy, so3.conjugate(_turns(graph, frames[owner], away)))
        for xy, frames, away in zip(ends, numbers.T, offsets, strict=True)
    )
    times = torch.tensor([frame.timestamp for frame in graph.log.frames], dtype=torch.float64)[numbers]
    pace = (second - turned(first, motions[owner, 3:])) / (times[:, 1] - times[:, 0])[owner, None]
    corrected = torch.cat([xy - pace * away[:, None] for xy, away in zip((first, second), offsets, strict=True)], 1)
    parts = corrected.split(counts)
    return [replace(pair, points=points.numpy()) for pair, points in zip(pairs, parts, strict=True)]


def _turns(graph: Map, numbers: Tensor, offsets: Tensor) -> Tensor:
    """Rotations ``(N, 4)`` of a camera from the times of frames ``(N,)`` to a little earlier or later, seconds."""
    log, turns = graph.log, offsets.new_zeros(len(offsets), 4)
    for segment in {log.frames[number].segment for number in numbers.unique().tolist()}:
        poses = {k: log.pose(k) for k, frame in enumerate(log.frames) if frame.segment == segment and not frame.lost}
        known = {k: pose for k, pose in poses.items() if pose is not None}
        times = torch.tensor([log.frames[k].timestamp for k in known], dtype=torch.float64)
        track = PoseTrack.through(times, torch.from_numpy(np.stack(list(known.values())).astype(np.float64)))
        rows, mine = torch.tensor(list(known)), torch.isin(numbers, torch.tensor(list(known)))
        turns[mine] = track.motion(torch.searchsorted(rows, numbers[mine]), offsets[mine])[:, 3:]
    return turns


def count_jumps(result: Result) -> int:
    """Number of steps between two frames that are far longer than most of those before and after.

    Args:
        result: of a sequence.

    Returns:
        The number, over all segments.
    """
    jumps = 0
    for segment in result.segments:
        rows = segment.trajectory
        intervals = np.maximum(np.diff(rows.timestamps), 1e-9)
        steps = np.linalg.norm(np.diff(rows.positions, axis=0), axis=1) / intervals
        if len(steps) < 5:
            continue
        none = np.full(JUMP_STEPS, np.nan)
        around = np.lib.stride_tricks.sliding_window_view(np.r_[none, steps, none], 2 * JUMP_STEPS + 1)
        before, after = around[:, :JUMP_STEPS].copy(), around[:, JUMP_STEPS + 1 :].copy()
        before[0], after[-1] = 0, 0
        beside = np.maximum(np.nanmedian(before, axis=1), np.nanmedian(after, axis=1))
        jumps += int((steps > JUMP * np.maximum(beside, np.median(steps))).sum())
    return jumps
