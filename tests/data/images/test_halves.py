"""Two views in one image, and bars that are no view."""

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import open_source
from dvo.data.images.halves import looks_all_around, two_views


def barred(image):
    return cv2.copyMakeBorder(image, 60, 60, 0, 0, cv2.BORDER_CONSTANT)


def texture(width):
    noise = np.random.default_rng(3).integers(100, 140, (30, width // 8), dtype=np.uint8)
    return cv2.cvtColor(noise.repeat(8, 0).repeat(8, 1), cv2.COLOR_GRAY2RGB)


def test_the_bars_of_a_letterbox_are_no_second_view():
    assert two_views(barred(texture(640))) is None


def test_two_views_between_bars():
    wide = texture(328)
    assert two_views(barred(np.hstack([wide[:, :320], wide[:, 6:326]]))) == "side by side"


def test_a_black_image():
    assert two_views(np.zeros((240, 320, 3), np.uint8)) is None


def all_around(seed, height=128):
    """An equirectangular image of waves in space."""
    rng = np.random.default_rng(seed)
    angles = (np.arange(2 * height) + 0.5) / height * np.pi
    lon, lat = np.meshgrid(angles, angles[:height] - np.pi / 2)
    rays = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], -1)
    waves = rays @ (rng.normal(size=(3, 40)) * rng.uniform(2, 12, 40))
    grey = np.sin(waves + rng.uniform(0, 6, 40)).sum(-1)
    grey = np.clip(128 + 20 * grey, 0, 255).astype(np.uint8)
    return cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)


@pytest.mark.parametrize("seed", range(6))
def test_images_that_show_all_around(seed):
    whole = all_around(seed)
    assert looks_all_around(whole)
    part = cv2.resize(whole[32:96, 20:148], (256, 128))  # a view of half of it
    assert not looks_all_around(part) and not looks_all_around(whole[:, :200])
    assert not looks_all_around(cv2.copyMakeBorder(part, 0, 0, 64, 64, cv2.BORDER_CONSTANT)[32:, :])
    assert not looks_all_around(np.full((128, 256, 3), 90, np.uint8))


def test_panoramas_by_what_their_files_say(make):
    folder = make.images("clip", ["0.jpg", "1.jpg"])
    assert not open_source(folder, calib=make.calib(), fps=1).warnings
    xmp = b"http://ns.adobe.com/xap/1.0/\0<x GPano:ProjectionType='equirectangular'/>"
    data = (folder / "0.jpg").read_bytes()
    (folder / "0.jpg").write_bytes(data[:2] + b"\xff\xe1" + (len(xmp) + 2).to_bytes(2) + xmp + data[2:])
    with pytest.raises(DvoError, match="shows all around .*v360=e:flat"):
        open_source(folder, guess=True, fps=1)
    assert "shows all around" in open_source(folder, calib=make.calib(), fps=1).warnings[0]
