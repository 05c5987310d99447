"""Odometry of the pose-regression network: which frames have a pose, segments and breaks, equal bytes."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry import se3
from dvo.geometry.camera import Camera
from dvo.models.deepvo import DeepVO, chain
from dvo.models.weights import LoadedWeights
from dvo.odometry.load import build_odometry
from dvo.odometry.protocol import Break, Interim, Odometry, Status
from dvo.odometry.two_frame.deepvo import DeepVOOdometry, RegressionConfig
from dvo.synth.sequence import make_sequence

STANDING = np.array([0.0, 0, 0, 0, 0, 0, 1])


@pytest.fixture(scope="module")
def frames():
    return list(make_sequence(7, frames=14, height=96, width=128, fps=10.0, sensor=False))


@pytest.fixture
def weights():
    torch.manual_seed(0)
    return LoadedWeights.of(DeepVO(DeepVO.presets["tiny"]), "untrained")


def track(weights, frames, **settings):
    odometry = build_odometry(weights, **settings)
    return [odometry.track(frame) for frame in frames], odometry.finish()


def with_images(frames, image, positions):
    return [replace(f, image=image) if k in positions else f for k, f in enumerate(frames)]


def test_every_frame_has_a_pose_which_is_the_product_of_the_steps(weights, frames):
    estimates, result = track(weights, frames)
    assert all(e.status is Status.TRACKING and e.segment == 0 for e in estimates)
    assert (result.frames_read, result.frames_lost, result.frames_tracked) == (14, 0, 14)
    assert len(result.segments) == 1 and result.breaks == ()
    np.testing.assert_array_equal(result.trajectory.poses_wc, [e.pose_wc for e in estimates])
    np.testing.assert_array_equal(result.trajectory.timestamps, [f.timestamp for f in frames])
    np.testing.assert_array_equal(estimates[0].pose_wc, STANDING)
    images = torch.stack([torch.from_numpy(f.image.copy()).permute(2, 0, 1) for f in frames])
    with torch.no_grad():  # the whole clip at once, as training sees it
        steps, _ = weights.model(images[None])
    expected = se3.inverse(chain(steps.double()))[0]
    torch.testing.assert_close(torch.from_numpy(result.trajectory.poses_wc), expected, atol=1e-5, rtol=1e-4)
    assert np.abs(result.trajectory.poses_wc[-1] - STANDING).max() > 1e-4


def test_the_same_frames_give_the_same_bytes_for_any_seed(weights, frames):
    first, second = (track(weights, frames, seed=seed)[1] for seed in (0, 5))
    assert first.trajectory.poses_wc.tobytes() == second.trajectory.poses_wc.tobytes()


def test_the_interface(weights):
    odometry = build_odometry(weights)
    assert isinstance(odometry, DeepVOOdometry) and isinstance(odometry, Odometry) and isinstance(odometry, Interim)
    assert odometry.name == "dvo-untrained"
    result = odometry.finish()
    assert len(result.trajectory) == result.frames_read == 0 and result.segments == result.breaks == ()


def test_frames_without_content_are_lost_and_a_segment_begins_after_them(weights, frames):
    dark = with_images(frames, np.zeros_like(frames[0].image), {0, 5, 6})
    estimates, result = track(weights, dark)
    lost = [k for k, e in enumerate(estimates) if e.status is Status.LOST]
    assert lost == [0, 5, 6]
    for k in lost:
        assert (estimates[k].pose_wc, estimates[k].confidence, estimates[k].reason) == (None, 0.0, "black image")
    assert [e.segment for e in estimates] == [0] * 7 + [1] * 7
    assert [len(segment) for segment in result.segments] == [4, 7] and len(result.trajectory) == 7
    times = [f.timestamp for f in frames]
    assert result.breaks == (
        Break(None, times[1], 1, "black image", False),
        Break(times[4], times[7], 2, "black image", True),
    )
    assert (result.frames_lost, result.longest) == (3, 1)
    _, fresh = track(weights, frames[7:])  # an empty recurrent state: nothing of the segment before is left
    np.testing.assert_array_equal(result.trajectory.poses_wc, fresh.trajectory.poses_wc)


def test_a_gap_in_time_ends_a_segment(weights, frames):
    late = [replace(f, timestamp=f.timestamp + (3.0 if k >= 8 else 0.0)) for k, f in enumerate(frames)]
    estimates, result = track(weights, late)
    assert [e.segment for e in estimates] == [0] * 8 + [1] * 6
    assert result.breaks == (Break(late[7].timestamp, late[8].timestamp, 0, "gap of 3.10 s", True),)
    assert len(track(weights, late, max_gap=100.0)[1].segments) == 1


def test_a_repeated_image_has_the_same_pose(weights, frames):
    repeated = with_images(frames, frames[4].image, {5, 6})
    estimates, result = track(weights, repeated)
    for k in (5, 6):
        np.testing.assert_array_equal(estimates[k].pose_wc, estimates[4].pose_wc)
        assert estimates[k].status is Status.TRACKING and estimates[k].timestamp == frames[k].timestamp
    assert len(result.trajectory) == 14 and result.breaks == ()
    twice_black = with_images(frames, np.zeros_like(frames[0].image), range(3, 14))
    estimates, result = track(weights, twice_black)
    assert all(e.status is Status.LOST and e.reason == "black image" for e in estimates[3:])
    assert len(result.trajectory) == 3 and result.breaks[0].frames == 11


def test_the_result_so_far_leaves_tracking_unchanged(weights, frames):
    odometry = build_odometry(weights)
    for k, frame in enumerate(frames):
        odometry.track(frame)
        assert len(odometry.current().trajectory) == k + 1
    _, whole = track(weights, frames)
    np.testing.assert_array_equal(odometry.finish().trajectory.poses_wc, whole.trajectory.poses_wc)
    with pytest.raises(DvoError, match="finished"):
        odometry.track(frames[-1])


def test_the_camera_is_not_known(weights, frames):
    wide = [replace(f, camera=Camera(40.0, 40.0, 63.5, 47.5, 128, 96)) for f in frames]
    assert (
        track(weights, wide)[1].trajectory.poses_wc.tobytes() == track(weights, frames)[1].trajectory.poses_wc.tobytes()
    )


def test_bad_input_is_named(weights, frames):
    for settings in ({"patches": 3}, {"preset": "faster"}, {"max_gap": 0.5}, {"pixels": 1.5}):
        with pytest.raises(DvoError, match=next(iter(settings))):
            build_odometry(weights, **settings)
    assert build_odometry(weights, config=RegressionConfig(max_gap=9.0), pixels=0).config == RegressionConfig(0, 9.0)
    fast = build_odometry(weights, config=RegressionConfig(max_gap=9.0), preset="fast", min_matches=0.2).config
    assert fast == RegressionConfig(160 * 120, 9.0, 0.2)
    odometry = build_odometry(weights)
    odometry.track(frames[1])
    with pytest.raises(DvoError, match="does not come after"):
        odometry.track(frames[0])
    lens = Camera(50, 50, 31.5, 23.5, 64, 48, "radtan", (0.1, 0, 0, 0))
    with pytest.raises(DvoError, match="distortion"):
        build_odometry(weights).track(Frame(0, 0.0, np.zeros((48, 64, 3), np.uint8), lens))


def noise(count, shape):
    return list(np.random.default_rng(3).integers(0, 256, (count, *shape), np.uint8))


def strange(frames, images, start):
    return [replace(f, image=images[k - start]) if 0 <= k - start < len(images) else f for k, f in enumerate(frames)]


@pytest.mark.parametrize("start", [0, 5])
def test_images_of_noise_are_lost(weights, frames, start):
    changed = strange(frames, noise(4, frames[0].image.shape), start)
    estimates, result = track(weights, changed)
    times = np.array([f.timestamp for f in frames])
    rows = np.concatenate([segment.trajectory.timestamps for segment in result.segments])
    # The first frame of a sequence has nothing before it; its pose is withdrawn when the next one shows no such scene.
    assert all(e.status is Status.LOST and e.reason for e in estimates[max(start, 1) : start + 4])
    np.testing.assert_array_equal(rows, np.delete(times, slice(start, start + 4)))
    assert [len(segment) for segment in result.segments] == ([5, 5] if start else [10])
    assert result.frames_lost == 4 and len(result.breaks) == 1 and result.breaks[0].frames == 4
    assert [e.segment for e in estimates[start + 5 :]] == [int(start > 0)] * (9 - start)


@pytest.mark.long
def test_another_scene_begins_a_segment(weights, frames):
    foreign = [f.image for f in make_sequence(23, frames=5, height=96, width=128, fps=10.0, sensor=False)]
    estimates, result = track(weights, strange(frames, foreign, 4))
    assert [len(segment) for segment in result.segments] == [4, 5, 5]
    times = [f.timestamp for f in frames]
    assert [(b.start, b.end, b.frames, b.new_segment) for b in result.breaks] == [
        (times[3], times[4], 0, True), (times[8], times[9], 0, True)
    ]  # fmt: skip
    assert [k for k, e in enumerate(estimates) if e.status is Status.LOST] == [4, 9]  # until the next one shows it too
    for segment in result.segments:
        np.testing.assert_array_equal(segment.trajectory.poses_wc[0], STANDING)
    whole = track(weights, strange(frames, foreign, 4), min_matches=0.0)[1]
    assert len(whole.segments) == 1 and whole.frames_lost == 0


def test_a_repeated_image_shares_the_fate_of_a_new_scene(weights, frames):
    foreign = [f.image for f in make_sequence(23, frames=3, height=96, width=128, fps=10.0, sensor=False)]
    _, result = track(weights, strange(frames, [foreign[0], foreign[0], *foreign[1:]], 6))
    assert [len(segment) for segment in result.segments] == [6, 4, 4] and len(result.breaks) == 2
    np.testing.assert_array_equal(result.segments[1].trajectory.poses_wc[:2], [STANDING] * 2)


def test_estimates_are_the_callers_to_change(weights, frames):
    odometry = build_odometry(weights)
    expected = []
    for frame in frames[:4]:
        pose = odometry.track(frame).pose_wc
        expected.append(pose.copy())
        pose[:] = 9
    np.testing.assert_array_equal(odometry.finish().trajectory.poses_wc, expected)
