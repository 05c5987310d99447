"""Malformed inputs that once ended in other exceptions, in hangs, in gigabytes, or in a wrong ground truth."""

import os
import struct
import zipfile
import zlib

import cv2
import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data import READERS, read_calibration, read_kitti_poses, read_tum
from dvo.data.calibration.kitti import read_projections
from dvo.data.files.stamps import read_times, times_from_names
from dvo.data.images.images import list_images, read_image
from dvo.data.readers.euroc import read_inertial, read_state_groundtruth
from dvo.data.readers.groundtruth import read_groundtruth
from dvo.data.readers.tartanair import read_ned_poses
from dvo.data.recording import rows_of_images
from dvo.data.sensors.depth import read_depth
from dvo.data.streams.streams import stream
from dvo.geometry.camera import Camera

DIGITS = "9" * 5000
REAL_CAPTURE = cv2.VideoCapture


def png_header(width, height):
    def chunk(name, content):
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"\0" * 100)) + chunk(b"IEND", b"")


def jpeg_header(width, height):
    data = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize("header", [png_header, jpeg_header])
@pytest.mark.parametrize("read", [read_image, read_depth])
def test_an_image_header_of_30000x30000_is_refused_before_decoding(tmp_path, monkeypatch, header, read):
    path = tmp_path / "a.png"
    path.write_bytes(header(30_000, 30_000))
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(DvoError, match="a.png: image of 30000x30000 pixels, more than 64,000,000"):
        read(path)


def test_a_depth_array_that_states_30000x30000_is_refused_before_reading(tmp_path):
    header = b"{'descr': '<f4', 'fortran_order': False, 'shape': (30000, 30000), }"
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header) + 1) + header + b"\n"
    (tmp_path / "a.npy").write_bytes(data)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("depth.npy", data)
    for name in ("a.npy", "a.npz"):
        with pytest.raises(DvoError, match=f"{name}: depth: depth of 30000x30000 pixels"):
            read_depth(tmp_path / name)


def test_depth_beyond_float32_is_unknown(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[1e300, 2.0], [-1.0, np.inf]]))
    np.testing.assert_array_equal(read_depth(tmp_path / "a.npy"), np.array([[np.nan, 2], [np.nan, np.nan]], np.float32))


def test_depth_by_columns(tmp_path):
    depth = np.arange(1, 7, dtype=np.float32).reshape(2, 3)
    np.save(tmp_path / "a.npy", np.asfortranarray(depth))
    np.testing.assert_array_equal(read_depth(tmp_path / "a.npy"), depth)


@pytest.mark.parametrize("place", ["pipe", "/dev/null", "/dev/zero"])
@pytest.mark.parametrize("reader", [None, *READERS])
def test_a_pipe_or_a_device_is_no_source(make, place, reader):
    os.mkfifo(make.root / "pipe")
    with pytest.raises(DvoError):
        dvo.open(make.root / place, calib=make.calib(), reader=reader)


@pytest.mark.parametrize("option", ["calib", "times", "groundtruth"])
@pytest.mark.parametrize("place", ["pipe", "/dev/zero", "x" * 300, "a\0b"])
def test_a_pipe_or_a_device_is_no_file_of_an_option(make, option, place):
    os.mkfifo(make.root / "pipe")
    options = {"calib": make.calib(), option: make.root / place}
    with pytest.raises(DvoError, match=f"{option}: no such file"):
        dvo.open(make.images("clip", ["1.png", "2.png"]), **options)


def test_a_name_that_is_too_long_is_no_source(tmp_path):
    for name in ("x" * 300, "a\0b", "\ud800"):
        with pytest.raises(DvoError):
            dvo.open(tmp_path / name, calib="calib.txt")


def tum(make, name):
    make.images("s/rgb", ["1.png", "2.png"])
    make.text("s/calib.txt", "50 51 31 23\n")
    make.text("s/rgb.txt", f"1.0 rgb/1.png\n2.0 {name}\n")
    return make.root / "s"


