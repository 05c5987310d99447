"""Every odometry with an untrained network, on walls that move."""

from __future__ import annotations

import numpy as np
import torch

from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.models.registry import ARCHITECTURES
from dvo.models.weights import LoadedWeights

SETTINGS = {
    "patch_vo": {
        "pixels": 96 * 72, "patches": 6, "lifetime": 4, "removal": 5, "optimisation": 4, "initial_frames": 5,
        "initial_motion": 0.0, "initial_parallax": 0.0, "lost_confidence": 0.0, "min_inliers": 0.0,
        "search_inliers": 0.0, "join_inliers": 0.0, "initial_inliers": 0.0, "selection": "random",
    },
    "droid": {
        "lost_confidence": 0.0, "filter_flow": 0.0, "warm_up": 4, "initial_updates": 2, "updates": 1,
        "frame_updates": 1, "restart": False,
    },
}  # fmt: skip
MEMBERS = ("patch_vo", "droid", "tartanvo", "deepvo")


def frames(seed, count=9, size=(96, 72)):
    rng, (width, height) = np.random.default_rng(seed), size
    wall = rng.integers(0, 255, (height // 4, (width + 4 * count) // 4, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)
    camera = Camera(80.0, 80.0, width / 2, height / 2, width, height)
    return [Frame(i, 0.1 * i, np.ascontiguousarray(wall[:, 4 * i : 4 * i + width]), camera) for i in range(count)]


def network(name):
    torch.manual_seed(0)
    cls = ARCHITECTURES.resolve(name)
    return LoadedWeights.of(cls(cls.presets["tiny"]), "tiny")


def outcome(odometry, images):
    estimates = [odometry.track(frame) for frame in images]
    result = odometry.finish()
    return [
        *(np.append(e.confidence, [] if e.pose_wc is None else e.pose_wc).tobytes() for e in estimates),
        *(str(e.status) for e in estimates), *(segment.trajectory.poses_wc.tobytes() for segment in result.segments),
        result.map.points.tobytes(), result.frames_read, result.breaks,
    ]  # fmt: skip
