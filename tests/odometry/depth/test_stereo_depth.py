"""Depths of patches from right images: rendered pairs, walls, and right images that cannot be used."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

import dvo
from dvo.core.errors import DvoError
from dvo.data.frame import Frame, StereoView
from dvo.data.trajectory import Trajectory
from dvo.geometry.camera import Camera
from dvo.geometry.poses import invert_poses
from dvo.map.measurements import SIGMA
from dvo.metrics import evaluate
from dvo.odometry.depth.patch_depth import followed_planes
from dvo.odometry.depth.right_view import right_view
from dvo.odometry.depth.scale_options import ScaleOptions
from dvo.odometry.depth.stereo_depth import match_right, sample_features, search_line
from dvo.odometry.frames.front_end import observe
from dvo.odometry.patch.config import TrackerConfig
from dvo.synth.render.shot import Offset
from dvo.synth.sequence import make_sequence
from tests.support.stereo_wall import stereo_wall
from tests.support.tiny_tracker import SMALL, frames, tracker

STEREO = ScaleOptions(stereo=True)
PARALLEL = np.array([0.2, 0, 0, 0, 0, 0, 1.0])
TURNED = np.array([0.2, 0.01, -0.02, 0.0, 0.03, 0.02, 0.99935])  # 3.4 degrees inwards, 2.3 about the optical axis
CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)


@pytest.fixture(scope="module")
def model():
    return dvo.load_model("small").eval()


def rendered_pair(mount, family="gallery"):
    """Frame with its right image, and its depth."""
    left = make_sequence(3, frames=4, fps=10.0, width=320, height=240, family=family)
    mount = np.concatenate([mount[:3], mount[3:] / np.linalg.norm(mount[3:])])
    path, times = Offset(left.path, mount), left.groundtruth.timestamps
    right = replace(left, path=path, groundtruth=Trajectory(times, path.poses_wc(times)), seed=left.seed + 1)
    first = left.frame(1)
    view = StereoView(right.frame(1).image, left.camera, mount)
    return replace(first, right=view), left.rendering(1).depth[0].numpy()


@torch.inference_mode()
def observed(model, frame, patches=64):
    select = partial(model.selection(), patches=patches, generator=torch.Generator().manual_seed(0))
    return observe(model, frame.image, frame.camera, select, torch.device("cpu"))


@pytest.mark.long
@pytest.mark.parametrize("mount", [PARALLEL, TURNED], ids=["parallel", "turned"])
@torch.inference_mode()
def test_depths_of_a_rendered_pair(model, mount):
    """The cameras need not be parallel."""
    frame, depth = rendered_pair(mount)
    seen = observed(model, frame)
    found = match_right(model, seen, right_view(frame, 320, 240), TrackerConfig().measuring, STEREO.stereo_error)
    true, _ = followed_planes(depth, seen.image.mean(2), seen.centres[0, 0].double().numpy() * 4)
    known = np.isfinite(true) & found.good.numpy()
    assert known.sum() > 0.5 * np.isfinite(true).sum()
    error = found.inverse_depth.numpy()[known] * true[known] - 1
    disparity = 0.2 * float(seen.intrinsics[0]) / true[known]
    assert abs(np.median(error)) < 0.01
    assert np.median(np.abs(error * disparity)) < 0.04  # feature pixels
    assert (np.abs(error * disparity) < 0.3).mean() > 0.9
    if mount is PARALLEL:  # the weight is that of the disparity
        weight = (SIGMA / STEREO.stereo_error * 0.2 * float(seen.intrinsics[0])) ** 2
        np.testing.assert_allclose(found.weight.numpy(), weight, rtol=1e-4)


@torch.inference_mode()
def test_slopes_of_floor_and_walls(model):
    """One image beside the other tells the slopes roughly: better than that there are none."""
    frame, depth = rendered_pair(PARALLEL, "hall")
    seen = observed(model, frame, 96)
    found = match_right(model, seen, right_view(frame, 320, 240), TrackerConfig().measuring, STEREO.stereo_error)
    metres, slopes = followed_planes(depth, seen.image.mean(2), seen.centres[0, 0].double().numpy() * 4)
    known = np.isfinite(metres) & found.good.numpy() & (metres < 5)
    true, slopes = 4 * slopes[known], found.slopes.numpy()[known]  # 1 / feature pixel
    assert known.sum() > 20 and np.median(np.abs(true).max(1)) > 0.02
    assert np.median(np.abs(slopes - true).max(1)) < 0.6 * np.median(np.abs(true).max(1))
    assert np.corrcoef(slopes.ravel(), true.ravel())[0, 1] > 0.8


@torch.inference_mode()
def test_a_right_image_of_another_place_gives_hardly_any_depth(model):
    frame, _ = rendered_pair(PARALLEL)
    other = np.ascontiguousarray(frame.right.image[::-1, ::-1])
    frame = replace(frame, right=replace(frame.right, image=other))
    found = match_right(
        model, observed(model, frame), right_view(frame, 320, 240), TrackerConfig().measuring, STEREO.stereo_error
    )
    assert float(found.good.float().mean()) < 0.15


@torch.inference_mode()
def test_the_search_finds_the_disparity_of_a_shifted_map():
    generator = torch.Generator().manual_seed(0)
    target = torch.randn(8, 30, 60, generator=generator)
    centres = torch.stack([torch.randint(22, 57, (12,), generator=generator),
                           torch.randint(2, 27, (12,), generator=generator)], 1).float()  # fmt: skip
    shift = torch.tensor([3.0, 0.0])
    around = torch.stack(torch.meshgrid(*[torch.arange(-1.0, 2)] * 2, indexing="xy"), -1)
    matching = sample_features(target, (centres - shift)[:, None, None] + around).transpose(0, 1)
    focal = torch.tensor([40.0, 40.0, 30.0, 15.0])
    pose = torch.tensor([-0.5, 0, 0, 0, 0, 0, 1.0])
    depths, places = search_line(matching, centres, target, (focal, focal), pose)
    torch.testing.assert_close(depths, torch.full((12,), 3.0 / 20))
    torch.testing.assert_close(places, centres - shift, atol=1e-4, rtol=0)


def test_samples_of_a_map_are_bilinear():
    features = torch.arange(12.0).reshape(1, 3, 4)
    found = sample_features(features, torch.tensor([[[1.0, 2.0], [0.5, 0.5]], [[-3.0, 0.0], [9.0, 9.0]]]))
    torch.testing.assert_close(found, torch.tensor([[[9.0, 2.5], [0.0, 11.0]]]))


def tracked(images, **settings):
    odometry = dvo.load("small", pixels=160 * 120, estimate_readout=False, **settings)
    for frame in images:
        odometry.track(frame)
    return odometry.finish()


@pytest.mark.long
def test_a_walk_with_right_images_is_in_metres_and_repeats_its_bytes():
    first, again = (tracked(stereo_wall(14), scale={"stereo": True}) for _ in range(2))
    assert first.metric and first.info["scale"]["source"] == "stereo"
    positions = first.trajectory.positions
    assert np.linalg.norm(positions[-1] - positions[0]) == pytest.approx(13 * 0.05, rel=0.02)
    assert np.array_equal(first.trajectory.poses_wc, again.trajectory.poses_wc)


@pytest.mark.slow
def test_a_rendered_clip_is_in_metres():
    left = make_sequence(5, frames=30, fps=15.0, width=320, height=240, family="gallery", kind="handheld")
    right = left.stereo(0.2)
    images = [replace(f, right=StereoView(right.frame(f.index).image, f.camera, PARALLEL)) for f in left]
    result = tracked(images, scale={"stereo": True})
    assert evaluate(result.trajectory, left.groundtruth).scale == pytest.approx(1, abs=0.02)


def test_right_images_that_are_not_asked_for_are_not_read_and_change_no_byte():
    def refuse():
        raise AssertionError("the right image was read")

    poses = []
    for right in (None, refuse):
        odometry = tracker()
        for frame in frames(10):
            object.__setattr__(frame, "right", right)
            odometry.track(frame)
        poses.append(odometry.finish().trajectory.poses_wc)
    assert np.array_equal(*poses)


@pytest.mark.long
def test_frames_without_right_images_are_tracked_as_without_the_option():
    results = []
    for scale in (ScaleOptions(), STEREO):
        odometry = tracker(replace(SMALL, scale=scale))
        for frame in frames(10):
            odometry.track(frame)
        results.append(odometry.finish())
    assert np.array_equal(results[0].trajectory.poses_wc, results[1].trajectory.poses_wc)
    assert not results[1].metric and results[1].info["scale"]["unit"] == "arbitrary"


def frame_with(right):
    return Frame(7, 0.0, np.zeros((48, 64, 3), np.uint8), CAMERA, right=right)


IMAGE, SMALLER = np.zeros((48, 64, 3), np.uint8), Camera(50.0, 50.0, 31.5, 22.5, 64, 46)
LENS = Camera(50.0, 50.0, 31.5, 23.5, 64, 48, "radtan", (0.1, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("right", "match"),
    [
        (IMAGE, "expected a StereoView"),
        (StereoView(IMAGE[:46], SMALLER, PARALLEL), "is 64x46, the left image 64x48"),
        (StereoView(IMAGE, SMALLER, PARALLEL), "camera"),
        (StereoView(IMAGE.astype(int), CAMERA, PARALLEL), "image"),
        (StereoView(IMAGE, LENS, PARALLEL), "distortion"),
        (StereoView(IMAGE, CAMERA, PARALLEL[:3]), "no pose"),
        (StereoView(IMAGE, CAMERA, np.array([np.nan, 0, 0, 0, 0, 0, 1])), "no pose"),
        (StereoView(IMAGE, CAMERA, np.array([0, 0, 0, 0, 0, 0, 1.0])), "at one place"),
    ],
)
def test_a_right_image_of_another_form_is_refused(right, match):
    with pytest.raises(DvoError, match=f"frame 7: right.*{match}"):
        right_view(frame_with(right), 64, 48)


def test_the_right_image_is_resized_with_its_camera():
    view = right_view(frame_with(StereoView(IMAGE, CAMERA, TURNED / np.linalg.norm(TURNED[3:]))), 32, 24)
    assert view.image.shape == (24, 32, 3)
    np.testing.assert_allclose(view.intrinsics, CAMERA.resized(32, 24).intrinsics)
    np.testing.assert_allclose(view.pose_right_left, invert_poses(TURNED / np.linalg.norm(TURNED[3:])))
    assert right_view(frame_with(None), 32, 24) is None
