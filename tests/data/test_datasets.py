"""Each dataset's layout, in miniature."""

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import open_source
from dvo.geometry.poses import pose_matrices

S = np.sqrt(0.5)


# --- TUM RGB-D


def tum(make, name="rgbd_dataset_freiburg2_desk", listing=True, size=(640, 480)):
    stamps = [f"{10 + i / 10:.6f}" for i in range(5)]
    make.images(f"{name}/rgb", [f"{stamp}.png" for stamp in stamps], *size)
    if listing:
        rows = [f"{stamp} rgb/{stamp}.png" for stamp in stamps]
        make.text(f"{name}/rgb.txt", "# color images\n# timestamp filename\n" + "\n".join(rows))
    # 50 Hz from 10.09 on: the first image has no truth
    rows = [f"{10.09 + i * 0.02:.4f} {i} 0 0 0 0 0 1" for i in range(20)]
    make.text(f"{name}/groundtruth.txt", "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows))
    return make.root / name


@pytest.mark.parametrize("listing", [True, False])
def test_tum(make, listing):
    source = open_source(tum(make, listing=listing))
    assert source.kind == "tum" and source.recorded_camera.fx == 520.9 and source.recorded_camera.is_distorted
    assert not source.camera.is_distorted
    assert [frame.timestamp for frame in source] == pytest.approx([10, 10.1, 10.2, 10.3, 10.4])
    assert source.groundtruth.timestamps == pytest.approx([10.1, 10.2, 10.3, 10.4])
    assert source.groundtruth.positions[:, 0] == pytest.approx([0.5, 5.5, 10.5, 15.5])  # interpolated
    assert any("4 of 5" in warning for warning in source.warnings)


def test_tum_calibrations(make):
    assert open_source(tum(make, "rgbd_dataset_freiburg1_xyz")).recorded_camera.coefficients[-1] == 1.1633
    assert open_source(tum(make, "fr3_office")).recorded_camera.fx == 535.4
    folder = tum(make, "own")
    with pytest.raises(DvoError, match="no calibration"):
        open_source(folder)
    make.text("own/calib.txt", "400 400 320 240")
    assert open_source(folder).camera.fx == 400
    make.text("other.txt", "410 410 320 240")
    assert open_source(folder, calib=make.root / "other.txt").camera.fx == 410


def test_tum_of_another_size_does_not_take_the_published_intrinsics(make):
    with pytest.raises(DvoError, match="640x480 images, but these are 320x240"):
        open_source(tum(make, size=(320, 240)))


def test_tum_missing_and_unsorted_images(make):
    folder = tum(make)
    text = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join(text[::-1]) + "\n10.150 rgb/gone.png\n")
    source = open_source(folder)
    assert [frame.timestamp for frame in source] == pytest.approx([10, 10.1, 10.2, 10.3, 10.4])
    assert source.skipped == 1 and "gone.png" in source.warnings[-1]
    (folder / "rgb.txt").write_text("10.0\n")
    with pytest.raises(DvoError, match="line 1.*timestamp filename"):
        open_source(folder)


# --- EuRoC

EUROC_SENSOR = """%YAML:1.0
T_BS:
  cols: 4
  rows: 4
  data: [0, -1, 0, 0.1,
         1, 0, 0, 0.2,
         0, 0, 1, 0.3,
         0.0, 0.0, 0.0, 1.0]
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50, 51, 31, 23]
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.01, 0.0, 0.0]
"""


def euroc(make, sensor=EUROC_SENSOR, listing=True):
    stamps = [1403636580000000000 + i * 50_000_000 for i in range(4)]
    make.images("V1/mav0/cam0/data", [f"{stamp}.png" for stamp in stamps])
    if listing:
        rows = "\n".join(f"{stamp},{stamp}.png" for stamp in stamps)
        make.text("V1/mav0/cam0/data.csv", f"#timestamp [ns],filename\n{rows}\n")
    if sensor:
        make.text("V1/mav0/cam0/sensor.yaml", sensor)
    # the body moves along world x, turned by 90 degrees about world z; q_RS is w x y z
    rows = [f"{stamps[0] + i * 25_000_000},{i},2,3,{S},0,0,{S},0,0,0" for i in range(8)]
    make.text("V1/mav0/state_groundtruth_estimate0/data.csv", "#timestamp, p_RS_R_x [m], ...\n" + "\n".join(rows))
    return make.root / "V1"


