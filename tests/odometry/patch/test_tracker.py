"""The streaming tracker with an untrained network: bookkeeping, determinism, bounded memory; with the shipped weights:
finding the way again."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import dvo
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.metrics import evaluate
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.initialisation import NOT_INITIALISED
from dvo.odometry.patch.tracker import _precision
from dvo.odometry.protocol import Odometry, Status
from dvo.synth.sequence import make_sequence
from tests.support.tiny_tracker import SMALL, frames, plain, run, tracker


@pytest.mark.long
def test_sigma_changes_no_trajectory():
    """It is for covariances alone."""
    poses = [run(tracker(replace(SMALL, sigma=sigma)), frames(10))[1].trajectory.poses_wc for sigma in (0.06, 1.0)]
    assert np.array_equal(*poses)
    with pytest.raises(DvoError, match="sigma"):
        TrackerConfig(sigma=0.0)


def test_is_an_odometry_with_a_pose_for_every_frame():
    assert isinstance(tracker(), Odometry)
    estimates, result = plain(14)
    assert len(result.trajectory) == result.frames_read == 14
    assert result.frames_lost == 0
    np.testing.assert_allclose(result.trajectory.timestamps, 0.1 * np.arange(14))
    assert np.isfinite(result.trajectory.poses_wc).all()
    np.testing.assert_allclose(np.linalg.norm(result.trajectory.poses_wc[:, 3:], axis=1), 1)
    assert estimates[0].status is Status.INITIALISING
    assert all(bool(e.reason) is (e.pose_wc is None) for e in estimates), "what it waits for"
    assert estimates[-1].status is Status.TRACKING
    assert result.map.points.shape == result.map.colors.shape
    assert len(result.map.points) > 0


@pytest.mark.long
def test_same_seed_same_bytes_and_another_seed_another_trajectory():
    first, second, other = (run(tracker(seed=s), frames(9))[1].trajectory.poses_wc for s in (3, 3, 4))
    assert first.tobytes() == second.tobytes()
    assert first.tobytes() != other.tobytes()


def test_precision_is_that_of_the_setting_or_of_the_processor(monkeypatch):
    for units, precision, dtype in (
        (False, "auto", torch.float32), (True, "auto", torch.bfloat16), (True, "float32", torch.float32),
        (False, "bfloat16", torch.bfloat16),
    ):  # fmt: skip
        monkeypatch.setattr("dvo.odometry.patch.tracker.multiplies_bfloat16", lambda device, units=units: units)
        monkeypatch.setattr("dvo.odometry.patch.tracker.multiplies_int8", lambda device: False)
        odometry = tracker(replace(SMALL, precision=precision))
        assert {p.dtype for p in odometry.network.parameters()} == {dtype}
        assert {p.dtype for p in odometry.model.parameters()} == {torch.float32}
    monkeypatch.setattr("dvo.odometry.patch.tracker.multiplies_int8", lambda device: True)
    assert tracker(SMALL).precision == "int8"
    assert tracker(SMALL, operator="mamba").precision == "float32"
    for precision in ("bfloat16", "int8"):
        results = [run(tracker(replace(SMALL, precision=precision)), frames(9))[1] for _ in range(2)]
        assert results[0].info["precision"] == precision and results[0].frames_lost == 0
        assert results[0].trajectory.poses_wc.tobytes() == results[1].trajectory.poses_wc.tobytes()
    with pytest.raises(DvoError, match="precision.*gated"):
        tracker(replace(SMALL, precision="int8"), operator="mamba")
    with pytest.raises(DvoError, match="precision.*CPU"):
        _precision("int8", tracker(SMALL).model, torch.device("cuda"))
    assert _precision("auto", tracker(SMALL).model, torch.device("cpu")) == "int8"


@pytest.mark.slow
def test_the_state_space_operator_tracks_and_its_states_stay_bounded():
    odometry = tracker(operator="mamba")
    estimates = [odometry.track(frame) for frame in frames(30)]
    assert estimates[-1].status is Status.TRACKING
    assert 0 < float(odometry.window.hidden.abs().max()) < 100
    result = odometry.finish()
    assert result.frames_lost == 0 and np.isfinite(result.trajectory.poses_wc).all()
    _, again = run(tracker(operator="mamba"), frames(30))
    assert again.trajectory.poses_wc.tobytes() == result.trajectory.poses_wc.tobytes()


def test_dropped_keyframes_keep_their_frames():
    """With a threshold that no motion passes every third-newest keyframe goes, and yet each frame has a pose."""
    odometry = tracker(replace(SMALL, keyframe_motion=1e9))
    _, result = run(odometry, frames(20))
    assert len(result.trajectory) == 20
    assert result.info["keyframes"] < 12


@pytest.mark.long
@pytest.mark.parametrize("setting", ["initial_motion", "initial_parallax"])
def test_a_sequence_that_is_not_initialised_has_no_rows(setting):
    """Neither without motion nor without parallax: a pose of every frame would be an invention, points too."""
    estimates, result = run(tracker(replace(SMALL, **{setting: 1e9})), frames(16))
    assert all(e.status is Status.INITIALISING and e.pose_wc is None for e in estimates)
    assert len(result.trajectory) == result.frames_tracked == 0 and result.frames_lost == 16
    assert len(result.map.points) == 0 and not result.segments
    assert [(b.frames, b.reason) for b in result.breaks] == [(16, NOT_INITIALISED)]


def test_window_does_not_grow():
    odometry = tracker()
    sizes = []
    for frame in frames(28):
        odometry.track(frame)
        sizes.append((len(odometry.window), len(odometry.window.kk), odometry.patch_window.correlation.capacity))
    assert max(sizes[20:]) == max(sizes[15:20])


@pytest.mark.parametrize("count", [0, 1, 2, 4])
def test_finish_after_few_frames(count):
    _, result = run(tracker(), frames(count))
    assert result.frames_read == result.frames_lost == count and len(result.trajectory) == 0


def test_frames_out_of_order_or_of_another_size_are_refused():
    odometry = tracker()
    images = frames(3)
    odometry.track(images[1])
    with pytest.raises(DvoError, match="does not come after"):
        odometry.track(images[0])
    with pytest.raises(DvoError, match="64x48"):
        odometry.track(replace(frames(1, size=(64, 48))[0], timestamp=9.0))
    assert odometry.finish().frames_read == 1


@pytest.mark.long
def test_a_buffer_that_is_used_again_for_every_frame():
    images = frames(9)
    buffer = np.zeros_like(images[0].image)
    odometry = tracker()
    for frame in images:
        buffer[:] = frame.image
        odometry.track(replace(frame, image=buffer))
    expected = plain(9)[1].trajectory
    assert odometry.finish().trajectory.poses_wc.tobytes() == expected.poses_wc.tobytes()


def test_a_refused_frame_leaves_no_size_behind():
    image = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    lens = Camera(80.0, 80.0, 32.0, 24.0, 64, 48, model="radtan", coefficients=(0.1, 0.0, 0.0, 0.0))
    odometry = tracker()
    with pytest.raises(DvoError, match="distortion"):
        odometry.track(Frame(0, 0.0, image, lens))
    assert odometry.track(frames(1)[0]).status is Status.INITIALISING


def test_poses_that_are_not_finite_are_not_given():
    odometry = tracker()
    images = frames(9)
    for frame in images[:8]:
        odometry.track(frame)
    with torch.no_grad():
        for parameter in odometry.network.update.parameters():
            parameter.fill_(float("nan"))
    estimate = odometry.track(images[8])
    assert estimate.status is Status.LOST and estimate.pose_wc is None
    assert np.isfinite(odometry.finish().trajectory.poses_wc).all()


def test_unknown_setting_is_named():
    with pytest.raises(DvoError, match="colour"):
        TrackerConfig.from_dict({"colour": 1})


@pytest.mark.slow
def test_a_covered_lens_is_lost_and_the_way_found_again():
    """Half a second without light: those frames are lost, nothing else is, and the path goes on as if it had not been
    (the same sequence without the dark is the yardstick)."""
    film = make_sequence(61, frames=48, height=120, width=160, fps=15, family="room", kind="handheld", sensor=False)
    clear = list(film)
    covered = [replace(f, image=np.zeros_like(f.image)) if 26 <= f.index < 33 else f for f in clear]
    errors = []
    for images in (clear, covered):
        odometry = dvo.load("small", device="cpu", seed=0)
        estimates = [odometry.track(frame) for frame in images]
        result = odometry.finish()
        errors.append(evaluate(result.trajectory, film.groundtruth).ate_percent)
    assert [e.status is Status.LOST for e in estimates] == [26 <= k < 33 for k in range(48)]
    assert result.frames_lost == 7 and len(result.trajectory) == 41
    assert errors[1] < max(2 * errors[0], 2.0), errors
