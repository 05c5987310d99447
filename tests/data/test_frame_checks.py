"""Frames as users make them: what is converted, what is refused and how, and what is left alone."""

from __future__ import annotations

import warnings
from importlib.util import find_spec, module_from_spec

import numpy as np
import pytest
import torch

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_frame
from dvo.geometry.camera import Camera
from dvo.models.patch_vo import PatchVO
from dvo.nets.patch.config import preset
from dvo.odometry.patch.config import TrackerConfig
from dvo.odometry.patch.tracker import PatchOdometry
from dvo.session import session

CAMERA = Camera(50, 50, 31.5, 23.5, 64, 48)
RGB = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
GREY = RGB[..., 1].copy()
GREY3 = np.repeat(GREY[..., None], 3, axis=2)


def frame(image=RGB, timestamp=0.5, camera=CAMERA, index=7, **more) -> Frame:
    return Frame(index, timestamp, image, camera, **more)


def read_only(image: np.ndarray) -> np.ndarray:
    image = image.copy()
    image.flags.writeable = False
    return image


def test_good_frame_is_returned_itself():
    good = frame(depth=lambda: pytest.fail("depth was read"), right=lambda: pytest.fail("right was read"))
    assert checked_frame(good) is good
    assert checked_frame(made := frame(timestamp=np.float64(0.5))) is made


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        (GREY, GREY3),
        (GREY[..., None], GREY3),
        (np.dstack([RGB, GREY]), RGB),
        (RGB.astype(np.uint16) * 257, RGB),
        (GREY.astype(">u2") * 257, GREY3),
        (RGB / 255, RGB),
        ((RGB / 255).astype(np.float32), RGB),
        ((RGB / 255).astype(">f4"), RGB),
        ((RGB / 255).astype(np.longdouble), RGB),
        (np.dstack([RGB, GREY]).astype(np.float32) / 255, RGB),
        (np.asfortranarray(RGB), RGB),
        (RGB[..., ::-1].copy()[..., ::-1], RGB),
        (RGB[::-1].copy()[::-1], RGB),
        (np.repeat(RGB, 2, axis=1)[:, ::2], RGB),
        (read_only(RGB), RGB),
        (torch.from_numpy(RGB), RGB),
        (torch.from_numpy(RGB).permute(2, 0, 1), RGB),
        (torch.from_numpy(GREY)[None], GREY3),
        (torch.from_numpy(GREY), GREY3),
        (torch.from_numpy(np.dstack([RGB, GREY])).permute(2, 0, 1), RGB),
        ((torch.from_numpy(RGB) / 255).requires_grad_(), RGB),
        ((torch.from_numpy(RGB) / 255).double(), RGB),
    ],
)  # fmt: skip
def test_images_are_converted_without_loss(image, expected):
    found = checked_frame(frame(image)).image
    assert found.dtype == np.uint8 and found.flags.carray and type(found) is np.ndarray
    np.testing.assert_array_equal(found, expected)


def test_conversion_leaves_the_rest_of_the_frame_alone():
    def fail() -> None:
        pytest.fail("a lazy field was read")

    given = frame(GREY, depth=fail, right=fail, inertial=fail)
    found = checked_frame(given)
    assert (found.index, found.timestamp, found.camera) == (7, 0.5, CAMERA)
    assert given.image is GREY and checked_frame(found) is found
    loaded = checked_frame(frame(GREY, depth=lambda: np.ones((48, 64), np.float32)))
    assert loaded.depth.shape == (48, 64)


def test_uint16_is_divided_by_257_and_rounded():
    values = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    found = checked_frame(frame(values, camera=Camera(50, 50, 127.5, 127.5, 256, 256))).image[..., 0]
    np.testing.assert_array_equal(found, np.rint(values / 257))


