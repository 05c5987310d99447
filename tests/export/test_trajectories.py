"""Trajectory formats read back: by dvo's readers of ground truth, and by evo."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.data.files.stamps import read_times
from dvo.data.readers.euroc import read_state_groundtruth
from dvo.data.trajectory import Trajectory, read_kitti_poses, read_tum
from dvo.export.trajectories import write_euroc_trajectory, write_kitti_trajectory, write_tum_trajectory
from dvo.geometry.poses import pose_matrices


def trajectory(values, start=0.0):
    """Trajectory of rows of seven numbers."""
    poses = np.array(values, dtype=np.float64).reshape(-1, 7)
    short = np.linalg.norm(poses[:, 3:], axis=1) < 0.1
    poses[short, 3:] = [0, 0, 0, 1]
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return Trajectory(start + 0.1 * np.arange(len(poses)), poses)


def assert_same(found, expected, atol=1e-6):
    np.testing.assert_allclose(pose_matrices(found), pose_matrices(expected), atol=atol)


rows = st.lists(st.lists(st.floats(-1, 1), min_size=7, max_size=7), min_size=1, max_size=6)
starts = st.sampled_from([0.0, 12.345678, 1403636579.763555])


@given(rows, starts)
@settings(max_examples=30)
def test_every_format_gives_the_poses_back(values, start):
    given_ = trajectory(values, start)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for write in (write_tum_trajectory, write_kitti_trajectory, write_euroc_trajectory):
            write(given_, folder)
        tum, euroc = read_tum(folder / "trajectory.txt"), read_state_groundtruth(folder / "trajectory.csv")
        kitti, times = read_kitti_poses(folder / "poses.txt"), read_times(folder / "times.txt", len(given_))
    assert_same(tum.poses_wc, given_.poses_wc)
    assert_same(euroc.poses_wc, given_.poses_wc)
    assert_same(kitti, given_.poses_wc)
    for found in (tum.timestamps, euroc.timestamps, times):
        np.testing.assert_allclose(found, given_.timestamps, atol=1e-6, rtol=0)


def test_the_rows_as_text(tmp_path):
    half = np.sqrt(0.5)
    given_ = Trajectory(np.array([0.1, 1.25]), np.array([[1, 2, 3, -0.0, 0, 0, 1], [4, 5, 6, 0, 0, half, half]]))
    write_kitti_trajectory(given_, tmp_path)
    write_euroc_trajectory(given_, tmp_path)
    matrix = np.loadtxt(tmp_path / "poses.txt")
    np.testing.assert_allclose(matrix[1], [0, -1, 0, 4, 1, 0, 0, 5, 0, 0, 1, 6], atol=1e-9)
    assert (tmp_path / "times.txt").read_text() == "0.100000000\n1.250000000\n"
    header, first, second = (tmp_path / "trajectory.csv").read_text().splitlines()
    assert header == "#timestamp [ns], p_x, p_y, p_z, q_w, q_x, q_y, q_z"
    assert first.startswith("100000000,1.000000000,2.000000000,3.000000000,1.000000000,0.000000000,")
    assert second.split(",")[0] == "1250000000" and float(second.split(",")[4]) == pytest.approx(half)


def test_evo_reads_them(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    given_ = trajectory(np.random.default_rng(0).uniform(-1, 1, (8, 7)), 5.0)
    write_kitti_trajectory(given_, tmp_path)
    write_euroc_trajectory(given_, tmp_path)
    kitti = file_interface.read_kitti_poses_file(tmp_path / "poses.txt")
    np.testing.assert_allclose(kitti.poses_se3, pose_matrices(given_.poses_wc), atol=1e-8)
    euroc = file_interface.read_euroc_csv_trajectory(tmp_path / "trajectory.csv")
    np.testing.assert_allclose(euroc.poses_se3, pose_matrices(given_.poses_wc), atol=1e-8)
    np.testing.assert_allclose(euroc.timestamps, given_.timestamps, atol=1e-9)
