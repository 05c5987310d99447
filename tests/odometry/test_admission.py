"""What every odometry asks of its frames before it measures anything: one gate for all of them."""

from dataclasses import replace

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data.inertial import InertialSamples
from dvo.geometry.camera import Camera
from dvo.odometry.load import build_odometry, load
from dvo.odometry.protocol import Status
from dvo.odometry.registry import SYSTEMS
from tests.support import tiny_members
from tests.support.tiny_members import MEMBERS, SETTINGS, network

EVERY = (*MEMBERS, *sorted(SYSTEMS))


def frames(seed, name="", **options):
    """Walls that move; of the system that needs inertial samples, with those of a sensor that lies still."""
    found = tiny_members.frames(seed, **options)
    if name != "msckf":
        return found
    times, here = np.arange(10) / 100, np.array([0.0, 0, 0, 0, 0, 0, 1])
    force, still = np.tile([0, -9.81, 0], (10, 1)), np.zeros((10, 3))
    return [
        replace(frame, inertial=InertialSamples(frame.timestamp - 0.09 + times, still, force, here)) for frame in found
    ]


def build(name):
    return load(name) if name in SYSTEMS else build_odometry(network(name), **SETTINGS.get(name, {}))


def changed(frame, **changes):
    return replace(frame, **changes)


def test_the_odometries_without_weights_are_here():
    assert {"klt-pnp", "keyframe", "direct", "monoslam", "msckf"} <= set(EVERY)


@pytest.mark.parametrize("name", EVERY)
def test_a_frame_that_may_not_be_tracked_is_refused(name):
    odometry, clip = build(name), frames(0, name)
    for frame in clip[:2]:
        odometry.track(frame)
    bent = Camera(80.0, 80.0, 48.0, 36.0, 96, 72, model="radtan", coefficients=(0.1, 0.0, 0.0, 0.0))
    for frame, words in (
        (changed(clip[2], timestamp=clip[1].timestamp), "does not come after"),
        (changed(frames(0, name, size=(112, 72))[2]), "112x72"),
        (changed(clip[2], camera=bent), "radtan"),
        (changed(clip[2], timestamp=float("nan")), "not finite"),
        (changed(clip[2], image=clip[2].image.astype(np.int32)), "int32"),
    ):
        with pytest.raises(DvoError, match=words):
            odometry.track(frame)
    masked = changed(clip[2], mask=np.ones((72, 96), bool))
    if name == "patch_vo":
        odometry.track(masked)
    else:
        with pytest.raises(DvoError, match="does not use masks"):
            odometry.track(masked)
        odometry.track(clip[2])
    first = odometry.finish()
    assert first.frames_read == 3, "what was refused does not count"
    with pytest.raises(DvoError, match="the sequence is finished"):
        odometry.track(clip[3])
    second = odometry.finish()
    assert np.array_equal(second.trajectory.poses_wc, first.trajectory.poses_wc)
    assert np.array_equal(second.map.points, first.map.points)


@pytest.mark.long
@pytest.mark.parametrize("name", EVERY)
def test_an_image_without_content_is_lost_and_says_why(name):
    odometry, clip = build(name), frames(0, name)
    dark = [changed(frame, image=np.zeros_like(frame.image)) for frame in clip[:2]]
    white = changed(clip[7], image=np.full_like(clip[7].image, 255))
    estimates = [odometry.track(frame) for frame in (*dark, *clip[2:7], white)]
    for estimate, reason in (
        (estimates[0], "black image"),
        (estimates[1], "black image"),
        (estimates[-1], "white image"),
    ):
        assert (estimate.status, estimate.pose_wc) == (Status.LOST, None) and estimate.reason == reason
    result = odometry.finish()
    rows = {time for segment in result.segments for time in segment.trajectory.timestamps}
    assert not rows & {clip[0].timestamp, clip[1].timestamp, clip[7].timestamp}


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in EVERY if name != "monoslam"])
def test_a_repeated_image_has_the_pose_and_the_state_of_the_first(name):
    """MonoSLAM measures it: its filter has to learn that the camera stands."""
    odometry, clip = build(name), frames(0, name)
    for number, frame in enumerate(clip):
        first = odometry.track(changed(frame, timestamp=0.2 * number))
        again = odometry.track(changed(frame, timestamp=0.2 * number + 0.1))
        assert again.timestamp == pytest.approx(first.timestamp + 0.1)
        assert (again.status, again.segment, again.reason) == (first.status, first.segment, first.reason)
        assert np.array_equal(np.array(again.pose_wc), np.array(first.pose_wc))
    result = odometry.finish()
    poses = dict(zip(np.round(result.trajectory.timestamps, 6), result.trajectory.poses_wc, strict=True))
    for number in range(len(clip)):
        pair = [poses.get(round(0.2 * number + later, 6)) for later in (0.0, 0.1)]
        assert np.allclose(*pair, atol=1e-9) if pair[0] is not None else pair[1] is None


@pytest.mark.parametrize("name", EVERY)
def test_times_are_numbers_whatever_was_given(name):
    odometry, clip = build(name), frames(0, name)
    for number, frame in enumerate(clip[:4]):
        estimate = odometry.track(changed(frame, timestamp=np.float32(number)))
        assert type(estimate.timestamp) is float and estimate.timestamp == number


def unreadable():
    raise DvoError("cannot be read", field="depth", remedy="replace it")


@pytest.mark.long
@pytest.mark.parametrize("at", [0, 3, 7])
def test_a_frame_that_failed_is_not_there_and_the_next_one_repeats_nothing(at):
    """Its depth is read while it is processed; the image comes again with a depth that can be read."""
    settings = SETTINGS["patch_vo"] | {"scale": {"depth": True}}
    odometry, clip = build_odometry(network("patch_vo"), **settings), frames(0)
    depth = np.ones((72, 96), np.float32)
    for number, frame in enumerate(clip):
        if number == at:
            with pytest.raises(DvoError, match="depth: cannot be read"):
                odometry.track(changed(frame, timestamp=frame.timestamp - 0.01, depth=unreadable))
        estimate = odometry.track(changed(frame, depth=depth))
        assert estimate.timestamp == frame.timestamp
    result = odometry.finish()
    assert set(result.trajectory.timestamps) <= {frame.timestamp for frame in clip}
    assert result.frames_read == len(clip) + 1, "it was read, and is lost"
