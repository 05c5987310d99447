"""Calibration of a camera from its images: ``dvo.calibrate``."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

import dvo
from dvo.core.errors import DvoError
from dvo.data import read_calibration
from dvo.data.calibration.focal_guess import FocalGuess, guess_from_angle
from dvo.geometry.undistort import Undistorter
from dvo.odometry.calibration.calibrate import CalibrationOptions, calibrate
from dvo.odometry.calibration.camera_estimate import SelfCalibration
from dvo.odometry.global_ba.focal_length import FocalProfile
from dvo.odometry.global_ba.self_calibration import Minimum
from dvo.odometry.protocol import Estimate, Status
from dvo.synth.sequence import make_sequence
from tests.support.stand_in_calibration import replace_tracking

FLAT = (Minimum(0.0, math.inf, 0.0),) * 2


@pytest.fixture(scope="module")
def clip():
    return list(
        make_sequence(77, frames=30, height=144, width=192, fps=30.0, family="room", kind="handheld", apart=True)
    )


@pytest.fixture(scope="module")
def found(clip):
    guess = FocalGuess(1.08 * clip[0].camera.fx, 0.3 * clip[0].camera.fx, "given", 192, 144)
    return calibrate(clip, guess, options=CalibrationOptions(rounds=1))


@pytest.mark.long
def test_the_focal_length_of_a_rendered_walk_is_found(clip, found):
    camera = clip[0].camera
    assert found.found and found.reason == "" and found.frames > 24
    assert found.focal == pytest.approx((camera.fx + camera.fy) / 2, rel=0.05)
    assert 0 < found.deviation < 0.1 * found.focal
    assert f"focal length {found.focal:.0f} +- {found.deviation:.0f} px (self-calibrated from" in str(found)


@pytest.mark.slow
def test_the_principal_point_is_told_where_the_measurements_tell_it(clip):
    """That of the rendered camera lies 3 pixels from the middle of the image; more than half of that is found."""
    options = CalibrationOptions(spare=500, max_aside=0.015)
    camera, believed = clip[0].camera, options.max_aside * 192
    true = camera.cx - 95.5, camera.cy - 71.5
    assert math.hypot(*true) > 2
    found = calibrate(clip, FocalGuess(camera.fx, 0.3 * camera.fx, "given", 192, 144), options=options)
    assert 0 < found.aside_deviation[0] <= believed and abs(found.aside[0] - true[0]) < abs(true[0]) / 2
    for value, deviation, wanted in zip(found.aside, found.aside_deviation, true, strict=True):
        assert value == 0 if math.isinf(deviation) else abs(value - wanted) < 3 * deviation
    assert str(found).splitlines()[1].startswith(f"principal point cx {95.5 + found.aside[0]:.1f} +- ")


def test_without_its_deviation_the_principal_point_is_the_middle(leaning):
    sure, unsure = Minimum(0.02, 0.001, 0.1), Minimum(0.02, 0.01, 0.1)
    guess = FocalGuess(200.0, 40.0, "prior", 192, 144)
    found, tracked = leaning(1.0, guess, aside=(sure, unsure), rounds=2)
    assert found.aside_deviation == (pytest.approx(math.hypot(0.6, 4.0)), math.inf) and len(tracked) == 2
    assert found.aside == (pytest.approx(2 * 0.02 * 200), 0.0), "tracked again with what the first round found"
    assert found.calibration.cx == pytest.approx(95.5 + 8.0) and found.calibration.cy == 71.5
    assert str(found).splitlines()[1] == "principal point cx 103.5 +- 4.0 px, cy 71.5 px, the centre"
    last, _ = leaning(1.0, guess, aside=(sure, unsure), rounds=1)
    assert last.aside_deviation[0] == pytest.approx(math.hypot(0.6, 4.0)), "it has not settled"
    far, _ = leaning(1.0, guess, aside=(replace(sure, value=0.11), unsure), rounds=1)
    assert far.found and far.aside == (0.0, 0.0), "22 of 192 pixels are hardly possible"
    found, tracked = leaning(1.0, guess, aside=(sure, unsure), max_aside=0.0)
    assert found.aside == (0.0, 0.0) and len(str(found).splitlines()) == 1 and len(tracked) == 1


def test_the_distortion_that_was_found_is_taken_from_the_images_of_the_next_round(clip, monkeypatch, tmp_path):
    tracked = []

    def track(frame):
        tracked.append(frame)
        return Estimate(frame.timestamp, None, Status.TRACKING)

    bent = FocalProfile(Minimum(0.0, 0.01, 0.5), 0.5, FLAT, Minimum(0.4, 0.01, 0.5))
    replace_tracking(monkeypatch, track, lambda: bent)
    frames = [replace(frame, mask=np.ones((144, 192), bool)) for frame in clip]
    options = CalibrationOptions(frames=30, spare=1000)
    found = calibrate(frames, FocalGuess(100.0, 40.0, "prior", 192, 144), options=options)
    assert len(tracked) == 60 and (found.bend, found.bend_deviation) == (0.4, pytest.approx(0.03))
    undistorter = Undistorter(dvo.Camera(100.0, 100.0, 95.5, 71.5, 192, 144, "eucm", (0.4, 1.0)))
    assert tracked[0].camera.intrinsics[0] == 100 and np.array_equal(tracked[0].image, clip[0].image)
    assert tracked[30].camera == undistorter.camera and tracked[30].mask.shape == (144, 192)
    assert np.array_equal(tracked[30].image, undistorter(clip[0].image))
    assert str(found).splitlines()[1] == "barrel distortion: eucm, alpha 0.40 +- 0.03, beta 1"
    assert found.write(tmp_path / "calib.txt")
    assert read_calibration(tmp_path / "calib.txt").camera(192, 144) == found.calibration.camera(192, 144)


@pytest.mark.slow
def test_the_same_seed_and_an_iterator_give_the_same_bytes(clip):
    options = CalibrationOptions(frames=20, rounds=1)
    assert calibrate(iter(clip), options=options) == calibrate(clip, options=options)


@pytest.mark.long
def test_the_file_for_the_next_run(tmp_path, found):
    file = tmp_path / "calib.txt"
    assert found.write(file) and found.write(file)
    camera = read_calibration(file).camera(192, 144)
    assert camera.fx == camera.fy == pytest.approx(found.focal, abs=1e-3)
    assert (camera.cx, camera.cy) == pytest.approx((95.5 + found.aside[0], 71.5 + found.aside[1]), abs=0.1)
    file.write_text("1 2 3 4\n")
    assert not found.write(file) and file.read_text() == "1 2 3 4\n"


def test_a_guess_that_is_kept_is_no_file(tmp_path):
    guess = FocalGuess(100.0, 25.0, "prior", 192, 144)
    kept = SelfCalibration(100.0, 25.0, "prior", 192, 144, 0, "too few frames could be tracked", guess)
    assert not kept.write(tmp_path / "calib.txt") and not any(tmp_path.iterdir())


@pytest.fixture
def leaning(clip, monkeypatch):
    """Calibration by measurements that ask for a share of the way to 200 px, the logarithm known to 1 %."""

    def find(share, guess, aside=FLAT, **options):
        tracked = []

        def track(frame):
            if frame.index == 0:
                tracked.append(frame.camera.fx)
            return Estimate(frame.timestamp, None, Status.TRACKING)

        def profile():
            step = share * math.log(200 / tracked[-1])
            return FocalProfile(Minimum(step, 0.01, 0.5), 0.5, aside)

        replace_tracking(monkeypatch, track, profile)
        frames = [replace(clip[0], index=k, timestamp=k / 30) for k in range(60)]
        return calibrate(frames, guess, options=CalibrationOptions(**{"frames": 30, "spare": 1000, **options})), tracked

    return find


def test_the_bars_of_a_letterbox_are_left_out(clip, monkeypatch):
    """A picture in the lower part of the image: its middle is that of the camera, its longer side that of the guess."""
    tracked = []

    def track(frame):
        tracked.append(frame)
        return Estimate(frame.timestamp, None, Status.TRACKING)

    replace_tracking(monkeypatch, track, lambda: FocalProfile(Minimum(0.0, 0.01, 0.5), 0.5, FLAT))
    wide = dvo.Camera(150.0, 150.0, 159.5, 99.5, 320, 200)
    bars = (40, 16), (64, 64), (0, 0)
    frames = [replace(frame, image=np.pad(frame.image, bars), camera=wide) for frame in clip[:30]]
    found = calibrate(frames, options=CalibrationOptions(frames=30))
    guess = guess_from_angle(190, 142)  # without the outermost pixels, which are of both as often as not
    assert found.focal == pytest.approx(guess.focal) and (found.width, found.height) == (320, 200)
    assert {(f.camera.width, f.camera.height, f.camera.cx, f.camera.cy) for f in tracked} == {(190, 142, 94.5, 70.5)}
    assert np.array_equal(tracked[3].image, clip[3].image[1:-1, 1:-1])
    assert (found.calibration.cx, found.calibration.cy) == (159.5, 111.5)


@pytest.mark.parametrize(("lean", "rounds"), [(0.0, 1), (0.3, 3), (0.6, 3)])
def test_the_secant_finds_the_fixed_point_of_measurements_that_lean(leaning, lean, rounds):
    """Measurements tracked at x ask for (1 - lean) of the way to 0."""
    guess = FocalGuess(200 * math.exp(0.4), 100.0, "prior", 192, 144)
    found, _ = leaning(1 - lean, guess, rounds=rounds)
    assert found.found and math.log(found.focal / 200) == pytest.approx(0, abs=1e-9)


def test_a_round_that_tells_far_better_does_not_lean_as_the_one_before(clip, monkeypatch):
    """Tracked with 256 px, the measurements ask for 160 px at a low contrast; with those, for what is right."""
    asked = []

    def track(frame):
        if frame.index == 0:
            asked.append(frame.camera.fx)
        return Estimate(frame.timestamp, None, Status.TRACKING)

    def profile():
        right = len(asked) > 1
        step = math.log((122 if right else 160) / asked[-1])
        return FocalProfile(Minimum(step, 0.01, 0.5), 2.6 if right else 0.07, FLAT)

    replace_tracking(monkeypatch, track, profile)
    frames = [replace(clip[0], index=k, timestamp=k / 30) for k in range(60)]
    options = CalibrationOptions(frames=30, spare=1000)
    found = calibrate(frames, FocalGuess(256.0, 64.0, "prior", 192, 144), options=options)
    assert found.focal == pytest.approx(122) and asked == pytest.approx([256, 160, 122])


@pytest.mark.parametrize("share", [1.0, 0.5])
def test_the_deviation_is_lengthened_with_the_step(leaning, share):
    found, tracked = leaning(share, FocalGuess(160.0, 40.0, "prior", 192, 144), floor=0.0)
    assert found.found and found.focal == pytest.approx(200, rel=1e-6) and len(tracked) == (2 if share == 1 else 3)
    assert found.deviation == pytest.approx(3 * 0.01 / share * 200, rel=1e-6)
    believed, _ = leaning(share, FocalGuess(160.0, 40.0, "prior", 192, 144), floor=0.0, max_deviation=0.05)
    assert believed.found == (share == 1)


@pytest.mark.parametrize(("spare", "rounds"), [(0, 2), (30, 3), (60, 3), (200, 3)])
def test_all_rounds_together_track_a_bounded_number_of_frames(leaning, spare, rounds):
    """A clip of 60 frames, rounds of 30: the last one that there are frames for gives the result, unsure as it is."""
    found, tracked = leaning(0.5, FocalGuess(160.0, 40.0, "prior", 192, 144), spare=spare)
    assert len(tracked) == rounds and found.found
    settled = rounds > 2
    assert found.focal == pytest.approx(200, rel=1e-6 if settled else 0.2)
    assert found.deviation < 20 if settled else found.deviation > abs(found.focal - 200)


@pytest.mark.parametrize("told_at", [20, 40, None])
def test_a_clip_that_does_not_tell_goes_on(clip, monkeypatch, told_at):
    """The next frames are added to those that are tracked already, as long as the focal length stays the guess."""
    tracked = []

    def track(frame):
        tracked.append((frame.index, round(frame.camera.fx)))
        return Estimate(frame.timestamp, None, Status.TRACKING)

    def profile():
        told = told_at is not None and len(tracked) >= told_at
        return FocalProfile(Minimum(math.log(200 / tracked[-1][1]), 0.01, 0.5), 0.5 if told else 0.001, FLAT)

    replace_tracking(monkeypatch, track, profile)
    frames = [replace(clip[0], index=k, timestamp=k / 30) for k in range(100)]
    guess = FocalGuess(160.0, 40.0, "prior", 192, 144)
    found = calibrate(frames, guess, options=CalibrationOptions(frames=20))
    first = {20: 20, 40: 40, None: 40}[told_at]
    assert tracked[:first] == [(k, 160) for k in range(first)]
    assert found.found == (told_at is not None) and (len(tracked) == first) == (told_at is None)
    assert found.kept == (None if found.found else found.guess)
    assert all(index == k and focal == 200 for k, (index, focal) in enumerate(tracked[first:]))


@pytest.mark.parametrize(("counts", "found"), [((120, 60), True), ((120, 119), True), ((120, 120, 60), False)])
def test_a_last_round_too_short_to_tell_leaves_what_the_one_before_has_found(clip, monkeypatch, counts, found):
    """The first round has a curve in it. One as long that does not tell speaks against the one before, for good."""
    rounds = []

    def profile():
        rounds.append(len(rounds))
        return FocalProfile(Minimum(0.2, 0.01, 0.5), 0.5 if len(rounds) == 1 else 0.001, FLAT)

    track = lambda frame: Estimate(frame.timestamp, None, Status.TRACKING)  # noqa: E731
    replace_tracking(monkeypatch, track, profile, lambda: (counts[0], *counts)[len(rounds)])
    frames = [replace(clip[0], index=k, timestamp=k / 30) for k in range(120)]
    options = CalibrationOptions(spare=1000)
    told = calibrate(frames, FocalGuess(160.0, 40.0, "prior", 192, 144), options=options)
    assert len(rounds) == len(counts) and told.found == found
    if found:
        assert told.focal == pytest.approx(160 * math.exp(0.2)) and told.frames == 120
        assert told.deviation > 0.1 * told.focal, "half of the last step may be left"


def test_what_is_hardly_possible_is_judged_after_the_last_step(leaning):
    """Half of the way lies in the range of the guess, the whole of it does not."""
    narrow = FocalGuess(160.0, 160 * 0.05, "exif", 192, 144)  # 131 to 195 px
    found, _ = leaning(0.5, narrow)
    assert not found.found and (found.focal, found.deviation) == (160.0, narrow.deviation)
    assert "fit 200 px best, which is hardly possible" in found.reason
    assert leaning(0.5, replace(narrow, deviation=160 * 0.06))[0].focal == pytest.approx(200, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("images", "focal"), [("tartanair_v1_60/image_left", 320), ("kitti00_120/image_0", 719)])
def test_the_focal_length_of_a_real_clip_far_from_the_usual_one(data_root, images, focal):
    found = calibrate(dvo.open(data_root / images, fps=10, guess=True))
    assert found.found and found.focal == pytest.approx(focal, rel=0.05)


def test_ignored_pixels_are_not_measured(clip):
    reasons = []
    hidden = [replace(frame, mask=np.zeros((144, 192), bool)) for frame in clip[:3]]
    estimate = calibrate(hidden, options=CalibrationOptions(rounds=1), on_frame=lambda _, e: reasons.append(e.reason))
    assert not estimate.found and reasons == 3 * ["masked image"]


def test_a_still_camera_keeps_the_guess(clip):
    still = [replace(clip[0], index=i, timestamp=i / 30) for i in range(30)]
    found = calibrate(still)
    guess = guess_from_angle(192, 144)
    assert (found.focal, found.deviation, found.source) == (guess.focal, guess.deviation, "prior") and not found.found
    assert "cannot tell (too few frames could be tracked): keeps" in str(found)


def test_frames_of_a_fast_camera_are_left_out(clip):
    options = CalibrationOptions(rounds=1, interval=0.06)
    seen = []
    calibrate(clip[:12], options=options, on_frame=lambda frame, estimate: seen.append(frame.index))
    assert seen == list(range(0, 12, 2))


@pytest.mark.long
def test_frames_that_cannot_be_read_end_the_estimate_only(clip):
    class Broken:
        """Source that can be read again and again, up to a fault."""

        def __iter__(self):
            yield from clip[:6]
            raise DvoError("this image is 64x48", field="frame 6")

    options, read = CalibrationOptions(rounds=1), []

    def live():
        for frame in clip:
            read.append(frame.index)
            yield frame

    assert calibrate(Broken(), options=options) == calibrate(clip[:6], options=options)
    calibrate(live(), options=replace(options, frames=3), on_frame=lambda frame, estimate: None)
    assert len(read) < len(clip), "an iterator is read as far as needed"


def test_a_source_whose_length_is_not_known(clip, tmp_path):
    """One that ends at a time, for example."""
    video, options, seen = tmp_path / "video.avi", CalibrationOptions(rounds=1), []
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 30, (192, 144))
    for frame in clip[:12]:
        writer.write(frame.image)
    writer.release()
    source = dvo.open(video, guess=True, end=0.19)
    with pytest.raises(TypeError, match="not known"):
        len(source)
    calibrate(source, options=options, on_frame=lambda frame, estimate: seen.append(frame.index))
    assert seen == list(range(6))


def test_it_is_part_of_the_public_interface():
    assert dvo.calibrate is calibrate and dvo.SelfCalibration is SelfCalibration


def test_bad_input_is_named():
    with pytest.raises(DvoError, match="no frames"):
        calibrate([])
    with pytest.raises(DvoError, match="rounds"):
        CalibrationOptions(rounds=0)
