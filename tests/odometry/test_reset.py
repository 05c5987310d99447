"""A new beginning of every odometry: the next sequence is tracked as by a new object, byte for byte."""

import numpy as np
import pytest

from dvo.models.registry import ARCHITECTURES
from dvo.odometry.load import build_odometry
from dvo.odometry.load_map import load_map
from dvo.odometry.protocol import Resettable
from tests.support.tiny_members import MEMBERS, SETTINGS, frames, network, outcome


def test_every_member_is_here():
    assert {name for name in ARCHITECTURES if name != "distance_vo"} == set(MEMBERS)


@pytest.mark.slow
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


@pytest.mark.long
def test_the_tracker_of_a_map_begins_without_it(tmp_path):
    weights, images = network("patch_vo"), frames(1)
    odometry = build_odometry(weights, **SETTINGS["patch_vo"])
    for frame in images:
        odometry.track(frame)
    odometry.save(tmp_path / "map.dvo")
    loaded = load_map(tmp_path / "map.dvo", weights=weights)
    loaded.reset()
    assert outcome(loaded, frames(2)) == outcome(build_odometry(weights, **SETTINGS["patch_vo"]), frames(2))
