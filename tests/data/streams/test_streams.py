import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from dvo.commands.run import track
from dvo.core.errors import DvoError
from dvo.data import Frame, open_source, stream
from dvo.data.frame_checks import checked_frame
from dvo.geometry.camera import Camera
from dvo.session.results import results_folder
from dvo.session.session import run

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)


def images(count=5):
    return (np.full((48, 64, 3), 10 * i % 256, np.uint8) for i in range(count))


def test_three_ways_to_give_times():
    stamped = ((0.5 * i, image) for i, image in enumerate(images()))
    for frames in (
        stream(images(), CAMERA, fps=2),
        stream(images(), CAMERA, timestamps=itertools.count(0, 0.5)),
        stream(stamped, CAMERA),
    ):
        found = list(frames)
        assert [(f.index, f.timestamp, int(f.image[0, 0, 0])) for f in found] == [(i, i / 2, 10 * i) for i in range(5)]
        assert all(f.camera == CAMERA and f.depth is None for f in found)


def test_the_rest_of_a_source():
    frames = stream(images(), CAMERA, fps=2, name="webcam")
    assert (frames.name, frames.kind, frames.frame_count) == ("webcam", "stream", None)
    assert frames.groundtruth is None and frames.warnings == []


def test_one_element_at_a_time():
    taken = []
    endless = (taken.append(i) or np.zeros((48, 64, 3), np.uint8) for i in itertools.count())
    first = list(itertools.islice(stream(endless, CAMERA, fps=10), 3))
    assert len(first) == 3 and taken == [0, 1, 2]


def test_a_second_pass_is_refused():
    frames = stream(images(), CAMERA, fps=2)
    assert len(list(frames)) == 5
    with pytest.raises(DvoError, match="only once.*list"):
        iter(frames)


def test_frames_pass_as_they_are():
    own = [Frame(i, 0.1 * i, np.zeros((48, 64, 3), np.uint8), CAMERA, depth=np.ones((48, 64))) for i in range(3)]
    assert [a is b for a, b in zip(stream(own), own, strict=True)] == [True] * 3


def test_late_images_are_dropped_with_a_warning():
    frames = stream(images(), CAMERA, timestamps=[0, 0.2, 0.1, 0.2, 0.3])
    assert [frame.index for frame in frames] == [0, 1, 4]
    assert frames.warnings == ["2 images were not later than the one before and were dropped, the first is 2"]


def regular(*starts, count=10):
    """Times of a clock of ten images a second that is set to each start in turn."""
    return [start + 0.1 * i for start in starts for i in range(count)]


@pytest.mark.parametrize("start", [0.0, -5.0, 0.35, -1e9, 1e9])
def test_a_clock_that_is_set_back_is_an_interruption(start):
    """Without it, every later image is dropped until the clock has made up for it."""
    times = regular(1.0, 1.0 + start if start < 1e9 else 2.0)
    times = times if start < 1e9 else [1e9 + time for time in times[:10]] + times[10:]
    frames = stream(images(20), CAMERA, timestamps=times)
    found = list(frames)
    assert [frame.index for frame in found] == list(range(20))
    stamps = np.array([frame.timestamp for frame in found])
    assert np.array_equal(stamps[:10], times[:10]) and np.allclose(np.diff(stamps), 0.1, atol=1e-6)
    assert [bool(frame.interruption) for frame in found] == [index == 10 for index in range(20)]
    assert found[10].interruption == f"clock set back by {times[9] - times[10]:.2f} s"
    assert frames.warnings == ["the clock was set back before image 10"]


def test_a_clock_that_is_set_back_again_and_goes_on():
    frames = stream(images(40), CAMERA, timestamps=regular(5.0, 3.0, 3.0, 100.0))
    found = list(frames)
    assert [frame.index for frame in found if frame.interruption] == [10, 20]
    assert len(found) == 40 and (np.diff([frame.timestamp for frame in found]) > 0).all()
    assert np.isclose(found[30].timestamp - found[29].timestamp, 96.1), "forward is a gap in time"
    assert frames.warnings == ["the clock was set back 2 times, first before image 10"]


