"""Files that dvo writes, read by dvo."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import dvo
from dvo.data.calibration.read import read_calibration
from dvo.data.readers.groundtruth import read_groundtruth
from dvo.data.trajectory import Trajectory
from dvo.export.colmap import write_colmap, write_colmap_text
from dvo.export.reconstruction import reconstruct
from dvo.geometry.camera import Camera
from dvo.geometry.poses import pose_matrices
from dvo.map.io.serialisation import load_graph
from dvo.odometry.load import build_odometry
from dvo.synth.export import export_sequence, write_calibration
from dvo.synth.sequence import make_sequence
from tests.support.reconstructions import walk
from tests.support.tiny_members import SETTINGS, frames, network

CAMERAS = {
    "none": Camera(80.25, 81.5, 40.125, 29.75, 80, 60),
    "radtan": Camera(80.25, 81.5, 40.125, 29.75, 80, 60, "radtan", (-0.2, 0.05, 1e-3, -2e-3)),
    "radtan5": Camera(80.25, 81.5, 40.125, 29.75, 80, 60, "radtan", (-0.2, 0.05, 1e-3, -2e-3, 0.01)),
    "fisheye": Camera(80.25, 81.5, 40.125, 29.75, 80, 60, "fisheye", (-0.02, 0.01, -5e-3, 1e-3)),
}


@pytest.mark.parametrize("readout", [0.0, 0.02])
@pytest.mark.parametrize("name", CAMERAS)
def test_calibrations(name: str, readout: float, tmp_path: Path) -> None:
    camera = replace(CAMERAS[name], readout=readout)
    write_calibration(camera, tmp_path)
    (file,) = tmp_path.iterdir()
    assert read_calibration(file).camera(80, 60) == camera


@pytest.mark.parametrize("write", [write_colmap, write_colmap_text])
def test_cameras_of_a_colmap_model(write, tmp_path: Path) -> None:
    found = reconstruct(walk(), 0)
    write(found, tmp_path)
    (file,) = (tmp_path / "sparse" / "0").glob("cameras.*")
    camera = found.cameras[0]
    read = read_calibration(Path(f"{file}:1")).camera(camera.width, camera.height)
    np.testing.assert_allclose(read.intrinsics, camera.intrinsics, atol=1e-12)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1.4e9]))
def test_trajectories(seed: int, start: float) -> None:
    """Of the formats that ground truth is read from."""
    rng = np.random.default_rng(seed)
    poses = rng.normal(size=(12, 7))
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    written = Trajectory(start + np.cumsum(rng.uniform(0.02, 1, 12)).round(6), poses)
    with tempfile.TemporaryDirectory() as folder:
        for name, file in (("tum", "trajectory.txt"), ("kitti", "poses.txt")):
            dvo.export_trajectory(written, Path(folder) / name, name)
            read = read_groundtruth(Path(folder) / name / file, written.timestamps)
            np.testing.assert_allclose(read.timestamps, written.timestamps, atol=1e-6, rtol=0)
            np.testing.assert_allclose(pose_matrices(read.poses_wc), pose_matrices(poses), atol=1e-7)


@pytest.mark.parametrize("layout", ["tum", "tartanair"])
def test_rendered_sequences(layout: str, tmp_path: Path) -> None:
    """Images, depth, camera, times and poses of ``dvo synth export`` through ``dvo.open``."""
    sequence = make_sequence(3, frames=3, height=48, width=64, family="room", sensor=False)
    export_sequence(sequence, tmp_path / "out", layout)
    source = dvo.open(tmp_path / "out")
    read = list(source)
    assert source.kind == layout and len(read) == 3
    for index, (frame, original) in enumerate(zip(read, sequence, strict=True)):
        assert np.array_equal(frame.image, original.image) and frame.depth is not None
        assert frame.timestamp == pytest.approx(original.timestamp, abs=1e-6)
        np.testing.assert_allclose(frame.camera.intrinsics, original.camera.intrinsics, atol=1e-6)
        depth = sequence.rendering(index).depth[0].numpy()
        known = np.isfinite(frame.depth)
        assert known.mean() > 0.9
        np.testing.assert_allclose(frame.depth[known], depth[known], atol=1e-4 if layout == "tum" else 1e-6)
    poses = pose_matrices(source.groundtruth.poses_wc), pose_matrices(sequence.groundtruth.poses_wc)
    np.testing.assert_allclose(*(np.linalg.inv(p[0]) @ p for p in poses), atol=1e-5)


@pytest.mark.long
def test_maps(tmp_path: Path) -> None:
    """Keyframes, points and trajectory of a tracker, by ``dvo.load_map`` and as a graph; and saved again."""
    weights = network("patch_vo")
    odometry = build_odometry(weights, seed=1, **SETTINGS["patch_vo"])
    for frame in frames(0, count=14):
        odometry.track(frame)
    result = odometry.finish()
    odometry.save(tmp_path / "a.dvo")
    loaded = dvo.load_map(tmp_path / "a.dvo", weights=weights)
    again = loaded.finish()
    np.testing.assert_array_equal(again.trajectory.timestamps, result.trajectory.timestamps)
    np.testing.assert_allclose(again.trajectory.poses_wc, result.trajectory.poses_wc, atol=1e-9)
    np.testing.assert_allclose(again.map.points, result.map.points, atol=1e-6)
    graph = load_graph(tmp_path / "a.dvo")
    assert [frame.identifier for frame in graph.archive] == [frame.identifier for frame in odometry.graph.archive]
    loaded = dvo.load_map(tmp_path / "a.dvo", weights=weights)
    loaded.save(tmp_path / "b.dvo")
    second = dvo.load_map(tmp_path / "b.dvo", weights=weights).finish()
    np.testing.assert_array_equal(second.trajectory.poses_wc, again.trajectory.poses_wc)
