"""Masks in the tracker: patches, weights, support, saved maps, and a clip under an overlay."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.metrics import evaluate
from dvo.nets.patch.masks import in_sight
from dvo.odometry.frames.gate import missing_content
from dvo.odometry.load import build_odometry
from dvo.odometry.load_map import load_map
from dvo.odometry.protocol import Status
from dvo.odometry.window.pose_validation import measured
from tests.support.overlay_clip import overlay_clip
from tests.support.tiny_members import SETTINGS, frames, network, outcome

MASK = np.ones((72, 96), bool)
MASK[:, 72:] = False


def masked(images, mask=MASK):
    return [replace(frame, mask=mask) for frame in images]


def tracker(weights=None):
    return build_odometry(weights or network("patch_vo"), **SETTINGS["patch_vo"])


def test_no_patch_lies_in_ignored_pixels():
    odometry = tracker()
    for frame in masked(frames(1)):
        odometry.track(frame)
    assert float(4 * odometry.window.patches[:, 0, 1, 1].max()) < 72 - 12
    assert len(odometry.finish().trajectory) == 9


def test_measurements_in_ignored_pixels_have_no_weight():
    """Patches of the whole image are looked for in a frame of which the left part is used."""
    odometry, images = tracker(), frames(1)
    for frame in images[:-1]:
        odometry.track(frame)
    odometry.track(replace(images[-1], mask=np.tile(np.arange(96) < 40, (72, 1))))
    window = odometry.window
    into = window.jj == len(window) - 1
    seen = in_sight(window.targets[None], window.jj, window.visible)[0]
    assert bool((into & seen).any()) and bool((into & ~seen).any()) and bool(seen[~into].all())
    assert bool((window.weights[~seen] == 0).all()) and bool((window.weights[seen] > 0).all())
    assert bool((measured(window, window.confidence, into) == (into & seen)).all())


@pytest.mark.long
def test_a_mask_that_ignores_nothing_changes_nothing():
    assert outcome(tracker(), masked(frames(1), np.ones((72, 96), bool))) == outcome(tracker(), frames(1))


def test_a_map_of_masked_frames_is_saved(tmp_path):
    weights, images = network("patch_vo"), masked(frames(1))
    odometry = tracker(weights)
    for frame in images[:7]:
        odometry.track(frame)
    odometry.save(tmp_path / "half.dvo")
    loaded = load_map(tmp_path / "half.dvo", weights=weights)
    assert [frame.identifier for frame in loaded.graph.archive] == list(range(7))
    kept = [frame for frame in loaded.graph.archive if frame.jpeg is not None]
    assert kept and all((cv2.imdecode(frame.mask, 0) == 255 * MASK).all() for frame in kept)
    assert outcome(odometry, images[7:])[-2] == 9


def test_other_sensors_are_not_read():
    """Depth, right image and unused inertial samples of a frame are functions until they are asked for."""

    def unwanted():
        raise AssertionError("loaded")

    (frame,) = frames(1, count=1)
    full = np.ones((72, 96), bool)
    lazy = Frame(0, 0.0, frame.image, frame.camera, unwanted, unwanted, unwanted, full)
    unused = build_odometry(network("patch_vo"), **SETTINGS["patch_vo"], inertial={"use": False})
    assert unused.track(lazy).status is Status.INITIALISING
    samples = Frame(0, 0.0, frame.image, frame.camera, unwanted, unwanted, None, full)
    assert tracker().track(samples).status is Status.INITIALISING


def test_too_little_is_left():
    estimate = tracker().track(masked(frames(1, count=1), np.pad(np.ones((8, 8), bool), ((64, 0), (88, 0))))[0])
    assert (estimate.status, estimate.reason) == (Status.LOST, "masked image")


@pytest.mark.parametrize("level", [0, 255])
def test_the_overlay_is_no_content(level):
    """A black or white image under a textured overlay has nothing to see."""
    image = np.full((240, 320, 3), level, np.uint8)
    image[200:] = np.random.default_rng(0).integers(0, 256, (10, 80, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)
    mask = np.ones((240, 320), bool)
    mask[200:] = False
    assert missing_content(image) == ""
    assert missing_content(image, mask) == ("white image" if level else "black image")
    image[100:140, 100:200] = 128
    assert missing_content(image, mask) == ""


def test_a_black_overlay_hides_no_content():
    image = np.zeros((240, 320, 3), np.uint8)
    image[:60] = np.random.default_rng(0).integers(0, 256, (15, 80, 3), dtype=np.uint8).repeat(4, 0).repeat(4, 1)
    mask = np.zeros((240, 320), bool)
    mask[:60] = True
    assert missing_content(image, mask) == ""


@pytest.mark.parametrize("name", ["droid", "tartanvo", "deepvo"])
def test_other_odometries_refuse_masks(name):
    odometry = build_odometry(network(name), **SETTINGS.get(name, {}))
    with pytest.raises(DvoError, match="does not use masks"):
        odometry.track(masked(frames(1, count=1))[0])


@pytest.mark.slow
def test_a_clip_under_an_overlay():
    """The overlay is found, and the clip begins anew without it; how much of the picture it is, is told."""
    _, covered, hidden, truth = overlay_clip()
    results = [dvo.run(dvo.load("small"), images).result for images in (covered, hidden)]
    errors = [evaluate(result.trajectory, truth).ate_percent for result in results]
    assert max(errors) < 1
    assert [result.quality.verdict for result in results] == ["doubtful", "good"]
    assert results[0].quality.fixed > 0.2 > 0.05 > results[1].quality.fixed
    assert 0.2 < 1 - hidden[0].mask.mean() < 0.25


def test_a_recording_begins_anew_without_the_pixels_that_are_found_to_be_fixed():
    """As if they had been ignored from the first frame on; later ones are no reason."""
    given, poses = frames(12), []
    for found_at, ignored in ((6, given), (None, masked(given))):
        odometry = tracker()
        odometry.state.fixed.see = lambda image: True
        for number, frame in enumerate(ignored):
            if number == found_at:
                odometry.state.fixed.mask = MASK
            odometry.track(frame)
        poses.append(odometry.finish().trajectory.poses_wc)
        assert odometry.state.beginning is None or found_at is None
    assert len(poses[0]) == len(given) and poses[0].tobytes() == poses[1].tobytes()


def test_no_more_of_large_images_is_kept_than_memory_allows(monkeypatch):
    odometry, kept = tracker(), []
    for frame in frames(6)[:6]:
        odometry.track(frame)
        beginning = odometry.state.beginning
        kept.append(None if beginning is None else len(beginning))
        if len(kept) == 1:
            monkeypatch.setattr("dvo.odometry.patch.tracker.MOST_KEPT", 4 * beginning[0].image.nbytes)
    assert kept == [1, 2, 3, 4, None, None]


def test_fixed_pixels_that_leave_too_little_are_used():
    """As many as all: the frames are not lost for it, and nothing is reported as left out."""
    odometry = tracker()
    given = frames(12)
    for frame in given:
        odometry.state.fixed.mask = np.zeros(frame.image.shape[:2], bool)
        odometry.state.fixed.see = lambda image: True
        odometry.track(frame)
    assert odometry.window.unfixed is None
    result = odometry.finish()
    assert len(result.trajectory) == len(given) > 6 and result.quality.fixed == 0
