"""Marks on images, and the video of the tracked patches."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dvo.cli import main
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.map.keyframe_graph import KeyframeGraph
from dvo.map.window import Keyframe
from dvo.odometry.protocol import Estimate, Status
from dvo.viz.marks import pixels, shade
from dvo.viz.overlay import OverlayVideo, _label
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
    rate = 0.0

    def __init__(self, name, codec, rate, size):
        self.frames.clear()
        FakeWriter.rate = rate
        Path(name).touch()

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
    overlay.close()
    picture, later = FakeWriter.frames
    rows, columns = np.nonzero(picture[24:].min(axis=2) > 60)
    np.testing.assert_allclose([rows.mean() + 24, columns.mean()], [32, 40], atol=0.5)
    assert later[24:].max() == 0, "a frame that has left the window has no marks"


def pictures(times, tmp_path, monkeypatch) -> np.ndarray:
    """Number of the frame that each picture of a video of frames at some times shows."""
    monkeypatch.setattr(cv2, "VideoWriter", FakeWriter)
    overlay = OverlayVideo(tmp_path / "a.mp4")
    for k, time in enumerate(times):
        frame = Frame(k, float(time), np.full((48, 64, 3), k, np.uint8), CAMERA)
        overlay.update(frame, Estimate(frame.timestamp, None, Status.INITIALISING))
    overlay.close()
    return np.array([picture[-1, -1, 0] for picture in FakeWriter.frames])


@settings(max_examples=25)
@given(st.floats(2, 60), st.integers(12, 40), st.integers(0, 2**20))
def test_the_video_has_the_speed_of_the_source(rate, count, seed):
    """Every frame is there, and none is shown more than a picture too early or too late."""
    times = (np.arange(count) + np.random.default_rng(seed).uniform(-0.2, 0.2, count)) / rate
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as folder:
        found = pictures(times, Path(folder), patch)
    assert set(found.tolist()) == set(range(count)) and (np.diff(found) >= 0).all()
    first = np.array([np.argmax(found == k) for k in range(count)]) / FakeWriter.rate
    assert np.abs(first - (times - times[0])).max() < 1.5 / FakeWriter.rate


def test_a_picture_stays_while_no_frame_comes_but_not_for_long(tmp_path, monkeypatch):
    steps = np.full(30, 0.1)
    steps[[15, 20]] = 1.0, 600.0
    found = pictures(np.append(0, np.cumsum(steps)), tmp_path, monkeypatch)
    shown = np.bincount(found)
    assert FakeWriter.rate == 10 and shown[15] == 10 and shown[20] == 20 and shown.sum() == 31 + 9 + 19


def test_frames_that_come_faster_later_do_not_slow_the_video_down(tmp_path, monkeypatch):
    found = pictures(np.append(0, np.cumsum([0.1] * 12 + [0.02] * 200)), tmp_path, monkeypatch)
    assert len(found) / FakeWriter.rate == pytest.approx(12 * 0.1 + 200 * 0.02, abs=0.8)


@pytest.mark.parametrize("size", [(240, 320), (376, 1241), (1080, 1920), (480, 640)])
def test_the_text_is_bright_on_a_dark_plate(size):
    """One width of strokes: a part of the plate is text, nearly white, and nothing of it lies outside."""
    height, width = size
    for text in ("tracking", "lost: no match with the frames before"):
        picture = np.full((height, width, 3), 255, np.uint8)
        _label(picture, text, 4)
        plate = picture[4:][(picture[4:, 0] < 60).all(axis=1)]
        assert 8 <= len(plate) < max(height / 8, 31) and (picture[:4] == 255).all()
        columns = np.flatnonzero((plate[0] < 60).all(axis=1))
        levels = plate[:, : columns[-1] + 1].max(axis=2)
        assert 0.02 < (levels > 150).mean() < 0.35 and (levels < 90).mean() > 0.5
        assert levels[:, -1].max() < 60, "the text ends before the plate does"


@pytest.mark.parametrize("name", ["taken/a.mp4", "a.txt"])
def test_a_video_that_cannot_be_written(name, given, image_folder, tmp_path, capsys):
    odometry = given()
    (tmp_path / "taken").write_text("a file")
    assert main(arguments(image_folder, tmp_path / "out", "--overlay", str(tmp_path / name))) == 2
    assert any("--overlay" in line and name[-5:] in line for line in capsys.readouterr().err.splitlines())
    assert not odometry.asked
