"""Corners of the checks under a rolling shutter."""

from types import SimpleNamespace

import numpy as np
import torch

from dvo.geometry import se3
from dvo.map.keyframe_log import KeyframeLog
from dvo.odometry.checks.check_pairs import CheckPair
from dvo.odometry.checks.measures import _as_read_at_once
from dvo.odometry.global_ba.rolling_shutter import Shutter

K = np.array([260.0, 260, 159.5, 119.5])
FRAMES, INTERVAL, READOUT, STRIDE = 12, 1 / 30, 0.02, 4
SHUTTER = Shutter(READOUT, 240 / STRIDE)


def pose_at(times):
    """Poses ``(N, 7)`` of a camera that turns faster and slower."""
    zero = torch.zeros_like(times)
    return se3.exp(torch.stack([zero, zero, zero, 0.1 * torch.sin(5 * times), 0.3 * torch.sin(4 * times), zero], -1))


def seen(points, times):
    """Pixels of points far away, ``(N, 3)``, at a time each."""
    there = se3.act(pose_at(times), points).numpy()
    return there[:, :2] / there[:, 2:] * K[:2] + K[2:]


def test_corners_are_those_of_a_global_shutter():
    log, times = KeyframeLog(), INTERVAL * torch.arange(FRAMES, dtype=torch.float64)
    for number, (time, pose) in enumerate(zip(times.tolist(), pose_at(times).numpy(), strict=True)):
        log.add(time, number)
        log.set_pose(number, pose)
    log.frames[5].lost = True  # it has no part in the motion
    g = torch.Generator().manual_seed(0)
    found, wanted, ends = [], [], [(0, 4), (3, 7), (6, 11)]
    for first, second in ends:
        rays = torch.rand(40, 3, generator=g, dtype=torch.float64) * torch.tensor([1.0, 0.7, 0.0]) - 0.4
        points, pair = 1e4 * (rays * torch.tensor([1, 1, 0]) + torch.tensor([0, 0, 1.0])), []
        for number in (first, second):
            at = seen(points, times[number].expand(40))
            wanted.append(at)
            for _ in range(20):  # the row that a point is seen in decides on its time
                offsets = SHUTTER.offsets(torch.from_numpy(at[:, 1]) / STRIDE)
                at = seen(points, times[number] + offsets)
            pair.append(at)
        found.append(CheckPair(first, second, np.concatenate(pair, 1).astype(np.float32), K))
    poses = pose_at(times)
    motions = se3.relative(poses[[a for a, _ in ends]], poses[[b for _, b in ends]])
    corrected = _as_read_at_once(SimpleNamespace(log=log), found, motions, SHUTTER, STRIDE)
    for at, (before, after) in enumerate(zip(found, corrected, strict=True)):
        exact = np.concatenate(wanted[2 * at : 2 * at + 2], 1)
        assert np.abs(before.points - exact).max() > 1.0
        assert np.abs(after.points - exact).max() < 0.02
        assert (after.first, after.second) == (before.first, before.second)