def test_floats_are_rounded_and_may_exceed_the_range_by_less_than_half_a_level():
    image = np.full((48, 64, 3), 0.5)
    image[0, 0], image[0, 1] = 1.0001, -0.0001
    found = checked_frame(frame(image)).image
    assert found[0, 0].tolist() == [255] * 3 and found[0, 1].tolist() == [0] * 3 and found[1, 1, 0] == 128
    image[0, 0] = 1.01
    with pytest.raises(DvoError, match="must lie in 0..1"):
        checked_frame(frame(image))


def as_in_a_new_process():
    """The check, from a copy of its module that has not warned of anything yet."""
    spec = find_spec("dvo.data.frame_checks")
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.checked_frame


def test_low_16_bit_values_warn_once():
    check, dark = as_in_a_new_process(), RGB.astype(np.uint16) * 8
    with pytest.warns(UserWarning, match="frame 7: image: uint16 values up to 2040") as told:
        check(frame(dark))
        check(frame(dark, index=8))
    assert len(told) == 1
    check = as_in_a_new_process()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(frame(np.zeros_like(dark)))
        check(frame(dark + 4096))


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "P", "1", "LA", "CMYK", "I;16", "F"])
def test_pil_images(mode):
    image_of = pytest.importorskip("PIL.Image")
    if mode == "I;16":
        given, expected = image_of.fromarray(GREY.astype(np.uint16) * 257), GREY3
    elif mode == "F":
        given, expected = image_of.fromarray((GREY / 255).astype(np.float32)), GREY3
    else:
        given = image_of.fromarray(RGB).convert(mode)
        expected = np.asarray(given.convert("RGB"))
    assert given.mode == mode
    np.testing.assert_array_equal(checked_frame(frame(given)).image, expected)


def test_broken_pil_image_is_refused(tmp_path):
    image_of = pytest.importorskip("PIL.Image")
    image_of.fromarray(RGB).save(tmp_path / "whole.png")
    (tmp_path / "cut.png").write_bytes((tmp_path / "whole.png").read_bytes()[:2000])
    with pytest.raises(DvoError, match="frame 7: image: .* cannot be read as an array"):
        checked_frame(frame(image_of.open(tmp_path / "cut.png")))


def with_value(value: float, dtype: type = np.float32) -> np.ndarray:
    image = (RGB / 255).astype(dtype)
    image[3, 4, 1] = value
    return image


@pytest.mark.parametrize(
    ("image", "message", "remedy"),
    [
        (None, "got None", "numpy array of uint8"),
        ("clip.png", "type str", "numpy array"),
        (RGB.tolist(), "type list", "numpy array of uint8"),
        ([[1, 2], [3]], "type list", "numpy array"),
        (with_value(np.nan), "1 of 9216 values are not finite", "replace nan"),
        (with_value(np.inf), "1 of 9216 values are not finite", "replace nan"),
        (with_value(np.nan, np.float16), "not finite", "replace nan"),
        (RGB.astype(np.float32), "0..1, got 0 to 255", "give uint8, or divide by 255"),
        (RGB.astype(np.float32) * 257, "0..1, got 0 to 65535", "divide by 65535"),
        (RGB / 127.5 - 1, "0..1, got -1 to 1", "scale them to 0..1"),
        (RGB > 99, "type bool", "a mask is no image"),
        (RGB.astype(np.int64), "type int64", "uint8"),
        (RGB.astype(np.int8), "type int8", "uint8"),
        (RGB.astype(object), "type object", "uint8"),
        (RGB.astype(complex), "type complex128", "uint8"),
        (RGB.astype(str), "type <U", "uint8"),
        (RGB.astype("M8[s]"), "type datetime64", "uint8"),
        (np.zeros((48, 64, 3), "u1,u1"), "has pixels of type", "uint8"),
        (RGB[:0], "has no pixels (0 x 64 x 3)", "(H, W, 3)"),
        (RGB[:, :, :0], "(48 x 64 x 0)", "(H, W, 3)"),
        (RGB[..., :2], "(48 x 64 x 2)", "(H, W, 3)"),
        (np.zeros((48, 64, 5), np.uint8), "(48 x 64 x 5)", "(H, W, 3)"),
        (RGB[None], "(1 x 48 x 64 x 3)", "image[0]"),
        (RGB.transpose(2, 0, 1), "(3 x 48 x 64)", "image.transpose(1, 2, 0)"),
        (np.uint8(3), "single number", "(H, W, 3)"),
        (np.zeros(0, np.uint8), "(0)", "(H, W, 3)"),
        (torch.zeros(48, 64, 3, dtype=torch.int32), "type int32", "uint8"),
        (torch.zeros(48, 64, 3, dtype=torch.bool), "type bool", "uint8"),
        (torch.zeros(48, 64, 3, device="meta"), "cannot be read as an array", "numpy array"),
        (torch.zeros(48, 64, dtype=torch.uint8).to_sparse(), "cannot be read as an array", "numpy array"),
        (torch.full((48, 64, 3), torch.nan), "not finite", "replace nan"),
    ],
)  # fmt: skip
def test_bad_images_are_refused(image, message, remedy):
    with pytest.raises(DvoError) as caught:
        checked_frame(frame(image))
    error = caught.value
    assert error.field == "frame 7: image" and message in error.message and remedy in error.remedy
    assert "\n" not in str(error)


