"""What two images share."""

import cv2
import numpy as np
import pytest

from dvo.odometry.frames.content import matched_share
from dvo.synth.sequence import make_sequence

SHAPE = (240, 320, 3)


@pytest.fixture(scope="module")
def view():
    return make_sequence(7, frames=1, family="room", kind="handheld").frame(0).image


@pytest.mark.long
def test_views_match_and_noise_and_other_scenes_do_not(view):
    from dvo.odometry.two_frame.deepvo import RegressionConfig

    least = RegressionConfig().min_matches
    rng = np.random.default_rng(0)
    film = [frame.image for frame in make_sequence(9, frames=4, kind="fast", fps=15.0, height=120, width=160)]
    seen = [matched_share(a, b) for a, b in zip(film, film[1:], strict=False)]
    assert min(seen) > 1.3 * least
    # Light that changes, and a blurred image.
    assert matched_share(film[0], (film[1] * 0.4 + 20).astype(np.uint8)) > 1.3 * least
    assert matched_share(film[0], cv2.GaussianBlur(film[1], (5, 5), 2)) > 1.3 * least
    fields = [rng.integers(0, 256, SHAPE, np.uint8) for _ in range(3)]
    fields += [rng.integers(0, 256, SHAPE[:2], np.uint8)[..., None].repeat(3, 2) for _ in range(2)]
    coarse = rng.integers(0, 256, (60, 80, 3), np.uint8)
    fields.append(cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC))
    assert max(matched_share(a, b) for a, b in zip(fields, fields[1:], strict=False)) < 0.7 * least
    assert max(matched_share(view, field) for field in fields) < 0.5 * least
    other = make_sequence(8, frames=1, family="corridor").frame(0).image
    assert matched_share(view, other) < 0.5 * least
    assert matched_share(np.full(SHAPE, 9, np.uint8), view) == 0


def test_the_share_of_a_shifted_image_is_that_of_what_is_still_seen(view):
    shares = [matched_share(view, np.roll(view, shift, 1)) for shift in (0, 16, 40)]
    assert shares[0] == 1 and shares[1] > 0.85 and 0.6 < shares[2] < 0.95
