"""Every real sequence of the shared data opens, and says what its README says."""

import csv
from pathlib import Path

import numpy as np
import pytest

from dvo.data import open_source, read_tum
from dvo.geometry.poses import pose_matrices

CLIPS = [
    ("kitti00_120", "sequence", 120, (1241, 376), (718.856, 607.1928), 91.97),
    ("7scenes_redkitchen_400", "sequence", 400, (640, 480), (525, 320), 3.0),
    ("tartanair_v1_60", "tartanair", 60, (640, 480), (320, 320), 5.15),
    ("tum_fr1_rpy_60", "tum", 60, (640, 480), (517.3, 318.6), 0.27),
    ("tartanair_v2_10", "tartanair", 10, (640, 640), (320, 320), 2.45),
    ("tum_fr1_xyz_10_rgbd", "sequence", 10, (640, 480), (517.3, 318.6), 0.11),
    ("euroc_V1_01", "sequence", 100, (752, 480), (458.654, 367.215), 49.4),
]


@pytest.mark.long
@pytest.mark.parametrize(("name", "kind", "count", "size", "intrinsics", "path"), CLIPS, ids=[c[0] for c in CLIPS])
def test_sequences(data_root, name, kind, count, size, intrinsics, path):
    source = open_source(data_root / name, stride=10 if count > 100 else 3)
    frames = list(source)
    assert (source.kind, source.name, source.skipped) == (kind, name, 0)
    assert source.frame_count == len(frames) == -(-count // source.stride)
    recorded = source.recorded_camera
    assert (recorded.width, recorded.height) == size and (recorded.fx, recorded.cx) == intrinsics
    assert not source.camera.is_distorted and frames[0].image.shape == (size[1], size[0], 3)
    assert 20 < frames[0].image.mean() < 235 and frames[0].image.std() > 15

    truth = source.groundtruth
    assert len(truth) == count and truth.path_length == pytest.approx(path, rel=0.02)
    times = np.array([frame.timestamp for frame in frames])
    # one row of truth for every frame, at its time
    assert np.abs(truth.timestamps[[frame.index for frame in frames]] - times).max() < 1e-5
    stored = read_tum(next((data_root / name).glob("*groundtruth*_tum.txt")))
    assert np.abs(pose_matrices(truth.poses_wc) - pose_matrices(stored.poses_wc)).max() < 1e-6


def test_standing_still(data_root):
    folder = data_root / "euroc_V1_01/static_start_20hz"
    for source, calib in ((folder, "../calib.txt"), (folder / "cam0", "../../calib.txt")):
        frames = list(open_source(source, calib=calib, stride=5))
        assert [frame.timestamp for frame in frames] == pytest.approx(1403715273.262143 + np.arange(4) / 4, abs=1e-5)
        assert np.abs(frames[0].image.astype(int) - frames[-1].image).mean() < 4


@pytest.mark.parametrize(
    ("images", "kind"), [("kitti00_120/image_0", "folder"), ("7scenes_redkitchen_400/color", "folder")]
)
def test_image_folders_with_options_relative_to_them(data_root, images, kind):
    options = {"calib": "../calib.txt", "times": "../groundtruth_tum.txt", "groundtruth": "../groundtruth_tum.txt"}
    source = open_source(data_root / images, stride=40, **options)
    assert source.kind == kind and source.warnings == []
    times = [frame.timestamp for frame in source]
    assert times == source.groundtruth.timestamps[::40].tolist()


def test_tum_motion_capture_is_interpolated_to_the_images(data_root, tmp_path):
    original = data_root / "tum_fr1_rpy_60"
    folder = tmp_path / "rgbd_dataset_freiburg1_rpy"
    folder.mkdir()
    for name in ("rgb", "rgb.txt", "groundtruth.txt"):
        (folder / name).symlink_to(original / name)
    source = open_source(folder)
    expected = read_tum(original / "groundtruth_tum.txt")
    assert source.recorded_camera.coefficients[-1] == 1.1633  # by the folder's name
    assert np.abs(source.groundtruth.timestamps - expected.timestamps).max() < 1e-6
    assert np.abs(pose_matrices(source.groundtruth.poses_wc) - pose_matrices(expected.poses_wc)).max() < 1e-4


def test_euroc_layout_from_the_real_keyframes(data_root: Path, tmp_path: Path):
    """The shared folder's camera poses (checked against the images) come out of the raw layout, T_BS and all."""
    shared = data_root / "euroc_V1_01"
    camera, state = tmp_path / "mav0/cam0", tmp_path / "mav0/state_groundtruth_estimate0"
    (camera / "data").mkdir(parents=True)
    state.mkdir()
    left = sorted((shared / "keyframes_100_stereo_jpg").glob("*_0.jpg"))
    with open(camera / "data.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["#timestamp [ns]", "filename"])
        for image in left:
            name = image.name.replace("_0.jpg", ".jpg")
            (camera / "data" / name).symlink_to(image)
            writer.writerow([name.removesuffix(".jpg"), name])
    (camera / "sensor.yaml").symlink_to(shared / "cam0_sensor.yaml")
    bodies = read_tum(shared / "groundtruth_imu_openvins_corrected.txt")
    with open(state / "data.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["#timestamp", "p_RS_R_x [m]"])
        for time, (x, y, z, qx, qy, qz, qw) in zip(bodies.timestamps, bodies.poses_wc, strict=True):
            writer.writerow([round(time * 1e9), x, y, z, qw, qx, qy, qz])

    source = open_source(tmp_path, stride=25)
    assert source.kind == "euroc" and len(list(source)) == 4
    expected = read_tum(shared / "keyframes_groundtruth_cam0_tum.txt")
    truth = source.groundtruth
    rows = np.array([int(np.abs(expected.timestamps - time).argmin()) for time in truth.timestamps])
    assert len(truth) >= 98 and np.abs(expected.timestamps[rows] - truth.timestamps).max() < 1e-6
    found, wanted = pose_matrices(truth.poses_wc), pose_matrices(expected.poses_wc[rows])
    assert np.abs(found[:, :3, 3] - wanted[:, :3, 3]).max() < 2e-3
    angle = np.arccos(np.clip((np.einsum("nij,nij->n", found[:, :3, :3], wanted[:, :3, :3]) - 1) / 2, -1, 1))
    assert np.rad2deg(angle).max() < 0.1