class Image:
    """Image of another package; without an array it fails in a way of its own."""

    def __init__(self, array: np.ndarray | None = None) -> None:
        self.array = array

    def __array__(self, dtype: object = None, copy: object = None) -> np.ndarray:
        if self.array is None:
            raise KeyError("no\npixels")
        return self.array


def test_objects_with_an_array():
    np.testing.assert_array_equal(checked_frame(frame(Image(GREY))).image, GREY3)
    with pytest.raises(DvoError, match="frame 7: image: an object of type Image cannot be read as an array"):
        checked_frame(frame(Image()))
    with pytest.raises(DvoError, match="frame 7: image: .*(1 x 48 x 64 x 3)"):
        checked_frame(frame(Image(RGB[None])))


@pytest.mark.parametrize(
    ("timestamp", "expected"),
    [(3, 3.0), (np.int64(3), 3.0), (np.float32(0.25), 0.25), (np.float64(0.1), 0.1), (-1.5, -1.5), (0, 0.0)],
)
def test_times_become_floats(timestamp, expected):
    found = checked_frame(frame(timestamp=timestamp)).timestamp
    assert found == expected and isinstance(found, float)


@pytest.mark.parametrize(
    ("timestamp", "message"),
    [
        (float("nan"), "nan is not finite"),
        (float("inf"), "inf is not finite"),
        (np.float32(-np.inf), "-inf is not finite"),
        (10**400, "not finite"),
        (True, "type bool"),
        (np.bool_(True), "type bool"),
        ("0.5", "type str"),
        (None, "got None"),
        (1j, "type complex"),
        (np.timedelta64(3, "s"), "type timedelta64"),
        (np.datetime64("2026-01-01"), "type datetime64"),
        (np.array([0.5]), "type ndarray"),
    ],
)
def test_bad_times_are_refused(timestamp, message):
    with pytest.raises(DvoError) as caught:
        checked_frame(frame(timestamp=timestamp))
    assert caught.value.field == "frame 7: timestamp" and message in caught.value.message
    assert "seconds" in caught.value.remedy


def test_bad_cameras_are_refused():
    for camera, message in ((None, "got None"), (np.eye(3), "type ndarray"), ((50, 50, 31.5, 23.5), "type tuple")):
        with pytest.raises(DvoError, match=message) as caught:
            checked_frame(frame(camera=camera))
        assert caught.value.field == "frame 7: camera" and "dvo.Camera" in caught.value.remedy
    with pytest.raises(DvoError, match="frame 7: camera: is of a 640x480 image, but the image is 64x48"):
        checked_frame(frame(camera=CAMERA.resized(640, 480)))
    with pytest.raises(DvoError, match="is of a 48x64 image, but the image is 64x48"):
        checked_frame(frame(camera=Camera(50, 50, 23.5, 31.5, 48, 64)))


