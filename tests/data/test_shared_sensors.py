"""Depth, right images and inertial samples of the real sequences agree with their images."""

import bz2
import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from dvo.data import Frame, open_source
from dvo.data.calibration.read import read_calibration
from dvo.geometry.poses import pose_matrices


def matches(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Normalised coordinates ``(M, 3)`` of points that look alike in the left and in the right image."""
    orb, matcher = cv2.ORB_create(2000), cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    found = [orb.detectAndCompute(image, None) for image in (frame.image, frame.right.image)]
    pairs = [m for m in matcher.match(found[0][1], found[1][1]) if m.distance < 30]
    assert len(pairs) > 30
    pixels = (
        np.array([found[0][0][m.queryIdx].pt for m in pairs]),
        np.array([found[1][0][m.trainIdx].pt for m in pairs]),
    )
    cameras = (frame.camera, frame.right.camera)
    rays = [
        np.column_stack([(p - [c.cx, c.cy]) / [c.fx, c.fy], np.ones(len(p))])
        for p, c in zip(pixels, cameras, strict=True)
    ]
    return rays[0], rays[1]


def depths_by_stereo(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Distance of the matches to their epipolar lines in pixels, and their depth in metres in the left camera."""
    left, right = matches(frame)
    T = pose_matrices(frame.right.T_left_right)
    x, y, z = T[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ T[:3, :3]  # left^T E right = 0
    lines = right @ essential.T
    distance = np.abs((left * lines).sum(1)) / np.linalg.norm(lines[:, :2], axis=1) * frame.camera.fx
    # depth along the left ray: s left - t (R right) = centre, least squares
    turned = right @ T[:3, :3].T
    depths = [
        np.linalg.lstsq(np.column_stack([a, -b]), T[:3, 3], rcond=None)[0][0] for a, b in zip(left, turned, strict=True)
    ]
    return distance, np.array(depths)


def euroc(data_root: Path, folder: Path) -> Path:
    """The shared keyframes as the raw layout has them."""
    shared = data_root / "euroc_V1_01"
    for camera in (0, 1):
        images = folder / f"mav0/cam{camera}/data"
        images.mkdir(parents=True)
        for image in sorted((shared / "keyframes_100_stereo_jpg").glob(f"*_{camera}.jpg"))[:40]:
            (images / image.name.replace(f"_{camera}.jpg", ".jpg")).symlink_to(image)
        (images.parent / "sensor.yaml").symlink_to(shared / f"cam{camera}_sensor.yaml")
    imu = folder / "mav0/imu0"
    imu.mkdir()
    rows = bz2.decompress((shared / "imu0_data.csv.bz2").read_bytes()).decode().splitlines()[:12000]
    (imu / "data.csv").write_text("\n".join(rows))
    (imu / "sensor.yaml").symlink_to(shared / "imu0_sensor.yaml")
    return folder


def test_euroc_stereo_and_inertial(data_root, tmp_path):
    source = open_source(euroc(data_root, tmp_path))
    frames = list(source)
    pair = frames[10]
    assert pair.right.baseline == pytest.approx(0.11, abs=0.001)
    distance, depths = depths_by_stereo(pair)
    good = distance < 2
    assert good.mean() > 0.8 and np.median(distance[good]) < 0.6  # undistorted, extrinsics the right way round
    assert (depths[good] > 0).mean() > 0.9 and 1 < np.median(depths[good]) < 10  # a room

    assert all(frame.inertial is not None for frame in frames)
    still = frames[1].inertial  # the drone stands for the first seconds
    span = frames[1].timestamp - frames[0].timestamp
    assert len(still) == pytest.approx(200 * span, abs=2) and np.diff(still.timestamps).max() < 0.006
    force = still.accel[:1000].mean(0)
    assert np.linalg.norm(force) == pytest.approx(9.81, abs=0.5)
    # gravity pulls down in the image, which the camera's y axis points to: the force on the sensor points up
    up = pose_matrices(still.T_camera_imu)[:3, :3] @ force
    assert up[1] < -6


def test_kitti_stereo(data_root, tmp_path):
    shared = data_root / "kitti00_120"
    folder = tmp_path / "sequences/00"
    folder.mkdir(parents=True)
    for name in ("image_0", "image_1", "times.txt"):
        (folder / name).symlink_to(shared / name)
    K = "718.856 0 607.1928 {} 0 718.856 185.2157 0 0 0 1 0"
    (folder / "calib.txt").write_text(f"P0: {K.format(0)}\nP1: {K.format(-386.1448)}\n")
    raw = open_source(folder, stride=60)
    calib = tmp_path / "calib.yaml"
    calib.write_text("{fx: 718.856, fy: 718.856, cx: 607.1928, cy: 185.2157, baseline: 0.53716}")
    plain = open_source(shared, calib=calib, stride=60)
    assert (raw.kind, plain.kind) == ("kitti", "sequence")
    first, second = (list(source) for source in (raw, plain))
    assert first[0].right.baseline == pytest.approx(0.53716, abs=1e-5) and second[0].right.baseline == 0.53716
    assert np.array_equal(first[0].right.image, second[0].right.image)
    distance, depths = depths_by_stereo(first[0])
    good = distance < 2
    assert good.mean() > 0.8 and np.median(distance[good]) < 0.6
    assert (depths[good] > 0).mean() > 0.95 and 5 < np.median(depths[good]) < 60  # a street
    # the right images of the last 20 frames were not copied
    assert [frame.index for frame in open_source(folder, stride=33) if frame.right is not None] == [0, 33, 66, 99]
    assert [frame.right is None for frame in open_source(folder, stride=110)] == [False, True]


def test_tartanair_v2_depth_and_stereo_agree(data_root):
    frames = list(open_source(data_root / "tartanair_v2_10", stride=2))
    pairs = [frame for frame in frames if frame.right is not None]
    assert pairs and all(frame.depth is not None for frame in frames)
    frame = pairs[0]
    shift = frame.camera.fx * frame.right.baseline / frame.depth  # right images see a point further left
    u, v = np.meshgrid(np.arange(640, dtype=np.float32), np.arange(640, dtype=np.float32))
    warped = cv2.remap(frame.right.image, u - shift, v, cv2.INTER_LINEAR)
    inside = (u - shift > 1) & np.isfinite(shift)
    error = np.abs(warped.astype(float) - frame.image).mean(2)[inside]
    unmoved = np.abs(frame.right.image.astype(float) - frame.image).mean(2)[inside]
    assert np.median(error) < 6 and np.median(error) < 0.6 * np.median(unmoved)


def test_tartanair_v1_depth(data_root):
    known = {f.index: f.depth for f in open_source(data_root / "tartanair_v1_60", stride=20) if f.depth is not None}
    assert sorted(known) == [0, 20, 40]
    assert all(0.2 < np.nanmedian(depth) < 50 and depth.shape == (480, 640) for depth in known.values())


@pytest.mark.parametrize(("name", "unit"), [("tum_fr1_rpy_60", None), ("tum_fr1_xyz_10_rgbd", 5000)])
def test_tum_depth_is_that_of_a_desk(data_root, name, unit):
    folder = data_root / name
    calib = dataclasses.replace(read_calibration(folder / "calib.txt"), depth_scale=unit) if unit else None
    frames = list(open_source(folder, calib=calib, stride=5))
    depths = [frame.depth for frame in frames]
    assert all(depth is not None and depth.dtype == np.float32 for depth in depths)
    assert all(0.5 < np.nanmedian(d) < 4 and 0.4 < np.isfinite(d).mean() < 1 for d in depths)
    # the Kinect loses depth on edges and far walls, never to a value near the lens
    assert min(np.nanmin(d) for d in depths) > 0.3


def test_7scenes_depth_in_millimetres(data_root):
    folder = data_root / "7scenes_redkitchen_400"
    calib = dataclasses.replace(read_calibration(folder / "calib.txt"), depth_scale=1000)
    frames = list(open_source(folder, calib=calib, stride=50))
    known = [frame.depth for frame in frames if frame.depth is not None]
    assert [frame.index for frame in frames if frame.depth is not None] == [0, 50, 100, 200, 300]
    assert all(0.5 < np.nanmedian(d) < 5 and np.nanmax(d) < 20 for d in known)  # 65535 is not 65 m
