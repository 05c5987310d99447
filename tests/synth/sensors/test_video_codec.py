"""H.264 compression of renderings."""

import importlib.util
import sys

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.synth.sensors.video_codec import LENGTH, compressed_video
from dvo.synth.sequence import make_sequence

SIZE = {"height": 48, "width": 64, "fps": 15.0, "family": "room", "kind": "handheld"}


def noise(frames=4, height=48, width=64):
    return np.random.default_rng(0).integers(0, 256, (frames, height, width, 3)).astype(np.uint8)


def test_more_compression_loses_more_and_calls_agree():
    y, x = np.mgrid[0:48, 0:64]
    images = np.stack([127 + 100 * np.sin(0.3 * (x + k) + 0.2 * y) for k in range(4)])[..., None].repeat(3, -1)
    images = (images + np.random.default_rng(0).normal(0, 8, images.shape)).clip(0, 255).astype(np.uint8)
    lost = [np.abs(compressed_video(images, crf).astype(float) - images).mean() for crf in (10, 40)]
    assert 0 < lost[0] < 0.7 * lost[1]
    assert np.array_equal(compressed_video(images, 40), compressed_video(images, 40))


@pytest.mark.parametrize(("height", "width"), [(48, 64), (47, 63), (16, 17)])
def test_any_size(height, width):
    grey = np.full((3, height, width, 3), 90, np.uint8)
    assert np.abs(compressed_video(grey, 20).astype(int) - 90).max() <= 3


@pytest.mark.long
def test_a_sequence_is_read_in_any_order():
    sequence = make_sequence(3, frames=LENGTH + 3, h264=34, **SIZE)
    last = sequence.frame(LENGTH + 1).image
    assert np.array_equal(sequence.frame(4).image, list(sequence)[4].image)
    assert np.array_equal(sequence.frame(LENGTH + 1).image, last)
    plain = make_sequence(3, frames=LENGTH + 3, **SIZE)
    difference = np.abs(plain.frame(4).image.astype(float) - sequence.frame(4).image)
    assert 1 < difference.mean() < 30


@pytest.mark.parametrize("program", [sys.executable, "no such program"])
def test_an_encoder_that_does_not_work(monkeypatch, program):
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", program)
    with pytest.raises(DvoError, match="h264: .* failed .*libx264"):
        compressed_video(noise(), 30)


def test_without_the_encoder(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(DvoError, match="imageio-ffmpeg"):
        compressed_video(noise(), 30)
