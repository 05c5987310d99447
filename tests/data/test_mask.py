import io

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import Calibration, open_source
from dvo.data.frame import Frame
from dvo.data.frame_checks import checked_frame
from dvo.data.mask import read_mask
from dvo.data.streams.live_source import open_stream
from dvo.geometry.camera import Camera

CALIB = Calibration(50, 50, 31, 23)
SHAPE = 48, 64


def write(make, name, rows=slice(0, 20), channels=1, level=1):
    """Mask that ignores all but some rows."""
    mask = np.zeros((*SHAPE, channels), np.uint8)
    mask[rows] = level
    path = make.root / name
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), mask)
    return path


def rows_of(frame):
    assert frame.mask.dtype == np.bool_ and frame.mask.shape == frame.image.shape[:2]
    assert (frame.mask.all(1) == frame.mask.any(1)).all()
    return frame.mask.any(1).nonzero()[0].tolist()


@pytest.mark.parametrize(
    ("name", "channels", "level"), [("m.png", 1, 1), ("m.png", 3, 255), ("m.png", 4, 9), ("m.jpg", 1, 255)]
)
def test_formats(make, name, channels, level):
    mask = read_mask(write(make, name, slice(0, 24), channels, level))
    assert mask[:24].all() and not mask[24:].any()
    assert np.array_equal(read_mask(make.root / name, invert=True), ~mask)


def test_one_mask_for_all(make):
    folder = make.images("clip", ["0.png", "1.png"])
    write(make, "m.png")
    source = open_source(folder, calib=CALIB, fps=1, mask="../m.png")
    assert [rows_of(frame) for frame in source] == [list(range(20))] * 2
    inverted = open_source(folder, calib=CALIB, fps=1, mask=make.root / "m.png", mask_invert=True)
    again = inverted.recalibrated(Calibration(60, 60, 31, 23))
    assert [rows_of(frame) for frame in again] == [list(range(20, 48))] * 2
    assert next(iter(open_source(folder, calib=CALIB, fps=1))).mask is None


def test_masks_by_stem_and_by_order(make):
    folder = make.images("clip", ["8.png", "9.png", "10.png"])
    for index, stem in enumerate(("10", "9", "8", "7")):
        write(make, f"same/{stem}.png", slice(0, 10 + index))
    for index in range(3):
        write(make, f"order/mask_{index}.png", slice(0, 20 + index))
    same = open_source(folder, calib=CALIB, fps=1, mask=make.root / "same", start="1f")
    assert [len(rows_of(frame)) for frame in same] == [11, 10]
    order = open_source(folder, calib=CALIB, fps=1, mask=make.root / "order")
    assert [len(rows_of(frame)) for frame in order] == [20, 21, 22]
    write(make, "order/mask_3.png")
    with pytest.raises(DvoError, match="4 masks for 3 images"):
        open_source(folder, calib=CALIB, fps=1, mask=make.root / "order")


def test_masks_of_colmap_are_named_after_the_whole_file(make):
    folder = make.images("clip", ["8.png", "9.png"])
    for index, name in enumerate(("10.png", "9.png", "8.png")):
        write(make, f"masks/{name}.png", slice(0, 10 + index))
    found = open_source(folder, calib=CALIB, fps=1, mask=make.root / "masks")
    assert [rows_of(frame)[-1] for frame in found] == [11, 10]


def test_a_mask_that_ignores_nothing_is_told(make):
    """Such as one of 0 and 1 whose meaning is the other one, or a photograph."""
    folder = make.images("clip", ["0.png", "1.png"])
    file = write(make, "m.png", slice(0, 48))
    assert "m.png ignores no pixel" in open_source(folder, calib=CALIB, fps=1, mask=file).warnings[0]
    assert not open_source(folder, calib=CALIB, fps=1, mask=write(make, "n.png", slice(0, 47))).warnings


def test_a_mask_is_undistorted_with_its_image(make):
    """An image that is white where it is used stays white there."""
    folder = make.root / "clip"
    folder.mkdir()
    white = np.zeros((*SHAPE, 3), np.uint8)
    cv2.circle(white, (31, 23), 15, (255, 255, 255), -1)
    for name in ("clip/0.png", "m.png"):
        assert cv2.imwrite(str(make.root / name), white)
    lens = Calibration(40, 40, 31, 23, model="radtan", coefficients=(-0.3, 0.1, 0.0, 0.0))
    (frame,) = open_source(folder, calib=lens, fps=1, mask=make.root / "m.png")
    bright = frame.image[..., 0] > 127
    assert frame.mask.sum() > 300 and (frame.mask != bright).sum() < 0.06 * bright.sum()
    assert not np.array_equal(frame.mask, white[..., 0] > 0)


def test_masks_that_cannot_be_used(make):
    folder = make.images("clip", ["0.png"])
    assert cv2.imwrite(str(make.root / "small.png"), np.ones((10, 12), np.uint8))
    assert cv2.imwrite(str(make.root / "black.png"), np.zeros((48, 64), np.uint8))
    wrong = {"small.png": "is 12x10, the images are 64x48", "none.png": "no such file", "black.png": "hides all"}
    for mask, message in wrong.items():
        with pytest.raises(DvoError, match=message):
            open_source(folder, calib=CALIB, fps=1, mask=make.root / mask)
    with pytest.raises(DvoError, match="cannot be read as an image"):
        open_source(folder, calib=CALIB, fps=1, mask=make.text("words.png", "no image"))
    with pytest.raises(DvoError, match="no mask to invert"):
        open_source(folder, calib=CALIB, fps=1, mask_invert=True)


def test_a_stream_takes_one_mask(make):

    data = io.BytesIO(cv2.imencode(".png", make.image(0))[1].tobytes())
    (frame,) = open_stream(data, calib=CALIB, fps=1, mask=write(make, "m.png"))
    assert rows_of(frame) == list(range(20))


def test_masks_of_frames():
    camera, image = Camera(50.0, 50.0, 31.5, 23.5, 64, 48), np.zeros((*SHAPE, 3), np.uint8)
    numbers = np.arange(48 * 64, dtype=np.uint8).reshape(SHAPE)
    assert np.array_equal(checked_frame(Frame(0, 0.0, image, camera, mask=numbers)).mask, numbers != 0)
    ready = Frame(0, 0.0, image, camera, mask=numbers > 5)
    assert checked_frame(ready) is ready
    for mask, message in ((numbers[1:], "shape"), (numbers.astype(float), "float64"), ([1], "of type list")):
        with pytest.raises(DvoError, match=f"frame 0: mask: .*{message}"):
            checked_frame(Frame(0, 0.0, image, camera, mask=mask))