@pytest.mark.parametrize("given", [None, RGB, "frame", (0, 0.0, RGB, CAMERA), Frame])
def test_what_is_no_frame_is_refused(given):
    with pytest.raises(DvoError, match=r"frame: expected a dvo.Frame, got .* Give dvo.Frame\(index"):
        checked_frame(given)


@pytest.mark.parametrize("time", [1_403_636_579_763_555_584, 1.4e18, 1.7e15, -1.7e12, 1.7e12])
def test_dates_in_a_finer_unit_are_no_seconds(time):
    with pytest.raises(DvoError, match="frame 7: timestamp: .* is no number of seconds"):
        checked_frame(frame(timestamp=time))


@pytest.mark.parametrize("index", [None, "3", 1.5])
def test_index_must_be_a_whole_number(index):
    with pytest.raises(DvoError, match="frame: index: expected a whole number"):
        checked_frame(frame(index=index))


def test_a_run_checks_every_frame_and_reports_the_converted_ones(fake_odometry):
    odometry = fake_odometry()
    given = [Frame(k, 0.1 * k, GREY, CAMERA) for k in range(5)]
    seen = []
    done = session.run(odometry, given, stride=2, on_frame=lambda frame, estimate: seen.append(frame))
    assert len(done.result.trajectory) == 5 and done.warnings == ()
    for one in (*odometry.frames, *seen):
        np.testing.assert_array_equal(one.image, GREY3)
    assert [one.index for one in seen] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize(
    "broken", [Frame(3, 0.3, with_value(np.nan), CAMERA), Frame(3, np.nan, RGB, CAMERA), None, Frame(3, 0.3, RGB, None)]
)
def test_a_run_keeps_what_was_tracked_before_a_bad_frame(fake_odometry, broken, stride):
    good = [Frame(k, 0.1 * k, RGB, CAMERA) for k in range(6)]
    if broken is None:
        broken = RGB  # None ends a source
    done = session.run(fake_odometry(), [*good[:3], broken, *good[4:]], stride=stride)
    assert len(done.result.trajectory) == 3
    (warning,) = done.warnings
    assert warning.startswith("stopped at frame 3: frame")
    with pytest.raises(DvoError):
        session.run(fake_odometry(), [broken, *good[4:]])


@pytest.mark.long
def test_the_tracker_goes_on_after_a_bad_frame_as_if_it_had_not_come():
    """Every kind of bad frame raises a DvoError; poses of good frames are those of a run without them."""
    config = TrackerConfig(pixels=64 * 48, patches=6, lifetime=4, removal=5, optimisation=4, initial_frames=5)
    wall = np.random.default_rng(1).integers(0, 256, (48, 64 + 4 * 9, 3), dtype=np.uint8)
    good = [Frame(k, 0.1 * k, wall[:, 4 * k : 4 * k + 64].copy(), CAMERA) for k in range(9)]
    images = (None, RGB[:0], with_value(np.nan), RGB > 99, RGB[:40], RGB.tolist(), RGB.transpose(2, 0, 1))
    bad = [frame(image, timestamp=0.35) for image in images]
    bad += [frame(timestamp=np.nan), frame(timestamp="1"), frame(camera=None), None, RGB]

    def track(sources: list) -> list[np.ndarray]:
        torch.manual_seed(0)
        odometry = PatchOdometry(PatchVO(preset("tiny")), config)
        poses = []
        for one in sources:
            if any(one is other for other in bad):
                with pytest.raises(DvoError, match="frame"):
                    odometry.track(one)
            else:
                pose_wc = odometry.track(one).pose_wc
                poses.append(np.full(7, np.nan) if pose_wc is None else pose_wc)
        assert np.isfinite(poses[-1]).all()
        assert np.isfinite(odometry.finish().trajectory.poses_wc).all()
        return poses

    np.testing.assert_array_equal(track([*bad, *good[:4], *bad, *good[4:], *bad]), track(good))
    as_floats = [Frame(one.index, one.timestamp, one.image / 255, one.camera) for one in good]
    np.testing.assert_array_equal(track(as_floats), track(good))
