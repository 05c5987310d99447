"""Images of a recording: the sharpest of each stretch, size and masks, and the observations of a graph in them."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.trajectory import Trajectory
from dvo.export.reconstruction import observe, reconstruct
from dvo.export.recorded import ImageChoice, recorded_images, sharpness
from dvo.geometry.camera import Camera
from dvo.geometry.poses import poses_from_matrices
from tests.support.reconstructions import SIDE, walk

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
NOISE = np.random.default_rng(0).integers(0, 255, (48, 64, 3), np.uint8)


def clip(count, sharp=(), mask=None):
    """Frames, of which those named are sharper, and poses on a line."""
    images = [NOISE if k in sharp else cv2.blur(NOISE, (5, 5)) for k in range(count)]
    frames = [Frame(k, 0.1 * k, image, CAMERA, mask=mask) for k, image in enumerate(images)]
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (count, 1))
    poses[:, 0] = np.arange(count)
    return frames, Trajectory(0.1 * np.arange(count), poses)


@pytest.mark.parametrize("choice", [ImageChoice(every=3), ImageChoice(count=3)])
def test_the_sharpest_image_of_each_stretch(choice):
    sharp = (2, 5, 7)
    with recorded_images(*clip(9, sharp), choice) as found:
        assert found.identifiers.tolist() == list(sharp) and found.T_cw[:, 0, 3].tolist() == [-2.0, -5.0, -7.0]
        assert found.cameras == (CAMERA,) and not found.masks
        assert cv2.imdecode(np.frombuffer(found.jpegs[1], np.uint8), cv2.IMREAD_COLOR).shape == (48, 64, 3)


def test_a_blurred_image_is_less_sharp_whatever_its_size():
    for factor in (1, 30):
        image = cv2.resize(NOISE, None, fx=factor, fy=factor, interpolation=cv2.INTER_NEAREST)
        assert sharpness(image) > 2 * sharpness(cv2.blur(image, (3 * factor, 3 * factor)))


@given(st.integers(1, 400), st.integers(1, 60))
def test_stretches(poses, number):
    by_count = [ImageChoice(count=number).stretch(row, poses) for row in range(poses)]
    lengths = np.bincount(by_count)
    assert len(lengths) == min(number, poses) and np.ptp(lengths) <= 1 and by_count == sorted(by_count)
    by_length = [ImageChoice(every=number).stretch(row, poses) for row in range(poses)]
    assert max(np.bincount(by_length)) == min(number, poses) and by_length == sorted(by_length)


def test_masks_come_along():
    used = np.ones((48, 64), bool)
    used[40:] = False
    with recorded_images(*clip(4, mask=used), ImageChoice(every=2)) as found:
        masks = [cv2.imdecode(np.frombuffer(mask, np.uint8), cv2.IMREAD_UNCHANGED) for mask in found.masks]
    assert len(masks) == 2
    for mask in masks:
        np.testing.assert_array_equal(mask, np.where(used, 255, 0))


def test_frames_without_a_pose_are_no_images():
    frames, trajectory = clip(6)
    few = Trajectory(trajectory.timestamps[1:3], trajectory.poses_wc[1:3])
    with recorded_images(frames, few) as found:
        assert found.identifiers.tolist() == [1, 2]
    other = Trajectory(trajectory.timestamps + 0.05, trajectory.poses_wc)
    with pytest.raises(DvoError, match="no image of the source has the time of a pose"), recorded_images(frames, other):
        pass


def larger(graph, keyframes, factor=2.5):
    """Images at the frames of some keyframes, larger than those that were tracked, and frames between."""
    whole = reconstruct(graph, 0)
    (camera,) = whole.cameras
    size = round(factor * SIDE)
    chosen = np.flatnonzero(np.isin(whole.identifiers, keyframes))
    image = np.zeros((size, size, 3), np.uint8)
    times = np.sort(np.append(whole.timestamps[chosen], whole.timestamps[0] + 0.03))
    poses = poses_from_matrices(np.linalg.inv(whole.T_cw[chosen]))
    poses = np.insert(poses, 1, poses[0], axis=0)
    frames = [Frame(k, time, image, camera.resized(size, size)) for k, time in enumerate(times.tolist())]
    return frames, Trajectory(times, poses)


def test_measurements_are_brought_to_larger_images():
    """Positions and points agree by the intrinsics of the images, half a pixel included."""
    graph = walk(12, dropped=(5,))
    with recorded_images(*larger(graph, [0, 2, 3])) as images:
        found = observe(graph, 0, images)
    assert len(found.identifiers) == 4 and len(found.residuals) > 20
    assert not (found.image_of == 1).any(), "an image between two keyframes has no measurement"
    (camera,) = found.cameras
    for image, point, position, residual in zip(
        found.image_of, found.point_of, found.positions, found.residuals, strict=True
    ):
        seen = found.T_cw[image] @ [*found.points[point], 1]
        projected = seen[:2] / seen[2] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        assert np.linalg.norm(projected - position) == pytest.approx(residual, abs=1e-3) and residual < 0.1
    views = np.bincount(found.point_of, minlength=len(found.points))
    assert set(np.unique(views)) > {0, 2}, "points that too few images see are there, without observations"
    assert not (views == 1).any()


def test_images_with_other_poses_are_not_of_the_graph():
    graph = walk(12)
    frames, trajectory = larger(graph, [0, 2, 3, 4])
    moved = replace(trajectory, poses_wc=trajectory.poses_wc + [0.1, 0, 0, 0, 0, 0, 0])
    with recorded_images(frames, moved) as images:
        assert observe(graph, 0, images) is images
