"""Tracking of validation clips with any odometry."""

import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.core.settings import parse_settings
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.models.patch_vo import PatchVO
from dvo.models.weights import LoadedWeights
from dvo.nets.patch.config import preset
from dvo.odometry.load import build_odometry
from dvo.odometry.protocol import Result, Segment, SparseMap
from dvo.synth.clip import make_clip
from train.validation.pictures import draw, image_at, patch_flow
from train.validation.validate import track_sequence
from train.validation.watch import track_with_flow


@pytest.fixture(scope="module")
def clip():
    """Frames and ground truth of a rendered training clip."""
    rendered = make_clip(5, 0, frames=8, height=48, width=64, sensor=False)
    frames = []
    for index in range(8):
        camera = Camera(*rendered.intrinsics[index].tolist(), width=64, height=48)
        image = np.ascontiguousarray(rendered.images[index].permute(1, 2, 0).numpy())
        frames.append(Frame(index, 0.1 * index, image, camera))
    poses_wc = se3.inverse(rendered.poses_cw.double()).numpy()
    return frames, Trajectory(np.array([frame.timestamp for frame in frames]), poses_wc)


def test_settings_are_read_as_yaml():
    assert parse_settings(["patches=16", "motion_damping=0.5", "name=x"]) == {
        "patches": 16, "motion_damping": 0.5, "name": "x",
    }  # fmt: skip
    for wrong in ("patches", "=3"):
        with pytest.raises(DvoError, match="NAME=VALUE"):
            parse_settings([wrong])


def test_any_odometry_is_measured(clip, fake_odometry):
    frames, truth = clip
    odometry = fake_odometry(lambda t: truth.poses_wc[np.abs(truth.timestamps - t).argmin()], lost=(3,))
    metrics, done = track_sequence(odometry, frames, truth)
    assert metrics.ate_percent < 1e-6 and done.result.frames_lost == 1 and done.result.frames_read == 8
    assert track_with_flow(fake_odometry(), frames, truth)[2] is None


def test_segments_are_aligned_one_by_one(fake_odometry):
    s = np.arange(120) / 10
    poses = np.column_stack([np.sin(s), 0.2 * np.sin(3 * s), s, 0 * s, 0 * s, 0 * s, 1 + 0 * s])
    truth = Trajectory(s, poses)
    image = np.zeros((8, 8, 3), np.uint8)
    frames = [Frame(k, float(time), image, Camera(8.0, 8.0, 3.5, 3.5, 8, 8)) for k, time in enumerate(s)]
    odometry = fake_odometry()
    parts = [Trajectory(s[a:b], poses[a:b] * [k, k, k, 1, 1, 1, 1]) for a, b, k in ((0, 50, 1.0), (60, 120, 3.0))]
    segments = tuple(Segment(part, part.timestamps[0], part.timestamps[-1]) for part in parts)
    odometry.finish = lambda: Result(parts[1], SparseMap(), 120, 10, segments=segments)
    metrics, done = track_sequence(odometry, frames, truth)
    assert metrics.ate_percent < 1e-6 and metrics.completeness == pytest.approx(110 / 120)
    assert done.result.segments == segments


def test_ctrl_c_ends_a_validation(clip, fake_odometry):
    frames, truth = clip

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        track_sequence(fake_odometry(at_frame={2: interrupt}), frames, truth)


@pytest.mark.long
def test_the_picture_shows_the_flow_of_the_last_window(clip, tmp_path):
    frames, truth = clip
    torch.manual_seed(0)
    odometry = build_odometry(LoadedWeights.of(PatchVO(preset("tiny")), "tiny"), initial_motion=0.0)
    _, done, flow = track_with_flow(odometry, frames, truth)
    assert patch_flow(odometry) is None  # finishing has emptied the window
    assert flow.timestamp == frames[-1].timestamp and flow.tails.shape == flow.heads.shape == (2 * 16, 2)
    assert np.isfinite(flow.heads).all() and flow.all_confidence.size > flow.confidence.size
    image = image_at(frames, flow.timestamp, flow.pixels)
    with_flow, without = (
        draw(tmp_path / "x.png", "x", done.result.trajectory, truth, shown, image) for shown in (flow, None)
    )
    assert with_flow.shape[2] == 3 and (with_flow.shape != without.shape or (with_flow != without).any())
