"""A tracker with an untrained network on noise that moves: quick, and with a pose for every frame."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import torch

from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import LoadedWeights
from dvo.nets.patch.config import preset
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.tracker import PatchOdometry

SMALL = TrackerConfig(
    pixels=96 * 72, patches=6, lifetime=4, removal=5, optimisation=4, initial_frames=5, initial_updates=3,
    final_updates=2, initial_motion=0.0, initial_parallax=0.0, keyframe_motion=0.0, lost_confidence=0.0,
    min_inliers=0.0, search_inliers=0.0, join_inliers=0.0, initial_inliers=0.0,
)  # fmt: skip


def frames(count, seed=0, size=(96, 72)):
    rng = np.random.default_rng(seed)
    width, height = size
    wall = rng.integers(0, 255, (height, width + 4 * count, 3), dtype=np.uint8)
    camera = Camera(80.0, 80.0, width / 2, height / 2, width, height)
    return [Frame(i, 0.1 * i, np.ascontiguousarray(wall[:, 4 * i : 4 * i + width]), camera) for i in range(count)]


def tracker(config=SMALL, seed=0, operator="gated"):
    torch.manual_seed(0)
    return PatchOdometry(PatchVO(replace(preset("tiny"), update_operator=operator)), config, seed=seed)


def run(odometry, images):
    estimates = [odometry.track(frame) for frame in images]
    return estimates, odometry.finish()


@cache
def plain(count):
    """Estimates and result of the tracker on so many frames, made once for all tests of a process."""
    return run(tracker(), frames(count))


def network(operator="gated"):
    return LoadedWeights.of(tracker(operator=operator).model, "tiny")
