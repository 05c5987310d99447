import dataclasses
import pickle

import numpy as np
import pytest

from dvo.core.errors import DvoError
from dvo.data import Frame, InertialSamples, StereoView
from dvo.data.inertial import checked_samples
from dvo.geometry.camera import Camera

CAMERA = Camera(50.0, 50.0, 31.5, 23.5, 64, 48)
IMAGE = np.zeros((48, 64, 3), np.uint8)


def constant_depth():
    return np.full((48, 64), 2.0, np.float32)


def test_images_alone_are_a_frame():
    frame = Frame(3, 0.5, IMAGE, CAMERA)
    assert (frame.depth, frame.right, frame.inertial) == (None, None, None)


def test_values_and_functions_are_both_accepted():
    assert Frame(0, 0.0, IMAGE, CAMERA, depth=constant_depth()).depth[0, 0] == 2
    assert Frame(0, 0.0, IMAGE, CAMERA, depth=constant_depth).depth[0, 0] == 2
    assert Frame(0, 0.0, IMAGE, CAMERA, right=lambda: None).right is None


def test_a_function_is_called_once_and_only_when_its_field_is_read():
    calls = []

    def load():
        calls.append(1)
        return constant_depth()

    frame = Frame(0, 0.0, IMAGE, CAMERA, load)
    assert calls == [] and frame.image is IMAGE
    assert frame.depth is frame.depth and calls == [1]
    other = Frame(1, 0.1, IMAGE, CAMERA)
    assert other.depth is None  # fields of one frame are not those of another


def test_frames_are_frozen_replaced_and_pickled():
    frame = Frame(0, 0.0, IMAGE, CAMERA, depth=constant_depth)
    with pytest.raises(dataclasses.FrozenInstanceError):
        frame.depth = None
    assert dataclasses.replace(frame, index=7).depth[0, 0] == 2
    assert pickle.loads(pickle.dumps(frame)).depth[0, 0] == 2


def test_baseline_is_the_distance_of_the_cameras():
    view = StereoView(IMAGE, CAMERA, np.array([0.3, 0, -0.4, 0, 0, 0, 1]))
    assert view.baseline == pytest.approx(0.5)


def test_samples_between_two_frames_leave_none_out_and_count_none_twice():
    samples = InertialSamples(np.arange(10) / 10, np.arange(30.0).reshape(10, 3), np.ones((10, 3)))
    parts = [samples.between(a, b) for a, b in ((0.0, 0.25), (0.25, 0.3), (0.3, 0.3), (0.3, 5))]
    assert [len(part) for part in parts] == [2, 1, 0, 6]
    assert np.concatenate([part.timestamps for part in parts]).tolist() == samples.timestamps[1:].tolist()
    assert np.concatenate([part.gyro for part in parts]).tolist() == samples.gyro[1:].tolist()


def test_samples_of_shapes_that_do_not_match():
    with pytest.raises(DvoError, match="do not match"):
        InertialSamples(np.zeros(3), np.zeros((3, 3)), np.zeros((2, 3)))


def test_inertial_samples_of_lists_are_arrays_and_others_are_refused() -> None:
    samples = InertialSamples([0, 1], [[0, 0, 1], [0, 0, 2]], np.ones((2, 3), np.float32), [0, 0, 0, 0, 0, 0, 1])  # type: ignore[arg-type]
    parts = (samples.timestamps, samples.gyro, samples.accel, samples.T_camera_imu)
    assert all(isinstance(part, np.ndarray) and part.dtype == np.float64 for part in parts)
    assert checked_samples(samples) is samples
    times, three = np.arange(2.0), np.ones((2, 3))
    for arguments, field in [
        ((None, three, three), "timestamps"), (("ab", three, three), "timestamps"),
        ((times, 3j * three, three), "gyro"),
        ((times, three, [["a", 1, 2]]), "accel"), ((times, three, three, np.eye(4)), "T_camera_imu"),
        ((times, three, three, None, "phone"), "noise"),
    ]:  # fmt: skip
        with pytest.raises(DvoError, match=f"inertial: {field}"):
            InertialSamples(*arguments)  # type: ignore[arg-type]
    wrong = [
        7, np.datetime64("2020"), InertialSamples(times[::-1], three, three),
        InertialSamples(times, three * np.nan, three), InertialSamples(times, three, three, np.zeros(7)),
        InertialSamples(times, three, three, [0, 0, 0, 0, 0, 0, 2]),
    ]  # fmt: skip
    for samples_given in wrong:
        with pytest.raises(DvoError, match="inertial"):
            checked_samples(samples_given)
