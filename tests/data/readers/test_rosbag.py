"""Small bags, written by rosbags on the spot."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import dvo
from dvo.cli import main
from dvo.core.errors import DvoError
from dvo.data.calibration.calibration import Calibration
from dvo.data.companions.depth_source import with_depth
from dvo.data.companions.right_source import with_right
from dvo.data.readers.ros_images import decode_message
from dvo.data.readers.rosbag import calibration_of_info, matches, split_topic
from tests.support.interlaced import moving, woven
from tests.support.rosbags import PLUMB, Bag, P


def rgb(make, index):
    return make.image(index)[..., ::-1]


def write(make, kind="mcap", content=lambda bag: None, name="clip"):
    path = make.root / (f"{name}.bag" if kind == "bag" else name)
    with Bag(path, kind) as bag:
        for index in range(6):
            bag.image("/camera/image_raw", rgb(make, index), 100 + 0.1 * index)
        content(bag)
    return path


def everything(bag):
    bag.info("/camera/camera_info")
    for index in range(30):
        bag.imu("/imu", 99.9 + 0.02 * index)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["bag", "mcap", "sqlite3"])
def test_images_calibration_and_inertial_samples(make, kind):
    path = write(make, kind, everything)
    source = dvo.open(path, undistort=False)
    assert (source.kind, source.name, source.frame_count, source.warnings) == ("rosbag", "clip", 6, [])
    frames = list(source)
    assert [frame.timestamp for frame in frames] == pytest.approx(100 + 0.1 * np.arange(6)), (
        "stamps, not times of recording"
    )
    assert all(np.array_equal(frame.image, rgb(make, i)) for i, frame in enumerate(frames))
    camera = source.camera
    assert [camera.fx, camera.fy, camera.cx, camera.cy, camera.model] == [50, 51, 31, 23, "radtan"]
    assert camera.coefficients == tuple(PLUMB)
    assert [len(frame.inertial) for frame in frames] == [0, 5, 5, 5, 5, 4]
    samples = frames[1].inertial
    assert np.allclose(samples.gyro[:, 0], samples.timestamps) and samples.T_camera_imu is None
    assert np.allclose(samples.accel, [0, 0, 9.8])
    assert np.array_equal(source.reading.inertial.rough().timestamps, source.inertial.timestamps)
    assert [frame.index for frame in dvo.open(path, stride=4)] == [0, 4]
    assert [frame.timestamp for frame in dvo.open(path, fps=2)] == [0, 0.5, 1, 1.5, 2, 2.5]


def test_a_topic_of_inertial_samples_is_chosen(make):
    def two(bag):
        for index in range(30):
            bag.imu("/imu/raw", 100 + 0.02 * index)
            bag.imu("/imu/filtered", 100.01 + 0.02 * index)

    path = write(make, content=two)
    calib = make.text("calib.txt", "50 51 31 23")
    source = dvo.open(path, calib=calib)
    assert source.inertial is None
    assert sum("several topics of inertial samples, none is used: /imu/filtered, /imu/raw (give --imu-topic)" in note
               for note in source.warnings) == 1  # fmt: skip
    for topic, first in (("/imu/raw", 100.0), ("imu/filtered", 100.01)):
        samples = dvo.open(path, calib=calib, imu_topic=topic).inertial
        assert samples.timestamps[0] == pytest.approx(first) and samples.origin == f"topic /{topic.lstrip('/')}"
    assert len(dvo.open(path, calib=calib, imu=path, imu_topic="/imu/raw").inertial) == 30
    with pytest.raises(DvoError, match="/imu/x is no topic of inertial samples. Give one of /imu/filtered, /imu/raw"):
        dvo.open(path, calib=calib, imu_topic="/imu/x")
    with pytest.raises(DvoError, match="the topic of inertial samples is not clear"):
        dvo.open(path, calib=calib, imu=path)


def test_gyroscope_and_accelerometer_of_two_topics(make):
    """RealSense: two topics of one type, the accelerometer at the times of the gyroscope."""

    def two(bag):
        for index in range(30):
            bag.imu("/camera/gyro/sample", 100 + 0.02 * index)
            bag.imu("/camera/accel/sample", 99.99 + 0.04 * index)

    calib = make.text("calib.txt", "50 51 31 23")
    samples = dvo.open(write(make, content=two), calib=calib).inertial
    assert samples.origin == "topic /camera/gyro/sample and /camera/accel/sample"
    assert len(samples) == 30 and np.allclose(samples.gyro[:, 0], samples.timestamps)
    assert np.allclose(samples.accel, [0, 0, 9.8])


def test_repeated_inertial_samples_are_told(make):
    def content(bag):
        for index in (0, 1, 2, 3, 3, 4):
            bag.imu("/imu", 100 + 0.02 * index)

    calib = make.text("calib.txt", "50 51 31 23")
    samples = dvo.open(write(make, content=content), calib=calib).inertial
    assert samples.timestamps == pytest.approx(100 + 0.02 * np.arange(5))
    assert samples.notes == ("topic /imu: 1 row with the time of the one before dropped",)


def test_the_file_inside_and_the_topic_beside_the_path(make):
    def two(bag):
        for index in range(3):
            bag.compressed("/right/image/compressed", rgb(make, 10 + index), 100 + 0.1 * index)
        bag.info("/right/camera_info", d=[])

    folder = write(make, content=two)
    (file,) = folder.glob("*.mcap")
    both = r"several topics of images: /camera/image_raw \(6\), /right/image/compressed \(3\).*--topic"
    with pytest.raises(DvoError, match=both):
        dvo.open(file)
    with pytest.raises(DvoError, match=r"/left is no topic of images; those are: /camera/image_raw"):
        dvo.open(file, topic="left")
    for source in (dvo.open(f"{file}:/right/image/compressed"), dvo.open(folder, topic="right/image/compressed")):
        assert all(np.array_equal(f.image, rgb(make, 10 + i)) for i, f in enumerate(source)) and len(source) == 3
        assert source.camera.model == "none" and source.camera.fx == 50


def test_rectified_images_have_the_projection_matrix(make):
    def rectified(bag):
        bag.image("/camera/image_rect", rgb(make, 0), 100.0)
        bag.info("/camera/camera_info")

    camera = dvo.open(write(make, content=rectified), topic="/camera/image_rect").camera
    assert [camera.fx, camera.fy, camera.cx, camera.cy, camera.model] == [40, 41, 30, 22, "none"]


@pytest.mark.parametrize(
    ("info", "warning"),
    [
        ({"k": [0.0] * 9}, "not calibrated"),
        ({"model": "f_theta", "d": [0.1] * 8}, "unknown distortion model"),
    ],
)
def test_calibrations_that_cannot_be_used(make, info, warning):
    path = write(make, content=lambda bag: bag.info("/camera/camera_info", **info))
    with pytest.raises(DvoError, match=f"no calibration; .*{warning}"):
        dvo.open(path)
    assert warning in " ".join(dvo.open(path, guess=True).warnings)
    assert dvo.open(path, calib=make.calib()).warnings == []


def test_stamps_that_are_missing_or_go_back(make):
    def unstamped(bag):
        for index in range(3):
            bag.image("/other", rgb(make, index), 0.0, recorded=7 + index)
        for index, stamp in enumerate([1.0, 3.0, 2.0, 4.0]):
            bag.image("/late", rgb(make, index), stamp, recorded=10 + index)

    path, calib = write(make, content=unstamped), make.calib()
    source = dvo.open(path, calib=calib, topic="/other")
    assert [frame.timestamp for frame in source] == [7, 8, 9] and "no stamps" in source.warnings[0]
    source = dvo.open(path, calib=calib, topic="/late")
    assert [frame.timestamp for frame in source] == [1, 3, 4] and "image 2 on" in source.warnings[0]


def test_bags_that_cannot_be_read(make, monkeypatch):
    pytest.importorskip("rosbags")
    for name in ("broken.bag", "broken.mcap", "broken.db3"):
        with pytest.raises(DvoError, match=f"{name}: cannot be read"):
            dvo.open(make.text(name, "no bag" * 50))
    with Bag(make.root / "imu", "mcap") as bag:
        bag.imu("/imu", 1.0)
    with pytest.raises(DvoError, match="no images in this bag"):
        dvo.open(make.root / "imu")
    assert main(["run", str(make.root / "broken.bag"), "--topic", "/a"]) == 2


def test_without_the_package(make, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "rosbags.highlevel", None)
    with pytest.raises(DvoError, match=r"clip.bag: the package rosbags is not installed. Run pip install 'dvo\[ros\]'"):
        dvo.open(make.text("clip.bag", "any"))


def test_paths(make):
    file = make.text("clip.mcap", "any")
    assert split_topic(f"{file}:/a/b", None) == (file, "/a/b") and split_topic(file, "/a") == (file, "/a")
    assert split_topic("missing.mcap:/a", None)[1] is None
    assert matches(file) and not matches(make.root) and not matches(make.text("clip.mp4", "any"))
    with pytest.raises(DvoError, match="only bags have topics"):
        dvo.open(make.images("clip", ["0.png"]), topic="/a")


def message(encoding, pixels, step=None, big=False):
    height, width = pixels.shape[:2]
    rows = np.ascontiguousarray(pixels).reshape(height, -1)
    rows = rows.astype(rows.dtype.newbyteorder(">" if big else "<")).view(np.uint8)
    if step:
        rows = np.pad(rows, ((0, 0), (0, step - rows.shape[1])), constant_values=77)
    data = SimpleNamespace(height=height, width=width, encoding=encoding, is_bigendian=big, step=rows.shape[1])
    data.data = rows.ravel()
    return data


def test_encodings():
    colour = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8), (0, 0), 4)
    grey = colour[..., 1]
    repeated = np.repeat(grey[..., None], 3, axis=2)
    alpha = np.dstack([colour, grey])
    cases = {"rgb8": colour, "bgr8": colour[..., ::-1], "8UC3": colour[..., ::-1], "rgba8": alpha}
    cases |= {"bgra8": alpha[..., [2, 1, 0, 3]], "rgb16": colour * np.uint16(257)}
    for encoding, pixels in cases.items():
        assert np.array_equal(decode_message(message(encoding, pixels, step=640), "x"), colour), encoding
    for encoding, pixels in {"mono8": grey, "8UC1": grey, "mono16": grey * np.uint16(257)}.items():
        assert np.array_equal(decode_message(message(encoding, pixels), "x"), repeated), encoding
    assert np.array_equal(decode_message(message("16UC1", grey * np.uint16(257), step=200, big=True), "x"), repeated)
    for pattern in ("rggb", "bggr", "gbrg", "grbg"):
        mosaic = np.empty_like(grey)
        for at, channel in enumerate(pattern):
            mosaic[at // 2 :: 2, at % 2 :: 2] = colour[at // 2 :: 2, at % 2 :: 2, "rgb".index(channel)]
        found = decode_message(message(f"bayer_{pattern}8", mosaic), "x")
        assert np.abs(found.astype(int) - colour)[2:-2, 2:-2].mean() < 3, pattern
    yuyv = np.dstack([grey, np.full_like(grey, 128)])
    for encoding, pixels in {"yuv422": yuyv[..., ::-1], "yuv422_yuy2": yuyv}.items():
        found = decode_message(message(encoding, pixels), "x").astype(int)
        assert np.abs(found - np.clip((repeated.astype(int) - 16) * 255 / 219, 0, 255)).max() < 3, encoding
    with pytest.raises(DvoError, match="encoding '32fc1'"):
        decode_message(message("32FC1", grey), "x")
    short = message("mono8", grey)
    short.data = short.data[:-1]
    assert decode_message(short, "x") is None


def stereo(bag, make):
    for index in range(6):
        bag.image("/cam0/image_raw", rgb(make, index), 100 + 0.1 * index)
        bag.image("/cam1/image_raw", rgb(make, index + 20), 100.002 + 0.1 * index)
    bag.info("/cam0/camera_info", p=P)
    bag.info("/cam1/camera_info", p=[*P[:3], -P[0] * 0.12, *P[4:]])


@pytest.mark.long
@pytest.mark.parametrize("kind", ["bag", "mcap"])
@pytest.mark.parametrize("right", ["/cam1/image_raw", None])
def test_right_images_of_another_topic(make, kind, right):
    path = make.root / ("pair.bag" if kind == "bag" else "pair")
    with Bag(path, kind) as bag:
        stereo(bag, make)
    source = dvo.open(path, topic="/cam0/image_raw", undistort=False, stride=2)
    frames = list(with_right(source, right))
    assert [frame.index for frame in frames] == [0, 2, 4]
    assert all(np.array_equal(frame.right.image, rgb(make, frame.index + 20)) for frame in frames)
    assert frames[0].right.T_left_right[:3] == pytest.approx([0.12, 0, 0]) and frames[0].right.camera.fx == 50
    assert next(iter(with_right(source, right, 0.3))).right.T_left_right[0] == pytest.approx(0.3)
    with pytest.raises(DvoError, match="/cam2 is no other topic of images in this bag; those are: /cam1/image_raw"):
        with_right(source, "/cam2")


def test_right_images_without_a_baseline(make):
    path = make.root / "pair"
    with Bag(path, "mcap") as bag:
        for index in range(2):
            bag.image("/left/image", rgb(make, index), 100 + 0.1 * index)
            bag.image("/right/image", rgb(make, index), 100 + 0.1 * index)
        bag.info("/left/camera_info")
    source = dvo.open(path, topic="/left/image")
    with pytest.raises(DvoError, match="--baseline: is not known from a calibration"):
        with_right(source)
    assert next(iter(with_right(source, baseline=0.1))).right.T_left_right[0] == pytest.approx(0.1)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_depth_of_another_topic(make, encoding):
    path, deep = make.root / "rgbd", (np.indices((48, 64))[0] * 10 + 500).astype(np.uint16)
    with Bag(path, "mcap") as bag:
        for index in range(4):
            bag.image("/camera/color/image_raw", rgb(make, index), 100 + 0.1 * index)
            if index != 2:
                pixels = deep + np.uint16(index) if encoding == "16UC1" else ((deep + index) / 1000).astype(np.float32)
                bag.depth("/camera/aligned_depth_to_color/image_raw", pixels, 100.003 + 0.1 * index, encoding)
        bag.info("/camera/color/camera_info", d=[])
    source = dvo.open(path)  # the topic of colour, without --topic
    assert "depth is beside it for --depth" in source.warnings[0]
    for depth in (None, "/camera/aligned_depth_to_color/image_raw"):
        frames = list(with_depth(source, depth))
        assert frames[2].depth is None
        assert np.allclose(frames[3].depth, (deep + 3) / 1000)
    if encoding == "16UC1":
        assert np.allclose(next(iter(with_depth(source, None, 500.0))).depth, deep / 500)


def test_few_bits_of_16_in_messages(make):
    path = make.root / "deep"
    with Bag(path, "mcap") as bag:
        for index in range(3):
            bag.depth("/image", rgb(make, index)[..., 1].astype(np.uint16) << 4, 100 + 0.1 * index, "mono16")
    source = dvo.open(path, calib=make.calib())
    assert np.array_equal(list(source)[2].image[..., 0], rgb(make, 2)[..., 1])
    assert "hold 12 bits" in source.warnings[0]


@pytest.mark.parametrize(("region", "principal", "size"), [((0, 0, 0, 0), (321, 241), (640, 480)),
                                                           ((100, 50, 320, 240), (221, 191), (320, 240))])  # fmt: skip
def test_images_of_a_region_of_the_sensor(tmp_path, region, principal, size):
    roi = SimpleNamespace(**dict(zip(("x_offset", "y_offset", "width", "height"), region, strict=True)))
    k, p = [500, 0, 321, 0, 510, 241, 0, 0, 1], [500, 0, 321, 0, 0, 510, 241, 0, 0, 0, 1, 0]
    info = SimpleNamespace(
        width=640, height=480, distortion_model="plumb_bob", k=k, d=[0.1, 0, 0, 0, 0], r=[], p=p, roi=roi
    )
    found = calibration_of_info(info, "image_raw", tmp_path / "a.bag")
    assert (found.cx, found.cy, found.width, found.height) == (*principal, *size)
    info.binning_x = info.binning_y = 2
    found = calibration_of_info(info, "image_rect", tmp_path / "a.bag")
    assert (found.fx, found.cx, found.width) == (250, principal[0] / 2, size[0] // 2)


@pytest.mark.parametrize(("interlaced", "dropped"), [(True, ()), (False, ()), (False, (2, 5, 6, 9, 10, 11))])
def test_interlaced_messages(tmp_path, interlaced, dropped):
    """Also if messages were dropped, so that the images before and after are not equally far."""
    images = list(woven(moving(32, 2), True)) if interlaced else list(moving(24, 2))
    with Bag(tmp_path / "bag.bag", "bag") as bag:
        for index, image in enumerate(images):
            if index not in dropped:
                bag.image("/image", image, 100 + 0.04 * index)
    warnings = dvo.open(tmp_path / "bag.bag", calib=Calibration(300, 300, 159.5, 119.5)).warnings
    assert any("interlaced" in said for said in warnings) == interlaced
