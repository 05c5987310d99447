"""Detection of boards."""

import cv2
import numpy as np
import pytest

from dvo.boards.board import CharucoBoard, Checkerboard
from dvo.core.errors import DvoError
from dvo.geometry.camera import Camera
from dvo.geometry.undistort import distort


def truth(scene, pose, points):
    """Pixels of points of the board."""
    camera = scene.camera
    seen = points @ cv2.Rodrigues(pose[:3])[0].T + pose[3:]
    return distort(seen[:, :2] / seen[:, 2:], camera) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


@pytest.mark.long
@pytest.mark.parametrize("scale", [1, 3], ids=["small", "large"])
def test_corners_of_a_checkerboard(boards, scale):
    """Those of a large image too, which is searched at reduced size."""
    camera = boards.RADTAN if scale == 1 else Camera(780.0, 790.0, 489.0, 351.0, 960, 720)
    scene = boards.Scene(camera, boards.checkerboard(7, 5))
    pose = scene.poses(3)[2]
    corners, points = Checkerboard(7, 5).detect(scene.image(pose))
    expected = truth(scene, pose, points)
    errors = min((np.linalg.norm(corners - e, axis=1) for e in (expected, expected[::-1])), key=np.max)  # order: either
    assert errors.max() < 0.15


@pytest.mark.parametrize("legacy", [False, True])
def test_corners_of_a_charuco_board_of_which_a_part_is_seen(boards, legacy):
    scene = boards.Scene(boards.RADTAN, boards.charuco(8, 6, legacy=legacy), origin=1.0)
    pose = scene.pose(np.array([0.45, -0.2]), 8.0, np.array([0.3, -0.3, 0.1]))
    corners, points = CharucoBoard(8, 6).detect(scene.image(pose))
    assert 8 <= len(corners) < len(CharucoBoard(8, 6).points)
    assert np.linalg.norm(corners - truth(scene, pose, points), axis=1).max() < 0.4


def test_points_have_the_unit_of_the_square():
    assert Checkerboard(4, 3, 0.03).points[[0, 1, 4]].tolist() == [[0, 0, 0], [0.03, 0, 0], [0, 0.03, 0]]
    assert np.ptp(CharucoBoard(5, 4, 0.02).points, axis=0) == pytest.approx([0.06, 0.04, 0])


def test_no_board(boards):
    noise = np.random.default_rng(0).integers(0, 256, (30, 40), dtype=np.uint8)
    board, other = Checkerboard(7, 5), CharucoBoard(8, 6)
    assert board.detect(noise) is None and other.detect(noise) is None
    assert "7x5 are those of 8x6 squares" in board.hint([noise])
    assert "no markers were seen" in other.hint([noise]) and "no markers" in other.hint([])


def test_hints_name_the_board_that_is_there(boards):
    image = boards.Scene(boards.RADTAN, boards.checkerboard(7, 5)).image(np.array([0, 0, 0, -3.0, -2, 12]))
    assert "give --board 7x5" in Checkerboard(8, 6).hint([image])
    assert "give --board 7x5" in Checkerboard(6, 7).hint([image])
    scene = boards.Scene(boards.RADTAN, boards.charuco(8, 6, cv2.aruco.DICT_5X5_100), origin=1.0)
    image = scene.image(np.array([0, 0, 0, -4.0, -3, 9]))
    assert "--dictionary 5X5_50" in CharucoBoard(8, 6).hint([image])
    assert "markers of 5X5_100 were seen: check the number" in CharucoBoard(7, 5, dictionary="5X5_100").hint([image])


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Checkerboard(2, 6), "2x6 is no board"),
        (lambda: Checkerboard(9, 6, 0.0), "0 is no length"),
        (lambda: Checkerboard(9, 6, float("nan")), "nan is no length"),
        (lambda: CharucoBoard(8, 6, 0.03, 0.04), "marker of 0.04 in a square of 0.03"),
        (lambda: CharucoBoard(8, 6, dictionary="9X9_50"), "no dictionary '9X9_50'"),
        (lambda: CharucoBoard(20, 20), "too few markers for 20x20"),
    ],
)
def test_boards_that_cannot_be(make, match):
    with pytest.raises(DvoError, match=match) as caught:
        make()
    assert caught.value.remedy
