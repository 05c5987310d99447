"""Pixels that are fixed to the image, found while the rest moves."""

import cv2
import numpy as np
import pytest

from dvo.odometry.frames.fixed_pixels import MARGIN, SAMPLES, Bars, FixedPixels


@pytest.fixture(scope="module")
def texture():
    rng = np.random.default_rng(0)
    levels = [cv2.resize(rng.uniform(0, 255, (n, 2 * n)), (640, 320), interpolation=cv2.INTER_CUBIC) for n in (20, 60)]
    grey = np.clip(0.5 * levels[0] + 0.5 * levels[1], 0, 255).astype(np.uint8)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)


def moving(texture, count, step, overlay=None, seed=1):
    """Frames of 160x120 that move over the texture, with sensor noise."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        x = round(k * step)
        image = texture[40:160, x : x + 160].copy()
        if overlay is not None:
            image[overlay > 0] = overlay[overlay > 0]
        yield np.clip(image + rng.normal(0, 1.0, image.shape), 0, 255).astype(np.uint8)


def bonnet(texture):
    """Overlay over the lowest quarter: a part of the same texture that stays."""
    overlay = np.zeros((120, 160, 3), np.uint8)
    overlay[90:] = np.maximum(texture[200:230, 300:460], 1)
    return overlay


def seen(frames):
    fixed = FixedPixels()
    for image in frames:
        fixed.see(image)
    return fixed


def test_what_stays_while_the_rest_moves_is_ignored(texture):
    mask = seen(moving(texture, 20, 3.0, bonnet(texture))).mask
    assert mask is not None and (~mask[95:]).mean() > 0.6 and mask[:85].mean() > 0.97


def test_a_picture_that_moves_as_a_whole_has_no_fixed_pixels(texture):
    mask = seen(moving(texture, 20, 3.0)).mask
    assert mask is None or mask.mean() > 0.98


def test_a_camera_that_stands_still_fixes_nothing(texture):
    fixed = seen(moving(texture, 4 * SAMPLES, 0.0, bonnet(texture)))
    assert fixed.mask is None
    for image in moving(texture, 20, 3.0, bonnet(texture)):
        fixed.see(image)
    standing = fixed.mask.copy()
    for image in [*moving(texture, 40, 0.0, bonnet(texture))]:
        fixed.see(image)
    assert (fixed.mask == standing).mean() > 0.99, "what was found is kept"


def test_a_body_before_a_still_camera_fixes_nothing(texture):
    still = np.maximum(texture[40:160, :160], 1)
    overlay = still.copy()
    overlay[20:100, 60:110] = 0  # the body moves there
    assert seen(moving(texture, 30, 3.0, overlay)).mask is None


def test_a_mask_ends_when_what_was_fixed_moves(texture):
    fixed = seen(moving(texture, 20, 3.0, bonnet(texture)))
    for image in moving(texture, 60, 3.0):
        fixed.see(image)
    assert fixed.mask is None or fixed.mask[95:].mean() > 0.9


def test_edges_along_which_the_picture_moves_are_not_fixed(texture):
    """Lane markings of a straight drive: they look the same in every frame."""
    lane = np.zeros((120, 160, 3), np.uint8)
    lane[100:106] = 255
    lane[94:100] = 40
    mask = seen(moving(texture, 30, 3.0, lane)).mask
    assert mask is None or mask[92:108].mean() > 0.97


def test_what_lies_straight_ahead_is_not_fixed(texture):
    """The picture grows from its middle, where nothing moves."""
    base = texture[40:160, 100:260]

    def grown(scale):
        matrix = cv2.getRotationMatrix2D((79.5, 59.5), 0, scale)
        return cv2.warpAffine(base, matrix, (160, 120), borderMode=cv2.BORDER_REFLECT)

    frames = [grown(1.03**k) for k in range(30)]
    mask = seen(frames).mask
    assert mask is None or mask.mean() > 0.98
    overlay = bonnet(texture)
    mask = seen([np.where(overlay > 0, overlay, image) for image in frames]).mask
    assert mask is not None and (~mask[95:]).mean() > 0.4 and mask[:85].mean() > 0.97


def boxed(images, above, below, left, right, level=0, quality=None):
    """The images between bars, as JPEG with artefacts if a quality is given."""
    for image in images:
        image = cv2.copyMakeBorder(image, above, below, left, right, cv2.BORDER_CONSTANT, value=(level,) * 3)
        if quality is not None:
            image = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1], 1)
        yield image


@pytest.mark.parametrize("widths", [(16, 16, 0, 0), (0, 0, 24, 24), (16, 16, 24, 24), (0, 12, 0, 0), (0, 0, 8, 30)])
@pytest.mark.parametrize(("level", "quality"), [(0, None), (24, 70)])
def test_bars_are_known_from_the_first_frame(texture, widths, level, quality):
    above, below, left, right = widths
    fixed = seen(boxed(moving(texture, 1, 3.0), *widths, level, quality))
    height, width = fixed.mask.shape
    right_one = np.zeros((height, width), bool)
    rows = slice(above and above + MARGIN, height - (below and below + MARGIN))
    right_one[rows, slice(left and left + MARGIN, width - (right and right + MARGIN))] = True
    assert (fixed.mask != right_one).mean() < 0.02 and np.array_equal(fixed.mask, fixed.picture)
    for image in boxed(moving(texture, 20, 3.0, bonnet(texture)), *widths, level, quality):
        fixed.see(image)
    bonnet_rows = slice(above + 97, above + 120)
    assert (~fixed.mask[bonnet_rows]).mean() > 0.6 and not fixed.mask[~right_one].any(), (
        "what is found later adds to it"
    )


def test_bars_are_as_narrow_as_in_any_frame(texture):
    """A dark scene may look like a wider bar; bars that end are none."""
    first, second = [*boxed(moving(texture, 2, 3.0), 16, 16, 0, 0)]
    wide = first.copy()
    wide[:40] = 0
    bars = Bars().with_image(wide)
    assert bars.widths == (40, 16, 0, 0) and all(bars.seen[:2])
    bars = bars.with_image(second)
    assert bars.widths == (16, 16, 0, 0) and bars.seen == (True, True, False, False)
    bars = bars.with_image(next(moving(texture, 1, 3.0)))
    assert bars.widths == (0, 0, 0, 0) and not any(bars.seen)


def test_darkness_and_skies_are_no_bars(texture):
    night = np.zeros((120, 160, 3), np.uint8)
    assert seen([night]).mask is None
    dim = next(moving(texture, 1, 3.0)) // 12  # little light everywhere
    dim[:30] //= 4
    assert seen([dim]).mask is None
    sky = next(moving(texture, 1, 3.0))
    sky[:40] = 255
    assert seen([sky]).mask is None
    lamps = night.copy()
    lamps[60:70, 20:30] = 200  # the darkness above the only lamp ends at no straight edge
    assert seen([lamps]).mask is None
