"""Odometry of the two-frame network: poses, breaks and settings, with a random network and one that knows the steps."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import dvo
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry import se3, so3
from dvo.geometry.camera import Camera
from dvo.losses.two_frame import true_flow
from dvo.models.tartanvo import TartanVO, TwoFrameMotion
from dvo.models.weights import LoadedWeights, save_weights
from dvo.nets.two_frame.flow_pyramid import Flows
from dvo.nets.two_frame.tartanvo import preset
from dvo.odometry.frames.content import NO_MATCH
from dvo.odometry.load import build_odometry
from dvo.odometry.protocol import Interim, Odometry, Status
from dvo.odometry.two_frame.tartanvo import UNRELATED, TartanOdometry, TwoFrameConfig
from dvo.session.session import run

CAMERA = Camera(70.0, 70.0, 31.5, 23.5, 64, 48)


def frames(count, seed=0, start=0, still=()):
    """Views along a wall of random blocks; ``still`` ones repeat the image before."""
    wall = np.random.default_rng(seed).integers(0, 255, (6, 8 + count, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    images = []
    for number in range(count):
        images.append(images[-1] if number in still else wall[:, 2 * number : 2 * number + 64].copy())
    return [Frame(start + i, 0.1 * (start + i), image, CAMERA) for i, image in enumerate(images)]


def black(number):
    return Frame(number, 0.1 * number, np.zeros((48, 64, 3), np.uint8), CAMERA)


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return TartanVO(preset("tiny")).eval()


def odometry(model, **settings):
    return build_odometry(LoadedWeights.of(model, "two"), **settings)


class Exact(TartanVO):
    """Knows the motion of every step, and gives the flow of a wall two units away."""

    def __init__(self, steps, returning=True):
        super().__init__(preset("tiny"))
        self.steps, self.returning, self.number = steps, returning, 0

    def between(self, first, second, intrinsics):
        pose_ab = self.steps[self.number][None].float()
        self.number += 1
        h, w = first[0].shape[-2:]
        flow, _ = true_flow(torch.full((1, h, w), 2.0), pose_ab, intrinsics / 4)
        if not self.returning:
            flow = flow + 40.0
        flows = Flows((flow,), flow)
        return TwoFrameMotion(7.0 * pose_ab[:, :3], so3.log(pose_ab[:, 3:]), flows)


def steps_of(count, seed=0):
    xi = 0.1 * torch.randn(count, 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return se3.exp(xi)


def test_every_frame_gets_a_pose(model):
    tracker = odometry(model)
    assert isinstance(tracker, Odometry) and isinstance(tracker, Interim) and tracker.name == "dvo-two"
    done = run(tracker, frames(8)).result
    assert len(done.trajectory) == done.frames_read == 8 and done.frames_lost == 0 and done.breaks == ()
    assert np.isfinite(done.trajectory.poses_wc).all()
    np.testing.assert_allclose(np.linalg.norm(done.trajectory.poses_wc[:, 3:], axis=1), 1.0, atol=1e-9)
    assert done.info["working_size"] == [64, 48] and done.info["config"]["scale"] == "parallax"


@pytest.mark.parametrize("scale", ["parallax", "unit"])
def test_the_trajectory_is_the_product_of_the_steps(scale):
    steps = steps_of(6)
    done = run(TartanOdometry(Exact(steps), TwoFrameConfig(scale=scale)), frames(7)).result
    pose, wanted = se3.identity().double(), [se3.identity().double()]
    for step in steps:
        length = step[:3].norm() / 2.0 / step[:3].norm() if scale == "parallax" else 1.0 / step[:3].norm()
        pose = se3.compose(pose, torch.cat([length * step[:3], step[3:]]))
        wanted.append(pose)
    got = torch.from_numpy(done.trajectory.poses_wc)
    torch.testing.assert_close(se3.matrix(got), se3.matrix(torch.stack(wanted)), atol=1e-3, rtol=1e-3)


def test_the_same_frames_give_the_same_bytes(model):
    a, b = (run(odometry(model, seed=seed), frames(6)).result for seed in (0, 0))
    assert a.trajectory.poses_wc.tobytes() == b.trajectory.poses_wc.tobytes()
    assert a.info == b.info


def test_a_repeated_image_stays_where_it_is(model):
    tracker = odometry(model, scale="unit")
    estimates = [tracker.track(frame) for frame in frames(5, still=(2, 3))]
    assert all(e.status is Status.TRACKING for e in estimates)
    for repeated in (2, 3):
        assert np.array_equal(estimates[repeated].pose_wc, estimates[1].pose_wc)
    assert np.linalg.norm(estimates[4].pose_wc[:3] - estimates[3].pose_wc[:3]) == pytest.approx(1.0, rel=1e-5)


def test_images_without_content_are_lost_and_bridged():
    steps = steps_of(4)
    network = Exact(steps)
    tracker = TartanOdometry(network, TwoFrameConfig())
    clip = [*frames(2), black(2), replace(black(3), image=np.full((48, 64, 3), 255, np.uint8)), *frames(2, 1, 4)]
    network.matching.match = lambda a, b: flow_back(network, steps[1])
    done = [tracker.track(frame) for frame in clip]
    assert [e.status is Status.LOST for e in done] == [False, False, True, True, False, False]
    assert [e.reason for e in done[2:4]] == ["black image", "white image"] and done[2].pose_wc is None
    result = tracker.finish()
    assert len(result.trajectory) == 4 and result.frames_lost == 2 and len(result.segments) == 1
    (gap,) = result.breaks
    assert (gap.frames, gap.reason, gap.new_segment) == (2, "black image", False)


def flow_back(network, step):
    flow, _ = true_flow(
        torch.full((1, 12, 16), 2.0), se3.inverse(step)[None].float(), torch.tensor([[17.5, 17.5, 7.9, 5.9]])
    )
    return Flows((flow,), flow)


def test_another_scene_after_a_loss_begins_a_segment():
    tracker = TartanOdometry(Exact(steps_of(6), returning=False), TwoFrameConfig())
    for frame in [*frames(3), black(3), *frames(2, 1, 4)]:
        tracker.track(frame)
    result = tracker.finish()
    assert [len(segment) for segment in result.segments] == [3, 2] and len(result.trajectory) == 3
    np.testing.assert_array_equal(result.segments[1].trajectory.poses_wc[0], [0, 0, 0, 0, 0, 0, 1])
    assert [(b.frames, b.reason, b.new_segment) for b in result.breaks] == [(1, "black image", True)]


def renumbered(*parts):
    """Parts of sequences one after the other, at 10 Hz."""
    return [
        replace(frame, index=k, timestamp=0.1 * k) for k, frame in enumerate(frame for part in parts for frame in part)
    ]


@pytest.mark.parametrize("start", [0, 5])
def test_images_of_noise_are_lost(model, start):
    rng = np.random.default_rng(3)
    images = [Frame(0, 0.0, rng.integers(0, 256, (48, 64, 3), np.uint8), CAMERA) for _ in range(4)]
    views = frames(10)
    odometry_ = odometry(model, join_share=1.0)
    estimates = [odometry_.track(frame) for frame in renumbered(views[:start], images, views[start:])]
    result = odometry_.finish()
    assert all(e.status is Status.LOST and e.reason == NO_MATCH for e in estimates[max(start, 1) : start + 4])
    rows = np.concatenate([segment.trajectory.timestamps for segment in result.segments])
    np.testing.assert_array_equal(rows, np.delete(0.1 * np.arange(14), slice(start, start + 4)))
    assert [len(segment) for segment in result.segments] == ([5, 5] if start else [10])
    assert len(result.breaks) == 1 and result.breaks[0].frames == 4 and result.breaks[0].reason == NO_MATCH


def test_a_cut_to_another_scene_begins_a_segment(model):
    odometry_ = odometry(model, join_share=1.0)
    foreign = frames(5, seed=8)
    estimates = [odometry_.track(frame) for frame in renumbered(frames(5), [foreign[0]], foreign)]
    result = odometry_.finish()
    assert [e.status is Status.LOST for e in estimates] == [False] * 5 + [True] * 2 + [False] * 4
    assert [len(segment) for segment in result.segments] == [5, 6] and result.frames_lost == 0
    assert len(result.breaks) == 1 and result.breaks[0].new_segment and result.breaks[0].reason == UNRELATED
    everything = odometry(model, min_matches=0.0)
    assert all(everything.track(frame).status is Status.TRACKING for frame in renumbered(frames(3), foreign))


def test_a_gap_in_time_is_told():
    tracker = TartanOdometry(Exact(steps_of(8), returning=False), TwoFrameConfig())
    early, late = frames(5), frames(2, 1, 5)
    for frame in [*early, *(replace(frame, timestamp=frame.timestamp + 9) for frame in late)]:
        tracker.track(frame)
    (gap,) = tracker.finish().breaks
    assert gap.new_segment and gap.frames == 0 and "gap of 9.10 s" in gap.reason
    assert UNRELATED == "new scene"


def test_finish_after_any_number_of_frames(model):
    nothing = odometry(model).finish()
    assert len(nothing.trajectory) == 0 and nothing.segments == () and nothing.frames_read == 0
    dark = odometry(model)
    dark.track(black(0))
    assert dark.finish().frames_lost == 1
    one = odometry(model)
    one.track(frames(1)[0])
    assert len(one.current().trajectory) == len(one.finish().trajectory) == len(one.finish().trajectory) == 1
    with pytest.raises(DvoError, match="finished"):
        one.track(frames(1, start=1)[0])


def test_bad_frames_and_settings_are_refused(model):
    tracker = odometry(model)
    first, second = frames(2)
    tracker.track(second)
    with pytest.raises(DvoError, match="does not come after"):
        tracker.track(first)
    with pytest.raises(DvoError, match="distortion"):
        bent = replace(CAMERA, model="radtan", coefficients=(0.1, 0.0, 0.0, 0.0))
        tracker.track(replace(second, timestamp=9.0, camera=bent))
    for settings, name in (
        ({"patches": 3}, "patches"), ({"scale": "metric"}, "scale"), ({"pixels": -1}, "pixels"),
        ({"preset": "best"}, "preset"), ({"seed": -1}, "seed"), ({"join_share": 2.0}, "join_share"),
    ):  # fmt: skip
        with pytest.raises(DvoError, match=name):
            odometry(model, **settings)


def test_weights_files_give_the_odometry(model, tmp_path):
    file = tmp_path / "two.safetensors"
    save_weights(file, model, {}, half=False)
    tracker = dvo.load(str(file), preset="fast", scale="unit")
    assert isinstance(tracker, TartanOdometry)
    assert tracker.config == TwoFrameConfig(pixels=256 * 192, scale="unit")
    assert len(run(tracker, frames(3)).result.trajectory) == 3


def test_estimates_are_the_callers_to_change(model):
    tracker = odometry(model)
    expected = []
    for frame in frames(4):
        pose = tracker.track(frame).pose_wc
        expected.append(pose.copy())
        pose[:] = 9
    np.testing.assert_array_equal(tracker.finish().trajectory.poses_wc, expected)
