"""A new beginning of every odometry: the next sequence is tracked as by a new object, byte for byte."""

import numpy as np
import pytest
import torch

from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.models.registry import ARCHITECTURES
from dvo.models.weights import LoadedWeights
from dvo.odometry.load import build_odometry
from dvo.odometry.load_map import load_map
from dvo.odometry.protocol import Resettable

SETTINGS = {
    "patch_vo": {
        "pixels": 96 * 72, "patches": 6, "lifetime": 4, "removal": 5, "optimisation": 4, "initial_frames": 5,
        "initial_motion": 0.0, "initial_parallax": 0.0, "lost_confidence": 0.0, "min_inliers": 0.0,
        "search_inliers": 0.0, "join_inliers": 0.0, "initial_inliers": 0.0, "selection": "random",
    },
    "droid": {"lost_confidence": 0.0, "filter_flow": 0.0, "warm_up": 4},
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


def test_every_member_is_here():
    assert {name for name in ARCHITECTURES if name != "distance_vo"} == set(MEMBERS)


@pytest.mark.parametrize("name", MEMBERS)
@pytest.mark.parametrize("finished", [False, True])
def test_the_next_sequence_has_the_bytes_of_a_new_odometry(name, finished):
    weights, first, second = network(name), frames(1), frames(2, size=(112, 80))
    used = build_odometry(weights, seed=3, **SETTINGS.get(name, {}))
    assert isinstance(used, Resettable)
    for frame in first:
        used.track(frame)
    before = used.finish() if finished else None
    kept = None if before is None else before.trajectory.poses_wc.copy()
    used.reset()
    new = build_odometry(weights, seed=3, **SETTINGS.get(name, {}))
    assert (used.name, used.seed, used.config) == (new.name, new.seed, new.config)
    assert outcome(used, second) == outcome(new, second)
    if before is not None:
        assert np.array_equal(before.trajectory.poses_wc, kept) and len(kept)


def test_the_tracker_of_a_map_begins_without_it(tmp_path):
    weights, images = network("patch_vo"), frames(1)
    odometry = build_odometry(weights, **SETTINGS["patch_vo"])
    for frame in images:
        odometry.track(frame)
    odometry.save(tmp_path / "map.dvo")
    loaded = load_map(tmp_path / "map.dvo", weights=weights)
    loaded.reset()
    assert outcome(loaded, frames(2)) == outcome(build_odometry(weights, **SETTINGS["patch_vo"]), frames(2))