@pytest.mark.parametrize(
    ("times", "kept"),
    [
        ([0, 1, 2, 0.5, 0.6, 3, 4], [0, 1, 2, 5, 6]),  # two stragglers
        ([0, 1, 2, 2, 2, 2, 2, 3], [0, 1, 2, 7]),  # a clock that stands
        ([6, 5, 4, 3, 2, 1, 0], [0]),  # one that runs backward
        ([0, 1, 2, -1, 3, -2, 4, -3, 5], [0, 1, 2, 4, 6, 8]),
        ([0, 1, 2, 0.5, 0.2, 0.3], [0, 1, 2]),
        ([0, 1, 2, 0.5, 0.2, 0.3, 0.4], [0, 1, 2, 4, 5, 6]),
        ([1, 0], [0]),
        ([5, 0, 1, 2], [0, 1, 2, 3]),
    ],
)
def test_images_that_are_late_are_not_a_clock_that_was_set_back(times, kept):
    frames = stream(images(len(times)), CAMERA, timestamps=times)
    assert [frame.index for frame in frames] == kept
    late = len(times) - len(kept)
    assert sum(f"{late} images were not later" in text for text in frames.warnings) == (late > 0)


def test_frames_of_a_clock_that_was_set_back_keep_their_fields():
    loaded = []
    own = [
        Frame(i, time, np.zeros((48, 64, 3), np.uint8), CAMERA, depth=lambda: loaded.append(1))
        for i, time in enumerate(regular(9.0, 0.0))
    ]
    found = list(stream(own))
    assert not loaded and all(frame.image is given.image for frame, given in zip(found, own, strict=True))
    assert own[10].timestamp == 0.0 and own[10].interruption == "" and found[10].interruption


@pytest.mark.parametrize("stride", [1, 3])
def test_a_run_tells_of_a_clock_that_was_set_back(fake_odometry, stride):
    done = run(fake_odometry(), stream(images(20), CAMERA, timestamps=regular(9.0, 0.0)), stride=stride)
    assert len(done.result.trajectory) == 20 and "the clock was set back before image 10" in done.warnings
    (found,) = done.result.breaks
    assert found.reason == "clock set back by 9.90 s" and found.frames == 0 and not found.new_segment
    assert found.start < 9.95 + 0.1 * stride and found.end > found.start


def test_a_run_tells_it_once(fake_odometry):
    """An odometry that tells of a break at that place has the word."""
    done = run(fake_odometry(lost=range(9, 12)), stream(images(20), CAMERA, timestamps=regular(9.0, 0.0)))
    assert len(done.result.breaks) == 1


