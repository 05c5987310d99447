"""Map files of a tracker with depth, or another scale."""

from dataclasses import replace

import numpy as np
import pytest

import dvo
from dvo.map.io.serialisation import load_graph, save_graph
from dvo.odometry.depth.scale_options import ScaleOptions
from tests.support.archived_walk import archived_walk
from tests.support.saved_maps import check_saved_run
from tests.support.stereo_wall import stereo_wall
from tests.support.tiny_tracker import SMALL, frames, network, tracker

WITH_DEPTH = replace(SMALL, scale=ScaleOptions(depth=True))


def with_depth(images):
    rng = np.random.default_rng(0)
    depth = [2 + 0.2 * rng.random((1, 1)) + np.linspace(0, 0.5, 96)[None].repeat(72, 0) for _ in images]
    return [replace(f, depth=d.astype(np.float32)) for f, d in zip(images, depth, strict=True)]


@pytest.mark.long
def test_a_map_with_measured_depths(tmp_path):
    """Saved mid-way it is in metres already, also while a frame waits to be joined."""
    images = with_depth(frames(16))
    images[9] = replace(images[9], image=np.zeros_like(images[9].image))
    config = replace(WITH_DEPTH, join_inliers=0.9, patience=3)
    _, result = check_saved_run(lambda: tracker(config), images, (4, 8, 12), tmp_path, network())
    assert result.metric and result.info["scale"]["source"] == "depth"
    found = dvo.load_map(tmp_path / "12.dvo", weights=network())
    assert all(frame.measured is not None for frame in found.graph.archive)
    assert found.finish().metric and found.finish().info["scale"]["source"] == "depth"


@pytest.mark.slow
def test_a_map_with_depths_from_right_images(tmp_path):
    """Before the initialisation, and after keyframes with depths from right images have left the window."""

    def new():
        settings = {"removal": 5, "lifetime": 4, "patches": 12, "initial_frames": 4, "keyframe_motion": 0.5}
        return dvo.load("small", pixels=160 * 120, scale={"stereo": True}, estimate_readout=False, **settings)

    _, result = check_saved_run(new, stereo_wall(14), (3, 11), tmp_path)
    assert result.metric and result.info["scale"]["source"] == "stereo"
    whole = load_graph(tmp_path / "11.dvo")
    assert whole.archive and any((frame.measured[:, 1] > 0).any() for frame in whole.archive)


def test_a_scale_by_a_known_distance_is_that_of_the_rows_so_far(tmp_path):
    """The running tracker stays up to scale until it is finished."""
    odometry = tracker(replace(SMALL, scale=ScaleOptions(distances=((0.0, 0.5, 3.0),))))
    for frame in frames(9):
        odometry.track(frame)
    odometry.save(tmp_path / "a.dvo")
    assert not odometry.graph.metric
    result = dvo.load_map(tmp_path / "a.dvo", weights=network()).finish()
    ends = result.trajectory.positions[[0, 5]]
    assert result.metric and np.linalg.norm(ends[1] - ends[0]) == pytest.approx(3.0, rel=1e-4)


def test_a_graph_in_metres_says_so_and_keeps_its_depths(tmp_path):
    graph, _ = archived_walk(frames=9, unit=2.0, archived=False)
    graph.archive_oldest()
    graph.metric[0] = "depth"
    save_graph(tmp_path / "map.dvo", graph)
    found = load_graph(tmp_path / "map.dvo")
    assert found.metric == {0: "depth"} and len(graph.window) == 8
    graph.archive_window()
    for mine, other in zip(found.archive, graph.archive, strict=True):
        np.testing.assert_array_equal(mine.measured, other.measured)
