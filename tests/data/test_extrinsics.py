import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import dvo
from dvo.core.errors import DvoError
from dvo.data.extrinsics import base_trajectory, pose_of_numbers, read_extrinsics
from dvo.data.trajectory import Trajectory
from dvo.geometry.poses import compose_poses, invert_poses, pose_from, pose_matrices, so3_exp

POSE = pose_from(so3_exp(np.array([0.3, -1.2, 0.8])), np.array([0.5, -0.1, 1.2]))
MATRIX = pose_matrices(POSE)

vectors = st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array)
poses = st.tuples(vectors, vectors).map(lambda parts: pose_from(so3_exp(parts[0]), parts[1]))


def near(a, b):
    return np.allclose(pose_matrices(a), pose_matrices(b), atol=1e-9)


@pytest.mark.long
@given(st.lists(poses, min_size=1, max_size=5), poses, poses)
def test_the_base_moves_as_it_did(bases, extrinsics, world):
    """Cameras made from known poses of the base, in any world, give back the motion of the base."""
    bases = np.stack(bases)
    cameras = compose_poses(world, compose_poses(bases, extrinsics))
    found = base_trajectory(Trajectory(np.arange(len(bases), dtype=float), cameras), extrinsics)
    assert near(found.poses_wc, compose_poses(invert_poses(bases[0]), bases))


def test_public_name_and_empty_trajectory():
    assert dvo.base_trajectory is base_trajectory
    assert len(base_trajectory(Trajectory(np.zeros(0), np.zeros((0, 7))), np.eye(4))) == 0


def rows(matrix):
    return "\n".join(" ".join(f"{value:.12g}" for value in row) for row in matrix)


CONTENTS = {
    "matrix.txt": "# camera on the car\n" + rows(MATRIX),
    "pose.txt": " ".join(map(str, POSE)),
    "pose.csv": ", ".join(map(str, POSE)),
    "rows.yaml": f"T_base_camera: {MATRIX.tolist()}\n",
    "flat.yml": f"T_BS:\n  cols: 4\n  rows: 4\n  data: {MATRIX.ravel().tolist()}\n",
    "rows.json": json.dumps({"T_base_camera": MATRIX.tolist()}),
    "pose.json": json.dumps(POSE.tolist()),
}


@pytest.mark.parametrize("name", CONTENTS)
def test_formats(tmp_path, name):
    (tmp_path / name).write_text(CONTENTS[name])
    assert near(read_extrinsics(tmp_path / name), POSE)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.txt", "1 2 3", "3 numbers"), ("a.txt", "", "0 numbers"), ("a.txt", "1 2 x 0 0 0 1", "line 1: no numbers"),
        ("a.txt", "1 2 3 0 0 0 2", "quaternion has the length 2"), ("a.txt", "1 2 3 0 0 0 nan", "no numbers"),
        ("a.txt", rows(2 * np.eye(4)), "not orthonormal"), ("a.txt", rows(np.diag([1, 1, -1, 1])), "mirrors"),
        ("a.txt", rows(MATRIX.T), "last row"), ("a.yaml", "T_cam_imu: [1]", "nor T_BS in it, but T_cam_imu"),
        ("a.yaml", "T_BS: [[1], [2, 3]]", "no table of numbers"), ("a.json", "[1, 2, .inf, 0, 0, 0, 1]", "not finite"),
    ],
)  # fmt: skip
def test_malformed_files(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(DvoError, match=message) as caught:
        read_extrinsics(tmp_path / name)
    assert caught.value.file == tmp_path / name and "T_base_camera row by row" in caught.value.remedy


def test_a_rounded_matrix_becomes_a_rotation():
    pose = pose_of_numbers(MATRIX.round(4))
    assert abs(np.linalg.norm(pose[3:]) - 1) < 1e-12 and np.allclose(pose_matrices(pose), MATRIX, atol=2e-4)


@pytest.mark.parametrize("values", ["rig.txt", [[1, 2], [3]], {"T_BS": 1}, [None] * 7])
def test_extrinsics_that_are_no_numbers(values):
    trajectory = Trajectory(np.zeros(1), POSE[None])
    with pytest.raises(DvoError, match="T_base_camera: (no table of numbers|a number that is not finite)"):
        base_trajectory(trajectory, values)
