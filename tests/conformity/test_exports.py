"""Exports read by the programs that they are for, and by their documented layouts.

COLMAP's own reader of both forms is also in ``tests/export/test_colmap.py``, evo's of other values in
``tests/export/test_trajectories.py``.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import dvo
from dvo.data.trajectory import Trajectory
from dvo.export.colmap import write_colmap, write_colmap_text
from dvo.export.nerfstudio import write_nerfstudio
from dvo.export.reconstruction import Reconstruction, reconstruct
from dvo.geometry.poses import pose_matrices
from dvo.synth.export import export_sequence
from dvo.synth.sequence import SyntheticSequence, make_sequence
from tests.support.reconstructions import walk

pytestmark = pytest.mark.peers


@pytest.fixture(scope="module")
def found() -> Reconstruction:
    """Reconstruction of a walk of twelve frames, without errors of measurement."""
    return reconstruct(walk(), 0)


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    """Four clean rendered frames."""
    return make_sequence(3, frames=4, height=48, width=64, family="room", sensor=False)


def trajectory() -> Trajectory:
    rng = np.random.default_rng(0)
    poses = rng.normal(size=(30, 7))
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return Trajectory(1.4e9 + np.cumsum(rng.uniform(0.02, 0.2, 30)).round(6), poses)


@pytest.mark.parametrize("write", [write_colmap, write_colmap_text])
def test_colmap_projects_points_where_they_are_seen(write, found: Reconstruction, tmp_path: Path) -> None:
    """By its own poses, cameras and tracks, for every observation."""
    pycolmap = pytest.importorskip("pycolmap", reason="pip install pycolmap")
    write(found, tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    count = 0
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.images[element.image_id]
            seen = image.points2D[element.point2D_idx].xy
            projected = image.project_point(point.xyz)
            assert np.linalg.norm(projected - seen) < 0.05
            count += 1
    assert count == model.compute_num_observations() > 100
    for number, image in model.images.items():
        assert (tmp_path / "images" / image.name).is_file()
        size = cv2.imread(str(tmp_path / "images" / image.name)).shape
        assert size[:2] == (image.camera.height, image.camera.width)
        matrix = image.cam_from_world().matrix() if callable(image.cam_from_world) else image.cam_from_world.matrix()
        np.testing.assert_allclose(matrix, found.T_cw[number - 1][:3], atol=1e-9)


def test_transforms_of_nerfstudio(found: Reconstruction, tmp_path: Path) -> None:
    """Its documentation: camera x right, y up, looking along -z; ``transform_matrix`` to the world, z up; the principal
    point from the corner of the first pixel."""
    write_nerfstudio(found, tmp_path)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert content["camera_model"] == "OPENCV" and all(content[name] == 0 for name in ("k1", "k2", "p1", "p2"))
    assert len(content["frames"]) == len(found.T_cw)
    turn = np.array(content["applied_transform"])
    points = found.points @ turn[:, :3].T + turn[:, 3]
    for row, frame in enumerate(content["frames"]):
        assert (tmp_path / frame["file_path"]).is_file()
        matrix = np.array(frame["transform_matrix"])
        np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
        local = (points - matrix[:3, 3]) @ matrix[:3, :3]
        u = content["cx"] + content["fl_x"] * local[:, 0] / -local[:, 2]
        v = content["cy"] - content["fl_y"] * local[:, 1] / -local[:, 2]
        mine = found.image_of == row
        seen = np.column_stack([u, v])[found.point_of[mine]]
        assert mine.sum() > 5 and (local[found.point_of[mine], 2] < 0).all()
        np.testing.assert_allclose(seen - 0.5, found.positions[mine], atol=0.05)
    up = np.array([0.0, -1, 0]) @ turn[:, :3].T  # dvo's y is down
    np.testing.assert_allclose(up, [0, 0, 1])


@pytest.mark.parametrize("format", ["tum", "kitti", "euroc"])
def test_evo_reads_trajectories(format: str, tmp_path: Path) -> None:
    interface = pytest.importorskip("evo.tools.file_interface", reason="evo is in the extra 'eval'")
    given = trajectory()
    dvo.export_trajectory(given, tmp_path / "out", format)
    (file,) = [path for path in (tmp_path / "out").iterdir() if path.name != "times.txt"]
    read = {
        "tum": interface.read_tum_trajectory_file,
        "kitti": interface.read_kitti_poses_file,
        "euroc": interface.read_euroc_csv_trajectory,
    }[format]
    theirs = read(file)
    np.testing.assert_allclose(theirs.poses_se3, pose_matrices(given.poses_wc), atol=1e-8)
    if format != "kitti":
        np.testing.assert_allclose(theirs.timestamps, given.timestamps, atol=1e-6, rtol=0)


@pytest.mark.long
def test_tum_layout(sequence: SyntheticSequence, tmp_path: Path) -> None:
    """Its documentation: lists of ``timestamp filename``, 16-bit depth of 5000 to a metre, poses that evo reads."""
    interface = pytest.importorskip("evo.tools.file_interface", reason="evo is in the extra 'eval'")
    export_sequence(sequence, tmp_path / "tum", "tum")
    theirs = interface.read_tum_trajectory_file(tmp_path / "tum" / "groundtruth.txt")
    np.testing.assert_allclose(theirs.poses_se3, pose_matrices(sequence.groundtruth.poses_wc), atol=1e-6)
    camera = sequence.camera
    clouds = []
    rows = [line.split() for line in (tmp_path / "tum" / "depth.txt").read_text().splitlines() if line[0] != "#"]
    for (stamp, name), matrix in zip(rows, theirs.poses_se3, strict=True):
        depth = cv2.imread(str(tmp_path / "tum" / name), cv2.IMREAD_UNCHANGED) / 5000
        assert float(stamp) in theirs.timestamps and (depth > 0).mean() > 0.9
        v, u = np.nonzero(depth)
        z = depth[v, u]
        local = np.column_stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
        clouds.append(local @ matrix[:3, :3].T + matrix[:3, 3])
    distance = np.linalg.norm(clouds[0][:, None] - clouds[1][None], axis=-1).min(1)
    assert np.median(distance) < 0.05 * np.median(np.linalg.norm(clouds[0] - theirs.positions_xyz[0], axis=1))


@pytest.mark.long
def test_tartanair_layout(sequence: SyntheticSequence, tmp_path: Path) -> None:
    """Its documentation: depth in metres, camera x forward, y right, z down, flow in pixels with a mask that is 0 where
    it is valid: points of one frame, moved by the poses, land where the flow says."""
    export_sequence(sequence, tmp_path / "air", "tartanair")
    poses = pose_matrices(np.loadtxt(tmp_path / "air" / "pose_left.txt"))
    fx, fy, cx, cy = np.loadtxt(tmp_path / "air" / "calib.txt")[:4]
    for index in range(3):
        depth = np.load(tmp_path / "air" / "depth_left" / f"{index:06d}_left_depth.npy")
        flow, mask = (
            np.load(tmp_path / "air" / "flow" / f"{index:06d}_{index + 1:06d}_{kind}.npy") for kind in ("flow", "mask")
        )
        assert depth.dtype == flow.dtype == np.float32 and mask.dtype == np.uint8 and flow.shape == (48, 64, 2)
        v, u = np.mgrid[:48, :64]
        forward, right, down = depth, (u - cx) / fx * depth, (v - cy) / fy * depth
        local = np.stack([forward, right, down, np.ones_like(depth)], -1)
        moved = local @ (np.linalg.inv(poses[index + 1]) @ poses[index]).T
        x, y = moved[..., 1] / moved[..., 0] * fx + cx, moved[..., 2] / moved[..., 0] * fy + cy
        valid = (mask == 0) & (depth > 0)
        assert valid.mean() > 0.5
        np.testing.assert_allclose(flow[valid], np.stack([x - u, y - v], -1)[valid], atol=1e-3)