@pytest.mark.parametrize("listing", [True, False])
def test_euroc(make, listing):
    source = open_source(euroc(make, listing=listing))
    assert (source.kind, source.name, source.recorded_camera.model) == ("euroc", "V1", "radtan")
    times = [1403636580 + i * 0.05 for i in range(4)]
    assert [frame.timestamp for frame in source] == pytest.approx(times, abs=1e-6)
    assert source.groundtruth.timestamps == pytest.approx(times, abs=1e-6)


def test_euroc_groundtruth_is_that_of_the_camera_not_of_the_body(make):
    truth = open_source(euroc(make)).groundtruth
    # p_WC = R_WB p_BC + p_WB = (-0.2, 0.1, 0.3) + (2i, 2, 3)
    assert truth.positions == pytest.approx(np.array([[2 * i - 0.2, 2.1, 3.3] for i in range(4)]), abs=1e-5)
    # R_WC = Rz(90) Rz(90): a half turn about z; the inverse of T_BS, or of q, would give the identity
    assert pose_matrices(truth.poses_wc)[0, :3, :3] == pytest.approx(np.diag([-1.0, -1, 1]), abs=1e-9)


def test_euroc_marker_frame_of_the_groundtruth_is_taken_off(make):
    folder = euroc(make)
    marker = "T_BS: {rows: 4, cols: 4, data: [1,0,0,1, 0,1,0,0, 0,0,1,0, 0,0,0,1]}\n"
    make.text("V1/mav0/state_groundtruth_estimate0/sensor.yaml", marker)
    # the marker sits 1 m along the body's x: the body is 1 m back, along world -y
    assert open_source(folder).groundtruth.positions[0] == pytest.approx([-0.2, 1.1, 3.3])


def test_euroc_mav0_itself_and_without_sensor(make):
    folder = euroc(make, sensor=None)
    with pytest.raises(DvoError, match="no calibration"):
        open_source(folder)
    source = open_source(folder / "mav0", calib=make.calib())
    assert source.name == "V1" and source.groundtruth is None and "T_BS" in source.warnings[0]


def test_euroc_with_a_broken_extrinsic_matrix(make):
    with pytest.raises(DvoError, match="T_BS"):
        open_source(euroc(make, sensor=EUROC_SENSOR.replace("[0, -1,", "[0, -7,")))


# --- KITTI