@pytest.mark.parametrize("name", ["/dev/zero", "../../../../etc/hostname"])
def test_rgb_txt_names_no_file_outside(make, name):
    with pytest.raises(DvoError, match="rgb.txt: line 2: .* is not a file of this folder"):
        dvo.open(tum(make, name))


@pytest.mark.parametrize("place", ["/dev/zero", "nowhere", "pipe"])
def test_an_image_that_is_no_file_is_skipped_and_told(make, place):
    path = tum(make, "rgb/odd.png")
    if place == "pipe":
        os.mkfifo(path / "rgb" / "odd.png")
    else:
        (path / "rgb" / "odd.png").symlink_to(place)
    source = dvo.open(path)
    assert [frame.index for frame in source] == [0]
    assert any("odd.png" in warning for warning in source.warnings)


def test_a_linked_image_is_read(make):
    path = tum(make, "rgb/linked.png")
    outside = make.images("other", ["x.png"]) / "x.png"
    (path / "rgb" / "linked.png").symlink_to(outside)
    assert len(list(dvo.open(path))) == 2


def test_euroc_lists_no_file_outside(make):
    make.images("s/mav0/cam0/data", ["1.png"])
    make.text("s/mav0/cam0/data.csv", "1403636579763555584,../../../x.png\n")
    with pytest.raises(DvoError, match="data.csv: line 1: .* is not a file of this folder"):
        dvo.open(make.root / "s", calib=make.calib())


@pytest.mark.parametrize("number", [DIGITS, "9" * 400, "9" * 25, "nan", "inf", "1e999", "1e13"])
def test_huge_numbers_in_tables(make, number):
    for read, text in [
        (lambda path: read_times(path, None), f"0\n{number}\n"),
        (read_tum, f"0 0 0 0 0 0 0 1\n{number} 0 0 0 0 0 0 1\n"),
        (read_tum, f"0 0 0 0 0 0 0 1\n1 0 {number} 0 0 0 0 1\n"),
        (read_kitti_poses, f"1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 {number} 0 1 0 0 0 0 1 0\n"),
        (read_ned_poses, f"0 0 0 0 0 0 1\n0 0 0 0 0 0 {number}\n"),
        (read_state_groundtruth, f"1,0,0,0,1,0,0,0\n{number},0,0,0,1,0,0,0\n"),
        (read_inertial, f"1,0,0,0,0,0,0\n{number},0,0,0,0,0,0\n"),
    ]:
        with pytest.raises(DvoError, match="t.csv: line 2"):
            read(make.text("t.csv", text))


@pytest.mark.parametrize("name", ["²", "1²2", "１２", "9" * 200, "9" * 200 + ".5", "9" * 19])
def test_odd_digits_in_names_are_names(make, name):
    folder = make.images("clip", [f"{name}.png", "7.png"])
    images = list_images(folder)
    assert len(images) == 2 and times_from_names(images) is None
    assert rows_of_images(images, 5) is None
    assert len(list(dvo.open(folder, calib=make.calib(), fps=10))) == 2


@pytest.mark.parametrize("first", ["nan", "inf", "1e999", DIGITS])
def test_a_number_is_no_header_of_times(make, first):
    with pytest.raises(DvoError, match="line 1: .* is no time"):
        read_times(make.text("times.txt", f"{first}\n1\n"), None)


@pytest.mark.parametrize("read", [
    read_tum, read_kitti_poses, read_ned_poses, read_state_groundtruth, read_inertial, read_projections,
    lambda path: read_times(path, None), lambda path: read_groundtruth(path, None), read_calibration,
])  # fmt: skip
def test_texts_in_other_encodings_and_endless_ones(make, read):
    path = make.root / "t.csv"
    for data in ("# für Kamera 1\n".encode("latin-1"), "1 2 3\n".encode("utf-16")):
        path.write_bytes(data)
        with pytest.raises(DvoError, match="not UTF-8 text"):
            read(path)
    os.truncate(path, 2**34)
    with pytest.raises(DvoError, match="larger than"):
        read(path)


