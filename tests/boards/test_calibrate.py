"""Calibration from rendered images of boards."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose

from dvo.boards.board import CharucoBoard, Checkerboard
from dvo.boards.calibrate import BoardOptions, calibrate_board
from dvo.core.errors import DvoError
from dvo.data import read_calibration

CASES = {
    "radtan": ("RADTAN", Checkerboard(7, 5, 0.03), {}),
    "k3": ("RADTAN", Checkerboard(7, 5), {"k3": True}),
    "fisheye": ("FISHEYE", Checkerboard(7, 5), {"fisheye": True}),
    "charuco": ("RADTAN", CharucoBoard(8, 6), {}),
}


def scene_of(boards, lens, board):
    if isinstance(board, CharucoBoard):
        return boards.Scene(getattr(boards, lens), boards.charuco(8, 6), origin=1.0)
    return boards.Scene(getattr(boards, lens), boards.checkerboard(7, 5))


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_known_cameras_are_recovered(boards, case, tmp_path):
    lens, board, settings = CASES[case]
    camera, scene = getattr(boards, lens), scene_of(boards, lens, board)
    reach = {"near": 5.0, "far": 9.0} if lens == "FISHEYE" else {}
    found = calibrate_board(scene.frames(scene.poses(18, **reach)), board, BoardOptions(**settings))
    truth = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    assert_allclose(found.solution.values[:4], truth, rtol=0.01)
    assert (np.abs(found.solution.values[:4] - truth) < 5 * found.solution.deviations[:4]).all()
    assert 0.01 < found.solution.rms < 0.15 and found.coverage > 0.5
    assert len(found.views) + len(found.rejected) == found.found <= found.examined == 18

    file = tmp_path / ("calib.yaml" if lens == "FISHEYE" else "calib.txt")
    found.write(file)
    again = read_calibration(file)
    assert again.model == found.calibration.model == camera.model
    assert_allclose(again.camera(boards.WIDTH, boards.HEIGHT).intrinsics, found.solution.values[:4], atol=1e-6)
    assert_allclose(again.coefficients, found.solution.values[4:], rtol=1e-8)
    assert f"px (RMS); corners in {found.coverage:.0%} of the image" in file.read_text()


@pytest.mark.long
def test_views_that_do_not_fit_are_rejected(boards):
    """A view of a picture that was squeezed after it was taken."""
    scene = boards.Scene(boards.RADTAN, boards.checkerboard(7, 5))
    frames = scene.frames(scene.poses(12))
    for index in (3, 7):
        bent = cv2.warpAffine(frames[index].image, np.array([[0.9, 0.06, 16.0], [0, 1.0, 0]]), (320, 240))
        object.__setattr__(frames[index], "image", bent)
    found = calibrate_board(frames, Checkerboard(7, 5))
    assert {view.index for view in found.rejected} >= {3, 7} and len(found.views) >= 6
    assert_allclose(found.solution.values[:2], [260, 264], rtol=0.01)


def test_a_board_that_faces_the_camera_is_refused(boards):
    scene = boards.Scene(boards.RADTAN, boards.checkerboard(7, 5))
    with pytest.raises(DvoError, match=r"do not determine the focal length.*tilt .* 0 to \d degrees. Tilt the board"):
        calibrate_board(scene.frames(scene.poses(10, tilt=0.0)), Checkerboard(7, 5), name="video.mp4")


@pytest.mark.long
def test_no_board_too_few_views_no_frames(boards):
    scene = boards.Scene(boards.RADTAN, boards.checkerboard(7, 5))
    frames = scene.frames(scene.poses(4))
    with pytest.raises(DvoError, match=r"no 8x6 checkerboard was found in 4 frames. .*give --board 7x5"):
        calibrate_board(frames, Checkerboard(8, 6))
    with pytest.raises(DvoError, match="usable views of the 7x5 checkerboard in 4 frames, 6 are needed"):
        calibrate_board(frames, Checkerboard(7, 5))
    with pytest.raises(DvoError, match="no frames"):
        calibrate_board([], Checkerboard(7, 5))


@pytest.mark.long
def test_doubts_are_told(boards):
    scene = boards.Scene(boards.RADTAN, boards.checkerboard(7, 5))
    found = calibrate_board(scene.frames(scene.poses(8, near=20.0, far=22.0)), Checkerboard(7, 5))
    assert any("of the image: outside of them the distortion is a guess" in text for text in found.warnings)
    with pytest.raises(ValueError, match="no fisheye"):
        options = BoardOptions(fisheye=True)
        calibrate_board(scene.frames(scene.poses(8)), Checkerboard(7, 5), options).write("calib.txt")
    with pytest.raises(DvoError, match="k3"):
        BoardOptions(fisheye=True, k3=True)