def kitti(make, cameras=("image_0", "image_2"), count=5, rows=5):
    for camera in cameras:
        make.images(f"sequences/07/{camera}", [f"{i:06d}.png" for i in range(count)])
    projections = [f"P{i}: {50 + i} 0 31 {-5.0 * i} 0 {50 + i} 23 0 0 0 1 0" for i in range(4)]
    make.text("sequences/07/calib.txt", "\n".join(projections) + "\nTr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    make.text("sequences/07/times.txt", "".join(f"{i * 0.1:.6e}\n" for i in range(rows)))
    make.text("poses/07.txt", "".join(f"0 0 1 {i} 0 1 0 0 -1 0 0 0\n" for i in range(rows)))  # looks along world x
    return make.root / "sequences/07"


def test_kitti_left_grey(make):
    source = open_source(kitti(make))
    assert (source.kind, source.name, source.camera.fx) == ("kitti", "kitti07", 50)
    assert [frame.timestamp for frame in source] == pytest.approx(np.arange(5) / 10)
    assert source.groundtruth.positions == pytest.approx(np.array([[i, 0, 0] for i in range(5)]))
    assert source.groundtruth.timestamps == pytest.approx(np.arange(5) / 10)
    assert pose_matrices(source.groundtruth.poses_wc)[0, :3, 2] == pytest.approx([1, 0, 0])


@pytest.mark.parametrize("whole", [True, False])
def test_kitti_colour_camera_has_its_own_projection_and_place(make, whole):
    folder = kitti(make, ("image_2",) if whole else ("image_0", "image_2"))
    source = open_source(folder if whole else folder / "image_2")
    assert source.kind == "kitti" and source.camera.fx == 52
    # P2 = K [I | t], t_x = -10 / 52: the camera lies 10/52 along camera 0's x, which is world -z here
    assert source.groundtruth.positions[3] == pytest.approx([3, 0, -10 / 52])


def test_kitti_copied_in_part(make):
    folder = kitti(make, ("image_0",), count=4, rows=9)
    (folder / "image_0/000000.png").unlink()
    source = open_source(folder)
    assert [frame.timestamp for frame in source] == pytest.approx([0.1, 0.2, 0.3])
    assert source.groundtruth.positions[:, 0] == pytest.approx([1, 2, 3])


def test_kitti_without_poses_or_times(make):
    folder = kitti(make)
    (make.root / "poses/07.txt").unlink()
    (folder / "times.txt").unlink()
    source = open_source(folder)
    assert source.groundtruth is None and any("9.64" in warning for warning in source.warnings)
    assert len(list(source)) == 5


def test_kitti_broken_calibration(make):
    folder = kitti(make)
    (folder / "calib.txt").write_text("P0: 1 2 3\n")
    with pytest.raises(DvoError, match="P0: not 12 numbers"):
        open_source(folder)


# --- TartanAir


@pytest.mark.parametrize(
    ("folder", "poses", "suffix", "size"),
    [
        ("image_left", "pose_left.txt", "left", (640, 480)),
        ("image_lcam_front", "pose_lcam_front.txt", "lcam_front", (640, 640)),
    ],
    ids=["v1", "v2"],
)
def test_tartanair(make, folder, poses, suffix, size):
    make.images(f"P000/{folder}", [f"{i:06d}_{suffix}.png" for i in range(3)], *size)
    make.text(f"P000/{poses}", f"1 2 3 0 0 0 1\n1 3 3 0 0 {S} {S}\n1 4 3 0 0 0 1\n")
    source = open_source(make.root / "P000")
    assert source.kind == "tartanair"
    assert source.camera.intrinsics.tolist() == [320, 320, 320, size[1] / 2]
    assert [frame.timestamp for frame in source] == pytest.approx([0, 0.1, 0.2])
    assert "10 frames a second" in source.warnings[0]
    assert source.groundtruth.positions == pytest.approx(np.array([[1, 2, 3], [1, 3, 3], [1, 4, 3]]))
    forward = pose_matrices(source.groundtruth.poses_wc)[:, :3, 2]
    assert forward[0] == pytest.approx([1, 0, 0])
    assert forward[1] == pytest.approx([0, 1, 0], abs=1e-9)  # yawed by 90 degrees to the right (z down)
    assert open_source(make.root / "P000", fps=20).groundtruth.timestamps == pytest.approx([0, 0.05, 0.1])


def test_tartanair_of_another_size(make):
    make.images("P000/image_left", ["000000_left.png"], 320, 240)
    make.text("P000/pose_left.txt", "1 2 3 0 0 0 1\n")
    with pytest.raises(DvoError, match="640x480 images, but these are 320x240"):
        open_source(make.root / "P000")


def test_tartanair_malformed_pose(make):
    make.images("P000/image_left", ["000000_left.png"], 640, 480)
    make.text("P000/pose_left.txt", "1 2 3 0 0 0\n")
    with pytest.raises(DvoError, match="line 1"):
        open_source(make.root / "P000")


def test_tartanair_v2_clock(make):
    make.images("P000/image_lcam_front", [f"{i:06d}_lcam_front.png" for i in range(3)], 640, 640)
    make.text("P000/imu/cam_time.txt", "0.0\n0.2\n0.4\n")
    source = open_source(make.root / "P000")
    assert [frame.timestamp for frame in source] == [0, 0.2, 0.4]
    assert source.warnings == [] and source.groundtruth is None


# --- sequence folders


def test_sequence_folder(make):
    make.images("clip/color", [f"frame-{i:06d}.color.jpg" for i in range(3)])
    make.images("clip/depth", ["frame-000000.depth.png"])
    make.calib("clip/calib.txt")
    make.text("clip/groundtruth_tum.txt", "0.0 0 0 0 0 0 0 1\n0.5 1 0 0 0 0 0 1\n0.9 2 0 0 0 0 0 1\n")
    source = open_source(make.root / "clip")
    assert (source.kind, source.name, source.camera.fx) == ("sequence", "clip", 50)
    assert [frame.timestamp for frame in source] == [0, 0.5, 0.9]  # those of the ground truth, row by row
    assert source.groundtruth.path_length == 2
    assert (
        len(source.warnings) == 1 and f"beside it are depth (--depth {make.root / 'clip/depth'})" in source.warnings[0]
    )
    (make.root / "clip/groundtruth_tum.txt").unlink()
    assert any("assuming 30" in warning for warning in open_source(make.root / "clip").warnings)


def test_sequence_folder_with_an_unusual_name_for_its_images(make):
    make.images("clip/shots", ["a.png"])
    make.calib("clip/calib.txt")
    assert len(list(open_source(make.root / "clip", fps=1))) == 1
    cv2.imwrite(str(make.images("clip/more", []) / "b.png"), make.image(0))
    with pytest.raises(DvoError, match="several folders of images: more, shots"):
        open_source(make.root / "clip")


# --- public benchmarks with ground truth of their own


def tartanair_test(make, deeper=False):
    make.images("mono/ME001", [f"{i:06d}.png" for i in range(3)], 640, 480)
    make.text(
        "mono_gt/ME001.txt" if deeper else "mono/mono_gt/ME001.txt", f"1 2 3 0 0 0 1\n1 3 3 0 0 {S} {S}\n1 4 3 0 0 0 1"
    )
    return make.root / "mono/ME001"


@pytest.mark.parametrize("deeper", [True, False])
def test_tartanair_test_set(make, deeper):
    source = open_source(tartanair_test(make, deeper))
    assert (source.kind, source.name, source.camera.intrinsics.tolist()) == ("tartanair", "ME001", [320, 320, 320, 240])
    assert source.groundtruth.timestamps == pytest.approx([0, 0.1, 0.2])
    assert source.groundtruth.positions.tolist() == [[1, 2, 3], [1, 3, 3], [1, 4, 3]]
    forward = pose_matrices(source.groundtruth.poses_wc)[:, :3, 2]
    assert forward[0] == pytest.approx([1, 0, 0]) and forward[1] == pytest.approx([0, 1, 0], abs=1e-9)
    frame = next(iter(source))
    assert frame.depth is None and frame.right is None


def test_groundtruth_of_tartanair_that_is_named(make):
    folder = tartanair_test(make)
    named = open_source(folder, groundtruth="../mono_gt/ME001.txt").groundtruth
    found = open_source(folder).groundtruth
    assert np.array_equal(named.poses_wc, found.poses_wc) and np.array_equal(named.timestamps, found.timestamps)
    make.text("mono/mono_gt/short.txt", "1 2 3 0 0 0 1\n")
    with pytest.raises(DvoError, match="1 rows without times for 3 images"):
        open_source(folder, groundtruth="../mono_gt/short.txt")


def icl_nuim(make, name="living_room_traj2_loop", truth="TrajectoryGT/livingRoom2.gt.freiburg"):
    make.images(name, [f"{i}.png" for i in range(12)], 640, 480)
    make.text(truth, "".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(1, 12)))  # one row less than images
    return make.root / name