@pytest.mark.parametrize(
    "row",
    ["0 0 0 0 0 0 0 0 0 0 0 0", "0 0 31 0 0 50 23 0 0 0 1 0", "50 0 31 0 0 -50 23 0 0 0 1 0",
     "50 0 31 0 0 50 23 0 0 0 0 0", "50 0 31 nan 0 50 23 0 0 0 1 0", "50 0 31 1e300 0 50 23 0 0 0 1 0",
     "1e-300 0 31 -5 0 50 23 0 0 0 1 0",
     "50 50 31 0 50 50 23 0 0 0 1 0"],
)  # fmt: skip
def test_kitti_projections_without_a_camera(make, row):
    with pytest.raises(DvoError, match="calib.txt: P1: not"):
        read_projections(make.text("calib.txt", f"P0: 50 0 31 0 0 50 23 0 0 0 1 0\nP1: {row}\n"))


@pytest.mark.parametrize(
    "matrix", ["0 0 0 {} 0 0 0 0 0 0 0 0", "1 0 0 {} 0 1 0 0 0 0 -1 0", "2 0 0 {} 0 2 0 0 0 0 2 0"]
)
def test_kitti_poses_without_a_rotation(make, matrix):
    with pytest.raises(DvoError, match="line 2: the matrix is no rotation"):
        read_kitti_poses(make.text("poses.txt", f"1 0 0 0 0 1 0 0 0 0 1 0\n{matrix.format(3)}\n"))


def test_kitti_poses_of_few_digits(make):
    poses = read_kitti_poses(make.text("poses.txt", "0.866 -0.5 0 1 0.5 0.866 0 2 0 0 1 3\n"))
    np.testing.assert_allclose(poses[0], [1, 2, 3, 0, 0, np.sin(np.pi / 12), np.cos(np.pi / 12)], atol=1e-4)


def test_ground_truth_of_times_that_do_not_increase(make):
    def rows(*times):
        return make.text("t.txt", "".join(f"{time} 0 0 0 0 0 0 1\n" for time in times))

    with pytest.raises(DvoError, match="line 2: times must not decrease"):
        read_tum(rows(1, 0))
    assert read_tum(rows(0, 1, 1, 2)).timestamps.tolist() == [0, 1, 2]  # TUM's own ground truth repeats some rows
    with pytest.raises(DvoError, match="line 2"):
        read_state_groundtruth(make.text("t.csv", "5,0,0,0,1,0,0,0\n5,0,0,0,1,0,0,0\n"))


@pytest.mark.parametrize("quaternion", ["1e12 1e12 0 0", "0 0 0 0", "0.1 0.2 0.3 0", "0 0 0 1.2"])
def test_a_quaternion_that_is_none(make, quaternion):
    file = make.text("t.txt", f"0 0 0 0 0 0 0 1\n1 0 0 0 {quaternion}\n")
    with pytest.raises(DvoError, match="line 2: a quaternion of the length"):
        read_tum(file)
    assert len(read_tum(make.text("rounded.txt", "0 0 0 0 0.7 0 0 0.7\n"))) == 1
    with pytest.raises(DvoError, match="line 1: a quaternion of the length 0.37"):  # a time, a position, three angles
        read_groundtruth(make.text("angles.csv", "14.5,1,2,0,0.1,0.2,0.3\n"), np.zeros(1))


def test_ground_truth_of_images_that_share_a_time(make):
    make.images("sequences/07/image_0", ["1.png", "01.jpg", "2.png"])
    make.text("sequences/07/calib.txt", "P0: 50 0 31 0 0 50 23 0 0 0 1 0\n")
    make.text("sequences/07/times.txt", "0\n1\n2\n3\n")
    make.text("poses/07.txt", "".join(f"1 0 0 {i} 0 1 0 0 0 0 1 0\n" for i in range(4)))
    source = dvo.open(make.root / "sequences" / "07")
    assert source.groundtruth.timestamps.tolist() == [1, 2] and len(list(source)) == 2


