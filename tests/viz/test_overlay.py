"""Marks on images, and the video of the tracked patches."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
import torch

from dvo.cli import main
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.window import Keyframe
from dvo.odometry.protocol import Estimate, Status
from dvo.viz.marks import pixels, shade
from dvo.viz.overlay import OverlayVideo
from tests.support.command_line import arguments

CAMERA = Camera(50, 40, 31.5, 23.5, 64, 48)


def read(file) -> list[np.ndarray]:
    """RGB frames of a video."""
    video, frames = cv2.VideoCapture(str(file)), []
    while (found := video.read())[0]:
        frames.append(found[1][..., ::-1])
    return frames


def test_shades_go_from_red_to_green():
    shades = shade(np.array([0.0, 0.5, 1.0])).astype(int)
    assert shades[0][0] > 200 > shades[0][1] and shades[2][1] > 200 > shades[2][0]
    assert min(shades[1][:2]) > 200


def test_rays_become_pixels():
    np.testing.assert_allclose(pixels(np.array([[0.1, -0.2]]), CAMERA), [[36.5, 15.5]])


def test_a_video_of_every_tracked_frame(given, image_folder, tmp_path):
    given(lost=(4,))
    file = tmp_path / "patches.mp4"
    assert main(arguments(image_folder, tmp_path / "out", "--overlay", str(file), "--stride", "2")) == 0
    frames = read(file)
    assert len(frames) == 10 and frames[0].shape == (48, 64, 3)
    tracked, lost = (frames[k][:3].mean(axis=(0, 1)) for k in (0, 2))
    assert tracked[1] > tracked[0] and lost[0] > lost[1], "the bar at the top has the colour of the status"


@dataclass
class WithGraph:
    """An odometry with a window of one frame."""

    graph: KeyframeGraph
    name: str = "graph"


class FakeWriter:
    """Stand-in for ``cv2.VideoWriter`` that keeps the frames as they are."""

    fourcc = cv2.VideoWriter.fourcc
    frames: list[np.ndarray] = []

    def __init__(self, *arguments):
        self.frames.clear()

    def isOpened(self):
        return True

    def write(self, image):
        self.frames.append(image[..., ::-1])

    def release(self):
        pass


def test_patches_are_marked_where_they_are(tmp_path, monkeypatch):
    graph = KeyframeGraph(1, 3, 4, torch.device("cpu"))
    features = torch.zeros(1, 1, 1, 1), torch.zeros(1, 4), torch.zeros(1, 3, dtype=torch.uint8)
    keyframe = Keyframe(0, 2.0, 0, *features, torch.tensor([12.5, 10, 7.875, 5.875]))
    patches = torch.ones(1, 3, 3, 3)
    patches[:, 0], patches[:, 1] = 10, 8  # pixel (40, 32) of the image, which is four times as large
    graph.window.append(keyframe, torch.tensor([0.0, 0, 0, 0, 0, 0, 1]), patches)
    monkeypatch.setattr(cv2, "VideoWriter", FakeWriter)
    overlay = OverlayVideo(tmp_path / "patches.mp4")
    overlay.begin(WithGraph(graph))
    frame = Frame(0, 2.0, np.zeros((48, 64, 3), np.uint8), CAMERA)
    overlay.update(frame, Estimate(2.0, None, Status.INITIALISING))
    overlay.update(Frame(1, 3.0, frame.image, CAMERA), Estimate(3.0, None, Status.LOST))
    picture, later = FakeWriter.frames
    rows, columns = np.nonzero(picture[24:].min(axis=2) > 60)
    np.testing.assert_allclose([rows.mean() + 24, columns.mean()], [32, 40], atol=0.5)
    assert later[24:].max() == 0, "a frame that has left the window has no marks"


@pytest.mark.parametrize("name", ["taken/a.mp4", "a.txt"])
def test_a_video_that_cannot_be_written(name, given, image_folder, tmp_path, capsys):
    odometry = given()
    (tmp_path / "taken").write_text("a file")
    assert main(arguments(image_folder, tmp_path / "out", "--overlay", str(tmp_path / name))) == 2
    assert any("--overlay" in line and name[-5:] in line for line in capsys.readouterr().err.splitlines())
    assert not odometry.asked