@pytest.mark.parametrize(
    ("name", "truth"),
    [
        ("living_room_traj2_loop", "TrajectoryGT/livingRoom2.gt.freiburg"),
        ("office_room_traj0_loop", "TrajectoryGT/traj0.gt.freiburg"),
        ("traj3_frei_png", "traj3_frei_png/traj3.gt.freiburg"),
    ],
)
def test_icl_nuim(make, name, truth):
    source = open_source(icl_nuim(make, name, truth))
    assert (source.kind, source.camera.intrinsics.tolist()) == ("icl_nuim", [481.2, 480, 319.5, 239.5])
    assert [frame.timestamp for frame in source] == pytest.approx(np.arange(12) / 30) and source.warnings == []
    # the first image is number 1
    assert source.groundtruth.timestamps == pytest.approx(np.arange(11) / 30)
    assert source.groundtruth.positions[:, 0].tolist() == list(range(1, 12))
    named = open_source(make.root / name, groundtruth=make.root / truth, fps=15).groundtruth
    assert named.timestamps == pytest.approx(np.arange(11) / 15)


def test_icl_nuim_needs_counted_stamps_and_its_names(make):
    folder = icl_nuim(make)
    make.text("TrajectoryGT/livingRoom2.gt.freiburg", "0.5 1 0 0 0 0 0 1\n1.5 2 0 0 0 0 0 1\n")
    with pytest.raises(DvoError, match="count images"):
        open_source(folder)
    other = make.images("somewhere", ["0.png"])
    assert open_source(other, calib=make.calib()).kind == "folder"


def test_icl_nuim_in_tums_layout_has_depth(make):
    folder = make.root / "living_room_traj1_frei_png"
    make.images(f"{folder.name}/rgb", ["0.png", "1.png"], 640, 480)
    make.text(f"{folder.name}/livingRoom1.gt.freiburg", "1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n")
    (folder / "depth").mkdir()
    cv2.imwrite(str(folder / "depth/1.png"), np.full((480, 640), 7500, np.uint16))
    first, second = open_source(folder)
    assert first.depth is None and float(second.depth[0, 0]) == 1.5