@pytest.mark.parametrize("text", [
    f"fx: 1{DIGITS}\nfy: 50\ncx: 31\ncy: 23\n", "fx: 2024-13-45\nfy: 50\ncx: 31\ncy: 23\n",
    "fx: [50, 51]\nfy: [50, 51]\ncx: [1, 2]\ncy: [3, 4]\n", "fx: 50\nfy: 50\ncx: 31\ncy: 23\nwidth: 1e400\n",
    "fx: 50\nfy: 50\ncx: 31\ncy: 23\ndepth_scale: 1e-320\n", "fx: 50\nfy: 50\ncx: 31\ncy: 23\nbaseline: 1e300\n",
    "Camera.fx: 0\nCamera.fy: 50\nCamera.cx: 31\nCamera.cy: 23\nCamera.bf: 5\n", "n: &n [*n]\n", "[" * 5000,
    "fx: 50\nfy: 50\ncx: 31\ncy: 23\nwidth: 64.5\nheight: 48\n", f"intrinsics: [{'9' * 90}, 50, 31, 23]\n",
])  # fmt: skip
def test_calibrations_of_odd_values(make, text):
    with pytest.raises(DvoError, match="c.yaml"):
        read_calibration(make.text("c.yaml", text))


@pytest.mark.parametrize("fps", [0, -1, np.nan, np.inf, 1e-320, 1e308, 10**400, "x"])
def test_rates_that_give_no_times(make, fps):
    folder, calib = make.images("clip", ["1.png", "2.png"]), make.calib()
    with pytest.raises(DvoError, match="fps: .* frames a second"):
        dvo.open(folder, calib=calib, fps=fps)
    with pytest.raises(DvoError, match="fps: .* frames a second"):
        stream([], Camera(50.0, 50.0, 31.0, 23.0, 64, 48), fps=fps)


def test_elements_that_are_no_images(make):
    camera, image = Camera(50.0, 50.0, 31.0, 23.0, 64, 48), make.image(0)
    for item in ("image", None, 3.5, [[1, 2], [3]], (1.0, image, 2), ("one", image), (10**400, image), ([1.0], image)):
        with pytest.raises(DvoError):
            list(stream([image, item], camera, timestamps=None if isinstance(item, tuple) else [0.0, 1.0]))
    with pytest.raises(DvoError, match="not images: int"):
        list(stream(3, camera, fps=10))


class Capture:
    """cv2.VideoCapture, whose type must not be subclassed, with some methods replaced."""

    def __init__(self, *arguments, **replaced):
        self._real, self._replaced = REAL_CAPTURE(*arguments), replaced

    def __getattr__(self, name):
        return self._replaced.get(name) or getattr(self._real, name)


def test_a_video_that_opencv_cannot_take(make, monkeypatch):
    def fail():
        raise cv2.error("no memory")

    path, calib = make.video("v.avi", "MJPG"), make.text("c.txt", "80 80 80 60\n")
    monkeypatch.setattr(cv2, "VideoCapture", lambda *arguments: Capture(*arguments, retrieve=fail))
    with pytest.raises(DvoError, match="v.avi: this video does not decode"):
        dvo.open(path, calib=calib)


def test_a_video_of_huge_frames_is_refused(make, monkeypatch):
    path = make.video("v.avi", "MJPG")
    monkeypatch.setattr(cv2, "VideoCapture", lambda *arguments: Capture(*arguments, get=lambda key: 30_000.0))
    with pytest.raises(DvoError, match="v.avi: frames of 30000x30000 pixels"):
        dvo.open(path, calib=make.calib())
