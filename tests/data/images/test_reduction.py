import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data import Calibration, open_source
from dvo.data.companions.depth_source import with_depth
from dvo.data.companions.right_source import with_right
from dvo.data.images.reduction import MAX_PIXELS, Reduction, reduction_to
from dvo.geometry.camera import Camera
from dvo.odometry.global_ba.focal_length import FocalProfile
from dvo.odometry.global_ba.self_calibration import Minimum
from dvo.odometry.protocol import Estimate, Status
from tests.support.stand_in_calibration import replace_tracking

WIDTH, HEIGHT = 160, 120
LIMIT = WIDTH * HEIGHT // 3  # a factor of 2
CALIB = Calibration(150, 151, 81, 58)


def averaged(image, factor=2):
    """Mean of blocks of an image whose sides are multiples of the factor."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return image.reshape(height, factor, width, factor, -1).mean(axis=(1, 3))


def smooth(make, index, width=WIDTH, height=HEIGHT):
    return cv2.resize(make.image(index), (width, height), interpolation=cv2.INTER_CUBIC)


def folder(make, suffix="png", width=WIDTH, height=HEIGHT, name="images"):
    path = make.root / name
    path.mkdir()
    for index in range(3):
        assert cv2.imwrite(str(path / f"{index}.{suffix}"), smooth(make, index, width, height))
    return path


@pytest.mark.parametrize(
    ("size", "limit", "factor"),
    [
        ((3840, 2160), MAX_PIXELS, 2),
        ((8000, 6000), MAX_PIXELS, 4),
        ((2000, 2000), MAX_PIXELS, 1),
        ((100, 100), 1112, 3),
    ],
)
def test_the_smallest_factor(size, limit, factor):
    found = reduction_to(limit, *size)
    assert (1 if found is None else found.factor) == factor
    assert reduction_to(None, *size) is None


@pytest.mark.parametrize(("suffix", "tolerance"), [("png", 0.51), ("jpg", 1)])
def test_images_are_averaged_and_the_camera_fits(make, suffix, tolerance):
    path = folder(make, suffix)
    full = list(open_source(path, calib=CALIB, fps=10))
    source = open_source(path, calib=CALIB, fps=10, max_pixels=LIMIT)
    assert source.recorded_camera == full[0].camera == Camera(150, 151, 81, 58, WIDTH, HEIGHT)
    assert source.camera == source.recorded_camera.resized(80, 60) and source.reduction.factor == 2
    assert source.camera.intrinsics == pytest.approx([75, 75.5, 40.25, 28.75])
    for frame, whole in zip(source, full, strict=True):
        assert frame.image.shape == (60, 80, 3) and frame.image.dtype == np.uint8 and frame.camera == source.camera
        assert (frame.index, frame.timestamp) == (whole.index, whole.timestamp)
        assert np.abs(frame.image - averaged(whole.image)).mean() < tolerance
        assert np.abs(frame.image[:, 1:] - averaged(whole.image)[:, :-1]).mean() > 2 * tolerance  # not displaced


def test_jpeg_files_are_decoded_at_the_reduced_size(make, monkeypatch):
    path, modes, decode = folder(make, "jpg"), [], cv2.imdecode
    monkeypatch.setattr(cv2, "imdecode", lambda data, mode: modes.append(mode) or decode(data, mode))
    for limit, factor in ((LIMIT, 2), (LIMIT // 2, 3), (LIMIT // 4, 4)):
        source = open_source(path, calib=CALIB, fps=10, max_pixels=limit)
        modes.clear()
        sizes = {frame.image.shape for frame in source}
        assert source.reduction.factor == factor and sizes == {(HEIGHT // factor, round(WIDTH / factor), 3)}
        known = {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4}
        wanted = known[factor] | cv2.IMREAD_IGNORE_ORIENTATION if factor in known else cv2.IMREAD_UNCHANGED
        assert set(modes) == {wanted}


def test_sides_that_are_no_multiple(make):
    """Pixels lie where the camera of the reduced image says, also at the far end."""
    width, height = 163, 121
    ramp = np.tile(np.arange(width, dtype=np.uint8), (height, 1))
    path = make.root / "images"
    path.mkdir()
    assert cv2.imwrite(str(path / "0.jpg"), ramp, [cv2.IMWRITE_JPEG_QUALITY, 100])
    (frame,) = open_source(path, calib=CALIB, fps=10, max_pixels=LIMIT)
    assert frame.image.shape == (60, 82, 3) and frame.camera.width == 82
    columns = (np.arange(82) - frame.camera.cx) / frame.camera.fx * 150 + 81  # in the recorded image
    assert frame.image[30, :, 0] == pytest.approx(columns, abs=1.5)


def test_sixteen_bits(make):
    path = make.root / "images"
    path.mkdir()
    deep = smooth(make, 0).astype(np.uint16) * 257
    assert cv2.imwrite(str(path / "0.png"), deep)
    (frame,) = open_source(path, calib=CALIB, fps=10, max_pixels=LIMIT)
    assert np.abs(frame.image - averaged(smooth(make, 0)[..., ::-1])).max() < 1


@pytest.mark.parametrize("codec", ["MJPG"])
def test_videos(make, codec):
    video = make.video("v.avi", codec)
    full = list(open_source(video, calib=CALIB))
    source = open_source(video, calib=CALIB, max_pixels=LIMIT)
    frames = list(source)
    assert source.camera == source.recorded_camera.resized(80, 60) and len(frames) == len(full) == 20
    for frame, whole in zip(frames, full, strict=True):
        assert frame.timestamp == whole.timestamp
        assert np.abs(frame.image - averaged(whole.image)).max() < 0.51 + 1e-6
    assert open_source(video, calib=CALIB, max_pixels=None).camera == source.recorded_camera
    assert open_source(video, calib=CALIB).reduction is None  # small enough


def test_undistortion_after_the_reduction(make):
    lens = replace(CALIB, model="radtan", coefficients=(-0.2, 0.05, 0.0, 0.0))
    path = folder(make)
    (full, *_), source = (open_source(path, calib=lens, fps=10, max_pixels=limit) for limit in (None, LIMIT))
    frame = next(iter(source))
    assert source.recorded_camera.coefficients == lens.coefficients and source.camera.model == "none"
    assert source.camera.fx == pytest.approx(full.camera.fx / 2, rel=0.01)
    moved = full.camera.resized(80, 60)
    assert moved.intrinsics == pytest.approx(frame.camera.intrinsics, rel=0.01)
    assert np.abs(frame.image - averaged(full.image)).mean() < 4  # the same view
    again = source.recalibrated(replace(lens, fx=160.0))
    assert again.recorded_camera.fx == 160 and again.camera.width == 80


def test_masks_depth_and_right_images_fit(make):
    path, right = folder(make), folder(make, name="right")
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:, 40:] = 255
    cv2.imwrite(str(make.root / "mask.png"), mask)
    depth = np.tile(np.arange(WIDTH, dtype=np.uint16) + 1000, (HEIGHT, 1))
    (make.root / "depth").mkdir()
    for index in range(3):
        cv2.imwrite(str(make.root / "depth" / f"{index}.png"), depth)
    source = open_source(path, calib=CALIB, fps=10, max_pixels=LIMIT, mask=make.root / "mask.png")
    source = with_right(with_depth(source, make.root / "depth", 1000.0), right, baseline=0.1)
    frame = next(iter(source))
    assert frame.mask.shape == (60, 80) and not frame.mask[:, :20].any() and frame.mask[:, 20:].all()
    assert frame.depth.shape == (60, 80) and frame.depth[3] == pytest.approx(
        1 + (2 * np.arange(80) + 0.5) / 1000, abs=1e-3
    )
    assert frame.right.camera == frame.camera and np.array_equal(frame.right.image, frame.image)


def test_a_mask_of_the_reduced_size_is_refused(make):
    path = folder(make)
    cv2.imwrite(str(make.root / "mask.png"), np.full((60, 80), 255, np.uint8))
    with pytest.raises(DvoError, match="is 80x60, the images are 160x120"):
        open_source(path, calib=CALIB, fps=10, max_pixels=LIMIT, mask=make.root / "mask.png")


def test_images_of_another_size_are_refused(make):
    path = folder(make)
    cv2.imwrite(str(path / "3.png"), smooth(make, 3, 200, 120))
    with pytest.raises(DvoError, match="this image is 200x120, those before are 160x120"):
        list(open_source(path, calib=CALIB, fps=10, max_pixels=LIMIT))


def test_calibrations_of_the_recorded_images_only(make):
    with pytest.raises(DvoError, match="calibration is for 80x60 images, but these are 160x120"):
        open_source(folder(make), calib=replace(CALIB, cx=40, cy=30, width=80, height=60), fps=10, max_pixels=LIMIT)


@pytest.mark.parametrize("pixels", [0, -1, float("nan")])
def test_limits_that_are_none(make, pixels):
    with pytest.raises(DvoError, match="max_pixels"):
        open_source(folder(make), calib=CALIB, fps=10, max_pixels=pixels)


def test_a_found_focal_length_is_that_of_the_recorded_images(make, monkeypatch):
    """The odometry gets the camera of the reduced frames, and the result is in pixels of the recorded ones."""
    cameras = []

    def track(frame):
        cameras.append((frame.camera.fx, frame.camera.width))
        return Estimate(frame.timestamp, None, Status.LOST)

    replace_tracking(monkeypatch, track, lambda: FocalProfile(Minimum(0.0, math.inf, 0.0), 0.0))
    source = open_source(folder(make), guess=True, fps=10, max_pixels=LIMIT)
    found = dvo.calibrate(source)
    assert source.guess.width == WIDTH and cameras == 3 * [(pytest.approx(source.guess.focal / 2), 80)]
    assert (found.focal, found.width, found.height) == (source.guess.focal, WIDTH, HEIGHT)
    assert source.recalibrated(found.calibration).camera.fx == pytest.approx(found.focal / 2)


def test_reduction_leaves_other_sizes_alone():
    reduction, image = Reduction((160, 120), 2), np.zeros((60, 80, 3), np.uint8)
    assert reduction(image) is image and reduction.is_exact and not Reduction((161, 120), 2).is_exact
