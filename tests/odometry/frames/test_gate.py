"""Admission of frames; order, size and intervals of a sequence; content of images."""

import cv2
import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.frame import Frame
from dvo.geometry.camera import Camera
from dvo.odometry.frames.gate import FrameSequence, Gate, missing_content
from dvo.synth.sequence import make_sequence

SHAPE = (240, 320, 3)


def ticks(times, max_gap=4.5):
    sequence = FrameSequence(max_gap)
    return [sequence.tick(time) for time in times]


def test_a_gap_is_told_by_the_usual_interval():
    *regular, gap = ticks([0.0, 0.1, 0.2, 0.3, 5.3])
    assert regular == [None] * 4
    assert gap.seconds == pytest.approx(5.0) and not gap.frozen and "gap of 5.00 s" in str(gap)


def test_a_variable_frame_rate_has_no_gaps():
    rng = np.random.default_rng(0)
    assert ticks(np.cumsum(rng.uniform(0.02, 0.06, 200))) == [None] * 200


def test_a_lower_frame_rate_is_a_gap_only_until_it_is_usual():
    times = [*np.arange(0, 1, 0.1), *np.arange(2, 60, 1.0)]
    found = [gap is not None for gap in ticks(times)]
    assert found[10] and not any(found[:10])


def test_first_frames_of_any_interval_are_no_gap():
    assert ticks([0.0, 7.0]) == [None, None]


def test_repeated_images_are_no_gap_in_time_but_a_frozen_image():
    sequence = FrameSequence(4.5)
    for time in (0.0, 0.1, 0.2):
        assert sequence.tick(time) is None
    for time in np.arange(0.3, 3.0, 0.1):
        sequence.repeat(time)
    gap = sequence.tick(3.0)
    assert gap.frozen and "frozen" in str(gap)
    assert gap.seconds == pytest.approx(2.7, abs=0.11)


def test_every_second_image_repeated_is_no_gap():
    sequence = FrameSequence(4.5)
    for step in range(40):
        assert sequence.tick(step / 30) is None
        sequence.repeat(step / 30 + 1 / 60)


def test_an_interruption_is_a_gap_whatever_its_length():
    sequence = FrameSequence(4.5)
    assert sequence.tick(0.0, "clock set back") is None, "nothing before it"
    assert [sequence.tick(0.1 * i) for i in range(1, 6)] == [None] * 5
    gap = sequence.tick(0.6, "clock set back")
    assert str(gap) == "clock set back" and not gap.frozen
    assert sequence.tick(0.7) is None and sequence.tick(5.7).reason == ""


@pytest.mark.parametrize("rate", [20, 30])
@pytest.mark.parametrize("taken", ["every second", "one of three"])
def test_dropped_frames_of_which_nothing_is_told_are_few_gaps(rate, taken):
    """After a start with close frames, of a hundred frames; each of the many others would cost a break."""
    numbers = np.arange(300)
    kept = (numbers % 2 == 0) if taken == "every second" else np.random.default_rng(1).random(300) < 1 / 3
    kept[:5] = True
    assert sum(gap is not None for gap in ticks(numbers[kept] / rate)) <= (0 if taken == "every second" else 3)


def test_a_rate_that_falls_is_a_gap_twice_at_most():
    found = [gap is not None for gap in ticks([0.0, 0.05, 0.1, *np.arange(1, 20, 0.4)])]
    assert 1 <= sum(found) <= 2 and not any(found[6:])


def test_each_of_several_equal_dropouts_is_a_gap():
    """A steady camera that is covered for a while, again and again."""
    times, at = [], 0.0
    for _ in range(5):
        times += [at + k / 30 for k in range(12)]
        at = times[-1] + 0.6
    assert sum(gap is not None for gap in ticks(times)) == 4


def test_what_was_received_is_no_gap():
    sequence = FrameSequence(4.5)
    assert [sequence.tick(0.05 * i) for i in range(10)] == [None] * 10
    assert sequence.tick(1.5, silence=0.06) is None
    assert str(sequence.tick(4.5, silence=2.0)) == "gap of 2.00 s"
    sequence.repeat(5.5, silence=0.05)
    assert sequence.tick(5.55).frozen, "an old image for a second"


