"""Map files of a tracker with depth, and files from before there was any."""

from dataclasses import replace

import numpy as np
import torch

import dvo
from dvo.graph.map_file import open_map_file, write_map_file
from dvo.graph.serialisation import load_graph, save_graph
from dvo.odometry.scale_options import ScaleOptions
from tests.archived_walk import archived_walk
from tests.odometry.test_saving import SMALL, check_cuts, network, saved
from tests.odometry.test_stereo_depth import clip
from tests.odometry.test_tracker import frames, tracker

WITH_DEPTH = replace(SMALL, scale=ScaleOptions(depth=True))


def with_depth(images):
    rng = np.random.default_rng(0)
    depth = [2 + 0.2 * rng.random((1, 1)) + np.linspace(0, 0.5, 96)[None].repeat(72, 0) for _ in images]
    return [replace(f, depth=d.astype(np.float32)) for f, d in zip(images, depth, strict=True)]


def test_going_on_from_a_file_with_measured_depths(tmp_path):
    """Lost in the middle, too: a frame that waits to be joined has measured depths that are written."""
    images = with_depth(frames(16))
    images[9] = replace(images[9], image=np.zeros_like(images[9].image))
    config = replace(WITH_DEPTH, join_inliers=0.9, patience=3)
    _, result = check_cuts(lambda: tracker(config), images, (4, 8, 12), tmp_path, network())
    assert result.metric and result.info["scale"]["source"] == "depth"
    whole = load_graph(tmp_path / "12.dvo")
    assert all(frame.measured is not None for frame in whole.archive)


def test_going_on_from_a_file_with_right_images(tmp_path):
    """Before the initialisation, and after keyframes with depths from right images have left the window."""

    def new():
        settings = {"removal": 5, "lifetime": 4, "patches": 12, "initial_frames": 4, "keyframe_motion": 0.5}
        return dvo.load("small", pixels=160 * 120, scale={"stereo": True}, estimate_readout=False, **settings)

    _, result = check_cuts(new, clip(14), (3, 11), tmp_path)
    assert result.metric and result.info["scale"]["source"] == "stereo"
    whole = load_graph(tmp_path / "11.dvo")
    assert whole.archive and any((frame.measured[:, 1] > 0).any() for frame in whole.archive)


def test_a_graph_in_metres_says_so_and_keeps_its_depths(tmp_path):
    graph, _ = archived_walk(frames=9, unit=2.0, archived=False)
    graph.archive_oldest()
    graph.metric[0] = "depth"
    save_graph(tmp_path / "map.dvo", graph)
    found = load_graph(tmp_path / "map.dvo")
    assert found.metric == {0: "depth"}
    np.testing.assert_array_equal(found.archive[0].measured, graph.archive[0].measured)
    assert torch.equal(found.window.measured, graph.window.measured)


def test_slopes_are_those_of_the_window(tmp_path):
    """A file from before there were any has none."""
    graph, _ = archived_walk(frames=9, unit=2.0, archived=False)
    save_graph(tmp_path / "old.dvo", graph)
    assert load_graph(tmp_path / "old.dvo").window.slopes is None
    rng = np.random.default_rng(0)
    for frame in graph.window.frames[1:]:
        frame.slopes = torch.from_numpy(rng.normal(0, 0.02, (graph.window.per_frame, 2))).float()
    save_graph(tmp_path / "new.dvo", graph)
    assert torch.equal(load_graph(tmp_path / "new.dvo").window.slopes, graph.window.slopes)


def test_a_file_from_before_metric_scale_is_read(tmp_path):
    file = saved(tmp_path)
    with open_map_file(file) as source:
        description = source.description
        names = [name.removesuffix(".npy") for name in source._container.namelist() if name.endswith(".npy")]
        arrays = {name: np.load(source._container.open(f"{name}.npy")) for name in names}
    assert not any("measured" in name for name in names)
    del description["graph"]["measured"], description["graph"]["metric"], description["tracker"]["config"]["scale"]
    write_map_file(
        tmp_path / "old.dvo", {k: v for k, v in description.items() if k not in ("format", "version")}, arrays
    )
    found = load_graph(tmp_path / "old.dvo")
    assert found.metric == {} and found.window.measured is None
