import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data import Trajectory, interpolate, read_kitti_poses, read_tum, write_kitti_poses, write_tum
from dvo.geometry.poses import (
    compose_poses,
    invert_poses,
    ned_to_camera,
    pose_matrices,
    poses_from_matrices,
    slerp,
)

number = st.floats(-1, 1)
quaternion = st.tuples(number, number, number, number).filter(lambda q: np.linalg.norm(q) > 1e-2)
pose = st.builds(lambda t, q: np.array([*t, *(np.array(q) / np.linalg.norm(q))]), st.tuples(*[number] * 3), quaternion)


def same(a, b, tolerance=1e-9):
    return np.abs(pose_matrices(a) - pose_matrices(b)).max() < tolerance


@settings(deadline=None)
@given(pose, pose)
def test_poses_behave_as_their_matrices(a, b):
    assert same(poses_from_matrices(pose_matrices(a)), a)
    assert np.abs(pose_matrices(compose_poses(a, b)) - pose_matrices(a) @ pose_matrices(b)).max() < 1e-9
    assert same(compose_poses(a, invert_poses(a)), np.array([0, 0, 0, 0, 0, 0, 1.0]))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_half_turns_become_the_right_quaternion(axis):
    rotation = -np.eye(4)
    rotation[axis, axis] = rotation[3, 3] = 1
    q = poses_from_matrices(rotation)[3:]
    assert np.abs(q).argmax() == axis and np.linalg.norm(q) == pytest.approx(1)


def test_scipy_agrees():
    rotations = pytest.importorskip("scipy.spatial.transform").Rotation
    q = np.random.default_rng(0).normal(size=(200, 4))
    poses = np.concatenate([np.zeros((200, 3)), q], 1)
    assert np.abs(pose_matrices(poses)[:, :3, :3] - rotations.from_quat(q).as_matrix()).max() < 1e-12


def test_ned_camera_looking_north_looks_along_world_x():
    # identity in NED: forward is world x, right is world y, down is world z
    matrix = pose_matrices(ned_to_camera(np.array([1, 2, 3, 0, 0, 0, 1.0])))
    assert matrix[:3, 2] == pytest.approx([1, 0, 0])  # our z, forward
    assert matrix[:3, 0] == pytest.approx([0, 1, 0])  # our x, right
    assert matrix[:3, 1] == pytest.approx([0, 0, 1])  # our y, down
    assert matrix[:3, 3] == pytest.approx([1, 2, 3])


def about_z(degrees, x=0.0):
    half = np.deg2rad(degrees) / 2
    return [x, 0, 0, 0, 0, np.sin(half), np.cos(half)]


def test_interpolation_between_two_poses():
    trajectory = Trajectory(np.array([1.0, 2.0, 5.0]), np.array([about_z(0), about_z(90, 4.0), about_z(90, 5.0)]))
    found = interpolate(trajectory, np.array([0.5, 1.0, 1.25, 2.0, 3.0, 5.0, 5.1]), max_gap=1.5)
    assert found.timestamps.tolist() == [1.0, 1.25, 2.0, 5.0]  # 3.0 lies in a gap of 3 s, the ends outside
    assert found.poses_wc[1] == pytest.approx(about_z(22.5, 1.0))
    assert found.poses_wc[3] == pytest.approx(about_z(90, 5.0))


def test_interpolation_takes_the_short_way_round():
    a, b = np.array([about_z(10)]), np.array([about_z(30)])
    b[:, 3:] *= -1  # the same rotation
    q = slerp(a[:, 3:], b[:, 3:], np.array([0.5]))
    assert same(np.array([[0, 0, 0, *q[0]]]), np.array([about_z(20)]))
    assert slerp(a[:, 3:], a[:, 3:], np.array([0.3])) == pytest.approx(a[:, 3:])


def test_interpolation_of_nothing():
    assert len(interpolate(Trajectory(np.zeros(0), np.zeros((0, 7))), np.array([1.0]))) == 0


def random_poses(count):
    rng = np.random.default_rng(1)
    q = rng.normal(size=(count, 4))
    return np.concatenate([rng.normal(size=(count, 3)), q / np.linalg.norm(q, axis=1, keepdims=True)], 1)


def test_kitti_and_tum_files_round_trip(tmp_path):
    poses = random_poses(7)
    write_kitti_poses(tmp_path / "k.txt", poses)
    assert same(read_kitti_poses(tmp_path / "k.txt"), poses, 1e-8)
    trajectory = Trajectory(1403715273.262143 + np.arange(7) / 20, poses)
    write_tum(tmp_path / "t.txt", trajectory)
    again = read_tum(tmp_path / "t.txt")
    assert np.abs(again.timestamps - trajectory.timestamps).max() < 1e-6
    assert same(again.poses_wc, poses, 1e-7)


def test_zero_is_written_without_a_sign(tmp_path):
    """Rounding to the digits of the file included."""
    pose = np.array([[-0.0, -1e-12, -1e-9, -0.0, 0.0, -0.0, 1.0]])
    write_tum(tmp_path / "t.txt", Trajectory(np.zeros(1), pose))
    written = "0.000000000 0.000000000 0.000000000 -0.000000001 0.000000000 0.000000000 0.000000000 1.000000000"
    assert (tmp_path / "t.txt").read_text().splitlines()[1] == written
    write_kitti_poses(tmp_path / "k.txt", np.array([[-0.0, -0.0, -0.5, 0, 0, 0, 1]]))
    numbers = (tmp_path / "k.txt").read_text().split()
    assert numbers[3::4] == ["0.000000000e+00", "0.000000000e+00", "-5.000000000e-01"]
    assert "-0.000000000e+00" not in numbers


@pytest.mark.parametrize("text", ["", "1 2 3\n", "1 0 0 0 0 1 0 0 0 0 1 nan\n", "a b c d e f g h i j k l\n"])
def test_malformed_kitti_poses(make, text):
    with pytest.raises(DvoError, match="KITTI row|no poses"):
        read_kitti_poses(make.text("k.txt", text))


def test_kitti_poses_of_the_shared_clip(data_root):
    poses = read_kitti_poses(data_root / "kitti00_120/poses.txt")
    assert same(poses, read_tum(data_root / "kitti00_120/groundtruth_tum.txt").poses_wc, 2e-6)