def test_grey_and_distorted_images(make):
    grey = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
    (frame,) = stream([grey], CAMERA, fps=1)
    assert frame.image.shape == (48, 64, 3) and np.array_equal(frame.image[..., 2], grey)
    # a stream undistorts as a source does
    lens = Camera(517.3, 516.5, 318.6, 255.3, 640, 480, "radtan", (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    calib = make.text("c.txt", "517.3 516.5 318.6 255.3 0.2624 -0.9531 -0.0054 0.0026 1.1633")
    folder = make.images("clip", ["0.png"], 640, 480)
    raw, straight = (next(iter(open_source(folder, calib=calib, undistort=u))) for u in (False, True))
    (found,) = stream([raw.image], lens, fps=1)
    assert found.camera == straight.camera and np.array_equal(found.image, straight.image)
    (kept,) = stream([raw.image], lens, fps=1, undistort=False)
    assert kept.camera == lens and np.array_equal(kept.image, raw.image)


def test_any_memory_layout_and_tensors():
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    wide = np.zeros((96, 200, 4), np.uint8)
    wide[::2, 10:138:2, :3] = rgb
    forms = [
        rgb,
        np.asfortranarray(rgb),
        rgb[::-1].copy()[::-1],
        wide[::2, 10:138:2, :3],
        rgb[..., ::-1].copy()[..., ::-1],
    ]
    forms += [torch.from_numpy(rgb), torch.from_numpy(rgb).permute(2, 0, 1), torch.from_numpy(wide)[::2, 10:138:2, :3]]
    assert sum(isinstance(form, np.ndarray) and form.flags.carray for form in forms) == 1
    for camera in (CAMERA, replace(CAMERA, model="radtan", coefficients=(-0.2, 0.05, 0.0, 0.0))):
        first, *others = stream(forms, camera, fps=1)
        assert all(np.array_equal(other.image, first.image) and other.image.flags.c_contiguous for other in others)
        assert np.array_equal(first.image, rgb) == (camera is CAMERA) and len(others) == 7


def test_images_are_converted_as_those_of_frames():
    rgb = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    rgba = np.dstack([rgb, np.full((48, 64), 9, np.uint8)])
    forms = [rgba, rgb.astype(np.uint16) * 257, rgb / 255, (rgb / 255).astype(np.float32), Image.fromarray(rgba)]
    forms += [torch.from_numpy(rgba).permute(2, 0, 1), torch.from_numpy(rgb / 255).float()]
    found = list(stream(forms, CAMERA, fps=1))
    assert len(found) == 7 and all(np.array_equal(frame.image, rgb) for frame in found)
    assert all(frame.image.dtype == np.uint8 and frame.image.flags.carray for frame in found)
    (grey,) = stream([rgb[..., 0] / 255], CAMERA, fps=1)
    assert np.array_equal(grey.image, rgb[..., :1].repeat(3, axis=2))
    assert np.array_equal(checked_frame(Frame(0, 0.0, rgba, CAMERA)).image, found[0].image)


def test_views_are_tracked_as_their_copies(fake_odometry):
    """Frames that are not contiguous reach an odometry as contiguous arrays of the same pixels."""
    whole = np.random.default_rng(0).integers(0, 256, (6, 48, 128, 3), dtype=np.uint8)
    views = [Frame(i, 0.1 * i, image[:, ::2][::-1], CAMERA) for i, image in enumerate(whole)]
    odometry = fake_odometry()
    assert not views[0].image.flags.c_contiguous and run(odometry, views).frames_fed == 6
    for view, frame in zip(views, odometry.frames, strict=True):
        assert frame.image.flags.carray and np.array_equal(frame.image, view.image)


@pytest.mark.parametrize(
    ("items", "options", "match"),
    [
        ([np.zeros((48, 64, 3), np.uint8)], {}, "no time for image 0"),
        ([np.zeros((48, 64, 3), np.uint8)] * 2, {"timestamps": [0.5]}, "no time for image 1"),
        ([(float("nan"), np.zeros((48, 64, 3), np.uint8))], {}, "no time for image 0"),
        ([np.full((48, 64, 3), 2.0, np.float32)], {"fps": 1}, "frame 0: image: float values must lie in 0..1"),
        ([np.zeros((48, 64, 3), np.int64)], {"fps": 1}, "has pixels of type int64"),
        ([np.zeros((48, 64, 2), np.uint8)], {"fps": 1}, "no image of 1, 3 or 4 channels"),
        (["image"], {"fps": 1}, "expected an array, got an object of type str"),
        ([np.zeros((24, 32, 3), np.uint8)], {"fps": 1}, "stream: frame 0: camera: .* 64x48 image, but .* 32x24"),
        ([np.zeros((48, 64, 3), np.uint8)], {"fps": 1, "camera": None}, "no camera"),
    ],
)
def test_elements_that_are_no_frames(items, options, match):
    with pytest.raises(DvoError, match=match) as caught:
        list(stream(items, **{"camera": CAMERA, **options}))
    assert caught.value.remedy


def test_options_that_do_not_fit():
    with pytest.raises(DvoError, match="both"):
        stream(images(), CAMERA, timestamps=[0], fps=1)
    with pytest.raises(DvoError, match="positive"):
        stream(images(), CAMERA, fps=0)


def test_a_session_and_the_command_line_take_a_stream(fake_odometry, tmp_path):
    done = run(fake_odometry(), stream(images(20), CAMERA, fps=10), stride=3)
    assert len(done.result.trajectory) == 20
    with results_folder(tmp_path / "out", "clip") as folder:
        code = track(fake_odometry(), stream(images(20), CAMERA, fps=10), folder, facts={})
    assert code == 0 and (tmp_path / "out/trajectory.txt").is_file()
