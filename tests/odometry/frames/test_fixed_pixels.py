"""Pixels that are fixed to the image, found while the rest moves."""

import cv2
import numpy as np
import pytest

from dvo.odometry.frames.fixed_pixels import SAMPLES, FixedPixels


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
