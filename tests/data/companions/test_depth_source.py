"""Depth images for any source: by time, by name, in order; registered, resized, or of another camera."""

import io

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import Calibration, open_source
from dvo.data.companions.depth_source import depth_range, with_depth
from dvo.data.sensors.depth import registered_depth, resized_depth
from dvo.data.streams.live_source import open_stream
from dvo.geometry.camera import Camera
from tests.support.tum_folder import depth_image, tum


def images(make, names=("1.png", "2.png", "3.png")):
    make.images("seq/rgb", list(names))
    make.calib("seq/calib.txt")
    return open_source(make.root / "seq" / "rgb", calib=make.root / "seq/calib.txt", fps=10)


def depths(source):
    return [None if f.depth is None else round(float(f.depth[20, 30]), 3) for f in source]


def test_by_the_numbers_in_the_names_in_any_unit(make):
    source = images(make)
    for number in (1, 3):
        depth_image(make, f"d/frame-{number}.depth.png", number, 1000)
    folder = make.root / "d"
    assert depths(source) == [None] * 3
    assert depths(with_depth(source, folder)) == [1, None, 3]
    assert depths(with_depth(source, folder, scale=500)) == [2, None, 6]
    assert depths(source) == [None] * 3  # as it was


@pytest.mark.parametrize(("unit", "told"), [(1, None), (1000, "1500 to 2500 m"), (0.01, "0.015 to 0.025 m")])
def test_depth_in_another_unit_is_told(make, unit, told):
    """Floats are metres, whatever ``scale``; nothing else says that they are millimetres."""
    source = images(make)
    (make.root / "d").mkdir()
    depth = np.full((48, 64), unit * 1.5, np.float32)
    depth[:, ::2], depth[0] = unit * 2.5, np.nan
    for number in (2, 3):
        np.save(make.root / "d" / f"{number}.npy", depth)
    found = with_depth(source, make.root / "d")
    assert depth_range(found) == pytest.approx((1.5 * unit, 2.5 * unit))
    said = [f"most of the depth is {told}: is it in another unit" in line for line in found.warnings]
    assert said == [True] * bool(told)
    assert depth_range(source) is None


def test_a_stream_is_not_read_for_its_range_of_depth(make):
    """It can be read once."""
    code = b"".join(cv2.imencode(".png", make.image(k))[1].tobytes() for k in range(3))
    for number in range(3):
        depth_image(make, f"d/{number}.png", number + 1, 1000)
    stream = open_stream(io.BytesIO(code), calib=make.calib(), fps=10)
    source = with_depth(stream, make.root / "d")
    assert depth_range(source) is None and depths(source) == [1, 2, 3]


def test_paths_beside_the_source(make):
    """Looked up from the working directory, then from the folder of the source, as those of the other options."""
    source = images(make)
    depth_image(make, "seq/beside-the-source/1.png", 1, 1000)
    make.calib("seq/depth.txt")
    found = with_depth(source, "../beside-the-source", calib="../depth.txt")
    assert depths(found) == [1, None, None] and found.reading.depth_calibration is not None
    for given in ({"depth": "beside-the-source"}, {"calib": "depth.txt"}):
        with pytest.raises(DvoError, match="no such file") as caught:
            with_depth(source, **given)
        assert caught.value.field == {"depth": "depth", "calib": "depth-calib"}[next(iter(given))]


def test_in_order_where_there_are_as_many(make):
    source = images(make, ("a.png", "b.png", "c.png"))
    for k, name in enumerate("xyz"):
        depth_image(make, f"d/{name}.png", k + 1, 1000)
    assert depths(with_depth(source, make.root / "d")) == [1, 2, 3]
    depth_image(make, "d/zz.png", 9, 1000)
    with pytest.raises(DvoError, match="4 depth images for 3 images"):
        with_depth(source, make.root / "d")


def test_by_time_up_to_half_an_interval(make):
    source = images(make, ("10.000000.png", "10.100000.png", "10.200000.png"))
    for stamp, metres in (("10.040000", 1), ("10.160000", 2), ("10.259000", 3)):
        depth_image(make, f"d/{stamp}.png", metres, 1000)
    assert depths(with_depth(source, make.root / "d")) == [1, None, 2]
    rows = "10.0 d/10.040000.png\n10.19 d/10.160000.png\n"
    found = with_depth(source, make.text("depth.txt", "# times\n" + rows))
    assert depths(found) == [0.2, None, 0.4]  # a list is in the layout of TUM RGB-D: 5000 units
    with pytest.raises(DvoError, match="at the time"):
        with_depth(source, make.text("late.txt", "99.0 d/10.040000.png\n"))


def test_the_depth_of_the_data_set_in_its_unit_or_another(make):
    source = open_source(tum(make))
    assert depths(with_depth(source)) == [1, 2, None, 3]
    assert depths(with_depth(source, scale=10000)) == [0.5, 1, None, 1.5]
    with pytest.raises(DvoError, match="no depth of its own"):
        with_depth(images(make))


@pytest.mark.parametrize("place", ["nothing", "empty"])
def test_a_folder_without_depth_is_refused(make, place):
    (make.root / "empty").mkdir()
    with pytest.raises(DvoError, match="--depth"):
        with_depth(images(make), make.root / place)
    with pytest.raises(DvoError, match="--depth-scale"):
        with_depth(images(make), make.root / place, scale=-1.0)


def test_a_video_has_depth_in_order(make):
    file = make.root / "clip.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for k in range(3):
        writer.write(np.full((48, 64, 3), 40 * k, np.uint8))
        depth_image(make, f"d/{k:03d}.png", k + 1, 1000)
    writer.release()
    make.calib("calib.txt")
    source = open_source(file, calib=make.root / "calib.txt")
    assert depths(with_depth(source, make.root / "d")) == [1, 2, 3]
    assert [
        f.depth is not None
        for f in with_depth(open_source(file, calib=make.root / "calib.txt", stride=2), make.root / "d")
    ] == [True, True]
    with pytest.raises(DvoError, match="video"):
        with_depth(source)


def test_smaller_depth_of_the_same_aspect_is_resized(make):
    half = np.arange(12, dtype=np.float32).reshape(3, 4)
    np.testing.assert_array_equal(resized_depth(half, (8, 6), "x")[::2, ::2], half)
    with pytest.raises(DvoError, match="aspect"):
        resized_depth(half, (8, 8), "x")


def test_depth_of_another_camera_is_taken_along_the_rays():
    """A depth camera with a longer lens: the image sees more, and a point is nearer to its centre there."""
    camera = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
    other = Calibration(100.0, 100.0, 31.5, 23.5)
    depth = np.ones((48, 64), np.float32)
    depth[:, 41:43] = 2.0  # 10 pixels right of the centre
    found = registered_depth(depth, other, camera)
    assert found.shape == (48, 64) and found[20, 37] == 2.0 and found[20, 34] == 1.0
    assert np.isnan(found[20, 5]) and np.isnan(found[2, 31])
    with pytest.raises(DvoError, match="distortion"):
        registered_depth(depth, Calibration(100.0, 100.0, 31.5, 23.5, "radtan", (0.1, 0, 0, 0, 0)), camera)


def test_the_camera_of_the_depth_stays_with_a_recalibrated_source(make):
    source = images(make)
    depth_image(make, "d/1.png", 1, 1000)
    found = with_depth(source, make.root / "d", calib=Calibration(100.0, 100.0, 31.5, 23.5))
    for each in (found, found.recalibrated(Calibration(50.0, 50.0, 31.5, 23.5))):
        depth = next(iter(each)).depth
        assert np.isnan(depth[0, 0]) and depth[24, 32] == 1