def test_order_and_size():
    def frame(time, width=64):
        image = np.zeros((48, width, 3), np.uint8)
        return Frame(3, time, image, Camera(50.0, 50.0, width / 2, 24.0, width, 48))

    sequence = FrameSequence(4.5)
    sequence.check(frame(1.0))
    sequence.tick(1.0)
    for time in (1.0, 0.5):
        with pytest.raises(DvoError, match="frame 3: time .* does not come after"):
            sequence.check(frame(time))
    with pytest.raises(DvoError, match="is 80x48, the frames before are 64x48"):
        sequence.check(frame(2.0, width=80))
    sequence.check(frame(2.0))


def admitted_by(gate, frame):
    with gate.admit(frame) as admitted:
        return admitted


def test_a_frame_whose_processing_failed_is_not_repeated():
    """What the odometry knows of the image before it belongs to another one."""
    camera, image = Camera(50.0, 50.0, 31.5, 23.5, 64, 48), np.zeros((48, 64, 3), np.uint8)
    gate = Gate(pixels=None)
    with pytest.raises(DvoError, match="no depth"), gate.admit(Frame(0, 0.0, image, camera)):
        raise DvoError("no depth")
    assert not admitted_by(gate, Frame(1, 0.1, image, camera)).repeated
    assert admitted_by(gate, Frame(2, 0.2, image, camera)).repeated
    with pytest.raises(KeyboardInterrupt), gate.admit(Frame(3, 0.3, image, camera)):
        raise KeyboardInterrupt
    assert not admitted_by(gate, Frame(4, 0.4, image, camera)).repeated


def test_a_gate_keeps_images_of_its_own():
    """A caller may use its buffers for the next frame."""
    camera, image, mask = (
        Camera(50.0, 50.0, 31.5, 23.5, 64, 48),
        np.zeros((48, 64, 3), np.uint8),
        np.ones((48, 64), bool),
    )
    image[:, ::16] = 200
    gate = Gate(pixels=None, masks=True)
    first = admitted_by(gate, Frame(0, 0.0, image, camera, mask=mask))
    before = first.image.copy()
    image[:], mask[:] = np.roll(image, 5, 1), False
    assert np.array_equal(first.image, before) and first.mask.all()
    assert not admitted_by(gate, Frame(1, 0.1, image, camera)).repeated


@pytest.mark.parametrize(("pixels", "size"), [(None, (65, 49)), (0, (64, 48)), (32 * 24, (32, 32))])
def test_a_gate_gives_the_working_image(pixels, size):
    camera, image = Camera(50.0, 50.0, 32.0, 24.0, 65, 49), np.zeros((49, 65, 3), np.uint8)
    admitted = admitted_by(Gate(pixels), Frame(0, 0.0, image, camera))
    assert admitted.image.shape == (size[1], size[0], 3) and (admitted.camera.width, admitted.camera.height) == size
    assert admitted.problem == "black image" and admitted.mask is None and admitted.gap is None


def flat(level, noise=0.0, vignetting=0.0, seed=0):
    image = np.full(SHAPE, float(level))
    image += np.random.default_rng(seed).normal(0, 1, SHAPE) * noise
    y, x = np.mgrid[-1:1:240j, -1:1:320j]
    image += vignetting * (x**2 + y**2)[..., None]
    return image.round().clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [0, 1, 3, 6])
@pytest.mark.parametrize("vignetting", [0, 5, -12])
@pytest.mark.parametrize(("level", "reason"), [(0, "black image"), (8, "black image"), (120, "image without content"),
                                               (250, "white image"), (255, "white image")])  # fmt: skip
def test_flat_images_have_no_content(level, reason, noise, vignetting):
    assert missing_content(flat(level, noise, vignetting)) == reason


@pytest.fixture(scope="module")
def view():
    return make_sequence(7, frames=1, family="room", kind="handheld").frame(0).image


@pytest.mark.parametrize("light", [1.0, 0.3, 0.1, 0.05])
def test_a_dim_view_has_content(view, light):
    noisy = view * light + np.random.default_rng(0).normal(0, 1, view.shape)
    assert missing_content(noisy.round().clip(0, 255).astype(np.uint8)) == ""


def test_an_overexposed_view_has_content(view):
    assert missing_content((view.astype(float) * 2 + 120).clip(0, 255).astype(np.uint8)) == ""


def test_one_picture_on_a_bare_wall_is_content():
    wall = flat(200, 1.0)
    cv2.rectangle(wall, (150, 100), (190, 130), (90, 60, 40), -1)
    assert missing_content(wall) == ""


def test_strong_noise_is_left_to_the_measurements():
    """It could be a fine texture in front of a moving camera."""
    assert missing_content(np.random.default_rng(0).integers(0, 256, SHAPE, np.uint8)) == ""
