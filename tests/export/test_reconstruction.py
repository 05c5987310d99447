"""Images, points and observations of a keyframe graph: exact on a walk whose measurements and poses are exact."""

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.export.reconstruction import PointOptions, longest_segment, reconstruct
from dvo.map.io.serialisation import load_graph, save_graph
from dvo.map.keyframe_log import FrameRecord
from tests.support.archived_walk import INTRINSICS, M
from tests.support.reconstructions import SIDE, image, walk


def reprojected(found):
    """``(O, 2)`` pixels of the points in the images in which they are observed."""
    T_cw, points = found.T_cw[found.image_of], found.points[found.point_of]
    seen = np.einsum("oij,oj->oi", T_cw[:, :3, :3], points) + T_cw[:, :3, 3]
    assert (seen[:, 2] > 0).all()
    intrinsics = np.array([camera.intrinsics for camera in found.cameras])[found.camera_of][found.image_of]
    return seen[:, :2] / seen[:, 2:] * intrinsics[:, :2] + intrinsics[:, 2:]


def test_points_are_seen_where_they_were_measured():
    graph = walk(12)
    found = reconstruct(graph, 0)
    (camera,) = found.cameras
    assert (camera.width, camera.height) == (SIDE, SIDE)
    np.testing.assert_allclose(camera.intrinsics, 4 * INTRINSICS.numpy(), rtol=1e-6)
    assert found.identifiers.tolist() == list(range(12)) and found.without_image == 0
    np.testing.assert_allclose(found.timestamps, 0.1 * np.arange(12))
    offsets = np.linalg.norm(reprojected(found) - found.positions, axis=1)
    np.testing.assert_allclose(offsets, found.residuals, atol=1e-9)
    assert offsets.max() < 0.01
    assert 0.7 * 12 * M < len(found.points) <= 12 * M
    # Every point is observed in its own keyframe too, exactly there.
    own = np.unique(found.point_of[found.residuals == 0])
    assert len(own) == len(found.points)
    np.testing.assert_array_equal(found.positions[found.residuals == 0] % 4, 0)
    assert np.bincount(found.point_of).min() >= 2
    pairs = list(zip(found.image_of.tolist(), found.point_of.tolist(), strict=True))
    assert pairs == sorted(set(pairs))
    sums = np.bincount(found.point_of, offsets) / np.bincount(found.point_of)
    np.testing.assert_allclose(found.errors, sums, atol=1e-9)
    assert found.mean_error == pytest.approx(offsets.mean(), abs=1e-9)


def test_dropped_keyframes_give_points_but_no_image():
    graph = walk(12, dropped=(3, 4, 8))
    found = reconstruct(graph, 0)
    assert found.identifiers.tolist() == [0, 1, 2, 5, 6, 7, 9, 10, 11] and len(found.jpegs) == 9
    offsets = np.linalg.norm(reprojected(found) - found.positions, axis=1)
    assert offsets.max() < 0.02
    without_own = set(range(len(found.points))) - set(found.point_of[found.residuals == 0].tolist())
    assert 0 < len(without_own) <= 3 * M


def test_images_are_those_of_their_keyframes():
    import cv2

    found = reconstruct(walk(5), 0)
    for identifier, jpeg, name in zip(found.identifiers.tolist(), found.jpegs, found.names, strict=True):
        decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        assert np.abs(decoded.astype(int) - image(identifier)).max() < 8
        assert name == f"{identifier:06d}.jpg"


def test_wrong_and_weak_measurements_are_no_observations():
    exact = reconstruct(walk(10), 0)
    graph = walk(10, wrong=0.3)
    found = reconstruct(graph, 0)
    assert found.residuals.max() < 0.01
    assert 0.6 * len(exact.residuals) < len(found.residuals) < 0.85 * len(exact.residuals)
    loose = reconstruct(graph, 0, PointOptions(max_error=20.0))
    assert loose.residuals.max() == pytest.approx(4 * np.hypot(3, 1), abs=0.1)
    with_weak = reconstruct(walk(10), 0, PointOptions(min_weight=0.6))  # all weights are 0.5
    assert len(with_weak.points) == 0 and with_weak.mean_error == 0.0
    alone = reconstruct(walk(10), 0, PointOptions(min_weight=0.6, min_images=1))
    assert len(alone.points) == len(alone.residuals) == 10 * M


def test_points_observed_in_more_images():
    graph = walk(10)
    few, many = (reconstruct(graph, 0, PointOptions(min_images=count)) for count in (2, 5))
    assert 0 < len(many.points) < len(few.points)
    assert np.bincount(many.point_of).min() >= 5


def test_points_whose_depth_is_uncertain_are_left_out():
    graph = walk(6)
    before = reconstruct(graph, 0)
    depth = graph.archive[2].inverse_depth.copy()
    depth[0], depth[1] = 1e-4, np.nan
    depth[2] = -1.0
    graph.archive.set_pose(2, graph.archive[2].pose_cw, depth)
    depth_ok = reconstruct(graph, 0)
    assert np.isfinite(depth_ok.points).all()
    assert len(before.points) - 3 <= len(depth_ok.points) < len(before.points)


def test_keyframes_whose_image_has_been_released_are_counted():
    graph = walk(8, max_bytes=walk(8).archive.nbytes - 1)
    found = reconstruct(graph, 0)
    assert found.without_image == 8 - len(found.jpegs) > 0
    assert "without an image left out" in str(found)
    assert found.image_of.max() == len(found.jpegs) - 1


def test_no_images_and_no_keyframes_are_told():
    with pytest.raises(DvoError, match=r"segment 0: no keyframe has its image. Track with ArchiveConfig"):
        reconstruct(walk(4, images=False), 0)
    with pytest.raises(DvoError, match="segment 3: no archived keyframes"):
        reconstruct(walk(4), 3)


def test_longest_segment():
    graph = walk(4)
    assert longest_segment(graph) == 0
    graph.log.frames += [FrameRecord(1.0 + 0.1 * i, 3, segment=1) for i in range(5)]
    graph.log.frames += [FrameRecord(3.0 + 0.1 * i, None, lost=True, segment=2) for i in range(9)]
    assert longest_segment(graph) == 1


def test_options_out_of_range():
    with pytest.raises(DvoError, match="min_images"):
        PointOptions(min_images=0)


def test_masks_of_keyframes_go_along_and_a_keyframe_without_one_uses_all(tmp_path):
    import cv2

    mask = np.ones((SIDE, SIDE), bool)
    mask[:20] = False
    graph = walk(5, dropped=(2,), masks={1: mask})
    save_graph(tmp_path / "a.dvo", graph)
    for kept in (graph, load_graph(tmp_path / "a.dvo")):
        found = reconstruct(kept, 0)
        decoded = [cv2.imdecode(np.frombuffer(one, np.uint8), cv2.IMREAD_UNCHANGED) for one in found.masks]
        assert found.identifiers.tolist() == [0, 1, 3, 4] and len(decoded) == 4 and "4 images with masks" in str(found)
        np.testing.assert_array_equal(decoded[1], 255 * mask.astype(np.uint8))
        assert all((one == 255).all() and one.shape == mask.shape for one in decoded[:1] + decoded[2:])
    assert not reconstruct(walk(5), 0).masks
